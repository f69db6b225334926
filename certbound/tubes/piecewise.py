"""What profiles over the pieces of a schedule share."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.rigor.balls import precision, upper
from certbound.tubes.schedule import Schedule
from certbound.tubes.tube import monotone


@dataclass(frozen=True, eq=False, kw_only=True)
class PiecewiseProfile:
    """A profile over the pieces of ``schedule``; what it has computed is not pickled."""

    schedule: Schedule

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def grid(self) -> Schedule:
        """The data on the pieces of the radius."""
        return self.schedule

    @property
    def times(self) -> Array:
        """Piece ends."""
        return self.grid.times


class MonotoneProfile(PiecewiseProfile):
    """A radius that is monotone on a piece and quick to evaluate in balls."""

    @abstractmethod
    def point(self, piece: int, t: float) -> arb:
        """The radius at a time of a piece."""

    def radius(self, t: Array) -> Array:
        """Radius, rounded up."""
        flat = np.ravel(t)
        pieces = self.grid.locate(flat)
        with precision():
            values = [upper(self.point(int(k), x)) for k, x in zip(pieces, flat.tolist())]
        return np.array(values).reshape(np.shape(t))

    def stretch(self, piece: int, start: float, end: float) -> tuple[float, float]:
        """The larger of the radii at both ends, and the one at ``end``."""
        return monotone(lambda t: self.point(piece, t), start, end)

    def rough(self, piece: int, start: float, end: float) -> float:
        """The bound itself: it is quick."""
        return self.stretch(piece, start, end)[0]
