"""Which cells of a grid lie in the safe region, and the parts of those that its boundary cuts.

A cut cell is divided into `PARTS` x `PARTS` equal parts. The ends of a part are no floats: they are enclosed, and V on
a part comes from V on the cell by de Casteljau's scheme, whose matrices are exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.rigor.intervals import Interval
from certbound.values.continuous.coefficients import Cells, Interpolant
from certbound.values.continuous.curved.boundaries import Wall, Walls
from certbound.values.continuous.hypotheses import Model
from certbound.values.continuous.residual import Patches
from certbound.values.continuous.surface import Surface
from certbound.values.polynomials import QUARTERS, nodes_of

PARTS = 4
Ends = tuple[tuple[Interval, Interval], ...]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Cuts:
    """The cells of a grid in the plane against the walls.

    Attributes
    ----------
    whole : ndarray of int
        Cells that surely lie in the safe region, numbered as in `Surface.patches`.
    cut : ndarray of int
        Cells of which that is not decided; all others surely do not meet its closure.
    cell, row, column : ndarray of int, shape (S,)
        The parts of cut cells that may meet the closure: which of ``cut``, and where in it.
    touched : tuple of (Wall, mask), shape (S,)
        For every wall, the parts that may hold boundary points of the safe region on it.
    ends : tuple of (Interval, Interval)
        Enclosed ends of the parts along both axes, shape (S,).
    """

    whole: Index
    cut: Index
    cell: Index
    row: Index
    column: Index
    touched: tuple[tuple[Wall, Mask], ...]
    ends: Ends

    @classmethod
    def of(cls, axes: tuple[Array, ...], walls: Walls) -> Cuts:
        """Decide in interval arithmetic; what is undecided counts as cut."""
        low = [part.ravel() for part in np.meshgrid(*(axis[:-1] for axis in axes), indexing="ij")]
        high = [part.ravel() for part in np.meshgrid(*(axis[1:] for axis in axes), indexing="ij")]
        within, away = walls.locate((Interval(low[0], high[0]), Interval(low[1], high[1])))
        cut = np.flatnonzero(~within & ~away)
        cell, row, column = (
            part.ravel() for part in np.meshgrid(np.arange(len(cut)), np.arange(PARTS), np.arange(PARTS), indexing="ij")
        )
        ends = tuple(
            _ends(one[cut][cell], other[cut][cell], share) for one, other, share in zip(low, high, (row, column))
        )
        box = (Interval(ends[0][0].lo, ends[0][1].hi), Interval(ends[1][0].lo, ends[1][1].hi))
        kept = np.flatnonzero(~walls.locate(box)[1])
        touched = tuple((wall, mask[kept]) for wall, mask in walls.touched(box) if mask[kept].any())
        return cls(
            whole=np.flatnonzero(within), cut=cut, cell=cell[kept], row=row[kept], column=column[kept], touched=touched,
            ends=tuple((left[kept], right[kept]) for left, right in ends),
        )  # fmt: skip

    def parts(self, patches: Patches, slabs: int) -> Patches:
        """V on the parts in ``slabs`` slabs, of which ``patches`` are the cut cells: time slowest.

        Each coefficient is off by at most 20 roundoffs of ``size`` more than those of the cell.
        """
        coefficients = patches.coefficients.reshape(slabs, len(self.cut), 4, 6, 6)[:, self.cell]
        coefficients = np.einsum("sab,kstbc->kstac", QUARTERS[self.row], coefficients)
        coefficients = np.einsum("sab,kstcb->kstca", QUARTERS[self.column], coefficients).reshape(-1, 4, 6, 6)

        def spread(values: Array, factor: float = 1.0) -> Array:
            return np.asarray(values.reshape(slabs, len(self.cut))[:, self.cell].ravel() * factor)

        return Patches(
            coefficients=coefficients, reference=spread(patches.reference), size=spread(patches.size),
            step=spread(patches.step), widths=tuple(spread(width, 1 / PARTS) for width in patches.widths),
        )  # fmt: skip

    def interpolants(
        self, surface: Surface, model: Model, first: int, last: int, counts: tuple[int, ...]
    ) -> tuple[list[Interpolant], Interpolant]:
        """The model's polynomials of the cut cells at the nodes of every part, in slabs ``first`` to ``last`` - 1."""
        x, y = np.unravel_index(self.cut, surface.cells)
        ends = [
            [np.repeat(surface.times[first + side : last + side], len(x))]
            + [np.tile(axis[k + side], last - first) for axis, k in zip(surface.axes, (x, y))]
            for side in (0, 1)
        ]
        cells = Cells(low=tuple(ends[0]), high=tuple(ends[1]))
        points = [(0.5,) if model.autonomous else nodes_of(counts[0])]
        points += [tuple((k + node) / PARTS for k in range(PARTS) for node in nodes_of(n)) for n in counts[1:]]

        def picked(found: Interpolant) -> Interpolant:
            place = (np.arange(last - first)[:, None] * len(self.cut) + self.cell).ravel()
            shape = (*found.samples.shape[:2], len(points[0]), PARTS, counts[1], PARTS, counts[2])
            row, column = np.tile(self.row, last - first), np.tile(self.column, last - first)
            samples = found.samples.reshape(shape).transpose(1, 3, 5, 0, 2, 4, 6)[place, row, column]
            return Interpolant(
                samples=np.ascontiguousarray(samples.swapaxes(0, 1)), size=found.size[:, place],
                remainder=found.remainder[:, place],
            )  # fmt: skip

        drifts = [picked(model.drift.interpolate(cells, branch, points)) for branch in model.branches]
        return drifts, picked(model.square.interpolate(cells, (), points))


def _ends(low: Array, high: Array, share: Index) -> tuple[Interval, Interval]:
    left, width = Interval.point(low), Interval.point(high) - Interval.point(low)
    first = left + width * Interval.point(share / PARTS)
    last = left + width * Interval.point((share + 1) / PARTS)
    return first, last
