"""Cells of a random start before a constraint: which of them keep it on every path, and which break it on every one.

A cell {|z - middle| <= half} keeps a constraint on a piece of time if the convex hull of its control points does, for
every z of the cell and every rest: half-spaces are linear in z, so that the signs of the gains tell their extremes; for
norms |v + sum_i s_i y_i|^2 <= |v|^2 + 2 sum_i |v . y_i| h_i + (sum_i |y_i| h_i)^2 where |s_i| <= h_i. It is broken by
all of a cell if at one time every path of it has left. Sets are closed: a path that touches an obstacle has met it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Integers, Mask
from certbound.constants.enclosures import enclose
from certbound.errors import EngineError
from certbound.problem.model import Tape
from certbound.problem.sets import Faces, Inside, Quadratic
from certbound.reach.starts.drawn_paths import StartPaths
from certbound.rigor.definite import is_positive_definite
from certbound.rigor.intervals import Interval
from certbound.rigor.rounding import quiet

_POINTS = (0.0, 0.25, 0.5, 0.75)  # of every piece, at which breaking is looked for; and the end of the last
_NUMBERS = 2_000_000  # numbers of a chunk of cells, pieces, points, coordinates and directions
_ROUND = 1e-13
_SHAPE = 1e-9  # what the root of an ellipsoid's shape may be off
_BRIEF = 3e-15  # of the horizon: what the times of points may be off


@dataclass(frozen=True, eq=False, kw_only=True)
class _Points:
    """Places (M, C, ...) relative to the centre, in coordinates in which the set has its form; one place is C = 1."""

    value: Array  # (M, C, k)
    gains: Array  # (M, C, k, d)
    rest: Array  # (M, C, k, p)
    slack: Array  # (M, k)

    def chosen(self, index: Integers | Mask) -> _Points:
        return _Points(**{name: getattr(self, name)[index] for name in self.__dataclass_fields__})

    def at(self, middle: Array) -> Array:
        """The places of the cells' middles (B, d): (B, M, C, k)."""
        return np.asarray(self.value + np.einsum("mckd,bd->bmck", self.gains, middle))


class Limit:
    """One constraint along the paths of a start.

    ``pieces`` and ``points`` are what keeping and breaking it are looked for on; cells are given by their middles and
    half-widths (B, d), half-widths not negative.
    """

    def __init__(self, constraint: Inside, paths: StartPaths, horizon: float) -> None:
        self.constraint, self.reach = constraint, paths.reach
        region, form, n = constraint.region, constraint.region.form, paths.controls.shape[2]
        self.form = form
        places, centre = region.places(n), _centre(constraint, paths.span)
        first, last = (0.0, horizon) if constraint.during is None else constraint.during
        asked = (paths.span.hi >= first) & (paths.span.lo <= last)
        slack = paths.slack[:, places] + centre.rad + _ROUND * (paths.size[:, places] + centre.mag)
        value = paths.controls[:, :, places] - np.asarray(centre.mid)[:, None]
        turn = form.normals if isinstance(form, Faces) else form.root
        if isinstance(form, Faces) and not len(form.bounds):
            raise EngineError(f"'{constraint.label}' bounds no state.")
        whole = _Points(
            value=value @ turn.T, gains=np.einsum("jk,nckd->ncjd", turn, paths.gains[:, :, places]),
            rest=np.einsum("jk,nckd->ncjd", turn, paths.rest[:, :, places]),
            slack=slack @ np.abs(turn).T * (1 + _ROUND),
        )  # fmt: skip
        self.radius = _radii(form, str(constraint.label)) if isinstance(form, Quadratic) else (0.0, 0.0)
        self.points = _points(whole, paths.span, first, last, horizon)
        self.pieces, self.asked = whole.chosen(asked), asked
        self.nodes, self.at_nodes = _nodes(paths, first, last, horizon)

    def near(self, middle: Array, half: Array) -> _Points:
        """The pieces on which some of the cells may not keep the constraint."""
        if not len(self.pieces.value):
            return self.pieces
        return self.pieces.chosen(self.room(self.pieces, *_hull(middle, half))[0] < 0)

    def beside(self, middle: Array, half: Array) -> _Points:
        """The points at which some of the cells may break it."""
        if not len(self.points.value):
            return self.points
        return self.points.chosen(self.room(self.points, *_hull(middle, half))[0] < 0)

    @quiet
    def rooms(self, middle: Array, half: Array) -> Array:
        """Lower bounds of the room that every face of a set to stay in leaves on every piece, (B, M, faces)."""
        assert isinstance(self.form, Faces)
        spread = np.einsum("mckd,bd->bmck", np.abs(self.pieces.gains), half) + self._rest(self.pieces)
        high = (self.pieces.at(middle) + spread).max(axis=2) + self.pieces.slack
        return _known(self.form.bounds - high)

    # ---- keeping -------------------------------------------------------------------------------------------------

    @quiet
    def room(self, pieces: _Points, middle: Array, half: Array) -> Array:
        """Lower bounds of the room that every piece leaves, (B, M): not negative where the constraint is kept."""
        return _known(self._room(pieces, middle, half))

    def _room(self, pieces: _Points, middle: Array, half: Array) -> Array:
        place = pieces.at(middle)
        if isinstance(self.form, Faces):
            spread = np.einsum("mckd,bd->bmck", np.abs(pieces.gains), half) + self._rest(pieces)
            if self.constraint.outside:
                low = (place - spread).min(axis=2) - pieces.slack - self.form.bounds
                return _positive(low.max(axis=-1))
            high = (place + spread).max(axis=2) + pieces.slack
            return np.asarray((self.form.bounds - high).min(axis=-1))
        if not self.constraint.outside:
            return np.asarray(self.radius[0] - self._norms(pieces, place, half).max(axis=-1))
        toward = _toward(place)
        low = np.einsum("bmck,bmk->bmc", place, toward) - self._along(pieces, toward, half)
        return _positive(low.min(axis=-1) - (np.abs(toward) * pieces.slack).sum(axis=-1) - self.radius[1])

    @quiet
    def breaks(self, points: _Points, middle: Array, half: Array) -> Array:
        """Lower bounds of how far all of a cell is beyond the constraint at every point, (B, M): positive where it is.

        At an obstacle also 0 breaks, and counts as positive.
        """
        beyond = self._beyond(points, middle, half)
        return np.where(np.isfinite(beyond), beyond, -np.inf)  # a distance that overflows proves nothing

    def _beyond(self, points: _Points, middle: Array, half: Array) -> Array:
        place = points.at(middle)
        if isinstance(self.form, Faces):
            spread = np.einsum("mckd,bd->bmck", np.abs(points.gains), half) + self._rest(points)
            if self.constraint.outside:
                high = (place + spread)[:, :, 0] + points.slack
                return _touching((self.form.bounds - high).min(axis=-1))
            low = (place - spread)[:, :, 0] - points.slack
            return np.asarray((low - self.form.bounds).max(axis=-1))
        if self.constraint.outside:
            return _touching(self.radius[0] - self._norms(points, place, half)[..., 0])
        size = np.linalg.norm(place[:, :, 0], axis=-1, keepdims=True)
        toward = place[:, :, 0] / np.maximum(size, 1e-300)
        low = size[..., 0] * (1 - _ROUND) - self._along(points, toward, half)[..., 0]
        return np.asarray(low - (np.abs(toward) * points.slack).sum(axis=-1) - self.radius[1] * (1 + _ROUND))

    @quiet
    def effects(self, piece: _Points, middle: Array, half: Array) -> Array:
        """How much each direction of a cell hides whether the piece of its number keeps the constraint: (B, d)."""
        place = (piece.value + np.einsum("bckd,bd->bck", piece.gains, middle)).mean(axis=1)
        gains = piece.gains.mean(axis=1)
        moved = np.abs(gains) * half[:, None]
        if isinstance(self.form, Faces):
            open_ = np.abs(place - self.form.bounds) <= moved.sum(axis=-1) + piece.slack
            open_[~open_.any(axis=1)] = True
            return np.asarray(np.where(open_[..., None], moved, 0.0).max(axis=1))
        toward = place / np.maximum(np.linalg.norm(place, axis=1, keepdims=True), 1e-300)
        square = (np.linalg.norm(gains, axis=1) * half) ** 2 / max(self.radius[1], 1e-300)
        return np.asarray(np.abs(np.einsum("bkd,bk->bd", gains, toward)) * half + square)

    # ---- parts ---------------------------------------------------------------------------------------------------

    def _rest(self, points: _Points) -> Array:
        """How far the rest moves a path along every coordinate: (M, C, k)."""
        return np.asarray(self.reach * np.linalg.norm(points.rest, axis=-1) * (1 + _ROUND))

    def _along(self, points: _Points, toward: Array, half: Array) -> Array:
        """How far a cell and the rest move a path along ``toward`` (B, M, k): (B, M, C)."""
        own = np.abs(np.einsum("mckd,bmk->bmcd", points.gains, toward))
        moved = np.einsum("bmcd,bd->bmc", own, half)
        if points.rest.shape[-1]:
            moved += self.reach * np.linalg.norm(np.einsum("mckp,bmk->bmcp", points.rest, toward), axis=-1)
        return np.asarray(moved * (1 + _ROUND))

    def _norms(self, points: _Points, place: Array, half: Array) -> Array:
        """Upper bounds of the norm over cells and rests: (B, M, C)."""
        along = np.abs(np.einsum("mckd,bmck->bmcd", points.gains, place))
        size = np.einsum("mcd,bd->bmc", np.linalg.norm(points.gains, axis=2), half)
        square = (place**2).sum(axis=-1) + 2 * np.einsum("bmcd,bd->bmc", along, half) + size**2
        rest = self.reach * np.linalg.norm(points.rest, axis=(2, 3))
        return np.asarray((np.sqrt(square) + rest + np.linalg.norm(points.slack, axis=-1)[:, None]) * (1 + _ROUND))

    def chunks(self, points: _Points, count: int) -> Iterator[slice]:
        """Cells in chunks that take little memory."""
        most = max(1, _NUMBERS // max(points.gains.size, 1))
        for begin in range(0, count, most):
            yield slice(begin, begin + most)


def _hull(middle: Array, half: Array) -> tuple[Array, Array]:
    """One cell around all of them."""
    low, high = (middle - half).min(axis=0), (middle + half).max(axis=0)
    centre = (low + high) / 2
    return centre[None], np.maximum(high - centre, centre - low)[None] * (1 + 1e-15) + 1e-15 * np.abs(centre)


def _known(room: Array) -> Array:
    """Numbers that overflowed leave no room: they are no numbers, which would compare with nothing."""
    return np.where(np.isnan(room), -np.inf, room)


def _positive(values: Array) -> Array:
    """Who touches an obstacle has met it: 0 is no room."""
    return np.where(values > 0, values, np.minimum(values, -1e-300))


def _touching(values: Array) -> Array:
    return np.where(values >= 0, np.maximum(values, 1e-300), values)


def _toward(place: Array) -> Array:
    """Unit vectors to the nearest point of the chord from the first control point to the last: (B, M, k)."""
    first, chord = place[:, :, 0], place[:, :, -1] - place[:, :, 0]
    length = (chord**2).sum(axis=-1, keepdims=True)
    share = np.clip(-(first * chord).sum(axis=-1, keepdims=True) / np.maximum(length, 1e-300), 0.0, 1.0)
    nearest = first + share * chord
    size = np.linalg.norm(nearest, axis=-1, keepdims=True)
    axis = np.eye(place.shape[-1])[0]
    return np.asarray(np.where(size > 0, nearest / np.maximum(size, 1e-300), axis) * (1 - _ROUND))


def _radii(form: Quadratic, label: str) -> tuple[float, float]:
    """Radii of balls of root y within and around the set."""
    if form.even:
        return form.radius, form.radius * (1 + _ROUND)
    root, eye = Interval.point(form.root), np.eye(form.dimension)
    image = root @ Interval.point(form.shape) @ Interval.point(form.root.T)
    inner, outer = (1 - _SHAPE) ** 2, (1 + _SHAPE) ** 2
    if not bool(is_positive_definite(image - inner * eye) & is_positive_definite(Interval.point(outer * eye) - image)):
        raise EngineError(f"`shape` of {label} is too badly conditioned; rescale the states.")
    return form.radius * (1 - 2 * _SHAPE), form.radius * (1 + 2 * _SHAPE)


def _centre(constraint: Inside, span: Interval) -> Interval:
    """Where the centre of a set is over the pieces: (N, k)."""
    region, count = constraint.region, len(span.lo)
    if isinstance(region.center, Tape):
        return enclose(region.center, [span]).broadcast_to((count, region.dimension))
    return Interval.point(np.broadcast_to(region.center_at(), (count, region.dimension)))


def _nodes(paths: StartPaths, first: float, last: float, horizon: float) -> tuple[Integers, Integers]:
    """The numbers of the nodes at which a constraint holds, and their places among its points."""
    if paths.controls.shape[1] == 1:
        nodes = np.flatnonzero((paths.span.lo >= first) & (paths.span.hi <= last))
        return nodes, np.arange(len(nodes))
    slip = _BRIEF * horizon
    inside = (paths.span.lo - slip >= first) & (paths.span.lo + slip <= last)
    inside[0] |= first <= 0 <= last
    nodes = np.flatnonzero(inside)
    return nodes, np.arange(len(nodes))


def _points(whole: _Points, span: Interval, first: float, last: float, horizon: float) -> _Points:
    """Single times at which the constraint holds, from the control points of the pieces that they are in."""
    if whole.value.shape[1] == 1:
        return whole.chosen((span.lo >= first) & (span.hi <= last))
    found = []
    begin = np.append(span.lo[1:], horizon)
    for share in (*_POINTS, 1.0):
        weights = np.array([1.0, 3.0, 3.0, 1.0]) * share ** np.arange(4) * (1 - share) ** np.arange(3, -1, -1)
        time = span.lo + share * (begin - span.lo)
        slip = _BRIEF * horizon
        inside = (time - slip >= first) & (time + slip <= last)
        inside[0] |= share == 0 and first <= 0 <= last
        inside[-1] |= share == 1 and first <= horizon <= last
        inside[:-1] &= share < 1
        blended = {
            name: np.einsum("c,mc...->m...", weights, getattr(whole, name))[:, None]
            for name in ("value", "gains", "rest")
        }
        found.append(_Points(**blended, slack=whole.slack).chosen(inside))
    names = _Points.__dataclass_fields__
    return _Points(**{name: np.concatenate([getattr(part, name) for part in found]) for name in names})
