"""Thm K1: special cases, limits, monotonicity, refusals."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from flint import arb
from scipy.special import hyp1f1, iv

from certbound.rigor.balls import kummer_excess, precision
from certbound.tubes.constants import Constants
from certbound.tubes.kummer.profile import kummer_tube
from certbound.tubes.question import Start

OU = Constants(rate=-0.5, sigma=0.1**0.5, dimension=1)


def tube(constants=OU, **changes):
    return kummer_tube(constants, **{"horizon": 5.0, "delta": 1e-3, "a": 0.3, "v0": 0.1, **changes})


def test_the_radius_solves_the_equation_of_the_theorem():
    a, v, delta = 0.3, 0.1, 1e-3  # v is constant: 2 c v + sigma^2 = 0
    level = 1 + math.expm1(a * 5.0) / delta
    for t in (0.0, 2.0, 5.0):
        z = tube().radius(t) ** 2 / (2 * v)
        assert math.exp(a * (5.0 - t)) * hyp1f1(a, 0.5, z) == pytest.approx(level, rel=1e-10)


def test_at_a_equal_nu_half_the_tube_is_that_of_the_exponential():
    # 1F1(b; b; z) = e^z
    got = tube(Constants(rate=-0.5, sigma=0.1**0.5, dimension=4), a=2.0).radius(5.0)
    assert got == pytest.approx(math.sqrt(2 * 0.1 * math.log1p(math.expm1(10.0) / 1e-3)), rel=1e-12)


@pytest.mark.parametrize("changes", [{}, {"bessel": True}, {"a": 0.0}])
@pytest.mark.parametrize("known", [{"rate": -0.5}, {"rate": 0.2}, {"gain": 0.9}])
def test_without_noise_the_bound_is_the_radius_and_both_are_zero(known, changes):
    silent = tube(Constants(**known, sigma=0.0, dimension=2), **changes)
    assert silent.radius(3.0) == silent.bound(0.0, 5.0) == silent.maximum == 0.0
    moved = tube(Constants(**known, sigma=0.0, dimension=2), start=Start(offset=0.1), **changes)
    assert 0 < moved.maximum < np.inf


def test_the_bessel_form_in_one_dimension_is_the_hyperbolic_cosine():
    walk = Constants(rate=0.0, sigma=1.0, dimension=1)
    rate, horizon, delta = 2.5, 2.0, 1e-3
    got = tube(walk, horizon=horizon, a=rate**2 / 2, v0=1.0, bessel=True)
    level = 1 + math.expm1(rate**2 * horizon / 2) / delta
    for t in (0.0, 1.0, 2.0):
        expected = math.acosh(level / math.exp(rate**2 * (horizon - t) / 2)) / rate
        assert got.radius(t) == pytest.approx(expected, rel=1e-12)


def test_the_bessel_form_in_three_dimensions_is_sinh_over_x():
    got = tube(Constants(rate=0.0, sigma=1.0, dimension=3), horizon=2.0, a=2.0, v0=1.0, bessel=True).radius(2.0)
    level = 1 + math.expm1(4.0) / 1e-3
    assert math.sinh(2 * got) / (2 * got) == pytest.approx(level, rel=1e-10)
    assert iv(0.5, 2 * got) * math.sqrt(math.pi / (4 * got)) == pytest.approx(level, rel=1e-10)


def test_a_large_with_fixed_ratio_tends_to_the_bessel_form():
    walk = Constants(rate=0.0, sigma=1.0, dimension=2)
    limit = tube(walk, horizon=2.0, a=2.0, v0=1.0, bessel=True).maximum
    errors = [abs(tube(walk, horizon=2.0, a=2 * s, v0=s).maximum / limit - 1) for s in (1e3, 1e4)]
    assert errors[1] < 0.2 * errors[0] < 1e-3


def test_the_limit_at_a_zero_is_the_closed_form():
    got = tube(a=0.0)
    with precision():
        z = got.radius(5.0) ** 2 / (2 * 0.1)
        assert float(kummer_excess(arb(0), arb(0.5), arb(z))) == pytest.approx(5.0 / 1e-3, rel=1e-10)
    assert tube(a=1e-10).radius(3.0) == pytest.approx(got.radius(3.0), rel=1e-8)


def test_discrete_time_is_continuous_time_at_whole_steps():
    # L = e^c and sigma^2 (L^2 - 1)/(2 c) per step give the same v and I at whole times
    rate, sigma = -0.3, 0.7
    gain = math.exp(rate)
    chain = Constants(gain=gain, sigma=sigma * math.sqrt(math.expm1(2 * rate) / (2 * rate)), dimension=3)
    flow = Constants(rate=rate, sigma=sigma, dimension=3)
    steps = np.arange(1.0, 9.0)
    a, b = (tube(c, horizon=8, a=0.8, v0=0.5).radius(steps) for c in (chain, flow))
    np.testing.assert_allclose(a, b, rtol=1e-12)


def test_splitting_constants_into_equal_pieces_changes_nothing():
    split = Constants(rate=[-0.5] * 4, sigma=[0.1**0.5] * 4, dimension=1, times=[0, 1, 2.5, 3, 5])
    np.testing.assert_allclose(
        tube(split).radius(np.linspace(0, 5, 9)), tube().radius(np.linspace(0, 5, 9)), rtol=1e-12
    )


@pytest.mark.parametrize("sigma", [1e-150, 1e-9, 1.0, 1e150])
def test_the_radius_scales_with_sigma_at_any_size(sigma):
    unit = tube(Constants(rate=-0.5, sigma=1.0, dimension=1), v0=1.0).maximum
    got = tube(Constants(rate=-0.5, sigma=sigma, dimension=1), v0=sigma**2).maximum
    assert got == pytest.approx(sigma * unit, rel=1e-9)


@pytest.mark.parametrize("dimension", [1, 12, 1000])
@pytest.mark.parametrize("delta", [0.5, 1e-12, 1e-300])
def test_any_dimension_and_any_delta_give_a_finite_bound(dimension, delta):
    constants = Constants(rate=-0.5, sigma=1.0, dimension=dimension)
    got = tube(constants, delta=delta, a=0.2, v0=1.0)
    assert math.sqrt(dimension * 0.9) / 3 < got.maximum < 10 * math.sqrt(dimension - math.log(delta))


def test_an_effective_dimension_below_one_behaves():
    sizes = [tube(Constants(rate=-0.5, sigma=1.0, dimension=3, effective_dimension=nu), v0=1.0).maximum
             for nu in (0.05, 0.4, 1.0, 3.0)]  # fmt: skip
    assert np.all(np.diff(sizes) > 0)


def test_everything_worse_makes_the_tube_larger():
    base = tube().maximum
    assert tube(delta=1e-4).maximum > base > tube(delta=1e-2).maximum
    assert tube(Constants(rate=-0.4, sigma=0.1**0.5, dimension=1)).maximum > base
    assert tube(Constants(rate=-0.5, sigma=0.33, dimension=1)).maximum > base
    assert tube(horizon=6.0).maximum > base > tube(horizon=4.0).maximum
    assert tube(Constants(rate=-0.5, sigma=0.1**0.5, dimension=2)).maximum > base


def test_bounds_over_intervals_cover_the_radius_and_are_tight():
    data = Constants(rate=[-2.0, 1.0, -1.0], sigma=[1.0, 0.5, 2.0], dimension=2, times=[0, 1, 2, 4])
    got = tube(data, horizon=4.0, v0=3.0)
    edges = np.linspace(0, 4, 23)
    bounds = got.bound(edges[:-1], edges[1:])
    for k, bound in enumerate(bounds):
        sampled = got.radius(np.linspace(edges[k], edges[k + 1], 201)).max()
        assert sampled <= bound <= sampled * (1 + 2e-3)
    assert got.maximum == pytest.approx(got.bound(0.0, 4.0))
    assert got.maximum >= bounds.max() * (1 - 1e-3)


def test_in_discrete_time_only_whole_steps_count():
    got = tube(Constants(gain=0.5, sigma=1.0, dimension=1), horizon=6, v0=1.0)
    assert got.radius(0) == 0.0
    assert got.bound(2.2, 2.9) == 0.0
    assert got.bound(2.2, 3.9) == pytest.approx(got.radius(3))
    with pytest.raises(ValueError, match="`t` must be whole steps"):
        got.radius(2.5)


def test_a_start_that_is_offset_obeys_item_7_4():
    a, v, delta, offset = 0.3, 0.1, 1e-3, 0.2
    got = tube(start=Start(offset=offset)).radius(5.0)
    level = 1 + (math.exp(a * 5) * hyp1f1(a, 0.5, offset**2 / (2 * v)) - 1) / delta
    assert hyp1f1(a, 0.5, got**2 / (2 * v)) == pytest.approx(level, rel=1e-10)


def test_a_random_start_obeys_item_7_4():
    a, v, delta, spread = 0.3, 0.1, 1e-3, 0.15
    got = tube(start=Start(sigma=spread)).radius(5.0)
    level = 1 + (math.exp(a * 5) * (1 - spread**2 / v) ** -a - 1) / delta
    assert hyp1f1(a, 0.5, got**2 / (2 * v)) == pytest.approx(level, rel=1e-10)
    assert tube(start=Start(sigma=0.4)).radius(5.0) == math.inf  # v_0 must exceed the start's variance


def test_the_offset_inside_the_martingale_beats_adding_it():
    assert tube(start=Start(offset=0.2)).radius(5.0) < tube().radius(5.0) + 0.2 * math.exp(-2.5)


def test_tubes_pickle_and_state_their_data():
    got = tube()
    again = pickle.loads(pickle.dumps(got))
    assert again.maximum == got.maximum
    data = got.to_dict()
    assert data["profile"]["kind"] == "kummer"
    assert data["profile"]["unit"] ** 2 * data["profile"]["v0"] == pytest.approx(0.1)
    assert data["constants"]["certified"] is False
    assert got.log10_delta == pytest.approx(-3)


def test_extents_carry_the_metric():
    metric = np.array([[4.0, 1.0], [1.0, 2.0]])
    got = tube(Constants(rate=-0.5, sigma=1.0, dimension=2, metric=metric), v0=1.0)
    directions = np.array([[1.0, 0.0], [1.0, -2.0]])
    expected = np.sqrt(np.einsum("ki,ij,kj->k", directions, np.linalg.inv(metric), directions))
    np.testing.assert_allclose(got.extent(directions, 2.0), got.radius(2.0) * expected, rtol=1e-11)
    assert got.extent(directions, [1.0, 2.0]).shape == (2, 2)
    assert np.all(got.extent(directions, 2.0) >= got.bound(2.0, 2.0) * expected * (1 - 1e-15))


@pytest.mark.parametrize(("changes", "message"), [
    ({"a": -0.1}, "`a` must be finite and not negative"),
    ({"a": 0.0, "bessel": True}, "`a` must be finite and positive"),
    ({"a": math.nan}, "`a` must be finite"),
    ({"v0": 0.0}, "`v0` must be positive and finite"),
    ({"delta": 1.0}, r"`delta` must lie in \(0, 1\), got 1.0"),
    ({"delta": 0.0}, r"`delta` must lie in \(0, 1\)"),
])  # fmt: skip
def test_parameters_out_of_range_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        tube(**changes)


def test_anisotropic_sub_gaussian_noise_caps_a():
    chain = Constants(gain=0.9, sigma=1.0, dimension=3, effective_dimension=1.2)
    assert tube(chain, horizon=5, a=0.59, v0=1.0).certified
    for changes in ({"a": 0.6}, {"a": 3.0}, {"a": 2.0, "bessel": True}):
        with pytest.raises(ValueError, match=r"`a` must be below nu/2 = 0.6"):
            tube(chain, horizon=5, v0=1.0, **changes)
    gaussian = Constants(gain=0.9, sigma=1.0, dimension=3, effective_dimension=1.2, gaussian=True)
    assert tube(gaussian, horizon=5, a=3.0, v0=1.0).certified


def test_a_random_start_needs_the_full_dimension():
    flat = Constants(rate=-0.5, sigma=1.0, dimension=3, effective_dimension=1.2)
    with pytest.raises(ValueError, match="a random `start` is isotropic"):
        tube(flat, v0=1.0, start=Start(sigma=0.1))
    with pytest.raises(ValueError, match="`start` offset must be finite and not negative"):
        Start(offset=-1.0)


@pytest.mark.parametrize(("call", "message"), [
    (lambda t: t.radius(5.1), r"`t` must lie in \[0, 5.0\]"),
    (lambda t: t.radius(math.nan), r"`t` must lie in \[0, 5.0\]"),
    (lambda t: t.bound(-1.0, 2.0), r"`t0` must lie in"),
    (lambda t: t.bound(2.0, 1.0), "`t0` must not exceed `t1`"),
    (lambda t: t.extent([1.0, 0.0], 1.0), r"`directions` must be finite, of shape \(..., 1\)"),
])  # fmt: skip
def test_questions_out_of_range_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(tube())


def test_a_power_beyond_all_floats_gives_wide_radii_not_zero():
    constants = Constants(gain=0.46, sigma=0.61, dimension=2)
    tube = kummer_tube(constants, horizon=31, delta=0.03, a=1.5e22, v0=4e20, bessel=True)
    assert tube.radius(0.0) == 0
    assert np.all(tube.radius(np.arange(1.0, 5.0)) > 2.0)
