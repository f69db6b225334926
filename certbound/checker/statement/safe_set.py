"""The set on which no constraint is broken, as inequalities phi_j(x) <= 0 that are decided on boxes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flint import arb

from certbound.checker.report import BALL, Budget, Unproved
from certbound.checker.statement.problem import Model
from certbound.checker.statement.regions import Constraint
from certbound.checker.statement.rooms import Grid, centres_of
from certbound.checker.words import named
from certbound.problem.model import Tape

_MOST_BOXES = 20_000
_DEEPEST = 40

Side = tuple[arb, arb]
Form = list[tuple[int, arb]]
Skip = Callable[[Sequence[arb], Sequence[arb]], bool]


def _over(form: Form, offset: arb, centre: Sequence[arb], radius: Sequence[arb]) -> tuple[arb, arb]:
    """Ends of form . x - offset over a box."""
    value, reach = -offset, arb(0)
    for place, factor in form:
        value += factor * centre[place]
        reach += abs(factor) * radius[place]
    return (value - reach).lower(), (value + reach).upper()


@dataclass(frozen=True, eq=False, kw_only=True)
class _Shape:
    """One constraint: phi = max_i (form_i . x - offset_i), or sum_i (form_i . x - offset_i)^2 - bound^2 if round.

    An obstacle has the other sign.
    """

    forms: list[Form]
    offsets: list[arb]
    outside: bool
    bound: arb | None = None

    def keeps(self, centre: Sequence[arb], radius: Sequence[arb], *, strictly: bool = False) -> bool:
        """Whether no point of a box breaks it; ``strictly``: nor touches an obstacle.

        Boxes that touch an obstacle are left to the boxes that reach into it and have the same points; of one that may
        have no interior there are none, and it must not be touched.
        """
        high = self.over(centre, radius)[1]
        return bool(high < 0 or (high <= 0 and not (self.outside and (strictly or self._thin()))))

    def breaks(self, centre: Sequence[arb], radius: Sequence[arb]) -> bool:
        """Whether every point of a box breaks it: regions are closed, so that a point on an obstacle's edge does."""
        low = self.over(centre, radius)[0]
        return bool(low > 0 or (self.outside and low >= 0))

    def _thin(self) -> bool:
        """Whether the region was not shown to have an interior, as a ball, a half-space and a box of a volume have."""
        if self.bound is not None:
            return not self.bound > 0
        if len(self.forms) == 1:
            return False
        low, high = dict[int, arb](), dict[int, arb]()
        for form, offset in zip(self.forms, self.offsets):
            if len(form) != 1:
                return True
            (j, factor), = form
            end = offset / factor
            if factor > 0:
                high[j] = arb.min(high.get(j, end), end)
            else:
                low[j] = arb.max(low.get(j, end), end)
        return not all(low[j] < high[j] for j in low.keys() & high.keys())

    def over(self, centre: Sequence[arb], radius: Sequence[arb]) -> tuple[arb, arb]:
        """Ends that enclose phi over a box."""
        ends = [_over(form, offset, centre, radius) for form, offset in zip(self.forms, self.offsets)]
        if self.bound is None:
            low, high = ends[0]
            for a, b in ends[1:]:
                low, high = arb.max(low, a), arb.max(high, b)
        else:
            low = high = -self.bound * self.bound
            for a, b in ends:
                high += arb.max(a * a, b * b)
                if a > 0 or b < 0:
                    low += arb.min(a * a, b * b)
            low, high = low.lower(), high.upper()
        return (-high, -low) if self.outside else (low, high)


def _shape_of(constraint: Constraint, center: Sequence[arb], dimension: int, budget: Budget) -> _Shape | None:
    """A constraint whose region lies around ``center``; None where nothing is asked."""
    region = constraint.region
    budget.balls((1 + len(region.faces)) * (dimension + 4))
    middle = [arb(0)] * dimension
    for place, value in zip(region.coordinates, center):
        middle[place] = value
    if region.round:
        image, bound = region.image(dimension, budget)
        rows = [[image[i, j] for j in range(dimension)] for i in range(image.nrows())]
        bounds = [arb(0)] * len(rows)
    else:
        rows = [region.lift(region.face(number), dimension) for number in range(len(region.faces))]
        bounds, bound = [arb(b) for b in region.bounds], None
        if not rows and not constraint.inside:
            raise Unproved(f"\"{constraint.label}\" leaves nothing")
        if not rows:
            return None
    forms = [[(j, x) for j, x in enumerate(row) if not x.is_zero()] for row in rows]
    offsets = [b + sum((x * middle[j] for j, x in form), arb(0)) for form, b in zip(forms, bounds)]
    return _Shape(forms=forms, offsets=offsets, outside=not constraint.inside, bound=bound)


def _size(shapes: Sequence[_Shape]) -> int:
    """Operations of balls by which all shapes are looked at over a box."""
    return sum(12 + 6 * (2 + len(form)) for shape in shapes for form in shape.forms)


class StepSet:
    """The states that break no constraint at one step: windows, and where moving sets are then, count."""

    def __init__(self, model: Model, step: int, budget: Budget) -> None:
        asked = [c for c in model.constraints if c.during is None or c.during[0] <= step <= c.during[1]]
        now = Grid(times=[(arb(step), arb(step))], hulls=[])
        shapes = [_shape_of(c, centres_of(c.region, now, budget)[0], model.dimension, budget) for c in asked]
        self._shapes = [shape for shape in shapes if shape is not None]
        self._budget, self._size = budget, _size(self._shapes)

    @property
    def work(self) -> int:
        """Units of work of one look at a box."""
        return self._size * BALL

    def holds(self, box: Sequence[Side], *, strictly: bool = False) -> bool:
        """Whether no point of a box breaks a constraint; ``strictly``: an obstacle must not be touched either."""
        self._budget.balls(self._size + 6 * len(box))
        centre = [(a + b) / 2 for a, b in box]
        radius = [(b - a) / 2 for a, b in box]
        return all(shape.keeps(centre, radius, strictly=strictly) for shape in self._shapes)

    def excludes(self, box: Sequence[Side]) -> bool:
        """Whether every point of a box breaks a constraint, the same one."""
        self._budget.balls(self._size + 6 * len(box))
        centre = [(a + b) / 2 for a, b in box]
        radius = [(b - a) / 2 for a, b in box]
        return any(shape.breaks(centre, radius) for shape in self._shapes)


@dataclass(frozen=True, eq=False, kw_only=True)
class Part:
    """A part of the boundary: points of ``box`` that ``skip`` does not rule out; ``exact``: all that lie in the set."""

    box: list[Side]
    skip: Skip
    exact: bool


class SafeSet:
    """The constraints of a model at rest.

    One that has a window or moves is `Unproved`, and, unless ``bounded`` is False, a state that nothing bounds; then
    there is no ``hull``.

    An obstacle that is one half-space {a.x <= b} bounds states as {a.x >= b} does. `holds` is of the closed set: who
    asks it counts paths that touch the boundary as failing, so that on what is left a.x > b. `excludes` is of a.x < b,
    where every point is in the obstacle.
    """

    def __init__(self, model: Model, *, bounded: bool = True) -> None:
        self.n, self.budget = model.dimension, model.budget
        self.shapes: list[_Shape] = []
        low: list[arb | None] = [None] * self.n
        high: list[arb | None] = [None] * self.n
        for constraint in model.constraints:
            shape = self._shape(constraint)
            if shape is not None:
                self.shapes.append(shape)
                self._narrow(shape, low, high)
        self._size = _size(self.shapes)
        self.hull: list[Side] = []
        for j, (a, b) in enumerate(zip(low, high) if bounded else ()):
            if a is None or b is None:
                raise Unproved(f"no constraint that a barrier can use bounds {named(model.states[j])}")
            if not a <= b:
                raise Unproved(f"no value of {named(model.states[j])} is safe")
            self.hull.append((a, b))

    def _shape(self, constraint: Constraint) -> _Shape | None:
        region = constraint.region
        if constraint.during is not None:
            raise Unproved(f"\"{constraint.label}\" has a time window, which this proof does not treat")
        if isinstance(region.center, Tape):
            raise Unproved(f"\"{constraint.label}\" moves, which this proof does not treat")
        return _shape_of(constraint, [arb(value) for value in region.center], self.n, self.budget)

    def _narrow(self, shape: _Shape, low: list[arb | None], high: list[arb | None]) -> None:
        """Take what a constraint says about single states."""
        if shape.outside and (shape.bound is not None or len(shape.forms) > 1):
            return
        reach = shape.bound
        for form, offset in zip(shape.forms, shape.offsets):
            if len(form) != 1:
                continue
            (j, factor), = form
            sides = [(factor, offset)] if reach is None else [(factor, offset + reach), (-factor, reach - offset)]
            sign = -1 if shape.outside else 1
            for a, b in [(sign * a, sign * b) for a, b in sides]:
                if a > 0:
                    end, known = (b / a).upper(), high[j]
                    high[j] = end if known is None else arb.min(known, end)
                elif a < 0:
                    end, known = (b / a).lower(), low[j]
                    low[j] = end if known is None else arb.max(known, end)

    # ---- on boxes ----------------------------------------------------------------------------------------

    def excludes(self, centre: Sequence[arb], radius: Sequence[arb]) -> bool:
        """Whether every point of a box surely breaks a constraint, the same one."""
        self.budget.balls(self._size)
        return any(shape.over(centre, radius)[0] > 0 for shape in self.shapes)

    def holds(self, centre: Sequence[arb], radius: Sequence[arb], *, strictly: bool = False) -> bool:
        """Whether no point of a box breaks a constraint; ``strictly``: an obstacle must not be touched either."""
        self.budget.balls(self._size)
        return all(shape.keeps(centre, radius, strictly=strictly) for shape in self.shapes)

    def contains(self, box: Sequence[Side], budget: Budget) -> bool:
        """Whether a box is proved to lie in the set, cut into parts where need be."""
        stack = [(list(box), 0)]
        for _ in range(_MOST_BOXES):
            if not stack:
                return True
            budget.box()
            sides, depth = stack.pop()
            centre = [((a + b) / 2).mid() for a, b in sides]
            radius = [arb.max(b - c, c - a).upper() for (a, b), c in zip(sides, centre)]
            if self.holds(centre, radius):
                continue
            widest = max(range(self.n), key=lambda j: float(radius[j]))
            a, b = sides[widest]
            cut = centre[widest]
            if depth > _DEEPEST * self.n or not a < cut < b or self.excludes(centre, [arb(0)] * self.n):
                return False
            stack += [([*sides[:widest], side, *sides[widest + 1 :]], depth + 1) for side in ((a, cut), (cut, b))]
        return not stack

    def boundary(self) -> list[Part]:
        """Parts that together hold every point of the set where a constraint is about to be broken (phi_j = 0)."""
        parts = []
        for shape in self.shapes:
            for number, form in enumerate(shape.forms if shape.bound is None else shape.forms[:1]):
                flat = self._flat(shape, number) if shape.bound is None and len(form) == 1 else self.hull
                if flat is not None:
                    exact = flat is not self.hull and not (shape.outside and len(shape.forms) > 1)  # it ends within
                    parts.append(Part(box=flat, skip=self._misses(shape, number), exact=exact))
        return parts

    def _flat(self, shape: _Shape, number: int) -> list[Side] | None:
        """The hull cut down to a face across one state; None where they do not meet."""
        (j, factor), = shape.forms[number]
        value = shape.offsets[number] / factor
        low, high = self.hull[j]
        if value > high or value < low:
            return None
        return [*self.hull[:j], (value.lower(), value.upper()), *self.hull[j + 1 :]]

    def _misses(self, shape: _Shape, number: int) -> Skip:
        """Rules out boxes that do not meet the face, and those outside of the set."""
        form, offset = shape.forms[number], shape.offsets[number]

        def skip(centre: Sequence[arb], radius: Sequence[arb]) -> bool:
            self.budget.balls(self._size)
            low, high = shape.over(centre, radius)
            if low > 0 or high < 0 or self.excludes(centre, radius):
                return True
            if shape.bound is not None:
                return False
            first, last = _over(form, offset, centre, radius)
            return bool(first > 0 or last < 0)

        return skip
