"""What importance splitting does with its particles between two runs, compiled into the kernels.

Particles have stored paths ``states`` of shape (particles, steps + 1, n), noise-free paths ``frees`` of the same
shape (or none, where all share one), records ``tops`` (particles, steps + 1) and scores, the last records.

Importing this module imports numba: import it inside functions.
"""

from __future__ import annotations

import numpy as np
from numba import njit, types

from certbound.simulation.compiled.entry import FOLLOW, KERNEL, OPTIONS, leap
from certbound.simulation.compiled.streams import inner, uniform


def _place(starts, path, states, frees):  # type: ignore[no-untyped-def]
    """Write the start of a particle to its stored paths."""
    for i in range(starts.shape[1]):
        states[path, 0, i] = starts[path, i]
        if frees.shape[0] > 0:
            frees[path, 0, i] = starts[path, i]


def _hold(tops, path, first, top):  # type: ignore[no-untyped-def]
    """A record that stays from a step on."""
    for k in range(first, tops.shape[1]):
        tops[path, k] = top


def _ranked(values, rank):  # type: ignore[no-untyped-def]
    """The entry that would stand at ``rank`` if the values were sorted (Hoare's quickselect, on a copy)."""
    kept = values.copy()
    low, high = 0, len(kept) - 1
    while low < high:
        pivot, i, j = kept[(low + high) // 2], low, high
        while i <= j:
            while kept[i] < pivot:
                i += 1
            while pivot < kept[j]:
                j -= 1
            if i <= j:
                kept[i], kept[j] = kept[j], kept[i]
                i, j = i + 1, j - 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return kept[rank]


def _survive(scores, level, alive):  # type: ignore[no-untyped-def]
    """The number of scores above a level; ``alive`` begins with their places."""
    count = 0
    for path in range(len(scores)):
        if scores[path] > level:
            alive[count] = path
            count += 1
    return count


def _branch(stream, alive, survivors, level, path, signals, states, frees, tops):  # type: ignore[no-untyped-def]
    """Make a particle a copy of a random survivor up to that one's first step above the level; returns this step."""
    parent = alive[min(int(uniform(stream) * survivors), survivors - 1)]
    first = 0
    while not tops[parent, first] > level:
        first += 1
    for i in range(signals.shape[1]):
        signals[path, i] = signals[parent, i]
    for k in range(first + 1):
        tops[path, k] = tops[parent, k]
        for i in range(states.shape[2]):
            states[path, k, i] = states[parent, k, i]
            if frees.shape[0] > 0:
                frees[path, k, i] = frees[parent, k, i]
    return first


def _read_scores(tops, scores):  # type: ignore[no-untyped-def]
    """Copy the last records to ``scores``; returns how many particles have left."""
    left = 0
    for path in range(len(scores)):
        scores[path] = tops[path, tops.shape[1] - 1]
        if scores[path] >= 1.0:
            left += 1
    return left


place = inner(_place)
hold = inner(_hold)
ranked = inner(_ranked)
survive = inner(_survive)
branch = inner(_branch)
read_scores = inner(_read_scores)
_follow = leap(FOLLOW)


def _replicate(  # type: ignore[no-untyped-def]
    address, stream, starts, signals, inputs, moving, windows, nominal, profile, marks, p, steps, counts, marginals,
    out, notes,
):  # fmt: skip
    """One replica: the estimate goes to ``out[0, 0, 0]``, the exits behind it; ``address`` is that of `FOLLOW`.

    ``profile[0]`` is the share of particles that a round discards; paths have noise-free ones of their own where
    ``marks`` is not empty.
    """
    count, dimension = starts.shape
    states = np.empty((count, steps + 1, dimension))
    frees = np.empty((count if len(marks) > 0 else 0, steps + 1, dimension))
    tops = np.zeros((count, steps + 1))
    scores = np.empty(count)
    alive = np.empty(count, dtype=np.int64)
    survivors = done = left = 0
    level, weight = -1.0, 1.0
    while count > 0:
        for path in range(count):
            if survivors > 0 and scores[path] > level:
                continue
            if survivors > 0:
                first = branch(stream, alive, survivors, level, path, signals, states, frees, tops)
            else:
                first = 0
                place(starts, path, states, frees)
            moved = _follow(
                address,
                (stream, signals, inputs, moving, windows, nominal, p, steps, notes, states, frees, tops, path, first),
            )
            if moved < 0:
                return -1
            done += moved
        left = read_scores(tops, scores)
        level = ranked(scores, int(profile[0] * count) - 1)
        if level >= 1.0:
            break
        survivors = survive(scores, level, alive)
        if survivors == 0:
            break
        weight *= survivors / count
    if count > 0:
        out[0, 0, 0] = weight * left / count
        out[0, 0, 1] = left
    return done


replicate = njit(types.int64(types.uintp, *KERNEL.args), **OPTIONS)(_replicate)
