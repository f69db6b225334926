"""Forged certificates of value functions of targets, of paths that end, of any noise and of many steps.

Part of ``FORGERIES``.
"""

from __future__ import annotations

import math
from functools import partial

import certbound as cb
from certbound.safety.answers import exact
from tests.checker.forgeries import _BASES, Data, _scale, _sharp, _stated, forges
from tests.checker.value_forgeries import _below

LESS = "less than the claimed"
MORE = "more than the claimed"
_PROOF, _STEP, _PIECES = "values/proof.py", "values/step_back.py", "values/piece_means.py"


def _walk(**options) -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=["x"], noise=cb.Gaussian(std=0.3))
    given = {"initial": [0.5], "safe": [cb.Inside(cb.Box([-1], [1]))], "horizon": 4, "delta": 0.7}
    return cb.Problem(system, **given | options)


def met(then: str | None = None, **options) -> cb.Problem:
    """A walk to the middle, there to stay or not."""
    goal = cb.Reach(cb.Box([-0.2], [0.3]), during=(1, 3), then=then)
    return _walk(reach=goal, initial=[0.4], **options)


def ended(**options) -> cb.Problem:
    """A walk that ends where its domain is left."""
    limits = {"safe": [cb.Outside(cb.Box([0.8], [1.0]))], "domain": cb.Box([-1], [2]), "leaving": "ends"}
    return _walk(**limits | options)


def multiplied(**options) -> cb.Problem:
    """Noise that the state multiplies."""
    system = cb.DiscreteSystem(
        lambda x: 0.9 * x, states=["x"], noise=cb.Gaussian(std=0.3), noise_matrix=lambda x: [[0.5 + x[0]]]
    )
    return _walk(**options).replace(system=system)


def tailed(**options) -> cb.Problem:
    """Laplace noise, which has no variance proxy."""
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=["x"], noise=cb.Laplace(scale=0.1))
    return _walk(**options).replace(system=system)


def tossed() -> cb.Problem:
    """To 1, the end of the domain and of an obstacle, or to 0."""
    system = cb.DiscreteSystem(lambda x: 0.5 + 0 * x, states=["x"], noise=cb.Rademacher(scale=0.5))
    limits = {"safe": [cb.Outside(cb.Box([1.0], [2.0]))], "domain": cb.Box([-1], [1]), "leaving": "ends"}
    return cb.Problem(system, initial=[0.25], horizon=1, delta=0.7, **limits)


def long() -> cb.Problem:
    """More steps than are looked at."""
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=["x"], noise=cb.Gaussian(std=0.2))
    return _walk(horizon=9000, initial=[0.1]).replace(system=system)


def endless(**options) -> cb.Problem:
    """A target that is met at any time."""
    return _walk(reach=cb.Box([-0.2], [0.3]), horizon=math.inf, **options)


_LOW = 1e-3
_BASES |= {
    "met": _sharp(_stated(met, "values")),
    "met below": _sharp(_below(partial(met, delta=_LOW))),
    "kept": _sharp(_stated(partial(met, "stay", delta=0.95), "values")),
    "kept below": _sharp(_below(partial(met, "stay", delta=_LOW))),
    "ended": _sharp(_stated(ended, "values")),
    "ended below": _sharp(_below(partial(ended, delta=_LOW))),
    "multiplied": _sharp(_stated(multiplied, "values")),
    "multiplied below": _sharp(_below(partial(multiplied, delta=_LOW))),
    "tailed": _sharp(_stated(tailed, "values")),
    "tossed": _sharp(_stated(tossed, "values")),
    "long": _sharp(_stated(long, "values")),
    "endless": _sharp(_stated(endless, "values")),
    "endless below": _sharp(_below(partial(endless, delta=_LOW))),
}


def _region(data: Data, **ends: list[float]) -> None:
    """Another target."""
    data["problem"]["reach"]["region"] |= {side: exact(value) for side, value in ends.items()}


# ---- targets -------------------------------------------------------------------------------------------------


@forges("only a cell that lies in the target counts as met", "met", _STEP, "zones", MORE)
def _(data: Data) -> None:
    _region(data, high=[0.299])


@forges("only a cell that keeps off the target counts as not met from below", "met below", _STEP, "zones", LESS)
def _(data: Data) -> None:
    _region(data, high=[0.301])


@forges("a target is met in its window", "met", _STEP, "counts", MORE)
def _(data: Data) -> None:
    data["problem"]["reach"]["during"] = exact([2.0, 3.0])


@forges("who has not met the target at the end of its window has failed", "met", _PROOF, "_Discrete._value", MORE)
def _(data: Data) -> None:
    data["problem"]["reach"]["during"] = exact([1.0, 2.0])
    data["proof"]["count"] = 2
    data["proof"]["steps"].pop()


@forges("a target may be met until its window ends from below", "met below", _PROOF, "_Discrete._value", LESS)
def _(data: Data) -> None:
    data["problem"]["reach"]["during"] = exact([1.0, 4.0])
    data["proof"]["steps"].append(0)
    data["proof"]["count"] = 4


@forges("a limit counts before the target", "met", _PROOF, "_Discrete._settled", MORE)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["high"] = exact([0.29])
    data["problem"]["initial"] |= {"low": exact([0.28]), "high": exact([0.28])}
    data["proof"]["splits"] = [exact([0.28, 0.28])]


@forges("a start in the target has met it from below", "met below", _PROOF, "_Discrete._over_starts", "no bound")
def _(data: Data) -> None:
    data["problem"]["reach"]["during"] = exact([0.0, 3.0])
    _region(data, high=[0.6])


@forges("a target that is to be stayed in is not only met", "met", _PROOF, "_Discrete._arrived", MORE)
def _(data: Data) -> None:
    data["problem"]["reach"]["kind"] = "reach and stay"
    data["proof"]["steps"].append(0)
    del data["proof"]["count"]


@forges("who was in the target stays in it", "kept", _PROOF, "_Discrete._arrived", MORE)
def _(data: Data) -> None:
    _region(data, high=[0.299])


@forges("who leaves the target fails from below", "kept below", _PROOF, "_Discrete._arrived", LESS)
def _(data: Data) -> None:
    _region(data, high=[0.31])


@forges("only value functions prove that a target is stayed in", "kept", "claims.py", "_parts", "must be \"values\"")
def _(data: Data) -> None:
    data["proof"] = {"engine": "reach", "time": exact(3.0), "proof": data["proof"]}
    data["claim"]["method"] = "reach"


@forges("a proof looks at no more steps than there are", "met", _PROOF, "_Discrete._last", "not exceed the horizon")
def _(data: Data) -> None:
    data["proof"]["count"] = 5


# ---- paths that end ------------------------------------------------------------------------------------------


@forges("the grid holds the domain beyond which paths end", "ended", _PROOF, "_Discrete._check_domain", "hold the")
def _(data: Data) -> None:
    data["problem"]["domain"] = [exact([-1.0, 2.1])]


@forges("who leaves the domain has failed where that counts", "ended", _PROOF, "_Discrete", MORE)
def _(data: Data) -> None:
    del data["problem"]["leaving"]


@forges("nothing counts beyond the domain from below", "ended below", _PROOF, "_Discrete._settled", LESS)
def _(data: Data) -> None:
    data["problem"]["domain"] = [exact([-0.9, 0.9])]


# ---- any noise -----------------------------------------------------------------------------------------------


@forges("the noise is as large as the state makes it", "multiplied", _PIECES, "PieceTransition", MORE)
def _(data: Data) -> None:
    node = next(node for node in data["problem"]["noise"]["matrix"]["nodes"] if node == ["const", exact(0.5)])
    node[1] = exact(0.55)


@forges("the noise is as large as the state makes it from below", "multiplied below", _PIECES, "PieceTransition", LESS)
def _(data: Data) -> None:
    node = next(node for node in data["problem"]["noise"]["matrix"]["nodes"] if node == ["const", exact(0.5)])
    node[1] = exact(0.4)


@forges("pieces of the noise have the probability of its law", "tailed", _PIECES, "pieces_of", MORE)
def _(data: Data) -> None:
    _scale(data["problem"]["noise"], "values", 1.01)


@forges("pieces are of independent noise", "multiplied", _PIECES, "pieces_of", "independent entries")
def _(data: Data) -> None:
    data["problem"]["noise"] |= {"law": "bounded", "level": "halfwidth", "independent": False}


@forges("who touches an obstacle by noise in pieces has failed", "tossed", _STEP, "zones", MORE)
def _(data: Data) -> None:
    data["proof"]["grids"] = [[exact([-1.0, 0.5, 1.0])]]
    data["claim"]["log10_delta"] = exact(-3.0)


@forges("only value functions know steps whose noise the state multiplies", "still", "claims.py", "prove", "multi")
def _(data: Data) -> None:
    data["problem"]["noise"]["matrix"] = {"columns": 1, "nodes": [["const", exact(0.05)]], "outputs": [0]}


@forges("a law without a variance proxy has none", "still", "statement/problem.py", "Noise.covariance", "no variance")
def _(data: Data) -> None:
    data["problem"]["noise"] |= {"law": "laplace", "level": "scale"}


# ---- many steps ----------------------------------------------------------------------------------------------


@forges("what follows the steps that are looked at is paid for", "long", _PROOF, "_Discrete._later", MORE)
def _(data: Data) -> None:
    data["problem"]["horizon"] = exact(9100.0)


@forges("all steps are alike where not all are looked at", "long", _PROOF, "_Discrete._later", "must be alike")
def _(data: Data) -> None:
    nodes = data["problem"]["dynamics"]["nodes"]
    nodes += [["input", 0], ["const", exact(0.0)], ["mul", len(nodes), len(nodes) + 1]]
    nodes.append(["add", len(nodes) - 1, data["problem"]["dynamics"]["outputs"][0]])
    data["problem"]["dynamics"]["outputs"] = [len(nodes) - 1]


@forges("who has not met the target after the last step has failed", "endless", _PROOF, "_Discrete._value", MORE)
def _(data: Data) -> None:
    data["proof"]["count"] -= 2
    del data["proof"]["steps"][-2:]


@forges("who may still meet the target has not failed from below", "endless below", _PROOF, "_Discrete._value", LESS)
def _(data: Data) -> None:
    data["proof"]["count"] = 2
    del data["proof"]["steps"][2:]
