"""Certificates of many kinds of problems are proved again, and speak only of their own problem."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from flint import arb

import certbound as cb
from certbound.checker import check, check_data, parse
from certbound.checker.report import Unproved
from certbound.checker.statement.comparison import first_difference
from certbound.errors import CertificateError
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.verification import verify_safety

INSIDE = [cb.Inside(cb.Box([-1, -1], [1, 1]))]


def checked(problem: cb.Problem, method: str, cells: int | None = None, **options: Any) -> Any:
    """The verdict and the checker's report on its certificate."""
    verdict = verify_safety(problem, method=method, cells=cells, **options)
    data = parse(certificate_text(problem, verdict))
    return verdict, check_data(data, json.loads(json.dumps(problem_data(problem))))


@pytest.mark.parametrize("name", ["stepping", "flowing", "contracting"])
def test_a_certificate_is_proved_again_from_the_file_alone(name: str, request: pytest.FixtureRequest) -> None:
    case = request.getfixturevalue(name)
    report = check_data(case.data)
    assert report.valid, report.reason
    assert report.log10_proved <= report.log10_delta <= 0
    assert "at most delta" in report.claim
    assert "ball arithmetic" in report.reason
    assert check_data(case.data, case.given).reason.endswith("speaks of the given problem")
    # the claim is close to what the prover found
    assert report.log10_delta <= 0.8 * case.verdict.log10_delta


def test_the_checker_and_an_exact_probability_agree() -> None:
    """x+ = 0.5 x + w from 0, two steps, |x| <= 1: P = 1 - P(|x1| <= 1, |x2| <= 1)."""
    from scipy.stats import multivariate_normal

    system = cb.DiscreteSystem(lambda x: [0.5 * x[0]], states=1, noise=cb.Gaussian(std=0.4))
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=2, delta=0.1)
    covariance = 0.16 * np.array([[1.0, 0.5], [0.5, 1.25]])
    law = multivariate_normal(mean=[0, 0], cov=covariance)
    exact = 1 - law.cdf([1, 1], lower_limit=[-1, -1])
    _, report = checked(problem, "linear")
    assert report.valid
    assert exact * (1 - 1e-6) <= 10**report.log10_proved <= 1.02 * exact


KINDS: dict[str, tuple[Any, str]] = {
    "uniform noise": (
        lambda: cb.Problem(
            cb.DiscreteSystem(lambda x: [0.8 * x[0], 0.7 * x[1]], states=2, noise=cb.Uniform(halfwidth=[0.1, 0.05])),
            initial=[0.2, 0.1], safe=INSIDE, horizon=4,
        ), "linear",
    ),
    "dependent bounded noise": (
        lambda: cb.Problem(
            cb.DiscreteSystem(
                lambda x: 0.5 * x, states=2, noise=cb.Bounded(halfwidth=[0.1, 0.1], independent=False)
            ),
            initial=[0.2, 0.1], safe=INSIDE, horizon=3,
        ), "constants",
    ),
    "sub-Gaussian noise through a matrix": (
        lambda: cb.Problem(
            cb.DiscreteSystem(
                lambda x: 0.5 * x, states=2, noise=cb.SubGaussian(proxy_variance=0.01), noise_matrix=[[1.0], [0.5]]
            ),
            initial=[0.2, 0.1], safe=INSIDE, horizon=3,
        ), "linear",
    ),
    "a normal start": (
        lambda: cb.Problem(
            cb.DiscreteSystem(
                lambda x: [0.5 * x[0] + 0.1 * np.sin(x[1]), 0.6 * x[1]], states=2,
                noise=cb.Gaussian(covariance=[[0.01, 0.002], [0.002, 0.01]]),
            ),
            initial=cb.GaussianStart([0.1, 0.1], [[0.01, 0.0], [0.0, 0.004]]), safe=INSIDE, horizon=3,
        ), "linear",
    ),
    "kinks": (
        lambda: cb.Problem(
            cb.DiscreteSystem(
                lambda x: [0.5 * np.abs(x[0]), 0.4 * np.maximum(x[1], x[0])], states=2, noise=cb.Gaussian(std=0.05)
            ),
            initial=cb.Box([-0.1, -0.1], [0.1, 0.1]), safe=INSIDE, horizon=3, delta=1e-2,
        ), "linear",
    ),
    "a plan": (
        lambda: cb.Problem(
            cb.DiscreteSystem(
                lambda x, u: [0.9 * x[0] + u[0], 0.5 * x[1] * np.cos(x[0])], states=2, inputs=cb.Box([-1], [1]),
                noise=cb.Gaussian(variance=[1e-4, 1e-4]),
            ),
            initial=[0.0, 0.1], safe=INSIDE, horizon=3, plan=[[0.1], [0.2], [-0.1]],
        ), "linear",
    ),
    "an ellipsoid, a half-space and a polytope": (
        lambda: cb.Problem(
            cb.DiscreteSystem(lambda x: [0.9 * x[0], 0.8 * x[1]], states=2, noise=cb.Gaussian(std=0.03)),
            initial=cb.Ball([0.1, 0.1], 0.05),
            safe=[
                cb.Inside(cb.Ellipsoid([0, 0], [[1.0, 0.2], [0.2, 0.8]])), cb.Outside(cb.HalfSpace([1, 1], -1)),
                cb.Outside(cb.Polytope([[1, 0], [0, 1], [-1, -1]], [1.2, 1.2, -2.0]), during=(1, 3)),
            ],
            horizon=3,
        ), "linear",
    ),
    "a round start and an ellipsoid by constants": (
        lambda: cb.Problem(
            cb.ContinuousSystem(lambda x: [-x[0] + 0.2 * x[1], -x[1]], states=2, diffusion=0.1 * np.eye(2)),
            initial=cb.Ellipsoid([0.1, 0.1], [[0.01, 0.002], [0.002, 0.01]]),
            safe=[cb.Inside(cb.Ellipsoid([0, 0], [[1.0, 0.2], [0.2, 0.8]])), cb.Outside(cb.Box([1, 1], [2, 2]))],
            horizon=1,
        ), "constants",
    ),
    "noise that depends on the state": (
        lambda: cb.Problem(
            cb.ContinuousSystem(
                lambda x: [-x[0]], states=1, diffusion=lambda t, x: np.array([[0.2 * np.cos(x[0])]])
            ),
            initial=[0.2], safe=[cb.Inside(cb.Box([-1.5], [1.5]))], horizon=1, delta=1e-2,
        ), "constants",
    ),
    "a domain": (
        lambda: cb.Problem(
            cb.DiscreteSystem(lambda x: [0.5 * x[0] - 0.1 * x[0] ** 3], states=1, noise=cb.Gaussian(std=0.05)),
            initial=[0.2], safe=[cb.Inside(cb.Box([-1], [1]))], domain=cb.Box([-2], [2]), horizon=3,
        ), "constants",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_problems_of_many_kinds_have_certificates(kind: str) -> None:
    build, method = KINDS[kind]
    verdict, report = checked(build(), method)
    assert verdict.status == "SAFE"
    assert report.valid, report.reason
    assert report.log10_delta <= 0.8 * verdict.log10_delta


def test_cells_of_the_initial_set_are_all_checked(stepping) -> None:
    verdict, report = checked(stepping.problem, "linear", cells=2)
    assert report.valid, report.reason
    data = parse(certificate_text(stepping.problem, verdict))
    assert len(data["proof"]["cells"]) == 4
    del data["proof"]["cells"][2]
    with pytest.raises(CertificateError, match="cells"):
        check_data(data)


def test_constants_prove_a_problem_without_noise_and_none_with_noise() -> None:
    def stating(size: float) -> Any:
        system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=size * np.eye(2))
        problem = cb.Problem(system, initial=[0.2, 0], safe=[cb.Inside(cb.Ball([0, 0], 1.0))], horizon=2.0, delta=1e-2)
        verdict = verify_safety(problem, method="constants")
        assert verdict.status == "SAFE"
        assert "0 % of the room" in verdict.reason or size > 0
        return parse(certificate_text(problem, verdict))

    silent, noisy = stating(0.0), stating(1e-3)
    assert check_data(silent).valid
    assert "not shown to bound the noise" in check_data({**silent, "problem": noisy["problem"]}).reason


def test_stated_constants_are_named_as_an_assumption() -> None:
    system = cb.DiscreteSystem(lambda x: [0.5 * x[0]], states=1, noise=cb.Gaussian(std=0.1))
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3)
    stated = cb.Constants(gain=0.5, sigma=0.1, dimension=1)
    _, report = checked(problem, "constants", constants=stated)
    assert report.outcome == "valid under assumptions"
    assert not report.valid
    assert "assuming that the stated constants" in report.claim


def test_a_bound_above_delta_says_so() -> None:
    system = cb.DiscreteSystem(lambda x: [0.5 * x[0]], states=1, noise=cb.Gaussian(std=0.4))
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3, delta=1e-6)
    verdict, report = checked(problem, "constants")
    assert verdict.status == "UNKNOWN"
    assert report.valid
    assert "more than delta" in report.claim


def test_a_certificate_speaks_of_one_problem_only(stepping, contracting) -> None:
    report = check_data(stepping.data, contracting.given)
    assert not report.valid
    assert "another problem" in report.reason
    renamed = {**stepping.given, "name": "something else"}
    assert check_data(stepping.data, renamed).valid


@pytest.mark.parametrize("name", ["name", "label", "units", "nodes"])
def test_what_is_drawn_is_compared_whatever_it_is_called(name: str) -> None:
    system = cb.DiscreteSystem(
        lambda x, d: 0.5 * x + d, states=["x"], disturbance=cb.Box([-9], [9]), disturbance_names=[name],
        noise=cb.Gaussian(std=0.1),
    )
    laws = [{name: cb.Random(law=cb.Gaussian(std=std))} for std in (0.1, 2.0)]
    data = [problem_data(cb.Problem(system, initial=[0], safe=[], horizon=2, random=law)) for law in laws]
    assert first_difference(data[0], data[0]) == ""
    assert first_difference(*data) == f"random.{name}.value differs"


def test_the_unit_of_time_which_a_claim_names_is_compared(stepping) -> None:
    given = stepping.given
    assert first_difference(given | {"units": {"time": "years"}}, given) == "units.time differs"
    assert first_difference(given, given | {"units": {"time": "years"}}) == "units.time differs"
    assert first_difference(given | {"units": {"x1": "m"}}, given) == ""


def test_the_order_of_operations_does_not_count() -> None:
    first = cb.DiscreteSystem(lambda x: [0.5 * x[0] + np.sin(x[1]), x[1]], states=2, noise=cb.Gaussian(std=0.1))

    def turned(x: Any) -> Any:
        later = np.sin(x[1])
        return [0.5 * x[0] + later, x[1]]

    second = cb.DiscreteSystem(turned, states=2, noise=cb.Gaussian(std=0.1))
    data = [problem_data(cb.Problem(s, initial=[0, 0], safe=INSIDE, horizon=2)) for s in (first, second)]
    assert first_difference(*data) == ""
    other = cb.DiscreteSystem(lambda x: [0.5 * x[0] + np.cos(x[1]), x[1]], states=2, noise=cb.Gaussian(std=0.1))
    changed = problem_data(cb.Problem(other, initial=[0, 0], safe=INSIDE, horizon=2))
    assert "another function" in first_difference(data[0], changed)


def test_a_check_ends_within_its_time_limit(flowing) -> None:
    report = check_data(flowing.data, seconds=0.0)
    assert not report.valid
    assert "limit" in report.reason


def test_a_jump_inside_the_tube_is_not_proved_over(stepping) -> None:
    """The dynamics of a valid certificate replaced by one that jumps where the tube is."""
    data = stepping.data
    tape = data["problem"]["dynamics"]
    tape["nodes"].append(["sign", tape["nodes"].index(["input", 1])])
    tape["nodes"].append(["if_else_zero", len(tape["nodes"]) - 1, tape["outputs"][0]])
    tape["outputs"][0] = len(tape["nodes"]) - 1
    report = check_data(data)
    assert not report.valid


def test_proved_levels_are_rounded_up(contracting) -> None:
    report = check_data(contracting.data)
    assert math.isfinite(report.log10_proved)
    data = contracting.data
    data["claim"]["log10_delta"] = float(report.log10_proved).hex()
    assert check_data(data).valid
    data["claim"]["log10_delta"] = (report.log10_proved * (1 + 1e-9)).hex()
    refused = check_data(data)
    assert not refused.valid
    assert "more than the claimed" in refused.reason


@pytest.mark.parametrize(
    ("proved", "level", "words"),
    [
        (arb(1) + arb(0, 1e-9), 0.0, r"no bound below 1, which is more than the claimed 10\^0$"),
        (arb(1) - arb(1e-9), -1e-3, r"10\^-4\.34294e-10, which is more than the claimed 10\^-0\.001$"),
        (arb("1e-3") * (1 + arb(1e-9)), -3.0, r"10\^-2\.99999, which is more than the claimed 10\^-3$"),
        (arb("1e-2"), -3.0, r"10\^-(2|1\.99999), which is more than the claimed 10\^-3$"),
    ],
)
def test_a_refusal_shows_by_how_much_a_claim_is_too_strong(proved: arb, level: float, words: str) -> None:
    with pytest.raises(Unproved, match=words):
        check._compare(proved, level)


def test_an_angle_that_is_constant_varies_for_nobody() -> None:
    system = cb.ContinuousSystem(
        lambda x: [0.1 * np.arctan2(x[0], x[0]) - x[0], np.sin(x[0]) - x[1]], states=2, diffusion=0.05 * np.eye(2)
    )
    safe = [cb.Inside(cb.Box([0.1, -1.0], [1.0, 1.0]))]
    _, report = checked(cb.Problem(system, initial=[0.5, 0.0], safe=safe, horizon=0.5), "linear")
    assert report.valid, report.reason


def test_a_nominal_curve_may_cross_a_kink_in_time() -> None:
    """No hundred pieces end where min(t, 0.4999) bends: the dynamics has no series there; more is still refused."""
    slow = cb.ContinuousSystem(
        lambda t, x: [-0.5 * x[0] - 0.05 * np.minimum(t / 0.437, 0.4999)], states=1, diffusion=[[0.05]]
    )
    safe = [cb.Inside(cb.Box([-1.0], [1.0]))]
    problem = cb.Problem(slow, initial=[0.2], safe=safe, horizon=0.437, delta=1e-2)
    data = parse(certificate_text(problem, cb.verify_safety(problem, method="kummer")))
    assert data["claim"]["method"] == "constants"
    assert check_data(data, problem_data(problem)).valid
    nodes = data["problem"]["dynamics"]["nodes"]
    bent = next(i for i, node in enumerate(nodes) if node[0] == "const" and float.fromhex(node[1]) == 0.4999)
    nodes[bent][1] = (0.6).hex()
    report = check_data(data)
    assert not report.valid
    assert "defect" in report.reason
