"""Reach tubes: for every time piece a set that contains the state, with support function, membership,
distances.

On piece k and cell b of the initial set the enclosure is the Minkowski sum of the nominal curve p(t), an
ellipsoid {||y||_P <= rho}, a zonotope {G xi : |xi_i| <= 1} and a box; any of the last three may be missing.
The reach set is the union over the cells. Both engines fill this one type: the contraction tube (Thm K5)
has an ellipsoid only, the linear response (Thm K7) a zonotope and a box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.display import Shown, log10_text
from certbound.problem.sets import Inside
from certbound.reach.nominal import Curve, polynomial_range
from certbound.reach.sets.clearance import constraint_clearance
from certbound.rigor.intervals import Interval
from certbound.rigor.norms import Norm


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Piece:
    """One time piece of a reach tube: [start, end] and the box hull of the set over it."""

    start: float
    end: float
    low: Array
    high: Array


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class ReachTube(Shown):
    """Sets that contain the state at every time, piece by piece (shapes: cells B, pieces K, states n).

    Proves, for ``noise=False``: every noise-free trajectory from the initial set, under every disturbance
    in D, lies in the set of each piece during that piece. For ``noise=True``: with probability at least 1 -
    10**log10_delta the noisy one does, at all times at once.

    Parameters
    ----------
    curve : Curve
        Nominal curves, one per cell.
    radius : array_like, shape (B, K), optional
        rho of the ellipsoid over each piece; 0 when omitted.
    metric : array_like, shape (n, n), optional
        P of the ellipsoid's norm; the identity when omitted.
    generators : array_like, shape (B, K, n, m), optional
        Generators of the zonotope.
    box : Interval, shape (B, K, n), optional
        The box.
    noise : bool
        Whether the stochastic deviation is included.
    log10_delta : float
        log10 of the probability that a noisy trajectory leaves (-inf without noise).
    method : str
        The engine, in words.
    assumption : str
        What the tube rests on besides the model (user-stated constants); empty when nothing.

    Examples
    --------
    >>> line = Curve(continuous=True, starts=[0.0], ends=[1.0], coefficients=[[[[0.5, 0.0], [1.0, 0.0]]]])
    >>> tube = ReachTube(curve=line, radius=[[0.25]])
    >>> tube.support([1.0, 0.0], 0).round(9).tolist(), tube.contains(1.0, [1.2, 0.1])
    (1.25, True)
    """

    curve: Curve
    radius: Any = None
    metric: Array | None = None
    generators: Array | None = None
    box: Interval | None = None
    noise: bool = False
    log10_delta: float = -np.inf
    method: str = "contraction"
    assumption: str = ""
    norm: Norm = field(init=False, repr=False)

    pictured: ClassVar[bool] = True

    def __post_init__(self) -> None:
        shape = (self.curve.cells, self.curve.pieces)
        radius = np.zeros(shape) if self.radius is None else np.array(self.radius, dtype=float)
        if radius.shape != shape or not np.all(radius >= 0):
            raise ValueError(f"`radius` must be nonnegative of shape {shape}, got shape {radius.shape}.")
        radius.setflags(write=False)
        object.__setattr__(self, "radius", radius)
        object.__setattr__(self, "norm", Norm(self.curve.dimension, self.metric))
        if self.generators is not None:
            generators = np.array(self.generators, dtype=float)
            if generators.shape[:-1] != (*shape, self.curve.dimension):
                raise ValueError(f"`generators` must have shape (*{shape}, n, m), got {generators.shape}.")
            generators.setflags(write=False)
            object.__setattr__(self, "generators", generators)
        if self.box is not None and self.box.shape != (*shape, self.curve.dimension):
            raise ValueError(f"`box` must have shape (*{shape}, n), got {self.box.shape}.")

    def summary(self) -> str:
        """The tube in one line."""
        kind = f"left with probability at most {log10_text(self.log10_delta, ulps=2)}" if self.noise else "noise-free"
        cells = f"{self.curve.cells} cells, " if self.curve.cells > 1 else ""
        return f"{kind}, by {self.method}, up to {self.end:g} in {self.curve.pieces} pieces, {cells}" + (
            f"{self.curve.dimension} states" + (f"; assumes {self.assumption}" if self.assumption else "")
        )

    def to_columns(self, states: Sequence[str] | None = None) -> dict[str, Array]:
        """Columns start, end and, per state, low and high of the box hulls, as ``pandas.DataFrame`` takes them."""
        names = [f"x{k + 1}" for k in range(self.curve.dimension)] if states is None else states
        columns = {"start": np.asarray(self.curve.starts), "end": np.asarray(self.curve.ends)}
        for k, name in enumerate(names):
            columns |= {f"{name}_low": self.hull.lo[:, k], f"{name}_high": self.hull.hi[:, k]}
        return columns

    def to_dict(self) -> dict[str, Any]:
        """Box hulls per piece, and what they rest on."""
        found = {"noise": self.noise, "log10_delta": self.log10_delta if self.noise else None, "method": self.method}
        columns = {name: column.tolist() for name, column in self.to_columns().items()}
        return {**found, "assumption": self.assumption, **columns}

    @property
    def certified(self) -> bool:
        """Whether the tube is proved; False where it rests on samples."""
        return True

    @property
    def end(self) -> float:
        """Last time that the tube covers."""
        return float(self.curve.ends[-1])

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """The time pieces with the box hulls of their sets."""
        hull = self.hull
        return tuple(
            Piece(start=float(a), end=float(b), low=hull.lo[k], high=hull.hi[k])
            for k, (a, b) in enumerate(zip(self.curve.starts, self.curve.ends))
        )

    @cached_property
    def hull(self) -> Interval:
        """Box hull over all cells, shape (K, n)."""
        boxes = self.boxes()
        return Interval(boxes.lo.min(axis=0), boxes.hi.max(axis=0))

    def boxes(self, extra: ArrayLike = 0.0) -> Interval:
        """Box hulls per cell, shape (B, K, n), of the sets grown by ``extra`` (shape (K,)) in the metric."""
        eye = np.eye(self.curve.dimension)
        dual = Interval.point(self.norm.dual(eye))
        grown = Interval.point(np.asarray(extra, dtype=float))[..., None] * dual
        above, below = (np.moveaxis(self.spread(rows[:, None, None]), 0, -1) for rows in (eye, -eye))
        centre = self.curve.range()
        upper = centre + Interval.at_most(above) + grown
        return Interval((centre - Interval.at_most(below) - grown).lo, upper.hi)

    def spread(self, directions: ArrayLike | Interval) -> Array:
        """Upper bounds of a . (x - p(t)) over the sets: directions (..., n) against (B, K) -> (..., B, K).

        A direction may differ from piece to piece, shape (K, n), and from cell to cell, shape (B, K, n); more
        axes come first.
        """
        a = directions if isinstance(directions, Interval) else Interval.point(directions)
        total = Interval.at_most(self.radius) * Interval.point(self.norm.dual(a))
        if self.generators is not None:
            row = a.reshape(*a.shape[:-1], 1, a.shape[-1])
            shares = (row @ Interval.point(self.generators))[..., 0, :]
            total = total + Interval.at_most(shares.mag).sum(axis=-1)
        if self.box is not None:
            total = total + Interval.at_most((a * self.box).hi).sum(axis=-1)
        return np.asarray(np.broadcast_to(total.hi, np.broadcast_shapes(total.shape, self.radius.shape)))

    def support(self, directions: ArrayLike, piece: int) -> Array:
        """Upper bounds of max a . x over the set of ``piece``, shape (..., n) -> (...)."""
        a = np.asarray(directions, dtype=float)
        rows = a.reshape(-1, 1, 1, a.shape[-1])
        part = self.section(piece, piece + 1)
        along = [
            (Interval.point(part.curve.coefficients[..., j, :]) * rows).sum(axis=-1)
            for j in range(part.curve.coefficients.shape[2])
        ]
        total = polynomial_range(along, part.curve.span) + Interval.at_most(part.spread(rows))
        return np.asarray(total.hi.max(axis=(1, 2)).reshape(a.shape[:-1]))

    def center(self, t: float) -> Array:
        """Mean of the cells' nominal states at time t, shape (n,)."""
        return np.asarray(self.curve.value(t).mean(axis=0))

    def extent(self, directions: ArrayLike, t: float) -> Array:
        """Reach of the set from `center` along directions: sup a . (x - center(t)), (..., n) -> (...)."""
        a = np.asarray(directions, dtype=float)
        piece = self.curve.piece_of(float(t))
        centres = self.curve.value(t)
        offsets = a.reshape(-1, a.shape[-1]) @ (centres - centres.mean(axis=0)).T
        spreads = self.section(piece, piece + 1).spread(a.reshape(-1, 1, 1, a.shape[-1]))[..., 0]
        return np.asarray(np.max(offsets + spreads, axis=-1).reshape(a.shape[:-1]))

    def contains(self, t: float, x: ArrayLike, *, tolerance: float = 1e-9) -> bool:
        """Whether a state lies in the set at time t, up to a relative ``tolerance`` for rounding."""
        state = np.asarray(x, dtype=float)
        piece = self.curve.piece_of(float(t))
        neighbours = {piece}
        if self.curve.continuous and piece > 0 and self.curve.starts[piece] == t:
            neighbours.add(piece - 1)
        return any(self._holds(k, float(t), state, tolerance) for k in neighbours)

    def _holds(self, piece: int, t: float, state: Array, tolerance: float) -> bool:
        s = (t - self.curve.middles[piece]) ** np.arange(self.curve.coefficients.shape[2])
        centres = np.einsum("j,bji->bi", s, self.curve.coefficients[:, piece])
        scale = tolerance * (1.0 + float(np.max(np.abs(state))))
        factor = np.eye(len(state)) if self.metric is None else np.linalg.cholesky(np.asarray(self.metric)).T
        slack = scale * float(np.linalg.norm(factor, 2))
        radius = self.radius
        for cell, centre in enumerate(centres):
            rest = self._distance(cell, piece, state - centre, factor)
            if rest <= radius[cell, piece] + slack:
                return True
        return False

    def _distance(self, cell: int, piece: int, offset: Array, factor: Array) -> float:
        """Least ||offset - z||_P over z in the zonotope plus the box."""
        parts = [] if self.generators is None else [self.generators[cell, piece]]
        if self.box is not None:
            box = self.box[cell, piece]
            offset = offset - box.mid
            parts.append(np.diag(box.rad))
        if not parts:
            return float(np.linalg.norm(factor @ offset))
        from scipy.optimize import lsq_linear

        matrix = np.hstack(parts)
        matrix = matrix[:, np.any(matrix != 0, axis=0)]
        if matrix.shape[1] == 0:
            return float(np.linalg.norm(factor @ offset))
        result = lsq_linear(factor @ matrix, factor @ offset, bounds=(-1.0, 1.0), tol=1e-12)
        return float(np.linalg.norm(factor @ (matrix @ result.x - offset)))

    def distance_to(self, constraint: Inside) -> float:
        """Lower bound of the Euclidean distance to breaking ``constraint`` while it is asked; inf if it
        never is.

        Negative: the set of some piece breaks it, or could not be shown not to.
        """
        room = constraint_clearance(self, constraint, Norm(self.curve.dimension))
        return float(np.min(room.radius, initial=np.inf))

    def section(self, first: int, last: int) -> ReachTube:
        """Pieces ``first`` up to, but without, ``last``."""
        return self.altered(
            curve=self.curve.section(first, last),
            radius=self.radius[:, first:last],
            generators=None if self.generators is None else self.generators[:, first:last],
            box=None if self.box is None else self.box[:, first:last],
        )

    def until(self, pieces: int) -> ReachTube:
        """The first ``pieces`` pieces."""
        return self.section(0, pieces)

    def grown(self, extra: ArrayLike, *, log10_delta: float, method: str) -> ReachTube:
        """The tube with a stochastic deviation of ``extra`` (shape (K,)) in the metric added."""
        radius = (Interval.point(self.radius) + Interval.point(np.asarray(extra, dtype=float))).hi
        return self.altered(radius=radius, noise=True, log10_delta=log10_delta, method=method)

    def altered(self, **changes: Any) -> ReachTube:
        """A copy with some fields replaced."""
        return replace(self, **changes)
