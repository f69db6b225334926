"""How the linear response divides a probability: every split of delta has its name here, and nowhere a number.

A share is a probability that events may cost together, as its natural logarithm. delta_N, which the levels along the
inner rows cost, is tried at a few parts of delta; a tenth of it goes to the coordinates that all rows share, and the
rest to the sides of the rows. What is left of delta is for the requirements, or for the tube.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

HOPED = ((0.1, 1), (0.3, 2), (0.8, 3))
"""Parts of the target that delta_N is proved at, each with the effort."""
HOPED_LINEAR = ((0.02, 1), (0.2, 1))
"""The same for a linear model, where only windows ask for any."""
GUESSED = ((0.1, 1), (0.1, 3), (0.3, 3), (0.6, 3), (0.85, 3))
"""The same where a guess of the remainder tells which have a chance."""
LIKELIER = (0.01, 0.05, 0.2)
"""delta_N itself, where nothing was proved near the target."""
FITTED = 0.3
"""Part of delta whose deviations the slopes are fitted over."""


@dataclass(frozen=True)
class Share:
    """A probability that may be spent, as its natural logarithm."""

    log: float

    @classmethod
    def of(cls, probability: float) -> Share:
        """The share of a probability as it is."""
        return cls(float(np.log(probability)))

    def part(self, fraction: float) -> Share:
        """A fraction of it."""
        return Share(self.log + float(np.log(fraction)))

    def half(self) -> Share:
        """One of two halves, but for the rounding of the logarithm: Z and M may each cost one."""
        return Share(self.log + float(np.log(0.5)) * (1 + 1e-15))

    def common(self, rows: int = 1) -> Share:
        """What the coordinates that all rows share may cost: a tenth, or all of it where there are no rows."""
        return self.part(0.1 if rows else 1.0)

    def stated(self, *, linear: bool = False) -> Share:
        """What a certificate tries for delta_N besides the engine's own; of a linear model only windows ask for any."""
        return self.part(0.02 if linear else 0.3)

    def side(self, rows: int, *, terms: int = 1) -> Share:
        """What one side of one row may cost for each of the ``terms`` of the deviation, beside `common`."""
        return self.part(0.9 / (2 * terms * max(rows, 1)))
