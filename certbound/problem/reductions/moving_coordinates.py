"""A system in coordinates y that move with time: x_i = p_i(t) + q_i(t) y_i with q_i > 0, p_i(0) = 0 and q_i(0) = 1.

Continuous time: dY_i = (f_i - p_i' - q_i' Y_i)/q_i dt + g_i/q_i dW, with f and g at x = p + q Y (Ito's formula of a map
that is linear in the state, p and q Lipschitz). Discrete time: Y_i+ = (f_i - p_i(k + 1))/q_i(k + 1) + G_i/q_i(k + 1) w.
At time 0 the coordinates are the states themselves, so that starts, also random ones, are what they were.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import Graph, Tape, jacobian, without_own
from certbound.problem.reductions.formulas_of_time import Formula, combined, difference, node_of, scaled
from certbound.problem.systems import ContinuousSystem, DiscreteSystem, System


@dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """How one coordinate moves: ``offset`` is p and ``scale`` is q (None: 1), tapes over ``("t",)`` of one output."""

    offset: Formula
    scale: Formula | None = None

    @classmethod
    def of_limits(cls, low: Formula, high: Formula) -> Motion:
        """The one in which an interval stays where it is at time 0.

        q = r/r(0) and p = c - c(0) q with r half its width and c its middle: limits that mirror each other move no
        middle.
        """
        middle = scaled(difference(high, scaled(low, -1.0)), 0.5)
        wide = difference(high, low)
        scale = combined("div", wide, start_of(wide))
        return cls(offset=difference(middle, combined("mul", start_of(middle), scale)), scale=scale)

    @classmethod
    def of_place(cls, place: Formula) -> Motion:
        """The one in which a place stays where it is at time 0, with nothing stretched."""
        return cls(offset=combined("sub", place, start_of(place)))


def start_of(part: Formula) -> Formula:
    """The value of a formula at time 0, as a formula: a number where it is known exactly."""
    if not isinstance(part, Tape):
        return part
    graph = Graph(("t",))
    node = node_of(graph, part, graph.const(0.0))
    value = graph.number(node)
    return graph.tape([node], (1,)) if value is None else value


def moved_system(
    system: System, closed: Tape, motions: Mapping[int, Motion], signals: Mapping[str, Any]
) -> ContinuousSystem | DiscreteSystem:
    """The system of y, under the closed loop ``closed``; ``signals`` are the inputs and disturbances that it has."""
    dynamics = _dynamics(closed, motions, discrete=isinstance(system, DiscreteSystem))
    if isinstance(system, ContinuousSystem):
        diffusion = _gain(system.diffusion, system.states, motions, later=False)
        return ContinuousSystem(dynamics, states=system.states, diffusion=diffusion, **signals)
    assert isinstance(system, DiscreteSystem)
    gain = _gain(system.fixed_gain if system.gain is None else system.gain, system.states, motions, later=True)
    return DiscreteSystem(dynamics, states=system.states, noise=system.noise, noise_matrix=gain, **signals)


class _Moved:
    """A graph over the inputs of a tape, the nodes of p, q and their slopes, and those of x."""

    def __init__(self, inputs: Sequence[str], motions: Mapping[int, Motion]) -> None:
        self.graph, self.motions = Graph(inputs), motions
        self.plain = self.graph.arithmetic()
        self.given = [self.graph.input(slot) for slot in range(len(inputs))]
        self.x = list(self.given)
        for place, motion in motions.items():
            stretched = self.apply("mul", self.at(motion.scale, self.given[0]), self.given[1 + place])
            self.x[1 + place] = self.apply("add", self.at(motion.offset, self.given[0]), stretched)

    def apply(self, op: str, *args: int) -> int:
        return self.graph.apply(op, *args)

    def at(self, part: Formula | None, time: int) -> int:
        return self.graph.const(1.0) if part is None else node_of(self.graph, part, time)

    def speed(self, motion: Motion, factor: float) -> int:
        """p' - factor p."""
        own = self.apply("mul", self.graph.const(factor), self.at(motion.offset, self.given[0]))
        return self.apply("sub", self.slope(motion.offset), own)

    def slope(self, part: Formula | None) -> int:
        """The derivative in time; where it jumps, at known times of no weight, the value there does not matter."""
        if not isinstance(part, Tape):
            return self.graph.const(0.0)
        table: dict[str, Callable[..., Any]] = self.plain | {"kink": partial(self.graph.apply, "sign")}
        return int(jacobian(part, [0]).evaluate(table, [self.given[0]])[0])


def _dynamics(closed: Tape, motions: Mapping[int, Motion], *, discrete: bool) -> Tape:
    """The drift, or the map, of y.

    What f_i adds of x_i by itself, c x_i, is c p_i/q_i + c Y_i in continuous time: a product of q_i and 1/q_i, which
    intervals would not see to be 1, is left out.
    """
    moved = _Moved(closed.inputs, motions)
    rest, own = (closed, [0.0] * len(closed.outputs)) if discrete else without_own(closed, len(closed.outputs))
    rates = rest.evaluate(moved.plain, moved.x)
    later = moved.apply("add", moved.given[0], moved.graph.const(1.0)) if discrete else moved.given[0]
    for place, factor in enumerate(own):
        y, motion = moved.given[1 + place], motions.get(place)
        if motion is not None:
            taken = moved.at(motion.offset, later) if discrete else moved.speed(motion, factor)
            left = moved.apply("sub", rates[place], taken)
            rates[place] = moved.apply("div", left, moved.at(motion.scale, later))
        slope = moved.graph.const(factor)
        if motion is not None and motion.scale is not None and not discrete:
            stretch = moved.apply("div", moved.slope(motion.scale), moved.at(motion.scale, later))
            slope = moved.apply("sub", slope, stretch)
        rates[place] = moved.apply("add", rates[place], moved.apply("mul", slope, y))
    return moved.graph.tape(rates, closed.shape)


def _gain(gain: Array | Tape, states: tuple[str, ...], motions: Mapping[int, Motion], *, later: bool) -> Array | Tape:
    """The noise's factor, its rows divided by the scales; in discrete time by those at the end of the step."""
    stretched = {place for place, motion in motions.items() if motion.scale is not None}
    if not isinstance(gain, Tape) and not any(np.any(gain[place]) for place in stretched):
        return gain
    moved = _Moved(("t", *states), motions)
    if isinstance(gain, Tape):
        entries = gain.evaluate(moved.plain, moved.x)
    else:
        entries = [moved.graph.const(entry) for entry in gain.ravel().tolist()]
    count = gain.shape[1]
    time = moved.apply("add", moved.given[0], moved.graph.const(1.0)) if later else moved.given[0]
    for place in stretched:
        scale = moved.at(motions[place].scale, time)
        for column in range(place * count, (place + 1) * count):
            if moved.graph.number(entries[column]) != 0.0:
                entries[column] = moved.apply("div", entries[column], scale)
    return moved.graph.tape(entries, tuple(gain.shape))
