"""Mirrored proposals: where signs of coordinates leave a program as it is, what it found at one wall serves others.

With S = diag(sigma, 1), V(t, S z) serves the wall that S maps to the first one, if S maps starts, walls and the corners
of the dynamics to themselves. Nothing of that is believed: what is mirrored is a proposal like any other.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array, Integers
from certbound.quadratic.corners import Cells
from certbound.quadratic.form_matrices import splitting
from certbound.quadratic.setting import Setting, Wall
from certbound.quadratic.wall_program import Proposal
from certbound.rigor.intervals import Interval

_MOST_STATES = 8
_NEAR = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Mirror:
    """Signs that leave a program as it is, but for its wall.

    Attributes
    ----------
    signs : ndarray, shape (n + 1,)
        The diagonal of S.
    corners, cells : ndarray of int
        The corner and the cell to which each is mapped.
    moves : ndarray
        The sign of each member of the space of splittings.
    inside : ndarray of int
        The inside form to which each is mapped.
    """

    signs: Array
    corners: Integers
    cells: Integers
    moves: Array
    inside: Integers

    def wall(self, wall: Wall, walls: Sequence[Wall]) -> Wall | None:
        """The wall to which S maps a wall; None where there is none."""
        return next((other for other in walls if _maps(self.signs, wall, other)), None)

    def of(self, found: Proposal) -> Proposal:
        """The mirrored proposal, of the mirrored walls in the same order."""
        n = len(self.signs) - 1
        places = np.concatenate([np.arange(n), n + self.inside])
        weights = found.weights[:, :, self.corners][:, :, :, self.cells][..., places]
        others = tuple((self._at_wall(one, places), rows * self.signs) for one, rows in found.others)
        return replace(
            found, matrices=found.matrices * np.outer(self.signs, self.signs), weights=weights,
            moves=found.moves[:, :, self.cells] * self.moves, others=others,
            wall_weights=self._at_wall(found.wall_weights, places), wall_rows=_rows(found.wall_rows, self.signs),
        )  # fmt: skip

    def _at_wall(self, weights: Array, places: Integers) -> Array:
        return np.concatenate([weights[:, places], weights[:, len(places) :]], axis=1)


def _rows(rows: Array, signs: Array) -> Array:
    return rows * signs if rows.shape[1] else rows


def mirrors(setting: Setting, cells: Cells) -> list[Mirror]:
    """The signs that leave starts, safe set and all corners of the dynamics as they are, to rounding."""
    n = setting.dimension
    if n > _MOST_STATES:
        return []
    found = []
    for choice in itertools.islice(itertools.product((1.0, -1.0), repeat=n), 1, None):
        signs = np.array([*choice, 1.0])
        inside = _inside(setting.inside, signs)
        if inside is None or not _keeps_starts(setting, signs):
            continue
        found += list(_on_cells(cells, signs, inside))
    return found


def _on_cells(cells: Cells, signs: Array, inside: Integers) -> Iterator[Mirror]:
    """The mirrors with these signs: corners and cells change their sides with them, or, of one cell, stay."""
    n, count = len(signs) - 1, len(cells.values)
    turned = [k for k, a in enumerate(cells.held) if signs[a] < 0]
    moves = _moves(n, cells.held, signs)
    stay, last = np.arange(count), count.bit_length() - 2
    swapped, corners = _swapped(cells, signs[:n]), stay ^ sum(1 << last - k for k in turned)
    if swapped is None:
        return
    single = len(cells.low) == 1 and 0 < len(turned) == len(cells.held)
    if _keeps(cells, signs, corners, swapped):
        yield Mirror(signs=signs, corners=corners, cells=swapped, moves=moves, inside=inside)
    elif single and _keeps(cells, signs, stay, swapped):  # the corners are the same, so each may keep its side
        yield Mirror(signs=signs, corners=stay, cells=swapped, moves=-moves, inside=inside)


def _moves(n: int, held: Sequence[int], signs: Array) -> Array:
    """The sign of s_a z_i z_j for each member of the space of splittings; it is that of both its places."""
    found = []
    for member in splitting(n, held):
        a, i, j = np.argwhere(member != 0)[0]
        found.append(signs[held[a]] * signs[i] * signs[j])
    return np.array(found)


def _swapped(cells: Cells, signs: Array) -> Integers | None:
    """The cell to which each is mapped; None where it is none."""
    low = np.where(signs < 0, -cells.high, cells.low)
    high = np.where(signs < 0, -cells.low, cells.high)
    far = np.abs(low[:, None] - cells.low).max(axis=-1) + np.abs(high[:, None] - cells.high).max(axis=-1)
    found = np.argmin(far, axis=1)
    return found if np.all(far[np.arange(len(far)), found] < _NEAR) else None


def _keeps(cells: Cells, signs: Array, corners: Integers, swapped: Integers) -> bool:
    """Whether drift, diffusion and remainders at all corners are mapped to themselves."""
    turn = np.outer(signs, signs)
    square = cells.spread.mid @ np.swapaxes(cells.spread.mid, -1, -2)
    pairs = [(part, part[corners][:, swapped] * turn) for part in (cells.drift.mid, square)]
    pairs.append((cells.bend.mid, cells.bend.mid[swapped] * turn))
    pairs.append((cells.toll.mid, cells.toll.mid[swapped]))
    if cells.affine is None:
        pairs.append((cells.square.mid, cells.square.mid[swapped] * turn[:-1, :-1]))
    else:
        tensor = np.einsum("cij,ckl->ijkl", cells.affine.mid, cells.affine.mid)
        pairs.append((tensor, np.einsum("ijkl,i,j,k,l->ijkl", tensor, signs, signs, signs, signs)))
    return all(_near(one, other) for one, other in pairs)


def _keeps_starts(setting: Setting, signs: Array) -> bool:
    start, turned = setting.start, signs[:-1] < 0
    forms = start.forms.mid
    even = _near(start.low[turned], -start.high[turned])
    return even and _near(forms, forms * np.outer(signs, signs))


def _inside(forms: Interval, signs: Array) -> Integers | None:
    """The inside form to which each is mapped; None where it is none."""
    turned = forms.mid * np.outer(signs, signs)
    found = [next((k for k, one in enumerate(turned) if _near(form, one)), None) for form in forms.mid]
    return None if None in found else np.array(found, dtype=int)


def _maps(signs: Array, wall: Wall, other: Wall) -> bool:
    if (wall.row is None) != (other.row is None) or len(wall.forms) != len(other.forms):
        return False
    if wall.row is not None and other.row is not None and not _near(other.row.mid, wall.row.mid * signs):
        return False
    return _near(other.forms.mid, wall.forms.mid * np.outer(signs, signs))


def _near(one: Array, other: Array) -> bool:
    return bool(np.all(np.abs(one - other) <= _NEAR * max(1.0, float(np.abs(one).max(initial=0.0)))))
