"""Value functions in the checker: its arithmetic against samples, its bounds against the engine's, forged files."""

from __future__ import annotations

import base64
import itertools
import json
import math
import zlib
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from flint import arb, arb_mat
from scipy.integrate import quad
from scipy.stats import norm

import certbound as cb
from certbound.checker import check_data, parse
from certbound.checker.reading import Record, unpacked
from certbound.checker.report import SECOND, Budget, Unproved
from certbound.checker.statement import read_model, starts_of
from certbound.checker.values import batches as tm
from certbound.checker.values import check_values_below, quadratic, walls
from certbound.checker.values.batch_tapes import run
from certbound.checker.values.crossing import Crossing, has_full_rank
from certbound.checker.values.hermite import Levels, Surface
from certbound.checker.values.normal_means import ORDER, axis_table, mean_table
from certbound.checker.values.passage import Passage
from certbound.checker.values.quadratic import missing_form, splitting
from certbound.checker.values.second_order import Flow
from certbound.checker.values.step_back import Grid, Steps, Values
from certbound.checker.values.uniform_means import UniformTransition
from certbound.errors import CertificateError
from certbound.problem.model import trace
from certbound.quadratic import bound_quadratic
from certbound.quadratic.form_matrices import splitting as enclosed_splitting
from certbound.safety.answers import EngineAnswer, exact
from certbound.safety.certificate import certificate_text, initial_data, problem_data
from certbound.safety.certificates import values_proof_below
from certbound.safety.certificates.parts import packed
from certbound.safety.verification import verify_safety
from certbound.values.continuous import bound_exits
from tests.checker.conftest import (
    exit_certificate,
    leaving,
    quadratic_certificate,
    shaken,
    side_of,
    squared,
    squared_certificate,
    started,
    valued,
    valued_plane,
    valued_space,
)
from tests.checker.forgeries import repacked, text
from tests.checker.mutations import rejected

FUNCTIONS = [
    lambda x: [np.sin(3 * x[0]) * x[1] + np.exp(-x[0])], lambda x: [np.sqrt(x[0] + 3) / (2 + x[1])],
    lambda x: [np.abs(x[0] - x[1])], lambda x: [np.maximum(x[0], x[1]) + np.minimum(0.3, x[0])],
    lambda x: [np.where(x[0] > 0.2, x[1] ** 3, np.tanh(x[0]))],
    lambda x: [np.log(x[0] + 4.5) ** 2.5 + np.hypot(x[0], x[1])],
]  # fmt: skip


def value_of(batch: tm.Batch, xi: np.ndarray) -> np.ndarray:
    powers = [np.prod([x**k for x, k in zip(xi, a)]) for a in batch.terms.exponents]
    return np.asarray(np.tensordot(powers, batch.coefficients, axes=1))


@pytest.mark.parametrize("function", FUNCTIONS)
def test_taylor_models_hold_the_function_everywhere_on_their_boxes(function: Any) -> None:
    rng = np.random.default_rng(3)
    tape = trace(function, {"x": ["a", "b"]})
    which = tm.terms(2, 4)
    low = rng.uniform(-1, 0.9, (2, 60))
    high = low + rng.choice([0.0, 0.01, 0.2, 0.7], (2, 60))
    with np.errstate(all="ignore"):
        (found,) = run(tape, [tm.variable(which, i, low[i], high[i]) for i in range(2)])
        ends, sharp = found.ends(), found.sharp_ends()
    for xi in itertools.product((-1.0, -0.3, 0.55, 1.0), repeat=2):
        x = (low + high) / 2 + np.array(xi)[:, None] * (high - low) / 2
        truth = np.array([function(point)[0] for point in x.T])
        assert (np.abs(value_of(found, np.array(xi)) - truth) <= found.error + 1e-15).all()
        for bottom, top in (ends, sharp):
            assert (truth >= bottom - 1e-15).all()
            assert (truth <= top + 1e-15).all()
    assert np.isfinite(found.error).mean() > 0.5
    assert not ((sharp[0] < ends[0] - 1e-9) | (sharp[1] > ends[1] + 1e-9)).any()


def test_what_is_undefined_or_jumps_on_a_box_is_unknown() -> None:
    which = tm.terms(1, 3)
    x = tm.variable(which, 0, np.array([-0.5, 0.5]), np.array([0.1, 0.6]))
    with np.errstate(all="ignore"):
        for function in (lambda x: [np.log(x[0])], lambda x: [1 / x[0]], lambda x: [np.sign(x[0])]):
            (found,) = run(trace(function, {"x": ["a"]}), [x])
            assert not np.isfinite(found.error[0])
            assert found.error[1] < 1e-3


def test_means_after_the_noise_agree_with_quadrature() -> None:
    edges, points = np.array([-1.0, -0.2, 0.1, 1.5]), np.array([-0.7, 0.0, 2.0])
    deviation, degree = 0.4, 3
    table = axis_table(points, edges, arb(deviation), degree, Budget(60.0))
    rng = np.random.default_rng(1)
    pieces = np.zeros((degree + 1, len(edges) + 1))
    pieces[:, 1:-1] = rng.normal(size=(degree + 1, 3))
    pieces[0, [0, -1]] = 1.0, 0.5
    found = mean_table([table], pieces, Budget(60.0))

    def u(y: float) -> float:
        k = int(np.searchsorted(edges, y))
        if k in (0, len(edges)):
            return float(pieces[0, k])
        xi = (y - (edges[k] + edges[k - 1]) / 2) / ((edges[k] - edges[k - 1]) / 2)
        return float(np.polyval(pieces[::-1, k], xi))

    def mean(m: float) -> float:
        return sum(quad(lambda y: u(y) * norm.pdf(y, m, deviation), a, b, epsabs=1e-13)[0]
                   for a, b in itertools.pairwise([-4.0, *edges, 6.0]))  # fmt: skip

    for j, m in enumerate(points):
        for v in (0.0, 0.3, -0.9):
            taylor = sum(found.derivatives[a,][j] * v**a for a in range(ORDER))
            allowed = found.dominant[j] * float(found.missing(np.array([abs(v)]))[0]) + found.far
            assert abs(taylor - mean(m + v * deviation)) <= allowed + 1e-10
    assert float(found.missing(np.array([0.2]))[0]) < 1e-5
    assert found.missing(np.array([2.0]))[0] == math.inf


@pytest.mark.parametrize("points", [[-60.0, -0.37, 0.0, 49.0, 300.0], [-60.0], [300.0]])
def test_cells_far_from_a_point_of_the_mesh_take_no_work_and_have_their_weight(points: list[float]) -> None:
    edges, deviation = np.linspace(-50.0, 50.0, 2001), 0.4

    budget = Budget(60.0)
    found = axis_table(np.array(points), edges, arb(deviation), 2, budget)
    assert 60.0 - budget.work / SECOND < 0.045 * len(points)  # of those within 17 deviations, not of 2,000 cells
    sides = [-np.inf, *edges, np.inf]
    for j, point in enumerate(points):
        wide, exact = (np.diff(norm.cdf(sides, point, s)) for s in (2**0.5 * deviation, deviation))
        assert np.all(found.weight[j] >= wide * (1 - 1e-6) - 1e-15)
        assert found.weight[j].sum() < 1 + 1e-9
        assert found.integrals[0, 0, j] == pytest.approx(exact, abs=1e-14)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_tables_of_means_are_the_sums_of_products_that_they_stand_for(n: int) -> None:
    rng, degree = np.random.default_rng(n), 2
    edges = [np.sort(rng.uniform(-1, 1, 3 + i)) for i in range(n)]
    tables = [axis_table(np.array([-0.3, 0.4, 0.9])[: 3 - i], edges[i], arb(0.3 + 0.1 * i), degree, Budget(60.0))
              for i in range(n)]  # fmt: skip
    pieces = rng.normal(size=(degree + 1,) * n + tuple(len(row) + 1 for row in edges))
    found = mean_table(tables, pieces, Budget(60.0))
    assert len(found.derivatives) == math.comb(ORDER - 1 + n, n)
    for orders in [(0,) * n, (ORDER - 1, *(0,) * (n - 1)), (*(0,) * (n - 1), 3), tuple(range(1, n + 1))]:
        given: list[Any] = [pieces, list(range(2 * n))]
        for i, (order, table) in enumerate(zip(orders, tables)):
            given += [table.integrals[order], [i, 2 * n + i, n + i]]
        truth = np.einsum(*given, list(range(2 * n, 3 * n)))
        allowed = found.dominant * found.missing(np.zeros(1)) + found.far
        assert found.derivatives[orders].shape == truth.shape
        assert (np.abs(found.derivatives[orders] - truth) <= allowed + 1e-12).all()


def test_means_after_uniform_noise_hold_everywhere_on_the_images() -> None:
    """U jumps between cells; x+ = .7 x + .2 sin(3 x) + w, w uniform on [-.3, .3]."""
    system = cb.DiscreteSystem(
        lambda x: [0.7 * x[0] + 0.2 * np.sin(3 * x[0])], states=["x"], noise=cb.Uniform(halfwidth=0.3)
    )
    problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=2, delta=0.5)
    model = read_model(json.loads(json.dumps(problem_data(problem))), Budget(60.0))
    rng = np.random.default_rng(7)
    grid = Grid((np.array([-1.0, -0.7, -0.2, 0.05, 0.1, 0.6, 1.1]),))
    value = Values(grid, rng.normal(size=(5, 6)), 1.5)
    places = np.sort(rng.uniform(-1.6, 1.6, 40))
    low, high = places, places + rng.choice([0.0, 0.01, 0.3], 40)
    transition = UniformTransition(Steps(model, 1, Budget(60.0), upper=True), 0, low[None], high[None], grid)
    found = transition.mean(transition.images[0], transition.table(value))

    def u(y: np.ndarray) -> np.ndarray:
        k = np.searchsorted(grid.edges[0], y)
        inside = (k > 0) & (k < 7)
        k = np.clip(k, 1, 6)
        left, right = grid.edges[0][k - 1], grid.edges[0][k]
        xi = (2 * y - left - right) / (right - left)
        return np.where(inside, sum(value.coefficients[i, k - 1] * xi**i for i in range(5)), 1.5)

    offsets = (np.arange(10_000) + 0.5) / 5_000 - 1
    for xi in (-1.0, -0.4, 0.0, 0.7, 1.0):
        x = (low + high) / 2 + xi * (high - low) / 2
        truth = np.array([u(0.7 * p + 0.2 * np.sin(3 * p) + 0.3 * offsets).mean() for p in x])
        wrong = np.abs(value_of(found, np.array([xi])) - truth)
        assert (wrong <= found.error + 1e-3).all()
        assert (wrong[low == high] <= 1e-3).all()


def test_patches_have_the_stated_derivatives() -> None:
    """V = exp(t) sin(x) cos(2 y), whose data are known: values, slopes and bends come out, and meet across nodes."""
    times, axes = np.array([0.0, 0.1, 0.25]), (np.array([0.0, 0.1, 0.3]), np.array([-0.2, 0.0, 0.1]))
    one = np.stack([np.sin(axes[0]), np.cos(axes[0]), -np.sin(axes[0])], axis=1)
    two = np.stack([np.cos(2 * axes[1]), -2 * np.sin(2 * axes[1]), -4 * np.cos(2 * axes[1])], axis=1)
    values = np.exp(times)[:, None, None, None, None] * one[None, :, :, None, None] * two[None, None, None]
    surface = Surface(times, axes, values, values)
    (block,) = surface.blocks()
    patches = surface.patches(*block)
    which = tm.terms(3, 13)
    for orders, exact_one in (
        ((0, 0, 0), lambda t, x, y: np.exp(t) * np.sin(x) * np.cos(2 * y)),
        ((1, 0, 0), lambda t, x, y: np.exp(t) * np.sin(x) * np.cos(2 * y)),
        ((0, 1, 0), lambda t, x, y: np.exp(t) * np.cos(x) * np.cos(2 * y)),
        ((0, 1, 1), lambda t, x, y: -2 * np.exp(t) * np.cos(x) * np.sin(2 * y)),
        ((0, 0, 2), lambda t, x, y: -4 * np.exp(t) * np.sin(x) * np.cos(2 * y)),
    ):
        found = patches.derivative(which, orders)
        assert found.error.max() < 1e-9
        for xi in ((0.0, 0.0, 0.0), (-1.0, 1.0, -1.0), (0.4, -0.7, 0.2)):
            t, x, y = (patches.low + patches.high) / 2 + np.array(xi)[:, None] * (patches.high - patches.low) / 2
            assert value_of(found, np.array(xi)) == pytest.approx(exact_one(t, x, y), abs=2e-4)
        (part,) = (one for one in patches.cut(4) if one.numbers == (3, 0, 1))
        fine, place = part.derivative(which, orders), (np.array([3, 0, 1]) * 2 + 1) / 4 - 1
        assert fine.error.max() < 1e-9
        for xi in ((0.0, 0.0, 0.0), (-1.0, 1.0, -1.0), (0.4, -0.7, 0.2)):
            whole = place + np.array(xi) / 4
            assert value_of(fine, np.array(xi)) == pytest.approx(value_of(found, whole), abs=1e-9)
            for axis, ends in enumerate(zip(patches.low, patches.high)):
                model = part.variable(which, axis)
                truth = (ends[0] + ends[1]) / 2 + whole[axis] * (ends[1] - ends[0]) / 2
                assert (np.abs(value_of(model, np.array(xi)) - truth) <= model.error).all()


def test_the_bound_is_as_good_as_the_engines_and_above_its_lower_one() -> None:
    problem = valued()
    verdict = verify_safety(problem, method="values")
    report = check_data(parse(certificate_text(problem, verdict)), problem_data(problem))
    assert report.valid, report.reason
    assert report.log10_proved is not None
    assert verdict.log10_lower < report.log10_proved < verdict.log10_delta + 0.02


def test_one_step_is_a_normal_probability() -> None:
    system = cb.DiscreteSystem(lambda x: 0.8 * x, states=1, noise=cb.Gaussian(std=0.3))
    problem = cb.Problem(system, initial=[0.1], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1, delta=0.1)
    data = parse(certificate_text(problem, verify_safety(problem, method="values")))
    truth = math.log10(norm.sf((1 - 0.08) / 0.3) + norm.cdf((-1 - 0.08) / 0.3))
    assert truth <= check_data(data).log10_proved < truth + 1e-6


def test_a_surface_in_two_states_starts_from_its_own_cells_only() -> None:
    """V = -1 - x^2 - y^2 on [-1, 1]^2: at most -1 - .02 on a start off the nodes, and not what a neighbour holds."""
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=0.4 * np.eye(2))
    start = cb.Box([0.3, -0.35], [0.4, -0.3])
    problem = cb.Problem(system, initial=start, safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=0.1, delta=0.5)
    axis = np.linspace(-1, 1, 5)
    square = np.stack([axis**2, 2 * axis, np.full(5, 2.0)], axis=1)
    flat = np.stack([np.ones(5), np.zeros(5), np.zeros(5)], axis=1)
    values = -np.einsum("ia,jb->iajb", flat, flat) * 3
    values += np.einsum("ia,jb->iajb", square, flat) + np.einsum("ia,jb->iajb", flat, square)
    proof = {
        "engine": "values", "axes": [exact(axis), exact(axis)], "times": exact([0.0, 0.1]),
        "values": packed(np.stack([values, values])), "rates": packed(np.zeros((2, 5, 3, 5, 3))),
        "edges": exact([0.0]), "m": [], "q": exact([0.0]), "lam": exact([1.0]), "eps": exact([0.0]),
    }  # fmt: skip
    model = read_model(json.loads(json.dumps(problem_data(problem))), Budget(60.0))
    with np.errstate(all="ignore"):
        passage = Passage(model, json.loads(json.dumps(proof)), Budget(60.0))
        assert passage._at_start() == pytest.approx(-3 + 0.4**2 + 0.35**2, abs=1e-9)
        assert passage._missing() == pytest.approx(2.0, abs=1e-9)
        assert passage._at_end() == pytest.approx(-3.0, abs=1e-9)


@pytest.mark.parametrize(
    "make", [valued, shaken, started, valued_plane, pytest.param(valued_space, marks=pytest.mark.slow)]
)
def test_the_two_bounds_of_a_probability_enclose_a_simulation(make: Any) -> None:
    problem = make()
    answers = dict(verify_safety(problem, method="values").answers)
    most = check_data(parse(side_of(problem, answers, lower=False)), problem_data(problem))
    least = check_data(parse(side_of(problem, answers, lower=True)), problem_data(problem))
    assert most.valid, most.reason
    assert least.valid, least.reason
    assert least.log10_lower_proved < most.log10_proved < least.log10_lower_proved + 0.1
    assert least.log10_proved is None
    assert least.log10_delta == 0.0
    assert "some" in least.claim or "normal start" in least.claim
    if problem.system.disturbance is None:
        found = cb.simulate_exits(problem, paths=20_000, rng=np.random.default_rng(4), confidence=0.999, halve=False)
        assert 10**least.log10_lower_proved <= found.upper
        assert found.lower <= 10**most.log10_proved


@pytest.mark.slow
def test_a_lower_bound_in_the_plane_is_proved_again() -> None:
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=0.8 * np.eye(2))
    room = cb.Inside(cb.Box([-1, -1], [1, 1]))
    problem = cb.Problem(system, initial=[0, 0], safe=[room], horizon=0.5)
    found = bound_exits(problem, seconds=0.5)
    assert found.lower is not None
    assert len(found.proposed_below) == 1
    answer = EngineAnswer(log10_delta=found.upper, log10_lower=found.lower, details=found, method="values")
    verdict = SimpleNamespace(status="UNSAFE", reason="", answers={"values": answer})
    report = check_data(parse(certificate_text(problem, verdict)), problem_data(problem))
    assert report.valid
    seen = cb.simulate_exits(problem, paths=20_000, rng=np.random.default_rng(0), halve=False)
    assert report.log10_lower_proved is not None
    assert found.lower - 0.3 < report.log10_lower_proved <= math.log10(seen.upper)


def test_levels_from_below_are_held_to_the_largest_slope_that_is_due() -> None:
    """(1 + q)(3 - q) is 3 at q = 0 and at q = 2, and 4 in between; from above (1 - q)(m - q) is convex."""
    with pytest.raises(Unproved, match="q was not shown"):
        Levels([-0.6, 0.0], [3.0], [0.0, 2.0], upper=False)
    assert Levels([-0.49, 0.0], [3.0], [0.0, 2.0], upper=False).m == [3.0]
    with pytest.raises(CertificateError, match="stay below 1"):
        Levels([-0.49, 0.0], [3.0], [0.0, 2.0])


def flat_below(level: float, *, high: float, end: float | None = None) -> arb:
    """What V = level follows below (x' = .4 dW from 0, safe within 1 and beyond -high), ``end`` being V at the end."""
    system = cb.ContinuousSystem(lambda x: 0 * x, states=1, diffusion=0.4)
    safe = [cb.Inside(cb.Box([-high], [1]))]
    problem = cb.Problem(system, initial=[0], safe=safe, horizon=0.5, delta=0.5)
    axis = np.array([-2.0, 0.0, 1.01])
    values = np.zeros((2, 3, 3))
    values[:, :, 0] = level
    values[1, :, 0] = level if end is None else end
    proof = {
        "engine": "values", "axes": [exact(axis)], "times": exact([0.0, 0.5]), "values": packed(values),
        "rates": packed(np.zeros((2, 3, 3))), "edges": exact([0.0]), "m": [], "q": exact([0.0]), "lam": exact([0.0]),
        "eps": exact([0.0]), "side": "lower", "starts": exact([[0.0]]),
    }  # fmt: skip
    model = read_model(json.loads(json.dumps(problem_data(problem))), Budget(60.0))
    return check_values_below(model, json.loads(json.dumps(proof)), Budget(60.0))


def test_what_v_is_at_the_end_and_on_harmless_sides_is_taken_off_from_below() -> None:
    assert flat_below(-1.0, high=1.5) == 0  # exp(-1) - exp(-1) at the end
    assert flat_below(-1.0, high=3.0) == 0
    falling = flat_below(-1.0, high=1.5, end=-3.0)  # V_t is -4 in the mean, at most 6 in size: lam pays for it
    assert falling == 0 or falling < math.exp(-1.0)


def test_the_residual_is_paid_for_from_below_unless_v_is_at_most_what_is_taken_off() -> None:
    """V falls from -1 at x = -1 to -3 at x = -2, bent by up to 11.5: R is about -.9 there, with x' = .4 dW."""
    system = cb.ContinuousSystem(lambda x: 0 * x, states=1, diffusion=0.4)
    problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-2], [1]))], horizon=0.5, delta=0.5)
    values = np.zeros((2, 4, 3))
    values[:, :, 0] = [-3.0, -1.0, -1.0, -1.0]
    proof = {
        "engine": "values", "axes": [exact([-2.0, -1.0, 0.0, 1.01])], "times": exact([0.0, 0.5]),
        "values": packed(values), "rates": packed(np.zeros((2, 4, 3))), "edges": exact([0.0]), "m": [],
        "q": exact([0.0]), "lam": exact([0.0]), "eps": exact([0.0]), "side": "lower", "starts": exact([[0.0]]),
    }  # fmt: skip
    model = read_model(json.loads(json.dumps(problem_data(problem))), Budget(60.0))
    crossing = Crossing(model, json.loads(json.dumps(proof)), Budget(60.0))
    crossing.lift, paid = 0.0, []
    for crossing.stopped in (-np.inf, -1.001, -0.999):
        paid.append(float(crossing._payments(-1.0).max()))
    assert paid[0] == paid[1] > 0.5
    assert paid[2] == 0


def test_feedback_disturbances_need_noise_ofhas_full_rank() -> None:
    which = tm.terms(1, 2)

    def number(value: float) -> tm.Batch:
        return tm.fixed(which, np.array([value]))

    assert has_full_rank([[number(1.0)]]).all()
    assert not has_full_rank([[number(0.0)]]).any()
    assert has_full_rank([[number(1.0), number(0.9)], [number(0.9), number(1.0)]]).all()
    assert not has_full_rank([[number(1.0), number(1.0)], [number(1.0), number(1.0)]]).any()


@pytest.mark.parametrize(
    ("initial", "point", "inside"),
    [
        (cb.Box([0, 0], [1, 1]), [1.0, 0.5], True), (cb.Box([0, 0], [1, 1]), [1.0, 1.5], False),
        (cb.Ball([1, 0], 0.5), [1.3, 0.39], True), (cb.Ball([1, 0], 0.5), [1.3, 0.41], False),
        (cb.Ellipsoid([0, 0], [[4, 0], [0, 1]]), [1.9, 0.3], True),
        (cb.Ellipsoid([0, 0], [[4, 0], [0, 1]]), [0.3, 1.01], False),
    ],
)  # fmt: skip
def test_starts_of_lower_bounds_lie_in_the_set_itself(initial: Any, point: list[float], inside: bool) -> None:
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=2, noise=cb.Gaussian(std=0.1))
    problem = cb.Problem(system, initial=initial, safe=[cb.Inside(cb.Box([-3, -3], [3, 3]))], horizon=2, delta=0.5)
    model = read_model(json.loads(json.dumps(problem_data(problem))), Budget(60.0))
    record = Record({"starts": exact([point])}, "proof", ["starts"])
    if inside:
        assert len(starts_of(model, record)) == 1
    else:
        with pytest.raises(Unproved, match="initial set"):
            starts_of(model, record)


def test_starts_that_are_stated_by_a_box_around_them_have_no_certificate_from_below() -> None:
    around = SimpleNamespace(
        random=False, data=lambda kinds: {"kind": "polytope"}, hull=lambda: SimpleNamespace(lo=[0.0], hi=[1.0])
    )
    assert initial_data(around) == {"kind": "box", "low": exact([0.0]), "high": exact([1.0]), "around": True}
    answer = EngineAnswer(log10_delta=-0.5, log10_lower=-1.0)
    with pytest.raises(CertificateError, match="a box, a ball or an ellipsoid"):
        values_proof_below(SimpleNamespace(initial=around, ending=False, endless=False), answer)


def test_quadratic_bounds_prove_about_what_the_engine_found() -> None:
    problem = squared()
    data = parse(squared_certificate())
    report = check_data(data, json.loads(json.dumps(problem_data(problem))))
    assert report.valid, report.reason
    assert data["claim"]["method"] == "quadratic"
    found = bound_quadratic(problem, target=0.5, seconds=60.0).upper
    assert found - 1e-6 <= report.log10_proved < found + 0.1


def test_forms_are_bounded_over_boxes_about_zero() -> None:
    """The square of a ball about 0 by ``**`` is no number: a box of starts in the middle of the working box."""
    found = walls.value(arb_mat([[1, 0], [0, 2]]), [arb(0, 1), arb(1)])
    assert found.is_finite()
    assert found.contains(2)
    assert found.contains(3)


def test_many_quadratic_bounds_are_not_all_unpacked() -> None:
    data = parse(squared_certificate())
    counted = patch.object(quadratic, "_Value", wraps=quadratic._Value)
    with patch.object(quadratic, "MOST_NUMBERS", 3000), counted as made:
        assert check_data(data).valid
        before = made.call_count
        data["proof"]["bounds"] = [data["proof"]["bounds"][0]] * 50
        with pytest.raises(CertificateError, match=r"`proof.bounds` must hold at most 3000 multipliers"):
            check_data(data)
    assert made.call_count < before + 40


def test_what_is_missing_of_a_curved_drift_is_proved_again_without_more_room() -> None:
    """A sine and a product with a square, over cells: the checker's enclosures are others than the engine's."""
    system = cb.ContinuousSystem(
        lambda x: [x[1], -2 * np.sin(x[0]) - x[1] + 0.3 * x[1] * x[2] ** 2, -x[2]], states=3,
        diffusion=[[0.05, 0, 0], [0, 0.3, 0], [0, 0, 0.3]],
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1.2, -1.5, -1.2], [1.2, 1.5, 1.2]))]
    problem = cb.Problem(system, initial=cb.Box([-0.1] * 3, [0.1] * 3), safe=safe, horizon=1.0, delta=0.5)
    found = bound_quadratic(problem, target=0.5, seconds=60.0)
    for item in found.walls:
        assert item.proved is not None
        assert item.proved.proposal.degree == 2
    data = parse(quadratic_certificate(problem))
    report = check_data(data, json.loads(json.dumps(problem_data(problem))))
    assert report.valid, report.reason
    assert found.upper - 1e-6 <= report.log10_proved < found.upper + 0.1 < 0
    assert any(len(edges) > 2 for one in data["proof"]["bounds"] for edges in one["cuts"])


def test_a_ball_of_starts_has_a_bound_of_its_own() -> None:
    """Against V at points of the ball; its corners, which lie outside, are left aside."""
    data = parse(squared_certificate())
    with patch.object(quadratic, "_at_corners", lambda *_: arb(1)):
        found = check_data(data).log10_proved
    assert found is not None
    center, width = (np.array([float.fromhex(x) for x in data["proof"][name]]) for name in ("center", "width"))
    turns = np.linspace(0, 2 * np.pi, 41)
    points = 0.05 * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    z = np.hstack([(points - center) / width, np.ones((41, 1))])
    total = np.zeros(41)
    for wall in data["proof"]["bounds"]:
        first = np.array([[float.fromhex(x) for x in row] for row in wall["matrices"][0]])
        total += np.exp(np.einsum("pi,ij,pj->p", z, first, z) / 2)
    assert math.log10(total.max()) <= found < math.log10(total.max()) + 0.5


def test_a_splitting_is_nothing_on_its_own_states() -> None:
    rng, n, held = np.random.default_rng(5), 3, [0, 2]
    pairs = splitting(n, held)
    assert len(pairs) == len(enclosed_splitting(n, held))
    z = np.append(rng.normal(size=n), 1.0)
    for first, other in pairs:
        values = [z[held[a]] * z[i] * z[j] for a, i, j in (first, other)]
        assert values[0] == pytest.approx(values[1])


@pytest.mark.parametrize("place", range(8))
def test_the_drift_lies_between_its_corners(place: int) -> None:
    """A z at a point of a cell, held values and disturbance interpolated, is f but for the remainder."""
    model = read_model(json.loads(json.dumps(problem_data(squared()))), Budget(60.0))
    flow, rng = Flow(model, Budget(60.0)), np.random.default_rng(place)
    center, width = [arb(0.1), arb(-0.2)], [arb(0.7), arb(0.9)]
    ends = np.sort(rng.uniform(-1, 1, (2, 2)), axis=1)
    low, high = [arb(a) for a, _ in ends], [arb(b) for _, b in ends]
    local = flow.over(low, high, [0, 1], center, width)
    xi, d = [rng.uniform(a, b) for a, b in ends], rng.uniform(-0.1, 0.1)
    x = [0.1 + 0.7 * xi[0], -0.2 + 0.9 * xi[1]]
    truth = [(-x[0] + 0.3 * x[1] - 0.1 * x[1] ** 2 + d) / 0.7,
             (-x[1] - 0.5 * x[0] * x[1] - 0.2 * x[0] ** 3) / 0.9]  # fmt: skip
    matrix = local.base + local.pushed[0] * arb(d / 0.1)
    for a in (0, 1):
        matrix = matrix + local.along[a] * (arb(xi[a]) - (low[a] + high[a]) / 2)
    found = (matrix * arb_mat(3, 1, [*map(arb, xi), arb(1)])).entries()
    size = [float(part) for part in local.size]
    assert np.allclose(size, (ends[:, 1] - ends[:, 0]) / 2)
    eta = [*(np.abs(np.subtract(xi, [float(part) for part in local.middle])) / size), 1.0]
    for value, exact_one, rest in zip(found, truth, local.rest):
        assert abs(float(value.mid()) - exact_one) <= np.dot([float(part) for part in rest], eta) + 1e-12
    assert max(map(float, local.rest[0])) < 1e-15
    assert float(local.rest[1][2]) < 1e-15 < float(local.rest[1][0])
    paid = missing_form(local)
    z = [*map(arb, xi), arb(1)]
    form = float(sum(z[i] * paid[i, j] * z[j] for i in range(3) for j in range(3)).mid())
    weights = [sum(float(row[b]) for row in local.rest) for b in range(3)]
    assert form == pytest.approx(4 * np.dot(weights, np.square(eta)), rel=1e-9, abs=1e-12)


# ---- files made to fool --------------------------------------------------------------------------------------


def packed_text(content: bytes) -> str:
    return base64.b64encode(zlib.compress(content, 9)).decode()


@pytest.mark.parametrize(
    ("value", "why"),
    [
        (None, "text in base 64"), ("é", "text in base 64"), ("%%%", "compressed text"), ("AAAA", "compressed text"),
        (packed_text(b"0x1.8p+1"), "hold 2 numbers"), (packed_text(b"0x1.8p+1 " * 9), "nothing else|hold 2 numbers"),
        (packed_text(b"nan 0x1.8p+1"), "hexadecimal"), (packed_text(b"0x1.8p+1 0x1.8p+9999"), "finite"),
        (packed_text(b"0x1.8p+1 inf"), "hexadecimal"), (packed_text(b"0x1.8p+1  0x1.8p+1"), "hold 2 numbers"),
        (packed_text(b"\xff\xfe 0x1.8p+1"), "hexadecimal"), (packed_text(b" " * 10**7), "nothing else"),
        (packed_text(b"0x1.8p+1 0x1.8p+1") + packed_text(b"more"), "compressed text|nothing else"),
    ],
)  # fmt: skip
def test_packed_numbers_that_are_none_are_refused(value: Any, why: str) -> None:
    with pytest.raises(CertificateError, match=why):
        unpacked(value, "proof.values", 2, Budget(60.0))


def test_packed_numbers_are_exact_and_no_longer_than_they_must_be() -> None:
    numbers = [0.0, 1.0, -0.5, 0.1, 1 / 3, 256.0625, -5e-324, 2.0**-1022, 1.7976931348623157e308]
    written = packed(np.array(numbers))
    assert list(unpacked(written, "proof.values", len(numbers), Budget(60.0))) == numbers
    assert zlib.decompress(base64.b64decode(written)).startswith(b"0x0.0p+0 0x1.0p+0 -0x1.0p-1 0x1.999999999999ap-4 ")


def test_a_text_that_unpacks_to_very_much_is_not_unpacked() -> None:
    bomb = base64.b64encode(zlib.compress(b"0" * 10**8, 9)).decode()
    assert len(bomb) < 200_000
    with pytest.raises(CertificateError, match="nothing else"):
        unpacked(bomb, "proof.values", 4, Budget(60.0))


@pytest.fixture(scope="module")
def exiting() -> str:
    return text("leaving")


@pytest.mark.parametrize(
    "change",
    [
        {"times": exact([0.0, 0.4])}, {"axes": []}, {"axes": [exact([1.0, -1.0])]}, {"edges": []}, {"q": exact([0.1])},
        {"m": exact([-1.0]), "edges": exact([-1.0, 0.0]), "q": exact([0.0, 0.0])}, {"eps": []}, {"values": ""},
        {"edges": exact([1.0])}, {"axes": [exact([-1.0, 1.0]), exact([-1.0, 1.0])]}, {"engine": "barrier"},
        {"q": exact([-0.5])}, {"lam": None}, {"axes": [[None]]}, {"more": 1},
    ],
)  # fmt: skip
def test_malformed_value_functions_are_refused(exiting: str, change: dict[str, Any]) -> None:
    data = parse(exiting)
    data["proof"] |= change
    assert rejected(data)


def test_a_lower_surface_proves_no_less(exiting: str) -> None:
    """Values, slopes and rates changed on purpose: whatever is claimed below what was proved is refused."""

    def dent(values: np.ndarray) -> None:
        values[:, 5:-5, 0] -= 0.3

    def bend(values: np.ndarray) -> None:
        values[:, :, 2] -= 5.0

    def fall(values: np.ndarray) -> None:
        values[:, :, 0] -= 1.0

    for name, change in (("values", dent), ("values", bend), ("rates", fall)):
        data = parse(exiting)
        data["claim"]["log10_delta"] = exact(float.fromhex(data["claim"]["log10_delta"]) - 0.02)
        repacked(data, name, change)
        assert rejected(data)


def test_lam_of_the_file_proves_nothing(exiting: str) -> None:
    data = parse(exiting)
    data["proof"]["lam"] = exact([1e9] * len(data["proof"]["lam"]))
    generous = check_data(data).log10_proved
    data["proof"]["lam"] = exact([-1e9] * len(data["proof"]["lam"]))  # a closer look at all, which proves a little more
    assert generous >= check_data(data).log10_proved >= check_data(parse(exiting)).log10_proved - 3e-3


def test_a_door_writes_what_the_checker_proves() -> None:
    problem = leaving()
    data = parse(exit_certificate(leaving))
    assert data["claim"]["method"] == "values"
    report = check_data(data, json.loads(json.dumps(problem_data(problem))))
    assert report.valid, report.reason
    assert "for every disturbance in its set that does not see coming noise" in report.claim


@pytest.mark.parametrize("std", [5e-324, 1e-310])
def test_noise_that_is_too_small_for_floats_is_refused_in_words(std: float) -> None:
    data = parse(text("valued"))
    data["problem"]["noise"]["values"] = exact([std])
    assert "the noise is too small" in check_data(data).reason


def test_a_start_on_the_edge_of_an_obstacle_is_proved_to_fail() -> None:
    obstacle = cb.Outside(cb.Box([1.0], [2.0]))
    system = cb.DiscreteSystem(lambda x: 0 * x, states=1, noise=cb.Rademacher(scale=1.0))
    problem = cb.Problem(system, initial=[1.0], safe=[obstacle, cb.Inside(cb.Box([-4.0], [4.0]))], horizon=1)
    verdict = cb.verify_safety(problem, method="values")
    assert verdict.status == "UNSAFE"
    report = check_data(verdict.certificate)
    assert report.valid, report.reason


@pytest.mark.parametrize("side", [np.sign, lambda x: np.where(x < 0, -1.0, 1.0)], ids=["sign", "where"])
def test_a_drift_that_jumps_is_paid_for_on_the_cells_that_hold_the_jump(side: Callable[[Any], Any]) -> None:
    """It was unknown there, so that no value function of such a model in continuous time had a certificate."""
    system = cb.ContinuousSystem(lambda x: -x - 0.5 * side(x), states=["x"], diffusion=0.3)
    problem = cb.Problem(system, initial=[0.1], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1.0, delta=0.05)
    verdict = cb.verify_safety(problem, method="values")
    report = check_data(parse(verdict.certificate_text(problem)), problem_data(problem))
    assert report.valid, report.reason
    assert verdict.log10_delta < -8
    assert report.log10_proved == pytest.approx(verdict.log10_delta, abs=0.1)
