"""A problem in three states with noise in one of them, as this room reads it: states (x, y, q), the noise on q."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, compile_numpy, sources
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces, Inside, Quadratic, Region
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.intervals import Interval, sq, sqrt, stack
from certbound.values.continuous import faces_of, starts_of
from certbound.values.semilagrangian.confines import Ends, parts_of
from certbound.values.semilagrangian.noisy_axis import reordered
from certbound.values.sets import box_around, contains

_PATHS, _STEPS = 400, 200
_BEYOND = 0.25  # of the simulated paths' extent, where nothing bounds a coordinate
STATES = 3


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Voyage:
    """d(x, y) = F dt, dq = g dt + s dW: two coordinates without noise, and one with it.

    Attributes
    ----------
    tape : Tape
        (F, g) over ("t", "x", "y", "q"), free of t.
    noise : float
        s, up to the relative error ``spread``.
    ends : tuple of (float, float)
        By coordinate: a box that holds the safe set, or beyond which hardly a path gets.
    starts : tuple of (float, float)
        A box around the starts.
    stays, obstacles : tuple of Region
        Sets of (x, y) alone, to stay in (convex) and to keep out of.
    order : tuple of int
        Which states x, y and q are.
    """

    tape: Tape
    noise: float
    spread: float
    ends: tuple[Ends, ...]
    starts: tuple[Ends, ...]
    horizon: float
    stays: tuple[Region, ...]
    obstacles: tuple[Region, ...]
    order: tuple[int, ...]

    def safe(self, box: Sequence[Interval], bow: Sequence[Array], near: Sequence[Array]) -> Mask:
        """Boxes of (x, y) that surely lie ``bow`` inside what is to stay in, and ``near`` off every obstacle."""
        found = np.ones(box[0].lo.shape, dtype=bool)
        for regions, away, kept in ((self.stays, bow, 0), (self.obstacles, near, 1)):
            grown = [Interval(part.lo - more, part.hi + more) for part, more in zip(box, away)]
            for part, ends in zip(grown, self.ends if kept == 0 else ()):
                found &= (part.lo >= ends[0]) & (part.hi <= ends[1])
            states = [Interval.point(np.zeros(found.shape))] * STATES
            for place, part in zip(self.order, grown):
                states[place] = part
            for region in regions:
                found &= contains(region, stack(states, axis=-1), 0)[kept]
        return found


def carries(problem: Problem) -> bool:
    """Whether a problem has three states in continuous time, and noise that surely leaves two of them alone."""
    system = problem.system
    if not isinstance(system, ContinuousSystem) or system.dimension != STATES or isinstance(system.diffusion, Tape):
        return False
    return int(np.any(np.asarray(system.diffusion) != 0, axis=1).sum()) == 1


def voyage_of(problem: Problem) -> Voyage:
    """Read a problem.

    Raises
    ------
    InfeasibleError
        Disturbances, time in the model, windows, moving sets, limits that join q to the others; the message says which.
    """
    system = problem.system
    if not carries(problem) or not isinstance(system, ContinuousSystem):
        raise InfeasibleError("steps along the flow serve three states with constant noise in one of them.")
    if system.disturbance is not None or problem.input_sequence is not None:
        raise InfeasibleError(
            "value functions with noise in one coordinate serve neither disturbances nor plans yet; "
            "value functions prove nothing here."
        )
    gain = np.asarray(system.diffusion, dtype=float)
    noisy = int(np.flatnonzero(np.any(gain != 0, axis=1))[0])
    order = (*(k for k in range(STATES) if k != noisy), noisy)
    size = sqrt(sq(Interval.point(gain[noisy])).sum(axis=-1))
    if any(0 in found for found in sources(problem.closed_loop)):
        raise InfeasibleError(
            "value functions with noise in one of three coordinates serve no models that change with time yet; "
            "value functions prove nothing here."
        )
    tape = reordered(problem.closed_loop, order)
    starts = starts_of(problem)
    stays, obstacles, limits = _limits(problem, noisy)
    low, high = box_around(problem.constraints, STATES, 0)
    low[noisy], high[noisy] = limits
    ends = [(float(low[k]), float(high[k])) for k in order]
    begun = tuple(starts[k] for k in order)
    noise = float(size.mid)
    return Voyage(
        tape=tape, noise=noise, spread=float(size.rad / size.mid) + 1e-15,
        ends=_closed(tape, noise, ends, begun, float(problem.horizon)), starts=begun, horizon=float(problem.horizon),
        stays=tuple(stays), obstacles=tuple(obstacles), order=order,
    )  # fmt: skip


def _limits(problem: Problem, noisy: int) -> tuple[list[Region], list[Region], Ends]:
    """Sets of the carried coordinates to stay in and to keep out of, and the limits of q, rounded inward."""
    stays: list[Region] = []
    obstacles: list[Region] = []
    ends = [-math.inf, math.inf]
    for constraint in problem.constraints:
        if constraint.region.moving or constraint.during not in (None, (0.0, float(problem.horizon))):
            raise InfeasibleError(
                "value functions with noise in one coordinate serve neither moving sets nor windows yet "
                f"('{constraint.label}')."
            )
        for region, outside in parts_of(constraint.region, outside=constraint.outside, states=STATES):
            if not _bounds(region, noisy):
                (obstacles if outside else stays).append(region)
                continue
            _check_alone(region, constraint, noisy, outside)
            for _, side, near, _ in faces_of(Inside(region, label=constraint.label)):
                ends[side] = (max, min)[side](ends[side], near)
    return stays, obstacles, (ends[0], ends[1])


def _bounds(region: Region, state: int) -> bool:
    """Whether a set says anything about a state."""
    places = region.places(STATES)
    if state not in places:
        return False
    form = region.form
    return isinstance(form, Quadratic) or bool(np.any(form.normals[:, places.index(state)]))


def _check_alone(region: Region, constraint: Inside, noisy: int, outside: bool) -> None:
    form = region.form
    rows = region.lifted(form.normals, STATES) if isinstance(form, Faces) else np.ones((1, STATES))
    if outside or np.any(np.delete(rows, noisy, axis=1)):
        raise InfeasibleError(
            f"'{constraint.label}' joins the noisy state to the others; write limits of it as a box of its own, "
            "value functions prove nothing here."
        )


def _closed(
    tape: Tape, noise: float, ends: Sequence[Ends], starts: Sequence[Ends], horizon: float
) -> tuple[Ends, ...]:
    """The limits, or else ends far beyond simulated paths; any will do, since leaving them counts as failing."""
    if not np.isfinite(ends).all():
        found = _reach(tape, noise, starts, horizon)
        ends = [tuple(a if math.isfinite(a) else b for a, b in zip(*pair)) for pair in zip(ends, found)]  # type: ignore
    if not all(low < high for low, high in ends):
        raise InfeasibleError("the safe set has no interior.")
    return tuple(ends)


def _reach(tape: Tape, noise: float, starts: Sequence[Ends], horizon: float) -> list[Ends]:
    rng, drift = np.random.default_rng(0), compile_numpy(tape)
    x = np.array([rng.uniform(*ends, _PATHS) for ends in starts])
    least, most = x.min(axis=1), x.max(axis=1)
    step = horizon / _STEPS
    for _ in range(_STEPS):
        with np.errstate(all="ignore"):
            f = np.moveaxis(np.broadcast_to(drift(0.0, *x), (_PATHS, STATES)), -1, 0)
        moved = x + step * f
        moved[-1] += noise * math.sqrt(step) * rng.standard_normal(_PATHS)
        x = np.where(np.isfinite(moved), moved, x)
        least, most = np.minimum(least, x.min(axis=1)), np.maximum(most, x.max(axis=1))
    more = _BEYOND * (most - least) + 1e-3 * noise * math.sqrt(horizon)
    return [(float(a), float(b)) for a, b in zip(least - more, most + more)]
