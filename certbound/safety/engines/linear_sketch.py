"""Whether the linear response has a chance, from a sketch of its remainder in floating point.

Along one noise-free path the linearised model's deviation is Gaussian. What the linearisation leaves out of f is
sampled within the deviations that have to be reckoned with, carried along, and the deviations grow by it. Where they
meet a constraint at fewer standard deviations than delta asks for, no proof will be found. Nothing here is proved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import Tape, compile_numpy, edged, varying_outputs
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem
from certbound.reach.nominal import Flow
from certbound.safety.falsification import follow, rooms

_FEWEST, _MOST = 2, 20
_WHOLE = 3  # states from which on sets of starts are looked at as a whole
_ROOM = 1.1
_PIECES = 48
_SAMPLES = 64
_ROUNDS = 4
_SHARE = 0.3  # of delta, for the deviations that have to be reckoned with
_SIZES = (0.25, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.4, 1.7, 2.0)
_FITTED = 0.6  # of a remainder is left once the slopes are fitted


def linear_chance(problem: Problem) -> float:
    """How far the constraints are away, in units of what the linear response needs at the problem's delta.

    Infinite where nothing speaks against it, though a look at one path says little for it either: a linear model,
    discrete time, one state, targets, and two states, whose sets of starts can be halved.
    """
    system, n = problem.system, problem.system.dimension
    if not isinstance(system, ContinuousSystem) or not _FEWEST <= n <= _MOST or problem.reach is not None:
        return math.inf
    flow = Flow(problem)
    curved = edged(flow.tape) or any(varying_outputs(flow.state_jacobian))
    if not curved and not isinstance(system.diffusion, Tape):
        return math.inf
    with np.errstate(all="ignore"):
        far, needed = _Sketch.of(problem, flow).levels()
    chance = far / (_ROOM * needed)
    return math.inf if chance >= 1 and n < _WHOLE else chance


@dataclass(frozen=True, eq=False, kw_only=True)
class _Sketch:
    """A noise-free path (K + 1, n), what carries deviations over its pieces (K, n, n), and their spread (K + 1, n, n).

    ``wide`` (K + 1, n, n) takes offsets at the start, in units of the initial set, to later times.
    """

    flow: Flow
    times: Array
    path: Array
    slopes: Array
    carried: Array
    spread: Array
    wide: Array

    @classmethod
    def of(cls, problem: Problem, flow: Flow) -> _Sketch:
        start = problem.initial
        hull = start.hull() if not start.random else None
        middle = np.asarray(start.middle, dtype=float)
        times, paths = follow(flow, middle[None], flow.centre_disturbance[None])
        chosen = np.unique(np.linspace(0, len(times) - 1, _PIECES + 1).astype(int))
        times, path = times[chosen], paths[0, chosen]
        slopes = _along(flow, flow.state_jacobian, times[:-1], path[:-1])
        steps, eye = np.diff(times)[:, None, None], np.eye(flow.dimension)
        carried = np.linalg.solve(eye - slopes * steps / 2, eye + slopes * steps / 2)
        radii = np.zeros(flow.dimension) if hull is None else np.asarray(hull.hi - hull.lo) / 2
        spread = [np.zeros_like(eye) if hull is not None else np.asarray(start.covariance, dtype=float)]
        wide = [np.diag(radii)]
        for step, noise in zip(carried, _noises(problem, flow, times, path), strict=True):
            spread.append(step @ spread[-1] @ step.T + noise)
            wide.append(step @ wide[-1])
        return cls(flow=flow, times=times, path=path, slopes=slopes, carried=carried, spread=np.array(spread),
                   wide=np.array(wide))  # fmt: skip

    def levels(self) -> tuple[float, float]:
        """How far away the nearest constraint is, in standard deviations of the noise, and how far it must be."""
        n, delta, rng = self.flow.dimension, self.flow.problem.delta, np.random.default_rng(0)
        level = math.sqrt(2 * (math.log(4.0 * n) - math.log(_SHARE * delta)))
        values, vectors = np.linalg.eigh(self.spread)
        factors = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        around = rng.standard_normal((_SAMPLES, n))
        noise = np.einsum("kij,sj->ksi", factors, around / np.linalg.norm(around, axis=1, keepdims=True))
        signs = rng.choice([-1.0, 1.0], (_SAMPLES, n))
        offset = np.einsum("kij,sj->ksi", self.wide, signs)
        extra = np.zeros(self.path.shape)
        for _ in range(_ROUNDS):
            extra = self._carried_on(self._remainder(level * noise + offset + extra[:, None] * signs))
            if not np.all(np.isfinite(extra)):
                return 0.0, level
        deviations = np.sqrt(np.einsum("kii->ki", self.spread))[:, None, :]
        likeliest = self.spread / np.where(deviations > 0, deviations, np.inf)  # towards each coordinate
        toward = np.concatenate([likeliest, -likeliest, noise], axis=1)
        moved = self.path[:, None] + np.sign(toward) * (np.abs(self.wide).sum(axis=-1) + extra)[:, None]
        for size in _SIZES:
            paths = np.swapaxes(moved + size * level * toward, 0, 1)
            if any(np.any(rooms(one, self.flow, self.times, paths) < 0) for one in self.flow.problem.constraints):
                return size * level, level
        return math.inf, level

    def _remainder(self, offsets: Array) -> Array:
        """The half-range of what the linearisation leaves out at the offsets (K + 1, S, n), a piece: (K, n)."""
        offsets, path = offsets[:-1], self.path[:-1, None]
        rows = self.flow.plan_rows(self.times[:-1])[:, None]
        t = self.times[:-1, None]
        moved = self.flow.value(t, path + offsets, rows)
        left = moved - self.flow.value(t, path, rows) - np.einsum("kij,ksj->ksi", self.slopes, offsets)
        return np.asarray(_FITTED * (left.max(axis=1) - left.min(axis=1)) / 2 * np.diff(self.times)[:, None])

    def _carried_on(self, pushes: Array) -> Array:
        """What the pushes (K, n), signs unknown, add up to at every time (K + 1, n)."""
        found = np.zeros((len(pushes) + 1, pushes.shape[1]))
        maps = np.zeros((0, *self.carried.shape[1:]))
        for k, step in enumerate(self.carried):
            maps = np.concatenate([step @ maps, np.eye(len(step))[None]])
            found[k + 1] = np.einsum("jab,jb->a", np.abs(maps), pushes[: k + 1])
        return found


def _along(flow: Flow, tape: Tape, times: Array, states: Array) -> Array:
    """A tape of the flow's slots along a path."""
    rows = flow.plan_rows(times)
    return compile_numpy(tape)(times, *states.T, *rows.T, *flow.centre_disturbance)


def _noises(problem: Problem, flow: Flow, times: Array, path: Array) -> Array:
    """The covariance that the noise adds on each piece, (K, n, n)."""
    system = problem.system
    assert isinstance(system, ContinuousSystem)
    g = system.diffusion
    if isinstance(g, Tape):
        g = compile_numpy(g)(times[:-1], *path[:-1].T)
    g = np.broadcast_to(np.asarray(g, dtype=float), (len(times) - 1, *np.shape(g)[-2:]))
    return np.asarray(g @ np.swapaxes(g, 1, 2) * np.diff(times)[:, None, None])
