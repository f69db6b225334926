"""Bounds of the probability of failing: closed forms, simulation, symmetry of what must not matter, refusals."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import pytest
from scipy.stats import beta, norm

import certbound as cb
from certbound.problem.model.evaluation import compile_numpy
from certbound.values.discrete import failures, layout
from certbound.values.discrete.failures import Work, bound_failure
from certbound.values.discrete.layout import without_hopeless
from certbound.values.discrete.shocks import Inapplicable
from certbound.values.sets import box_around


def scalar(f: Any = None, **changes: Any) -> cb.Problem:
    options = {"initial": [0.1], "safe": [cb.Inside(cb.Box([-1], [1]))], "horizon": 1, "noise": cb.Gaussian(std=0.3)}
    options |= changes
    keys = ("noise", "disturbance", "inputs")
    system = {key: options.pop(key) for key in keys if key in options}
    return cb.Problem(cb.DiscreteSystem(f or (lambda x: 0.8 * x), states=1, **system), **options)


def limits(problem: cb.Problem, paths: int, seed: int, policy: Any = None) -> tuple[float, float]:
    """Clopper-Pearson limits (99.99 %) of the probability of failing from the initial point."""
    rng = np.random.default_rng(seed)
    step, system, initial = compile_numpy(problem.closed_loop), problem.system, problem.initial
    x = initial.sample(rng, paths) if isinstance(initial, cb.GaussianStart) else np.tile(initial.low, (paths, 1))
    safe = np.ones(paths, dtype=bool)
    for t in range(problem.horizon + 1):
        for c in problem.constraints:
            if c.during is None or c.during[0] <= t <= c.during[1]:
                safe &= c.satisfied(x, t)
        if t < problem.horizon:
            inputs = [] if problem.input_sequence is None else list(problem.input_sequence[t])
            given = [] if policy is None else policy(t, x)
            x = step(float(t), *x.T, *inputs, *given) + system.noise.sample(rng, paths) @ system.noise_matrix.T
    bad = int(np.sum(~safe))
    low = beta.ppf(1e-4, bad, paths - bad + 1) if bad else 0.0
    return float(low), float(beta.ppf(1 - 1e-4, bad + 1, paths - bad)) if bad < paths else 1.0


def test_one_step_is_a_normal_probability() -> None:
    found = bound_failure(scalar(), ratio=1.0001)
    exact = norm.sf((1 - 0.08) / 0.3) + norm.cdf((-1 - 0.08) / 0.3)
    assert found.lower <= exact <= found.upper <= exact * 1.001
    assert found.lower >= exact / 1.001


def test_both_sides_at_once_are_the_same_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    system = cb.DiscreteSystem(
        lambda x: [x[0] + 0.1 * x[1], x[1] - 0.5 * np.sin(x[0])], states=2, noise=cb.Gaussian(std=0.3)
    )
    problem = cb.Problem(system, initial=[0.1, 0.1], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=5)
    found, where, below = [], set[str](), failures.back_below

    def noted(*given: Any) -> Any:
        where.add(threading.current_thread().name)
        return below(*given)

    monkeypatch.setattr(failures, "back_below", noted)
    for cells in (math.inf, 1):
        monkeypatch.setattr(failures, "_APART", cells)
        work = Work(problem, None, 4)
        found.append(work.bounds(work.layout(0.5), 0.5))
        assert len(where) == (1 if cells > 1 else 2)
    assert found[0] == found[1]


def test_a_set_of_starts_counts_its_worst_point() -> None:
    found = bound_failure(scalar(initial=cb.Box([-0.2], [0.3])), ratio=1.0001)
    exact = norm.sf((1 - 0.24) / 0.3) + norm.cdf((-1 - 0.24) / 0.3)
    assert found.lower <= exact <= found.upper <= exact * 1.01
    assert found.lower >= exact / 1.001


@pytest.mark.parametrize("low", [-0.4, -0.31, -0.2])
def test_the_worst_start_may_lie_between_the_nodes(low: float) -> None:
    problem = scalar(
        lambda x: 0.6 - 3 * x**2,
        initial=cb.Box([low], [0.35]),
        noise=cb.Gaussian(std=0.1),
        safe=[cb.Inside(cb.Box([-2], [1]))],
    )
    assert bound_failure(problem, ratio=1e9).upper >= norm.sf(4.0)


def test_a_random_start_is_one_more_convolution() -> None:
    found = bound_failure(scalar(lambda x: x, initial=cb.GaussianStart([0.0], [[0.01]]), safe=[
        cb.Inside(cb.Box([-1], [1]), during=(1, 1))]), ratio=1.001)  # fmt: skip
    exact = 2 * norm.sf(1 / np.sqrt(0.1))
    assert found.lower <= exact <= found.upper <= exact * 1.01


def test_two_independent_states_fail_as_two_scalar_ones() -> None:
    one = bound_failure(scalar(horizon=3), ratio=1.001)
    system = cb.DiscreteSystem(lambda x: 0.8 * x, states=2, noise=cb.Gaussian(std=0.3))
    both = cb.Problem(system, initial=[0.1, 0.1], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=3)
    found = bound_failure(both, ratio=1.01)
    assert found.lower <= 1 - (1 - one.upper) ** 2 * (1 - 1e-9)
    assert found.upper >= 1 - (1 - one.lower) ** 2 * (1 - 1e-9)
    assert found.upper <= 1.03 * found.lower


def test_three_independent_states_fail_as_three_scalar_ones() -> None:
    one = bound_failure(scalar(lambda x: 0.3 * x, horizon=2), ratio=1.001)
    system = cb.DiscreteSystem(lambda x: 0.3 * x, states=3, noise=cb.Gaussian(std=0.3))
    three = cb.Problem(system, initial=[0.1] * 3, safe=[cb.Inside(cb.Box([-1] * 3, [1] * 3))], horizon=2)
    found = bound_failure(three, ratio=1.2)
    assert found.lower <= 1 - (1 - one.upper) ** 3 * (1 - 1e-9)
    assert found.upper >= 1 - (1 - one.lower) ** 3 * (1 - 1e-9)
    assert found.upper <= 1.2 * found.lower


@pytest.mark.parametrize("std", [0.04, 0.06])
def test_the_logistic_map_is_bounded_tightly(std: float) -> None:
    system = cb.DiscreteSystem(lambda x: 2.8 * x * (1 - x), states=1, noise=cb.Gaussian(std=std))
    problem = cb.Problem(system, initial=cb.Box([0.6], [0.7]), safe=[cb.Inside(cb.Box([0.35], [0.95]))], horizon=20)
    found = bound_failure(problem, ratio=1.03)
    low, high = limits(problem.replace(initial=[0.7]), 100_000, 0)
    assert found.upper <= 1.03 * found.lower
    assert found.upper >= low
    assert found.lower <= max(high, limits(problem.replace(initial=[0.6]), 100_000, 1)[1])


def _random(rng: np.random.Generator) -> cb.Problem:
    """Affine, bent, kinked or clocked dynamics in one or two states, with all sorts of sets."""
    n = int(rng.integers(1, 3))
    a = rng.normal(size=(n, n))
    a *= rng.uniform(0.3, 1.05) / np.abs(np.linalg.eigvals(a)).max()
    c, kind = rng.normal(size=n) * 0.3, int(rng.integers(5))

    def f(t: Any, x: Any) -> list[Any]:
        y = [sum(a[i, j] * x[j] for j in range(n)) for i in range(n)]
        more = [0 * x, np.sin(2 * x), x**2, 0 * x + np.cos(0.7 * t), abs(x)][kind]
        return [y[i] + c[i] * more[n - 1 - i] for i in range(n)]

    std = rng.uniform(0.1, 0.5, n)
    law = cb.Gaussian(std=std)
    if n == 2 and rng.random() < 0.3:
        r = rng.uniform(-0.8, 0.8) * std[0] * std[1]
        law = cb.Gaussian(covariance=np.array([[std[0] ** 2, r], [r, std[1] ** 2]]))
    low, high, horizon = -rng.uniform(0.6, 1.5, n), rng.uniform(0.6, 1.5, n), int(rng.integers(1, 9))
    boxes = [
        cb.Inside(cb.Box(low, high)),
        cb.Inside(cb.Box(low, high, center=lambda t: [0.1 * np.sin(t)] * n)),
        cb.Inside(cb.Box(low, high), during=(min(1, horizon - 1), max(horizon - 1, 1))),
    ]
    more = [[], [cb.Outside(cb.Box([0.4] * n, [0.6] * n))]]
    if n == 2:
        more += [[cb.Outside(cb.Ball([0.6, 0.6], 0.3))], [cb.Inside(cb.HalfSpace([1, 1], 0.9))]]
        more += [[cb.Inside(cb.Ellipsoid([0, 0], [[1.5, 0.4], [0.4, 1.0]]))]]
    safe = [boxes[int(rng.integers(3))], *more[int(rng.integers(len(more)))]]
    start: Any = rng.uniform(-0.2, 0.2, n)
    if rng.random() < 0.3:
        start = cb.GaussianStart(np.zeros(n), np.diag(rng.uniform(0.05, 0.2, n) ** 2))
    system = cb.DiscreteSystem(f, states=n, noise=law)
    return cb.Problem(system, initial=start, safe=safe, horizon=horizon)


def _check(seed: int, paths: int, seconds: float) -> None:
    problem = _random(np.random.default_rng(seed))
    found = bound_failure(problem, seconds=seconds, ratio=1.05)
    low, high = limits(problem, paths, seed)
    assert found.upper >= low
    assert found.lower <= high
    assert found.upper <= 2 * found.lower + 0.05


@pytest.mark.parametrize("seed", range(16))
def test_random_problems_agree_with_simulation(seed: int) -> None:
    _check(seed, 20_000, 1.0 if seed in (3, 8, 12, 13) else 0.3)  # those are close on finer grids only


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(16, 216))
def test_many_random_problems_agree_with_simulation(seed: int) -> None:
    _check(seed, 400_000, 1.0)


DISTURBED = [
    (lambda x, d: 0.8 * x + d, [-3.0], [1.0], lambda t, x: [np.full(len(x), 0.1)]),
    (lambda x, d: 0.8 * x + d, [-1.0], [1.0], lambda t, x: [np.where(x[:, 0] >= 0, 0.1, -0.1)]),
]


@pytest.mark.parametrize("case", DISTURBED)
def test_the_worst_disturbance_is_bounded_from_both_sides(case: Any) -> None:
    f, low, high, worst = case
    problem = scalar(
        f, initial=[0.0], safe=[cb.Inside(cb.Box(low, high))], horizon=8, noise=cb.Gaussian(std=0.2),
        disturbance=cb.Box([-0.1], [0.1]),
    )  # fmt: skip
    found = bound_failure(problem, ratio=1.03)
    under, over = limits(problem, 100_000, 3, worst)
    assert under <= found.upper <= 1.03 * found.lower
    assert found.lower <= over
    calm = bound_failure(problem.replace(system=cb.DiscreteSystem(
        lambda x: 0.8 * x, states=1, noise=cb.Gaussian(std=0.2))))  # fmt: skip
    assert calm.upper < found.lower


def test_inputs_by_step_and_by_feedback_agree() -> None:
    box = cb.Box([-1], [1])
    options: dict[str, Any] = {"inputs": box, "horizon": 4}
    by_step = scalar(lambda x, u: 0.8 * x + u, plan=[[0.1], [0.1], [0.1], [0.1]], **options)
    by_law = scalar(lambda x, u: 0.8 * x + u, plan=lambda t, x: [0.1], **options)
    first, second = bound_failure(by_step), bound_failure(by_law)
    assert first.upper == pytest.approx(second.upper, rel=1e-9)
    assert first.lower == pytest.approx(second.lower, rel=1e-9)


def test_a_target_ends_the_danger() -> None:
    plain = scalar(lambda x: x + 0.2, horizon=6, noise=cb.Gaussian(std=0.2), initial=[-0.5])
    found = bound_failure(plain, target=cb.Box([0.3], [1.0]), ratio=1.01)
    rng = np.random.default_rng(0)
    x, state = np.full(400_000, -0.5), np.zeros(400_000, dtype=int)
    for _ in range(6):
        x = x + 0.2 + 0.2 * rng.standard_normal(len(x))
        inside = (x >= 0.3) & (x <= 1.0)
        state = np.where(state == 0, np.where(np.abs(x) > 1, 1, np.where(inside, 2, 0)), state)
    failed = np.mean(state != 2)
    slack = 4 * np.sqrt(failed * (1 - failed) / len(x))
    assert found.lower - slack <= failed <= found.upper + slack
    assert found.upper <= 1.02 * found.lower


def test_a_state_without_a_constraint_is_followed_as_far_as_it_can_get() -> None:
    system = cb.DiscreteSystem(lambda x: [0.8 * x[0] + 0.1 * x[1], 0.5 * x[1]], states=2, noise=cb.Gaussian(std=0.2))
    free = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1], [1], coordinates=[0]))], horizon=4)
    found = bound_failure(free, ratio=1.02)
    low, high = limits(free, 200_000, 0)
    assert low <= found.upper <= 1.05 * found.lower
    assert found.lower <= high


def test_a_state_without_limits_is_cut_where_paths_do_not_get_to() -> None:
    """The worst cases of all steps lead across a pole at n = -1, and no path goes there."""
    system = cb.DiscreteSystem(
        lambda a, n: [0.9 * a + 0.1 * a * n / (1 + n), n + 0.1 * (1 - n)], states=["a", "n"],
        noise=cb.Gaussian(std=[0.1, 0.1]),
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([0.2], [1.4], coordinates=[0]))]
    problem = cb.Problem(system, initial=[0.5, 1.0], safe=safe, horizon=8, delta=0.5)
    found = bound_failure(problem, seconds=1.0, ratio=1.5)
    low, high = limits(problem, 20_000, 0)
    assert 0 < found.lower < high
    assert low < found.upper < 1


def test_what_passes_a_cut_is_safe_from_below_and_fails_from_above(monkeypatch: pytest.MonkeyPatch) -> None:
    """Boxes that end right beside the start: most paths pass their ends, and none has failed."""
    system = cb.DiscreteSystem(lambda x, y: [0.5 * x, 0.5 * y], states=["x", "y"], noise=cb.Gaussian(std=[0.3, 0.3]))
    safe = [cb.Inside(cb.Box([-1.0], [1.0], coordinates=[0]))]
    problem = cb.Problem(system, initial=[0.0, 0.0], safe=safe, horizon=3, delta=0.5)
    boxes = layout.Boxes(np.tile([-2.8, -0.2], (4, 1)), np.tile([2.8, 0.2], (4, 1)), 0.0, cut=True)
    monkeypatch.setattr(failures, "boxes_of", lambda *_: boxes)
    work = Work(problem, None, 1)
    upper, lower = work.bounds(work.layout(0.33), 0.33)
    _, high = limits(problem, 20_000, 0)
    assert lower < high < 0.5 < upper


def test_wider_sets_shorter_horizons_and_less_noise_are_never_worse() -> None:
    base = bound_failure(scalar(horizon=5), ratio=1.01)
    for better in (
        scalar(horizon=4), scalar(horizon=5, noise=cb.Gaussian(std=0.25)),
        scalar(horizon=5, safe=[cb.Inside(cb.Box([-1.1], [1.1]))]),
    ):  # fmt: skip
        assert bound_failure(better, ratio=1.01).upper < base.upper


def test_where_the_model_is_undefined_counts_as_failing() -> None:
    found = bound_failure(scalar(lambda x: 0.8 * np.sqrt(x), initial=[0.5], horizon=2))
    assert found.upper >= norm.cdf((0 - 0.8 * np.sqrt(0.5)) / 0.3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"safe": [cb.Inside(cb.Box([-np.inf], [1]))], "f": lambda x: 1e9 * x}, "more than"),
        ({"noise": cb.Gaussian(std=0.0)}, "noise of its own"),
        ({"noise": cb.Rademacher(scale=0.1)}, "Rademacher"),
        ({"noise": cb.Bounded(halfwidth=0.1)}, "class of laws"),
        ({"noise": cb.Gaussian(std=1e-8)}, "of use"),
    ],
)
def test_what_does_not_fit_is_refused_in_words(
    monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], words: str
) -> None:
    monkeypatch.setattr(failures, "_MOST_NODES", 30_000)
    monkeypatch.setattr(layout, "_MOST_PLACES", layout._MOST_PLACES // 100)
    with pytest.raises(Inapplicable, match=words):
        bound_failure(scalar(**change))


def test_four_states_and_too_many_nodes_are_refused() -> None:
    four = cb.DiscreteSystem(lambda x: 0.5 * x, states=4, noise=cb.Gaussian(std=0.1))
    with pytest.raises(Inapplicable, match="at most 3 states, not 4"):
        bound_failure(cb.Problem(four, initial=[0] * 4, safe=[cb.Inside(cb.Box([-1] * 4, [1] * 4))], horizon=2))
    fine = cb.DiscreteSystem(lambda x: x, states=2, noise=cb.Gaussian(std=5e-4))
    with pytest.raises(Inapplicable, match="more than 3000000 nodes"):
        bound_failure(cb.Problem(fine, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=2))


def test_bounds_do_not_depend_on_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = scalar(horizon=6)
    first = bound_failure(problem, seconds=0.02, ratio=1.0001)
    ticks = iter(range(0, 10**9, 1000))
    monkeypatch.setattr("certbound.values.discrete.failures.time.perf_counter", lambda: float(next(ticks)))
    second = bound_failure(problem, seconds=0.02, ratio=1.0001)
    assert first.tried == second.tried
    assert len(first.tried) > 1
    longer = bound_failure(problem, seconds=5.0, ratio=1.0001)
    assert longer.share < first.share


def test_sizes_of_cells_that_would_leave_too_wide_a_gap_are_left_out() -> None:
    shares = [share for share, _, _ in bound_failure(scalar(horizon=6), ratio=1.001).tried]
    assert shares[0] == 0.33
    assert 0.15 not in shares
    left = [0.33, 0.22, 0.15, 0.1]
    assert without_hopeless(left, (0.5, 2.8, 1.58), 1.05, 2.5, lambda share: True)[0] == 0.15
    assert without_hopeless(left, (0.5, 2.8, 1.58), 1.05, 2.5, lambda share: share > 0.3) == left
    assert without_hopeless(left, (0.5, 2.8, 0.0), 1.05, 2.5, lambda share: True) == left


def test_boxes_of_long_horizons_cost_in_proportion(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def noted(constraints: Any, dimension: int, step: int) -> Any:
        asked.append(step)
        return box_around(constraints, dimension, step)

    monkeypatch.setattr(layout, "box_around", noted)
    problem = scalar(horizon=40, noise=cb.Gaussian(std=0.1))
    assert bound_failure(problem, seconds=0.01).upper < 1
    assert asked == list(range(41))


def _kept(f: Any, std: float, safe: tuple[float, float], start: float, steps: int) -> float:
    """P(leaving) of x+ = f(x) + std w by the midpoint rule on 1500 cells."""
    edges = np.linspace(*safe, 1501)
    middles = np.append((edges[1:] + edges[:-1]) / 2, start)
    step = np.diff(norm.cdf((edges[None] - f(middles)[:, None]) / std), axis=1)
    left = np.ones(1500)
    for _ in range(steps - 1):
        left = step[:-1] @ left
    return float(1 - step[-1] @ left)


@pytest.mark.parametrize(
    ("f", "std", "safe", "start", "ratio"),
    [
        (lambda x: x + 0.1 * (10 - x) + np.where(x < 20, 1.8, 0.0), 0.3, (18.6, 21.2), 20.1, 1.02),  # a thermostat
        (lambda x: np.where(x < 40, 100.0, x) - 10, 4.0, (16.0, 120.0), 100.0, 1.4),  # a stock that is filled up
    ],
)
def test_over_a_jump_what_both_sides_of_it_lead_to_counts(
    f: Any, std: float, safe: tuple[float, float], start: float, ratio: float
) -> None:
    limits, law = [cb.Inside(cb.Box([safe[0]], [safe[1]]))], cb.Gaussian(std=std)
    found = bound_failure(scalar(lambda x: f(x[0]), noise=law, safe=limits, initial=[start], horizon=20), ratio=1.01)
    exact = _kept(f, std, safe, start, 20)
    assert found.lower <= exact * 1.001  # of the midpoint rule
    assert exact * 0.999 <= found.upper
    assert found.upper <= ratio * exact <= ratio**2 * found.lower


def test_uniform_noise_over_a_jump() -> None:
    worn = cb.DiscreteSystem(
        lambda x: np.where(x[0] > 8, 0.0, x[0]) + 0.5, states=["wear"], noise=cb.Uniform(halfwidth=0.5)
    )
    problem = cb.Problem(worn, initial=[7.0], safe=[cb.Inside(cb.Box([-1], [9.1]))], horizon=6)
    assert bound_failure(problem, delta=1e-2).upper <= 1e-2  # 0: more than 8 is replaced, and at most 1 is added
    tight = problem.replace(safe=[cb.Inside(cb.Box([-1], [8.6]))])
    found, (low, high) = bound_failure(tight, ratio=1.3), limits(tight, 20_000, 3)
    assert found.lower <= high
    assert found.upper >= low
    assert found.upper <= 1.3 * found.lower


def test_disturbances_over_a_jump() -> None:
    pushed = scalar(
        lambda x, d: np.where(x[0] + d[0] > 0.3, -0.4, x[0]) + d[0], noise=cb.Gaussian(std=0.1), horizon=6,
        disturbance=cb.Box([-0.1], [0.1]), initial=[0.0], safe=[cb.Inside(cb.Box([-0.8], [0.55]))],
    )  # fmt: skip
    found = bound_failure(pushed)
    for policy in (lambda t, x: [np.full(len(x), 0.1)], lambda t, x: [np.where(x[:, 0] > 0, -0.1, 0.1)],
                   lambda t, x: [np.where(x[:, 0] > 0.1, 0.1 * (x[:, 0] < 0.2), 0.1)]):  # fmt: skip
        assert found.upper >= limits(pushed, 20_000, 4, policy)[0]
    assert 0 < found.lower < found.upper < 0.9
