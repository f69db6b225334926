"""Barriers proved from the file alone: what holds is proved, what does not is refused."""

from __future__ import annotations

import itertools
import json
import math
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data
from certbound.checker.expressions import ceiling
from certbound.errors import CertificateError
from certbound.safety.answers import exact
from certbound.safety.certificate import problem_data


def by_hand(
    problem: cb.Problem, theta: float, growth: float, start: float, boundary: float, inflow: float | None = None
) -> dict[str, Any]:
    """A certificate with V = theta |x|^2."""
    n = problem.system.dimension
    claimed = (start - boundary + max(growth, 0.0) * problem.horizon) / math.log(10)
    if inflow is not None:
        claimed = math.log10(math.exp(start - boundary) + inflow * problem.horizon)
    return json.loads(json.dumps({
        "format": "certbound certificate", "version": 1,
        "claim": {"log10_delta": exact(min(claimed, 0.0) * (1 - 1e-9)), "method": "barrier", "assumptions": []},
        "problem": problem_data(problem),
        "proof": {
            "engine": "barrier", "center": exact(np.zeros(n)), "scale": exact(np.ones(n)),
            "exponents": (2 * np.eye(n, dtype=int)).tolist(), "coefficients": exact(np.full(n, theta)),
            "growth": exact(growth), "start": exact(start), "boundary": exact(boundary),
            **({} if inflow is None else {"inflow": exact(inflow)}),
        },
    }))  # fmt: skip


def kinked(**changes: Any) -> cb.Problem:
    """dx = -(x + |x| x) dt + .3 dW in [-1, 1]: for V = 8 x^2 the growth is at most .72, at x = 0."""
    system = cb.ContinuousSystem(lambda x: [-x[0] - np.abs(x[0]) * x[0]], states=1, diffusion=[[0.3]])
    given = {"initial": cb.Box([-0.1], [0.1]), "safe": [cb.Inside(cb.Box([-1], [1]))], "horizon": 1.0}
    return cb.Problem(system, **{**given, **changes})


def test_a_barrier_made_by_hand_is_proved_and_its_numbers_are_sharp() -> None:
    problem = kinked()
    report = check_data(by_hand(problem, 8.0, 0.72 + 1e-6, 0.08 + 1e-9, 8.0 - 1e-9))
    assert report.valid, report.reason
    assert report.log10_proved == pytest.approx((0.08 - 8 + 0.72) / math.log(10), abs=1e-5)
    for growth, start, boundary, why in [
        (0.7199, 0.0801, 7.999, "grow as slowly"), (0.7201, 0.0799, 7.999, "on the initial set"),
        (0.7201, 0.0801, 8.001, "where a constraint breaks"),
    ]:  # fmt: skip
        refused = check_data(by_hand(problem, 8.0, growth, start, boundary))
        assert not refused.valid
        assert why in refused.reason


def test_an_inflow_made_by_hand_is_proved_and_sharp() -> None:
    """exp(8 x^2 - 8) changes at most at the rate 2.419e-4, at |x| = .0491."""
    problem = kinked(horizon=30.0)
    report = check_data(by_hand(problem, 8.0, 0.0, 0.08 + 1e-9, 8.0 - 1e-9, 2.4196e-4))
    assert report.valid, report.reason
    assert 10**report.log10_proved == pytest.approx(math.exp(-7.92) + 30 * 2.4196e-4, rel=1e-6)
    refused = check_data(by_hand(problem, 8.0, 0.0, 0.08 + 1e-9, 8.0 - 1e-9, 2.4180e-4))
    assert not refused.valid
    assert "grow as slowly" in refused.reason


def test_where_the_generator_is_negative_its_exponential_is_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """Around a cycle, V = 12 (|x|^2 - 1)^2 - 6.75: exp(V) times a rough range of what is far below 0 is huge."""
    monkeypatch.setattr(ceiling, "_MOST_BOXES", 8000)
    system = cb.ContinuousSystem(
        lambda x: [x[1] + x[0] * (1 - x[0] ** 2 - x[1] ** 2), -x[0] + x[1] * (1 - x[0] ** 2 - x[1] ** 2)], states=2,
        diffusion=0.15 * np.eye(2),
    )  # fmt: skip
    safe = [cb.Inside(cb.Ball([0, 0], 1.5)), cb.Outside(cb.Ball([0, 0], 0.5))]
    data = by_hand(cb.Problem(system, initial=[1.0, 0.0], safe=safe, horizon=2), 0.0, 0.0, -6.75 + 1e-6, -1.0, 0.08)
    data["proof"]["exponents"] = [[2, 0], [0, 2], [4, 0], [2, 2], [0, 4], [0, 0]]
    data["proof"]["coefficients"] = exact([-24.0, -24.0, 12.0, 24.0, 12.0, 5.25])
    report = check_data(data)
    assert report.valid, report.reason


@pytest.mark.parametrize("obstacle", [
    cb.Box([0.5, 0.4], [0.7, 0.8]), cb.Polytope([[-1, 0], [0, -1], [1, 1]], [-0.5, -0.4, 1.5]),
])  # fmt: skip
def test_faces_of_an_obstacle_end_and_v_may_be_low_on_what_goes_on_beyond(obstacle: cb.Box | cb.Polytope) -> None:
    """V = 8 |x|^2 is 3.28 at the nearest corner, and 2 or 1.28 on the lines through it."""
    system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=0.3 * np.eye(2))
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1])), cb.Outside(obstacle)]
    problem = cb.Problem(system, initial=cb.Box([-0.1, -0.1], [0.1, 0.1]), safe=safe, horizon=0.5)
    report = check_data(by_hand(problem, 8.0, 1.441, 0.161, 3.279))
    assert report.valid, report.reason
    refused = check_data(by_hand(problem, 8.0, 1.441, 0.161, 3.281))
    assert not refused.valid
    assert "where a constraint breaks" in refused.reason


def test_three_states_a_ball_an_obstacle_and_noise_that_depends_on_the_state() -> None:
    """V = 12 |x|^2 in the unit ball with a face cut off, beside a ball: the least of V on the boundary is decided."""
    system = cb.ContinuousSystem(
        lambda x, d: [-x[0] + 0.1 * d[0] + 0.2 * x[1], -x[1] - 0.2 * x[0], -x[2]], states=3,
        disturbance=cb.Box([-1], [1]),
        diffusion=lambda t, x: np.array([[0.2 * np.cos(x[1]), 0, 0], [0, 0.2, 0], [0, 0, 0.2 + 0 * t]]),
    )  # fmt: skip
    safe = [
        cb.Inside(cb.Ball([0, 0, 0], 1.0)), cb.Inside(cb.HalfSpace([3, 0, 4], 4.5)),
        cb.Outside(cb.Ball([1.0, 1.0, 0.0], 0.5)),
    ]
    problem = cb.Problem(system, initial=cb.Ball([0, 0, 0], 0.1), safe=safe, horizon=0.5, delta=0.05)
    nearest = min(0.9, math.sqrt(2) - 0.5, 1.0) ** 2  # the face is the nearest: 4.5/5
    assert nearest == pytest.approx(0.81)
    good = by_hand(problem, 12.0, 1.7, 12 * 0.0301, 12 * (nearest - 0.01))
    report = check_data(good)
    assert report.valid, report.reason
    assert not check_data(by_hand(problem, 12.0, 1.7, 12 * 0.0301, 12 * (nearest + 0.001))).valid
    assert not check_data(by_hand(problem, 12.0, 1.7, 12 * 0.0299, 12 * (nearest - 0.01))).valid
    assert not check_data(by_hand(problem, 12.0, 1.4, 12 * 0.0301, 12 * (nearest - 0.01))).valid


@pytest.mark.parametrize(
    ("problem", "why"),
    [
        (kinked(safe=[cb.Inside(cb.Box([-1], [1]), during=(0.0, 0.5))]), "window"),
        (kinked(safe=[cb.Inside(cb.Ball(lambda t: [0.1 * t], 1.0))]), "moves"),
        (kinked(safe=[cb.Inside(cb.HalfSpace([1.0], 1.0))]), "bounds "),
        (kinked(initial=cb.GaussianStart([0.0], [[0.01]])), "bounded initial set"),
        (cb.load("chain"), "discrete time"),
    ],
)
def test_what_a_barrier_cannot_prove_is_refused(problem: cb.Problem, why: str) -> None:
    report = check_data(by_hand(problem, 8.0, 0.73, 0.09, 7.99))
    assert not report.valid
    assert why in report.reason


@pytest.mark.parametrize("ends", [([0.9], [1.0000001]), ([-1.5], [1.5]), ([2.0], [2.1])])
def test_the_initial_set_must_lie_in_the_safe_set(ends: Any) -> None:
    data = by_hand(kinked(), 0.0, 0.0, 0.0, 10.0)
    data["problem"]["initial"] = {"kind": "box", "low": exact(ends[0]), "high": exact(ends[1])}
    report = check_data(data)
    assert not report.valid
    assert "initial set" in report.reason


def test_the_growth_is_asked_everywhere_in_the_safe_set() -> None:
    """Between the hull's corners and a slanted face nothing is asked; on the face itself it is."""
    system = cb.ContinuousSystem(lambda x: [x[0] ** 7, -x[1]], states=2, diffusion=0.2 * np.eye(2))
    start = cb.Box([-0.1, -0.1], [0.1, 0.1])

    def problem(bound: float) -> cb.Problem:
        safe = [cb.Inside(cb.Box([-0.5, -0.5], [1, 1])), cb.Inside(cb.Polytope([[1, 1], [1, -1]], [bound, bound]))]
        return cb.Problem(system, initial=start, safe=safe, horizon=0.2, delta=0.5)

    # V = 4 |x|^2: growth 8 (x1^8 - x2^2) + .32 + 1.28 |x|^2 is largest at (bound, 0)
    def growth(x: float) -> float:
        return 8 * x**8 + 0.32 + 1.28 * x * x

    for bound in (0.5, 0.8):
        boundary = min(2 * bound**2, 1.0) - 0.01
        assert check_data(by_hand(problem(bound), 4.0, growth(bound) + 1e-3, 0.081, boundary)).valid
        assert not check_data(by_hand(problem(bound), 4.0, growth(bound) - 1e-3, 0.081, boundary)).valid


def test_dynamics_that_is_undefined_or_jumps_in_the_safe_set_is_not_proved_over() -> None:
    for rate in (lambda x: [-x[0] + 1e-9 * np.log(x[0] + 0.5)], lambda x: [-x[0] + np.where(x[0] > 0.3, 2.0, 0.0)]):
        system = cb.ContinuousSystem(rate, states=1, diffusion=[[0.3]])
        problem = cb.Problem(
            system, initial=cb.Box([-0.1], [0.1]), safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1.0
        )
        report = check_data(by_hand(problem, 8.0, 2.0, 0.09, 7.9))
        assert not report.valid
        assert "grow as slowly" in report.reason


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"scale": exact([0.0])}, "scale"), ({"scale": exact([-1.0])}, "scale"), ({"exponents": [[2], [2]]}, "differ"),
        ({"exponents": [[2, 0]]}, "one a state"), ({"exponents": [[-1]]}, "0..12"), ({"exponents": [[99]]}, "0..12"),
        ({"coefficients": exact([1.0, 2.0])}, "1 entries"), ({"growth": None}, "hexadecimal"), ({"x": 1}, "unknown"),
        ({"inflow": exact(0.1)}, "must be 0 beside"), ({"inflow": exact(-0.1)}, "at least 0"),
    ],
)  # fmt: skip
def test_malformed_barriers_are_refused(change: dict[str, Any], why: str) -> None:
    data = by_hand(kinked(), 8.0, 0.73, 0.09, 7.99)
    data["proof"] |= change
    with pytest.raises(CertificateError, match=why):
        check_data(data)


def test_a_negative_growth_gains_nothing() -> None:
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=np.zeros((2, 1)))
    safe = [cb.Inside(cb.Box([1, -1], [2, 1]))]
    problem = cb.Problem(system, initial=cb.Box([1.5, 0], [1.6, 0]), safe=safe, horizon=100.0)
    report = check_data(by_hand(problem, 1.0, -2.0, 2.57, 1.0))  # V falls along every path
    assert not report.valid
    assert "more than the claimed" in report.reason or report.log10_proved is None or report.log10_proved >= 0


def test_every_corner_of_time_and_disturbance_counts() -> None:
    system = cb.ContinuousSystem(
        lambda t, x, d: [-x[0] + (1 + t) * d[0] * d[1]], states=1, disturbance=cb.Box([-1, -0.1], [1, 0.1]),
        diffusion=[[0.3]],
    )  # fmt: skip
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1.0)
    points = itertools.product(np.linspace(-1, 1, 401), (-0.2, 0.2))
    truth = max(16 * x * (-x + push) + 0.72 + 11.52 * x * x for x, push in points)
    assert check_data(by_hand(problem, 8.0, truth + 1e-3, 1e-9, 7.999)).valid
    assert not check_data(by_hand(problem, 8.0, truth - 1e-3, 1e-9, 7.999)).valid
