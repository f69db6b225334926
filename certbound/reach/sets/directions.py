"""Constraints as one-sided requirements on linear functionals, piece by piece.

A safe set {a . x <= b} asks a . S <= b - a . p of the deviation S from the nominal curve p; a convex obstacle is
kept off by the direction that separates it from the nominal piece; a round safe set is replaced by a polygon
inside it. Every room below is a proved lower bound over the whole piece.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.constants.enclosures import enclose
from certbound.problem.model import Tape
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces, Inside, Quadratic, Region
from certbound.problem.systems import System
from certbound.reach.sets.separation import polyhedral_weights
from certbound.rigor.definite import is_positive_definite
from certbound.rigor.intervals import Interval

_POLYGON = 24


@dataclass(frozen=True, eq=False, kw_only=True)
class NominalPieces:
    """A nominal curve, piece by piece: every p_t of a piece lies in the convex hull of its control points."""

    times: Array  # (N + 1,) in continuous time, (N,) steps in discrete time
    controls: Array  # (N, C, n)
    continuous: bool
    # (N, n, n): about that of the deviation: where an obstacle is a corner, it decides how its faces are mixed
    covariance: Array | None = None
    extent: Array | None = None  # (N, n): about how far the state lies from the curve without noise

    @property
    def pieces(self) -> int:
        """Number of pieces (continuous time) or of time steps, the first and the last included."""
        return len(self.controls)

    def span(self) -> Interval:
        """The time interval of every piece."""
        if self.continuous:
            slip = 1e-15 * float(self.times[-1])  # the nodes are floats near k h
            return Interval(self.times[:-1] - slip, self.times[1:] + slip)
        return Interval.point(self.times)

    def required(self, during: tuple[float, float] | None) -> Mask:
        """Pieces that meet the time window ``during``."""
        span = self.span()
        if during is None:
            return np.ones(self.pieces, dtype=bool)
        return np.asarray((span.hi >= during[0]) & (span.lo <= during[1]))

    def least(self, rows: Array, offset: Interval) -> Array:
        """Lower bound over each piece of offset - rows . p (rows of shape (N, n))."""
        value = (Interval.point(rows)[:, None, :] * self.controls).sum(axis=-1)
        return (offset - Interval(value.lo.max(axis=1), value.hi.max(axis=1))).lo


@dataclass(frozen=True, eq=False, kw_only=True)
class Requirement:
    """rows[k] . S_t <= room[k] on piece k keeps constraint number ``constraint`` (room is inf where not asked).

    ``limit`` is that of its limits (`limit_names`) to which it belongs.
    """

    label: str
    constraint: int
    limit: int
    rows: Array
    room: Array


def requirements(problem: Problem, curve: NominalPieces) -> list[Requirement]:
    """Every constraint of the problem (its domain last, numbered -1) as requirements along ``curve``."""
    found = []
    for number, constraint in enumerate(problem.constraints):
        own, needed = number if number < len(problem.safe) else -1, curve.required(constraint.during)
        by_faces = isinstance(constraint.region.form, Faces) and not constraint.outside
        for place, (label, rows, room) in enumerate(_constraint(constraint, curve, problem.system)):
            asked = np.where(needed, room, np.inf)
            limit = place if by_faces else 0
            found.append(Requirement(label=label, constraint=own, limit=limit, rows=rows, room=asked))
    return found


def limit_names(constraint: Inside, system: System) -> list[str]:
    """Names of the limits that a constraint is made of: the faces of a set to stay in, or the constraint itself."""
    form = constraint.region.form
    if not isinstance(form, Faces) or constraint.outside:
        return [str(constraint.label)]
    normals = constraint.region.lifted(form.normals, system.dimension)
    return [_face(constraint, row, index, len(normals), system) for index, row in enumerate(normals)]


def _face(constraint: Inside, row: Array, index: int, count: int, system: System) -> str:
    region, label = constraint.region, str(constraint.label)
    if count == 1:
        return label
    side = _side(region, row, index, system)
    named = region.kind != "box" or label != region.describe(system.states, constraint.word)
    named &= " <= " not in label  # a box that is stated in other coordinates is not named either
    return side if side and not named else f"{label}, side {index + 1}{side and f' ({side})'}"


Rows = Iterator[tuple[str, Array, Array]]


def _constraint(constraint: Inside, curve: NominalPieces, system: System) -> Rows:
    region, label = constraint.region, str(constraint.label)
    match region.form:
        case Quadratic() as form if constraint.outside:
            yield _outside_round(region, form, label, curve)
        case Quadratic() as form:
            yield from _inside_round(region, form, label, curve)
        case Faces() as form if constraint.outside:
            yield _outside_facet(region, form, label, curve)
        case Faces() as form:
            a, b = _facets(region, form, curve)
            for index in range(len(a)):
                rows = np.broadcast_to(a[index], (curve.pieces, a.shape[1])).copy()
                yield _face(constraint, a[index], index, len(a), system), rows, curve.least(rows, b[:, index])


def _side(region: Region, row: Array, index: int, system: System) -> str:
    """One side of a resting set as an inequality."""
    if region.moving or not isinstance(region.form, Faces):
        return ""
    bound = float(region.form.bounds[index] + region.form.normals[index] @ region.center_at())
    row = system.said_of(row)
    sign = -1.0 if np.count_nonzero(row) == 1 and row.sum() < 0 else 1.0
    factors = {1.0: "", -1.0: "-"}
    parts = [f"{factors.get(sign * a, f'{sign * a:g}*')}{name}" for a, name in zip(row, system.states) if a]
    return f"{' + '.join(parts).replace('+ -', '- ')} {'<=' if sign > 0 else '>='} {sign * bound + 0.0:g}"


def _outside_facet(region: Region, form: Faces, label: str, curve: NominalPieces) -> tuple[str, Array, Array]:
    """The facet that the piece keeps farthest away from; for a box a mixture of facets, weighed by the noise."""
    a, b = _facets(region, form, curve)
    if not len(a):
        raise ValueError(f"`safe` must not keep outside all states ({label}); give the box a finite side.")
    if len(a) == 1:
        rows = np.broadcast_to(-a[0], (curve.pieces, a.shape[1])).copy()
        return label, rows, curve.least(rows, -b[:, 0])
    norms = np.linalg.norm(a, axis=1)
    middle = curve.controls.mean(axis=1)
    best = np.argmax((middle @ a.T - b.mid) / norms, axis=1)
    rows = -a[best]
    if form.axial and curve.covariance is not None:
        taken = 0.0 if curve.extent is None else curve.extent @ np.abs(a).T
        mixed = _mixed(middle, a, b.mid + taken, curve.covariance)
        rows = np.where(np.isfinite(mixed).all(axis=1, keepdims=True), mixed, rows)
    weights = np.maximum(-rows @ a.T, 0.0) if form.axial else np.eye(len(a))[best]
    return label, rows, curve.least(rows, -(b * weights).sum(axis=1))


def _mixed(points: Array, faces: Array, bounds: Array, covariance: Array) -> Array:
    """Rows (N, n) that keep off a box's corner with the most standard deviations to spare.

    Every face reads one state, so that a row tells the weight of each face without rounding.
    """
    size = np.trace(covariance, axis1=1, axis2=2)[:, None, None]
    spread = covariance + (1e-9 * size + 1e-280) * np.eye(covariance.shape[1])
    scores, options = [], []
    with np.errstate(all="ignore"):
        for weights in polyhedral_weights(points, faces, bounds, spread):
            row = weights @ faces
            deviation = np.sqrt(np.einsum("ki,kij,kj->k", row, spread, row))
            scores.append(np.sum(weights * (points @ faces.T - bounds), axis=1) / deviation)
            options.append(-row)
    best = np.nanargmax(np.where(np.isfinite(scores), scores, -1e300), axis=0)
    return np.asarray(np.stack(options)[best, np.arange(len(points))])


def _facets(region: Region, form: Faces, curve: NominalPieces) -> tuple[Array, Interval]:
    """Rows (F, n) over all states and bounds (N, F) with the set equal to {rows . x <= bounds} on every piece."""
    rows = region.lifted(form.normals, curve.controls.shape[2])
    bounds = Interval.point(np.broadcast_to(form.bounds, (curve.pieces, len(form.bounds))))
    if region.center is None:
        return rows, bounds
    centre = _centre(region, curve)
    return rows, bounds + (Interval.point(form.normals)[None] * centre[:, None, :]).sum(axis=-1)


def _centre(region: Region, curve: NominalPieces) -> Interval:
    """Enclosure of the centre over each piece: shape (N, k)."""
    if isinstance(region.center, Tape):
        values = enclose(region.center, [curve.span()])
        return values.broadcast_to((curve.pieces, values.shape[-1]))
    return Interval.point(np.broadcast_to(region.center_at(), (curve.pieces, region.dimension)))


def _outside_round(region: Region, form: Quadratic, label: str, curve: NominalPieces) -> tuple[str, Array, Array]:
    """Separation by the direction from the centre (for an ellipsoid: the normal of its level set)."""
    centre = _centre(region, curve)
    coordinates = region.places(curve.controls.shape[2])
    offset = curve.controls.mean(axis=1)[:, coordinates] - centre.mid
    normal = offset if form.even else np.linalg.solve(form.shape, offset.T).T
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0, normal / np.maximum(length, 1e-300), np.eye(len(coordinates))[0])
    direction = Interval.point(normal)
    if form.even:
        square = (direction * direction).sum(axis=-1)
    else:
        square = ((direction[:, :, None] * form.shape[None]).sum(axis=1) * direction).sum(axis=-1)
    support = form.radius * Interval(np.zeros(len(square)), np.sqrt(np.maximum(square.hi, 0)) * (1 + 1e-15))
    offset_bound = -((direction * centre).sum(axis=-1) + Interval(support.hi, support.hi))
    rows = region.lifted(-normal, curve.controls.shape[2])
    return label, rows, curve.least(rows, offset_bound)


def _inside_round(region: Region, form: Quadratic, label: str, curve: NominalPieces) -> Rows:
    """A polygon (in one dimension an interval, beyond two a cross-polytope's dual) inside the round set."""
    centre = _centre(region, curve)
    k = centre.shape[-1]
    if k == 1:
        directions, scale = np.array([[1.0], [-1.0]]), 1.0
    elif k == 2:
        angles = 2 * np.pi * np.arange(_POLYGON) / _POLYGON
        directions, scale = np.stack([np.cos(angles), np.sin(angles)], 1), np.cos(np.pi / _POLYGON) * (1 - 1e-9)
    else:
        directions, scale = np.concatenate([np.eye(k), -np.eye(k)]), (1 - 1e-12) / np.sqrt(k)
    if not form.even:
        matrix = form.root
        scale *= 1 - 1e-9
        image = Interval.point(matrix) @ Interval.point(form.shape) @ Interval.point(matrix.T)
        if not bool(np.all(is_positive_definite(image - (1 - 1e-9) ** 2 * np.eye(k)))):
            raise ValueError(f"`shape` of {label} is too badly conditioned; rescale the states.")
        directions = directions @ matrix
    for index, direction in enumerate(directions):
        rows = np.broadcast_to(direction, (curve.pieces, k))
        offset = (Interval.point(rows) * centre).sum(axis=-1) + float(form.radius * scale)
        full = region.lifted(rows, curve.controls.shape[2])
        yield f"{label}, direction {index + 1} of {len(directions)}", full, curve.least(full, offset)
