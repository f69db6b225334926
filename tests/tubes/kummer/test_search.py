"""The floating-point search for Kummer parameters."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

import certbound as cb
from certbound.tubes.kummer.search import Search, simplex
from certbound.tubes.schedule import make_schedule


@pytest.mark.parametrize("wanted", [(0.3, -2.0), (-5.0, 1.0), (7.0, 40.0)])
def test_the_simplex_finds_the_least_value_in_its_box(wanted):
    seen = []

    def bowl(point):
        seen.append(point)
        return sum((x - y) ** 2 for x, y in zip(point, wanted)) + 0.5 * abs(point[0] - wanted[0])

    value, place = simplex(bowl, (0.5, 0.0), 0.5, tolerance=1e-9, low=(0.0, -9.0), high=(2.0, 9.0))
    expected = np.clip(wanted, (0.0, -9.0), (2.0, 9.0))
    assert np.allclose(place, expected, atol=2e-3)
    assert value == bowl(place)
    assert all(0 <= x <= 2 and -9 <= y <= 9 for x, y in seen)


def test_it_starts_inwards_from_a_corner():
    value, _ = simplex(lambda p: (p[0] - 1) ** 2, (2.0,), 0.5, tolerance=1e-9, low=(0.0,), high=(2.0,))
    assert value < 1e-4


@pytest.mark.parametrize("known", [{"rate": -0.5}, {"rate": 0.3}, {"gain": 0.99}])
def test_the_scale_for_few_pieces_is_the_one_of_the_radii(known):
    schedule = make_schedule(cb.Constants(**known, sigma=1.0, dimension=3), 5)
    weights = np.linspace(1.0, 2.0, len(schedule.graded(6).times))
    search = Search(schedule=schedule.graded(6), kind="scale", weights=weights, log_delta=math.log(1e-3))
    for a, v0 in itertools.product((0.0, 0.4, 30.0), (0.3, 2.0)):
        short = search.scale(a, v0)
        radii = Search.scale(_long(search), a, v0)
        assert short == pytest.approx(radii, rel=1e-8)


def _long(search):
    """The same search by the formula for many pieces."""
    search = Search(**{name: getattr(search, name) for name in search.__dataclass_fields__})
    vars(search)["_pieces"] = [None] * 100
    return search


def test_gains_that_leave_no_trace_of_the_noise_before_them_end_the_search_without_a_tube():
    constants = cb.Constants(
        gain=[1.0, 0.002, 1.0, 0.91, 0.24], sigma=[4.3, 42.6, 68.4, 18.4, 4.7], dimension=5,
        times=[0.0, 8.0, 50.0, 99.0, 124.0, 300.0],
    )
    assert cb.tune_tube(constants, horizon=300, delta=1e-3, method="bessel").maximum == math.inf
    assert cb.tune_tube(constants, horizon=300, delta=1e-3).maximum < 1e4


def test_scales_whose_squares_are_no_floats_any_more_are_answered():
    schedule = make_schedule(cb.Constants(rate=-0.5, sigma=1.0, dimension=2), 5.0).graded(32)
    search = Search(schedule=schedule, kind="scale", weights=np.ones(len(schedule.times)), log_delta=-7.0)
    assert search.log_probability(0.5, 1.0, 1e200) == -math.inf
