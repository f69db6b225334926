"""Slepian clocks: they dominate, and the probabilities they give are close."""

import itertools

import numpy as np
import pytest
from scipy.stats import norm

from certbound.gaussian.scalar.normal import log_tail
from certbound.gaussian.scalar.slepian import Clock, clock_crossing, group_windows, node_clock

LN10 = np.log(10.0)


def own_time(count, step=0.1, every=None):
    """The clock of an Ornstein-Uhlenbeck process: its own time, in blocks of ``every`` pieces."""
    return Clock(increments=np.full(count, step), starts=np.arange(0, count, every or count))


@pytest.mark.parametrize("seed", range(8))
def test_the_lines_of_all_windows_lie_below_the_boundary(seed):
    rng = np.random.default_rng(seed)
    clock = np.concatenate([[0], np.cumsum(rng.uniform(0.001, 0.2, 60))])
    left = rng.uniform(2, 6) + np.cumsum(rng.normal(0, 0.1, 60)) + rng.uniform(0, 0.5, 60)
    right = np.maximum(left + rng.normal(0, 0.1, 60), 0.1)
    lines = group_windows(clock, left, right, span=0.4)
    assert 10 < len(lines.first) < 60
    for first, span, start, stop in zip(lines.first, lines.spans, lines.starts, lines.stops):
        begin, end = clock[first], clock[first] + span
        for k in np.flatnonzero((clock[:-1] >= begin - 1e-12) & (clock[1:] <= end + 1e-12)):
            # levels of chords: q(x) = (q0 sinh(d - x) + q1 sinh(x))/sinh(d)
            x = np.linspace(clock[k], clock[k + 1], 5)
            d = clock[k + 1] - clock[k]
            chord = (left[k] * np.sinh(clock[k + 1] - x) + right[k] * np.sinh(x - clock[k])) / np.sinh(d)
            line = (start * np.sinh(end - x) + stop * np.sinh(x - begin)) / np.sinh(span)
            assert np.all(line <= chord + 1e-12)


def exact_ou_crossing(level, horizon):
    """P(sup of a stationary OU > level), by the backward equation on a fine grid (Crank-Nicolson)."""
    count, low = 1000, -7.0
    x = np.linspace(low, level, count + 1)
    h, steps = x[1] - x[0], 1500
    from scipy.linalg import solve_banded

    upper, lower = 1 / h**2 - x[1:-1] / (2 * h), 1 / h**2 + x[1:-1] / (2 * h)
    u = np.zeros(count + 1)
    u[-1] = 1.0
    dt = horizon / steps
    for k in range(steps + 8):
        theta, d = (1.0, dt / 8) if k < 16 else (0.5, dt * (steps - 2) / (steps - 8))
        rhs = u[1:-1] + (1 - theta) * d * (upper * u[2:] - 2 / h**2 * u[1:-1] + lower * u[:-2])
        band = np.zeros((3, count - 1))
        band[0, 1:], band[1], band[2, :-1] = -theta * d * upper[:-1], 1 + theta * d * 2 / h**2, -theta * d * lower[1:]
        rhs[-1] += theta * d * upper[-1]
        rhs[0] += theta * d * lower[0] * u[0]
        u[1:-1] = solve_banded((1, 1), band, rhs)
        u[0] = u[1]
    return norm.sf(level) + np.trapezoid(norm.pdf(x) * u, x)


@pytest.mark.parametrize("level", [2.0, 3.0, 4.0, 5.0])
def test_the_crossing_of_an_ornstein_uhlenbeck_process_matches_its_differential_equation(level):
    exact = exact_ou_crossing(level, 5.0)
    bound = 10 ** clock_crossing(own_time(50), np.full(50, level))
    assert exact * (1 - 2e-3) <= bound
    assert bound <= exact * (1.4 if level < 3 else 1.17)


def test_moving_and_jumping_boundaries_are_bounded_from_below_by_their_parts():
    clock = own_time(40)
    t = np.linspace(0, 4, 41)
    curve = 3.5 + 0.8 * np.sin(3 * t)
    ramp = np.stack([curve[:-1], curve[1:]], axis=-1)
    lines, stairs = clock_crossing(clock, ramp), clock_crossing(clock, ramp.min(axis=1))
    assert lines < stairs
    drop = np.where(np.arange(40) < 20, 5.0, 3.0)
    whole = clock_crossing(clock, drop)
    half = clock_crossing(own_time(20), np.full(20, 3.0))
    assert half - 0.01 <= whole <= half + 0.05
    gap = np.where((np.arange(40) > 9) & (np.arange(40) < 20), np.inf, 4.0)
    assert clock_crossing(clock, gap) < clock_crossing(clock, np.full(40, 4.0)) - 0.05


def test_restarted_blocks_cost_more():
    clock = own_time(40, every=5)
    same = clock_crossing(clock, np.full(40, 3.0))
    single = clock_crossing(own_time(40), np.full(40, 3.0))
    assert single < same


def test_a_process_that_does_not_move_has_the_probability_of_one_time():
    clock = own_time(2, step=0.0)
    assert clock_crossing(clock, [3.0, 3.0]) == pytest.approx(float(log_tail(3.0)) / LN10, abs=1e-3)
    assert clock_crossing(clock, [-0.1, 3.0]) == 0.0
    assert clock_crossing(clock, [np.inf, np.inf]) == -np.inf


def test_malformed_levels_are_refused_by_name():
    with pytest.raises(ValueError, match="`levels` must have shape"):
        clock_crossing(own_time(1), [1.0, 1.0])


def test_a_clock_at_the_nodes_is_the_least_that_serves() -> None:
    rng = np.random.default_rng(7)
    count = 30
    nodes = np.concatenate([[0.0], np.cumsum(rng.uniform(0.01, 0.1, count))])
    needs = nodes - nodes[:, None] + 0.02 * rng.random((count + 1, count + 1))
    near = 0.3 * rng.random(count)
    for limit in (0.2, 0.7, 5.0):
        clock = node_clock(np.full(count, 0.1), near, needs, limit=limit)
        time = np.concatenate([[0.0], np.cumsum(clock.increments)])
        blocks = np.append(clock.starts, count)
        for start, stop in itertools.pairwise(blocks):
            for b in range(start + 1, stop + 1):
                room = time[b] - time[start:b] - needs[start:b, b]
                least = min(room.min(), clock.increments[b - 1] - 0.1 * near[b - 1])
                assert 0 <= least < 1e-13
            assert np.all(needs[start, start + 2 : stop + 1] <= limit)


def test_malformed_needs_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="`durations`"):
        node_clock([0.0], [1.0], np.zeros((2, 2)))
    with pytest.raises(ValueError, match="`near` and `needs` must have shapes"):
        node_clock([1.0], [1.0], np.zeros((3, 3)))
    with pytest.raises(ValueError, match="must be finite"):
        node_clock([1.0], [1.0], [[0, np.inf], [0, 0]])
