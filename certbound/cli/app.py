"""The application: global options, the commands, and the one place where errors become messages."""

from __future__ import annotations

import _thread
import contextlib
import difflib
import functools
import logging
import re
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import typer

from certbound._version import __version__
from certbound.cli.commands import (
    check,
    derive,
    doctor,
    exit_times,
    new,
    problems,
    simulate,
    sweep,
    synthesize,
    tune,
    verify,
)
from certbound.cli.messages import BAD_INPUT, INTERRUPTED, explain, for_files, write_error
from certbound.cli.output import SETTINGS, logging_to_stderr, show
from certbound.errors import SolverError
from certbound.watch import OutOfTime

_ClickException = typer.BadParameter.__mro__[2]  # whichever click typer brings: vendored or its own
_log = logging.getLogger(__name__)
_AGAIN = 0.05  # seconds

app = typer.Typer(
    name="certbound",
    help="Certified probabilities that a noisy nonlinear system leaves its safe set.",
    epilog="Exit codes: 0 done or SAFE, 1 UNKNOWN, unsafe or refuted, 2 bad input, 3 failed, 130 stopped.",
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def _global_options(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Log the work to standard error (any place).")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print the answer's first line only (any place).")] = False,
) -> None:
    if version:
        sys.stdout.write(f"certbound {__version__}\n")
        raise typer.Exit(0)
    if context.invoked_subcommand is None:
        sys.stdout.write(context.get_help() + "\n")
        raise typer.Exit(BAD_INPUT)


for _module in (verify, sweep, derive, tune, synthesize, simulate, exit_times, check, problems, new, doctor):
    _name = _module.__name__.rpartition(".")[2]
    app.command(_name.replace("_", "-"), epilog=_module.EXAMPLES)(getattr(_module, _name))


def run(arguments: Sequence[str] | None = None, *, began: float | None = None) -> int:
    """Run one command and return its exit code; ``--verbose`` and ``--quiet`` may stand anywhere.

    Limits of time count from ``began``, a time of ``time.perf_counter``; from now when omitted.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    SETTINGS.verbose, SETTINGS.quiet, SETTINGS.json = ("--verbose" in words, "--quiet" in words, "--json" in words)
    SETTINGS.answered, SETTINGS.began = False, time.perf_counter() if began is None else began
    words = [word for word in words if word not in ("--verbose", "--quiet")]
    command = next((word for word in words if not word.startswith("-")), "")
    try:
        with logging_to_stderr(verbose=SETTINGS.verbose):
            return _run(words, command)
    finally:
        SETTINGS.began = None


@contextlib.contextmanager
def interruptible() -> Iterator[list[BaseException]]:
    """Those that came within a callback of compiled code, which drops them: they come again soon."""
    told, lost, again = sys.unraisablehook, list[BaseException](), threading.Timer(_AGAIN, _thread.interrupt_main)

    def dropped(what: sys.UnraisableHookArgs) -> None:
        if not isinstance(what.exc_value, KeyboardInterrupt):
            told(what)
        elif not lost:
            lost.append(what.exc_value)
            again.start()

    sys.unraisablehook = dropped
    try:
        yield lost
    finally:
        again.cancel()
        sys.unraisablehook = told


@functools.cache
def _command() -> Any:
    """The commands with their options, read from their functions once."""
    return typer.main.get_command(app)


def _run(words: list[str], command: str) -> int:
    lost: list[BaseException] = []
    try:
        with interruptible() as lost:
            code = _command()(args=words, prog_name="certbound", standalone_mode=False)
        sys.stdout.flush()
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except OutOfTime:
        return _report(SolverError("nothing was proved in time; give a larger --time-limit"), command, words)
    except Exception as error:  # noqa: BLE001  (the outermost frame: whatever happened, three lines)
        _log.debug("the command ended with an error", exc_info=True)
        if not lost:
            return _report(error, command, words)
        code = INTERRUPTED
    if code == INTERRUPTED:
        kept = next((word for word in ("--checkpoint", "--resume") if word in words), "")
        _tell(
            f"{command or 'the command'} was interrupted",
            "it had no answer yet; " + (f"what was done is in the file of {kept}" if kept else "nothing was written"),
            "run it again to go on" if kept else f"run it again{_shorter(command)}",
        )
    return code if isinstance(code, int) else 0


def _tell(what: str, why: str, cure: str) -> None:
    """Three lines on standard error; with ``--json`` the same as the one object on standard output, too."""
    write_error(what, why, cure)
    if SETTINGS.json and not SETTINGS.answered:
        show({"error": what, "why": why, "try": cure}, as_json=True, in_words=lambda: None)


def _shorter(command: str) -> str:
    limited = command in ("verify", "derive", "tune", "simulate", "exit-times")
    return "; --time-limit SECONDS gives the best answer after some time" if limited else " and let it finish"


def _report(error: Exception, command: str, words: list[str]) -> int:
    known = [entry.name for entry in app.registered_commands if entry.name]
    if isinstance(error, _ClickException):
        why = error.format_message().rstrip(".")  # type: ignore[attr-defined]  # which class it is, click and typer do not agree
        _tell("the command line was not understood", why.partition(". Did you")[0], _usage_hint(command, known))
        return BAD_INPUT
    code, why, cure = explain(error, command)
    named = re.search(r"`([a-z_]+)`", why)
    if named and cure == f"see `certbound {command} --help`" and f"--{named[1]}" in words:
        cure = f"change --{named[1]}; `certbound {command} --help` says what it takes"
    if not any(":" in word for word in words):  # a problem of the user's in Python is told Python's cures
        why, cure = for_files(why), for_files(cure)
    _tell(f"{command or 'the command'} {'refused its input' if code == BAD_INPUT else 'failed'}", why, cure)
    return code


def _example(command: str) -> str:
    """The first example of a command's help."""
    epilog = next(entry.epilog for entry in app.registered_commands if entry.name == command)
    return (epilog or f"certbound {command}").partition("\n")[0].removeprefix("Example: ").strip()


def _usage_hint(command: str, known: list[str]) -> str:
    if command in known:
        return f"for example `{_example(command)}`; see `certbound {command} --help`"
    near = difflib.get_close_matches(command, known, n=1)
    return f"did you mean `certbound {near[0]}`?" if near else "see `certbound --help` for the commands"
