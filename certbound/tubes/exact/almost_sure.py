"""The almost-sure bound of bounded noise (DT): b_{t+1} = L_t b_t + h_t with ||w_t|| <= h_t (item 7.14).

It holds with probability one, so that the pointwise minimum with any tube is a tube of the same level.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from flint import arb

from certbound.arrays import Array
from certbound.rigor.balls import precision
from certbound.tubes.piecewise import MonotoneProfile


@dataclass(frozen=True, eq=False, kw_only=True)
class AlmostSureProfile(MonotoneProfile):
    """b_t from b_0 = ``start``."""

    bounds: Array  # (K,): h per piece
    start: float = 0.0  # bound of ||S_0||

    def to_dict(self) -> dict[str, Any]:
        """Parameters as plain data."""
        return {"kind": "almost sure", "bounds": self.bounds.tolist(), "start": self.start}

    @cached_property
    def _nodes(self) -> list[arb]:
        with precision():
            nodes = [arb(self.start)]
            for piece, length in enumerate(self.schedule.lengths.tolist()):
                nodes.append(self._advance(nodes[-1], piece, length))
            return nodes

    def _advance(self, b: arb, piece: int, steps: float) -> arb:
        gain, bound = arb(float(self.schedule.slopes[piece])), arb(float(self.bounds[piece]))
        power = gain ** round(steps)
        total = arb(steps) if gain == 1 else (power - 1) / (gain - 1)
        return power * b + bound * total

    def point(self, piece: int, t: float) -> arb:
        """b_t, which is monotone on a piece."""
        return self._advance(self._nodes[piece], piece, t - float(self.schedule.times[piece]))
