"""Second moments of a scalar response w . Z_t over every part of a grid, and rows and columns to make others of.

Values lie between those at a part's ends up to h^2/8 of the second derivative, or follow Taylor's formula; what the
derivatives can be is bounded by entrywise majorants of |A|, |V| and their derivatives. alpha = w A, kappa = w A',
alpha_2 = alpha A + kappa; c_0 = V w, c_1 = V alpha + G w, c_2 = -A c_1 + c_1'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.gaussian.response.linear_response import LinearResponse
from certbound.gaussian.scalar import EPS
from certbound.rigor.intervals import Interval
from certbound.rigor.rounding import quiet

UP = 1 + 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class _Majorants:
    """Entrywise bounds over every part: of |A|, |V| and its derivatives, |g g^T|, |Phi(t, s)|, and of float errors.

    ``loose_v`` and ``loose_a`` bound the floats' errors of V and of A in every entry.
    """

    a: Array
    v: tuple[Array, Array, Array, Array]
    gram: Array
    grow: Array
    loose_v: Array
    loose_a: float


def _majorants(r: LinearResponse, diffusion: Array, first: int) -> _Majorants:
    """Bounds over the parts from number ``first`` on; ``diffusion`` (n, m), or (K, n, m) from that part on."""
    h, pick = r.step * (1 + 1e-14), slice(first, None)
    noise = np.abs(diffusion)
    gram = noise @ np.swapaxes(noise, -1, -2) * (1 + 1e-13)
    v, v_next = r.covariance[0, first:-1], r.covariance[0, first + 1 :]
    traces = np.trace(r.covariance_error[0], axis1=1, axis2=2)
    spill = traces[first:-1] + traces[first + 1 :]
    grow = np.eye(v.shape[-1]) + r.deviation[0, pick]
    size = grow @ (np.abs(v) + spill[:, None, None]) @ np.swapaxes(grow, 1, 2)
    size = (size + h * (grow @ gram @ np.swapaxes(grow, 1, 2))) * UP
    drift = np.abs(r.drift[0, pick])
    loose_a = r.slope_error + 8 * EPS * float(np.abs(r.slope[0]).max(initial=0.0) + h * drift.max(initial=0.0))
    a = (np.abs(r.slope[0, pick]) + h * drift + loose_a) * UP

    def both(product: Array) -> Array:
        return np.asarray((product + np.swapaxes(product, 1, 2)) * UP)

    one = both(a @ size) + gram
    two = both(drift @ size + a @ one)
    three = both(2 * (drift @ one) + a @ two)
    loose_v = spill + 1e-14 * np.maximum(np.abs(v), np.abs(v_next)).max(axis=(1, 2))
    return _Majorants(a=a, v=(size, one, two, three), gram=gram, grow=grow, loose_v=loose_v, loose_a=loose_a)


@dataclass(frozen=True, eq=False)
class Vectors:
    """Vectors within ``radius`` of ``middle``, entry by entry: (K, n)."""

    middle: Array
    radius: Array


def apply(matrix: Array, vector: Array) -> Array:
    """Matrix times vector, part by part."""
    return np.asarray(np.einsum("kij,kj->ki", matrix, vector))


def _left(vector: Array, matrix: Array) -> Array:
    return np.asarray(np.einsum("ki,kij->kj", vector, matrix))


class RowMoments:
    """Rows and columns of one w over the parts, with majorants of their derivatives."""

    def __init__(self, r: LinearResponse, w: Array, diffusion: Array, first: int) -> None:
        self.h = h = r.step * (1 + 1e-14)
        pick = slice(first, None)
        self.m = m = _majorants(r, diffusion, first)
        a, drift = r.slope[0, pick], r.drift[0, pick]
        a_end = a + h * drift
        self.w = np.broadcast_to(w, a.shape[:2])
        size_w, size_k = np.abs(self.w), np.abs(drift)
        gram = np.broadcast_to(diffusion @ np.swapaxes(diffusion, -1, -2), a.shape)
        noise = np.broadcast_to(m.gram, a.shape)
        self.alpha, self.kappa = _left(self.w, a), _left(self.w, drift)
        self.alpha_end = _left(self.w, a_end)
        self.alpha2 = _left(self.alpha, a) + self.kappa
        alpha2_end = _left(self.alpha_end, a_end) + self.kappa
        # majorants of the rows' derivatives
        s_kappa = _left(size_w, size_k) * UP
        self.s_alpha = _left(size_w, m.a) * UP
        self.s_alpha2 = (_left(self.s_alpha, m.a) + s_kappa) * UP
        self.s_turn = (_left(s_kappa, m.a) + _left(self.s_alpha, size_k)) * UP  # of alpha_2'
        s_alpha3 = (_left(self.s_alpha2, m.a) + self.s_turn) * UP
        # majorants of c_1, its derivatives, and of c_2, c_3
        s1 = (apply(m.v[0], self.s_alpha) + apply(noise, size_w)) * UP
        s1_one = (apply(m.v[1], self.s_alpha) + apply(m.v[0], s_kappa)) * UP
        self.s1_two = (apply(m.v[2], self.s_alpha) + 2 * apply(m.v[1], s_kappa)) * UP
        s2 = (apply(m.a, s1) + s1_one) * UP
        s3 = (apply(m.a, s2) + apply(size_k, s1) + apply(m.a, s1_one) + self.s1_two) * UP
        self._set_loose(size_w, size_k, noise)
        v, v_next = r.covariance[0, first:-1], r.covariance[0, first + 1 :]
        self.v = v, v_next
        push = a_end @ v_next
        v_rate = push + np.swapaxes(push, 1, 2) + gram
        c0, c1 = apply(v_next, self.w), apply(v_next, self.alpha_end) + apply(gram, self.w)
        c2 = -apply(a_end, c1) + apply(v_rate, self.alpha_end) + apply(v_next, self.kappa)
        grow = m.grow
        self.columns = (
            self._column(0, c0, c1, h * h / 2 * apply(grow, s2)), self._column(1, c1, c2, h * h / 2 * apply(grow, s3)),
            self._column(2, c2, np.zeros_like(c2), h * apply(grow, s3)),
        )
        self.rows = (
            self._row(0, self.w, self.alpha, h * h / 2 * _left(self.s_alpha2, grow)),
            self._row(1, self.alpha, self.alpha2, h * h / 2 * _left(s_alpha3, grow)),
            self._row(2, self.alpha2, np.zeros_like(self.alpha2), h * _left(s_alpha3, grow)),
        )
        self.at_middle = (
            self._row(0, self.w, self.alpha, h * h / 2 * _left(self.s_alpha2, grow), 0.0),
            self._row(1, self.alpha, self.alpha2, h * h / 2 * _left(s_alpha3, grow), 0.0),
            self._column(0, c0, c1, h * h / 2 * apply(grow, s2), 0.0),
        )
        b0, b1 = apply(v, self.w), apply(v, self.alpha) + apply(gram, self.w)
        # inside a part: c_0 and c_1 themselves, alpha and alpha_2 themselves
        self.inner_columns = (
            self._between(b0, c0, h * h / 8 * apply(m.v[2], size_w), self.loose_columns[0]),
            self._between(b1, c1, h * h / 8 * self.s1_two, self.loose_columns[1]),
        )
        self.inner_rows = self._inner_rows(alpha2_end, s_kappa, size_k)
        self._own(gram, (b0, c0), (b1, c1), alpha2_end, (s1, s1_one))

    def _set_loose(self, size_w: Array, size_k: Array, noise: Array) -> None:
        """Errors of the floats: sums of products of at most three matrices."""
        m, n = self.m, size_w.shape[-1]
        total = float(size_w.max(axis=0).sum())
        norm_a = float(m.a.sum(axis=2).max())
        norm_v, norm_g = m.v[0].sum(axis=2).max(axis=1), float(noise.sum(axis=2).max())
        norm_k = float(size_k.sum(axis=2).max())
        loose_v = n * m.loose_v
        loose_a = n * (m.loose_a + 1e-14 * norm_a)
        loose_c = (loose_v * norm_a + norm_v * loose_a + 1e-14 * norm_g) * total
        self.loose_rows = total * np.array([0.0, loose_a, 3 * norm_a * loose_a + 1e-13 * norm_k])
        self.loose_columns = (
            (loose_v + 1e-14 * norm_v) * total, loose_c,
            8 * (norm_a * loose_c + loose_a * (norm_v * norm_a + norm_g) * total)
            + (loose_v + 1e-13 * norm_v) * total * norm_k,
        )

    def _column(self, k: int, middle: Array, swing: Array, rest: Array, share: float = 1.0) -> Vectors:
        """On the whole part, or, with ``share`` = 0, at its middle."""
        half = self.h / 2
        radius = share * half * np.abs(swing) + (rest if share else rest / 4)
        loose = self.loose_columns[k][:, None] + self.h * self.loose_columns[min(k + 1, 2)][:, None]
        return Vectors(middle - half * swing, radius * UP + loose)

    def _row(self, k: int, middle: Array, swing: Array, rest: Array, share: float = 1.0) -> Vectors:
        """The same for rows, which are given at the other end."""
        half = self.h / 2
        radius = share * half * np.abs(swing) + (rest if share else rest / 4)
        radius = radius * UP + self.loose_rows[k] + self.h * self.loose_rows[min(k + 1, 2)]
        return Vectors(middle + half * swing, radius)

    def _inner_rows(self, alpha2_end: Array, s_kappa: Array, size_k: Array) -> tuple[Vectors, Vectors, Vectors]:
        """w, alpha and alpha_2 inside a part."""
        half = self.h / 2
        turned = np.abs(alpha2_end - self.alpha2) / 2 + self.h * self.h * _left(s_kappa, size_k)
        return (
            Vectors(self.w, np.zeros_like(self.w)),
            Vectors(self.alpha + half * self.kappa, half * np.abs(self.kappa) + self.loose_rows[1]),
            Vectors((self.alpha2 + alpha2_end) / 2, turned * UP + self.loose_rows[2]),
        )

    @staticmethod
    def _between(left: Array, right: Array, bend: Array, loose: Array) -> Vectors:
        """Values between two ends, up to h^2/8 of the second derivative."""
        extra = loose[:, None] if loose.ndim else loose
        return Vectors((left + right) / 2, (np.abs(right - left) / 2 + bend) * UP + extra)

    def _own(
        self, gram: Array, c0: tuple[Array, Array], c1: tuple[Array, Array], alpha2_end: Array, s1: tuple[Array, Array]
    ) -> None:
        """The variance w V w and its derivatives V' = 2 alpha c_0 + w G w, V'' = 2 (alpha_2 c_0 + alpha c_1)."""
        h, m, size_w = self.h, self.m, np.abs(self.w)

        def dot(x: Array, y: Array) -> Array:
            return np.asarray(np.einsum("ki,ki->k", x, y))

        noise = np.einsum("ki,kij,kj->k", self.w, gram, self.w)
        loose_noise = 1e-13 * np.einsum("ki,kij,kj->k", size_w, np.broadcast_to(m.gram, gram.shape), size_w)
        self.noise = Interval(np.maximum(noise - loose_noise, 0.0), noise + loose_noise)
        value = [dot(self.w, c) for c in c0]
        rate = [2 * dot(x, c) + noise for x, c in zip((self.alpha, self.alpha_end), c0, strict=True)]
        bend = [2 * (dot(y, c) + dot(x, d)) for x, y, c, d in zip(
            (self.alpha, self.alpha_end), (self.alpha2, alpha2_end), c0, c1, strict=True)]
        s0, s0_one = apply(m.v[0], size_w), apply(m.v[1], size_w)
        s_bend = 2 * (dot(self.s_alpha2, s0) + dot(self.s_alpha, s1[0])) * UP
        s_third = self._third(s0, s0_one, s1)
        total = size_w.sum(axis=1)
        loose0 = self.loose_columns[0] * total
        loose1 = 2 * (self.loose_columns[0] * self.s_alpha.sum(axis=1) + self.loose_rows[1] * s0.sum(axis=1))
        loose2 = 2 * (self.loose_columns[0] * self.s_alpha2.sum(axis=1) + self.loose_rows[2] * s0.sum(axis=1)
                      + self.loose_columns[1] * self.s_alpha.sum(axis=1) + self.loose_rows[1] * s1[0].sum(axis=1))
        self.ends = tuple(Interval(x - loose0, x + loose0) for x in value)
        self.variance = self._span(value[0], value[1], h * h / 8 * s_bend, loose0)
        third = h * h / 8 * self._third(s0, s0_one, s1) * UP + loose1 + loose_noise
        self.rate = self._span(rate[0], rate[1], 0.0 * third, third)
        bow, mean = h * h / 8 * s_bend * UP + loose0, [(x[0] + x[1]) / 2 for x in (value, rate)]
        self.own_middle = tuple(Interval(x - y, x + y) for x, y in zip(mean, (bow, third), strict=True))
        middle, radius = (bend[0] + bend[1]) / 2, h / 2 * s_third
        self.bend = Interval(middle - radius - loose2, middle + radius + loose2)

    def _third(self, s0: Array, s0_one: Array, s1: tuple[Array, Array]) -> Array:
        """Majorant of V'''."""
        parts = ((self.s_turn, s0), (self.s_alpha2, s0_one), (np.abs(self.kappa), s1[0]), (self.s_alpha, s1[1]))
        return np.asarray(2 * UP * sum(np.einsum("ki,ki->k", x, y) for x, y in parts))

    @staticmethod
    def _span(left: Array, right: Array, bend: Array, loose: Array) -> Interval:
        radius = bend * UP + loose
        return Interval(np.minimum(left, right) - radius, np.maximum(left, right) + radius)


@dataclass(frozen=True, eq=False, kw_only=True)
class SmoothMoments:
    """Enclosures over every part of Var xi, cov(xi, xi') and Var xi', and of Var xi at the start, where w . g = 0."""

    variance: Interval
    covariance: Interval
    velocity: Interval
    start: Interval


@quiet
def smooth_moments(r: LinearResponse, w: Array, diffusion: Array) -> SmoothMoments:
    """Second moments of xi = w . Z and xi' = alpha . Z over all parts.

    Proves: each lies between its values at the part's ends up to h^2/8 of its second derivative; (alpha V alpha)'' =
    2 kappa V kappa + 4 kappa V' alpha + alpha V'' alpha, kappa = w A'.
    """
    row = RowMoments(r, w, diffusion, 0)
    m, kappa = row.m, np.abs(row.kappa)

    def form(x: Array, matrix: Array, y: Array) -> Array:
        return np.asarray(np.einsum("ki,kij,kj->k", x, matrix, y))

    value = [form(x, v, x) for x, v in zip((row.alpha, row.alpha_end), row.v, strict=True)]
    s = row.s_alpha
    bend = 2 * form(kappa, m.v[0], kappa) + 4 * form(kappa, m.v[1], s) + form(s, m.v[2], s)
    loose = s.sum(axis=1) * (row.loose_columns[1] + row.loose_columns[0] * s.sum(axis=1))
    loose += row.loose_rows[1] * apply(m.v[0], s).sum(axis=1) + 1e-13 * form(s, m.v[0], s)
    velocity = row._span(value[0], value[1], row.h**2 / 8 * bend, 2 * loose)
    start = row.ends[0][:1]
    return SmoothMoments(
        variance=Interval(np.maximum(row.variance.lo, 0.0), row.variance.hi), covariance=row.rate * 0.5,
        velocity=Interval(np.maximum(velocity.lo, 0.0), velocity.hi),
        start=Interval(np.maximum(start.lo[0], 0.0), np.maximum(start.hi[0], 0.0)),
    )
