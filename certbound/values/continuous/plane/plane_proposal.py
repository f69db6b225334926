"""Proposals for both sides: faces at V = 0 above, a margin around the box below."""

from __future__ import annotations

import math

import numpy as np

from certbound.arrays import Array
from certbound.values.continuous.plane.plane_grids import Plan, Plane, Source, layer_rate, rise, spread_nodes
from certbound.values.continuous.plane.solver import Solver, integrated
from certbound.values.continuous.surface import Surface

_OUTSIDE = 12  # cells of the margin around the box, for lower bounds
_MARGIN = 4.0  # its width, in units of 1/k
_DRAWN = 400.0  # how fast V is drawn there, in units of the speed at which it rises
_STIFF = 20.0  # by how much that may exceed one over a step
_CARELESS = 4.0  # times the cells that V may move by in a step there
_DEEPER = 3.0  # below what V is on the faces at T, for lower bounds


def propose_plane(plane: Plane, plan: Plan, source: Source | None = None) -> Surface | None:
    """V on a tensor grid; None where the integration breaks down or needs too many steps."""
    return integrated((SolverBelow if plan.below else Solver)(plane, plan, source))


class SolverBelow(Solver):
    """For lower bounds: a margin around the box, where V is drawn to what it should be on the faces at each time.

    On the faces themselves V may be anything that is not positive. Were it given there, it would rise on two of them
    at each corner, where V has no curvature then that could make it rise: a residual that nothing pays for.
    """

    def __init__(self, plane: Plane, plan: Plan, source: Source | None) -> None:
        super().__init__(plane, plan, source)
        shares = [
            np.maximum(np.maximum((low - place) / (low - nodes[0]), (place - high) / (nodes[-1] - high)), 0.0)
            for place, low, high, nodes in zip((self.x, self.y), plane.low, plane.high, self.nodes)
        ]
        drawn = np.minimum(shares[0] ** 2 + shares[1] ** 2, 1.0)
        self.drawn = -_DRAWN * plan.floor / plan.lead * drawn
        self.counted, _ = plane.counted(self.x, self.y)

    def grid(self, axis: int) -> Array:
        nodes = spread_nodes(self.plane, self.plan, axis)
        wide = [_MARGIN / layer_rate(self.plane, self.plan, axis, side) for side in (0, 1)]
        out = [width * np.arange(1, _OUTSIDE + 1) / _OUTSIDE for width in wide]
        return np.concatenate([nodes[0] - out[0][::-1], nodes, nodes[-1] + out[1]])

    def _model(self, t: float) -> tuple[Array, Array]:
        x, y = (np.clip(p, low, high) for p, low, high in zip((self.x, self.y), self.plane.low, self.plane.high))
        return self.plane.drift(t, x, y), self.plane.square(t, x, y)

    def _eased(self, force: Array, a: Array, slopes: tuple[Array, Array], value: Array) -> Array:
        return force

    def _viscosity(self, a: Array, slopes: tuple[Array, Array], bends: tuple[Array, Array]) -> Array:
        return np.zeros(a.shape)

    def start(self) -> Array:
        """V falls from the faces as steeply as it has to where it follows them, and ends a little deeper."""
        product = np.ones(self.x.shape)
        for axis, place in enumerate((self.x, self.y)):
            for side in (0, 1):
                away = place - self.plane.low[axis] if side == 0 else self.plane.high[axis] - place
                k = rise(self.plane, self.plan, axis, side, self.x, self.y)
                product = product * -np.expm1(-k * np.maximum(away, 0.0))
        least = math.exp(-_DEEPER)
        return np.asarray(self.plan.floor + np.log(least + (1 - least) * (1 - product)))

    def face(self, tau: float) -> tuple[Array | float, Array | float]:
        s, top = min(tau / self.plan.lead, 1.0), self.plan.floor
        rise = s**3 * (10 - 15 * s + 6 * s * s)
        return top * (1 - rise), -top * 30 * (s * (1 - s)) ** 2 / self.plan.lead

    def _fed(self, tau: float, value: Array) -> Array:
        return np.asarray(self.drawn * (self._drawn_to(tau) - value) - self._source(tau))

    def _drawn_to(self, tau: float) -> Array:
        """V on the faces, and what it is at T on those that are no limits."""
        return np.asarray(self.plan.floor + self.counted * (self.face(tau)[0] - self.plan.floor))

    def _falls(self, tau: float, value: Array) -> Array:
        return np.asarray(self.drawn)

    def steps(self, tau: float, value: Array, span: float) -> int:
        return max(super().steps(tau, value, span), math.ceil(span * float(self.drawn.max()) / _STIFF))

    def _reaches(self) -> list[Array]:
        """In the margin, where nothing has to be accurate, V may move by more cells in a step."""
        return [np.where(self.drawn > 0, _CARELESS * width, width) for width in self.widths]

    def surface(self, times: Array, values: list[Array], first: list[Array], last: list[Array]) -> Surface:
        """What lies in the box."""
        whole = super().surface(times, values, first, last)
        kept = slice(_OUTSIDE, -_OUTSIDE)
        parts = [part[:, kept, :, kept] for part in (whole.values, whole.start_rates, whole.end_rates)]
        return Surface(
            axes=tuple(axis[kept] for axis in whole.axes), times=whole.times, values=parts[0], start_rates=parts[1],
            end_rates=parts[2],
        )  # fmt: skip
