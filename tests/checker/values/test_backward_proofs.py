"""Certificates by the backward equation: the checker's bounds against samples, the writer's refusals, whole files."""

from __future__ import annotations

import itertools
import json
import math
import pickle
from fractions import Fraction
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest
from flint import arb
from scipy.interpolate import BSpline

import certbound as cb
from certbound.checker import check_data, parse
from certbound.checker.report import unlimited
from certbound.checker.statement import read_model
from certbound.checker.values.kolmogorov import patch_residual, solution
from certbound.checker.values.kolmogorov.cell_operator import Grid, Operator
from certbound.checker.values.kolmogorov.patches import DEGREE, ROUNDED, Splines, to_powers
from certbound.checker.values.kolmogorov.solution import Solution
from certbound.checker.values.kolmogorov.stage import Stage
from certbound.errors import CertificateError
from certbound.problem.model import Tape, compile_numpy
from certbound.safety.answers import EngineAnswer, exact
from certbound.safety.certificate import problem_data
from certbound.safety.certificates import backward_proof, backward_proof_below, carried_values
from certbound.values.kolmogorov import Bounds
from tests.checker.backward_forgeries import changed
from tests.checker.conftest import (
    arriving,
    backward_answer,
    backward_certificate,
    gated,
    loud_gated,
    loud_pendulum,
    loud_toggle,
    pendulum,
    predator,
    pushed,
    scattered,
    side_of,
    toggle,
)

FINE = {"cell": 0.12, "steps": 12}


def sheared() -> cb.Problem:
    """Two states with correlated noise that both multiply."""
    system = cb.ContinuousSystem(
        lambda x, y: [np.sin(y) - x * y, x / (1 + y**2)], states=["x", "y"],
        diffusion=lambda x: [[0.2 + 0.1 * x[1], 0.0], [0.1 * x[0], 0.3]],
    )  # fmt: skip
    return cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1.0)


def space() -> cb.Problem:
    """Three states."""
    system = cb.ContinuousSystem(
        lambda x, y, z: [y - x, x * z - y, np.cos(x) - z], states=["x", "y", "z"],
        diffusion=[[0.3, 0.1, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.0]],
    )  # fmt: skip
    return cb.Problem(system, initial=[0, 0, 0], safe=[cb.Inside(cb.Box([-1] * 3, [1] * 3))], horizon=1.0)


def driven() -> cb.Problem:
    """Two states, time that swings and jumps, a drift that jumps, and a disturbance that is squared too."""
    system = cb.ContinuousSystem(
        lambda t, x, y, d: [np.where(t < 0.4, x, -y) + np.sin(3 * t) * y + d * x + d**2, np.where(x < 0.1, 0.3, -0.2)],
        states=["x", "y"], diffusion=lambda t, x: [[0.3 + 0.1 * np.cos(2 * t), 0.0], [0.1 * x[0], 0.2]],
        disturbance=cb.Box([-0.3], [0.3]),
    )  # fmt: skip
    return cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1.0)


def rough(problem: cb.Problem, cells: int, slabs: int, rng: np.random.Generator, size: float = 1.0) -> Stage:
    """A stage whose v is anything on uneven nodes."""
    n = problem.system.dimension
    axes = tuple(np.sort(np.concatenate([[-0.9, 0.9], rng.uniform(-0.9, 0.9, cells - 1)])) for _ in range(n))
    times = np.sort(np.concatenate([[0.0, 1.0], rng.uniform(0, 1, slabs - 1)]))
    shape = (len(times), *(len(axis) - 1 + DEGREE for axis in axes))
    rows = [np.rint(rng.normal(size=shape) * size * 2**20) / 2**20 - 3 for _ in range(2)]
    made = Splines(axes=axes, times=times, values=rows[0], rates=rows[1], budget=unlimited())
    proof = {"engine": "backward", "axes": exact([list(a) for a in axes]), "times": exact(times),
             "units": exact([1.0, 1.0]), "values": "", "rates": "", "eta": exact([1e9] * slabs)}  # fmt: skip
    with patch.object(solution, "read_splines", lambda *_: made):
        model = read_model(json.loads(json.dumps(problem_data(problem))), unlimited())
        return Solution(model, proof, unlimited(), upper=True).stages[0]


def value(splines: Splines, t: float, x: np.ndarray, orders: tuple[int, ...], rate: bool = False) -> float:
    """A derivative of v by SciPy's splines and the cubic's own formula."""
    k = min(int(np.searchsorted(splines.times, t, side="right")) - 1, splines.slabs - 1)
    h = splines.times[k + 1] - splines.times[k]
    s = (t - splines.times[k]) / h
    u, d, e, w = splines.values[k], splines.rates[k], splines.rates[k + 1], splines.values[k + 1]
    b = [u, u + h / 3 * d, w - h / 3 * e, w]
    if rate:
        q = [3 * (b[j + 1] - b[j]) / h for j in range(3)]
        table = (1 - s) ** 2 * q[0] + 2 * s * (1 - s) * q[1] + s * s * q[2]
    else:
        table = (1 - s) ** 3 * b[0] + 3 * s * (1 - s) ** 2 * b[1] + 3 * s * s * (1 - s) * b[2] + s**3 * b[3]
    for axis, place, order in zip(splines.axes, x, orders):
        knots = np.concatenate([[axis[0]] * DEGREE, axis, [axis[-1]] * DEGREE])
        one = BSpline(knots, table, DEGREE, axis=0)
        table = (one.derivative(order) if order else one)(place)
    return float(table)


def generator(problem: cb.Problem, splines: Splines, t: float, x: np.ndarray, d: tuple[float, ...] = ()) -> float:
    """v_t + L v."""
    given, n = problem.system.diffusion, len(x)
    flow = compile_numpy(problem.closed_loop)(t, *x, *d).ravel()
    g = compile_numpy(given)(t, *x).reshape(n, -1) if isinstance(given, Tape) else np.asarray(given)
    a = g @ g.T
    total = value(splines, t, x, (0,) * n, rate=True)
    for i in range(n):
        total += flow[i] * value(splines, t, x, tuple(int(k == i) for k in range(n)))
        for j in range(n):
            total += a[i, j] / 2 * value(splines, t, x, tuple((k == i) + (k == j) for k in range(n)))
    return total


@pytest.mark.parametrize(("build", "cells"), [(sheared, 4), (space, 2), (driven, 3)])
@pytest.mark.parametrize("level", [0, 1])
def test_the_residual_lies_below_its_bound_everywhere_on_a_patch(build, cells: int, level: int) -> None:
    problem, rng = build(), np.random.default_rng(level)
    stage = rough(problem, cells, 2, rng)
    splines, n = stage.splines, problem.system.dimension
    shape = (*(count * 2**level for count in splines.cells), splines.slabs)
    *places, slab = np.unravel_index(np.arange(np.prod(shape)), shape)
    need = stage.residual._needs(slab, places, level)
    disturbed = problem.system.disturbance is not None
    for number in rng.choice(len(slab), 8, replace=False):
        k, seen = slab[number], -np.inf
        ends = [np.interp(np.array([p, p + 1]) / 2**level, np.arange(len(axis)), axis)
                for axis, p in zip(splines.axes, (row[number] for row in places))]  # fmt: skip
        for share in rng.random((25, n + 1)):
            t = splines.times[k] + share[0] * (splines.times[k + 1] - splines.times[k])
            x = np.array([low + s * (high - low) for (low, high), s in zip(ends, share[1:])])
            d = (float(rng.choice([-0.3, 0.3, rng.uniform(-0.3, 0.3)])),) if disturbed else ()
            seen = max(seen, generator(problem, splines, t, x, d))
        size = abs(need[number]) + 1
        assert seen <= need[number] + 1e-9 * size


def test_a_bound_is_close_where_patches_are_small() -> None:
    problem, rng = sheared(), np.random.default_rng(5)
    stage = rough(problem, 3, 1, rng)
    found = []
    for level in range(4):
        shape = tuple(count * 2**level for count in stage.splines.cells)
        places = np.unravel_index(np.arange(np.prod(shape)), shape)
        found.append(stage.residual._needs(0 * places[0], places, level).max())
    assert np.all(np.diff(found) <= 1e-9 * found[0])
    assert found[-2] - found[-1] < 0.05 * (found[0] - found[-1]) + 1e-9 * found[0]


@pytest.mark.parametrize(("build", "cells"), [(sheared, 3), (space, 1)])
def test_on_a_small_part_of_a_cell_the_bound_is_the_residual_itself(build, cells: int) -> None:
    problem, rng = build(), np.random.default_rng(3)
    stage = rough(problem, cells, 1, rng)
    splines, n = stage.splines, problem.system.dimension
    splines.values[1], splines.rates[:] = splines.values[0], 0.0
    chosen = rng.integers(0, 2**7 * cells, size=(n, 40))
    need = stage.residual._needs(np.zeros(40, dtype=int), list(chosen), 7)
    middle = [np.interp((place + 0.5) / 2**7, np.arange(len(a)), a) for a, place in zip(splines.axes, chosen)]
    seen = np.array([generator(problem, splines, 0.5, x) for x in np.array(middle).T])
    assert np.sum(seen > 0) > 10
    np.testing.assert_allclose(need, np.maximum(seen, 0), rtol=0, atol=0.06 * np.abs(seen).max())


def test_from_below_one_disturbance_serves_each_patch() -> None:
    swung = driven()
    smooth = cb.ContinuousSystem(
        lambda t, x, y, d: [np.sin(3 * t) * y + d * x, d - y], states=["x", "y"], diffusion=0.3 * np.eye(2),
        disturbance=cb.Box([-0.3], [0.3]),
    )  # fmt: skip
    stage = rough(swung.replace(system=smooth), 3, 2, np.random.default_rng(4))
    *places, slab = np.unravel_index(np.arange(18), (3, 3, 2))
    alone = []
    for acting in ((-0.3,), (0.3,)):
        stage.residual.actings = (acting,)
        alone.append(stage.residual._needs(slab, places, 0))
    stage.residual.stated[:] = -1.0
    stage.residual.actings = ((-0.3,), (0.3,))
    assert np.any(alone[0] < alone[1])
    assert np.any(alone[1] < alone[0])
    np.testing.assert_array_equal(stage.residual._needs(slab, places, 0), np.minimum(*alone))


def test_from_below_nothing_is_known_of_a_drift_that_jumps_under_disturbances() -> None:
    stage = rough(driven(), 3, 1, np.random.default_rng(4))
    places = np.unravel_index(np.arange(9), (3, 3))
    assert np.isfinite(stage.residual._needs(0 * places[0], places, 0)).all()
    stage.residual.actings = ((0.3,),)
    need = stage.residual._needs(0 * places[0], places, 0)
    jumps = (stage.splines.axes[0][:-1] < 0.1) & (stage.splines.axes[0][1:] > 0.1)
    assert np.isinf(need[jumps[places[0]]]).all()
    assert np.isfinite(need[~jumps[places[0]]]).all()


def test_beside_a_jump_or_a_bend_in_time_the_model_is_smooth() -> None:
    system = cb.ContinuousSystem(
        lambda t, x, y: [np.where(t < 0.5, 0.3, 0.1) * x, np.abs(np.sin(4 * t - 2)) * y], states=["x", "y"],
        diffusion=np.eye(2),
    )
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1.0)
    operator = Operator(read_model(json.loads(json.dumps(problem_data(problem))), unlimited()), unlimited())
    about = 1e-11
    grid = Grid(axes=(np.array([0.0, 1.0]),) * 2, times=np.array([0.4, 0.5 - about, 0.5 + about, 0.6]))
    places = (np.zeros(3, dtype=int),) * 2
    models = operator.models(grid, np.arange(3), places, 0, None)
    errors = np.array([model.error for orders, _, model in models if sum(orders) == 1])
    assert np.all(errors[:, [0, 2]] < 1e-4)
    assert 0.05 < errors[0, 1] < 0.5
    assert errors[1, 1] < 1e-9


def test_parts_of_patches_cover_them_where_the_file_states_too_little(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = rough(sheared(), 3, 2, np.random.default_rng(9))
    monkeypatch.setattr(patch_residual, "_DEEPEST", 1)
    stage.residual.stated[:] = -1.0
    shape = (*(2 * count for count in stage.splines.cells), 2)
    *places, slab = np.unravel_index(np.arange(np.prod(shape)), shape)
    need = stage.residual._needs(slab, places, 1)
    assert stage.residual.payments() == pytest.approx([need[slab == k].max() for k in (0, 1)])


def blossom(knots: list[Fraction], coefficients: list[Fraction], arguments: list[Fraction]) -> Fraction:
    """The blossom of the polynomial on the cell between the sixth and the seventh of twelve knots."""
    rows = list(coefficients)
    for stage, u in enumerate(arguments, 1):
        for i in range(DEGREE, stage - 1, -1):
            low, high = knots[i], knots[i + DEGREE + 1 - stage]
            rows[i] = ((high - u) * rows[i - 1] + (u - low) * rows[i]) / (high - low)
    return rows[DEGREE]


@pytest.mark.parametrize("level", [0, 3])
def test_coefficients_on_patches_are_off_by_less_than_is_said(level: int) -> None:
    rng = np.random.default_rng(level)
    axis = 1000 + np.cumsum(10.0 ** rng.uniform(-7, 0, 8))
    times = np.array([0.0, 0.3])
    values, rates = np.rint(rng.normal(size=(2, 2, 12)) * 2**40) / 2**40
    splines = Splines(axes=(axis,), times=times, values=values, rates=rates, budget=unlimited())
    place = np.arange(7 * 2**level)
    patches = splines.patches(0 * place, [place], level)
    knots = [Fraction(x) for x in [axis[0]] * 5 + axis.tolist() + [axis[-1]] * 5]
    powers, change = patches.powers(), [[Fraction(x) for x in row] for row in to_powers().tolist()]
    step, off = Fraction(0.3), 0.0
    for p in place.tolist():
        c, part = divmod(p, 2**level)
        low, width = knots[c + 5], knots[c + 6] - knots[c + 5]
        ends = [low + width * Fraction(part + k, 2**level) for k in (0, 1)]
        u, w = ([Fraction(x) for x in row[c : c + 6]] for row in values)
        d, e = ([Fraction(x) * step / 3 for x in row[c : c + 6]] for row in rates)
        rows = [u, [a + b for a, b in zip(u, d)], [a - b for a, b in zip(w, e)], w]
        for j, row in enumerate(rows):
            less = [x - row[0] for x in row]
            true = [blossom(knots[c : c + 12], less, [ends[0]] * (5 - k) + [ends[1]] * k) for k in range(6)]
            for k, factors in enumerate(change):
                off = max(off, abs(float(Fraction(patches.local[j, k, p]) - true[k])) / patches.size[p])
                power = abs(float(Fraction(powers[j, k, p]) - sum(a * b for a, b in zip(factors, true))))
                assert power <= ROUNDED * math.comb(5, k) * patches.size[p]
    assert 0 < off <= ROUNDED


def test_v_on_a_face_is_that_of_its_outermost_coefficients() -> None:
    rng = np.random.default_rng(11)
    splines = rough(space(), 2, 2, rng).splines
    for axis in range(3):
        for side in (0, 1):
            face = splines.face(axis, side)
            *places, slab = np.unravel_index(np.arange(np.prod((*face.cells, 2))), (*face.cells, 2))
            least = face.patches(slab, places, 0).lowest().min()
            seen = []
            for share in rng.random((30, 4)):
                x = np.array([row[0] + s * (row[-1] - row[0]) for row, s in zip(splines.axes, share[1:])])
                x[axis] = splines.axes[axis][-side]
                seen.append(value(splines, share[0], x, (0, 0, 0)))
            assert least <= min(seen)
            assert least >= min(seen) - 4


@pytest.mark.parametrize("level", [0, 2])
def test_v_lies_above_its_lower_bound_and_below_its_upper_one_at_starts(level: int) -> None:
    problem, rng = space(), np.random.default_rng(level)
    splines = rough(problem, 2, 1, rng).splines
    stage = rough(problem, 2, 1, rng)
    splines = stage.splines
    shape = tuple(count * 2**level for count in splines.cells)
    places = np.unravel_index(np.arange(np.prod(shape)), shape)
    least = splines.patches(0 * places[0], places, level).lowest()
    for number in rng.choice(len(least), 8, replace=False):
        ends = [np.interp(np.array([p, p + 1]) / 2**level, np.arange(len(axis)), axis)
                for axis, p in zip(splines.axes, (row[number] for row in places))]  # fmt: skip
        for share in rng.random((20, 4)):
            x = np.array([low + s * (high - low) for (low, high), s in zip(ends, share[1:])])
            assert value(splines, share[0], x, (0, 0, 0)) >= least[number] - 1e-9
    low, high = np.array([-0.5, -0.3, 0.1]), np.array([0.2, -0.3, 0.8])
    most = stage.most_over([(arb(a), arb(b)) for a, b in zip(low.tolist(), high.tolist())])
    seen = max(value(splines, 0.0, low + s * (high - low), (0, 0, 0)) for s in rng.random((300, 3)))
    assert seen <= most
    point = [(arb(a), arb(a)) for a in low.tolist()]
    assert stage.most_over(point) == pytest.approx(value(splines, 0.0, low, (0, 0, 0)), abs=1e-7)


# ---- whole files ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("build", "grid"),
    [(toggle, {}), (pendulum, {}), (predator, {}), (gated, {"cell": 0.2, "steps": 8}), (arriving, FINE),
     (pushed, {"steps": 8}), (scattered, FINE)],
)  # fmt: skip
def test_certificates_from_above_are_proved_and_say_about_what_the_engine_says(build, grid) -> None:
    problem, answer = backward_answer(build, lower=False, **grid)
    report = check_data(parse(backward_certificate(build, **grid)), json.loads(json.dumps(problem_data(problem))))
    assert report.valid, report.reason
    assert "a solution of the backward equation" in report.reason
    assert 0.94 * answer.details.upper <= 10**report.log10_proved <= 1.01 * answer.details.upper


@pytest.mark.parametrize(
    ("build", "grid"),
    [(loud_toggle, {"steps": 16}), (loud_pendulum, {"cell": 0.12, "steps": 16}),
     (loud_gated, {"cell": 0.2, "steps": 8}), (arriving, FINE), (pushed, {"cell": 0.1, "steps": 14}),
     (scattered, FINE)],
)  # fmt: skip
def test_certificates_from_below_are_proved_and_say_about_what_the_engine_says(build, grid) -> None:
    problem, answer = backward_answer(build, lower=True, **grid)
    data = parse(backward_certificate(build, lower=True, **grid))
    report = check_data(data, json.loads(json.dumps(problem_data(problem))))
    assert report.valid, report.reason
    assert 10**report.log10_lower_proved >= 0.99 * answer.details.lower


def test_from_above_a_limit_may_hold_for_less_time_than_the_proof_says_and_from_below_not() -> None:
    data = parse(backward_certificate(toggle))
    for window in ([0.0, 1.0], [0.0, 0.9]):
        data["problem"]["constraints"][0]["during"] = exact(window)
        assert check_data(data).valid
    data = parse(backward_certificate(loud_toggle, lower=True, steps=16))
    data["problem"]["constraints"][0]["during"] = exact([0.0, 2.0])
    assert check_data(data).valid
    data["problem"]["constraints"][0]["during"] = exact([0.0, 1.9])
    assert not check_data(data).valid


def test_smaller_rooms_take_more_digits_and_change_the_bound_less() -> None:
    _, answer = backward_answer(toggle, lower=False)
    (witness,) = answer.details.witnesses
    wide, narrow = witness.rounded(0.02), witness.rounded(1e-6)
    assert wide.bound <= witness.bound + 0.02
    assert narrow.bound <= witness.bound + 1e-6
    assert wide.stages[0].units[0] > narrow.stages[0].units[0]


def test_what_is_kept_does_not_change_with_later_passes() -> None:
    _, answer = backward_answer(toggle, lower=False)
    (witness,) = answer.details.witnesses
    assert not hasattr(witness.side, "carrier")
    assert pickle.loads(pickle.dumps(witness)).bound == witness.bound
    assert witness.bound == answer.details.upper


def refused(problem: cb.Problem, answer: EngineAnswer, lower: bool = False) -> str:
    with pytest.raises(CertificateError) as caught:
        (backward_proof_below if lower else backward_proof)(problem, answer)
    return str(caught.value)


def test_the_writer_says_where_it_has_no_function() -> None:
    problem, answer = backward_answer(toggle, lower=False)
    still = problem.replace(initial=cb.GaussianStart([1, 1], np.zeros((2, 2))))
    assert "does not vary" in refused(still, answer)
    assert "kept no function" in refused(problem, EngineAnswer(details=None))
    assert "kept no function" in refused(problem, answer, lower=True)


def solution_of(text: str, lower: bool = False) -> Solution:
    """The proof of a certificate."""
    data = parse(text)
    return Solution(read_model(data["problem"], unlimited()), data["proof"], unlimited(), upper=not lower)


@pytest.mark.parametrize("lower", [False, True])
def test_what_a_stage_lacks_at_its_end_is_the_most_that_the_next_one_asks_for(lower: bool) -> None:
    proof = solution_of(backward_certificate(loud_gated if lower else gated, lower=lower, cell=0.2, steps=8), lower)
    first, second = proof.stages
    rng, size = np.random.default_rng(3), 0.6 if lower else 0.7
    first.splines.values[-1] += 0.05 * rng.normal(size=first.splines.values[-1].shape)
    lacks, seen = first._at_end(second), -np.inf
    for x in rng.uniform(-1.5, 1.5, size=(1000, 2)):
        own, after = value(first.splines, 0.5, x, (0, 0)), value(second.splines, 0.5, x, (0, 0))
        wanted = (-1.0 if lower else 1.0) if np.abs(x).max() > size else min(0.0 if lower else 1.0, after)
        seen = max(seen, wanted - own)
    assert 0.3 * lacks < seen <= lacks + 1e-12


@pytest.mark.parametrize("lower", [False, True])
def test_the_mean_over_a_normal_start_is_bounded_closely(lower: bool) -> None:
    proof = solution_of(backward_certificate(scattered, lower=lower, **FINE), lower)
    (stage,), start = proof.stages, scattered().initial
    z, weights = np.polynomial.hermite_e.hermegauss(40)
    factor, mean = np.linalg.cholesky(start.covariance), 0.0
    for (a, p), (b, q) in itertools.product(zip(z, weights / weights.sum()), repeat=2):
        x = start.mean + factor @ [a, b]
        inside = np.abs(x).max() < 1
        seen = value(stage.splines, 0.0, x, (0, 0)) * (-1.0 if lower else 1.0) if inside else 1.0
        mean += p * q * min(max(seen, 0.0), 1.0)
    bound = proof.start.bound(stage)
    if lower:
        assert 0.8 * mean - 1e-3 <= -bound <= mean + 1e-4
    else:
        assert mean - 1e-3 <= bound <= 1.05 * mean


def test_arrays_of_more_than_the_limit_are_refused_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, answer = backward_answer(toggle, lower=False)
    monkeypatch.setattr(carried_values, "_MOST_BYTES", 1000)
    assert "too much for a certificate" in refused(problem, answer)


def test_the_coarsest_grid_that_decides_is_written() -> None:
    problem, answer = backward_answer(toggle, lower=False)
    (witness,) = answer.details.witnesses
    rows = [SimpleNamespace(side=witness.side, bound=bound) for bound in (0.5, 0.25, 0.2)]
    assert carried_values.coarsest(problem, rows).bound == 0.25
    assert carried_values.coarsest(problem.replace(delta=0.1), rows).bound == 0.2
    assert isinstance(answer.details, Bounds)
    assert "claim" in json.loads(side_of(problem, {"backward": answer}, lower=False))


WRONG = {
    "noise": lambda found, rng: found + np.rint(rng.normal(size=found.shape) * 0.02 * np.abs(found).max()).astype(int),
    "half": lambda found, rng: found // 2,
    "nothing": lambda found, rng: 0 * found,
    "mirrored": lambda found, rng: found[:, ::-1],
    "another time": lambda found, rng: np.concatenate([found[3:], found[-1:], found[-1:], found[-1:]]),
    "negative": lambda found, rng: -found,
}


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.parametrize("lower", [False, True])
def test_a_wrong_function_costs_width_and_never_truth(name: str, lower: bool) -> None:
    """2e4 simulated paths put the probability into [.650, .684] with confidence 1 - 1e-6."""
    rng = np.random.default_rng(2)
    data = parse(backward_certificate(loud_toggle, lower=lower, steps=16))
    for array in ("values", "rates"):
        changed(data, array, lambda found: found.__setitem__(slice(None), WRONG[name](found.copy(), rng)))
    data["proof"]["eta"] = exact([1e9] * len(data["proof"]["eta"]))  # no patch is cut
    data["claim"] |= {"log10_lower": exact(-0.01)} if lower else {"log10_delta": exact(-9.0)}
    report = check_data(data)
    assert not report.valid
    if lower:
        assert report.log10_lower_proved is None or report.log10_lower_proved <= np.log10(0.684)
    else:
        assert report.log10_proved is None or report.log10_proved >= np.log10(0.650)
