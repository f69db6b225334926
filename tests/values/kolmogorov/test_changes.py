"""Models that change with time, and bounded disturbances: products, factors, residuals and bounds hold."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.linalg import solve_banded

import certbound as cb
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.values.kolmogorov import bound_failing
from certbound.values.kolmogorov.box_setting import Setting, stages_of
from certbound.values.kolmogorov.door import refined, side_of, starts_in
from certbound.values.kolmogorov.equation import knots_of
from certbound.values.kolmogorov.factors import HALF, clock_breaks, disturbance_nodes, factor_of
from certbound.values.kolmogorov.products import separated

MODELS = {
    "a forced oscillator": lambda t, x, d: [x[1], -x[0] - 0.3 * x[1] + 0.4 * np.cos(2 * t) + d[0]],
    "a parameter that swings": lambda t, x, d: [x[1], -(1 + 0.3 * np.cos(t)) * x[0] + d[0] * x[1]],
    "a season": lambda t, x, d: [x[0] * (1 - x[0] / (2 + np.sin(t))) - x[0] * x[1] / (3 + x[0]), d[0] * x[0] * x[1]],
    "moved powers": lambda t, x, d: [-((x[0] - np.sin(t)) ** 3) + d[0] ** 2, -((x[1] + d[0] * np.sin(t)) ** 2)],
    "switches and kinks": lambda t, x, d: [
        np.where(t < 1, 1.0, x[0]) - x[1], d[0] * np.abs(np.sin(3 * t)) - np.abs(x[1]) * np.where(t < 0.4, 1.0, 2.0)
    ],
}  # fmt: skip


def system(name: str = "a forced oscillator", diffusion: object = None) -> cb.ContinuousSystem:
    g = 0.4 * np.eye(2) if diffusion is None else diffusion
    return cb.ContinuousSystem(MODELS[name], states=2, disturbance=cb.Box([-0.2], [0.3]), diffusion=g)


def problem(name: str = "a forced oscillator", diffusion: object = None) -> cb.Problem:
    stay = [cb.Inside(cb.Box([-1, -1.5], [1, 1.5]))]
    return cb.Problem(system(name, diffusion), initial=[0, 0], safe=stay, horizon=2.0)


@pytest.mark.parametrize("name", MODELS)
def test_a_model_is_the_sum_of_its_products(name: str) -> None:
    tape, rng = system(name).dynamics, np.random.default_rng(0)
    found = separated(tape, 2)
    assert found is not None
    t, x, y, d = rng.normal(size=(4, 50)) * 2
    total = np.zeros((50, 2))
    for one in found:
        factor = 1.0 if one.coefficient is None else compile_numpy(one.coefficient)(t, d)
        total = total + factor * compile_numpy(one.function)(t, x, y)
    assert np.allclose(total, compile_numpy(tape)(t, x, y, d), atol=1e-11, rtol=1e-11)


INSIDE = {
    "a wave": lambda t, x: [np.sin(x[0] - t), -x[1]],
    "a moving kink": lambda t, x: [np.abs(x[0] - t), -x[1]],
    "a moving switch": lambda t, x: [np.where(x[0] < 0.1 * t, 1.0, -1.0), -x[1]],
}


@pytest.mark.parametrize("name", INSIDE)
def test_time_inside_of_a_function_of_the_state_is_no_product_and_refused_in_words(name: str) -> None:
    moving = cb.ContinuousSystem(INSIDE[name], states=2, diffusion=np.eye(2))
    assert separated(moving.dynamics, 2) is None
    asked = cb.Problem(moving, initial=[0.5, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1)
    with pytest.raises(InfeasibleError, match="as factors of functions of the state"):
        stages_of(asked)[0]


def of_time(text: object, disturbance: cb.Box | None = None):
    box = {} if disturbance is None else {"disturbance": disturbance}
    model = cb.ContinuousSystem(text, states=1, diffusion=[[1.0]], **box)
    (one,) = [row for row in separated(model.dynamics, 1) or [] if row.coefficient is not None]
    return one.coefficient


FACTORS = {
    "smooth": (lambda t, x: [x[0] * np.sin(3 * t)], 0.03),
    "a kink": (lambda t, x: [x[0] * np.abs(np.sin(5 * t))], 1.5),
    "a jump": (lambda t, x: [x[0] * np.sign(np.sin(5 * t))], 2.5),
}


@pytest.mark.parametrize("name", FACTORS)
def test_a_factor_is_off_its_polynomials_by_at_most_its_errors(name: str) -> None:
    text, most = FACTORS[name]
    coefficient = of_time(text)
    times = np.linspace(2, 0, 12)
    factor = factor_of(coefficient, times, (0.0, 2.0), *disturbance_nodes([coefficient], np.zeros(0), np.zeros(0)))
    s = np.linspace(0, 1, 101)[:, None]
    basis = np.concatenate([(1 - s) ** 2, 2 * s * (1 - s), s**2], axis=1)
    for k in range(11):
        truth = compile_numpy(coefficient)(times[k + 1] + s[:, 0] * (times[k] - times[k + 1]))[:, 0]
        off = np.abs(basis @ factor.bernstein[0, k] - truth)
        assert np.all(off <= factor.error[0, k])
        assert np.all(np.abs(truth) <= factor.size[k])
    assert factor.error.max() < most


def test_a_factor_between_the_nodes_of_a_disturbance_that_bends_it_is_paid_for() -> None:
    coefficient = of_time(lambda t, x, d: [x[0] * np.sin(2 * d[0]) * t], cb.Box([-1], [1]))
    nodes, gaps = disturbance_nodes([coefficient], np.array([-1.0]), np.array([1.0]))
    factor = factor_of(coefficient, np.linspace(2, 0, 5), (0.0, 2.0), nodes, gaps)
    assert len(nodes) == 5
    d = np.linspace(-1, 1, 201)
    chords = np.interp(d, nodes[:, 0], compile_numpy(coefficient)(2.0, nodes[:, 0])[:, 0])
    off = np.abs(chords - compile_numpy(coefficient)(2.0, d)[:, 0]).max()
    assert 0.5 * factor.between[0] < off <= factor.between[0]
    straight = of_time(lambda t, x, d: [x[0] * d[0] * t], cb.Box([-1], [1]))
    assert len(disturbance_nodes([straight], np.array([-1.0]), np.array([1.0]))[0]) == 2


def test_too_many_disturbances_are_refused_in_words() -> None:
    with pytest.raises(InfeasibleError, match="at most 16 combinations"):
        disturbance_nodes([], -np.ones(5), np.ones(5))


def test_a_factor_without_a_finite_range_is_refused() -> None:
    coefficient = of_time(lambda t, x: [x[0] / (t - 1)])
    with pytest.raises(EnclosureError):
        factor_of(coefficient, np.linspace(2, 0, 6), (0.0, 2.0), np.zeros((1, 0)), np.zeros(0))


def test_the_clock_s_jumps_and_bends_are_found_and_each_stands_in_a_slab_of_its_own() -> None:
    tape = cb.ContinuousSystem(
        lambda t, x: [np.where(t < 0.3, 1.0, 2.0) * x[0] + np.abs(np.sin(2 * t)) + np.floor(t / 0.9)], states=1,
        diffusion=[[1.0]],
    ).dynamics  # fmt: skip
    breaks = clock_breaks([tape], 2.0)
    assert np.allclose(breaks, [0.3, 0.9, np.pi / 2, 1.8], atol=1e-12)
    times = knots_of(0.0, 2.0, partial(np.full_like, fill_value=0.1), 0.1, breaks, 2)
    assert times[0] == 2.0
    assert times[-1] == 0.0
    assert np.all(np.diff(times) < 0)
    for time in (0.3, 0.9, np.pi / 2, 1.8):
        k = int(np.flatnonzero((times[1:] < time) & (times[:-1] > time))[0])
        assert times[k] - times[k + 1] == pytest.approx(4 * HALF, rel=1e-3)
    with pytest.raises(InfeasibleError, match="jumps and bends"):
        clock_breaks([tape], 2000.0)


def spline_at(axes, coefficients: np.ndarray, points: np.ndarray, orders: tuple[int, int]) -> np.ndarray:
    rows = [one.at_points(points[:, k], order).along(np.eye(one.cells + 5), 0) for k, (one, order)
            in enumerate(zip(axes, orders))]  # fmt: skip
    return np.einsum("pi,pj,ij->p", *rows, coefficients)


@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize("name", MODELS)
def test_the_residual_of_a_random_function_lies_below_its_bound_at_all_times(name: str, above: bool) -> None:
    """From above for every disturbance, from below for one of the nodes."""
    rng = np.random.default_rng(3)

    def noise(t, x):
        return [[0.4 + 0.1 * np.sin(4 * t) * x[0], 0.0], [0.2, 0.3 * np.exp(-t)]]

    setting = stages_of(problem(name, noise))[0]
    side = side_of([setting], 0.3, 6, above)
    shape = (len(side.steps) + 1, *(axis.cells + 5 for axis in side.axes))
    side.values, side.rates = list(rng.normal(size=shape)), list(rng.normal(size=shape))
    side._decided = lambda *given: np.zeros(given[0][1:, :-5, :-5].shape, dtype=bool)
    bounds = side.residuals()
    points = np.stack([rng.uniform(one.nodes[0], one.nodes[-1], 400) for one in side.axes], axis=1)
    cells = tuple(np.searchsorted(one.nodes, points[:, k], side="right") - 1 for k, one in enumerate(side.axes))
    drift, square = (compile_numpy(one.tape) for one in (setting.drift, setting.square))
    acting = np.append(rng.uniform(-0.2, 0.3, 6), [-0.2, 0.3]) if above else setting.nodes[:, 0]
    for k in range(len(side.steps)):
        h, early, late = side.steps[k], k + 1, k
        t = rng.uniform(0, 1, len(points))
        basis = [2 * t**3 - 3 * t**2 + 1, (t**3 - 2 * t**2 + t) * h, 3 * t**2 - 2 * t**3, (t**3 - t**2) * h]
        slope = [(6 * t**2 - 6 * t) / h, 3 * t**2 - 4 * t + 1, (6 * t - 6 * t**2) / h, 3 * t**2 - 2 * t]
        data = (side.values[early], side.rates[early], side.values[late], side.rates[late])

        def at(orders: tuple[int, int], weights: list[np.ndarray], data: tuple = data) -> np.ndarray:
            return sum(w * spline_at(side.axes, one, points, orders) for w, one in zip(weights, data))

        time = side.times[early] + t * (side.times[late] - side.times[early])
        a = square(time, *points.T)
        rest = at((0, 0), slope) + a[:, 0, 0] / 2 * at((2, 0), basis) + a[:, 1, 1] / 2 * at((0, 2), basis)
        rest += a[:, 0, 1] * at((1, 1), basis)
        first, second = at((1, 0), basis), at((0, 1), basis)
        seen = np.array([rest + (drift(time, *points.T, d) * np.stack([first, second], axis=1)).sum(axis=1)
                         for d in acting])  # fmt: skip
        if above:
            assert np.all(seen <= np.maximum(bounds[k][cells], 0) + 1e-9 * np.abs(seen).max())
        else:  # one node serves each cell: at the points of a cell the least of the largest
            for cell in set(zip(*cells)):
                own = (cells[0] == cell[0]) & (cells[1] == cell[1])
                assert seen[:, own].max(axis=1).min() <= max(bounds[k][cell], 0) + 1e-9 * np.abs(seen).max()


def survival(model: object, disturbed: bool = False, nodes: int = 401, steps: int = 1600) -> np.ndarray:
    """Of one state within [-1, 1] up to 2, at starts on a line, by Crank and Nicolson after a few implicit steps."""
    x, h = np.linspace(-1, 1, nodes), 2.0 / steps
    gap, a = x[1] - x[0], np.where(np.abs(x) < 1, 1.0, 0.0)
    for k in range(steps):
        share = 1.0 if k < 8 else 0.5
        worst = -0.1 * np.sign(np.gradient(a, x)) if disturbed else 0.0
        f = np.broadcast_to(model(2.0 - (k + 0.5) * h, x) + worst, x.shape)
        up, down = 0.125 / gap**2 + f / (2 * gap), 0.125 / gap**2 - f / (2 * gap)
        up[[0, -1]] = down[[0, -1]] = 0.0
        right = a + (1 - share) * h * (up * np.roll(a, -1) + down * np.roll(a, 1) - (up + down) * a)
        rows = np.array([np.roll(-share * h * up, 1), 1 + share * h * (up + down), np.roll(-share * h * down, -1)])
        a = solve_banded((1, 1), rows, right)
    return a


def two_apart(model: object, disturbed: bool = False) -> tuple[cb.Problem, float]:
    """Two states, the first perhaps with a disturbance, and what fails by the product of survivals."""
    if disturbed:
        two = cb.ContinuousSystem(
            lambda t, x, d: [model(t, x[0]) + d[0], model(t, x[1])], states=2, diffusion=0.5 * np.eye(2),
            disturbance=cb.Box([-0.1], [0.1]),
        )  # fmt: skip
    else:
        two = cb.ContinuousSystem(
            lambda t, x: [model(t, x[0]), model(t, x[1])], states=2, diffusion=0.5 * np.eye(2)
        )  # fmt: skip
    asked = cb.Problem(two, initial=[0.2, 0.2], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=2.0)
    first, second = (float(np.interp(0.2, np.linspace(-1, 1, 401), survival(model, one))) for one in (disturbed, False))
    return asked, 1 - first * second


TIMED = {
    "swinging": lambda t, x: -(1 + 0.5 * np.sin(3 * t)) * x + 0.3 * np.cos(2 * t),
    "switched": lambda t, x: np.where(t < 0.7, -x, -2 * x) + 0.2 * np.abs(np.sin(4 * t)),
}


@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize(("name", "disturbed"), [("swinging", False), ("switched", False), ("swinging", True)])
def test_two_states_apart_fail_as_often_as_the_bounds_say(name: str, disturbed: bool, above: bool) -> None:
    asked, truth = two_apart(TIMED[name], disturbed)
    side = side_of([stages_of(asked)[0]], 0.06, 30, above)
    side.propose()
    bound, _, _ = refined(side, starts_in(asked))
    if above:
        assert truth * 0.995 <= bound < 4 * truth
    else:
        assert -truth * 1.005 <= bound < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("name", "disturbed"), [("swinging", False), ("switched", False), ("swinging", True)])
def test_the_bounds_are_close_where_there_is_time(name: str, disturbed: bool) -> None:
    asked, truth = two_apart(TIMED[name], disturbed)
    found = list(bound_failing(asked, seconds=20))[-1]
    assert found.lower <= truth * 1.005
    assert found.upper >= truth * 0.995
    assert 0.6 * truth < found.lower < found.upper < 1.5 * truth


@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize("wrong", ["noise", "half", "policy"])
def test_a_wrong_proposal_costs_width_and_never_truth(above: bool, wrong: str) -> None:
    asked, truth = two_apart(TIMED["swinging"], True)
    setting, rng = stages_of(asked)[0], np.random.default_rng(7)
    side = side_of([setting], 0.1, 12, above)
    if wrong == "policy":  # the disturbances that do least
        side._worst = lambda mesh, time, a: np.zeros(mesh.equation.shape, dtype=np.intp)
    side.propose()
    for rows in (side.values, side.rates):
        for k, row in enumerate(rows):
            rows[k] = row + 0.02 * rng.normal(size=row.shape) if wrong == "noise" else row
            rows[k] = 0.5 * row if wrong == "half" else rows[k]
    bound, _, _ = refined(side, starts_in(asked))
    if above:
        assert bound >= truth * 0.995
    else:
        assert -bound <= truth * 1.005


def test_a_face_that_paths_can_leave_through_for_some_time_or_disturbance_only_is_left_then() -> None:
    for text, box in (
        (lambda t, x: [np.cos(t) - 0.5, -x[1]], {}),
        (lambda t, x, d: [d[0] - 0.5, -x[1]], {"disturbance": cb.Box([-1], [1])}),
    ):
        moved = cb.ContinuousSystem(text, states=2, diffusion=[[0.0], [0.5]], **box)
        asked = cb.Problem(moved, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=2.0)
        side = side_of([stages_of(asked)[0]], 0.2, 8, True)
        upper = next(face for face in side.faces if (face.axis, face.side) == (0, 1))
        if box:
            assert upper.leaves.all()
        else:
            assert np.array_equal(upper.leaves.all(axis=1), side.times[1:] <= np.arccos(0.5))
            assert upper.leaves.any(axis=1).sum() < len(side.steps)


def test_a_root_that_no_factor_shows_is_refused_where_it_is_undefined() -> None:
    rooted = cb.ContinuousSystem(
        lambda t, x: [-x[0], -x[1]], states=2, diffusion=lambda t, x: [[np.sqrt(x[0]) * (1 + t), 0.0], [0.0, 0.5]]
    )
    asked = cb.Problem(rooted, initial=[0.5, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1.0)
    setting = stages_of(asked)[0]
    assert isinstance(setting, Setting)
    with pytest.raises(EnclosureError, match="undefined"):
        side_of([setting], 0.2, 8, True)


def test_no_lower_bound_is_said_of_unknown_constants_or_of_disturbances_where_the_drift_jumps() -> None:
    stay = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    torn = cb.ContinuousSystem(
        lambda x, d: [np.where(x[0] < 0.1, 0.4, -0.4) + d[0], -x[1]], states=2, diffusion=0.5 * np.eye(2),
        disturbance=cb.Box([-0.3], [0.3]),
    )  # fmt: skip
    assert stages_of(cb.Problem(torn, initial=[0, 0], safe=stay, horizon=2.0))[0].torn
    smooth = cb.ContinuousSystem(
        lambda x, d: [d[0] - x[0], -x[1]], states=2, diffusion=0.5 * np.eye(2), disturbance=cb.Box([-0.3], [0.3])
    )
    worst = cb.Problem(smooth, initial=[0.6, 0], safe=stay, horizon=1.0)
    assert not stages_of(worst)[0].torn
    for asked in (worst.replace(unknown=["d"]), worst.replace(system=torn, horizon=0.5)):
        assert all(found.lower == 0 for found in bound_failing(asked, seconds=1.5))
