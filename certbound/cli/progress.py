"""What long work is at: a line that changes on a terminal, a line every ten seconds elsewhere, nothing for programs."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator

from certbound.cli.output import SETTINGS, animated, spinner
from certbound.display import log10_text
from certbound.watch import Progress

_EVERY = 10.0  # seconds between two plain lines


def line_of(found: Progress) -> str:
    """One line: the time, who is at what, the bound so far.

    Examples
    --------
    >>> line_of(Progress(engine="linear", phase="cell 3", log10_delta=-2.0, log10_lower=None, seconds=4.2, limit=60.0))
    '4 of 60 s: linear, cell 3; P <= 0.01 so far'
    """
    used = f"{found.seconds:.0f} s" if found.limit is None else f"{found.seconds:.0f} of {found.limit:g} s"
    work = ", ".join(word for word in (found.engine, found.phase) if word) or "at work"
    return f"{used}: {work}" + (f"; P <= {log10_text(found.log10_delta)} so far" if found.log10_delta < 0 else "")


@contextlib.contextmanager
def progress(title: str, *, silent: bool = False) -> Iterator[Callable[[Progress], None]]:
    """A callback for the block's work: ``title`` and what `line_of` says, on standard error."""
    if animated() and not silent:
        with spinner(title) as change:
            yield lambda found: change(f"{title}  {line_of(found)}")
        return
    told = 0.0

    def tell(found: Progress) -> None:
        nonlocal told
        if not silent and not SETTINGS.quiet and found.seconds - told >= _EVERY:
            told = found.seconds
            sys.stderr.write(f"{title}, {line_of(found)}\n")
            sys.stderr.flush()

    yield tell
