"""Certificates of small problems, made once for all tests of the checker."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from flint import arb, ctx

import certbound as cb
from certbound.checker import parse
from certbound.checker.linear import events
from certbound.checker.values import step_back
from certbound.quadratic import bound_quadratic
from certbound.quadratic.refinement import Search
from certbound.quadratic.wall_attempts import SPLIT, log10_up, total
from certbound.reach.linear import linearisation
from certbound.reach.linear.held import held_linearisation
from certbound.safety.answers import EngineAnswer
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.certificates import linear
from certbound.safety.verification import verify_safety
from certbound.values.continuous import bound_exits
from certbound.values.continuous.line import ladder
from certbound.values.kolmogorov import Bounds, Witness
from certbound.values.kolmogorov.box_setting import stages_of
from certbound.values.kolmogorov.door import refined, starts_in
from certbound.values.kolmogorov.door import side_of as solution_of


@contextmanager
def coarsely() -> Iterator[None]:
    """Linear responses of fewer pieces of time than usual, for short certificates: what is proved of each is the same.

    Those of full length are proved again in tests/safety/test_certificate.py.
    """
    fewer = (linearisation, "FEWEST_PIECES", 20), (held_linearisation, "_FEWEST", 50), (linear, "_FEWEST", 16)
    with ExitStack() as patches:
        for change in fewer:
            patches.enter_context(patch.object(*change))
        yield


class Case:
    """A problem, its certificate as data, and its problem part."""

    @coarsely()
    def __init__(self, build: Callable[[], cb.Problem], method: str) -> None:
        self.problem, self.verdict = proved(build, method)
        self.text = certificate_text(self.problem, self.verdict)
        self.given = json.loads(json.dumps(problem_data(self.problem)))

    @property
    def data(self) -> dict[str, Any]:
        """A fresh copy of the certificate."""
        return parse(self.text)


@cache
def proved(build: Callable[[], cb.Problem], method: str) -> tuple[cb.Problem, Any]:
    """A problem and its verdict, once for all tests."""
    problem = build()
    return problem, verify_safety(problem, method=method)


def steps() -> cb.Problem:
    """Discrete time: coupled nonlinear states, a disturbance, an obstacle, a window, a domain."""

    def move(x: Any, d: Any) -> Any:
        return [0.9 * x[0] + 0.1 * np.sin(x[1]) + 0.02 * d[0], 0.8 * x[1] - 0.1 * x[0] * x[1]]

    system = cb.DiscreteSystem(
        move, states=2, disturbance=cb.Box([-1], [1]), noise=cb.Gaussian(std=0.02)
    )
    safe = [
        cb.Inside(cb.Box([-2, -2], [2, 2])),
        cb.Outside(cb.Ball([1.5, 1.0], 0.3)),
        cb.Outside(cb.Box([1.0, -1.8], [1.5, -1.2]), during=(2, 4)),
    ]
    return cb.Problem(
        system, initial=cb.Box([0.2, 0.1], [0.3, 0.2]), safe=safe, horizon=6, domain=cb.Box([-4, -4], [4, 4])
    )


def flow() -> cb.Problem:
    """Continuous time, nonlinear: a moving obstacle and a round safe set."""

    def rate(x: Any) -> Any:
        return [x[1], -2.0 * np.sin(x[0]) - x[1]]

    system = cb.ContinuousSystem(rate, states=2, diffusion=[[0.0], [0.05]])
    safe = [cb.Inside(cb.Ball([0, 0], 1.5)), cb.Outside(cb.Ball(lambda t: [1.0 + t, 1.0], 0.3))]
    return cb.Problem(system, initial=cb.Box([0.3, -0.02], [0.34, 0.02]), safe=safe, horizon=1.5)


def contraction() -> cb.Problem:
    """Continuous time, for the constants: a disturbance, a saturation, an obstacle."""

    def rate(x: Any, d: Any) -> Any:
        return [-x[0] - np.tanh(x[0]) + 0.1 * d[0], -1.5 * x[1] + 0.5 * x[0]]

    system = cb.ContinuousSystem(rate, states=2, disturbance=cb.Box([-1], [1]), diffusion=0.15 * np.eye(2))
    safe = [cb.Inside(cb.Ball([0, 0], 1.3)), cb.Outside(cb.Ball([1.5, 1.5], 0.4))]
    return cb.Problem(system, initial=cb.Box([0.1, 0.1], [0.2, 0.2]), safe=safe, horizon=1.0, delta=1e-2)


def spring() -> cb.Problem:
    """Continuous time, for the barrier: a hardening spring, a wall that the velocity must not reach, a domain."""

    def rate(x: Any) -> Any:
        return [x[1], -x[0] - x[1] - 0.5 * x[0] ** 3]

    system = cb.ContinuousSystem(rate, states=["x1", "x2"], diffusion=[[0.0], [0.5]])
    return cb.Problem(
        system, initial=cb.Box([-1, -1], [1, 1]), safe=[cb.Inside(cb.HalfSpace([0, 1], 2.25))], horizon=5.0,
        domain=cb.Box([-3, -3], [3, 3]),
    )  # fmt: skip


def stirred() -> cb.Problem:
    """Continuous time, noise that grows with the state, near enough to its nominal value for a Gaussian part."""
    system = cb.ContinuousSystem(
        lambda x: [-x[0] + 0.1 * np.sin(x[0])], states=1, diffusion=lambda t, x: [[0.1 * (1 + 0.02 * np.sin(x[0]))]]
    )
    return cb.Problem(
        system, initial=cb.Box([0.4], [0.5]), safe=[cb.Inside(cb.HalfSpace([-1.0], 0.15))], horizon=1.0, delta=1e-2
    )


def valued() -> cb.Problem:
    """Discrete time, for value functions: a wave, a disturbance, an obstacle with a window."""
    system = cb.DiscreteSystem(
        lambda x, d: [0.7 * x[0] + 0.1 * np.sin(3 * x[0]) + d[0]], states=["x"], disturbance=cb.Box([-0.05], [0.05]),
        noise=cb.Gaussian(std=0.15),
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1], [1])), cb.Outside(cb.Box([0.75], [0.9]), during=(2, 3))]
    return cb.Problem(system, initial=cb.Box([-0.1], [0.2]), safe=safe, horizon=4, delta=0.1)


def valued_plane() -> cb.Problem:
    """The same in two states, without a disturbance."""
    system = cb.DiscreteSystem(
        lambda x: [0.8 * x[0] + 0.2 * x[1], 0.7 * x[1] - 0.1 * np.sin(x[0])], states=["x", "y"],
        noise=cb.Gaussian(covariance=[[0.04, 0.0], [0.0, 0.03]]),
    )
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    return cb.Problem(system, initial=[0.1, 0.0], safe=safe, horizon=3, delta=0.1)


def valued_space() -> cb.Problem:
    """The same in three states."""
    system = cb.DiscreteSystem(
        lambda x: [0.8 * x[0] + 0.1 * x[1], 0.8 * x[1] - 0.1 * x[0] * x[2], 0.7 * x[2]], states=3,
        noise=cb.Gaussian(std=[0.3, 0.25, 0.3]),
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1, -1, -1], [1, 1, 1]))]
    return cb.Problem(system, initial=[0.1, 0.0, 0.0], safe=safe, horizon=2, delta=0.1)


def leaving() -> cb.Problem:
    """Continuous time, for value functions: a wave, noise that grows with the state, a disturbance."""
    system = cb.ContinuousSystem(
        lambda x, d: [-x[0] + 0.2 * np.sin(3 * x[0]) + d[0]], states=["x"], disturbance=cb.Box([-0.1], [0.1]),
        diffusion=lambda t, x: [[0.75 + 0.1 * x[0] ** 2]],
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1], [1]))]
    return cb.Problem(system, initial=cb.Box([-0.1], [0.2]), safe=safe, horizon=0.4, delta=0.5)


@cache
def _exits(build: Callable[[], cb.Problem]) -> tuple[cb.Problem, Any]:
    problem = build()
    with patch.object(ladder, "LADDER", ((1.5, 1e-3, 0.03),)):
        return problem, bound_exits(problem, seconds=0.1)


def exit_certificate(build: Callable[[], cb.Problem], *, lower: bool = False) -> str:
    """A certificate by a value function in continuous time from one attempt, coarser than usual, for short checks."""
    problem, found = _exits(build)
    answer = EngineAnswer(log10_delta=found.upper, log10_lower=found.lower, method="values", details=found)
    return side_of(problem, {"values": answer}, lower=lower)


def side_of(problem: cb.Problem, answers: dict[str, EngineAnswer], *, lower: bool) -> str:
    """The certificate of one of the two bounds, whatever the verdict is."""
    status = "UNSAFE" if lower else "UNKNOWN"
    return certificate_text(problem, SimpleNamespace(status=status, reason="", answers=answers))


def toggle(noise: float = 0.3, horizon: float = 1.0) -> cb.Problem:
    """Continuous time, for the backward equation: two genes that repress each other, noise along both states."""
    system = cb.ContinuousSystem(
        lambda u, v: [2 / (1 + v**2) - u, 2 / (1 + u**2) - v], states=["u", "v"], diffusion=noise * np.eye(2)
    )
    safe = [cb.Inside(cb.Box([0.5, 0.05], [2.6, 1.6]))]
    return cb.Problem(system, initial=[1.5, 0.6], safe=safe, horizon=horizon, delta=0.3, name="toggle")


def loud_toggle() -> cb.Problem:
    """The same with so much noise that it often fails."""
    return toggle(0.6, 2.0)


def pendulum(noise: float = 0.5) -> cb.Problem:
    """A pendulum with noise in the velocity alone, which nothing bounds."""
    system = cb.ContinuousSystem(
        lambda x, v: [v, -np.sin(x) - 0.5 * v], states=["x", "v"], diffusion=[[0.0], [noise]]
    )
    safe = [cb.Inside(cb.Box([-1, -np.inf], [1, np.inf]))]
    return cb.Problem(system, initial=[0, 0], safe=safe, horizon=2.0, delta=0.6, name="pendulum")


def loud_pendulum() -> cb.Problem:
    """The same with so much noise that it often fails."""
    return pendulum(0.9)


def predator() -> cb.Problem:
    """Holling's predator and its prey, with noise that both multiply."""
    system = cb.ContinuousSystem(
        lambda x, y: [x * (1 - x / 3) - x * y / (1 + x), y * (x / (1 + x) - 0.4)], states=["x", "y"],
        diffusion=lambda x: [[0.3 * x[0], 0], [0, 0.3 * x[1]]],
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([0.3, 0.3], [3.0, 3.0]))]
    return cb.Problem(system, initial=[1.0, 1.0], safe=safe, horizon=1.0, delta=0.3, name="predator")


def gated(noise: float = 0.5, size: float = 0.7) -> cb.Problem:
    """A wide limit at all times, and a tight one at one time."""
    system = cb.ContinuousSystem(lambda x, y: [-x, -y], states=["x", "y"], diffusion=noise * np.eye(2))
    safe = [cb.Inside(cb.Box([-1.5, -1.5], [1.5, 1.5])),
            cb.Inside(cb.Box([-size, -size], [size, size]), during=(0.5, 0.5))]  # fmt: skip
    return cb.Problem(system, initial=[0.2, 0.2], safe=safe, horizon=1.0, delta=0.2, name="gated")


def loud_gated() -> cb.Problem:
    """The same with so much noise that it often fails."""
    return gated(1.0, 0.6)


def arriving(during: tuple[float, float] | None = None) -> cb.Problem:
    """A box, and a target behind one of its sides that noise must find."""
    system = cb.ContinuousSystem(lambda x, y: [0.0, -y], states=["x", "y"], diffusion=0.8 * np.eye(2))
    safe, ahead = [cb.Inside(cb.Box([-1, -1], [2, 1]))], cb.Reach(cb.Box([0.8, -1], [2, 1]), during=during)
    return cb.Problem(system, initial=[-0.3, 0], safe=safe, reach=ahead, horizon=1.0, delta=0.2, name="arriving")


def pushed() -> cb.Problem:
    """A model that swings and jumps with time, under a disturbance."""
    system = cb.ContinuousSystem(
        lambda t, x, y, d: [-(1 + 0.5 * np.sin(3 * t)) * x + np.where(t < 0.6, 0.3, 0.1) + d, -y], states=["x", "y"],
        diffusion=lambda t, x: [[0.8 + 0.16 * np.cos(t), 0.0], [0.0, 0.8]], disturbance=cb.Box([-0.2], [0.2]),
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    return cb.Problem(system, initial=[0.2, 0.1], safe=safe, horizon=1.0, delta=0.8, name="pushed")


def scattered() -> cb.Problem:
    """A normal start whose states depend on each other."""
    system = cb.ContinuousSystem(
        lambda x, y: [-x + 0.3 * y, -y - 0.2 * x * y], states=["x", "y"], diffusion=np.eye(2)
    )
    start, safe = cb.GaussianStart([0.2, 0.1], [[0.04, 0.02], [0.02, 0.03]]), [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    return cb.Problem(system, initial=start, safe=safe, horizon=0.5, delta=0.8, name="scattered")


@cache
def backward_answer(
    build: Callable[[], cb.Problem], *, lower: bool, cell: float = 0.2, steps: int = 12
) -> tuple[cb.Problem, EngineAnswer]:
    """What the backward equation bounds on one coarse grid, for short checks."""
    problem = build()
    n = problem.system.dimension
    side = solution_of(stages_of(problem), cell, steps, not lower)
    for stage in side.stages[::-1]:
        stage.propose()
    bound = refined(side, starts_in(problem))[0]
    found = Bounds(
        lower=max(-bound, 0.0) if lower else 0.0, upper=1.0 if lower else bound, cells=(0,) * n, steps=steps, runs=1,
        estimate=abs(bound), work=0.0, witnesses=Witness.of(side),
    )  # fmt: skip
    level = np.log10(found.lower) if lower else 0.0
    answer = EngineAnswer(
        log10_delta=0.0 if lower else np.log10(found.upper), log10_lower=level if lower else None, method="backward",
        details=found,
    )  # fmt: skip
    return problem, answer


def backward_certificate(build: Callable[[], cb.Problem], *, lower: bool = False, **grid: Any) -> str:
    """The certificate of one side by the backward equation."""
    problem, answer = backward_answer(build, lower=lower, **grid)
    return side_of(problem, {"backward": answer}, lower=lower)


def squared() -> cb.Problem:
    """Continuous time, for quadratic bounds: a cubic, noise that grows, a disturbance, an obstacle, an oblique face."""
    system = cb.ContinuousSystem(
        lambda x, d: [-x[0] + 0.3 * x[1] - 0.1 * x[1] ** 2 + d[0], -x[1] - 0.5 * x[0] * x[1] - 0.2 * x[0] ** 3],
        states=["x", "y"], disturbance=cb.Box([-0.1], [0.1]),
        diffusion=lambda t, x: [[0.1 + 0.05 * x[0], 0.0], [0.0, 0.15]],
    )  # fmt: skip
    safe = [
        cb.Inside(cb.Box([-1, -1], [1, 1])), cb.Outside(cb.Ball([0.6, 0.6], 0.15)),
        cb.Inside(cb.HalfSpace([1.0, 1.0], 1.2)),
    ]  # fmt: skip
    return cb.Problem(system, initial=cb.Ball([0, 0], 0.05), safe=safe, horizon=0.5, delta=0.1)


@cache
def squared_certificate(*, windows: bool = False) -> str:
    """Of ``squared``, by quadratic value bounds."""
    return quadratic_certificate(squared(), windows=windows)


def quadratic_certificate(problem: cb.Problem, *, windows: bool = False) -> str:
    """A certificate by quadratic value bounds from the first attempts, the last one (all sides) in two windows."""
    found = bound_quadratic(problem, target=0.5, seconds=60.0)
    if windows:
        search, *before, last = Search(problem, found.setting, together=False), *found.walls
        parts = last.finer(SPLIT)
        for part in parts:
            search._solve(part, math.inf)
        walls = (*before, *parts)
        found = replace(found, upper=log10_up(total(walls)[0]), walls=walls)
    answer = EngineAnswer(log10_delta=found.upper, method="quadratic", details=found)
    return side_of(problem, {"quadratic": answer}, lower=False)


def started() -> cb.Problem:
    """Discrete time, for value functions: a normal start."""
    system = cb.DiscreteSystem(lambda x: 0.8 * x, states=["x"], noise=cb.Gaussian(std=0.2))
    start = cb.GaussianStart([0.1], [[0.04]])
    return cb.Problem(system, initial=start, safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3, delta=0.1)


def shaken() -> cb.Problem:
    """Discrete time, for value functions: uniform noise."""
    system = cb.DiscreteSystem(
        lambda x, d: [0.9 * x[0] + 0.1 * np.sin(2 * x[0]) + d[0]], states=["x"], disturbance=cb.Box([-0.02], [0.03]),
        noise=cb.Uniform(halfwidth=0.3),
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1], [1]))]
    return cb.Problem(system, initial=cb.Box([0], [0.1]), safe=safe, horizon=5, delta=0.1)


def drifting() -> cb.Problem:
    """Continuous time, for value functions: a normal start, and no limit below."""
    system = cb.ContinuousSystem(lambda x: -x, states=["x"], diffusion=0.5)
    start = cb.GaussianStart([0.1], [[0.02]])
    safe = [cb.Inside(cb.HalfSpace([1.0], 1.0))]
    return cb.Problem(system, initial=start, safe=safe, horizon=0.5, delta=0.1)


@pytest.fixture(autouse=True)
def precise(request: pytest.FixtureRequest) -> Iterator[None]:
    """The working precision of a check, of certificates that are short (those of slow tests are as usual)."""
    usual = request.node.get_closest_marker("slow") is not None
    with ctx.workprec(128), nullcontext() if usual else coarsely():
        yield


@pytest.fixture(scope="module")
def kept_tables() -> Iterator[None]:
    """Integrals that many changed copies of one certificate have in common are computed once, by all their digits."""
    tables: dict[Any, Any] = {}
    compute, meet = step_back.axis_table, events.below_and_above

    def exactly(ball: arb) -> Any:
        return (ball.mid().man_exp(), ball.rad().man_exp()) if ball.is_finite() else str(ball)

    def kept(points: Any, edges: Any, deviation: arb, degree: int, budget: Any) -> Any:
        budget.check()
        key = points.tobytes(), np.asarray(edges).tobytes(), exactly(deviation), ctx.prec, degree
        if key not in tables:
            tables[key] = compute(points, edges, deviation, degree, budget)
        return tables[key]

    def met(*numbers: arb) -> arb:
        key = *map(exactly, numbers), ctx.prec
        if key not in tables:
            tables[key] = meet(*numbers)
        return tables[key]

    with patch.object(step_back, "axis_table", kept), patch.object(events, "below_and_above", met):
        yield


@pytest.fixture(scope="session")
def stepping() -> Case:
    return Case(steps, "linear")


@pytest.fixture(scope="session")
def flowing() -> Case:
    return Case(flow, "linear")


@pytest.fixture(scope="session")
def contracting() -> Case:
    return Case(contraction, "constants")


@pytest.fixture(scope="session")
def springing() -> Case:
    return Case(spring, "barrier")


@pytest.fixture(scope="session")
def stirring() -> Case:
    return Case(stirred, "linear")


@pytest.fixture(scope="session")
def valuing() -> Case:
    return Case(valued, "values")


@pytest.fixture(scope="session")
def squaring() -> SimpleNamespace:
    """Quadratic value bounds."""
    problem = squared()
    text, given = squared_certificate(windows=True), json.loads(json.dumps(problem_data(problem)))
    return SimpleNamespace(problem=problem, text=text, data=parse(text), given=given)


@pytest.fixture(scope="session")
def valuing_below(valuing: Case) -> Case:
    """The lower bound of the same verdict."""
    case = copy.copy(valuing)
    case.text = side_of(case.problem, dict(case.verdict.answers), lower=True)
    return case
