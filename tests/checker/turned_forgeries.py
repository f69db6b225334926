"""Forged certificates of proofs in other coordinates: part of ``FORGERIES``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import certbound as cb
from certbound.safety.answers import exact
from certbound.safety.certificate import certificate_text
from certbound.safety.engines import Turned, linear_engine
from certbound.safety.engines.oblique_limits import axes
from certbound.safety.engines.turning import turned_problem
from certbound.safety.verdict import verdict_of
from tests.checker.forgeries import _BASES, BEYOND, MORE, Data, forges

_TURNED = "statement/turned.py"


def oblique() -> cb.Problem:
    """Two states whose difference has a limit."""
    system = cb.ContinuousSystem(lambda x: [-x[0], 0.5 * x[0] - x[1]], states=["a", "b"], diffusion=0.125 * np.eye(2))
    safe = [cb.Inside(cb.HalfSpace([1.0, -1.0], 1.0))]
    return cb.Problem(system, initial=[0.25, 0.0], safe=safe, horizon=1.0, delta=1e-2)


def turned_text() -> str:
    """The certificate by a linear response in coordinates a - b and b, whether or not they are needed."""
    problem = oblique()
    turn = axes(problem)
    assert turn is not None
    other = turned_problem(problem, *turn)
    answer = linear_engine(other)
    found = Turned(matrix=turn[0], inverse=turn[1], problem=other, answer=answer, plain=answer)
    return certificate_text(problem, verdict_of(problem, {"linear": replace(answer, details=found)}))


_BASES["turned"] = turned_text


@forges("other coordinates have the stated inverse", "turned", _TURNED, "turned_model", "must be the inverse")
def _(data: Data) -> None:
    data["proof"]["inverse"][0][1] = exact(np.nextafter(1.0, 2.0))


@forges("a limit is exact in other coordinates", "turned", _TURNED, "_constraint", "is not exact")
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["normal"] = exact([0.1, 0.2])


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
