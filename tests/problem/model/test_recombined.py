"""Models in logarithms of a state, however deep their expressions are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.problem.model import compile_numpy
from certbound.problem.model.recombined import in_logarithms

_TERMS = 2000  # nested more deeply than Python calls functions


def long_sum(x: Any) -> list[Any]:
    """x times a sum of sines, and what x does not divide."""
    total = x[0] * np.sin(x[0])
    for k in range(1, _TERMS):
        total = total + x[0] * np.sin(x[0] + k) if k % 7 else total - np.cos(x[0] + k)
    return [total]


def long_product(x: Any) -> list[Any]:
    """x times many cosines near one."""
    total = x[0]
    for k in range(_TERMS):
        total = total * np.cos(1e-3 * x[0] * (k % 10))
    return [total - x[0]]


def long_chain(x: Any) -> list[Any]:
    """Signs, quotients and constant factors in turn."""
    total = x[0] + np.sin(x[0])
    for k in range(_TERMS // 4):
        total = 1.001 * -(total / (1 + 1e-3 * x[0] * x[0]) - 0.1 * x[0]) + (k % 3)
    return [total]


@pytest.mark.parametrize("rates", [long_sum, long_product, long_chain])
def test_a_deep_expression_is_divided_by_its_state(rates: Callable[[Any], list[Any]]) -> None:
    """dy = (f/x - .1^2/2) dt + .1 dW at x = exp(y)."""
    system = cb.ContinuousSystem(rates, states=1, diffusion=lambda x: [[0.1 * x[0]]])
    found = in_logarithms(system.dynamics, system.diffusion, [0])
    assert found is not None
    places, dynamics, diffusion = found
    assert places == (0,)
    for x in (0.3, 1.0, 2.5):
        y = np.array(np.log(x))
        expected = rates(np.array([x]))[0] / x - 0.1**2 / 2
        assert compile_numpy(dynamics)(0.0, y).item() == pytest.approx(expected, rel=1e-9, abs=1e-9)
        assert compile_numpy(diffusion)(0.0, y).item() == pytest.approx(0.1)
