"""The recipe of CONTRIBUTING.md, followed: the error function, with one row in each table, is known everywhere."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import scipy.special
from flint import arb

import certbound as cb
from certbound.checker import check_data, parse
from certbound.checker.expressions import arithmetic as balls
from certbound.checker.expressions import operations as checker
from certbound.checker.expressions import series as ball_series
from certbound.problem.files.formulas import formulas
from certbound.problem.model import compile_numpy, jacobian, operations, trace
from certbound.problem.model.tape import ARITY
from certbound.rigor import series
from certbound.rigor.intervals import Interval
from certbound.safety.certificate import certificate_text
from tests.checker.expressions import test_operations as checker_columns
from tests.problem.model import test_operations as prover_columns

# ---- what an author writes: in rigor an enclosure, in each table a row ---------------------------------------------

HALF_ROOT_PI = Interval(0.8862269254527579, 0.8862269254527581)


def erf_interval(x: Interval) -> Interval:
    """erf rises: the ends in ball arithmetic, rounded outward."""
    lo = [np.nextafter(float(arb(end).erf().lower()), -2.0) for end in x.lo.ravel().tolist()]
    hi = [np.nextafter(float(arb(end).erf().upper()), 2.0) for end in x.hi.ravel().tolist()]
    return Interval(np.reshape(lo, x.shape), np.reshape(hi, x.shape))


def erf_series(x: series.Series, order: int) -> series.Series:
    """sqrt(pi)/2 y' = exp(-x^2) x'."""
    bell = series.exp([-c for c in series.sq(x, order)], order)
    rate = series.product(bell, series.derivative(x, order), order)
    return series.integral(erf_interval(x[0]), rate, [HALF_ROOT_PI], order)


def erf_slope(g: operations.Builder, a: int, y: int) -> int:
    """exp(-a^2)/sqrt(atan 1): 4 atan 1 is pi, which no float is."""
    bell = g.apply("exp", g.apply("neg", g.apply("sq", a)))
    return g.apply("div", bell, g.apply("sqrt", g.apply("atan", g.const(1.0))))


PROVER = operations.Operation(
    scipy.special.erf, "math.erf({0})", erf_interval, erf_series, (erf_slope,), at_zero=0.0, in_files=True
)

erf_ball = balls.between(arb.erf, lambda: arb(1))


def erf_ball_series(x: ball_series.Series) -> ball_series.Series:
    bell = ball_series.exp([-c for c in ball_series.sq(x)])
    outer = ball_series.scale(bell, 2 / arb.pi().sqrt())
    return ball_series.integrated(erf_ball(x[0]), ball_series.known(outer), x)


def erf_derivatives(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    scale, square = 2 / arb.pi().sqrt(), balls.square(r)
    slope = scale * (-v * v).exp()
    return v.erf(), slope, -v * slope, scale * (-square).exp() * (4 * square - 2)


def erf_outer(g: checker.Builder, y: int, a: int) -> int:
    bell = g.apply("exp", g.neg(g.apply("sq", a)))
    return g.div(bell, g.apply("sqrt", g.apply("atan", g.const(1.0))))


CHECKER = checker.function(erf_ball, erf_ball_series, erf_outer, erf_derivatives)


@pytest.fixture
def erf(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ARITY, "erf", 1)
    monkeypatch.setitem(operations.OPERATIONS, "erf", PROVER)
    monkeypatch.setitem(checker.OPERATIONS, "erf", CHECKER)


# ---- what users then have ------------------------------------------------------------------------------------------

FILE = """
name = "a valve"
time = "continuous"
horizon = 1.0
delta = 1e-3
states = ["x"]
[dynamics]
x = "0.5*erf(x) - 2*x"
[noise]
diffusion = [[0.1]]
[initial]
box = [[-0.1, 0.1]]
[[stay]]
box = { x = [-1, 1] }
"""


def valve(x: np.ndarray) -> list[object]:
    return [0.5 * scipy.special.erf(x[0]) - 2 * x[0]]


@pytest.fixture
def problem(erf: None, tmp_path: Path) -> cb.Problem:
    path = tmp_path / "valve.toml"
    path.write_text(FILE)
    return cb.load(str(path))


@pytest.mark.usefixtures("erf")
@pytest.mark.parametrize(("columns", "count"), [(prover_columns, 8), (checker_columns, 4)])
def test_the_tests_of_the_tables_hold_for_it(columns: object, count: int) -> None:
    done = 0
    for test in vars(columns).values():
        marks = {mark.args[0] for mark in getattr(test, "pytestmark", []) if mark.name == "parametrize"}
        if "op" in marks:
            test("erf", *[0.01] * (len(marks) - 1))
            done += 1
    assert done == count


@pytest.mark.usefixtures("erf")
def test_a_python_model_is_traced_and_differentiated() -> None:
    tape = trace(valve, {"x": ["x"]})
    assert formulas(tape, iter("d"))[1] == ["0.5*erf(x) - 2*x"]
    slope = compile_numpy(jacobian(tape))(0.3)[0, 0]
    assert slope == pytest.approx(math.exp(-0.09) / math.sqrt(math.pi) - 2, rel=1e-15)


def test_a_file_gives_the_same_tape_as_python(problem: cb.Problem) -> None:
    direct = cb.ContinuousSystem(valve, states=["x"], diffusion=[[0.1]])
    texts = [formulas(system.dynamics, iter("d"))[1] for system in (problem.system, direct)]
    assert texts == [["0.5*erf(x) - 2*x"]] * 2


def test_it_is_simulated_by_a_compiled_kernel(problem: cb.Problem) -> None:
    wild = problem.replace(horizon=200.0, safe=[cb.Inside(cb.Box([-0.15], [0.15]))])
    found = cb.simulate_exits(wild, paths=200, rng=np.random.default_rng(0), halve=False)
    assert found.exits > 100


def test_it_is_proved_safe_and_the_checker_agrees(problem: cb.Problem) -> None:
    verdict = cb.verify_safety(problem, method="linear")
    assert verdict.status == "SAFE"
    text = certificate_text(problem, verdict)
    assert check_data(parse(text)).valid
    data = json.loads(text)
    nodes = data["problem"]["dynamics"]["nodes"]
    nodes[[node[0] for node in nodes].index("erf")][0] = "tanh"
    assert not check_data(data).valid


def test_an_operation_without_a_row_is_refused_by_the_checker(
    problem: cb.Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = certificate_text(problem, cb.verify_safety(problem, method="linear"))
    monkeypatch.delitem(checker.OPERATIONS, "erf")
    with pytest.raises(cb.errors.CertificateError, match="is no operation"):
        check_data(parse(text))


def test_without_its_rows_it_is_unknown(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="erf"):
        trace(valve, {"x": ["x"]})
    (tmp_path / "valve.toml").write_text(FILE)
    with pytest.raises(ValueError, match="unknown function 'erf'"):
        cb.load(str(tmp_path / "valve.toml"))
