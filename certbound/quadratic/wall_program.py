"""The program of one wall: the least sup over the starts of V(0, .) among quadratic V that the theorem admits.

V(t, x) = z' H(t) z / 2 with H continuous and on every piece of time a polynomial of degree 1 or 2, in Bernstein form.
At all its control points, H' that of the slope, at every corner (A, G) of every cell, with box forms B_i >= 0 there,
    -(H' + H A + A' H + sum_c G_c' H G_c)/2 - D(s) - H G G' H / 2 - sum_i mu_i B_i >= 0,   mu >= 0,
which is linear in what is searched after a Schur complement; on the wall  H/2 - sum mu_i B_i - (row nu' + nu row')/2
>= 0, and on the starts  rho - H(0)/2 - sum mu_i B_i >= 0. Everything here is in floating point and proves nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Integers
from certbound.quadratic.conic import Block, Part, Program, block
from certbound.quadratic.corners import Cells
from certbound.quadratic.form_matrices import side_forms, splitting, symmetric_basis
from certbound.quadratic.setting import Setting, Wall

_DEEPEST = -120.0  # log of the smallest probability that is looked for


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Proposal:
    """What the solver found for one wall: H, and the multipliers with which the proof may succeed.

    Attributes
    ----------
    times : ndarray, shape (K + 1,)
    degree : int
        d, of H on a piece.
    first : int
        The piece with which the time begins at which the wall is looked at; it ends with the last.
    others : tuple of (ndarray, ndarray)
        ``wall_weights`` and ``wall_rows`` of further walls that the same V serves.
    matrices : ndarray, shape (d K + 1, n + 1, n + 1)
        Control points of H: d k to d k + d are those of piece k, and every d-th is H at one of the times.
    moves : ndarray, shape (K, d + 1, C, b)
        Coefficients of the splitting at the control points of each piece.
    weights : ndarray, shape (K, d + 1, V, C, n + k)
        mu of the cells' sides and of the inside forms.
    wall_weights : ndarray, shape (d K + 1, n + k + w)
        mu on the wall: sides of the working box, inside forms, forms of the wall; 0 before the piece ``first``.
    wall_rows : ndarray, shape (d K + 1, n + 1)
        nu, likewise.
    start_weights : ndarray, shape (n' + s,)
        mu of the wide sides of the starts, and of their forms.
    level : float
        rho.
    """

    times: Array
    matrices: Array
    moves: Array
    weights: Array
    wall_weights: Array
    wall_rows: Array
    start_weights: Array
    level: float
    degree: int = 1
    first: int = 0
    others: tuple[tuple[Array, Array], ...] = ()


def slopes(degree: int) -> tuple[tuple[int, int, float], ...]:
    """Of each control point of a piece: (a, b, c) such that c (H_b - H_a) / length is that of the slope in time."""
    return ((0, 1, 1.0), (0, 1, 1.0)) if degree == 1 else ((0, 1, 2.0), (0, 2, 1.0), (1, 2, 2.0))


def start_frame(setting: Setting) -> tuple[Integers, Array]:
    """The coordinates along which the starts are wide, and the map from (those, 1) to z."""
    low, high = setting.start.low, setting.start.high
    wide = np.flatnonzero(high - low > 1e-9)
    frame = np.zeros((len(low) + 1, len(wide) + 1))
    frame[wide, np.arange(len(wide))] = 1.0
    frame[:-1, -1] = np.where(high - low > 1e-9, 0.0, (low + high) / 2)
    frame[-1, -1] = 1.0
    return wide, frame


class StatedCells:
    """Cells with the inequality of each corner (v) and cell (c), the slope in time with the factor 1: blocks[v][c]."""

    def __init__(self, setting: Setting, cells: Cells) -> None:
        self.cells, self.size = cells, setting.dimension + 1
        self.basis = symmetric_basis(self.size)
        self.splits = splitting(setting.dimension, cells.held)
        self.forms = setting.inside.mid.transpose(1, 2, 0)
        spread = cells.spread.mid.reshape(-1, *cells.spread.shape[2:])
        self.spreads, group = np.unique(spread, axis=0, return_inverse=True)
        self.group = group.reshape(cells.values.shape[:2])
        self.blocks = [[self._block(cells, v, c) for c in range(len(cells.low))] for v in range(len(cells.values))]

    def _block(self, cells: Cells, v: int, c: int) -> Block:
        size, basis = self.size, self.basis
        product = np.einsum("ijk,jl->ilk", basis, cells.drift.mid[v, c])
        main = -(product + product.transpose(1, 0, 2)) / 2 - self._trace(cells, c)
        sides = side_forms(cells.low[c], cells.high[c]).transpose(1, 2, 0)
        split = np.einsum("a,baij->ijb", cells.values[v, c], self.splits)
        maps = [main, -basis / 2, basis / 2, -split, -np.concatenate([sides, self.forms], axis=2), -basis / 2]
        constant = -cells.bend.mid[c]
        constant[-1, -1] -= cells.toll.mid[c]
        if cells.affine is None:
            radius = cells.square.rad[c][np.triu_indices(size - 1)]
            twice = np.where(np.equal(*np.triu_indices(size - 1)), 0.5, 1.0)
            extra = np.zeros((size, size, len(radius)))
            extra[size - 1, size - 1] = -radius * twice
            maps.append(extra)
        return block(constant, maps)

    def _trace(self, cells: Cells, c: int) -> Array:
        """tr(g g' H)/2 as a form over z, linear in H: exact where the diffusion is affine, else at its middle."""
        size = self.size
        if cells.affine is not None:
            return np.asarray(np.einsum("cai,abk,cbj->ijk", cells.affine.mid, self.basis, cells.affine.mid) / 2)
        form = np.zeros((size, size, self.basis.shape[2]))
        form[-1, -1] = np.einsum("ij,ijk->k", cells.square.mid[c], self.basis[:-1, :-1]) / 2
        return form


def propose(
    setting: Setting, wall: Wall, times: Array, stated: Sequence[StatedCells], *, seconds: float, degree: int = 2,
    first: int = 0, others: Sequence[Wall] = (),
) -> Proposal | None:
    """What the program of a wall, and of others with the same V, proposes; None where the solver failed.

    ``stated`` are the cells of each piece of time with their inequality; for ``degree`` and ``first`` see `Proposal`.
    """
    return _WallProgram(setting, (wall, *others), times, stated, degree=degree, first=first).solve(seconds)


class _WallProgram:
    """The program of one V, and where its variables are."""

    def __init__(
        self, setting: Setting, walls: Sequence[Wall], times: Array, stated: Sequence[StatedCells], *, degree: int,
        first: int,
    ) -> None:
        self.setting, self.walls, self.times, self.stated = setting, walls, times, stated
        self.degree, self.first = degree, first
        cells = [one.cells for one in stated]
        self.cells = cells
        self.size = setting.dimension + 1
        self.basis = symmetric_basis(self.size)
        self.program = Program()
        count = self.basis.shape[2]
        self.nodes = [self.program.variables(count) for _ in range(degree * len(stated) + 1)]
        self.splits = splitting(setting.dimension, cells[0].held)
        self.forms = setting.inside.mid.transpose(1, 2, 0)
        self.squares: dict[tuple[int, int, int], Integers] = {}
        self.moves: list[list[list[Integers]]] = []
        self.weights: list[list[list[list[Integers]]]] = []
        self.absolute: list[Integers | None] = []

    def solve(self, seconds: float) -> Proposal | None:
        self._generator()
        before = self.degree * self.first
        places = [[self._at_wall(wall, node) for node in self.nodes[before:]] for wall in self.walls]
        level, start = self._at_start()
        found = self.program.minimise(int(level[0]), seconds=seconds)
        if found is None:
            return None
        walls = [
            (_after(before, np.maximum(found[np.array([mu for mu, _ in one])], 0.0)),
             _after(before, found[np.array([nu for _, nu in one], dtype=np.int64)])) for one in places
        ]  # fmt: skip
        return Proposal(
            times=self.times,
            matrices=np.array([self.basis @ found[node] for node in self.nodes]),
            moves=found[np.array(self.moves, dtype=np.int64)],
            weights=np.maximum(found[np.array(self.weights)], 0.0),
            wall_weights=walls[0][0], wall_rows=walls[0][1], others=tuple(walls[1:]),
            start_weights=np.maximum(found[np.asarray(start, dtype=np.int64)], 0.0),
            level=float(found[level[0]]),
            degree=self.degree, first=self.first,
        )

    # ---- the inequality of the generator -----------------------------------------------------------------------

    def _generator(self) -> None:
        if self.cells[0].affine is None:
            self.absolute = [self._absolutes(node) for node in self.nodes]
        for k, one in enumerate(self.stated):
            length = float(self.times[k + 1] - self.times[k])
            ends = []
            for place, (a, b, factor) in enumerate(slopes(self.degree)):
                base, count = self.degree * k, self.basis.shape[2]
                blocks = [[_timed(stated, count, length / factor) for stated in row] for row in one.blocks]
                ends.append(self._piece(base + place, (base + a, base + b), one, blocks))
            self.moves.append([moves for moves, _ in ends])
            self.weights.append([weights for _, weights in ends])

    def _piece(
        self, point: int, slope: tuple[int, int], one: StatedCells, blocks: list[list[Block]]
    ) -> tuple[list[Integers], list[list[Integers]]]:
        """State the inequality at a control point, for all cells and corners: the places of D and mu."""
        program, many = self.program, len(one.cells.low)
        moves = [program.variables(len(self.splits)) for _ in range(many)]
        weights = []
        for corner, row in enumerate(blocks):
            weights.append([program.nonnegative(self.size - 1 + self.forms.shape[2]) for _ in range(many)])
            for c, stated in enumerate(row):
                square, (a, b) = self._square(point, one, int(one.group[corner, c])), slope
                parts = [self.nodes[point], self.nodes[b], self.nodes[a], moves[c], weights[corner][c], square]
                parts += [] if not self.absolute else [self.absolute[point]]  # type: ignore[list-item]
                program.semidefinite(stated, np.concatenate(parts))
        return moves, weights

    def _square(self, end: int, one: StatedCells, group: int) -> Integers:
        """Variables Y >= H G G' H at a time, the same for all corners with that diffusion."""
        key, node = (end, id(one), group), self.nodes[end]
        if key in self.squares:
            return self.squares[key]
        own = self.squares[key] = self.program.variables(len(node))
        spread = one.spreads[group]
        size, m = self.size, spread.shape[1]
        whole = np.zeros((size + m, size + m, len(node)))
        whole[:size, :size] = self.basis
        border = np.zeros_like(whole)
        part = np.einsum("ijk,jc->ick", self.basis, spread)
        border[:size, size:], border[size:, :size] = part, part.transpose(1, 0, 2)
        constant = np.zeros((size + m, size + m))
        constant[size:, size:] = np.eye(m)
        self.program.semidefinite(block(constant, [whole, border]), np.concatenate([own, node]))
        return own

    def _absolutes(self, node: Integers) -> Integers:
        """New variables at least |H_ij|, i <= j < n."""
        rows = [k for k, (i, j) in enumerate((i, j) for i in range(self.size) for j in range(i, self.size))
                if j < self.size - 1]  # fmt: skip
        own = self.program.variables(len(rows))
        eye = np.eye(len(rows))
        for sign in (1.0, -1.0):
            self.program.at_least(np.zeros(len(rows)), [Part(eye, own), Part(sign * eye, node[rows])])
        return own

    # ---- wall and starts ---------------------------------------------------------------------------------------

    def _at_wall(self, wall: Wall, node: Integers) -> tuple[Integers, Integers]:
        n, program = self.size - 1, self.program
        forms = wall.forms.mid.transpose(1, 2, 0)
        sides = side_forms(-np.ones(n), np.ones(n)).transpose(1, 2, 0)
        known = np.concatenate([sides, self.forms, forms], axis=2)
        weights = program.nonnegative(known.shape[2])
        maps, columns = [self.basis / 2, -known], [node, weights]
        rows = program.variables(self.size if wall.row is not None else 0)
        if wall.row is not None:
            row, eye = wall.row.mid, np.eye(self.size)
            outer = np.einsum("i,jk->ijk", row, eye)
            maps.append(-(outer + outer.transpose(1, 0, 2)) / 2)
            columns.append(rows)
        program.semidefinite(block(np.zeros((self.size, self.size)), maps), np.concatenate(columns))
        return weights, rows

    def _at_start(self) -> tuple[Integers, Integers]:
        program, start = self.program, self.setting.start
        wide, frame = start_frame(self.setting)
        size = len(wide) + 1
        level = program.variables(1)
        sides = side_forms(start.low[wide], start.high[wide]).transpose(1, 2, 0)
        forms = np.einsum("ia,kij,jb->abk", frame, start.forms.mid, frame)
        known = np.concatenate([sides, forms], axis=2)
        weights = program.nonnegative(known.shape[2])
        corner = np.zeros((size, size, 1))
        corner[-1, -1] = 1.0
        value = -np.einsum("ia,ijk,jb->abk", frame, self.basis, frame) / 2
        stated = block(np.zeros((size, size)), [corner, value, -known])
        program.semidefinite(stated, np.concatenate([level, self.nodes[0], weights]))
        program.at_least(np.array([-_DEEPEST]), [Part(np.eye(1), level)])
        return level, weights


def _after(count: int, values: Array) -> Array:
    """The values after so many rows of zeros."""
    return np.concatenate([np.zeros((count, *values.shape[1:])), values])


def _timed(stated: Block, count: int, length: float) -> Block:
    """The block with the slope in time, its second and third groups of ``count`` columns, divided by a length."""
    slope = (stated.columns >= count) & (stated.columns < 3 * count)
    return stated._replace(values=np.where(slope, stated.values / length, stated.values))
