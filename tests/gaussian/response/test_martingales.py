"""Martingales of bounded quadratic variation against closed forms and simulation."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from certbound.gaussian.response.events import WindowEvents
from certbound.gaussian.response.linear_response import LinearResponse, continuous_response
from certbound.gaussian.response.martingales import MartingaleEvent, Martingales, SplitEvent, Windowed, quantile
from certbound.rigor.intervals import Interval

Array = NDArray[np.float64]


def response(matrix: Array, horizon: float, pieces: int) -> LinearResponse:
    slope = np.broadcast_to(matrix, (1, pieces, *matrix.shape))
    return continuous_response(
        slope, np.zeros_like(slope), horizon / pieces, np.zeros((len(matrix), 1)), np.zeros(matrix.shape)
    )


def test_the_quadratic_variation_of_a_decaying_state_has_its_closed_form() -> None:
    found = Martingales(response(np.array([[-1.0]]), 2.0, 100), 0, Interval(*np.full((2, 100, 1, 1), 0.3)), -9.0)
    kappa, _ = found.variation(np.ones((len(found.frame.ends), 1)))
    end = found.frame.ends * 0.02
    exact = 0.3 * np.sqrt((1 - np.exp(-2 * end)) / 2)
    assert np.all(kappa >= exact * (1 - 1e-12))
    assert kappa == pytest.approx(exact, rel=1e-3)


def test_excess_over_a_tube_counts_with_its_larger_end() -> None:
    base = response(np.array([[0.0, 1.0], [-1.0, 0.0]]), 1.0, 50)
    low, high = np.full((50, 2, 1), -0.2), np.full((50, 2, 1), 0.1)
    wide = Martingales(base, 0, Interval(low, high), -9.0)
    for value in (low, high, (low + high) / 2):
        thin = Martingales(base, 0, Interval(value, value), -9.0)
        for row in ([1.0, 0.0], [0.3, -0.8]):
            rows = np.broadcast_to(row, (len(wide.frame.ends), 2))
            assert np.all(wide.variation(rows)[0] >= thin.variation(rows)[0] - 1e-12)


def test_the_event_bounds_a_rotating_martingale() -> None:
    """M' = J M dt + c dW with a rotation J: the worst of the admissible integrands."""
    matrix = np.array([[0.0, 2.0], [-2.0, 0.0]])
    horizon, pieces, paths, fine = 1.0, 50, 20_000, 10
    found = Martingales(response(matrix, horizon, pieces), 0, Interval(*np.full((2, pieces, 2, 1), 0.5)), np.log(1e-7))
    event = found.along(np.broadcast_to([1.0, 0.0], (pieces, 2)))
    rng = np.random.default_rng(0)
    h = horizon / pieces / fine
    turn = np.array([[np.cos(2 * h), np.sin(2 * h)], [-np.sin(2 * h), np.cos(2 * h)]])
    state, top = np.zeros((paths, 2)), np.zeros(paths)
    for _ in range(pieces * fine):
        state = state @ turn.T + 0.5 * np.sqrt(h) * rng.standard_normal((paths, 1))
        top = np.maximum(top, state[:, 0])
    for share in (0.1, 0.01):
        level = float(np.quantile(top, 1 - share))
        assert np.exp(event.log_exceedance(np.full(pieces, level))) >= share - 3 * np.sqrt(share / paths)
    level = event.level(np.log(0.01))
    assert event.log_exceedance(level) <= np.log(0.01)
    assert level.max() < 3 * float(np.quantile(top, 0.99))
    assert event.log_exceedance(np.full(pieces, -0.1)) == 0.0


def test_every_window_costs_the_tail_of_a_reflected_brownian_motion() -> None:
    event = MartingaleEvent(
        kappa=np.array([1.0, 0.5]), window=np.repeat([0, 1], 3), starts=np.array([0, 3]), cost=np.zeros(6)
    )
    found = event.log_exceedance(np.full(6, 3.0))
    assert found == pytest.approx(np.log(2 * norm.sf(3.0) + 2 * norm.sf(6.0)), abs=1e-9)
    assert event.log_exceedance(event.level(-9.0)) <= -9.0


def test_coordinates_without_levels_leave_no_level_that_is_finite() -> None:
    """Units far apart: what rounding adds feeds itself, and the coordinates' levels are infinite."""
    frame = Windowed(response(np.eye(2), 0.2, 20), 0)
    frame.error = np.ones_like(frame.error)
    found = Martingales(response(np.eye(2), 0.2, 20), 0, Interval(*np.full((2, 20, 2, 1), 0.5)), -9.0, frame)
    assert np.all(np.isinf(found.coordinates))
    event = found.along(np.broadcast_to([1.0, 0.0], (20, 2)))  # the second coordinate is off by 0
    assert np.all(event.cost == np.inf)
    assert np.all(event.level(-5.0) == np.inf)
    assert event.log_exceedance(np.full(20, 1e9)) == 0.0


def test_an_infinite_level_is_not_exceeded_whatever_it_costs() -> None:
    cost = np.array([0.0, 0.0, 0.0, np.inf, np.inf, np.inf])
    event = MartingaleEvent(
        kappa=np.full(2, 0.1), window=np.repeat([0, 1], 3), starts=np.array([0, 3]), cost=cost
    )
    level = event.level(-9.0)
    assert np.array_equal(np.isinf(level), np.isinf(cost))
    assert event.log_exceedance(level) <= -9.0
    slope = np.full((1, 6, 1, 1), -1.0)
    base = continuous_response(slope, np.zeros_like(slope), 1 / 6, np.ones((1, 1)), np.zeros((1, 1)))
    gaussian = WindowEvents(base, 0, 3, -9.0).along(np.ones((6, 1)))
    split = SplitEvent(gaussian=gaussian, martingale=event)
    assert split.log_exceedance(10 * level) < 0.0
    assert split.log_exceedance(np.full(6, 1e9)) == 0.0
    object.__setattr__(gaussian, "cost", cost)
    assert gaussian.log_exceedance(10 * level) < 0.0
    assert gaussian.log_exceedance(np.full(6, 1e9)) == 0.0


def test_what_rows_lose_by_rounding_is_no_more_than_is_said() -> None:
    """rho_{k+1} F - rho_k in fractions, for transition matrices whose products cancel."""
    frame = Martingales(response(np.eye(2), 0.2, 20), 0, Interval(*np.full((2, 20, 2, 1), 0.5)), -9.0).frame
    frame.transition = np.tile(np.eye(2) + 1e4 / 7 * np.array([[1, -1], [1, -1]]), (20, 1, 1))
    for j in reversed(range(20)):
        frame.basis[frame.inside[:, j], j] = frame.basis[frame.inside[:, j], j + 1] @ frame.transition[j]
    frame.magnitude, frame.error = np.abs(frame.basis), np.zeros_like(frame.error)  # what is left is rounding
    directions = np.tile([0.7, -0.3], (len(frame.ends), 1))
    rows = np.einsum("wi,wkij->wkj", directions, frame.basis)
    said = frame.loss(directions, rows[:, 1:])
    missed = 0
    for w, k, j in zip(*np.nonzero(np.repeat(frame.inside[:, :, None], 2, axis=2))):
        moved = sum(Fraction(rows[w, k + 1, i]) * Fraction(frame.transition[k, i, j]) for i in range(2))
        lost = abs(moved - Fraction(rows[w, k, j]))
        assert lost <= said[w, k, j]
        missed += lost > 0
    assert missed


def test_rows_are_computed_once_for_all_martingales_of_a_frame() -> None:
    frame = Windowed(response(np.array([[0.0, 1.0], [-1.0, -0.5]]), 1.0, 50), 0)
    first, second = (np.broadcast_to(row, (len(frame.ends), 2)) for row in ([1.0, 0.0], [0.3, -0.8]))
    found = frame.rows(first)
    assert frame.rows(first.copy()) is found
    for directions in (second, first):
        rows, loss = frame.rows(directions)
        assert np.array_equal(rows, np.einsum("wi,wkij->wkj", directions, frame.basis))
        assert np.array_equal(loss, frame.loss(directions, rows[:, 1:]))


def test_without_excess_nothing_is_exceeded() -> None:
    found = Martingales(response(-np.eye(2), 1.0, 50), 0, Interval(*np.zeros((2, 50, 2, 1))), -9.0)
    event = found.along(np.ones((50, 2)))
    assert event.log_exceedance(np.zeros(50)) == -np.inf
    assert not event.level(-5.0).any()


@pytest.mark.parametrize("log", [-0.1, -1.0, -20.0, -4000.0])
def test_the_quantile_is_a_level_of_the_normal_tail(log: float) -> None:
    level = quantile(log)
    assert norm.logsf(level) <= max(log, np.log(0.5)) + 1e-9
    assert level == 0 or norm.logsf(level * (1 - 1e-6)) > log
