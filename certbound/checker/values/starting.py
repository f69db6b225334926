"""Where a lower bound starts: at stated points that surely lie in the initial set."""

from __future__ import annotations

from flint import arb

from certbound.checker.balls import cholesky, column
from certbound.checker.reading import Record, numbers
from certbound.checker.report import Unproved
from certbound.checker.statement import Model

MOST_STARTS = 256


def starts_of(model: Model, record: Record) -> list[list[arb]]:
    """The stated starts.

    Raises
    ------
    Unproved
        If one was not shown to lie in the initial set.
    """
    rows = record.items("starts", 1, MOST_STARTS)
    points = [list(map(arb, numbers(row, f"proof.starts[{k}]", model.dimension))) for k, row in enumerate(rows)]
    if not all(_is_inside(model, point) for point in points):
        raise Unproved("a start was not shown to lie in the initial set")
    return points


def _is_inside(model: Model, point: list[arb]) -> bool:
    initial = model.initial
    if initial.kind == "box":
        return all(low <= x <= high for low, x, high in zip(initial.low, point, initial.high))
    away = [x - arb(c) for x, c in zip(point, initial.centre)]
    if initial.shape is not None:
        image = (cholesky(initial.shape).inv() * column(away)).entries()
        return bool(sum((x * x for x in image), arb(0)) <= 1)
    radius = arb(initial.radius)
    return bool(sum((x * x for x in away), arb(0)) <= radius * radius)
