"""Source lines of the exponential midpoint rule; the rule itself stands in ``stiffness``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from certbound.arrays import Array
from certbound.simulation.stepping import Exponential, StepModel
from certbound.simulation.tape_text import Parameters, each, indent, linear_form, vector
from certbound.simulation.wide_text import product


def pair_begins(model: StepModel, first: str) -> str:
    """The condition that step k is the first of a pair; pairs begin anew where inputs change, and at step ``first``."""
    steps = f"(k - {first})" if first else "k"
    return f"{steps} % {model.constant} % 2 == 0" if model.constant and not first else f"{steps} % 2 == 0"


def move_lines(
    model: StepModel, names: tuple[str, str, str, str], drift: tuple[Sequence[str], Sequence[str]], begins: str,
    p: Parameters, noise: Sequence[str] = (),
) -> list[str]:  # fmt: skip
    """Lines that take a state a step on.

    Parameters
    ----------
    model : StepModel
        Of the exponential scheme.
    names : tuple of str
        Letters of the state, of the new state, and of what the rest of the drift adds in this step and in the next one.
    drift : tuple of lists of str
        Lines that set the drift, f, at the state and now, and at the state "lead" a step later.
    begins : str
        Whether the step is the first of a pair.
    p : Parameters
        Numbers of the kernel.
    noise : list of str
        In arrays: lines that add the noise to the new state. Else: one expression a state, "0.0" for none.
    """
    assert model.exponential is not None
    n, (_, new, push, later) = model.dimension, names
    moved, taken, settled = (_wide if p.wide else _narrow)(model.exponential, names, drift, p, noise)
    lines = [*moved, f"if {begins}:", *indent([*taken, *settled])]
    entry = "{0}[{{0}}]" if p.wide else "{0}_{{0}}"
    to, now, then = (entry.format(name) for name in (new, push, later))
    if np.any(model.exponential.second):
        lines += ["else:", *indent(each(f"{now} = {then}", n, p))]
    return [*lines, *each(f"{to} = {to} + {now}", n, p)]


_Lines = tuple[list[str], list[str], list[str]]
"""Lines that move the state by its linear part, that take the rest of the drift anew, and that keep what it adds."""


def _narrow(
    scheme: Exponential, names: tuple[str, str, str, str], drift: tuple[Sequence[str], Sequence[str]], p: Parameters,
    noise: Sequence[str],
) -> _Lines:  # fmt: skip
    n, (state, new, push, later) = len(scheme.base), names

    def form(matrix: Array, source: str) -> list[str]:
        return [linear_form(row.tolist(), vector(source, n), p) for row in matrix]

    def rests(target: str, at: str) -> list[str]:
        return [f"{target}_{i} = f_{i} - ({value})" for i, value in enumerate(form(scheme.base, at))]

    shocks = list(noise) or ["0.0"] * n
    moved = [f"{new}_{i} = {value}" + ("" if shock == "0.0" else f" + ({shock})")
             for i, (value, shock) in enumerate(zip(form(scheme.move, state), shocks))]  # fmt: skip
    lead = [f"lead_{i} = {new}_{i} + {value}" for i, value in enumerate(form(scheme.lead, "change"))]
    taken = [*drift[0], *rests("change", state), *lead, *drift[1], *rests("rest", "lead")]
    settled = [f"{push}_{i} = {value}" for i, value in enumerate(form(scheme.response, "rest"))]
    if np.any(scheme.second):
        settled += [f"change_{i} = rest_{i} - change_{i}" for i in range(n)]
        settled += [f"{later}_{i} = {push}_{i} + {value}" for i, value in enumerate(form(scheme.second, "change"))]
        settled += [f"{push}_{i} = {push}_{i} - ({value})" for i, value in enumerate(form(scheme.first, "change"))]
    return moved, taken, settled


def _wide(
    scheme: Exponential, names: tuple[str, str, str, str], drift: tuple[Sequence[str], Sequence[str]], p: Parameters,
    noise: Sequence[str],
) -> _Lines:  # fmt: skip
    n, (state, new, push, later) = len(scheme.base), names

    def rests(target: str, at: str) -> list[str]:
        return [f"{target}[:] = f", *product(-scheme.base, at, target, p)]

    moved = [*each(f"{new}_{{0}} = 0.0", n, p), *product(scheme.move, state, new, p), *noise]
    lead = [f"lead[:] = {new}", *product(scheme.lead, "change", "lead", p)]
    taken = [*drift[0], *rests("change", state), *lead, *drift[1], *rests("rest", "lead")]
    settled = [*each(f"{push}[{{0}}] = 0.0", n, p), *product(scheme.response, "rest", push, p)]
    if np.any(scheme.second):
        settled += [f"for i in range({n}):", "    change[i] = rest[i] - change[i]"]
        settled += [f"{later}[:] = {push}", *product(scheme.second, "change", later, p)]
        settled += product(-scheme.first, "change", push, p)
    return moved, taken, settled
