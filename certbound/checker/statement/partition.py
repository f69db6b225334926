"""The initial set cut into cells, by a grid of edges or by halving a box again and again; and points of it."""

from __future__ import annotations

from itertools import pairwise, product

from flint import arb, arb_mat

from certbound.checker.balls import cholesky, column
from certbound.checker.reading import Record, number, numbers, whole
from certbound.checker.report import Unproved
from certbound.checker.statement.problem import Model
from certbound.checker.words import named
from certbound.errors import CertificateError

MOST_CELLS = 4096
MOST_STARTS = 256


def cells_of(model: Model, record: Record) -> list[list[tuple[arb, arb]]]:
    """Boxes that cover the initial set: products of the intervals between the edges of ``splits``.

    With ``cuts`` the one product that ``splits`` makes is cut as they say.
    """
    sides: list[list[tuple[arb, arb]]] = []
    count = 1
    for j, item in enumerate(record.items("splits", model.dimension, model.dimension)):
        row = numbers(item, f"proof.splits[{j}]", None)
        if len(row) < 2 or any(a > b for a, b in pairwise(row)):
            raise CertificateError(f"`proof.splits[{j}]` must be two or more numbers that do not fall.")
        if not (arb(row[0]) <= model.initial.low[j].lower() and arb(row[-1]) >= model.initial.high[j].upper()):
            raise Unproved(f"the cells do not cover the initial set along {named(model.states[j])}")
        sides.append([(arb(a), arb(b)) for a, b in pairwise(row)])
        count *= len(sides[-1])
        if count > MOST_CELLS:
            raise CertificateError(f"`proof.splits` must make at most {MOST_CELLS} cells.")
    model.budget.take(count * (120 + 8 * model.dimension))
    model.budget.spend(count * (1_000 + 20 * model.dimension))
    boxes = [list(box) for box in product(*sides)]
    return boxes if record["cuts"] is None else _cut(boxes, record, model)


def _cut(boxes: list[list[tuple[arb, arb]]], record: Record, model: Model) -> list[list[tuple[arb, arb]]]:
    """The parts of one box, in order: an entry of ``cuts`` says where the next part is cut, or null that it is a cell.

    Both parts of a cut follow it, the lower one with all its own cuts first. Each cut lies inside its part, so that
    the parts cover what is cut.
    """
    dimension = model.dimension
    if len(boxes) != 1:
        raise CertificateError("`proof.splits` must make one box where `proof.cuts` cuts it.")
    left, cells = boxes, []
    for index, item in enumerate(record.items("cuts", 1, 2 * MOST_CELLS)):
        if not left:
            raise CertificateError("`proof.cuts` must end with its last cell.")
        box = left.pop()
        model.budget.take(200 + 16 * dimension)
        model.budget.spend(2_000 + 20 * dimension)
        if item is None:
            cells.append(box)
            continue
        path = f"proof.cuts[{index}]"
        if not isinstance(item, list) or len(item) != 2:
            raise CertificateError(f"`{path}` must be null, or a state's number and where it is cut.")
        side, place = whole(item[0], path, 0, dimension - 1), arb(number(item[1], path))
        low, high = box[side]
        if not low < place < high:
            raise CertificateError(f"`{path}` must lie inside the part that it cuts.")
        left += [[*box[:side], part, *box[side + 1 :]] for part in ((place, high), (low, place))]
    if left:
        raise CertificateError("`proof.cuts` must end every part in a cell.")
    return cells


def starts_of(model: Model, record: Record) -> list[list[arb]]:
    """The stated starts.

    Raises
    ------
    Unproved
        If one was not shown to lie in the initial set.
    """
    rows = record.items("starts", 1, MOST_STARTS)
    points = [list(map(arb, numbers(row, f"proof.starts[{k}]", model.dimension))) for k, row in enumerate(rows)]
    n, shape = model.dimension, model.initial.shape
    if shape is not None:
        model.budget.products(n, n, n)
    image = None if shape is None else cholesky(shape, model.budget).inv()
    model.budget.products(len(points), n, 1 if shape is None else n)
    if not all(_is_inside(model, point, image) for point in points):
        raise Unproved("a start was not shown to lie in the initial set")
    return points


def _is_inside(model: Model, point: list[arb], image: arb_mat | None) -> bool:
    initial = model.initial
    if initial.kind == "box":
        return all(low <= x <= high for low, x, high in zip(initial.low, point, initial.high))
    away = [x - arb(c) for x, c in zip(point, initial.centre)]
    if image is not None:
        return bool(sum((x * x for x in (image * column(away)).entries()), arb(0)) <= 1)
    radius = arb(initial.radius)
    return bool(sum((x * x for x in away), arb(0)) <= radius * radius)
