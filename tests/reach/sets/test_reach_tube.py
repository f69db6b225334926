"""Reach tubes: membership, support, extents, distances."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.problem.sets.constraints import Inside, Outside
from certbound.problem.sets.regions import Ball, HalfSpace
from certbound.reach.nominal.curve import Curve
from certbound.reach.sets.reach_tube import ReachTube
from certbound.rigor.intervals import Interval

METRIC = np.array([[2.0, 0.6], [0.6, 1.0]])


def general(seed=0, cells=2, pieces=3, n=2) -> ReachTube:
    rng = np.random.default_rng(seed)
    edges = np.linspace(0, 1.5, pieces + 1)
    curve = Curve(
        continuous=True,
        starts=edges[:-1],
        ends=edges[1:],
        coefficients=rng.normal(size=(cells, pieces, 4, n)),
    )
    low = rng.uniform(-0.3, 0.0, (cells, pieces, n))
    return ReachTube(
        curve=curve,
        radius=rng.uniform(0.1, 0.4, (cells, pieces)),
        metric=METRIC if n == 2 else np.diag(np.arange(1.0, n + 1)),
        generators=0.2 * rng.normal(size=(cells, pieces, n, 3)),
        box=Interval(low, low + 0.4),
    )


def members(tube: ReachTube, piece: int, rng: np.random.Generator, count: int = 300) -> tuple[float, np.ndarray]:
    """A time in the piece and random points of the set at that time."""
    t = float(rng.uniform(tube.curve.starts[piece], tube.curve.ends[piece]))
    cell = int(rng.integers(tube.curve.cells))
    n = tube.curve.dimension
    unit = rng.normal(size=(count, n))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    ellipsoid = tube.radius[cell, piece] * unit @ np.linalg.inv(np.linalg.cholesky(tube.metric)).T.T
    zonotope = rng.choice([-1.0, 1.0], (count, 3)) @ tube.generators[cell, piece].T
    box = np.where(rng.random((count, n)) < 0.5, tube.box.lo[cell, piece], tube.box.hi[cell, piece])
    return t, tube.curve.value(t)[cell] + ellipsoid + zonotope + box


def test_random_members_are_contained_and_supported():
    tube, rng = general(), np.random.default_rng(1)
    for piece in range(3):
        t, points = members(tube, piece, rng)
        directions = rng.normal(size=(20, 2))
        support = tube.support(directions, piece)
        assert np.all(points @ directions.T <= support + 1e-12)
        assert np.all((points - tube.center(t)) @ directions.T <= tube.extent(directions, t) + 1e-12)
        hull = tube.pieces[piece]
        assert np.all(hull.low <= points.min(axis=0) + 1e-12)
        assert np.all(points.max(axis=0) <= hull.high + 1e-12)
        for point in points[:25]:
            assert tube.contains(t, point)


def test_points_beyond_the_support_are_not_contained():
    tube, rng = general(cells=1), np.random.default_rng(2)
    for direction in rng.normal(size=(20, 2)):
        direction /= np.linalg.norm(direction)
        reach = float(tube.extent(direction, 0.2))
        assert not tube.contains(0.2, tube.center(0.2) + (reach + 1e-4) * direction)


def test_support_over_a_piece_sees_its_whole_time():
    curve = Curve(continuous=True, starts=[0.0], ends=[2.0], coefficients=[[[[1.0], [0.0], [-1.0]]]])
    tube = ReachTube(curve=curve)
    assert tube.support([1.0], 0) == pytest.approx(1.0)
    assert tube.support([-1.0], 0) == pytest.approx(0.0, abs=1e-12)


def test_a_common_end_belongs_to_both_pieces():
    curve = Curve(continuous=True, starts=[0.0, 1.0], ends=[1.0, 2.0], coefficients=np.zeros((1, 2, 1, 1)))
    tube = ReachTube(curve=curve, radius=[[0.5, 0.1]])
    assert tube.contains(1.0, [0.4])
    assert not tube.contains(1.5, [0.4])


def test_discrete_time_has_steps_only():
    curve = Curve(continuous=False, starts=[0, 1], ends=[0, 1], coefficients=[[[[0.0]], [[2.0]]]])
    tube = ReachTube(curve=curve, radius=[[0.1, 0.2]])
    assert tube.contains(1, [2.15])
    with pytest.raises(ValueError, match="whole number of steps"):
        tube.contains(0.5, [1.0])
    with pytest.raises(ValueError, match=r"`t` must lie in \[0, 1\]"):
        tube.contains(2, [1.0])


def test_distances_are_euclidean_and_the_least_over_pieces_and_cells():
    tube = general()
    constraint = Inside(HalfSpace([3.0, 4.0], 100.0))
    supports = [float(tube.support([0.6, 0.8], k)) for k in range(3)]
    assert tube.distance_to(constraint) == pytest.approx(20.0 - max(supports), rel=1e-9)
    ball = Outside(Ball([40.0, 0.0], 1.0))
    directions = np.stack([np.cos(a := np.linspace(-1, 1, 2001)), np.sin(a)], -1)
    exact = min(np.max(40 * directions[:, 0] - 1 - tube.support(directions, k)) for k in range(3))
    assert exact * 0.99 <= tube.distance_to(ball) <= exact * (1 + 1e-3)
    asked_never = Inside(HalfSpace([1.0, 0.0], 1.0), during=(9.0, 9.0))
    assert tube.distance_to(asked_never) == np.inf


def test_growing_by_a_deviation_adds_to_the_radius():
    tube = general()
    grown = tube.grown([0.1, 0.2, 0.3], log10_delta=-3.0, method="kummer")
    assert grown.noise
    assert grown.log10_delta == -3.0
    assert grown.radius == pytest.approx(tube.radius + np.array([0.1, 0.2, 0.3]))
    assert np.all(grown.radius >= tube.radius + np.array([0.1, 0.2, 0.3]))


def test_until_keeps_the_first_pieces():
    tube = general().until(2)
    assert tube.curve.pieces == 2
    assert tube.end == pytest.approx(1.0)
    assert len(tube.pieces) == 2


def test_twelve_states():
    tube, rng = general(n=12, cells=1), np.random.default_rng(3)
    t, points = members(tube, 1, rng, 50)
    directions = rng.normal(size=(30, 12))
    assert np.all(points @ directions.T <= tube.support(directions, 1) + 1e-12)
    assert all(tube.contains(t, point) for point in points[:5])


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"radius": [[1.0]]}, "`radius` must be nonnegative"),
        ({"radius": -np.ones((2, 3))}, "`radius` must be nonnegative"),
        ({"generators": np.zeros((2, 3, 5, 1))}, "`generators` must have shape"),
        ({"box": Interval.point(np.zeros((2, 3, 5)))}, "`box` must have shape"),
    ],
)
def test_malformed_parts_are_refused(change, match):
    with pytest.raises(ValueError, match=match):
        general().altered(**change)
