"""Limits that move in discrete time, step by step: at each step a set is one that rests, and is asked for then alone.

Nothing else changes: states, noise and starts are what they were. A number that no float is goes to the side on which
failing is no less probable, for upper bounds, or no more probable, for lower ones.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import EnclosureError
from certbound.problem.model import Tape
from certbound.problem.problem import Problem
from certbound.problem.reductions.formulas_of_time import Formula, at_time
from certbound.problem.sets import Ball, Box, Ellipsoid, HalfSpace, Inside, Polytope, entries_of, shifted

_MOST = 400  # sets, one a step: beyond that problems are too long for what reads them


def limits_by_step(problem: Problem) -> tuple[Problem | None, Problem | None] | None:
    """The problems above and below (one and the same where nothing was rounded); None where this does not serve.

    It serves sets to stay in and to avoid, of the usual shapes, and targets that rest, in a few hundred steps.
    """
    moving = [one for one in problem.safe if one.region.moving]
    known = all(isinstance(one.region, (Ball, Box, Ellipsoid, HalfSpace, Polytope)) for one in moving)
    if problem.system.time != "discrete" or problem.endless or not known:
        return None
    if problem.reach is not None and problem.reach.region.moving:
        return None
    spans = [one.during or (0.0, float(problem.horizon)) for one in moving]
    if not moving or sum(last - first + 1 for first, last in spans) > _MOST:
        return None
    work = _Steps(problem)
    above = work.stated(narrow=True)
    if above is not None and not work.rounded:
        return above, above
    return above, work.stated(narrow=False)


class _Steps:
    def __init__(self, problem: Problem) -> None:
        self.problem, self.rounded = problem, False

    def stated(self, *, narrow: bool) -> Problem | None:
        """The problem with each set that moves as one set a step; None where no set is left at some step."""
        safe: list[Inside] = []
        try:
            for constraint in self.problem.safe:
                safe += self._steps(constraint, narrow) if constraint.region.moving else [constraint]
            return self.problem.replace(safe=safe)
        except EnclosureError:
            raise
        except ValueError:
            return None

    def _steps(self, constraint: Inside, narrow: bool) -> list[Inside]:
        first, last = constraint.during or (0.0, float(self.problem.horizon))
        larger = constraint.outside == narrow
        return [
            replace(constraint, region=self._at(constraint.region, k, larger), during=(k, k),
                    label=f"{constraint.label} at step {k:g}")
            for k in np.arange(first, last + 1.0).tolist()
        ]  # fmt: skip

    def _at(self, region: Any, k: float, larger: bool) -> Any:
        if isinstance(region, Box):
            low = self._numbers(entries_of(shifted(region.low, region.center)), k, up=not larger)
            high = self._numbers(entries_of(shifted(region.high, region.center)), k, up=larger)
            return Box(low, high, coordinates=region.coordinates)
        if isinstance(region, HalfSpace):
            return HalfSpace(region.normal, self._numbers([region.bound], k, up=larger)[0])
        if isinstance(region, Polytope):
            return Polytope(region.A, self._numbers(entries_of(region.b), k, up=larger))
        centers = [at_time(center, k) for center in entries_of(region.center)]
        middles = [float((center.lo + center.hi) / 2) for center in centers]
        slack = sum(float(np.nextafter(one.hi - one.lo, np.inf)) for one in centers if one.lo < one.hi)
        if isinstance(region, Ellipsoid):
            if slack:
                raise EnclosureError("the centre of an ellipsoid is no floating-point number at some step; use a ball.")
            return replace(region, center=np.array(middles))
        radius = self._numbers([region.radius], k, up=larger)[0]
        if slack:
            self.rounded = True
            radius = float(np.nextafter(radius + (slack if larger else -slack), np.inf if larger else -np.inf))
        return Ball(np.array(middles), radius, coordinates=region.coordinates)

    def _numbers(self, entries: list[Formula], k: float, *, up: bool) -> Array:
        found = []
        for entry in entries:
            value = at_time(entry, k) if isinstance(entry, Tape) else None
            if value is None:
                found.append(float(entry))  # type: ignore[arg-type]  # not a tape
                continue
            if not np.isfinite([value.lo, value.hi]).all():
                raise EnclosureError(f"{entry.describe(entry.outputs[0])} is not defined at step {k:g}.")  # type: ignore[union-attr]  # a tape
            self.rounded |= bool(value.lo < value.hi)
            found.append(float(value.hi if up else value.lo))
        return np.array(found)
