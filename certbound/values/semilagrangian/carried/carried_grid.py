"""The grid and the levels for one length of the steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy, jacobian
from certbound.rigor.intervals import Interval
from certbound.values.grids import graded_axis
from certbound.values.semilagrangian.carried.carried_motion import Blocks, blocks_of, images_of
from certbound.values.semilagrangian.carried.carried_problem import STATES, Voyage
from certbound.values.semilagrangian.carried.carried_step import Layout, kick_of
from certbound.values.semilagrangian.remainders import upper_tail

_UP = 1 + 1e-9
_LEAST = 0.1  # of the widest cells
_MOST = 1_000_000  # cells along q


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Fineness:
    """How fine: steps, and the cells' sizes.

    Attributes
    ----------
    count : int
        Steps.
    cells : int
        Along each coordinate without noise, about.
    edge : float
        Size of the cells near its faces, relative to how far the noise has blurred a front that gets there.
    cell : float
        Cells along q, in standard deviations of a step's noise.
    omega : float
        Standard deviations that the noise of half a step is followed.
    """

    count: int
    cells: int
    edge: float
    cell: float
    omega: float

    @property
    def rare(self) -> float:
        """Upper bound of the probability of the events of one step that are not followed."""
        return 12 * upper_tail(self.omega)


def layout_of(voyage: Voyage, fineness: Fineness) -> Layout:
    """Prepare the steps.

    Raises
    ------
    InfeasibleError
        No part of the safe set could be followed over a step.
    """
    step = voyage.horizon / fineness.count * (1 + 1e-15)
    axes = axes_of(voyage, fineness, step)
    blocks = blocks_of(voyage, axes, step, fineness.omega)
    level = _levels(voyage, axes, blocks, step)
    if not (level == 0).any():
        raise InfeasibleError(
            "no part of the safe set could be followed over a step; value functions prove nothing here."
        )
    sigma = voyage.noise * math.sqrt(step)
    spread = math.sqrt(step**3 / 12) * _UP
    return Layout(
        axes=axes, blocks=blocks, images=images_of(voyage, axes, step),
        kick=kick_of(axes[2], sigma, voyage.spread + 4e-16, 2 * fineness.omega / math.sqrt(2) * _UP), level=level,
        reach=blocks.most.max(axis=(1, 2, 3)), sway=(spread * math.sqrt(2 / math.pi) * _UP, spread),
        sweep=blocks.swing.max(axis=(1, 2, 3)) * spread * fineness.omega * _UP,
    )  # fmt: skip


def axes_of(voyage: Voyage, fineness: Fineness, step: float) -> tuple[Array, Array, Array]:
    """Nodes along x, y and q; InfeasibleError where the noise is so small that q would need too many."""
    speed, turn = _speeds(voyage)
    found = []
    for (low, high), fastest, most in zip(voyage.ends[:2], speed, turn):
        wide = (high - low) / fineness.cells
        beyond = 2.2 * step * fastest + 3 * wide
        depth = np.linspace(0.0, (high - low) / 2, 60)
        long = np.minimum(depth, voyage.horizon * fastest) / max(fastest, 1e-300)  # that a front has been on its way
        blur = most * voyage.noise * (step + long) ** 1.5
        inside = np.clip(fineness.edge * blur, _LEAST * wide, wide)
        close = 3 * inside[0]
        half = np.concatenate([[-beyond, -close], depth]), np.concatenate([[wide, inside[0]], inside])
        places = np.concatenate([low + half[0], (high - half[0])[::-1]])
        widths = np.concatenate([half[1], half[1][::-1]])
        found.append(graded_axis(low - beyond, high + beyond, places, widths, (low, high)))
    low, high = voyage.ends[2]
    cell = fineness.cell * voyage.noise * math.sqrt(step)
    if not high - low < _MOST * cell:
        raise InfeasibleError(
            f"the noise of a step is less than {1 / _MOST:g} of the way between the ends of the state that it moves; "
            "value functions prove nothing here."
        )
    count = math.ceil((high - low) / cell)
    cell = (high - low) / count
    return found[0], found[1], np.asarray(low + cell * np.arange(-3, count + 4))


def _speeds(voyage: Voyage) -> tuple[Array, Array]:
    """Largest speeds of x and y over the box, and how fast they change with q, about."""
    grid = np.meshgrid(*(np.linspace(*ends, 17) for ends in voyage.ends))
    points, size = [part.ravel() for part in grid], grid[0].size
    with np.errstate(all="ignore"):
        f = np.broadcast_to(compile_numpy(voyage.tape)(0.0, *points), (size, STATES))
        slope = compile_numpy(jacobian(voyage.tape, (STATES,)))(0.0, *points)
    slope = np.broadcast_to(slope, (size, STATES, 1))[..., 0]
    fine = np.isfinite(f).all(axis=1) & np.isfinite(slope).all(axis=1)
    if not fine.any():
        raise InfeasibleError("the model is undefined all over the safe set; value functions prove nothing here.")
    return np.abs(f[fine, :2]).max(axis=0), np.abs(slope[fine, :2]).max(axis=0)


def _levels(voyage: Voyage, axes: tuple[Array, ...], blocks: Blocks, step: float) -> Array:
    """0 on cells all of whose states are half a step ahead of safe ones; 1 elsewhere; 2 where a path may end that has
    met a limit of q."""
    shape = tuple(len(axis) - 1 for axis in axes)
    ends = voyage.ends[2]
    least, most = blocks.noisy
    drift = blocks.inward * step * _UP
    met = blocks.known & (least <= ends[0]), blocks.known & (most >= ends[1])
    inward = [float(np.where(*pair, 0.0).max()) for pair in zip(met, drift)]
    inner = ends[0] + inward[0], ends[1] - inward[1]
    level = np.empty(shape)
    for i in range(shape[0]):
        low = np.meshgrid(axes[0][i : i + 1], axes[1][:-1], axes[2][:-1], indexing="ij")
        high = np.meshgrid(axes[0][i + 1 : i + 2], axes[1][1:], axes[2][1:], indexing="ij")
        place = np.ix_(blocks.index[0][i : i + 1], blocks.index[1], blocks.index[2])
        box = [
            (Interval(a, b) + Interval(blocks.back.lo[k][place], blocks.back.hi[k][place])).reshape(-1)
            for k, (a, b) in enumerate(zip(low, high))
        ]
        known = blocks.known[place].ravel()
        bow, near = ([side[place].ravel() for side in part] for part in (blocks.bow, blocks.near))
        kept = known & voyage.safe(box[:2], bow, near)
        crossed = (box[2].lo <= inner[0]) | (box[2].hi >= inner[1]) | ~known
        level[i] = np.where(crossed, 2.0, np.where(kept, 0.0, 1.0)).reshape(shape[1:])
    return level
