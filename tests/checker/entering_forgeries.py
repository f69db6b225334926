"""Forged certificates of targets in continuous time, from above and below: part of ``FORGERIES``."""

from __future__ import annotations

from collections.abc import Callable
from unittest.mock import patch

import numpy as np

import certbound as cb
from certbound.problem.goals import until
from certbound.safety.answers import EngineAnswer, exact
from certbound.values.continuous import ExitBounds, Surface, bound_exits, exits
from certbound.values.continuous.line import arrivals, ladder
from certbound.values.continuous.plane import plane_targets as targets
from tests.checker.conftest import side_of
from tests.checker.forgeries import _BASES, Data, _sharp, forges, repacked
from tests.checker.value_forgeries import LESS, MORE

_FILE = "values/reaching/entering.py"
RATE, STEEP, INSIDE, BENT = 1.0, 20.0, 0.3, 0.5


def arriving() -> cb.Problem:
    """One state: to the middle before a limit."""
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=[[0.5]])
    safe = [cb.Inside(cb.Box([-1], [1]))]
    start, goal = cb.Box([0.4], [0.5]), cb.Reach(cb.Box([-0.3], [0.1]), during=(0.0, 1.0))
    return cb.Problem(system, initial=start, safe=safe, reach=goal, horizon=1.0, delta=0.5)


def meeting(horizon: float, start: tuple[float, float]) -> cb.Problem:
    """Two states: to the middle, against little noise."""
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=[[0.03, 0], [0, 0.03]])
    region = cb.Box([-INSIDE, -INSIDE], [INSIDE, INSIDE])
    goal = cb.Reach(region, during=(0.0, horizon))
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    return cb.Problem(system, initial=list(start), safe=safe, reach=goal, horizon=horizon, delta=0.5)


def answered(problem: cb.Problem, found: ExitBounds, *, lower: bool) -> str:
    """The certificate of one of the bounds."""
    answer = EngineAnswer(log10_delta=found.upper, log10_lower=found.lower, method="values", details=found)
    return side_of(problem, {"values": answer}, lower=lower)


def _arrival(*, lower: bool) -> Callable[[], str]:
    def made() -> str:
        problem = arriving()
        plain = until(problem, 1.0)
        with patch.object(ladder, "LADDER", ((2.5, 1e-3, 0.03),)), patch.object(arrivals, "_RUNGS", 1):
            return answered(problem, bound_exits(plain, target=problem.reach.region), lower=lower)

    return made


def _surface(horizon: float, table: Callable[[float], np.ndarray], moved: Callable[[float], np.ndarray]) -> Surface:
    nodes, times = np.array([-1.0, -0.6, -INSIDE, INSIDE, 0.6, 1.0]), np.linspace(0, horizon, 7)
    values, rates = (np.array([made(t) for t in times]) for made in (table, moved))
    return Surface(axes=(nodes, nodes), times=times, values=values, start_rates=rates[:-1], end_rates=rates[1:])


def _bowl(horizon: float) -> Surface:
    """V = k (|x|^2 exp(-2 r (T - t)) - d^2), with which the drift moves."""
    nodes = np.array([-1.0, -0.6, -INSIDE, INSIDE, 0.6, 1.0])
    square, one = np.stack([nodes**2, 2 * nodes, 2 + 0 * nodes], axis=1), np.array([[1.0, 0, 0]] * 6)
    both = np.einsum("ia,jb->iajb", square, one) + np.einsum("ia,jb->iajb", one, square)
    flat = STEEP * INSIDE**2 * np.einsum("ia,jb->iajb", one, one)

    def grown(t: float) -> np.ndarray:
        return STEEP * both * np.exp(-2 * RATE * (horizon - t))

    return _surface(horizon, lambda t: grown(t) - flat, lambda t: 2 * RATE * grown(t))


def _dent(horizon: float) -> Surface:
    """V is below 0 in the target and around it."""
    row = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0]])
    table = -BENT * np.einsum("ia,jb->iajb", row, row)
    return _surface(horizon, lambda t: table, lambda t: 0 * table)


def _meeting(*, lower: bool) -> Callable[[], str]:
    def made() -> str:
        problem = meeting(0.05, (0.8, 0.8)) if lower else meeting(1.2, (0.5, 0.0))
        plain, log10 = until(problem, float(problem.horizon)), np.log(10)
        aim = targets._aim(plain, exits._model(plain), problem.reach.region, upper=not lower)
        if lower:
            surface = _dent(0.05)
            payment = targets.prove_failing_below(surface, aim)
            found = ExitBounds(
                upper=0.0, lower=payment.log / log10, words="", seconds=0.0, proposed_below=((surface, payment),)
            )
        else:
            surface, payment = targets.prove_failing_above(_bowl(1.2), aim)
            found = ExitBounds(
                upper=payment.log / log10, lower=None, words="", seconds=0.0, proposed=((surface, payment),)
            )
        return answered(problem, found, lower=lower)

    return made


_BASES |= {
    "arriving": _sharp(_arrival(lower=False)),
    "arriving below": _sharp(_arrival(lower=True)),
    "meeting": _sharp(_meeting(lower=False)),
    "meeting below": _sharp(_meeting(lower=True)),
}


def _claim(data: Data, name: str, level: float) -> None:
    data["claim"][name] = exact(level)


def _target(data: Data, **ends: list[float]) -> None:
    data["problem"]["reach"]["region"] |= {side: exact(value) for side, value in ends.items()}


# ---- one state -----------------------------------------------------------------------------------------------


@forges("a side of the target counts as arrived", "arriving", _FILE, "_ArrivingBelow._harmless_sides", MORE)
def _(data: Data) -> None:
    _target(data, high=[0.099])


@forges(
    "who meets an obstacle and the target at once has failed", "arriving", _FILE, "_ArrivingBelow._harmless_sides",
    "no bound below 1",
)  # fmt: skip
def _(data: Data) -> None:
    data["problem"]["constraints"].append({
        "kind": "outside", "during": None, "label": "x <= .1",
        "region": {"kind": "halfspace", "normal": exact([1.0]), "bound": exact(0.1)},
    })


@forges("the worst start arrives", "arriving", _FILE, "_ArrivingBelow._level", MORE)
def _(data: Data) -> None:
    data["problem"]["initial"]["high"] = exact([0.51])


@forges("a path arrives before it leaves the safe set", "arriving", _FILE, "_ArrivingBelow._level", "in the safe set")
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["high"] = exact([0.99])


@forges("one state arrives without disturbances", "arriving", _FILE, "_ArrivingBelow._level", "under disturbances")
def _(data: Data) -> None:
    data["problem"] |= {"disturbances": ["d"], "disturbance_set": [exact([0.0, 0.1])]}


@forges("a target counts from the beginning", "arriving", _FILE, "_window", "count from the beginning")
def _(data: Data) -> None:
    data["problem"]["reach"]["during"] = exact([0.1, 1.0])


@forges("a target is met from a set of starts", "arriving", _FILE, "_window", "from a set of starts only")
def _(data: Data) -> None:
    data["problem"]["initial"] = {"kind": "gaussian", "mean": exact([0.4]), "covariance": exact([[1e-4]])}
    data["proof"]["pieces"] = 1
    _claim(data, "log10_delta", -0.42)


@forges("paths arrive by the end of the window", "arriving", _FILE, "_ArrivingBelow._last", "do not cover the horizon")
def _(data: Data) -> None:
    data["problem"]["reach"]["during"] = exact([0.0, 0.9])


@forges("no path arrives within the grid", "arriving below", _FILE, "_ArrivingAbove._check_box", "keep off the target")
def _(data: Data) -> None:
    _target(data, high=[0.11])


@forges("who leaves by a side may arrive", "arriving below", _FILE, "_ArrivingAbove._spared", LESS)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["high"] = exact([1.1])


@forges("who fails counts at most what is taken off", "arriving below", "values/passage.py", "Passage._at_end", LESS)
def _(data: Data) -> None:
    """V is lower beside the limit, but at the end."""
    rows = data["proof"]["axes"][0], data["proof"]["times"]
    nodes, times = (np.array([float.fromhex(x) for x in row]) for row in rows)
    share = np.maximum(nodes - 0.5, 0.0) / (nodes[-1] - 0.5)
    width = nodes[-1] - 0.5
    dent = -0.01 * np.stack([share**3, 3 * share**2 / width, 6 * share / width**2], axis=1)

    def lowered(values: np.ndarray) -> None:
        values += (1 - times / times[-1])[:, None, None] * dent

    repacked(data, "values", lowered)
    repacked(data, "rates", lambda rates: np.subtract(rates, dent / times[-1], out=rates))
    _claim(data, "log10_lower", -0.624)


@forges("a start that may miss lies in the grid", "arriving below", _FILE, "_ArrivingAbove._at_start", "in the grid")
def _(data: Data) -> None:
    limit = data["proof"]["axes"][0][-1]
    data["problem"]["initial"]["high"] = [limit]
    data["proof"]["starts"].append([limit])


@forges("a target is missed until its window ends", "arriving below", _FILE, "_ArrivingAbove._last", "do not cover")
def _(data: Data) -> None:
    data["problem"] |= {"horizon": exact(1.1)}
    data["problem"]["reach"]["during"] = exact([0.0, 1.1])


# ---- two states ----------------------------------------------------------------------------------------------


@forges("only cells that lie in the target are over", "meeting", _FILE, "_Cells", "more than the|part of the grid")
def _(data: Data) -> None:
    _target(data, high=[0.29, 0.3])


@forges("V is at least 0 where a path has missed the target", "meeting", _FILE, "_FailingAbove._missing", MORE)
def _(data: Data) -> None:
    def change(values: np.ndarray) -> None:
        values[-1, :, 0, :, 0] -= 0.3

    repacked(data, "values", change)


@forges("who meets the target counts at least what is taken off", "meeting", _FILE, "_FailingAbove._at_end", MORE)
def _(data: Data) -> None:
    _claim(data, "log10_delta", float.fromhex(data["claim"]["log10_delta"]) - 0.1)


@forges("two states meet the target in its window", "meeting", _FILE, "_FailingAbove._last", "do not cover the horizon")
def _(data: Data) -> None:
    data["problem"]["reach"]["during"] = exact([0.0, 1.1])


@forges("all cells are over that may meet the target", "meeting below", _FILE, "_Cells", LESS)
def _(data: Data) -> None:
    _target(data, high=[0.31, 0.3])


@forges("who meets the target counts at most what is taken off", "meeting below", _FILE, "_FailingBelow._at_end", LESS)
def _(data: Data) -> None:
    _claim(data, "log10_lower", float.fromhex(data["claim"]["log10_lower"]) + 0.02)


@forges("a start has not met the target", "meeting below", _FILE, "_FailingBelow._level", "keep off the target")
def _(data: Data) -> None:
    data["problem"]["initial"]["low"] = exact([0.0, 0.0])
    data["proof"]["starts"].append(exact([0.1, 0.1]))


@forges("two states miss it until the window ends", "meeting below", _FILE, "_FailingBelow._last", "do not cover")
def _(data: Data) -> None:
    data["problem"] |= {"horizon": exact(0.1)}
    data["problem"]["reach"]["during"] = exact([0.0, 0.1])
