"""Polytopes made of something else: polygons from their corners, and intersections of sets with flat faces."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.checks import matrix
from certbound.problem.sets.forms import Faces, Region, linear_maximum
from certbound.problem.sets.regions import Polytope

_SLACK = 2.0**-48
"""Rounding of a side that floats do not compute exactly, in units of the numbers that it is computed from."""


def polygon(vertices: ArrayLike, *, places: Sequence[int] = (0, 1), dimension: int = 2, outward: bool) -> Polytope:
    """The convex polygon with these corners, in two of the states, as a polytope over all of them.

    Proves: the polytope contains the polygon (``outward``: for what is to be avoided), or lies in it (for what is to be
    stayed in or reached). A side lies exactly where its corners put it where floats compute it without rounding;
    elsewhere a few units of rounding lie between the two.

    Parameters
    ----------
    vertices : array_like, shape (m, 2)
        Corners in order, either way round.
    places : sequence of int
        The states of the two columns.
    dimension : int
        Number of states.
    outward : bool
        To which side rounding may move the faces.

    Raises
    ------
    ValueError
        If these are not the corners of a convex polygon in order.

    Examples
    --------
    >>> triangle = polygon([[0, 0], [1, 0], [0, 1]], outward=True)
    >>> [bool(triangle.contains(x)) for x in ([0.4, 0.4], [0.6, 0.6])]
    [True, False]
    """
    points = matrix("vertices", vertices, columns=2)
    if _turn(points) < 0:
        points = points[::-1]
    if len(points) < 3 or not _is_convex(points):
        raise ValueError(
            f"`vertices` must be the corners of a convex polygon in order, without corners on a side, got "
            f"{points.tolist()}; cut others into convex ones."
        )
    normals, bounds, size = [], [], float(np.abs(points).max())
    for (x0, y0), (x1, y1) in zip(points, np.roll(points, -1, axis=0)):
        normal = np.array([y1 - y0, x0 - x1])
        row = np.zeros(dimension)
        row[list(places)] = normal
        normals.append(row)
        bounds.append(_bound(normal, [(x0, y0), (x1, y1)], size, outward))
    return Polytope(np.array(normals), np.array(bounds))


def _bound(normal: Array, ends: list[tuple[float, float]], size: float, outward: bool) -> float:
    """The bound of a side between two corners: exact where floats compute it exactly, else moved to one side."""
    (x0, y0), (x1, y1) = corners = _exactly(np.array(ends))
    along, across = map(Fraction, normal.tolist())
    found = [float(normal @ np.array(end)) for end in ends]
    held = (along, across) == (y1 - y0, x0 - x1)
    if held and all(along * x + across * y == Fraction(value) for (x, y), value in zip(corners, found)):
        return max(found)
    slack = _SLACK * size * float(np.abs(normal).sum())
    return max(found) + slack if outward else max(found) - slack


def _exactly(points: Array) -> list[tuple[Fraction, Fraction]]:
    return [(Fraction(float(x)), Fraction(float(y))) for x, y in points]


def _turn(points: Array) -> Fraction:
    """Twice the signed area."""
    exact = _exactly(points)
    return sum((a[0] * b[1] - b[0] * a[1] for a, b in zip(exact, exact[1:] + exact[:1])), Fraction(0))


def _is_convex(points: Array) -> bool:
    """Whether every corner lies strictly to the left of every side that does not touch it."""
    exact = _exactly(points)
    for k, a in enumerate(exact):
        b = exact[(k + 1) % len(exact)]
        for j, c in enumerate(exact):
            side = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
            if j not in (k, (k + 1) % len(exact)) and side <= 0:
                return False
    return True


def intersection(parts: Sequence[Region], *, dimension: int, outward: bool) -> Polytope:
    """What several sets with flat faces have in common, over all states.

    Parameters
    ----------
    parts : sequence of Region
        Fixed boxes, half-spaces and polytopes.
    dimension : int
        Number of states.
    outward : bool
        To which side rounding may move faces that have to be moved by a centre.

    Raises
    ------
    ValueError
        If a part has no flat faces or moves, or they have no point in common.
    """
    normals, bounds = [], []
    for part in parts:
        form = part.form
        if not isinstance(form, Faces) or part.moving:
            kind = part.kind or type(part).__name__
            moves = "moves" if part.moving else "is round"
            raise ValueError(
                f"`all` must hold fixed boxes, halfspaces, polytopes and polygons here, and the {kind} {moves}; put a "
                "polygon around it (or inside it, for what is to be stayed in or reached)."
            )
        center = part.center_at()
        moved = form.bounds + form.normals @ center
        slack = _SLACK * (np.abs(form.normals) @ np.abs(center)) * (1.0 if outward else -1.0)
        held = [_adds_up(*numbers, center) for numbers in zip(moved, form.bounds, form.normals)]
        normals.append(part.lifted(form.normals, dimension))
        bounds.append(np.where(held, moved, moved + slack))
    faces, ends = np.concatenate(normals), np.concatenate(bounds)
    if linear_maximum(faces, ends, np.zeros(dimension)) is None:
        raise ValueError("`all` must hold sets with a point in common, and these have none.")
    return Polytope(faces, ends)


def _adds_up(found: float, bound: float, normal: Array, center: Array) -> bool:
    """Whether a float is bound + normal.center to the last digit."""
    products = (Fraction(a) * Fraction(b) for a, b in zip(normal.tolist(), center.tolist()))
    return Fraction(float(found)) == sum(products, Fraction(float(bound)))
