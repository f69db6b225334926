"""The kernels' elementary functions agree with the library's, everywhere."""

import math

import numpy as np
import pytest

from certbound.simulation.compiled.elementary import atan2, sincos, tanh

RNG = np.random.default_rng(1)
ANGLES = np.hstack(
    [
        RNG.uniform(-10, 10, 20_000),
        RNG.uniform(-1e5, 1e5, 20_000),
        RNG.standard_normal(2000) * 1e-8,
        np.arange(-200, 200) * np.pi / 4,
        [0.0, -0.0, 1e-310, 1e5, -2e5, 1e22],
    ]
)
VALUES = np.array([0.0, -0.0, 1e-310, 1e-3, 0.4142135, 0.4142136, 1.0, 3.0, 1e200, 1e308, math.inf])


def test_sine_and_cosine_are_accurate_to_the_last_bits():
    found = np.array([sincos(angle) for angle in ANGLES])
    np.testing.assert_allclose(found[:, 0], np.sin(ANGLES), rtol=0, atol=3e-16)
    np.testing.assert_allclose(found[:, 1], np.cos(ANGLES), rtol=0, atol=3e-16)


def test_small_angles_keep_their_relative_accuracy():
    small = RNG.uniform(-0.7, 0.7, 10_000) * 10.0 ** RNG.uniform(-12, 0, 10_000)
    found = np.array([sincos(angle)[0] for angle in small])
    np.testing.assert_allclose(found, np.sin(small), rtol=4e-16)


def test_the_arc_tangent_is_accurate_in_every_quadrant():
    y, x = RNG.standard_normal((2, 40_000)) * 10.0 ** RNG.uniform(-5, 5, (2, 40_000))
    found = np.array([atan2(*point) for point in zip(y, x)])
    np.testing.assert_allclose(found, np.arctan2(y, x), rtol=6e-16, atol=5e-16)


@pytest.mark.parametrize("y", [*VALUES, *-VALUES])
def test_the_arc_tangent_keeps_signs_zeros_and_infinities(y):
    for x in (*VALUES, *-VALUES):
        assert atan2(y, x) == pytest.approx(math.atan2(y, x), rel=6e-16, abs=0.0)
        assert math.copysign(1.0, atan2(y, x)) == math.copysign(1.0, math.atan2(y, x))


def test_the_hyperbolic_tangent_is_accurate_and_saturates():
    x = np.concatenate([RNG.uniform(-20, 20, 10_000), [0.0, 400.0, -1e4, math.inf, -math.inf]])
    found = np.array([tanh(value) for value in x])
    np.testing.assert_allclose(found, np.tanh(x), rtol=0, atol=4e-16)


def test_nan_and_infinite_angles_give_nan():
    assert all(math.isnan(value) for bad in (math.nan, math.inf) for value in sincos(bad))
    assert math.isnan(atan2(math.nan, 1.0))
    assert math.isnan(atan2(1.0, math.nan))
    assert math.isnan(tanh(math.nan))
