"""Sets know their points, supports and faces, in some coordinates or all, also when they move."""

from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from certbound.problem.model.tape import Tape
from certbound.problem.model.tracing import trace
from certbound.problem.sets.regions import Ball, Box, Ellipsoid, HalfSpace, Polytope

SETS = [
    Box([-1, 0, 2], [1, 3, 2]),
    Box([-1, 0, 2], [1, 3, 2.5], center=lambda t: [t, 0, -t]),
    Ball([1, 2, 3], 0.7),
    Ball(lambda t: [1 + t, 2 * t, np.sin(t)], 0.7),
    Ellipsoid([0, 1, 0], [[2, 0.5, 0], [0.5, 1, 0], [0, 0, 0.1]]),
    Polytope(np.vstack([np.eye(3), -np.eye(3), [[1, 1, 1]]]), [1, 1, 1, 1, 1, 1, 1.5]),
]


@pytest.mark.parametrize("region", SETS, ids=lambda region: region.kind)
def test_samples_lie_inside_and_below_the_support(region):
    t = 0.8
    points = region.sample(np.random.default_rng(0), 500, t=t)
    assert points.shape == (500, 3)
    assert np.all(region.contains(points, t=t))
    directions = np.random.default_rng(1).normal(size=(40, 3))
    support = region.support(directions, t=t)
    assert np.all(points @ directions.T <= support + 1e-9)
    assert np.all((points @ directions.T).max(axis=0) >= support - 1.2 * np.linalg.norm(directions, axis=1))


@pytest.mark.parametrize("region", SETS, ids=lambda region: region.kind)
def test_points_beyond_the_support_lie_outside(region):
    directions = np.random.default_rng(1).normal(size=(40, 3))
    support = region.support(directions, t=0.3)
    squares = np.sum(directions**2, axis=1)
    points = directions * ((support + 1e-6 * squares) / squares)[:, None]
    assert not np.any(region.contains(points, t=0.3))


@settings(derandomize=True, deadline=None)
@given(center=st.tuples(st.floats(-5, 5), st.floats(-5, 5)), radius=st.floats(0.01, 5), angle=st.floats(0, 6.28))
def test_a_round_ellipsoid_is_a_ball(center, radius, angle):
    ball, ellipsoid = Ball(center, radius), Ellipsoid(center, radius**2 * np.eye(2))
    direction = np.array([np.cos(angle), np.sin(angle)])
    assert ellipsoid.support(direction) == pytest.approx(float(ball.support(direction)))
    for factor, inside in ((0.999, True), (1.001, False)):
        point = np.array(center) + factor * radius * direction
        assert ball.contains(point) == ellipsoid.contains(point) == inside


@settings(derandomize=True, deadline=None)
@given(x=st.lists(st.floats(-4, 4), min_size=3, max_size=3))
def test_faces_describe_the_box(x):
    box = Box([-1, -np.inf, 2], [1, 3, np.inf])
    faces, bounds = box.halfspaces()
    assert len(bounds) == 4
    assert bool(np.all(faces @ np.array(x) <= bounds)) == bool(box.contains(x))


def test_polytope_support_is_exact_at_a_vertex():
    polytope = Polytope([[1, 0], [0, 1], [-1, 0], [0, -1], [1, 1]], [1, 1, 0, 0, 1.5])
    np.testing.assert_allclose(polytope.support([[1, 1], [1, 0], [2, 1]]), [1.5, 1.0, 2.5])
    assert np.isinf(Polytope([[1.0, 0.0]], [1.0]).support([0.0, 1.0]))


def test_half_space_support_is_finite_along_its_normal_only():
    half = HalfSpace([3.0, 4.0], 10.0)
    np.testing.assert_allclose(half.support([[6.0, 8.0], [-3.0, -4.0], [1.0, 0.0]]), [20.0, np.inf, np.inf])
    assert half.contains([2.0, 1.0])
    assert not half.contains([2.0, 1.1])


def test_coordinates_select_states():
    ball = Ball([5.0, 0.0], 1.0, coordinates=(2, 0))
    assert ball.contains([0.5, 99.0, 5.0])
    assert not ball.contains([5.0, 99.0, 0.5])
    np.testing.assert_array_equal(ball.local([1.0, 2.0, 3.0]), [3.0, 1.0])
    np.testing.assert_allclose(ball.support([[0.0, 0.0, 1.0], [0.0, 1.0, 1.0]]), [6.0, np.inf])


def test_a_moving_centre_is_a_tape_over_time():
    ball = Ball(lambda t: [5 + 0.1 * t, 0.0], 0.9)
    assert ball.moving
    assert isinstance(ball.center, Tape)
    assert ball.center.inputs == ("t",)
    np.testing.assert_allclose(ball.center_at(10.0), [6.0, 0.0])
    assert ball.contains([6.0, 0.5], t=10.0)
    assert not ball.contains([6.0, 0.5], t=0.0)
    same = Ball(trace(lambda t: [5 + 0.1 * t, 0.0], {"t": ["t"]}), 0.9)
    np.testing.assert_array_equal(same.center_at(3.0), ball.center_at(3.0))


def test_a_moving_box_moves_and_a_fixed_centre_is_added():
    box = Box([-1, -1], [1, 1], center=lambda t: [t, 0.0])
    assert box.contains([3.5, 0.0], t=3.0)
    assert not box.contains([3.5, 0.0], t=1.0)
    fixed = Box([-1, -1], [1, 1], center=[10, 20])
    assert fixed.center is None
    np.testing.assert_array_equal(fixed.low, [9, 19])


def test_a_centre_that_does_not_move_is_an_array():
    ball = Ball(lambda t: [1.0, 2.0], 1.0)
    assert not ball.moving
    np.testing.assert_array_equal(ball.center, [1.0, 2.0])


def test_low_equal_to_high_is_a_point():
    box = Box([1.0, 2.0], [1.0, 2.0])
    assert box.contains([1.0, 2.0])
    np.testing.assert_array_equal(box.sample(np.random.default_rng(0), 3), [[1, 2]] * 3)


def test_a_ball_in_twelve_dimensions_is_sampled_uniformly():
    points = Ball(np.zeros(12), 2.0).sample(np.random.default_rng(0), 20_000)
    radii = np.linalg.norm(points, axis=1)
    assert radii.max() <= 2.0
    assert np.mean((radii / 2) ** 12) == pytest.approx(0.5, abs=0.02)


def test_coordinates_are_positions_and_nothing_is_cut_to_one():
    for wrong in (["a", "b"], "ab", [0, 1.5], 3):
        with pytest.raises(TypeError, match="`coordinates` must be indices of states, counted from 0, got"):
            Ball([0, 0], 1, coordinates=wrong)
    assert Ball([0, 0], 1, coordinates=np.array([2, 0])).coordinates == (2, 0)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Box([1, 2], [0, 3]), "`low` must not exceed `high`, got 1 > 0 in entry 0"),
        (lambda: Box([1, 2], [3]), "`high` must have 2 entries, got 1"),
        (lambda: Box([np.nan], [1]), "`low` must not contain nan"),
        (lambda: Box([np.inf], [np.inf]), "`low` must be below inf"),
        (lambda: Box([], []), "`low` must be a vector"),
        (lambda: Box([0], [1], coordinates=(0, 1)), "`coordinates` must be 1 distinct state indices"),
        (lambda: Box([0, 0], [1, 1], coordinates=(1, 1)), "`coordinates` must be 2 distinct"),
        (lambda: Box([0, 0], [1, 1], coordinates=(-1, 1)), "`coordinates` must be 2 distinct"),
        (lambda: Box([0, -np.inf], [1, 1]).sample(np.random.default_rng(0), 1), "infinite sides cannot be sampled"),
        (lambda: Ball([0, 0], -1), "`radius` must not be negative, got -1"),
        (lambda: Ball([0, np.inf], 1), "`center` must be finite"),
        (lambda: Ball([0, 0], np.nan), "must not contain nan"),
        (lambda: Ball([0, 0], [1, 2]), "`radius` must be one number"),
        (lambda: Ball(lambda t: [[t, t]], 1), r"must be a vector over \('t',\), got shape \(1, 2\)"),
        (lambda: Ball(trace(lambda x: x, {"x": ["x"]}), 1), r"must be a vector over \('t',\)"),
        (lambda: Ellipsoid([0, 0], [[1, 2], [2, 1]]), "`shape` must be positive definite"),
        (lambda: Ellipsoid([0, 0], [[1, 1], [0, 1]]), "`shape` must be symmetric"),
        (lambda: Ellipsoid([0, 0, 0], np.eye(2)), "`center` must have 2 entries, got 3"),
        (lambda: Ellipsoid(lambda t: [t], np.eye(2)), r"`center` must have 2 entries, got shape \(1,\)"),
        (lambda: HalfSpace([0, 0], 1), "`normal` must not be all 0"),
        (lambda: HalfSpace([1, 0], np.inf), "`bound` must be finite"),
        (lambda: HalfSpace([1, 0], 0).sample(np.random.default_rng(0), 1), "cannot be sampled"),
        (lambda: Polytope([[1, 0]], [1, 2]), "`b` must have 1 entries, got 2"),
        (lambda: Polytope([[0, 0]], [1]), "row that is all 0"),
        (lambda: Polytope([[1.0], [-1.0]], [0.0, -1.0]), "got an empty one"),
        (lambda: Polytope([[1.0, 0.0]], [1.0]).sample(np.random.default_rng(0), 1), "unbounded polytope"),
        (lambda: Box([0], [1]).contains([1, 2]), "must end in an axis of 1"),
        (lambda: Ball([0, 0], 1, coordinates=(0, 3)).contains([1, 2, 3]), "must have 4 or more entries"),
    ],
)
def test_bad_sets_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_a_complex_number_is_refused():
    with pytest.raises(TypeError, match="`low` must hold numbers"):
        Box([1j], [2])


def test_text_is_no_number():
    with pytest.raises(TypeError, match="`low` must hold numbers"):
        Box(["1"], ["2"])
    with pytest.raises(TypeError, match="`low` must hold numbers"):
        Box(["a"], ["b"])


@pytest.mark.parametrize("region", [Ball([0], 1), Ellipsoid([0], [[1]])])
def test_round_sets_have_no_faces(region):
    with pytest.raises(TypeError, match="is no polyhedron"):
        region.halfspaces()


def test_arrays_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        Box([0], [1]).low[0] = 5


def test_a_shape_is_symmetric_in_the_units_of_its_small_entries():
    large = np.diag([1e16, 2.0, 3.0])
    for asymmetry, refused in [(1e-13, False), (1e-2, True)]:
        shape = large + asymmetry * np.eye(3)[:, [0, 2, 1]] * [[0], [1], [0]]
        with pytest.raises(ValueError, match="must be symmetric") if refused else nullcontext():
            assert Ellipsoid([0, 0, 0], shape).shape[1, 2] == asymmetry / 2


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("room", [1.0, 1e-3])
def test_a_polytope_is_the_same_in_units_far_apart(seed, room):
    """Numbers of mixed units differ by many powers of ten, and none of them is too small to count."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    faces = np.vstack([np.eye(n), -np.eye(n), np.round(rng.standard_normal((2, n)), 2)])
    bounds = faces @ rng.standard_normal(n) + room * rng.random(len(faces))
    units, sizes = 10.0 ** rng.uniform(-8, 8, n), 10.0 ** rng.uniform(-6, 6, len(faces))
    turned = faces / units * sizes[:, None]
    here, there = Polytope(faces, bounds), Polytope(turned, bounds * sizes)
    directions = rng.standard_normal((6, n))
    np.testing.assert_allclose(there.support(directions / units), here.support(directions), atol=1e-6 * room)
    gap = np.append(bounds, -bounds[-1] - 1e-3 * room)  # beyond the last face
    with pytest.raises(ValueError, match="got an empty one"):
        Polytope(np.vstack([turned, -turned[-1]]), gap * np.append(sizes, sizes[-1]))


def test_what_no_face_bounds_has_no_end():
    assert Polytope([[0.0, 1e9]], [1e9]).support([[1e-9, 1.0], [0.0, 1.0]]).tolist() == [np.inf, 1.0]


def test_entries_that_rounding_left_do_not_set_the_scale():
    faces = np.vstack([np.eye(2), -np.eye(2)]) + np.array([[0, 6e-17], [6e-17, 0], [0, 0], [0, 0]])
    square = Polytope(faces, [1.0, 2.0, 1e-17, 0.0])
    np.testing.assert_allclose(square.support([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]), [1.0, 2.0, 0.0], atol=1e-12)
