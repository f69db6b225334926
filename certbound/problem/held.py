"""Inputs that are computed at sampling times and held in between, as states of a model that jumps at known times.

The state z = (x, u) of the sampled closed loop moves by x' = f(t, x, u, d), u' = 0 between two sampling times, and at
one of them by (x, u) -> (x, k(t, x)): what is held is part of the state.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import Node, Tape
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, GaussianStart, Inside
from certbound.problem.systems import ContinuousSystem, DiscreteSystem


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldLoop:
    """A problem with held inputs in the states (x, u); who reads one of its parts alone misses the other.

    Parameters
    ----------
    plain : Problem
        As it was stated.
    flow : Problem
        What happens between sampling times. Its start has the middle of ``plain``'s, with inputs of 0: they are
        computed at time 0.
    sample : Problem
        A step of discrete time: what a sampling time does.
    """

    plain: Problem
    flow: Problem
    sample: Problem

    @property
    def delta(self) -> float:
        """The accepted probability."""
        return float(self.plain.delta)

    @property
    def count(self) -> int:
        """Number of sampling times."""
        return self.plain.samples

    @property
    def held(self) -> int:
        """Number of inputs."""
        return len(self.plain.system.input_names)


def held_loop(problem: Problem) -> HeldLoop:
    """The parts of a problem whose inputs are held.

    Raises
    ------
    InfeasibleError
        If its noise depends on the state, or it has a target.

    Examples
    --------
    >>> import certbound as cb
    >>> system = cb.ContinuousSystem(lambda x, u: u, states=["x"], inputs=cb.Box([-1], [1]), diffusion=0.1)
    >>> safe = [cb.Inside(cb.Box([-1], [1]))]
    >>> problem = cb.Problem(system, initial=[0], safe=safe, horizon=1, plan=lambda x: -x, hold=0.25)
    >>> loop = held_loop(problem)
    >>> loop.flow.system.states, loop.count
    (('x', 'u'), 4)
    """
    system = problem.system
    assert isinstance(system, ContinuousSystem)
    assert isinstance(problem.plan, Tape)
    if problem.reach is not None:
        raise InfeasibleError("targets are not served where inputs are held: state constraints with `during`.")
    if isinstance(system.diffusion, Tape):
        raise InfeasibleError("noise that depends on the state is not served where inputs are held.")
    n, m = system.dimension, len(system.input_names)
    states = [*system.states, *system.input_names]
    between = ContinuousSystem(
        resting(system.dynamics, m), states=states, disturbance=system.disturbance,
        disturbance_names=system.disturbance_names or None,
        diffusion=np.concatenate([np.asarray(system.diffusion), np.zeros((m, np.shape(system.diffusion)[1]))]),
    )
    flow = Problem(
        between, initial=_start(problem, m), safe=[_raised(one, n, m) for one in problem.safe],
        horizon=problem.horizon, delta=problem.delta, unknown=problem.unknown, name=problem.name, units=problem.units,
        domain=None if problem.domain is None else _wide(problem.domain, m),
    )
    jump = DiscreteSystem(sampled(problem.plan, system.input_names), states=states)
    return HeldLoop(
        plain=problem, flow=flow, sample=Problem(jump, initial=np.zeros(n + m), safe=[], horizon=1, name=problem.name)
    )


def resting(dynamics: Tape, count: int) -> Tape:
    """The derivatives of the states and of ``count`` held inputs, which stand behind them."""
    nodes = (*dynamics.nodes, Node("const", (), 0.0))
    outputs = (*dynamics.outputs, *[len(dynamics.nodes)] * count)
    return Tape(inputs=dynamics.inputs, nodes=nodes, outputs=outputs, shape=(len(outputs),))


def sampled(law: Tape, inputs: tuple[str, ...]) -> Tape:
    """What a sampling time does to (t, x, u): the states as they are, and the law's values."""
    n = len(law.inputs) - 1
    nodes = (*law.nodes, *(Node("input", (1 + j,)) for j in range(n)))
    outputs = (*range(len(law.nodes), len(nodes)), *law.outputs)
    return Tape(inputs=(*law.inputs, *inputs), nodes=nodes, outputs=outputs, shape=(len(outputs),))


def _start(problem: Problem, count: int) -> Any:
    start = problem.initial
    middle = np.concatenate([start.middle, np.zeros(count)])
    if not start.random:
        return middle
    n = len(start.middle)
    covariance: Array = np.zeros((n + count, n + count))
    covariance[:n, :n] = start.covariance
    return GaussianStart(middle, covariance)


def _raised(constraint: Inside, n: int, count: int) -> Inside:
    """The same constraint on the states and the held inputs."""
    region: Any = constraint.region
    if region.kind == "halfspace":
        region = replace(region, normal=np.concatenate([region.normal, np.zeros(count)]))
    elif region.kind == "polytope" and hasattr(region, "A"):
        region = replace(region, A=np.pad(region.A, ((0, 0), (0, count))))
    elif "coordinates" not in {entry.name for entry in fields(region)}:
        raise InfeasibleError(f"'{constraint.label}' is no Box, Ball, Ellipsoid or Polytope, as held inputs ask.")
    elif region.coordinates is None:
        region = replace(region, coordinates=tuple(range(n)))
    return replace(constraint, region=region)


def _wide(box: Box, count: int) -> Box:
    free = np.full(count, np.inf)
    return Box(np.concatenate([box.low, -free]), np.concatenate([box.high, free]))
