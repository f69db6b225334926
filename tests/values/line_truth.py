"""The exit probability in one state, from both sides, by a fine monotone scheme: limits moved in and out by a cell."""

from __future__ import annotations

import itertools
import math

import numpy as np
from scipy.linalg.lapack import dgtsv
from scipy.stats import norm

import certbound as cb
from certbound.problem.model import compile_numpy
from certbound.values.enclosing import squared_diffusion

_GAMMA = 1 - 0.5**0.5


def bracket(problem: cb.Problem, low: float, high: float, cells: int = 4800, steps: int = 900) -> tuple[float, float]:
    """Probabilities of failing with every limit moved outward and inward by a cell of the grid on [low, high].

    The rest of the error (time steps, the worst vertex of the disturbances) is of the order of 1e-3.
    """
    found = [_Scheme(problem, low, high, cells, steps, sign).solved() for sign in (1, -1)]
    return found[0], found[1]


class _Scheme:
    def __init__(self, problem: cb.Problem, low: float, high: float, cells: int, steps: int, sign: int) -> None:
        self.problem, self.steps = problem, steps
        self.x = np.linspace(low, high, cells + 1)
        self.h = self.x[1] - self.x[0]
        self.shift = sign * self.h
        self.drift = compile_numpy(problem.closed_loop)
        self.square = compile_numpy(squared_diffusion(problem.system.diffusion, problem.system.states))
        box = problem.system.disturbance
        self.corners = [()] if box is None else list(itertools.product(*zip(box.low, box.high)))
        horizon = float(problem.horizon)
        self.constraints = [(c, c.during or (0.0, horizon)) for c in problem.constraints]
        self.instants = sorted({0.0, horizon, *(end for _, window in self.constraints for end in window)})

    def broken(self, t: float, first: float, last: float) -> np.ndarray:
        """Places that break a constraint which holds on all of [first, last], limits moved outward by the shift."""
        mask = np.zeros(len(self.x), dtype=bool)
        for constraint, window in self.constraints:
            if window[0] <= first and last <= window[1]:
                moved = [constraint.satisfied((self.x + s)[:, None], t) for s in (-self.shift, self.shift)]
                if constraint.outside == (self.shift > 0):  # a smaller obstacle, or a smaller safe set
                    mask |= ~(moved[0] | moved[1]) if constraint.outside else ~(moved[0] & moved[1])
                else:
                    mask |= ~(moved[0] & moved[1]) if constraint.outside else ~(moved[0] | moved[1])
        return mask

    def solved(self) -> float:
        end = self.instants[-1]
        u = self.broken(end, end, end).astype(float)
        for first, last in reversed(list(itertools.pairwise(self.instants))):
            count = max(60, int(self.steps * (last - first) / end))
            times = last - (last - first) * np.concatenate([[0.0], np.geomspace(1e-6, 1.0, count)])
            for after, before in itertools.pairwise(times):
                u = self.step(u, before, after, self.broken(0.5 * (before + after), first, last))
            u = np.where(self.broken(first, first, first), 1.0, u)
        return self.over_start(u)

    def step(self, u: np.ndarray, before: float, after: float, bad: np.ndarray) -> np.ndarray:
        t, dt, x = 0.5 * (before + after), _GAMMA * (after - before), self.x
        drifts = np.array([np.broadcast_to(self.drift(t, x, *corner)[..., 0], x.shape) for corner in self.corners])
        f = drifts[0]
        if len(drifts) > 1:
            f = drifts[np.argmax(drifts * np.gradient(u, x), axis=0), np.arange(len(x))]
        a = np.maximum(np.broadcast_to(self.square(t, x)[..., 0, 0], x.shape), 1e-12)
        q = np.clip(2 * f * self.h / a, -500, 500)
        q = np.where(np.abs(q) < 1e-9, 1e-9, q)
        left = np.maximum(a / (2 * self.h**2) * q / np.expm1(q), 0.0)
        right = np.maximum(left + f / self.h, 0.0)
        left[0] = right[-1] = 0.0
        left, right = np.where(bad, 0.0, left), np.where(bad, 0.0, right)
        bands = -dt * left[1:], 1 + dt * (left + right), -dt * right[:-1]
        u = np.where(bad, 1.0, u)
        stage = dgtsv(*bands, u)[3]
        return np.maximum(dgtsv(*bands, u + (1 / _GAMMA - 1) * (stage - u))[3], 0.0)

    def over_start(self, u: np.ndarray) -> float:
        start = self.problem.initial
        if start.random:
            z = np.linspace(-9, 9, 8001)
            weight = norm.pdf(z) / norm.pdf(z).sum()
            places = start.mean[0] + z * math.sqrt(start.covariance[0, 0])
            return float(np.sum(weight * np.interp(places, self.x, u, left=1.0, right=1.0)))
        around = start.hull()
        return float(np.interp(np.linspace(around.lo[0], around.hi[0], 101), self.x, u).max())
