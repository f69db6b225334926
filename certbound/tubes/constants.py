"""The record of constants that every tube formula reads (symbols: c, L, sigma, nu, P of docs/theory.md)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.display import Shown, plain, span_text
from certbound.rigor.norms import Norm


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Proof:
    """What the rigorous recheck established; built by ``certbound.constants`` alone, never by a user."""

    sampled: float  # largest value of the bounded quantity that sampling found: no valid constant lies below it
    boxes: int  # number of boxes that the branch and bound proved
    status: str  # what proposed the metric: ``closed form`` or the status of the solver
    domain: str  # where the constants hold, in words
    fingerprint: str  # ``Constants.fingerprint`` of what was proved: altered constants are no longer certified


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Constants(Shown):
    """Bounds on a system's contraction and noise: mu_P(D_x f) <= rate (CT) or ||D_x f||_P <= gain (DT).

    Constants that a user states are an assumption: ``certified`` is False on them, and every verdict built on
    them says so.

    Parameters
    ----------
    sigma : float or array_like
        Noise level in the metric: g g^T <= sigma^2 P^-1 (CT), variance proxy of the noise (DT, measured in the
        metric of the next step).
    dimension : int
        State dimension n.
    rate, gain : float or array_like, optional
        Exactly one: matrix measure bound c in 1/s (continuous time) or Lipschitz bound L > 0 per step (discrete
        time); an array holds one value per piece of ``times``.
    effective_dimension : float, optional
        nu with tr(P g g^T) <= nu sigma^2 at every time and state; ``dimension`` when omitted.
    metric : array_like, shape (n, n), optional
        P of the norm sqrt(x^T P x); the identity when omitted.
    isotropic : bool
        Asserts P^{1/2} g = sigma I (CT), Gaussian noise with covariance sigma^2 P^-1 (DT), exactly.
    gaussian : bool
        Asserts that the noise of a discrete-time system is Gaussian (implied by ``isotropic``; a Wiener process
        always is).
    times : array_like, optional
        Piece ends, one entry more than the per-piece values, which hold on [times[k], times[k+1]).
    noise_bound : float or array_like, optional
        Almost-sure bound of ||w_t|| in the metric of the next step (discrete time): every tube is then cut by the
        almost-sure bound, pointwise.
    proof : Proof, optional
        How they were proved, of constants that certbound found; None: stated.

    Source: Assumptions 1-3 (paper), with E4 and Sec. 7.2-7.3 of docs/theory.md.
    """

    sigma: float | Array
    dimension: int
    rate: float | Array | None = None
    gain: float | Array | None = None
    effective_dimension: float | None = None
    metric: Array | None = None
    isotropic: bool = False
    gaussian: bool = False
    times: Array | None = None
    noise_bound: float | Array | None = None
    proof: Proof | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if (self.rate is None) == (self.gain is None):
            raise ValueError("give exactly one of `rate` (continuous time) and `gain` (discrete time).")
        if int(self.dimension) != self.dimension or self.dimension < 1:
            raise ValueError(f"`dimension` must be a positive integer, got {self.dimension}.")
        name = "rate" if self.gain is None else "gain"
        times = None if self.times is None else np.asarray(self.times, dtype=float)
        for field_name in (name, "sigma"):
            value = _values(field_name, getattr(self, field_name), times)
            object.__setattr__(self, field_name, value)
        if self.noise_bound is not None:
            if self.gain is None or self.gaussian or self.isotropic:
                raise ValueError("`noise_bound` is for discrete-time noise that is not Gaussian; leave it out.")
            object.__setattr__(self, "noise_bound", _values("noise_bound", self.noise_bound, times))
            if np.any(np.asarray(self.noise_bound) < 0):
                raise ValueError(f"`noise_bound` must not be negative, got {self.noise_bound}.")
        if np.any(np.asarray(self.sigma) < 0):
            raise ValueError(f"`sigma` must not be negative, got {self.sigma}.")
        if self.gain is not None and np.any(np.asarray(self.gain) <= 0):
            raise ValueError(f"`gain` must be positive (replace 0 by any small positive bound), got {self.gain}.")
        if times is not None:
            if times.ndim != 1 or len(times) < 2 or times[0] != 0 or np.any(np.diff(times) <= 0):
                raise ValueError("`times` must rise strictly from 0 and have at least two entries.")
            object.__setattr__(self, "times", _read_only(times))
        nu = float(self.dimension) if self.effective_dimension is None else float(self.effective_dimension)
        if not 0 < nu <= self.dimension:
            raise ValueError(f"`effective_dimension` must lie in (0, {self.dimension}], got {nu}.")
        object.__setattr__(self, "effective_dimension", nu)
        if self.metric is not None:
            object.__setattr__(self, "metric", _read_only(_checked_metric(self.metric, self.dimension)))
        if self.isotropic:
            object.__setattr__(self, "gaussian", True)
            if nu != self.dimension:
                raise ValueError(f"`isotropic` noise has effective dimension {self.dimension}, got {nu}.")

    @property
    def continuous(self) -> bool:
        """True for a rate (continuous time), False for a gain (discrete time)."""
        return self.rate is not None

    @property
    def slope(self) -> float | Array:
        """The rate (CT) or the gain (DT)."""
        value = self.gain if self.rate is None else self.rate
        assert value is not None
        return value

    @property
    def worst_slope(self) -> float:
        """The largest of it."""
        return float(np.max(np.asarray(self.slope)))

    @property
    def matrix(self) -> Array:
        """P, the identity where none is stated."""
        return np.eye(self.dimension) if self.metric is None else self.metric

    @property
    def inverse(self) -> Array:
        """P^-1 in floating point: for proposals, not for proofs."""
        return np.asarray(np.linalg.inv(self.matrix))

    @cached_property
    def norm(self) -> Norm:
        """The norm of P, with a root that is proved once.

        Raises
        ------
        SolverError
            If P is too ill-conditioned for that.
        """
        return Norm(self.dimension, self.metric)

    @property
    def nu(self) -> float:
        """Effective dimension as a float."""
        assert self.effective_dimension is not None
        return self.effective_dimension

    @property
    def certified(self) -> bool:
        """True only for constants that the rigorous recheck returned."""
        return self.proof is not None and self.proof.fingerprint == self.fingerprint

    @property
    def fingerprint(self) -> str:
        """Digest of every number that a proof speaks of."""
        digest = hashlib.sha256()
        for name in _PROVED:
            value = getattr(self, name)
            content = b"" if value is None else np.asarray(value, dtype=np.float64).tobytes()
            digest.update(f"{name}:{len(content)}:".encode() + content)
        return digest.hexdigest()

    def summary(self) -> str:
        """The constants in one line."""
        name, unit = ("rate", "1/s") if self.continuous else ("gain", "per step")
        origin = "certified" if self.certified else "stated"
        value = span_text(self.slope)
        states = "1 state" if self.dimension == 1 else f"{self.dimension} states"
        return f"{name} {value} {unit}, sigma {span_text(self.sigma)}, {states}, {origin}"

    def rows(self) -> list[tuple[str, str]]:
        """Effective dimension, metric, and what the constants rest on."""
        found = [("effective dimension", f"{self.nu:.4g} of {self.dimension}")]
        found.append(("metric", "identity" if self.metric is None else f"{self.dimension} x {self.dimension} matrix"))
        found += [] if self.times is None else [("pieces of time", str(len(self.times) - 1))]
        if self.proof is not None and self.certified:
            found += [("holds on", self.proof.domain), ("above what sampling found", f"{self.gap:.3g}")]
        return found

    def to_dict(self) -> dict[str, Any]:
        """Every field as plain data, with ``certified``, ``gap`` and ``domain`` (where it is proved)."""
        found = {name: plain(getattr(self, name)) for name in _PROVED}
        domain = None if self.proof is None else self.proof.domain
        return found | {"certified": self.certified, "gap": self.gap, "domain": domain}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Constants:
        """Constants from ``to_dict``'s data, as stated ones: only proving them again certifies them.

        Raises
        ------
        ValueError
            If an entry is missing or malformed.
        """
        missing = [name for name in ("sigma", "dimension") if data.get(name) is None]
        if missing:
            raise ValueError(f"`data` must have {missing[0]}, got {', '.join(data) or 'nothing'}.")
        return cls(**{name: data[name] for name in _PROVED if data.get(name) is not None})

    def with_full_dimension(self) -> Constants:
        """The same constants with nu = n, which a smaller nu implies: a proof goes on to vouch for them."""
        return self._weakened(replace(self, effective_dimension=float(self.dimension), proof=None))

    def with_fewer_pieces(self, count: int) -> Constants:
        """The same constants on at most ``count`` pieces, at the largest values of those that are joined.

        Larger values are implied, so that a proof goes on to vouch for them.
        """
        pieces = 0 if self.times is None else len(self.times) - 1
        if self.times is None or pieces <= count:
            return self
        edges = np.unique(np.linspace(0, pieces, count + 1).astype(int))

        def largest(values: float | Array) -> Array:
            return np.asarray(np.maximum.reduceat(np.broadcast_to(values, pieces), edges[:-1]))

        sigma = largest(self.sigma)
        same = np.array_equal(np.repeat(sigma, np.diff(edges)), np.broadcast_to(self.sigma, pieces))
        joined = replace(
            self,
            times=self.times[edges],
            rate=None if self.rate is None else largest(self.rate),
            gain=None if self.gain is None else largest(self.gain),
            sigma=sigma,
            noise_bound=None if self.noise_bound is None else largest(self.noise_bound),
            isotropic=self.isotropic and same,
            proof=None,
        )
        return self._weakened(joined)

    def _weakened(self, weaker: Constants) -> Constants:
        """``weaker`` with this record's proof, for constants that this record's imply."""
        if self.proof is None or not self.certified:
            return weaker
        return replace(weaker, proof=replace(self.proof, fingerprint=weaker.fingerprint))

    @property
    def gap(self) -> float | None:
        """Certified minus sampled value of the rate or gain; None for stated constants."""
        if self.proof is None or not self.certified:
            return None
        return self.worst_slope - self.proof.sampled


_PROVED = (
    "rate",
    "gain",
    "sigma",
    "dimension",
    "effective_dimension",
    "metric",
    "isotropic",
    "gaussian",
    "times",
    "noise_bound",
)


def _read_only(array: Array) -> Array:
    copy: Array = np.array(array, dtype=float)
    copy.setflags(write=False)
    return copy


def _values(name: str, value: ArrayLike | None, times: Array | None) -> float | Array:
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise TypeError(f"`{name}` must hold numbers, got {value!r}.") from error
    if not np.all(np.isfinite(array)):
        raise ValueError(f"`{name}` must be finite, got {value!r}.")
    if array.ndim == 0:
        return float(array)
    if times is None or array.ndim != 1 or len(array) != len(times) - 1:
        expected = "a number, or an array together with `times`" if times is None else f"{len(times) - 1} values"
        raise ValueError(f"`{name}` must be {expected}, got shape {array.shape}.")
    return _read_only(array)


def _checked_metric(metric: ArrayLike, dimension: int) -> Array:
    matrix: Array = np.asarray(metric, dtype=float)
    if matrix.shape != (dimension, dimension):
        raise ValueError(f"`metric` must have shape ({dimension}, {dimension}), got {matrix.shape}.")
    if not np.all(np.isfinite(matrix)):
        raise ValueError("`metric` must be finite.")
    if not np.allclose(matrix, matrix.T, rtol=1e-12, atol=0):
        raise ValueError("`metric` must be symmetric; use (P + P.T) / 2.")
    matrix = (matrix + matrix.T) / 2
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    if smallest <= 0:
        raise ValueError(f"`metric` must be positive definite, its smallest eigenvalue is {smallest:.3g}.")
    return matrix


def check_delta(delta: float) -> float:
    """``delta`` as a float in (0, 1)."""
    value = float(delta)
    if not 0 < value < 1:
        raise ValueError(f"`delta` must lie in (0, 1), got {delta}.")
    return value
