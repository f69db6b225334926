"""Exit probabilities of affine laws: closed forms, stiffness, long horizons, and both sides of the truth."""

import time

import numpy as np
import pytest
from flint import arb_mat, ctx
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.stats import norm

from certbound.gaussian.affine import AffineLaw, Limit, bound_exits, bound_exits_below
from certbound.gaussian.affine.lagged import Mark, Spans, lagged_cost
from certbound.gaussian.affine.upper import Exit

LN10 = np.log(10.0)


def law_of(slope, noise, horizon, mean=None, covariance=None, starts=None):
    slope = np.atleast_2d(np.asarray(slope, dtype=float))
    mean = np.zeros(len(slope)) if mean is None else np.asarray(mean, dtype=float)
    return AffineLaw(
        slope=arb_mat(slope.tolist()), noise=arb_mat(np.asarray(noise, dtype=float).reshape(len(slope), -1).tolist()),
        horizon=float(horizon), mean=arb_mat([[x] for x in mean.tolist()]),
        covariance=None if covariance is None else arb_mat(np.atleast_2d(covariance).tolist()),
        starts=None if starts is None else arb_mat(np.asarray(starts, dtype=float).tolist()),
    )  # fmt: skip


def both(law, rows, levels, bits=256):
    """Bounds from above and below of P(some |row X| exceeds its level)."""
    limits = [Limit(direction=i, sign=sign, bound=level) for i, level in enumerate(levels) for sign in (1, -1)]
    with ctx.workprec(bits):
        high = float(np.exp(bound_exits(law, rows, limits).log_probability))
        low = bound_exits_below(law, rows, [(one.direction, one.sign, one.bound) for one in limits])
    return low, high


def one_sided(law, row, level, during=None):
    with ctx.workprec(256):
        found = bound_exits(law, [row], [Limit(direction=0, sign=1, bound=level, during=during)])
    return found.log_probability / LN10


def moved_by(slope, noise, step):
    """Transition matrix and covariance of a step, by doubling."""
    halvings = max(0, int(np.ceil(np.log2(np.abs(slope).sum(axis=1).max() * step))) + 1)
    n, gram = len(slope), noise @ noise.T
    block = expm(np.block([[-slope, gram], [np.zeros((n, n)), slope.T]]) * step / 2**halvings)
    flow = block[n:, n:].T
    spread = flow @ block[:n, n:]
    for _ in range(halvings):
        spread = spread + flow @ spread @ flow.T
        flow = flow @ flow
    return flow, spread


def test_a_stationary_ou_process_agrees_with_its_differential_equation():
    # P(sup over 5 relaxation times > 4 deviations) = 10^-2.592
    law = law_of([[-1.0]], [np.sqrt(2.0)], 5.0, covariance=[[1.0]])
    assert -2.592 < one_sided(law, [1.0], 4.0) < -2.592 + np.log10(1.2)


def test_a_stationary_start_is_bounded_from_both_sides():
    # X of variance 1/8 all the time: the variance never grows, and events at single times were put no step apart
    low, high = both(law_of([[-1.0]], [0.5], 5.0, covariance=[[0.125]]), [[1.0]], [1.5])
    assert 3e-4 < low < 1.8e-3 < high < 2.4e-3  # 1.78e-3 of 40 000 simulated paths leave at 2000 samples


def test_a_smooth_stationary_row_agrees_with_rices_formula():
    # position of a damped oscillator, variance 1, mean period 2 pi
    slope, noise = [[0, 1], [-1, -0.4]], [0, np.sqrt(0.8)]
    law = law_of(slope, noise, 50.0, covariance=np.eye(2))
    rice = norm.sf(4.5) + 50 / (2 * np.pi) * np.exp(-(4.5**2) / 2)
    assert np.log10(rice) - 1e-9 <= one_sided(law, [1.0, 0.0], 4.5) < np.log10(1.02 * rice)


def test_one_time_alone_costs_the_normal_tail():
    slope, noise = np.array([[0, 1], [-1, -0.4]]), np.array([[0], [1.0]])
    law = law_of(slope, noise, 8.0)
    _, spread = moved_by(slope, noise, 8.0)
    exact = norm.logsf(3.0 / np.sqrt(spread[0, 0])) / LN10
    assert exact - 0.01 < one_sided(law, [1.0, 0.0], 3.0, during=(8.0, 8.0)) < exact + 0.2


@pytest.mark.parametrize("horizon", [1.0, 1e2, 1e5])
def test_stiff_and_slow_modes_together_cost_neither_time_nor_accuracy(horizon):
    rates = np.array([1e-4, 1e-2, 1.0, 1e2, 1e4])
    slope = np.diag(-rates) + np.diag(0.3 * rates[1:], -1)
    noise = np.zeros((5, 1))
    noise[0] = np.sqrt(2e-4)
    _, spread = moved_by(slope, noise, horizon)
    begun = time.perf_counter()
    level = 4.5 * np.sqrt(spread[-1, -1])
    low, high = both(law_of(slope, noise, horizon), [np.eye(5)[-1]], [level])
    assert 0 < low <= high < 8 * low
    assert time.perf_counter() - begun < 60


def test_the_cost_does_not_grow_with_the_horizon():
    slope, noise = [[0, 1], [-1, -0.4]], [0, np.sqrt(0.8)]
    for horizon in (1e3, 1e6):
        law = law_of(slope, noise, horizon)
        rice = 2 * horizon / (2 * np.pi) * np.exp(-(7.5**2) / 2)
        _, high = both(law, [[1.0, 0.0]], [7.5])
        assert 0.9 * rice < high < 1.05 * rice


def test_a_narrow_band_counts_clumps_of_crossings_about_once():
    slope, noise = [[0, 1], [-1, -0.02]], [0, np.sqrt(0.04)]
    law = law_of(slope, noise, 2000.0, covariance=np.eye(2))
    rice = 2 * 2000 / (2 * np.pi) * np.exp(-(4.5**2) / 2)
    low, high = both(law, [[1.0, 0.0]], [4.5])
    assert low <= high < 0.7 * rice


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10**6))
def test_simulated_paths_leave_between_both_bounds(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    slope = rng.standard_normal((n, n))
    slope -= (np.linalg.eigvals(slope).real.max() + rng.uniform(0.1, 1)) * np.eye(n)
    noise = np.zeros((n, 1))
    noise[-1] = 1.0
    spread = solve_continuous_lyapunov(slope, -noise @ noise.T)
    row, horizon = np.eye(n)[0], float(rng.uniform(2, 20))
    level = float(rng.uniform(2, 2.8) * np.sqrt(spread[0, 0]))
    low, high = both(law_of(slope, noise, horizon), [row], [level])
    steps, count = 200, 4000
    flow, added = moved_by(slope, noise, horizon / steps)
    values, vectors = np.linalg.eigh(added)
    root = vectors * np.sqrt(np.maximum(values, 0))
    x, left = np.zeros((count, n)), np.zeros(count, dtype=bool)
    for _ in range(steps):
        x = x @ flow.T + rng.standard_normal((count, n)) @ root.T
        left |= np.abs(x @ row) > level
    seen, slack = left.mean(), 5 * np.sqrt(max(high, 1e-3) / count)
    assert low <= high
    assert seen - slack <= high  # between the samples a path may leave and return, which only adds to what is bounded
    assert low <= seen * 1.3 + slack


def test_a_mean_that_falls_pays_where_it_is_near():
    # from .9 towards 0: the level 1 is near at the beginning only
    law = law_of([[-1.0, 0.0], [1.0, -1.0]], [[0.05], [0.0]], 10.0, mean=[0.0, 0.9])
    near, far = one_sided(law, [0.0, 1.0], 1.0), one_sided(law_of([[-1.0, 0], [1, -1]], [0.05, 0], 10.0), [0, 1.0], 1.0)
    assert far < near < 0


def test_a_set_of_starts_counts_its_worst():
    slope, noise = [[-1.0, 0.0], [1.0, -1.0]], [0.3, 0.0]
    whole = one_sided(law_of(slope, noise, 5.0, starts=[[0.0], [0.2]]), [0.0, 1.0], 1.0)
    corner = one_sided(law_of(slope, noise, 5.0, mean=[0.0, 0.2]), [0.0, 1.0], 1.0)
    middle = one_sided(law_of(slope, noise, 5.0), [0.0, 1.0], 1.0)
    assert middle < corner <= whole + 1e-9


def test_beyond_the_limit_everything_fails():
    assert one_sided(law_of([[-1.0]], [0.1], 1.0, mean=[2.0]), [1.0], 1.0) == 0.0


def test_a_resting_row_that_a_drawn_state_drives_is_bounded_in_few_pieces():
    """v starts at 0 with little noise of its own, w from its stationary law: pieces were halved for minutes."""
    slope, noise = [[-1.0, 1.0], [0.0, -0.5]], [[0.1, 0.0], [0.0, 0.5]]
    law = law_of(slope, noise, 5.0, covariance=np.diag([0.0, 0.25]))
    with ctx.workprec(256):
        found = Exit(law, (1, 0), [Limit(direction=0, sign=1, bound=1.5)])
    assert len(found.trace) < 1000
    rng, paths, step = np.random.default_rng(1), 40_000, 0.005
    v, w, beyond = np.zeros(paths), 0.5 * rng.normal(size=paths), np.zeros(paths, dtype=bool)
    for _ in range(1000):
        kicks = np.sqrt(step) * rng.normal(size=(2, paths))
        v, w = v + step * (w - v) + 0.1 * kicks[0], w - step * 0.5 * w + 0.5 * kicks[1]
        beyond |= v > 1.5
    high = np.exp(found.log_of(0))
    assert beyond.mean() - 4 * np.sqrt(beyond.mean() / paths) < high < 4 * beyond.mean()  # it was 75 times as much


def test_a_level_that_falls_is_followed_as_a_line():
    """A row with noise of its own whose mean moves: levels that stand still over pieces said twice as much."""
    slope, noise = [[-1.0, 0.0], [1.0, -1.0]], [[0.2, 0.0], [0.0, 0.1]]
    law = law_of(slope, noise, 5.0, mean=[1.0, 0.2], covariance=np.diag([0.02, 0.01]))
    assert 10 ** one_sided(law, [0.0, 1.0], 1.0) < 2.5e-6  # 3.1e-6 by blocks alone


def test_marked_crossings_are_counted_as_often_as_paths_make_them():
    """Upcrossings of 2 that were at most 2 a period before: their mean number, stationary."""
    slope, noise, lag, step = np.array([[0.0, 1.0], [-1.0, -0.1]]), np.array([[0.0], [np.sqrt(0.2)]]), 6.28, 0.04
    law = law_of(slope, noise, 20.0, covariance=np.eye(2))
    marks = [Mark(row=(1.0, 0.0), lag=lag, sign=1, level=2.0)]
    with ctx.workprec(256):
        found = lagged_cost(law, (1.0, 0.0), 2.0, marks, Spans(law)).between(lag, 20.0)
    flow, added = moved_by(slope, noise, step)
    root = np.linalg.cholesky(added)
    rng, paths = np.random.default_rng(3), 10_000
    x, seen = rng.standard_normal((paths, 2)), []
    for _ in range(501):
        seen.append(x[:, 0])
        x = x @ flow.T + rng.standard_normal((paths, 2)) @ root.T
    seen, back = np.array(seen), round(lag / step)
    counted = (seen[back:-1] <= 2) & (seen[back + 1 :] > 2) & (seen[: -back - 1] <= 2)
    mean = counted.sum() / paths
    assert mean - 5 * np.sqrt(mean / paths) < found < 1.1 * mean
