"""The parts that a system is made of, checked: names of states and signals, bounds of signals, noise matrices."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import frozen, matrix, names, number
from certbound.problem.adapters import is_symbolic, read_model
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.sets import Box


def state_names(states: Any) -> tuple[str, ...]:
    """The names of the states, or x1, x2, ... for a number of them."""
    if isinstance(states, (int, np.integer)) and not isinstance(states, bool):
        if states < 1:
            raise ValueError(f"`states` must be at least 1, got {states}.")
        return tuple(f"x{k}" for k in range(1, states + 1))
    if isinstance(states, str) or not isinstance(states, Sequence) or not states:
        raise TypeError(f"`states` must be a number or a list of names, got {states!r}.")
    return names("states", states)


def signal_box(name: str, value: Any, symbol: str) -> Box | None:
    """The bounds of a signal, where it has any."""
    if value is None or (isinstance(value, Box) and value.coordinates is None and not value.moving):
        return value
    raise TypeError(f"`{name}` must be a Box that bounds {symbol}, got {value!r}; use cb.Box(low, high).")


def signal_names(
    name: str, given: Sequence[str] | None, box: Box | None, symbol: str, taken: Sequence[str]
) -> tuple[str, ...]:
    """The names of a signal's entries: the given ones, else the symbol with a number, and no name that is taken."""
    if given is not None and not isinstance(given, Iterable):
        raise TypeError(f"`{name}` must be a list of names, got {given!r}.")
    if box is None:
        if given:
            raise ValueError(f"`{name}` must come with bounds, got {list(given)} alone.")
        return ()
    if given is not None:
        if len(given) != box.dimension:
            raise ValueError(f"`{name}` must hold {box.dimension} names, got {list(given)}.")
        return names(name, given, taken)
    while any(entry.startswith(symbol) for entry in taken):
        symbol = f"{symbol}_"
    count = box.dimension
    return (symbol,) if count == 1 else tuple(f"{symbol}{k}" for k in range(1, count + 1))


def _noise_matrix(name: str, value: Any, n: int) -> Array:
    cure = "; write np.diag([...]) for independent noise on every state" if isinstance(value, Mapping) else ""
    try:
        raw = np.asarray("" if cure else value)
        array = (raw if raw.dtype.kind in "biufO" else np.asarray("")).astype(float)
    except (TypeError, ValueError) as error:  # rows of different lengths too
        raise TypeError(f"`{name}` must hold numbers, in rows of equal length, got {value!r}{cure}.") from error
    if array.ndim < 2 and n == 1:
        array = array.reshape(1, -1)
    if array.ndim == 0:
        raise ValueError(
            f"`{name}` must be a matrix with {n} rows (one per state), got the scalar "
            f"{number(name, value):g}; write {float(value):g} * np.eye({n}) for independent noise."
        )
    if array.ndim == 1:
        raise ValueError(
            f"`{name}` must be a matrix with {n} rows (one per state), got a vector; write np.diag([...]) "
            "for independent noise on every state, or a column [[...], [...]] for one common noise."
        )
    return matrix(name, array, rows=n)


def diffusion_of(
    value: Any, states: Sequence[str], name: str = "diffusion", *, rows: int | None = None
) -> Array | Tape:
    """The matrix of the noise: numbers where it is constant, else a tape over t and the states, with two axes.

    ``rows`` is their number where not every state has one.
    """
    n = len(states) if rows is None else rows
    if value is None:
        return frozen(np.zeros((n, 1)))
    if not callable(value) and not isinstance(value, Tape) and not is_symbolic(value):
        return _noise_matrix(name, value, n)
    tape = value if isinstance(value, Tape) else read_model(value, {"t": ["t"], "x": states}, matrix=True)
    if tape.inputs != ("t", *states):
        raise ValueError(f"`{name}` must be a tape over {('t', *states)}, got {tape.inputs}.")
    shape = tape.shape if len(tape.shape) == 2 else (1, *tape.shape)
    if len(tape.shape) == 1 and n > 1:
        raise ValueError(
            f"`{name}` must return a matrix with {n} rows (one per state), got shape {tape.shape}; write "
            "np.diag([...]) for independent noise on every state, or a column [[...], [...]]."
        )
    if shape[0] != n:
        raise ValueError(f"`{name}` must return {n} rows (one per state), got shape {shape}.")
    if all(node.op != "input" for node in tape.nodes):
        with np.errstate(all="ignore"):
            return matrix(name, compile_numpy(tape)(*np.zeros(1 + len(states))).reshape(shape), rows=n)
    return Tape(inputs=tape.inputs, nodes=tape.nodes, outputs=tape.outputs, shape=shape)
