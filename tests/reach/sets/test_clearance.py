"""Room of constraints around tubes."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.problem.sets.constraints import Inside, Outside
from certbound.problem.sets.regions import Ball, Box, Ellipsoid, HalfSpace, Polytope
from certbound.reach.nominal.curve import Curve
from certbound.reach.sets import clearance
from certbound.reach.sets.clearance import constraint_clearance
from certbound.reach.sets.reach_tube import ReachTube
from certbound.rigor.intervals import Interval
from certbound.rigor.norms import Norm

METRIC = np.array([[4.0, 1.0], [1.0, 0.5]])


def still(point, radius=0.0, metric=None, **parts) -> ReachTube:
    """One piece [0, 1] at rest."""
    curve = Curve(continuous=True, starts=[0.0], ends=[1.0], coefficients=[[[point]]])
    return ReachTube(curve=curve, radius=[[radius]], metric=metric, **parts)


def moving(pieces=8, cells=1) -> ReachTube:
    """The curve (cos t, sin t), t in [0, 2], as Taylor polynomials, in an ellipsoidal tube."""
    edges = np.linspace(0, 2, pieces + 1)
    middle = (edges[:-1] + edges[1:]) / 2
    scale = np.array([1, 1, 1 / 2, 1 / 6, 1 / 24, 1 / 120])
    orders = np.arange(6)
    coefficients = np.stack(
        [np.cos(middle[:, None] + orders * np.pi / 2) * scale, np.sin(middle[:, None] + orders * np.pi / 2) * scale], -1
    )
    stack = np.stack([coefficients + 0.1 * c * np.eye(6, 1)[None] for c in range(cells)])
    curve = Curve(continuous=True, starts=edges[:-1], ends=edges[1:], coefficients=stack)
    return ReachTube(curve=curve, radius=np.full((cells, pieces), 0.05), metric=METRIC)


def room(constraint, tube, metric=None) -> np.ndarray:
    return constraint_clearance(tube, constraint, Norm(2, metric)).radius


@pytest.mark.parametrize(
    ("constraint", "point", "expected"),
    [
        (Inside(HalfSpace([3.0, 4.0], 10.0)), [0.0, 0.0], 2.0),
        (Outside(HalfSpace([3.0, 4.0], -10.0)), [0.0, 0.0], 2.0),
        (Inside(Box([-1, -2], [3, 5])), [0.0, 0.5], 1.0),
        (Inside(Box([-np.inf, -np.inf], [np.inf, np.inf])), [0.0, 0.5], np.inf),
        (Inside(Ball([1.0, 0.0], 3.0)), [0.0, 0.0], 2.0),
        (Inside(Ball([1.0], 3.0, coordinates=(1,))), [7.0, 0.0], 2.0),
        (Outside(Ball([3.0, 4.0], 1.0)), [0.0, 0.0], 4.0),
        (Outside(Ball([3.0, 4.0], 0.0)), [0.0, 0.0], 5.0),
        (Inside(Ellipsoid([0.0, 0.0], np.diag([4.0, 1.0]))), [0.0, 0.0], 1.0),
        (Outside(Ellipsoid([5.0, 0.0], np.diag([4.0, 1.0]))), [0.0, 0.0], 3.0),
        (Outside(Box([3, -1], [4, 1])), [0.0, 0.0], 3.0),
        (Outside(Box([3, 4], [9, 9])), [0.0, 0.0], 5.0),
        (Outside(Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]], [-3.0, -4.0, 20.0])), [0.0, 0.0], 5.0),
        (Inside(Polytope([[1.0, 1.0], [-1.0, 0.0], [0.0, -1.0]], [2.0, 1.0, 5.0])), [0.0, 0.0], 1.0),
    ],
)
def test_euclidean_room_of_a_point_is_its_distance(constraint, point, expected):
    value = room(constraint, still(point))[0]
    if np.isinf(expected):
        assert value == np.inf
    else:
        assert expected * (1 - 1e-6) <= value <= expected


@pytest.mark.parametrize("metric", [None, METRIC])
def test_room_in_a_metric_divides_by_the_dual_norm(metric):
    a = np.array([1.0, 2.0])
    inverse = np.eye(2) if metric is None else np.linalg.inv(metric)
    expected = (4.0 - a @ [0.5, 0.25]) / np.sqrt(a @ inverse @ a)
    assert room(Inside(HalfSpace(a, 4.0)), still([0.5, 0.25]), metric)[0] == pytest.approx(expected, rel=1e-9)


def test_the_tubes_own_spread_is_subtracted_in_its_own_metric():
    expected = 2.0 - 0.5 * np.sqrt(np.array([0.6, 0.8]) @ np.linalg.inv(METRIC) @ np.array([0.6, 0.8]))
    tube = still([0.0, 0.0], radius=0.5, metric=METRIC)
    assert room(Inside(HalfSpace([3.0, 4.0], 10.0)), tube)[0] == pytest.approx(expected, rel=1e-9)


def test_zonotope_and_box_are_subtracted_too():
    tube = still([0.0, 0.0], generators=[[[[0.1, 0.3], [0.2, 0.0]]]], box=Interval([[[-0.5, 0.0]]], [[[0.25, 0.4]]]))
    assert room(Inside(HalfSpace([1.0, 1.0], 10.0)), tube)[0] == pytest.approx((10 - 0.6 - 0.65) / 2**0.5)
    assert room(Inside(HalfSpace([-1.0, 0.0], 10.0)), tube)[0] == pytest.approx(10 - 0.4 - 0.5)
    outside = room(Outside(Ball([10.0, 0.0], 1.0)), tube)[0]
    assert outside == pytest.approx(9 - 0.4 - 0.25)


@pytest.mark.parametrize("radius", [1.5e308, np.inf])
@pytest.mark.parametrize(
    "constraint",
    [Inside(Ball([0.0, 0.0], 1.0)), Inside(Ellipsoid([0.0, 0.0], np.diag([4.0, 1.0]))), Outside(Ball([9.0, 0.0], 1.0)),
     Inside(HalfSpace([3.0, 4.0], 1.0)), Outside(Box([3, 4], [9, 9]))],
)  # fmt: skip
def test_a_tube_whose_numbers_overflow_leaves_no_room(constraint, radius):
    assert room(constraint, still([0.0, 0.0], radius=radius, metric=METRIC))[0] < -1e308
    far = still([1e200, 0.0], radius=1.0)
    if not constraint.outside:
        assert room(constraint, far)[0] <= -1e199


def test_an_obstacle_in_a_metric_uses_its_nearest_point():
    # the exact distance in the P-norm from the origin to the disc, by sampling its boundary
    angles = np.linspace(0, 2 * np.pi, 200001)
    boundary = np.array([2.0, 1.0]) + 0.5 * np.stack([np.cos(angles), np.sin(angles)], -1)
    exact = np.sqrt(np.einsum("bi,ij,bj->b", boundary, METRIC, boundary)).min()
    value = room(Outside(Ball([2.0, 1.0], 0.5)), still([0.0, 0.0]), METRIC)[0]
    assert value == pytest.approx(exact, rel=1e-6)
    straight = (np.sqrt(5.0) - 0.5) / np.sqrt(np.array([2, 1]) @ np.linalg.inv(METRIC) @ np.array([2, 1]) / 5)
    assert value > 1.01 * straight


def test_a_box_obstacle_in_a_metric_uses_its_nearest_point():
    grid = np.stack(np.meshgrid(np.linspace(1, 2, 401), np.linspace(1, 2, 401)), -1).reshape(-1, 2)
    exact = np.sqrt(np.einsum("bi,ij,bj->b", grid, METRIC, grid)).min()
    value = room(Outside(Box([1, 1], [2, 2])), still([0.0, 0.0]), METRIC)[0]
    assert exact * (1 - 1e-3) <= value <= exact * (1 + 1e-9)


@pytest.mark.parametrize(
    "constraint",
    [
        Outside(Ball([3.0, 0.0], 1.0)),
        Inside(Ball([0.0, 0.0], 1.0)),
        Inside(Box([-1, -1], [1, 1])),
        Outside(Box([2, -1], [4, 1])),
        Outside(Ellipsoid([3.0, 0.0], np.eye(2))),
        Inside(HalfSpace([1.0, 0.0], 2.0)),
    ],
)
def test_a_violated_constraint_has_no_room(constraint):
    assert room(constraint, still([3.0, 0.0]))[0] < 0


@pytest.mark.parametrize(
    "constraint",
    [
        Inside(HalfSpace([1.0, 0.3], 1.5)),
        Inside(Box([-3, -2], [2, 2])),
        Inside(Ball([0.2, 0.1], 2.5)),
        Inside(Ellipsoid([0.0, 0.0], np.array([[6.0, 0.5], [0.5, 4.0]]))),
        Outside(Ball([2.0, 1.2], 0.4)),
        Outside(Ellipsoid([2.0, 1.2], np.array([[0.3, 0.1], [0.1, 0.2]]))),
        Outside(Box([1.6, 1.0], [3, 3])),
        Outside(Polytope([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]], [-2.6, 4.0, 4.0])),
        Outside(HalfSpace([0.0, 1.0], -1.0)),
        Inside(Ball(lambda t: [0.5 * np.sin(3 * t), 0.2 * t], 3.0)),
        Outside(Ball(lambda t: [2.0 + 0.3 * np.cos(4 * t), 1.5], 0.4)),
        Outside(Box([-0.2, -0.2], [0.3, 0.3], center=lambda t: [2.2, 1.5 * t])),
    ],
)
def test_every_point_within_the_room_keeps_the_constraint_and_the_room_is_not_wasted(constraint):
    tube = moving(cells=2)
    metric = np.array([[1.0, -0.4], [-0.4, 2.0]])
    radius = room(constraint, tube, metric)
    assert np.all(radius > 0)
    rng = np.random.default_rng(2)
    inner, outer = np.linalg.inv(np.linalg.cholesky(METRIC)).T, np.linalg.inv(np.linalg.cholesky(metric)).T
    broken = 0
    for k in range(tube.curve.pieces):
        for t in rng.uniform(tube.curve.starts[k], tube.curve.ends[k], 20):
            unit = rng.normal(size=(2, 400, 2))
            unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
            for centre in tube.curve.value(t):
                base = centre + 0.05 * unit[0] @ inner.T
                assert np.all(constraint.satisfied(base + radius[k] * unit[1] @ outer.T, t))
                broken += np.count_nonzero(~constraint.satisfied(base + 1.35 * radius[k] * unit[1] @ outer.T, t))
    assert broken > 0


def test_windows_confine_the_constraint_to_their_pieces():
    tube = moving()
    everywhere = room(Inside(HalfSpace([0.0, 1.0], 2.0)), tube)
    window = room(Inside(HalfSpace([0.0, 1.0], 2.0), during=(0.5, 1.0)), tube)
    asked = np.isfinite(window)
    assert asked.tolist() == [(e >= 0.5 and s <= 1.0) for s, e in zip(tube.curve.starts, tube.curve.ends)]
    assert np.all(window[asked] >= everywhere[asked])


def test_a_terminal_constraint_sees_the_last_instant_only():
    tube = moving(pieces=2)
    value = room(Inside(HalfSpace([0.0, 1.0], 2.0), during=(2.0, 2.0)), tube)
    spread = 0.05 * np.sqrt(np.linalg.inv(METRIC)[1, 1])
    assert np.isinf(value[0])
    assert value[1] == pytest.approx(2.0 - np.sin(2.0) - spread, abs=3e-3)


def test_coordinates_pick_states():
    curve = Curve(continuous=False, starts=[0.0], ends=[0.0], coefficients=[[[[9.0, 1.0, 2.0, 9.0]]]])
    tube = ReachTube(curve=curve)
    value = constraint_clearance(tube, Outside(Ball([4.0, 6.0], 1.0, coordinates=(1, 2))), Norm(4)).radius
    assert value[0] == pytest.approx(4.0)


def test_a_fast_obstacle_is_not_missed_between_nodes():
    """A small ball that crosses the state in the middle of the only piece, far away at both ends."""
    tube = still([0.0, 0.0])
    crossing = Outside(Ball(lambda t: [40.0 * (t - 0.5), 0.0], 0.1))
    assert room(crossing, tube)[0] < 0
    passing = Outside(Ball(lambda t: [40.0 * (t - 0.5), 3.0], 0.1))
    assert room(passing, tube)[0] == pytest.approx(2.9, rel=1e-6)


def test_a_jumping_centre_is_covered_on_both_sides():
    tube = still([0.0, 0.0])
    jumping = Outside(Ball(lambda t: [np.where(t < 0.25, -3.0, 5.0), 4.0], 1.0))
    value = room(jumping, tube)[0]
    assert value <= 4.0 or value == -np.inf


def test_an_obstacle_that_is_everywhere_leaves_no_room():
    assert room(Outside(Box([-np.inf, -np.inf], [np.inf, np.inf])), still([0.0, 0.0]))[0] == -np.inf


def test_twelve_states():
    curve = Curve(continuous=True, starts=[0.0], ends=[1.0], coefficients=np.zeros((1, 1, 1, 12)))
    metric = np.diag(np.arange(1.0, 13.0))
    tube = ReachTube(curve=curve, radius=[[0.5]], metric=metric)
    value = constraint_clearance(tube, Inside(Box(-np.ones(12), np.ones(12))), Norm(12, metric)).radius[0]
    assert value == pytest.approx(0.5, rel=1e-9)
    ball = constraint_clearance(tube, Outside(Ball(np.full(12, 1.0), 0.1)), Norm(12, metric)).radius[0]
    assert 0 < ball < np.sqrt(78.0)


def test_a_face_of_one_state_asks_for_nothing_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, combined = [], clearance._combined
    monkeypatch.setattr(clearance, "_combined", lambda r, w: seen.append(len(r)) or combined(r, w))
    sides = np.array([0.5, 2.0, 1.0])
    assert room(Inside(Box(-sides, sides)), still([0.0, 0.1, 0.25]))[0] == pytest.approx(0.5, rel=1e-12)
    assert seen == [1] * 6
