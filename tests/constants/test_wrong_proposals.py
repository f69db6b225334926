"""Proposals that are wrong on purpose: what is printed as certified holds all the same, in exact arithmetic."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import eigh

import certbound as cb
from certbound.constants import metrics
from certbound.constants.programs import ErosionSearch

Array = NDArray[np.float64]

SPREAD = np.array([1.0, 1e6])
WRONG: dict[str, Callable[[Array], Array]] = {
    "ten per cent off": lambda p: p * (1 + 0.1 * np.array([[1.0, -1.0], [-1.0, 1.0]])),
    "indefinite": lambda p: p - 2 * np.linalg.eigvalsh(p)[0] * np.eye(2),
    "singular": lambda p: np.outer([1.0, 0.1], [1.0, 0.1]),
    "nearly singular": lambda p: np.outer([1.0, 0.1], [1.0, 0.1]) + 1e-15 * np.eye(2),
    "in units 1e6 apart": lambda p: p * np.outer(SPREAD, SPREAD),
    "times 1e12": lambda p: 1e12 * p,
    "beyond floats": lambda p: 1e305 * p,
    "not symmetric": lambda p: p + np.array([[0.0, 0.5], [0.0, 0.0]]),
    "no numbers": lambda p: p * np.nan,
}


def rate(x: Any) -> list[Any]:
    return [-x[0] + 2 * np.tanh(x[1]), -1.5 * x[1] + 0.3 * np.sin(x[0])]


def slopes() -> list[Array]:
    angle, bend = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(0, 1, 5))
    return [np.array([[-1.0, 2 * b], [0.3 * a, -1.5]]) for a, b in zip(angle.ravel(), bend.ravel())]


def problem(*, continuous: bool) -> cb.Problem:
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    if continuous:
        system: Any = cb.ContinuousSystem(rate, states=2, diffusion=0.02 * np.eye(2))
    else:
        system = cb.DiscreteSystem(
            lambda x: [x[i] + 0.1 * r for i, r in enumerate(rate(x))], states=2, noise=cb.Gaussian(std=0.005)
        )
    return cb.Problem(system, initial=[0.2, 0.1], safe=safe, horizon=2 if continuous else 20, delta=1e-2)


@functools.cache
def without_a_metric(*, continuous: bool) -> cb.Constants:
    return cb.bound_constants(problem(continuous=continuous), metric="euclidean")


def spoil(monkeypatch: pytest.MonkeyPatch, wrong: Callable[[Array], Array]) -> list[Array]:
    """Make every program propose a wrong metric; the list gathers them."""
    made: list[Array] = []

    def spoilt(found: list[Any]) -> list[Any]:
        with np.errstate(all="ignore"):
            result = [replace(one, metric=wrong(np.asarray(one.metric))) for one in found]
        made.extend(one.metric for one in result)
        return result

    rates, erosions = metrics.rate_proposals, ErosionSearch.proposals
    monkeypatch.setattr(metrics, "rate_proposals", lambda *a, **k: spoilt(rates(*a, **{**k, "wanted": np.inf})))
    monkeypatch.setattr(ErosionSearch, "proposals", lambda self, *a, **k: spoilt(erosions(self, *a, **k)))
    return made


def exceeds(constants: Any, slope: Array) -> bool:
    """Whether some direction shows, by fractions, that a rate or gain does not hold at a slope."""
    p = np.eye(2) if constants.metric is None else np.asarray(constants.metric)
    whole = p @ slope + slope.T @ p if constants.continuous else slope.T @ p @ slope
    _, vectors = eigh((whole + whole.T) / 2, p)
    bound = Fraction(float(np.max(constants.rate if constants.continuous else constants.gain)))
    exact = [[Fraction(float(entry)) for entry in row] for row in p]
    for x in vectors.T:
        x = [Fraction(float(entry)) for entry in x]
        moved = [sum(Fraction(float(a)) * b for a, b in zip(row, x)) for row in slope]
        left, right = (x, moved) if constants.continuous else (moved, moved)
        size = sum(exact[i][j] * left[i] * right[j] for i in range(2) for j in range(2))
        own = sum(exact[i][j] * x[i] * x[j] for i in range(2) for j in range(2))
        if own <= 0 or size > ((bound if constants.continuous else bound**2) + Fraction(1, 10**12)) * own:
            return True
    return False


@pytest.mark.parametrize("objective", ["rate", pytest.param("erosion", marks=pytest.mark.slow)])
@pytest.mark.parametrize("continuous", [True, False])
@pytest.mark.parametrize("name", WRONG)
def test_constants_from_a_wrong_metric_hold(
    name: str, continuous: bool, objective: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = spoil(monkeypatch, WRONG[name])
    subject = problem(continuous=continuous)
    plain = without_a_metric(continuous=continuous)
    constants = cb.bound_constants(subject, objective=objective)
    assert made
    assert constants.certified
    assert np.isfinite(constants.worst_slope)
    assert objective == "erosion" or constants.worst_slope <= plain.worst_slope
    slopes_ = slopes() if continuous else [np.eye(2) + 0.1 * slope for slope in slopes()]
    assert not any(exceeds(constants, slope) for slope in slopes_)
    if not np.all(np.isfinite(made[0])) or np.linalg.eigvalsh((made[0] + made[0].T) / 2)[0] < -1e-9:
        assert all(constants.metric is None or not np.array_equal(constants.metric, metric) for metric in made)


def test_the_fractions_notice_a_rate_that_is_too_small() -> None:
    constants: Any = cb.bound_constants(problem(continuous=True))
    assert not any(exceeds(constants, slope) for slope in slopes())
    forged = replace(constants, rate=float(constants.rate) - 0.05)
    assert any(exceeds(forged, slope) for slope in slopes())


@pytest.mark.parametrize("name", ["indefinite", "in units 1e6 apart", "beyond floats", "no numbers"])
def test_a_verdict_with_wrong_metrics_is_an_answer(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    spoil(monkeypatch, WRONG[name])
    verdict = cb.verify_safety(problem(continuous=True), method="constants")
    assert verdict.status in ("SAFE", "UNKNOWN")
    assert verdict.constants is None or verdict.constants.certified
