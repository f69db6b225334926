"""Rows along which the remainder asks for bounds of the deviation: the active coordinates, and where curvature acts.

Any rows are valid; these bound what the Hessians see, and move so that bounds along them cost little.
"""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array
from certbound.reach.linear.linearisation import Linearisation

_POINTS = 64
_MOST = 8  # active coordinates
_MOST_KINKS = 16  # each of which takes its share of what is left out
_FARTHEST = 2.0  # times the spread, for points at which kinks are looked for


def inner_rows(engine: Linearisation) -> tuple[Array, Array]:
    """All rows (B, N, D, n), the active coordinates first, and the others over the active coordinates alone."""
    active, cells = engine.model.active, engine.cells
    unit = np.zeros((len(active), engine.n))
    unit[np.arange(len(active)), active] = 1.0
    rows = np.broadcast_to(unit, (cells, engine.pieces, *unit.shape))
    extra = _curved(engine)
    full = np.zeros((cells, engine.pieces, extra.shape[2], engine.n))
    full[..., active] = extra
    return np.concatenate([rows, full], axis=2), extra


def _curved(engine: Linearisation) -> Array:
    """Extreme eigen-directions of the Hessians in the metric of the deviation's spread."""
    active, cells, blocks = engine.model.active, engine.cells, engine.model.blocks
    count = len(active)
    rows = _normals(engine)
    if not 2 <= count <= _MOST or len(blocks) != 1 or len(blocks[0]) != 1:
        return rows
    hessians = engine.model.reference_hessians(engine.frame).reshape(cells, engine.pieces, -1, count, count)
    kinks = not hessians.any() and engine.model.kinked and not engine.model.planar
    if not hessians.shape[2] and not kinks:
        return rows
    node = slice(1, None) if engine.continuous else slice(0, -1)
    spread = 16 * engine.response.covariance[:, node] + _spread(engine)[:, node]
    spread = spread[..., active, :][..., active]
    trace = np.trace(spread, axis1=-2, axis2=-1)[..., None, None]
    spread = spread + (1e-9 * trace + 1e-30 * float(engine.sizes.max()) ** 2 + 1e-300) * np.eye(count)
    root = np.linalg.cholesky(spread)
    inverse = np.linalg.inv(root)
    if not kinks or not rows.shape[2]:
        hessians = _jumps(engine, root) if kinks else hessians
        _, vectors = np.linalg.eigh(np.swapaxes(root, -1, -2)[:, :, None] @ hessians @ root[:, :, None])
        chosen = np.swapaxes(vectors, -1, -2)[..., [-1] if kinks else [0, -1], :] @ inverse[:, :, None]
        rows = np.concatenate([chosen.reshape(cells, engine.pieces, -1, count), rows], axis=2)
    # what the remainder does not depend on must not help to cull its boxes
    rows[..., np.setdiff1d(np.arange(count), blocks[0][0])] = 0.0
    rows = rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-300)  # the spread may be next to nothing
    if engine.continuous and len(blocks[0][0]) == engine.n:
        rows = _carried(rows, engine)
    # the sign of an eigenvector is free: keep it from flipping between neighbours
    flips = np.einsum("bkda,bkac,bkdc->bkd", rows[:, 1:], spread[:, 1:], rows[:, :-1])
    sign = np.cumprod(np.where(flips < 0, -1.0, 1.0), axis=1)
    rows[:, 1:] *= sign[..., None]
    return rows


def _normals(engine: Linearisation) -> Array:
    """Normals of the kinks that sums of coordinates have, (B, N, K, active): what stays short of them is smooth."""
    shape, count = (engine.cells, engine.pieces), len(engine.model.active)
    nothing = np.zeros((*shape, 0, count))
    if engine.model.planar or not engine.model.kinked:
        return nothing
    found = engine.model.kink_normals(engine.frame)
    return nothing if found.shape[1] > _MOST_KINKS else found.reshape(*shape, -1, count)


def _jumps(engine: Linearisation, root: Array) -> Array:
    """Squares of how gradients turn within the spread, summed over points: largest along the normals of kinks."""
    count = root.shape[-1]
    unit = np.random.default_rng(0).normal(size=(_POINTS, count))
    unit *= (_FARTHEST * np.linspace(0, 1, _POINTS) / np.linalg.norm(unit, axis=1))[:, None]
    shift = np.einsum("bkij,pj->bkpi", root, unit).reshape(-1, _POINTS, count)
    turned = engine.model.turned_gradients(engine.frame, shift)
    found = np.einsum("mpoi,mpoj->moij", turned, turned).reshape(*root.shape[:2], -1, count, count)
    return np.asarray(found + 1e-6 * found.mean(axis=1, keepdims=True))


def _carried(rows: Array, engine: Linearisation) -> Array:
    """The rows of every window's middle, moved with the flow: seen from the window's end they hardly turn."""
    result, length = rows.copy(), engine.window
    forward = engine.response.transition
    back = np.linalg.inv(forward)
    for start in range(0, engine.pieces, length):
        end = min(start + length, engine.pieces)
        middle = (start + end) // 2
        nodes = {middle: rows[:, min(middle, end - 1)]}
        for k in range(middle, end):
            nodes[k + 1] = nodes[k] @ back[:, k]
        for k in range(middle - 1, start - 1, -1):
            nodes[k] = nodes[k + 1] @ forward[:, k]
        for k in range(start, end):
            result[:, k] = (nodes[k] + nodes[k + 1]) / 2
    return result


def _spread(engine: Linearisation) -> Array:
    """Rough second moment of y at the nodes (floats; it only shapes directions)."""
    cells, n = engine.centres.shape
    gram = np.zeros((cells, engine.pieces + 1, n, n))
    own = 2 * engine.radii[:, :, None] ** 2 * np.eye(n)
    drift = np.zeros((cells, n, len(engine.d_radius)))
    gram[:, 0] = own
    for k in range(engine.pieces):
        f = engine.response.transition[:, k]
        own = f @ own @ np.swapaxes(f, -1, -2)
        drift = f @ drift + np.swapaxes(engine.gathering.generators[:, k], -1, -2)
        gram[:, k + 1] = own + drift @ np.swapaxes(drift, -1, -2)
    return gram
