"""Verdicts."""

from __future__ import annotations

import math

import numpy as np
import pytest

import certbound as cb
from certbound.problem.library import MODELS
from certbound.safety.verification import Verdict, verify_safety


def brownian(sigma=0.1, bound=1.0, horizon=2.0, rate=-1.0, **changes) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: rate * x, states=2, diffusion=sigma * np.eye(2))
    options = {"initial": [0.2, 0.0], "safe": [cb.Inside(cb.Box([-bound] * 2, [bound] * 2))], "horizon": horizon}
    return cb.Problem(system, **(options | changes))


def by_constants(problem: cb.Problem, **options) -> Verdict:
    """With certified constants in the Euclidean norm: no semidefinite program is solved."""
    constants = cb.bound_constants(problem, metric="euclidean")
    return verify_safety(problem, **({"method": "constants", "constants": constants} | options))


@pytest.fixture(scope="module")
def chain_constants() -> cb.Constants:
    return cb.bound_constants(MODELS["chain"](), objective="erosion")


def consistent(verdict: Verdict, problem: cb.Problem) -> None:
    """What every verdict promises."""
    assert verdict.status in ("SAFE", "UNSAFE_NOMINAL", "UNKNOWN")
    assert math.isfinite(verdict.log10_delta)
    assert verdict.log10_delta <= 0
    assert (verdict.status == "SAFE") == (verdict.log10_delta <= math.log10(problem.delta))
    assert verdict.reason
    if verdict.margin is not None and verdict.status == "SAFE":
        assert verdict.margin >= 0


def test_the_bundled_ou_is_safe():
    problem = MODELS["ou"]()
    verdict = by_constants(problem)
    consistent(verdict, problem)
    assert verdict.status == "SAFE"
    assert -4.1 < verdict.log10_delta < -3.9
    assert verdict.margin == pytest.approx(1.5 - 1.3398, abs=2e-3)
    assert verdict.tube.certified
    assert verdict.reach.end == 5.0


@pytest.mark.parametrize("name", ["chain_rest", "chain"])
def test_the_chain_is_safe_by_global_constants_in_one_metric(name, chain_constants):
    problem = MODELS[name]()
    verdict = verify_safety(problem, method="constants", constants=chain_constants)
    consistent(verdict, problem)
    assert verdict.status == "SAFE"
    assert "assumed" not in verdict.reason
    assert chain_constants.metric is not None
    assert chain_constants.certified
    assert chain_constants.gain < 1


def test_a_noisy_chain_is_unknown_and_the_constraint_and_the_step_are_named(chain_constants):
    problem = MODELS["chain"](sigma=2.0)
    noisy = cb.bound_constants(problem, metric=chain_constants.metric)
    verdict = verify_safety(problem, method="constants", constants=noisy)
    consistent(verdict, problem)
    assert verdict.status == "UNKNOWN"
    assert verdict.constraint in [constraint.label for constraint in problem.safe]
    assert verdict.time == int(verdict.time)
    assert verdict.constraint in verdict.reason
    assert f"step {verdict.time:g}" in verdict.reason
    assert verdict.margin < 0
    assert "noise at most" in verdict.reason


def test_the_engine_finds_its_own_metric_where_the_euclidean_one_does_not_contract():
    system = cb.linear_system([[0.0, 1.0], [-1.0, -1.0]], diffusion=[[0.0], [0.1]])
    problem = cb.Problem(system, initial=[0.1, 0.0], safe=[cb.Inside(cb.HalfSpace([0.0, 1.0], 1.0))], horizon=8.0)
    assert cb.bound_constants(problem, metric="euclidean").rate > -1e-9
    verdict = verify_safety(problem, method="constants")
    consistent(verdict, problem)
    assert verdict.status == "SAFE"
    assert verdict.constants.metric is not None
    assert verdict.constants.rate < 0


def test_two_tanks_carries_logarithms_far_below_the_smallest_float():
    system = cb.linear_system([[0.9, 0], [0.1, 0.9]], b=[0.45, -0.3], noise=cb.Gaussian(std=0.01))
    problem = cb.Problem(
        system,
        initial=cb.Box([1.75] * 2, [2.25] * 2),
        safe=[cb.Outside(cb.Box([9, 9], [10, 10]))],
        horizon=5,
        delta=1e-6,
    )
    verdict = verify_safety(problem, method="constants")
    consistent(verdict, problem)
    assert verdict.constants.gain == pytest.approx(0.951388, abs=1e-6)
    assert -5.0e4 < verdict.log10_delta < -4.9e4


def test_a_problem_whose_noise_free_path_leaves_is_unsafe_without_any_engine():
    problem = brownian(rate=1.0, horizon=2.0)
    verdict = verify_safety(problem)
    consistent(verdict, problem)
    assert verdict.status == "UNSAFE_NOMINAL"
    assert verdict.constraint == problem.safe[0].label
    assert verdict.margin < 0
    assert verdict.time > np.log(5.0)
    assert "without any noise" in verdict.reason
    assert not verdict.answers


def test_leaving_the_domain_is_unknown_not_unsafe():
    problem = brownian(rate=1.0, safe=[], domain=cb.Box([-1, -1], [1, 1]))
    verdict = by_constants(problem)
    consistent(verdict, problem)
    assert verdict.status == "UNKNOWN"
    assert verdict.constraint == "the model's domain"


def test_the_domain_counts_as_a_constraint():
    free, bounded = brownian(), brownian(domain=cb.Box([-0.4, -1], [0.4, 1]))
    assert by_constants(bounded).log10_delta > by_constants(free).log10_delta
    assert by_constants(bounded).constraint == "the model's domain"


def test_constants_on_a_domain_do_not_speak_beyond_it():
    """Inside [-1, 1] the cubic pushes in, beyond it pushes out: only the domain makes it contract."""
    system = cb.ContinuousSystem(lambda x: [-x[0] + 0.2 * x[0] ** 3], states=1, diffusion=0.05)
    problem = cb.Problem(
        system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1.0, domain=cb.Box([-1.2], [1.2])
    )
    verdict = by_constants(problem)
    assert verdict.status == "SAFE"
    assert verdict.constants.rate == pytest.approx(-1 + 0.6 * 1.44, abs=0.02)


def test_moving_obstacles_and_windows():
    far = brownian(sigma=0.05, safe=[cb.Outside(cb.Ball(lambda t: [0.2 * np.exp(-t), 1.0 - 0.2 * t], 0.2))])
    near = brownian(sigma=0.05, safe=[cb.Outside(cb.Ball(lambda t: [0.2 * np.exp(-t), 1.0 - 0.3 * t], 0.2))])
    assert by_constants(far).log10_delta < by_constants(near).log10_delta < 0
    hit = brownian(safe=[cb.Outside(cb.Ball(lambda t: [0.2 * np.exp(-t), 1.0 - 0.5 * t], 0.2))])
    assert verify_safety(hit).status == "UNSAFE_NOMINAL"
    early = brownian(safe=[cb.Outside(cb.Ball(lambda t: [0.2 * np.exp(-t), 1.0 - 0.5 * t], 0.2), during=(0.0, 0.5))])
    assert by_constants(early).status == "SAFE"


def test_a_terminal_constraint_costs_less_than_a_permanent_one():
    whole = brownian(sigma=0.2)
    last = brownian(sigma=0.2, safe=[cb.Inside(cb.Box([-1] * 2, [1] * 2), during=(2.0, 2.0))])
    assert by_constants(last).log10_delta < by_constants(whole).log10_delta


def test_no_constraint_is_safe():
    verdict = by_constants(brownian(safe=[]))
    assert verdict.status == "SAFE"
    assert verdict.log10_delta == -1e12


def test_no_noise_is_safe_with_certainty():
    problem = brownian(sigma=0.0)
    verdict = by_constants(problem)
    consistent(verdict, problem)
    assert verdict.log10_delta == -1e12


def test_no_noise_is_safe_where_constants_hold_along_the_tube_alone():
    """The room of a tube without width is none, and was refused as a ValueError."""
    system = cb.ContinuousSystem(lambda x: [0.1 * x[0] - 0.2 * x[0] * x[1], 0.1 * x[1]], states=2)
    problem = cb.Problem(system, initial=[1, 1], safe=[cb.Inside(cb.Box([0.5] * 2, [2] * 2))], horizon=1.0)
    assert cb.verify_safety(problem, method="kummer").log10_delta == -1e12


def test_stated_constants_are_named_as_an_assumption():
    problem = brownian()
    stated = cb.Constants(rate=-1.0, sigma=0.1, dimension=2)
    verdict = by_constants(problem, constants=stated)
    assert verdict.status == "SAFE"
    assert "assumed, not proved" in verdict.reason
    assert "assumed" not in by_constants(problem).reason


@pytest.mark.parametrize("method", ["prop1", "prop2", "markov", "chebyshev"])
def test_one_time_bounds_are_never_safe(method):
    problem = brownian(sigma=0.01)
    if method in ("prop2",):
        system = cb.linear_system(0.5 * np.eye(2), noise=cb.Gaussian(std=0.01))
        problem = cb.Problem(system, initial=[0.2, 0], safe=problem.safe, horizon=4)
    verdict = by_constants(problem, method=method)
    consistent(verdict, problem)
    assert verdict.status == "UNKNOWN"
    assert "one time" in verdict.reason
    assert "fits" in verdict.reason


@pytest.mark.parametrize("method", ["kummer", "bessel", "thm3"])
def test_named_tubes_prove_with_their_own_radius(method):
    problem = brownian(sigma=0.1)
    verdict = by_constants(problem, method=method)
    consistent(verdict, problem)
    assert verdict.status == "SAFE"
    assert verdict.method == method


def test_the_paper_s_tube_needs_more_room_than_ours():
    problem = brownian(sigma=0.2)
    assert by_constants(problem, method="thm3").log10_delta > by_constants(problem).log10_delta


def test_certified_probabilities_hold_against_simulation():
    problem = brownian(sigma=0.35)
    verdict = by_constants(problem)
    assert -3 < verdict.log10_delta < -0.3
    counted = cb.simulate_exits(problem, paths=5_000, rng=np.random.default_rng(0), halve=False)
    assert counted.lower <= 10**verdict.log10_delta


def test_more_noise_time_or_start_and_a_smaller_set_never_help():
    base = by_constants(brownian(sigma=0.25)).log10_delta
    assert by_constants(brownian(sigma=0.3)).log10_delta >= base
    assert by_constants(brownian(sigma=0.25, horizon=4.0)).log10_delta >= base - 1e-6
    assert by_constants(brownian(sigma=0.25, bound=0.9)).log10_delta >= base
    assert by_constants(brownian(sigma=0.25, initial=cb.Box([0.1, -0.1], [0.3, 0.1]))).log10_delta >= base


def test_a_larger_delta_never_makes_a_verdict_worse():
    order = {"UNKNOWN": 0, "SAFE": 1}
    previous = 0
    for delta in (1e-9, 1e-6, 1e-3, 0.1):
        status = by_constants(brownian(sigma=0.3, delta=delta)).status
        assert order[status] >= previous
        previous = order[status]
    assert previous == 1


def test_cells_split_the_start():
    problem = brownian(sigma=0.05, initial=cb.Box([-0.3, -0.3], [0.3, 0.3]), rate=0.2)
    one, four = by_constants(problem), by_constants(problem, cells=2)
    assert four.log10_delta < one.log10_delta
    assert four.reach.curve.cells == 4


def test_a_random_start_enters_the_martingale():
    fixed = brownian(sigma=0.1, initial=[0.0, 0.0])
    random = brownian(sigma=0.1, initial=cb.problem.problem.GaussianStart([0.0, 0.0], 0.02**2 * np.eye(2)))
    wide = brownian(sigma=0.1, initial=cb.problem.problem.GaussianStart([0.0, 0.0], 0.2**2 * np.eye(2)))
    levels = [by_constants(problem).log10_delta for problem in (fixed, random, wide)]
    assert levels[0] < levels[1] < levels[2] < 0


def test_local_constants_answer_where_no_global_ones_exist():
    system = cb.ContinuousSystem(lambda x: [-x[0] + 0.3 * x[0] ** 2], states=1, diffusion=0.05)
    problem = cb.Problem(system, initial=cb.Box([0.4], [0.5]), safe=[cb.Inside(cb.Box([-1], [1.2]))], horizon=2.0)
    verdict = verify_safety(problem, method="constants")
    consistent(verdict, problem)
    assert verdict.status == "SAFE"
    assert verdict.constants.times is not None
    assert verdict.constants.certified
    named = verify_safety(problem, method="thm3")
    assert named.method == "thm3"
    assert named.log10_delta > verdict.log10_delta
    once = verify_safety(problem, method="markov")
    assert once.status == "UNKNOWN"
    assert "must not be combined with local constants" in once.reason


def test_a_tube_that_local_constants_cannot_carry_is_explained():
    system = cb.ContinuousSystem(lambda x: [-1.0 / x[0]], states=1, diffusion=0.01)
    problem = cb.Problem(system, initial=cb.Box([0.9], [1.1]), safe=[cb.Inside(cb.Box([-9], [9]))], horizon=0.45)
    verdict = verify_safety(problem, method="constants")
    assert verdict.status == "UNKNOWN"
    assert "could not be proved beyond t =" in verdict.reason
    assert "cells" in verdict.reason


def test_bounded_discrete_noise():
    system = cb.DiscreteSystem(lambda x: 0.7 * np.sin(x), states=2, noise=cb.Uniform(halfwidth=0.1))
    problem = cb.Problem(system, initial=[0.1, 0.0], safe=[cb.Inside(cb.Ball([0, 0], 1.0))], horizon=20, delta=1e-3)
    verdict = by_constants(problem)
    consistent(verdict, problem)
    assert verdict.status == "SAFE"


def test_twelve_states():
    n = 12
    coupling = -np.eye(n) + 0.3 * np.eye(n, k=1)
    system = cb.ContinuousSystem(lambda x: coupling @ x, states=n, diffusion=0.05 * np.eye(n))
    problem = cb.Problem(
        system, initial=np.full(n, 0.2), safe=[cb.Inside(cb.Box(-np.ones(n), np.ones(n)))], horizon=2.0
    )
    verdict = by_constants(problem)
    consistent(verdict, problem)
    assert verdict.status == "SAFE"
    assert verdict.deviation.extent.shape == (len(verdict.deviation.times) - 1, n)


def test_the_deviation_is_given_per_piece_and_state():
    verdict = by_constants(MODELS["ou"]())
    deviation = verdict.deviation
    assert len(deviation.times) == len(deviation.radius) + 1
    assert deviation.radius.max() == pytest.approx(1.3398, abs=1e-3)
    assert np.all(deviation.extent[:, 0] <= deviation.radius * (1 + 1e-9))


def test_the_engines_run_side_by_side_and_the_smallest_probability_is_kept():
    problem = brownian(sigma=0.25)
    verdict = verify_safety(problem)
    assert set(verdict.answers) == {"linear", "constants", "barrier", "values", "quadratic", "backward"}
    assert verdict.log10_delta == min(answer.log10_delta for answer in verdict.answers.values())
    assert verdict.log10_delta <= by_constants(problem).log10_delta


def test_inputs_without_a_plan_are_refused():
    system = cb.linear_system([[0.0]], [[1.0]], time="continuous", diffusion=1.0)
    problem = cb.Problem(system, initial=[0.0], safe=[], horizon=1.0)
    with pytest.raises(ValueError, match="give `plan=`"):
        verify_safety(problem)


def test_dynamics_that_are_undefined_at_the_start_are_refused():
    system = cb.ContinuousSystem(lambda x: [-np.sqrt(x[0] - 5)], states=["h"], diffusion=0.1)
    problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1)
    with pytest.raises(ValueError, match="`dynamics` must be defined at the start, got nan for h at h = 0"):
        cb.verify_safety(problem)


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="`method` must be one of auto, starts, linear, constants, backward, barrier"):
        verify_safety(brownian(), method="magic")


def test_an_unbounded_jacobian_on_the_users_domain_is_the_constants_engines_reason():
    system = cb.ContinuousSystem(lambda x: [-np.sqrt(x[0])], states=1, diffusion=0.01)
    problem = cb.Problem(system, initial=[1.0], safe=[], horizon=0.5, domain=cb.Box([0.0], [2.0]))
    verdict = verify_safety(problem, method="constants")
    assert verdict.status == "UNKNOWN"
    assert not verdict.answers["constants"].applicable
    assert "`domain` must" in verdict.reason


def test_a_verdict_is_no_boolean():
    with pytest.raises(TypeError, match="compare"):
        bool(by_constants(brownian()))


def test_a_random_start_far_wider_than_the_noise_is_answered():
    start = cb.GaussianStart([0.0], covariance=[[0.01]])
    for std in (1e-6, 1e-3, 0.1):
        system = cb.DiscreteSystem(lambda x: [0.5 * x[0]], states=1, noise=cb.Gaussian(std=std))
        safe = [cb.Inside(cb.Box([-0.5], [0.5]))]
        verdict = by_constants(cb.Problem(system, initial=start, safe=safe, horizon=2, delta=0.01))
        assert verdict.status == "SAFE"
        assert verdict.log10_delta > -6.25  # log10 of 2 Q(5), of the start alone
