"""How far paths stray from their noise-free path: histograms, quantiles and their confidence limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.checks import positive_definite
from certbound.simulation.blocks import MEMORY_LIMIT, Counts, check_count
from certbound.simulation.checkpoint import seed_of
from certbound.simulation.estimates.preparation import Setting, prepare, refuse_held
from certbound.simulation.estimates.statistics import bound_binomial, order_ranks
from certbound.simulation.executors import Progress, run_work
from certbound.simulation.kernel_source import kernel_source
from certbound.simulation.stepping import Scenario
from certbound.simulation.tasks import LOWEST, Task

_OCTAVES = 64  # histograms reach from 2**LOWEST to 2**(LOWEST + 64)
_FINE, _COARSE = 2000, 100  # bins per octave: 0.035 % and 0.7 %


class Quantile(NamedTuple):
    """An estimated quantile and its confidence limits (inf where the sample is too small for one)."""

    value: float
    lower: float
    upper: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Measure:
    """What is measured of the deviation s = X_t - x_t."""

    metric: ArrayLike | None = None  # (n, n): P of sqrt(s' P s); the identity when omitted
    coordinates: Sequence[int] | None = None  # measure the Euclidean norm of these states only (instead of ``metric``)
    directions: ArrayLike | None = None  # (q, n): measure each directions[j] . s, with its sign (instead of a norm)
    # (steps + 1,), or callable: divide by this positive function of time (or its values on the steps): the quantiles
    # then tell by which factor a tube with this radius would have to be scaled
    profile: ArrayLike | Callable[[Array], ArrayLike] | None = None

    def __post_init__(self) -> None:
        given = [name for name in ("metric", "coordinates", "directions") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"at most one of `metric`, `coordinates`, `directions` may be given, got {given}.")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Deviations:
    """Histograms of deviations; rows belong to the directions (one row for a norm)."""

    paths: int
    # (rows, bins): largest deviation over the horizon. Bin 0 holds all up to ``edges[0]``, bin k those up to
    # ``edges[k]``.
    counts: Counts = field(repr=False)
    edges: Array = field(repr=False)  # (bins,): upper ends of the bins; neighbours differ by 0.035 %
    times: Array = field(repr=False)  # (points,): where the two histograms below were taken
    # (points, rows, marginal bins): deviation at that time, and the largest one until then
    marginal_counts: Counts = field(repr=False)
    running_counts: Counts = field(repr=False)
    marginal_edges: Array = field(repr=False)  # (marginal bins,): upper ends of their bins; neighbours differ by 0.7 %
    steps: int
    scheme: str
    # compilation left out
    seconds: float
    path_steps_per_second: float

    def quantile(self, level: float, *, confidence: float = 0.99, row: int = 0) -> Quantile:
        """The radius that the largest deviation stays below with probability ``level``.

        Examples
        --------
        >>> import certbound as cb
        >>> found = sup_deviation(cb.load("ou"), paths=20000, rng=np.random.default_rng(2))
        >>> bool(found.quantile(0.99).lower < 1.104 < found.quantile(0.99).upper)
        True
        """
        return _quantile(self.counts[row], self.edges, self.paths, level, confidence)

    def exceedance(self, radius: float, *, confidence: float = 0.99, row: int = 0) -> Quantile:
        """Probability that the largest deviation exceeds ``radius``, with Clopper-Pearson limits.

        ``radius`` is rounded to the nearest bin end.
        """
        place = int(np.argmin(np.abs(self.edges - radius)))
        above = int(self.counts[row, place + 1 :].sum())
        lower, upper = bound_binomial(above, self.paths, confidence)
        return Quantile(above / self.paths, float(lower), float(upper))

    def quantile_curve(self, level: float, *, running: bool = False, confidence: float = 0.99, row: int = 0) -> Array:
        """Quantile at each of ``times``: shape (points, 3) with value, lower and upper limit.

        ``running`` takes the largest deviation until that time instead of the one at that time.
        """
        counts = self.running_counts if running else self.marginal_counts
        edges = self.marginal_edges
        return np.array([_quantile(count, edges, self.paths, level, confidence) for count in counts[:, row]])


def sup_deviation(
    problem: Any,
    *,
    paths: int,
    rng: np.random.Generator | int | None = None,
    steps: int | None = None,
    points: int = 0,
    measure: Measure | None = None,
    executor: Any = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
    scenario: Scenario | None = None,
) -> Deviations:
    """Distribution of sup_{t <= T} ‖X_t - x_t‖, with x the noise-free path of the same start and disturbance.

    In continuous time the supremum includes what happens between two steps: a Brownian bridge's maximum is
    drawn where it can exceed the record (exact in one dimension up to the scheme's error, else of first order
    in the step).

    Parameters
    ----------
    problem : Problem
    paths : int
        Number of independent paths. Memory does not depend on it.
    rng : numpy.random.Generator, optional
        The same state gives the same counts, on any executor.
    steps : int, optional
        Time steps over the horizon; 1000 in continuous time, the horizon itself in discrete time.
    points : int
        Also take histograms at this many equally spaced times, the last one T.
    measure : Measure, optional
        Norm or directions; the Euclidean norm when omitted.
    executor, checkpoint, progress, scenario
        As in `certbound.simulate_exits`.

    Returns
    -------
    Deviations

    Raises
    ------
    ValueError
        If an argument is malformed, the noise has no law, or the model gives a state that is not finite.
    """
    paths = check_count("paths", paths)
    refuse_held(problem, "a simulation of deviations")
    setting = prepare(problem, steps, scenario)
    task, profile = _task(setting, measure or Measure(), points != 0)
    rows, bins = 1 if task.directions is None else len(task.directions), _OCTAVES * _COARSE + 2
    marks = _marks(points, setting.steps, rows * bins)
    work = setting.work(
        kernel_source(setting.model, task),
        nominal=setting.nominal(),
        profile=profile,
        marks=marks,
        counts_shape=(rows, _OCTAVES * _FINE + 2),
        marginals_shape=(2, len(marks), rows, bins),
        paths=paths,
        entropy=seed_of(rng, checkpoint),
    )
    outcome = run_work(work, executor, checkpoint, progress)
    return Deviations(
        paths=paths,
        counts=outcome.tally.counts,
        edges=_edges(_FINE),
        times=setting.times[marks],
        marginal_counts=outcome.tally.marginals[0],
        running_counts=outcome.tally.marginals[1],
        marginal_edges=_edges(_COARSE),
        steps=setting.steps,
        scheme=setting.model.scheme,
        seconds=outcome.seconds,
        path_steps_per_second=outcome.rate,
    )


def _marks(points: int, steps: int, bins: int) -> Counts:
    """Steps at equal distances, the last one included, where histograms of ``bins`` counts are taken."""
    count = check_count("points", points) if points else 0
    if count > steps:
        raise ValueError(f"`points` must be at most the number of steps, {steps}, got {count}.")
    if 16 * count * bins > MEMORY_LIMIT:
        raise ValueError(f"`points` must be at most {MEMORY_LIMIT // (16 * bins)}, got {count}.")
    return np.round(np.arange(1, count + 1) * steps / max(count, 1)).astype(np.int64)


def _task(setting: Setting, measure: Measure, marked: bool) -> tuple[Task, Array]:
    n = setting.model.dimension
    fields: dict[str, Any] = {"norm": np.eye(n)}
    densities = (float(_FINE), float(_COARSE))
    if measure.metric is not None:
        fields["norm"] = np.linalg.cholesky(positive_definite("metric", measure.metric, n)).T
    elif measure.coordinates is not None:
        chosen = list(measure.coordinates)
        if not chosen or len(set(chosen)) < len(chosen) or not all(0 <= i < n for i in chosen):
            raise ValueError(f"`coordinates` must be distinct state indices below {n}, got {chosen}.")
        fields["norm"] = np.eye(n)[chosen]
    elif measure.directions is not None:
        rows = np.atleast_2d(np.asarray(measure.directions, dtype=float))
        if rows.ndim != 2 or rows.shape[1] != n or not np.all(np.isfinite(rows)):
            raise ValueError(f"`directions` must be finite rows of {n} numbers, got shape {rows.shape}.")
        fields = {"directions": rows}
    profile = np.zeros(0)
    if measure.profile is not None:
        given = measure.profile(setting.times) if callable(measure.profile) else measure.profile
        profile = np.broadcast_to(np.asarray(given, dtype=float), (setting.steps + 1,)).copy()
        if not np.all(np.isfinite(profile[1:]) & (profile[1:] > 0)):
            raise ValueError("`profile` must be positive and finite after time 0.")
        fields["smallest_scale"] = float(profile[1:].min())
    own = not setting.shared_nominal
    return Task(kind="deviation", own_nominal=own, marked=marked, densities=densities, **fields), profile


def _edges(density: int) -> Array:
    """Upper ends of the bins 0, 1, ...; the last bin has none and gets inf."""
    ends = 2.0 ** (LOWEST + np.arange(_OCTAVES * density + 1) / density)
    return np.append(ends, np.inf)


def _quantile(counts: Counts, edges: Array, paths: int, level: float, confidence: float) -> Quantile:
    if not 0.0 < level < 1.0:
        raise ValueError(f"`level` must lie in (0, 1), got {level!r}.")
    total = np.cumsum(counts)
    low, high = order_ranks(level, paths, confidence)
    place = int(np.searchsorted(total, level * paths, side="left"))
    before = int(total[place - 1]) if place else 0
    share = (level * paths - before) / max(int(counts[place]), 1)
    start = edges[place - 1] if place else 0.0
    value = float(start + np.clip(share, 0.0, 1.0) * (edges[place] - start)) if place < len(edges) - 1 else np.inf
    lower = int(np.searchsorted(total, low, side="right")) if low >= 0 else -1
    upper = float(edges[np.searchsorted(total, high, side="right")]) if high < paths else np.inf
    return Quantile(value, float(edges[lower - 1]) if lower > 0 else 0.0, upper)
