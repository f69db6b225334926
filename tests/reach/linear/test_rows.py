"""Rows for the remainder, what windows charge for their turning, and levels along them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import certbound as cb
from certbound.gaussian.response.events import WindowEvent, WindowEvents
from certbound.gaussian.response.levels import level_along, level_scale
from certbound.gaussian.response.linear_response import LinearResponse, continuous_response, discrete_response
from certbound.reach.linear.answer import linear_answer
from certbound.reach.linear.inclusion import Supports, gathering_of
from certbound.reach.linear.linearisation import WINDOW, Linearisation
from certbound.reach.linear.rows import inner_rows

TURN = np.array([[-0.2, -3.0], [3.0, -0.1]])
PIECES, STEP = 24, 0.025


def turning() -> LinearResponse:
    shape = (1, PIECES, 2, 2)
    slope = np.broadcast_to(TURN, shape).copy()
    return continuous_response(slope, np.zeros(shape), STEP, np.diag([0.1, 0.2]), 0.01 * np.eye(2))


def test_a_row_seen_from_the_windows_end_stays_between_its_ends_up_to_the_stated_error() -> None:
    events = WindowEvents(turning(), 0, 4, np.log(1e-4))
    last, first, error = events.chords
    rng = np.random.default_rng(0)
    tight = 0.0
    for k in range(PIECES):
        end = events.bounds[np.searchsorted(events.bounds, k, side="right")] * STEP
        for t in STEP * (k + rng.uniform(0, 1, 40)):
            row = rng.normal(size=2)
            seen = row @ expm(TURN * (t - end))  # Phi(t, t_e): the flow backwards
            ends = row @ first[k], row @ last[k]
            low, high = np.minimum(*ends), np.maximum(*ends)
            slack = np.abs(row) @ error[k]
            assert np.all(seen >= low - slack)
            assert np.all(seen <= high + slack)
            tight = max(tight, float(np.max((np.maximum(low - seen, seen - high)) / slack)))
    assert tight > 0.3  # the bound is needed, and not loose by much


def event(rows: np.ndarray) -> WindowEvent:
    return WindowEvents(turning(), 0, 4, np.log(1e-4)).along(rows)


def test_levels_along_a_row_cost_what_was_granted() -> None:
    turned = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0, 6, PIECES) ** 1.5])
    found = event(turned)
    levels = level_along(found, np.log(1e-5))
    assert np.log(1e-5) - 0.5 < found.log_exceedance(levels) <= np.log(1e-5)


def test_the_piece_that_turns_fastest_does_not_raise_the_levels_of_all() -> None:
    angle = np.where(np.arange(PIECES) < 4, 1.5 * np.arange(PIECES), 6.0)
    found = event(np.stack([np.cos(angle), np.sin(angle)], axis=1))
    levels = level_along(found, np.log(1e-5))
    even = level_scale(found, found.profile, np.log(1e-5)) * found.profile
    assert np.mean(levels[8:] / even[8:]) < 0.95
    assert np.all(levels[8:] < 1.02 * even[8:])


@pytest.mark.parametrize("share", [-6.0, -12.0])
def test_rows_that_move_with_the_flow_cost_little_in_every_window(share: float) -> None:
    engine = Linearisation.of(cb.load("unicycle").replace(horizon=1.0))
    rows, extra = inner_rows(engine)
    assert rows.shape[2] == 3 + extra.shape[2]
    assert extra.shape[2] == 6
    windows = WindowEvents(engine.response, 0, max(1, round(WINDOW * engine.pieces)), share)
    covariance = engine.response.covariance[0, 1:]
    for d in range(3, 9):
        own = rows[0, :, d]
        deviation = np.sqrt(np.einsum("ki,kij,kj->k", own, covariance, own))
        assert np.median(windows.along(own).cost / deviation) < 0.5


def test_an_actuator_that_is_far_from_its_limits_in_spread_leaves_no_remainder() -> None:
    """Stock and orders: the box around both deviations reaches the limits of the orders, what is likely does not."""

    def step(x: list[Any]) -> list[Any]:
        orders = 10 + 0.5 * (40 - x[0]) + 0.6 * (10 - x[1])
        return [x[0] + x[1] - 10, np.maximum(0, np.minimum(30, orders))]

    system = cb.DiscreteSystem(step, states=2, noise=cb.Gaussian(std=[3.0]), noise_matrix=[[1.0], [0.0]])
    safe = cb.Inside(cb.Box([10, -np.inf], [80, np.inf]))
    problem = cb.Problem(system, initial=cb.Box([38, 10], [42, 10]), safe=[safe], horizon=52, delta=1e-4)
    engine = Linearisation.of(problem)
    _, extra = inner_rows(engine)
    assert extra.shape[2] == 1
    normal = extra[0, 20, 0] / extra[0, 20, 0, 0]
    np.testing.assert_allclose(normal, [1.0, 1.2], rtol=1e-6)
    assert linear_answer(problem).log10_delta < -4


def followers() -> cb.Problem:
    """Two followers that keep 10 m, whose accelerations saturate at seven standard deviations of what is asked."""

    def step(x: Any) -> list[Any]:
        asked = [0.6 * (x[0] - 10) - 1.2 * x[1], 0.6 * (x[2] - 10) + 0.9 * (x[1] - x[3])]
        first, second = (np.maximum(np.minimum(a, 2), -2) for a in asked)
        return [x[0] - 0.1 * x[1], x[1] + 0.1 * first, x[2] + 0.1 * (x[1] - x[3]), x[3] + 0.1 * second]

    system = cb.DiscreteSystem(step, states=4, noise=cb.Gaussian(std=[1e-9, 0.08, 1e-9, 0.08]))
    safe = [cb.Inside(cb.Box([7, -9, 7, -9], [13, 9, 13, 9]))]
    return cb.Problem(system, initial=[10, 0, 10, 0], safe=safe, horizon=70)


def test_normals_of_kinks_are_rows_once_each_however_far_kinks_are() -> None:
    """They were looked for at sample points, and those of a saturation at seven deviations were not found."""
    rows = inner_rows(Linearisation.of(followers(), cells=1))[1][0]
    wanted = np.array([[0.6, -1.2, 0, 0], [0, 0.9, 0.6, -0.9]])
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    assert rows.shape[1] == 2
    assert np.abs(np.abs(np.einsum("kdi,di->kd", rows, wanted)) - 1).max() < 1e-12


def test_what_saturates_hardly_ever_costs_no_more_than_what_does_not() -> None:
    """Boxes of the states reach beyond the kinks that sums of states stay far from."""
    assert linear_answer(followers().replace(delta=1e-5), cells=1).log10_delta < -5


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("couplings", [0.0, 3.0])
def test_supports_of_numbers_that_overflow_are_infinite(continuous: bool, couplings: float) -> None:
    steps, none = 40, np.zeros((2, 2))
    slope = np.broadcast_to([[0.1, couplings], [0.0, 0.2]], (1, steps, 2, 2)).copy()
    if continuous:
        response = continuous_response(slope, np.zeros_like(slope), 0.1, none, none)
    else:
        response = discrete_response(slope, none, 0.0, none)
    response = replace(response, transition=1e12 * response.transition)  # whose products overflow
    gathering = gathering_of(response, slope, np.zeros((1, steps, 2, 0)), np.zeros(0), continuous=continuous)
    rows = np.broadcast_to(np.eye(2), (steps + (not continuous), 2, 2)).copy()
    found = Supports(response, gathering.of_cell(0), 0, rows, 0.1 * np.eye(2), continuous=continuous)
    assert not np.isnan(found.y).any()
    assert (found.y[-1] == np.inf).any()
    for size in (1.0, 1e300):
        low, high, reach = found.remainder(np.full((steps, 2), -size), np.full((steps, 2), size))
        assert (low[-1] == -np.inf).any()
        assert (high[-1] == np.inf).any()
        assert not any(np.isnan(one).any() for one in (low, high, reach))
