"""Constraints as rows along a nominal curve: sets in some coordinates, sets that move."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.reach.sets.directions import NominalPieces, requirements

SYSTEM = cb.ContinuousSystem(lambda x: [-x[0], -x[1], -x[2]], states=3, diffusion=0.1 * np.eye(3))
TIMES = np.linspace(0.0, 2.0, 21)


def still(point: list[float]) -> NominalPieces:
    """A curve that rests at a point."""
    return NominalPieces(times=TIMES, controls=np.tile(np.array(point), (20, 1, 1)), continuous=True)


def rooms(constraint: Any, point: list[float]) -> list[Any]:
    problem = cb.Problem(SYSTEM, initial=point, safe=[constraint], horizon=2)
    return requirements(problem, still(point))


def test_a_box_in_some_coordinates_asks_nothing_of_the_others() -> None:
    found = rooms(cb.Inside(cb.Box([-1, -2], [1, 2], coordinates=(2, 0))), [0.5, 9.0, 0.25])
    assert [np.flatnonzero(r.rows[0]).tolist() for r in found] == [[2], [0], [2], [0]]
    np.testing.assert_allclose([r.room[0] for r in found], [0.75, 1.5, 1.25, 2.5], rtol=1e-12)


def test_a_side_of_a_box_is_named_by_its_inequality_and_by_the_users_words_if_there_are_any() -> None:
    box = cb.Box([-1, -2], [1, 2], coordinates=(2, 0))
    sides = [r.label for r in rooms(cb.Inside(box), [0.5, 9.0, 0.25])]
    assert sides == ["x3 <= 1", "x1 <= 2", "x3 >= -1", "x1 >= -2"]
    named = [r.label for r in rooms(cb.Inside(box, label="lane"), [0.5, 9.0, 0.25])]
    assert named[0] == "lane, side 1 (x3 <= 1)"


def test_the_rooms_of_a_moving_box_move_with_it() -> None:
    box = cb.Box([-1, -1, -1], [1, 1, 1], center=lambda t: [0.3 * t, 0, 0])
    upper, lower = (r.room for r in rooms(cb.Inside(box), [0.0, 0.0, 0.0])[::3])
    np.testing.assert_allclose(upper, 1 + 0.3 * TIMES[:-1], atol=1e-9)  # least over the piece: at its start
    np.testing.assert_allclose(lower, 1 - 0.3 * TIMES[1:], atol=1e-9)


def test_the_best_facet_of_a_moving_obstacle_is_chosen_where_the_obstacle_is() -> None:
    box = cb.Box([-1, -1], [0, 1], center=lambda t: [0.2 * t, 0], coordinates=(0, 1))
    (found,) = rooms(cb.Outside(box), [1.0, 0.0, 0.0])
    np.testing.assert_allclose(found.rows, np.tile([-1.0, 0.0, 0.0], (20, 1)))
    np.testing.assert_allclose(found.room, 1 - 0.2 * TIMES[1:], atol=1e-9)


def test_a_corner_is_kept_off_by_a_mixture_of_its_faces() -> None:
    rng = np.random.default_rng(3)
    corner = cb.Box([1, 2], [4, np.inf], coordinates=(2, 0))  # x3 >= 1 and x1 >= 2
    problem = cb.Problem(SYSTEM, initial=[0, 0, 0], safe=[cb.Outside(corner)], horizon=2)
    root = rng.normal(size=(20, 3, 3))
    covariance = root @ root.transpose(0, 2, 1)
    points = rng.normal(size=(20, 3)) * 0.3
    curve = NominalPieces(times=TIMES, controls=points[:, None], continuous=True, covariance=covariance)
    (found,) = requirements(problem, curve)
    deviation = np.sqrt(np.einsum("ki,kij,kj->k", found.rows, covariance, found.rows))
    for state, bound in ((2, 1.0), (0, 2.0)):  # never worse than a single face, often better
        single = (bound - points[:, state]) / np.sqrt(covariance[:, state, state])
        assert np.all(found.room / deviation > single - 1e-9)
    assert np.mean(np.count_nonzero(found.rows, axis=1) == 2) > 0.2
    inside = np.stack([rng.uniform(2, 9, 500), rng.normal(size=500), rng.uniform(1, 4, 500)], axis=1)
    reached = np.einsum("ki,ksi->ks", found.rows, inside[None] - points[:, None])
    assert np.all(reached >= found.room[:, None] - 1e-9)
    # on the boundary of the half-space lies a point of the obstacle
    assert np.all((found.rows @ np.array([2.0, 0.0, 1.0]) - np.sum(found.rows * points, axis=1)) < found.room + 1e-9)


def test_keeping_outside_all_states_is_refused() -> None:
    box = cb.Box([-np.inf] * 3, [np.inf] * 3)
    problem = cb.Problem(SYSTEM, initial=[0, 0, 0], safe=[cb.Outside(box, during=(1, 2))], horizon=2)
    with pytest.raises(ValueError, match="must not keep outside all states"):
        requirements(problem, still([0.0, 0.0, 0.0]))
