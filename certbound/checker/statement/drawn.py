"""Constants that are drawn once: what is known of their laws, and the probabilities of cells of their values.

A constant is mean + w, w of a law with one entry; a law with single values takes mean + scale * value, as floats are
added and multiplied. The average of bounds b over disjoint cells is at most 1 - sum P(cell) (1 - b): what lies in no
cell counts as failing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

from flint import arb

from certbound.checker.reading import Record, text
from certbound.checker.report import BALL, FUNCTION, Budget
from certbound.checker.words import quoted
from certbound.errors import CertificateError

Range = tuple[float, float]
_SUM = arb(2) ** -39
_TABLES = {"discrete": "values", "histogram": "edges"}
_LEVELS = {
    "gaussian": ("std", "variance", "covariance"), "uniform": ("halfwidth",), "triangular": ("halfwidth",),
    "laplace": ("scale",), "rademacher": ("scale",), "discrete": ("scale",), "histogram": ("scale",),
}  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Drawn:
    """A constant by its law: P(w <= x), or single values with their probabilities."""

    place: int  # among the disturbances
    mean: float
    below: Callable[[arb], arb] | None = None
    atoms: tuple[tuple[float, arb], ...] = ()
    size: int = 1  # of the law's table

    @property
    def work(self) -> int:
        """Units of work of one probability."""
        return 3 * FUNCTION + 12 * BALL * self.size

    def probability(self, low: float, high: float) -> arb:
        """P(low <= constant <= high)."""
        if self.below is None:
            return sum((p for value, p in self.atoms if low <= value <= high), arb(0))
        shift = arb(self.mean)
        return self.below(arb(high) - shift) - self.below(arb(low) - shift)

    def apart(self, one: Range, other: Range) -> bool:
        """Whether nothing that can be drawn lies in two ranges but with probability 0."""
        if self.below is None:
            return one[1] < other[0] or other[1] < one[0]
        return one[1] <= other[0] or other[1] <= one[0]


def read_drawn(value: object, path: str, disturbances: Sequence[str]) -> tuple[Drawn, ...]:
    """The constants of a problem, by the names of disturbances; CertificateError where they make no sense."""
    if value is None:
        return ()
    record = Record(value, path, (), disturbances)
    return tuple(_drawn(record[name], record.at(name), disturbances.index(name)) for name in record.value)


def _drawn(value: object, path: str, place: int) -> Drawn:
    name = text(value.get("law") if isinstance(value, dict) else None, f"{path}.law", 200)
    if name not in _LEVELS:
        raise CertificateError(f"`{path}.law` must be one of {', '.join(_LEVELS)}, got {quoted(name, 40)}.")
    record = Record(value, path, ("law", "level", "value", "mean"), ("tables",) if name in _TABLES else ())
    level, mean, size = record.text("level"), record.number("mean"), record.number("value", least=0.0)
    if level not in _LEVELS[name] or not size > 0:
        raise CertificateError(f"`{path}` must have a positive {' or '.join(_LEVELS[name])}.")
    if name == "rademacher":
        return Drawn(place=place, mean=mean, atoms=((mean - size, arb(1) / 2), (mean + size, arb(1) / 2)))
    if name in _TABLES:
        return _tabled(name, record, place, mean, size)
    spread = arb(size) if level not in ("variance", "covariance") else arb(size).sqrt()
    return Drawn(place=place, mean=mean, below=lambda x: _BELOW[name](x / spread))


def _tabled(name: str, record: Record, place: int, mean: float, size: float) -> Drawn:
    tables = Record(record["tables"], record.at("tables"), (_TABLES[name], "probabilities"))
    weights = [arb(weight) for weight in tables.array("probabilities", None)]
    rows = tables.array(_TABLES[name], len(weights) + (name == "histogram"))
    whole = sum(weights, arb(0))
    if not weights or any(weight < 0 for weight in weights) or not abs(whole - 1) <= _SUM:
        raise CertificateError(f"`{tables.at('probabilities')}` must not be negative, and sum to 1.")
    if any(b <= a for a, b in pairwise(rows)):
        raise CertificateError(f"`{tables.at(_TABLES[name])}` must rise.")
    shares = [weight / whole for weight in weights]
    if name == "discrete":
        values = [mean + size * row for row in rows]
        if not all(map(math.isfinite, values)) or len(set(values)) < len(values):
            raise CertificateError(f"`{tables.at('values')}` must be different finite numbers.")
        return Drawn(place=place, mean=mean, atoms=tuple(zip(values, shares)), size=len(values))
    centre = sum((p * (arb(a) + arb(b)) / 2 for p, (a, b) in zip(shares, pairwise(rows))), arb(0))

    def below(x: arb) -> arb:
        at = x / arb(size) + centre
        found = arb(0)
        for share, (a, b) in zip(shares, pairwise(rows)):
            found += share * _clipped((at - arb(a)) / (arb(b) - arb(a)))
        return found

    return Drawn(place=place, mean=mean, below=below, size=len(shares))


def _clipped(x: arb) -> arb:
    return arb(0).max(x.min(arb(1)))


def _triangle(x: arb) -> arb:
    place = arb(-1).max(x.min(arb(1)))
    left, right = (1 + place.min(arb(0))) ** 2 / 2, (1 - arb(0).max(place)) ** 2 / 2
    return left + arb(1) / 2 - right


def _two_sided(x: arb) -> arb:
    left, right = (x.min(arb(0))).exp() / 2, (-arb(0).max(x)).exp() / 2
    return left + arb(1) / 2 - right


_BELOW: dict[str, Callable[[arb], arb]] = {
    "gaussian": lambda x: (1 + (x / arb(2).sqrt()).erf()) / 2,
    "uniform": lambda x: _clipped((x + 1) / 2),
    "triangular": _triangle,
    "laplace": _two_sided,
}
"""P(w <= x) of laws of size 1."""


def weights_of(constants: Sequence[Drawn], cells: Sequence[Sequence[Range]], budget: Budget) -> list[arb]:
    """The probability of every cell, a range a constant; CertificateError where two cells overlap."""
    budget.spend(len(cells) * (len(constants) + 1) * len(cells) * BALL)
    budget.balls(len(cells), sum(constant.work for constant in constants))
    for (i, one), (j, other) in combinations(enumerate(cells), 2):
        if not any(constant.apart(a, b) for constant, a, b in zip(constants, one, other)):
            raise CertificateError(f"`proof.cells` must not overlap; number {i + 1} and number {j + 1} do.")
    found = []
    for cell in cells:
        weight = arb(1)
        for constant, (low, high) in zip(constants, cell):
            weight *= constant.probability(low, high)
        found.append(weight)
    return found
