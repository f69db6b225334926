"""Local constants: contraction and noise bounds that hold along a tube only, and the tubes that they prove.

- Reach (Thm K5): c_k bounds mu_P(D_x f) on p(t) + {||y||_P <= guess_k} over piece k; the radius rho that follows is
  proved on every piece up to the first one where it is not below the guess.
- Tube (Thm K4): a tube r computed from constants of the sets reach + {||y||_P <= guess} is a tube if r <= guess at
  every time. Only trajectory-level tubes survive this (7.7).

Source: Thms K4, K5 (theory).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from certbound.errors import EnclosureError
from certbound.problem.problem import Problem
from certbound.reach.cells import initial_cells
from certbound.reach.contraction import bound_forcing, integrate_radius, jump_sizes
from certbound.reach.curve import Curve
from certbound.reach.flow import Flow
from certbound.reach.nominal import nominal_curve
from certbound.reach.norms import Norm
from certbound.reach.slopes import LocalSlopes
from certbound.reach.tube import ReachTube

__all__ = ["local_contraction_tube"]

Array = NDArray[np.float64]

BLOCK = 16
ITERATIONS = 12
INFLATION = 1.03


def local_contraction_tube(
    problem: Problem | Flow,
    *,
    metric: Array | None = None,
    cells: int | None = None,
    curve: Curve | None = None,
) -> ReachTube:
    """Noise-free reach tube whose contraction rate is bounded along the tube itself (Thm K5).

    Proves: every associated trajectory x from the initial set, under every disturbance, satisfies
    ||x_t - p(t)||_P <= rho_t up to the end of the returned tube, which may come before the horizon (see
    ``ReachTube.end``): the tube stops where no guess of its size confirmed itself.

    Parameters
    ----------
    problem : Problem or Flow
    metric : array_like, shape (n, n), optional
        P; the identity when omitted.
    cells : int, optional
        Parts along each side of the initial set.
    curve : Curve, optional
        The nominal curves, when they are known already.

    Raises
    ------
    EnclosureError
        If not even the first piece is proved.
    ValueError
        If the nominal trajectory cannot be followed.
    """
    flow = problem if isinstance(problem, Flow) else Flow(problem)
    parts = initial_cells(flow.problem, cells)
    if curve is None:
        curve = nominal_curve(flow, parts.centres)
    norm = Norm(flow.dimension, metric)
    march = _March(flow, curve, norm)
    radius = march.run(parts.radii(norm, curve.initial()))
    proved = radius.shape[1]
    if proved == 0:
        raise EnclosureError(
            "the noise-free reach tube could not be proved on its first piece; use more cells of the initial set, "
            "a smaller disturbance, or check where the model is defined."
        )
    return ReachTube(
        curve=curve.until(proved), radius=radius, metric=metric, method="contraction (local rates)"
    )


class _March:
    """Guess and confirm radii, a block of pieces at a time."""

    def __init__(self, flow: Flow, curve: Curve, norm: Norm) -> None:
        self.curve = curve
        self.slopes = LocalSlopes(flow, norm)
        self.eta = bound_forcing(flow, curve, norm)
        self.gaps = jump_sizes(curve, norm)

    def run(self, rho: Array) -> Array:
        """Radii of all pieces that could be proved, shape (B, proved)."""
        blocks: list[Array] = []
        first, size = 0, BLOCK
        slope = self.slopes.bound(self.curve.section(0, 1), rho[:, None])[:, 0]
        while first < self.curve.pieces:
            last = min(first + size, self.curve.pieces)
            result = self._confirm(first, last, rho, slope)
            if result is not None:
                radius, rho, slope = result
                blocks.append(radius)
                first, size = last, min(2 * size, BLOCK)
            elif size == 1:
                break
            else:
                size = max(1, size // 4)
        return np.concatenate(blocks, axis=1) if blocks else np.empty((len(rho), 0))

    def _confirm(self, first: int, last: int, rho: Array, slope: Array) -> tuple[Array, Array, Array] | None:
        """Radii over a block that confirm themselves, the radius after it, and its last slope.

        The first guess is what ``slope`` predicts.
        """
        part = self.curve.section(first, last)
        eta, gaps = self.eta[:, first:last], self.gaps[:, first:last]
        slopes = np.broadcast_to(slope[:, None], eta.shape)
        guess = np.zeros(eta.shape)
        for _ in range(ITERATIONS):
            radius, after = integrate_radius(part, gaps, rho, slopes, eta)
            if np.all(radius < guess):
                return radius, after, slopes[:, -1]
            if not np.all(np.isfinite(radius)):
                return None
            guess = np.where(radius < guess, guess, INFLATION * radius + 1e-12)
            slopes = self.slopes.bound(part, guess)
        return None
