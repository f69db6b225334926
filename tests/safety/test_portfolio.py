"""Every engine on every problem of the zoo: bounds hold, certificates are accepted, nothing gets worse with less."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.cli.commands.check import proved_certificate
from certbound.errors import CertificateError, EngineError
from certbound.safety.answers import EngineAnswer
from certbound.safety.certificate import problem_data
from certbound.safety.portfolio import ENGINES, engine_named, in_order
from certbound.safety.verdict import best_lower
from certbound.safety.verification import verify_safety
from tests.zoo import ZOO

LOOSER = {
    ("constants", "decay"): "the search over two steps ends at a worse place than that over five",
    ("constants", "swing"): "the first metric that proves SAFE is kept, and another one serves less noise better",
    ("barrier", "spring"): "the search for a polynomial stops at a tolerance",
}
"""Where less noise or time gives a larger bound, which is sound and costs tightness, and why."""
ENOUGH = ("quadratic",)
"""Engines that end at the first bound below delta: less noise is SAFE too, with another one of the bounds below it."""
UNWRITTEN = {
    "linear": ["double_well"],  # the writer's own events are coarser than the engine's
    "constants": ["double_well", "prices", "spring"],  # constants along a tube
    "barrier": ["random_start"],
    "quadratic": ["walk", "decay", "sine", "uniform", "coins", "pushed", "spiral", "swing", "post", "random_start"],
    "values": ["window", "pendulum", "circle", "spring"],
}
"""Bounds that no certificate states."""
ROWS = [(engine, name) for engine in ENGINES for name in ZOO]


def test_every_row_says_what_it_is() -> None:
    for name, row in ENGINES.items():
        assert name == row.name
        assert len(row.words) > 20
        assert engine_named(name) == name
    assert engine_named("thm3") == "constants"
    assert engine_named("prophecy") is None


@pytest.mark.slow
@pytest.mark.parametrize(("engine", "name"), ROWS)
def test_a_bound_holds_and_is_certified_and_grows_with_what_it_must(engine: str, name: str) -> None:
    problem = ZOO[name](1.0, 1.0)
    verdict = verify_safety(problem, method=engine)
    answer = verdict.answers.get(engine)
    if answer is None or not answer.applicable:
        assert verdict.reason
        return
    found = cb.simulate_exits(problem, paths=20_000, rng=np.random.default_rng(0), confidence=1 - 1e-6, halve=False)
    assert 10**verdict.log10_delta >= found.lower
    if verdict.log10_lower is not None and problem.system.disturbance is None:
        corner = found.upper if name == "random_start" else 1.0
        assert 10**verdict.log10_lower <= max(corner, found.upper * 3)
    for factor in ((0.8, 1.0), (1.0, 0.5)):  # less noise, a shorter horizon
        less = verify_safety(ZOO[name](*factor), method=engine)
        assert (less.status == "SAFE") >= (verdict.status == "SAFE")
        if (engine, name) not in LOOSER and (engine not in ENOUGH or less.status != "SAFE"):
            assert less.log10_delta <= verdict.log10_delta * (1 - 0.02) + 0.02
    looser = verify_safety(problem.replace(delta=0.1), method=engine)
    assert (looser.status == "SAFE") >= (verdict.status == "SAFE")
    if ENGINES[engine].write is None or verdict.log10_delta >= 0:
        return
    try:
        data = parse(proved_certificate(problem, verdict, []))
    except (CertificateError, EngineError):
        assert name in UNWRITTEN[engine]
        return
    assert check_data(data, problem_data(problem)).valid


@pytest.mark.parametrize("name", ["logistic", pytest.param("relaxation", marks=pytest.mark.slow)])
def test_two_engines_agree_from_both_sides(name: str) -> None:
    problem = ZOO[name](1.0, 1.0)
    verdict = verify_safety(problem, method="values")
    assert verdict.log10_lower is not None
    assert verdict.log10_lower <= verdict.log10_delta
    assert best_lower(verdict.answers) == verdict.log10_lower
    assert verify_safety(problem, method="linear").log10_delta >= verdict.log10_lower


def test_a_probability_that_is_proved_to_exceed_delta_is_unsafe() -> None:
    problem = ZOO["logistic"](1.0, 1.0).replace(delta=1e-9)
    verdict = verify_safety(problem, method="values")
    assert verdict.status == "UNSAFE"
    assert verdict.log10_lower is not None
    assert -9 < verdict.log10_lower <= verdict.log10_delta
    assert verdict.to_dict()["log10_lower"] == verdict.log10_lower
    shown = float(verdict.summary().split("at least ")[1].split(",")[0])
    assert 0.9 * 10**verdict.log10_lower < shown <= 10**verdict.log10_lower


def test_an_assumption_that_a_lower_bound_refutes_is_left_out_in_words() -> None:
    from certbound.safety.answers import EngineAnswer
    from certbound.safety.verdict import verdict_of

    problem = cb.load("ou")
    stated = EngineAnswer(log10_delta=-9.0, method="kummer", assumption="the constants are those stated")
    proved = EngineAnswer(log10_delta=-0.5, log10_lower=-1.0, method="values")
    found = verdict_of(problem, {"constants": stated, "values": proved})
    assert (found.status, found.log10_delta, found.method) == ("UNSAFE", -0.5, "values")
    assert "the constants are those stated" in found.reason
    assert "refuted" in found.reason
    assert "defect" not in found.reason


def test_engines_that_contradict_each_other_answer_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    from dataclasses import replace

    from certbound.errors import SolverError
    from certbound.safety.answers import EngineAnswer

    def lying(*_: object, **__: object) -> EngineAnswer:
        return EngineAnswer(log10_delta=-1.0, log10_lower=-2.0, method="barrier")

    monkeypatch.setitem(ENGINES, "barrier", replace(ENGINES["barrier"], prove=lying))
    with pytest.raises(SolverError, match="contradict each other"):
        verify_safety(ZOO["decay"](0.5, 1.0))


def test_bounds_that_cross_answer_nothing_either_where_both_are_above_delta() -> None:
    from certbound.errors import SolverError
    from certbound.safety.answers import EngineAnswer
    from certbound.safety.verdict import verdict_of

    above, below = EngineAnswer(log10_delta=-1.0), EngineAnswer(log10_delta=-0.5, log10_lower=-0.9)
    with pytest.raises(SolverError, match="contradict each other"):
        verdict_of(ZOO["decay"](0.5, 1.0), {"linear": above, "values": below})
    assumed = EngineAnswer(log10_delta=-1.0, assumption="the stated constants hold")
    assert verdict_of(ZOO["decay"](0.5, 1.0), {"linear": assumed, "values": below}).log10_lower == -0.9


def test_what_was_tried_in_vain_at_one_time_is_not_tried_again_before_all_times_are() -> None:
    names = tuple(ENGINES)
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=1, noise=cb.Gaussian(std=0.3))
    safe, reach = [cb.Inside(cb.Box([-3], [3]))], cb.Box([-0.2], [0.2])
    endless = cb.Problem(system, initial=[1.0], safe=safe, reach=reach, horizon=np.inf)
    vain, partly = (EngineAnswer(log10_delta=level, hit=9.0) for level in (0.0, -0.1))
    assert in_order(names, endless, {"linear": vain})[:4] == ("backward", "values", "starts", "linear")
    assert in_order(names, endless, {"linear": partly}) == names
    assert in_order(names, endless.replace(horizon=9), {"linear": vain}) == names
