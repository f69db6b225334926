"""Bounds of the probability that a centred normal process along a row exceeds a level on a piece of time.

A level z changes evenly over a piece. Each bound is an inequality of docs/theory.md, section 9 ("Affine models
exactly"). Three of them serve a piece:

- `rice`, of rows without noise of their own (a G = 0): int phi(z/s)/s E[(eta - dz/dt)^+ | xi = z] dt bounds the
  probability to be at most z at its start and beyond z on it;
- `windows`, of rows with noise of their own: Slepian's comparison with an Ornstein-Uhlenbeck process in windows of
  equal length bounds the same;
- `crude`, of any row: what is gained on the piece is its own Wiener process and an integral of eta.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from flint import arb

from certbound.checker.affine.row_pieces import Piece
from certbound.checker.balls import below_and_above, tail, upper
from certbound.checker.report import FUNCTION, Budget

_JOINT = 1_000_000
"""Units of work of a joint probability of two normals."""
_RICE, CRUDE = 12 * FUNCTION, 24 * FUNCTION
"""Units of work of a bound by Rice's formula or of the rates of windows, and of a crude one: 50 and 100 us measured."""
_SHARES = (0.5, 0.8, 0.95, 0.99)
"""Parts of a level that what moves most may take of it, the best of which counts."""
_SHORTEST = arb(2) ** -60
"""The least clock of a window: one that is longer than it need be is sound."""
_BEYOND = 1 + arb(2) ** -40
"""How far a rate of decay is taken beyond the root of what it must satisfy, lest rounding decide."""
_LONGEST = 4
"""The longest clock of a window that is looked at: far shorter ones say more."""
_SAFE = 1 - arb(2) ** -30
"""Parts of a level, as floats, add up to no more than the level."""


class Level(NamedTuple):
    """A level above 0 that changes evenly over a piece: exact numbers at its ends."""

    first: arb
    last: arb

    @property
    def least(self) -> arb:
        """The smaller one of both ends."""
        return arb.min(self.first, self.last)


@dataclass(frozen=True, eq=False, kw_only=True)
class Cost:
    """What a piece costs, given that it begins at most at ``enters`` s (None: from anywhere), a lower bound.

    Who did not fail on it is at most at ``leaves`` s at its end, an upper bound (None: nothing is known).
    """

    probability: arb
    enters: arb | None
    leaves: arb | None


def density(level: arb, variance: arb) -> arb:
    """exp(-z^2/(2 s^2))/sqrt(2 pi s^2)."""
    return (-level * level / (2 * variance)).exp() / (2 * arb.pi() * variance).sqrt()


def positive_part(mean: arb, variance: arb) -> arb:
    """Upper bound of E[Y^+] of a normal Y, of a mean and a variance that are exact."""
    if not variance > 0:
        return arb.max(mean, arb(0))
    spread = variance.sqrt()
    ratio = mean / spread
    value = spread * (-ratio * ratio / 2).exp() / (2 * arb.pi()).sqrt() + mean * tail(-ratio)
    return arb.max(upper(value), arb(0))


def rice(level: Level, piece: Piece, budget: Budget) -> Cost | None:
    """P(xi is at most z at the start of the piece and beyond z on it); None where s may be 0.

    On a path that does so f = xi - z passes from 0 to every small y > 0, so that int f'^+ 1{0 < f < y} dt >= y: by
    Fatou's lemma the probability is at most int phi(z/s)/s E[(eta - z')^+ | xi = z] dt. With s^2, c and e enclosed:
    phi(z/s)/s falls in z, rises in s up to z and falls from there, and the mean of (eta - z')^+ rises with the mean c
    z/s^2 - z' and the variance e - c^2/s^2.
    """
    if not (piece.s_low > 0 and piece.s_high.is_finite() and piece.e_high.is_finite()):
        return None
    budget.balls(1, _RICE)
    low, high = level.least, arb.max(*level)
    square = low * low
    if piece.s_high <= square:
        most = density(low, piece.s_high)
    elif piece.s_low >= square:
        most = density(low, piece.s_low)
    else:
        most = arb(-0.5).exp() / ((2 * arb.pi()).sqrt() * low)
    mean = piece.c_high * (high / piece.s_low if piece.c_high > 0 else low / piece.s_high)
    mean = upper(mean - (level.last - level.first) / piece.length)
    least = arb.max(arb.max(piece.c_low, -piece.c_high), arb(0))
    rest = upper(arb.max(piece.e_high - least * least / piece.s_high, arb(0)))
    found = upper(piece.length * most * positive_part(mean, rest))
    return Cost(
        probability=found, enters=_below(level.first, piece.first_high), leaves=_above(level.last, piece.last_low)
    )


def windows(level: Level, piece: Piece, own: arb, count: int, budget: Budget) -> Cost | None:
    """The same of a row with noise of its own, ``own`` an upper bound of a G G^T a^T, in so many windows.

    In each xi/s is compared with a stationary Ornstein-Uhlenbeck process U (Slepian's lemma). Of several windows the
    level over s is taken to be the least of the piece; a single one knows both at its start, and that log s grows at a
    rate of at most ``Rates.spread``, while z lies above an exponential between its ends, which is convex. None where
    that says nothing.
    """
    if not (piece.s_low > 0 and piece.s_high.is_finite() and piece.v_high.is_finite()):
        return None
    budget.balls(1, _RICE)
    length = upper(piece.length / count)
    rates = rates_over(piece, own, length)
    clock = upper(arb.max(rates.decay * length, _SHORTEST))
    if not clock < _LONGEST:
        return None
    if count > 1:
        scaled = _below(level.least, piece.s_high)
        found = upper(count * crossing(scaled, scaled, clock, budget))
        return Cost(probability=found, enters=scaled, leaves=scaled)
    scaled = _below(level.first, piece.first_high)
    falls = upper(rates.spread * length + arb.max(upper((level.first / level.last).log()), arb(0)))
    end = (scaled * (-falls).exp()).lower()
    found = crossing(scaled, end, arb.max(clock, falls), budget)
    return Cost(probability=found, enters=scaled, leaves=_above(level.last, piece.last_low))


class Rates(NamedTuple):
    """k with corr(xi_s, xi_t) >= exp(-k (t - s)) on a window, and D >= 0 with s_t <= s_s exp(D (t - s)), D <= k."""

    decay: arb
    spread: arb


def rates_over(piece: Piece, own: arb, length: arb) -> Rates:
    """Rates over windows of a length L on a piece, upper bounds.

    For s < t = s + x let g = a F(x) V_s a^T. By Taylor's formula and |a A^3 F(y) V_s a^T| <= sd(a A^3 Z_(s+y)) s_s,
    g/s_s^2 >= 1 - p x + q x^2/2 - r x^3/6 with p >= -c/s^2, q <= d/s^2 and r >= sd(a A^3 Z)/s on the piece. That is at
    least exp(-k x), which is at most 1 - k x + k^2 x^2/2, where k >= 0 and k - p >= L max(k^2 - q, 0)/2 + r L^2/6. And
    corr = (g/s_s^2)(s_s/s_t), where log s has the slope (c + own/2)/s^2.
    """
    p = upper(-piece.c_low / (piece.s_low if piece.c_low < 0 else piece.s_high))
    q = (piece.d_low / (piece.s_high if piece.d_low > 0 else piece.s_low)).lower()
    rest = upper((piece.v_high / piece.s_low).sqrt() * length * length / 6)
    # the least root of k - p - rest = L (k^2 - q)/2, or p + rest where k^2 <= q; what is found is proved below
    part = 2 * length * (p + rest - length * q / 2)
    root = part / length / (1 + (1 - part).sqrt()) if part < 1 else arb.pos_inf()
    k = arb.max(arb.max(upper(root * _BEYOND), upper(p + rest)), arb(0))
    if not k >= p + rest + length * arb.max(k * k - q, arb(0)) / 2:
        return Rates(decay=arb.pos_inf(), spread=arb(0))
    grown = upper(piece.c_high + own / 2)
    spread = upper(grown / (piece.s_low if grown > 0 else piece.s_high))
    return Rates(decay=upper(k + spread), spread=arb.max(spread, arb(0)))


def crossing(first: arb, last: arb, clock: arb, budget: Budget) -> arb:
    """Upper bound of P(U_0 <= l and U exceeds l exp(-D x), 0 <= x <= L) for l = ``first`` > 0, ``last`` = l exp(-D L).

    Numbers are exact, corr(U at x, U at y) = exp(-k |x - y|), ``clock`` = k L, and 0 <= D <= k. U = W(u)/sqrt(u) at
    u = exp(2 k x) with a Wiener process W, and l u^((1 - D/k)/2) is concave, so that it lies above its chord L(u) = l +
    beta (u - 1) on [1, E], E = exp(2 k L), which ends at last sqrt(E). By the reflection principle W_1 <= l, and W
    exceeds L on [1, E], with probability P(N <= l, Y > last) + exp(2 beta^2 - 2 beta l) P(N <= l - 2 beta, Y > (l -
    2 beta - beta (E - 1))/sqrt(E)), N and Y standard normal with correlation 1/sqrt(E).
    """
    budget.balls(1, 2 * _JOINT)
    root = clock.exp()
    slope = (last * root - first) / (root * root - 1)
    direct = below_and_above(first, last, 1 / root)
    start = first - 2 * slope
    turned = below_and_above(start, (start - slope * (root * root - 1)) / root, 1 / root)
    return upper(direct + (2 * slope * slope - 2 * slope * first).exp() * turned)


def crude(level: Level, piece: Piece, own: arb, budget: Budget) -> Cost:
    """P(xi exceeds the least z on the piece), from anywhere: parts of z for what it was, its own noise, and int |eta|.

    sup a G W exceeds y with probability 2 Q(y/sqrt(own h)), by reflection; the mean of |eta| over the piece has
    E exp(l .) <= 2 exp(l^2 e/2), by Jensen's inequality, so that int |eta| exceeds y with probability at most
    2 exp(-y^2/(2 h^2 e)).
    """
    budget.balls(1, CRUDE)
    best, least = arb(1), level.least
    for shares in _shares(piece.first_high.is_zero(), own.is_zero()):
        before, noise, rest = (arb(share) * least * _SAFE for share in shares)
        total = arb(0)
        if not piece.first_high.is_zero():
            total += tail(before / piece.first_high.sqrt())
        if not own.is_zero():
            total += 2 * tail(noise / (own * piece.length).sqrt())
        if not piece.e_high.is_zero():
            total += 2 * (-rest * rest / (2 * piece.length * piece.length * piece.e_high)).exp()
        best = arb.min(best, upper(total))
    return Cost(probability=best, enters=None, leaves=_above(least, piece.last_low))


def _shares(rests: bool, smooth: bool) -> list[tuple[float, float, float]]:
    """Parts of a level for what the row was, for its own noise, and for the integral: ``rests``: it was 0."""
    if rests and smooth:
        return [(0.0, 0.0, 1.0)]
    if rests:
        return [(0.0, share, 1 - share) for share in _SHARES]
    if smooth:
        return [(share, 0.0, 1 - share) for share in _SHARES]
    return [(share, 0.9 * (1 - share), 0.1 * (1 - share)) for share in _SHARES]


def _below(level: arb, variance: arb) -> arb:
    """At most z/s, of an upper bound of s^2 that is not 0."""
    return (level / variance.sqrt()).lower()


def _above(level: arb, variance: arb) -> arb | None:
    """At least z/s, of a lower bound of s^2; None where that is 0."""
    return upper(level / variance.sqrt()) if variance > 0 else None
