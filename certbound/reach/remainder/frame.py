"""Nominal data of pieces of time, as enclosures: what bounds of the remainder start from."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from certbound.arrays import Array, Integers
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
    beside: Interval | None = None  # inputs that rows of the plan may have on a part of the piece, where they jump
    part: float = 0.0  # that part of its length, at the most

    def __len__(self) -> int:
        return len(self.spread)

    def taken(self, index: Integers) -> Frame:
        """Some of the pieces."""
        whole = {"half", "part", "disturbance_middle", "disturbance_low", "disturbance_high"}
        whole |= {"beside"} if self.beside is None else set()
        names = [entry.name for entry in fields(self) if entry.name not in whole]
        return replace(self, **{name: getattr(self, name)[index] for name in names})
