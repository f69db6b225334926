"""Faces: distances, erosions and CasADi expressions that agree."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.problem.adapters.casadi import casadi_module
from certbound.synthesis.faces import Facets, Plane, Round, faces_of

SYSTEM = cb.linear_system(np.eye(3) * 0.9, np.eye(3), inputs=cb.Box([-1] * 3, [1] * 3), time="discrete")
SETS = {
    "inside a half-space": cb.Inside(cb.HalfSpace([1, -2, 0.5], 9)),
    "inside a box": cb.Inside(cb.Box([-9, -9], [9, 9], coordinates=(2, 0))),
    "inside a ball": cb.Inside(cb.Ball([0.5, 0.5], 8.0, coordinates=(0, 1))),
    "inside a ball of three": cb.Inside(cb.Ball([0.5, 0.5, 0.5], 9.0)),
    "inside an ellipsoid": cb.Inside(cb.Ellipsoid([0, 0], [[60, 10], [10, 80]], coordinates=(1, 2))),
    "outside a ball": cb.Outside(cb.Ball([4.0, 4.0], 1.0, coordinates=(0, 2))),
    "outside a moving ball": cb.Outside(cb.Ball(lambda t: [4 + t, 4.0], 1.0, coordinates=(0, 2))),
    "outside an ellipsoid": cb.Outside(cb.Ellipsoid([5, 5, 5], np.diag([1.0, 2.0, 3.0]))),
    "outside a half-space": cb.Outside(cb.HalfSpace([1, 1, 0], -9)),
    "outside a box": cb.Outside(cb.Box([3, 3], [4, 5], coordinates=(1, 0))),
    "outside a polytope": cb.Outside(cb.Polytope([[1, 0, 0], [0, 1, 0], [-1, -1, -1]], [-3, -3, 12])),
}


def faces(constraint: Any) -> Any:
    return faces_of(cb.Problem(SYSTEM, initial=[0, 0, 0], safe=[constraint], horizon=5))


@pytest.mark.parametrize("name", SETS)
def test_the_erosion_of_a_ball_covers_every_point_of_it(name: str) -> None:
    rng = np.random.default_rng(1)
    states, radius, times = rng.uniform(-2, 2, (40, 3)), 0.3, np.full(40, 1.0)
    shifts = rng.standard_normal((200, 3))
    shifts *= radius / np.linalg.norm(shifts, axis=1, keepdims=True)
    found, satisfied = faces(SETS[name]), []
    for face in found:
        erosion = face.erosion(radius * np.linalg.norm(face.rows(states, times), axis=-1))
        satisfied.append(face.room(states, times, erosion) >= 0)
    kept = np.all(satisfied, axis=0)
    moved = (states[kept][:, None] + shifts[None]).reshape(-1, 3)
    assert kept.any()
    assert np.all(SETS[name].satisfied(moved, 1.0))


@pytest.mark.parametrize("name", SETS)
def test_expression_and_numbers_agree(name: str) -> None:
    ca = casadi_module()
    rng = np.random.default_rng(2)
    for face in faces(SETS[name]):
        state, taken = rng.uniform(-2, 2, 3), rng.uniform(0.1, 0.4, face.parts)
        room = face.room(state[None], np.array([2.0]), taken[None])[0]
        weights = face.best(state[None], np.array([2.0]), taken[None])[0] if isinstance(face, Facets) else np.zeros(0)
        z = ca.SX.sym("z", 3)
        gap = face.gap(ca, z, ca.SX(2.0), ca.DM(taken), ca.DM(weights))
        value = float(ca.Function("g", [z], [gap])(state))
        assert value == pytest.approx(room, abs=2e-2 if isinstance(face, Round) and not face.outside else 1e-6)
        assert value <= room + 1e-6  # smoothing never adds room


def test_a_face_is_asked_within_its_window_only() -> None:
    (face,) = faces(cb.Inside(cb.HalfSpace([1, 0, 0], 1), during=(2, 3)))
    assert face.asked(np.arange(6.0)).tolist() == [False, False, True, True, False, False]


def test_infinite_sides_make_no_face() -> None:
    found = faces(cb.Inside(cb.Box([-np.inf, -1, -np.inf], [np.inf, np.inf, 2])))
    assert [type(face) for face in found] == [Plane, Plane]
    assert {tuple(face.normal) for face in found} == {(0.0, -1.0, 0.0), (0.0, 0.0, 1.0)}
