"""Certificates of the exact law from the problem to the checker's answer, and files that were changed on the way."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.checker import Report, check_data, parse
from certbound.errors import CertificateError
from certbound.reach.affine import affine_answer
from certbound.safety.answers import exact
from certbound.safety.certificate import problem_data
from certbound.safety.certificates import law_proof
from tests.checker.affine.models import correlated, oscillator, two_areas

Data = dict[str, Any]


def written(problem: cb.Problem, attempt: int = 0) -> Data:
    """A certificate that claims what its writer expects of the checker."""
    proof, log10, assumptions = law_proof(problem, attempt)
    claim = {"log10_delta": exact(log10), "method": "affine", "assumptions": assumptions}
    head = {"format": "certbound certificate", "version": 1, "claim": claim}
    return parse(json.dumps({**head, "problem": problem_data(problem), "proof": proof}))


def report_of(data: Data, problem: cb.Problem) -> Report:
    return check_data(data, json.loads(json.dumps(problem_data(problem))))


@pytest.mark.parametrize("horizon", [20.0, 120.0])
def test_two_power_areas_are_certified_within_a_third_of_what_is_proved_of_them(horizon: float) -> None:
    answer = affine_answer(two_areas(horizon, 0.05))
    assert answer is not None
    problem = two_areas(horizon, 1.3 * 10**answer.log10_delta)
    report = report_of(written(problem), problem)
    assert report.valid, report.reason
    assert "at most delta" in report.claim
    assert "the exact law of a linear model" in report.reason


@pytest.mark.parametrize("attempt", [0, 1, 2])
def test_at_every_attempt_the_writer_claims_what_is_proved(attempt: int) -> None:
    for problem in (oscillator(), correlated()):
        report = report_of(written(problem, attempt), problem)
        assert report.valid, report.reason
        assert report.log10_proved is not None
        assert report.log10_proved > report.log10_delta - 0.01


def test_twenty_states_with_forty_limits_are_certified() -> None:
    generator = np.random.default_rng(1)
    a = generator.normal(size=(20, 20)) / np.sqrt(20)
    a -= (np.linalg.eigvals(a).real.max() + 0.3) * np.eye(20)
    noise = np.zeros((20, 10))
    noise[10:] = 0.1 * np.eye(10)
    system = cb.ContinuousSystem(lambda x: a @ x, states=20, diffusion=noise)
    safe = [cb.Inside(cb.Box([-0.6] * 20, [0.6] * 20))]
    problem = cb.Problem(system, initial=[0.0] * 20, safe=safe, horizon=10.0, delta=0.01)
    data = written(problem)
    report = report_of(data, problem)
    assert report.log10_proved is not None
    assert report.log10_proved < -2
    assert len(json.dumps(data["proof"])) < 100_000


def windows(data: Data) -> Data:
    """What a limit of a row with noise of its own states."""
    found: Data = data["proof"]["limits"][0]
    return found


def set_in(*path: Any, value: Any) -> Callable[[Data], None]:
    """A change of one entry."""

    def change(data: Data) -> None:
        place: Any = data
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value

    return change


MALFORMED = {
    "a level below 0": set_in("proof", "grids", 0, 0, value=-1),
    "a level of a billion": set_in("proof", "grids", 0, 0, value=10**9),
    "a level that is a text": set_in("proof", "grids", 0, 0, value="0x1.0p+0"),
    "a level that is true": set_in("proof", "grids", 0, 0, value=True),
    "no pieces": set_in("proof", "grids", 0, value=[]),
    "no grids": set_in("proof", "grids", value=[]),
    "a grid that is a number": set_in("proof", "grids", 0, value=3),
    "no windows": set_in("proof", "limits", 0, "windows", 0, value=0),
    "windows below 0": set_in("proof", "limits", 0, "windows", 0, value=-5),
    "too many windows": set_in("proof", "limits", 0, "windows", 0, value=10**9 + 1),
    "another grid than there is": set_in("proof", "limits", 0, "grid", value=7),
    "a limit that is null": set_in("proof", "limits", 0, value=None),
    "a limit with more": set_in("proof", "limits", 0, "level", value="0x1.0p+0"),
    "no bits": set_in("proof", "bits", value=0),
    "a million bits": set_in("proof", "bits", value=10**6),
    "an unknown entry": set_in("proof", "bound", value="0x0.0p+0"),
    "another method": set_in("claim", "method", value="linear"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_what_is_malformed_is_refused_in_words(name: str) -> None:
    data = written(correlated())
    MALFORMED[name](data)
    with pytest.raises(CertificateError, match="`"):
        check_data(data)


DRAWN = cb.GaussianStart([0.0, 0.0], [[0.05, 0.01], [0.01, 0.02]])


@pytest.mark.parametrize("value", [[["nan"] * 2] * 2, [["0x1.0p+2000"] * 2] * 2, [[]], [[], []], [["0x0.0p+0"]], 3])
def test_a_split_of_no_numbers_is_refused(value: Any) -> None:
    data = written(correlated(initial=DRAWN))
    data["proof"]["loss"] = value
    with pytest.raises(CertificateError, match=r"proof\.loss"):
        check_data(data)


def test_a_split_of_huge_numbers_proves_nothing() -> None:
    data = written(correlated(initial=DRAWN))
    data["proof"]["loss"] = exact((np.eye(2) * 1.7e308).tolist())
    assert not check_data(data).valid


def test_a_certificate_of_another_problem_or_of_more_than_is_proved_is_not_proved() -> None:
    data, problem = written(correlated()), correlated()
    assert report_of(data, problem).valid
    for other in (correlated(horizon=19.0), correlated(bounds=[1.1, 1.2]), oscillator()):
        assert "speaks of another problem" in report_of(data, other).reason
    bold = copy.deepcopy(data)
    bold["claim"]["log10_delta"] = exact(float.fromhex(data["claim"]["log10_delta"]) - 0.1)
    report = report_of(bold, problem)
    assert not report.valid
    assert "more than the claimed" in report.reason


def test_an_infinite_horizon_is_refused() -> None:
    data = written(oscillator())
    data["problem"]["horizon"] = None
    report = check_data(data)
    assert not report.valid
    assert "finite horizon" in report.reason


def test_disturbances_may_see_the_noise_to_come() -> None:
    problem = oscillator(gain=[[0.0], [0.05]], bounds=[1.8, float("inf")])
    report = report_of(written(problem), problem)
    assert "even one that sees coming noise" in report.claim
