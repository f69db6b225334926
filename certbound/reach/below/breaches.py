"""What breaks a constraint at a single time, as events of the Gaussian response: half-spaces that it must leave.

A path with w . X_t > b has left {w . x <= b}; one inside all faces of an obstacle has met it. With X = p + Z + R and
bounds of R that hold on every path that has not failed before, both are events of Z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.gaussian.response import Exceedances
from certbound.gaussian.scalar import log_tail
from certbound.problem.sets import Faces, Quadratic, Region
from certbound.reach.below.survival import centre_over
from certbound.reach.linear import Linearisation
from certbound.rigor.definite import is_positive_definite
from certbound.rigor.intervals import Interval

_MOST = 192  # events
_WORTH = 0.1  # of the likeliest one
_ANGLES = (0.3, 0.6, 0.9)  # of the corners of a box in a ball, seen from its centre


@dataclass(frozen=True, eq=False, kw_only=True)
class Breach:
    """At node k + offset a constraint is broken where all rows[j, k] . s > levels[j, k], s = X - p: (J, K, n), (J, K).

    ``asked`` (K,) tells at which nodes the constraint holds at all. ``label`` names it, and
    ``place`` is its number and that of the way to break it: the same on all grids.
    """

    label: str
    place: tuple[int, int]
    rows: Array
    levels: Array
    asked: Mask


def breaches(engine: Linearisation) -> list[Breach]:
    """Every way to break a constraint at the end of a piece (at a step in discrete time), along the only cell.

    Leaving the model's domain is not looked for: there the model says nothing.
    """
    first_node, found = int(engine.continuous), []
    nodes, times = engine.nodes[0, first_node:], engine.times[first_node:]
    slip = 4e-15 * float(times[-1]) * engine.continuous  # the nodes are floats near k h, the last one is the horizon
    span = Interval(times - slip, times + slip)
    for number, constraint in enumerate(engine.problem.safe):
        asked = np.ones(len(times), dtype=bool)
        if constraint.during is not None:
            first, last = constraint.during
            asked = (span.lo >= first) & (span.hi <= last)
            asked[-1] = first <= float(engine.problem.horizon) <= last
        region = constraint.region
        y = Interval.point(nodes[:, region.places(engine.n)]) - centre_over(region, span)
        ways = (_met if constraint.outside else _left)(region, y, engine) if asked.any() else []
        for way, (rows, levels) in enumerate(ways):
            found.append(Breach(label=constraint.label, place=(number, way), rows=rows, levels=levels, asked=asked))
    return found


def _left(region: Region, y: Interval, engine: Linearisation) -> list[tuple[Array, Array]]:
    """Half-spaces beyond a set that is to be stayed in."""
    form, found = region.form, []
    if isinstance(form, Faces):
        normals, bounds = form.normals, form.bounds
    else:
        normals = _directions(form, engine.response.covariance[0, -1][np.ix_(*[region.places(engine.n)] * 2)], y)
        bounds = _reach(form, normals)
    for normal, bound in zip(normals, bounds):
        level = (Interval.point(bound) - (Interval.point(normal) * y).sum(axis=-1)).hi
        rows = region.lifted(np.broadcast_to(normal, (len(y.lo), len(normal))), engine.n)
        found.append((rows[None], level[None]))
    return found


def _reach(form: Quadratic, normals: Array) -> Array:
    """Upper bounds of the support function of a round set about its centre."""
    square = np.einsum("ij,ik,jk->i", normals, normals, form.shape) + 1e-14 * np.abs(form.shape).max() * (
        np.abs(normals).sum(axis=1) ** 2)
    return np.asarray(form.radius * np.sqrt(square) * (1 + 1e-14))


def _directions(form: Quadratic, spread: Array, y: Interval) -> Array:
    """Directions in which a round set may be left: of the largest noise in its own metric, and of the nominal."""
    root = form.root
    _, vectors = np.linalg.eigh(root @ spread @ root.T)
    offset = np.asarray(y.mid) @ root.T
    nearest = offset[np.argmax(np.linalg.norm(offset, axis=1))]
    along = np.concatenate([vectors.T, -vectors.T, [nearest] if np.any(nearest) else np.zeros((0, len(nearest)))])
    return np.asarray(along @ root)


def _met(region: Region, y: Interval, engine: Linearisation) -> list[tuple[Array, Array]]:
    """Obstacles, or boxes inside round ones that look to the nominal."""
    form = region.form
    if isinstance(form, Faces):
        normals = np.broadcast_to(-form.normals[:, None], (len(form.normals), len(y.lo), form.dimension))
        return [_faces(region.lifted(normals, engine.n), normals, form.bounds[:, None], y)]
    k, root = form.dimension, form.root
    image = Interval.point(root) @ Interval.point(form.shape) @ Interval.point(root.T)
    if not bool(np.all(is_positive_definite(image - (1 - 1e-9) ** 2 * np.eye(k)))):
        return []
    offset = np.asarray(y.mid) @ root.T
    size = np.linalg.norm(offset, axis=1, keepdims=True)
    toward = np.where(size > 1e-9, offset / np.maximum(size, 1e-9), np.eye(k)[0])
    basis = np.linalg.qr(np.concatenate([toward[:, :, None], np.broadcast_to(np.eye(k), (len(y.lo), k, k))], 2))[0]
    frame = np.swapaxes(basis[:, :, :k], 1, 2)  # (K, k, k): rows, the first along the offset
    rows = np.concatenate([frame, -frame], axis=1) @ root
    found = []
    for angle in _ANGLES if k > 1 else (0.0,):
        sides = np.full(k, np.sin(angle) / np.sqrt(max(k - 1, 1)))
        sides[0] = np.cos(angle)
        # {|q . y| <= side * radius} for orthonormal rows q of W y: |W y| <= radius there, but for rounding
        half = np.tile(sides, 2)[:, None] * form.radius * (1 - 3e-9)
        normals = -np.swapaxes(rows, 0, 1)
        found.append(_faces(region.lifted(normals, engine.n), normals, half, y))
    return found


def _faces(lifted: Array, normals: Array, bounds: Array, y: Interval) -> tuple[Array, Array]:
    """Rows and levels of {-normals . (p + s - c) <= bounds}: s beyond the level along every row."""
    value = (Interval.point(normals) * y).sum(axis=-1)
    return lifted, (Interval.point(-bounds) - value).hi


def events_of(
    engine: Linearisation, found: list[Breach], remainder: list[tuple[Array, Array]], *, most: int = _MOST
) -> tuple[Exceedances, list[str]]:
    """The likeliest breaches at single times, given bounds of y + R along every breach's rows, and their labels.

    ``remainder`` has a pair (J, K) of lower and upper bounds for every breach. Events that are next to each other in
    time are thinned out.
    """
    offset, response, kept, labels = int(engine.continuous), engine.response, [], []
    for breach, (low, _) in zip(found, remainder):
        nodes = np.flatnonzero(breach.asked)
        level = breach.levels - low
        level = level + 4e-16 * (np.abs(breach.levels) + np.abs(low))
        places = nodes + offset
        high = np.stack([response.variance(rows[None, nodes], places)[1][0] for rows in breach.rows])
        with np.errstate(divide="ignore", invalid="ignore"):
            size = np.where(high > 0, level[:, nodes] / np.sqrt(high), np.inf)
        leading = np.argmax(size, axis=0)
        lost = np.zeros(len(nodes))
        for j in range(len(breach.rows)):
            single = Exceedances(nodes=places, rows=-breach.rows[j, nodes], levels=-level[j, nodes], lost=lost)
            missed = np.exp(_log_misses(engine, single))
            lost = lost + np.where(leading == j, 0.0, missed) * (1 + 1e-12)
        pick = np.arange(len(nodes))
        kept.append(Exceedances(
            nodes=places, rows=breach.rows[leading, nodes], levels=level[leading, nodes[pick]], lost=lost))
        labels += [breach.label] * len(nodes)
    whole = Exceedances(**{
        name: np.concatenate([getattr(one, name) for one in kept]) for name in ("nodes", "rows", "levels", "lost")})
    chances = whole.chances(response)
    worth = np.flatnonzero(chances > _WORTH * chances.max(initial=0.0))
    if len(worth) > most:
        worth = worth[np.unique(np.linspace(0, len(worth) - 1, most).round().astype(int))]
    return whole.chosen(worth), [labels[k] for k in worth]


def _log_misses(engine: Linearisation, events: Exceedances) -> Array:
    """Upper bounds of log P(rows . Z >= levels)."""
    low, high = (v[0] for v in engine.response.variance(events.rows[None], events.nodes))
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.where(events.levels >= 0, events.levels / np.sqrt(high), events.levels / np.sqrt(np.maximum(low, 0)))
    return np.asarray(log_tail(np.nan_to_num(size - 1e-12 * np.abs(size), nan=-np.inf)))
