"""``--time-limit``: the best answer after some seconds."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import Annotated

import typer

from certbound.cli.messages import InputError
from certbound.cli.options import number, option
from certbound.watch import OutOfTime


def positive(text: str) -> float:
    """A positive number of seconds from the command line.

    Examples
    --------
    >>> positive("2.5")
    2.5
    """
    value = number(text)
    if value <= 0:
        raise typer.BadParameter(f"must be positive, got `{text}`")
    return value


TimeLimitOption = Annotated[
    float | None, option("--time-limit", "SECONDS", "Stop searching then, and give the best answer so far.", positive)
]
VerdictLimitOption = Annotated[
    float | None, option("--time-limit", "SECONDS", "Stop then, with the best answer so far [60].", positive)
]


class Clock:
    """Time that is left of a limit; None is no limit."""

    def __init__(self, limit: float | None) -> None:
        self.limit = limit
        self.started = time.perf_counter()

    @property
    def left(self) -> float:
        """Seconds left (infinite without a limit)."""
        return float("inf") if self.limit is None else self.limit - (time.perf_counter() - self.started)

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Raise ``OutOfTime`` in the block when the time is over (between two steps of Python).

        InputError on systems without interval timers.
        """
        if self.limit is None:
            yield
            return
        if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
            raise InputError("`--time-limit` needs a system with interval timers", "leave it out")
        if self.left <= 0:
            raise OutOfTime

        def stop(number: int, frame: FrameType | None) -> None:
            raise OutOfTime

        before = signal.signal(signal.SIGALRM, stop)
        signal.setitimer(signal.ITIMER_REAL, self.left)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
