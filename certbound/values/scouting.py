"""Where failing paths go, in floats: a rough value function in the plane, and the visits of the paths that fail.

One step of a coarse chain is a matrix P on a grid: u_k = P u_{k+1}, 1 where paths have failed. From the starts visits
are m_{k+1} = P' m_k, and given that a path fails they are m_k u_k / u_0 (Doob). Nothing is proved with this: it says
where a grid has to be fine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.values.grids import corners

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Ends = tuple[float, float]

_NODES = (141, 121)
_KICKS = np.polynomial.hermite_e.hermegauss(5)
_LEAST = 1e-280
_NEAR, _FARTHER = 6, 3.2  # nodes, and deviations of a step's noise, around all that paths come to: kicks are bounded
_CHAINS = 12  # for the times of a model that changes with it, where only that is asked
_FLAT = 1e-3  # of the least answer: what lies below is flat


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Scouted:
    """What paths that fail do at the points of a grid, shape (N,) each, in seconds a path.

    Attributes
    ----------
    p, q : ndarray
        The points.
    visits : ndarray
        Time spent near a point.
    steep_p, steep_q : ndarray
        The same, times the square of d_p log u and the cube of |d_q log u|.
    cells : (float, float)
        The grid's distances.
    share : float
        Of the paths that fail, roughly, from the worst start.
    """

    p: Array
    q: Array
    visits: Array
    steep_p: Array
    steep_q: Array
    cells: tuple[float, float]
    share: float


def scouted(
    drift: Callable[[float, Array, Array], Array], noise: float, faces: tuple[Ends, Ends],
    starts: Array, horizon: float, steps: int, broken: Callable[[Array, Array], Mask], *, timed: bool = False,
) -> Scouted | None:  # fmt: skip
    """Follow dp = F dt, dq = g dt + s dW; None where nothing fails or all does, or the drift is undefined.

    Parameters
    ----------
    drift : callable
        (F, g) at a time and points, shape (2, N).
    noise : float
        s.
    faces : pair of ends
        A box; who leaves it fails.
    starts : ndarray, shape (K, 2)
        Each counts alike.
    broken : callable
        Which points of the box fail.
    timed : bool
        Whether the drift changes with time.
    """
    axes = [np.linspace(*ends, count) for ends, count in zip(faces, _NODES)]
    p, q = (part.ravel() for part in np.meshgrid(*axes, indexing="ij"))
    length = horizon / steps
    fails = broken(p, q)
    chains = []
    for k in range(steps if timed else 1):
        step, lost = _chain(partial(drift, (k + 0.5) * length), noise, axes, (p, q), length)
        if step is None:
            return None
        chains.append((step, lost))
    values = [np.where(fails, 1.0, 0.0)]
    for k in reversed(range(steps)):
        step, lost = chains[k % len(chains)]
        values.append(np.where(fails, 1.0, step @ values[-1] + lost))
    index, weight = _placed(axes, starts[:, 0], starts[:, 1])
    first = (values[-1][index] * weight).sum(axis=1)
    if not first.min() > _LEAST:
        return None
    mass = np.bincount(index.ravel(), (weight / first[:, None]).ravel() / len(starts), minlength=len(p))
    visits, steep_p, steep_q = np.zeros((3, len(p)))
    floor = _FLAT * first.min()
    back = [step.T.tocsr() for step, _ in chains]
    for k, value in enumerate(values[::-1]):
        share = np.where(fails, 0.0, mass * value) * length
        slopes = np.gradient(np.log(np.maximum(value, floor)).reshape(_NODES), *axes)
        visits += share
        steep_p += share * slopes[0].ravel() ** 2
        steep_q += share * np.abs(slopes[1].ravel()) ** 3
        mass = back[k % len(back)] @ np.where(fails, 0.0, mass)
    if not (steep_p.any() and steep_q.any()):
        return None
    cells = float(axes[0][1] - axes[0][0]), float(axes[1][1] - axes[1][0])
    return Scouted(
        p=p, q=q, visits=visits, steep_p=steep_p, steep_q=steep_q, cells=cells, share=float(first.max())
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Reached:
    """Points of a grid that paths come near before they fail, ``seen`` (K, *grid) at the times 0, step, 2 step, ..."""

    axes: list[Array]
    seen: Mask

    def cells(self, y: Array, q: Array, shear: float, when: slice) -> Mask:
        """Which cells of (y, q), p = y + shear q, have such a corner at some of these times."""
        seen = np.asarray(self.seen[when].any(axis=0))
        p = y[:, None] + shear * q
        place = [
            np.clip(np.rint((x - axis[0]) / (axis[1] - axis[0])), 0, len(axis) - 1).astype(int)
            for axis, x in zip(self.axes, (p, np.broadcast_to(q, p.shape)))
        ]
        return np.asarray(np.logical_or.reduce(corners(seen[tuple(place)])))


def reached(
    drift: Callable[[float, Array, Array], Array], noise: float, faces: tuple[Ends, Ends], starts: tuple[Ends, Ends],
    step: float, count: int, broken: Callable[[Array, Array], Mask], *, overlooked: float, timed: bool = False,
) -> Reached | None:  # fmt: skip
    """What paths from the starts come near in ``count`` steps; None where the drift is undefined.

    ``overlooked``: what all points that are left out may be visited, of a path from every start on the grid.
    """
    from scipy.ndimage import maximum_filter

    axes = [np.linspace(*ends, nodes) for ends, nodes in zip(faces, _NODES)]
    p, q = (part.ravel() for part in np.meshgrid(*axes, indexing="ij"))
    fails, cells = broken(p, q), [axis[1] - axis[0] for axis in axes]
    back, every = None, max(1, -(-count // _CHAINS)) if timed else count + 1
    near = [(x >= low - cell) & (x <= high + cell) for x, (low, high), cell in zip((p, q), starts, cells)]
    mass = np.where(near[0] & near[1], 1.0, 0.0)
    wide = _NEAR, _NEAR + int(np.ceil(_FARTHER * noise * np.sqrt(step) / cells[1]))
    found = np.zeros((count + 1, *_NODES), dtype=bool)
    for k in range(count + 1):
        rising = np.sort(mass)
        least = rising[np.searchsorted(np.cumsum(rising), overlooked / (count + 1))]
        seen = (mass >= least).reshape(_NODES)
        found[k] = maximum_filter(seen, [2 * width + 1 for width in wide])
        if k % every == 0:
            chain, _ = _chain(partial(drift, (k + every / 2) * step), noise, axes, (p, q), step)
            if chain is None:
                return None
            back = chain.T.tocsr()
        mass = back @ np.where(fails, 0.0, mass)
    return Reached(axes=axes, seen=found)


def _chain(
    drift: Callable[[Array, Array], Array], noise: float, axes: list[Array], points: tuple[Array, Array], length: float
) -> tuple[csr_array | None, Array]:
    """The matrix of a step, and what leaves the box in it; (None, ...) where the drift is undefined."""
    from scipy.sparse import csr_array

    p, q = points
    total: csr_array | None = None
    lost = np.zeros(len(p))
    for kick, weight in zip(_KICKS[0], _KICKS[1] / _KICKS[1].sum()):
        push = np.array([0.0, noise * kick / np.sqrt(length)])[:, None]
        with np.errstate(all="ignore"):
            middle = np.stack([p, q]) + length / 2 * (drift(p, q) + push)
            end = np.stack([p, q]) + length * (drift(*middle) + push)
        if not np.isfinite(end).all():
            return None, lost
        out = np.logical_or.reduce([(x < axis[0]) | (x > axis[-1]) for x, axis in zip(end, axes)])
        lost += weight * out
        index, parts = _placed(axes, *end)
        parts = parts * np.where(out, 0.0, weight)[:, None]
        rows = np.repeat(np.arange(len(p)), 4)
        part = csr_array((parts.ravel(), (rows, index.ravel())), shape=(len(p), len(p)))
        total = part if total is None else total + part
    return total, lost


def _placed(axes: list[Array], p: Array, q: Array) -> tuple[Index, Array]:
    """The four nodes around points and their bilinear weights, shapes (N, 4)."""
    found = []
    for axis, x in zip(axes, (p, q)):
        place = np.clip((x - axis[0]) / (axis[1] - axis[0]), 0.0, len(axis) - 1.0)
        k = np.minimum(place.astype(int), len(axis) - 2)
        found.append((k, place - k))
    (i, t), (j, s) = found
    index = np.stack([(i + a) * len(axes[1]) + j + b for a in (0, 1) for b in (0, 1)], axis=1)
    weight = np.stack([(t if a else 1 - t) * (s if b else 1 - s) for a in (0, 1) for b in (0, 1)], axis=1)
    return index, weight
