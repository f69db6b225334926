"""Limits in windows: stages of time, one after the other, each with its box, and limits that are due at one time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_banded

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.values.kolmogorov import bound_failing
from certbound.values.kolmogorov.box_setting import stages_of
from certbound.values.kolmogorov.door import largest_at_start, refined, side_of, starts_in
from certbound.values.kolmogorov.splines import Axis, Sampling, most_of_difference

SYSTEM = cb.ContinuousSystem(lambda x, y: [-x, -y], states=["x", "y"], diffusion=0.5 * np.eye(2))


def box(size: float) -> cb.Box:
    return cb.Box([-size, -size], [size, size])


def problem(inner: tuple[float, float], size: float = 1.0) -> cb.Problem:
    """A wide limit at all times, and a tight one in a window."""
    safe = [cb.Inside(box(1.5)), cb.Inside(box(size), during=inner)]
    return cb.Problem(SYSTEM, initial=[0.2, 0.2], safe=safe, horizon=2.0)


def truth(inner: tuple[float, float], size: float = 1.0, steps: int = 1600) -> float:
    """What fails, by Crank and Nicolson's scheme for one of the two states, which are independent."""
    x = np.linspace(-1.5, 1.5, 601)
    gap, h = x[1] - x[0], 2.0 / steps
    within, wide = np.abs(x) < size - 1e-9, np.abs(x) < 1.5
    a, since = np.where(wide, 1.0, 0.0), 0
    for k in range(steps, -1, -1):
        t = k * h
        tight = inner[0] - 1e-9 <= t <= inner[1] + 1e-9
        if tight or t == 2.0:
            a = np.where(within if tight else wide, a, 0.0)
            since = 0 if t in inner or t == 2.0 else since
        if k == 0:
            break
        tight = inner[0] < t - h / 2 < inner[1]
        inside = within if tight else wide
        share, since = (1.0 if since < 8 else 0.5), since + 1
        up, down = (0.125 / gap**2 + sign * -x / (2 * gap) for sign in (1, -1))
        up, down = up * inside, down * inside
        right = a + (1 - share) * h * (up * np.roll(a, -1) + down * np.roll(a, 1) - (up + down) * a)
        rows = np.array([np.roll(-share * h * up, 1), 1 + share * h * (up + down), np.roll(-share * h * down, -1)])
        a = solve_banded((1, 1), rows, right)
    return float(1 - np.interp(0.2, x, a) ** 2)


WINDOWS = {"late": (1.0, 2.0), "early": (0.0, 1.0), "between": (0.6, 1.4), "at the end": (2.0, 2.0), "once": (1.0, 1.0)}


def test_stages_lie_between_the_times_at_which_limits_change() -> None:
    first, second, third = stages_of(problem(WINDOWS["between"]))
    assert [(one.begin, one.horizon) for one in (first, second, third)] == [(0.0, 0.6), (0.6, 1.4), (1.4, 2.0)]
    assert np.all(first.high == 1.5)
    assert np.all(second.high == 1.0)
    assert all(one.staged and one.limited.all() and np.isinf(one.due_low).all() for one in (first, second, third))
    before, after = stages_of(problem(WINDOWS["once"]))
    assert np.all(before.due_high == 1.0)
    assert np.isinf(after.due_high).all()
    assert np.all(before.high == 1.5)
    (alone,) = stages_of(problem((0.0, 2.0)))
    assert not alone.staged
    assert np.all(alone.high == 1.0)


def test_a_limit_that_is_due_at_the_first_moment_alone_and_one_that_moves_are_refused() -> None:
    with pytest.raises(InfeasibleError, match="due at time 0 alone"):
        stages_of(problem((0.0, 0.0)))
    moving = cb.Inside(cb.Box([-1, -1], [1, 1], center=lambda t: [0.1 * t, 0.0]))
    with pytest.raises(InfeasibleError, match="moving"):
        stages_of(cb.Problem(SYSTEM, initial=[0, 0], safe=[moving], horizon=2.0))


@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize("name", WINDOWS)
def test_a_limit_in_a_window_is_broken_as_often_as_the_bounds_say(name: str, above: bool) -> None:
    asked, exact = problem(WINDOWS[name]), truth(WINDOWS[name])
    side, starts = side_of(stages_of(asked), 0.09, 24, above), starts_in(asked)
    for stage in side.stages[::-1]:
        stage.propose()
        assert stage.times[-1] == stage.setting.begin
        assert stage.steps.sum() == pytest.approx(stage.setting.horizon - stage.setting.begin, rel=1e-12)
    estimate = largest_at_start(side, starts)[0]
    bound, _, _ = refined(side, starts)
    if above:
        assert 0.95 * exact < estimate < 5 * exact
        assert bound >= 0.995 * exact
    else:
        assert 0.1 * exact < -estimate < 1.2 * exact
        assert -bound <= 1.005 * exact


@pytest.mark.slow
@pytest.mark.parametrize("name", WINDOWS)
def test_the_bounds_are_close_where_there_is_time(name: str) -> None:
    exact = truth(WINDOWS[name])
    found = list(bound_failing(problem(WINDOWS[name]), seconds=40))[-1]
    assert found.lower <= 1.005 * exact
    assert 0.995 * exact <= found.upper < 4 * exact


@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize("wrong", ["first", "second"])
def test_a_wrong_stage_costs_width_and_never_truth(above: bool, wrong: str) -> None:
    asked, exact = problem(WINDOWS["late"]), truth(WINDOWS["late"])
    side, starts = side_of(stages_of(asked), 0.12, 16, above), starts_in(asked)
    spoiled = side.stages[wrong == "second"]
    proposed = spoiled.propose

    def propose() -> None:
        proposed()
        spoiled.values = [0.5 * row for row in spoiled.values]

    spoiled.propose = propose
    for stage in side.stages[::-1]:
        stage.propose()
    bound, _, _ = refined(side, starts)
    if above:
        assert bound >= 0.995 * exact
    else:
        assert -bound <= 1.005 * exact


def test_the_next_stage_s_spline_is_compared_with_this_one_s_on_the_cells_of_both() -> None:
    rng = np.random.default_rng(1)
    lines = [np.sort(rng.uniform(-1, 1, 21)) for _ in range(2)]
    wide = tuple(Axis(line, Sampling(4)) for line in lines)
    tight = tuple(Axis(line[4:18], Sampling(4)) for line in lines)
    first, second = rng.normal(size=(25, 25)), rng.normal(size=(18, 18))
    own, places = (slice(4, 17), slice(4, 17)), (slice(0, 13), slice(0, 13))
    most = most_of_difference(wide, tight, first, second, own, places)
    points = [rng.uniform(line[4], line[17], 300) for line in lines]
    values = []
    for axes, coefficients in ((wide, first), (tight, second)):
        value = coefficients
        for k, axis in enumerate(axes):
            value = axis.at_points(points[k], 0).along(value, k)
        values.append(value)
    cells = [np.searchsorted(line[4:18], x) - 1 for line, x in zip(lines, points)]
    seen = values[1] - values[0]
    bound = most[np.ix_(*cells)]
    assert np.all(seen <= bound)
    assert np.max(seen / np.maximum(bound, 1e-9)) > 0.9


@pytest.mark.parametrize("above", [True, False])
def test_what_a_stage_lacks_at_its_end_is_the_most_that_the_next_one_asks_for(above: bool) -> None:
    asked = problem(WINDOWS["late"]).replace(
        safe=[cb.Inside(box(1.5)), cb.Inside(box(1.0), during=(1.0, 2.0)), cb.Inside(box(0.7), during=(1.0, 1.0))]
    )
    side = side_of(stages_of(asked), 0.15, 12, above)
    for stage in side.stages[::-1]:
        stage.propose()
    rng = np.random.default_rng(2)
    side.values[0] = side.values[0] + 0.1 * rng.normal(size=side.values[0].shape)
    lacks = side.shortfall_at_end()
    points = [rng.uniform(axis.nodes[0], axis.nodes[-1], 400) for axis in side.axes]
    own, after = side.values[0], side.later.values[-1]
    for k in range(2):
        own = side.axes[k].at_points(points[k], 0).along(own, k)
        within = np.clip(points[k], side.later.axes[k].nodes[0], side.later.axes[k].nodes[-1])
        after = side.later.axes[k].at_points(within, 0).along(after, k)
    x, y = np.meshgrid(*points, indexing="ij")
    lost = np.maximum(np.abs(x), np.abs(y)) > 0.7
    wanted = np.where(lost, 1.0 if above else -1.0, after)
    cells = [np.searchsorted(axis.nodes, x) - 1 for axis, x in zip(side.axes, points)]
    assert np.all(wanted - own <= lacks[np.ix_(*cells)] + 1e-12)
