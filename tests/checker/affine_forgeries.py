"""Forged certificates of the exact law of linear models: part of ``FORGERIES``."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np

import certbound as cb
from certbound.safety.answers import exact
from certbound.safety.certificate import problem_data
from certbound.safety.certificates import law_proof
from tests.checker.affine.models import OPEN, correlated, oscillator
from tests.checker.forgeries import _BASES, BEYOND, MORE, Data, _sharp, forges

_LIMITS, _PROOF, _PIECES = "affine/affine_limits.py", "affine/proof.py", "affine/row_pieces.py"
_CROSSINGS = "affine/crossings.py"


def _written(build: Callable[[], cb.Problem]) -> Callable[[], str]:
    """The certificate as text, which claims what is proved of it."""

    def text() -> str:
        problem = build()
        proof, log10, _ = law_proof(problem)
        claim = {"log10_delta": exact(log10), "method": "affine", "assumptions": []}
        head: Data = {"format": "certbound certificate", "version": 1, "claim": claim}
        return json.dumps({**head, "problem": problem_data(problem), "proof": proof})

    return _sharp(text)


def _planned() -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x, u: [x[1], u[0] - x[0] - 0.4 * x[1]], states=2, inputs=cb.Box([-1], [1]), diffusion=[[0], [0.2]]
    )
    safe = [cb.Inside(cb.Box([-1.5, -OPEN], [1.5, OPEN]))]
    return cb.Problem(system, initial=[0, 0], safe=safe, horizon=8.0, plan=[[0.1]], delta=0.1)


def _pushed() -> cb.Problem:
    return oscillator(horizon=8.0, gain=[[0.0], [0.05]], bounds=[1.8, OPEN], drift=[0.0, 0.05])


_DRAWN = cb.GaussianStart([0.0, 0.0], [[0.05, 0.01], [0.01, 0.02]])

_BASES |= {
    "law": _written(lambda: oscillator(horizon=8.0)),
    "law, rough": _written(lambda: correlated(horizon=8.0)),
    "law, drawn": _written(lambda: correlated(horizon=8.0, initial=_DRAWN)),
    "law, starts": _written(lambda: oscillator(horizon=8.0, initial=cb.Box([-0.1, -0.1], [0.1, 0.1]))),
    "law, pushed": _written(_pushed),
    "law, planned": _written(_planned),
}


def _tape(data: Data, build: Callable[[Any], list[Any]], **given: Any) -> None:
    """Other dynamics in the problem."""
    system = cb.ContinuousSystem(build, states=2, diffusion=np.array([[0.0], [0.2]]), **given)
    problem = cb.Problem(system, initial=[0, 0], safe=[], horizon=8.0, delta=0.1)
    data["problem"]["dynamics"] = problem_data(problem)["dynamics"]


@forges("the law is one of continuous time", "law", _LIMITS, "affine_of", "continuous time")
def _(data: Data) -> None:
    noise = {"law": "gaussian", "level": "std", "values": exact([0.1]), "matrix": data["problem"]["noise"]["diffusion"]}
    data["problem"] |= {"time": "discrete", "noise": noise}


@forges("the model is linear", "law", _LIMITS, "affine_of", "affine in the states")
def _(data: Data) -> None:
    _tape(data, lambda x: [x[1], -np.sin(x[0]) - 0.2 * x[1]])


@forges("no jump is hidden in a linear model", "law", _LIMITS, "affine_of", "affine in the states")
def _(data: Data) -> None:
    _tape(data, lambda x: [x[1], -x[0] - 0.2 * x[1] + np.where(x[0] > 1, 1.0, 0.0)])


@forges("a linear model does not change with time", "law", _LIMITS, "affine_of", "change with time")
def _(data: Data) -> None:
    system = cb.ContinuousSystem(
        lambda t, x: [x[1], np.sin(t) - x[0] - 0.2 * x[1]], states=2, diffusion=np.array([[0.0], [0.2]])
    )
    problem = cb.Problem(system, initial=[0, 0], safe=[], horizon=8.0, delta=0.1)
    data["problem"]["dynamics"] = problem_data(problem)["dynamics"]


@forges("inputs of a linear model do not change", "law, planned", _LIMITS, "affine_of", "inputs that do not change")
def _(data: Data) -> None:
    data["problem"]["plan"] = exact([[0.1], [0.2]])


@forges("the law has the plan's input", "law, planned", _LIMITS, "affine_of", MORE)
def _(data: Data) -> None:
    data["problem"]["plan"] = exact([[0.15]])


@forges("noise of a linear model does not depend on the state", "law", _LIMITS, "affine_of", "neither on the state")
def _(data: Data) -> None:
    nodes = [["const", exact(0.0)], ["input", 1]]
    data["problem"]["noise"]["diffusion"] = {"columns": 1, "nodes": nodes, "outputs": [0, 1]}


@forges("the law is that of the stated slope", "law", "affine/gramians.py", "Transitions", MORE)
def _(data: Data) -> None:
    _tape(data, lambda x: [x[1], -x[0] - 0.19 * x[1]])


@forges("the law is that of the stated noise", "law", _LIMITS, "split_source", MORE)
def _(data: Data) -> None:
    data["problem"]["noise"]["diffusion"] = exact([[0.0], [0.201]])


@forges("the law counts to the horizon", "law", "affine/gramians.py", "Transitions", MORE)
def _(data: Data) -> None:
    data["problem"]["horizon"] = exact(8.5)


@forges("the law is kept within the stated limit", "law", _PROOF, "_level", MORE)
def _(data: Data) -> None:
    region = data["problem"]["constraints"][0]["region"]
    region["high"][0] = exact(1.49)


@forges("the mean takes the worst start", "law, starts", _PIECES, "Follower._means", MORE)
def _(data: Data) -> None:
    data["problem"]["initial"]["high"] = exact([0.11, 0.1])


@forges("the mean takes the worst disturbance", "law, pushed", _PIECES, "Follower._means", MORE)
def _(data: Data) -> None:
    data["problem"]["disturbance_set"] = [exact([-1.1, 1.0])]


@forges("something is left of a limit for the noise", "law, starts", _PROOF, "_level", "nothing is left")
def _(data: Data) -> None:
    data["problem"]["initial"] |= {"low": exact([1.5, 0.0]), "high": exact([1.5, 0.0])}


@forges("pieces leave no gap", "law", _PROOF, "_grids", "without a gap")
def _(data: Data) -> None:
    del data["proof"]["grids"][0][3]


@forges("pieces do not overlap", "law", _PROOF, "_grids", "without a gap")
def _(data: Data) -> None:
    data["proof"]["grids"][0].insert(3, 4)


@forges("every limit is followed", "law", _PROOF, "_plans", "must have 2 to 2 entries")
def _(data: Data) -> None:
    del data["proof"]["limits"][0]


@forges("a limit of the law is a fixed half-space", "law", _LIMITS, "limits_of", "half-spaces")
def _(data: Data) -> None:
    region = {"kind": "ball", "center": exact([0.0, 0.0]), "radius": exact(5.0), "coordinates": None}
    data["problem"]["constraints"].append({"kind": "inside", "region": region, "during": None, "label": "round"})


@forges("a limit of the law does not move", "law", _LIMITS, "limits_of", "do not move")
def _(data: Data) -> None:
    centre = {"nodes": [["input", 0], ["const", exact(0.0)]], "outputs": [0, 1]}
    data["problem"]["constraints"][0]["region"]["center"] = centre


@forges("noise of a row's own has windows", "law, rough", _PROOF, "_Law.cost", "must be a list")
def _(data: Data) -> None:
    data["proof"]["limits"][0]["windows"] = None


@forges("each piece has its number of windows", "law, rough", _PROOF, "_plans", "one entry for each")
def _(data: Data) -> None:
    data["proof"]["limits"][0]["windows"].append(1)


@forges("windows of a row are compared with a process that decays as fast", "law, rough", _CROSSINGS, "windows", BEYOND)
def _(data: Data) -> None:
    for limit in data["proof"]["limits"]:
        limit["windows"] = [1] * len(limit["windows"])


@forges("a normal start is split", "law, drawn", _LIMITS, "split_source", "needs `loss`")
def _(data: Data) -> None:
    del data["proof"]["loss"]


@forges("what the variance gains is positive", "law, drawn", _LIMITS, "split_source", "gains was not shown")
def _(data: Data) -> None:
    data["proof"]["loss"] = exact((np.zeros((2, 2))).tolist())
    data["problem"]["noise"]["diffusion"] = exact([[0.01, 0.0], [0.0, 0.01]])


@forges("a normal start has its mean", "law, drawn", _PIECES, "Follower._means", MORE)
def _(data: Data) -> None:
    data["problem"]["initial"]["mean"] = exact([0.05, 0.0])


@forges("limits of a linear model are added up", "law, rough", _PROOF, "check_affine", MORE)
def _(data: Data) -> None:
    row = data["problem"]["constraints"][0]
    data["problem"]["constraints"].append(row)
    data["proof"]["limits"] *= 2
