"""The engine of quadratic value bounds: what it asks of the search."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.safety.answers import Request
from certbound.safety.engines import quadratic, quadratic_engine
from certbound.watch import Watch


def test_a_first_bound_is_what_the_first_walls_say_and_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []

    def search(problem: cb.Problem, **options: Any) -> None:
        asked.append(options)
        raise InfeasibleError("nothing.")

    monkeypatch.setattr(quadratic, "bound_quadratic", search)
    system = cb.ContinuousSystem(lambda x: [-x[i] for i in range(4)], states=4, diffusion=0.1 * np.eye(4))
    problem = cb.Problem(system, initial=[0] * 4, safe=[cb.Inside(cb.Box([-1] * 4, [1] * 4))], horizon=1, delta=1e-3)
    with Watch(60.0).running():
        quadratic_engine(problem, Request(first=True, thorough=False))
        quadratic_engine(problem, Request(thorough=False))
    first, later = asked
    assert first["target"] == 1.0  # whatever is found, and nothing, is enough
    assert first["seconds"] < 5 < later["seconds"]
    assert later["target"] == 1e-3


@pytest.mark.parametrize("obstacle", [cb.Box([0], [1]), cb.HalfSpace([-1.0], 0.0), cb.Box([0], [0]), cb.Ball([1], 1.0)])
@pytest.mark.parametrize("method", ["constants", "quadratic", "linear", "values"])
def test_who_starts_on_the_edge_of_an_obstacle_has_failed(obstacle, method: str) -> None:
    """The first step leads away, and was all that constants and quadratic bounds looked at in discrete time."""
    system = cb.DiscreteSystem(lambda x: [x[0] - 1], states=1, noise=cb.Gaussian(std=0.05))
    safe = [cb.Outside(obstacle), cb.Inside(cb.Box([-50], [50]))]
    problem = cb.Problem(system, initial=[0.0], safe=safe, horizon=1, delta=0.3)
    assert cb.verify_safety(problem, method=method, time_limit=5).log10_delta == 0


_SQUARE, _DISC = cb.Box([-0.5, -0.5], [0.5, 0.5]), cb.Ball([0.0, 0.0], 0.5)


@pytest.mark.parametrize(("start", "obstacle", "apart"), [
    (_SQUARE, cb.Polytope([[-1, 0], [0, -1], [1, 1]], [-0.4, -0.4, 1.4]), False),  # a corner of it
    (_SQUARE, cb.Polytope([[-1, 0], [0, -1], [1, 1]], [-0.5, 0, 4]), False),  # a face of it, from beside
    (_SQUARE, cb.Polytope([[1, 1], [-1, -1]], [1, -1]), False),  # of no width, at a corner
    (_DISC, cb.Box([0.5, -1], [2, 1]), False),
    (_SQUARE, cb.Polytope([[1, -1], [1, 1], [-1, 0]], [2, 2, -0.6]), True),
    (_SQUARE, cb.Polytope([[-3, 1], [1, -3]], [-1.5, -1.5]), True),  # its apex is kept off by a sum of faces alone
    (_DISC, cb.Box([0.6, -1], [2, 1]), True),
])  # fmt: skip
def test_in_discrete_time_starts_are_shown_to_keep_off_obstacles(start, obstacle, apart: bool) -> None:
    """Starts that reach into one, or to its edge, have failed; the steps that V looks at lead away from it."""
    system = cb.DiscreteSystem(lambda x: 0.1 * x, states=2, noise=cb.Uniform(halfwidth=0.02))
    safe = [cb.Inside(cb.Box([-3, -3], [3, 3])), cb.Outside(obstacle)]
    problem = cb.Problem(system, initial=start, safe=safe, horizon=3, delta=0.1)
    found = quadratic_engine(problem, Request())
    assert found.log10_delta < -10 if apart else not found.applicable
