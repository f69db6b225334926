"""Proposals of V over a stage after which another one comes: V joins what follows, and layers grow at new faces."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from certbound.arrays import Array
from certbound.values.continuous.plane.plane_grids import Plan, Plane, Source
from certbound.values.continuous.plane.plane_proposal import SolverBelow
from certbound.values.continuous.plane.solver import Solver
from certbound.values.continuous.plane.stages import Stage
from certbound.values.continuous.plane.target_proposal import smooth
from certbound.values.continuous.surface import Surface
from certbound.values.polynomials import HERMITE

_BENT = 3.0  # cells over which V leaves 0 inside a gate that is narrower than the box
_NEW = 1e-3  # a face where what follows is lower than minus this is new

Values = Callable[[Array, Array], Array]


def values_of(surface: Surface) -> Values:
    """V at the surface's beginning at the products of points along both states (given as grids); 0 beyond its faces."""

    def values(x: Array, y: Array) -> Array:
        places = x[:, 0], y[0]
        maps = [_hermite(nodes, points) for nodes, points in zip(surface.axes, places)]
        return np.asarray(np.einsum("pia,iajb,qjb->pq", maps[0], surface.values[0], maps[1], optimize=True))

    return values


def _hermite(nodes: Array, points: Array) -> Array:
    """The weights of the data of all nodes for values at points, shape (points, nodes, 3); 0 outside."""
    cell = np.clip(np.searchsorted(nodes, points, side="right") - 1, 0, len(nodes) - 2)
    width = np.diff(nodes)[cell]
    s = (points - nodes[cell]) / width
    basis = np.stack([c * s**k * (1 - s) ** (5 - k) for k, c in enumerate((1, 5, 10, 10, 5, 1))], axis=1) @ HERMITE
    basis = basis * np.where((s >= 0) & (s <= 1), 1.0, 0.0)[:, None]
    found = np.zeros((len(points), len(nodes), 3))
    rows = np.arange(len(points))
    for order in range(3):
        found[rows, cell, order] = basis[:, order] * width**order
        found[rows, cell + 1, order] = basis[:, 3 + order] * width**order
    return found


class LaterAbove(Solver):
    """V = 0 on all faces and outside of the gate; within it V is what follows, or nothing at the last time."""

    def __init__(self, plane: Plane, plan: Plan, source: Source | None, stage: Stage, after: Values | None) -> None:
        self.stage, self.after = stage, after
        super().__init__(plane, plan, source)

    def start(self) -> Array:
        follows = np.full(self.x.shape, -np.inf) if self.after is None else np.minimum(self.after(self.x, self.y), 0.0)
        rows, bent = [np.maximum(follows, -1e4)], np.ones(self.x.shape)
        for axis, place in enumerate((self.x, self.y)):
            for side in (0, 1):
                gate = (self.stage.gate_low, self.stage.gate_high)[side][axis]
                face = (self.plane.low, self.plane.high)[side][axis]
                inside = gate > face if side == 0 else gate < face
                edge = gate if inside else face
                away = np.maximum(place - edge if side == 0 else edge - place, 0.0)
                if inside:
                    width = float(np.interp(edge, self.nodes[axis], np.gradient(self.nodes[axis])))
                    bent = bent * smooth(away / (_BENT * width))
                if self.after is None or (not inside and np.take(follows, -side, axis=axis).min() < -_NEW):
                    rate, bend, curve = self._layer(axis, side)
                    depth = rate * away
                    rows.append(np.log1p(bend * depth) + 0.5 * curve * depth**2 * np.exp(-depth) - depth)
        if len(rows) > 1:
            with np.errstate(divide="ignore"):  # 1 - the product of 1 - exp(row), which far from faces is the sum
                rest = np.sum([np.log1p(-np.exp(np.minimum(row, 0.0))) for row in rows], axis=0)
                near = np.log(-np.expm1(rest))
            total = np.where(np.logaddexp.reduce(rows) < -15, np.logaddexp.reduce(rows), near)
        else:
            total = rows[0]
        value = np.minimum(np.maximum(total, -1e4), 0.0) * bent
        value[self.edge] = 0.0
        return np.asarray(value)


class LaterBelow(SolverBelow):
    """V is drawn in the margin to what it begins with there, and from that to 0."""

    def __init__(self, plane: Plane, plan: Plan, source: Source | None, stage: Stage, after: Values | None) -> None:
        self.stage, self.after = stage, after
        super().__init__(plane, plan, source)
        self.begun = self.start()

    def start(self) -> Array:
        if self.after is not None:
            places = (self.x, self.y)
            x, y = (np.clip(p, low, high) for p, low, high in zip(places, self.plane.low, self.plane.high))
            return np.asarray(np.clip(self.after(x, y), self.plan.floor, 0.0))
        rest = np.ones(self.x.shape)
        for axis, place in enumerate((self.x, self.y)):
            for side in (0, 1):
                gate = (self.stage.gate_low, self.stage.gate_high)[side][axis]
                if (gate > self.plane.low[axis]) if side == 0 else (gate < self.plane.high[axis]):
                    width = float(np.interp(gate, self.nodes[axis], np.gradient(self.nodes[axis])))
                    beyond = gate - place if side == 0 else place - gate
                    rest = rest * (1 - smooth(beyond / (_BENT * width)))
        if rest.min() > 0:
            return super().start()
        return np.asarray(self.plan.floor * rest)

    def face(self, tau: float) -> tuple[Array | float, Array | float]:
        s, begun = min(tau / self.plan.lead, 1.0), self.begun[self.edge]
        risen = s**3 * (10 - 15 * s + 6 * s * s)
        return begun * (1 - risen), -begun * 30 * (s * (1 - s)) ** 2 / self.plan.lead

    def _fed(self, tau: float, value: Array) -> Array:
        s = min(tau / self.plan.lead, 1.0)
        wanted = self.begun * (1 - s**3 * (10 - 15 * s + 6 * s * s))
        return np.asarray(self.drawn * (wanted - value) - self._source(tau))
