"""A set's form is the set: half-spaces or a quadratic form, with a box around either that holds all of it."""

import numpy as np
import pytest

from certbound.problem.sets.forms import Faces, Quadratic, Region
from certbound.problem.sets.regions import Ball, Box, Ellipsoid, HalfSpace, Polytope
from certbound.rigor.intervals import Interval

SHAPE = np.array([[1.0, 0.2], [0.2, 0.5]])
SHAPES = [
    Box([-1.0, 0.2], [0.5, 0.7]),
    Box([-1.0, -np.inf], [0.5, 0.7], center=lambda t: [0.1 * t, 1.0 / 3.0]),
    Ball([0.3, 0.1], 0.7),
    Ball(lambda t: [0.3 * t, np.sin(t)], 0.1),
    Ellipsoid([0.1, 0.2], SHAPE),
    HalfSpace([0.0, -3.0], 0.1),
    Polytope([[3.0, 0.0], [1.0, 1.0], [0.0, -7.0]], [1.0, 1.0, 1.0]),
]


@pytest.mark.parametrize("region", SHAPES)
def test_a_set_is_its_form(region):
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (2000, 2))
    y = points - region.center_at(0.7)
    if region.form.round:
        inside = np.einsum("ki,ij,kj->k", y, np.linalg.inv(region.form.matrix), y) <= 1
    else:
        inside = np.all(y @ region.form.normals.T <= region.form.bounds, axis=1)
    assert 0 < inside.sum() < len(points)
    np.testing.assert_array_equal(region.contains(points, 0.7), inside)


@pytest.mark.parametrize("region", SHAPES)
def test_the_box_around_a_set_holds_it(region):
    around, eye = region.hull(0.7), np.eye(2)
    assert np.all(around.hi >= region.support(eye, 0.7) - 1e-15)
    assert np.all(around.lo <= -region.support(-eye, 0.7) + 1e-15)
    points = np.random.default_rng(1).uniform(-1.5, 1.5, (2000, 2))
    points = points[region.contains(points, 0.7)]
    assert np.all((around.lo <= points) & (points <= around.hi))


def test_the_box_around_a_box_is_exact_and_others_are_rounded_outward():
    box = Box([-1 / 3, 0.1], [0.7, np.inf])
    np.testing.assert_array_equal(box.hull().lo, box.low)
    np.testing.assert_array_equal(box.hull().hi, box.high)
    third = Polytope([[3.0]], [1.0]).hull().hi[0]
    assert 3 * third >= 1
    assert third == pytest.approx(1 / 3)
    assert Ball([1.0], 1e-20).hull().hi[0] > 1


def test_axial_faces_compare_exactly():
    form, cells = Box([0.1], [0.3]).form, Interval(np.array([[0.1], [0.3]]), np.array([[0.3], [0.4]]))
    values = form.values(cells)
    np.testing.assert_array_equal(values.hi[0], form.bounds)
    np.testing.assert_array_equal(values.lo[1], [0.3, -0.4])


@pytest.mark.parametrize("normals", [[[1.0, 1.0]], [[2.0, 0.0]], [[1.0, 0.0], [1.0, 0.0]]])
def test_faces_that_only_claim_to_be_axial_are_refused(normals):
    with pytest.raises(ValueError, match="`axial` faces must bound one coordinate each"):
        Faces(np.array(normals), np.ones(len(normals)), axial=True)


def test_a_ball_is_even_and_an_ellipsoid_is_not():
    assert Quadratic(np.eye(3), 2.0).even
    assert not Quadratic(SHAPE, 1.0).even
    np.testing.assert_array_equal(Quadratic(np.eye(2), 2.0).matrix, 4 * np.eye(2))


def test_a_shape_says_its_form_and_without_a_centre_its_middle():
    class Nothing(Region):
        center = None

    with pytest.raises(NotImplementedError):
        Nothing().form  # noqa: B018  # asking is what refuses
    with pytest.raises(NotImplementedError, match="a Nothing without a centre must say its `middle`"):
        Nothing().middle  # noqa: B018  # as above


def test_what_cannot_be_moved_outward_says_so():
    with pytest.raises(ValueError, match="a set of the kind ellipsoid cannot be moved outward evenly"):
        Ellipsoid([0, 0], SHAPE).grown(0.1)
    np.testing.assert_allclose(Polytope([[3.0, 4.0]], [1.0]).grown(0.1).b, [1.5])


def test_points_on_the_edge_of_an_ellipsoid_with_whole_half_axes_are_in_it():
    for shape, points in (([25.0, 25.0], [[3, 4], [-4, 3], [5, 0]]), ([9.0, 16.0], [[3, 0], [0, -4]])):
        found = Ellipsoid([1.0, -2.0], np.diag(shape))
        edge = np.array(points) + np.array([1.0, -2.0])
        assert found.contains(edge).all()
        assert not found.contains(edge + 2.0**-40 * np.array(points)).any()
