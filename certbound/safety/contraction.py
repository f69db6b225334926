"""The constants engine: c or L, sigma and a metric -> a tube by formula -> set erosion.

- Global constants: the reach tube of Thm K5 in the constants' metric leaves every constraint some room r_k on piece
  k; Thm K2 bounds P(exists t: ||S_t||_P > r_t), which bounds the probability of breaking a constraint. Constants that
  hold on the model's domain only serve as well: until the state leaves the domain they hold, and leaving it is among
  the events that are bounded.
- Local constants (Thm K4): the room is cut to what a tube needs, the constants are taken on reach + that room, and
  K2 is applied to the cut room.
- A method of the paper by name: its tube at delta must fit into the room; delta is then made as small as it goes.

Source: Thms K1, K2, K4, K5 of theory; Table I and Prop 4 (paper).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from certbound.constants.bounds import bound_constants
from certbound.errors import CertboundError, EnclosureError, InfeasibleError
from certbound.problem.problem import Problem
from certbound.problem.sets import GaussianStart
from certbound.reach.cells import initial_cells
from certbound.reach.contraction import contraction_tube
from certbound.reach.curve import Curve
from certbound.reach.flow import Flow
from certbound.reach.local import local_constants, local_contraction_tube, radius_over_pieces
from certbound.reach.nominal import nominal_curve
from certbound.reach.norms import Norm
from certbound.reach.tube import ReachTube
from certbound.rigor.definite import is_positive_definite
from certbound.rigor.intervals import Interval
from certbound.safety.answers import Deviation, EngineAnswer
from certbound.safety.erosion import Erosion, erode
from certbound.tubes.constants import Constants
from certbound.tubes.kummer import Start
from certbound.tubes.tube import Tube
from certbound.tubes.tuning import bound_exit_probability, tune_tube

__all__ = ["ONE_TIME", "constants_engine"]

Array = NDArray[np.float64]

ONE_TIME = ("prop1", "prop1_cosh", "prop2", "markov", "chebyshev")
"""Methods that bound one time at a time: never SAFE."""
SHARES = (1.15, 1.6, 2.4, 4.0)
"""Room tried with local constants, in units of the tube at the target probability."""
BISECTIONS = 14
SMALLEST_LOG10 = -290.0


def constants_engine(
    problem: Problem, *, method: str = "auto", cells: int | None = None, constants: Constants | None = None
) -> EngineAnswer:
    """The best answer from constants: global ones, or local ones along the reach tube where none are global.

    Parameters
    ----------
    problem : Problem
    method : str
        "auto" (Thm K2), or a tube method by name.
    cells : int, optional
        Parts along each side of the initial set.
    constants : Constants, optional
        Stated constants, used instead of certified ones.

    Raises
    ------
    ValueError
        If the Jacobian is unbounded on the domain that the user gave, or the nominal is lost before the horizon.
    """
    work = _Work(problem, method, cells)
    best: EngineAnswer | None = None
    reason = ""
    try:
        for candidate in [constants] if constants is not None else _proposals(problem):
            answer = work.global_answer(candidate)
            best = answer if best is None else _better(best, answer)
            if best.certified and best.log10_delta <= math.log10(problem.delta):
                return best
    except (InfeasibleError, EnclosureError) as error:
        reason = str(error)
    if best is not None:
        return best
    if method in ONE_TIME:
        return EngineAnswer(
            applicable=False,
            reason=f"{reason} A bound for one time must not be combined with local constants.",
            method=method,
        )
    return work.local_answer(reason)


def _proposals(problem: Problem) -> Iterator[Constants]:
    """Certified global constants: Euclidean first, then in the metric that the erosion asks for."""
    euclidean = bound_constants(problem, metric="euclidean")
    yield euclidean
    if problem.system.dimension == 1:
        return
    proposed = bound_constants(problem, objective="erosion")
    if proposed.metric is not None:
        yield proposed


def _better(first: EngineAnswer, second: EngineAnswer) -> EngineAnswer:
    if second.log10_delta != first.log10_delta:
        return second if second.log10_delta < first.log10_delta else first
    margins = (-math.inf if a.margin is None else a.margin for a in (first, second))
    return first if next(margins) >= next(margins) else second


class _Work:
    """One problem, one method; the nominal curves are shared by all constants."""

    def __init__(self, problem: Problem, method: str, cells: int | None) -> None:
        self.problem, self.method, self.cells = problem, method, cells
        self.flow = Flow(problem)
        self.curve: Curve = nominal_curve(self.flow, initial_cells(problem, cells).centres)
        self.name = "kummer" if method == "auto" else method

    def global_answer(self, constants: Constants) -> EngineAnswer:
        """With constants that hold everywhere, or on the domain."""
        reach = contraction_tube(self.flow, constants, cells=self.cells, curve=self.curve)
        erosion = erode(reach, self.problem, reach.norm)
        start = _random_start(self.problem, constants)
        answer = EngineAnswer(reach=reach, constants=constants, method=self.name, assumption=_assumption(constants))
        refused = self._refused(reach, erosion, answer)
        if refused is not None:
            return refused
        return self._decided(answer, erosion, constants, start)

    def local_answer(self, why: str) -> EngineAnswer:
        """With constants along the reach tube plus the room that the tube needs (Thm K4)."""
        if isinstance(self.problem.initial, GaussianStart):
            return EngineAnswer(
                applicable=False, reason=f"{why} Local constants need a bounded initial set.", method=self.name
            )
        try:
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
            found = self._decided(replace(answer, constants=constants), cut, constants, Start())
            best = found if best is None else _better(best, found)
        if best is None:
            tightest = erosion.tightest()
            return replace(
                answer, margin=tightest.margin, time=tightest.time, constraint=tightest.label,
                reason="no local constants hold on the reach tube and its surroundings; use more cells or method "
                '"linear".',
            )  # fmt: skip
        return best

    def _cuts(self, reach: ReachTube, erosion: Erosion) -> Iterator[tuple[Erosion, Constants]]:
        """Rooms cut to multiples of what a tube needs, with the constants that hold there."""
        try:
            first = local_constants(self.problem, reach)
            tube = tune_tube(first, horizon=reach.end, delta=self.problem.delta, method="kummer")
        except (CertboundError, ValueError):
            return
        needed = radius_over_pieces(tube, reach.curve)
        for share in SHARES:
            limit = share * needed
            if not reach.curve.continuous:
                limit[0] = math.inf
            cut = erosion.capped(limit)
            room = np.where(np.isfinite(cut.least), cut.least, 0.0)
            try:
                yield cut, local_constants(self.problem, reach, np.maximum(room, 0.0))
            except (CertboundError, ValueError):
                return

    def _refused(self, reach: ReachTube, erosion: Erosion, answer: EngineAnswer) -> EngineAnswer | None:
        """An answer where the reach tube ends early or leaves no room; None where it serves."""
        worst = erosion.tightest()
        held = replace(answer, margin=worst.margin, time=worst.time, constraint=worst.label or None)
        if reach.end < self.flow.horizon:
            return replace(
                held, time=reach.end, reach=reach,
                reason=f"the reach tube could not be proved beyond t = {reach.end:.4g}; use more cells of the initial "
                "set, a smaller disturbance, or a shorter horizon.",
            )  # fmt: skip
        if erosion.broken():
            return replace(
                held,
                reason=f"the noise-free reach tube already leaves no room for '{worst.label}' at "
                f"{self._when(worst.time)} (short by {-worst.margin:.3g}); use more cells of the initial set, or "
                'method "linear".',
            )
        return None

    def _when(self, time: float) -> str:
        return f"t = {time:.4g}" if self.flow.continuous else f"step {time:g}"

    def _decided(self, answer: EngineAnswer, erosion: Erosion, constants: Constants, start: Start) -> EngineAnswer:
        """Probability and margin for given rooms."""
        target, horizon = self.problem.delta, self.flow.horizon
        profile = erosion.profile(random_start=start != Start())
        curve = answer.reach.curve if answer.reach is not None else self.curve
        by_name = self.method not in ("auto", "kummer", "bessel")
        asked = bool(np.any(np.isfinite(profile[1])))
        objective = _merged(profile, 0.02) if asked else "max"
        name = self.method if by_name else "kummer"
        tube = tune_tube(constants, horizon=horizon, delta=target, objective=objective, method=name, start=start)
        needed = _needed(tube, curve, start)
        if by_name:
            fits = bool(np.all(needed <= erosion.least))
            level = self._smallest_level(constants, erosion, curve, objective, fits)
        else:
            level = bound_exit_probability(constants, horizon=horizon, clearance=_merged(profile, 1e-7), start=start)
            fits = level <= math.log10(target)
        worst = erosion.tightest(needed)
        margin = max(worst.margin, 0.0) if fits else worst.margin
        deviation = Deviation.of_ball(*_deviation_pieces(curve, needed), Norm(self.flow.dimension, constants.metric))
        return replace(
            answer,
            log10_delta=level,
            margin=margin,
            time=worst.time,
            constraint=worst.label or None,
            reason=self._explained(tube, erosion, needed, worst.label, worst.time, level, fits),
            tube=tube,
            constants=constants,
            deviation=deviation,
            certified=tube.certified and tube.level == "trajectory",
            method=self.name,
        )

    def _smallest_level(
        self, constants: Constants, erosion: Erosion, curve: Curve, objective: object, fits: bool
    ) -> float:
        """log10 of the smallest delta at which the named tube fits, by bisection; 0 if none below 1 does."""
        target = math.log10(self.problem.delta)

        def fitting(log10: float) -> float | None:
            delta = 10.0**log10
            tube = tune_tube(constants, horizon=self.flow.horizon, delta=delta, objective=objective, method=self.method)
            return tube.log10_delta if bool(np.all(_needed(tube, curve, Start()) <= erosion.least)) else None

        low, high = (SMALLEST_LOG10, target) if fits else (target, -1e-3)
        proved = target if fits else fitting(high)
        if proved is None:
            return 0.0
        smallest = fitting(low) if fits else None
        if smallest is not None:
            return smallest
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            found = fitting(middle)
            if found is None:
                low = middle
            else:
                high, proved = middle, found
            if high - low < 0.005 * abs(high):
                break
        return proved

    def _explained(
        self, tube: Tube, erosion: Erosion, needed: Array, label: str, time: float, level: float, fits: bool
    ) -> str:
        """The reason, in words."""
        if not label:
            return "no constraint asks anything."
        room = erosion.least
        with np.errstate(all="ignore"):
            ratio = float(np.nanmax(np.where(room > 0, needed / room, np.inf)[0 if self.flow.continuous else 1 :]))
        if fits:
            return f"the tube takes {100 * ratio:.3g} % of the room that the constraints leave."
        return (
            f"at delta = {self.problem.delta:g} the tube takes {ratio:.3g} times the room that '{label}' leaves at "
            f"{self._when(time)}; what would do: delta >= {10**level:.2g}, or noise at most {1 / ratio:.2g} times as "
            "large."
        )


def _assumption(constants: Constants) -> str:
    if constants.certified:
        return ""
    name, value = ("rate", constants.rate) if constants.continuous else ("gain", constants.gain)
    return f"the stated constants ({name} = {value}, sigma = {constants.sigma}) are assumed, not proved"


def _needed(tube: Tube, curve: Curve, start: Start) -> Array:
    """Radius of a tube over each piece; step 0 of discrete time owes nothing unless the start is random."""
    radius = radius_over_pieces(tube, curve)
    if not curve.continuous and start != Start():
        radius[0] = tube.bound(0.0, 0.0)
    return radius


def _deviation_pieces(curve: Curve, needed: Array) -> tuple[Array, Array]:
    """Times (K + 1,) and the radius between them."""
    if curve.continuous:
        return np.append(curve.starts, curve.ends[-1]), needed
    return np.asarray(curve.starts), np.maximum(needed[:-1], needed[1:])


def _merged(profile: tuple[Array, Array], tolerance: float) -> tuple[Array, Array]:
    """The profile with neighbours of nearly equal values joined at the smaller one."""
    times, values = profile
    kept, joined = [times[0]], [values[0]]
    largest = values[0]
    for start, value in zip(times[1:-1], values[1:]):
        low, high = min(joined[-1], value), max(largest, value)
        if high <= low * (1 + tolerance):
            joined[-1], largest = low, high
        else:
            kept.append(start)
            joined.append(value)
            largest = value
    return np.append(kept, times[-1]), np.array(joined)


def _random_start(problem: Problem, constants: Constants) -> Start:
    """X_0 - mean as isotropic sub-Gaussian noise: the least s with covariance <= s^2 P^-1 (item 7.4)."""
    if not isinstance(problem.initial, GaussianStart):
        return Start()
    covariance = np.asarray(problem.initial.covariance, dtype=float)
    n = len(covariance)
    metric = np.eye(n) if constants.metric is None else np.asarray(constants.metric, dtype=float)
    if not np.any(covariance):
        return Start()
    root = np.linalg.cholesky(metric)
    square = float(np.linalg.eigvalsh(root.T @ covariance @ root)[-1])
    inner = Interval.point(metric) @ Interval.point(covariance) @ Interval.point(metric)
    for slack in 10.0 ** np.arange(-12, 1):
        factor = square * (1 + slack)
        if bool(is_positive_definite(Interval.point(metric) * factor - inner)):
            return Start(sigma=math.nextafter(math.sqrt(factor), math.inf))
    raise EnclosureError("the random start could not be bounded in the metric; it is too ill-conditioned.")
