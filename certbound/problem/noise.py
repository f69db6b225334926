"""Noise of discrete-time systems: zero-mean laws, independent from step to step, given by name.

A level is never a bare number: standard deviation, variance and covariance are different things, and so are a
law's covariance and a variance proxy. A matrix S is a **variance proxy** of w when
E exp(l.w) <= exp(l' S l / 2) for every vector l, conditionally on the past.

A law carries all that the package asks of it (see `Law`), so that a new one is a class, here or in a user's module,
and a row in the checker's table (``certbound/checker/statement/laws.py``), which trusts nothing that is said here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from certbound.arrays import Array
from certbound.checks import frozen, positive_definite, vector
from certbound.rigor.intervals import Interval, sq

LAWS: dict[str, type[Law]] = {}
"""Every law that has a name, by its name; a class enters when it is defined."""

_VARIATES: dict[str, Callable[[np.random.Generator, tuple[int, ...]], NDArray[Any]]] = {
    "normal": lambda rng, shape: rng.standard_normal(shape),
    "uniform": lambda rng, shape: rng.uniform(-1.0, 1.0, shape),
    "sign": lambda rng, shape: 2.0 * rng.integers(0, 2, shape) - 1.0,
}
"""The variates that everything is drawn from; compiled kernels draw the same ones."""


class Law:
    """What a law carries. A new one is a dataclass that derives from this class (or from `BoxLaw`).

    Sizes are known once ``resolve`` has been called (systems do so). What a law is and how it is drawn (``name``,
    ``variate``, ``unit``, ``gaussian``, ``uniform``) is stated by each class itself and never inherited: a class made
    from another may draw otherwise.
    """

    name = ""  # in problem files and certificates; a law without one is neither simulated nor written
    levels: tuple[str, ...] = ()  # the fields of which one is given: a matrix if it ends with "covariance", or a vector
    flags: tuple[str, ...] = ()  # further fields, true or false
    tables: tuple[str, ...] = ()  # further fields, each a list of numbers
    variate = ""  # what it is drawn from: "normal", "uniform" (on (-1, 1)) or "sign"; "": it cannot be drawn
    gaussian = False  # exactly normal, with ``proxy`` as covariance
    exact_covariance: Callable[[], list[list[Fraction]]]  # of a Gaussian law
    enclosed_covariance: Callable[[], Interval]  # the same, zeros that the structure gives exact
    uniform = False  # exactly uniform on the box of ``bound``

    def __init_subclass__(cls) -> None:
        for fact in ("name", "variate", "unit", "gaussian", "uniform"):
            if fact not in vars(cls):
                setattr(cls, fact, getattr(Law, fact))
        if not cls.name:
            return
        wanted = ["levels", "proxy", *(["factor"] if cls.variate else []), *(["bound"] if cls.uniform else [])]
        wanted += ["exact_covariance", "enclosed_covariance"] if cls.gaussian else []
        lacking = [part for part in wanted if getattr(cls, part, None) is getattr(Law, part, None)]
        if lacking:
            raise TypeError(f"the law {cls.name!r} must state {' and '.join(lacking)}; {cls.__name__} does not.")
        if cls.variate and cls.variate not in _VARIATES:
            raise TypeError(f"`variate` must be one of {', '.join(_VARIATES)}, got {cls.variate!r}.")
        other = LAWS.setdefault(cls.name, cls)
        if (other.__module__, other.__qualname__) != (cls.__module__, cls.__qualname__):
            raise TypeError(f"`name` {cls.name!r} is that of the law {other.__name__}; give another.")
        LAWS[cls.name] = cls

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        if args:
            levels = " or ".join(f"{level}=" for level in cls.levels)
            raise TypeError(f"{cls.__name__} takes no bare value, got {args[0]!r}; say {levels}.")
        return super().__new__(cls)

    def __post_init__(self) -> None:
        kind, value = self.level, getattr(self, self.level)
        if kind.endswith("covariance"):
            checked = positive_definite(kind, value, strict=False)
        else:
            matrices = [level for level in self.levels if level.endswith("covariance")]
            rows = value if isinstance(value, list | tuple) else []  # perhaps of different lengths
            if matrices and (getattr(value, "ndim", 0) > 1 or any(isinstance(row, list | tuple) for row in rows)):
                raise ValueError(f"`{kind}` must be a number or a vector; a matrix is a {matrices[0]}=.")
            checked = vector(kind, value)
            if np.any(checked < 0):
                raise ValueError(f"`{kind}` must not be negative, got {checked.tolist()}.")
        object.__setattr__(self, kind, checked)
        for flag in self.flags:
            if not isinstance(getattr(self, flag), bool | np.bool_):
                raise ValueError(f"`{flag}` must be true or false, got {getattr(self, flag)!r}.")

    @property
    def level(self) -> str:
        """The one level that is given."""
        given = [level for level in self.levels if getattr(self, level) is not None]
        if len(given) != 1:
            ways = ", ".join(f"{level}=" for level in self.levels)
            raise ValueError(f"{type(self).__name__} needs exactly one of {ways}; got {given or 'none'}.")
        return given[0]

    def resolve(self, dimension: int) -> Self:
        """The same law for noise of ``dimension`` entries: numbers become vectors."""
        kind, value = self.level, getattr(self, self.level)
        if kind.endswith("covariance"):
            if len(value) != dimension:
                raise ValueError(f"`{kind}` must be {dimension} x {dimension}, got {len(value)} x {len(value)}.")
            return self
        if len(value) not in (1, dimension):
            raise ValueError(f"`{kind}` must be a number or {dimension} numbers, got {len(value)}.")
        fields = {kind: frozen(np.broadcast_to(value, (dimension,)))}
        return type(self)(**fields, **{name: getattr(self, name) for name in (*self.flags, *self.tables)})

    def data(self) -> dict[str, Any]:
        """Name, level, and the flags that are not at their defaults, as a problem file states them."""
        flags = {flag: bool(getattr(self, flag)) for flag in self.flags}
        changed = {flag: value for flag, value in flags.items() if value != getattr(type(self), flag, None)}
        tables = {name: getattr(self, name).tolist() for name in self.tables}
        return {"law": self.name, self.level: getattr(self, self.level).tolist(), **tables, **changed}

    @property
    def dimension(self) -> int:
        """Number of entries of the noise."""
        return len(self.proxy)

    @property
    def proxy(self) -> Array:
        """Variance proxy, shape (m, m), rounded up on its diagonal; the covariance where the law is normal."""
        raise NotImplementedError

    @property
    def bound(self) -> Array | None:
        """Almost-sure bounds of the entries' absolute values, shape (m,), or None."""
        return None

    @property
    def factor(self) -> Array:
        """F, shape (m, m): the noise is F z, with z independent entries ``unit`` of ``variate``."""
        raise NotImplementedError

    def unit(self, v: Array) -> Array:
        """z from a variate v, written as dynamics are (NumPy's elementary functions): kernels trace it."""
        return v

    def check_drawable(self) -> None:
        """Refuse a law that does not say how it is drawn."""
        if not self.variate:
            name = type(self).__name__
            raise ValueError(f"{name} has no `variate` and cannot be simulated; give a law to sample from.")

    def sample(self, rng: np.random.Generator, size: int | tuple[int, ...]) -> Array:
        """Independent draws, shape (*size, m)."""
        self.check_drawable()
        shape = (size,) if isinstance(size, int) else tuple(size)
        factor = self.factor
        return np.asarray(self.unit(_VARIATES[self.variate](rng, (*shape, factor.shape[1]))) @ factor.T)


def check_law(law: Law, task: str, error: type[Exception] = TypeError) -> None:
    """Refuse a law that has no name of its own: a class made from another law may draw otherwise.

    ``task`` says what it was wanted for, ``error`` which exception that is.
    """
    if not law.name:
        raise error(
            f"`noise` must be one of {known_laws()} or another law with a `name` to {task}, got the class "
            f"{type(law).__name__}: what it draws is not known; state what it keeps by cb.Bounded(halfwidth=...) or "
            "cb.SubGaussian(proxy_std=...)."
        )


def known_laws() -> str:
    """The laws of the package and how each is given, in words."""
    own = [law for law in LAWS.values() if law.__module__.startswith("certbound.")]
    return ", ".join(f"cb.{law.__name__}({' | '.join(f'{level}=...' for level in law.levels)})" for law in own)


def _up(value: Fraction) -> float:
    """The least float that is not below."""
    nearest = float(value)
    return nearest if Fraction(nearest) >= value else float(np.nextafter(nearest, np.inf))


def _square_up(value: Array) -> Array:
    """Squares of floats, rounded up."""
    return frozen([_up(Fraction(float(x)) ** 2) for x in value])


class _Quadratic(Law):
    """A law given by a standard deviation, a variance or a covariance (or proxies of these)."""

    @property
    def proxy(self) -> Array:
        kind = self.level
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
    levels = ("std", "variance", "covariance")
    variate = "normal"
    gaussian = True

    @property
    def factor(self) -> Array:
        """A matrix F with F F' equal to the covariance, up to rounding."""
        if self.level == "covariance":
            values, vectors = np.linalg.eigh(self.covariance)
            return frozen(vectors * np.sqrt(np.maximum(values, 0.0)))
        return frozen(np.diag(self.std if self.level == "std" else np.sqrt(self.variance)))

    def exact_covariance(self) -> list[list[Fraction]]:
        squares = [[Fraction(float(entry)) for entry in row] for row in self.proxy]
        if self.level == "std":
            for i, deviation in enumerate(self.std):
                squares[i][i] = Fraction(float(deviation)) ** 2
        return squares

    def enclosed_covariance(self) -> Interval:
        if self.level != "std":
            return Interval.point(self.proxy)
        square = sq(Interval.point(self.std))
        return Interval(np.diag(square.lo), np.diag(square.hi))


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


class BoxLaw(Law):
    """A law of independent entries with |w_i| <= h_i, where h is its only level; proxy h_i^2 (Hoeffding's lemma)."""

    @property
    def proxy(self) -> Array:
        return frozen(np.diag(_square_up(self.bound)))

    @property
    def bound(self) -> Array:
        value: Array = getattr(self, self.level)
        return value

    @property
    def factor(self) -> Array:
        return np.diag(self.bound)


@dataclass(frozen=True, eq=False, kw_only=True)
class Uniform(BoxLaw):
    """Independent entries, uniform on [-h_i, h_i]; proxy h_i^2 / 3, the variance (sinh(x)/x <= exp(x^2/6)).

    Parameters
    ----------
    halfwidth : float or array_like, shape (m,)
        h, not negative; a number holds for each entry.
    """

    halfwidth: Any

    name = "uniform"
    levels = ("halfwidth",)
    variate = "uniform"
    uniform = True

    @property
    def proxy(self) -> Array:
        return frozen(np.diag(np.nextafter(_square_up(self.halfwidth) / 3.0, np.inf)) * (self.halfwidth > 0))


@dataclass(frozen=True, eq=False, kw_only=True)
class Triangular(BoxLaw):
    """Independent entries with the density (h_i - |w|)/h_i^2 on [-h_i, h_i]; proxy h_i^2 / 6, the variance.

    Each is the sum of two independent ones, uniform on [-h_i/2, h_i/2], whose proxies h_i^2/12 add.

    Parameters
    ----------
    halfwidth : float or array_like, shape (m,)
        h, not negative; a number holds for each entry.
    """

    halfwidth: Any

    name = "triangular"
    levels = ("halfwidth",)
    variate = "uniform"

    @property
    def proxy(self) -> Array:
        return frozen(np.diag(np.nextafter(_square_up(self.halfwidth) / 6.0, np.inf)) * (self.halfwidth > 0))

    def unit(self, v: Array) -> Array:
        return np.asarray(np.sign(v) * (1.0 - np.sqrt(1.0 - np.abs(v))))


@dataclass(frozen=True, eq=False, kw_only=True)
class Rademacher(BoxLaw):
    """Independent entries, +s_i or -s_i with probability 1/2 each; proxy s_i^2 (cosh(x) <= exp(x^2/2)).

    Parameters
    ----------
    scale : float or array_like, shape (m,)
        s, not negative; a number holds for each entry.
    """

    scale: Any

    name = "rademacher"
    levels = ("scale",)
    variate = "sign"


@dataclass(frozen=True, eq=False, kw_only=True)
class Bounded(BoxLaw):
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
    flags = ("independent",)
    variate = "sign"

    @property
    def proxy(self) -> Array:
        squares = _square_up(self.halfwidth)
        if self.independent:
            return frozen(np.diag(squares))
        total = sum((Fraction(float(s)) for s in squares), Fraction(0))
        return frozen(_up(total) * np.eye(len(squares)))
