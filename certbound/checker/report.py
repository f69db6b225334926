"""What the checker answers, and how it says no."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from flint import ctx

from certbound.errors import CertboundError

VALID = "valid"
UNDER_ASSUMPTIONS = "valid under assumptions"
NOT_PROVED = "not proved"

MOST_BALLS = 16_000_000
"""About a gigabyte."""
BALL_BYTES = 64
"""Memory of a ball of 128 bits as python-flint holds it."""
SECOND = 10**9
"""Units of work that a second has: a unit is a nanosecond of the machine of the measurements below, or less.

Measured at 128 bits with Python 3.11 and python-flint 0.9 on one core of a server of 2.5 GHz: a sum or a product of two
balls takes 100 to 110 ns, a step of a program around it as much again; exp, sin, log and sqrt 250 to 700 ns, tanh and
powers 1,400 ns, erfc 3,100 ns, and of a wide ball both ends are taken; a product inside ball matrices takes 16 to 120
ns. At 1,000 bits products take 5 to 8 times as long, at 3,000 bits 15 to 40 times. NumPy takes 0.3 to 1 ns for a number
of an array, and about 1,500 ns for a call. The certificates of the tests count 0.4 to 5 units a
nanosecond of their check, 1.5 in the median: on a quiet machine the count ends most checks before the clock does.
"""
BALL, FUNCTION, PRODUCT, STEP = 300, 5_000, 50, 1_000
"""Units of an operation of balls, of an elementary function, of a product inside matrices, and of a step of a loop."""
UNLIMITED = 10**30

T = TypeVar("T")


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
    """Limits on the work, the memory and the number of boxes of a check; the clock stands behind them.

    Work and memory are counted before they are done and taken, in whole numbers of any size, from what the file asks
    for. What goes beyond a limit is `Unproved`.

    Parameters
    ----------
    seconds : float
        Work, in seconds of the machine that `SECOND` speaks of, and the limit on time.
    boxes : int
        Sub-boxes over all pieces together.
    balls : int
        Memory, in balls of 128 bits.
    clock : float, optional
        Limit on time in seconds, where it is another one.
    """

    def __init__(
        self, seconds: float, boxes: int = 2_000_000, balls: int = MOST_BALLS, *, clock: float | None = None
    ) -> None:
        self.started = time.monotonic()
        self.seconds, self.boxes = seconds, boxes
        self.work = int(seconds * SECOND) if math.isfinite(seconds) else UNLIMITED
        self.memory = balls * BALL_BYTES
        self._end = self.started + (seconds if clock is None else clock)
        self._more_work = f"the check needs more work than its limit of {seconds:g} s"
        self._made: dict[tuple[Any, ...], tuple[Any, Any]] = {}

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self.started

    # ---- work ------------------------------------------------------------------------------------------------

    def spend(self, units: int) -> None:
        """Count work before it is done."""
        self.work -= units
        if self.work < 0:
            raise Unproved(self._more_work)
        if time.monotonic() > self._end:
            raise Unproved(f"the check was not finished within its limit of {self.seconds:g} s")

    def expect(self, units: int) -> None:
        """Refuse work that is sure to be counted later on and will not fit, before any of it is done."""
        if units > self.work:
            raise Unproved(self._more_work)

    def check(self) -> None:
        """Count one step of a loop."""
        self.spend(STEP)

    def balls(self, count: int, units: int = BALL) -> None:
        """Count operations of balls, of so many units each at 128 bits."""
        bits = ctx.prec
        self.spend(count * units if bits <= 128 else count * units * bits * (3000 + bits) // (128 * 3000))

    def products(self, *shape: int) -> None:
        """Count products of ball matrices: of shapes (a, b) and (b, c) it is ``a, b, c``."""
        self.balls(math.prod(shape) + 100, PRODUCT)

    def floats(self, numbers: int, calls: int = 1) -> None:
        """Count operations of arrays: so many numbers in all, in so many calls."""
        self.spend(numbers + 2_000 * calls)

    def box(self) -> None:
        """Count one sub-box."""
        self.boxes -= 1
        if self.boxes < 0:
            raise Unproved("the check needs more sub-boxes than its limit")
        self.check()

    # ---- memory ----------------------------------------------------------------------------------------------

    def hold(self, count: int) -> None:
        """Take the memory of so many balls, before they are made."""
        self.take(count * BALL_BYTES * ctx.prec // 128)

    def take(self, size: int) -> None:
        """Take so many bytes, before they are used."""
        self.fits(size)
        self.memory -= size

    def give(self, size: int) -> None:
        """Give back so many bytes."""
        self.memory += size

    def fits(self, size: int) -> None:
        """Refuse arrays of so many bytes beside what is held, before they are made; they are gone soon."""
        if size > self.memory:
            raise Unproved("the check needs more memory than its limit")

    @contextmanager
    def passing(self) -> Iterator[None]:
        """Give back at the end what is held within."""
        memory = self.memory
        try:
            yield
        finally:
            self.memory = memory

    def once(self, about: object, key: tuple[Any, ...], make: Callable[[], T]) -> T:
        """What is made of an object, for all who ask: ``key`` says what, and which of the object's data count."""
        place = (id(about), *key)
        if place not in self._made:
            self._made[place] = about, make()  # the object is kept, so that its number stays its own
        found: T = self._made[place][1]
        return found


def unlimited() -> Budget:
    """No limits, for what is no check of a file."""
    return Budget(math.inf, UNLIMITED, UNLIMITED)
