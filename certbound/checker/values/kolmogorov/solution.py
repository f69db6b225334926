"""The proof by the backward equation (Thm K10): a function v, its error included, that the process cannot increase.

The file states v in a box (`patches`), or one such function for each of some stages of time that follow each other.
With L v = f . v_x + tr(a v_xx) / 2, a = g g^T, and ``end`` = 1 from above, 0 from below, proved is of each stage

- v_t + L v <= eta_k in slab k wherever v < end (`patch_residual`);
- v >= goal - gamma on every face of the box by which a path may leave: from above goal = 1, from below -1 where all of
  the face breaks a constraint that holds in all of the stage, else 0. By a face that noise does not cross a path
  leaves only where the drift points outward or along it (`cell_operator`);
- v >= -gamma where a path may meet the target, on whose cells nothing else is asked (`stage_limits`);
- at its end, on every cell, v >= goal - gamma: from above goal = 1, but min(1, v of the next stage) on cells that the
  next grid has too and on which no constraint is broken then, 0 on those where a path is over by then; from below -1
  where all of the cell breaks a constraint, min(0, v of the next stage) on those that the next grid has, else 0. At the
  last end a path is over that breaks no constraint (from below: that may break none) and, if there is a target, is in
  it (may be in it);
- from above: the box lies in the constraints of the stage, and the starts in the first box and in the constraints of
  the first moment; from below: a stated start lies in the initial set and in the first box, and not where it may have
  met the target.

Then, P being the probability of failing (theory.md, section 15), v that of the first stage, and sums over all stages,

    P <= v(0, x) + sum gamma + sum eta_k h_k     (above),     P >= -v(0, x) - sum gamma - sum eta_k h_k     (below).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from flint import arb

from certbound.checker.reading import Record, numbers
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model, starts_of
from certbound.checker.values.kolmogorov.cell_operator import Acting, Operator, about
from certbound.checker.values.kolmogorov.patches import read_splines
from certbound.checker.values.kolmogorov.stage import Stage
from certbound.checker.values.kolmogorov.stage_limits import end_of
from certbound.checker.values.kolmogorov.start_mean import StartMean
from certbound.errors import CertificateError

MOST_STAGES = 50
MOST_ACTINGS = 64
_OWN = ("axes", "times", "units", "values", "rates", "eta")
_STATES = (2, 3)


def check_backward(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability of failing."""
    with np.errstate(all="ignore"):  # what is no number is unknown
        return Solution(model, value, budget, upper=True).bound()


def check_backward_below(model: Model, value: object, budget: Budget) -> arb:
    """Lower bound of the probability of failing, from one of the stated starts."""
    if model.initial.around:
        raise Unproved("the initial set is stated by a box around it, of which lower bounds say nothing")
    with np.errstate(all="ignore"):
        return Solution(model, value, budget, upper=False).bound()


class Solution:
    """The proof's numbers, and what follows from them."""

    def __init__(self, model: Model, value: object, budget: Budget, *, upper: bool) -> None:
        staged = isinstance(value, dict) and "stages" in value
        random = model.initial.covariance is not None
        more = [] if upper else ["side"] if random else ["side", "starts"]
        more += ["gains", "rows", "parts"] if random else []
        more += ["disturbances"] if model.disturbance and not upper else []
        self.record = record = Record(value, "proof", ["engine", *(["stages"] if staged else _OWN), *more])
        self.model, self.budget, self.above, self.n = model, budget, upper, model.dimension
        self._refuse()
        self.operator = Operator(model, budget)
        actings = (None,) if upper else self._actings()
        rows = [(record, "proof")]
        if staged:
            paths = [f"proof.stages[{k}]" for k in range(len(record.items("stages", 1, MOST_STAGES)))]
            rows = [(Record(item, path, _OWN), path) for item, path in zip(record["stages"], paths)]
        given = [(read_splines(one, self.n, budget), one) for one, _ in rows]
        times = [splines.times for splines, _ in given]
        together = all(first[-1] == second[0] for first, second in pairwise(times))
        if times[0][0] != 0 or times[-1][-1] != end_of(model) or not together:
            raise CertificateError(
                "`proof.times` must begin at 0 and end at the horizon (the end of the target's window), stage by stage."
            )
        self.start = StartMean(model, record, budget) if random else None
        self.stages = [
            Stage(model, self.operator, splines, np.array(one.array("eta", splines.slabs)), actings, upper=upper)
            for splines, one in given
        ]

    def _refuse(self) -> None:
        """What this proof does not treat."""
        model = self.model
        if not model.continuous or self.n not in _STATES:
            raise Unproved("this proof treats two and three states in continuous time")
        if model.ends or model.stays or model.hold is not None or model.plan is not None:
            raise Unproved("this proof treats no plan with steps in time, and no path that ends unharmed")
        if not end_of(model) > 0:
            raise Unproved("this proof treats no target that counts at the first moment alone")

    def _actings(self) -> Sequence[Acting | None]:
        """The disturbances one of which serves each patch from below."""
        if not self.model.disturbance:
            return (None,)
        found = []
        for k, row in enumerate(self.record.items("disturbances", 1, MOST_ACTINGS)):
            acting = numbers(row, f"proof.disturbances[{k}]", len(self.model.disturbance))
            if not all(low <= x <= high for x, (low, high) in zip(acting, self.model.disturbance)):
                raise Unproved("a stated disturbance was not shown to lie in its set")
            found.append(tuple(acting))
        return found

    def bound(self) -> arb:
        """At least the probability of failing from any start, or (lower) at most that from one of the stated ones."""
        self.budget.expect(sum(stage.residual.work for stage in self.stages))
        for stage in self.stages:
            stage.check_box()
        total = arb(self._at_starts())
        for stage, after in zip(self.stages, [*self.stages[1:], None]):
            gamma = stage.lacking(after)
            if not math.isfinite(gamma):
                raise Unproved("v was not shown to be what the faces of the grid ask for")
            total += arb(gamma)
        for stage in self.stages:
            times = [arb(float(t)) for t in stage.splines.times]
            for eta, (first, last) in zip(stage.residual.payments(), pairwise(times)):
                total += arb(float(eta)) * (last - first)
        found = total if self.above else -total
        return arb.max(arb.min(found, arb(1)), arb(0)).upper() if self.above else arb.max(found, arb(0)).lower()

    def _at_starts(self) -> float:
        """At least v(0, .) on the initial set, or (lower) at the best of the stated starts."""
        first, initial = self.stages[0], self.model.initial
        if self.start is not None:
            if not first.limits.begins_alike if self.above else first.over.any():
                raise Unproved("a random start is treated without a target or a limit of the first moment alone")
            return self.start.bound(first)
        if self.above:
            box = list(zip(initial.low, initial.high))
            if not first.limits.at_begin().holds(*about(box), strictly=True):
                raise Unproved("the initial set was not shown to lie in the safe set")
            return first.most_over(box)
        points = [[(x, x) for x in point] for point in starts_of(self.model, self.record)]
        if any(first.is_over(point) for point in points):
            raise Unproved("a start was not shown to keep off the target")
        return min(first.most_over(point) for point in points)
