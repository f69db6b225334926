"""The laws of discrete-time noise that the checker knows, one row each, with what is proved of it.

A row trusts nothing that a certificate or the prover says of the law but its name, its level and its flags.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from flint import arb

from certbound.checker.reading import Record

Squares = list[arb]


@dataclass(frozen=True, eq=False, kw_only=True)
class Law:
    """What is proved of a law: E exp(l.w) <= exp(sum p_i l_i^2 / 2) for every l, given the past.

    It is given by one of ``levels``. ``proxies`` finds the p_i from the squared levels of the entries (a variance is
    one already, and a covariance stands as it is) and from the law's data, if it has ``flags``, true or false.
    """

    levels: tuple[str, ...]
    proxies: Callable[[Squares, Record], Squares]
    flags: tuple[str, ...] = ()
    gaussian: bool = False  # exactly normal
    uniform: bool = False  # independent entries, each uniform between its level and minus that


def _as_they_are(squares: Squares, data: Record) -> Squares:
    return squares


def _bounded(squares: Squares, data: Record) -> Squares:
    """Hoeffding's lemma, for every entry or (where they may depend on each other) for l.w, as |l.w| <= |l| |h|."""
    return squares if data.flag("independent") else [sum(squares[1:], squares[0])] * len(squares)


def _thirds(squares: Squares, data: Record) -> Squares:
    return [square / 3 for square in squares]


LAWS = {
    # E exp(l.w) = exp(l' S l / 2): S is the covariance
    "gaussian": Law(levels=("std", "variance", "covariance"), proxies=_as_they_are, gaussian=True),
    # what it says of itself
    "subgaussian": Law(levels=("std", "variance", "covariance"), proxies=_as_they_are),
    # sinh(x)/x <= exp(x^2/6)
    "uniform": Law(levels=("halfwidth",), proxies=_thirds, uniform=True),
    # cosh(x) <= exp(x^2/2)
    "rademacher": Law(levels=("scale",), proxies=_as_they_are),
    "bounded": Law(levels=("halfwidth",), proxies=_bounded, flags=("independent",)),
}
