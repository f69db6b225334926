"""Certificates of random starts by the linear response: their deviation is as wide at the start as anywhere."""

from __future__ import annotations

from typing import Any

import numpy as np

import certbound as cb
from certbound.checker import check_data
from certbound.safety.certificate import certificate_data


def checked(problem: cb.Problem) -> tuple[bool, str]:
    report = check_data(certificate_data(problem, cb.verify_safety(problem, method="linear")))
    return report.valid, report.reason


def test_rows_over_further_states_cut_what_a_remainder_is_bounded_over() -> None:
    def move(x: Any) -> Any:
        return [x[0] + 0.1 * (x[1] - x[0]), x[1] + 0.3 * x[0] * (1 - x[2]), x[2] + 0.3 * x[0] * x[1] - 0.03 * x[2]]

    system = cb.DiscreteSystem(move, states=3, noise=cb.Gaussian(std=1e-3))
    start = cb.GaussianStart([0.1, 0.1, 1.0], 1e-2 * np.array([[1, -0.5, -0.3], [-0.5, 1.25, 0.1], [-0.3, 0.1, 1.1]]))
    safe = [cb.Inside(cb.HalfSpace([0.0, 0.0, 1.0], 2.0))]
    valid, reason = checked(cb.Problem(system, initial=start, safe=safe, horizon=3, delta=1e-2))
    assert valid, reason


def test_a_singular_start_leaves_levels_where_it_has_no_variance() -> None:
    system = cb.DiscreteSystem(
        lambda x: [0.9 * x[0] + 0.1 * np.sin(x[1]), 0.8 * x[1] - 0.1 * x[0] * x[1]], states=2,
        noise=cb.Gaussian(std=0.02),
    )
    start = cb.GaussianStart([0.2, 0.1], 0.01 * np.ones((2, 2)))
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    valid, reason = checked(cb.Problem(system, initial=start, safe=safe, horizon=3, delta=1e-3))
    assert valid, reason
