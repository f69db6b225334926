"""What a picture shows, and in which colours."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.arrays import Array

if TYPE_CHECKING:
    from certbound.problem.problem import Problem
    from certbound.reach.sets import ReachTube
    from certbound.safety.verification import Verdict

INK, GREY, BLUE, VERMILION, YELLOW = "#000000", "#8c8c8c", "#0072B2", "#D55E00", "#F0E442"
INNER, OUTER, RIM = "#86B9DD", "#C3E0F2", "#7a3500"
GREEN, EDGE = "#009E73", "#8a7d00"


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """What a picture shows: the constraints of ``problem``, the noise-free tube ``reach``, whose curve is the nominal.

    Where no tube was proved there is no ``reach``, and no nominal but the start. ``tube`` has the stochastic deviation;
    ``times``, shape (K + 1,), and ``paths``, shape (paths, K + 1, n), are sample paths. ``rooms`` are what an engine
    measured of single constraints: number in ``problem.safe``, directions (K, n), room (K,).
    """

    problem: Problem
    reach: ReachTube | None
    tube: ReachTube | None = None
    times: Array | None = None
    paths: Array | None = None
    rooms: tuple[tuple[int, Array, Array], ...] = ()
    title: str = ""

    @classmethod
    def of(cls, verdict: Verdict, *, times: Array | None = None, paths: Array | None = None, title: str = "") -> Scene:
        """What a verdict proved, with sample paths where there are any.

        Raises
        ------
        ValueError
            If nothing was proved that could be drawn.
        """
        if verdict.problem is None or verdict.reach is None:
            raise ValueError(f"nothing was proved that could be drawn; {verdict.reason}")
        return cls(
            problem=verdict.problem, reach=verdict.reach, tube=noisy_reach(verdict), times=times, paths=paths,
            rooms=measured_rooms(verdict), title=title,
        )  # fmt: skip

    def between(self, first: float, last: float) -> Scene:
        """The part of the scene from one time to another, by whole pieces."""
        assert self.reach is not None
        curve = self.reach.curve
        kept = np.flatnonzero((np.asarray(curve.ends) >= first) & (np.asarray(curve.starts) <= last))
        if not len(kept):
            raise ValueError(f"`times` must meet [0, {self.reach.end:g}], got ({first:g}, {last:g}).")
        ends = int(kept[0]), int(kept[-1]) + 1
        tube = None if self.tube is None else self.tube.section(*ends)
        rooms = tuple((number, rows[slice(*ends)], room[slice(*ends)]) for number, rows, room in self.rooms)
        found = replace(self, reach=self.reach.section(*ends), tube=tube, rooms=rooms)
        if self.times is None or self.paths is None:
            return found
        now = (self.times >= first) & (self.times <= last)
        return replace(found, times=self.times[now], paths=self.paths[:, now])

    @property
    def tubes(self) -> list[tuple[ReachTube, str]]:
        """The tubes with their colours, the wider one first."""
        inner = [] if self.reach is None else [(self.reach, INNER)]
        return inner if self.tube is None else [(self.tube, OUTER), *inner]

    def nominal(self, count: int = 400) -> tuple[Array, Array]:
        """Times at which the nominal is drawn, shape (K,), and its states then, shape (K, n)."""
        if self.reach is None:
            start: Any = self.problem.starts[0]
            return np.zeros(1), np.asarray(start.mean if start.random else start.middle)[None]
        curve = self.reach.curve
        times = np.asarray(curve.starts)
        if curve.continuous:
            times = np.linspace(float(times[0]), self.reach.end, count)
        return times, np.array([self.reach.center(float(t)) for t in times])


def noisy_reach(verdict: Verdict) -> ReachTube | None:
    """The reach tube of a verdict with the stochastic deviation at the problem's delta, where there is one."""
    from certbound.reach.contraction import needed_radius
    from certbound.reach.sets import ReachTube
    from certbound.tubes.question import Start
    from certbound.tubes.tube import Tube

    if verdict.reach is None or verdict.deviation is None:
        return None
    for answer in verdict.answers.values():
        whole = getattr(answer.details, "reach", None)
        if answer.reach is verdict.reach and isinstance(whole, ReachTube):
            return whole
    if not isinstance(verdict.tube, Tube):
        return None
    start = getattr(verdict.tube.profile, "start", Start())
    radius = needed_radius(verdict.tube, verdict.reach.curve, start)
    if not np.all(np.isfinite(radius)):
        return None
    return verdict.reach.grown(radius, log10_delta=verdict.tube.log10_delta, method=verdict.method)


def measured_rooms(verdict: Verdict) -> tuple[tuple[int, Array, Array], ...]:
    """The room of every constraint along its own direction, where the engine of a verdict measured it."""
    for answer in verdict.answers.values():
        found = getattr(answer.details, "rooms", None)
        if answer.reach is verdict.reach and isinstance(found, list):
            return tuple((asked.constraint, asked.rows, room) for asked, room in found)
    return ()
