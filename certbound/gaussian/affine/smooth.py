"""Crossings of a row without noise of its own (a G = 0): Rice's formula over the pieces of its trace."""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array, Integers
from certbound.gaussian.affine.row_windows import crude_parts
from certbound.gaussian.affine.trace import Trace
from certbound.gaussian.scalar import log_crossings
from certbound.rigor.rounding import quiet

PARTS = 8  # of a piece, over each of which the variance is enclosed about its chord
_WEIGHTS = np.arange(PARTS + 1) / PARTS


def _ends(values: Array) -> tuple[Array, Array]:
    """Least and largest of neighbouring columns."""
    return np.minimum(values[:, :-1], values[:, 1:]), np.maximum(values[:, :-1], values[:, 1:])


def _chord(first: Array, last: Array) -> Array:
    return first[:, None] + (last - first)[:, None] * _WEIGHTS


@quiet
def smooth_parts(trace: Trace, lines: Array, chosen: Integers) -> tuple[Array, Array, Array, Array]:
    """What crossing ``lines`` (K, 2) costs: at the start, piece by piece, about that without enclosures, and at the
    highest rate of each piece (infinite where what is sure from any start costs less than crossings).

    Natural logarithms; of the ``chosen`` pieces, which follow each other. The variance has the slope 2 c, so that it
    lies within h (sup c - inf c)/2 of its chord.
    """
    pick, after = chosen, chosen + 1
    h = trace.steps[pick]
    c_low, c_high = (x[pick] for x in trace.cross_of())
    s_low, s_high = (x[pick] for x in trace.spread_of())
    e_low, e_high = (x[pick] for x in trace.speed_of())
    bend = 0.5 * h * (c_high - c_low) * (1 + 1e-14)
    low, _ = _ends(_chord(trace.s[0][pick], trace.s[0][after]) * (1 - 1e-15))
    _, high = _ends(_chord(trace.s[1][pick], trace.s[1][after]) * (1 + 1e-15))
    low = np.maximum(low - bend[:, None], s_low[:, None]) * (1 - 1e-15)
    high = np.maximum(np.minimum(high + bend[:, None], s_high[:, None]) * (1 + 1e-15), low)
    line = _chord(lines[pick, 0], lines[pick, 1])
    line = line - 4e-16 * np.abs(line)
    levels = np.stack([line[:, :-1], line[:, 1:]], axis=-1).reshape(-1, 2)
    spans = np.repeat(h / PARTS, PARTS)

    def flat(values: Array) -> Array:
        return np.asarray(np.repeat(values, PARTS))

    start = (trace.s[0][pick[0]].clip(0.0), trace.s[1][pick[0]])
    first, rates, jumps = log_crossings(
        spans, levels, (low.ravel(), high.ravel()), (flat(c_low), flat(c_high)), (flat(e_low), flat(e_high)),
        start_variance=start,
    )  # fmt: skip
    rates[1:] = np.logaddexp(rates[1:], jumps)
    chords = [_chord(end[pick], end[after]) for end in trace.s]
    middle = 0.5 * (chords[0][:, :-1] + chords[1][:, 1:])
    c = 0.5 * (c_low + c_high)
    e = 0.25 * (trace.e[0][pick] + trace.e[1][pick] + trace.e[0][after] + trace.e[1][after])
    at = levels + flat(trace.chord_error[pick])[:, None]
    _, about, _ = log_crossings(spans, at, middle.ravel().clip(1e-290), flat(c), flat(e).clip(1e-290))
    peaks = np.max(rates.reshape(-1, PARTS), axis=1) + np.log(PARTS) + 1e-13
    crude, pieces = crude_parts(trace, lines, chosen).costs, _sums(rates)
    least = np.min(lines[pick], axis=1)
    blurred = (least <= 0) & (least + trace.chord_error[pick] > 0)  # the start and jumps cost more than crossings there
    pieces = np.where(blurred, np.maximum(pieces, 0.0), pieces)
    crossed = (pieces <= crude) & ~blurred
    about, peaks = np.where(crossed, _sums(about), -np.inf), np.where(crossed, peaks, np.inf)
    return first, np.fmin(pieces, crude), about, peaks


def _sums(logs: Array) -> Array:
    return np.asarray(np.logaddexp.reduce(logs.reshape(-1, PARTS), axis=1))
