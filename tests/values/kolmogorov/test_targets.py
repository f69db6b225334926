"""Targets: a path that is in one has not failed, and one that is in none by the end has."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_banded

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.values.kolmogorov import bound_failing
from certbound.values.kolmogorov.box_setting import stages_of
from certbound.values.kolmogorov.door import largest_at_start, refined, side_of, starts_in

AHEAD = cb.HalfSpace([-1, 0], -1)  # x >= 1
WINDOWS = {"always": None, "late": (2.0, 3.0), "early": (0.0, 2.0), "once": (3.0, 3.0)}


def problem(during: tuple[float, float] | None) -> cb.Problem:
    """x drifts toward the target and fails at -0.6; y is free."""
    system = cb.ContinuousSystem(lambda x, y: [0.6, -y], states=["x", "y"], diffusion=0.4 * np.eye(2))
    stay = [cb.Inside(cb.Box([-0.6, -np.inf], [np.inf, np.inf]))]
    return cb.Problem(system, initial=[0, 0], safe=stay, reach=cb.Reach(AHEAD, during=during), horizon=3.0)


def truth(during: tuple[float, float] | None, steps: int = 1500) -> float:
    """What fails, by Crank and Nicolson's scheme for x."""
    first, last = during or (0.0, 3.0)
    x = np.linspace(-0.6, 5.4, 1201)
    gap, h = x[1] - x[0], 3.0 / steps
    there = x >= 1 - 1e-9
    a = np.where(there, 1.0, 0.0)
    for k in range(round(last / h)):
        arrives = last - (k + 0.5) * h > first
        moves = (x > -0.6) & (x < x[-1]) & ~(there & arrives)
        if k == round((last - first) / h):
            a = np.where(there, 1.0, a)
        share = 1.0 if k < 8 or 0 <= k - round((last - first) / h) < 8 else 0.5
        up, down = ((0.08 / gap**2 + sign * 0.6 / (2 * gap)) * moves for sign in (1, -1))
        right = a + (1 - share) * h * (up * np.roll(a, -1) + down * np.roll(a, 1) - (up + down) * a)
        rows = np.array([np.roll(-share * h * up, 1), 1 + share * h * (up + down), np.roll(-share * h * down, -1)])
        a = solve_banded((1, 1), rows, right)
    return float(1 - np.interp(0.0, x, a))


def test_a_target_counts_in_the_stages_of_its_window_and_is_due_at_the_end_of_it() -> None:
    before, within = stages_of(problem((1.0, 2.0)))
    assert before.target is None
    assert within.target[0, 0, 0] == pytest.approx(1.0)
    assert within.horizon == 2.0
    assert within.due_low[0, 0] == pytest.approx(1.0)
    (alone,) = stages_of(problem((3.0, 3.0)))
    assert alone.target is None
    assert alone.due_low[1, 0] == pytest.approx(1.0)


def test_starts_that_meet_the_target_or_are_random_are_refused() -> None:
    asked = problem(None)
    for start in (cb.Box([0, 0], [1.2, 0]), cb.GaussianStart([0, 0], 0.01 * np.eye(2))):
        with pytest.raises((InfeasibleError, ValueError), match="target"):
            stages_of(asked.replace(initial=start))


@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize("name", WINDOWS)
def test_a_target_is_missed_as_often_as_the_bounds_say(name: str, above: bool) -> None:
    asked, exact = problem(WINDOWS[name]), truth(WINDOWS[name])
    side, starts = side_of(stages_of(asked), 0.07, 30, above), starts_in(asked)
    for stage in side.stages[::-1]:
        stage.propose()
    estimate = largest_at_start(side, starts)[0]
    bound, _, _ = refined(side, starts)
    if above:
        assert 0.97 * exact < estimate < 2.5 * exact
        assert bound >= 0.995 * exact
    else:
        assert 0.4 * exact < -estimate < 1.1 * exact
        assert -bound <= 1.005 * exact


@pytest.mark.slow
@pytest.mark.parametrize("name", WINDOWS)
def test_the_bounds_are_close_where_there_is_time(name: str) -> None:
    exact = truth(WINDOWS[name])
    found = list(bound_failing(problem(WINDOWS[name]), seconds=30))[-1]
    assert found.lower <= 1.005 * exact
    assert 0.995 * exact <= found.upper < 2 * exact


def boxed() -> cb.Problem:
    system = cb.ContinuousSystem(lambda x, y: [-x, -y], states=["x", "y"], diffusion=0.5 * np.eye(2))
    stay = [cb.Inside(cb.Box([-1.5, -1.5], [1.5, 1.5]))]
    target = cb.Reach(cb.Box([-0.3, -0.3], [0.3, 0.3]))
    return cb.Problem(system, initial=[0.8, 0.5], safe=stay, reach=target, horizon=3.0)


@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize("wrong", ["nothing", "noise", "half", "arrived"])
def test_a_target_within_the_limits_is_missed_as_often_as_simulated_whatever_is_proposed(
    wrong: str, above: bool
) -> None:
    side, starts = side_of(stages_of(boxed()), 0.1, 20, above), starts_in(boxed())
    side.propose()
    rng = np.random.default_rng(5)
    if wrong == "noise":
        side.values = [row + 0.02 * rng.normal(size=row.shape) for row in side.values]
    elif wrong != "nothing":  # "arrived": as if it were entered from everywhere
        side.values = [(0.5 if wrong == "half" else 0.0) * row for row in side.values]
    bound, _, _ = refined(side, starts)
    if above:  # .0245 of 20,000 paths failed: [.0195, .0303] at 1 - 1e-6
        assert bound >= 0.0195
    else:
        assert -bound <= 0.0303


def test_what_v_lacks_at_the_target_s_faces_is_the_most_that_it_lacks_there() -> None:
    side = side_of(stages_of(boxed()), 0.15, 10, True)
    side.propose()
    rng = np.random.default_rng(6)
    side.values = [row + 0.05 * rng.normal(size=row.shape) for row in side.values]
    inner = [(face, lacks) for face, lacks in zip(side.faces, side.shortfalls()) if face.place is not None]
    assert len(inner) == 4
    for face, lacks in inner:
        other = side.axes[1 - face.axis]
        place = side.axes[face.axis].nodes[face.place]
        assert abs(place) == pytest.approx(0.3)
        points = rng.uniform(-0.3, 0.3, 200)
        cells = np.searchsorted(other.nodes, points) - 1
        for k in (0, 3, len(side.steps) - 1):
            value = side.axes[face.axis].at_points(np.array([place]), 0).along(side.values[k], face.axis)
            value = other.at_points(points, 0).along(value, 1 - face.axis).ravel()
            assert np.all(-value <= lacks[k][cells] + 1e-12)
