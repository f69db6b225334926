"""The inclusion of Thm K7: an enclosure of the remainder beta that proves itself, for all cells and pieces at once.

beta is bounded over a polytope of deviations s = y + Z + R, and R follows from beta: bounds that imply no more than the
polytope over which they hold are proved. Sampled ranges guess them.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from certbound.arrays import Array
from certbound.reach.linear.inclusion import Supports
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.rows import inner_rows
from certbound.watch import poll

_LOG = logging.getLogger(__name__)

_GUESSES = 30
_PICARD = 12
_HUGE = 1e6  # times what a row sees of the nominal states, the initial set and the noise: beyond all use
_ROUNDING = 1e-12  # share of a typical remainder that its guess is widened by, so that it may be 0
PADS = (0.15, 0.1, 0.06, 0.04)  # how much wider than the sampled range the first guess is, by effort
_REPAIRS, _REPAIRED = 4, 0.03  # times that pieces are tried again, each with so much more room
_WIDER = 0.05  # of the remainder's share in a polytope


class Inclusion:
    """Supports of y and R for all cells of a linearisation, and the bounds of beta that they prove.

    ``learnt`` is what the last proof needed beyond the sampled range of beta, (B, N, n) each: where it is given, the
    first guess is made with it.
    """

    def __init__(self, engine: Linearisation) -> None:
        self.engine = engine
        self.failed_at = 0
        self.learnt: tuple[Array, Array] | None = None

    @cached_property
    def _rows(self) -> tuple[Array, Array]:
        return inner_rows(self.engine)

    @property
    def rows(self) -> Array:
        """The inner rows."""
        return self._rows[0]

    @property
    def extra(self) -> Array:
        """Those beside the active coordinates, over these alone."""
        return self._rows[1]

    @property
    def inner(self) -> int:
        """How many inner rows there are on a piece."""
        return int(self.rows.shape[2])

    def outer(self, cell: int) -> Sequence[Array]:
        """Rows of a cell that R is bounded along beside the inner ones: (N, n) each, (N + 1, n) in discrete time."""
        return ()

    @cached_property
    def supports(self) -> list[Supports]:
        """The supports of every cell, along the inner rows first."""
        return [self._supports(cell, self.outer(cell)) for cell in range(self.engine.cells)]

    @cached_property
    def inner_supports(self) -> list[Supports]:
        """The same along the inner rows alone, of which a fixed point asks again and again."""
        return [self._supports(cell, ()) for cell in range(self.engine.cells)]

    def _supports(self, cell: int, outer: Sequence[Array]) -> Supports:
        inner = self.rows[cell]
        if not self.engine.continuous:
            inner = np.concatenate([inner, np.zeros((1, *inner.shape[1:]))])
        rows = np.concatenate([inner, *(rows[:, None] for rows in outer)], axis=1)
        return self.engine.supports(cell, rows, self.engine.moved)

    @property
    def nothing(self) -> tuple[Array, Array]:
        """Bounds of a remainder that is 0."""
        return np.zeros(self.engine.shape), np.zeros(self.engine.shape)

    @property
    def curved(self) -> bool:
        """Whether the model leaves a remainder at all."""
        return bool(len(self.engine.model.active))

    def polytope(self, levels: Array, remainder: list[tuple[Array, Array]]) -> tuple[Array, Array]:
        """Bounds of s = y + Z + R along the inner rows over all pieces: (B N, D)."""
        n = self.engine.pieces
        lows, highs = [], []
        for support, level, (r_lo, r_hi) in zip(self.inner_supports, levels, remainder, strict=True):
            y = support.y[:n]
            lows.append(-y - level + r_lo[:n, : self.inner])
            highs.append(y + level + r_hi[:n, : self.inner])
        low, high = np.concatenate(lows), np.concatenate(highs)
        slack = 4e-16 * (np.abs(low) + np.abs(high))
        return low - slack, high + slack

    def include(self, levels: Array, effort: int) -> tuple[Array, Array] | None:
        """beta's bounds (B, N, n) that prove themselves, or None (``failed_at`` then names a piece)."""
        engine = self.engine
        self.failed_at = engine.pieces - 1
        # what the proof needs beyond the sampled range
        least = _ROUNDING * engine.remainder_sizes
        below = above = engine.model.defect(engine.frame).reshape(engine.shape) * 1.05 + least
        if self.learnt is not None:
            below, above = (np.maximum(own, known) for own, known in zip((below, above), self.learnt))
        low, high = self.nothing
        for attempt in range(_PICARD):
            first = attempt == 0 and self.learnt is None
            guess = self.guess(levels, (low, high), (below, above), PADS[effort] if first else 0.02)
            if guess is None:
                return None
            low, high = guess
            implied = self.deviations(levels, low, high)
            if implied is None:
                return None
            polytope = self._wider(levels, implied)
            found = self._closed(levels, polytope, guess, effort)
            if found is None:
                return None
            closed, b_low, b_high = found
            if closed:
                self.learnt = below, above
                return b_low, b_high
            _LOG.debug("inclusion %d: widths %s, beyond the guess by %.3g", attempt, (b_high - b_low).max(
                axis=(0, 2))[:: max(1, engine.pieces // 8)].round(4), max(np.max(low - b_low), np.max(b_high - high)))
            sample = self.sampled(polytope)
            below = np.maximum(1.02 * (sample[0] - b_low), 0.0) + least
            above = np.maximum(1.02 * (b_high - sample[1]), 0.0) + least
        return None

    def _closed(
        self, levels: Array, polytope: tuple[Array, Array], hoped: tuple[Array, Array], effort: int
    ) -> tuple[bool, Array, Array] | None:
        """Bounds of beta over a polytope, and whether what they imply lies in it: then they prove themselves.

        Pieces on which it does not are tried again over a larger part. None where a bound is infinite.
        """
        engine, shape = self.engine, self.engine.shape
        (p_low, p_high), target = polytope, [b.reshape(-1, engine.n) for b in hoped]
        low, high = (part.reshape(-1, engine.n) for part in self.nothing)
        again = np.arange(len(p_low))
        for _ in range(_REPAIRS):
            poll("remainder of the linearisation")
            found = engine.model.bound(
                engine.frame, p_low, p_high, self.flat_extra, effort, (target[0], target[1]), again)
            low[again], high[again] = found[0][again], found[1][again]
            b_low, b_high = low.reshape(shape), high.reshape(shape)
            implied = self.deviations(levels, b_low, b_high) if self._all_finite(b_low, b_high) else None
            if implied is None:
                return None
            again = np.flatnonzero(((implied[0] < p_low) | (implied[1] > p_high)).any(axis=1))
            if not len(again):
                return True, b_low, b_high
            if 2 * len(again) > len(p_low):
                break
            wider = self._wider(levels, implied)
            p_low, p_high = p_low.copy(), p_high.copy()
            p_low[again], p_high[again] = wider[0][again], wider[1][again]
            room = _REPAIRED * (high - low)
            target = [low - room, high + room]
        return False, b_low, b_high

    def _wider(self, levels: Array, implied: tuple[Array, Array]) -> tuple[Array, Array]:
        """A polytope with the remainder's share enlarged a little: room for bounds that differ a little."""
        base = self.deviations(levels, *self.nothing)
        if base is None:
            return implied
        return implied[0] - _WIDER * np.abs(implied[0] - base[0]), implied[1] + _WIDER * np.abs(implied[1] - base[1])

    def guess(
        self, levels: Array, start: tuple[Array, Array], widening: tuple[Array, Array], share: float
    ) -> tuple[Array, Array] | None:
        """The fixed point of the sampled range of beta, widened by ``share`` of itself and by what a proof needed."""
        low, high = start
        for _ in range(_GUESSES):
            poll("a guess of the remainder")
            polytope = self.deviations(levels, low, high)
            if polytope is None:
                return None
            old = low, high
            sample = self.sampled(polytope)
            if not self._all_finite(*sample):
                return None
            pad = share * (sample[1] - sample[0])
            low, high = sample[0] - widening[0] - pad, sample[1] + widening[1] + pad
            if not self._all_finite(low, high):
                return None
            change = max(float(np.max(old[0] - low)), float(np.max(high - old[1])))
            if change <= 1e-3 * float(np.max(high - low)):
                break
        return low, high

    @property
    def flat_extra(self) -> Array:
        """The extra rows over the active coordinates, cells and pieces in one batch."""
        return self.extra.reshape(self.extra.shape[0] * self.extra.shape[1], *self.extra.shape[2:])

    def sampled(self, polytope: tuple[Array, Array]) -> list[Array]:
        """Range of beta over sample points: two arrays (B, N, n)."""
        engine = self.engine
        found = engine.model.sampled(engine.frame, *polytope, self.flat_extra)
        return [b.reshape(engine.shape) for b in found]

    def _all_finite(self, low: Array, high: Array) -> bool:
        """Whether all bounds are finite; if not, ``failed_at`` names the first piece."""
        finite = np.isfinite(low) & np.isfinite(high)
        if not finite.all():
            self.failed_at = int(np.argmax((~finite).any(axis=(0, 2))))
        return bool(finite.all())

    def deviations(self, levels: Array, low: Array, high: Array) -> tuple[Array, Array] | None:
        """The polytope that bounds on beta imply, or None where it is beyond all use."""
        reach = [s.remainder(lo, hi)[:2] for s, lo, hi in zip(self.inner_supports, low, high, strict=True)]
        p_low, p_high = self.polytope(levels, reach)
        with np.errstate(invalid="ignore"):
            beyond = ~(np.isfinite(p_low) & np.isfinite(p_high)) | (p_high - p_low > self._limit(levels))
        if beyond.any():
            self.failed_at = int(np.argmax(beyond.any(axis=1).reshape(len(low), -1).any(axis=0)))
            return None
        return p_low, p_high

    def _limit(self, levels: Array) -> Array:
        """The widest polytope that is of any use, in the units of every row: (B N, D)."""
        count = self.engine.pieces
        moved = np.stack([2 * support.y[:count] for support in self.inner_supports]) + 2 * levels
        size = np.abs(self.rows) @ self.engine.sizes + moved
        widest = np.broadcast_to(size.max(axis=(0, 1), initial=0.0), (size.shape[0] * count, self.inner))
        return np.where(widest > 0, _HUGE * widest, np.inf)
