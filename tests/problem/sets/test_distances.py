"""The clearance is a radius up to which the weighted ball around a state respects the constraint."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from certbound.problem.sets.constraints import Inside, Outside
from certbound.problem.sets.distances import clearance, face_erosion, round_erosion
from certbound.problem.sets.regions import Ball, Box, Ellipsoid, HalfSpace, Polytope

METRIC = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.2], [0.0, 0.2, 4.0]])
INVERSE = np.linalg.inv(METRIC)
REGIONS = [
    Box([-1, -2, -3], [1, 2, 3]),
    Ball([0.5, 0.0], 1.2, coordinates=(0, 2)),
    Ball([0.5, 0.0, 1.0], 1.2),
    Ellipsoid([0, 0, 0], np.diag([1.0, 2.0, 0.5])),
    HalfSpace([1.0, -1.0, 0.5], 0.3),
    Polytope(np.vstack([np.eye(3), -np.eye(3), [[1.0, 1, 1]]]), [1, 1, 1, 1, 1, 1, 1.5]),
]


@pytest.mark.parametrize("region", REGIONS, ids=lambda region: region.kind)
@pytest.mark.parametrize("kind", [Inside, Outside])
def test_the_weighted_ball_of_that_radius_respects_the_constraint(region, kind):
    rng = np.random.default_rng(0)
    constraint = kind(region)
    checked = 0
    for x in rng.uniform(-2, 2, (150, 3)):
        room = float(clearance(constraint, x, INVERSE))
        assert (room >= 0) == bool(constraint.satisfied(x))
        if room > 0:
            y = rng.normal(size=(300, 3))
            y *= 0.9999 * room / np.sqrt(np.einsum("ki,ij,kj->k", y, METRIC, y))[:, None]
            assert np.all(constraint.satisfied(x + y))
            checked += 1
    assert checked > 3


@settings(derandomize=True, deadline=None)
@given(x=st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_half_space_clearance_is_exact(x):
    a, b = np.array([1.0, -1.0, 0.5]), 0.3
    room = clearance(Inside(HalfSpace(a, b)), x, INVERSE)
    expected = (b - a @ np.array(x)) / np.sqrt(a @ INVERSE @ a)
    assert room == pytest.approx(expected, abs=1e-12)
    touching = np.array(x) + room * INVERSE @ a / np.sqrt(a @ INVERSE @ a)
    assert a @ touching == pytest.approx(b, abs=1e-9)


def test_euclidean_distances_in_closed_form():
    assert clearance(Outside(Ball([0.0, 0.0], 1.0)), [3.0, 4.0]) == 4.0
    assert clearance(Inside(Ball([0.0, 0.0], 6.0)), [3.0, 4.0]) == 1.0
    assert clearance(Inside(Box([0, 0], [1, 2])), [0.2, 1.0]) == pytest.approx(0.2)
    assert clearance(Outside(Ellipsoid([0, 0], 4 * np.eye(2))), [3.0, 4.0]) == pytest.approx(3.0)


def test_a_moving_obstacle_is_met_where_it_is():
    rock = Outside(Ball(lambda t: [t, 0.0], 1.0))
    np.testing.assert_allclose([clearance(rock, [5.0, 0.0], t=t) for t in (0.0, 3.0, 4.5)], [4.0, 1.0, -0.5])


def test_a_box_without_sides_leaves_all_room():
    everything = Box([-np.inf] * 2, [np.inf] * 2)
    assert clearance(Inside(everything), [0.0, 0.0]) == np.inf
    assert clearance(Outside(everything), [0.0, 0.0]) == -np.inf


def test_erosions():
    np.testing.assert_allclose(face_erosion([[3.0, 4.0]]), [5.0])
    np.testing.assert_allclose(face_erosion([[1.0, 0, 0]], INVERSE), [np.sqrt(INVERSE[0, 0])])
    assert round_erosion(np.diag([1.0, 9.0])) == pytest.approx(3.0)


def test_twelve_states_in_a_batch():
    constraint = Inside(Box([-1] * 12, [1] * 12))
    x = np.random.default_rng(0).uniform(-1, 1, (50, 12))
    np.testing.assert_allclose(clearance(constraint, x), 1 - np.abs(x).max(axis=1))


def test_the_metric_must_fit():
    with pytest.raises(ValueError, match=r"`inverse_metric` must have shape \(2, 2\)"):
        clearance(Inside(Ball([0.0, 0.0], 1.0)), [0.0, 0.0], np.eye(3))
