"""Small problems that plan in a moment."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb

A = np.array([[1.0, 0.1], [0.0, 1.0]])
B = np.array([[0.0], [0.1]])


def cart(**changes: Any) -> cb.Problem:
    """A double integrator that comes to rest at the origin, its speed bounded."""
    std = changes.pop("std", 0.01)
    inputs = changes.pop("inputs", cb.Box([-3], [3]))
    system = cb.linear_system(A, B, inputs=inputs, noise=cb.Gaussian(std=std))
    options: dict[str, Any] = {
        "initial": [1.0, 0.0], "safe": [cb.Inside(cb.Box([-0.5, -0.8], [1.5, 0.8]))], "horizon": 20, "delta": 1e-3,
        "cost": ([1, 1], [0.01]), "name": "cart",
    }  # fmt: skip
    return cb.Problem(system, **(options | changes))


@pytest.fixture(scope="session")
def problem() -> cb.Problem:
    return cart()


@pytest.fixture(scope="session")
def planned(problem: cb.Problem) -> Any:
    """The cart's plan on the linear response."""
    return cb.synthesize_plan(problem, method="linear")
