"""What the checker answers, and how it says no."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from flint import ctx

from certbound.errors import CertboundError

VALID = "valid"
UNDER_ASSUMPTIONS = "valid under assumptions"
NOT_PROVED = "not proved"

MOST_BALLS = 16_000_000
"""About a gigabyte."""


class Unproved(CertboundError):
    """An inequality that the certificate needs could not be proved; the message names it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Report:
    """The answer about one certificate."""

    # whether the claim may be relied on: every inequality was proved again, and nothing had to be assumed, unless
    # whoever asked allows assumptions
    valid: bool
    claim: str  # what the certificate claims, in words: for which disturbances, and under which assumptions
    reason: str  # what was proved, or the first thing that could not be
    seconds: float  # time taken
    log10_delta: float  # the claimed bound on log10 of the probability
    log10_proved: float | None = None  # the bound that the checker itself arrived at (None where it did not)
    log10_lower: float | None = None  # the claimed lower bound, of a certificate that claims one (and no upper one)
    log10_lower_proved: float | None = None  # the lower bound that the checker itself arrived at
    # what the proof takes for granted, derived from the proof itself, and what the file says besides
    assumptions: tuple[str, ...] = ()
    proved: bool = False  # whether every inequality was proved again but for the assumptions

    @property
    def outcome(self) -> str:
        """`VALID`, `UNDER_ASSUMPTIONS` or `NOT_PROVED`, whatever is allowed."""
        if not self.proved:
            return NOT_PROVED
        return UNDER_ASSUMPTIONS if self.assumptions else VALID


class Budget:
    """Limits on the checker's own time, number of boxes and memory.

    ``boxes`` are sub-boxes over all pieces together, ``balls`` balls of 128 bits held at a time, each some 50 to 100
    bytes. What goes beyond a limit is `Unproved`.
    """

    def __init__(self, seconds: float, boxes: int = 2_000_000, balls: int = MOST_BALLS) -> None:
        self.started = time.monotonic()
        self.seconds, self.boxes, self.balls = seconds, boxes, balls

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self.started

    def check(self) -> None:
        """Stop when the time is used up."""
        if self.elapsed > self.seconds:
            raise Unproved(f"the check was not finished within its limit of {self.seconds:g} s")

    def box(self) -> None:
        """Count one sub-box."""
        self.boxes -= 1
        if self.boxes < 0:
            raise Unproved("the check needs more sub-boxes than its limit")
        self.check()

    def hold(self, count: int) -> None:
        """Take the memory of so many balls, before they are made."""
        self.balls -= count * ctx.prec // 128
        if self.balls < 0:
            raise Unproved("the check needs more memory than its limit")

    @contextmanager
    def passing(self) -> Iterator[None]:
        """Give back at the end what is held within."""
        balls = self.balls
        try:
            yield
        finally:
            self.balls = balls
