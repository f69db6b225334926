"""Polynomial barriers: what is proved holds at every point, and the bound is above the truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import certbound as cb
from certbound.checker import check_data, parse
from certbound.errors import CertificateError, InfeasibleError
from certbound.rigor.intervals import Interval
from certbound.safety.answers import EngineAnswer
from certbound.safety.certificate import problem_data
from certbound.safety.certificates.barrier import barrier_proof
from certbound.safety.engines import barrier as engine
from certbound.safety.engines import barrier_programs
from certbound.safety.engines.barrier import Barrier, barrier_engine
from certbound.safety.engines.barrier_programs import Polynomials
from certbound.safety.engines.gaps import gaps_of, lies_inside
from certbound.values.continuous.exits import bound_exits


def scalar(**changes: object) -> cb.Problem:
    """Brownian motion with an inward drift in an interval."""
    system = cb.ContinuousSystem(lambda x: -x, states=["x"], diffusion=[[0.3]])
    given = {"initial": [0.0], "safe": [cb.Inside(cb.Box([-1.0], [1.0]))], "horizon": 2.0, "delta": 1e-2}
    return cb.Problem(system, **{**given, **changes})  # type: ignore[arg-type]


def oscillator(sigma: float) -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x: [x[1], -x[0] - x[1] - 0.5 * x[0] ** 3], states=["x1", "x2"], diffusion=[[0.0], [sigma]]
    )
    return cb.Problem(
        system, initial=cb.Box([-1, -1], [1, 1]), safe=[cb.Inside(cb.HalfSpace([0, 1], 2.25))], horizon=5.0,
        delta=1e-3, domain=cb.Box([-3, -3], [3, 3]),
    )  # fmt: skip


def values(barrier: Barrier, x: np.ndarray) -> np.ndarray:
    y = (x - barrier.center) / barrier.scale
    return np.sum(barrier.coefficients * np.prod(y[:, None, :] ** barrier.exponents, axis=-1), axis=-1)


def test_the_bound_is_above_the_probability_and_not_far_above() -> None:
    found = barrier_engine(scalar())
    exits = cb.simulate_exits(scalar(), paths=200_000, rng=1, steps=400, halve=False)
    assert 10**found.log10_delta >= exits.probability
    stationary = 2 * norm.sf(1 / (0.3 / np.sqrt(2)))
    assert 10**found.log10_delta < 100 * stationary


def test_a_hardening_spring_is_certified_at_large_noise() -> None:
    problem = oscillator(0.5)
    verdict = cb.verify_safety(problem, method="barrier")
    assert verdict.status == "SAFE"
    assert verdict.method == "barrier"
    barrier = verdict.answers["barrier"].details
    rng = np.random.default_rng(3)
    x = rng.uniform([-3, -3], [3, 2.25], (30_000, 2))
    step = 1e-4
    slope = np.stack([(values(barrier, x + e) - values(barrier, x - e)) / (2 * step) for e in step * np.eye(2)], axis=1)
    up = np.array([0.0, step])
    bend = (values(barrier, x + up) - 2 * values(barrier, x) + values(barrier, x - up)) / step**2
    drift = np.stack([x[:, 1], -x[:, 0] - x[:, 1] - 0.5 * x[:, 0] ** 3], axis=1)
    generator = np.sum(slope * drift, axis=1) + 0.125 * bend + 0.125 * slope[:, 1] ** 2
    assert generator.max() <= barrier.growth + 1e-4
    assert generator.max() > barrier.growth - 0.05
    assert values(barrier, rng.uniform(-1, 1, (20_000, 2))).max() <= barrier.start
    sides = np.concatenate([
        np.stack([rng.uniform(-3, 3, 5000), np.full(5000, 2.25)], axis=1),
        np.stack([np.full(5000, 3.0), rng.uniform(-3, 2.25, 5000)], axis=1),
        np.stack([np.full(5000, -3.0), rng.uniform(-3, 2.25, 5000)], axis=1),
        np.stack([rng.uniform(-3, 3, 5000), np.full(5000, -3.0)], axis=1),
    ])  # fmt: skip
    assert values(barrier, sides).min() >= barrier.boundary


def test_noise_that_depends_on_the_state_a_disturbance_and_an_obstacle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(engine._FINE, 2, 21)  # where the program looks; what is proved does not rest on it
    system = cb.ContinuousSystem(
        lambda x, d: [-x[0] + d[0], -2 * x[1]], states=["a", "b"], disturbance=cb.Box([-0.1], [0.1]),
        diffusion=lambda t, x: np.array([[0.25 + 0.25 * x[0], 0.0], [0.0, 0.375]]),
    )  # fmt: skip
    problem = cb.Problem(
        system, initial=cb.Ball([0.0, 0.0], 0.05), horizon=1.0, delta=0.05,
        safe=[cb.Inside(cb.Box([-1, -1], [1, 1])), cb.Outside(cb.Ball([0.7, 0.7], 0.2))],
    )  # fmt: skip
    found = barrier_engine(problem)
    exits = cb.simulate_exits(problem, paths=20_000, rng=1, steps=200, halve=False)
    assert found.log10_delta < -1.5
    assert 10**found.log10_delta >= exits.lower


def test_an_inflow_stays_near_the_truth_where_noise_keeps_moving() -> None:
    """Every exp(V) grows by a factor e^(kappa T) that leaves nothing over 8 units of time."""
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=[[0.45]])
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1.2], [1.2]))], horizon=8, delta=1e-9)
    work = engine._Work(problem, system)
    found = work.steady(4, lambda _: None, 0.0)
    assert found is not None
    assert work.steady(4, lambda _: None, found.log10_probability(8.0), 1.15) is None  # it hopes for no more than that
    truth = bound_exits(problem, seconds=0.1)
    assert truth.lower <= found.log10_probability(8.0) <= truth.upper + np.log10(2)
    answer = barrier_engine(problem)
    assert answer.log10_delta == pytest.approx(found.log10_probability(8.0), abs=0.3)


def test_where_a_steep_polynomial_falls_is_decided_without_its_exponential() -> None:
    """Around a cycle, V = 14 (|x|^2 - 1)^2 - 7.875: exp(V) times a rough range of what is far below 0 is huge."""
    system = cb.ContinuousSystem(
        lambda x: [x[1] + x[0] * (1 - x[0] ** 2 - x[1] ** 2), -x[0] + x[1] * (1 - x[0] ** 2 - x[1] ** 2)], states=2,
        diffusion=0.15 * np.eye(2),
    )  # fmt: skip
    safe = [cb.Inside(cb.Ball([0, 0], 1.5)), cb.Outside(cb.Ball([0, 0], 0.5))]
    work = engine._Work(cb.Problem(system, initial=[1.0, 0.0], safe=safe, horizon=10), system)
    powers = np.array([[2, 0], [0, 2], [4, 0], [2, 2], [0, 4]])
    unit = work.scale[0] ** powers.sum(axis=1)
    found, _ = work._certified(powers, np.append([-28, -28, 14, 28, 14] * unit, 14 - 7.875), steady=True)
    assert found is not None
    assert found.log10_probability(10.0) < -2


def test_a_steady_polynomial_takes_few_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tangents far above the level that the last polynomial serves lead down by a factor e each."""
    asked, solved = [], barrier_programs._solved
    monkeypatch.setattr(barrier_programs, "_solved", lambda cp, program: asked.append(1) or solved(cp, program))
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=[[0.45]])
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1.2], [1.2]))], horizon=8, delta=1e-9)
    work = engine._Work(problem, system)
    coefficients, hoped = work.programs.steadiest(work._exponents(4), work._points(51))
    assert coefficients is not None
    assert hoped < 0
    assert len(asked) <= 7


@pytest.mark.parametrize(
    ("problem", "why"),
    [
        (cb.load("chain"), "continuous time"),
        (scalar(safe=[cb.Inside(cb.HalfSpace([1.0], 1.0))]), "bound every state"),
        (scalar(safe=[cb.Inside(cb.Box([-1.0], [1.0]), during=(1.0, 2.0))]), "windows"),
        (scalar(initial=cb.GaussianStart([0.0], [[0.01]])), "bounded initial set"),
    ],
)
def test_what_it_does_not_treat_it_names(problem: cb.Problem, why: str) -> None:
    found = barrier_engine(problem)
    assert not found.applicable
    assert why in found.reason


def test_its_certificate_is_proved_again_and_claims_little_less() -> None:
    problem = scalar()
    verdict = cb.verify_safety(problem, method="barrier")
    data = parse(verdict.certificate_text(problem))
    report = check_data(data, problem_data(problem))
    assert report.valid, report.reason
    assert verdict.log10_delta <= report.log10_delta <= verdict.log10_delta + 0.02
    assert report.log10_delta <= np.log10(problem.delta)
    assert "exponential of a polynomial" in report.reason
    other = check_data(data, problem_data(scalar(horizon=2.5)))
    assert not other.valid
    assert "another problem" in other.reason


def test_a_certificate_next_to_delta_still_says_safe() -> None:
    """Of the room between the bound and delta at most half is given away to the checker."""
    problem = scalar()
    verdict = cb.verify_safety(problem, method="barrier")
    close = problem.replace(delta=float(10 ** (verdict.log10_delta + 1e-3)))
    data, log10, assumptions = barrier_proof(close, verdict.answers["barrier"])
    assert verdict.log10_delta < log10 < verdict.log10_delta + 6e-4
    assert assumptions == []
    assert data["engine"] == "barrier"


def test_a_barrier_without_room_has_no_certificate() -> None:
    weak = Barrier(
        exponents=np.array([[2]]), coefficients=np.ones(1), center=np.zeros(1), scale=np.ones(1), start=0.0,
        boundary=1e-9, growth=0.0,
    )  # fmt: skip
    for details in (weak, None):
        with pytest.raises(CertificateError, match="barrier"):
            barrier_proof(scalar(), EngineAnswer(method="barrier", details=details))


def test_a_start_that_may_touch_the_obstacle_is_not_answered() -> None:
    system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=0.05 * np.eye(2))
    corner = cb.Polytope([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]], [-0.5, 1.0, 1.0])  # {a + b >= .5}

    def problem(width: float) -> cb.Problem:
        return cb.Problem(
            system, initial=cb.Box([-width] * 2, [width] * 2), horizon=0.5, delta=0.5,
            safe=[cb.Inside(cb.Box([-1, -1], [1, 1])), cb.Outside(corner)],
        )  # fmt: skip

    found = gaps_of(problem(0.2))
    assert lies_inside(found, Interval(np.full(2, -0.24), np.full(2, 0.24)))
    assert not lies_inside(found, Interval(np.full(2, -0.26), np.full(2, 0.26)))
    assert not lies_inside(found, Interval(np.full(2, 0.3), np.full(2, 0.3)))
    assert lies_inside(found, Interval(np.zeros(2), np.zeros(2)))


def test_an_initial_set_that_was_not_proved_safe_gets_no_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("certbound.safety.engines.barrier.lies_inside", lambda gaps, box: False)
    found = barrier_engine(scalar())
    assert not found.applicable
    assert "initial set" in found.reason


def test_a_target_far_out_of_reach_is_not_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    hopes, asked = list[float](), [0.0]

    def program(_: object, exponents: np.ndarray, points: object) -> tuple[np.ndarray, float]:
        hopes.append(asked[0])
        return np.zeros(len(exponents) + 1), asked[0]

    monkeypatch.setattr(Polynomials, "slowest", program)
    monkeypatch.setattr(engine._Work, "steady", lambda *_: None)
    nothing = np.zeros((0, 4)), np.zeros((0, 3)), np.zeros((0, 3))
    monkeypatch.setattr(engine._Work, "_certified", lambda *_: (None, nothing))
    system = cb.ContinuousSystem(lambda x: -x, states=3, diffusion=0.3 * np.eye(3))
    safe = [cb.Inside(cb.Box(-np.ones(3), np.ones(3)))]
    problem = cb.Problem(system, initial=np.zeros(3), safe=safe, horizon=2.0, delta=1e-3)
    for hoped, rounds in ((-0.2, 1), (-2.0, 3)):
        hopes.clear()
        asked[0] = hoped
        assert barrier_engine(problem).log10_delta == 0.0
        assert len(hopes) == rounds


@pytest.mark.parametrize(("drift", "times"), [(lambda t, x: -x, 1), (lambda t, x: -(1 + 0.1 * t) * x, 3)])
def test_points_are_taken_at_several_times_only_where_the_model_depends_on_it(drift: object, times: int) -> None:
    system = cb.ContinuousSystem(drift, states=1, diffusion=[[0.3]])
    problem = scalar().replace(system=system)
    inner, _, _ = engine._Work(problem, system)._points(11)
    assert len(inner) == 11 * times
    assert len(np.unique(inner[:, 0])) == times


def test_of_many_points_only_those_that_bind_enter_the_program(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    program = Polynomials.slowest

    def counted(self: Polynomials, exponents: np.ndarray, points: Any) -> object:
        asked.append(len(points[0]))
        return program(self, exponents, points)

    monkeypatch.setattr(Polynomials, "slowest", counted)
    found = barrier_engine(oscillator(0.4))
    assert found.log10_delta < -2
    assert max(asked) < 0.8 * engine._FINE[2] ** 2


def test_a_further_degree_that_cannot_reach_the_target_is_given_up_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    hopes: list[tuple[int, float]] = []
    program = Polynomials.slowest

    def noted(self: Any, exponents: Any, points: Any) -> Any:
        found = program(self, exponents, points)
        hopes.append((int(exponents.sum(axis=1).max()), found[1]))
        return found

    monkeypatch.setattr(Polynomials, "slowest", noted)
    monkeypatch.setattr(engine._Work, "steady", lambda *_: None)
    system = cb.ContinuousSystem(lambda x: [x[0] - x[0] ** 3, -x[1]], states=2, diffusion=0.3 * np.eye(2))
    room = cb.Inside(cb.Box([-0.4, -1.5], [2, 1.5]))
    problem = cb.Problem(system, initial=cb.Box([0.9, -0.1], [1.0, 0.1]), safe=[room], horizon=3)
    assert barrier_engine(problem).log10_delta < -1
    assert [degree for degree, _ in hopes].count(6) == 1
    assert hopes[-1][1] > -3


def test_a_proposal_that_is_far_below_at_the_start_leaves_no_tolerance_of_0() -> None:
    system = cb.ContinuousSystem(lambda x: [3 * np.sign(x[0])], states=["x"], diffusion=[[0.15]])
    safe = [cb.Inside(cb.Box([-1.6], [1.6]))]
    found = barrier_engine(scalar(initial=[0.3], safe=safe, horizon=10.0, delta=1e-3).replace(system=system))
    assert found.reason == "no polynomial barrier was found."


@pytest.mark.parametrize(("drift", "noise"), [
    (lambda x: [np.log(x[0])], [[0.3]]), (lambda x: -x, lambda x: [[np.sqrt(x[0])]])
])
def test_a_model_that_is_undefined_in_the_safe_set_is_refused_in_words(drift: Any, noise: Any) -> None:
    """It ended as a defect, in the words of a solver that was given no numbers."""
    system = cb.ContinuousSystem(drift, states=1, diffusion=noise)
    problem = cb.Problem(system, initial=[0.1], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1)
    with pytest.raises(InfeasibleError, match="undefined somewhere in the safe set"):
        barrier_engine(problem)
