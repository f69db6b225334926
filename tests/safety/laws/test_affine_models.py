"""The linear engine asks the exact law first."""

import json

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.errors import CertificateError
from certbound.gaussian.affine import lagged, upper
from certbound.reach.affine import affine_answer
from certbound.safety.certificate import certificate_text, problem_data


def areas(horizon, load=0.012, delta=0.05):
    """A stiff servo behind a slow load: rates from 1/300 to 100."""
    slope = np.array([[-0.05, 6, -6, 0.0], [-0.8, -2, 0, 2.0], [0, 0, -1 / 300, 0], [-20, 0, 0, -100.0]])
    noise = np.zeros((4, 1))
    noise[2] = load * np.sqrt(2 / 300)
    system = cb.ContinuousSystem(lambda x: slope @ x, states=4, diffusion=noise)
    safe = [cb.Inside(cb.Box([-0.08, *[-np.inf] * 3], [0.08, *[np.inf] * 3]))]
    return cb.Problem(system, initial=np.zeros(4), safe=safe, horizon=horizon, delta=delta)


def test_a_long_horizon_is_decided_near_the_truth():
    verdict = cb.verify_safety(areas(3000.0), time_limit=30)
    assert verdict.status == "SAFE"
    assert "exact law" in verdict.reason


def test_what_fails_more_often_than_is_asked_is_unsafe():
    safe = cb.verify_safety(areas(3000.0), time_limit=30)
    least = 10**safe.log10_lower
    assert cb.verify_safety(areas(3000.0, delta=least / 2), time_limit=30).status == "UNSAFE"


def test_a_certificate_states_the_law_where_the_linear_response_proves_too_little():
    problem = areas(3000.0)
    verdict = cb.verify_safety(problem, method="linear")
    text = certificate_text(problem, verdict)
    report = check_data(parse(text), problem_data(problem))
    assert report.valid, report.reason
    assert json.loads(text)["claim"]["method"] == "affine"
    assert "even one that sees" not in report.claim  # there is no disturbance
    assert report.log10_proved <= verdict.log10_delta + np.log10(1.5)  # whose crossings come in clumps


def test_where_the_linear_response_serves_delta_its_own_proof_is_written():
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=[[0.2]])
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1.0], [1.0]))], horizon=2.0, delta=0.05)
    verdict = cb.verify_safety(problem, method="linear")
    assert json.loads(certificate_text(problem, verdict))["claim"]["method"] == "linear"


def test_where_neither_serves_it_is_said_why():
    problem = areas(3000.0, load=0.05)
    verdict = cb.verify_safety(problem, method="linear")
    with pytest.raises(CertificateError, match=r"too likely|no probability was bounded"):
        certificate_text(problem, verdict)


@pytest.mark.parametrize("rounds", [1, 3])
def test_where_looks_at_pieces_run_out_every_piece_has_its_costs(rounds, monkeypatch):
    for module in (lagged, upper):
        monkeypatch.setattr(module, "_ROUNDS", rounds)
    assert affine_answer(areas(3000.0)).log10_delta <= 0


def test_a_stationary_start_has_an_exact_law():
    start = cb.GaussianStart([0.0, 0.0], [[0.05, 0.0], [0.0, 0.05]])
    system = cb.ContinuousSystem(lambda x: [x[1], -x[0] - 0.4 * x[1]], states=2, diffusion=[[0.0], [0.2]])
    safe = [cb.Inside(cb.Box([-1.5, -np.inf], [1.5, np.inf]))]
    answer = affine_answer(cb.Problem(system, initial=start, safe=safe, horizon=30.0, delta=0.1))
    crossings = 2 * 30.0 / (2 * np.pi) * np.exp(-(1.5**2) / 0.1)  # by Rice's formula
    assert 0.9 * crossings <= 10**answer.log10_delta <= 1.1 * crossings
