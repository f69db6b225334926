"""The almost-sure bound of bounded noise (DT): b_{t+1} = L_t b_t + h_t with ||w_t|| <= h_t (item 7.14).

It holds with probability one, so that the pointwise minimum with any tube is a tube of the same level.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from flint import arb
from numpy.typing import NDArray

from certbound.rigor.balls import precision, upper
from certbound.tubes.schedule import Schedule
from certbound.tubes.tube import monotone

__all__ = ["AlmostSureProfile"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class AlmostSureProfile:
    """b_t from b_0 = ``start``.

    Parameters
    ----------
    schedule : Schedule
        Gains.
    bounds : ndarray (K,)
        h per piece.
    start : float
        Bound of ||S_0||.
    """

    schedule: Schedule
    bounds: Array
    start: float = 0.0

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    @property
    def times(self) -> Array:
        """Piece ends of the schedule."""
        return self.schedule.times

    def to_dict(self) -> dict[str, Any]:
        """Parameters as plain data."""
        return {"kind": "almost sure", "bounds": self.bounds.tolist(), "start": self.start}

    def radius(self, t: Array) -> Array:
        """Radius, rounded up."""
        flat = np.ravel(t)
        pieces = self.schedule.locate(flat)
        with precision():
            values = [upper(self._point(int(k), x)) for k, x in zip(pieces, flat.tolist())]
        return np.array(values).reshape(np.shape(t))

    def stretch(self, piece: int, start: float, end: float) -> tuple[float, float]:
        """b_t is monotone on a piece."""
        return monotone(lambda t: self._point(piece, t), start, end)

    def rough(self, piece: int, start: float, end: float) -> float:
        """The bound itself: it is quick."""
        return self.stretch(piece, start, end)[0]

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

    def _point(self, piece: int, t: float) -> arb:
        return self._advance(self._nodes[piece], piece, t - float(self.schedule.times[piece]))
