"""Forged certificates of what comes, goes or ends in continuous time: part of ``FORGERIES``."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.special import ndtr

import certbound as cb
from certbound.safety.answers import exact
from certbound.safety.certificate import problem_data
from certbound.safety.certificates.parts import packed
from certbound.values.continuous import ExitBounds, bound_exits
from certbound.values.continuous.line import ladder
from tests.checker.entering_forgeries import answered
from tests.checker.forgeries import _BASES, Data, _lower, _sharp, forges, repacked
from tests.checker.value_forgeries import LESS, MORE, _more

_FILE = "values/reaching/gated.py"
_CROSSING = "values/crossing.py"
FIRST = 0.2


def passing() -> cb.Problem:
    """One state: within a limit, and in narrower boxes at two instants."""
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=[[0.6]])
    safe = [
        cb.Inside(cb.Box([-1], [1])), cb.Inside(cb.Box([-0.6], [0.6]), during=(FIRST, FIRST)),
        cb.Inside(cb.Box([-0.5], [0.5]), during=(0.4, 0.4)),
    ]  # fmt: skip
    return cb.Problem(system, initial=[0.1], safe=safe, horizon=0.4, delta=0.5)


def ending() -> cb.Problem:
    """One state: before a limit below, or out of its domain above, where paths end."""
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=[[0.6]])
    start, domain = cb.Box([0.0], [0.1]), cb.Box([-1], [0.5])
    safe = [cb.Inside(cb.HalfSpace([-1.0], 0.6))]
    return cb.Problem(system, initial=start, safe=safe, horizon=0.4, domain=domain, leaving="ends", delta=0.5)


@cache
def _found(build: Callable[[], cb.Problem]) -> ExitBounds:
    with patch.object(ladder, "LADDER", ((1.5, 1e-2, 0.1),)):
        return bound_exits(build(), seconds=0.1)


def _written(build: Callable[[], cb.Problem], *, lower: bool) -> Callable[[], str]:
    return _sharp(lambda: answered(build(), _found(build), lower=lower))


def ended_early() -> str:
    """Noise alone, its domain left by many before a narrow limit counts: exp(V) is 1 - u, u = 0 when that begins."""
    system = cb.ContinuousSystem(lambda x: 0 * x, states=1, diffusion=[[1.0]])
    safe = [cb.Inside(cb.Box([-0.2], [0.2]), during=(0.5, 1.0))]
    problem = cb.Problem(system, initial=[0], safe=safe, domain=cb.Box([-1], [1]), leaving="ends", horizon=1, delta=0.9)
    axis, times = np.linspace(-1.001, 1.001, 17), 0.5 - np.linspace(0.5**0.5, 0, 9) ** 2
    times[[0, -1]] = 0, 0.5
    spread = np.sqrt(np.maximum(0.5 - times, 1e-4))[:, None]
    w = np.zeros((5, 9, 17))
    w[0] = 1
    for sign in (1, -1):  # u and its derivatives
        z = (sign * axis - 1.4) / spread
        hermite = (1, -z / spread, (z * z - 1) / spread**2, (3 * z - z**3) / spread**3)
        w[0] -= 2.5 * ndtr(z)
        for k, part in enumerate(hermite, 1):
            w[k] -= 2.5 * sign**k * np.exp(-z * z / 2) / np.sqrt(2 * np.pi) / spread * part
    slope, moved = w[1] / w[0], -w[2] / 2 / w[0]
    turned = -w[3] / 2 / w[0] - slope * moved
    values = np.stack([np.log(w[0]), slope, w[2] / w[0] - slope**2], axis=-1)
    bent = -w[4] / 2 / w[0] - w[2] / w[0] * moved - 2 * slope * turned
    stages = []
    for nodes, ends, table in ((axis, times, (values, np.stack([moved, turned, bent], axis=-1))),
                               (np.array([-0.2, 0.2]), np.array([0.5, 1]), np.zeros((2, 2, 2, 3)))):  # fmt: skip
        none = exact([0.0] * (len(ends) - 1))
        stages.append({"axes": [exact(nodes)], "times": exact(ends), "lam": none, "eps": none}
                      | {"values": packed(table[0]), "rates": packed(table[1])})  # fmt: skip
    data = json.loads(_written(passing, lower=False)()) | {"problem": problem_data(problem)}
    data["claim"]["log10_delta"] = exact(0.0)
    flat = {"edges": exact([-9.0, 0.0]), "m": exact([0.0]), "q": exact([0.0, 0.0])}
    return json.dumps(data | {"proof": {"engine": "values", "stages": stages} | flat})


_BASES |= {
    "passing": _written(passing, lower=False), "passing below": _written(passing, lower=True),
    "ending": _written(ending, lower=False), "ending below": _written(ending, lower=True),
    "ended early": _sharp(ended_early),
}  # fmt: skip


def _limit(data: Data, number: int, *, box: float | None = None, during: list[float] | None = None) -> None:
    one = data["problem"]["constraints"][number]
    if box is not None:
        one["region"] |= {"low": exact([-box]), "high": exact([box])}
    if during is not None:
        one["during"] = exact(during)


def _raised(data: Data, number: int, amount: float) -> None:
    def change(values: np.ndarray) -> None:
        values[:, :, 0] += amount

    repacked({"proof": data["proof"]["stages"][number]}, "values", change)


def _elsewhere(data: Data, level: float) -> None:
    """The last stage speaks of a few places that fail by the gate before it; a constant there."""
    stage: dict[str, Any] = data["proof"]["stages"][1]
    stage["axes"] = [exact([0.8, 0.85])]
    stage["times"] = exact([FIRST, 0.4])
    stage |= {"lam": exact([0.0]), "eps": exact([0.0])}
    flat = np.zeros((2, 2, 3))
    flat[:, :, 0] = level
    stage |= {"values": packed(flat), "rates": packed(0 * flat)}


@forges("stages cover the windows", "passing", _FILE, "check_stages", "do not cover the windows")
def _(data: Data) -> None:
    data["problem"]["horizon"] = exact(0.5)


@forges("stages follow each other", "passing", _FILE, "check_stages", "do not follow each other")
def _(data: Data) -> None:
    times = data["proof"]["stages"][1]["times"]
    times[0] = exact(FIRST + 1e-6)


@forges("no constraint is one of time 0 alone", "passing", _FILE, "check_stages", "at time 0 alone")
def _(data: Data) -> None:
    data["problem"]["constraints"].append(data["problem"]["constraints"][1] | {"during": exact([0.0, 0.0])})


@forges("the levels are those of all stages", "passing", _FILE, "check_stages", "unknown entry `m`")
def _(data: Data) -> None:
    data["proof"]["stages"][1]["m"] = data["proof"]["m"]


@forges("a stage lies in all that holds while it lasts", "passing", _FILE, "_StageAbove", "grid was not shown")
def _(data: Data) -> None:
    _limit(data, 1, during=[FIRST, FIRST + 0.01])


@forges("V does not rise from a stage to the next", "passing", _FILE, "_StageAbove.join", MORE)
def _(data: Data) -> None:
    _raised(data, 1, 0.02)
    _lower(data, -0.001)


@forges("V is at least 0 off the gate", "passing", _FILE, "_StageAbove.join", MORE)
def _(data: Data) -> None:
    _limit(data, 1, box=0.55)


@forges("V is at least 0 off the last gate", "passing", _FILE, "_StageAbove.join", MORE)
def _(data: Data) -> None:
    _limit(data, 2, box=0.49)


@forges(
    "parts on both sides of an obstacle of no width touch it", "passing", "statement/safe_set.py", "_Shape.keeps",
    "no bound below 1",
)  # fmt: skip
def _(data: Data) -> None:
    edges = data["proof"]["stages"][-1]["axes"][0]
    place = [edges[len(edges) // 2]]
    data["problem"]["constraints"].append({
        "kind": "outside", "during": exact([0.4, 0.4]), "label": "a point",
        "region": {"kind": "box", "low": place, "high": place, "center": None, "coordinates": None},
    })


@forges("V is at least 0 where the next stage is silent", "passing", _FILE, "_StageAbove.join", MORE)
def _(data: Data) -> None:
    _elsewhere(data, 0.0)


@forges("only what covers a stage is broken in it", "passing below", _FILE, "_StageBelow", LESS)
def _(data: Data) -> None:
    _limit(data, 0, during=[0.01, 0.4])


@forges("V does not fall from a stage to the next", "passing below", _FILE, "_StageBelow.join", LESS)
def _(data: Data) -> None:
    _raised(data, 1, -0.01)


@forges("who may pass the gate goes on", "passing below", _FILE, "_StageBelow.join", LESS)
def _(data: Data) -> None:
    _limit(data, 1, box=0.61)
    _more(data, -0.005)


@forges("who may pass the last gate is taken off", "passing below", _FILE, "_StageBelow.join", LESS)
def _(data: Data) -> None:
    _limit(data, 2, box=0.51)
    _more(data, -0.005)


@forges("who passes to where the next stage is silent is taken off", "passing below", _FILE, "_StageBelow.join", LESS)
def _(data: Data) -> None:
    _elsewhere(data, -20.0)


# ---- paths that end as they leave the domain -----------------------------------------------------------------


@forges("a path ends by a side beyond the domain only", "ending", "values/passage.py", "Passage._spared", "1, which is")
def _(data: Data) -> None:
    data["problem"]["domain"][0][1] = exact(0.501)


@forges("a path ends in any stage", "ended early", "values/passage.py", "Passage._where_spared", MORE)
def _(data: Data) -> None:
    _lower(data, 0.1)


@forges("the grid lies in the domain, where a path ends", "ending below", _CROSSING, "Crossing._check_domain", "domain")
def _(data: Data) -> None:
    data["problem"]["domain"][0][1] = exact(0.499)


@forges("stages count the domain as a limit from below", "passing below", "claims.py", "check_side", "as it leaves the")
def _(data: Data) -> None:
    data["problem"] |= {"domain": [exact([-2.0, 2.0])], "leaving": "ends"}


@forges("a random start counts the domain as a limit", "drifting below", "claims.py", "check_side", "as it leaves the")
def _(data: Data) -> None:
    data["problem"] |= {"domain": [exact([-9.0, 9.0])], "leaving": "ends"}
