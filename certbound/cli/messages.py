"""Three lines for everything that goes wrong: what, why, what to do."""

from __future__ import annotations

import contextlib
import linecache
import re
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from certbound.display import one_line
from certbound.errors import (
    CertboundError,
    CertificateError,
    EnclosureError,
    EngineError,
    InfeasibleError,
    SolverError,
    contained,
)

if TYPE_CHECKING:
    from certbound.problem.problem import Problem

BAD_INPUT = 2
FAILED = 3
INTERRUPTED = 130


class InputError(ValueError):
    """What the user asked for cannot be understood; carries the second and third line of the message."""

    def __init__(self, why: str, cure: str) -> None:
        super().__init__(f"{why}; {cure}")
        self.why = why
        self.cure = cure


def explain(error: Exception, command: str) -> tuple[int, str, str]:
    """Exit code, reason and cure for an error that ended a command.

    Input is at fault where certbound itself refused it (a ``raise`` in its own source), where a file could
    not be read or written, or where an extra is missing; all else is a failure of a solver or of certbound.
    """
    help_line = f"see `certbound {command} --help`" if command else "see `certbound --help`"
    why, cure = split_cure(str(error))
    if isinstance(error, InputError):
        return BAD_INPUT, error.why, error.cure
    if isinstance(error, (SolverError, InfeasibleError)):
        other = "another --method or " if command in ("verify", "synthesize") else ""
        return FAILED, why, cure or f"try {other}a smaller problem; --verbose shows the details"
    if isinstance(error, (EnclosureError, CertificateError)):
        return BAD_INPUT, why, cure or help_line
    if isinstance(error, SyntaxError):
        place = f"line {error.lineno} of {error.filename}"
        return BAD_INPUT, f"{place} is not Python: {error.msg}", "mend the module"
    if isinstance(error, FileNotFoundError):
        why = f"`{error.filename or error}`: {error.strerror or 'No such file'}"
        return BAD_INPUT, why, "check the path and the folder"
    if isinstance(error, OSError):
        subject = f"`{error.filename}`: " if error.filename else ""
        return BAD_INPUT, f"{subject}{error.strerror or error}", "check the path and its permissions"
    if isinstance(error, ModuleNotFoundError) and not str(error.name).startswith("certbound."):
        return BAD_INPUT, f"the module `{error.name}` is not installed", _install_hint(error.name or "")
    if isinstance(error, (ValueError, TypeError)) and _refused(error):
        return BAD_INPUT, why, cure or help_line
    if isinstance(error, MemoryError):
        why = f"the memory is too small: {_one_line(str(error))}"
        return FAILED, why, "ask for less: fewer states, paths or points"
    if isinstance(error, CertboundError):
        return FAILED, why, cure or "run again with --verbose for the details"
    return (
        FAILED,
        f"certbound failed: {type(error).__name__}: {_one_line(str(error))}",
        "this is a defect; run again with --verbose and report what it prints",
    )


@contextlib.contextmanager
def computing(engine: str, problem: Problem) -> Iterator[None]:
    """What fails in the block is a failure of certbound's, for the problem was checked when it was read.

    Two refusals stay the user's to mend: a plan that is missing, and a domain of the user's on which the model is
    undefined or its slopes unbounded. Every other failure is an EngineError or a SolverError.
    """
    _ = problem.closed_loop
    try:
        with contained(engine):
            yield
    except EngineError as error:
        cause = error.__cause__
        if isinstance(cause, SolverError) or (isinstance(cause, EnclosureError) and problem.domain is not None):
            raise cause from error
        raise


def split_cure(message: str) -> tuple[str, str]:
    """A library message split into its reason and its cure (empty where it names none).

    Examples
    --------
    >>> split_cure("`delta` must lie in (0, 1), got 1.5; give a probability.")
    ('`delta` must lie in (0, 1), got 1.5', 'give a probability')
    """
    text = _one_line(message)
    depth = 0
    for position, letter in enumerate(text):
        depth += (letter in "([{") - (letter in ")]}")
        if depth <= 0 and text.startswith("; ", position) and not text.startswith("; got ", position):
            return text[:position], text[position + 2 :].rstrip(".")
    match = re.search(r"(?<=[\w`)\]])\. (?=[A-Z`])", text)
    if match:
        return text[: match.start()], text[match.end() :].rstrip(".")
    return text.rstrip("."), ""


_FOR_FILES = (
    (r"`plan=` \(\[plan\] in a problem file\)", "a [plan] table"),
    (r"`inputs=` \(\[inputs\] in a problem file\)", "an [inputs] table"),
    (r"(a smaller )?`domain=(cb\.Box\(low, high\))?`", "\\1[domain] table with a box"),
    (r"(?<=give )\[domain\]", "a [domain]"),
    (r"`plan=`", "a [plan] table"),
    (r"`reach=`", "[[reach]]"),
    (r"`disturbance=`", "a [disturbances] table"),
    (r"`inputs=`", "an [inputs] table"),
    (r"\(`?cells`?\)", "(--cells)"),
    (r"`smallest=True`", "--smallest"),
    (r"method [\"'](\w+)[\"']", "--method \\1"),
    (r"write np\.diag\(\[\.\.\.\]\)", "write [[a, 0], [0, b]]"),
    (r"write ([\d.e+-]+) \* np\.eye\(2\)", "write [[\\1, 0], [0, \\1]]"),
    (r"\bcb\.Histogram\b", 'law = "histogram"'),
    (r"\bcb\.SubGaussian\b", 'law = "subgaussian"'),
    (r"\bcb\.Gaussian\b", 'law = "gaussian"'),
    (r"use cb\.(Box|Ball|Ellipsoid)\(.*?\)", "write a table"),
)
"""What a message says to who writes Python, and what to who writes problem files."""


def for_files(text: str) -> str:
    """A message with the cures of problem files and of the command line, in place of those of Python.

    Examples
    --------
    >>> for_files("use more cells, or give `domain=cb.Box(low, high)`")
    'use more cells, or give a [domain] table with a box'
    """
    for pattern, words in _FOR_FILES:
        text = re.sub(pattern, words, text)
    return text


def write_error(what: str, why: str, cure: str) -> None:
    """Three lines on standard error, whatever the texts hold."""
    sys.stderr.write(f"certbound: {one_line(what)}\n  why: {one_line(why)}\n  try: {one_line(cure)}\n")
    sys.stderr.flush()


def _install_hint(module: str) -> str:
    extra = {
        "dask": "cluster",
        "distributed": "cluster",
        "sklearn": "learn",
        "jax": "compare",
        "immrax": "compare",
    }
    name = extra.get(module.split(".")[0])
    return f'pip install "certbound[{name}]"' if name else f"install it, or check the spelling: pip install {module}"


def _one_line(message: str) -> str:
    return " ".join(message.split())


def place_in_module(error: Exception) -> str:
    """Where a user's module raised an error, in words to add; empty where it did not, or certbound refused its input.

    The place is the innermost line of the traceback in a file that is not installed, or in any that is not certbound's.
    """
    if _refused(error):
        return ""
    installed = tuple(sysconfig.get_path(kind) for kind in ("stdlib", "purelib", "platlib"))
    own, other, trace = "", "", error.__traceback__
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        module = str(trace.tb_frame.f_globals.get("__name__", "")).split(".")[0]
        if module not in ("certbound", "importlib") and not file.startswith("<"):
            other = f" in line {trace.tb_lineno} of {Path(file).name}"
            own = own if file.startswith(installed) else other
        trace = trace.tb_next
    return own or other


def _refused(error: Exception) -> bool:
    """True where the innermost frame is a ``raise`` statement of certbound's own source."""
    trace: TracebackType | None = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None:
        return False
    frame = trace.tb_frame
    line = linecache.getline(frame.f_code.co_filename, trace.tb_lineno)
    module = str(frame.f_globals.get("__name__", ""))
    return module.split(".")[0] == "certbound" and line.lstrip().startswith("raise ")
