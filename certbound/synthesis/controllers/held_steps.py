"""One proved step of the noise-free state under an input that is held: what a filter's promise rests on.

Every noise-free path x from the initial set, under the inputs that were let through, stays around the filter's own
curve p: ||x_t - p(t)||_P <= rho_t, with rho at first the extent of the initial set and then carried from step to step
by Thm K5; it pays for the integrator's error and all rounding (the defect of p is enclosed over the whole step). The
noisy path is within the tube's radius r_t of x_t, whatever the inputs reacted to. A step is proved when {p(t)} +
{||y||_P <= rho_t + r_t} keeps every constraint at all its times, between the samples as well.

Source: Thm K5 (theory); Thm 1 (paper).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.errors import EnclosureError
from certbound.problem.problem import Problem
from certbound.reach.contraction import bound_forcing, integrate_radius, jump_sizes, values_on_pieces
from certbound.reach.nominal import Curve, Flow, initial_cells, nominal_curve
from certbound.reach.sets import ReachTube, constraint_clearance
from certbound.rigor.intervals import Interval
from certbound.rigor.norms import Norm
from certbound.tubes.tube import Tube

CHARGE = 1e-4
"""Share of the tube that the integrator's error may take in one step before more pieces are tried."""
SPARE = 1.0005
"""Times the tube that a step should leave room for in continuous time, where the next one begins at its end."""
LARGEST_DIVISION = 64


@dataclass(frozen=True, eq=False, kw_only=True)
class Link:
    """||x - c||_P <= radius at one time, for every noise-free path x, c the point in the box ``end``, shape (n,)."""

    end: Interval
    radius: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ProvedStep:
    """What one step leaves."""

    state: Array  # (n,): noise-free state to go on from
    link: Link  # at the end of the step
    # (constraints,): room of every constraint over the step, in the metric, beyond what this step and the
    # beginning of the next one take; inf where it is not asked
    room: Array
    proved: bool  # this step keeps every constraint


@dataclass(frozen=True, eq=False)
class _Held(Flow):
    """The dynamics under one input row on [first, last]."""

    row: ArrayLike = ()
    first: float = 0.0
    last: float = 0.0

    @cached_property
    def breaks(self) -> Array:
        return np.array([self.first, self.last])

    def plan_rows(self, starts: ArrayLike) -> Array:
        return np.tile(np.asarray(self.row, dtype=float), (len(np.asarray(starts)), 1))

    def plan_ranges(self, starts: ArrayLike) -> Interval:
        return Interval.point(self.plan_rows(starts))


@dataclass(eq=False, kw_only=True)
class HeldSteps:
    """The steps of one problem around one tube."""

    problem: Problem  # with an array plan, which is not used, and without a disturbance
    tube: Tube  # its constants hold for every input
    times: Array  # (steps + 1,): ends of the steps, from 0 to the horizon
    _norm: Norm = field(init=False)
    _radii: dict[int, float] = field(init=False, default_factory=dict)
    _pieces: int = field(init=False, default=1)

    def __post_init__(self) -> None:
        self._norm = self.tube.constants.norm

    @property
    def continuous(self) -> bool:
        """True in continuous time."""
        return bool(self.problem.system.time == "continuous")

    def start(self, state: Array) -> tuple[Link, bool]:
        """The initial set around ``state``, and whether it is proved to keep the constraints at step 0."""
        cells, point = initial_cells(self.problem), Interval.point(state)
        link = Link(end=point, radius=float(cells.radii(self._norm, point.reshape(1, -1))[0]))
        if self.continuous:
            return link, True  # the first step begins there
        here = Curve(continuous=False, starts=np.zeros(1), ends=np.zeros(1), coefficients=state[None, None, None])
        around = [
            ReachTube(curve=here, box=(cells.boxes - point).reshape(1, 1, -1)),
            ReachTube(curve=here, radius=[[link.radius]], metric=self.tube.constants.metric),
        ]
        if cells.round is not None and cells.round[1].even:
            euclidean = cells.radii(Norm(len(state)), point.reshape(1, -1))
            around.append(ReachTube(curve=here, radius=euclidean[:, None]))
        rooms = np.max([self._rooms(reach)[:, 0] for reach in around], axis=0)
        return link, bool(np.all(rooms >= 0))

    def advance(self, link: Link, state: Array, index: int, inputs: Array) -> ProvedStep:
        """The step ``index`` from ``state`` under inputs (m,); what ``state`` is off from ``link`` is charged.

        Raises
        ------
        ValueError, EnclosureError
            If the noise-free path cannot be followed, or has no enclosure.
        """
        first, last = float(self.times[index]), float(self.times[index + 1])
        flow = _Held(self.problem, row=inputs, first=first, last=last)
        taken = self._radius(index)
        curve, eta = self._followed(flow, state, taken)
        slope = self.tube.constants.rate if self.continuous else self.tube.constants.gain
        slopes = values_on_pieces(slope, self.tube.constants.times, curve)
        moved = self._norm.length(curve.initial()[0] - link.end)
        start = (Interval.point(link.radius) + Interval.point(moved)).hi
        radius, after = integrate_radius(curve, jump_sizes(curve, self._norm), np.array([start]), slopes, eta)
        if not np.all(np.isfinite(radius)) or not np.isfinite(after[0]):
            raise EnclosureError(f"the noise-free path has no enclosure on [{first:g}, {last:g}].")
        reach = ReachTube(curve=curve, radius=radius, metric=self.tube.constants.metric)
        rooms = self._rooms(reach)[:, slice(None) if self.continuous else slice(1, None)]
        end = curve.range(curve.offset(Interval.point(curve.ends)))[0, -1]
        reached = float(after[0]) if self.continuous else float(radius[0, -1])
        return ProvedStep(
            state=np.asarray(end.mid), link=Link(end=end, radius=reached), room=rooms.min(axis=1) - self._aim(index),
            proved=bool(np.all(rooms >= taken) and (np.all(rooms > 0) or not self.continuous)),
        )  # fmt: skip

    def _rooms(self, reach: ReachTube) -> Array:
        """Proved rooms (constraints, pieces)."""
        found = [constraint_clearance(reach, one, self._norm).radius for one in self.problem.constraints]
        return np.reshape(found, (len(found), reach.curve.pieces))

    def _radius(self, index: int) -> float:
        """Upper bound of the tube's radius over a step (in discrete time: at its end)."""
        if index not in self._radii:
            first, last = self.times[index + (0 if self.continuous else 1)], self.times[index + 1]
            self._radii[index] = float(self.tube.bound(float(first), float(last)))
        return self._radii[index]

    def _aim(self, index: int) -> float:
        """What a step should leave room for."""
        if not self.continuous:
            return self._radius(index)
        return SPARE * max(self._radius(k) for k in (index, index + 1) if k + 1 < len(self.times))

    def _followed(self, flow: _Held, state: Array, taken: float) -> tuple[Curve, Array]:
        """A curve over the step, and the forcing that its defect makes (Thm K5), shape (1, K)."""
        if not self.continuous:
            points = np.array([state, flow.value(flow.first, state, np.asarray(flow.row))])
            if not np.all(np.isfinite(points)):
                raise ValueError("the noise-free path is lost: the next state is not finite.")
            steps = np.array([flow.first, flow.last])
            curve = Curve(continuous=False, starts=steps, ends=steps, coefficients=points[None, :, None])
            return curve, bound_forcing(flow, curve, self._norm)
        marks = [t for one in self.problem.safe for t in one.during or () if flow.first < t < flow.last]
        while True:
            grid = np.unique([*np.linspace(flow.first, flow.last, self._pieces + 1), *marks])
            curve = nominal_curve(flow, state, times=grid)
            eta = bound_forcing(flow, curve, self._norm)
            if float((eta @ np.diff(grid))[0]) <= CHARGE * taken or self._pieces >= LARGEST_DIVISION:
                return curve, eta
            self._pieces *= 2
