"""Sets of the deterministic responses y and R along rows, for one cell of the initial set.

Inside a continuous-time piece a response s obeys s_t = Phi(t, t_k) s_k + (what the piece itself adds); along a row
w the first part stays between its two ends up to a bulge of (h^2/8) |w| |Phi''| |s_k|.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Integers
from certbound.gaussian.response import LinearResponse, RowResponse
from certbound.rigor.rounding import quiet

_ROUND = 1 + 1e-13
_UNIT = 2.0**-53


@dataclass(frozen=True, eq=False, kw_only=True)
class Gathering:
    """Effect of one piece on its end and on its inside; shapes (B, N, ...).

    ``centre`` maps a constant remainder to the end of the piece, up to ``second`` times its size; ``first`` bounds
    |Phi - I|; ``curve`` times |s_k| bounds how far Phi(t, t_k) s_k bulges beyond its chord; ``generators`` and
    ``box`` hold the disturbance's effect at the end of the piece, ``size`` bounds |E (d - d0)|.
    """

    centre: Array
    second: Array
    first: Array
    curve: Array
    generators: Array
    box: Array
    size: Array

    def of_cell(self, cell: int) -> Gathering:
        """The data of one cell."""
        return Gathering(**{name: getattr(self, name)[cell] for name in self.__dataclass_fields__})


def gathering_of(
    response: LinearResponse, slope: Array, gain: Array, d_radius: Array, *, continuous: bool
) -> Gathering:
    """The gathering of slopes A (B, N, n, n), gains E (B, N, n, q) and a disturbance |d - d0| <= ``d_radius`` (q,)."""
    h, n = response.step, slope.shape[-1]
    size_e = np.abs(gain) @ d_radius
    if not continuous:
        generators = gain * d_radius
        loss = np.abs(generators).sum(-1) * 4 * 2.0**-53
        zero = np.zeros((*slope.shape[:2], n, n))
        return Gathering(centre=zero + np.eye(n), second=zero, first=zero, curve=zero,
                         generators=np.swapaxes(generators, -1, -2), box=loss, size=size_e)
    identity = np.eye(n)
    middle = identity + (h / 2) * slope
    second = np.maximum(response.deviation - h * np.abs(slope), 0.0) + 4e-16 * response.deviation
    box = (h * h / 4 * np.abs(slope) + h * second) @ size_e[..., None]
    generators = h * (middle @ gain) * d_radius
    rounding = 16 * (n + 4) * 2.0**-53 * h * (np.abs(middle) @ size_e[..., None])
    size = np.abs(slope) + h * np.abs(response.drift)
    bend = np.abs(response.drift) + size @ size * _ROUND
    return Gathering(
        centre=h * middle, second=h * second, first=response.deviation,
        curve=h * h / 8 * (bend @ (identity + response.deviation)) * _ROUND,
        generators=np.swapaxes(generators, -1, -2), box=(box + rounding)[..., 0] * _ROUND, size=size_e * _ROUND,
    )


class Supports:
    """Bounds of y and R of one cell along ``rows`` over every piece (and along the coordinates at every node).

    Where numbers overflow the bounds are infinite.

    Parameters
    ----------
    gathering : Gathering
        Of this cell.
    rows : ndarray, shape (N, D, n)
        In discrete time N + 1 rows, one a node.
    generators : ndarray, shape (G, n)
        Zonotope of the initial set about the nominal start.
    outputs : ndarray of int, optional
        States that the remainder or the disturbance moves by more than a rounding error (discrete time).
    """

    @quiet
    def __init__(
        self, response: LinearResponse, gathering: Gathering, cell: int, rows: Array, generators: Array,
        *, continuous: bool, outputs: Integers | None = None,
    ) -> None:
        self.gathering, self.continuous, self.step = gathering, continuous, response.step
        self.rows = rows
        self.pieces, self.n = response.pieces, rows.shape[2]
        nodes = self.pieces + 1
        count = rows.shape[1]
        self.count = count
        unit = np.broadcast_to(np.eye(self.n), (nodes, self.n, self.n))
        parts = [unit, _padded(rows, nodes)]
        if continuous:
            f, phi = response.transition[cell], response.transition_error[cell]
            parts.append(_padded(rows @ f, nodes))
            self.end_error = phi[:, None] + 2 * (self.n + 2) * _UNIT * np.abs(f).max(axis=(1, 2))[:, None]
        self.response = RowResponse(response, cell, np.concatenate(parts, axis=1), None if continuous else outputs)
        main = (self.response.start(generators) + self.response.segments(gathering.generators)
                + self.response.boxes(gathering.box))
        total = self._with_errors(main, np.zeros_like(main))[1]
        self.y_nodes = total[:, : self.n]
        self.y = self._over_pieces(-total, total, own=None)[1]

    def _with_errors(self, upper: Array, lower: Array) -> tuple[Array, Array]:
        """Add the effect of rounded adjoint rows; ``upper`` and -``lower`` bound the exact sums."""
        reach = np.maximum(np.abs(upper), np.abs(lower))[:, : self.n]
        sizes = 1.001 * reach + 1e-290
        for _ in range(20):
            error = self.response.errors(sizes)
            if not np.isfinite(error[:, : self.n]).all():
                break
            if np.all(reach + error[:, : self.n] <= sizes):
                return lower - error, upper + error
            sizes = 2 * (reach + error[:, : self.n])
        return np.full_like(lower, -np.inf), np.full_like(upper, np.inf)

    def _over_pieces(self, lower: Array, upper: Array, own: tuple[Array, Array] | None) -> tuple[Array, Array]:
        """From values at the nodes (all rows) to bounds over the pieces along ``rows``."""
        n, count = self.n, self.count
        start = slice(n, n + count)
        if not self.continuous:
            return _known(lower[: len(self.rows), start], upper[: len(self.rows), start])
        last = slice(n + count, n + 2 * count)
        size = np.maximum(np.abs(lower), np.abs(upper))[:-1, :n]
        weights = np.abs(self.rows)
        bulge = np.einsum("kdi,kij,kj->kd", weights, self.gathering.curve, size)
        bulge += weights.sum(-1) * self.end_error * size.sum(-1)[:, None]
        low = np.minimum(lower[:-1, start], lower[:-1, last]) - bulge * _ROUND
        high = np.maximum(upper[:-1, start], upper[:-1, last]) + bulge * _ROUND
        if own is None:
            inside = self.gathering.size + np.einsum("kij,kj->ki", self.gathering.first, self.gathering.size)
            added = self.step * np.einsum("kdi,ki->kd", weights, inside) * _ROUND
            own = -added, added
        return _known(low + own[0], high + own[1])

    @quiet
    def remainder(self, low: Array, high: Array) -> tuple[Array, Array, Array]:
        """Bounds of R over every piece from those of beta (N, n): lower, upper (N, D), and |R| at the nodes."""
        if not (np.any(low) or np.any(high)):  # what is not there moves nothing
            none = np.zeros((len(self.rows), self.count))
            return none, none.copy(), np.zeros((self.pieces + 1, self.n))
        g, h = self.gathering, self.step
        middle = (low + high) / 2
        radius = np.maximum(high - middle, middle - low) * (1 + 1e-15)
        size = np.abs(middle)
        centre = np.einsum("kij,kj->ki", g.centre, middle)
        box = h * (radius + np.einsum("kij,kj->ki", g.first, radius)) + np.einsum("kij,kj->ki", g.second, size)
        box += 4 * (self.n + 4) * _UNIT * np.einsum("kij,kj->ki", np.abs(g.centre), size)
        value, reach = self.response.centred(centre, box * _ROUND)
        lower, upper = self._with_errors(value + reach, value - reach)
        own = None
        if self.continuous:
            linear = h * np.einsum("kdi,ki->kd", self.rows, middle)
            weights = np.abs(self.rows)
            full = np.einsum("kij,kj->ki", g.first, size + radius)
            rest = h * np.einsum("kdi,ki->kd", weights, radius + full) * _ROUND
            rest += h * 4 * (self.n + 4) * _UNIT * np.einsum("kdi,ki->kd", weights, size)
            own = (np.minimum(linear, 0) - rest, np.maximum(linear, 0) + rest)
        lo, hi = self._over_pieces(lower, upper, own)
        return lo, hi, np.maximum(np.abs(lower), np.abs(upper))[:, : self.n]


def _known(low: Array, high: Array) -> tuple[Array, Array]:
    """Bounds from below and above; infinite ones for what is no number."""
    return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)


def _padded(rows: Array, nodes: int) -> Array:
    if len(rows) == nodes:
        return rows
    return np.concatenate([rows, np.zeros((nodes - len(rows), *rows.shape[1:]))])
