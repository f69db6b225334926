"""The almost-sure bound of bounded noise: the recursion, its limit, its use in tubes."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.tubes.constants import Constants
from certbound.tubes.exact.almost_sure import AlmostSureProfile
from certbound.tubes.question import Start
from certbound.tubes.schedule import make_schedule
from certbound.tubes.tuning import tune_tube

VARYING = Constants(
    gain=[0.5, 1.0, 1.2], sigma=[1.0, 0.5, 0.2], dimension=2, times=[0.0, 3.0, 5.0, 8.0], noise_bound=[1.0, 0.4, 0.3]
)


def test_it_follows_the_recursion_from_above():
    schedule = make_schedule(VARYING, 8)
    profile = AlmostSureProfile(schedule=schedule, bounds=np.array([1.0, 0.4, 0.3]), start=0.25)
    b, expected = 0.25, [0.25]
    for step in range(8):
        piece = 0 if step < 3 else (1 if step < 5 else 2)
        b = (0.5, 1.0, 1.2)[piece] * b + (1.0, 0.4, 0.3)[piece]
        expected.append(b)
    got = profile.radius(np.arange(9.0))
    np.testing.assert_allclose(got, expected, rtol=1e-14)
    assert np.all(got >= np.array(expected) * (1 - 1e-15))


def test_no_path_of_extreme_noise_exceeds_it():
    tube = tune_tube(VARYING, horizon=8, delta=1e-9)
    rng = np.random.default_rng(3)
    x, worst = np.zeros((2000, 2)), []
    for step in range(8):
        piece = 0 if step < 3 else (1 if step < 5 else 2)
        w = rng.standard_normal(x.shape)
        w[:1000] = x[:1000] + 1e-9  # outward
        w *= (1.0, 0.4, 0.3)[piece] / np.linalg.norm(w, axis=1, keepdims=True)
        x = (0.5, 1.0, 1.2)[piece] * x + w
        worst.append(np.linalg.norm(x, axis=1).max())
    assert np.all(worst <= tube.radius(np.arange(1.0, 9.0)) * (1 + 1e-12))
    # the outward noise attains it: anything smaller would be left
    np.testing.assert_allclose(worst, tube.radius(np.arange(1.0, 9.0)), rtol=1e-6)


def test_uniform_noise_at_gain_one_half_stays_within_two():
    constants = Constants(gain=0.5, sigma=1 / np.sqrt(3), dimension=1, noise_bound=1.0)
    assert tune_tube(constants, horizon=100, delta=1e-9).maximum == pytest.approx(2.0, rel=1e-12)


def test_the_pointwise_minimum_keeps_the_better_of_the_two():
    constants = Constants(gain=0.9, sigma=1 / np.sqrt(3), dimension=1, noise_bound=1.0)
    cut = tune_tube(constants, horizon=50, delta=1e-3)
    plain = tune_tube(Constants(gain=0.9, sigma=1 / np.sqrt(3), dimension=1), horizon=50, delta=1e-3)
    assert cut.radius(1.0) == pytest.approx(1.0)
    assert cut.radius(50.0) == plain.radius(50.0) < 9.0
    assert cut.bound(0, 50) <= plain.bound(0, 50)


def test_a_start_that_is_offset_is_carried_along():
    constants = Constants(gain=0.5, sigma=1 / np.sqrt(3), dimension=1, noise_bound=1.0)
    tube = tune_tube(constants, horizon=3, delta=1e-9, start=Start(offset=1.0))
    np.testing.assert_allclose(tube.radius(np.arange(4.0)), [1.0, 1.5, 1.75, 1.875], rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"noise_bound": -1.0}, "`noise_bound` must not be negative"),
        ({"noise_bound": np.inf}, "`noise_bound` must be finite"),
        ({"noise_bound": 1.0, "gaussian": True}, "`noise_bound` is for discrete-time noise that is not Gaussian"),
    ],
)
def test_bounds_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Constants(gain=0.5, sigma=1.0, dimension=1, **changes)
