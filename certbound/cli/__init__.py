"""The command line: one module a command.

``certbound --help`` lists the commands; exit codes are 0 (done, SAFE), 1 (UNKNOWN, unsafe or refuted), 2 (bad
input), 3 (a solver or certbound itself failed) and 130 (interrupted).
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and leave with its exit code."""
    from certbound.cli.app import run

    raise SystemExit(run(arguments))
