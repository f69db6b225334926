"""``synthesize_plan``: plans, verdicts and refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.synthesis.plans.infeasibility import smallest_delta
from tests.synthesis.conftest import A, B, cart


def test_the_plan_is_verified_and_keeps_its_tightened_constraints(planned: Any) -> None:
    assert planned.feasible
    assert planned.status == "SAFE"
    assert planned.log10_delta <= -3
    assert planned.softened == 0
    assert planned.infeasibility is None
    assert planned.max_input <= 3 + 1e-9
    again = cb.verify_safety(planned.problem, method="linear")
    assert again.log10_delta == planned.log10_delta


def test_the_plan_survives_the_noise(planned: Any) -> None:
    runs = cb.simulate_closed_loop(planned, runs=3000, rng=1)
    assert runs.lower <= planned.problem.delta
    assert runs.max_input == pytest.approx(planned.max_input)
    assert runs.mean_final_cost < 0.1 * runs.mean_cost[0]


def test_less_noise_is_never_worse() -> None:
    quiet, loud = (cb.synthesize_plan(cart(std=std), method="linear") for std in (0.01, 0.03))
    assert quiet.scale > loud.scale
    assert quiet.cost <= loud.cost + 1e-6


def test_constants_give_a_plan_of_their_own(problem: cb.Problem) -> None:
    found = cb.synthesize_plan(problem, method="kummer")
    assert found.method == "kummer"
    assert found.constants is not None
    assert found.constants.certified
    assert (found.status == "SAFE") == (found.log10_delta <= -3)


def test_a_one_time_bound_is_unknown_however_well_it_fits() -> None:
    constants = cb.Constants(gain=1.06, sigma=0.001, dimension=2, isotropic=True)
    found = cb.synthesize_plan(cart(std=0.001), method="markov", constants=constants)
    assert found.feasible
    assert found.status == "UNKNOWN"
    assert "one time" in found.reason


def test_stated_constants_are_named_as_an_assumption(problem: cb.Problem) -> None:
    constants = cb.Constants(gain=1.06, sigma=0.01, dimension=2)
    found = cb.synthesize_plan(problem, method="kummer", constants=constants)
    assert "assumed" in found.reason
    with pytest.raises(ValueError, match=r"`constants.sigma` must be at least 0.01, .* got 0.001"):
        cb.synthesize_plan(problem, method="kummer", constants=cb.Constants(gain=1.06, sigma=0.001, dimension=2))


def test_an_infeasible_problem_says_why_and_what_would_do(problem: cb.Problem) -> None:
    constants = cb.Constants(gain=1.06, sigma=0.02, dimension=2)
    found = cb.synthesize_plan(problem, method="markov", constants=constants)
    assert not found.feasible
    assert found.infeasibility is not None
    assert found.infeasibility.proved
    assert found.softened > 0
    delta = found.smallest_delta
    assert delta is not None
    assert problem.delta < delta < 1
    larger, smaller = (
        cb.synthesize_plan(problem.replace(delta=delta * factor), method="markov", constants=constants)
        for factor in (1.01, 0.99)
    )
    assert larger.feasible
    assert not smaller.feasible


def test_a_response_that_does_not_fit_is_no_proof() -> None:
    found = cb.synthesize_plan(cart(std=0.3, delta=1e-6), method="linear")
    assert not found.feasible
    assert found.status in ("UNKNOWN", "UNSAFE")
    assert found.infeasibility is not None
    assert not found.infeasibility.proved
    assert "not a proof" in found.reason


@pytest.mark.slow
def test_auto_says_what_it_looked_for() -> None:
    found = cb.synthesize_plan(cart(std=0.07, horizon=12))
    assert not found.feasible
    assert found.infeasibility is not None
    delta = found.smallest_delta
    assert delta is not None
    assert delta > found.source.delta
    assert f"{delta:.4g}" in found.reason
    assert cb.synthesize_plan(cart(std=0.07, horizon=12, delta=1.02 * delta), method=found.method).feasible


def test_continuous_time_is_planned_and_proved() -> None:
    system = cb.ContinuousSystem(
        lambda x, u: [x[1], u[0] - np.sin(x[0])], states=2, inputs=cb.Box([-6], [6]), diffusion=[[0], [0.02]]
    )
    safe = [cb.Inside(cb.Box([-0.2, -0.6], [1.2, 0.6])), cb.Inside(cb.Box([-0.2, -0.6], [0.8, 0.6]), during=(0.6, 0.6))]
    problem = cb.Problem(system, initial=[1, 0], safe=safe, horizon=0.6, delta=1e-2)
    found = cb.synthesize_plan(problem, method="linear", steps=4, feedback=[[-4.0, -3.0]])
    assert found.status == "SAFE"
    assert found.states[-1, 0] < 0.8
    assert np.all(np.abs(found.inputs) <= 6)
    assert any("inputs within their bounds" in c.label for c in found.problem.safe)


@pytest.mark.slow
def test_continuous_time_is_planned_around_an_obstacle() -> None:
    system = cb.ContinuousSystem(
        lambda x, u: [x[1], u[0] - np.sin(x[0])], states=2, inputs=cb.Box([-6], [6]), diffusion=[[0], [0.02]]
    )
    safe = [cb.Outside(cb.Ball([0.5, -0.8], 0.3)), cb.Inside(cb.Box([-0.2, -2], [1.2, 2]))]
    end = cb.Inside(cb.Box([-0.2, -0.5], [0.2, 0.5]), during=(1.5, 1.5))
    problem = cb.Problem(system, initial=[1, 0], safe=[*safe, end], horizon=1.5, delta=1e-2)
    found = cb.synthesize_plan(problem, method="linear", steps=12)
    assert found.status == "SAFE"
    assert np.linalg.norm(found.states - [0.5, -0.8], axis=1).min() > 0.3


def test_a_given_tube_serves(problem: cb.Problem) -> None:
    constants = cb.Constants(gain=1.0, sigma=0.002, dimension=2)
    tube = cb.tune_tube(constants, horizon=20, delta=1e-3, method="thm4")
    found = cb.synthesize_plan(problem, tube=tube)
    assert found.method == "thm4"
    assert found.feasible
    half = 0.8 - tube.radius(20)
    assert found.states[:, 1].min() >= -half - 0.1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "nonsense"}, "`method` must be one of"),
        ({"terminal": "nonsense"}, "`terminal` must be 'contraction', 'riccati'"),
        ({"terminal": cb.Box([-1, -0.79], [1, 0.79])}, "`terminal` must lie inside the tightened constraints"),
        ({"terminal": cb.Ball([0, 0, 0], 1)}, "`terminal` must have dimension 2"),
        ({"feedback": [[1.0, 1.0]]}, "`feedback` must stabilise"),
        ({"feedback": [[1.0]]}, "`feedback` must have shape"),
        ({"feedback": "nonsense"}, "`feedback` must be 'riccati', 'lmi' or a"),
        ({"steps": 7}, "`steps` must be the horizon"),
        ({"steps": 0}, "`steps` must be a positive integer"),
    ],
)
def test_bad_input_is_refused(problem: cb.Problem, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cb.synthesize_plan(problem, **({"method": "linear"} | changes))


def test_a_method_is_no_tube(problem: cb.Problem) -> None:
    with pytest.raises(TypeError, match=r"`tube` must be a cb.Tube, got 'thm5'; the name of one goes under `method`"):
        cb.synthesize_plan(problem, tube="thm5")  # type: ignore[arg-type]


def test_a_terminal_of_another_type_is_refused(problem: cb.Problem) -> None:
    with pytest.raises(TypeError, match="`terminal` must be"):
        cb.synthesize_plan(problem, terminal=3.0)  # type: ignore[arg-type]


def test_a_tube_that_ends_early_is_refused(problem: cb.Problem) -> None:
    tube = cb.tune_tube(cb.Constants(gain=0.9, sigma=0.01, dimension=2), horizon=10, delta=1e-3)
    with pytest.raises(ValueError, match="`tube` must cover the horizon"):
        cb.synthesize_plan(problem, tube=tube)


def test_a_system_without_inputs_is_refused() -> None:
    with pytest.raises(ValueError, match="`problem` must have inputs"):
        cb.synthesize_plan(cb.load("ou"))


def test_a_problem_without_constraints_is_refused() -> None:
    with pytest.raises(ValueError, match="`problem` must have a constraint"):
        cb.synthesize_plan(cart(safe=[]))


def test_inputs_without_bounds_are_refused_where_the_jacobian_depends_on_them() -> None:
    system = cb.DiscreteSystem(
        lambda x, u: [0.9 * x[0] + x[0] * u[0]], states=1, inputs=cb.Box([-np.inf], [np.inf]),
        noise=cb.Gaussian(std=0.01),
    )  # fmt: skip
    problem = cb.Problem(system, initial=[0.1], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=5)
    with pytest.raises(ValueError, match="`inputs` must be bounded"):
        cb.synthesize_plan(problem, method="kummer")


@pytest.mark.parametrize("feedback", ["riccati", [[-4.0, -3.0]]])
def test_a_feedback_narrows_the_tube_and_its_inputs_are_proved(problem: cb.Problem, feedback: Any) -> None:
    found, blind = (cb.synthesize_plan(cart(std=0.03), method="linear", feedback=f) for f in (feedback, None))
    assert found.status == "SAFE"
    assert found.scale > blind.scale
    assert any("inputs within their bounds" in c.label for c in found.problem.safe)
    runs = cb.simulate_closed_loop(found, runs=2000, rng=0)
    assert runs.lower <= 1e-3
    assert runs.max_input <= 3
    ends = [cb.sample_paths(r.problem, paths=500, rng=np.random.default_rng(0))[:, -1] for r in (found, blind)]
    assert np.all(ends[0].std(axis=0) < 0.8 * ends[1].std(axis=0))


def test_the_closed_loop_is_the_system_under_the_feedback(problem: cb.Problem) -> None:
    found = cb.synthesize_plan(problem, method="linear", feedback=[[-4.0, -3.0]])
    quiet = found.problem.replace(system=_silent(found.problem.system))
    (path,) = cb.sample_paths(quiet, paths=1, rng=np.random.default_rng(0))
    np.testing.assert_allclose(path, found.states, atol=1e-9)
    by_hand = path[0]
    for row in found.inputs:
        by_hand = A @ by_hand + B @ row
    np.testing.assert_allclose(by_hand, path[-1], atol=1e-9)


def _silent(system: Any) -> Any:
    return cb.DiscreteSystem(
        system.dynamics, states=system.states, inputs=system.inputs, input_names=system.input_names,
        noise=cb.Gaussian(std=0.0),
    )  # fmt: skip


@pytest.mark.parametrize("threshold", [3e-7, 0.04, 0.9])
@pytest.mark.parametrize("start", [1e-9, 1e-3, 0.5])
def test_the_smallest_delta_is_found_from_either_side(threshold: float, start: float) -> None:
    assert smallest_delta(lambda delta: delta >= threshold, start) == pytest.approx(threshold, rel=0.003)


def test_no_delta_at_all_is_said() -> None:
    assert smallest_delta(lambda delta: False, 1e-3) is None


@pytest.mark.slow
@pytest.mark.parametrize(("delta", "feasible"), [(0.03, False), (0.05, True)])
def test_markov_on_the_chain_is_infeasible_below_four_percent(delta: float, feasible: bool) -> None:
    found = cb.synthesize_plan(cb.load("chain").replace(delta=delta), method="markov")
    assert found.feasible is feasible
    assert found.status != "SAFE"
    assert feasible or (found.infeasibility is not None and found.infeasibility.proved)


@pytest.mark.slow
def test_the_chain_is_planned_with_the_papers_tube_and_with_ours() -> None:
    chain = cb.load("chain")
    paper = cb.synthesize_plan(chain, method="thm5", epsilon=15 / 16, step=1)
    ours = cb.synthesize_plan(chain.replace(delta=1e-6), method="kummer", constants=paper.constants)
    response = cb.synthesize_plan(chain, method="linear")
    assert paper.status == ours.status == response.status == "SAFE"
    runs = cb.simulate_closed_loop(response, runs=3000, rng=0)
    assert runs.lower <= 0.002
    assert runs.max_input <= 100
    assert runs.mean_final_cost < 0.01 * runs.mean_cost[0]


@pytest.mark.slow
def test_ours_plans_the_chain_at_more_than_twice_the_noise_of_the_papers() -> None:
    loud = cb.load("chain", sigma=0.43 * 3.2)
    assert cb.synthesize_plan(loud, method="linear").status == "SAFE"
    assert not cb.synthesize_plan(cb.load("chain", sigma=0.43 * 1.6), method="thm5", epsilon=15 / 16, step=1).feasible


def test_a_plan_needs_an_end() -> None:
    for system in (
        cb.DiscreteSystem(lambda x, u: [x[0] + u[0]], states=1, inputs=cb.Box([-1], [1]), noise=cb.Gaussian(std=0.1)),
        cb.ContinuousSystem(lambda x, u: [u[0]], states=1, inputs=cb.Box([-1], [1]), diffusion=0.1),
    ):
        problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=np.inf)
        with pytest.raises(InfeasibleError, match="give a finite `horizon`"):
            cb.synthesize_plan(problem)


def test_a_run_that_ends_where_it_leaves_the_domain_breaks_nothing_later():
    system = cb.DiscreteSystem(
        lambda x, u: [0.9 * x[0] + u[0]], states=["x"], inputs=cb.Box([-1], [1]), noise=cb.Gaussian(std=0.2)
    )
    problem = cb.Problem(
        system, initial=[0.5], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3, delta=0.9, cost=(np.eye(1), np.eye(1)),
        domain=cb.Box([-0.6], [0.6]), leaving="ends",
    )  # fmt: skip
    runs = cb.simulate_closed_loop(cb.synthesize_plan(problem), runs=2000, rng=0)
    assert runs.violations <= 5  # one in nine leaves the domain
