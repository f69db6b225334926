"""The proof by value functions: the probability of failing itself, bounded from every state, step by step backward."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from flint import arb

from certbound.checker.reading import Record, entries, numbers, wholes
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model, StepSet, cells_of, starts_of
from certbound.checker.values import batches as tm
from certbound.checker.values.batches import Array, above, terms
from certbound.checker.values.crossing import Crossing
from certbound.checker.values.normal_means import axis_table, mean_table
from certbound.checker.values.passage import Passage
from certbound.checker.values.piece_means import PieceTransition, pieces_of
from certbound.checker.values.reaching import bound_failing_above, bound_failing_below, check_stages
from certbound.checker.values.step_back import (
    DEGREE,
    Grid,
    Steps,
    Transition,
    Values,
    Zones,
    bounded,
    counts,
    highest,
    independent,
    levelled,
    lowest,
    target_of,
    zones,
)
from certbound.checker.values.uniform_means import UniformTransition
from certbound.errors import CertificateError

Side = tuple[arb, arb]

MOST_STATES = 3
MOST_CELLS = 100_000
MOST_PARTS = 4096
MOST_STEPS = 2_000
_MOST_ZONES = 8
_PER_OPERATION = 3_000
"""Units of work of an operation of a tape on a batch, at least."""
_LOST = 1e-3  # of the largest probability of being safe: cells with less count as failed


def check_values(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability that a constraint is broken."""
    with np.errstate(all="ignore"):  # what is no number is unknown
        if model.continuous and model.target is not None:
            return bound_failing_above(model, value, budget)
        if model.continuous and isinstance(value, Mapping) and "stages" in value:
            return check_stages(model, value, budget, upper=True)
        if model.continuous:
            return Passage(model, value, budget).upper()
        return _Discrete(model, value, budget, upper=True).bound()


def check_values_below(model: Model, value: object, budget: Budget) -> arb:
    """Lower bound of the probability that a constraint is broken, from one of the starts or from a random one."""
    if model.initial.around:
        raise Unproved("the initial set is stated by a box around it, of which lower bounds say nothing")
    with np.errstate(all="ignore"):
        if model.continuous and model.target is not None:
            return bound_failing_below(model, value, budget)
        if model.continuous and isinstance(value, Mapping) and "stages" in value:
            return check_stages(model, value, budget, upper=False)
        if model.continuous:
            return Crossing(model, value, budget).lower()
        return _Discrete(model, value, budget, upper=False).bound()


class _Discrete:
    """Discrete time: backward induction on the grids that the file states, and nothing else of it.

    With a target V is 0 on it while it counts (from below on all that is not shown to keep off it), and 1 where it is
    over and was not met. Where it must be stayed in, W_t is the probability of failing of who has met it: by the same
    step, 1 off the target; V_t = W_t on it, and W >= V everywhere.

    ``count`` steps instead of all of them: after these V is 1 from above, and from below 0 but where a constraint is
    broken. Without a target, and from above, all that follows is paid for by a rate (`_Discrete._later`).
    """

    def __init__(self, model: Model, value: object, budget: Budget, *, upper: bool) -> None:
        self.random = model.initial.covariance is not None
        names = ["engine", "parts", "grids", "steps", *([] if upper else ["side"])]
        own = [] if self.random else ["splits"] if upper else ["starts"]
        record = Record(value, "proof", names + own, ("count", "pieces"))
        self.model, self.budget, self.above = model, budget, upper
        if model.dimension > MOST_STATES:
            raise Unproved(f"value functions are proved for at most {MOST_STATES} states")
        self.last = self._last(record)
        self.starts: list[list[Side]] = []
        if not self.random:
            points = [] if upper else starts_of(model, record)
            self.starts = cells_of(model, record) if upper else [[(x, x) for x in point] for point in points]
        self.grids = [_grid(item, f"proof.grids[{k}]", model) for k, item in enumerate(record.items("grids", 1, 4000))]
        order = wholes(record["steps"], "proof.steps", 0, len(self.grids) - 1)
        self.first = 0 if self.random else 1
        count = self.last + 1 - self.first
        if len(order) != count:
            raise CertificateError(f"`proof.steps` must have {count} entries, one for each step that it speaks of.")
        self.order = dict(enumerate(order, self.first))
        self.window = (0, self.last) if model.target is None else self._window(model.target.during)
        self.beyond = 1.0 if upper and not model.ends else 0.0
        if upper and model.ends:
            self._check_domain()
        parts = record.whole("parts", 1, 1000)
        if parts ** len(model.disturbance) > MOST_PARTS:
            raise CertificateError(f"`proof.parts` must cut the disturbances into at most {MOST_PARTS} parts.")
        self.steps = Steps(model, parts, budget, upper=upper)
        self.pieces = None if record["pieces"] is None else pieces_of(model, record.whole("pieces", 2, 20_000))
        self._zones: dict[tuple[int, int], Zones] = {}
        self._kept: tuple[tuple[int, int, int], Transition] | None = None
        self._held = 0  # bytes that it takes

    def _last(self, record: Record) -> int:
        """The last step that is looked at."""
        horizon = self.model.horizon
        last = int(min(horizon, MOST_STEPS + 1)) if record["count"] is None else record.whole("count", 1, MOST_STEPS)
        if last > MOST_STEPS:
            raise Unproved(f"value functions are proved for at most {MOST_STEPS} steps")
        if last > horizon:
            raise CertificateError("`proof.count` must not exceed the horizon.")
        return last

    def _window(self, during: tuple[float, float] | None) -> tuple[int, int]:
        """First and last step at which the target may be met; the last one may come after all that are looked at."""
        first, last = during or (0.0, self.model.horizon)
        if last < 1:
            raise Unproved("value functions need a target that counts after the start")
        return math.ceil(first), int(min(last, MOST_STEPS + 1))

    def _check_domain(self) -> None:
        """Where paths end beyond the grid, it must hold the domain."""
        if self.model.domain is None:
            raise CertificateError("`problem.domain` must be there where a path ends as it leaves it.")
        for grid in self.grids:
            for edges, (low, high) in zip(grid.edges, self.model.domain):
                if low is None or high is None or not (edges[0] <= low and high <= edges[-1]):
                    raise Unproved("the grid was not shown to hold the domain, beyond which paths end")

    def bound(self) -> arb:
        """At least the probability of failing from any start, or (lower) at most that from one of the stated ones."""
        if self.above and not self.random:
            limits = self.model.constraints[:-1] if self.model.ends else self.model.constraints
            first = StepSet(replace(self.model, constraints=limits), 0, self.budget)
            if not all(first.holds(box, strictly=True) for box in self.starts):
                raise Unproved("the initial set was not shown to lie in the safe set")
        if not self.steps.steady:
            parts = len(self.steps.disturbances)
            self.budget.expect((self.last - self.first) * parts * len(self.model.dynamics.nodes) * _PER_OPERATION)
        stays, value, arrived = self.model.stays, None, None
        for t in range(self.last, self.first - 1, -1):
            if stays and t >= self.window[0]:
                arrived = self._arrived(t, arrived)
            if t <= self.window[1]:
                value = self._value(t, value, arrived)
        assert value is not None
        more = self.model.horizon - self.last
        if self.above and more > 0 and self.model.target is None and not self.model.ends:
            return self._later(value, more)
        found = self._over_law(value) if self.random else self._over_starts(value, arrived)
        return arb(min(max(found, 0.0), 1.0))

    # ---- one step ------------------------------------------------------------------------------------------------

    def _value(self, t: int, after: Values | None, arrived: Values | None) -> Values:
        """V at a step."""
        zone, whole = self._zone(t), self.last == self.model.horizon
        done, undone, over = zone.done, zone.undone, after is None and t == self.window[1]
        if not self.window[0] <= t <= self.window[1]:
            done = undone = None
        if after is not None:
            found = self._stepped(t, after)
        elif self.above:  # who is not there, or (without a target) anybody after fewer steps, has failed
            plain = self.model.target is None and (whole or not self.model.ends)
            found = self._constant(t, 0.0 if plain else 1.0)
        else:
            found = self._constant(t, 0.0)
            if undone is not None and over:
                levelled(found, undone, 1.0)
        there = None if arrived is None else arrived.coefficients
        if done is not None and undone is not None:
            if self.above:  # W is at least V
                met = done if there is None or after is None else ~undone
            else:
                met = ~undone if there is None or over else done
            found[:, met] = 0.0 if there is None else there[:, met]
        return self._settled(t, found)

    def _arrived(self, t: int, after: Values | None) -> Values:
        """W at a step."""
        zone = self._zone(t)
        assert zone.done is not None
        assert zone.undone is not None
        if after is not None:
            found = self._stepped(t, after)
        else:
            found = self._constant(t, 1.0 if self.above and self.last < self.model.horizon else 0.0)
        return self._settled(t, levelled(found, ~zone.done if self.above else zone.undone, 1.0))

    def _settled(self, t: int, found: Array) -> Values:
        """With what constraints say: 1 where one is broken, or (above) may be; 0 (below) where the path may be over."""
        zone = self._zone(t)
        levelled(found, ~zone.safe if self.above else zone.unsafe, 1.0)
        if not self.above:
            levelled(found, ~zone.within, 0.0)
        return Values(self._grid(t), found, self.beyond)

    def _constant(self, t: int, level: float) -> Array:
        which, cells = terms(self.model.dimension, DEGREE, self.budget), len(self._zone(t).safe)
        self.budget.floats(4 * which.numbers(cells), 40)
        found = np.zeros((len(which.exponents), cells))
        found[0] = level
        return found

    def _stepped(self, t: int, after: Values) -> Array:
        """One step back, on the cells of a step."""
        key = (self.order[t], self.order[t + 1], 0 if self.steps.steady else t)
        if self._kept is None or self._kept[0] != key:
            low, high = self._grid(t).boxes()
            self._kept = None
            self.budget.give(self._held)
            before = self.budget.memory
            self._kept = key, self._transition(t, low, high, self._grid(t + 1))
            self._held = before - self.budget.memory
        return bounded(self._kept[1].apply(after), upper=self.above)

    def _over_starts(self, value: Values, arrived: Values | None) -> float:
        low = np.array([[-_end(-box[i][0]) for box in self.starts] for i in range(self.model.dimension)])
        high = np.array([[_end(box[i][1]) for box in self.starts] for i in range(self.model.dimension)])
        step = self._transition(0, low, high, value.grid)
        found = step.apply(value)
        if self.model.target is not None and counts(self.model, 0):
            target = StepSet(replace(self.model, constraints=(target_of(self.model),)), 0, self.budget)
            off = np.array([target.excludes(box) for box in self.starts])
            over = tm.fixed(found.terms, np.zeros(len(off)))
            if not self.above:
                found = tm.chosen(off, found, over) if arrived is None else found
            elif arrived is None:
                found = tm.chosen(np.array([target.holds(box) for box in self.starts]), over, found)
            else:
                found = tm.chosen(off, found, step.apply(arrived))
        if not self.above:
            limits = self.model.constraints[:-1] if self.model.ends else self.model.constraints
            first = StepSet(replace(self.model, constraints=limits), 0, self.budget)
            failed = np.array([first.excludes(box) for box in self.starts])
            found = tm.chosen(failed, tm.fixed(found.terms, np.ones(len(failed))), found)
        if self.model.ends and not self.above:
            domain = StepSet(replace(self.model, constraints=self.model.constraints[-1:]), 0, self.budget)
            within = np.array([domain.holds(box) for box in self.starts])
            found = tm.chosen(within, found, tm.fixed(found.terms, np.zeros(len(within))))
        return highest(found) if self.above else lowest(found)

    def _transition(self, step: int, low: Array, high: Array, after: Grid) -> Transition:
        if self.pieces is not None:
            return PieceTransition(self.steps, step, low, high, after, self.pieces)
        kind = Transition if self.model.noise.uniform is None else UniformTransition
        return kind(self.steps, step, low, high, after)

    def _later(self, value: Values, more: float) -> arb:
        """The bound at the horizon, ``more`` steps further on than were looked at, where all steps are alike.

        psi = 1 - U, at least 0 and at most the probability of still being safe after these steps, is taken by one step
        back to at least (1 - r) psi; that map is monotone and homogeneous, so psi (1 - r)^m bounds the probability of
        being safe m steps later.
        """
        still = all(c.during is None and isinstance(c.region.center, list) for c in self.model.constraints)
        if not self.steps.steady or not still or len(set(self.order.values())) > 1 or self.last <= self.first:
            raise Unproved("all steps must be alike where not all of them are looked at")
        high = _tops(value.coefficients)
        lost = high >= 1 - _LOST * float(np.max(1 - np.minimum(high, 1.0)))
        value = Values(value.grid, levelled(value.coefficients.copy(), lost, 1.0), value.beyond)
        rise = _tops(self._stepped(self.last - 1, value) - value.coefficients)[~lost] + 1e-13
        rate = max(float((rise / (1 - high[~lost])).max(initial=0.0)), 0.0) * (1 + 1e-12)
        found = self._over_law(value) if self.random else self._over_starts(value, None)
        if math.isinf(more) or rate >= 1 or found >= 1:
            return arb(1)
        return 1 - (1 - arb(max(found, 0.0))) * (1 - arb(rate)) ** int(more)

    def _over_law(self, value: Values) -> float:
        """The mean over a normal start."""
        covariance = self.model.initial.covariance
        assert covariance is not None
        spreads = independent(covariance, "the start")
        points = [np.array([place]) for place in self.model.initial.centre]
        axes = [
            axis_table(one, edges, spread, DEGREE, self.budget)
            for one, edges, spread in zip(points, value.grid.edges, spreads)
        ]
        self.budget.fits(8 * 2 * value.size)
        table = mean_table(axes, value.pieces(), self.budget)
        mean = float(table.derivatives[(0,) * len(axes)].item())
        wrong = float(table.dominant.item() * table.missing(np.zeros(1)).item() + table.far) * (1 + 1e-9)
        return float(np.nextafter(mean + wrong, np.inf) if self.above else np.nextafter(mean - wrong, -np.inf))

    def _grid(self, step: int) -> Grid:
        return self.grids[self.order[step]]

    def _zone(self, step: int) -> Zones:
        """What is known of the cells at a step; the same at all steps where nothing moves or has a window.

        Noise in pieces may lead to a face of a cell more than rarely.
        """
        asked = (*self.model.constraints, *([] if self.model.target is None else [self.model.target]))
        still = all(c.during is None and isinstance(c.region.center, list) for c in asked)
        key = (self.order[step], 0 if still else step)
        if key not in self._zones:
            if len(self._zones) >= _MOST_ZONES:
                self._zones.clear()
            self._zones[key] = zones(
                self._grid(step), self.model, step, self.budget, strictly=self.pieces is not None
            )
        return self._zones[key]


def _end(ball: arb) -> float:
    """A float that is at least every number in a ball; the very number where it is a float."""
    return float(ball) if arb(float(ball)) >= ball else above(ball)


def _tops(coefficients: Array) -> Array:
    """At least the largest value on every cell."""
    size = np.abs(coefficients[1:]).sum(axis=0)
    return np.asarray(coefficients[0] + size + (np.abs(coefficients[0]) + size) * 1e-14)


def _grid(value: object, path: str, model: Model) -> Grid:
    """Rising edges of every state, without gaps between cells."""
    rows = [numbers(item, path, None) for item in entries(value, path, model.dimension, model.dimension)]
    if any(len(row) < 2 or any(not a < b for a, b in pairwise(row)) for row in rows):
        raise CertificateError(f"`{path}` must hold two or more rising numbers for every state.")
    if math.prod(len(row) - 1 for row in rows) > MOST_CELLS:
        raise CertificateError(f"`{path}` must make at most {MOST_CELLS} cells.")
    return Grid(tuple(np.array(row) for row in rows))
