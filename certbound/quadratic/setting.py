"""Where a problem's paths may go, in coordinates that make the working box [-1, 1]^n.

x = center + width xi, with floats center and width: whatever is said of xi is exact. The working box lies inside the
safe set's own sides, and leaving it counts as failing; where the safe set has no side, or a far one, the box has a side
of its own choice (a path that leaves it is paid like one that fails). A form Q stands for z' Q z, z = (xi, 1).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from certbound.arrays import Array
from certbound.constants.enclosures import enclose
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, is_zero, jacobian
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces, HalfSpace, Inside, Quadratic
from certbound.problem.systems import ContinuousSystem, System
from certbound.quadratic.form_matrices import as_forms, ball_form, linear_form, scaled_row
from certbound.rigor.intervals import Interval, concatenate


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Wall:
    """A part of the boundary, or an obstacle: the bound V must be at least 0 there.

    Attributes
    ----------
    label : str
        In words.
    row : Interval, shape (n + 1,), or None
        ``row . z`` is 0 on the wall and grows outward; None for an obstacle or a curved wall.
    forms : Interval, shape (k, n + 1, n + 1)
        Quadratic forms that are at least 0 where paths can leave.
    own : bool
        Whether it is a side that the working box has of its own, inside the safe set.
    far : bool
        Whether it is a side along whose coordinate the model is affine.
    """

    label: str
    row: Interval | None
    forms: Interval
    own: bool = False
    far: bool = False

    @property
    def side(self) -> tuple[int, int] | None:
        """Axis and end (0: below, 1: above) of a side of the working box; None for other walls."""
        axes = np.zeros(0) if self.row is None else np.flatnonzero(self.row.mag[:-1])
        if self.row is None or len(axes) != 1 or abs(self.row.mid[axes[0]]) != 1 or self.row.mid[-1] != -1:
            return None
        return int(axes[0]), int(self.row.mid[axes[0]] > 0)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Start:
    """The initial set: a box of xi, and forms that are at least 0 on it (those of a ball)."""

    low: Array
    high: Array
    forms: Interval


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Setting:
    """The working box, what else bounds the paths, and where they start."""

    system: System
    center: Array
    width: Array
    walls: tuple[Wall, ...]
    inside: Interval  # (k, n + 1, n + 1): forms that are at least 0 on the safe set, besides the box
    start: Start

    @property
    def dimension(self) -> int:
        """Number of states."""
        return len(self.center)

    def name_of(self, wall: Wall) -> str:
        """What a wall limits, in words: of a side of the box the inequality that holds within."""
        if wall.side is None:
            return wall.label
        axis, upper = wall.side
        row = self.system.said_of(np.eye(self.dimension)[axis])
        unit = float(np.abs(row).max())
        limit = (self.center[axis] + (self.width[axis] if upper else -self.width[axis])) / unit
        name = HalfSpace(row / unit, 0.0).describe(self.system.states, "inside").partition(" <= ")[0]
        words = f"{name} {'<=' if upper else '>='} {limit:.4g}"
        return f"{words}, a side of a box that certbound chose" if wall.own else words

    def over(self, low: Array, high: Array) -> Interval:
        """x over boxes of xi, shape (..., n)."""
        return Interval.point(self.center) + Interval.point(self.width) * Interval(low, high)


def diffusion_of(problem: Problem) -> Array | Tape:
    """g of a problem in continuous time.

    Raises
    ------
    InfeasibleError
        The problem is in discrete time.
    """
    if not isinstance(problem.system, ContinuousSystem):
        raise InfeasibleError("quadratic value bounds need continuous time; the problem is discrete.")
    return problem.system.diffusion


def safe_sides(problem: Problem) -> tuple[Array, Array]:
    """Ends of a box that the constraints along the coordinates leave, rounded inward; infinite where nothing bounds."""
    n = problem.system.dimension
    low, high = np.full(n, -np.inf), np.full(n, np.inf)
    for constraint in problem.constraints:
        form = constraint.region.form
        if constraint.outside or not isinstance(form, Faces):
            continue
        center = constraint.region.center_at()
        for normal, bound in zip(form.normals, form.bounds):
            used = np.flatnonzero(normal)
            if len(used) != 1:
                continue
            axis, factor = constraint.region.places(n)[used[0]], normal[used[0]]
            end = Interval.point(bound) / Interval.point(factor) + Interval.point(center[used[0]])
            exact = form.axial and not center[used[0]]
            if factor > 0:
                high[axis] = min(high[axis], float(bound * factor if exact else end.lo))
            else:
                low[axis] = max(low[axis], float(bound * factor if exact else end.hi))
    return low, high


def make_setting(problem: Problem, low: Array, high: Array) -> Setting:
    """The setting on the box [low, high], which must be finite and lie in the safe set's own sides.

    Raises
    ------
    InfeasibleError
        Constraints of a kind that is not served, or a start outside the box.
    """
    refuse(problem)
    safe = safe_sides(problem)
    center, width = _scaled(low, high)
    n, jumps = len(center), not isinstance(problem.system, ContinuousSystem)  # a step may lead beyond any side
    start = _start(problem, center, width)
    walls: list[Wall | None] = []
    inside: list[Interval] = []
    for constraint in problem.constraints:
        more, forms = _constraint(problem, constraint, center, width, start, jumps)
        walls += more
        inside += forms
    known = as_forms(inside, n + 1)
    for axis, sign in itertools.product(range(n), (-1.0, 1.0)):
        z = _side(n, axis, sign)
        beyond = (z.reshape(-1, 1) * known * z.reshape(1, -1)).sum(axis=(-1, -2)).hi < 0
        if jumps or not (np.any(beyond) or _never_reached(problem, center, width, axis, sign)):
            row = np.zeros(n + 1)
            row[axis], row[n] = sign, -1.0
            label = f"{problem.system.states[axis]} {'above' if sign > 0 else 'below'}"
            wall = _flat(problem, center, width, Interval.point(row), label)
            gap = (high[axis] - safe[1][axis]) if sign > 0 else (safe[0][axis] - low[axis])
            walls.append(None if wall is None else replace(wall, own=bool(gap < -1e-9 * width[axis])))
    found = tuple(wall for wall in walls if wall is not None)
    return Setting(system=problem.system, center=center, width=width, walls=found, inside=known, start=start)


def _side(n: int, axis: int, sign: float) -> Interval:
    """z over a side of the working box."""
    low, high = -np.ones(n + 1), np.ones(n + 1)
    low[axis] = high[axis] = sign
    low[n] = 1.0
    return Interval(low, high)


def refuse(problem: Problem) -> None:
    """InfeasibleError for what the theorem, or this implementation of it, does not serve."""
    if problem.initial.random:
        raise InfeasibleError("quadratic value bounds need a bounded set of starts, not a random start.")
    if problem.input_sequence is not None:
        raise InfeasibleError("quadratic value bounds need a feedback law; the plan is an array.")
    for constraint in problem.constraints:
        region, window = constraint.region, constraint.during
        if region.moving:
            raise InfeasibleError(f"quadratic value bounds do not serve moving sets yet ('{constraint.label}').")
        if window is not None and window != (0.0, float(problem.horizon)):
            raise InfeasibleError(f"quadratic value bounds do not serve windows of time yet ('{constraint.label}').")
        if isinstance(region.form, Quadratic) and not region.form.even:
            raise InfeasibleError(f"quadratic value bounds do not serve ellipsoids yet ('{constraint.label}').")


def _scaled(low: Array, high: Array) -> tuple[Array, Array]:
    """Floats center and width > 0 with [center - width, center + width] inside [low, high], exactly."""
    center, width = (low + high) / 2, (high - low) / 2
    for axis in range(len(center)):
        middle, ends = Fraction(float(center[axis])), (Fraction(float(low[axis])), Fraction(float(high[axis])))
        while middle - Fraction(float(width[axis])) < ends[0] or middle + Fraction(float(width[axis])) > ends[1]:
            width[axis] = np.nextafter(width[axis], 0.0)
    if not np.all(width > 0):
        raise InfeasibleError("the safe set has no interior.")
    return center, width


def _start(problem: Problem, center: Array, width: Array) -> Start:
    region = problem.initial
    box = (region.hull() - Interval.point(center)) / Interval.point(width)
    if not (np.all(box.lo > -1) and np.all(box.hi < 1)):
        raise InfeasibleError("the starts reach the boundary of the set that is looked at.")
    forms = []
    if isinstance(region.form, Quadratic) and region.form.even:
        forms.append(ball_form(region.center_at(), region.form.radius, list(range(len(center))), center, width))
    return Start(low=box.lo, high=box.hi, forms=as_forms(forms, len(center) + 1))


def _constraint(
    problem: Problem, constraint: Inside, center: Array, width: Array, start: Start, jumps: bool
) -> tuple[list[Wall | None], list[Interval]]:
    """The walls of a constraint that is no side of the box, and the forms that are at least 0 where it holds.

    Where paths jump V is asked for from the first step on: a start in an obstacle, or on its edge, has failed before.
    """
    n, region = len(center), constraint.region
    places = region.places(n)
    if isinstance(region.form, Quadratic):
        form = ball_form(region.center_at(), region.form.radius, places, center, width)
        inner = -form if constraint.outside else form
        _check_start(start, inner, constraint.label, strictly=jumps and constraint.outside)
        return [Wall(label=constraint.label, row=None, forms=as_forms([-inner], n + 1))], [inner]
    rows = []
    for normal, bound in zip(region.form.normals, region.form.bounds):
        shift = (Interval.point(normal) * Interval.point(region.center_at())).sum() + Interval.point(bound)
        rows.append(scaled_row(region.lifted(normal, n), shift, center, width))
    if constraint.outside:
        if jumps:
            _check_apart(start, rows, constraint.label)
        forms = [-linear_form(row) for row in rows]  # the obstacle: every row . z <= 0
        return [Wall(label=constraint.label, row=None, forms=as_forms(forms, n + 1))], []
    walls, inside = [], []
    for normal, row in zip(region.form.normals, rows):
        if np.count_nonzero(normal) > 1:
            _check_start(start, -linear_form(row), constraint.label)
            walls.append(_flat(problem, center, width, row, constraint.label))
            inside.append(-linear_form(row))
    return walls, inside


def _check_start(start: Start, form: Interval, label: str, *, strictly: bool = False) -> None:
    """Refuse starts that may lie where a form is negative, or (``strictly``) 0."""
    z = _around(start)
    value = (z.reshape(-1, 1) * form * z.reshape(1, -1)).sum()
    if not (value.lo > 0 if strictly else value.lo >= 0):
        raise InfeasibleError(f"the starts may touch the boundary of '{label}'.")


def _check_apart(start: Start, rows: Sequence[Interval], label: str) -> None:
    """Refuse starts of which it is not shown that none lies where every row . z <= 0.

    One combination of the rows by weights that are not negative is positive over the box of the starts; a linear
    program proposes it.
    """
    from scipy.optimize import linprog

    z, count, n = _around(start), len(rows), len(start.low)
    table = np.stack([row.mid for row in rows])
    middle, half = (start.low + start.high) / 2, (start.high - start.low) / 2
    slopes, value = table[:, :n], table[:, :n] @ middle + table[:, n]
    signs = [np.hstack([sign * slopes.T, -np.eye(n)]) for sign in (1, -1)]  # |slopes' w| <= u
    found = linprog(np.concatenate([-value, half]), A_ub=np.vstack(signs), b_ub=np.zeros(2 * n),
                    A_eq=[[1.0] * count + [0.0] * n], b_eq=[1.0], method="highs")  # fmt: skip
    weights = np.eye(count) if found.x is None else np.vstack([np.eye(count), np.maximum(found.x[:count], 0.0)])
    for weight in weights.tolist():
        mixed = sum((row * share for row, share in zip(rows, weight) if share), Interval.point(np.zeros(n + 1)))
        if (mixed * z).sum().lo > 0:
            return
    raise InfeasibleError(f"the starts may touch '{label}', where they have failed.")


def _around(start: Start) -> Interval:
    """z over a box around the starts."""
    return concatenate([Interval(start.low, start.high), Interval.point(np.ones(1))])


def _flat(problem: Problem, center: Array, width: Array, row: Interval, label: str) -> Wall | None:
    """A flat wall; one without noise is left only where the drift points outward, and None where it nowhere does."""
    n, continuous = len(center), isinstance(problem.system, ContinuousSystem)
    drift = _outward_drift(problem, center, width, row) if continuous else None
    forms = [] if drift is None else [linear_form(drift)]
    if drift is not None:
        used = np.flatnonzero(row.mag[:n])
        z = _side(n, used[0] if len(used) == 1 else n, float(np.sign(row.mid[used[0]])) if len(used) == 1 else 1.0)
        if (drift * z).sum().hi < 0:
            return None
    return Wall(label=label, row=row, forms=as_forms(forms, n + 1))


def _outward_drift(problem: Problem, center: Array, width: Array, row: Interval) -> Interval | None:
    """d(row . z)/dt as a row over z where it is affine and free of noise, disturbances and time; None elsewhere."""
    n = len(center)
    states = np.flatnonzero(row.mag[:n]).tolist()
    if not _without_noise(problem, states):
        return None
    tape = problem.closed_loop
    slopes = jacobian(tape)
    flat = jacobian(slopes)
    count = len(tape.inputs)
    for i in states:
        if not all(is_zero(flat, (i * count + a) * count + b) for a in range(count) for b in range(count)):
            return None
        if not all(is_zero(slopes, i * count + a) for a in (0, *range(n + 1, count))):
            return None
    point = [Interval.point(0.0)] * count
    value = enclose(tape, point, undefined="infinite")
    slope = enclose(slopes, point, undefined="infinite")[:, 1 : n + 1]
    if not np.all(np.isfinite(value.mag[states])) or not np.all(np.isfinite(slope.mag[states])):
        return None
    total: Interval = Interval.point(np.zeros(n + 1))
    for i in states:
        at = value[i] + (slope[i] * Interval.point(center)).sum()
        entries = concatenate([slope[i] * Interval.point(width), at.reshape(1)])
        total = total + row[i] * entries / Interval.point(width[i])
    return total


def _without_noise(problem: Problem, states: Sequence[int]) -> bool:
    diffusion = diffusion_of(problem)
    columns = diffusion.shape[1]
    if isinstance(diffusion, Tape):
        return all(is_zero(diffusion, i * columns + j) for i in states for j in range(columns))
    return not np.any(np.asarray(diffusion)[list(states)])


def _never_reached(problem: Problem, center: Array, width: Array, axis: int, sign: float) -> bool:
    """Whether no path crosses a side of the working box, as drift and noise of its state vanish there."""
    place = float(center[axis] + sign * width[axis])
    if Fraction(place) != Fraction(float(center[axis])) + int(sign) * Fraction(float(width[axis])):
        return False
    box = Interval.point(center) + Interval.point(width) * Interval(-np.ones(len(center)), np.ones(len(center)))
    return never_crossed(problem, box, axis, place)


def never_crossed(problem: Problem, box: Interval, axis: int, place: float) -> bool:
    """Whether drift and noise of a state vanish where it is at ``place`` and are Lipschitz in a box.

    There dX_i = (X_i - place)(alpha dt + beta dW) with bounded alpha and beta, so that X_i - place keeps its sign.
    """
    tape, diffusion = problem.closed_loop, diffusion_of(problem)
    span, given = Interval(0.0, float(problem.horizon)), problem.system.disturbance
    whole = [span, *(box[i] for i in range(len(box)))]
    there = [*whole[: axis + 1], Interval.point(place), *whole[axis + 2 :]]
    extra = [] if given is None else [Interval(float(a), float(b)) for a, b in zip(given.low, given.high)]
    at = enclose(tape, [*there, *extra], undefined="infinite")[axis]
    slope = enclose(jacobian(tape), [*whole, *extra], undefined="infinite")[axis]
    if not (at.lo == 0 == at.hi and np.all(np.isfinite(slope.mag))):
        return False
    if not isinstance(diffusion, Tape):
        return not np.any(np.asarray(diffusion)[axis])
    columns = diffusion.shape[1]
    noise = enclose(diffusion, there, undefined="infinite")[axis]
    rise = enclose(jacobian(diffusion), whole, undefined="infinite")[axis * columns : (axis + 1) * columns]
    return bool(np.all((noise.lo == 0) & (noise.hi == 0)) and np.all(np.isfinite(rise.mag)))


def deviation_of(paths: Array) -> Array:
    """Standard deviation of each state of sampled paths (P, n); InfeasibleError where it overflows."""
    found = paths.std(axis=0)
    if not np.all(np.isfinite(found)):
        raise InfeasibleError("sampled paths run away; quadratic value bounds need them bounded.")
    return np.asarray(found)
