"""The law of dX = A X dt + sum_j d_j E_j dt + G dW: what of it a row needs, in balls.

X = mean + starts + disturbances + Z. Z is Gaussian, dV/dt = F(t) M F(t)^T with M = A V_0 + V_0 A^T + G G^T, split into
M = M+ - M- with M+, M- >= 0, so that V = V_0 + V+ - V- where V+ and V- only grow. Without a random start V_0 = 0, M+ =
G G^T, M- = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from flint import arb, arb_mat

from certbound.arrays import Array
from certbound.errors import EngineError
from certbound.gaussian.affine.doubling import Doubling
from certbound.rigor.balls import lower, upper

GAIN, LOSS, MEAN, WIDE = "gain", "loss", "mean", "wide"
_RAISED = 2.0**-40  # of the largest entry, by which both parts of an indefinite source are raised
_NOTHING = 1.0  # the largest entry, in its own units, of what is 0: a stationary start's variance does not change


def transposed_square(columns: arb_mat) -> arb_mat:
    """B B^T."""
    return columns * columns.transpose()


@dataclass(frozen=True, eq=False, kw_only=True)
class AffineLaw:
    """An affine model over [0, horizon]; every matrix is a ball that contains the exact one.

    Parameters
    ----------
    slope : arb_mat
        A, (n, n).
    noise : arb_mat
        G, (n, m).
    horizon : float
    mean : arb_mat
        Middle of the start, (n, 1).
    starts : arb_mat or None
        Generators of a zonotope of starts about it, (n, g).
    covariance : arb_mat or None
        V_0 of a random start.
    disturbances : sequence of arb_mat
        E_j times the disturbance's radius, each (n, 1): it may take any values in [-1, 1] of that.
    """

    slope: arb_mat
    noise: arb_mat
    horizon: float
    mean: arb_mat
    starts: arb_mat | None = None
    covariance: arb_mat | None = None
    disturbances: tuple[arb_mat, ...] = ()

    @property
    def dimension(self) -> int:
        """States."""
        return int(self.slope.nrows())

    @property
    def still(self) -> bool:
        """Whether the mean is 0 at all times."""
        return all(self.mean[i, 0].is_zero() for i in range(self.dimension))

    @property
    def resting(self) -> bool:
        """Whether all but the noise stays at 0."""
        return self.still and self.starts is None and not self.disturbances

    @cached_property
    def parts(self) -> tuple[arb_mat, arb_mat | None]:
        """M+ and M- (None: 0)."""
        gram = transposed_square(self.noise)
        if self.covariance is None:
            return gram, None
        moved = self.slope * self.covariance
        source = moved + moved.transpose() + gram
        n = self.dimension
        middle = np.array([[float(source[i, j].mid()) for j in range(n)] for i in range(n)])
        scale = np.sqrt(np.maximum(np.abs(middle).max(axis=1), 1e-300))
        values, vectors = np.linalg.eigh(middle / scale / scale[:, None])
        raised = np.maximum(-values, 0.0) + _RAISED * np.abs(values).max(initial=_NOTHING)
        root = scale[:, None] * vectors * np.sqrt(raised)
        columns = arb_mat(root.tolist())
        loss = transposed_square(columns)
        gain = source + loss
        if not is_semidefinite(gain, scale):
            raise EngineError("the random start's covariance changes in a way that could not be split.")
        return gain, loss

    @cached_property
    def doubling(self) -> Doubling:
        """F and the Gramians."""
        gain, loss = self.parts
        sources = {GAIN: gain}
        if loss is not None:
            sources[LOSS] = loss
        return Doubling(self.slope, sources | self.pushing, self.horizon)

    @property
    def pushing(self) -> dict[str, arb_mat]:
        """Sources of the Gramians that bound the mean, the starts and the disturbances."""
        sources = {}
        if not self.still:
            sources[MEAN] = transposed_square(self.mean)
        if self.starts is not None:
            sources[WIDE] = transposed_square(self.starts)
        for place, push in enumerate(self.disturbances):
            sources[f"push{place}"] = transposed_square(push)
        return sources


def is_semidefinite(matrix: arb_mat, scale: Array) -> bool:
    """Whether a symmetric matrix is proved positive semidefinite, by Cholesky's factors in units of ``scale``."""
    n = matrix.nrows()
    rows = [[matrix[i, j] / arb(float(scale[i])) / arb(float(scale[j])) for j in range(n)] for i in range(n)]
    for k in range(n):
        pivot = rows[k][k]
        if not pivot > 0:
            return False
        for i in range(k + 1, n):
            factor = rows[i][k] / pivot
            for j in range(k + 1, i + 1):
                rows[i][j] = rows[i][j] - factor * rows[j][k]
    return True


def floats(balls: list[arb]) -> tuple[Array, Array]:
    """Lower and upper bounds of balls as floats; infinite where a ball is no number."""
    middle = np.array([float(x.mid()) for x in balls], dtype=float)
    radius = np.array([float(x.rad()) for x in balls], dtype=float)
    slack = radius * (1 + 1e-14) + np.abs(middle) * 2.0**-51 + 2.0**-1022
    slack[[x.is_zero() for x in balls]] = 0.0
    bad = ~(np.isfinite(middle) & np.isfinite(radius))
    return np.where(bad, -np.inf, middle - slack), np.where(bad, np.inf, middle + slack)


def root_up(values: Array) -> Array:
    """Upper bounds of square roots; of nothing below 0."""
    return np.asarray(np.sqrt(np.maximum(values, 0.0)) * (1 + 1e-15) + 1e-300)


__all__ = ["AffineLaw", "floats", "lower", "root_up", "upper"]
