"""The proof by value functions: the probability of failing itself, bounded from every state, step by step backward."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from flint import arb

from certbound.checker.reading import Record, entries, numbers, wholes
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model, StepSet, cells_of
from certbound.checker.values.batches import above, below
from certbound.checker.values.passage import Passage
from certbound.checker.values.step_back import (
    Grid,
    Steps,
    Transition,
    Values,
    Zones,
    bounded,
    final,
    highest,
    zones,
)
from certbound.errors import CertificateError

MOST_STATES = 2
MOST_CELLS = 100_000
MOST_PARTS = 4096
MOST_STEPS = 2_000


def check_values(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability that a constraint is broken."""
    with np.errstate(all="ignore"):  # what is no number is unknown
        if model.continuous:
            return Passage(model, value, budget).upper()
        return _Discrete(model, value, budget).upper()


class _Discrete:
    """Discrete time: backward induction on the grids that the file states, and nothing else of it."""

    def __init__(self, model: Model, value: object, budget: Budget) -> None:
        record = Record(value, "proof", ("engine", "splits", "parts", "grids", "steps"))
        self.model, self.budget = model, budget
        if model.dimension > MOST_STATES:
            raise Unproved(f"value functions are proved for at most {MOST_STATES} states")
        if model.steps > MOST_STEPS:
            raise Unproved(f"value functions are proved for at most {MOST_STEPS} steps")
        if model.initial.covariance is not None:
            raise Unproved("value functions are proved for bounded starts only")
        self.starts = cells_of(model, record)
        self.grids = [_grid(item, f"proof.grids[{k}]", model) for k, item in enumerate(record.items("grids", 1, 4000))]
        self.order = wholes(record["steps"], "proof.steps", 0, len(self.grids) - 1)
        if len(self.order) != model.steps:
            raise CertificateError(f"`proof.steps` must have {model.steps} entries, one for each later step.")
        parts = record.whole("parts", 1, 1000)
        if parts ** len(model.disturbance) > MOST_PARTS:
            raise CertificateError(f"`proof.parts` must cut the disturbances into at most {MOST_PARTS} parts.")
        self.steps = Steps(model, parts, budget, upper=True)
        self._zones: dict[tuple[int, int], Zones] = {}

    def upper(self) -> arb:
        """At least the probability of failing from any start."""
        first = StepSet(self.model, 0, self.budget)
        if not all(first.holds(box, strictly=True) for box in self.starts):
            raise Unproved("the initial set was not shown to lie in the safe set")
        last = self.model.steps
        value = final(self._grid(last), self._zone(last), upper=True)
        kept: tuple[tuple[int, int], Transition] | None = None
        for t in range(last - 1, 0, -1):
            key = (self.order[t - 1], self.order[t])
            if kept is None or kept[0] != key or not self.steps.steady:
                low, high = self._grid(t).boxes()
                kept = key, Transition(self.steps, t, low, high, self._grid(t + 1))
            value = bounded(kept[1].apply(value), self._grid(t), self._zone(t), upper=True)
        return self._over_starts(value)

    def _over_starts(self, value: Values) -> arb:
        low = np.array([[below(box[i][0]) for box in self.starts] for i in range(self.model.dimension)])
        high = np.array([[above(box[i][1]) for box in self.starts] for i in range(self.model.dimension)])
        found = Transition(self.steps, 0, low, high, value.grid).apply(value)
        return arb(min(highest(found), 1.0))

    def _grid(self, step: int) -> Grid:
        return self.grids[self.order[step - 1]]

    def _zone(self, step: int) -> Zones:
        """What is known of the cells at a step; the same at all steps where no constraint moves or has a window."""
        still = all(c.during is None and isinstance(c.region.center, list) for c in self.model.constraints)
        key = (self.order[step - 1], 0 if still else step)
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
