"""The program of some walls in discrete time: V_t(z) = z' H_t z / 2, H linear between some steps.

With a step L (z, p), |p_k| <= |C_k (z, p)| (``secants``), noise of covariance (or proxy) G G' and N = I - G' H+ G > 0,
    E exp(V+) <= exp(y' W y / 2 - log det(N) / 2),   y = L (z, p),   W = H+ + H+ G inv(N) G' H+,
and the program asks that this is at most exp(V) wherever box forms B_i >= 0 hold:
    | H - l e e' - sum mu_i B_i,  0 |
    | 0,                  diag(tau) |  - C' tau C - L' W L >= 0
which is linear in H, H+, l, mu, tau after a Schur complement; l = tr(G' H+ G)/2 + tr(inv(N) - I)/2 is at least
-log det N. V is convex, and at least 0 beyond the walls in a window of last steps. Before it H changes the more slowly
the longer ago. Its largest value at the corners of the starts is minimised, at all steps before the window, as the same
V later serves the windows before. Everything here is in floating point and proves nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array, Integers
from certbound.quadratic.conic import Part, Program, block
from certbound.quadratic.form_matrices import linear_form, side_forms, symmetric_basis
from certbound.quadratic.setting import Setting, Wall
from certbound.quadratic.steps.secants import Secants
from certbound.rigor.intervals import Interval

_DEEPEST = -200.0  # log of the smallest probability that is looked for


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class StepProposal:
    """What the solver found: V at some steps, and the multipliers with which the proof may succeed.

    Attributes
    ----------
    steps : ndarray of int, shape (K,)
        The steps of ``matrices``, from 0 to the last one.
    window : int
        How many last steps V is at least 0 beyond the walls.
    matrices : ndarray, shape (K, n + 1, n + 1)
        H at these, linear between.
    weights : ndarray, shape (K - 1, 2, n + k)
        mu at both ends of each piece between steps.
    scales : ndarray, shape (K - 1, 2, k)
        tau.
    wall_weights : tuple of ndarray, shape (K, forms)
        Of each wall the multipliers of what holds beyond it; 0 before the window.
    """

    steps: Integers
    window: int
    matrices: Array
    weights: Array
    scales: Array
    wall_weights: tuple[Array, ...]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Steps:
    """What the program and the proof know of a problem on a working box.

    ``noise`` are columns G, shape (n + 1, m), in the box's coordinates with GG' no less than the covariance or proxy;
    ``corners`` those of the starts, shape (c, n + 1).
    """

    setting: Setting
    secants: Secants
    noise: Array
    corners: Interval
    horizon: int


def turned(proposal: StepProposal) -> StepProposal:
    """V(t, -xi) with the same multipliers: what it serves where the problem is the same turned about the middle."""
    sign = -np.ones(proposal.matrices.shape[1])
    sign[-1] = 1.0
    return replace(proposal, matrices=proposal.matrices * np.outer(sign, sign))


def beyond(wall: Wall) -> Interval:
    """Forms that are at least 0 where a path that has left through the wall may be."""
    return wall.forms if wall.row is None else linear_form(wall.row).reshape(1, len(wall.row), -1)


def propose_steps(
    given: Steps, walls: Sequence[Wall], steps: Integers, window: int, *, seconds: float
) -> StepProposal | None:
    """What the program proposes for one V that serves the walls; None where the solver failed.

    The window has to begin at one of the steps.
    """
    return _StepProgram(given, walls, steps, window).solve(seconds)


class _StepProgram:
    """The program, and where its variables are."""

    def __init__(self, given: Steps, walls: Sequence[Wall], steps: Integers, window: int) -> None:
        self.given, self.walls, self.steps, self.window = given, walls, steps, window
        self.size = given.setting.dimension + 1
        self.basis = symmetric_basis(self.size)
        self.program = Program()
        self.nodes = [self.program.variables(self.basis.shape[2]) for _ in steps]
        self.level = self.program.variables(1)
        n = self.size - 1
        self.known = np.concatenate([side_forms(-np.ones(n), np.ones(n)), given.setting.inside.mid]).transpose(1, 2, 0)
        joined = given.secants.matrix.mid
        self.moved = np.einsum("ia,ijk,jb->abk", joined, self.basis, joined)
        self.border = np.einsum("ia,ijk,jc->ack", joined, self.basis, given.noise)
        self.own = np.einsum("ia,ijk,jc->ack", given.noise, self.basis, given.noise)

    def solve(self, seconds: float) -> StepProposal | None:
        ends = []
        for k, length in enumerate(np.diff(self.steps).tolist()):
            first = self._step([(k, 1.0)], [(k, 1 - 1 / length), (k + 1, 1 / length)])
            last = first if length == 1 else self._step([(k, 1 / length), (k + 1, 1 - 1 / length)], [(k + 1, 1.0)])
            ends.append((first, last))
        for node in self.nodes:
            state = self.basis[:-1, :-1]
            self.program.semidefinite(block(np.zeros(state.shape[:2]), [state]), node)
        start = int(np.searchsorted(self.steps, self.steps[-1] - self.window + 1))
        walls = [[self._beyond(wall, node) for node in self.nodes[start:]] for wall in self.walls]
        self._objective()
        found = self.program.minimise(int(self.level[0]), seconds=seconds)
        if found is None:
            return None
        weights, scales = (
            np.array([[np.maximum(found[one[part]], 0.0) for one in pair] for pair in ends]) for part in (0, 1)
        )
        beyond_walls = [np.array([np.maximum(found[mu], 0.0) for mu in one]) for one in walls]
        return StepProposal(
            steps=self.steps, window=self.window, matrices=np.array([self.basis @ found[node] for node in self.nodes]),
            weights=weights, scales=scales,
            wall_weights=tuple(np.concatenate([np.zeros((start, one.shape[1])), one]) for one in beyond_walls),
        )  # fmt: skip

    def _step(self, now: list[tuple[int, float]], then: list[tuple[int, float]]) -> tuple[Integers, Integers]:
        """State the inequality for H and H+ as sums of nodes: the places of mu and tau."""
        program, noise = self.program, self.given.noise
        size, k, m = self.size, len(self.given.secants.rows), noise.shape[1]
        log, whole = self._log_determinant(then), size + k + m
        rows, places = self.given.secants.rows.mid, np.arange(size, size + k)
        sector = _placed(-np.einsum("ka,kb->abk", rows, rows), whole)
        sector[places, places, np.arange(k)] += 1.0
        corner = np.zeros((whole, whole, 1))
        corner[size - 1, size - 1] = 1.0
        part = np.zeros((whole, whole, self.basis.shape[2]))
        part[: size + k, : size + k] = -self.moved
        part[: size + k, size + k :] = self.border
        part[size + k :, : size + k] = self.border.transpose(1, 0, 2)
        part[size + k :, size + k :] = -self.own
        weights, scales = program.nonnegative(self.known.shape[2]), program.nonnegative(k)
        maps = [_placed(factor * self.basis, whole) for _, factor in now] + [factor * part for _, factor in then]
        maps += [_placed(-self.known, whole), sector, -corner]
        columns = [*(self.nodes[place] for place, _ in (*now, *then)), weights, scales, log]
        constant = np.zeros((whole, whole))
        constant[size + k :, size + k :] = np.eye(m)
        program.semidefinite(block(constant, maps), np.concatenate(columns))
        return weights, scales

    def _log_determinant(self, then: list[tuple[int, float]]) -> Integers:
        """A variable that is at least tr(G' H+ G)/2 + tr(inv(N) - I)/2."""
        program, m = self.program, self.given.noise.shape[1]
        basis = symmetric_basis(m)
        inverse, log = program.variables(basis.shape[2]), program.variables(1)
        maps, columns, constant = [_placed(basis, 2 * m)], [inverse], np.zeros((2 * m, 2 * m))
        constant[:m, m:] = constant[m:, :m] = constant[m:, m:] = np.eye(m)
        parts = [Part(np.eye(1), log), Part(-np.trace(basis)[None] / 2, inverse)]
        for place, factor in then:
            part = np.zeros((2 * m, 2 * m, self.basis.shape[2]))
            part[m:, m:] = -factor * self.own
            maps.append(part)
            columns.append(self.nodes[place])
            parts.append(Part(-factor * np.trace(self.own)[None] / 2, self.nodes[place]))
        program.semidefinite(block(constant, maps), np.concatenate(columns))
        program.at_least(np.array([m / 2]), parts)
        return log

    def _beyond(self, wall: Wall, node: Integers) -> Integers:
        """V >= 0 beyond a wall: the places of the multipliers."""
        forms = beyond(wall).mid.transpose(1, 2, 0)
        weights = self.program.nonnegative(forms.shape[2])
        stated = block(np.zeros((self.size, self.size)), [self.basis / 2, -forms])
        self.program.semidefinite(stated, np.concatenate([node, weights]))
        return weights

    def _objective(self) -> None:
        corners = self.given.corners.mid
        value = -np.einsum("ca,abk,cb->ck", corners, self.basis, corners) / 2
        above = Part(np.ones((len(corners), 1)), self.level)
        for step, node in zip(self.steps, self.nodes):
            if step <= max(self.steps[-1] - self.window, 0):
                self.program.at_least(np.zeros(len(corners)), [above, Part(value, node)])
        self.program.at_least(np.array([-_DEEPEST]), [Part(np.eye(1), self.level)])


def _placed(maps: Array, size: int) -> Array:
    """Maps to matrices in the upper left of larger ones."""
    larger = np.zeros((size, size, maps.shape[2]))
    larger[: maps.shape[0], : maps.shape[1]] = maps
    return larger
