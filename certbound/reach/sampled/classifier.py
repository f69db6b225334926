"""Reachable sets learned by Gaussian-process classification: a statistical statement, no proof.

Whether a state is reachable at a time t is a question with a yes or a no, and a simulation answers it: the noise-free
model, run backwards from that state, ends in the initial set or not (for some of a few constant disturbances). A
Gaussian process learns the boundary from few such answers, and asks next where it knows least.

What it learned carries no guarantee of its own. The guarantee comes from trajectories that it never saw: a threshold is
lowered until all N of them are accepted at every classified time. Together with the boxes around them this is a
scenario program with 2 n K + 1 variables.

Source: Devonport and Arcak, "Data-driven reachable set computation using adaptive Gaussian process classification and
Monte Carlo methods" (2020).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certbound.arrays import Array, Mask
from certbound.problem.problem import Problem
from certbound.reach.nominal import Flow
from certbound.reach.sampled.boxes import (
    SampledTube,
    boxes_tube,
    noise_free_boxes,
    noise_free_states,
    scenario_count,
    time_grid,
)

_TIMES = 8
_FIRST = 500
_POOL = 2000
_ASKED = 20
_MARGIN = 0.25  # beyond the reached states, in their own coordinates
_HEIGHT, _LENGTH = 100.0, 1.0  # of the kernel, in coordinates in which the reached states have variance 1
_FEW = 8  # random disturbances beside the corners and the middle
_MOST_CORNERS = 6


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class LearnedTube(SampledTube):
    """Boxes around samples, cut down by classifiers at some times.

    Parameters
    ----------
    classifiers : mapping
        Time to a function (M, n) -> (M,), the probability that a state is reachable.
    threshold : float
        States below it are taken for unreachable.
    """

    classifiers: Mapping[float, Any] = field(default_factory=dict)
    threshold: float = 0.0

    def contains(self, t: float, x: ArrayLike, *, tolerance: float = 1e-9) -> bool:
        """Whether a state lies in the box at time t and, at a classified time, is accepted there."""
        inside = super().contains(t, x, tolerance=tolerance)
        if not inside or float(t) not in self.classifiers:
            return inside
        score = self.classifiers[float(t)](np.asarray(x, dtype=float)[None])[0]
        return bool(score >= self.threshold * (1 - 1e-12))

    def to_dict(self) -> dict[str, Any]:
        """Box hulls per piece, classified times, threshold, and what they rest on."""
        return {**super().to_dict(), "classified": list(self.classifiers), "threshold": self.threshold}


def estimate_reach_by_classifier(
    problem: Problem,
    *,
    epsilon: float = 0.01,
    confidence: float = 0.999,
    pieces: int | None = None,
    points: int = 240,
    rng: np.random.Generator | int | None = None,
) -> LearnedTube:
    """Noise-free reachable sets by Gaussian-process classification, with a statistical guarantee (see the module).

    Parameters
    ----------
    problem : Problem
        In continuous time, with an initial set that has an interior.
    epsilon, confidence : float
        With probability ``confidence`` over the draw, at most ``epsilon`` of all trajectories leave the tube.
    pieces : int, optional
        Pieces of time; up to eight of their ends are classified.
    points : int
        Answers that each classifier may ask for.
    rng : numpy.random.Generator or int, optional

    Returns
    -------
    LearnedTube

    Raises
    ------
    ValueError
        If the problem is in discrete time, its initial set has no interior, a number is malformed, or scikit-learn is
        not installed.
    """
    flow = Flow(problem)
    if not flow.continuous:
        raise ValueError('`problem` must be in continuous time, where the model runs backwards; use method "sampled".')
    inside = _membership(problem)
    if isinstance(points, bool) or int(points) != points or points < 2 * _ASKED:
        raise ValueError(f"`points` must be a whole number, at least {2 * _ASKED}, got {points!r}.")
    _classifier()  # before any work
    random = np.random.default_rng(rng)
    grid = time_grid(flow, pieces)
    chosen = np.unique(np.linspace(1, len(grid) - 1, min(_TIMES, len(grid) - 1)).astype(int))
    training, *_ = _forward(flow, grid, chosen, random, _FIRST)
    models = {
        k: _learn(flow, grid[: k + 1], states, inside, random, points) for k, states in zip(chosen.tolist(), training)
    }
    count = scenario_count(2 * flow.dimension * (len(grid) - 1) + 1, epsilon, confidence)
    fresh, low, high = _forward(flow, grid, chosen, random, count)
    threshold = min(float(models[k](states).min()) for k, states in zip(chosen.tolist(), fresh))
    boxes = boxes_tube(flow, grid, low, high, noise=False, epsilon=epsilon, confidence=confidence, samples=count)
    found = {name: getattr(boxes, name) for name in ("curve", "box", "log10_delta", "assumption", "epsilon")}
    return LearnedTube(
        **found, confidence=confidence, samples=count, threshold=threshold,
        method="boxes around samples and Gaussian-process classification",
        classifiers=MappingProxyType({float(grid[k]): model for k, model in models.items()}),
    )


def _classifier() -> Any:
    """scikit-learn's Gaussian-process classifier."""
    try:
        from sklearn.gaussian_process import GaussianProcessClassifier
    except ImportError as error:
        raise ValueError(
            '`method` "learned" needs scikit-learn; install it with: pip install \'certbound[learn]\'.'
        ) from error
    return GaussianProcessClassifier


def _membership(problem: Problem) -> Any:
    """Membership in the initial set; it must have an interior."""
    initial = problem.initial
    states = problem.system.states
    wide = np.zeros(len(states)) if initial.random else initial.extent().lo < initial.extent().hi
    flat = [name for name, has_width in zip(states, wide) if not has_width]
    if flat:
        raise ValueError(
            f"`initial` must have an interior to be hit backwards, got no width in {', '.join(flat)}; "
            'give it a width, or use method "sampled".'
        )
    return initial.contains


def _forward(
    flow: Flow, grid: Array, chosen: NDArray[Any], rng: np.random.Generator, count: int
) -> tuple[list[Array], Array, Array]:
    """States at the chosen grid times of ``count`` new trajectories, and the boxes around them on every piece."""
    wanted = [float(grid[k]) for k in chosen]
    low, high, kept = noise_free_boxes(flow, grid, count, rng, wanted)
    return [kept[t] for t in wanted], low, high


def _disturbances(flow: Flow, rng: np.random.Generator) -> Array:
    """Constant disturbances that are tried backwards: middle, corners and a few at random."""
    box = flow.problem.system.disturbance
    if box is None:
        return np.zeros((1, 0))
    ends = list(zip(box.low, box.high))
    corners = list(itertools.product(*ends)) if len(ends) <= _MOST_CORNERS else []
    tried = [np.array([(a + b) / 2 for a, b in ends])[None], np.reshape(corners, (-1, len(ends)))]
    return np.concatenate([*tried, rng.uniform(box.low, box.high, (_FEW, len(ends)))])


def _labels(flow: Flow, grid: Array, states: Array, inside: Any, disturbances: Array) -> Mask:
    """Whether states at the grid's end come from the initial set, for some of the disturbances."""
    count, tried = len(states), len(disturbances)
    both = np.tile(states, (tried, 1)), np.repeat(disturbances, count, axis=0)
    *_, (_, _, back) = noise_free_states(flow, grid[::-1], *both, strict=False)
    found = np.asarray(inside(back), dtype=bool)  # a state that is lost on the way back is in no set
    return np.asarray(found.reshape(tried, count).any(axis=0))


def _learn(
    flow: Flow, grid: Array, positive: Array, inside: Any, rng: np.random.Generator, points: int
) -> Any:
    """A classifier of the states at the grid's end: a function from states (M, n) to probabilities (M,)."""
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    build = _classifier()
    # coordinates in which the reached states are round: a thin slanted set is as easy as a ball
    middle = positive.mean(axis=0)
    spread = np.cov(positive, rowvar=False).reshape(len(middle), len(middle))
    spread = spread + 1e-12 * (np.trace(spread) + 1e-300) * np.eye(len(middle))
    factor = np.linalg.cholesky(spread)

    def whitened(x: ArrayLike) -> Array:
        return np.asarray(np.linalg.solve(factor, (np.asarray(x, dtype=float) - middle).T).T)

    reach = np.abs(whitened(positive)).max(axis=0) * (1 + _MARGIN)
    disturbances = _disturbances(flow, rng)

    def asked(z: Array) -> Mask:
        return _labels(flow, grid, middle + z @ factor.T, inside, disturbances)

    own = whitened(positive[: points // 4])
    z = np.concatenate([own, rng.uniform(-reach, reach, (points // 4, len(middle)))])
    known = np.concatenate([np.ones(len(own), dtype=bool), asked(z[len(own) :])])
    kernel = ConstantKernel(_HEIGHT, "fixed") * RBF(_LENGTH, "fixed")
    model = None
    while not known.all() and (model is None or len(z) < points):
        model = build(kernel=kernel, optimizer=None).fit(z, known)
        pool = rng.uniform(-reach, reach, (_POOL, len(middle)))
        doubt = np.abs(model.predict_proba(pool)[:, 1] - 0.5)
        more = pool[np.argsort(doubt)[: min(_ASKED, max(points - len(z), 1))]]
        z, known = np.concatenate([z, more]), np.concatenate([known, asked(more)])

    def score(x: ArrayLike) -> Array:
        where = whitened(x)
        # without a model nothing around the samples is unreachable
        found = np.ones(len(where)) if model is None else np.asarray(model.predict_proba(where)[:, 1])
        near: Mask = (np.abs(where) <= reach).all(axis=1)
        return np.asarray(np.where(near, found, 0.0), dtype=float)

    return score
