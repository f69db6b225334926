"""Certified constants: closed forms, soundness on samples, refusals, constants along a tube."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import certbound as cb
from certbound.constants.bounds import bound_constants, constants_along
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model.derivative import jacobian
from certbound.problem.model.evaluation import compile_numpy
from certbound.rigor.intervals import Interval


def oscillator(x):
    return [x[1], -x[0] - x[1] - 0.5 * x[0] ** 3]


def test_linear_systems_get_the_exact_measure_and_norm():
    rng = np.random.default_rng(0)
    for n in (1, 2, 5, 12):
        a = rng.normal(size=(n, n))
        c = bound_constants(cb.linear_system(a, diffusion=0.1 * np.eye(n)), metric="euclidean")
        gain = bound_constants(cb.linear_system(a, noise=cb.Gaussian(std=0.1)), metric="euclidean")
        assert 0 <= c.rate - np.linalg.eigvalsh((a + a.T) / 2)[-1] < 1e-12
        assert 0 <= gain.gain - np.linalg.norm(a, 2) < 1e-12
        assert (c.gain, gain.rate) == (None, None)
        assert c.certified
        assert c.proof.domain == "all of R^n"
        assert abs(c.gap) < 1e-12


def test_a_weighted_norm_gives_the_constants_of_the_transformed_system():
    a, p = np.array([[0.0, 1.0], [-1.0, -1.0]]), np.array([[1.5, 0.5], [0.5, 1.0]])
    root = np.linalg.cholesky(p).T
    inside = root @ a @ np.linalg.inv(root)
    k = bound_constants(cb.linear_system(a, diffusion=[[0], [0.5]]), metric=p)
    assert 0 <= k.rate - np.linalg.eigvalsh((inside + inside.T) / 2)[-1] < 1e-12
    assert np.array_equal(k.metric, p)
    assert k.rate < -0.27


def test_saturations_are_bounded_on_the_whole_space():
    k = bound_constants(cb.ContinuousSystem(lambda x: [-x[0] + 2 * np.tanh(x[0])], states=1), metric="euclidean")
    assert 1.0 <= k.rate < 1 + 1e-9
    damped = cb.ContinuousSystem(lambda x: [-x[0] - x[0] ** 3], states=1)
    assert -1.0 <= bound_constants(damped, metric="euclidean").rate < -1 + 1e-12


def test_angles_need_no_domain():
    dubins = cb.ContinuousSystem(lambda x: [np.cos(x[2]), np.sin(x[2]), -0.5 * x[2]], states=3)
    k = bound_constants(dubins, metric="euclidean")
    exact = (-0.5 + np.sqrt(0.25 + 1)) / 2
    assert exact <= k.rate < exact + 0.01


def test_affine_inputs_do_not_matter_and_others_range_over_their_box():
    affine = cb.ContinuousSystem(lambda x, u: [-x[0] + u[0]], states=1, inputs=cb.Box([-np.inf], [np.inf]))
    assert abs(bound_constants(affine, metric="euclidean").rate + 1) < 1e-12
    bilinear = cb.ContinuousSystem(lambda x, u: [-x[0] + u[0] * x[0]], states=1, inputs=cb.Box([-1], [3]))
    assert abs(bound_constants(bilinear, metric="euclidean").rate - 2) < 1e-12


def test_disturbances_times_plans_and_domains_of_a_problem_count():
    system = cb.ContinuousSystem(
        lambda t, x, u, d: [(d[0] - 2) * x[0] + 0.1 * t * x[0] + u[0] * x[0]],
        states=["q"],
        inputs=cb.Box([-9], [9]),
        disturbance=cb.Box([-1], [1]),
    )
    base = {"initial": [0.0], "safe": [cb.Inside(cb.Box([-1], [1]))], "horizon": 2.0}
    planned = cb.Problem(system, **base, plan=np.array([[0.25], [0.5]]))
    k = bound_constants(planned, metric="euclidean")
    assert abs(k.rate - (-1 + 0.2 + 0.5)) < 1e-9
    feedback = cb.Problem(system, **base, plan=lambda x: [-3 * x[0]], domain=cb.Box([-1], [1]))
    k = bound_constants(feedback, metric="euclidean")
    assert abs(k.rate - (-0.8 + 6)) < 0.05
    assert k.proof.domain == "q in [-1, 1]"


MODELS = {
    "oscillator": (oscillator, 2, cb.Box([-1.5, -1.5], [1.5, 1.5])),
    "pendulum": (lambda x: [x[1], -9.81 * np.sin(x[0]) - 0.5 * x[1]], 2, None),
    "kinks": (lambda x: [-x[0] + abs(x[1]), np.maximum(x[0], 0.0) - 2 * x[1]], 2, None),
    "lorenz": (
        lambda x: [10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]],
        3,
        cb.Box([-20, -30, 0], [20, 30, 50]),
    ),
}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_no_sampled_jacobian_exceeds_the_certified_constants_and_the_gap_is_small(name, discrete, weighted):
    f, n, domain = MODELS[name]
    rng = np.random.default_rng(5)
    root = np.eye(n) + (0.3 * rng.normal(size=(n, n)) if weighted else 0)
    p = root.T @ root
    p = (p + p.T) / 2
    if discrete:
        system = cb.DiscreteSystem(lambda x: x + 0.1 * np.array(f(x)), states=n)
    else:
        system = cb.ContinuousSystem(f, states=n)
    k = bound_constants(system, domain, metric=p if weighted else "euclidean")
    low, high = (domain.low, domain.high) if domain else (np.full(n, -7.0), np.full(n, 7.0))
    x = rng.uniform(low, high, (20_000, n))
    x = np.where(rng.uniform(size=x.shape) < 0.3, np.where(rng.uniform(size=x.shape) < 0.5, low, high), x)
    j = compile_numpy(jacobian(system.dynamics, range(1, n + 1)))(0.0, *x.T)
    inside = root @ np.broadcast_to(j, (len(x), n, n)) @ np.linalg.inv(root)
    norms = np.linalg.norm(inside, 2, axis=(1, 2))
    values = norms if discrete else np.linalg.eigvalsh((inside + np.swapaxes(inside, 1, 2)) / 2)[:, -1]
    bound = k.gain if discrete else k.rate
    assert values.max() <= bound
    assert k.gap <= 0.01 * max(1.0, norms.max())
    assert bound - values.max() <= 0.05 * max(1.0, norms.max())


@given(st.floats(-2, 0), st.floats(0.1, 2), st.floats(0.2, 1))
@settings(max_examples=15, deadline=None, derandomize=True)
def test_a_smaller_domain_is_never_worse(low, width, share):
    system = cb.ContinuousSystem(oscillator, states=2)
    outer = cb.Box([low, -1.0], [low + width, 1.0])
    inner = cb.Box([low, -1.0], [low + share * width, 1.0])
    large, small = (bound_constants(system, box, metric="euclidean") for box in (outer, inner))
    assert small.rate <= large.rate + 0.05
    assert small.proof.sampled <= large.rate


def test_a_proposed_metric_is_kept_only_where_it_is_certified_to_be_better():
    pendulum = cb.ContinuousSystem(MODELS["pendulum"][0], states=2, diffusion=[[0], [0.05]])
    euclidean, best = (bound_constants(pendulum, metric=m) for m in ("euclidean", "auto"))
    assert best.rate < 0.7 * euclidean.rate
    again = bound_constants(pendulum, metric=best.metric)
    assert abs(again.rate - best.rate) < 0.02
    skew = bound_constants(cb.linear_system([[-1.0, 2.0], [-2.0, -1.0]], diffusion=np.eye(2)))
    assert skew.metric is None
    with pytest.raises(ValueError, match="horizon"):
        bound_constants(pendulum, objective="erosion")


def test_python_control_systems_are_accepted():
    control = pytest.importorskip("control")
    a = np.array([[0.0, 1.0], [-1.0, -1.0]])
    plant = control.ss(a, [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
    assert abs(bound_constants(plant, metric="euclidean").rate) < 1e-12
    sampled = control.c2d(plant, 0.1)
    assert abs(bound_constants(sampled, metric="euclidean").gain - np.linalg.norm(sampled.A, 2)) < 1e-12


def test_a_gain_of_zero_is_replaced_by_a_small_positive_one():
    k = bound_constants(cb.DiscreteSystem(lambda x: [0.0 * x[0]], states=1), metric="euclidean")
    assert 0 < k.gain <= 1e-12


def test_unbounded_jacobians_are_refused_with_entry_and_cure():
    cubic = cb.ContinuousSystem(lambda x: [x[0] ** 3, -x[1]], states=["q", "r"])
    with pytest.raises(InfeasibleError, match=r"all of R\^n: entry d f_q / d q = .*give `domain=cb.Box"):
        bound_constants(cubic, metric="euclidean")
    with pytest.raises(EnclosureError, match=r"`domain` must keep the Jacobian bounded, but entry d f_q / d q"):
        bound_constants(cubic, cb.Box([0, 0], [np.inf, 1]), metric="euclidean")


@pytest.mark.parametrize(
    ("f", "expression"),
    [
        (lambda x: [1 / x[0]], r"\(1 / q\)"),
        (lambda x: [np.log(x[0])], r"log\(q\)|1 / q"),
        (lambda x: [np.sqrt(x[0])], r"sqrt\(q\).* q in \[-"),
        (lambda x: [np.sign(x[0])], r"sign\(q\)"),
        (lambda x: [np.where(x[0] > 0.3, 1.0, 0.0)], r"q"),
    ],
)
def test_undefined_and_jumping_models_are_refused_by_name(f, expression):
    system = cb.ContinuousSystem(f, states=["q"])
    with pytest.raises(EnclosureError, match=expression):
        bound_constants(system, cb.Box([-1], [1]), metric="euclidean")
    with pytest.raises(InfeasibleError, match=expression):
        bound_constants(system, metric="euclidean")
    assert bound_constants(system, cb.Box([0.5], [1]), metric="euclidean").certified


def test_kinks_are_bounded_by_the_generalised_jacobian_and_said():
    bent = cb.ContinuousSystem(lambda x: [-x[0] + 0.5 * np.abs(x[0]), np.maximum(x[0], -x[1])], states=2)
    k = bound_constants(bent, metric="euclidean")
    jacobians = np.array([[[-1 + a / 2, 0], [b, b - 1]] for a in (-1, 1) for b in (0, 1)])  # at the kink: their hull
    truth = np.linalg.eigvalsh(jacobians + jacobians.transpose(0, 2, 1)).max() / 2
    assert truth <= k.rate <= truth + 0.01
    assert "generalised Jacobian at the kinks" in k.proof.status
    along = constants_along(bent, [0.0, 1.0], Interval([[-1.0, -1.0]], [[1.0, 1.0]]))
    assert along.rate[0] >= truth
    assert "generalised Jacobian at the kinks" in along.proof.status
    smooth = bound_constants(cb.ContinuousSystem(lambda x: [-x[0]], states=1), metric="euclidean")
    assert "generalised" not in smooth.proof.status


def test_huge_slopes_raise_no_warning_and_stay_sound():
    steep = cb.ContinuousSystem(lambda x: [np.exp(x[0]) * np.sin(x[1]), -x[1]], states=2)
    k = bound_constants(steep, cb.Box([600, 0], [700, 6]), metric="euclidean", budget=200)
    assert np.exp(699.9) * 0.99 <= k.rate < np.inf


def test_an_empty_domain_is_refused():
    with pytest.raises(ValueError, match="low"):
        bound_constants(cb.linear_system(-np.eye(1)), cb.Box([1.0], [0.0]))


def test_constants_along_a_tube_follow_the_pieces():
    system = cb.ContinuousSystem(
        lambda t, x: [-(x[0] ** 3) - t * x[0], -x[1]], states=2, diffusion=lambda x: [[0.1 * x[0], 0], [0, 0.05]]
    )
    boxes = Interval([[1.0, 0.0], [2.0, 0.0]], [[2.0, 1.0], [3.0, 1.0]])
    k = constants_along(system, [0.0, 1.0, 2.0], boxes)
    assert k.certified
    assert k.times.tolist() == [0.0, 1.0, 2.0]
    assert np.all(k.rate >= [-1.0, -1.0])
    assert np.all(k.sigma >= [0.2, 0.3])
    assert np.all(k.sigma < [0.2 + 1e-9, 0.3 + 1e-9])
    levels = [0.04 + 0.0025, 0.09 + 0.0025]
    assert np.all(k.nu * np.asarray(k.sigma) ** 2 >= np.array(levels) * (1 - 1e-12))
    weighted = constants_along(system, [0.0, 1.0, 2.0], boxes, metric=[[2.0, 0.0], [0.0, 1.0]], refine=8)
    assert np.all(weighted.rate <= -1 + 1e-9)


def test_constants_along_a_tube_in_discrete_time_use_the_plan_of_each_step():
    system = cb.DiscreteSystem(
        lambda x, u: [u[0] * x[0]], states=1, inputs=cb.Box([-1], [1]), noise=cb.Gaussian(std=0.1)
    )
    problem = cb.Problem(
        system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3, plan=[[0.2], [0.4], [0.8]]
    )
    k = constants_along(problem, [0, 1, 2, 3], Interval(-np.ones((3, 1)), np.ones((3, 1))))
    assert np.allclose(k.gain, [0.2, 0.4, 0.8], atol=1e-12)
    assert np.all(k.gain >= [0.2, 0.4, 0.8])


def test_refining_pieces_is_never_worse():
    system = cb.ContinuousSystem(oscillator, states=2)
    boxes = Interval([[-1.0, -1.0]], [[1.0, 1.0]])
    coarse, fine = (constants_along(system, [0.0, 1.0], boxes, refine=r).rate[0] for r in (1, 64))
    assert fine <= coarse
    assert fine >= bound_constants(system, cb.Box([-1, -1], [1, 1]), metric="euclidean").proof.sampled - 1e-12


def test_pieces_on_which_the_model_is_undefined_are_refused():
    system = cb.ContinuousSystem(lambda x: [1 / x[0]], states=["q"])
    with pytest.raises(EnclosureError, match=r"\(1 / q\)"):
        constants_along(system, [0.0, 1.0, 2.0], Interval([[1.0], [-1.0]], [[2.0], [1.0]]))
    cubic = cb.ContinuousSystem(lambda x: [x[0] ** 3], states=["q"])
    with pytest.raises(EnclosureError, match="on piece 0, entry d f_q / d q"):
        constants_along(cubic, [0.0, 1.0], Interval([[0.0]], [[np.inf]]))
    with pytest.raises(ValueError, match="one row of 1 intervals"):
        constants_along(cubic, [0.0, 1.0], Interval(np.zeros((2, 1)), np.ones((2, 1))))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"metric": "frobenius"}, ValueError, '`metric` must be "auto"'),
        ({"metric": [[1.0, 2.0], [2.0, 1.0]]}, ValueError, "positive definite"),
        ({"objective": "size"}, ValueError, "`objective` must be"),
        ({"horizon": 0.0}, ValueError, "`horizon` must be positive"),
        ({"domain": cb.Box([0.0], [1.0])}, ValueError, "`domain` must have 2 sides"),
        ({"domain": [0.0, 1.0]}, TypeError, "`domain` must be a fixed cb.Box"),
    ],
)
def test_malformed_arguments_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        bound_constants(cb.linear_system(-np.eye(2)), **options)


@pytest.mark.parametrize(
    "change", [{"rate": 0.99}, {"sigma": 0.99}, {"metric": 1.01}, {"effective_dimension": 0.99}, {"sigma": 1.0}]
)
def test_constants_that_were_altered_after_their_proof_are_no_longer_certified(change: dict[str, float]) -> None:
    problem = cb.load("pendulum")
    proved = cb.bound_constants(problem, metric=np.array([[9.81, 0.5], [0.5, 1.0]]))
    assert proved.certified
    altered = {name: getattr(proved, name) * factor for name, factor in change.items()}
    assert replace(proved, **altered).certified == (change == {"sigma": 1.0})


def test_samples_whose_measure_would_overflow_are_left_out() -> None:
    """A stirred reactor: slopes were finite, their symmetric part was not, and the search ended with LAPACK's error."""

    def flow(x: object) -> list[object]:
        reaction = 0.072 * (1 - x[0]) * np.exp(x[1] / (1 + x[1] / 20))  # type: ignore[index]
        return [-x[0] + reaction, -3.3 * x[1] + 8 * reaction - x[2], 0.5 * (x[1] - 2.5)]  # type: ignore[index]

    system = cb.ContinuousSystem(flow, states=3, diffusion=0.01 * np.eye(3))
    with pytest.raises(InfeasibleError):
        bound_constants(system)
