"""Noise of discrete-time systems: zero-mean laws, independent from step to step, given by name.

A level is never a bare number: standard deviation, variance and covariance are different things, and so are a
law's covariance and a variance proxy. A matrix S is a **variance proxy** of w when
E exp(l.w) <= exp(l' S l / 2) for every vector l, conditionally on the past.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certbound.checks import frozen, positive_definite, vector

__all__ = ["Bounded", "Gaussian", "Law", "Rademacher", "SubGaussian", "Uniform", "check_law"]

Array = NDArray[np.float64]


class Law:
    """What every law offers; sizes are known once ``resolve`` has been called (systems do so)."""

    name = "law"
    gaussian = False
    levels: tuple[str, ...] = ()

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        if args:
            levels = " or ".join(f"{level}=" for level in cls.levels)
            raise TypeError(f"{cls.__name__} takes no bare value, got {args[0]!r}; say {levels}.")
        return super().__new__(cls)

    def resolve(self, dimension: int) -> Law:
        """The same law for noise of ``dimension`` entries: numbers become vectors."""
        raise NotImplementedError

    @property
    def dimension(self) -> int:
        """Number of entries of the noise."""
        return len(self.proxy)

    @property
    def proxy(self) -> Array:
        """Variance proxy, shape (m, m), rounded up on its diagonal."""
        raise NotImplementedError

    @property
    def bound(self) -> Array | None:
        """Almost-sure bounds of the entries' absolute values, shape (m,), or None."""
        return None

    def sample(self, rng: np.random.Generator, size: int | tuple[int, ...]) -> Array:
        """Independent draws, shape (*size, m)."""
        raise NotImplementedError


def _square_up(value: Array) -> Array:
    """Squares of floats, rounded up."""
    squares = [float(x) * float(x) for x in value]
    exact = [Fraction(float(x)) ** 2 for x in value]
    return frozen([s if Fraction(s) >= e else np.nextafter(s, np.inf) for s, e in zip(squares, exact)])


def _level(name: str, value: ArrayLike) -> Array:
    level = vector(name, value)
    if np.any(level < 0):
        raise ValueError(f"`{name}` must not be negative, got {level.tolist()}.")
    return level


def _broadcast(name: str, level: Array, dimension: int) -> Array:
    if len(level) not in (1, dimension):
        raise ValueError(f"`{name}` must be a number or {dimension} numbers, got {len(level)}.")
    return frozen(np.broadcast_to(level, (dimension,)))


def _one_of(law: Law, levels: tuple[str, ...]) -> str:
    given = [level for level in levels if getattr(law, level) is not None]
    if len(given) != 1:
        ways = ", ".join(f"{level}=" for level in levels)
        raise ValueError(f"{type(law).__name__} needs exactly one of {ways}; got {given or 'none'}.")
    return given[0]


class _Quadratic(Law):
    """A law given by a standard deviation, a variance or a covariance (or proxies of these)."""

    def __post_init__(self) -> None:
        kind = _one_of(self, self.levels)
        value = getattr(self, kind)
        if kind.endswith("covariance"):
            object.__setattr__(self, kind, positive_definite(kind, value, strict=False))
            return
        if np.ndim(value) > 1:
            raise ValueError(f"`{kind}` must be a number or a vector; a matrix is a {self.levels[2]}=.")
        object.__setattr__(self, kind, _level(kind, value))

    def resolve(self, dimension: int) -> Self:
        kind = _one_of(self, self.levels)
        value = getattr(self, kind)
        if kind.endswith("covariance"):
            if len(value) != dimension:
                size = f"{len(value)} x {len(value)}"
                raise ValueError(f"`{kind}` must be {dimension} x {dimension}, got {size}.")
            return self
        return type(self)(**{kind: _broadcast(kind, value, dimension)})

    @property
    def proxy(self) -> Array:
        kind = _one_of(self, self.levels)
        value: Array = getattr(self, kind)
        if kind.endswith("covariance"):
            return value
        return frozen(np.diag(_square_up(value) if kind.endswith("std") else value))


@dataclass(frozen=True, eq=False, kw_only=True)
class Gaussian(_Quadratic):
    """Normal noise; exactly one of the three levels.

    Parameters
    ----------
    std, variance : float or array_like, shape (m,)
        Standard deviation or variance of independent entries; a number holds for each.
    covariance : array_like, shape (m, m)
        Positive semidefinite.

    Examples
    --------
    >>> Gaussian(std=0.5).resolve(2).proxy
    array([[0.25, 0.  ],
           [0.  , 0.25]])
    """

    std: Any = None
    variance: Any = None
    covariance: Any = None

    name = "gaussian"
    gaussian = True
    levels = ("std", "variance", "covariance")

    def sample(self, rng: np.random.Generator, size: int | tuple[int, ...]) -> Array:
        return _normal(rng, size, self.factor)

    @property
    def factor(self) -> Array:
        """A matrix F with F F' equal to the covariance, up to rounding."""
        kind = _one_of(self, self.levels)
        if kind == "covariance":
            values, vectors = np.linalg.eigh(self.covariance)
            return frozen(vectors * np.sqrt(np.maximum(values, 0.0)))
        return frozen(np.diag(self.std if kind == "std" else np.sqrt(self.variance)))


def _normal(rng: np.random.Generator, size: int | tuple[int, ...], factor: Array) -> Array:
    shape = (size,) if isinstance(size, int) else tuple(size)
    return np.asarray(rng.standard_normal((*shape, len(factor))) @ factor.T)


@dataclass(frozen=True, eq=False, kw_only=True)
class SubGaussian(_Quadratic):
    """Any noise with the given variance proxy, conditionally on the past; it cannot be simulated.

    Parameters
    ----------
    proxy_std, proxy_variance : float or array_like, shape (m,)
        Proxy (its root) of the entries, whose moment generating functions multiply; a number holds for each.
    proxy_covariance : array_like, shape (m, m)
        Positive semidefinite S with E exp(l.w) <= exp(l' S l / 2).
    """

    proxy_std: Any = None
    proxy_variance: Any = None
    proxy_covariance: Any = None

    name = "subgaussian"
    levels = ("proxy_std", "proxy_variance", "proxy_covariance")

    def sample(self, rng: np.random.Generator, size: int | tuple[int, ...]) -> Array:
        raise ValueError(
            "noise that is only known to be sub-Gaussian cannot be simulated; give a law (cb.Gaussian, "
            "cb.Uniform, cb.Rademacher or cb.Bounded) to sample from."
        )


class _Box(Law):
    """Noise in a box around 0."""

    _level_name = "halfwidth"

    def __post_init__(self) -> None:
        value = getattr(self, self._level_name)
        object.__setattr__(self, self._level_name, _level(self._level_name, value))

    def resolve(self, dimension: int) -> Self:
        value = _broadcast(self._level_name, getattr(self, self._level_name), dimension)
        return type(self)(**(self._options() | {self._level_name: value}))

    def _options(self) -> dict[str, Any]:
        return {}

    @property
    def proxy(self) -> Array:
        return frozen(np.diag(_square_up(getattr(self, self._level_name))))

    @property
    def bound(self) -> Array:
        value: Array = getattr(self, self._level_name)
        return value


@dataclass(frozen=True, eq=False, kw_only=True)
class Uniform(_Box):
    """Independent entries, uniform on [-h_i, h_i]; proxy h_i^2 / 3, the variance (sinh(x)/x <= exp(x^2/6)).

    Parameters
    ----------
    halfwidth : float or array_like, shape (m,)
        h, not negative; a number holds for each entry.
    """

    halfwidth: Any

    name = "uniform"
    levels = ("halfwidth",)

    @property
    def proxy(self) -> Array:
        return frozen(np.diag(np.nextafter(_square_up(self.halfwidth) / 3.0, np.inf)) * (self.halfwidth > 0))

    def sample(self, rng: np.random.Generator, size: int | tuple[int, ...]) -> Array:
        shape = (size,) if isinstance(size, int) else tuple(size)
        return np.asarray(rng.uniform(-1.0, 1.0, (*shape, len(self.halfwidth))) * self.halfwidth)


@dataclass(frozen=True, eq=False, kw_only=True)
class Rademacher(_Box):
    """Independent entries, +s_i or -s_i with probability 1/2 each; proxy s_i^2 (cosh(x) <= exp(x^2/2)).

    Parameters
    ----------
    scale : float or array_like, shape (m,)
        s, not negative; a number holds for each entry.
    """

    scale: Any

    name = "rademacher"
    levels = ("scale",)
    _level_name = "scale"

    def sample(self, rng: np.random.Generator, size: int | tuple[int, ...]) -> Array:
        return _signs(rng, size, self.scale)


def _signs(rng: np.random.Generator, size: int | tuple[int, ...], scale: Array) -> Array:
    shape = (size,) if isinstance(size, int) else tuple(size)
    return np.asarray((2.0 * rng.integers(0, 2, (*shape, len(scale))) - 1.0) * scale)


@dataclass(frozen=True, eq=False, kw_only=True)
class Bounded(_Box):
    """Any zero-mean noise with |w_i| <= h_i, conditionally on the past (Hoeffding's lemma).

    The proxy is diag(h_i^2) for entries independent of each other, and (sum of h_i^2) I otherwise. Sampling
    draws independent signs times h, the law of largest variance in the class.

    Parameters
    ----------
    halfwidth : float or array_like, shape (m,)
        h, not negative; a number holds for each entry.
    independent : bool
        Whether the entries of one step are independent of each other.
    """

    halfwidth: Any
    independent: bool = True

    name = "bounded"
    levels = ("halfwidth",)

    def _options(self) -> dict[str, Any]:
        return {"independent": self.independent}

    @property
    def proxy(self) -> Array:
        squares = _square_up(self.halfwidth)
        if self.independent:
            return frozen(np.diag(squares))
        total = sum(Fraction(float(s)) for s in squares)
        rounded = float(total)
        rounded = rounded if Fraction(rounded) >= total else float(np.nextafter(rounded, np.inf))
        return frozen(rounded * np.eye(len(squares)))

    def sample(self, rng: np.random.Generator, size: int | tuple[int, ...]) -> Array:
        return _signs(rng, size, self.halfwidth)


def check_law(law: Law, task: str) -> None:
    """Refuse a law that is not exactly one of this module's: a class made from one of them may draw otherwise.

    Raises
    ------
    TypeError
        If the law is of any other class, a subclass included; ``task`` says what it was wanted for.
    """
    known = (Gaussian, Uniform, Rademacher, Bounded, SubGaussian)
    if type(law) not in known:
        names = ", ".join(f"cb.{one.__name__}" for one in known)
        raise TypeError(
            f"`noise` must be exactly one of {names} to {task}, got the class {type(law).__name__}: what it draws is "
            "not known; state what it keeps by cb.Bounded(halfwidth=...) or cb.SubGaussian(proxy_std=...)."
        )
