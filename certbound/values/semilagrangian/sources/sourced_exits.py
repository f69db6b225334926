"""The door: bounds of the probability of leaving, from functions that are stepped with their sources."""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import replace

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape
from certbound.values.continuous import ExitBounds
from certbound.values.semilagrangian.noisy_axis import Setting
from certbound.values.semilagrangian.sources.ground import Ground, cells_of, ground_of
from certbound.values.semilagrangian.sources.marching import march
from certbound.watch import OutOfTime

_KINKS = {"abs", "min", "max", "kink", "clip"}
_RATE = 450_000  # cells times steps in a second
_FINEST, _COARSEST = 0.6, 3.0
_LOOK, _SHARES = 0.06, (1.0, 0.75, 0.56)
_GUESS = 1e-3
_SLICES = 16


def kinked(tape: Tape) -> bool:
    """Whether a drift is written with operations whose slope may jump."""
    return any(node.op in _KINKS for node in tape.nodes)


def bound_sourced_exits(setting: Setting, *, seconds: float) -> ExitBounds:
    """Bound P(X_t leaves the box for some t <= T) from above, for a drift that does not depend on time.

    Parameters
    ----------
    seconds : float
        About what may be spent, as a number of cells and steps.

    Raises
    ------
    InfeasibleError
        Walls, time in the drift, or nothing is proved.
    """
    if setting.walls or setting.timed:
        raise InfeasibleError("value functions with sources take limits along the coordinates that stand still.")
    begin = time.process_time()
    work = _RATE * seconds
    rough = [_bound(one, _affordable(one, _LOOK * work), _GUESS) for one in _narrower(setting)]
    best, setting = min(((found[0], one) for found, one in zip(rough, _narrower(setting))), key=lambda pair: pair[0])
    try:
        upper, ground = _bound(setting, _affordable(setting, work), max(min(best / 3, _GUESS), 1e-12))
    except OutOfTime:
        if not best < 1:
            raise
        upper, ground = 1.0, None
    if ground is None and not best < 1:
        raise InfeasibleError("sources do not settle; value functions prove nothing here.")
    upper = min(upper, best)
    cells = "a rough grid" if ground is None else f"{ground.p.cells} x {ground.q.cells} cells"
    words = f"value function with sources on {cells}"
    return ExitBounds(
        upper=min(0.0, math.log10(max(upper, 1e-300)) * (1 - 1e-15) + 1e-15), lower=None, words=words,
        seconds=time.process_time() - begin,
    )  # fmt: skip


def _narrower(setting: Setting) -> list[Setting]:
    """The problem with the whole range of q, and with parts of it where nothing bounds q: leaving them counts."""
    found = []
    for share in _SHARES:
        ends = list(setting.faces[1])
        for side, start in enumerate(setting.starts[1]):
            if not math.isfinite(setting.beyond[1][side]):
                ends[side] = start + share * (ends[side] - start)
        found.append(replace(setting, faces=(setting.faces[0], (ends[0], ends[1]))))
    return found if math.inf in map(abs, setting.beyond[1]) else found[:1]


def _affordable(setting: Setting, work: float) -> float:
    return min(max(math.cbrt(cells_of(setting, 1.0) / work), _FINEST), _COARSEST)


def _bound(setting: Setting, grain: float, guess: float) -> tuple[float, Ground | None]:
    """An upper bound and its ground; 1 where nothing is proved."""
    ground = ground_of(setting, grain)
    for steady in (False, True):
        try:
            found = march(ground, setting.horizon, guess, steady=steady)
        except InfeasibleError:
            continue
        upper = (_highest(ground, found.values, setting) + found.amount) * math.exp(found.rate) * (1 + 1e-12)
        return min(1.0, upper), ground
    return 1.0, None


def _ranges(ground: Ground, values: Array, p: tuple[float, float], q: tuple[float, float]) -> Array:
    """Bernstein coefficients of a spline on the parts of a box in cells, each rounded up."""
    parts = []
    for axis, (low, high) in ((ground.p, p), (ground.q, q)):
        first = max(int(np.searchsorted(axis.knots, low, side="right")) - 1, 0)
        last = max(min(int(np.searchsorted(axis.knots, high)), axis.cells), first + 1)
        cell = np.arange(first, min(last, axis.cells)) if first < axis.cells else np.array([axis.cells - 1])
        ends = np.clip([[low], [high]], axis.knots[cell], axis.knots[cell + 1])
        parts.append((cell, axis.pieces(cell, ends[0], ends[1])))
    (i, rows), (j, columns) = parts
    block = np.array([[values[a : a + 3, b : b + 4] for b in j] for a in i])
    found = np.einsum("aik,bjl,abkl->abij", rows, columns, block)
    return np.asarray(found + 1e-12 * np.abs(block).max(axis=(2, 3), keepdims=True))


def _highest(ground: Ground, values: Array, setting: Setting) -> float:
    """Upper bound of W over the starts."""
    best = -math.inf
    for q in itertools.pairwise(np.linspace(*setting.starts[1], _SLICES + 1).tolist()):
        p = setting.starts_between(*q)
        slack = 1e-15 * (1 + abs(p[0]) + abs(p[1]))
        if p[0] - slack < ground.p.knots[0] or p[1] + slack > ground.p.knots[-1]:
            return 1.0
        best = max(best, float(_ranges(ground, values, (p[0] - slack, p[1] + slack), q).max()))
    return best
