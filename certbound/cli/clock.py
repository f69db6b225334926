"""``--time-limit``: the best answer after some seconds."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Annotated

import typer

from certbound.cli.options import number, option
from certbound.cli.output import SETTINGS
from certbound.watch import OutOfTime, Progress, Watch


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
LimitOption = Annotated[
    float | None, option("--time-limit", "SECONDS", "Give up then, where there is no answer yet.", positive)
]
VerdictLimitOption = Annotated[
    float | None, option("--time-limit", "SECONDS", "Stop then, with the best answer so far [60].", positive)
]


class Clock:
    """Time that is left of a limit (None is no limit), and who hears of progress.

    It counts from where the command began: to load the program and to read the problem take time as well.
    """

    def __init__(self, limit: float | None, tell: Callable[[Progress], object] | None = None) -> None:
        self.limit = limit
        self.started = time.perf_counter() if SETTINGS.began is None else SETTINGS.began
        self._tell = tell

    @property
    def left(self) -> float:
        """Seconds left (infinite without a limit)."""
        return float("inf") if self.limit is None else self.limit - (time.perf_counter() - self.started)

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Raise ``OutOfTime`` in the block when the time is over, and tell what it is at."""
        if self.left <= 0:
            raise OutOfTime
        with Watch(None if self.limit is None else self.left, progress=self._tell).running():
            yield
