"""What the constraints leave to the deviation along a nominal curve: rows and rooms, piece by piece."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

from flint import arb, arb_mat

from certbound.checker.balls import column
from certbound.checker.expressions import Graph, Program, Undecided
from certbound.checker.report import BALL, BALL_BYTES, PRODUCT, STEP, Budget, Unproved
from certbound.checker.statement.problem import Model
from certbound.checker.statement.regions import Constraint, Region
from certbound.errors import CertificateError
from certbound.problem.model import Tape

_STRICT = arb(2) ** -300


@dataclass(frozen=True, eq=False, kw_only=True)
class Demand:
    """rows[k] . S <= rooms[k] on piece k keeps a constraint; rooms are None where it is not asked."""

    label: str
    rows: list[list[arb]]
    rooms: list[arb | None]


@dataclass(frozen=True, eq=False, kw_only=True)
class Grid:
    """Time pieces as balls, and points whose convex hull holds the nominal curve on each.

    ``part`` gives such points for a part [start, end] of a piece.
    """

    times: list[tuple[arb, arb]]
    hulls: list[list[list[arb]]]
    part: Callable[[int, arb, arb], list[list[arb]]] | None = None

    def points(self, k: int, during: tuple[float, float] | None) -> list[list[arb]]:
        """Points around the curve on piece k while a constraint is asked."""
        if self.part is None or during is None:
            return self.hulls[k]
        start, end = self.times[k]
        return self.part(k, arb.max(start, arb(during[0])), arb.min(end, arb(during[1])))

    def asked(self, during: tuple[float, float] | None) -> list[bool]:
        """Which pieces may meet a time window."""
        if during is None:
            return [True] * len(self.times)
        first, last = during
        return [not (end < first or start > last) for start, end in self.times]


def demands(
    model: Model, grid: Grid, separations: list[object], path: str, budget: Budget, *, polygons: bool = True
) -> list[Demand]:
    """Every constraint of the model as demands along a nominal curve (without ``polygons``: but for round safe sets).
    """
    if len(separations) != len(model.constraints):
        raise CertificateError(f"`{path}` must have {len(model.constraints)} entries, got {len(separations)}.")
    budget.expect(len(model.constraints) * len(grid.times) * STEP)
    result: list[Demand] = []
    for number, (constraint, given) in enumerate(zip(model.constraints, separations)):
        if polygons or not (constraint.inside and constraint.region.round):
            result += _demand(model, grid, constraint, given, f"{path}[{number}]", budget)
    return result


def _demand(
    model: Model, grid: Grid, constraint: Constraint, given: object, path: str, budget: Budget
) -> list[Demand]:
    """The rows of one constraint: fixed ones, or one a piece where the certificate names them."""
    region, count = constraint.region, len(grid.times)
    budget.check()
    families: list[list[tuple[list[arb], arb]]]
    if constraint.separated:
        pairs = constraint.read_separation(given, path, count, budget)
        away = {id(row): [-x for x in row] for row, _ in pairs}
        families = [[(away[id(row)], -height - _STRICT) for row, height in pairs]]
    elif given is not None:
        raise CertificateError(f"`{path}` must be null: that constraint needs no directions.")
    elif not constraint.inside:
        face = [-x for x in region.face(0)]
        families = [[(face, -arb(region.bounds[0]) - _STRICT)] * count]
    elif region.round:
        pairs = region.inscribed(budget)
        budget.take(8 * len(pairs) * count)
        families = [[pair] * count for pair in pairs]
    else:
        budget.fits((8 + 2 * BALL_BYTES) * len(region.bounds) * count)
        budget.take(8 * len(region.bounds) * count)
        families = [
            [(region.face(number), arb(b))] * count for number, b in enumerate(region.bounds)
        ]
    centres = centres_of(region, grid, budget)
    asked = grid.asked(constraint.during)
    found = []
    budget.expect(sum(asked) * len(families) * model.dimension * BALL)
    for family in families:
        budget.hold(2 * count)
        found.append(Demand(label=constraint.label, rows=_lifted(region, family, model.dimension, budget), rooms=[]))
    for k in range(count):
        points = grid.points(k, constraint.during) if asked[k] else []
        for family, demand in zip(families, found):
            budget.balls((1 + len(points)) * (10 + 2 * len(demand.rows[k])))
            row, bound = family[k]
            offset = bound + _dot(row, centres[k])
            rooms = [offset - _dot(demand.rows[k], point) for point in points]
            demand.rooms.append(reduce(arb.min, rooms).lower() if rooms else None)
    return found


def _lifted(region: Region, family: list[tuple[list[arb], arb]], dimension: int, budget: Budget) -> list[list[arb]]:
    """The rows over all states; one that comes again is the same."""
    known: dict[int, list[arb]] = {}
    budget.spend(len(family) * 200)
    for row, _ in family:
        if id(row) not in known:
            budget.balls(dimension // 4)
            budget.hold(dimension // 8 + 1)  # most of it is the same 0
            known[id(row)] = region.lift(row, dimension)
    return [known[id(row)] for row, _ in family]


@dataclass(frozen=True, eq=False, kw_only=True)
class RoundDemand:
    """|W S| <= rooms[k] on piece k keeps a safe ball or ellipsoid {|W (x - o)| <= bound}; None: not asked."""

    label: str
    image: arb_mat
    rooms: list[arb | None]


def round_demands(model: Model, grid: Grid, budget: Budget) -> list[RoundDemand]:
    """The round safe sets."""
    result = []
    for constraint in model.constraints:
        region = constraint.region
        if not (constraint.inside and region.round):
            continue
        image, bound = region.image(model.dimension, budget)
        asked, centres = grid.asked(constraint.during), centres_of(region, grid, budget)
        budget.hold(len(grid.times))
        budget.expect(sum(asked) * image.nrows() * image.ncols() * PRODUCT)
        rooms: list[arb | None] = []
        for k in range(len(grid.times)):
            budget.check()
            if not asked[k]:
                rooms.append(None)
                continue
            moved = region.lift(centres[k], model.dimension)
            sizes = []
            for point in grid.points(k, constraint.during):
                budget.products(image.nrows(), image.ncols())
                budget.balls(4 * (image.ncols() + image.nrows()))
                offset = (image * column([a - b for a, b in zip(point, moved)])).entries()
                sizes.append(sum((x * x for x in offset), arb(0)).upper().sqrt())
            rooms.append((bound + reduce(arb.min, [-size for size in sizes])).lower())
        result.append(RoundDemand(label=constraint.label, image=image, rooms=rooms))
    return result


def _dot(row: Sequence[arb], point: Sequence[arb]) -> arb:
    return sum((a * b for a, b in zip(row, point) if not a.is_zero()), arb(0))


def centres_of(region: Region, grid: Grid, budget: Budget) -> list[list[arb]]:
    """Enclosures of the centre on every piece."""
    if not isinstance(region.center, Tape):
        return [[arb(x) for x in region.center]] * len(grid.times)
    budget.hold(2 * len(grid.times) * len(region.coordinates))
    graph = Graph(budget)
    nodes = graph.include(region.center, [graph.input(0)])
    program = Program(graph, [nodes[output] for output in region.center.outputs], variables=1)
    program.prepare([])
    result = []
    for start, end in grid.times:
        try:
            result.append(program.run([start.union(end)]))
        except Undecided as error:
            raise Unproved("the centre of a moving set is not defined at all times") from error
    return result
