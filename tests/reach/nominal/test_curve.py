"""Piecewise polynomial curves."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.reach.nominal.curve import Curve

RNG = np.random.default_rng(3)
EDGES = np.array([0.0, 0.3, 1.0, 1.2])
CURVE = Curve(continuous=True, starts=EDGES[:-1], ends=EDGES[1:], coefficients=RNG.normal(size=(2, 3, 5, 2)))


def derivative(order: int, t: float, piece: int) -> np.ndarray:
    """p^(order)/order! at a time of a piece, both cells."""
    s = t - CURVE.middles[piece]
    total = np.zeros((2, 2))
    for j in range(order, 5):
        factor = np.prod(np.arange(j - order + 1, j + 1)) / np.prod(np.arange(1, order + 1))
        total += factor * CURVE.coefficients[:, piece, j] * s ** (j - order)
    return total


@pytest.mark.parametrize("order", range(5))
def test_series_over_a_piece_enclose_the_taylor_coefficients_everywhere(order):
    wide = CURVE.series_over(CURVE.span)
    for piece in range(3):
        for t in np.linspace(EDGES[piece], EDGES[piece + 1], 21):
            exact = derivative(order, t, piece)
            for i in range(2):
                assert np.all(wide[i][order].lo[:, piece] <= exact[:, i] + 1e-12)
                assert np.all(exact[:, i] <= wide[i][order].hi[:, piece] + 1e-12)


def test_range_holds_all_values_and_is_not_wasteful():
    bounds = CURVE.range()
    for piece in range(3):
        samples = np.stack([derivative(0, t, piece) for t in np.linspace(EDGES[piece], EDGES[piece + 1], 201)])
        low, high = samples.min(axis=0), samples.max(axis=0)
        assert np.all(bounds.lo[:, piece] <= low)
        assert np.all(high <= bounds.hi[:, piece])
        assert np.all(bounds.width[:, piece] <= 3 * (high - low) + 1e-9)


def test_jumps_are_the_gaps_between_pieces():
    jumps = CURVE.jumps()
    for piece in range(2):
        exact = derivative(0, EDGES[piece + 1], piece + 1) - derivative(0, EDGES[piece + 1], piece)
        assert np.all(np.abs(jumps.mid[:, piece] - exact) < 1e-12)


def test_values_at_times_and_sections():
    assert CURVE.value(0.5).shape == (2, 2)
    assert np.allclose(CURVE.value([0.1, 1.1])[:, 1], derivative(0, 1.1, 2))
    assert np.allclose(CURVE.section(1, 3).value(1.1), CURVE.value(1.1))
    assert np.allclose(CURVE.initial().mid, derivative(0, 0.0, 0))
    assert CURVE.piece_of(0.3) == 1
    assert CURVE.piece_of(1.2) == 2


def test_times_outside_are_refused():
    with pytest.raises(ValueError, match="must lie in"):
        CURVE.value(1.3)


def test_coefficients_are_read_only_copies():
    with pytest.raises(ValueError, match="read-only"):
        CURVE.coefficients[0, 0, 0, 0] = 1.0
