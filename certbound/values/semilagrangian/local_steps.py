"""One step from coarse boxes: the flow's derivatives, the covariance, the remainder, block by block."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.rigor.intervals import Interval, concatenate, sq
from certbound.values.semilagrangian.flows import EQUATIONS, augmented, flow, sheared
from certbound.values.semilagrangian.noisy_axis import Setting
from certbound.values.semilagrangian.remainders import Remainders, remainders


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Clock:
    """One step: its length h, the shear, and the levels of the noise that are followed (``remainders``)."""

    step: float
    count: int
    shear: float
    omega: float
    chord: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Blocks:
    """What is known of a step from boxes of (y, q), all of shape (blocks of y, blocks of q).

    Attributes
    ----------
    image : (Interval, Interval)
        Of the flow, in (y, q).
    slopes : ndarray, shape (4, ...)
        Ranges of d_y y and d_y q.
    bends : ndarray, shape (4, ...)
        |d_yy y|, |d_yy q|, |d_qq y|, |d_qq q|.
    covariance : (Interval, Interval, Interval)
        S_yy, S_yq, S_qq.
    tilted : (Interval, Interval, Interval)
        S_qq in the box's middle, and its derivatives by y and q over the box.
    strays : Remainders
        In (p, q).
    known : ndarray of bool
    """

    image: tuple[Interval, Interval]
    slopes: Array
    bends: Array
    covariance: tuple[Interval, Interval, Interval]
    tilted: tuple[Interval, Interval, Interval]
    strays: Remainders
    known: Mask


def blocks_of(
    setting: Setting, clock: Clock, y: Array, q: Array, *, order: int, wanted: Mask | None = None
) -> Blocks:
    """Enclose one step from every box of the grid y x q (from those ``wanted``; nothing is known of the others)."""
    low = np.meshgrid(y[:-1], q[:-1], indexing="ij")
    high = np.meshgrid(y[1:], q[1:], indexing="ij")
    shape = low[0].shape
    keep = np.ones(shape, dtype=bool) if wanted is None else wanted
    box = [Interval(a[keep], b[keep]) for a, b in zip(low, high)]
    size = int(keep.sum())
    middle = [Interval.point(value.mid) for value in box]
    both = [concatenate([value, point]) for value, point in zip(box, middle)]  # boxes and their middles in one go
    zero, one = Interval.point(np.zeros(2 * size)), Interval.point(np.ones(2 * size))
    tape = augmented(sheared(setting.tape, clock.shear), setting.noise, clock.shear)
    rest = [one, zero, zero, one, *[zero] * (EQUATIONS - 6)]
    flown = flow(tape, [*both, *rest], clock.step, order)
    end, centre = [value[:size] for value in flown.end], [value[size:] for value in flown.end]
    away = [value - point for value, point in zip(box, middle)]
    covariance = [_both(end[k], centre[k] + end[k + 3] * away[0] + end[k + 6] * away[1]) for k in range(10, 13)]
    p = box[0] + box[1] * clock.shear
    strays = remainders(
        setting.tape, setting.noise * (1 + setting.spread), p, box[1], step=clock.step, omega=clock.omega,
        chord=clock.chord,
    )  # fmt: skip
    loose = Interval(1 - 4 * setting.spread - 1e-15, 1 + 4 * setting.spread + 1e-15)

    def filled(part: Array) -> Array:
        whole = np.zeros((*part.shape[:-1], *shape))
        whole[..., keep] = part
        return whole

    def shaped(value: Interval) -> Interval:
        return Interval(filled(value.lo), filled(value.hi))

    known = flown.known[:size] & flown.known[size:] & strays.known
    return Blocks(
        image=(shaped(end[0]), shaped(end[1])),
        slopes=filled(np.stack([getattr(end[k], side) for k in (2, 3) for side in ("lo", "hi")])),
        bends=filled(np.stack([end[k].mag for k in range(6, 10)])),
        covariance=tuple(shaped(value * loose) for value in covariance),  # type: ignore[arg-type]
        tilted=tuple(shaped(value * loose) for value in (centre[12], end[15], end[18])),  # type: ignore[arg-type]
        strays=_filled(strays, filled), known=filled(known.astype(float)) > 0,
    )  # fmt: skip


def _filled(strays: Remainders, filled: Callable[[Array], Array]) -> Remainders:
    p, q = (Interval(filled(part.lo), filled(part.hi)) for part in strays.tube)
    return replace(
        strays, most=filled(strays.most), mean=filled(strays.mean), dip=filled(strays.dip),
        inward=filled(strays.inward), tube=(p, q),
    )  # fmt: skip


def _both(one: Interval, other: Interval) -> Interval:
    """The intersection of two enclosures of the same thing."""
    low, high = np.maximum(one.lo, other.lo), np.minimum(one.hi, other.hi)
    return Interval(np.minimum(low, high), high)


def height_on(
    blocks: Blocks, edges: tuple[Array, Array], index: tuple[Index, Index], axes: tuple[Array, Array]
) -> Interval:
    """S_qq on cells of finer axes, shape (len(y) - 1, len(q) - 1): its mean-value form about the blocks' middles."""
    spread = np.ix_(*index)
    found, by_y, by_q = (part[spread] for part in blocks.tilted)
    places = [
        Interval(axis[:-1], axis[1:]) - Interval.point(Interval(edge[:-1], edge[1:]).mid[block])
        for axis, edge, block in zip(axes, edges, index)
    ]
    found = found + by_y * places[0][:, None] + by_q * places[1][None]
    return _both(found, blocks.covariance[2][spread])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Base:
    """The noise of y that a band's kernels are made for: D = S - diag(sigma_y^2, v) >= 0 on ``known`` blocks, if v is
    at most S_qq less ``tilt``.

    ``excess`` holds upper bounds of D_yy, |D_yq|, and the tilt D_yq^2/D_yy, shape (3, blocks of y, blocks of q).
    """

    sigma: float
    excess: Array
    known: Mask


def base_of(blocks: Blocks, known: Mask) -> Base:
    """About the largest such law, given up on the few blocks where the covariance is most uncertain."""
    yy, yq, qq = blocks.covariance
    with np.errstate(all="ignore"):
        tilt = np.where(known & (yy.lo > 0), yq.mag / np.sqrt(np.maximum(yy.lo, 1e-300) * qq.lo), np.inf)
    limit = max(0.02, 4 * float(np.median(tilt[known])))
    known = known & (tilt <= min(limit, 0.3))
    if not known.any():
        return Base(sigma=1.0, excess=np.zeros((3, *known.shape)), known=known)
    share = 4.2 * min(float(tilt[known].max()), 0.2) + 1e-6
    sigma = math.sqrt(float(yy.lo[known].min()) * (1 - share))
    first = yy - sq(Interval.point(sigma))
    fine = first.lo > 0
    least = sq(yq) / Interval.point(np.where(fine, first.lo, 1.0))
    return Base(sigma=sigma, excess=np.stack([first.hi, yq.mag, least.hi]), known=known & fine)
