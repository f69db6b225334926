"""Problems whose limits move as problems whose limits rest, in coordinates that move with the limits.

In coordinates x_i = p_i(t) + q_i(t) y_i (`moving_coordinates`) a path breaks a limit x_i <= h(t) just where y_i breaks
y_i <= (h(t) - p_i(t))/q_i(t). Of each state one interval, or one limit, decides p_i and q_i, and rests. What still
moves is bounded over its window: for upper bounds the set to stay in, or to arrive in, is made smaller and an obstacle
larger, so that failing is no less probable; for lower bounds the other way round. Both are the same problem where
nothing moves any more and no number had to be rounded: then the two problems fail on the same paths.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model import Tape
from certbound.problem.problem import DOMAIN, Problem
from certbound.problem.reductions.formulas_of_time import (
    Formula,
    at_start,
    combined,
    composed,
    difference,
    may_jump,
    range_over,
    scaled,
    values,
)
from certbound.problem.reductions.limits_by_step import limits_by_step
from certbound.problem.reductions.moving_coordinates import Motion, moved_system, start_of
from certbound.problem.sets import Ball, Box, Ellipsoid, HalfSpace, Inside, Polytope, entries_of, shifted, stacked

_TIMES = 513  # times at which limits are compared, in floats
_NEAR = 1e-12  # of their size, by which limits may miss each other and count as equal
_DIFFERENT = "states that move in different ways cannot be stated together"

Window = tuple[float, float]


@dataclass(frozen=True, eq=False, kw_only=True)
class RestingLimits:
    """The problem in coordinates that move with its limits.

    Parameters
    ----------
    above : Problem or None
        P(failing) is at most this one's; None: nothing is left to be safe in.
    below : Problem or None
        P(failing) is at least this one's, from the worst start; ``above`` itself where the two are equal.
    states : tuple of str
        The states that are stated in coordinates of their own; none where limits are stated step by step.
    """

    above: Problem | None
    below: Problem | None
    states: tuple[str, ...]

    @property
    def exact(self) -> bool:
        """Whether both problems are one, which fails on the same paths."""
        return self.above is self.below


@dataclass(frozen=True, eq=False, kw_only=True)
class _Face:
    """normal . x <= bound(t): one face of the set of a constraint, which counts in a window."""

    normal: Array
    bound: Formula
    constraint: Inside
    window: Window

    @property
    def state(self) -> int | None:
        """The one state that it bounds; None where it is oblique."""
        places = np.flatnonzero(self.normal)
        return int(places[0]) if len(places) == 1 else None

    @property
    def factor(self) -> float:
        """Its entry of the state that it bounds."""
        return float(self.normal[np.flatnonzero(self.normal)[0]])

    @property
    def place(self) -> Formula:
        """Where it bounds its state."""
        return scaled(self.bound, 1.0, over=self.factor)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Limit:
    """A face as a limit from below (0) or from above (1) to paths."""

    side: int
    face: _Face


def bring_to_rest(problem: Problem) -> RestingLimits:
    """The problem in coordinates in which as many of its limits rest as can, or in discrete time step by step.

    Raises
    ------
    InfeasibleError
        If none can, limits jump in continuous time, are not defined or meet within the horizon, or the problem is of a
        kind that is not stated so; the message says what would work.

    Examples
    --------
    >>> import numpy as np, certbound as cb
    >>> system = cb.ContinuousSystem(lambda x: 0.5 - x, states=["x"], diffusion=0.4)
    >>> closing = cb.Box([lambda t: -np.exp(-t)], [lambda t: np.exp(-t)])
    >>> problem = cb.Problem(system, initial=[0], safe=[cb.Inside(closing)], horizon=1.0)
    >>> found = bring_to_rest(problem)
    >>> found.exact, found.above.safe[0].region.high.tolist()
    (True, [1.0])
    """
    if problem.endless:
        raise InfeasibleError("limits that move need a finite horizon; give one.")
    if problem.hold is not None:
        raise InfeasibleError("limits that move are not served where inputs are held; leave `hold` out.")
    try:
        steps = limits_by_step(problem)
        if steps is not None and steps != (None, None):
            return RestingLimits(above=steps[0], below=steps[1], states=())
        return by_coordinates(problem)
    except EnclosureError as error:
        raise InfeasibleError(f"limits that move could not be brought to rest: {error}") from error


def by_coordinates(problem: Problem) -> RestingLimits:
    """The problem in coordinates in which as many of its limits rest as can; errors are those of `bring_to_rest`."""
    return _Resting(problem).found()


class _EmptyError(InfeasibleError):
    """Nothing is left of a set that is made smaller."""


class _Resting:
    def __init__(self, problem: Problem) -> None:
        self.problem, self.n = problem, problem.system.dimension
        self.discrete = problem.system.time == "discrete"
        self.whole: Window = (0.0, float(problem.horizon))
        times = np.linspace(*self.whole, _TIMES)
        self.times = np.unique(np.round(times)) if self.discrete else times
        self.domain = None if problem.domain is None else Inside(problem.domain, label=DOMAIN)
        self.target = problem.reach
        self.all = [one for one in (*problem.safe, self.domain, self.target) if one is not None]
        self.faces = [face for constraint in self.all for face in self._faces(constraint)]
        self.motions: dict[int, Motion] = {}
        self.resting: dict[_Face, Formula] = {}  # where faces are at time 0 that rest in the new coordinates
        self.hidden: dict[_Face, float] = {}  # bounds of faces that no path meets, for others stand before them
        self.balls: set[Inside] = set()  # whose ball rests
        self.rounded = False

    def found(self) -> RestingLimits:
        for place in range(self.n):
            self._choose(place)
        for constraint in self.all:
            self._choose_for_ball(constraint)
        for face in self.faces:
            self._choose_for_oblique(face)
        if not self.motions:
            raise InfeasibleError("no limit that moves can be brought to rest by coordinates that move with it.")
        self._check()
        for face in self.faces:
            self._hide(face)
        names = tuple(self.problem.system.states[place] for place in sorted(self.motions))
        above, refusal = self._stated(narrow=True)
        if above is not None and not self.rounded:
            return RestingLimits(above=above, below=above, states=names)
        below, _ = self._stated(narrow=False)
        if above is None and below is None:
            raise InfeasibleError(refusal)
        return RestingLimits(above=above, below=below, states=names)

    # ---- faces -------------------------------------------------------------------------------------------------

    def _faces(self, constraint: Inside) -> list[_Face]:
        region: Any = constraint.region
        rows: list[tuple[Array, Formula]] = []
        if isinstance(region, Ball) and self.n == 1:
            center, radius = entries_of(region.center)[0], region.radius
            rows = [(np.ones(1), combined("add", center, radius)), (-np.ones(1), combined("sub", radius, center))]
        elif isinstance(region, Box):
            rows = self._box_rows(region)
        elif isinstance(region, HalfSpace):
            rows = [(region.normal, region.bound)]
        elif isinstance(region, Polytope):
            rows = list(zip(region.A, entries_of(region.b)))
        window = constraint.during or self.whole
        return [_Face(normal=row, bound=bound, constraint=constraint, window=window) for row, bound in rows]

    def _box_rows(self, region: Box) -> list[tuple[Array, Formula]]:
        rows: list[tuple[Array, Formula]] = []
        for sign, sides in ((-1.0, region.low), (1.0, region.high)):
            for place, side in zip(region.places(self.n), entries_of(shifted(sides, region.center))):
                if isinstance(side, Tape) or np.isfinite(side):
                    row = np.zeros(self.n)
                    row[place] = sign
                    rows.append((row, scaled(side, sign)))
        return rows

    def _of(self, constraint: Inside) -> list[_Face]:
        return [face for face in self.faces if face.constraint is constraint]

    # ---- coordinates -------------------------------------------------------------------------------------------

    def _choose(self, place: int) -> None:
        """Let the interval that paths of a state are in rest, where a side of it moves."""
        limits = self._limits(place)
        if not any(isinstance(limit.face.place, Tape) for limit in limits):
            return
        ends = [self._innermost(limits, side) for side in (0, 1)]
        found = [end for end, _ in ends if end is not None]
        alike = len(found) == 1 or not isinstance(difference(found[1], found[0]), Tape)
        self.motions[place] = Motion.of_place(found[0]) if alike else Motion.of_limits(*found)
        for end, faces in ends:
            if end is not None:
                self.resting |= dict.fromkeys(faces, end)

    def _limits(self, place: int) -> list[_Limit]:
        """The limits to paths of a state: of sets to stay in, of half-spaces to avoid, and in one state of others.

        Where there are none, the sides of a target or an obstacle that moves.
        """
        own = [face for face in self.faces if face.state == place]
        found, others = list[_Limit](), list[_Face]()
        for face in own:
            up = int(face.factor > 0)
            if face.constraint is self.target or (face.constraint.outside and len(self._of(face.constraint)) > 1):
                others.append(face)
            else:
                found.append(_Limit(side=1 - up if face.constraint.outside else up, face=face))
        if self.n == 1:
            return found + self._facing(others)
        moving = [face for face in others if isinstance(face.place, Tape)]
        if found or not moving:
            return found
        chosen = self.target if any(face.constraint is self.target for face in moving) else moving[0].constraint
        return [_Limit(side=int(face.factor > 0), face=face) for face in others if face.constraint is chosen]

    def _facing(self, others: Sequence[_Face]) -> list[_Limit]:
        """The sides of targets and obstacles of one state that the middle of the start sees."""
        start = float(np.ravel(self.problem.initial.middle)[0])
        found = []
        for face in others:
            above = float(values(face.place, np.array([face.window[0]]))[0]) >= start
            if above == (face.factor < 0):
                found.append(_Limit(side=int(above), face=face))
        return found

    def _innermost(self, limits: Sequence[_Limit], side: int) -> tuple[Formula | None, list[_Face]]:
        """The innermost limit of one side, at all times or else at time 0, and the faces that are there.

        Where sets to stay in are innermost by turns, and nothing else is, it is the innermost of these at each time.
        """
        faces = [limit.face for limit in limits if limit.side == side]
        if not faces:
            return None, []
        places = [self._everywhere(face) for face in faces]
        sign = -1.0 if side == 1 else 1.0
        table = sign * np.array([values(place, self.times) for place in places])
        most = table.max(axis=0)
        near = table >= most - _NEAR * (1 + np.abs(most))
        best = int(np.argmax(near.sum(axis=1)))
        if near[best].all():
            alike = [face for face, own in zip(faces, near) if own.all() and self._alike(face, places[best])]
            return places[best], alike
        turns = [k for k in range(len(faces)) if near[k].any()]
        plain = all(not faces[k].constraint.outside and faces[k].constraint is not self.target
                    and faces[k].window == self.whole for k in turns)  # fmt: skip
        if plain:
            found = combined("max" if side == 0 else "min", *(places[k] for k in turns))
            return found, [faces[k] for k in turns]
        first = int(np.argmax(table[:, 0]))
        return places[first], [faces[first]]

    def _everywhere(self, face: _Face) -> Formula:
        """The limit of a face; where it is not defined beyond its window, as it is at the window's ends."""
        place = face.place
        if face.window == self.whole or np.all(np.isfinite(values(place, self.times))):
            return place
        return composed(place, *face.window)

    def _alike(self, face: _Face, place: Formula) -> bool:
        """Whether a face is at a place at all times of its window."""
        own = self._everywhere(face)
        return own is place or difference(own, place) == 0.0

    def _choose_for_ball(self, constraint: Inside) -> None:
        """Let a ball rest whose states nothing else bounds."""
        region: Any = constraint.region
        if self.n == 1 or not isinstance(region, Ball) or not region.moving:
            return
        places = region.places(self.n)
        taken = {face.state for face in self.faces} | set(self.motions)
        if taken & set(places):
            return
        scale = combined("div", region.radius, start_of(region.radius)) if isinstance(region.radius, Tape) else None
        for place, center in zip(places, entries_of(region.center)):
            if scale is None:
                self.motions[place] = Motion.of_place(center)
            else:
                offset = combined("sub", center, combined("mul", start_of(center), scale))
                self.motions[place] = Motion(offset=offset, scale=scale)
        self.balls.add(constraint)

    def _choose_for_oblique(self, face: _Face) -> None:
        """Let an oblique face rest that moves: by a state of its own that nothing else bounds."""
        if face.state is not None or not isinstance(face.bound, Tape):
            return
        taken = {one.state for one in self.faces} | set(self.motions)
        balls = [one.region.places(self.n) for one in self.all if isinstance(one.region, (Ball, Ellipsoid))]
        taken |= {k for own in balls for k in own}
        free = [k for k in np.flatnonzero(face.normal).tolist() if k not in taken]
        if not free:
            return
        place = max(free, key=lambda k: abs(face.normal[k]))
        rest = combined("sub", face.bound, start_of(face.bound))
        self.motions[place] = Motion(offset=scaled(rest, 1.0, over=float(face.normal[place])))

    def _check(self) -> None:
        """Refuse coordinates that jump, are not defined at all times, or shrink to nothing."""
        for place, motion in self.motions.items():
            name = self.problem.system.states[place]
            parts = [part for part in (motion.offset, motion.scale) if part is not None]
            if not self.discrete and any(map(may_jump, parts)):
                raise InfeasibleError(
                    f"limits of {name} jump in t, and no path jumps with them; state what holds between two jumps as "
                    "limits of their own, each with its `during`."
                )
            range_over(motion.offset, self.whole, discrete=self.discrete)
            if motion.scale is not None and not range_over(motion.scale, self.whole, discrete=self.discrete)[0] > 0:
                raise InfeasibleError(
                    f"the limits of {name} meet, or hardly miss each other, at some time of the horizon; end it before "
                    "that, or keep them apart."
                )

    def _hide(self, face: _Face) -> None:
        """Note where a face is when another one, which rests, stands before it at all times: nothing depends on it.

        Of two limits of sets to stay in the outer one asks for nothing more. In one state and continuous time a path
        that comes to a target is in it before it can be at the target's other side, or at a limit beyond.
        """
        place, stays = face.state, face.constraint is not self.target and not face.constraint.outside
        if place is None or face in self.resting or abs(face.factor) != 1.0 or face.constraint.outside:
            return
        least = self._range(face)[0]  # of a bound of sign * y
        for other, start in self.resting.items():
            if other.state != place or other.window != self.whole or not isinstance(start_of(start), float):
                continue
            own, alike = face.factor * float(at_start(start).lo), other.factor * face.factor > 0
            limit = other.constraint is not self.target and not other.constraint.outside
            if stays and alike and limit and least >= own:
                self.hidden[face] = own
            beyond = other.constraint is self.target and not alike and isinstance(face.constraint.region, (Box, Ball))
            if beyond and self.n == 1 and not self.discrete and least >= own and self._start_before(face, own):
                self.hidden[face] = np.inf

    def _start_before(self, face: _Face, bound: float) -> bool:
        """Whether all starts have sign * y below a bound."""
        initial: Any = self.problem.initial
        if initial.random:
            return False
        hull = initial.hull()
        return bool((hull.hi[0] if face.factor > 0 else -hull.lo[0]) < bound)

    # ---- the problem in these coordinates ----------------------------------------------------------------------

    def _stated(self, *, narrow: bool) -> tuple[Problem | None, str]:
        """The problem with sets no larger than the stated ones (``narrow``), or no smaller; or why there is none."""
        problem, system = self.problem, self.problem.system
        law, signals = isinstance(problem.plan, Tape), dict[str, Any]()
        if system.inputs is not None and not law:
            signals |= {"inputs": system.inputs, "input_names": system.input_names}
        if system.disturbance is not None:
            signals |= {"disturbance": system.disturbance, "disturbance_names": system.disturbance_names}
        try:
            domain = self.domain and self._reshaped(self.domain, narrow).region
            if problem.ending and domain is not problem.domain:
                raise InfeasibleError('limits that move are not served along a `domain` that "ends" paths.')
            target = self.target and self._reshaped(self.target, narrow)
            return problem.replace(
                system=moved_system(system, problem.closed_loop, self.motions, signals),
                safe=self._kept(narrow), reach=target, domain=domain,
                plan=None if law else problem.plan, cost=None, units=None,
            ), ""  # fmt: skip
        except ValueError as error:
            return None, str(error)

    def _kept(self, narrow: bool) -> list[Inside]:
        """The constraints; without obstacles of which, made smaller, nothing is left."""
        found = []
        for constraint in self.problem.safe:
            try:
                found.append(self._reshaped(constraint, narrow))
            except _EmptyError:
                if narrow or not constraint.outside:
                    raise
        return found

    def _reshaped(self, constraint: Inside, narrow: bool) -> Inside:
        """The constraint in the new coordinates."""
        region: Any = constraint.region
        faces, larger = self._of(constraint), constraint.outside == narrow
        if faces:
            touched = any(face.normal[place] for face in faces for place in self.motions)
            if not (touched or region.changing):
                return constraint
            bounds = np.array([self._bound(face)[int(larger)] for face in faces])
            return replace(constraint, region=self._polyhedron(region, faces, bounds, constraint))
        if not (region.changing or set(region.places(self.n)) & set(self.motions)):
            return constraint
        return replace(constraint, region=self._round(region, constraint, larger))

    def _polyhedron(self, region: Any, faces: Sequence[_Face], bounds: Array, constraint: Inside) -> Any:
        if isinstance(region, HalfSpace):
            return HalfSpace(region.normal, bounds[0])
        if isinstance(region, Polytope):
            return Polytope(region.A, bounds)
        low, high = np.full(self.n, -np.inf), np.full(self.n, np.inf)
        for face, bound in zip(faces, bounds):
            side, sign = (high, 1.0) if face.factor > 0 else (low, -1.0)
            side[face.state] = sign * bound
        if np.any(low > high):
            raise _EmptyError(
                f"nothing is inside of '{constraint.label}' at all times in the coordinates in which others rest: it "
                "moves in another way; state limits that move alike, or shorten the horizon."
            )
        return Box(low, high)

    def _round(self, region: Any, constraint: Inside, larger: bool) -> Any:
        if not isinstance(region, (Ball, Ellipsoid)):
            raise InfeasibleError(f"'{constraint.label}' cannot be stated in moving coordinates; use a box or a ball.")
        places = region.places(self.n)
        scale = self._scale(places)
        centers = [self._moved(center, {place: 1.0}) for place, center in zip(places, entries_of(region.center))]
        if isinstance(region, Ellipsoid) and scale is None:
            return replace(region, center=stacked(centers))
        if not isinstance(region, Ball):
            raise InfeasibleError(f"'{constraint.label}' cannot be stated in stretched coordinates; use a ball.")
        window = constraint.during or self.whole
        size = combined("div", region.radius, scale) if scale is not None else region.radius
        slack, center = 0.0, stacked(centers)
        if constraint in self.balls:
            starts = [at_start(center) for center in entries_of(region.center)]
            middles = [float((start.lo + start.hi) / 2) for start in starts]
            slack = sum(float(np.nextafter(start.hi - start.lo, np.inf)) for start in starts if start.lo < start.hi)
            ends, center = at_start(region.radius), stacked(middles)
            low, high = float(ends.lo), float(ends.hi)
        else:
            low, high = range_over(size, window, discrete=self.discrete)
        if slack:
            low, high = float(np.nextafter(low - slack, -np.inf)), float(np.nextafter(high + slack, np.inf))
        self.rounded |= low < high
        if not (high if larger else low) >= 0:
            raise _EmptyError(f"nothing is inside of '{constraint.label}' at all times where other limits rest.")
        return replace(region, center=center, radius=high if larger else low)

    def _bound(self, face: _Face) -> tuple[float, float]:
        """The bound of a face in the new coordinates, from below and above over its window."""
        if face in self.hidden:
            return self.hidden[face], self.hidden[face]
        if face in self.resting:
            start, factor = at_start(self.resting[face]), face.factor
            if abs(factor) != 1.0:
                start = start * abs(factor)
            low, high = (float(start.lo), float(start.hi)) if factor > 0 else (-float(start.hi), -float(start.lo))
        else:
            low, high = self._range(face)
        self.rounded |= low < high
        return low, high

    def _range(self, face: _Face) -> tuple[float, float]:
        """The bounds of a face over its window."""
        weights = {place: float(face.normal[place]) for place in np.flatnonzero(face.normal).tolist()}
        return range_over(self._moved(face.bound, weights), face.window, discrete=self.discrete)

    def _moved(self, bound: Formula, weights: dict[int, float]) -> Formula:
        """(bound - sum of weights times offsets) over the scale that the states have in common."""
        scale, total = self._scale(weights), bound
        for place, weight in weights.items():
            if place in self.motions:
                total = difference(total, scaled(self.motions[place].offset, weight))
        return total if scale is None else combined("div", total, scale)

    def _scale(self, places: Iterable[int]) -> Formula | None:
        """The scale of some states; InfeasibleError where they have several."""
        scales = [self.motions[place].scale if place in self.motions else None for place in places]
        if any(scale is not scales[0] for scale in scales):
            raise InfeasibleError(f"{_DIFFERENT}; state their limits apart.")
        return scales[0]
