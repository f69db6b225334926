"""The command line: one module a command.

``certbound --help`` lists the commands; exit codes are 0 (done, SAFE), 1 (UNKNOWN, unsafe or refuted), 2 (bad
input), 3 (a solver or certbound itself failed) and 130 (interrupted).
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence

__all__ = ["main"]

EARLY = "certbound: interrupted\n  why: it had not begun yet; nothing was written\n  try: run it again\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and leave with its exit code.

    Limits of time count from where the process began, if the command is that of its own command line.
    """
    began = time.perf_counter() - time.process_time() if arguments is None else None  # so far it has only worked
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):  # before NumPy is loaded; see `certbound.parallel.alone`
        os.environ.setdefault(name, "1")
    try:
        from certbound.cli.app import run

        code = run(arguments, began=began)
    except KeyboardInterrupt:  # before the command had begun
        sys.stderr.write(EARLY)
        code = 130
    raise SystemExit(code)
