"""``sweep``: prove point after point, each in a process of its own, and keep what is proved."""

from __future__ import annotations

import importlib
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from certbound.checks import nearest
from certbound.errors import CertboundError
from certbound.parallel import Answer, Crew, LostError, crew
from certbound.problem.problem import Problem
from certbound.safety.sweeps.family import Family, Grid, Point
from certbound.safety.sweeps.found import FAILED, Boundary, Row, Sweep
from certbound.safety.sweeps.record import Record
from certbound.safety.verification import verify_safety
from certbound.watch import Progress, Watch, poll

_TRIES = 3  # of a point whose process is lost
_HEAVY = ("cvxpy", "scipy.integrate", "scipy.interpolate", "scipy.linalg", "scipy.ndimage", "scipy.optimize")
"""What engines import when they first need it, and copies of this process once for all."""


def sweep(
    source: Any, over: Mapping[str, Any], *, boundary: str | None = None, parameters: Mapping[str, float] | None = None,
    method: str = "auto", cells: int | None = None, time_limit: float | None = None, smallest: bool = False,
    jobs: int | None = None, executor: Any = None, resume: str | Path | None = None,
    progress: Callable[[Progress], object] | None = None,
) -> Sweep:
    """Verify a problem at every point of a grid of parameters, or find where along one of them it ceases to be SAFE.

    Proves at each point what `verify_safety` proves of the problem there, in a process of its own (on an executor: in
    its workers); the answers do not depend on where, but for points that ``time_limit`` ended. A process that is lost
    is replaced.

    Parameters
    ----------
    source : str, Path, function or Problem
        What `load` takes, or a function of the parameters that returns a Problem; of a Problem itself only ``horizon``
        and ``delta`` can change.
    over : mapping
        Names of parameters, or ``horizon`` and ``delta``, to the values that they take.
    boundary : str, optional
        Prove only what is needed to find where along this parameter SAFE ends: both ends, then by bisection of its
        values, which supposes that the status changes once.
    parameters : mapping, optional
        Parameters that every point shares.
    method, cells
        As for `verify_safety`.
    time_limit : float, optional
        Seconds that each point may take.
    smallest : bool
        As for `verify_safety`.
    jobs : int, optional
        Processes at a time; as many as there are cores where it is left out.
    executor : concurrent.futures.Executor or dask Client, optional
        Who works instead.
    resume : path, optional
        A file to which each point is written as soon as it is proved; what it holds already is not proved again.
    progress : callable, optional
        Called with a `certbound.watch.Progress` about four times a second.

    Returns
    -------
    Sweep

    Raises
    ------
    ValueError, TypeError
        If an argument is malformed, there is no problem at some point, or the file belongs to another sweep.
    SolverError
        If an executor takes no more tasks.

    Examples
    --------
    >>> sweep("ou", {"sigma": [0.1, 0.5]}, method="linear", jobs=1, boundary="sigma").boundaries[0].safe
    0.1
    """
    grid, family = Grid.of(over), Family(source, parameters or {})
    twice = next((name for name in grid.names if name in family.fixed), None)
    if twice is not None:
        raise ValueError(f"`parameters` must not hold `{twice}`, which `over` changes; name it once.")
    if boundary is not None and boundary not in grid.names:
        raise ValueError(f"`boundary` must be a name in `over`, got {boundary!r}{nearest(boundary, grid.names)}")
    settings = {"method": method, "cells": cells, "smallest": smallest, "time_limit": time_limit}
    chains = [] if boundary is None else list(grid.chains(boundary).values())
    first = grid.points() if boundary is None else [line[end] for line in chains for end in (0, -1)]
    shared, *_ = [family.at(grid.named(point)) for point in first]  # what there is no problem for is refused at once
    search = _Search(grid, family, Record(None if resume is None else Path(resume), grid, settings), settings, chains)
    for name in _HEAVY if executor is None else ():
        importlib.import_module(name)
    watch = Watch(progress=progress, jobs=_cores() if jobs is None else jobs)
    watch.engine = "sweep"
    with watch.running(), crew(watch.jobs, executor) as workers:
        search.prove(workers, first)
    return Sweep(
        name=shared.name, delta=None if "delta" in grid.names else shared.delta,
        over=dict(zip(grid.names, grid.values)),
        points=tuple(search.rows[point] for point in grid.points() if point in search.rows),
        boundaries=None if boundary is None else tuple(search.boundary(boundary, line) for line in chains),
    )  # fmt: skip


class _Search:
    """What is proved so far, and what is to be proved next; ``chains`` are those along which a boundary is sought."""

    def __init__(
        self, grid: Grid, family: Family, record: Record, settings: Mapping[str, Any], chains: list[list[Point]]
    ) -> None:
        self.rows: dict[Point, Row] = {}
        self._grid, self._family, self._record, self._settings = grid, family, record, settings
        self._chain = {point: line for line in chains for point in line}
        self._tries: Counter[Point] = Counter()

    def prove(self, workers: Crew, first: list[Point]) -> None:
        """Prove points, and those that follow from what is found at them."""
        queue, asked = deque(dict.fromkeys(first)), set(first)
        underway: dict[Point, Problem] = {}
        while queue or underway:
            while queue and len(underway) < workers.width:
                point = queue.popleft()
                problem = self._family.at(self._grid.named(point))
                if self._record.has(point, problem):
                    self._found(point, self._record.rows[point], queue, asked)
                else:
                    underway[point] = problem
                    workers.begin(point, partial(_proved, problem, self._settings))
            for point, answer in workers.finished() if underway else ():
                problem = underway.pop(point)
                row = self._row(point, answer)
                if row is None:
                    queue.appendleft(point)
                    continue
                if row.status != FAILED:
                    self._record.add(point, row, problem)
                self._found(point, row, queue, asked)
            poll(f"{len(self.rows)} of {len(asked)} points")

    def _found(self, point: Point, row: Row, queue: deque[Point], asked: set[Point]) -> None:
        self.rows[point] = row
        line = self._chain.get(point, [])
        for index in _next(self._known(line), len(line)) if line else ():
            if line[index] not in asked:
                asked.add(line[index])
                queue.append(line[index])

    def _known(self, line: list[Point]) -> dict[int, bool]:
        return {k: self.rows[point].status == "SAFE" for k, point in enumerate(line) if point in self.rows}

    def _row(self, point: Point, answer: Answer) -> Row | None:
        """The row of an answer; None where the point has to be given out again. What is a user's mistake is raised."""
        value, error = answer
        if error is None:
            return Row(parameters=self._grid.named(point), **value)
        if isinstance(error, LostError):
            self._tries[point] += 1
            if self._tries[point] < _TRIES:
                return None
        elif not isinstance(error, CertboundError | MemoryError):
            raise error
        nothing: dict[str, Any] = {"log10_delta": 0.0, "log10_lower": None, "method": "", "seconds": 0.0}
        words = str(error) or type(error).__name__
        return Row(parameters=self._grid.named(point), status=FAILED, reason=words, **nothing)

    def boundary(self, name: str, line: list[Point]) -> Boundary:
        """What is known along a chain."""
        known = self._known(line)
        values = [self._grid.named(point)[name] for point in line]
        others = {key: value for key, value in self._grid.named(line[0]).items() if key != name}
        good, bad = [k for k in known if known[k]], [k for k in known if not known[k]]
        upward = bool(good) and (not bad or min(good) < min(bad))  # SAFE below, not above
        safe = None if not good else max(good) if upward else min(good)
        beyond = None if not good or not bad else min(bad) if upward else max(bad)
        return Boundary(
            parameters=others, name=name, safe=None if safe is None else values[safe],
            not_safe=None if beyond is None else values[beyond],
            log10_delta=None if safe is None else self.rows[line[safe]].log10_delta,
        )  # fmt: skip


def _next(known: Mapping[int, bool], count: int) -> list[int]:
    """Which of the values of a chain are to be tried next: its ends, then the middle between two that differ."""
    ends = [end for end in (0, count - 1) if end not in known]
    if ends:
        return ends
    low, high = 0, count - 1
    while known[low] != known[high] and high - low > 1:
        middle = (low + high) // 2
        if middle not in known:
            return [middle]
        low, high = (middle, high) if known[middle] == known[low] else (low, middle)
    return []


def _proved(problem: Problem, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The verdict on a problem as plain data."""
    began = time.perf_counter()
    found = verify_safety(problem, **settings)
    names = ("status", "log10_delta", "log10_lower", "method", "reason")
    return {name: getattr(found, name) for name in names} | {"seconds": time.perf_counter() - began}


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
