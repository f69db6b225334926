"""Certificates by the backward equation: the checker's bounds against samples, the writer's refusals, whole files."""

from __future__ import annotations

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
from certbound.checker.values.kolmogorov.patches import DEGREE, ROUNDED, Splines, to_powers
from certbound.checker.values.kolmogorov.solution import Solution, Stage
from certbound.errors import CertificateError
from certbound.problem.model import Tape, compile_numpy
from certbound.safety.answers import EngineAnswer, exact
from certbound.safety.certificate import problem_data
from certbound.safety.certificates import backward_proof, backward_proof_below, carried_values
from certbound.values.kolmogorov import Bounds
from tests.checker.backward_forgeries import changed
from tests.checker.conftest import (
    backward_answer,
    backward_certificate,
    loud_pendulum,
    loud_toggle,
    pendulum,
    predator,
    side_of,
    toggle,
)


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


def generator(problem: cb.Problem, splines: Splines, t: float, x: np.ndarray) -> float:
    """v_t + L v."""
    given, n = problem.system.diffusion, len(x)
    flow = compile_numpy(problem.closed_loop)(0.0, *x).ravel()
    g = compile_numpy(given)(0.0, *x).reshape(n, -1) if isinstance(given, Tape) else np.asarray(given)
    a = g @ g.T
    total = value(splines, t, x, (0,) * n, rate=True)
    for i in range(n):
        total += flow[i] * value(splines, t, x, tuple(int(k == i) for k in range(n)))
        for j in range(n):
            total += a[i, j] / 2 * value(splines, t, x, tuple((k == i) + (k == j) for k in range(n)))
    return total


@pytest.mark.parametrize(("build", "cells"), [(sheared, 4), (space, 2)])
@pytest.mark.parametrize("level", [0, 1])
def test_the_residual_lies_below_its_bound_everywhere_on_a_patch(build, cells: int, level: int) -> None:
    problem, rng = build(), np.random.default_rng(level)
    stage = rough(problem, cells, 2, rng)
    splines, n = stage.splines, problem.system.dimension
    shape = (*(count * 2**level for count in splines.cells), splines.slabs)
    *places, slab = np.unravel_index(np.arange(np.prod(shape)), shape)
    need = stage.residual._needs(slab, places, level)
    for number in rng.choice(len(slab), 8, replace=False):
        k, seen = slab[number], -np.inf
        ends = [np.interp(np.array([p, p + 1]) / 2**level, np.arange(len(axis)), axis)
                for axis, p in zip(splines.axes, (row[number] for row in places))]  # fmt: skip
        for share in rng.random((25, n + 1)):
            t = splines.times[k] + share[0] * (splines.times[k + 1] - splines.times[k])
            x = np.array([low + s * (high - low) for (low, high), s in zip(ends, share[1:])])
            seen = max(seen, generator(problem, splines, t, x))
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


@pytest.mark.parametrize("build", [toggle, pendulum, predator])
def test_certificates_from_above_are_proved_and_say_about_what_the_engine_says(build) -> None:
    problem, answer = backward_answer(build, lower=False)
    report = check_data(parse(backward_certificate(build)), json.loads(json.dumps(problem_data(problem))))
    assert report.valid, report.reason
    assert "a solution of the backward equation" in report.reason
    assert 10**report.log10_proved == pytest.approx(answer.details.upper, rel=0.01)


@pytest.mark.parametrize(
    ("build", "grid"), [(loud_toggle, {"steps": 16}), (loud_pendulum, {"cell": 0.12, "steps": 16})]
)
def test_certificates_from_below_are_proved_and_say_about_what_the_engine_says(build, grid) -> None:
    problem, answer = backward_answer(build, lower=True, **grid)
    data = parse(backward_certificate(build, lower=True, **grid))
    report = check_data(data, json.loads(json.dumps(problem_data(problem))))
    assert report.valid, report.reason
    assert 10**report.log10_lower_proved >= 0.99 * answer.details.lower


def test_a_limit_over_the_whole_horizon_is_one_for_all_times_and_another_window_is_not_treated() -> None:
    data = parse(backward_certificate(toggle))
    data["problem"]["constraints"][0]["during"] = exact([0.0, 1.0])
    assert check_data(data).valid
    data["problem"]["constraints"][0]["during"] = exact([0.0, 0.9])
    assert "time window" in check_data(data).reason


def test_smaller_rooms_take_more_digits_and_change_the_bound_less() -> None:
    _, answer = backward_answer(toggle, lower=False)
    (witness,) = answer.details.witnesses
    wide, narrow = witness.rounded(0.02), witness.rounded(1e-6)
    assert wide.bound <= witness.bound + 0.02
    assert narrow.bound <= witness.bound + 1e-6
    assert wide.units[0] > narrow.units[0]


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


def test_the_writer_says_what_no_certificate_states_yet() -> None:
    problem, answer = backward_answer(toggle, lower=False)
    system = problem.system
    pushed = cb.ContinuousSystem(
        lambda x, d: [d[0] - x[0], -x[1]], states=2, disturbance=cb.Box([-0.1], [0.1]), diffusion=np.eye(2)
    )
    timed = cb.ContinuousSystem(lambda t, x: [t - x[0], -x[1]], states=2, diffusion=np.eye(2))
    plain = problem.replace(initial=[0.6, 0.6])
    assert "disturbance" in refused(plain.replace(system=pushed), answer)
    assert "changes with time" in refused(plain.replace(system=timed), answer)
    assert "random starts" in refused(plain.replace(initial=cb.GaussianStart([1, 1], 0.01 * np.eye(2))), answer)
    assert "kept no function" in refused(problem, EngineAnswer(details=None))
    assert "kept no function" in refused(problem, answer, lower=True)
    assert system is problem.system


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
