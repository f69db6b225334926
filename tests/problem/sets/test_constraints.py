"""Constraints check their window and describe themselves; random starts are checked and sampled."""

import numpy as np
import pytest

from certbound.problem.sets.constraints import GaussianStart, Inside, Open, Outside
from certbound.problem.sets.regions import Ball, Box, Ellipsoid, HalfSpace, Polytope

STATES = ("px", "py", "th")


def test_inside_and_outside_are_opposite():
    region = Ball([0, 0], 1)
    points = np.random.default_rng(0).normal(size=(100, 2))
    np.testing.assert_array_equal(Inside(region).satisfied(points), ~Outside(region).satisfied(points))


@pytest.mark.parametrize(
    ("constraint", "label"),
    [
        (Inside(Box([-1, -2, -np.inf], [10, 2, np.inf])), "-1 <= px <= 10, -2 <= py <= 2"),
        (Inside(Box([-np.inf] * 3, [np.inf, np.inf, 3])), "th <= 3"),
        (Outside(Box([1, 2], [2, 3], coordinates=(0, 2))), "outside 1 <= px <= 2, 2 <= th <= 3"),
        (Inside(HalfSpace([1, -1, 0], 2)), "px - py <= 2"),
        (Outside(HalfSpace([-1, 0, 0.5], 2)), "-px + 0.5*th > 2"),
        (Outside(Ball([1, 2], 0.5, coordinates=(0, 1))), "outside the ball of radius 0.5 around (1, 2) in (px, py)"),
        (Inside(Ball(lambda t: [t, t, t], 2)), "inside the ball of radius 2 around a moving centre"),
        (Outside(Ellipsoid([0, 0, 0], np.eye(3))), "outside the ellipsoid around (0, 0, 0)"),
        (Inside(Polytope(np.eye(3), [1, 1, 1])), "inside a polytope of 3 faces"),
        (Outside(Ball([0, 0, 0], 1), label="the rock"), "the rock"),
    ],
)
def test_labels_use_the_states_names(constraint, label):
    assert constraint.named(STATES).label == label


def test_a_long_label_is_cut():
    label = Inside(Box([-1] * 14, [1] * 14)).named(tuple(f"x{k}" for k in range(14))).label
    assert label == "-1 <= x0 <= 1, -1 <= x1 <= 1, ... (14 intervals)"


@pytest.mark.parametrize("window", [(2, 1), (-1, 1), (0, np.inf), (0, np.nan), (1, 2, 3)])
def test_a_window_must_be_an_interval(window):
    with pytest.raises(ValueError, match="`during`"):
        Inside(Box([0], [1]), during=window)


def test_a_region_must_be_a_set():
    with pytest.raises(TypeError, match="`region` must be a Box, Ball"):
        Inside([0, 1])


def test_a_random_start_has_its_moments():
    start = GaussianStart([1.0, 2.0], [[1.0, 0.5], [0.5, 1.0]])
    samples = start.sample(np.random.default_rng(0), 100_000)
    np.testing.assert_allclose(samples.mean(axis=0), [1, 2], atol=0.02)
    np.testing.assert_allclose(np.cov(samples.T), start.covariance, atol=0.02)


def test_a_random_start_is_checked():
    with pytest.raises(ValueError, match="`covariance` must be positive semidefinite"):
        GaussianStart([0, 0], [[1, 2], [2, 1]])
    with pytest.raises(ValueError, match=r"`covariance` must have shape \(3, 3\)"):
        GaussianStart([0, 0, 0], np.eye(2))


def test_a_label_names_the_states_in_their_order() -> None:
    names = ("a", "b", "c")
    box = Box([-2.0, -1.0], [2.0, 1.0], coordinates=(2, 0))
    assert Outside(box).named(names).label == "outside -1 <= a <= 1, -2 <= c <= 2"


@pytest.mark.parametrize(
    "region",
    [
        HalfSpace([1, -2], 0.3), Polytope([[0, -3]], [1]), Box([-np.inf, -np.inf], [0.2, np.inf]), Box([0.1], [np.inf]),
        Box([-np.inf], [0.4], coordinates=[1], center=lambda t: [0.5 * t]),
    ],
)
def test_a_half_space_to_keep_out_of_leaves_a_set_to_stay_in(region):
    """Both go together but for points of the face, which fail."""
    kept = Outside(region, during=(1, 2), label="far")
    stay = kept.as_stay()
    assert (type(stay), stay.during, stay.label) == (Open, (1, 2), "far")
    points = np.random.default_rng(0).normal(size=(500, 1 if region.dimension == 1 and not region.moving else 2))
    for t in (0.0, 1.5):
        np.testing.assert_array_equal(stay.satisfied(points, t), kept.satisfied(points, t))
    assert stay.inward(0, 0.0) > 0 > stay.inward(1, 0.0)
    assert [Inside(region).inward(side, 0.0) for side in (0, 1)] == [0.0, 0.0]


def test_other_constraints_stay_as_they_are():
    given = [Inside(HalfSpace([1, 0], 1)), Outside(Box([0, 0], [1, np.inf])), Outside(Ball([0, 0], 1))]
    assert [one.as_stay() for one in given] == given
