"""Bounds of the probability that a centred normal process along a row exceeds a level on a piece of time.

Each is an inequality of docs/theory.md, section 9 ("Affine models exactly"). Three of them serve a piece:

- `rice`, of rows without noise of their own (a G = 0): E(upcrossings) <= int phi(z/s)/s E[eta^+ | xi = z] dt bounds the
  probability to be at most z at its start and beyond z on it;
- `windows`, of rows with noise of their own: Slepian's comparison with an Ornstein-Uhlenbeck process in windows of equal
  length bounds the same for the levels l s_t;
- `crude`, of any row: what is gained on the piece is its own Wiener process and an integral of eta.
"""

from __future__ import annotations

from dataclasses import dataclass

from flint import arb

from certbound.checker.affine.pieces import Piece
from certbound.checker.balls import below_and_above, tail, upper
from certbound.checker.report import FUNCTION, Budget

_JOINT = 1_000_000
"""Units of work of a joint probability of two normals."""
_RICE, _CRUDE = 12 * FUNCTION, 24 * FUNCTION
_SHARES = (0.5, 0.8, 0.95, 0.99)
"""Parts of a level that what moves most may take of it, the best of which counts."""
_FAST = arb(2) ** -60
"""The least clock of a window: one that is longer than it need be is sound."""
_LONGEST = 4
"""The longest clock of a window that is looked at: far shorter ones say more."""
_SAFE = 1 - arb(2) ** -30
"""Parts of a level, as floats, add up to no more than the level."""


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


def rice(level: arb, piece: Piece, budget: Budget) -> Cost | None:
    """P(xi is at most z at the start of the piece and beyond z on it), z = ``level`` > 0; None where s may be 0.

    With s^2, c and e enclosed: phi(z/s)/s rises in s up to z and falls from there, and the mean of eta^+ rises with the
    mean c z/s^2 and the variance e - c^2/s^2 of eta.
    """
    if not (piece.s_low > 0 and piece.s_high.is_finite() and piece.e_high.is_finite()):
        return None
    budget.balls(1, _RICE)
    square = level * level
    if piece.s_high <= square:
        most = density(level, piece.s_high)
    elif piece.s_low >= square:
        most = density(level, piece.s_low)
    else:
        most = arb(-0.5).exp() / ((2 * arb.pi()).sqrt() * level)
    mean = upper(piece.c_high * level / (piece.s_low if piece.c_high > 0 else piece.s_high))
    least = arb.max(arb.max(piece.c_low, -piece.c_high), arb(0))
    rest = upper(arb.max(piece.e_high - least * least / piece.s_high, arb(0)))
    found = upper(piece.length * most * positive_part(mean, rest))
    return Cost(probability=found, enters=_below(level, piece.first_high), leaves=_above(level, piece.last_low))


def windows(level: arb, piece: Piece, own: arb, count: int, budget: Budget) -> Cost | None:
    """The same in so many windows of equal length of a row with noise of its own, ``own`` an upper bound of a G G^T a^T.

    For s < t = s + x in a window of length d let g = a F(x) V_s a^T, w = dg/dx. w lies within d sqrt(b s^2) of c_s, and
    log corr(s, t) has the slope w/g - (c_t + own/2)/s_t^2 in x, which is at least -k. By Slepian's lemma xi/s exceeds
    l = z/sup s on a window, from below l at its start, no oftener than an Ornstein-Uhlenbeck process of rate k. None
    where that says nothing.
    """
    if not (piece.s_low > 0 and piece.s_high.is_finite() and piece.b_high.is_finite()):
        return None
    budget.balls(1, _RICE)
    length = upper(piece.length / count)
    bend = upper(length * (piece.b_high * piece.s_high).sqrt())
    lowest, highest = (piece.c_low - bend).lower(), (piece.c_high + bend).upper()
    least = (piece.s_low + length * arb.min(lowest, arb(0))).lower()
    most = (piece.s_high + length * arb.max(highest, arb(0))).upper()
    if not (least > 0 and most.is_finite()):
        return None
    fall = -lowest / (least if lowest < 0 else most)
    grown = upper(piece.c_high + own / 2)
    fall += grown / (piece.s_low if grown > 0 else piece.s_high)
    clock = upper(arb.max(upper(fall * length), _FAST))
    scaled = _below(level, piece.s_high)
    if not (clock < _LONGEST and scaled > 0 and scaled.is_finite()):
        return None
    found = upper(count * ornstein_uhlenbeck(scaled, clock, budget))
    return Cost(probability=found, enters=scaled, leaves=scaled)


def ornstein_uhlenbeck(level: arb, clock: arb, budget: Budget) -> arb:
    """Upper bound of P(U_0 <= l and U exceeds l within the clock), corr(U_s, U_t) = exp(-|t - s|), l > 0 exact.

    U_t = W(u)/sqrt(u) at u = exp(2 t), and l sqrt(u) lies above its chord L(u) = l + beta (u - 1) on [1, U],
    beta = l/(sqrt(U) + 1). Of a Wiener process, P(W_1 <= l, W exceeds L on [1, U]) is, by the reflection principle,
    P(N <= l, Y > l) + exp(2 beta^2 - 2 beta l) P(N <= l - 2 beta, Y > (2 l - 2 beta - l sqrt(U))/sqrt(U)) with standard
    normal N and Y of correlation 1/sqrt(U).
    """
    budget.balls(1, 2 * _JOINT)
    root = clock.exp()
    slope = level / (root + 1)
    start = level - 2 * slope
    direct = below_and_above(level, level, 1 / root)
    turned = below_and_above(start, (start + level) / root - level, 1 / root)
    return upper(direct + (2 * slope * slope - 2 * slope * level).exp() * turned)


def crude(level: arb, piece: Piece, own: arb, budget: Budget) -> Cost:
    """P(xi exceeds z on the piece), from anywhere: with parts of z for what it was, its own noise, and int |eta|.

    sup a G W exceeds y with probability 2 Q(y/sqrt(own h)), by reflection; the mean of |eta| over the piece has
    E exp(l .) <= 2 exp(l^2 e/2), by Jensen's inequality, so that int |eta| exceeds y with probability at most
    2 exp(-y^2/(2 h^2 e)).
    """
    budget.balls(1, _CRUDE)
    best = arb(1)
    for shares in _shares(piece.first_high.is_zero(), own.is_zero()):
        before, noise, rest = (arb(share) * level * _SAFE for share in shares)
        total = arb(0)
        if not piece.first_high.is_zero():
            total += tail(before / piece.first_high.sqrt())
        if not own.is_zero():
            total += 2 * tail(noise / (own * piece.length).sqrt())
        if not piece.e_high.is_zero():
            total += 2 * (-rest * rest / (2 * piece.length * piece.length * piece.e_high)).exp()
        best = arb.min(best, upper(total))
    return Cost(probability=best, enters=None, leaves=_above(level, piece.last_low))


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
