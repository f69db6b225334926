"""The constants engine: c or L, sigma and a metric -> a tube by formula -> set erosion.

- Global constants: the reach tube of Thm K5 in the constants' metric leaves every constraint some room r_k on piece
  k; Thm K2 bounds P(exists t: ||S_t||_P > r_t), which bounds the probability of breaking a constraint. Constants that
  hold on the model's domain only serve as well: until the state leaves the domain they hold, and leaving it is among
  the events that are bounded.
- Local constants (Thm K4): the room is cut to what a tube needs, the constants are taken on reach + that room, and
  K2 is applied to the cut room.
- A method of the paper by name: its tube at delta must fit into the room; delta is then made as small as it goes.

All of them cover the disturbances that do not see coming noise, and no others: they rest on supermartingales.

Source: Thms K1, K2, K4, K5 of theory; Table I and Prop 4 (paper).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np

from certbound.arrays import Array
from certbound.constants.bounds import bound_constants
from certbound.constants.metrics import bound_metrics
from certbound.constants.stated import proved_or_stated, refuse_contradiction, refuse_jumps
from certbound.display import log10_text, rounded
from certbound.errors import CertboundError, EnclosureError, InfeasibleError
from certbound.problem.jumps_as_plan import in_pieces
from certbound.problem.problem import Problem
from certbound.problem.sets import check_start
from certbound.reach.contraction import (
    contraction_tube,
    local_constants,
    local_contraction_tube,
    needed_radius,
    radius_over_pieces,
    random_start,
)
from certbound.reach.nominal import Curve, Flow, initial_cells, nominal_curve
from certbound.reach.sets import ReachTube
from certbound.safety.answers import AS_IT_IS, Deviation, EngineAnswer, Request
from certbound.safety.engines.erosion import Erosion, Tightest, erode
from certbound.safety.engines.rooms import (
    BELOW,
    deviation_pieces,
    joined,
    log10_sum,
    room_level,
    smallest_level,
)
from certbound.tubes.constants import Constants
from certbound.tubes.question import Start
from certbound.tubes.tube import Tube
from certbound.tubes.tuning import tune_tube
from certbound.watch import poll

ONE_TIME = ("prop1", "prop1_cosh", "prop2", "markov", "chebyshev")
"""Methods that bound one time at a time: never SAFE."""
BY_CLEARANCE = ("auto", "kummer", "bessel")
"""Methods that go from rooms to a probability directly (Thm K2)."""
NO_START = Start()
SEGMENTS, SEGMENTS_BY_NAME = 48, 16
"""Pieces of local constants: the paper's window bounds take time that grows with their square."""
SHARES = (1.15, 1.6, 2.4, 4.0)
"""Room tried with local constants, in units of the tube at the target probability."""
_BURST = 1e3  # times the most room that the tube leaves at any time, by how much it is hopelessly wide elsewhere
_ROUGH = 30.0  # times the room from which on what a tube takes says nothing of the problem
_HAIR = 1e-3
"""Of the least room: what is left around the reach tube where no noise asks for any."""
NEAR_MISS = 2.0
"""Metrics of their own for the constraints are tried where the tube takes at most so many times the room."""
QUICK_BUDGET = 250
"""Boxes spent on global constants when another engine has proved SAFE already."""


def constants_engine(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
    """The best answer from constants: global ones, or local ones along the reach tube where none are global.

    It covers the disturbances that do not see coming noise. Where it is asked to be quick, proposed metrics and local
    constants are left out. ValueError where stated constants contradict the problem's own noise, EnclosureError where
    the Jacobian is unbounded or undefined on the domain that the user gave, EngineError where the nominal is lost
    before the horizon.
    """
    problem = in_pieces(problem)
    if problem.system.time == "discrete":
        check_start(problem.initial, problem.safe, apart=True)
    method, constants, quick = asked.method, asked.constants, asked.quick
    if constants is not None:
        refuse_contradiction(problem, constants)
        constants = proved_or_stated(problem, constants)
        refusal = "" if constants.certified else _across_jumps(problem)
        if refusal:
            return EngineAnswer(applicable=False, reason=refusal, method="kummer" if method == "auto" else method)
    work = _Work(problem, asked)
    by_clearance, target = method in BY_CLEARANCE, math.log10(problem.delta)
    best: EngineAnswer | None = None
    reason = ""
    try:
        for candidate in [constants] if constants is not None else _proposals(problem, quick=quick):
            answer = work.global_answer(candidate)
            best = answer if best is None else _better(best, answer)
            asked.found(best)
            if best.certified and best.log10_delta <= target:
                return best
        if best is not None and constants is None and not quick:
            best = work.with_own_metrics(best)
    except (InfeasibleError, EnclosureError) as error:
        if problem.domain is not None and best is None:
            raise EnclosureError(f"`domain` must lie where the model is defined and smooth: {error}") from error
        reason = str(error)
    if best is not None and (not by_clearance or quick or constants is not None or best.log10_delta <= target):
        return best
    if method in ONE_TIME:
        reason = f"{reason} A bound for one time must not be combined with local constants."
    if method in ONE_TIME or quick or constants is not None:
        return EngineAnswer(applicable=False, reason=reason, method=work.name)
    local = work.local_answer(reason)
    return local if best is None or (local.applicable and local.log10_delta < best.log10_delta) else best


def _across_jumps(problem: Problem) -> str:
    """Why constants that are stated say nothing of a model; empty where they do."""
    try:
        refuse_jumps(problem)
    except EnclosureError as error:
        return f"stated constants are slopes, which bound no jump and need a model that is defined: {error}"
    return ""


def _proposals(problem: Problem, *, quick: bool) -> Iterator[Constants]:
    """Certified global constants: Euclidean first, then in the metric that the erosion asks for."""
    if quick:
        yield bound_constants(problem, metric="euclidean", budget=QUICK_BUDGET)
        return
    poll("constants in the Euclidean norm")
    euclidean = bound_constants(problem, metric="euclidean")
    yield euclidean
    poll("constants in a metric of their own")
    if problem.system.dimension == 1:
        return
    proposed = bound_constants(problem, objective="erosion")
    if proposed.metric is not None:
        yield proposed


def _better(first: EngineAnswer, second: EngineAnswer) -> EngineAnswer:
    return min(first, second, key=lambda a: (a.log10_delta, math.inf if a.margin is None else -a.margin))


class _Work:
    """One problem, one request; the nominal curves are shared by all constants."""

    def __init__(self, problem: Problem, asked: Request) -> None:
        self.problem, self.method, self.cells = problem, asked.method, asked.cells
        self.found = asked.found
        self.flow = Flow(problem)
        self.name = "kummer" if self.method == "auto" else self.method
        self.segments = SEGMENTS if self.method in BY_CLEARANCE else SEGMENTS_BY_NAME

    @cached_property
    def curve(self) -> Curve:
        """The nominal curves, one a cell."""
        return nominal_curve(self.flow, initial_cells(self.problem, self.cells).centres)

    def global_answer(self, constants: Constants) -> EngineAnswer:
        """With constants that hold everywhere, or on the domain."""
        reach = contraction_tube(self.flow, constants, cells=self.cells, curve=self.curve)
        erosion = erode(reach, self.problem, reach.norm)
        start = random_start(self.problem, constants)
        if start != NO_START:
            constants = constants.with_full_dimension()
        answer = EngineAnswer(reach=reach, constants=constants, method=self.name, assumption=self._assumed(constants))
        refused = self._refused(reach, erosion, answer, start)
        if refused is not None:
            return refused
        return self._decided(answer, erosion, constants, start)

    def with_own_metrics(self, common: EngineAnswer) -> EngineAnswer:
        """The better one of ``common`` and the union bound over the constraints, each in a metric of its own.

        While no constraint is broken the state is in the domain, so that all constants hold up to the first event.
        """
        count = len(self.problem.constraints)
        if self.method != "auto" or count < 2 or not common.applicable or self.problem.initial.random:
            return common
        if common.tube is not None and common.reach is not None:
            erosion = erode(common.reach, self.problem, common.reach.norm)
            if _taken(erosion, needed_radius(common.tube, common.reach.curve, NO_START)) > NEAR_MISS:
                return common
        answers = []
        poll("a metric for each constraint")
        for index, constants in enumerate(bound_metrics(self.problem)):
            poll(f"constraint {index + 1} of {count} in its own metric")
            reach = contraction_tube(self.flow, constants, cells=self.cells, curve=self.curve)
            erosion = erode(reach, self.problem, reach.norm).only(index)
            answer = EngineAnswer(reach=reach, constants=constants, method=self.name)
            if self._refused(reach, erosion, answer) is not None:
                return common
            answers.append(self._decided(answer, erosion, constants, share=1 / count))
        level = log10_sum([answer.log10_delta for answer in answers])
        if level >= common.log10_delta:
            return common
        worst = min(answers, key=lambda answer: math.inf if answer.margin is None else answer.margin)
        parts = [answer.deviation for answer in answers if answer.deviation is not None]
        deviation = Deviation(
            times=parts[0].times,
            radius=np.min([part.radius for part in parts], axis=0),
            extent=np.min([part.extent for part in parts], axis=0),
        )
        fits = level <= math.log10(self.problem.delta)
        margin = None if worst.margin is None else max(worst.margin, 0.0) if fits else worst.margin
        reason = f"with a metric of its own for each constraint: {worst.reason}"
        return replace(worst, log10_delta=level, margin=margin, reason=reason, deviation=deviation, details=answers)

    def local_answer(self, why: str) -> EngineAnswer:
        """With constants along the reach tube plus the room that the tube needs (Thm K4)."""
        if self.problem.initial.random:
            return EngineAnswer(
                applicable=False, reason=f"{why} Local constants need a bounded initial set.", method=self.name
            )
        try:
            poll("local constants along the tube")
            reach = local_contraction_tube(self.flow, cells=self.cells, curve=self.curve)
        except EnclosureError as error:
            return EngineAnswer(applicable=False, reason=str(error), method=self.name)
        erosion = erode(reach, self.problem, reach.norm)
        answer = EngineAnswer(reach=reach, method=self.name)
        refused = self._refused(reach, erosion, answer)
        if refused is not None:
            return refused
        best: EngineAnswer | None = None
        for cut, constants in self._cuts(reach, erosion):
            found = self._decided(answer, cut, constants)
            best = found if best is None else _better(best, found)
            self.found(best)
        if best is None:
            tightest = erosion.tightest()
            return replace(
                answer, margin=tightest.margin, time=tightest.time, constraint=tightest.label,
                reason=f"no local constants hold on the reach tube and about it; {self._narrower} less noise.",
            )  # fmt: skip
        return best

    def _cuts(self, reach: ReachTube, erosion: Erosion) -> Iterator[tuple[Erosion, Constants]]:
        """Rooms cut to multiples of what a tube needs, with the constants that hold there."""
        try:
            first = local_constants(self.problem, reach, segments=self.segments)
            tube = tune_tube(first, horizon=reach.end, delta=self.problem.delta, method="kummer")
        except (CertboundError, ValueError):
            return
        needed = radius_over_pieces(tube, reach.curve)
        if not needed.any():  # no noise: some room is asked for all the same
            needed = needed + _HAIR * min(erosion.least.min(), 1.0)
        for share in SHARES:
            limit = share * needed
            if not reach.curve.continuous:
                limit[0] = math.inf
            cut = erosion.capped(limit)
            room = np.where(np.isfinite(cut.least), cut.least, 0.0)
            try:
                yield cut, local_constants(self.problem, reach, np.maximum(room, 0.0), segments=self.segments)
            except (CertboundError, ValueError):
                return

    def _assumed(self, constants: Constants) -> str:
        """Stated constants in words: their values, their norm, and where they hold; empty of proved ones."""
        if constants.certified:
            return ""
        name, value = ("rate", constants.rate) if constants.continuous else ("gain", constants.gain)
        norm = "the Euclidean norm" if constants.metric is None else "the norm of their metric"
        where = "everywhere" if self.problem.domain is None else "on the domain"
        numbers = f"{name} = {value}, sigma = {constants.sigma}, {where}, in {norm}"
        return f"the stated constants ({numbers}) are assumed, not proved"

    def _refused(
        self, reach: ReachTube, erosion: Erosion, answer: EngineAnswer, start: Start = NO_START
    ) -> EngineAnswer | None:
        """An answer where the reach tube ends early or leaves no room; None where it serves."""
        worst = erosion.tightest()
        held = replace(answer, **worst.place)
        if reach.end < self.flow.horizon:
            return replace(
                held, time=reach.end, reach=reach,
                reason=f"the reach tube could not be proved beyond t = {reach.end:.4g}; {self._cure}.",
            )  # fmt: skip
        if erosion.broken(random_start=start != NO_START):
            most = np.max(erosion.least, initial=0.0, where=np.isfinite(erosion.least))
            lost = bool(most > 0 and not -worst.margin < _BURST * most)
            words = "is proved so widely only that it leaves" if lost else "already leaves"
            short = "" if lost or worst.margin == 0 else f" (short by {-worst.margin:.3g})"
            return replace(
                answer if lost else held,
                reason=f"the noise-free reach tube {words} no room for '{worst.label}' at "
                f"{self._when(worst.time)}{short}; {'start elsewhere' if worst.time == 0 else self._cure}.",
            )
        return None

    @property
    def _cure(self) -> str:
        """What makes the reach tube narrower: of what the problem has, and a shorter horizon."""
        smaller = "a smaller disturbance, or " if self.problem.system.disturbance is not None else ""
        return f"{self._narrower} {smaller}a shorter horizon"

    @property
    def _narrower(self) -> str:
        """The beginning of a cure: cells where the initial set can be split."""
        start = self.problem.initial
        wide = not start.random and np.any(start.hull().lo < start.hull().hi)
        return "split the initial set (cells), or try" if wide else "try"

    def _when(self, time: float) -> str:
        return f"t = {time:.4g}" if self.flow.continuous else f"step {time:g}"

    def _decided(
        self, answer: EngineAnswer, erosion: Erosion, constants: Constants, start: Start = NO_START, share: float = 1.0
    ) -> EngineAnswer:
        """Probability of the rooms of ``erosion``, and the margin of the tube at ``share`` of the target."""
        target, horizon = self.problem.delta * share, self.flow.horizon
        profile = erosion.profile(random_start=start != NO_START)
        curve = answer.reach.curve if answer.reach is not None else self.curve
        by_name = self.method not in BY_CLEARANCE
        objective = joined(profile, 0.02) if np.any(np.isfinite(profile[1])) else "max"
        name = self.method if by_name else "kummer"

        def tube_at(delta: float) -> Tube:
            return tune_tube(constants, horizon=horizon, delta=delta, objective=objective, method=name, start=start)

        def fit(tube: Tube) -> bool:
            return bool(np.all(needed_radius(tube, curve, start) <= erosion.least))

        tube = tube_at(target)
        needed = needed_radius(tube, curve, start)
        fits = bool(np.all(needed <= erosion.least))
        if by_name:
            closely = constants.times is None
            level = smallest_level(tube_at, fit, target, tube if fits else None, closely=closely)
        else:
            rooms = joined(profile, 1e-7)
            level = room_level(constants, horizon=horizon, profile=rooms, start=start, fits=fits)
            if fits and level > math.log10(target) - BELOW:
                closer = tube_at(target * 10**-BELOW)
                level = min(level, (closer if fit(closer) else tube).log10_delta)
            fits = level <= math.log10(target)
        worst = erosion.tightest(needed)
        place = worst.place | {"margin": max(worst.margin, 0.0) if fits else worst.margin}
        rough = not fits and _taken(erosion, needed) > _ROUGH
        return replace(
            answer,
            **({} if rough else place),
            log10_delta=level,
            reason=self._explained(erosion, needed, worst, level, fits),
            tube=tube,
            constants=constants,
            deviation=Deviation.of_ball(*deviation_pieces(curve, needed), constants.norm),
            certified=tube.certified and tube.level == "trajectory",
            method=self.name,
        )

    def _explained(self, erosion: Erosion, needed: Array, worst: Tightest, level: float, fits: bool) -> str:
        """The reason, in words."""
        if not worst.label:
            return "no constraint asks anything."
        ratio = _taken(erosion, needed)
        if fits:
            return f"the tube takes {rounded(100 * ratio, up=True, digits=3)} % of the room that the constraints leave."
        larger = f"delta >= {log10_text(level)}, or " if level < -0.01 else ""
        cure = f"what would do: {larger}noise at most {rounded(1 / ratio, up=False, digits=2)} times as large."
        if ratio > _ROUGH:
            cure = "these constants are much too rough here, which says nothing of the problem itself."
        return (
            f"at delta = {self.problem.delta!r} the tube takes {ratio:.3g} times the room that '{worst.label}' leaves "
            f"at {self._when(worst.time)}; {cure}"
        )


def _taken(erosion: Erosion, needed: Array) -> float:
    """Largest share of the room that a tube takes."""
    room = erosion.least
    first = 0 if erosion.continuous else 1
    with np.errstate(all="ignore"):
        shares = np.where(room > 0, needed / room, np.inf)[first:]
    return float(np.max(shares, initial=0.0))
