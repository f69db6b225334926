"""The laws of discrete-time noise that the checker knows, one row each, with what is proved of it.

A row trusts nothing that a certificate or the prover says of the law but its name, its level and its flags.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

from flint import arb

from certbound.checker.reading import Record
from certbound.checker.statement.law_pieces import Cut, atoms, bins, cut_by
from certbound.errors import CertificateError

Squares = list[arb]
_SUM = arb(2) ** -39


@dataclass(frozen=True, eq=False, kw_only=True)
class Law:
    """What is proved of a law: E exp(l.w) <= exp(sum p_i l_i^2 / 2) for every l, given the past.

    It is given by one of ``levels``. ``proxies`` finds the p_i from the squared levels of the entries (a variance is
    one already, and a covariance stands as it is) and from the law's data, if it has ``flags``, true or false, or
    ``tables``; None where no such p_i exist. ``cut`` makes pieces of one entry at level 1, where entries are
    independent and of this very law.
    """

    levels: tuple[str, ...]
    proxies: Callable[[Squares, Record], Squares] | None
    flags: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()  # lists of numbers, under ``tables``
    gaussian: bool = False  # exactly normal
    uniform: bool = False  # independent entries, each uniform between its level and minus that
    bounded: bool = False  # no entry is larger than its level, whatever its sign
    cut: Cut | None = None


def _as_they_are(squares: Squares, data: Record) -> Squares:
    return squares


def _bounded(squares: Squares, data: Record) -> Squares:
    """Hoeffding's lemma, for every entry or (where they may depend on each other) for l.w, as |l.w| <= |l| |h|."""
    return squares if data.flag("independent") else [sum(squares[1:], squares[0])] * len(squares)


def _tabled(places: str, more: int) -> Callable[[Squares, Record], Squares]:
    """Hoeffding's lemma for a law about its mean: a quarter of the squared range, in units of the scale.

    ``places`` names the table of its values or edges, which has ``more`` entries than that of the probabilities.
    """

    def proxies(squares: Squares, data: Record) -> Squares:
        tables = Record(data["tables"], data.at("tables"), (places, "probabilities"))
        weights = tables.array("probabilities", None)
        values = tables.array(places, len(weights) + more)
        if not weights or any(weight < 0 for weight in weights):
            raise CertificateError(f"`{tables.at('probabilities')}` must not be empty or negative.")
        if not abs(sum(map(arb, weights), arb(0)) - 1) <= _SUM:
            raise CertificateError(f"`{tables.at('probabilities')}` must sum to 1.")
        if any(b <= a for a, b in itertools.pairwise(values)):
            raise CertificateError(f"`{tables.at(places)}` must rise.")
        square = (arb(values[-1]) - arb(values[0])) ** 2 / 4
        return [entry * square for entry in squares]

    return proxies


def _thirds(squares: Squares, data: Record) -> Squares:
    return [square / 3 for square in squares]


LAWS = {
    # E exp(l.w) = exp(l' S l / 2): S is the covariance
    "gaussian": Law(levels=("std", "variance", "covariance"), proxies=_as_they_are, gaussian=True,
                    cut=cut_by("normal", -8.3, 8.3)),
    # what it says of itself
    "subgaussian": Law(levels=("std", "variance", "covariance"), proxies=_as_they_are),
    # sinh(x)/x <= exp(x^2/6)
    "uniform": Law(levels=("halfwidth",), proxies=_thirds, uniform=True, bounded=True,
                   cut=cut_by("uniform", -1, 1)),
    # cosh(x) <= exp(x^2/2)
    "rademacher": Law(levels=("scale",), proxies=_as_they_are, bounded=True,
                      cut=lambda count, tables: atoms([-1, 1], [0.5, 0.5])),
    # the sum of two uniform ones
    "triangular": Law(levels=("halfwidth",), proxies=lambda squares, data: [square / 6 for square in squares],
                      bounded=True, cut=cut_by("triangular", -1, 1)),
    "discrete": Law(levels=("scale",), proxies=_tabled("values", 0), tables=("values", "probabilities"),
                    cut=lambda count, tables: atoms(*tables)),
    "histogram": Law(levels=("scale",), proxies=_tabled("edges", 1), tables=("edges", "probabilities"),
                     cut=lambda count, tables: bins(count, *tables)),
    # its tails are those of an exponential
    "laplace": Law(levels=("scale",), proxies=None, cut=cut_by("laplace", -37, 37)),
    "bounded": Law(levels=("halfwidth",), proxies=_bounded, flags=("independent",), bounded=True),
}
