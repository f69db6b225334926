"""Forged certificates of proofs in other coordinates: part of ``FORGERIES``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import certbound as cb
from certbound.checker import check_data, parse
from certbound.safety.answers import exact
from certbound.safety.certificate import certificate_text, restated
from certbound.safety.engines import Apart, Logarithmic, Turned, linear_engine
from certbound.safety.engines.oblique_limits import axes
from certbound.safety.engines.turning import logarithmic, turned_problem
from certbound.safety.verdict import verdict_of
from tests.checker.forgeries import _BASES, BEYOND, MORE, Data, forges
from tests.safety.engines.test_logarithms import prices
from tests.safety.engines.test_oblique_limits import oblique

_TURNED = "statement/turned.py"


def turned_text() -> str:
    """The certificate by a linear response in coordinates a - b and b, whether or not they are needed."""
    problem = oblique()
    turn = axes(problem)
    assert turn is not None
    other = turned_problem(problem, *turn)
    answer = linear_engine(other)
    found = Turned(matrix=turn[0], inverse=turn[1], problem=other, answer=answer, plain=answer)
    return certificate_text(problem, verdict_of(problem, {"linear": replace(answer, details=found)}))


def apart_text() -> str:
    """A certificate whose two parts are about one of two equal limits each."""
    system = cb.ContinuousSystem(lambda x: [-x[0]], states=["a"], diffusion=0.5)
    limits = [cb.Inside(cb.HalfSpace([side], 1.0)) for side in (1.0, -1.0)]
    problem = cb.Problem(system, initial=[0.0], safe=limits, horizon=1.0, delta=0.5)
    alone = [problem.replace(safe=[one]) for one in limits]
    answers = [linear_engine(one) for one in alone]
    found = Apart(parts=(((0,), alone[0], answers[0]), ((1,), alone[1], answers[1])), plain=answers[0])
    both = replace(answers[0], log10_delta=answers[0].log10_delta + np.log10(2.0) + 1e-9, details=found)
    text = certificate_text(problem, verdict_of(problem, {"linear": both}))
    proved = check_data(parse(text)).log10_proved
    assert proved is not None
    return restated(text, proved)


_BASES |= {"turned": turned_text, "apart": apart_text}


@forges("other coordinates have the stated inverse", "turned", _TURNED, "turned_model", "must be the inverse")
def _(data: Data) -> None:
    data["proof"]["inverse"][0][1] = exact(np.nextafter(1.0, 2.0))


@forges("a limit is exact in other coordinates", "turned", _TURNED, "_constraint", "is not exact")
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["normal"] = exact([0.1, 0.2])


@forges("noise is exact in other coordinates", "turned", _TURNED, "_noise", "`problem.noise` is not exact")
def _(data: Data) -> None:
    data["problem"]["noise"]["diffusion"] = exact([[0.1, 0.0], [0.001, 0.02]])


@forges("a limit is the stated one in other coordinates", "turned", _TURNED, "_constraint", BEYOND)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["normal"] = exact([1.5, -1.0])


@forges("the dynamics is the stated one in other coordinates", "turned", _TURNED, "_composed", "remainder of a")
def _(data: Data) -> None:
    tape = data["problem"]["dynamics"]
    tape["nodes"].append(["neg", tape["outputs"][0]])
    tape["outputs"][0] = len(tape["nodes"]) - 1


@forges("the noise is the stated one in other coordinates", "turned", _TURNED, "_noise", MORE)
def _(data: Data) -> None:
    data["problem"]["noise"]["diffusion"] = exact([[0.25, 0.0], [0.0, 0.25]])


@forges("the starts lie in the box of other coordinates", "turned", _TURNED, "_start", "cover|splits|initial")
def _(data: Data) -> None:
    data["problem"]["initial"] |= {"low": exact([0.25, -0.5]), "high": exact([0.25, -0.5])}


@forges("other coordinates prove no lower bound", "turned", "claims.py", "check_side", "in other coordinates")
def _(data: Data) -> None:
    data["claim"] |= {"log10_delta": exact(0.0), "log10_lower": data["claim"]["log10_delta"]}


@forges("limits that are taken apart are all of them", "apart", "claims.py", "_apart", "name every constraint")
def _(data: Data) -> None:
    data["proof"]["parts"] = data["proof"]["parts"][:1]


@forges("probabilities of limits that are taken apart add up", "apart", "claims.py", "prove", MORE)
def _(data: Data) -> None:
    data["claim"]["log10_delta"] = exact(float.fromhex(data["claim"]["log10_delta"]) - 0.25)


@forges("limits that are taken apart prove no lower bound", "apart", "claims.py", "check_side", "taken apart")
def _(data: Data) -> None:
    data["claim"] |= {"log10_delta": exact(0.0), "log10_lower": data["claim"]["log10_delta"]}


_LOGS = "statement/by_ito.py"


def logarithms_text() -> str:
    """The certificate of a price by a linear response in its logarithm."""
    problem = prices()
    places, other = logarithmic(problem) or ((), problem)
    answer = linear_engine(other)
    found = Logarithmic(places=places, problem=other, answer=answer, plain=answer)
    return certificate_text(problem, verdict_of(problem, {"linear": replace(answer, details=found, foresight=False)}))


_BASES |= {"logarithms": logarithms_text}


@forges("what has a logarithm stays positive", "logarithms", _LOGS, "logarithmic_model", "keeps positive")
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["during"] = exact([0.0, 0.5])


@forges("a limit is one of a single state in logarithms", "logarithms", _LOGS, "_constraint", "no positive one")
def _(data: Data) -> None:
    data["problem"]["constraints"][1]["region"]["normal"] = exact([-1.0])


@forges("a limit is the stated one in logarithms", "logarithms", _LOGS, "_constraint", BEYOND)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["high"] = exact([1.75])


@forges("the dynamics is the stated one in logarithms", "logarithms", _LOGS, "_derived", "remainder of")
def _(data: Data) -> None:
    tape = data["problem"]["dynamics"]
    tape["nodes"] += [["const", exact(4.0)], ["mul", tape["outputs"][0], len(tape["nodes"])]]
    tape["outputs"][0] = len(tape["nodes"]) - 1


@forges("the noise is the stated one in logarithms", "logarithms", _LOGS, "_derived", "remainder of")
def _(data: Data) -> None:
    tape = data["problem"]["noise"]["diffusion"]
    tape["nodes"] += [["const", exact(2.0)], ["mul", tape["outputs"][0], len(tape["nodes"])]]
    tape["outputs"][0] = len(tape["nodes"]) - 1


@forges("the starts are those of the logarithms", "logarithms", _LOGS, "_start", "cover|splits|initial")
def _(data: Data) -> None:
    data["problem"]["initial"] |= {"low": exact([1.25]), "high": exact([1.25])}


@forges("logarithms prove no lower bound", "logarithms", "claims.py", "check_side", "in other coordinates")
def _(data: Data) -> None:
    data["claim"] |= {"log10_delta": exact(0.0), "log10_lower": data["claim"]["log10_delta"]}
