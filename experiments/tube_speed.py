"""Seconds of the two questions of the tubes, warm: medians of processor time and of wall-clock time.

The claims are judged by processor time, which other programs on the machine disturb less.
"""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import certbound as cb
from experiments.harness import Arrays, Claims, main

__all__ = ["LIMITS", "QUESTIONS", "compute", "medians"]

LIMITS = {"kummer": 0.02, "auto": 0.1, "auto_pieces": 0.3, "exit": 0.005, "table": 30.0}
"""Seconds at most, each."""

SYSTEMS = (
    cb.Constants(rate=-0.5, sigma=0.1**0.5, dimension=1),
    cb.Constants(rate=0.0, sigma=1.0, dimension=3),
    cb.Constants(gain=0.9, sigma=1.0, dimension=3, effective_dimension=2.0),
    cb.Constants(gain=0.99, sigma=1.0, dimension=6),
)
_TURN = np.linspace(0.0, 6.0, 500)
PIECES = (
    cb.Constants(
        rate=-0.5 + 0.4 * np.sin(_TURN), sigma=1 + 0.3 * np.cos(_TURN), dimension=2, times=np.linspace(0, 5, 501)
    ),
    cb.Constants(
        gain=0.9 + 0.08 * np.sin(_TURN), sigma=1 + 0.3 * np.cos(_TURN), dimension=2, times=np.arange(501.0)
    ),
)  # fmt: skip


def _horizon(constants: cb.Constants) -> float:
    return float(constants.times[-1]) if constants.times is not None else (5.0 if constants.continuous else 50)


def _tune(constants: cb.Constants, method: str) -> float:
    return float(cb.tune_tube(constants, horizon=_horizon(constants), delta=1e-3, method=method).maximum)


def _exit(constants: cb.Constants, clearance: float) -> float:
    return float(cb.bound_exit_probability(constants, horizon=_horizon(constants), clearance=clearance))


def _table() -> float:
    """Largest radii for 1000 pairs of a rate and a level."""
    total = 0.0
    for rate, delta in itertools.product(np.linspace(-2.0, 0.2, 40), np.geomspace(1e-9, 0.1, 25)):
        constants = cb.Constants(rate=float(rate), sigma=1.0, dimension=2)
        total += cb.tune_tube(constants, horizon=4.0, delta=float(delta), method="kummer").maximum
    return total


QUESTIONS: dict[str, list[Callable[[], Any]]] = {
    "kummer": [lambda c=c: _tune(c, "kummer") for c in SYSTEMS],
    "auto": [lambda c=c: _tune(c, "auto") for c in SYSTEMS],
    "auto_pieces": [lambda c=c: _tune(c, "auto") for c in PIECES],
    "exit": [lambda c=c: _exit(c, 1.2 * _RADII[c]) for c in SYSTEMS],
    "table": [_table],
}
_RADII: dict[cb.Constants, float] = {}


def medians(name: str, repeats: int) -> tuple[float, float]:
    """Largest median over the systems: (processor time, wall-clock time)."""
    for constants in SYSTEMS:
        _RADII.setdefault(constants, _tune(constants, "kummer"))
    worst = (0.0, 0.0)
    for question in QUESTIONS[name]:
        if repeats > 1:
            question()
        spent = []
        for _ in range(repeats):
            begin = time.process_time(), time.perf_counter()
            question()
            spent.append((time.process_time() - begin[0], time.perf_counter() - begin[1]))
        processor, wall = (statistics.median(column) for column in zip(*spent))
        worst = max(worst[0], processor), max(worst[1], wall)
    return worst


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Seconds per question."""
    claims: Claims = {}
    for name, limit in LIMITS.items():
        processor, wall = medians(name, 1 if name == "table" else (25 if full else 7))
        claims[name] = {"seconds": processor, "wall": wall, "limit": limit, "met": processor < limit}
        print(f"{name:>12}: {1e3 * processor:8.1f} ms (wall {1e3 * wall:8.1f} ms), at most {1e3 * limit:.0f} ms")
    return {}, claims


if __name__ == "__main__":
    main("tube_speed", compute)
