"""The proof by value functions: the probability of failing itself, bounded from every state, step by step backward."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from flint import arb

from certbound.checker.reading import Record, entries, numbers, wholes
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model, StepSet, cells_of, starts_of
from certbound.checker.values.batches import Array, above, below
from certbound.checker.values.crossing import Crossing
from certbound.checker.values.normal_means import axis_table, mean_table
from certbound.checker.values.passage import Passage
from certbound.checker.values.step_back import (
    DEGREE,
    Grid,
    Steps,
    Transition,
    Values,
    Zones,
    bounded,
    final,
    highest,
    independent,
    lowest,
    zones,
)
from certbound.checker.values.uniform_means import UniformTransition
from certbound.errors import CertificateError

Side = tuple[arb, arb]

MOST_STATES = 3
MOST_CELLS = 100_000
MOST_PARTS = 4096
MOST_STEPS = 2_000


def check_values(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability that a constraint is broken."""
    with np.errstate(all="ignore"):  # what is no number is unknown
        if model.continuous:
            return Passage(model, value, budget).upper()
        return _Discrete(model, value, budget, upper=True).bound()


def check_values_below(model: Model, value: object, budget: Budget) -> arb:
    """Lower bound of the probability that a constraint is broken, from one of the starts or from a random one."""
    if model.initial.around:
        raise Unproved("the initial set is stated by a box around it, of which lower bounds say nothing")
    with np.errstate(all="ignore"):
        if model.continuous:
            return Crossing(model, value, budget).lower()
        return _Discrete(model, value, budget, upper=False).bound()


class _Discrete:
    """Discrete time: backward induction on the grids that the file states, and nothing else of it."""

    def __init__(self, model: Model, value: object, budget: Budget, *, upper: bool) -> None:
        self.random = model.initial.covariance is not None
        names = ["engine", "parts", "grids", "steps", *([] if upper else ["side"])]
        record = Record(value, "proof", names + ([] if self.random else ["splits"] if upper else ["starts"]))
        self.model, self.budget, self.above = model, budget, upper
        if model.dimension > MOST_STATES:
            raise Unproved(f"value functions are proved for at most {MOST_STATES} states")
        if model.steps > MOST_STEPS:
            raise Unproved(f"value functions are proved for at most {MOST_STEPS} steps")
        self.starts: list[list[Side]] = []
        if not self.random:
            points = [] if upper else starts_of(model, record)
            self.starts = cells_of(model, record) if upper else [[(x, x) for x in point] for point in points]
        self.grids = [_grid(item, f"proof.grids[{k}]", model) for k, item in enumerate(record.items("grids", 1, 4000))]
        order = wholes(record["steps"], "proof.steps", 0, len(self.grids) - 1)
        self.first = 0 if self.random else 1
        count = model.steps + 1 - self.first
        if len(order) != count:
            raise CertificateError(f"`proof.steps` must have {count} entries, one for each step that it speaks of.")
        self.order = dict(enumerate(order, self.first))
        parts = record.whole("parts", 1, 1000)
        if parts ** len(model.disturbance) > MOST_PARTS:
            raise CertificateError(f"`proof.parts` must cut the disturbances into at most {MOST_PARTS} parts.")
        self.steps = Steps(model, parts, budget, upper=upper)
        self._zones: dict[tuple[int, int], Zones] = {}

    def bound(self) -> arb:
        """At least the probability of failing from any start, or (lower) at most that from one of the stated ones."""
        first = StepSet(self.model, 0, self.budget)
        if self.above and not all(first.holds(box, strictly=True) for box in self.starts):
            raise Unproved("the initial set was not shown to lie in the safe set")
        last = self.model.steps
        value = final(self._grid(last), self._zone(last), upper=self.above)
        kept: tuple[tuple[int, int], Transition] | None = None
        for t in range(last - 1, self.first - 1, -1):
            key = (self.order[t], self.order[t + 1])
            if kept is None or kept[0] != key or not self.steps.steady:
                low, high = self._grid(t).boxes()
                kept = key, self._transition(t, low, high, self._grid(t + 1))
            value = bounded(kept[1].apply(value), self._grid(t), self._zone(t), upper=self.above)
        found = self._over_law(value) if self.random else self._over_starts(value)
        return arb(min(max(found, 0.0), 1.0))

    def _over_starts(self, value: Values) -> float:
        low = np.array([[below(box[i][0]) for box in self.starts] for i in range(self.model.dimension)])
        high = np.array([[above(box[i][1]) for box in self.starts] for i in range(self.model.dimension)])
        found = self._transition(0, low, high, value.grid).apply(value)
        return highest(found) if self.above else lowest(found)

    def _transition(self, step: int, low: Array, high: Array, after: Grid) -> Transition:
        kind = Transition if self.model.noise.uniform is None else UniformTransition
        return kind(self.steps, step, low, high, after)

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
        table = mean_table(axes, value.pieces(), self.budget)
        mean = float(table.derivatives[(0,) * len(axes)].item())
        wrong = float(table.dominant.item() * table.missing(np.zeros(1)).item() + table.far) * (1 + 1e-9)
        return float(np.nextafter(mean + wrong, np.inf) if self.above else np.nextafter(mean - wrong, -np.inf))

    def _grid(self, step: int) -> Grid:
        return self.grids[self.order[step]]

    def _zone(self, step: int) -> Zones:
        """What is known of the cells at a step; the same at all steps where no constraint moves or has a window."""
        still = all(c.during is None and isinstance(c.region.center, list) for c in self.model.constraints)
        key = (self.order[step], 0 if still else step)
        if key not in self._zones:
            self._zones[key] = zones(self._grid(step), StepSet(self.model, step, self.budget), self.budget)
        return self._zones[key]


def _grid(value: object, path: str, model: Model) -> Grid:
    """Rising edges of every state, without gaps between cells."""
    rows = [numbers(item, path, None) for item in entries(value, path, model.dimension, model.dimension)]
    if any(len(row) < 2 or any(not a < b for a, b in pairwise(row)) for row in rows):
        raise CertificateError(f"`{path}` must hold two or more rising numbers for every state.")
    if np.prod([len(row) - 1 for row in rows]) > MOST_CELLS:
        raise CertificateError(f"`{path}` must make at most {MOST_CELLS} cells.")
    return Grid(tuple(np.array(row) for row in rows))
