"""Walls, working boxes, and what is refused."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.quadratic import bound_quadratic
from certbound.quadratic.setting import make_setting, safe_sides
from certbound.quadratic.working_boxes import working_box
from certbound.safety.answers import Request
from certbound.safety.engines import quadratic_engine
from certbound.watch import Watch

PUSHED = cb.ContinuousSystem(lambda x: [x[1], -x[0] - x[1]], states=["p", "v"], diffusion=[[0.0], [0.3]])


def of(safe: list[Any], **changes: Any) -> cb.Problem:
    asked: dict[str, Any] = {"initial": [0.0, 0.0], "horizon": 1.0, "delta": 0.01} | changes
    return cb.Problem(changes.pop("system", PUSHED), safe=safe, **{k: v for k, v in asked.items() if k != "system"})


def labels(problem: cb.Problem) -> list[str]:
    return [wall.label for wall in make_setting(problem, *working_box(problem, 4.0)).walls]


def test_a_state_without_bounds_gets_sides_that_are_paid_for() -> None:
    problem = of([cb.Inside(cb.Box([-1.0, -np.inf], [1.0, np.inf]))])
    low, high = working_box(problem, 4.0)
    assert np.isfinite([low, high]).all()
    assert not np.isfinite(safe_sides(problem)[0][1])
    assert labels(problem) == ["p below", "p above", "v below", "v above"]
    found = bound_quadratic(problem, target=1.0, seconds=60.0)
    seen = cb.simulate_exits(problem, paths=4000, rng=np.random.default_rng(0), halve=False)
    assert seen.lower <= 10**found.upper < 0.5


def test_sides_are_named_by_the_inequality_that_holds_within() -> None:
    setting = make_setting(of([cb.Inside(cb.Box([-1.0, -np.inf], [1.0, np.inf]))]), np.array([-1.0, -2.0]), np.ones(2))
    assert [setting.name_of(wall) for wall in setting.walls] == [
        "p >= -1", "p <= 1",
        "v >= -2, a side of a box that certbound chose", "v <= 1, a side of a box that certbound chose",
    ]  # fmt: skip


def test_a_side_without_noise_is_left_only_where_the_drift_points_outward() -> None:
    setting = make_setting(of([]), -np.ones(2), np.ones(2))
    forms = {wall.label: wall.forms for wall in setting.walls}
    assert [len(forms[name]) for name in ("p below", "p above", "v below", "v above")] == [1, 1, 0, 0]
    z = np.array([1.0, 0.5, 1.0])  # p = 1, v = .5: outward
    assert z @ forms["p above"].mid[0] @ z > 0 > z @ forms["p below"].mid[0] @ z


def test_a_side_that_nothing_crosses_is_no_wall() -> None:
    system = cb.ContinuousSystem(lambda x: [0.1 * x[0] * x[1], -x[1]], states=["a", "b"],
                                 diffusion=lambda x: [[0.2 * x[0], 0.0], [0.0, 0.1]])  # fmt: skip
    problem = cb.Problem(system, initial=[1.0, 0.0], safe=[cb.Inside(cb.Box([0.0, -1.0], [3.0, 1.0]))], horizon=1.0)
    names = [wall.label for wall in make_setting(problem, *safe_sides(problem)).walls]
    assert names == ["a above", "b below", "b above"]


def test_half_spaces_balls_and_obstacles_are_walls() -> None:
    safe = [
        cb.Inside(cb.Ball([0.0, 0.0], 1.0)), cb.Inside(cb.HalfSpace([1.0, 1.0], 0.9)),
        cb.Outside(cb.Ball([-0.6, 0.0], 0.1)), cb.Outside(cb.Box([0.3, -0.9], [0.9, -0.6])),
    ]  # fmt: skip
    problem = of(safe)
    assert len([name for name in labels(problem) if "inside" in name or "<=" in name]) == 3
    assert "outside" in labels(problem)[2]
    found = bound_quadratic(problem, target=1.0, seconds=60.0)
    seen = cb.simulate_exits(problem, paths=4000, rng=np.random.default_rng(0), halve=False)
    assert seen.lower <= 10**found.upper < 1


def test_disturbances_are_covered() -> None:
    pushed = cb.ContinuousSystem(lambda x, d: [x[1], -x[0] - x[1] + d[0]], states=2, diffusion=[[0.05], [0.3]],
                                 disturbance=cb.Box([-0.4], [0.4]))  # fmt: skip
    problem = of([cb.Inside(cb.Box([-0.6, -1.0], [0.6, 1.0]))], system=pushed)
    found = bound_quadratic(problem, target=1.0, seconds=60.0)
    worst = cb.ContinuousSystem(lambda x: [x[1], -x[0] - x[1] + 0.4], states=2, diffusion=[[0.05], [0.3]])
    seen = cb.simulate_exits(problem.replace(system=worst), paths=4000, rng=np.random.default_rng(0), halve=False)
    assert seen.lower <= 10**found.upper < 1
    assert 10**found.upper > 10 ** bound_quadratic(of(problem.safe), target=1.0, seconds=60.0).upper


@pytest.mark.parametrize(
    ("problem", "reason"),
    [
        (of([cb.Inside(cb.Box([-1, -1], [1, 1]), during=(0.0, 0.5))]), "windows of time"),
        (of([cb.Inside(cb.Ball(lambda t: [t, 0.0], 1.0))]), "moving sets"),
        (of([cb.Inside(cb.Ellipsoid([0.0, 0.0], np.diag([1.0, 2.0])))]), "ellipsoids"),
        (of([cb.Inside(cb.Box([-1, -1], [1, 1]))], initial=cb.GaussianStart([0, 0], 0.01 * np.eye(2))), "random start"),
        (of([cb.Inside(cb.Box([-1, -1], [1, 1]))], initial=cb.Box([-1, 0], [0, 0])), "reach the boundary"),
    ],
)
def test_what_is_not_served_is_an_answer(problem: cb.Problem, reason: str) -> None:
    answer = quadratic_engine(problem)
    assert not answer.applicable
    assert reason in answer.reason


@pytest.mark.parametrize(("limit", "thorough", "most"), [(40, True, 40), (40, False, 5), (None, True, 20)])
def test_who_asks_for_it_alone_gives_it_all_of_his_time(
    monkeypatch: pytest.MonkeyPatch, limit: float | None, thorough: bool, most: float
) -> None:
    granted: list[float] = []

    def bounded(problem: cb.Problem, *, seconds: float, **options: Any) -> Any:
        granted.append(seconds)
        raise InfeasibleError("nothing")

    monkeypatch.setattr(sys.modules[quadratic_engine.__module__], "bound_quadratic", bounded)
    cooling = cb.ContinuousSystem(lambda x: [-x[0], -x[1], -x[2]], states=3, diffusion=0.1 * np.eye(3))
    with Watch(limit).running():
        quadratic_engine(of([cb.Inside(cb.Box([-1] * 3, [1] * 3))], system=cooling, initial=[0] * 3),
                         Request(thorough=thorough))  # fmt: skip
    assert granted[0] == pytest.approx(most, abs=0.5)


@pytest.mark.filterwarnings("error")
def test_sampled_paths_whose_squares_overflow_run_away() -> None:
    """Steps of 1/300 of the horizon: a swing of 48 rad a second grows by four a step."""
    fast = cb.ContinuousSystem(lambda x: [x[1], -2300 * x[0]], states=["p", "v"], diffusion=[[0.0], [0.3]])
    slanted = cb.Inside(cb.HalfSpace([1.0, 0.01], 5.0))
    with pytest.raises(InfeasibleError, match="run away"):
        bound_quadratic(of([slanted], system=fast, horizon=24.8))
