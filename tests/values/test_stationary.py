"""Sums of Chebyshev polynomials that the rates rest on: within their error of the exact ones, and close."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from numpy.polynomial import Chebyshev

import certbound as cb
from certbound.values.continuous.line.stationary import leaving_rate, mean_time


def exactly(coefficients: list[Fraction], y: float) -> Fraction:
    place = Fraction(y)
    before, now, total = Fraction(1), place, coefficients[0]
    for value in coefficients[1:]:
        total += value * now
        before, now = now, 2 * place * now - before
    return total


@pytest.mark.parametrize("kind", ["even", "falling", "cancelling", "tiny", "one", "two"])
def test_sums_lie_within_their_error_of_the_exact_ones(kind: str) -> None:
    rng = np.random.default_rng(1)
    values = rng.standard_normal({"one": 1, "two": 2}.get(kind, 30))
    if kind == "falling":
        values *= 0.3 ** np.arange(30)
    if kind == "cancelling":  # all but nothing at 1
        values[0] -= values.sum()
    scale = 1e-310 if kind == "tiny" else 1.0
    given = [Fraction(value * scale) / 3 for value in values.tolist()]
    once = leaving_rate._derivative(given)
    for coefficients in (given, once, leaving_rate._derivative(once)):
        y = np.concatenate([np.arange(-7, 8, 2) / 8, [1 - 2.0**-14, -1 + 2.0**-14]])
        found, error = leaving_rate._summed(coefficients, y)
        exact = [exactly(coefficients, place) for place in y.tolist()]
        assert all(abs(Fraction(a) - b) <= Fraction(e) for a, b, e in zip(found.tolist(), exact, error.tolist()))
        assert np.all(error <= 1e-12 * float(sum(map(abs, coefficients))) + 1e-300)


def test_derivatives_are_the_exact_ones() -> None:
    given = [Fraction(k, 7) for k in (3, -2, 5, 1, -4)]
    once, h = leaving_rate._derivative(given), Fraction(1, 10**6)
    assert len(once) == 4
    assert leaving_rate._derivative(given[:1]) == [0]
    for y in (-0.75, 0.0, 0.5):
        middle = (exactly(given, y + float(h)) - exactly(given, y - float(h))) / (
            Fraction(y + float(h)) - Fraction(y - float(h))
        )
        assert abs(float(middle - exactly(once, y))) < 1e-9


def test_ranges_over_cells_hold_between_the_middles() -> None:
    """m, and L m = -x^3 m' + .08 m'', of a polynomial of degree 12 that is worked out anew at places in each cell."""
    problem = cb.Problem(
        cb.ContinuousSystem(lambda x: -(x**3), states=1, diffusion=0.4),
        initial=[0],
        safe=[cb.Inside(cb.Box([-2], [1]))],
        horizon=1,
    )
    square = mean_time.squared_of(problem)
    assert square is not None
    cells = leaving_rate._Cells(problem, square, -2.0, 1.0, 32)
    m = Chebyshev(np.random.default_rng(4).standard_normal(13), domain=[-2, 1])
    x = -2 + 3 * (np.arange(32)[:, None] + np.linspace(0, 1, 21)) / 32
    for found, exact in (
        (cells.values(m.coef), m(x)),
        (cells.moved(m.coef), -(x**3) * m.deriv(1)(x) + 0.08 * m.deriv(2)(x)),
    ):
        near = 1e-9 * np.abs(exact).max()
        assert np.all(found.lo <= exact.min(axis=1) + near)
        assert np.all(exact.max(axis=1) <= found.hi + near)
        assert np.all(found.hi - found.lo < 20 * np.ptp(exact, axis=1).max())


def test_a_plan_in_steps_has_no_rate_and_no_mean_time() -> None:
    """The model under it depends on time, through its input."""
    system = cb.ContinuousSystem(lambda x, u: -x + u, states=1, inputs=cb.Box([-2], [2]), diffusion=0.3)
    steps, safe = np.array([[1.5], [-1.5]]), [cb.Inside(cb.Box([-1], [1]))]
    problem = cb.Problem(system, initial=[0], safe=safe, horizon=2.0, delta=0.05, plan=steps)
    assert leaving_rate.bound_rate(problem) is None
    assert mean_time.bound_mean_time(problem) is None
    verdict = cb.verify_safety(problem, method="values")
    assert "the plan is an array" in verdict.reason
    assert "failed" not in verdict.reason
