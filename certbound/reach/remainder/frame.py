"""Nominal data of pieces of time, as enclosures: what bounds of the remainder start from."""

from __future__ import annotations

from dataclasses import dataclass

from certbound.arrays import Array
from certbound.rigor.intervals import Interval


@dataclass(frozen=True, eq=False, kw_only=True)
class Frame:
    """Nominal data of a batch of pieces (axis 0), as enclosures.

    ``velocity`` encloses p' over the piece and ``middle_velocity`` at t_m (in discrete time the next node);
    ``spread`` bounds |p_t - p(t_m)|. ``half`` is half the length of a piece (0 in discrete time).
    """

    half: float
    middle_time: Interval
    span: Interval
    middle: Interval
    spread: Array
    middle_velocity: Interval
    velocity: Interval
    middle_acceleration: Interval
    acceleration: Interval
    jerk: Interval
    slope: Interval
    drift: Array
    input_gain: Array
    inputs: Array
    disturbance_middle: Array
    disturbance_low: Array
    disturbance_high: Array

    def __len__(self) -> int:
        return len(self.spread)
