"""Probabilities for noise that depends on the state: martingales of bounded quadratic variation (Thm K7).

Where the diffusion is g(t, X), its deviation from a chosen ghat drives M' = Jhat M dt + (g - ghat) dW. Stopped when the
state leaves a tube, r . Phi(t_e, s) M_s is a martingale N whose quadratic variation up to t_e is at most

    kappa^2 = int_0^{t_e} sup_tube |r Phi(t_e, tau) (g - ghat)|^2 dtau,

so that P(sup N > z) <= 2 Q(z / kappa): N is a Brownian motion run for a time of at most kappa^2. As for the Gaussian
part, a row w at a time s of the window that ends at t_e reads w . M_s = b . Phi(t_e, s) M_s with b = w Phi(s, t_e), and
what b differs from the window's own direction r is paid for by two-sided levels of all coordinates.

Rows are floats rho_k at the nodes; between two nodes they follow the adjoint equation exactly, and where they jump,
by the rounding of one product, they meet M_{t_k}, whose size is known. Symbols: kappa, N, M of Thm K7; Q the normal
tail.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from certbound.arrays import Array, Index, Integers
from certbound.gaussian.response.clocks import ClockEvents, SteadyEvent
from certbound.gaussian.response.events import WindowEvent, WindowEvents
from certbound.gaussian.response.linear_response import LinearResponse
from certbound.gaussian.response.martingale_windows import level_left, logsumexp
from certbound.gaussian.scalar import log_tail
from certbound.rigor.intervals import Interval

_ROUND = 1 + 1e-12
_UNIT = 2.0**-53
_TINY = 1e-290
_TURN = 0.1  # ||J|| times the length of a window
_MOST_WINDOWS = 150
_MOST_ENTRIES = 6_000_000  # of the transition matrices from every node to every window's end
_MOST_KEPT = 2_000_000  # of the rows that are not computed again
_HALVINGS = 48
_SPLITS = (10.0, 3.0)  # how far the log probability granted to M lies below that of Z


def _along(rows: Array, matrices: Array) -> Array:
    """Rows (W, N, n) times a matrix each piece (N, n, m): (W, N, m)."""
    return np.swapaxes(np.swapaxes(rows, 0, 1) @ matrices, 0, 1)


@lru_cache(maxsize=1024)  # events share their probabilities
def quantile(log_probability: float) -> float:
    """A level q with log Q(q) <= ``log_probability``, nearly the least."""
    if log_probability >= -0.7:  # Q(0) = 1/2
        return 0.0
    low, high = 0.0, float(np.sqrt(-2.0 * log_probability)) * (1 + 1e-12)  # Q(x) <= exp(-x^2/2)/2
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if float(log_tail(middle)) <= log_probability else (middle, high)
    return high


class Martingales:
    """The part of the noise that depends on the state, for one cell of the initial set.

    ``excess`` (N, n, m) is g - ghat over the tube, piece by piece; ``shared_log`` the log probability granted to the
    event that some coordinate of M leaves its level in some window; ``frame`` what `Windowed` found before.
    """

    def __init__(
        self, response: LinearResponse, cell: int, excess: Interval, shared_log: float, frame: Windowed | None = None
    ) -> None:
        self.frame = Windowed(response, cell) if frame is None else frame
        self.middle = (excess.lo + excess.hi) / 2
        self.radius = np.maximum(excess.hi - self.middle, self.middle - excess.lo) * (1 + 1e-15)
        self.size = np.abs(self.middle) + self.radius
        self.silent = not np.any(self.size)
        self.shared_log = shared_log

    def variation(self, directions: Array) -> tuple[Array, Array]:
        """kappa of every window (W,) along ``directions`` (W, n), and per unit of |M| what rounding adds (W, N, n).

        The squared size along a chord is convex, so that its integral over a piece is at most that of its ends.
        """
        f = self.frame
        rows, loss = f.rows(directions)
        late, early = rows[:, 1:], rows[:, :-1]
        ends = [self._squares(late, np.zeros_like(loss)), self._squares(early, loss)]
        main = f.step / 2 * (np.where(f.inside, ends[0] + ends[1], 0.0)).sum(axis=1)
        bulge = _along(np.abs(late), f.bulge @ self.size)
        rest = f.step * np.where(f.inside, (bulge**2).sum(axis=-1), 0.0).sum(axis=1)
        return (np.sqrt(main) + np.sqrt(rest)) * _ROUND, np.where(f.inside[:, :, None], loss, 0.0)

    def _squares(self, rows: Array, blur: Array) -> Array:
        """Upper bounds of |rho (g - ghat)|^2 for rows (W, N, n) known up to ``blur``."""
        n = rows.shape[2]
        spread = self.radius + 2 * (n + 2) * _UNIT * self.size
        size = np.abs(_along(rows, self.middle))
        size += _along(np.abs(rows), spread) + _along(blur, self.size)
        return np.asarray((size**2).sum(axis=-1))

    @cached_property
    def coordinates(self) -> Array:
        """Levels of the coordinates of Phi(t_e, s) M_s that together cost exp(shared_log): (W, n)."""
        f = self.frame
        n, count = f.basis.shape[-1], len(f.ends)
        if self.silent:
            return np.zeros((count, n))
        found = [self.variation(np.broadcast_to(row, (count, n))) for row in np.eye(n)]
        kappa = np.stack([kappa for kappa, _ in found], axis=1)
        losses = np.stack([loss for _, loss in found], axis=1)
        factor = self._factor(int(np.count_nonzero(kappa)))
        base = factor * kappa * _ROUND
        levels = base * (1 + 1e-9) + _TINY
        for _ in range(20):
            needed = base + self._rounding(losses, levels)
            if np.all(needed <= levels):
                return levels
            levels = needed * (1 + 1e-6) + _TINY
        return np.full_like(levels, np.inf)

    def _factor(self, count: int) -> float:
        return quantile(self.shared_log - float(np.log(4.0 * max(count, 1))) - 1e-12)

    @property
    def factor(self) -> float:
        """The levels of the coordinates in units of their kappa."""
        return self._factor(self.frame.basis.shape[-1] * len(self.frame.ends))

    def _rounding(self, losses: Array, levels: Array) -> Array:
        """What jumps of the rows add: losses (W, ..., N, n) times |M| at the nodes, where the coordinates hold."""
        f = self.frame
        # |M_i| at node k, seen from the window of piece k
        size = np.einsum("kij,kj->ki", np.abs(f.back[0]) + f.back[1], levels[f.window]) * _ROUND
        return np.asarray(np.einsum("w...ki,ki->w...", losses, size) * _ROUND)

    def along(self, rows: Array) -> MartingaleEvent:
        """The event along ``rows`` (N, n); its cost is infinite where no levels of the coordinates were found."""
        f = self.frame
        if self.silent:
            nothing = np.zeros(len(rows))
            return MartingaleEvent(kappa=np.zeros(len(f.ends)), window=f.window, starts=f.starts, cost=nothing)
        g, error = f.back
        exact = np.einsum("ki,kij->kj", rows, g)
        slack = np.einsum("ki,kij->kj", np.abs(rows), error) + 1e-14 * np.abs(exact)
        directions = (np.maximum.reduceat(exact, f.starts) + np.minimum.reduceat(exact, f.starts)) / 2
        kappa, loss = self.variation(directions)
        off = np.abs(exact - directions[f.window]) + slack
        levels = self.coordinates
        with np.errstate(invalid="ignore"):
            cost = np.einsum("ki,ki->k", off, levels[f.window]) + self._rounding(loss, levels)[f.window]
        cost = np.where(np.isnan(cost), np.inf, cost * _ROUND)  # 0 times an infinite level
        return MartingaleEvent(kappa=kappa, window=f.window, starts=f.starts, cost=cost)


class Windowed:
    """Windows of one response and the transition matrices from every node to their ends.

    Attributes
    ----------
    basis : ndarray, shape (W, N + 1, n, n)
        Phi(t_e, t_k) in floats, 0 after the window's end.
    inside : ndarray, shape (W, N)
        Which pieces lie before the window's end.
    bulge : ndarray, shape (N, n, n)
        How far a row may leave its chord inside a piece, per unit of its size.
    magnitude : ndarray, shape (W, N + 1, n, n)
        Absolute values of ``basis``.
    """

    def __init__(self, response: LinearResponse, cell: int) -> None:
        pieces, n = response.pieces, response.slope.shape[-1]
        h = self.step = response.step * (1 + 1e-14)
        a, k, dev = np.abs(response.slope[cell]), np.abs(response.drift[cell]), response.deviation[cell]
        self.transition, self.error = response.transition[cell], response.transition_error[cell]
        slope = a + h * k
        self.bulge = h * h / 8 * ((np.eye(n) + dev) @ (slope @ slope + k)) * _ROUND
        turn = max(float(np.linalg.norm(a, axis=(-2, -1)).max()) * response.step, 1e-12)
        most = max(4, min(_MOST_WINDOWS, _MOST_ENTRIES // (pieces * n * n)))
        length = max(1, round(_TURN / turn), -(-pieces // most)) if pieces > 1 else 1
        windows = WindowEvents(response, cell, min(length, max(1, pieces // 4)), 0.0)
        self.starts, self.ends = windows.bounds[:-1], windows.bounds[1:]
        self.window = np.repeat(np.arange(len(self.ends)), np.diff(windows.bounds))
        self.back = windows.back
        self.inside = np.arange(pieces)[None] < self.ends[:, None]
        self.basis = np.zeros((len(self.ends), pieces + 1, n, n))
        self.basis[np.arange(len(self.ends)), self.ends] = np.eye(n)
        for j in range(pieces - 1, -1, -1):
            later = self.inside[:, j]
            self.basis[later, j] = self.basis[later, j + 1] @ self.transition[j]
        self.magnitude = np.abs(self.basis)
        self._known: dict[bytes, tuple[Array, Array]] = {}

    def rows(self, directions: Array) -> tuple[Array, Array]:
        """The float rows rho = directions . basis (W, N + 1, n) and their `loss`; others ask for the same."""
        key = directions.tobytes()
        if key in self._known:
            return self._known[key]
        rows = np.einsum("wi,wkij->wkj", directions, self.basis)
        found = rows, self.loss(directions, rows[:, 1:])
        if (len(self._known) + 1) * rows.size <= _MOST_KEPT:
            self._known[key] = found
        return found

    def loss(self, directions: Array, late: Array) -> Array:
        """Entrywise bound of |rho_{k+1} F - rho_k| for the float rows rho = directions . basis: (W, N, n)."""
        n = late.shape[2]
        sizes = np.einsum("wi,wkij->wkj", np.abs(directions), self.magnitude)
        rounding = 6 * (n + 2) * _UNIT * np.einsum("wki,kij->wkj", sizes[:, 1:], np.abs(self.transition))
        own = 6 * (n + 2) * _UNIT * sizes[:, :-1]
        return np.asarray(rounding + own + np.abs(late).sum(axis=-1)[..., None] * self.error[:, None] + _TINY)


@dataclass(frozen=True, eq=False, kw_only=True)
class MartingaleEvent:
    """One family of rows: kappa of every window, and what a level loses to coordinates and rounding on every piece."""

    kappa: Array
    window: Index
    starts: Integers
    cost: Array

    @property
    def profile(self) -> Array:
        """Shape of levels: kappa, and the cost as it stands to a level of a few kappa."""
        return np.asarray(self.kappa[self.window] + self.cost / 4.0)

    def factor(self, log_probability: float) -> float:
        """About the number of kappas that are exceeded in some window with probability exp(log_probability)."""
        count = max(int(np.count_nonzero(self.kappa)), 1)
        return quantile(log_probability - float(np.log(2.0 * count)))

    def level(self, log_probability: float) -> Array:
        """Levels per piece that are exceeded with probability of at most exp(log_probability)."""
        factor = self.factor(log_probability)
        for wider in (1e-9, 1e-6, 1e-3):
            level = (factor * (1 + wider) * self.kappa)[self.window] + self.cost * (1 + wider)
            if self.log_exceedance(level) <= log_probability:
                return np.asarray(level)
        return np.full(len(self.cost), np.inf)

    def log_exceedance(self, levels: Array) -> float:
        """Upper bound of log P(exists t: rows[k] . M_t > levels[k] on piece k, no coordinate above its level)."""
        room = np.minimum.reduceat(level_left(levels, self.cost * _ROUND), self.starts)
        room = room - 4e-16 * np.abs(np.where(np.isfinite(room), room, 0.0))
        if np.any(room < 0):
            return 0.0
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            ratio = np.where(self.kappa > 0, room / self.kappa * (1 - 1e-14), np.inf)
        return min(logsumexp(log_tail(ratio) + np.log(2.0) * (1 + 1e-15)), 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class SplitEvent:
    """w . (Z + M) above a level: w . Z above a part of it, or w . M above the rest.

    ``gaussian`` is None where Z = 0.
    """

    gaussian: WindowEvent | SteadyEvent | None
    martingale: MartingaleEvent

    @property
    def profile(self) -> Array:
        """Shape of levels."""
        return self.martingale.profile + (0.0 if self.gaussian is None else self.gaussian.profile)

    def log_exceedance(self, levels: Array) -> float:
        """Upper bound of log P(exists t: rows[k] . (Z + M)_t > levels[k] on piece k), the best of a few splits."""
        return self.split(levels)[0]

    def split(self, levels: Array) -> tuple[float, float]:
        """That bound, and log of the probability granted to M in the best split (0 where all the room is M's)."""
        if self.gaussian is None:
            return self.martingale.log_exceedance(levels), 0.0
        base = self.gaussian.log_exceedance(levels)
        if not np.any(self.martingale.kappa) and not np.any(self.martingale.cost):
            return base, 0.0
        best, granted = 0.0, 0.0
        for less in _SPLITS:
            share = max(base - less, -1e8)
            part = self.martingale.level(share)
            base = self.gaussian.log_exceedance(level_left(levels, part * _ROUND))
            if base >= 0.0:
                break
            total = logsumexp(np.array([base, self.martingale.log_exceedance(part)]))
            if total < best:
                best, granted = total, share
        return best, granted


@dataclass(frozen=True, eq=False, kw_only=True)
class SplitEvents:
    """Events of Z + M: the Gaussian ones of Z (None where Z = 0) and the martingales of M."""

    gaussian: ClockEvents | WindowEvents | None
    martingales: Martingales

    @property
    def shared_log(self) -> float:
        """Log probability that all rows share."""
        gaussian = -np.inf if self.gaussian is None else self.gaussian.shared_log
        return logsumexp(np.array([gaussian, self.martingales.shared_log]))

    def along(self, rows: Array) -> SplitEvent:
        """The event along ``rows`` (pieces, n)."""
        gaussian = None if self.gaussian is None else self.gaussian.along(rows)
        return SplitEvent(gaussian=gaussian, martingale=self.martingales.along(rows))
