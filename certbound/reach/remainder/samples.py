"""The remainder beta of Thm K7 at sample points of the deviation: proposals only, nothing here is certified.

The range over the points is a guess for the inclusion that `certbound.reach.linear.run` proves; the affine
least-squares fit over them is a slope Jhat that leaves less to the remainder than the Jacobian at the nominal point.
"""

from __future__ import annotations

import itertools

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import compile_numpy
from certbound.reach.remainder.derivatives import Derivatives
from certbound.reach.remainder.frame import Frame

_POINTS = {1: 17, 2: 9, 3: 7, 4: 3, 5: 3, 6: 3}
_DIRECTIONS = 64
_NEGLIGIBLE = 1e-9  # of the widest deviation of a state
_ROUNDING = 1e-13  # of the nominal state


def sampled_range(model: Derivatives, frame: Frame, low: Array, high: Array, rows: Array) -> tuple[Array, Array]:
    """Range of beta at the middle of every piece over the points: two arrays (M, n).

    ``low`` and ``high`` (M, D) bound s along the active coordinates (first) and along ``rows`` (M, D - active, active).
    """
    base = _remainder(model, frame, np.zeros((len(frame), 1, len(model.active))))[:, 0]
    lower, upper = base.copy(), base.copy()
    for group in model.blocks:
        values = _remainder(model, frame, _points(model, group, low, high, rows)[0]) - base[:, None]
        lower += np.fmin(np.fmin.reduce(values, axis=1), 0.0)
        upper += np.fmax(np.fmax.reduce(values, axis=1), 0.0)
        lost = ~np.isfinite(values).all(axis=1)
        lower[lost], upper[lost] = -np.inf, np.inf
    return lower, upper


def fitted_slopes(model: Derivatives, frame: Frame, low: Array, high: Array, rows: Array) -> Array:
    """What to add to the slope at the middle of every piece: the affine fit of beta over the points, (M, n, n).

    Constant entries of the Jacobian keep their values.
    """
    m, n = frame.spread.shape
    result = np.zeros((m, n, n))
    position = {int(state): a for a, state in enumerate(model.active)}
    for group in model.blocks:
        shift, half = _points(model, group, low, high, rows)
        values = _remainder(model, frame, shift)
        least = np.maximum(_NEGLIGIBLE * half.max(axis=0), _ROUNDING * np.abs(frame.middle.mid[:, model.active]))
        scale = np.where(half > least, half, np.inf)
        for i in range(n):
            states = [j for o, j in model.entries if o == i and any(position[j] in block for block in group)]
            if not states:
                continue
            columns = [position[j] for j in states]
            design = np.concatenate([np.ones((*shift.shape[:2], 1)), shift[..., columns] / scale[:, None, columns]], 2)
            with np.errstate(invalid="ignore"):
                normal = np.swapaxes(design, 1, 2) @ design + 1e-9 * shift.shape[1] * np.eye(len(columns) + 1)
                solution = np.linalg.solve(normal, np.swapaxes(design, 1, 2) @ values[..., i, None])[..., 0]
            found = solution[:, 1:] / scale[:, columns]
            result[:, i, states] = np.where(np.isfinite(found).all(axis=1, keepdims=True), found, 0.0)
    return result


def _points(
    model: Derivatives, group: list[list[int]], low: Array, high: Array, rows: Array
) -> tuple[Array, Array]:
    """Points (M, K, active) of the polytope that move the blocks of one group, and the half-widths (M, active)."""
    count, size = len(model.active), len(group[0])
    middle, half = (low[:, :count] + high[:, :count]) / 2, (high[:, :count] - low[:, :count]) / 2
    if size in _POINTS:
        line = np.cos(np.pi * np.arange(_POINTS[size]) / (_POINTS[size] - 1))
        unit = np.array(list(itertools.product(line, repeat=size)))
    else:
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (_DIRECTIONS, size))
        unit = np.concatenate([np.zeros((1, size)), signs, signs / 2])
    step, shift = (np.zeros((len(low), len(unit), count)) for _ in range(2))
    for block in group:
        step[..., block] = half[:, None, block] * unit
        shift[..., block] = middle[:, None, block]
    if len(group) == 1 and rows.shape[1]:
        along, offset = np.einsum("mda,mka->mkd", rows, step), np.einsum("mda,ma->md", rows, shift[:, 0])[:, None]
        room = np.where(along > 0, high[:, None, count:] - offset, offset - low[:, None, count:])
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(np.abs(along) > 0, room / np.abs(along), np.inf)
        step *= np.clip(ratio.min(axis=2), 0.0, 1.0)[..., None]
    return shift + step, half


def _remainder(model: Derivatives, frame: Frame, shift: Array) -> Array:
    """beta in floats at the middle of the pieces for deviations ``shift`` (M, K, active): (M, K, n)."""
    with np.errstate(all="ignore"):
        value = np.asarray(compile_numpy(model.value)(*model.shifted(frame, shift))).reshape(*shift.shape[:2], -1)
        linear = shift @ np.swapaxes(frame.slope.mid[:, :, model.active], 1, 2)
        return np.asarray(value - frame.middle_velocity.mid[:, None] - linear)
