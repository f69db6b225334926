"""What a linearisation leaves over, bounded over boxes of the deviation."""

from __future__ import annotations

from certbound.reach.remainder.bound import Remainder
from certbound.reach.remainder.frame import Frame
from certbound.reach.remainder.held_remainder import HeldFrame, HeldRemainder
from certbound.reach.remainder.jumps import hidden_jump

__all__ = ["Frame", "HeldFrame", "HeldRemainder", "hidden_jump", "Remainder"]
