"""Source lines of the exponential midpoint rule; the rule itself stands in ``stiffness``."""

from __future__ import annotations

from collections.abc import Sequence

from certbound.arrays import Array
from certbound.simulation.stepping import Exponential, StepModel
from certbound.simulation.tape_text import Parameters, each, indent, linear_form, vector
from certbound.simulation.wide_text import product


def pair_begins(model: StepModel, first: str) -> str:
    """The condition that step k is the first of a pair; pairs begin anew where inputs change, and at step ``first``."""
    steps = f"(k - {first})" if first else "k"
    return f"{steps} % {model.constant} % 2 == 0" if model.constant and not first else f"{steps} % 2 == 0"


def move_lines(
    model: StepModel, names: tuple[str, str, str], drift: tuple[Sequence[str], Sequence[str]], begins: str,
    p: Parameters, noise: Sequence[str] = (),
) -> list[str]:  # fmt: skip
    """Lines that take a state a step on.

    Parameters
    ----------
    model : StepModel
        Of the exponential scheme.
    names : tuple of str
        Letters of the state, of the new state, and of the rest of the drift, which is kept for two steps.
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
    state, new, rest = names
    write = _wide if p.wide else _narrow
    return write(model.exponential, state, new, rest, drift, begins, p, noise)


def _narrow(
    scheme: Exponential, state: str, new: str, rest: str, drift: tuple[Sequence[str], Sequence[str]], begins: str,
    p: Parameters, noise: Sequence[str],
) -> list[str]:  # fmt: skip
    n = len(scheme.base)

    def form(matrix: Array, source: str) -> list[str]:
        return [linear_form(row.tolist(), vector(source, n), p) for row in matrix]

    def rests(at: str) -> list[str]:
        return [f"{rest}_{i} = f_{i} - ({value})" if value != "0.0" else f"{rest}_{i} = f_{i}"
                for i, value in enumerate(form(scheme.base, at))]  # fmt: skip

    shocks = list(noise) or ["0.0"] * n
    moved = [f"{new}_{i} = {value}" + ("" if shock == "0.0" else f" + ({shock})")
             for i, (value, shock) in enumerate(zip(form(scheme.move, state), shocks))]  # fmt: skip
    lead = [f"lead_{i} = {new}_{i} + {value}" for i, value in enumerate(form(scheme.lead, rest))]
    taken = [*drift[0], *rests(state), *lead, *drift[1], *rests("lead")]
    answer = [f"{new}_{i} = {new}_{i} + {value}" for i, value in enumerate(form(scheme.response, rest))]
    return [*moved, f"if {begins}:", *indent(taken), *answer]


def _wide(
    scheme: Exponential, state: str, new: str, rest: str, drift: tuple[Sequence[str], Sequence[str]], begins: str,
    p: Parameters, noise: Sequence[str],
) -> list[str]:  # fmt: skip
    n = len(scheme.base)

    def rests(at: str) -> list[str]:
        return [f"{rest}[:] = f", *product(-scheme.base, at, rest, p)]

    lead = [f"lead[:] = {new}", *product(scheme.lead, rest, "lead", p)]
    taken = [*drift[0], *rests(state), *lead, *drift[1], *rests("lead")]
    begin = each(f"{new}_{{0}} = 0.0", n, p)
    moved = [*begin, *product(scheme.move, state, new, p), *noise]
    return [*moved, f"if {begins}:", *indent(taken), *product(scheme.response, rest, new, p)]
