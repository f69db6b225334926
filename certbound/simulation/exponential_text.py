"""Source lines of the exponential midpoint rule; the rule itself stands in ``stiffness``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.simulation.stepping import Exponential, StepModel
from certbound.simulation.tape_text import Parameters, indent, linear_form, vector
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
        Letters of the state, of the new state, of the rest of the drift, and of what it adds in each of two steps.
    drift : tuple of lists of str
        Lines that set the drift, f, at the state and now, and at the state "lead" a step later.
    begins : str
        Whether the step is the first of a pair.
    p : Parameters
        Numbers of the kernel.
    noise : list of str
        In arrays: lines that add the noise to the new state. Else: one expression a state, "0.0" for none.
    """
    scheme, n, (state, new, rest, push) = model.exponential, model.dimension, names
    assert scheme is not None
    text = _Arrays(n, p) if p.wide else _Variables(n, p)
    first = [*drift[0], *text.rest("change", scheme, state), *text.sum("lead", new, scheme.lead, "change")]
    first += [*drift[1], *text.rest(rest, scheme, "lead"), *text.sum(push, "", scheme.response, rest)]
    lines = text.moved(new, scheme.move, state, noise)
    if not np.any(scheme.second):
        return [*lines, f"if {begins}:", *indent(first), *text.add(new, push)]
    first += [*text.difference("change", rest, "change"), *text.sum("change", "", -scheme.first, "change")]
    second = [*text.added("lead", new, push), *drift[1], *text.rest("change", scheme, "lead")]
    second += [*text.difference("change", "change", rest), *text.sum("change", "", scheme.second, "change")]
    lines += [f"if {begins}:", *indent(first), "else:", *indent(second)]
    return [*lines, *text.add(new, push), *text.add(new, "change")]


@dataclass(frozen=True)
class _Variables:
    """Lines over states that are variables."""

    n: int
    p: Parameters

    def _form(self, matrix: Array, source: str) -> list[str]:
        return [linear_form(row.tolist(), vector(source, self.n), self.p) for row in matrix]

    def moved(self, target: str, matrix: Array, state: str, noise: Sequence[str]) -> list[str]:
        shocks = list(noise) or ["0.0"] * self.n
        return [f"{target}_{i} = {value}" + ("" if shock == "0.0" else f" + ({shock})")
                for i, (value, shock) in enumerate(zip(self._form(matrix, state), shocks))]  # fmt: skip

    def rest(self, target: str, scheme: Exponential, state: str) -> list[str]:
        return [f"{target}_{i} = f_{i} - ({value})" for i, value in enumerate(self._form(scheme.base, state))]

    def sum(self, target: str, first: str, matrix: Array, source: str) -> list[str]:
        """The target as ``first`` and matrix . source; the source may be the target, and has a copy then."""
        copied = [f"copy_{i} = {source}_{i}" for i in range(self.n)] if source == target else []
        forms = self._form(matrix, "copy" if copied else source)
        begins = [f"{target}_{i} = " + (f"{first}_{i} + " if first else "") for i in range(self.n)]
        return copied + [begin + form for begin, form in zip(begins, forms)]

    def difference(self, target: str, first: str, second: str) -> list[str]:
        return [f"{target}_{i} = {first}_{i} - {second}_{i}" for i in range(self.n)]

    def added(self, target: str, first: str, second: str) -> list[str]:
        return [f"{target}_{i} = {first}_{i} + {second}_{i}" for i in range(self.n)]

    def add(self, target: str, source: str) -> list[str]:
        return self.added(target, target, source)


@dataclass(frozen=True)
class _Arrays:
    """Lines over states that are arrays."""

    n: int
    p: Parameters

    def _each(self, line: str) -> list[str]:
        return [f"for i in range({self.n}):", "    " + line]

    def moved(self, target: str, matrix: Array, state: str, noise: Sequence[str]) -> list[str]:
        return [*self._each(f"{target}[i] = 0.0"), *product(matrix, state, target, self.p), *noise]

    def rest(self, target: str, scheme: Exponential, state: str) -> list[str]:
        return [f"{target}[:] = f", *product(-scheme.base, state, target, self.p)]

    def sum(self, target: str, first: str, matrix: Array, source: str) -> list[str]:
        copied = [f"copy[:] = {source}"] if source == target else []
        begin = self._each(f"{target}[i] = {first}[i]" if first else f"{target}[i] = 0.0")
        return [*copied, *begin, *product(matrix, "copy" if copied else source, target, self.p)]

    def difference(self, target: str, first: str, second: str) -> list[str]:
        return self._each(f"{target}[i] = {first}[i] - {second}[i]")

    def added(self, target: str, first: str, second: str) -> list[str]:
        return self._each(f"{target}[i] = {first}[i] + {second}[i]")

    def add(self, target: str, source: str) -> list[str]:
        return self.added(target, target, source)
