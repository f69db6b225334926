"""The energy of the averaged moment generating function (Def. 5 and Lemma 2 of the paper).

Phi_{n,lam}(x) = E exp(lam <l, x>) over l uniform on the unit sphere = 0F1(; n/2; (lam ||x||)^2/4), which is
cosh(lam x) for n = 1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.tubes.excess import log_excess


def log_energy(x: ArrayLike, rate: float) -> Any:
    """log Phi_{n,lam}(x) for vectors x and lam = ``rate``, at any size, in floating point.

    It depends on ||x|| only, rises with it, is at least (n/2) log(1 - e^2) + e lam ||x|| for every e in (0, 1), and
    for a sub-Gaussian w with proxy variance s^2 obeys E Phi(x + w) <= exp(lam^2 s^2/2) Phi(x) (Lemma 2 of the paper).

    Parameters
    ----------
    x : array_like, shape (..., n)
    rate : float
        lam, in 1 over the unit of ``x``.

    Raises
    ------
    ValueError
        If ``x`` has no axis, or a value is not finite.

    Examples
    --------
    >>> bool(abs(log_energy([2.0], 3.0) - np.log(np.cosh(6.0))) < 1e-12)
    True
    """
    vectors = np.asarray(x, dtype=float)
    if vectors.ndim == 0 or not np.all(np.isfinite(vectors)) or not np.isfinite(rate):
        raise ValueError("`x` must be finite, of shape (..., n), and `rate` finite; a scalar is [x].")
    size = np.linalg.norm(vectors, axis=-1) * abs(rate)
    excess, _ = log_excess(np.ones_like(size), vectors.shape[-1] / 2, size**2 / 4, bessel=True)
    result = np.logaddexp(0.0, excess)
    return float(result) if result.ndim == 0 else result
