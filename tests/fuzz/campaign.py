"""Many seeds in worker processes; one that hangs or dies is reported, and another takes its place."""

from __future__ import annotations

import faulthandler
import json
import multiprocessing
import signal
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

__all__ = ["finished_seeds", "run_campaign"]

RECYCLED = 100
"""Problems after which a worker is replaced by a fresh process."""
PATIENCE, GRACE = 20.0, 60.0
"""A problem hangs by the clock too, after so many times its processor time; seconds more for what is imported."""


def finished_seeds(path: Path) -> dict[int, dict[str, Any]]:
    """Records in a file of results, by seed; a last line that was cut off is left out."""
    found: dict[int, dict[str, Any]] = {}
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                record = json.loads(line)
            except json.JSONDecodeError:
                continue
            found[record["seed"]] = record
    return found


def _work(connection: Any, trace: str, limit: float) -> None:
    """A worker: seeds come in, records go out."""
    from tests.fuzz.runner import run_seed

    with open(trace, "w+", encoding="utf-8") as stream:
        faulthandler.register(signal.SIGPROF, file=stream, chain=True)  # where it was, and then the process ends
        while True:
            seed = connection.recv()
            if seed is None:
                return
            signal.setitimer(signal.ITIMER_PROF, limit)
            record = run_seed(seed)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            connection.send(record)


class _Worker:
    def __init__(self, limit: float) -> None:
        self.limit = limit
        with tempfile.NamedTemporaryFile(suffix=".trace", delete=False) as file:
            self.trace = file.name
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, self.trace, limit), daemon=True)
        self.process.start()
        theirs.close()
        self.done = 0

    def run(self, seed: int) -> dict[str, Any]:
        """The record of a seed; of a hang or a death, where it was."""
        self.connection.send(seed)
        self.done += 1
        try:
            if self.connection.poll(PATIENCE * self.limit + GRACE):
                record: dict[str, Any] = self.connection.recv()
                return record
            kind = "hang"
        except EOFError:
            self.process.join()
            kind = "hang" if self.process.exitcode == -signal.SIGPROF else f"death by {self.process.exitcode}"
        self.done = RECYCLED
        said = Path(self.trace).read_text(encoding="utf-8")
        places = [line.strip() for line in said.splitlines() if "/certbound/" in line]
        place = places[0].rpartition("/certbound/")[2].replace('"', "") if places else "nowhere in certbound"
        finding = {"command": "all", "kind": kind, "signature": f"{kind} in {place}", "message": said[-1500:]}
        facts = {"limit": self.limit}
        return {"seed": seed, "family": "?", "features": [], "answers": {}, "seconds": {"all": self.limit}, "facts": facts, "findings": [finding]}  # fmt: skip  # noqa: E501

    def close(self) -> None:
        if self.process.is_alive() and self.done < RECYCLED:
            self.connection.send(None)
            self.process.join(5.0)
        if self.process.is_alive():
            self.process.kill()
        self.process.join()
        self.connection.close()
        Path(self.trace).unlink(missing_ok=True)


def run_campaign(
    seeds: Iterable[int],
    *,
    jobs: int,
    limit: float,
    finished: Callable[[dict[str, Any]], None],
) -> None:
    """Run seeds in ``jobs`` processes; ``finished`` is called with every record, one at a time.

    Parameters
    ----------
    seeds : iterable of int
    jobs : int
        Processes at a time.
    limit : float
        Seconds of processor time after which a problem counts as hanging.
    finished : callable
    """
    queue, lock = iter(seeds), threading.Lock()

    def serve() -> None:
        worker: _Worker | None = None
        try:
            for seed in _shared(queue, lock):
                if worker is not None and worker.done >= RECYCLED:
                    worker.close()
                    worker = None
                worker = worker or _Worker(limit)
                record = worker.run(seed)
                with lock:
                    finished(record)
        finally:
            if worker is not None:
                worker.close()

    threads = [threading.Thread(target=serve, daemon=True) for _ in range(jobs)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _shared(queue: Iterator[int], lock: threading.Lock) -> Iterator[int]:
    while True:
        with lock:
            seed = next(queue, None)
        if seed is None:
            return
        yield seed
