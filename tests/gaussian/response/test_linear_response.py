"""Adjoint rows of many states: sparse products and chosen columns against the plain ones."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.errors import EngineError
from certbound.gaussian.response.adjoint_rows import RowResponse
from certbound.gaussian.response.linear_response import continuous_response, discrete_response
from certbound.gaussian.response.step_events import StepEvents


@pytest.mark.parametrize("n", [5, 60])
def test_chosen_columns_and_repeated_rows_bound_what_is_driven(n: int) -> None:
    rng = np.random.default_rng(3)
    steps, moved = 6, np.array([1, 3])
    slope = 0.9 * np.eye(n) + 0.2 * np.eye(n, k=1) + 0.1 * np.eye(n, k=-1)
    response = discrete_response(np.tile(slope, (1, steps, 1, 1)), 1e-2 * np.eye(n), 0.0, np.zeros((n, n)))
    rows = rng.normal(size=(steps + 1, 3, n))
    rows = np.concatenate([rows, rows[:, :1]], axis=1)
    low, high = np.full((steps, n), -1e-16), np.full((steps, n), 1e-16)
    low[:, moved], high[:, moved] = rng.uniform(-0.2, 0.1, (steps, 2)), rng.uniform(0.1, 0.4, (steps, 2))
    middle, radius = (low + high) / 2, (high - low) / 2
    bounds = []
    for columns in (None, moved):
        found = RowResponse(response, 0, rows, columns)
        value, reach = found.centred(middle, radius)
        reach = reach + found.errors(np.ones((steps + 1, n)))
        bounds.append((value - reach, value + reach))
        np.testing.assert_array_equal(bounds[-1][1][:, 0], bounds[-1][1][:, 3])
    np.testing.assert_allclose(bounds[1], bounds[0], atol=1e-11)
    for _ in range(200):
        state = np.zeros(n)
        for k in range(steps):
            state = slope @ state + np.where(rng.random(n) < 0.5, low[k], high[k])
            along = rows[k + 1] @ state
            for below, above in bounds:
                assert np.all(along <= above[k + 1] + 1e-13)
                assert np.all(along >= below[k + 1] - 1e-13)
    # and the bound is attained
    k, row = steps, rows[steps, 0]
    best, adjoint = 0.0, row
    for j in range(k - 1, -1, -1):
        best += float(np.maximum(adjoint * low[j], adjoint * high[j]).sum())
        adjoint = adjoint @ slope
    assert bounds[1][1][k, 0] == pytest.approx(best, abs=1e-10)


def test_states_that_hardly_drive_each_other_keep_their_own_units() -> None:
    """Units that balance couplings of 1 and 1e-12 widen bounds that are the same for all entries."""
    slope = np.array([[-1.0, 1.0, 0.0], [1e-12, -1.0, 1.0], [0.0, 1e-12, -1.0]])
    shape = (1, 30, 3, 3)
    found = continuous_response(np.broadcast_to(slope, shape), np.zeros(shape), 0.1, np.eye(3), np.zeros((3, 3)))
    assert found.transition_error.max() < 1e-10
    assert found.covariance_error.max() < 1e-9


@pytest.mark.parametrize("exponent", [0, 14, 50])
def test_units_of_single_states_cost_no_accuracy(exponent: int) -> None:
    """x_2 in units of 2^-exponent: the same response, though the slope's norm times a piece is 2^exponent / 10."""
    unit = np.array([1.0, 2.0**-exponent])
    slope, noise = np.array([[0.0, 1.0], [-1.0, -0.4]]), np.diag([0.3, 0.2])
    start = np.diag([0.01, 0.02])
    shape = (1, 10, 2, 2)
    plain = continuous_response(np.broadcast_to(slope, shape), np.zeros(shape), 0.1, noise, start)
    other = np.broadcast_to(unit[:, None] * slope / unit, shape)
    moved = continuous_response(
        other, np.zeros(shape), 0.1, unit[:, None] * noise, unit[:, None] * start * unit
    )  # fmt: skip
    np.testing.assert_allclose(moved.transition[0, 0], unit[:, None] * plain.transition[0, 0] / unit, rtol=1e-12)
    row = np.array([[[1.0, 1.0]]]) / unit
    bounds = moved.variance(row, np.array([10]))
    exact = float(plain.variance(np.ones((1, 1, 2)), np.array([10]))[0][0, 0])
    assert bounds[0][0, 0] <= exact <= bounds[1][0, 0] * (1 + 1e-15)
    assert bounds[1][0, 0] - bounds[0][0, 0] <= 1e-9 * exact


def test_variances_along_few_states_need_only_those() -> None:
    n, rng = 30, np.random.default_rng(4)
    a = np.tile(0.8 * np.eye(n) + 0.1 * np.eye(n, k=1), (1, 4, 1, 1))
    response = discrete_response(a, np.diag(rng.uniform(0.5, 1.0, n)), 0.0, np.zeros((n, n)))
    row = np.zeros((1, 5, n))
    row[..., 2], row[..., 3] = 1.0, -0.5
    low, high = response.variance(row, np.arange(5))
    exact = np.einsum("bmi,bmij,bmj->bm", row, response.covariance, row)
    assert np.all(low <= exact)
    assert np.all(high >= exact)
    np.testing.assert_allclose(high, exact, rtol=1e-10, atol=1e-200)


def test_an_event_is_found_once() -> None:
    response = discrete_response(np.full((1, 4, 1, 1), 0.5), np.eye(1), 0.0, np.zeros((1, 1)))
    events = StepEvents(response, 0, True)
    rows = np.ones((5, 1))
    assert events.along(rows) is events.along(rows.copy())
    assert events.along(-rows) is events.along(rows)  # the same law
    assert events.along(2 * rows) is not events.along(rows)


@pytest.mark.parametrize("size", [1e-90, 1.0, 1e160])
def test_variances_of_any_size_are_enclosed(size: float) -> None:
    response = discrete_response(np.full((1, 3, 1, 1), 0.5), np.array([[size]]), 0.0, np.array([[0.0]]))
    low, high = response.variance(np.full((1, 4, 1), 1e10), np.arange(4))
    exact = size * 1e20 * np.array([0.0, 1.0, 1.25, 1.3125])
    assert np.all((low <= exact) & (exact <= high))
    assert np.all(high - low <= 1e-10 * exact + 1e-299)
    assert StepEvents(response, 0, True).along(np.full((4, 1), 1e10)).correlation[1:] == pytest.approx(
        0.5 * np.sqrt([1 / 1.25, 1.25 / 1.3125]), rel=1e-9
    )


def test_rows_that_would_fill_the_memory_are_refused_before_they_are_made(monkeypatch):
    response = discrete_response(np.full((1, 10, 1, 1), 0.5), np.eye(1), 0.0, np.zeros((1, 1)))
    rows = np.ones((11, 1, 1))
    assert RowResponse(response, 0, rows).count == 1
    monkeypatch.setattr("certbound.gaussian.response.adjoint_rows._MEMORY", 400)
    with pytest.raises(EngineError, match="GiB of memory, for 1 rows at 11 times"):
        RowResponse(response, 0, rows)


@pytest.mark.parametrize("columns", [None, np.array([1, 3])])
def test_all_steps_at_once_are_the_steps_one_by_one(columns, monkeypatch):
    rng, steps, n = np.random.default_rng(4), 7, 4
    slope = 0.8 * np.eye(n) + 0.2 * np.eye(n, k=1)
    response = discrete_response(np.tile(slope, (1, steps, 1, 1)), np.eye(n), 0.0, np.zeros((n, n)))
    rows, radii = rng.normal(size=(steps + 1, 3, n)), rng.uniform(0, 1, (steps, n))
    found, slow = (RowResponse(response, 0, rows, columns) for _ in range(2))
    assert found._whole is not None
    monkeypatch.setattr("certbound.gaussian.response.adjoint_rows._ENTRIES", 0)
    assert slow._whole is None
    np.testing.assert_allclose(found.boxes(radii), slow.boxes(radii), rtol=1e-14)
    some = found.boxes(np.concatenate([radii[:4], np.full((3, n), np.inf)]))  # nothing is known from step 4 on
    np.testing.assert_allclose(some[:5], found.boxes(radii)[:5], rtol=1e-14)
    assert np.all(some[5:] == np.inf)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("exponent", "noise"), [(50, 1e150), (0, 1e200)])
def test_a_response_that_overflows_is_refused_in_words(exponent: int, noise: float) -> None:
    """In its own units, or only where it is brought back to those of the states."""
    unit = np.array([1.0, 2.0**exponent])
    slope, shape = unit[:, None] * np.array([[0.0, 1.0], [-1.0, -0.4]]) / unit, (1, 10, 2, 2)
    with pytest.raises(EngineError, match="beyond all floats before the horizon"):
        continuous_response(
            np.broadcast_to(slope, shape), np.zeros(shape), 0.1, noise * unit[:, None] * np.eye(2), np.zeros((2, 2))
        )
    with pytest.raises(EngineError, match="beyond all floats before the horizon"):
        discrete_response(np.full((1, 40, 1, 1), 1e10), np.eye(1), 0.0, np.zeros((1, 1)))


@pytest.mark.filterwarnings("error")
def test_variances_beyond_all_floats_are_infinite_from_both_sides_or_no_bound() -> None:
    response = discrete_response(np.full((1, 3, 1, 1), 0.5), np.array([[1e300]]), 0.0, np.array([[0.0]]))
    low, high = response.variance(np.full((1, 4, 1), 1e10), np.arange(4))
    assert np.all(high[0, 1:] == np.inf)
    assert not np.isnan(low).any()


@pytest.mark.filterwarnings("error")
def test_slopes_that_are_no_numbers_for_the_series_are_too_stiff() -> None:
    shape = (1, 1, 2, 2)
    slope = np.broadcast_to([[1e200, 1e200], [-1e200, 1e200]], shape)
    with pytest.raises(EngineError, match="too stiff"):
        continuous_response(slope, np.zeros(shape), 1.0, np.eye(2), np.zeros((2, 2)))
