"""What is written into certificates, and what is not."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.cli.commands.check import proved_certificate
from certbound.errors import CertificateError
from certbound.safety.answers import EngineAnswer, exact, is_at_most
from certbound.safety.certificate import certificate_data, certificate_text, problem_data, restated
from certbound.safety.portfolio import ENGINES
from certbound.safety.verification import verify_safety
from certbound.watch import Watch, poll


def small(**changes: Any) -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: [0.5 * x[0] + 0.1 * np.sin(x[0])], states=1, noise=cb.Gaussian(std=0.1))
    values = {"initial": [0.1], "safe": [cb.Inside(cb.Box([-1], [1]))], "horizon": 3, "delta": 1e-3}
    return cb.Problem(system, **(values | changes))


def test_numbers_are_exact() -> None:
    values = [0.1, -1e-300, np.float64(1 / 3), 0.0]
    assert [float.fromhex(text) for text in exact(values)] == values
    assert exact(np.array([[0.5]])) == [["0x1.0000000000000p-1"]]
    with pytest.raises(CertificateError, match="nan"):
        exact(float("nan"))


def test_a_verdict_carries_its_certificate_as_data() -> None:
    problem = small()
    verdict = verify_safety(problem, method="linear")
    data = verdict.certificate
    assert data is not None
    assert data["claim"]["method"] == "linear"
    assert float.fromhex(data["claim"]["log10_delta"]) <= np.log10(problem.delta)
    assert verdict.certificate is data
    assert json.loads(verdict.certificate_text(problem)) == json.loads(json.dumps(data))


@pytest.mark.parametrize("method", ["linear", "constants"])
def test_a_certificate_claims_no_more_than_the_verdict(method: str) -> None:
    problem = small()
    verdict = verify_safety(problem, method=method)
    data = certificate_data(problem, verdict)
    assert float.fromhex(data["claim"]["log10_delta"]) >= verdict.log10_delta
    assert check_data(parse(json.dumps(data))).valid


def test_over_a_jump_no_more_is_claimed_than_the_checker_sees() -> None:
    """It counts the worst on the cells of a jump, the engine what both sides lead to."""
    heated = cb.DiscreteSystem(
        lambda x: x + 0.1 * (10 - x) + np.where(x < 20, 1.8, 0.0), states=["T"], noise=cb.Gaussian(std=0.2)
    )
    safe = [cb.Inside(cb.Box([17], [22.5]))]
    problem = cb.Problem(heated, initial=[20.1], safe=safe, horizon=10, delta=1e-3)
    verdict = verify_safety(problem, method="values")
    assert verdict.log10_delta < -10
    report = check_data(certificate_data(problem, verdict))
    assert report.valid
    assert -10 < (report.log10_proved or 0.0) <= -3


@pytest.mark.parametrize("place", [0.0, 0.25, -0.1, 1 / 3, 0.5])
def test_a_jump_anywhere_is_found_and_costs_little(place: float) -> None:
    """Parts that were looked at had gaps of an ulp between them: of x < 0 in the middle of -1 .. 1 nothing was seen."""
    system = cb.DiscreteSystem(
        lambda x: 0.8 * x + np.where(x < place, 0.1, -0.1), states=["x"], noise=cb.Gaussian(std=0.2)
    )
    problem = cb.Problem(system, initial=[0.1], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=5, delta=0.05)
    verdict = verify_safety(problem, method="values")
    report = check_data(certificate_data(problem, verdict))
    assert report.valid, report.reason
    assert report.log10_proved == pytest.approx(verdict.log10_delta, abs=0.1)


def test_a_certificate_restated_claims_what_was_proved_of_it() -> None:
    problem = small()
    text = certificate_text(problem, verify_safety(problem, method="linear"))
    proved = check_data(parse(text)).log10_proved
    assert proved is not None
    data = parse(restated(text, proved))
    claim = float.fromhex(data["claim"]["log10_delta"])
    assert proved < claim <= float.fromhex(parse(text)["claim"]["log10_delta"])
    assert claim == pytest.approx(proved, rel=1e-5)
    assert check_data(data).valid
    assert restated(text, 0.0) == text
    data["claim"]["log10_delta"] = (claim - 1e-4).hex()
    assert not check_data(data).valid


def test_an_unsafe_nominal_has_no_certificate() -> None:
    system = cb.DiscreteSystem(lambda x: [2.0 * x[0]], states=1, noise=cb.Gaussian(std=0.01))
    problem = cb.Problem(system, initial=[0.5], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=4)
    verdict = verify_safety(problem)
    assert verdict.status == "UNSAFE_NOMINAL"
    assert verdict.certificate is None
    with pytest.raises(CertificateError, match="no probability was bounded"):
        verdict.certificate_text(problem)


def test_more_attempts_spend_more_room() -> None:
    problem = small()
    verdict = verify_safety(problem, method="linear")
    claims = []
    for attempt in range(4):
        data = parse(certificate_text(problem, verdict, attempt=attempt))
        assert check_data(data).valid
        claims.append(float.fromhex(data["claim"]["log10_delta"]))
    assert claims == sorted(claims)


def test_everything_that_a_problem_states_is_in_its_data() -> None:
    base = problem_data(small())
    changes = [
        {"horizon": 4}, {"delta": 1e-2}, {"initial": [0.2]}, {"initial": cb.Ball([0.1], 0.01)},
        {"safe": [cb.Outside(cb.Box([1], [2]))]}, {"safe": [cb.Inside(cb.Box([-1], [1]), during=(1, 2))]},
        {"domain": cb.Box([-3], [3])}, {"safe": [cb.Inside(cb.Ball(lambda t: [0.1 * t], 1.0))]},
    ]  # fmt: skip
    for change in changes:
        assert problem_data(small(**change)) != base
    assert problem_data(small(name="another")) != base
    assert problem_data(small()) == base


def test_the_law_of_the_noise_is_stated_by_name() -> None:
    def noise(law: Any) -> dict[str, Any]:
        system = cb.DiscreteSystem(lambda x: 0.5 * x, states=2, noise=law)
        found: dict[str, Any] = problem_data(cb.Problem(system, initial=[0, 0], safe=[], horizon=1))["noise"]
        return found

    assert noise(cb.Gaussian(std=0.5))["level"] == "std"
    assert noise(cb.SubGaussian(proxy_variance=0.5))["level"] == "variance"
    assert noise(cb.Rademacher(scale=0.5))["law"] == "rademacher"
    assert noise(cb.Bounded(halfwidth=0.5, independent=False))["independent"] is False
    flowing = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=lambda t, x: np.array([[x[0]], [1.0]]))
    data = problem_data(cb.Problem(flowing, initial=[0, 0], safe=[], horizon=1))["noise"]
    assert data["law"] == "wiener"
    assert data["diffusion"]["columns"] == 1


@pytest.mark.parametrize(("name", "method"), [("chain", "linear"), ("chain_rest", "linear"), ("ou", "constants")])
def test_quick_bundled_problems_are_proved_again(name: str, method: str) -> None:
    _bundled(name, method)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ou", "unicycle", "chain", "chain_rest", "pendulum"])
def test_every_bundled_problem_is_proved_again_in_time(name: str) -> None:
    _bundled(name, "auto")


def _bundled(name: str, method: str) -> None:
    problem = cb.load(name)
    started = time.perf_counter()
    verdict = verify_safety(problem, method=method)
    proving = time.perf_counter() - started
    assert verdict.status == "SAFE"
    data = parse(certificate_text(problem, verdict))
    started = time.perf_counter()
    report = check_data(data, json.loads(json.dumps(problem_data(problem))))
    assert report.valid, report.reason
    assert report.log10_delta <= np.log10(problem.delta)
    assert time.perf_counter() - started < max(10 * proving, 20.0)


def test_a_barrier_states_what_the_linear_response_proved_by_sharper_events() -> None:
    """The linear response proves SAFE with events that certificates do not know; theirs alone leave delta behind."""
    system = cb.ContinuousSystem(
        lambda x: [x[1], -x[0] - x[1] - 0.5 * x[0] ** 3], states=["x1", "x2"], diffusion=[[0.0], [0.2]]
    )
    problem = cb.Problem(
        system, initial=cb.Box([-0.2, -0.2], [0.2, 0.2]), horizon=1.0, delta=1e-4,
        safe=[cb.Inside(cb.HalfSpace([0, 1], 1.1))], domain=cb.Box([-2, -2], [2, 2]),
    )  # fmt: skip
    answer = EngineAnswer(log10_delta=-4.5, method="linear", details=None)
    quick = EngineAnswer(applicable=False, reason="another engine is enough.", method="barrier")
    verdict = verify_safety(problem, method="linear")
    assert verdict.status == "SAFE"
    weak = replace(verdict, answers={"linear": answer, "barrier": quick})
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ENGINES, "linear", replace(ENGINES["linear"], write=lambda *_: ({}, -2.0, [])))
        data = certificate_data(problem, weak)
    assert data["claim"]["method"] == "barrier"
    assert float.fromhex(data["claim"]["log10_delta"]) < -4


def test_windows_of_a_linear_flow_cost_little_of_a_small_probability() -> None:
    system = cb.ContinuousSystem(lambda x: [-x[0]], states=1, diffusion=[[0.1**0.5]])
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1.4], [1.4]))], horizon=2.0)
    verdict = verify_safety(problem, method="linear")
    claim = float.fromhex(certificate_data(problem, verdict)["claim"]["log10_delta"])
    assert verdict.log10_delta < -7
    assert claim < 0.85 * verdict.log10_delta


def test_who_was_only_asked_for_a_certificate_is_asked_once_and_may_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def refusing(*_: Any) -> Any:
        raise CertificateError("not today.")

    def failing(problem: cb.Problem, request: Any) -> EngineAnswer:
        asked.append("barrier")
        raise ZeroDivisionError

    def proving(problem: cb.Problem, request: Any) -> EngineAnswer:
        asked.append("values")
        return EngineAnswer(log10_delta=-4.0, method="values", details="a proof")

    def writing(problem: cb.Problem, answer: EngineAnswer, attempt: int) -> Any:
        return {"engine": answer.details}, -3.5, []

    verdict = verify_safety(small())
    assert verdict.status == "SAFE"
    for name, row in ENGINES.items():
        monkeypatch.setitem(ENGINES, name, replace(row, write=refusing, reserve=name in ("barrier", "values")))
    monkeypatch.setitem(ENGINES, "barrier", replace(ENGINES["barrier"], prove=failing))
    monkeypatch.setitem(ENGINES, "values", replace(ENGINES["values"], prove=proving, write=writing))
    for attempt in range(2):
        claim = certificate_data(small(), verdict, attempt=attempt)["claim"]
        assert claim == {"log10_delta": exact(-3.5), "method": "values", "assumptions": []}
    assert asked == ["barrier", "values"]


@pytest.mark.parametrize(("proved", "asked"), [(-3.1, False), (-2.9, True)])
def test_engines_that_only_a_certificate_asks_come_after_the_check_of_what_is_there(
    monkeypatch: pytest.MonkeyPatch, proved: float, asked: bool
) -> None:
    """A claim leaves the checker some room, so that one of more than delta may prove less than that."""
    calls: list[str] = []

    def silent(*_: Any) -> EngineAnswer:
        calls.append("asked")
        return EngineAnswer(applicable=False)

    def refusing(*_: Any) -> Any:
        raise CertificateError("not today.")

    def proving(data: Any, *_: Any, **__: Any) -> Any:
        return SimpleNamespace(valid=True, proved=True, log10_proved=proved, log10_lower_proved=None, reason="")

    verdict = verify_safety(small())
    monkeypatch.setattr("certbound.checker.check_data", proving)
    for name, row in ENGINES.items():
        monkeypatch.setitem(ENGINES, name, replace(row, prove=silent, write=refusing))
    row = replace(ENGINES["linear"], write=lambda *_: ({"engine": "linear"}, -2.8, []))
    monkeypatch.setitem(ENGINES, "linear", row)
    data = parse(proved_certificate(small(), verdict))
    assert float.fromhex(data["claim"]["log10_delta"]) == pytest.approx(proved, abs=1e-4)
    assert bool(calls) == asked


def test_engines_on_grids_are_asked_for_a_certificate_after_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def refusing(*_: Any) -> Any:
        raise CertificateError("not today.")

    def silent(name: str) -> Any:
        def prove(problem: cb.Problem, request: Any) -> EngineAnswer:
            asked.append(name)
            return EngineAnswer(applicable=False, method=name)

        return prove

    verdict = verify_safety(small())
    for name, row in ENGINES.items():
        monkeypatch.setitem(ENGINES, name, replace(row, write=refusing, prove=silent(name)))
    with pytest.raises(CertificateError, match="not today"):
        certificate_data(small(), verdict)
    assert asked == ["barrier", "quadratic", "backward", "values"]


def test_a_proof_that_more_effort_writes_again_is_not_checked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    checked: list[Any] = []

    def refuted(data: Any, *_: Any, **__: Any) -> Any:
        checked.append(data)
        return SimpleNamespace(
            valid=False, proved=False, log10_proved=None, log10_lower_proved=None, reason="nothing holds."
        )

    verdict = verify_safety(small(), method="linear")
    row = ENGINES["linear"]
    monkeypatch.setattr("certbound.checker.check_data", refuted)
    monkeypatch.setitem(ENGINES, "linear", replace(row, write=lambda *_: ({"engine": "linear"}, -3.5, [])))
    with pytest.raises(CertificateError, match="linear: nothing holds"):
        proved_certificate(small(), verdict)
    assert len(checked) == 1
    other = replace(row, write=lambda *given: ({"engine": "linear"}, -3.5 + given[-1], []))
    monkeypatch.setitem(ENGINES, "linear", other)
    with pytest.raises(CertificateError, match="linear: nothing holds"):
        proved_certificate(small(), verdict)
    assert len(checked) > 2


@pytest.mark.parametrize(("status", "proved", "claims"), [("SAFE", -3.2, 1), ("SAFE", -2.9, 3), ("UNKNOWN", -3.2, 3)])
def test_what_the_checker_proved_is_claimed_where_it_shows_that_all_is_safe(
    monkeypatch: pytest.MonkeyPatch, status: str, proved: float, claims: int
) -> None:
    """A claim of more than was proved was written again and again, with more effort, though 10**-3.2 < delta."""
    checked: list[Any] = []

    def proving(data: Any, *_: Any, **__: Any) -> Any:
        checked.append(data)
        return SimpleNamespace(
            valid=False, proved=False, log10_proved=proved, log10_lower_proved=None, reason="less follows."
        )

    verdict = replace(verify_safety(small(), method="linear"), status=status)
    row = replace(ENGINES["linear"], write=lambda *given: ({"engine": "linear"}, -3.5 + 0.1 * given[-1], []))
    monkeypatch.setattr("certbound.checker.check_data", proving)
    monkeypatch.setitem(ENGINES, "linear", row)
    if claims > 1:  # which leaves those of other engines, here none
        with pytest.raises(CertificateError, match="linear: less follows"):
            proved_certificate(small(), verdict)
    else:
        data = parse(proved_certificate(small(), verdict))
        assert float.fromhex(data["claim"]["log10_delta"]) == pytest.approx(proved, abs=1e-5)
        assert float.fromhex(data["claim"]["log10_delta"]) > proved
    assert len(checked) == claims


@pytest.mark.parametrize(("proved", "claims"), [(-2.5, 1), (-3.5, 2)])
def test_what_the_checker_proved_from_below_is_claimed_where_it_refutes_delta(
    monkeypatch: pytest.MonkeyPatch, proved: float, claims: int
) -> None:
    checked: list[Any] = []

    def proving(data: Any, *_: Any, **__: Any) -> Any:
        checked.append(data)
        level = proved if len(checked) == 1 else -2.5
        return SimpleNamespace(
            valid=False, proved=False, log10_proved=None, log10_lower_proved=level, reason="less follows."
        )

    answer = EngineAnswer(log10_delta=0.0, log10_lower=-2.0, method="values")
    verdict = replace(verify_safety(small(), method="linear"), status="UNSAFE", answers={"values": answer})
    row = replace(ENGINES["values"], write_below=lambda *given: ({"engine": "values"}, -2.1 - 0.1 * given[-1], []))
    monkeypatch.setattr("certbound.checker.check_data", proving)
    monkeypatch.setitem(ENGINES, "values", row)
    data = parse(proved_certificate(small(), verdict))
    assert float.fromhex(data["claim"]["log10_lower"]) == pytest.approx(-2.5, abs=1e-5)
    assert float.fromhex(data["claim"]["log10_lower"]) < -2.5
    assert len(checked) == claims


def test_a_claim_of_less_than_is_proved_already_is_not_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    checked: list[float] = []

    def proving(data: Any, *_: Any, **__: Any) -> Any:
        checked.append(float.fromhex(data["claim"]["log10_delta"]))
        return SimpleNamespace(
            valid=True, proved=True, log10_proved=checked[-1] - 0.01, log10_lower_proved=None, reason=""
        )

    verdict = verify_safety(small(), method="linear")
    levels = [-2.8, -2.7, -2.9]
    row = replace(ENGINES["linear"], write=lambda *given: ({"engine": "linear"}, levels[given[-1]], []))
    monkeypatch.setattr("certbound.checker.check_data", proving)
    monkeypatch.setitem(ENGINES, "linear", row)
    for engine in ("barrier", "quadratic", "backward", "values"):
        monkeypatch.setitem(ENGINES, engine, replace(ENGINES[engine], write=None))
    data = parse(proved_certificate(small(), verdict))
    assert checked == [-2.8, -2.9]
    assert float.fromhex(data["claim"]["log10_delta"]) == pytest.approx(-2.91, abs=1e-4)


def test_engines_that_only_a_certificate_asks_share_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that does not come to its end leaves time to the next one, and what it had proved counts."""
    asked: list[str] = []

    def refusing(*_: Any) -> Any:
        raise CertificateError("not today.")

    def lasting(name: str, level: float) -> Any:
        def prove(problem: cb.Problem, request: Any) -> EngineAnswer:
            asked.append(name)
            request.found(EngineAnswer(log10_delta=level, method=name))
            while True:
                poll("lasting")

        return prove

    def writing(problem: cb.Problem, answer: EngineAnswer, attempt: int) -> Any:
        return {"engine": answer.method}, answer.log10_delta, []

    verdict = verify_safety(small())
    assert verdict.status == "SAFE"
    for name, row in ENGINES.items():
        monkeypatch.setitem(ENGINES, name, replace(row, write=refusing, reserve=name in ("barrier", "values")))
    for name, level in (("barrier", -2.0), ("values", -4.0)):
        monkeypatch.setitem(ENGINES, name, replace(ENGINES[name], prove=lasting(name, level), write=writing))
    with Watch(2.0).running():
        claim = certificate_data(small(), verdict)["claim"]
    assert asked == ["barrier", "values"]
    assert claim == {"log10_delta": exact(-4.0), "method": "values", "assumptions": []}


def test_a_target_whose_certificate_is_not_proved_leaves_those_of_other_engines() -> None:
    """Its proof is not called as its engine, which was looked for by that name."""
    system = cb.ContinuousSystem(lambda x: [x[0] - x[0] ** 3], states=1, diffusion=[[0.1]])
    problem = cb.Problem(
        system, initial=[-1.0], safe=[cb.Inside(cb.Box([-2.0], [2.0]))], horizon=1.0, delta=0.05,
        reach=cb.Box([-1.5], [np.inf]),
    )  # fmt: skip
    verdict = verify_safety(problem)
    assert verdict.answers["constants"].log10_delta < verdict.answers["linear"].log10_delta < -1.4
    report = check_data(parse(proved_certificate(problem, verdict)), problem_data(problem))
    assert report.valid, report.reason
    assert "linear response" in report.reason


def test_a_certificate_that_proves_less_than_safe_is_written_again_with_more_effort() -> None:
    unit = 1e-5
    system = cb.ContinuousSystem(
        lambda x: [1.29 * x[1], -1.29 * x[0] - 0.49 * x[1]], states=2, diffusion=[[0.0], [0.162 * unit]]
    )
    post = cb.Outside(cb.Box([-1.1747 * unit, 0.28755 * unit], [1.5026 * unit, 2.9649 * unit]), during=(0.378, 2.126))
    problem = cb.Problem(system, initial=[0.5 * unit, 0.0], safe=[post], horizon=2.29, delta=3.03e-3)
    verdict = verify_safety(problem)
    assert verdict.status == "SAFE"
    least = np.log10(problem.delta)
    assert float.fromhex(certificate_data(problem, verdict)["claim"]["log10_delta"]) > least
    assert float.fromhex(parse(proved_certificate(problem, verdict))["claim"]["log10_delta"]) <= least


def test_boxes_of_the_remainder_are_widened_less_where_a_certificate_would_prove_less_than_safe() -> None:
    system = cb.ContinuousSystem(lambda x: [x[0] - x[0] ** 3], states=1, diffusion=[[0.13, 0.065]])
    limit = cb.Inside(cb.Box([-np.inf], [1.144]))
    problem = cb.Problem(system, initial=[0.0], safe=[limit], horizon=1.0, delta=1.4e-5)
    verdict = verify_safety(problem, method="linear")
    assert verdict.status == "SAFE"
    data = certificate_data(problem, verdict)
    assert float.fromhex(data["claim"]["log10_delta"]) <= np.log10(problem.delta)
    assert check_data(parse(json.dumps(data))).valid


def test_grids_of_steps_have_no_more_cells_than_the_checker_takes() -> None:
    system = cb.DiscreteSystem(lambda x: [0.5 * x[0], 0.5 * x[1]], states=2, noise=cb.Gaussian(std=[0.01, 0.01]))
    safe = [cb.Inside(cb.Box([-1.0, -1.0], [1.0, 1.0]))]
    problem = cb.Problem(system, initial=[0.0, 0.0], safe=safe, horizon=1, delta=0.01)
    verdict = verify_safety(problem, method="values")
    for attempt, few in ((0, 5e4), (2, 1e5)):
        (grid,) = certificate_data(problem, verdict, attempt=attempt)["proof"]["grids"]
        assert few / 2 < np.prod([len(axis) - 1 for axis in grid]) <= few


def test_noise_that_states_share_is_stated_in_pieces() -> None:
    """Polynomials the checker refused after all was written, since it has them for independent noise alone."""
    system = cb.DiscreteSystem(
        lambda x: [0.5 * x[0], 0.5 * x[1]], states=2, noise=cb.Gaussian(std=[1, 1]),
        noise_matrix=[[0.1, 0.05], [0.0, 0.1]],
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1.0, -1.0], [1.0, 1.0]))]
    problem = cb.Problem(system, initial=[0.0, 0.0], safe=safe, horizon=2, delta=0.05)
    verdict = verify_safety(problem, method="values")
    assert verdict.status == "SAFE"
    data = parse(proved_certificate(problem, verdict))
    assert data["proof"]["pieces"] > 0
    assert is_at_most(float.fromhex(data["claim"]["log10_delta"]), 0.05)


def test_a_certificate_of_quadratic_bounds_claims_less_than_delta_itself() -> None:
    """The float log10(delta) is above the logarithm of every second delta, and so SAFE seemed not to be shown."""
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=0.2 * np.eye(2))
    safe = [cb.Inside(cb.Box([-1.0, -1.0], [1.0, 1.0]))]
    problem = cb.Problem(system, initial=[0.0, 0.0], safe=safe, horizon=1.0, delta=0.1)
    verdict = verify_safety(problem, method="quadratic")
    level = verdict.answers["quadratic"].log10_delta
    assert level < -2
    for k in range(8):
        delta = 10.0 ** (level + 0.01 * (k + 1))
        claim = certificate_data(problem.replace(delta=delta), verdict)["claim"]
        assert claim["method"] == "quadratic"
        assert level < float.fromhex(claim["log10_delta"])
        assert is_at_most(float.fromhex(claim["log10_delta"]), delta)


def test_a_law_of_an_unknown_class_is_stated_by_no_certificate() -> None:
    class Triangular(cb.Uniform):
        """Draws otherwise than its parent."""

    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=1, noise=Triangular(halfwidth=0.01))
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3)
    verdict = cb.verify_safety(problem)
    assert verdict.status == "SAFE"
    with pytest.raises(CertificateError, match="got the class Triangular"):
        verdict.certificate_text(problem)
