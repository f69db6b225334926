"""The scalars v and I: closed forms, limits, and the two routes to them."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.integrate import quad

from certbound.rigor.balls import precision
from certbound.tubes.ballpath import ball_path
from certbound.tubes.constants import Constants
from certbound.tubes.schedule import make_schedule

TIMES = [0.0, 0.5, 2.0, 3.0]


def varying(**changes):
    return Constants(**{"rate": [-1.0, 0.0, 0.7], "sigma": [1.0, 0.3, 2.0], "dimension": 2, "times": TIMES, **changes})


def test_v_solves_its_differential_equation_on_every_piece():
    data = make_schedule(varying(), 3.0)
    t, h = np.array([0.2, 1.1, 2.6]), 1e-6
    ahead, behind = (data.path_at(0.4, t + s * h)[0] for s in (1, -1))
    v, _ = data.path_at(0.4, t)
    rates, noise = np.array([-1.0, 0.0, 0.7]), (np.array([1.0, 0.3, 2.0]) / 2) ** 2
    np.testing.assert_allclose((ahead - behind) / (2 * h), 2 * rates * v + noise, rtol=1e-8)


def test_the_information_is_the_integral_of_the_noise_over_v():
    data = make_schedule(varying(), 3.0)
    for bessel in (False, True):

        def density(s, bessel=bessel):
            v, _ = data.path_at(0.4, np.array(s), bessel=bessel)
            return float(data.noise[data.locate(np.array(s))] / v)

        expected = quad(density, 0.3, 3.0, points=TIMES[1:-1], epsabs=1e-12)[0]
        assert data.path_at(0.4, np.array(0.3), bessel=bessel)[1] == pytest.approx(expected, rel=1e-9)


def test_discrete_time_follows_the_recursion():
    gains, sigmas = [0.8, 1.0, 1.3], [1.0, 0.5, 2.0]
    data = make_schedule(Constants(gain=gains, sigma=sigmas, dimension=1, times=[0, 3, 5, 9]), 9)
    v, info, path = 0.7, 0.0, []
    steps = np.repeat(np.arange(3), [3, 2, 4])
    for k in steps:
        after = gains[k] ** 2 * v + (sigmas[k] / 2) ** 2
        path.append((v, info))
        info += np.log(after / (gains[k] ** 2 * v))
        v = after
    path.append((v, info))
    got_v, got_info = data.path_at(0.7, np.arange(10.0))
    np.testing.assert_allclose(got_v, [p[0] for p in path], rtol=1e-12)
    np.testing.assert_allclose(got_info, info - np.array([p[1] for p in path]), rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("bessel", [False, True])
@pytest.mark.parametrize("constants", [
    varying(),
    Constants(rate=-3.0, sigma=0.2, dimension=1),
    Constants(rate=1e-17, sigma=0.2, dimension=1),
    Constants(gain=1 + 1e-15, sigma=3.0, dimension=1),
])  # fmt: skip
def test_balls_and_floats_agree(constants, bessel):
    data = make_schedule(constants, 3)
    path = ball_path(data, 0.4, bessel=bessel)
    v, info = data.path_at(0.4, np.array([1.0, 2.0]), bessel=bessel)
    for t, x, y in zip((1.0, 2.0), v, info):
        with precision():
            ball_v, ball_info = path.at(int(data.locate(np.array(t))), t)
        assert float(ball_v) == pytest.approx(x, rel=1e-12)
        assert float(ball_info) == pytest.approx(y, rel=1e-11)


@pytest.mark.parametrize("rate", [0.0, 1e-300, 1e-17, -1e-17])
def test_a_vanishing_rate_leaves_the_variance_of_a_walk(rate):
    data = make_schedule(Constants(rate=rate, sigma=2.0, dimension=1), 3.0)
    assert data.nodes[1][-1] == pytest.approx(3.0, rel=1e-14)


def test_long_contraction_and_long_growth_stay_finite_where_they_can():
    data = make_schedule(Constants(rate=-1.0, sigma=1.0, dimension=1), 1e6)
    v, info = data.path(np.array(0.5))
    assert v[-1] == pytest.approx(0.5)
    assert info[0] == pytest.approx(2e6)
    growing = make_schedule(Constants(rate=1.0, sigma=1.0, dimension=1), 1000.0)
    assert growing.nodes[1][-1] == np.inf


def test_a_horizon_inside_the_pieces_cuts_them():
    data = make_schedule(varying(), 1.0)
    np.testing.assert_array_equal(data.times, [0, 0.5, 1.0])
    np.testing.assert_array_equal(data.sigmas, [1.0, 0.3])


def test_refining_changes_nothing():
    data = make_schedule(varying(), 3.0)
    fine = data.graded(40)
    assert len(fine.lengths) >= 40
    assert fine.nodes[1][-1] == pytest.approx(data.nodes[1][-1], rel=1e-13)
    assert fine.path(np.array(0.4))[1][0] == pytest.approx(data.path(np.array(0.4))[1][0], rel=1e-13)


def test_a_cut_schedule_keeps_its_unit_and_everything_pickles():
    data = make_schedule(varying(), 3.0)
    assert data.until(2).unit == data.unit == 2.0
    again = pickle.loads(pickle.dumps(data))
    np.testing.assert_array_equal(again.nodes[1], data.nodes[1])


@pytest.mark.parametrize(("constants", "horizon", "message"), [
    (varying(), 0.0, "`horizon` must be positive and finite"),
    (varying(), np.nan, "`horizon` must be positive and finite"),
    (varying(), 3.5, "`horizon` must not exceed the last entry of `times`"),
    (Constants(gain=0.5, sigma=1.0, dimension=1), 2.5, "`horizon` must be a whole number of steps"),
    (Constants(gain=[0.5, 0.6], sigma=1.0, dimension=1, times=[0, 1.5, 3]), 3, "`times` must be whole numbers"),
])  # fmt: skip
def test_horizons_and_times_out_of_range_are_refused(constants, horizon, message):
    with pytest.raises(ValueError, match=message):
        make_schedule(constants, horizon)
