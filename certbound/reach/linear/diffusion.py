"""Thm K7 where the noise depends on the state: X = p + y + Z + M + R.

Z answers a chosen diffusion ghat(t) exactly, M' = Jhat M dt + (g(t, X) - ghat) dW the rest of the noise, stopped when
the state leaves a tube. `DiffusionRun` guesses the tube, bounds g - ghat over it, grants Z and M their levels, encloses
the remainder, and accepts when what follows lies strictly inside the guess. Two choices of ghat compete: g along the
nominal curve (M is of second order), and 0 (all noise in M: better where the state moves g a lot).

M is a martingale only if the start and the disturbance do not see coming noise: every answer says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.constants.enclosures import enclose
from certbound.gaussian.response import (
    ClockEvents,
    LinearResponse,
    Martingales,
    SplitEvents,
    Windowed,
    WindowEvents,
    continuous_response,
    level_along,
)
from certbound.problem.model import Tape
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem
from certbound.reach.linear.answer_tubes import levels_of_coordinates
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.run import LinearRun, Outcome
from certbound.reach.linear.shares import Share
from certbound.reach.sets import Requirement
from certbound.rigor.intervals import Interval

_ROUNDS = 12
_SETTLE = 6
_GROWTH = 0.03
_ENOUGH = 0.5  # levels of M below this share of those of Z: all noise in M cannot be better


def depends_on_state(problem: Problem) -> bool:
    """Whether the diffusion is a function of the state or of time."""
    return isinstance(problem.system, ContinuousSystem) and isinstance(problem.system.diffusion, Tape)


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference:
    """One choice of ghat: its Gaussian response, ghat itself (B, N, n, m), and what is computed once for it."""

    response: LinearResponse
    value: Array
    gaussian: bool
    memory: dict[int, dict[bytes, Any]] = field(default_factory=dict)
    events: dict[tuple[int, Share], ClockEvents | WindowEvents] = field(default_factory=dict)
    levels: dict[tuple[int, int, Share], Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class Accepted:
    """A reference and the bounds of g - ghat, one (N, n, m) a cell, over a tube that closed."""

    reference: Reference
    excess: list[Interval]


class DiffusionRun(LinearRun):
    """`LinearRun` for a diffusion g(t, x).

    ``probability`` finds the tube for a given delta_N; the other methods use the tube found for it.
    """

    def __init__(self, engine: Linearisation) -> None:
        super().__init__(engine)
        assert isinstance(engine.system, ContinuousSystem)
        assert isinstance(engine.system.diffusion, Tape)
        self.tape = engine.system.diffusion
        cells, pieces, n = engine.shape
        slope, drift, _ = engine.slopes
        silent = np.zeros((cells, pieces, n, self.tape.shape[1]))
        without = continuous_response(
            slope, drift, engine.step, np.zeros((n, 1)), engine.start_covariance, slope_error=engine.slope_error
        )
        self.references = [
            Reference(response=engine.response, value=engine.diffusion, gaussian=True),
            Reference(response=without, value=silent, gaussian=bool(engine.start_covariance.any())),
        ]
        self.frames = [Windowed(engine.response, cell) for cell in range(cells)]
        self.outcomes: dict[Share, Outcome] = {}
        self.accepted: dict[Share, Accepted] = {}
        self.held = Accepted(reference=self.references[0], excess=[])

    # ---- the noise over a tube ---------------------------------------------------------------------------

    def excess(self, reference: Reference, low: Array, high: Array) -> list[Interval] | None:
        """g - ghat over p + [low, high] in the active coordinates (B N, active); None where g is not defined."""
        engine, frame = self.engine, self.engine.frame
        active = engine.model.active
        reach = frame.spread * (1 + 1e-15)
        lower, upper = -reach, reach.copy()
        lower[:, active] += low - 4e-16 * np.abs(low)
        upper[:, active] += high + 4e-16 * np.abs(high)
        state = frame.middle + Interval(np.nextafter(lower, -np.inf), np.nextafter(upper, np.inf))
        slots = [frame.span, *(state[:, i] for i in range(engine.n))]
        value = enclose(self.tape, slots, undefined="infinite").broadcast_to((len(low), *self.tape.shape))
        finite = np.isfinite(value.lo) & np.isfinite(value.hi)
        if not finite.all():
            cells = finite.all(axis=(1, 2)).reshape(-1, engine.pieces).all(axis=0)
            self.failed_at = int(np.argmin(cells))
            return None
        value = value - reference.value.reshape(value.shape)
        shape = (engine.pieces, *self.tape.shape)
        return [value[k * engine.pieces : (k + 1) * engine.pieces].reshape(*shape) for k in range(self.engine.cells)]

    def events(self, cell: int, shared: Share) -> SplitEvents:
        """Scalar events of Z + M of one cell; half of the shared probability is granted to each."""
        reference, gaussian = self.held.reference, None
        share = shared.half() if reference.gaussian else shared
        if reference.gaussian:
            if (cell, share) not in reference.events:
                windows = WindowEvents(reference.response, cell, self.engine.window, share.log)
                reference.events[cell, share] = self._events_of(windows, cell)
            gaussian = reference.events[cell, share]
        martingales = Martingales(reference.response, cell, self.held.excess[cell], share.log, self.frames[cell])
        return SplitEvents(gaussian=gaussian, martingales=martingales)

    def _events_of(self, windows: WindowEvents, cell: int) -> ClockEvents | WindowEvents:
        """The events of Z that follow from windows."""
        reference = self.held.reference
        return ClockEvents(windows, reference.value[cell], reference.memory.setdefault(cell, {}))

    def levels(self, nonlinear: Share) -> tuple[Array, list[Any]]:
        """Levels of |Z + M| along the inner rows that together cost exp(nonlinear.log), and the events.

        What `Share.common` leaves is divided between the rows, and in equal parts between Z and M.
        """
        self.held = self.accepted.get(nonlinear, self.held)
        cells, pieces, count = self.rows.shape[:3]
        result = np.zeros((cells, pieces, count))
        share = nonlinear.side(count, terms=2)
        events = [self.events(cell, nonlinear.common()) for cell in range(cells)]
        for cell, d in np.ndindex(cells, count):
            level = events[cell].martingales.along(self.rows[cell, :, d]).level(share.log)
            result[cell, :, d] = level * (1 + 1e-12) + self._gaussian_level(events[cell], cell, d, share)
        return result, list(events)

    def _gaussian_level(self, events: SplitEvents, cell: int, d: int, share: Share) -> Array:
        """Levels of w . Z along an inner row that cost a share."""
        found, key = self.held.reference.levels, (cell, d, share)
        if key not in found:
            event = None if events.gaussian is None else events.gaussian.along(self.rows[cell, :, d])
            found[key] = np.zeros(self.rows.shape[1])
            if event is not None and event.profile.max() > 0:
                found[key] = level_along(event, share.log)
        return found[key]

    def tightest(self, outcome: Outcome) -> tuple[Requirement | None, int, float]:
        """See `LinearRun.tightest`."""
        self.held = self.accepted.get(outcome.nonlinear, self.held)
        return super().tightest(outcome)

    # ---- the fixed point ---------------------------------------------------------------------------------

    def bounded(self, nonlinear: Share, effort: int = 2) -> Outcome:
        """See `LinearRun.bounded`; by the reference whose levels are smaller, in the mean of their logarithms."""
        if nonlinear in self.outcomes:
            return self.outcomes[nonlinear]
        best = Outcome(log_probability=0.0, nonlinear=nonlinear, bounds=None)
        size = np.inf
        for reference in self.references:
            found = self._close(reference, nonlinear, effort)
            if found is None:
                continue
            accepted, bounds, share = found
            one = Outcome(log_probability=0.0, nonlinear=nonlinear, bounds=bounds)
            self.accepted[nonlinear] = accepted
            own = -np.inf if share < _ENOUGH else self._size(one)
            if best.bounds is None or own < size:
                best, kept, size = one, accepted, own
            if share < _ENOUGH:
                break
        if best.bounds is not None:
            self.accepted[nonlinear] = self.held = kept
        return best

    def _size(self, outcome: Outcome) -> float:
        """How large levels are: along the inner rows, or along the coordinates where there are none."""
        levels = [self.levels(outcome.nonlinear)[0]]
        if not levels[0].size:
            levels = levels_of_coordinates(self, outcome)[0]
        return float(np.mean([np.log(np.maximum(part, 1e-300)).mean() for part in levels]))

    def probability(self, nonlinear: Share, effort: int = 2) -> Outcome:
        """Thm K7' with delta_N = exp(nonlinear.log), by the better of both references."""
        if nonlinear in self.outcomes:
            return self.outcomes[nonlinear]
        best = Outcome(log_probability=0.0, nonlinear=nonlinear, bounds=None)
        for reference in self.references:
            found = self._close(reference, nonlinear, effort)
            if found is None:
                continue
            accepted, bounds, share = found
            _, events = self.levels(nonlinear)
            outcomes = [self._cell(k, bounds, events[k], nonlinear) for k in range(self.engine.cells)]
            worst = max(outcomes, key=lambda outcome: outcome.log_probability)
            if best.bounds is None or worst.log_probability < best.log_probability:
                best, kept = worst, accepted
            if share < _ENOUGH:
                break
        if best.bounds is not None:
            self.accepted[nonlinear] = self.held = kept
        self.outcomes[nonlinear] = best
        return best

    def promise(self, nonlinear: Share, effort: int, limit: float = 0.0) -> float:
        """What `probability` finds, in logarithms: nothing can be guessed before a tube has closed."""
        return self.probability(nonlinear, effort).log_probability

    def _close(
        self, reference: Reference, nonlinear: Share, effort: int
    ) -> tuple[Accepted, tuple[Array, Array], float] | None:
        """Bounds of g - ghat and of the remainder over a tube that contains what follows from them.

        The third entry is the largest share of M in the levels (1 where there is no Z).
        """
        engine = self.engine
        count = len(engine.model.active)
        low = high = np.zeros((engine.cells * engine.pieces, count))
        bounds = self.nothing
        fresh = False
        for _ in range(_ROUNDS):
            for _ in range(_SETTLE):
                excess = self.excess(reference, low, high)
                if excess is None:
                    return None
                self.held = Accepted(reference=reference, excess=excess)
                levels, events = self.levels(nonlinear)
                levels = levels * (1 + 1e-12) + 1e-280  # the state then stays strictly inside
                reached = self.deviations(levels, *bounds) if np.isfinite(levels).all() else None
                if reached is None:
                    return None
                inner = reached[0][:, :count], reached[1][:, :count]
                if np.all((inner[0] >= low) & (inner[1] <= high)):
                    if fresh:
                        return self.held, bounds, self._share(events)
                    break
                wider = _GROWTH * (inner[1] - inner[0])
                low, high = np.minimum(low, inner[0] - wider), np.maximum(high, inner[1] + wider)
                fresh = False
            found = self.include(levels, effort)
            if found is None:
                return None
            bounds, fresh = found, True
        return None

    def _share(self, events: list[Any]) -> float:
        """The largest ratio of M's levels to Z's along the inner rows."""
        ratios = [1.0]
        for cell, own in enumerate(events):
            for d in range(len(self.engine.model.active)):
                event = own.along(self.rows[cell, :, d])
                size = 0.0 if event.gaussian is None else float(event.gaussian.profile.max())
                ratios.append(float(event.martingale.profile.max()) / size if size > 0 else 1.0)
        return max(ratios[1:], default=1.0)
