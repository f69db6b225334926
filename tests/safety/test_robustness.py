"""Legal problems get a verdict: an engine that fails says so, and hides nothing that another one proved."""

from __future__ import annotations

import functools
import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.cli.commands.check import proved_certificate
from certbound.constants.bounds import bound_constants
from certbound.constants.metrics import bound_metrics
from certbound.errors import EnclosureError, EngineError, InfeasibleError, SolverError, contained
from certbound.reach.linear import linearisation
from certbound.reach.linear.linearisation import Linearisation
from certbound.safety.engines import linear_engine
from certbound.safety.portfolio import ENGINES
from certbound.safety.verification import verify_safety
from certbound.watch import OutOfTime


def sine_map(unit: float = 1.0) -> cb.Problem:
    system = cb.DiscreteSystem(
        lambda x: [0.5 * unit * np.sin(x[0] / unit)], states=1, noise=cb.Gaussian(std=0.1 * unit)
    )
    return cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-unit], [unit]))], horizon=6)


def pendulum(unit: float = 1.0) -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x: [x[1], -unit * np.sin(x[0] / unit) - x[1]], states=2, diffusion=[[0.0], [0.05 * unit]]
    )
    safe = [cb.Inside(cb.Box([-unit, -unit], [unit, unit]))]
    initial = cb.Box([-0.05 * unit, 0.0], [0.05 * unit, 0.0])
    return cb.Problem(system, initial=initial, safe=safe, horizon=1)


def bent_map(unit: float = 1.0) -> cb.Problem:
    """No constants hold everywhere."""
    system = cb.DiscreteSystem(
        lambda x: 0.8 * x + 0.1 * x**2 / unit, states=1, noise=cb.Gaussian(std=0.05 * unit)
    )
    initial = cb.Box([0.1 * unit], [0.2 * unit])
    return cb.Problem(system, initial=initial, safe=[cb.Inside(cb.Box([-unit], [unit]))], horizon=4)


def decaying(unit: float = 1.0) -> cb.Problem:
    """The noise depends on the state."""
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=lambda x: [[0.1 * x[0]]])
    return cb.Problem(system, initial=[0.5 * unit], safe=[cb.Inside(cb.Box([-unit], [unit]))], horizon=0.5)


def van_der_pol() -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x: [-x[1], x[0] + (x[0] ** 2 - 1) * x[1]], states=2, diffusion=0.3 * np.eye(2)
    )
    return cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1.2, -1.2], [1.2, 1.2]))], horizon=2)


def across_the_cut() -> cb.Problem:
    system = cb.DiscreteSystem(
        lambda x: [0.9 * x[0], 0.3 * np.arctan2(x[1], x[0])], states=2, noise=cb.Gaussian(std=0.1)
    )
    return cb.Problem(system, initial=[-1.0, 0.05], safe=[cb.Inside(cb.Box([-3, -3], [3, 3]))], horizon=3)


def logistic() -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: 2.8 * x * (1 - x), states=1, noise=cb.Gaussian(std=0.04))
    return cb.Problem(system, initial=cb.Box([0.6], [0.7]), safe=[cb.Inside(cb.Box([0.35], [0.95]))], horizon=20)


def epidemic() -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x: [-1.5 * x[0] * x[1], 1.5 * x[0] * x[1] - 0.5 * x[1]],
        states=["S", "I"],
        diffusion=lambda x: [[-0.1 * x[0] * x[1]], [0.1 * x[0] * x[1]]],
    )
    safe = [cb.Inside(cb.HalfSpace([0, 1], 0.6))]
    return cb.Problem(system, initial=cb.Box([0.94, 0.04], [0.96, 0.06]), safe=safe, horizon=10)


def stiff() -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: [-1e4 * x[0], -x[1]], states=2, diffusion=np.diag([1.0, 0.1]))
    return cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=10)


def constant_map() -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: [0.3, -0.2], states=2, noise=cb.Gaussian(std=0.1))
    return cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1.5, 1]))], horizon=4)


def draining() -> cb.Problem:
    """Undefined at x = 0, where constant slopes are read."""
    system = cb.ContinuousSystem(
        lambda x: [-0.1 * np.log(x[0] / 0.5), -x[1]], states=2, diffusion=0.01 * np.eye(2)
    )
    return cb.Problem(system, initial=[0.4, 0], safe=[cb.Inside(cb.Box([0.02, -1], [1, 1]))], horizon=1)


# ---- one engine's failure ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (AssertionError(), r"the linear engine failed \(AssertionError\)\. This is a defect of certbound\."),
        (ValueError("`value` must be finite"), r"failed \(ValueError: `value` must be finite\)\.$"),
        (OverflowError("too large"), r"failed \(OverflowError: too large\)\.$"),
        (np.linalg.LinAlgError("Singular matrix"), "LinAlgError: Singular matrix"),
        (MemoryError("no room"), "MemoryError: no room"),
        (InfeasibleError("no tube; use less noise."), "^no tube; use less noise.$"),
        (SolverError("it stalled."), "^it stalled.$"),
        (EnclosureError("log(x) on [-1, 1]."), "^log"),
        (ArithmeticError("the remainder feeds itself"), "^the remainder feeds itself$"),
        (ValueError("9" * 500), "9{200}[.]{3}"),
    ],
)
def test_whatever_goes_wrong_in_an_engine_becomes_its_answer(
    error: Exception, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: Any, **__: Any) -> Any:
        raise error

    with pytest.raises(EngineError, match=words), contained("linear"):
        failing()
    monkeypatch.setitem(ENGINES, "linear", replace(ENGINES["linear"], prove=failing))
    verdict = verify_safety(sine_map())
    assert verdict.status == "SAFE"
    assert verdict.answers["constants"].applicable
    assert not verdict.answers["linear"].applicable
    assert verdict.answers["linear"].reason


def test_what_one_engine_proved_outlives_the_failure_of_a_later_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: Any, **__: Any) -> Any:
        raise KeyError("lost")

    alone = verify_safety(sine_map(), method="linear").log10_delta
    monkeypatch.setitem(ENGINES, "constants", replace(ENGINES["constants"], prove=failing))
    verdict = verify_safety(sine_map())
    assert verdict.status == "SAFE"
    assert verdict.log10_delta == alone


def test_with_every_engine_failing_there_is_still_a_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: Any, **__: Any) -> Any:
        raise ZeroDivisionError

    for name in ENGINES:
        monkeypatch.setitem(ENGINES, name, replace(ENGINES[name], prove=failing))
    verdict = verify_safety(sine_map())
    assert (verdict.status, verdict.log10_delta) == ("UNKNOWN", 0.0)
    assert "the barrier engine failed (ZeroDivisionError)" in verdict.reason


def test_a_search_for_violations_that_fails_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(_: Any) -> Any:
        raise AssertionError

    monkeypatch.setattr("certbound.safety.decision.find_violation", failing)
    assert verify_safety(sine_map()).status == "SAFE"


@pytest.mark.parametrize("kind", [RuntimeWarning, KeyboardInterrupt])
def test_warnings_and_interruptions_are_not_swallowed(kind: type[BaseException]) -> None:
    with pytest.raises(kind), contained("linear"):
        raise kind


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cells": 0}, "`cells` must be a positive integer"),
        ({"cells": float("nan")}, "`cells` must be a positive integer"),
        ({"method": "magic"}, "`method` must be one of"),
        ({"method": "thm3"}, "`method` 'thm3' needs constants with `rate`"),
        ({"constants": cb.Constants(rate=-1.0, sigma=0.1, dimension=1)}, "`constants` must state a gain"),
        ({"constants": cb.Constants(gain=0.5, sigma=0.1, dimension=2)}, "`constants` must have dimension 1"),
        (
            {"constants": cb.Constants(gain=[0.5, 0.5], sigma=[0.1, 0.1], times=[0, 1, 2], dimension=1)},
            "`constants` must reach the horizon 6, got 2",
        ),
    ],
)
def test_bad_input_is_refused_before_any_engine_runs(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        verify_safety(sine_map(), **options)


def test_a_method_that_is_no_text_is_refused_by_name() -> None:
    with pytest.raises(TypeError, match="`method` must be the name of one, got"):
        verify_safety(sine_map(), method=["linear"])  # type: ignore[arg-type]


# ---- problems that used to end in an exception -------------------------------------------------------------


@pytest.mark.parametrize("method", ["linear", "constants"])
@pytest.mark.parametrize("build", [across_the_cut, logistic, constant_map, draining, van_der_pol])
def test_ordinary_problems_get_an_answer_without_a_warning(build: Callable[[], cb.Problem], method: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        verdict = verify_safety(build(), method=method)
    assert verdict.status in ("SAFE", "UNKNOWN")
    assert "failed (" not in verdict.reason


def test_a_reach_tube_that_grows_beyond_all_bounds_is_no_bad_input() -> None:
    verdict = verify_safety(epidemic(), method="constants")
    assert verdict.status == "UNKNOWN"
    assert "could not be proved beyond t =" in verdict.reason


def test_a_system_too_stiff_for_the_linear_engine_says_so() -> None:
    with pytest.raises(EngineError, match=r"too stiff for the linear engine: \|\|J\|\| h = 50"):
        linear_engine(stiff())
    verdict = verify_safety(stiff(), method="linear")  # the exact law does not mind
    assert verdict.status == "SAFE"


def test_an_exact_engine_that_found_no_bound_keeps_no_other_from_being_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(linearisation, "MOST_PIECES", 200)  # too few for this rate
    system = cb.ContinuousSystem(lambda x: -1000 * x, states=1, diffusion=[[1.0]])
    problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-0.5], [0.5]))], horizon=0.5)
    answer = linear_engine(problem)
    assert answer.margin is None
    assert not answer.conclusive
    assert "no bound of the deviation was found" in answer.reason


def test_a_map_that_forgets_its_state_has_metrics_for_its_constraints() -> None:
    assert all(constants.certified for constants in bound_metrics(constant_map()))


def test_constant_slopes_are_read_where_the_function_is_undefined() -> None:
    slope, _, _ = Linearisation.of(draining()).slopes
    assert np.all(slope[..., 1, 1] == -1.0)
    assert np.isfinite(slope).all()


def test_the_nominal_of_a_stiff_system_is_not_lost_on_a_coarse_grid() -> None:
    system = cb.ContinuousSystem(
        lambda x: [-500 * (x[0] - np.tanh(x[1])), -0.3 * x[1] + 0.1 * x[0]], states=2, diffusion=0.01 * np.eye(2)
    )
    problem = cb.Problem(system, initial=[0, 0.1], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=3)
    assert np.abs(Linearisation.of(problem).nodes).max() < 0.2


def test_a_deviation_that_overflows_is_an_answer() -> None:
    system = cb.ContinuousSystem(lambda x: 2 * x + 0.1 * np.sin(x), states=1, diffusion=[[0.01]])
    problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=400)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        verdict = verify_safety(problem, method="linear")
    assert verdict.status == "UNKNOWN"
    assert "defect" not in verdict.reason


def test_dynamics_undefined_inside_the_safe_set_end_the_search_for_a_barrier() -> None:
    system = cb.ContinuousSystem(lambda x: [-np.sign(x[0])], states=1, diffusion=[[0.1]])
    problem = cb.Problem(system, initial=[0.5], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1)
    verdict = verify_safety(problem, method="barrier")
    assert not verdict.answers["barrier"].applicable
    assert "undefined there, or jump" in verdict.reason


# ---- other units -------------------------------------------------------------------------------------------


@functools.cache
def verdict_in(build: Callable[[float], cb.Problem], unit: float, method: str) -> cb.Verdict:
    return verify_safety(build(unit), method=method)


@pytest.mark.parametrize("unit", [1e-14, 1e8])
@pytest.mark.parametrize(
    ("build", "method"),
    [
        (sine_map, "linear"), (sine_map, "constants"), (bent_map, "constants"),
        (pendulum, "linear"), (pendulum, "constants"),
        (decaying, "linear"), (decaying, "constants"), (decaying, "barrier"),
    ],
)  # fmt: skip
def test_other_units_give_the_same_verdict(build: Callable[[float], cb.Problem], method: str, unit: float) -> None:
    plain, scaled = (verdict_in(build, size, method) for size in (1.0, unit))
    assert scaled.status == plain.status
    assert scaled.log10_delta == pytest.approx(plain.log10_delta, rel=1e-2)


@pytest.mark.parametrize("unit", [1e-14, 1e8])
def test_noise_that_depends_on_the_state_is_bounded_alike_in_other_units(unit: float) -> None:
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=lambda x: [[0.1 * x[0] * (1 - x[0] / unit)]])
    domain = cb.Box([0.0], [unit])
    problem = cb.Problem(system, initial=[0.5 * unit], safe=[], horizon=1, domain=domain)
    sigma = float(np.max(bound_constants(problem, metric="euclidean").sigma))
    assert sigma / unit == pytest.approx(0.025, rel=1e-2)


@pytest.mark.parametrize("unit", [1e-14, 1e8])
@pytest.mark.parametrize(("build", "method"), [(sine_map, "linear"), (sine_map, "constants"), (decaying, "linear")])
def test_other_units_have_a_certificate_too(build: Callable[[float], cb.Problem], method: str, unit: float) -> None:
    problem = build(unit)
    text = proved_certificate(problem, verdict_in(build, unit, method))
    assert float.fromhex(json.loads(text)["claim"]["log10_delta"]) < -3


@pytest.mark.parametrize("kind", [OutOfTime, KeyboardInterrupt])
def test_what_stops_compiled_code_is_no_failure_of_an_engine(kind: type[BaseException]) -> None:
    with pytest.raises(kind), contained("values"):
        raise SystemError("a compiled function returned a result with an exception set") from kind()
