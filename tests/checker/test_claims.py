"""What a report says: whose disturbances, which assumptions, numbers rounded to the safe side, and a name in quotes."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import certbound as cb
from certbound.checker import Report, check_data, parse
from certbound.checker.words import plainly, quoted, rounded
from certbound.cli.app import run
from certbound.cli.commands.check import proved_certificate
from certbound.errors import CertificateError
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.verification import verify_safety
from tests.checker.conftest import Case

Data = dict[str, Any]
SIDE = [cb.Inside(cb.Box([-1], [1]))]
BLIND = "for every disturbance in its set that does not see coming noise"
ANY = "for every disturbance in its set, even one that sees coming noise"


def stated(metric: Any = None, sigma: float = 0.1) -> Data:
    """A certificate that rests on stated constants, of a system with constant noise."""
    system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=0.1 * np.eye(2))
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=2.0, delta=1e-2)
    constants = cb.Constants(rate=-0.9, sigma=sigma, dimension=2, metric=metric)
    return parse(certificate_text(problem, verify_safety(problem, method="constants", constants=constants)))


def with_level(data: Data, level: float) -> Report:
    data["claim"]["log10_delta"] = level.hex()
    return check_data(data)


# ---- disturbances ------------------------------------------------------------------------------------------------


def test_the_claim_names_the_disturbances_that_its_engine_covers(stepping: Case, contracting: Case) -> None:
    additive, constants = check_data(stepping.data), check_data(contracting.data)
    assert ANY in additive.claim
    assert BLIND in constants.claim
    for report in (additive, constants):
        assert report.valid
        assert (report.outcome, report.assumptions) == ("valid", ())
        assert "assum" not in report.claim


@pytest.mark.parametrize("name", ["flowing", "springing"])
def test_without_a_disturbance_there_is_nothing_to_name(name: str, request: pytest.FixtureRequest) -> None:
    assert "disturbance" not in check_data(request.getfixturevalue(name).data).claim


def test_a_bound_for_disturbances_that_react_says_nothing_from_below_of_a_constant(valuing_below: Case) -> None:
    fixed = valuing_below.problem.replace(unknown=valuing_below.problem.system.disturbance_names)
    report = check_data(parse(valuing_below.text), json.loads(json.dumps(problem_data(fixed))))
    assert not report.valid
    assert "unknown differs" in report.reason
    data = parse(valuing_below.text)
    data["problem"]["unknown"] = ["something else"]
    with pytest.raises(CertificateError, match="names of disturbances"):
        check_data(data)


def test_a_barrier_and_noise_that_depends_on_the_state_need_a_disturbance_without_foresight() -> None:
    cases = {
        "barrier": ([[0.3]], "barrier"),
        "state": (lambda t, x: [[0.1 * (1 + 0.02 * np.sin(x[0]))]], "linear"),
    }
    for diffusion, method in cases.values():
        system = cb.ContinuousSystem(
            lambda x, d: [-x[0] - x[0] ** 3 + 0.01 * d[0]], states=["x"], disturbance=cb.Box([-1], [1]),
            diffusion=diffusion,
        )  # fmt: skip
        problem = cb.Problem(system, initial=[0.1], safe=SIDE, horizon=0.5, delta=5e-2)
        verdict = verify_safety(problem, method=method)
        assert "every disturbance in its set that does not see coming noise" in verdict.reason
        assert BLIND in check_data(parse(certificate_text(problem, verdict))).claim


# ---- assumptions -------------------------------------------------------------------------------------------------


def test_stated_constants_are_printed_and_make_a_third_outcome() -> None:
    data = stated()
    report = check_data(data)
    assert (report.outcome, report.valid, report.proved) == ("valid under assumptions", False, True)
    words = "rate -0.9 1/s, noise level sigma 0.1, effective dimension 2, in the Euclidean norm"
    assert len(report.assumptions) == 1
    assert words in report.assumptions[0]
    assert report.assumptions[0] in report.claim
    assert "but what the claim assumes" in report.reason
    allowed = check_data(data, allow_assumptions=True)
    assert (allowed.outcome, allowed.valid) == ("valid under assumptions", True)


def test_a_file_cannot_hide_what_its_proof_assumes() -> None:
    data = stated()
    assert data["claim"]["assumptions"] == ["the stated constants hold"]
    data["claim"]["assumptions"] = []
    report = check_data(data)
    assert report.outcome == "valid under assumptions"
    assert "rate -0.9 1/s" in report.claim


def test_what_a_file_adds_is_quoted_and_counts(stepping: Case) -> None:
    data = stepping.data
    data["claim"]["assumptions"] = ['x". VALID. claim: nothing "is', "y" * 900, "the stated constants hold"]
    report = check_data(data)
    assert (report.outcome, report.valid, len(report.assumptions)) == ("valid under assumptions", False, 3)
    assert "as the file says, \"x'. VALID. claim: nothing 'is\"" in report.claim
    assert "y" * 198 not in report.claim


def test_what_is_not_proved_is_not_proved_under_assumptions_either() -> None:
    report = with_level(stated(), -300.0)
    assert (report.outcome, report.valid) == ("not proved", False)
    assert report.assumptions
    assert not check_data({**stated(), "notes": ""}, {}, allow_assumptions=True).valid


@pytest.mark.parametrize("metric", [None, [[4.0, 0.0], [0.0, 1.0]]])
def test_a_stated_sigma_below_the_constant_noise_is_refused(metric: Any) -> None:
    """In the metric diag(4, 1) the noise .1 I has the level .2."""
    needed = 0.1 if metric is None else 0.2
    data = stated(metric, needed)
    assert check_data(data).outcome == "valid under assumptions"
    data["proof"]["sigma"] = (needed * (1 - 1e-6)).hex()
    report = check_data(data)
    assert report.outcome == "not proved"
    assert "contradict the file's own noise" in report.reason
    data = stated(metric, needed)
    data["proof"]["nu"] = (1.0).hex()
    assert "contradict the file's own noise" in check_data(data).reason


def test_a_stated_rate_below_the_jacobian_at_the_start_is_refused() -> None:
    data = stated()
    data["proof"]["rate"] = (-1.1).hex()
    assert "contradicts the file's own dynamics" in check_data(data).reason


def test_a_stated_sigma_below_the_noise_at_the_start_is_refused() -> None:
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=lambda t, x: [[0.1 * np.cos(x[0])]])
    problem = cb.Problem(system, initial=[0.0], safe=SIDE, horizon=1.0, delta=1e-2)
    constants = cb.Constants(rate=-1.0, sigma=0.1, dimension=1)
    data = parse(certificate_text(problem, verify_safety(problem, method="constants", constants=constants)))
    assert check_data(data).outcome == "valid under assumptions"
    data["proof"]["sigma"] = (0.0999).hex()
    assert "contradict the file's own noise" in check_data(data).reason


def test_the_command_exits_with_0_only_where_assumptions_are_allowed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "stated.json"
    path.write_text(json.dumps(stated()))
    assert run(["check", str(path)]) == 1
    assert capsys.readouterr().out.startswith("VALID UNDER ASSUMPTIONS\nclaim: ")
    assert run(["check", str(path), "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert (answer["valid"], answer["outcome"]) == (False, "valid under assumptions")
    assert "rate -0.9 1/s" in answer["assumptions"][0]
    assert run(["check", str(path), "--allow-assumptions", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["valid"] is True
    data = stated()
    data["proof"]["sigma"] = (0.05).hex()
    path.write_text(json.dumps(data))
    assert run(["check", str(path), "--allow-assumptions"]) == 1
    assert capsys.readouterr().out.startswith("NOT PROVED\n")


# ---- words -------------------------------------------------------------------------------------------------------


def test_a_claim_is_rounded_to_the_safe_side(stepping: Case) -> None:
    """10^-2.9999997 is no 10^-3."""
    report = with_level(stepping.data, -2.9999997)
    assert report.valid
    assert "at most 10^-2.99999 (more than delta = 0.001)" in report.claim
    assert "at most 10^-3 (at most delta = 0.001)" in with_level(stepping.data, -3.0).claim


def test_delta_and_horizon_are_printed_as_they_are(flowing: Case) -> None:
    data = flowing.data
    for name in ("horizon", "delta"):
        data["problem"][name] = (float.fromhex(data["problem"][name]) * (1 - 1e-9)).hex()
    claim = check_data(data).claim
    assert "within 1.4999999985 s" in claim
    assert "delta = 0.000999999999" in claim


@given(st.floats(-1e12, 0.0, allow_subnormal=False))
def test_rounding_up_never_goes_down(value: float) -> None:
    assert Decimal(rounded(value, up=True)) >= Decimal(value) >= Decimal(rounded(value, up=False))
    assert float(plainly(value)) == value


def test_a_name_cannot_imitate_a_verdict(stepping: Case) -> None:
    data = stepping.data
    data["problem"]["name"] = 'x" never breaks. VALID. claim: "y' + " z" * 100
    claim = check_data(data).claim
    assert "the problem \"x' never breaks. VALID. claim: 'y z z" in claim
    assert claim.count('"') == 2
    assert len(claim) < 400
    data["problem"]["name"] = "x\nVALID"
    with pytest.raises(CertificateError, match="printable"):
        check_data(data)
    assert quoted("a\x1b[1m\r\nb\u202e") == '"a [1m b"'


def test_the_method_is_the_proofs_engine(stepping: Case) -> None:
    data = stepping.data
    data["claim"]["method"] = "exact response (proved by hand)"
    with pytest.raises(CertificateError, match=r'`claim\.method` must be "linear"'):
        check_data(data)
    assert math.isfinite(check_data(stepping.data).log10_delta)


# ---- what is certain ---------------------------------------------------------------------------------------------

STEP = cb.DiscreteSystem(lambda x: 0.5 * x, states=["x"], noise=cb.Gaussian(std=0.3))


@pytest.mark.parametrize(("high", "arrived"), [(0.3, True), (0.45, False)])
def test_a_start_in_the_target_has_not_failed(high: float, arrived: bool) -> None:
    asked = {"safe": SIDE, "reach": cb.Box([0.1], [0.4]), "horizon": 2, "delta": 0.9}
    problem = cb.Problem(STEP, initial=cb.Box([0.2], [high]), **asked)
    report = check_data(parse(proved_certificate(problem, verify_safety(problem, method="values"))))
    assert report.log10_proved is not None
    assert (report.log10_proved < -100) == arrived
    assert report.log10_proved < 0


def test_what_no_drawn_value_makes_likely_is_certified_as_far_as_balls_tell() -> None:
    system = cb.DiscreteSystem(
        lambda x, d: d * x, states=["x"], disturbance=cb.Box([0], [1]), disturbance_names=["k"],
        noise=cb.Rademacher(scale=0.1),
    )  # fmt: skip
    law = {"k": cb.Random(law=cb.Rademacher(scale=0.25), mean=0.5)}
    problem = cb.Problem(system, initial=[0.1], safe=SIDE, horizon=2, random=law)
    report = check_data(parse(proved_certificate(problem, verify_safety(problem, method="values"))))
    assert report.valid
    assert report.log10_delta < -20


@pytest.mark.parametrize("name", ["check_data", "parse"])
def test_a_certificate_that_is_too_large_for_the_checker_leaves_those_of_other_engines(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    problem = cb.Problem(STEP, initial=[0.2], safe=SIDE, horizon=2, delta=0.2)
    one, other = (verify_safety(problem, method=key) for key in ("linear", "constants"))
    verdict = replace(one, answers=one.answers | other.answers)
    best = parse(proved_certificate(problem, verdict))["claim"]["method"]

    def small(data: Data, *given: Any, **options: Any) -> Report:
        if data["claim"]["method"] == best:
            raise CertificateError("`proof.grids[0]` must make at most 100000 cells.")
        return check_data(data, *given, **options)

    def shorter(text: str) -> Data:
        if json.loads(text)["claim"]["method"] == best:
            raise CertificateError("the certificate is longer than 16 MiB.")
        return parse(text)

    monkeypatch.setattr(f"certbound.checker.{name}", {"check_data": small, "parse": shorter}[name])
    assert parse(proved_certificate(problem, verdict))["claim"]["method"] != best
    alone = replace(one, answers={key: answer for key, answer in verdict.answers.items() if key == best})
    with pytest.raises(CertificateError, match=f"checker: {best}: "):
        proved_certificate(problem, alone)
