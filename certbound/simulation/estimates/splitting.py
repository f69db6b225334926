"""Probabilities of rare exits by adaptive multilevel splitting.

N particles run to the horizon. Again and again the tenth with the lowest scores (see `score`) is discarded
and each replaced by a copy of a survivor up to the first step at which that one exceeded the level, continued
with new noise. The product of the surviving shares, times the final share of exits, is an unbiased estimate
of the exit probability (Brehier, Gazeau, Goudenege, Lelievre, Rousset: Unbiasedness of some generalized
adaptive multilevel splitting algorithms, 2016), whatever the score; a good score makes its variance small.
Independent replicas give the standard error."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from certbound.arrays import Array
from certbound.simulation.blocks import MEMORY_LIMIT, Tally, Work, check_count
from certbound.simulation.checkpoint import seed_of
from certbound.simulation.estimates.halving import OTHER, StepEffect, checkpoint_beside, halved
from certbound.simulation.estimates.preparation import Setting, prepare, refuse_held
from certbound.simulation.estimates.score import score_source
from certbound.simulation.estimates.statistics import bound_binomial, check_confidence
from certbound.simulation.executors import Progress, run_work
from certbound.simulation.gap_tests import Barrier, barriers_of, tables_of
from certbound.simulation.kernel_source import (
    close_noise,
    function_lines,
    kernel_body,
    load_lines,
    module_text,
    nominal_lines,
    open_noise,
    start_text,
    step_lines,
)
from certbound.simulation.stepping import Scenario, StepModel
from certbound.simulation.tape_text import each, indent

_PARTICLES = 500
_DISCARDED = 0.1


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RareExits:
    """An exit probability from importance splitting."""

    probability: float  # mean of the replicas' estimates: unbiased for the time-discretised model
    standard_error: float  # of the mean, from the scatter of the replicas
    # Student interval of the mean, cut off at 0 (approximate, unlike Clopper-Pearson limits). If no particle of any
    # replica left, ``lower`` is 0 and ``upper`` the Clopper-Pearson limit of the first generation alone.
    lower: float
    upper: float
    confidence: float
    paths: int  # particles in all replicas
    exits: int  # particles that had left in the end, in all replicas
    replicas: int
    step: StepEffect | None  # what the step adds, from independent replicas with half of it; None in discrete time
    steps: int
    scheme: str
    path_steps: int  # path-steps done, copies included
    # compilation left out
    seconds: float
    path_steps_per_second: float

    @property
    def refuted(self) -> float:
        """The bound below which all are refuted: by the limit with the step, and by that with half of it."""
        return self.lower if self.step is None else min(self.lower, self.step.halved_lower)


def simulate_rare_exits(
    problem: Any,
    *,
    paths: int = 200 * _PARTICLES,
    particles: int = _PARTICLES,
    rng: np.random.Generator | int | None = None,
    steps: int | None = None,
    confidence: float = 0.99,
    halve: bool = True,
    executor: Any = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
    scenario: Scenario | None = None,
) -> RareExits:
    """Estimate a small probability that a path leaves the safe set, or the domain.

    Parameters
    ----------
    problem : Problem
    paths : int
        Particles in all; ``paths // particles`` independent replicas run, at least ten.
    particles : int
        Particles per replica, at least 20.
    rng, steps, confidence
        As in `certbound.simulate_exits`.
    halve : bool
        Run half as many replicas of half as many particles with half of the step too, on noise of their own: copies of
        particles cannot share it. Not in discrete time.
    executor, checkpoint, progress, scenario
        As in `certbound.simulate_exits`; a switching disturbance is refused.

    Returns
    -------
    RareExits

    Raises
    ------
    ValueError
        If an argument is malformed, the particles' stored paths exceed the memory limit (the message says
        what fits), the noise has no law, or the model gives a state that is not finite.

    Examples
    --------
    >>> import certbound as cb
    >>> found = simulate_rare_exits(cb.load("ou", radius=1.9), paths=10000, rng=np.random.default_rng(4))
    >>> bool(1e-8 < found.probability < 1e-6)
    True
    """
    paths, particles = check_count("paths", paths), check_count("particles", particles)
    confidence = check_confidence(confidence)
    if particles < 20:
        raise ValueError(f"`particles` must be at least 20, got {particles}.")
    replicas = max(10, paths // particles)
    refuse_held(problem, "splitting")
    setting = prepare(problem, steps, scenario)
    model = setting.model
    if model.switching > 0.0:
        raise ValueError("`disturbance` must not be 'switching' for rare exits; give a constant, an array or d(t, x).")
    if problem.ending:
        raise ValueError("`problem` must count leaving its domain as failing here; use simulate_exits.")
    if problem.reach is not None:
        raise ValueError("`problem` must have no target for rare exits; count plain paths, simulate_exits.")
    _check_memory(setting, particles)
    work = _rare_work(problem, setting, particles, replicas, seed_of(rng, checkpoint))
    outcome = run_work(work, executor, checkpoint, progress)
    probability, error, lower, upper = _summary(_estimates(outcome.tally), replicas * particles, confidence)
    step, seconds = None, outcome.seconds
    if halve and model.scheme != "discrete":
        fine, few = halved(problem, setting, scenario), max(particles // 2, 10)
        half = _rare_work(problem, fine, few, max(replicas // 2, 10), work.entropy ^ OTHER)
        other = run_work(half, executor, checkpoint_beside(checkpoint))
        step = _step_effect(_estimates(outcome.tally), _estimates(other.tally), few, confidence)
        seconds += other.seconds
    return RareExits(
        probability=probability,
        standard_error=error,
        lower=lower,
        upper=upper,
        confidence=confidence,
        paths=replicas * particles,
        exits=int(outcome.tally.counts[:, 1].sum()),
        replicas=replicas,
        step=step,
        steps=setting.steps,
        scheme=model.scheme,
        path_steps=outcome.tally.steps,
        seconds=seconds,
        path_steps_per_second=outcome.rate,
    )


def _rare_work(problem: Any, setting: Setting, particles: int, replicas: int, entropy: int) -> RareWork:
    own = not setting.shared_nominal
    barriers = barriers_of(problem, setting.times)
    work = setting.work(
        _kernel_source(setting.model, barriers, own),
        RareWork,
        nominal=setting.nominal(),
        **tables_of(barriers),
        profile=np.array([_DISCARDED]),
        marks=np.ones(1 if own else 0, dtype=np.int64),
        counts_shape=(replicas, 2),
        paths=replicas * particles,
        block=particles,
        entropy=entropy,
    )
    return cast(RareWork, work)


def _estimates(tally: Tally) -> Array:
    """The replicas' estimates."""
    return np.asarray(tally.counts[:, 0].copy().view(np.float64))


def _step_effect(coarse: Array, fine: Array, particles: int, confidence: float) -> StepEffect:
    """The difference of two means of replicas, with Student limits of the fewer ones (approximate)."""
    from scipy.special import stdtrit

    paths = len(fine) * particles
    (first, above, *_), (second, below, low, _) = (
        _summary(estimates, paths, confidence) for estimates in (coarse, fine)
    )
    width = float(stdtrit(len(fine) - 1, 0.5 * (1.0 + confidence))) * math.hypot(above, below)
    adds = first - second
    return StepEffect(adds=adds, lower=adds - width, upper=adds + width, halved_lower=low, paths=paths)


def _check_memory(setting: Setting, particles: int) -> None:
    """Refuse more particles than their stored paths may take; noise-free paths of their own are stored too."""
    n = setting.model.dimension
    size = 8 * (setting.steps + 1) * (1 + n * (1 if setting.shared_nominal else 2))
    if particles * size > MEMORY_LIMIT // 4:
        raise ValueError(
            f"`particles` must be at most {MEMORY_LIMIT // 4 // size} with {setting.steps} steps of {n} "
            f"states, got {particles}; lower `particles` or `steps`."
        )


def _summary(estimates: Array, paths: int, confidence: float) -> tuple[float, float, float, float]:
    """Mean, its standard error, and an interval."""
    from scipy.special import stdtrit

    count = len(estimates)
    mean = math.fsum(estimates) / count
    if mean == 0.0:
        return 0.0, 0.0, 0.0, float(bound_binomial(0, paths, confidence)[1])
    error = math.sqrt(math.fsum((estimates - mean) ** 2) / (count - 1) / count)
    width = float(stdtrit(count - 1, 0.5 * (1.0 + confidence))) * error
    return mean, error, max(mean - width, 0.0), min(mean + width, 1.0)


class RareWork(Work):
    """One replica a block.

    A tally's row holds the bits of a replica's estimate, and its exits: adding tallies joins their rows.
    """

    def run_block(self, block: int, tally: Tally, out: Array | None = None) -> int:
        result = np.zeros((1, 1, 2))
        done = super().run_block(block, tally, result)
        tally.counts[block, 0] = result[0, 0].view(np.int64)[0]
        tally.counts[block, 1] = int(result[0, 0, 1])
        return done


_IMPORTS = """
from certbound.simulation.compiled.entry import FOLLOW
from certbound.simulation.compiled.particles import hold
from certbound.simulation.compiled.supremum import fall_between
"""

_RUN = """
@njit(
    FOLLOW, nogil=True, cache=@CACHE@, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True,
)
def run(
    stream, signals, inputs, moving, windows, nominal, p, steps, notes, states, frees, tops, path, first
):
    done = 0
"""


def _kernel_source(model: StepModel, barriers: list[Barrier], own: bool) -> tuple[str, Array]:
    """Source of the splitting kernel, which runs one particle on from a step; see `compiled.particles`."""
    p = start_text(model)
    functions = function_lines(model, p)
    step, bridge = step_lines(model, p, "first")
    begin, within, end = score_source(barriers, bridge, p)
    n = model.dimension
    load = [*load_lines(model, "states[path, first, {0}]", p), "top = tops[path, first]"]
    free = each("b_{0} = nominal[k + 1, {0}]", n, p)
    store = [*each("states[path, k + 1, {0}] = y_{0}", n, p), "tops[path, k + 1] = top"]
    if own:
        load += each("a_{0} = frees[path, first, {0}]", n, p)
        free = nominal_lines(model, p, "first")
        store += each("frees[path, k + 1, {0}] = b_{0}", n, p)
        end = [*end, *each("a_{0} = b_{0}", n, p)]
    full = ["hold(tops, path, k + 1, top)", "break"]
    loop = [*step, *free, *within, *store, "if top >= 1.0:", *indent(full), *each("x_{0} = y_{0}", n, p), *end]
    out = ["if top >= 1.0:", "    hold(tops, path, first, top)", "    return done"]
    body = [*open_noise(model, p), *load, *begin, *out, "for k in range(first, steps):", *indent(loop)]
    body += [close_noise(), "return done"]
    text = module_text(model, "splitting", functions, p) + _IMPORTS + _RUN + kernel_body(body, p)
    return text, np.array([*p.values, 0.0])
