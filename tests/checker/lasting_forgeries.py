"""Forged certificates of proofs for every horizon at once: part of ``FORGERIES``."""

from __future__ import annotations

import json
import math
from functools import cache
from typing import Any
from unittest.mock import patch

import certbound as cb
from certbound.safety.answers import EngineAnswer, exact
from certbound.safety.certificate import problem_data
from certbound.safety.certificates import values_proof
from certbound.values.continuous import bound_rate
from tests.checker.forgeries import _BASES, Data, _sharp, _stated, forges
from tests.checker.value_forgeries import _below

_LASTING, _LEAVING = "endless/scale_function.py", "endless/eigenfunction.py"
_SURELY = "endless/surely.py"
_HALF = [cb.Inside(cb.HalfSpace([-1.0], 0.0))]


def drifting(**options) -> cb.Problem:
    """Brownian motion with drift from a barrier: exp(-2 x)."""
    system = cb.ContinuousSystem(lambda x: 0 * x + 1.0, states=["x"], diffusion=1.0)
    given = {"initial": [2.0], "safe": _HALF, "horizon": math.inf, "delta": 0.02, "name": "drift"} | options
    return cb.Problem(system, **given)


def growing() -> cb.Problem:
    """Geometric growth."""
    system = cb.ContinuousSystem(lambda x: 0.1 * x, states=["x"], diffusion=lambda x: [[0.2 * x[0]]])
    return drifting(initial=[2.0], safe=[cb.Inside(cb.HalfSpace([-1.0], -1.0))], delta=0.2).replace(system=system)


def met(delta: float = 0.2) -> cb.Problem:
    """Drift to a target, away from a barrier."""
    return drifting(initial=cb.Box([1.0], [1.5]), reach=cb.Reach(cb.Box([3.0], [4.0])), delta=delta)


def restless(delta: float = 0.5) -> cb.Problem:
    """Brownian motion between two limits, for ever."""
    system = cb.ContinuousSystem(lambda x: 0 * x, states=["x"], diffusion=1.0)
    return drifting(initial=[0.1], safe=[cb.Inside(cb.Box([-1.0], [1.0]))], delta=delta).replace(system=system)


def shaken_for_ever(delta: float = 0.5) -> cb.Problem:
    """A velocity with noise, for ever."""
    system = cb.ContinuousSystem(
        lambda x, d: [x[1], d[0] - x[1] - x[0] ** 3], states=["p", "v"], disturbance=cb.Box([-0.1], [0.1]),
        diffusion=lambda x: [[0.0], [0.5 + 0.2 * x[1]]],
    )
    safe = [cb.Inside(cb.Ball([0.0, 0.0], 1.0))]
    return cb.Problem(system, initial=[0.1, 0.0], safe=safe, horizon=math.inf, delta=delta, name="for ever")


def shaken_steps(delta: float = 0.5) -> cb.Problem:
    """Four states that normal noise shakes at every step, for ever."""
    system = cb.DiscreteSystem(lambda x: 0.8 * x, states=4, noise=cb.Gaussian(std=0.2))
    safe = [cb.Inside(cb.Box([-1.0] * 4, [1.0] * 4))]
    return cb.Problem(system, initial=[0.0] * 4, safe=safe, horizon=math.inf, delta=delta, name="steps for ever")


def lasting_steps() -> cb.Problem:
    """A random walk that drifts away from its limit."""
    system = cb.DiscreteSystem(lambda x: x + 0.3, states=["x"], noise=cb.Gaussian(std=0.5))
    return drifting(initial=[2.0], delta=0.02).replace(system=system)


def rested() -> cb.Problem:
    """The upper bound by the same rate, of a horizon that ends."""
    return restless(delta=0.99).replace(horizon=0.5)


@cache
def _rate() -> Any:
    return bound_rate(rested())


def _rate_below() -> str:
    """Of an infinite horizon, by the same functions."""
    with patch("certbound.safety.engines.values.bound_rate", lambda _: _rate()):
        return _below(restless)()


def _by_rate() -> str:
    problem, rate = rested(), _rate()
    answer = EngineAnswer(log10_delta=math.log10(rate.before(0.5)[1]), reason="", method="values", details=rate)
    proof, log10, _ = values_proof(problem, answer)
    claim = {"log10_delta": exact(log10), "method": "rate", "assumptions": []}
    whole = {"format": "certbound certificate", "version": 1, "claim": claim, "problem": problem_data(problem)}
    return json.dumps(whole | {"proof": proof})


_BASES |= {
    "lasting": _sharp(_stated(drifting, "values")),
    "lasting power": _sharp(_stated(growing, "values")),
    "lasting target": _sharp(_stated(met, "values")),
    "lasting below": _sharp(_below(lambda: met(delta=0.01))),
    "rate": _sharp(_by_rate),
    "rate below": _sharp(_rate_below),
    "surely": _sharp(_below(shaken_for_ever)),
    "surely steps": _sharp(_below(shaken_steps)),
    "drift": _sharp(_stated(lasting_steps, "values")),
}


@forges("psi is at most twice the drift", "lasting", _LASTING, "_Proof._check_cells", "on its side of the drift")
def _(data: Data) -> None:
    data["proof"]["slopes"][5] = exact(2.0001)


@forges("psi is at least twice the drift from below", "lasting below", _LASTING, "_Proof._check_cells", "on its side")
def _(data: Data) -> None:
    data["proof"]["slopes"][5] = exact(1.9999)


@forges("psi goes on at most as the drift", "lasting", _LASTING, "_Proof._check_tail", "last piece was not shown")
def _(data: Data) -> None:
    data["proof"]["tail"]["rate"] = exact(2.0001)


@forges("psi goes on as a power at most", "lasting power", _LASTING, "_Proof._check_tail", "last piece was not shown")
def _(data: Data) -> None:
    data["proof"]["tail"]["rate"] = exact(5.0001)


@forges("the last piece has an integral", "lasting power", _LASTING, "_Proof._check_tail", "no finite integral")
def _(data: Data) -> None:
    data["proof"]["tail"]["rate"] = exact(1.0)


@forges("no constraint ends a line without an end", "lasting", _LASTING, "_Proof._check_sets", "ends the line")
def _(data: Data) -> None:
    region = {"kind": "halfspace", "normal": exact([1.0]), "bound": exact(1e6)}
    data["problem"]["constraints"].append(data["problem"]["constraints"][0] | {"region": region})


@forges("the interval breaks no constraint", "lasting target", _LASTING, "_Proof._check_sets", "kept on the whole")
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["bound"] = exact(-0.01)


@forges("the interval ends in the target", "lasting target", _LASTING, "_Proof._check_sets", "lie in the target")
def _(data: Data) -> None:
    data["problem"]["reach"]["region"]["low"] = exact([3.01])


@forges("without a target the line has no end", "lasting", _LASTING, "_Proof.check", "the interval ends")
def _(data: Data) -> None:
    data["proof"]["tail"] = None


@forges("a target is met at any time", "lasting target", _LASTING, "_Proof.check", "needs an infinite horizon")
def _(data: Data) -> None:
    data["problem"]["horizon"] = exact(5.0)


@forges("all starts lie in the interval", "lasting target", _LASTING, "_Proof", "lie in the interval")
def _(data: Data) -> None:
    data["problem"]["initial"]["high"] = exact([9.0])


@forges("the limit is broken beyond the interval from below", "lasting below", _LASTING, "_Proof._check_sets", "beyond")
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["bound"] = exact(0.01)


@forges("the interval from below keeps off the target", "lasting below", _LASTING, "_Proof._check_sets", "keep off")
def _(data: Data) -> None:
    data["problem"]["reach"]["region"]["low"] = exact([2.99])


@forges("a lower bound of all times needs all times", "lasting below", _LASTING, "check_lasting_below", "infinite")
def _(data: Data) -> None:
    data["problem"]["horizon"] = exact(5.0)


@forges("a function of the state alone knows no time", "lasting", _LASTING, "_Proof._check_clock", "depend on time")
def _(data: Data) -> None:
    nodes = data["problem"]["dynamics"]["nodes"]
    nodes += [["input", 0], ["add", len(nodes), data["problem"]["dynamics"]["outputs"][0]]]
    data["problem"]["dynamics"]["outputs"] = [len(nodes) - 1]


@forges("only some proofs know an infinite horizon", "leaving", "claims.py", "prove", "needs a finite horizon")
def _(data: Data) -> None:
    data["problem"]["horizon"] = None


@forges("v changes at its rate", "rate", _LEAVING, "_Leaving._check_generator", "change at the stated rate")
def _(data: Data) -> None:
    data["proof"]["rate"] = exact(float.fromhex(data["proof"]["rate"]) * 0.99)


@forges("v changes at its rate from below", "rate below", _LEAVING, "_Leaving._check_generator", "change at the stated")
def _(data: Data) -> None:
    data["proof"]["rate"] = exact(float.fromhex(data["proof"]["rate"]) * 1.05)


@forges("v is at most 0 at the ends", "rate", _LEAVING, "_Leaving._check_values", "at most 0 at the ends")
def _(data: Data) -> None:
    data["proof"]["coefficients"][0] = exact(float.fromhex(data["proof"]["coefficients"][0]) + 0.01)


@forges("v is what it is at the starts", "rate", _LEAVING, "_Leaving._check_values", "what is stated")
def _(data: Data) -> None:
    data["problem"]["initial"] |= {"low": exact([0.5]), "high": exact([0.5])}


@forges("v is what it is on all states from below", "rate below", _LEAVING, "_Leaving._check_values", "what is stated")
def _(data: Data) -> None:
    data["proof"]["extreme"] = exact(float.fromhex(data["proof"]["extreme"]) * 1.1)


@forges("the interval of v lies in the safe set", "rate", _LEAVING, "_Leaving._check_interval", "lie in the safe set")
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["high"] = exact([0.99])


@forges("the interval of v holds the safe set from below", "rate below", _LEAVING, "_Leaving._check_interval", "lie in")
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["high"] = exact([1.2])


@forges("noise shakes a state everywhere", "surely", _SURELY, "check_surely_below", "the noise of the state")
def _(data: Data) -> None:
    data["proof"]["noise"] = exact(0.0901)


@forges("normal noise shakes a state at every step", "surely steps", _SURELY, "check_surely_below", "to be at least")
def _(data: Data) -> None:
    data["problem"]["noise"]["values"] = exact([0.199] * 4)


@forges("noise within bounds leads nowhere surely", "surely steps", _SURELY, "check_surely_below", "normal noise")
def _(data: Data) -> None:
    data["problem"]["noise"] |= {"law": "uniform", "level": "halfwidth"}


@forges("the drift against the way out is bounded", "surely", _SURELY, "check_surely_below", "the drift of the state")
def _(data: Data) -> None:
    data["proof"]["drift"] = exact(float.fromhex(data["proof"]["drift"]) * 0.6)


@forges("only who may go on for ever leaves surely", "surely", _SURELY, "check_surely_below", "infinite horizon")
def _(data: Data) -> None:
    data["problem"]["horizon"] = exact(5.0)


@forges("a bounded set is left surely", "surely", "statement/safe_set.py", "SafeSet", "bounds p")
def _(data: Data) -> None:
    region = {"kind": "halfspace", "normal": exact([1.0, 0.0]), "bound": exact(1.0)}
    data["problem"]["constraints"][0]["region"] = region


@forges("what leads every path out bounds nothing from above", "surely", _SURELY, "check_surely", "from below only")
def _(data: Data) -> None:
    del data["claim"]["log10_lower"], data["proof"]["side"]
    data["claim"]["log10_delta"] = exact(-1.0)


@forges(
    "who leaves the domain has not failed where a path ends there", "surely steps", "claims.py", "check_side",
    "path ends",
)
def _(data: Data) -> None:
    data["problem"] |= {"domain": [exact([-0.5, 0.5])] * 4, "leaving": "ends"}


@forges("the drift outweighs the noise", "drift", _LASTING, "check_drift", "outweigh the noise")
def _(data: Data) -> None:
    data["problem"]["noise"]["values"] = exact([0.51])


@forges("the drift leads away from the only limit", "drift", _LASTING, "check_drift", "kept on the whole half-line")
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["bound"] = exact(-0.01)


@forges("the starts are as far from the limit as counted", "drift", "check.py", "_compare", "more than the claimed")
def _(data: Data) -> None:
    data["problem"]["initial"] |= {"low": exact([1.99]), "high": exact([1.99])}
