"""Disturbances that see coming noise: they break bounds that say so, and no others."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.safety.verification import verify_safety

BLIND = "It holds for every disturbance in its set that does not see coming noise."
ANY = "It holds for every disturbance in its set, even one that sees coming noise."


def test_foresight_breaks_what_the_constants_certify_and_the_verdict_says_so() -> None:
    """X+ = d X + w with |d| <= .95: a d that sees w turns every step outwards, and the mean grows to 16."""
    system = cb.DiscreteSystem(
        lambda x, d: [d[0] * x[0]], states=1, disturbance=cb.Box([-0.95], [0.95]), noise=cb.Gaussian(std=1.0)
    )
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-13.5], [13.5]))], horizon=60, delta=1e-2)
    verdict = verify_safety(problem, method="constants")
    assert verdict.status == "SAFE"
    assert BLIND in verdict.reason
    noise = np.random.default_rng(1).normal(size=(4000, 60))
    x, out = np.zeros((2, 4000)), np.zeros((2, 4000), dtype=bool)  # with foresight, and without
    for w in noise.T:
        d = 0.95 * np.array([np.where(x[0] * w < 0, -1.0, 1.0), np.ones(4000)])
        x = d * x + w
        out |= np.abs(x) > 13.5
    seeing, blind = out.mean(axis=1)
    assert seeing > 0.9
    assert blind < 10**verdict.log10_delta


def test_foresight_does_not_break_the_linear_response_with_additive_noise() -> None:
    system = cb.DiscreteSystem(
        lambda x, d: [0.5 * x[0] + 0.1 * d[0] * np.cos(x[0])], states=1, disturbance=cb.Box([-1], [1]),
        noise=cb.Gaussian(std=0.1),
    )  # fmt: skip
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-0.5], [0.5]))], horizon=10, delta=0.2)
    verdict = verify_safety(problem, method="linear")
    assert verdict.status == "SAFE"
    assert ANY in verdict.reason
    x, out = np.zeros(20_000), np.zeros(20_000, dtype=bool)
    for w in np.random.default_rng(2).normal(scale=0.1, size=(10, 20_000)):
        x = 0.5 * x + 0.1 * np.sign(0.5 * x + w) * np.cos(x) + w
        out |= np.abs(x) > 0.5
    assert 0.01 < out.mean() < 10**verdict.log10_delta


def test_foresight_breaks_the_linear_response_where_the_noise_depends_on_the_state() -> None:
    """dx = y dW, y' = 20 (d - y), |d| <= 1: a d that sees W lets y follow the noise to come."""
    system = cb.ContinuousSystem(
        lambda x, d: [0 * x[0], 20 * (d[0] - x[1])], states=2, disturbance=cb.Box([-1], [1]),
        diffusion=lambda t, x: [[x[1]], [0.0]],
    )  # fmt: skip
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.HalfSpace([1, 0], 6.0))], horizon=2.0, delta=2e-2)
    verdict = verify_safety(problem, method="linear")
    assert verdict.status == "SAFE"
    assert BLIND in verdict.reason
    steps, paths = 1000, 2000
    h, decay = 2.0 / steps, np.exp(-20 * 2.0 / steps)
    noise = np.random.default_rng(3).normal(scale=np.sqrt(h), size=(steps, paths))
    coming = np.zeros((steps + 1, paths))
    for k in reversed(range(steps)):
        coming[k] = decay * coming[k + 1] + noise[k]
    x, y, top = np.zeros(paths), np.zeros(paths), np.zeros(paths)
    for k in range(steps):
        x = x + y * noise[k]
        y = decay * y + (1 - decay) * np.sign(coming[k + 1])
        top = np.maximum(top, x)
    assert np.mean(top > 6.0) > 4 * 10**verdict.log10_delta


def test_the_barrier_names_its_disturbances_and_a_problem_without_any_names_none() -> None:
    system = cb.ContinuousSystem(
        lambda x, d: [-x[0] - x[0] ** 3 + 0.01 * d[0]], states=["x"], disturbance=cb.Box([-1], [1]), diffusion=[[0.3]]
    )
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=0.5, delta=5e-2)
    assert BLIND in verify_safety(problem, method="barrier").reason
    free = cb.ContinuousSystem(lambda x: [-x[0] - x[0] ** 3], states=["x"], diffusion=[[0.3]])
    assert "disturbance" not in verify_safety(problem.replace(system=free), method="barrier").reason


# ---- stated constants --------------------------------------------------------------------------------------------


def noisy(**options: object) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=0.1 * np.eye(2))
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    return cb.Problem(system, **{"initial": [0, 0], "safe": safe, "horizon": 2.0, "delta": 1e-2, **options})


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"sigma": 0.05}, r"`constants.sigma` must be at least 0.1, .* got 0.05"),
        ({"sigma": 0.1, "metric": [[4.0, 0.0], [0.0, 1.0]]}, r"`constants.sigma` must be at least 0.2, .* got 0.1"),
        ({"sigma": 0.1, "effective_dimension": 1.0}, "`constants.effective_dimension` must be at least 2"),
        ({"sigma": 0.2, "isotropic": True}, "isotropic"),
        ({"sigma": 0.1, "rate": -2.0}, r"`constants.rate` must be at least -1, .* got -2.0"),
        ({"sigma": 0.1, "dimension": 3}, "must have dimension 2, got 3"),
    ],
)
def test_stated_constants_that_the_problem_contradicts_are_refused(changes: dict[str, object], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        verify_safety(noisy(), method="constants", constants=cb.Constants(**{"rate": -1.0, "dimension": 2, **changes}))


def test_stated_constants_that_agree_are_assumed() -> None:
    for metric, sigma in ((None, 0.1), ([[4.0, 0.0], [0.0, 1.0]], 0.2)):
        stated = cb.Constants(rate=-1.0, sigma=sigma, dimension=2, metric=metric)
        verdict = verify_safety(noisy(), method="constants", constants=stated)
        assert "assumed, not proved" in verdict.reason


def test_noise_that_is_not_gaussian_is_not_stated_to_be() -> None:
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=1, noise=cb.Uniform(halfwidth=0.1))
    problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3)
    with pytest.raises(ValueError, match="assert Gaussian noise"):
        verify_safety(
            problem, method="constants", constants=cb.Constants(gain=0.5, sigma=0.1, dimension=1, gaussian=True)
        )
    with pytest.raises(ValueError, match=r"`constants.gain` must be at least 0.5"):
        verify_safety(problem, method="constants", constants=cb.Constants(gain=0.4, sigma=0.1, dimension=1))
