"""Simulated paths themselves, for plots."""

from __future__ import annotations

from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.simulation.blocks import BLOCK, MEMORY_LIMIT, check_count, entropy_of
from certbound.simulation.estimates.preparation import prepare, refuse_held
from certbound.simulation.kernel_source import kernel_source
from certbound.simulation.stepping import Scenario
from certbound.simulation.tasks import Task


def sample_paths(
    problem: Any,
    *,
    paths: int,
    rng: np.random.Generator | int | None = None,
    steps: int | None = None,
    points: int | None = None,
    deviation: bool = False,
    scenario: Scenario | None = None,
) -> Array:
    """Simulated states, also after a path has left the safe set.

    Parameters
    ----------
    problem : Problem
    paths : int
        Number of independent paths.
    rng : numpy.random.Generator, optional
        The same state gives the same paths.
    steps : int, optional
        Time steps over the horizon; 1000 in continuous time, the horizon itself in discrete time.
    points : int, optional
        Store this many equal pieces of the horizon instead of every step (it must divide ``steps``).
    deviation : bool
        Store X_t - x_t, with x the noise-free path of the same start and disturbance, instead of X_t.
    scenario : Scenario, optional
        Starts, disturbances, scheme.

    Returns
    -------
    ndarray, shape (paths, points + 1, n)
        State at the times ``np.linspace(0, horizon, points + 1)``.

    Raises
    ------
    ValueError
        If an argument is malformed, or the result would exceed the memory limit (the message says what fits).

    Examples
    --------
    >>> import certbound as cb
    >>> cb.sample_paths(cb.load("ou"), paths=3, rng=np.random.default_rng(0), points=50).shape
    (3, 51, 1)
    """
    paths = check_count("paths", paths)
    if deviation:
        refuse_held(problem, "a sample of deviations")
    setting = prepare(problem, steps, scenario)
    points = setting.steps if points is None else check_count("points", points)
    if setting.steps % points:
        raise ValueError(f"`points` must divide the number of steps, {setting.steps}, got {points}.")
    n = setting.model.dimension
    per_path = 8 * n * (points + 1)
    if paths * per_path > MEMORY_LIMIT:
        raise ValueError(
            f"`paths` must be at most {MEMORY_LIMIT // per_path} with {points + 1} stored times of {n} "
            f"states ({MEMORY_LIMIT // 2**20} MiB), got {paths}; lower `paths` or `points`."
        )
    kernel = kernel_source(setting.model, Task(kind="record", own_nominal=deviation))
    marks = np.arange(points + 1, dtype=np.int64) * (setting.steps // points)
    work = setting.work(kernel, marks=marks, counts_shape=(1, 1), paths=paths, entropy=entropy_of(rng))
    out = np.empty((paths, points + 1, n))
    for block in range(work.blocks):
        work.run_block(block, work.tally(), out[block * BLOCK : (block + 1) * BLOCK])
    return out
