"""Sums of Chebyshev polynomials that the rates rest on: within their error of the exact ones, and close."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from certbound.values.continuous.line import stationary


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
    for coefficients in (given, stationary._derivative(given), stationary._derivative(stationary._derivative(given))):
        y = np.concatenate([np.arange(-7, 8, 2) / 8, [1 - 2.0**-14, -1 + 2.0**-14]])
        found, error = stationary._summed(coefficients, y)
        exact = [exactly(coefficients, place) for place in y.tolist()]
        assert all(abs(Fraction(a) - b) <= Fraction(e) for a, b, e in zip(found.tolist(), exact, error.tolist()))
        assert np.all(error <= 1e-12 * float(sum(map(abs, coefficients))) + 1e-300)


def test_derivatives_are_the_exact_ones() -> None:
    given = [Fraction(k, 7) for k in (3, -2, 5, 1, -4)]
    once, h = stationary._derivative(given), Fraction(1, 10**6)
    assert len(once) == 4
    assert stationary._derivative(given[:1]) == [0]
    for y in (-0.75, 0.0, 0.5):
        middle = (exactly(given, y + float(h)) - exactly(given, y - float(h))) / (
            Fraction(y + float(h)) - Fraction(y - float(h))
        )
        assert abs(float(middle - exactly(once, y))) < 1e-9
