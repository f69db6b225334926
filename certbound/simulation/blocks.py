"""A simulation as a row of blocks: every block has a random stream of its own, so that the answer depends on
the seed alone, not on how blocks are spread over threads, processes or machines.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certbound.arrays import Array
from certbound.problem.random_constants import Random

Counts = NDArray[np.int64]

BLOCK = 1024
"""Paths per block."""

_MOST = 1e12  # of anything that is counted: a mark for every chunk of so many paths takes 25 MB

MEMORY_LIMIT = 512 * 2**20
"""Bytes that the arrays of one simulation may take."""


def check_count(name: str, value: Any) -> int:
    """A positive whole number (3e6 is one)."""
    if not isinstance(value, (int, float, np.integer, np.floating)) or isinstance(value, bool):
        raise TypeError(f"`{name}` must be a positive whole number, got {value!r}.")
    number = float(value)
    if not np.isfinite(number) or number != int(number) or number <= 0:
        raise ValueError(f"`{name}` must be a positive whole number, got {value!r}.")
    if number > _MOST:
        raise ValueError(f"`{name}` must be at most {_MOST:g}, got {number:g}.")
    return int(number)


def entropy_of(rng: np.random.Generator | int | None) -> int:
    """128 random bits that name all streams of a run; drawn from ``rng``, so that the next run differs."""
    if rng is not None and not isinstance(rng, (np.random.Generator, int, np.integer)):
        raise TypeError(f"`rng` must be a numpy.random.Generator, got {rng!r}; use np.random.default_rng(seed).")
    return int.from_bytes(np.random.default_rng(rng).bytes(16), "little")


@dataclass(frozen=True, eq=False, kw_only=True)
class Tally:
    """What blocks counted: whole numbers, so that the order of summation does not matter."""

    counts: Counts
    marginals: Counts
    steps: int
    paths: int

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            counts=self.counts + other.counts,
            marginals=self.marginals + other.marginals,
            steps=self.steps + other.steps,
            paths=self.paths + other.paths,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Work:
    """Everything that a worker needs to run any block; it can be pickled."""

    source: str  # the kernel's source
    p: Array  # its parameters
    # ``sample_start(rng, count)`` -> starts of shape (count, n)
    sample_start: Callable[[np.random.Generator, int], Array]
    # (q,): box of the disturbance that each path draws
    low: Array
    high: Array
    constants: tuple[tuple[int, Random], ...] = ()  # places of those that have a law, and the law
    # tables over the steps
    inputs: Array
    moving: Array
    nominal: Array
    windows: Counts  # (constraints, 2): first and last step of each constraint
    # divisor of deviations, steps to look at
    profile: Array
    marks: Counts
    steps: int
    interval: float  # time of a step
    dimension: int
    counts_shape: tuple[int, int]
    marginals_shape: tuple[int, int, int, int] = (2, 0, 1, 1)
    paths: int
    entropy: int
    block: int = BLOCK  # paths per block

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return -(-self.paths // self.block)

    def tally(self) -> Tally:
        """An empty tally."""
        counts = np.zeros(self.counts_shape, dtype=np.int64)
        return Tally(counts=counts, marginals=np.zeros(self.marginals_shape, np.int64), steps=0, paths=0)

    def digest(self) -> str:
        """Hash of all that the answer depends on."""
        state = hashlib.sha256()
        generator = np.random.default_rng(0)
        starts = np.ascontiguousarray(self.sample_start(generator, 8))
        arrays = (self.p, starts, self.low, self.high, self.inputs, self.moving, self.nominal, self.windows)
        for array in (*arrays, self.profile, self.marks):
            state.update(str(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        state.update("".join(f"{place} {law.data()}" for place, law in self.constants).encode())
        state.update(f"{self.source} {self.steps} {self.interval!r} {self.counts_shape} {self.block}".encode())
        return state.hexdigest()

    def compile(self) -> None:
        """Compile the kernel (or load it) by running no path."""
        self._call(np.zeros((0, self.dimension)), np.zeros((0, len(self.low))), 0, self.tally(), None)

    def run_block(self, block: int, tally: Tally, out: Array | None = None) -> int:
        """Add one block to ``tally``'s arrays; returns the number of steps done."""
        from certbound.simulation.compiled import start_generator

        generator = start_generator(self.entropy, block)
        count = min(self.block, self.paths - block * self.block)
        starts = np.ascontiguousarray(self.sample_start(generator, self.block)[:count], dtype=float)
        signals = generator.uniform(self.low, self.high, (self.block, len(self.low)))
        for place, law in self.constants:
            signals[:, place] = law.sample(generator, self.block)
        signals = signals[:count]
        return self._call(starts, signals, block, tally, out)

    def _call(self, starts: Array, signals: Array, block: int, tally: Tally, out: Array | None) -> int:
        from certbound.simulation.compiled import load_kernel, seed_stream

        notes = np.zeros(2 + self.dimension)
        kernel = load_kernel(self.source)
        arrays = (self.inputs, self.moving, self.windows, self.nominal, self.profile, self.marks, self.p)
        store = np.zeros((0, 0, 0)) if out is None else out
        done = kernel(
            seed_stream(self.entropy, block), starts, signals, *map(_contiguous, arrays), self.steps,
            tally.counts, tally.marginals, store, notes,
        )  # fmt: skip
        if done < 0:
            state = ", ".join(f"{value:.6g}" for value in notes[2:])
            raise ValueError(
                "the model gave a state that is not finite in the step after time "
                f"{notes[1] * self.interval:.6g} on path {block * self.block + int(notes[0])}, from state "
                f"({state}); use more steps, or set `domain` to where the model is meant; "
                "where a step may cross 0 write sqrt(max(.., 0))."
            )
        return int(done)


def _contiguous(array: Any) -> Any:
    return np.require(array, requirements=["C", "W"])


def run_blocks(work: Work, first: int, last: int) -> Tally:
    """Run blocks ``first`` .. ``last - 1``: what an executor calls."""
    tally = work.tally()
    steps = sum(work.run_block(block, tally) for block in range(first, last))
    paths = min(last * work.block, work.paths) - first * work.block
    return Tally(counts=tally.counts, marginals=tally.marginals, steps=steps, paths=paths)
