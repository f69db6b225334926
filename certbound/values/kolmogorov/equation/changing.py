"""The backward equation in floats where its coefficients change, with time or as the worst disturbance does.

A W-method of third order, whose Jacobian may be any: that of an earlier step serves as long as what has changed since
moves nothing by more than a cell within a step. This is the stiffly accurate one of Rang and Angermann (2005,
ROS34PW2). Nothing here is trusted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse as sp

from certbound.arrays import Array, Mask
from certbound.values.kolmogorov.equation.solve import (
    CENTRAL,
    NOISE,
    Discretised,
    Source,
    banded,
    difference,
    discretised,
    upwind,
)

_G = 0.435866521508459
_ACCURATE = (
    [[0, 0, 0, 0], [0.87173304301691801, 0, 0, 0], [0.84457060015369423, -0.11299064236484185, 0, 0], [0, 0, 1, 0]],
    [[_G, 0, 0, 0], [-0.87173304301691801, _G, 0, 0], [-0.90338057013044082, 0.054180672388095326, _G, 0],
     [0.24212380706095346, -1.2232505839045147, 0.54526025533510214, _G]],
    [0.24212380706095346, -1.2232505839045147, 1.5452602553351020, _G],
)  # fmt: skip
"""Coefficients alpha and gamma of the stages, and the weights."""

_STALE = 0.5  # cells that the change of the drift since the Jacobian may lead within a step

_LARGEST, _FILL = 3e7, 150.0  # nonzeros of the factors that are kept for the next pass, and of one for each node

Coefficients = Callable[[float], tuple[Array, Array]]
"""Of a time: f and a at the nodes, shapes (n, ...) and (n, n, ...)."""


class ChangingEquation:
    """u_t + L(t) u - rate u + s = 0 on the nodes of a tensor grid; `now` says what L is.

    Parameters
    ----------
    nodes : sequence of ndarray
    dead : ndarray of bool
        Nodes whose values are given.
    rate : ndarray
        Soft killing.
    noisy : sequence of bool
        Whether noise moves a coordinate.
    more : sparse array, shape (size, size), optional
        What L has besides.
    """

    def __init__(
        self, nodes: Sequence[Array], dead: Mask, rate: Array, noisy: Sequence[bool], more: sp.csr_array | None = None
    ) -> None:  # fmt: skip
        self.nodes, self.shape, self.live = list(nodes), dead.shape, ~dead
        self.dead, self.rate, self.more = dead, rate * self.live, more
        self.first = [tuple(map(banded, upwind(line, one))) for line, one in zip(nodes, noisy)]
        self.second = [banded(difference(line, NOISE if len(nodes) < 3 else NOISE[-1:], 2)) for line in nodes]
        self.central = [banded(difference(line, CENTRAL, 1)) for line in nodes]
        self.coefficients: Coefficients | None = None
        self.time = 0.0
        self.frozen: tuple[Discretised, Array, Array] | None = None
        self.kept: dict[float, tuple[Discretised, Array, Array]] = {}
        self.known: dict[float, tuple[Array, Array]] = {}
        self.method = _in_solves(*map(np.array, _ACCURATE))
        gaps = [np.minimum(np.append(np.diff(line), np.inf), np.append(np.inf, np.diff(line))) for line in nodes]
        self.gaps = [gap.reshape([-1 if k == i else 1 for k in range(len(nodes))]) for i, gap in enumerate(gaps)]

    def now(self, time: float, coefficients: Coefficients) -> None:
        """Set the time and the coefficients, as functions of it."""
        self.time, self.coefficients = time, coefficients
        self.known = {}

    def at(self, time: float) -> tuple[Array, Array]:
        """Coefficients at a time."""
        if time not in self.known:
            assert self.coefficients is not None
            self.known[time] = self.coefficients(time)
        return self.known[time]

    def speed(self, values: Array, source: Array | float = 0.0, given: Array | float = 0.0, part: float = 0.0) -> Array:
        """-u_t: L u and the source at live nodes, what is given at the others; ``part`` is time that has passed."""
        flow, spread = self.at(self.time - part)
        total = source - self.rate * values
        if self.more is not None:
            total = total + (self.more @ values.ravel()).reshape(self.shape)
        for i, (ahead, behind) in enumerate(self.first):
            if flow[i].any():
                total = total + np.maximum(flow[i], 0) * ahead.along(values, i)
                total += np.minimum(flow[i], 0) * behind.along(values, i)
            if spread[i, i].any():
                total = total + spread[i, i] / 2 * self.second[i].along(values, i)
            for j in range(i):
                if spread[i, j].any():
                    total = total + spread[i, j] * self.central[i].along(self.central[j].along(values, j), i)
        return np.where(self.live, total, given)

    def solve(self, share: float, values: Array) -> Array:
        """About (1 - share L)^-1 values."""
        return self._jacobian(share / _G).solve(share, values)

    def adjoint(self, share: float, values: Array) -> Array:
        """About the same with the transposed matrix."""
        return self._jacobian(share / _G).adjoint(share, values)

    def _jacobian(self, step: float) -> Discretised:
        """Of this time, or of another one that is as good."""
        flow, spread = self.at(self.time)
        if self.frozen is not None:
            _, f, a = self.frozen
            moved = sum(np.abs(flow[i] - f[i]) / gap + np.abs(spread[i, i] - a[i, i]) / gap**2
                        for i, gap in enumerate(self.gaps))  # fmt: skip
            if step * float(np.max(moved * self.live)) <= _STALE:
                return self.frozen[0]
        if self.time in self.kept:  # an earlier pass needed it
            self.frozen = self.kept[self.time]
            return self.frozen[0]
        new = discretised(self.nodes, flow, spread, self.dead, self.rate, more=self.more)
        self.frozen = (new, flow, spread)
        if len(self.kept) * _FILL * flow[0].size < _LARGEST:
            self.kept[self.time] = self.frozen
        return new

    def step(self, values: Array, step: float, source: Source, given: Source) -> Array:
        """One step backward in time."""
        stage, mixed, weights, shares = self.method
        stages: list[Array] = []
        jacobian = self._jacobian(step)
        for i in range(4):
            place = values
            for j in range(i):
                place = place + stage[i, j] * stages[j]
            part = float(shares[i])
            right = self.speed(place, source(part), given(part), step * part)
            for j in range(i):
                right = right + mixed[i, j] / step * stages[j]
            stages.append(jacobian.solve(step * _G, step * _G * right))
        return np.asarray(values + sum(weight * one for weight, one in zip(weights, stages)))


def _in_solves(alpha: Array, gamma: Array, beta: Array) -> tuple[Array, Array, Array, Array]:
    """Stage matrix, mixing matrix and weights for stages (1 - h gamma_ii J)^-1 (...), and their shares of the step."""
    diagonal = gamma[0, 0]
    inverse = np.linalg.inv(gamma)
    return alpha @ inverse, np.eye(4) / diagonal - inverse, beta @ inverse, alpha.sum(axis=1)
