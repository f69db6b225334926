"""Forged certificates: for every inequality that a proof rests on, a file that violates just this one.

Each is made from a certificate that is proved, so that nothing else is wrong with it. ``FORGERIES`` is keyed by the
inequality's name in docs/certificate.md.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
from flint import arb

import certbound as cb
from certbound.checker import Report, check, check_data, parse
from certbound.checker.claims import prove
from certbound.safety.answers import exact
from certbound.safety.certificate import certificate_text, problem_data, restated
from tests.checker import conftest
from tests.checker.linear.test_diffusion import growth
from tests.checker.test_adversary import jumping, linear
from tests.checker.test_barrier import by_hand, kinked

Data = dict[str, Any]

MORE = "more than the claimed"
BEYOND = f"{MORE}|nothing is left"


@dataclass(frozen=True, kw_only=True)
class Forgery:
    """How a proved certificate is forged, and what the checker says: the function ``place`` of ``file`` refuses it."""

    base: str
    file: str
    place: str
    reason: str
    change: Callable[[Data], None]


FORGERIES: dict[str, Forgery] = {}


def forges(
    name: str, base: str, file: str, place: str, reason: str
) -> Callable[[Callable[[Data], None]], Callable[[Data], None]]:
    """Enter a change into the table."""

    def enter(change: Callable[[Data], None]) -> Callable[[Data], None]:
        assert name not in FORGERIES
        FORGERIES[name] = Forgery(base=base, file=file, place=place, reason=reason, change=change)
        return change

    return enter


# ---- certificates that are proved ----------------------------------------------------------------------------


def _cornered() -> cb.Problem:
    faces = ([1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0])
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=2, noise=cb.Gaussian(std=0.1))
    safe = [cb.Inside(cb.HalfSpace(face, 0.25)) for face in faces]
    return cb.Problem(system, initial=[0, 0], safe=safe, horizon=2, delta=0.2)


def _unequal() -> cb.Problem:
    system = cb.DiscreteSystem(
        lambda x: [x[1], 0 * x[1]], states=2, noise=cb.Gaussian(covariance=[[1e12, 0], [0, 0.01]])
    )
    safe = [cb.Inside(cb.HalfSpace([0.0, 1.0], 1.0))]
    return cb.Problem(system, initial=[0, 0], safe=safe, horizon=3, delta=0.5)


def _still() -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: [0.5 * x[0] - 0.1 * x[0] ** 3], states=["x"], noise=cb.Gaussian(std=0.05))
    return cb.Problem(
        system, initial=[0.2], safe=[cb.Inside(cb.Box([-1], [1]))], domain=cb.Box([-2], [2]), horizon=3
    )


def _random() -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=2, noise=cb.Gaussian(std=0.05))
    start = cb.GaussianStart([0, 0], 0.01 * np.eye(2))
    return cb.Problem(system, initial=start, safe=[cb.Inside(cb.Ball([0, 0], 1.0))], horizon=3, delta=1e-2)


def _bounded() -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=2, noise=cb.Uniform(halfwidth=[0.1, 0.05]))
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    return cb.Problem(system, initial=[0.2, 0.1], safe=safe, horizon=3, delta=1e-2)


def _long() -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: 0.95 * x, states=2, noise=cb.Uniform(halfwidth=[0.1, 0.05]))
    return cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=30, delta=1e-2)


def _planned() -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x, u: [-x[0] + u[0]], states=["x"], inputs=cb.Box([-1], [1]), diffusion=[[0.1]]
    )
    safe = [cb.Inside(cb.Box([-1], [1]))]
    return cb.Problem(system, initial=[0], safe=safe, horizon=1.0, plan=[[0.2], [-0.2]], delta=1e-2)


def _bent() -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: [0.5 * np.abs(x[0])], states=["x"], noise=cb.Gaussian(std=0.05))
    return cb.Problem(system, initial=cb.Box([-0.1], [0.1]), safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3)


def _rising() -> Data:
    """x' = 10 tanh(40 (t + 1/2)) + .01 dW from 0 with x <= 12, by constants: x(1) is 10."""
    system = cb.ContinuousSystem(
        lambda t, x: [10 * np.tanh(40 * (t + 0.5)) + 0 * x[0]], states=["x"], diffusion=[[0.01]]
    )
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.HalfSpace([1.0], 12.0))], horizon=1.0)
    cell = {
        "nominal": [exact([[0.0], [10.0]]), exact([[5.0], [10.0]])], "eta": exact([0.1, 0.1]),
        "radius": exact([0.1, 0.2]), "separations": [None],
    }  # fmt: skip
    proof = {
        "engine": "constants", "assumed": False, "metric": None, "region": "everywhere",
        "times": exact([0.0, 0.5, 1.0]), "middles": exact([0.0, 0.5]), "rate": exact(1e-6), "sigma": exact(0.0101),
        "nu": exact(1.0), "start_sigma": exact(0.0), "splits": [exact([0.0, 0.0])], "rooms": exact([0.5, 0.5]),
        "kummer": {"form": "kummer", "a": exact(100.0), "v0": exact(1e-6)}, "cells": [cell],
    }  # fmt: skip
    return {
        "format": "certbound certificate", "version": 1, "problem": problem_data(problem), "proof": proof,
        "claim": {"log10_delta": exact(-180.0), "method": "constants", "assumptions": []},
    }  # fmt: skip


def _drawn() -> cb.Problem:
    system = cb.DiscreteSystem(
        lambda x, d: [d[0] * x[0]], states=["x"], disturbance=cb.Box([0.4], [0.8]), disturbance_names=["gain"],
        noise=cb.Gaussian(std=0.25),
    )
    law = {"gain": cb.Random(law=cb.Uniform(halfwidth=0.2), mean=0.6)}
    return cb.Problem(
        system, initial=[0.3], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=2, delta=0.0035, random=law
    )


def _switched() -> cb.Problem:
    system = cb.ContinuousSystem(lambda t, x: [-x[0] + np.where(t < 1, 0.2, -0.2)], states=["x"], diffusion=0.1)
    return cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=2)


def _crossed() -> cb.Problem:
    """A start on which x + y is nearly 0, and y has a remainder that reads x and z."""
    system = cb.DiscreteSystem(
        lambda x: [0.5 * x[0] + 0.1 * x[1], 0.5 * x[1] + 0.3 * x[0] * x[2] + 0.01 * x[0] ** 2,
                   0.5 * x[2] + 0.3 * x[0] * x[1]],
        states=["x", "y", "z"], noise=cb.Gaussian(std=1e-3),
    )
    start = cb.GaussianStart([0, 0, 0], 1e-2 * np.array([[1, -0.9999, 0], [-0.9999, 1, 0], [0, 0, 0.1]]))
    return cb.Problem(system, initial=start, safe=[cb.Inside(cb.Ball([0, 0, 0], 3.0))], horizon=2, delta=1e-2)


def _sampled() -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x, u: [u[0]], states=["x"], inputs=cb.Box([-1], [1]), diffusion=[[0.05]]
    )
    safe = [cb.Inside(cb.Box([-1], [1]))]
    return cb.Problem(
        system, initial=[0.2], safe=safe, horizon=0.4, delta=1e-3, plan=lambda x: -np.sin(x[0]), hold=0.2
    )


def _stated(build: Callable[[], cb.Problem], method: str) -> Callable[[], str]:
    def text() -> str:
        return certificate_text(*conftest.proved(build, method))

    return text


_PROVED: dict[str, arb] = {}  # of what ``_sharp`` has written


def _sharp(written: Callable[[], str]) -> Callable[[], str]:
    """A certificate by value functions that claims what is proved of it, and no more."""

    def text() -> str:
        found, seen = written(), []

        def looked(*args: Any, **options: Any) -> arb:
            seen.append(prove(*args, **options))
            return seen[-1]

        with patch.object(check, "prove", looked):
            report = check_data(parse(found))
        lower = report.log10_lower is not None
        proved = report.log10_lower_proved if lower else report.log10_proved
        assert proved is not None
        sharp = restated(found, proved, lower=lower)
        (_PROVED[sharp],) = seen
        return sharp

    return text


def report_of(base: str) -> Report:
    """What the checker says of a certificate; another claim changes nothing of what is proved of the same numbers."""
    known = _PROVED.get(text(base))
    with nullcontext() if known is None else patch.object(check, "prove", lambda *_, **__: known):
        return check_data(parse(text(base)))


_BASES: dict[str, Callable[[], str]] = {
    "steps": _stated(conftest.steps, "linear"),
    "flow": _stated(conftest.flow, "linear"),
    "stirred": _stated(conftest.stirred, "linear"),
    "growth": _stated(growth, "linear"),
    "cornered": _stated(_cornered, "linear"),
    "unequal": _stated(_unequal, "linear"),
    "bent": _stated(_bent, "linear"),
    "crossed": _stated(_crossed, "linear"),
    "sampled": _stated(_sampled, "linear"),
    "bounded steps": _stated(_long, "linear"),
    "steps within reach": _stated(_bounded, "linear"),
    "straight": lambda: json.dumps(linear()),
    "disturbed": lambda: json.dumps(linear(disturbance=cb.Box([0.0], [0.1]))),
    "contraction": _stated(conftest.contraction, "constants"),
    "still": _stated(_still, "constants"),
    "random": _stated(_random, "constants"),
    "bounded": _stated(_bounded, "constants"),
    "switched": _stated(_switched, "linear"),
    "drawn": _stated(_drawn, "values"),
    "planned": _stated(_planned, "constants"),
    "rising": lambda: json.dumps(_rising()),
    "valued": _sharp(_stated(conftest.valued, "values")),
    "valued plane": _sharp(_stated(conftest.valued_plane, "values")),
    "leaving": _sharp(lambda: conftest.exit_certificate(conftest.leaving)),
    "barrier": lambda: json.dumps(by_hand(kinked(), 8.0, 0.7201, 0.0801, 7.999)),
    "steady": lambda: json.dumps(by_hand(kinked(horizon=30.0), 8.0, 0.0, 0.0801, 7.999, 2.4215e-4)),
}


@cache
def text(base: str) -> str:
    """A certificate that is proved."""
    return _BASES[base]()


def forged(name: str) -> Data:
    """The forged certificate of an inequality."""
    forgery = FORGERIES[name]
    data = parse(text(forgery.base))
    forgery.change(data)
    return data


# ---- small changes -------------------------------------------------------------------------------------------


def _scale(holder: Any, key: Any, factor: float, shift: float = 0.0) -> None:
    value = holder[key]
    if isinstance(value, list):
        for place in range(len(value)):
            _scale(value, place, factor, shift)
    else:
        holder[key] = exact(float.fromhex(value) * factor + shift)


def _cell(data: Data) -> Data:
    found: Data = data["proof"]["cells"][0]
    return found


def _claim(data: Data, level: float) -> None:
    data["claim"]["log10_delta"] = exact(level)


def _from(data: Data, low: list[float], high: list[float]) -> None:
    """Another initial box, and one cell that is just this."""
    data["problem"]["initial"] |= {"low": exact(low), "high": exact(high)}
    data["proof"]["splits"] = [exact([a, b]) for a, b in zip(low, high)]


# ---- what every proof rests on -------------------------------------------------------------------------------


@forges("the claimed probability is at least what follows", "still", "check.py", "_compare", MORE)
def _(data: Data) -> None:
    _claim(data, -44.9)


@forges(
    "the problem is the given one", "still", "statement/comparison.py", "first_difference", "speaks of another problem",
)
def _(data: Data) -> None:
    region = data["problem"]["constraints"][0]["region"]
    region["low"], region["high"] = exact([-1.1]), exact([1.1])


@forges(
    "a covariance is positive semidefinite", "unequal", "statement/problem.py", "_semidefinite", "negative variance",
)
def _(data: Data) -> None:
    data["problem"]["noise"]["values"][1][1] = exact(-0.5)
    _claim(data, -100.0)


@forges("no correlation exceeds 1", "unequal", "statement/problem.py", "_semidefinite", "must be positive semidefinite")
def _(data: Data) -> None:
    data["problem"]["noise"]["values"] = exact([[1e12, 2e5], [2e5, 0.01]])


@forges("the cells cover the initial set", "steps", "statement/partition.py", "cells_of", "do not cover")
def _(data: Data) -> None:
    top = float.fromhex(data["problem"]["initial"]["high"][0])
    data["proof"]["splits"][0][-1] = exact(float(np.nextafter(top, 0.0)))


# ---- the linear response -------------------------------------------------------------------------------------


@forges(
    "every entry of a Jacobian that varies is stated", "steps", "linear/shared.py", "Shared", "entries of the Jacobian",
)
def _(data: Data) -> None:
    del data["proof"]["varying"][0]
    for row in _cell(data)["slopes"]:
        del row[0]


@forges("every jump is decided", "straight", "linear/proof.py", "_Cell._check_remainder", "may jump with x")
def _(data: Data) -> None:
    jumping(data, "sign", 1, 0.2)


@forges("a jump in time lies between two pieces", "switched", "time_pieces.py", "_step", "decides no jump")
def _(data: Data) -> None:
    constants = [node for node in data["problem"]["dynamics"]["nodes"] if node == ["const", exact(1.0)]]
    for node in constants:
        node[1] = exact(0.75)


@forges("cells of drawn constants do not overlap", "drawn", "statement/drawn.py", "weights_of", "must not overlap")
def _(data: Data) -> None:
    for cell in data["proof"]["cells"]:
        cell["high"] = [exact(0.8)]


@forges("what lies in no cell counts as failing", "drawn", "claims.py", "_average", MORE)
def _(data: Data) -> None:
    data["problem"]["random"]["gain"]["mean"] = exact(0.62)


@forges("what is drawn beyond the disturbances' set counts as failing", "drawn", "claims.py", "_cells", "beyond which")
def _(data: Data) -> None:
    data["problem"]["disturbance_set"] = [[exact(0.45), exact(0.8)]]


@forges("of a union what is drawn is averaged member by member", "drawn", "claims.py", "prove", MORE)
def _(data: Data) -> None:
    start, proof = data["problem"]["initial"], data["proof"]
    proof["cells"].pop()
    data["problem"]["initial"] = {"kind": "union", "members": [start, start]}
    data["claim"]["method"], data["proof"] = "union", {"engine": "union", "members": [proof, proof]}


@forges("a constant derivative is defined", "straight", "statement/structure.py", "_values", "is not defined")
def _(data: Data) -> None:
    tape = data["problem"]["dynamics"]
    nodes = tape["nodes"]
    n = len(nodes)
    nodes += [["const", exact(0.0)], ["div", n, n], ["input", 1], ["mul", n + 1, n + 2]]
    nodes.append(["add", tape["outputs"][0], n + 3])
    tape["outputs"] = [n + 4]


@forges("the nominal curve does not jump", "flow", "linear/proof.py", "_Cell", "curve jumps")
def _(data: Data) -> None:
    pieces = _cell(data)["nominal"]
    for piece in pieces[len(pieces) // 2 :]:
        for point in piece:
            point[0] = exact(float.fromhex(point[0]) + 1e-9)


@forges(
    "every state that enters nonlinearly has levels", "flow", "linear/proof.py", "_Cell._frames", "enters nonlinearly",
)
def _(data: Data) -> None:
    data["proof"]["units"] = []
    cell = _cell(data)
    cell["levels"], cell["rows"] = [[] for _ in cell["levels"]], [[] for _ in cell["rows"]]


@forges("the rows of a frame are independent", "steps", "linear/remainder.py", "_Frame", "not regular")
def _(data: Data) -> None:
    _cell(data)["frames"][1] = [0, 0]


@forges("the rows of a frame are as many as its states", "steps", "linear/remainder.py", "_Frame", "as many rows")
def _(data: Data) -> None:
    _cell(data)["frames"][1] = [0]


@forges(
    "the remainder lies in its box at every step", "steps", "linear/remainder.py", "OutputRemainder.prove",
    "in its box",
)
def _(data: Data) -> None:
    _scale(_cell(data)["slopes"][2], 0, 1.0, 0.3)
    _claim(data, -3.9)


@forges(
    "the remainder lies in its box over a piece", "flow", "linear/remainder.py", "OutputRemainder.prove", "in its box",
)
def _(data: Data) -> None:
    _scale(_cell(data)["drifts"][10], 0, 1.0, 20.0)


@forges(
    "a kinked remainder lies in its box", "bent", "linear/remainder.py", "OutputRemainder._kinked_form", "in its box",
)
def _(data: Data) -> None:
    _scale(_cell(data)["slopes"][0], 0, 1.0, 1.0)
    _claim(data, -23.0)


@forges("the series of a piece converge", "flow", "linear/response.py", "_piece", "too long for the slope")
def _(data: Data) -> None:
    _scale(_cell(data)["slopes"][3], 0, 1.0, 1e4)


@forges("y starts anywhere in its cell", "straight", "linear/response.py", "_carried", BEYOND)
def _(data: Data) -> None:
    _from(data, [0.1], [0.95])


@forges("y takes every disturbance", "disturbed", "linear/proof.py", "_Cell._load", BEYOND)
def _(data: Data) -> None:
    data["problem"]["disturbance_set"] = [exact([-0.35, 0.45])]  # the same middle


@forges("Z has the covariance of the noise", "straight", "linear/response.py", "covariances", MORE)
def _(data: Data) -> None:
    _scale(data["problem"]["noise"], "values", 1.1)


@forges("a constraint leaves the room that is used", "straight", "statement/rooms.py", "_demand", BEYOND)
def _(data: Data) -> None:
    _scale(data["problem"]["constraints"][0]["region"], "high", 0.8)


@forges(
    "a direction keeps all of an obstacle off", "steps", "statement/regions.py", "Constraint.read_separation",
    "nothing is",
)
def _(data: Data) -> None:
    for row in _cell(data)["separations"][1]:
        _scale([row], 0, -1.0)


@forges("weights of faces are not negative", "steps", "statement/regions.py", "Constraint._mixed", "at least 0")
def _(data: Data) -> None:
    rows = _cell(data)["separations"][2]
    rows[:] = [exact([0.0, 0.0, 0.0, -1.0])] * len(rows)


@forges(
    "an obstacle is kept off at every moment of a piece", "flow", "statement/rooms.py", "centres_of", "nothing is left",
)
def _(data: Data) -> None:
    tape = data["problem"]["constraints"][1]["region"]["center"]  # o(t) (1 - exp(-(1e4 (t - .615))^2))
    nodes = tape["nodes"]
    n = len(nodes)
    nodes += [["input", 0], ["const", exact(0.615)], ["sub", n, n + 1], ["const", exact(1e4)], ["mul", n + 2, n + 3]]
    nodes += [["sq", n + 4], ["neg", n + 5], ["exp", n + 6], ["const", exact(1.0)], ["sub", n + 8, n + 7]]
    nodes += [["mul", output, n + 9] for output in tape["outputs"]]
    tape["outputs"] = [n + 10, n + 11]


@forges("a constraint is asked on all of its window", "flow", "statement/rooms.py", "Grid.asked", "nothing is left")
def _(data: Data) -> None:
    constraint = data["problem"]["constraints"][1]
    constraint["during"] = exact([0.615, 0.6150001])
    constraint["region"]["center"] = exact([0.2, -0.3])


@forges("levels are not negative", "steps", "linear/proof.py", "_Cell._rows", "at least 0")
def _(data: Data) -> None:
    _cell(data)["levels"][2][0] = exact(-1.0)


@forges("a level costs what Z exceeds it, in steps", "steps", "linear/events.py", "chain", MORE)
def _(data: Data) -> None:
    _scale(_cell(data)["levels"], 3, 0.3)


@forges("a level costs what Z exceeds it, in windows", "flow", "linear/events.py", "Windows.exceedance", BEYOND)
def _(data: Data) -> None:
    _scale(_cell(data)["levels"], 8, 0.3)


@forges("levels of the martingale's coordinates cost", "flow", "linear/events.py", "Windows.coordinates", BEYOND)
def _(data: Data) -> None:
    _scale(_cell(data)["window_levels"], 12, 0.3)


@forges("noise that is only sub-Gaussian has its own tail", "steps", "linear/events.py", "sub_gaussian", MORE)
def _(data: Data) -> None:
    data["problem"]["noise"]["law"] = "subgaussian"


@forges("a level costs what sub-Gaussian noise exceeds it", "bounded steps", "linear/proof.py", "_Cell._leaving", MORE)
def _(data: Data) -> None:
    data["problem"]["noise"] |= {"law": "bounded", "level": "halfwidth", "independent": False}


@forges("only noise of bounded entries has a reach", "steps within reach", "linear/proof.py", "_Cell._drives", MORE)
def _(data: Data) -> None:
    data["problem"]["noise"] = {
        "law": "subgaussian", "level": "std", "values": exact([0.1, 0.05]), "matrix": data["problem"]["noise"]["matrix"]
    }  # fmt: skip


@forges("bounded noise takes all of its reach", "steps within reach", "linear/events.py", "bounded_drives", MORE)
def _(data: Data) -> None:
    data["problem"]["noise"]["values"] = exact([0.6, 0.05])


@forges("only opposite requirements share a product", "cornered", "linear/families.py", "correlated", MORE)
def _(data: Data) -> None:
    data["problem"]["constraints"][1]["region"]["normal"] = exact([-1.0, 1e-12])


@forges("the windows begin at 0 and rise", "flow", "linear/shared.py", "Shared", "must rise from 0")
def _(data: Data) -> None:
    data["proof"]["windows"][0] = 1


@forges(
    "a row over further states leaves what these may add", "crossed", "linear/remainder.py", "_Frame._cut", "of y was",
)
def _(data: Data) -> None:
    for name in ("remainder_low", "remainder_high"):  # enough where x + y = 0 would say that x = 0
        _scale(_cell(data)[name][0], 1, 0.6)


# ---- inputs that are held ------------------------------------------------------------------------------------


@forges(
    "what a law leaves over at a sample lies in its box", "sampled", "linear/proof.py", "_Cell._check_remainder",
    "remainder of u",
)
def _(data: Data) -> None:
    sample = data["proof"]["pieces"] // 2
    for name in ("remainder_low", "remainder_high"):
        _cell(data)[name][sample] = exact([0.0, 0.0])


@forges(
    "every entry of a law that varies is stated", "sampled", "linear/samplers.py", "sampler_of", "entries of the law's",
)
def _(data: Data) -> None:
    del data["proof"]["sampled"][0]
    for row in _cell(data)["sampled"]:
        del row[0]


@forges("no sample lies inside a window", "sampled", "linear/events.py", "Windows", "window is too long")
def _(data: Data) -> None:
    place = data["proof"]["windows"].index(data["proof"]["pieces"] // 2)
    del data["proof"]["windows"][place], _cell(data)["window_levels"][place]


# ---- noise that depends on the state -------------------------------------------------------------------------


def _stopped(data: Data) -> Data:
    found: Data = _cell(data)["stopped"]
    return found


@forges(
    "the state stays inside the set of its noise", "stirred", "linear/diffusion.py", "StateNoise.holds",
    "to stay in the set",
)
def _(data: Data) -> None:
    _scale(_stopped(data)["high"], 10, 0.5)


@forges(
    "the excess of the noise is bounded over its set", "stirred", "linear/diffusion.py", "StateNoise.excess",
    "in its box",
)
def _(data: Data) -> None:
    _scale(_stopped(data), "reference", 0.95)  # more is M's, whose levels widen what the remainder must hold on
    _claim(data, -4.0)


@forges(
    "the noise depends on states with bounds only", "growth", "linear/diffusion.py", "StateNoise.excess",
    "noise depends on",
)
def _(data: Data) -> None:
    data["proof"]["units"] = []
    cell, stopped = _cell(data), _stopped(data)
    for holder, name in ((cell, "levels"), (cell, "rows"), (stopped, "low"), (stopped, "high")):
        holder[name] = [[] for _ in holder[name]]
    stopped["rows"] = []


@forges("levels of M's coordinates cost", "stirred", "linear/diffusion.py", "Stopped", BEYOND)
def _(data: Data) -> None:
    _scale(_stopped(data), "coordinates", 0.3)


@forges("levels of M along the rows cost", "stirred", "linear/diffusion.py", "Stopped.along", BEYOND)
def _(data: Data) -> None:
    _scale(_stopped(data)["rows"], 0, 0.3)


@forges("the part of a room that is M's costs", "stirred", "linear/diffusion.py", "Stopped.along", BEYOND)
def _(data: Data) -> None:
    _scale(_stopped(data), "rooms", 0.3)


@forges("all of a room that is M's costs", "growth", "linear/diffusion.py", "_beyond", BEYOND)
def _(data: Data) -> None:
    _scale(data["problem"]["constraints"][0]["region"], "bound", 0.9)


@forges("all of a room is M's where Z is 0", "stirred", "linear/diffusion.py", "StateNoise", "where all noise is in M")
def _(data: Data) -> None:
    _stopped(data)["rooms"] = None


@forges("the windows of M begin at 0 and rise", "stirred", "linear/diffusion.py", "StateNoise", "must rise from 0")
def _(data: Data) -> None:
    _stopped(data)["windows"][0] = 1


# ---- constants -----------------------------------------------------------------------------------------------


@forges(
    "the pieces cover the horizon", "contraction", "constants/proof.py", "_Proof._read_times",
    "do not cover the horizon",
)
def _(data: Data) -> None:
    data["problem"]["horizon"] = exact(2.0)


@forges(
    "a polynomial is written about a time in its piece", "rising", "constants/proof.py", "_Proof._read_times",
    "outside its",
)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["bound"] = exact(1.0)
    data["proof"]["middles"] = exact([-10.0, -10.0])  # there the velocity is -10
    _cell(data)["nominal"] = [exact([[100.0], [-10.0]])] * 2


@forges("the metric is positive definite", "contraction", "balls/eigen.py", "cholesky", "not positive definite")
def _(data: Data) -> None:
    data["proof"]["metric"] = exact([[1.0, 0.0], [0.0, -1.0]])


@forges(
    "the defect of the nominal curve is at most eta", "contraction", "constants/reach_tube.py", "Tube.defect", "defect",
)
def _(data: Data) -> None:
    _scale(_cell(data)["eta"], 60, 0.9)


@forges(
    "the defect holds for every disturbance", "contraction", "constants/reach_tube.py", "Tube._with_disturbance",
    "defect",
)
def _(data: Data) -> None:
    data["problem"]["disturbance_set"] = [exact([-1.1, 1.1])]


@forges(
    "an input of the plan holds on its own piece", "planned", "constants/reach_tube.py", "Tube.inputs",
    "between two changes",
)
def _(data: Data) -> None:
    proof, cell = data["proof"], _cell(data)
    middle = proof["times"].index(exact(0.5))
    for holder, name in ((proof, "times"), (proof, "middles"), (proof, "rooms")):
        del holder[name][middle]
    proof["middles"][middle - 1] = exact(0.5)
    for name in ("nominal", "eta", "radius"):
        del cell[name][middle]


@forges(
    "the reach tube starts around its cell", "contraction", "constants/reach_tube.py", "Norm.start",
    "stated radius on piece 0",
)
def _(data: Data) -> None:
    _from(data, [0.1, 0.1], [0.3, 0.2])


@forges(
    "the reach tube grows as its equation says", "contraction", "constants/reach_tube.py", "Tube.prove",
    "stated radius on piece 60",
)
def _(data: Data) -> None:
    _scale(_cell(data)["radius"], 60, 0.99)


@forges(
    "jumps of the nominal curve widen the tube", "rising", "constants/reach_tube.py", "Tube.prove",
    "stated radius on piece 1",
)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["bound"] = exact(8.0)
    _cell(data)["nominal"][1] = exact([[1.0], [10.0]])


@forges(
    "a polyhedral constraint leaves the room", "still", "constants/proof.py", "_Proof._check_rooms", "the stated room",
)
def _(data: Data) -> None:
    _scale(data["proof"]["rooms"], 2, 1.1)


@forges("a round constraint leaves the room", "random", "statement/rooms.py", "round_demands", "the stated room")
def _(data: Data) -> None:
    _scale(data["proof"]["rooms"], 2, 1.01)


@forges(
    "a room is stated where a constraint is asked", "still", "constants/proof.py", "_Proof._check_rooms",
    "states nothing",
)
def _(data: Data) -> None:
    data["proof"]["rooms"][2] = None


@forges("a certain start needs no room", "still", "constants/proof.py", "_Proof._check_rooms", "stated room on piece 0")
def _(data: Data) -> None:
    _from(data, [1.5], [1.5])
    cell = _cell(data)
    cell["nominal"][:2] = exact([[[1.5]], [[0.5 * 1.5 - 0.1 * 1.5**3]]])
    cell["nominal"][2:] = exact([[[0.20194]], [[0.10]]])
    cell["eta"], cell["radius"] = exact([0.01] * 3), exact([0.03] * 4)
    data["proof"]["rooms"] = exact([-0.6, 0.55, 0.7, 0.8])
    _claim(data, -10.0)


@forges(
    "a start lies in the domain of the constants", "still", "constants/proof.py", "_Proof._check_rooms",
    "domain.*piece 0",
)
def _(data: Data) -> None:
    _from(data, [1.95], [2.1])
    data["problem"]["constraints"][0]["during"] = exact([1.0, 3.0])
    cell = _cell(data)
    cell["nominal"], cell["eta"] = exact([[[2.025]], [[0.1821]], [[0.0904]], [[0.0451]]]), exact([1e-3] * 3)
    cell["radius"] = exact([0.08, 0.07, 0.06, 0.06])
    data["proof"]["rooms"] = exact([-0.2, 0.7, 0.8, 0.85])
    _claim(data, -20.0)


@forges("rooms are positive, in steps", "still", "constants/kummer.py", "_least_discrete", MORE)
def _(data: Data) -> None:
    data["proof"]["rooms"][2] = exact(-0.5)


@forges("rooms are positive, in continuous time", "rising", "constants/kummer.py", "_least_continuous", MORE)
def _(data: Data) -> None:
    data["proof"]["rooms"][1] = exact(-0.1)


@forges(
    "the rate bounds the Jacobian", "contraction", "constants/rates.py", "Contraction.prove", "rate .* was not shown",
)
def _(data: Data) -> None:
    _scale(data["proof"], "rate", 1.01)


@forges("the gain bounds the Jacobian", "still", "constants/rates.py", "Contraction.prove", "gain .* was not shown")
def _(data: Data) -> None:
    _scale(data["proof"], "rate", 0.99)


@forges(
    "the constants hold wherever a path may go", "still", "constants/proof.py", "_Proof._global_box", "gain .* was not",
)
def _(data: Data) -> None:
    data["proof"]["region"] = "everywhere"


@forges(
    "the domain of the constants is a constraint", "still", "constants/proof.py", "_Proof._global_box", "has no domain",
)
def _(data: Data) -> None:
    data["problem"]["domain"] = None
    _cell(data)["separations"].pop()


@forges(
    "sigma bounds the noise", "contraction", "constants/rates.py", "Spread.prove", "were not shown to bound the noise",
)
def _(data: Data) -> None:
    _scale(data["problem"]["noise"]["diffusion"][0], 0, 1.01)


@forges("nu bounds the trace of the noise", "bounded", "constants/rates.py", "Spread.prove", "were not shown to bound")
def _(data: Data) -> None:
    _scale(data["proof"], "nu", 0.99)
    data["proof"]["kummer"]["a"] = exact(0.5)


@forges("nu is at most the number of states", "still", "constants/proof.py", "_Proof", "must lie in")
def _(data: Data) -> None:
    data["proof"]["nu"] = exact(0.0)


@forges("sub-Gaussian noise with nu < n needs a < nu/2", "bounded", "constants/proof.py", "_Proof._kummer", "a < nu/2")
def _(data: Data) -> None:
    _scale(data["proof"]["kummer"], "a", 1.1)


@forges("a random start needs nu = n", "random", "constants/proof.py", "_Proof._kummer", "random start needs nu")
def _(data: Data) -> None:
    data["problem"]["noise"] |= {"values": exact([0.05]), "matrix": exact([[1.0], [0.0]])}
    data["proof"]["nu"] = exact(1.5)


@forges(
    "the spread of a random start is bounded", "random", "constants/proof.py", "_Proof._check_start",
    "random start was not",
)
def _(data: Data) -> None:
    _scale(data["problem"]["initial"]["covariance"][0], 0, 1.01)


@forges("v0 exceeds the spread of a random start", "random", "constants/kummer.py", "_initial", "v_0 is too small")
def _(data: Data) -> None:
    data["proof"]["kummer"]["v0"] = exact(0.005)


@forges("Theorem K2 bounds the probability", "contraction", "constants/kummer.py", "exit_probability", MORE)
def _(data: Data) -> None:
    _scale(data["proof"]["kummer"], "v0", 30.0)


# ---- barriers ------------------------------------------------------------------------------------------------


@forges("the barrier grows no faster than stated", "barrier", "barrier.py", "check_barrier", "grow as slowly")
def _(data: Data) -> None:
    _scale(data["proof"], "growth", 1.0, -0.0005)


@forges("no more than the inflow comes to the barrier", "steady", "barrier.py", "check_barrier", "grow as slowly")
def _(data: Data) -> None:
    _scale(data["proof"], "inflow", 0.999)


@forges("the barrier is below its level at the start", "barrier", "barrier.py", "check_barrier", "on the initial set")
def _(data: Data) -> None:
    _scale(data["proof"], "start", 1.0, -0.0005)


@forges(
    "the barrier is above its level at the boundary", "barrier", "statement/safe_set.py", "SafeSet.boundary",
    "constraint breaks",
)
def _(data: Data) -> None:
    _scale(data["proof"], "boundary", 1.0, 0.0015)


@forges(
    "the initial set lies in the safe set", "barrier", "statement/safe_set.py", "SafeSet.contains",
    "lie in the safe set",
)
def _(data: Data) -> None:
    data["problem"]["initial"] |= {"low": exact([1.99]), "high": exact([2.01])}
    proof = data["proof"]  # 8 x^2 - 2 x^4 is small again out there
    proof |= {"exponents": [[2], [4]], "coefficients": exact([8.0, -2.0])}
    proof |= {"start": exact(0.9), "boundary": exact(5.999)}
    _claim(data, -1.9)


@forges(
    "the constraints bound every state", "barrier", "statement/safe_set.py", "SafeSet", "bounds x|no constraint that",
)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["low"] = [None]


@forges("a negative growth gains nothing", "barrier", "barrier.py", "check_barrier", MORE)
def _(data: Data) -> None:
    problem = data["problem"]  # without noise every path falls below 1, and x^2 with it
    problem["constraints"][0]["region"] |= {"low": exact([1.0]), "high": exact([2.0])}
    problem["initial"] |= {"low": exact([1.5]), "high": exact([1.6])}
    problem["noise"]["diffusion"] = exact([[0.0]])
    data["proof"] |= {
        "coefficients": exact([1.0]), "growth": exact(-3.99), "start": exact(2.57), "boundary": exact(0.999)
    }
    _claim(data, -1.0)


@forges("the barrier's units are positive", "barrier", "barrier.py", "_Expressions._polynomial", "scale")
def _(data: Data) -> None:
    data["proof"]["scale"] = exact([-1.0])


@forges(
    "a barrier treats no constraint with a window", "barrier", "statement/safe_set.py", "SafeSet._shape", "time window",
)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["during"] = exact([0.0, 0.5])


@forges("a barrier treats bounded starts only", "barrier", "barrier.py", "_refuse", "bounded initial set")
def _(data: Data) -> None:
    data["problem"]["initial"] = {"kind": "gaussian", "mean": exact([0.0]), "covariance": exact([[1e-4]])}


# ---- value functions in discrete time ------------------------------------------------------------------------


def _grid(data: Data, edges: list[float]) -> None:
    """The same few cells at every step."""
    data["proof"] |= {"grids": [[exact(edges)]], "steps": [0] * len(data["proof"]["steps"])}


@forges(
    "a cell that is not shown to be safe counts as failed", "valued", "values/step_back.py", "zones", MORE,
)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"] |= {"low": exact([-0.8]), "high": exact([0.8])}


@forges("what lies beyond the grid counts as failed", "valued", "values/step_back.py", "Values", MORE)
def _(data: Data) -> None:
    for grid in data["proof"]["grids"]:
        grid[0] = grid[0][2:-2]


@forges("the cells of a grid are in order", "valued", "values/proof.py", "_grid", "rising numbers")
def _(data: Data) -> None:
    for grid in data["proof"]["grids"]:
        grid[0].insert(2, grid[0][1])


@forges("the mean is taken over the noise", "valued", "values/normal_means.py", "axis_table", MORE)
def _(data: Data) -> None:
    _scale(data["problem"]["noise"], "values", 1.001)


@forges("what a polynomial misses of the mean is added", "valued", "values/normal_means.py", "MeanTable.missing", MORE)
def _(data: Data) -> None:
    _grid(data, [-1.0 + 0.4 * k for k in range(6)])
    _claim(data, -0.3)


@forges("what a polynomial misses of the dynamics is added", "valued", "values/batches.py", "composed", MORE)
def _(data: Data) -> None:
    nodes = data["problem"]["dynamics"]["nodes"]
    nodes[nodes.index(["const", exact(3.0)])][1] = exact(20.0)
    _grid(data, [-1.0 + 0.125 * k for k in range(17)])
    _claim(data, -0.08)


@forges("nothing is known where the dynamics jumps", "valued", "values/batch_tapes.py", "run", MORE)
def _(data: Data) -> None:
    jumping(data, "sign", 1, 0.6)


@forges("every disturbance counts", "valued", "values/step_back.py", "_without", MORE)
def _(data: Data) -> None:
    data["problem"]["disturbance_set"] = [exact([-0.051, 0.05])]


@forges("the worst part of the disturbances counts", "valued", "values/step_back.py", "Transition.apply", MORE)
def _(data: Data) -> None:
    data["problem"]["disturbance_set"] = [exact([-0.05, 0.06])]


@forges("the starts break no constraint", "valued", "values/proof.py", "_Discrete.bound", "lie in the safe set")
def _(data: Data) -> None:
    data["problem"]["constraints"].append(
        {"kind": "inside", "label": "x", "during": exact([0.0, 0.0]), "region": {
            "kind": "halfspace", "normal": exact([1.0]), "bound": exact(0.1),
        }}
    )  # fmt: skip


@forges("a constraint counts at every step of its window", "valued", "statement/safe_set.py", "StepSet", MORE)
def _(data: Data) -> None:
    data["problem"]["constraints"][1]["during"] = exact([1.0, 4.0])


@forges("value functions need noise that is exactly normal", "valued", "values/step_back.py", "_deviations", "normal")
def _(data: Data) -> None:
    data["problem"]["noise"]["law"] = "subgaussian"


@forges(
    "value functions need noise that is independent from state to state", "valued plane", "values/step_back.py",
    "_deviations", "independent",
)
def _(data: Data) -> None:
    data["problem"]["noise"]["values"] = exact([[0.04, 0.001], [0.001, 0.03]])


@forges("a normal start is not a bounded one", "valued", "values/proof.py", "_Discrete", "unknown entry `splits`")
def _(data: Data) -> None:
    data["problem"]["initial"] = {"kind": "gaussian", "mean": exact([0.0]), "covariance": exact([[1e-4]])}


# ---- value functions in continuous time ----------------------------------------------------------------------


def repacked(data: Data, name: str, change: Callable[[np.ndarray], None]) -> None:
    """Change the numbers of a packed array."""
    proof = data["proof"]
    shape = (len(proof["times"]), *(size for axis in proof["axes"] for size in (len(axis), 3)))
    words = zlib.decompress(base64.b64decode(proof[name])).decode().split(" ")
    numbers = np.array([float.fromhex(word) for word in words]).reshape(shape)
    change(numbers)
    words = [float(value).hex() for value in numbers.ravel()]
    proof[name] = base64.b64encode(zlib.compress(" ".join(words).encode())).decode()


def _lower(data: Data, amount: float) -> None:
    """Claim less."""
    _claim(data, float.fromhex(data["claim"]["log10_delta"]) - amount)


@forges("the grid of V lies in the safe set", "leaving", "values/passage.py", "Passage._check_box", "grid was not")
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["high"] = exact([0.999])


@forges("the grid of V holds the starts", "leaving", "values/passage.py", "Passage._check_box", "lie in the grid")
def _(data: Data) -> None:
    data["problem"]["initial"]["high"] = exact([1.5])


@forges("V is at least 0 on the sides of its grid", "leaving", "values/passage.py", "Passage._missing", MORE)
def _(data: Data) -> None:
    def change(values: np.ndarray) -> None:
        values[:, :, 0] -= 0.5

    repacked(data, "values", change)
    _lower(data, 0.1)


@forges("V is what it is at every start", "leaving", "values/passage.py", "Passage._at_start", MORE)
def _(data: Data) -> None:
    data["problem"]["initial"]["high"] = exact([0.25])


@forges("the slabs of time cover the horizon", "leaving", "values/passage.py", "Passage._read", "cover the horizon")
def _(data: Data) -> None:
    data["problem"]["horizon"] = exact(0.5)


@forges("the residual of V is paid for", "leaving", "values/passage.py", "Passage._residual", MORE)
def _(data: Data) -> None:
    nodes = data["problem"]["noise"]["diffusion"]["nodes"]
    nodes[nodes.index(["const", exact(0.75)])][1] = exact(0.755)


@forges("the residual is taken for every disturbance", "leaving", "values/passage.py", "Passage._residual", MORE)
def _(data: Data) -> None:
    data["problem"]["disturbance_set"] = [exact([-0.1, 0.11])]


@forges("the dynamics is defined where V is negative", "leaving", "values/passage.py", "Passage._payments", "defined")
def _(data: Data) -> None:
    tape = data["problem"]["dynamics"]
    count = len(tape["nodes"])
    tape["nodes"] += [
        ["input", 1], ["const", exact(-0.6)], ["add", count, count + 1], ["const", exact(1e-12)],
        ["div", count + 3, count + 2], ["add", tape["outputs"][0], count + 4],
    ]  # fmt: skip
    tape["outputs"][0] = count + 5


@forges("what is paid as eps is not negative", "leaving", "values/passage.py", "Passage", "must not be negative")
def _(data: Data) -> None:
    data["proof"]["eps"] = exact([-0.01] * len(data["proof"]["eps"]))
    _lower(data, 0.005)


@forges("q grows as its inequality asks", "leaving", "values/hermite.py", "Levels", "q was not shown")
def _(data: Data) -> None:
    data["proof"] |= {"edges": exact([-8.0, 0.0]), "m": exact([0.5]), "q": exact([0.0, 0.0])}


@forges("q lies between 0 and 1", "leaving", "values/hermite.py", "Levels", "stay below 1")
def _(data: Data) -> None:
    data["proof"] |= {"edges": exact([-8.0, 0.0]), "m": exact([0.5]), "q": exact([0.0, 1.0])}


@forges(
    "a normal start is cut into parts in continuous time", "leaving", "values/passage.py", "Passage", "have `pieces`",
)
def _(data: Data) -> None:
    data["problem"]["initial"] = {"kind": "gaussian", "mean": exact([0.0]), "covariance": exact([[1e-4]])}


@forges("value functions need a plan without steps in time", "leaving", "values/passage.py", "Passage", "steps in time")
def _(data: Data) -> None:
    data["problem"] |= {"inputs": ["u"], "plan": exact([[0.0]])}
    nodes = data["problem"]["dynamics"]["nodes"]
    nodes[nodes.index(["input", 2])] = ["input", 3]
