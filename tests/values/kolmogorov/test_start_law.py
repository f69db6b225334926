"""Normal starts: the mean of v over them is bounded from both sides, and so is the probability of failing."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.values.kolmogorov import bound_failing, start_law
from certbound.values.kolmogorov.box_setting import stages_of
from certbound.values.kolmogorov.door import refined, side_of, starts_in
from certbound.values.kolmogorov.splines import Axis, Sampling
from certbound.values.kolmogorov.start_law import StartMean, directions_of
from certbound.values.room import limits_of

COVARIANCES = {
    "independent": np.diag([0.04, 0.09]),
    "correlated": np.array([[0.04, 0.05], [0.05, 0.09]]),
    "singular": np.array([[0.04, 0.06], [0.06, 0.09]]),
    "along one coordinate": np.diag([0.04, 0.0]),
}


def hermite(start: cb.GaussianStart, function: object, count: int = 400) -> float:
    """The mean of a function by sums over a fine grid in two standard normal directions."""
    z = np.linspace(-8, 8, count)
    weights = np.exp(-(z**2) / 2) / np.exp(-(z**2) / 2).sum()
    values, vectors = np.linalg.eigh(start.covariance)
    factor = vectors * np.sqrt(np.maximum(values, 0))
    points = start.mean + np.stack([row.ravel() for row in np.meshgrid(z, z, indexing="ij")], axis=1) @ factor.T
    return float(np.outer(weights, weights).ravel() @ function(points))


@pytest.mark.parametrize("limited", [True, False])
@pytest.mark.parametrize("kind", COVARIANCES)
def test_the_mean_of_a_spline_lies_between_its_bounds(kind: str, limited: bool) -> None:
    start = cb.GaussianStart([0.1, 0.2], COVARIANCES[kind])
    axes = tuple(Axis(np.linspace(-1, 1, 17), Sampling(4)) for _ in range(2))
    x, y = np.meshgrid(*(axis.nodes for axis in axes), indexing="ij")
    first, second = (axis.from_nodes() for axis in axes)
    coefficients = first @ (0.9 * np.exp(-3 * ((x - 0.5) ** 2 + (y + 0.2) ** 2)) - 0.02) @ second.T

    def value(points: np.ndarray, beyond: float, at_least: float) -> np.ndarray:
        inside = np.all(np.abs(points) <= 1, axis=1)
        v = 0.9 * np.exp(-3 * ((points[:, 0] - 0.5) ** 2 + (points[:, 1] + 0.2) ** 2)) - 0.02
        return np.where(inside, np.maximum(v, at_least), beyond)

    mean, limits = StartMean(start), np.full((2, 2), limited)
    for above in (True, False):
        side = SimpleNamespace(
            axes=axes, values=[coefficients if above else -coefficients], above=above,
            setting=SimpleNamespace(limited=limits),
        )  # fmt: skip
        rough, bound = mean.bound(side)
        truth = hermite(start, lambda points, one=above: value(points, 1.0 if one or limited else 0.0, 0.0))
        if above:
            assert truth * (1 - 3e-3) <= bound <= truth * 1.01
            assert rough == pytest.approx(bound, rel=0.01)
        else:
            assert 0.98 * truth <= -bound <= truth * (1 + 3e-3)
            assert rough == pytest.approx(bound, rel=0.06)


def test_the_rest_of_a_singular_covariance_is_small_and_a_hopeless_one_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = directions_of(cb.GaussianStart([0, 0], COVARIANCES["singular"]))
    assert found.gains.shape == (2, 1)
    assert found.slack.max() < 1e-6
    assert found.under <= 1 <= found.over
    monkeypatch.setattr(start_law, "_SINGULAR", 1e-15)
    nearly = np.array([[1.0, 1 - 1e-13], [1 - 1e-13, 1.0]])
    with pytest.raises(InfeasibleError, match="badly conditioned"):
        directions_of(cb.GaussianStart([0, 0], nearly))


def test_cells_of_a_start_beyond_one_limit_count_as_failing_from_below_and_beyond_other_ends_do_not() -> None:
    start = cb.GaussianStart([0.0, 0.0], np.diag([1.0, 1.0]))
    axes = tuple(Axis(np.linspace(-1, 1, 9), Sampling(4)) for _ in range(2))
    limited = np.array([[True, False], [True, False]])
    setting = SimpleNamespace(limited=limited)
    side = SimpleNamespace(axes=axes, values=[np.zeros((13, 13))], above=False, setting=setting)
    beyond = 0.31731050786291415  # P(|z| > 1)
    assert 0.95 * beyond < -StartMean(start).bound(side)[1] <= beyond


def two_apart(covariance: list[float]) -> tuple[cb.Problem, float]:
    """Two independent states from an independent normal start, and what fails."""
    from tests.values.kolmogorov.test_changes import survival

    system = cb.ContinuousSystem(lambda x, y: [-x, -y], states=["x", "y"], diffusion=0.5 * np.eye(2))
    x = np.linspace(-1, 1, 401)
    kept = 1.0
    for mean, variance in zip((0.2, -0.1), covariance):
        weights = np.exp(-((x - mean) ** 2) / (2 * variance)) / np.sqrt(2 * np.pi * variance) * (x[1] - x[0])
        kept *= float(weights @ survival(lambda t, x: -x))
    start = cb.GaussianStart([0.2, -0.1], np.diag(covariance))
    return cb.Problem(system, initial=start, safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=2.0), 1 - kept


@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize("wrong", [False, True])
def test_a_random_start_fails_as_often_as_the_bounds_say_whatever_is_proposed(above: bool, wrong: bool) -> None:
    asked, truth = two_apart([0.04, 0.09])
    side = side_of([stages_of(asked)[0]], 0.06, 30, above)
    side.propose()
    if wrong:
        rng = np.random.default_rng(0)
        side.values = [row + 0.05 * rng.normal(size=row.shape) for row in side.values]
    bound, _, _ = refined(side, starts_in(asked))
    if above:
        assert truth * 0.995 <= bound
        assert wrong or bound < 2 * truth
    else:
        assert -bound <= truth * 1.005
        assert wrong or bound < 0.05


def test_a_normal_start_without_variance_is_its_mean() -> None:
    asked, _ = two_apart([0.04, 0.09])
    sure = asked.replace(initial=cb.GaussianStart([0.2, -0.1], np.zeros((2, 2))))
    starts = starts_in(sure)
    assert not starts.means
    assert np.array_equal(starts.low, [[0.2, -0.1]])


def test_one_state_is_refused_before_its_start_is_looked_at() -> None:
    """A normal start beside an obstacle has no box around it, of which side it is on."""
    system = cb.ContinuousSystem(lambda x: [-x[0]], states=1, diffusion=[[0.1]])
    post = cb.Outside(cb.Box([1.0], [1.5]))
    problem = cb.Problem(system, initial=cb.GaussianStart([0.0], [[0.01]]), safe=[post], horizon=1.0)
    with pytest.raises(InfeasibleError, match="serve two and three states"):
        next(iter(bound_failing(problem)))
    with pytest.raises(InfeasibleError, match="random start lies on both sides of"):
        limits_of(problem)
