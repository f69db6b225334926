"""Who is at what, and the bound so far, beside the spinner of long work."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from certbound.cli.output import spinner
from certbound.display import log10_text
from certbound.watch import Progress


def line_of(found: Progress) -> str:
    """Who is at what, and the bound so far.

    Examples
    --------
    >>> line_of(Progress(engine="linear", phase="cell 3", log10_delta=-2.0, log10_lower=None, seconds=4.2, limit=60.0))
    'linear, cell 3; P <= 1e-2 so far'
    """
    work = ", ".join(word for word in (found.engine, found.phase) if word) or "at work"
    return work + (f"; P <= {log10_text(found.log10_delta)} so far" if found.log10_delta < 0 else "")


@contextlib.contextmanager
def progress(title: str, limit: float | None = None) -> Iterator[Callable[[Progress], None]]:
    """A callback for the block's work: ``title``, the limit in seconds, and what `line_of` says, on standard error."""
    within = "" if limit is None else f" (at most {limit:g} s)"
    with spinner(f"{title}{within}") as change:
        yield lambda found: change(f"{title}{within}: {line_of(found)}")
