"""The command line: one module a command.

``certbound --help`` lists the commands; exit codes are 0 (done, SAFE), 1 (UNKNOWN, unsafe or refuted), 2 (bad
input), 3 (a solver or certbound itself failed) and 130 (interrupted).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

__all__ = ["main"]

EARLY = "certbound: interrupted\n  why: it had not begun yet; nothing was written\n  try: run it again\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and leave with its exit code."""
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):  # before NumPy is loaded; see `certbound.parallel.alone`
        os.environ.setdefault(name, "1")
    try:
        from certbound.cli.app import run

        code = run(arguments)
    except KeyboardInterrupt:  # before the command had begun
        sys.stderr.write(EARLY)
        code = 130
    raise SystemExit(code)
