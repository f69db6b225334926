"""What certbound proves of one problem: ``python -m tests.yardstick.measure NAME LIMIT METHOD`` prints it as JSON.

All seconds, those of limits too, are of processor time, so that waiting for a busy machine does not count. Work that
shares its caches with other work takes up to three times as many of them: compare runs of a quiet machine.
"""

from __future__ import annotations

import json
import math
import resource
import subprocess
import sys
import threading
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import certbound as cb

ROOT = Path(__file__).parents[2]
_QUESTIONS, _GRACE = 3, 60.0  # verdict, bounds and certificate; seconds for imports and what is slow to end
_CLOSE = 1.1  # ratio of the bounds below which they are not asked for once more
_BUSY = 12.0  # seconds of the clock for one of processor time, after which a process hangs


@dataclass(frozen=True, kw_only=True)
class Run:
    """What was proved of a problem.

    Attributes
    ----------
    status : str
        Of the question that is to be decided; what went wrong, where something did.
    upper, lower : float or None
        log10 of the best bounds of both questions; None for none.
    seconds : float
        Of processor time, until the status was known.
    engine : str
    certificate : int
        Bytes of the certificate that the checker proved; 0 for none.
    limit : float
        Seconds that each question was allowed to take.
    """

    status: str
    upper: float | None
    lower: float | None
    seconds: float
    engine: str
    certificate: int
    limit: float

    def as_data(self) -> dict[str, Any]:
        """Plain data for a file."""
        return asdict(self)


def measure(name: str, limit: float, method: str) -> Run:
    """Ask for a verdict, for a certificate of it, and for both bounds."""
    import certbound as cb
    from tests.yardstick.problems import entries

    entry = entries()[name]
    problem, begin = entry.problem(), _processor()
    first = cb.verify_safety(problem, method=method, time_limit=limit)
    seconds = _processor() - begin
    certificate = _bytes(problem, first, limit) if first.status in ("SAFE", "UNSAFE") else 0
    upper, lower = first.log10_delta, _lower(first)
    if upper > lower + math.log10(_CLOSE):
        second = cb.verify_safety(problem.replace(delta=entry.truth), method=method, time_limit=limit)
        upper, lower = min(upper, second.log10_delta), max(lower, _lower(second))
    return Run(
        status=first.status, upper=None if upper == 0 else upper, lower=None if lower == -math.inf else lower,
        seconds=round(seconds, 2), engine=first.method or "", certificate=certificate, limit=limit,
    )  # fmt: skip


def _lower(verdict: cb.Verdict) -> float:
    return -math.inf if verdict.log10_lower is None else verdict.log10_lower


def measured(name: str, limit: float, method: str) -> Run:
    """`measure` in a process of its own, which may fail and is ended where it hangs."""
    command = [sys.executable, "-m", "tests.yardstick.measure", name, repr(limit), method]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            check=False,
            cwd=ROOT,
            timeout=_BUSY * (_QUESTIONS * limit + _GRACE),
        )
    except subprocess.TimeoutExpired:
        return _failed("HANGS", limit)
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:]
        return _failed(f"FAILS: {' '.join(last)[:200]}", limit)
    return Run(**json.loads(done.stdout.splitlines()[-1]))


def _failed(status: str, limit: float) -> Run:
    return Run(status=status, upper=None, lower=None, seconds=0.0, engine="", certificate=0, limit=limit)


def _bytes(problem: cb.Problem, verdict: cb.Verdict, limit: float) -> int:
    from certbound.cli.commands.check import proved_certificate
    from certbound.errors import CertificateError
    from certbound.watch import OutOfTime, Watch

    try:
        with Watch(limit).running():
            return len(proved_certificate(problem, verdict).encode())
    except (CertificateError, OutOfTime):
        return 0


def _processor() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def main() -> None:
    """Command line of one process."""
    name, limit, method = sys.argv[1:]
    time.perf_counter = _processor  # before certbound is imported: its limits count that
    warnings.simplefilter("ignore")
    found: list[Run] = []
    work = threading.Thread(target=lambda: found.append(measure(name, float(limit), method)))
    work.start()  # in a thread of its own no timer of the clock interrupts it
    work.join()
    if not found:
        raise SystemExit(1)
    sys.stdout.write("\n" + json.dumps(found[0].as_data()) + "\n")


if __name__ == "__main__":
    main()
