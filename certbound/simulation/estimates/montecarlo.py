"""Exit probabilities by plain Monte Carlo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from certbound.arrays import Array
from certbound.problem.problem import DOMAIN
from certbound.simulation.blocks import Counts, Work, check_count
from certbound.simulation.checkpoint import seed_of
from certbound.simulation.estimates.halving import (
    OTHER,
    PairedWork,
    StepEffect,
    checkpoint_beside,
    composed,
    halved,
    paired_paths,
    step_effect,
)
from certbound.simulation.estimates.preparation import Setting, prepare
from certbound.simulation.estimates.statistics import bound_binomial, check_confidence
from certbound.simulation.executors import Progress, run_work
from certbound.simulation.gap_tests import barriers_of, goal_of, keep_of, tables_of
from certbound.simulation.kernel_source import kernel_source
from certbound.simulation.stepping import Scenario, StepModel
from certbound.simulation.tasks import Task

_TIME_BINS = 200


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ExitCounts:
    """How many simulated paths left the safe set or the domain; with a target, before they were in it, or never were.

    Parameters
    ----------
    paths, exits : int
        Paths simulated, and those that left.
    probability : float
        Their ratio.
    lower, upper : float
        Clopper-Pearson limits: each misses the true probability (of the time-discretised model) with chance
        at most (1 - confidence)/2.
    step : StepEffect or None
        What the time step adds to the probability, from paths that are simulated with half of it too. None in discrete
        time, and where it was not asked for.
    confidence : float
    by_constraint : dict
        Label to the number of paths that left through this constraint first.
    times : ndarray, shape (bins + 1,)
        Ends of time bins.
    exits_by_time : ndarray of int, shape (constraints, bins + 1)
        First exits by constraint: column 0 at the start, column k + 1 within bin k.
    steps : int
        Time steps per path.
    scheme : str
        ``exact``, ``milstein``, ``euler``, ``exponential`` or ``discrete``.
    seconds, path_steps_per_second : float
        Compilation left out.
    """

    paths: int
    exits: int
    probability: float
    lower: float
    upper: float
    confidence: float
    step: StepEffect | None
    by_constraint: dict[str, int]
    times: Array = field(repr=False)
    exits_by_time: Counts = field(repr=False)
    steps: int
    scheme: str
    seconds: float
    path_steps_per_second: float

    @property
    def refuted(self) -> float:
        """The bound below which all are refuted: by the limit with the step, and by that with half of it."""
        return self.lower if self.step is None else min(self.lower, self.step.halved_lower)

    def refutes(self, delta: float) -> bool:
        """Whether the exit probability exceeds ``delta``, with the step and with half of it.

        Each is wrong with a chance of (1 - confidence)/2 at most.
        """
        return self.refuted > delta


def simulate_exits(
    problem: Any,
    *,
    paths: int,
    rng: np.random.Generator | int | None = None,
    steps: int | None = None,
    confidence: float = 0.99,
    halve: bool = True,
    executor: Any = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
    scenario: Scenario | None = None,
) -> ExitCounts:
    """Estimate the probability that a path leaves the safe set, or the domain, within the horizon.

    Where the problem has a target: before it has entered that, or that it never enters it. Between two steps of
    continuous time entering is looked for as leaving is, by a bridge.

    Parameters
    ----------
    problem : Problem
    paths : int
        Number of independent paths. Memory does not depend on it.
    rng : numpy.random.Generator, optional
        The same state gives the same counts, on any executor.
    steps : int, optional
        Time steps over the horizon; the horizon itself in discrete time, and in continuous time 1000, or as many as
        the model's fastest modes need (a warning says so where given ones are too few).
    confidence : float
        Of the limits.
    halve : bool
        Simulate some of the paths (all of few, an eighth of many) with half of the step too, on the same Brownian
        paths: what the step adds. Not in discrete time.
    executor : concurrent.futures.Executor or dask Client, optional
        Threads of this process when omitted.
    checkpoint : path, optional
        File that keeps finished chunks, and beside it one named with ``.halved`` those with half of the step. An
        existing one is continued, with its seed where ``rng`` is omitted.
    progress : callable, optional
        Called now and then with a `Progress`.
    scenario : Scenario, optional
        Starts, disturbances, scheme.

    Returns
    -------
    ExitCounts

    Raises
    ------
    ValueError
        If an argument is malformed, the noise has no law, or the model gives a state that is not finite.
    SolverError
        If the executor breaks down.

    Notes
    -----
    Nothing is certified: the limits hold for the time-discretised model, up to the stated confidence. What halving
    the step changes is about half of the step's error in a scheme of first order, and three quarters in one of second.

    Examples
    --------
    >>> import certbound as cb
    >>> problem = cb.load("ou", radius=0.8)
    >>> result = cb.simulate_exits(problem, paths=20000, rng=np.random.default_rng(1))
    >>> bool(result.lower < 0.136 < result.upper), result.paths
    (True, 20000)
    """
    paths, confidence = check_count("paths", paths), check_confidence(confidence)
    setting = prepare(problem, steps, scenario)
    barriers, goal = barriers_of(problem, setting.times), goal_of(problem, setting.times)
    rows = [*barriers, *(row for row in (goal, keep_of(problem, setting.times)) if row is not None)]
    shape = len(rows), 1 + min(setting.steps, _TIME_BINS)
    work = _work(problem, setting, setting.model, paths=paths, entropy=seed_of(rng, checkpoint), counts_shape=shape)
    outcome = run_work(work, executor, checkpoint, progress)
    counts = outcome.tally.counts
    ends = problem.ending and barriers[-1].label == DOMAIN
    if ends:  # who left the domain has ended, and does not count
        rows, counts = [row for row in rows if row is not barriers[-1]], np.delete(counts, len(barriers) - 1, axis=0)
    exits = int(counts.sum())
    lower, upper = bound_binomial(exits, paths, confidence)
    step, seconds = None, outcome.seconds
    if halve and setting.model.scheme != "discrete":
        paired = _paired(problem, setting, scenario, work, len(barriers) - 1 if ends else -1)
        pairs = run_work(paired, executor, checkpoint_beside(checkpoint))
        step = step_effect(pairs.tally.counts[0], (exits, paths), paired.paths, confidence)
        seconds += pairs.seconds
    by_constraint: dict[str, int] = {}
    for barrier, count in zip(rows, counts.sum(axis=1)):
        by_constraint[barrier.label] = by_constraint.get(barrier.label, 0) + int(count)
    return ExitCounts(
        paths=paths,
        exits=exits,
        probability=exits / paths,
        lower=float(lower),
        upper=float(upper),
        confidence=confidence,
        step=step,
        by_constraint=by_constraint,
        times=_bin_ends(setting, counts.shape[1] - 1),
        exits_by_time=counts,
        steps=setting.steps,
        scheme=setting.model.scheme,
        seconds=seconds,
        path_steps_per_second=outcome.rate,
    )


def _work(problem: Any, setting: Setting, model: StepModel, kind: type[Work] = Work, **fields: Any) -> Work:
    """The work that counts exits by constraint, by a model of the setting's step."""
    barriers, goal = barriers_of(problem, setting.times), goal_of(problem, setting.times)
    keep = keep_of(problem, setting.times)
    rows = [*barriers, *(row for row in (goal, keep) if row is not None)]
    task = Task(kind="exits", barriers=barriers, goal=goal, keep=keep)
    return setting.work(kernel_source(model, task), kind, **tables_of(rows), **fields)


def _paired(problem: Any, setting: Setting, scenario: Scenario | None, work: Work, ignored: int) -> PairedWork:
    """The work that counts exits with the step, and with half of it, of the same paths; none of those of ``work``."""
    fine = halved(problem, setting, scenario)
    rows = work.counts_shape[0]
    both: dict[str, Any] = {"paths": paired_paths(work.paths), "entropy": work.entropy ^ OTHER}
    coarse = _work(problem, setting, composed(setting.model, fine.model), counts_shape=(rows, 2), **both)
    both |= {"coarse": coarse, "rows": rows, "ignored": ignored, "counts_shape": (1, 3)}
    return cast(PairedWork, _work(problem, fine, fine.model, PairedWork, **both))


def _bin_ends(setting: Setting, bins: int) -> Array:
    """Times that separate the bins: bin k holds the steps j with j bins // steps = k."""
    firsts = -(-np.arange(bins + 1) * setting.steps // bins)
    return np.asarray(setting.times[np.minimum(firsts, setting.steps)])
