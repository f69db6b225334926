"""What the commands print: JSON for programs, short tables for people, and what long work is at."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certbound.display import one_line, plain

if TYPE_CHECKING:
    from rich.console import Console


EVERY = 10.0
"""Seconds between two lines on what is done, where nothing can be animated."""


class Settings:
    """The global options of this run."""

    verbose: bool = False
    quiet: bool = False
    json: bool = False
    answered: bool = False
    """Whether the one JSON object of ``--json`` has been printed."""
    began: float | None = None
    """Since when limits of time count, by ``time.perf_counter``; None between commands."""


SETTINGS = Settings()


def console() -> Console:
    """Standard output for people: colours and box drawing on a terminal only; a text is printed as it is."""
    from rich.console import Console

    terminal = sys.stdout.isatty()
    width = None if terminal else max(100, int(os.environ.get("COLUMNS") or 100))
    return Console(file=sys.stdout, highlight=False, emoji=False, soft_wrap=not terminal, width=width)


def show(result: Mapping[str, Any], as_json: bool, in_words: Callable[[], None]) -> None:
    """A command's result: one JSON object on one line, with nothing beside it on standard output, or words."""
    if not as_json:
        in_words()
        return
    SETTINGS.answered = True
    sys.stdout.write(json.dumps(plain(result), allow_nan=False) + "\n")
    sys.stdout.flush()


def print_status(screen: Console, status: str) -> None:
    """The word of a verdict in its colour, without the end of the line."""
    color = {"SAFE": "green", "UNKNOWN": "yellow"}.get(status, "red")
    screen.print(f"[bold {color}]{status}[/]  ", end="")


def animated() -> bool:
    """Whether somebody watches standard error, who did not ask for less or for more."""
    return _heard() and sys.stderr.isatty()


def _heard() -> bool:
    return not (SETTINGS.quiet or SETTINGS.verbose or SETTINGS.json)


@contextlib.contextmanager
def spinner(text: str) -> Iterator[Callable[[str], None]]:
    """What is done, with the elapsed time, on standard error: a spinner on a terminal, a line every 10 s elsewhere.

    Nothing with --json, --quiet and --verbose. What the block is given changes the text.
    """
    if not _heard():
        yield lambda text: None
        return
    if not animated():
        with _lines(text) as change:
            yield change
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(text, total=None)
        yield lambda text: progress.update(task, description=text)


@contextlib.contextmanager
def _lines(text: str) -> Iterator[Callable[[str], None]]:
    """Lines from a thread of their own, so that work which says nothing is heard of too."""
    begun, over, said = time.monotonic(), threading.Event(), [text]

    def tell() -> None:
        while not over.wait(EVERY):
            sys.stderr.write(f"{one_line(said[-1])}, {time.monotonic() - begun:.0f} s\n")
            sys.stderr.flush()

    thread = threading.Thread(target=tell, daemon=True)
    thread.start()
    try:
        yield said.append
    finally:
        over.set()
        thread.join()


@contextlib.contextmanager
def logging_to_stderr(*, verbose: bool) -> Iterator[None]:
    """Send the library's log and every warning to standard error with --verbose, and nowhere without."""
    handler: logging.Handler = logging.StreamHandler(sys.stderr) if verbose else logging.NullHandler()
    handler.setFormatter(logging.Formatter("%(relativeCreated)8.0f ms  %(name)s: %(message)s"))
    loggers = [logging.getLogger("certbound"), logging.getLogger("py.warnings")]
    before = [(logger.level, logger.propagate) for logger in loggers]
    logging.captureWarnings(True)
    for logger in loggers:
        logger.addHandler(handler)
        logger.setLevel(logging.DEBUG if verbose else logging.WARNING)
        logger.propagate = False
    try:
        yield
    finally:
        logging.captureWarnings(False)
        for logger, (level, propagate) in zip(loggers, before):
            logger.removeHandler(handler)
            logger.setLevel(level)
            logger.propagate = propagate


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all: an interrupted run leaves the old file as it was. Links and devices stay."""
    data = content.encode() if isinstance(content, str) else content
    try:
        if path.exists() and not path.is_file():  # a device or a pipe
            path.write_bytes(data)
        else:
            _replace(Path(os.path.realpath(path)), data)
    except OSError as error:  # name what the user named, no temporary file
        raise OSError(error.errno, error.strerror, str(path)) from error


def _replace(path: Path, data: bytes) -> None:
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
