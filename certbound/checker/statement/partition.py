"""The initial set cut into cells."""

from __future__ import annotations

from itertools import pairwise, product

from flint import arb

from certbound.checker.reading import Record, numbers
from certbound.checker.report import Unproved
from certbound.checker.statement.problem import Model
from certbound.errors import CertificateError

MOST_CELLS = 4096


def cells_of(model: Model, record: Record) -> list[list[tuple[arb, arb]]]:
    """Boxes that cover the initial set: products of the intervals between the edges of ``splits``."""
    sides: list[list[tuple[arb, arb]]] = []
    count = 1
    for j, item in enumerate(record.items("splits", model.dimension, model.dimension)):
        row = numbers(item, f"proof.splits[{j}]", None)
        if len(row) < 2 or any(a > b for a, b in pairwise(row)):
            raise CertificateError(f"`proof.splits[{j}]` must be two or more numbers that do not fall.")
        if not (arb(row[0]) <= model.initial.low[j].lower() and arb(row[-1]) >= model.initial.high[j].upper()):
            raise Unproved(f"the cells do not cover the initial set along {model.states[j]}")
        sides.append([(arb(a), arb(b)) for a, b in pairwise(row)])
        count *= len(sides[-1])
        if count > MOST_CELLS:
            raise CertificateError(f"`proof.splits` must make at most {MOST_CELLS} cells.")
    return [list(box) for box in product(*sides)]
