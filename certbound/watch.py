"""How long work may take, and who hears of it: long loops ask at every step, and engines say what they are at.

A loop that may be long calls `poll` with a word on what it does. Where nobody watches this costs next to nothing; where
somebody does, he is told, and once the time is over `OutOfTime` ends the work. What was proved until then is with
whoever asked for it.
"""

from __future__ import annotations

import contextlib
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from types import FrameType
from typing import Any

_OFTEN = 0.25  # seconds between two reports that say nothing new
_GRACE = 0.05  # of the limit, and seconds, after which a timer ends what does not poll
_AGAIN = 1.0  # seconds after which it does so again, should its exception have been lost
_SOON = 0.05  # the same where a module was being loaded
_HELD: list[bool] = []  # for every block of the main thread that must not be interrupted


class OutOfTime(BaseException):
    """The time limit has passed; like KeyboardInterrupt, it is no error that a handler may swallow."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Progress:
    """What is being done, and what is proved so far.

    Parameters
    ----------
    engine, phase : str
        Who is at work (empty: nobody yet), and on what.
    log10_delta : float
        log10 of the smallest bound of the probability so far; 0 where there is none.
    log10_lower : float or None
        log10 of the largest lower bound so far.
    seconds : float
        Spent.
    limit : float or None
        Seconds that may be spent.
    """

    engine: str
    phase: str
    log10_delta: float
    log10_lower: float | None
    seconds: float
    limit: float | None


class Watch:
    """A limit of time, and a callback that hears of progress.

    Parameters
    ----------
    limit : float, optional
        Seconds; None: as long as it takes.
    progress : callable, optional
        Called with a `Progress` whenever the phase or a bound changes, and about four times a second.
    clock : callable
        Seconds from any beginning.
    jobs : int
        Processes that may work side by side.
    executor : concurrent.futures.Executor or dask Client, optional
        Who works instead.
    patient : bool
        Whether somebody waits until the limit for an answer that is worth it, rather than for an answer.
    started : float, optional
        Since when the limit counts, by the clock; since now when omitted.
    """

    def __init__(
        self, limit: float | None = None, *, progress: Callable[[Progress], object] | None = None,
        clock: Callable[[], float] = time.perf_counter, jobs: int = 1, executor: Any = None, patient: bool = False,
        started: float | None = None,
    ) -> None:
        if limit is not None and not (isinstance(limit, (int, float)) and 0 < limit < math.inf):
            raise ValueError(f"`time_limit` must be a positive number of seconds, got {limit!r}.")
        if isinstance(jobs, bool) or int(jobs) != jobs or jobs < 1:
            raise ValueError(f"`jobs` must be a positive number of processes, got {jobs!r}.")
        if progress is not None and not callable(progress):
            raise TypeError(f"`progress` must be a function of what is being done, got {progress!r}.")
        self.jobs, self.executor, self.patient = int(jobs), executor, patient
        self.limit, self._progress, self._clock = limit, progress, clock
        self.started = clock() if started is None else started
        self._end = math.inf if limit is None else self.started + limit
        self._told, self._said = -math.inf, ""
        self._alarm: tuple[float, Callable[[], object]] | None = None
        self.engine, self.phase = "", ""
        self.log10_delta: float = 0.0
        self.log10_lower: float | None = None

    def silence(self) -> None:
        """Tell no more, and interrupt nothing for others."""
        self._progress = self._alarm = None

    @property
    def spent(self) -> float:
        """Seconds since it began."""
        return self._clock() - self.started

    @property
    def left(self) -> float:
        """Seconds that the work at hand may still take (infinite without a limit)."""
        return self._end - self._clock()

    def poll(self, phase: str = "") -> None:
        """Note what is done, tell it, and raise ``OutOfTime`` where the time is over."""
        if phase:
            self.phase = phase
        now = self._clock()
        if self._progress is not None and (self._news != self._said or now - self._told >= _OFTEN):
            self.tell()
        if now >= self._end:
            raise OutOfTime
        if self._alarm is not None and now >= self._alarm[0]:
            call, self._alarm = self._alarm[1], None
            place = self.engine, self.phase
            try:
                call()
            finally:
                self.engine, self.phase = place

    @property
    def _news(self) -> str:
        return f"{self.engine} {self.phase} {self.log10_delta} {self.log10_lower}"

    def tell(self) -> None:
        """Call the callback."""
        self._told, self._said = self._clock(), self._news
        if self._progress is not None:
            self._progress(
                Progress(
                    engine=self.engine, phase=self.phase, log10_delta=self.log10_delta, log10_lower=self.log10_lower,
                    seconds=self.spent, limit=self.limit,
                )
            )

    def noted(self, log10_delta: float, log10_lower: float | None = None) -> None:
        """Keep better bounds, and tell them."""
        self.log10_delta = min(self.log10_delta, log10_delta)
        if log10_lower is not None:
            self.log10_lower = log10_lower if self.log10_lower is None else max(self.log10_lower, log10_lower)
        if self._news != self._said:
            self.tell()

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Let `poll` and `seconds_left` speak of this watch within the block.

        Where the system and the thread allow it, a timer ends what does not poll, a little after the limit.
        """
        before, token = _CURRENT.get(), _CURRENT.set(self)
        try:
            with contextlib.nullcontext() if before is self else self._timed():
                yield
        finally:
            _CURRENT.reset(token)

    @contextlib.contextmanager
    def _timed(self) -> Iterator[None]:
        main = threading.current_thread() is threading.main_thread()
        if self.limit is None or self._clock is not time.perf_counter or not main or not hasattr(signal, "setitimer"):
            yield
            return

        loading = _loading(sys._getframe())

        def stop(number: int, frame: FrameType | None) -> None:
            if _HELD or _loading(frame) > loading:  # a library that is loaded by half is broken for good
                signal.setitimer(signal.ITIMER_REAL, _SOON, _AGAIN)
                return
            raise OutOfTime

        def lost(what: sys.UnraisableHookArgs) -> None:
            if not isinstance(what.exc_value, OutOfTime):  # into a callback of compiled code; the timer goes on
                told(what)

        told, sys.unraisablehook = sys.unraisablehook, lost
        before, began = signal.signal(signal.SIGALRM, stop), time.perf_counter()
        alarm = max(self.left, 0.0) + _GRACE * self.limit + _GRACE
        outer, again = signal.setitimer(signal.ITIMER_REAL, alarm, _AGAIN)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
            sys.unraisablehook = told
            if outer > 0:  # a timer of a watch around this one goes on
                signal.setitimer(signal.ITIMER_REAL, max(outer - (time.perf_counter() - began), _GRACE), again)

    @contextlib.contextmanager
    def share(self, part: float, most: float = math.inf) -> Iterator[None]:
        """Leave a part of the time to the block, at ``most`` so many seconds, and end it quietly then, unless the whole
        of it is over.
        """
        before = self._end
        self._end = min(before, self._clock() + min(part * self.left, most))
        try:
            yield
        except OutOfTime:
            if self._clock() >= before:
                raise
        finally:
            self._end = before

    @contextlib.contextmanager
    def after(self, seconds: float, call: Callable[[], object]) -> Iterator[None]:
        """Interrupt the block once, at a `poll` after so many seconds, for a call; the block goes on afterwards."""
        before = self._alarm
        self.remind(seconds, call)
        try:
            yield
        finally:
            self._alarm = before

    @contextlib.contextmanager
    def held_back(self) -> Iterator[None]:
        """Put the interruption of the work at hand off until the block is over."""
        alarm, self._alarm = self._alarm, None
        try:
            yield
        finally:
            self._alarm = self._alarm or alarm

    def remind(self, seconds: float, call: Callable[[], object]) -> None:
        """Interrupt the work at hand once, at a `poll` after so many seconds; what was to interrupt it does not."""
        self._alarm = (self._clock() + seconds, call)


def _loading(frame: FrameType | None) -> int:
    """How many imports are under way."""
    count = 0
    while frame is not None:
        count += frame.f_code.co_filename.startswith("<frozen importlib")
        frame = frame.f_back
    return count


_CURRENT: ContextVar[Watch | None] = ContextVar("certbound_watch", default=None)


def current_watch() -> Watch | None:
    """The watch that runs, if any."""
    return _CURRENT.get()


def poll(phase: str = "") -> None:
    """What a long loop calls at every step: raises ``OutOfTime`` where a limit has passed.

    Examples
    --------
    >>> poll("counting")  # nobody watches
    """
    watch = _CURRENT.get()
    if watch is not None:
        watch.poll(phase)


@contextlib.contextmanager
def share_of_time(part: float) -> Iterator[None]:
    """`Watch.share` of the watch that runs, if any."""
    watch = _CURRENT.get()
    with contextlib.nullcontext() if watch is None else watch.share(part):
        yield


@contextlib.contextmanager
def limited_to(seconds: float, part: float = 1.0) -> Iterator[None]:
    """End the block quietly after so many seconds, or after a part of what the watch that runs leaves, if that is less.

    Where nobody watches these are seconds of processor time of this thread, which a busy machine stretches little.
    """
    watch = _CURRENT.get()
    if watch is not None:
        with watch.share(part, seconds):
            yield
        return
    with contextlib.suppress(OutOfTime), Watch(seconds, clock=time.thread_time).running():
        yield


@contextlib.contextmanager
def in_proportion(part: float, least: float) -> Iterator[None]:
    """Under a limit, end the block quietly after a part of the time that was spent before it, ``least`` at least."""
    watch = _CURRENT.get()
    limited = watch is not None and watch.limit is not None
    with watch.share(1.0, max(part * watch.spent, least)) if watch and limited else contextlib.nullcontext():
        yield


def solver_limit() -> dict[str, float]:
    """The option that keeps a call of Clarabel to the time that is left; none where there is no limit."""
    left = seconds_left()
    return {} if left == math.inf else {"time_limit": max(left, 0.01)}


def jobs_allowed() -> int:
    """Processes that may work side by side: one where nobody watches."""
    watch = _CURRENT.get()
    return 1 if watch is None else watch.jobs


def executor_lent() -> Any:
    """Whose executor works on parts of a proof, if any."""
    watch = _CURRENT.get()
    return None if watch is None else watch.executor


@contextlib.contextmanager
def held_back() -> Iterator[None]:
    """Put off what `Watch.after` would interrupt the block for: it comes at the next `poll` after it."""
    watch = _CURRENT.get()
    with contextlib.nullcontext() if watch is None else watch.held_back():
        yield


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Hold the timer of a limit back in the block, for a library that an interruption would leave broken for good.

    A signal that another thread takes is handled in the main one all the same: so it is told as well as masked.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    main = threading.current_thread() is threading.main_thread()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
    if main:
        _HELD.append(True)
    try:
        yield
    finally:
        if main:
            del _HELD[-1:]  # none in a copy of the process
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def silenced() -> None:
    """Let the watch that runs, if any, only end the work: in a copy of the process, whose own timers are heard."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGALRM})
    _HELD.clear()
    watch = _CURRENT.get()
    if watch is not None:
        watch.silence()


def seconds_left() -> float:
    """What is left to the work at hand; infinite where nobody watches."""
    watch = _CURRENT.get()
    return math.inf if watch is None else watch.left
