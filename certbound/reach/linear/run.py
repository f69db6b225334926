"""The linear-response engine (Thm K7): nominal + zonotope + exact Gaussian response + proved remainder.

X = p + y + Z + R: y answers the initial set and the disturbance linearly, Z is Gaussian, and R gathers what the
linearisation leaves over. The event that Z stays within levels along the coordinates that enter nonlinearly costs
delta_N; on it R obeys an inclusion that `Inclusion.include` guesses and proves. What each constraint then leaves
to Z is a scalar event, so that P(unsafe) <= delta_N + sum_j P_j (Thm K7').
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.gaussian.response import (
    ClockEvents,
    SplitEvents,
    SteadyEvent,
    StepEvents,
    WindowEvents,
    level_along,
    log_any_exceedance,
    log_occupancy,
    logsumexp,
    quantile,
)
from certbound.gaussian.scalar import log_tail_below
from certbound.problem.systems import ContinuousSystem
from certbound.reach.linear.fixed_point import PADS, Inclusion
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.shares import Share
from certbound.reach.sets import Requirement, requirements
from certbound.watch import poll

Events = StepEvents | ClockEvents | SplitEvents | WindowEvents

_MARGIN = 2.0  # times that width is what a proof is expected to need
_OVERLAPPING = -8.0  # from which on constraints that are broken together are counted once
_LIKELY = -4.0  # log of a probability from which on a product is worth more than a sum


@dataclass(frozen=True, eq=False, kw_only=True)
class Outcome:
    """What one run proved."""

    log_probability: float  # natural logarithm of a bound on P(unsafe); 0 when nothing was proved
    nonlinear: Share  # delta_N
    bounds: tuple[Array, Array] | None  # (B, N, n): the proved enclosure of the remainder beta, None when it fed itself
    cell: int = 0  # the worst cell
    logs: tuple[float, ...] = ()  # what every requirement costs there
    shared: float = 0.0  # and what they cost in common
    unshared: tuple[float, ...] = ()  # or what each costs where they share nothing


class LinearRun(Inclusion):
    """One evaluation of the engine: the inclusion for the remainder, the events, and their room.

    ``hoped`` is the delta_N that promised most, here or in a run much like this one, and ``lost`` the logarithm of the
    largest one at which the remainder could not be enclosed; ``parted``: cells of the starts were tried in vain;
    ``halving``: what is proved of them so far; ``beyond``: what the first share that was too small said.
    """

    def __init__(self, engine: Linearisation) -> None:
        super().__init__(engine)
        self.hoped: Share | None = None
        self.lost = -np.inf
        self.parted = False
        self.halving: Any = None
        self.beyond: Outcome | None = None
        self.memory: dict[int, dict[bytes, Any]] = {}
        self.steps: dict[int, StepEvents] = {}
        self.kept: dict[Share, tuple[Array, list[Events]]] = {}
        self.spent: dict[Share, tuple[Array, Array] | None] = {}

    @cached_property
    def requirements(self) -> list[list[Requirement]]:
        """What the constraints ask for, cell by cell."""
        return [requirements(self.engine.problem, self.engine.nominal(cell)) for cell in range(self.engine.cells)]

    def outer(self, cell: int) -> list[Array]:
        """The rows of what is asked."""
        return [asked.rows for asked in self.requirements[cell]]

    def events(self, cell: int, shared: Share) -> Events:
        """Scalar events of one cell; ``shared`` is what they may cost in common."""
        engine = self.engine
        if isinstance(engine.system, ContinuousSystem):
            kept = self.memory.setdefault(cell, {})
            windows = WindowEvents(engine.response, cell, engine.window, shared.log, kept)
            if engine.response.jumps:  # which clocks and crossing rates do not know
                return windows
            diffusion = engine.diffusion if engine.diffusion.ndim == 2 else engine.diffusion[cell]
            return ClockEvents(windows, diffusion, kept)
        if cell not in self.steps:
            self.steps[cell] = engine.step_events(cell)
        return self.steps[cell]

    def levels(self, nonlinear: Share) -> tuple[Array, list[Events]]:
        """Levels of |Z| along the inner rows costing exp(nonlinear.log) together (B, N, D); no events without noise."""
        if nonlinear in self.kept:
            return self.kept[nonlinear]
        cells, pieces, count = self.rows.shape[:3]
        result = np.zeros((cells, pieces, count))
        if not self.engine.noise:
            return result, []
        share = nonlinear.side(count).log
        found = []
        for cell in range(cells):
            events = self.events(cell, nonlinear.common(count))
            found.append(events)
            for d in range(count):
                poll(self.phase("levels of the noise", cell))
                event = events.along(self.rows[cell, :, d])
                if event.profile.max() > 0:
                    result[cell, :, d] = level_along(event, share)
        self.kept[nonlinear] = result, found
        return result, found

    def hopeless(self, nonlinear: Share) -> bool:
        """Whether the remainder feeds itself at levels that are too small already (``failed_at`` names a piece).

        Z leaves a level of q standard deviations with probability 2 Q(q) at one time alone, so that all levels that
        cost exp(nonlinear.log) are larger; in continuous time they are dear, and not asked for where this is enough.
        """
        if not (self.engine.continuous and self.engine.noise and self.curved):
            return False
        return self._at_least(nonlinear) is None

    def _at_least(self, nonlinear: Share) -> tuple[Array, Array] | None:
        """A guess of the remainder at those levels: less than what any proof finds; None where it feeds itself."""
        if nonlinear not in self.spent:
            q = quantile(nonlinear.log - float(np.log(2.0)))
            v = self.engine.response.covariance[:, 1:]
            variance = np.einsum("bkdi,bkij,bkdj->bkd", self.rows, v, self.rows)
            levels = 0.99 * q * np.sqrt(np.maximum(variance, 0.0))
            self.spent[nonlinear] = self.guess(levels, self.nothing, self.nothing, 0.0)
        return self.spent[nonlinear]

    def _one_time(self, nonlinear: Share) -> float:
        """Logarithm of what leaving costs at least, by the guess: the noise beyond the room of one row at one time."""
        if not (self.engine.continuous and self.engine.noise and self.curved):
            return -np.inf
        guess, worst = self._at_least(nonlinear), -np.inf
        for cell, asked in enumerate(self.requirements if guess is not None else ()):
            assert guess is not None
            rooms, v = self.rooms(cell, guess), self.engine.response.covariance[cell, 1:]
            for i, requirement in enumerate(asked):
                deviation = np.sqrt(np.maximum(np.einsum("ki,kij,kj->k", requirement.rows, v, requirement.rows), 0.0))
                with np.errstate(divide="ignore", invalid="ignore"):
                    sizes = np.where(deviation > 0, rooms[:, i] / deviation, np.inf)
                worst = max(worst, float(log_tail_below(np.clip(np.min(sizes), -1e3, 1e100))))
        return worst

    def promise(self, nonlinear: Share, effort: int, limit: float = 0.0) -> float:
        """What `probability` is likely to find, in logarithms: from a guess of the remainder that is not proved.

        A value beyond ``limit`` says no more than that: the cells that come after such a one are left out.
        """
        if self.hopeless(nonlinear):
            return 0.0
        least = self._one_time(nonlinear)
        if least > limit:
            return least
        levels, events = self.levels(nonlinear)
        guess = self.guess(levels, self.nothing, self.nothing, _MARGIN * PADS[effort])
        if guess is None:
            return 0.0
        worst = -np.inf
        for cell in range(self.engine.cells):
            poll(self.phase("a guess of the probability", cell))
            worst = max(worst, self._cell(cell, guess, events[cell], nonlinear, limit).log_probability)
            if worst > limit:
                break
        return worst

    def bounded(self, nonlinear: Share, effort: int = 2) -> Outcome:
        """What `probability` rests on, for a tube: the limits are not asked for, and the probability is left 1."""
        bounds = None
        if not self.hopeless(nonlinear):
            bounds = self.include(self.levels(nonlinear)[0], effort)
            self.lost = self.lost if bounds is not None else max(self.lost, nonlinear.log)
        return Outcome(log_probability=0.0, nonlinear=nonlinear, bounds=bounds)

    def probability(self, nonlinear: Share, effort: int = 2) -> Outcome:
        """Thm K7' with delta_N = exp(nonlinear.log): the outcome of the worst cell."""
        found = self.bounded(nonlinear, effort)
        bounds, events = found.bounds, [] if found.bounds is None else self.levels(nonlinear)[1]
        if bounds is None or not events:  # without events the noise-free reachable set alone
            return found
        outcomes = [self._cell(cell, bounds, events[cell], nonlinear) for cell in range(self.engine.cells)]
        return max(outcomes, key=lambda outcome: outcome.log_probability)

    def phase(self, work: str, cell: int) -> str:
        """What is done, and in which cell of the initial set."""
        return work if self.engine.cells == 1 else f"{work}, cell {cell + 1} of {self.engine.cells}"

    def rooms(self, cell: int, bounds: tuple[Array, Array]) -> Array:
        """Room that each requirement leaves to Z on each piece: (pieces, requirements), rounded down."""
        support = self.supports[cell]
        _, high, _ = support.remainder(bounds[0][cell], bounds[1][cell])
        used = support.y[:, self.inner :] + high[:, self.inner :]
        room = np.concatenate([used[:, :0], *(r.room[:, None] for r in self.requirements[cell])], axis=1)
        with np.errstate(invalid="ignore"):  # where nothing is asked
            left = room - used - 4e-16 * (np.abs(room) + np.abs(used))
        return np.asarray(np.where(np.isinf(room), np.inf, left))

    def _cell(
        self, cell: int, bounds: tuple[Array, Array], events: Events, nonlinear: Share, limit: float = 0.0
    ) -> Outcome:
        """What the bounds leave to the events; in continuous time no more than that it is beyond ``limit``."""
        rooms = self.rooms(cell, bounds)
        shared = nonlinear.log if self.curved else events.shared_log
        asked = self.requirements[cell]
        along = [events.along(r.rows) for r in asked]
        logs = []
        for i, event in enumerate(along):
            poll(self.phase("probability of leaving", cell))
            logs.append(event.log_exceedance(rooms[:, i]))
            if self.curved and not isinstance(events, StepEvents) and limit < logsumexp(np.array([shared, *logs])):
                break
        if isinstance(events, StepEvents) and events.gaussian:
            logs = [self._entered(cell, r, log, bounds) for r, log in zip(asked, logs, strict=True)]
        total = logsumexp(np.array([shared, *logs]))
        steady = [event for event in along if isinstance(event, SteadyEvent)]
        unshared: list[float] = []
        if asked and not self.curved and len(steady) == len(along):
            unshared = [e.log_unshared(rooms[:, i]) for i, e in enumerate(steady)]
            total = min(total, logsumexp(np.array(unshared)))
        if total > _LIKELY and isinstance(events, StepEvents) and events.gaussian:
            total = min(total, correlated(events, asked, rooms, shared, logs))
        if total > _OVERLAPPING and isinstance(events, StepEvents) and events.gaussian and asked:
            joined = log_any_exceedance(events, [r.rows for r in asked], list(rooms.T))
            total = min(total, logsumexp(np.array([shared, joined])))
        return Outcome(
            log_probability=min(total, 0.0), nonlinear=nonlinear, bounds=bounds, cell=cell, logs=tuple(logs),
            shared=shared, unshared=tuple(unshared),
        )

    def _entered(self, cell: int, asked: Requirement, log: float, bounds: tuple[Array, Array]) -> float:
        """What a requirement costs, or the time spent in its obstacle, if that is less and the cost is too much."""
        engine, constraints = self.engine, self.engine.problem.constraints
        if log <= Share.of(engine.problem.delta).log or not 0 <= asked.constraint < len(constraints):
            return log
        support = self.supports[cell]
        remainder = support.remainder(bounds[0][cell], bounds[1][cell])[2]
        return min(log, log_occupancy(
            constraints[asked.constraint], engine.response, cell, nominal=engine.nodes[cell], moved=support.y_nodes,
            remainder=remainder, disturbed=bool(np.any(engine.d_radius))))

    def tightest(self, outcome: Outcome) -> tuple[Requirement | None, int, float]:
        """The requirement with the least room at the problem's delta (shared evenly), its piece, and that room."""
        if outcome.bounds is None:
            return None, self.failed_at, -np.inf
        asked = self.requirements[outcome.cell]
        if not asked:
            return None, 0, np.inf
        left = self.left(outcome)
        piece, tightest = divmod(int(np.argmin(left)), len(asked))
        return asked[tightest], piece, float(left[piece, tightest])

    def left(self, outcome: Outcome) -> Array:
        """The room that the problem's delta, shared evenly, leaves of every requirement on every piece: (K, R)."""
        assert outcome.bounds is not None
        asked = self.requirements[outcome.cell]
        rooms = self.rooms(outcome.cell, outcome.bounds)
        kept = self.kept.get(outcome.nonlinear, (None, []))[1]
        events = kept[outcome.cell] if kept else self.events(outcome.cell, outcome.nonlinear.common(self.inner))
        target = Share.of(self.engine.problem.delta / max(len(asked), 1)).log
        left = np.empty_like(rooms)
        for index, requirement in enumerate(asked):
            event = events.along(requirement.rows)
            level = level_along(event, target) if event.profile.max() > 0 else np.zeros(len(rooms))
            asking = np.isfinite(rooms[:, index])  # elsewhere no level, however large, takes the room
            left[:, index] = np.where(asking, rooms[:, index] - np.where(asking, level, 0.0), rooms[:, index])
        return left


def correlated(events: StepEvents, asked: list[Requirement], rooms: Array, shared: float, logs: list[float]) -> float:
    """Logarithm of the probability of leaving, by the Gaussian correlation inequality.

    Requirements along w and -w with equal rooms keep Z in a symmetric convex set, and so do the levels along the inner
    rows: the probability of their intersection is at least the product of theirs (Royen, 2014). Requirements
    without a partner are added by the union bound.
    """
    lone = dict(enumerate(asked))
    if shared > -1e-6:
        return 0.0
    stay, rest = np.log1p(-np.exp(shared) * (1 + 1e-14)), []
    for i, requirement in enumerate(asked):
        partner = next((j for j in lone if j > i and np.array_equal(asked[j].rows, -requirement.rows)), None)
        if i not in lone:
            continue
        del lone[i]
        if partner is None:
            rest.append(logs[i])
            continue
        del lone[partner]
        room = np.minimum(rooms[:, i], rooms[:, partner])
        both = np.log(2.0) + events.along(requirement.rows).log_exceedance(room)
        if both > logsumexp(np.array([logs[i], logs[partner], np.log(1e-3)])):
            rest += [logs[i], logs[partner]]
        elif both > -1e-6:  # next to nothing is left, and its logarithm is lost in rounding
            return 0.0
        else:
            stay += np.log1p(-np.exp(both) * (1 + 1e-14))
    stay = stay * (1 + 1e-12) - 1e-300
    return logsumexp(np.array([np.log(-np.expm1(stay)) + 1e-14, *rest]))
