"""Checks of user input: each returns a clean read-only value, or says which argument broke which rule."""

from __future__ import annotations

import contextlib
import difflib
import keyword
import operator
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from certbound.arrays import Array

_SLACK, _ROUNDING = 1e-12, 1e-14
"""How far a semidefinite matrix with a diagonal of 1 may miss it, and how far its computed eigenvalues may."""


def frozen(value: Any) -> Array:
    """A read-only copy as floats (-0.0 becomes 0.0)."""
    array = np.array(value, dtype=float) + 0.0
    array.setflags(write=False)
    return array


def assign(instance: object, **values: Any) -> None:
    """Set fields of a frozen record, while it is made."""
    for name, value in values.items():
        object.__setattr__(instance, name, value)


def _floats(name: str, value: Any) -> Array:
    try:
        raw = np.asarray(value)
        array = np.asarray(raw, dtype=float) if raw.dtype.kind in "biufO" else None
    except OverflowError as error:
        raise ValueError(f"`{name}` must hold numbers of at most 1.8e308 in size.") from error
    except (TypeError, ValueError) as error:
        raise TypeError(f"`{name}` must hold numbers, got {value!r}.") from error
    if array is None or value is None:
        raise TypeError(f"`{name}` must hold numbers, got {value!r}.")
    if np.any(np.isnan(array)):
        raise ValueError(f"`{name}` must not contain nan, got {value!r}.")
    return array


def number(name: str, value: Any, *, infinite: bool = False) -> float:
    """One real number."""
    if isinstance(value, bool):
        raise TypeError(f"`{name}` must be a number, got {value!r}.")
    array = _floats(name, value)
    if array.size != 1 or array.ndim > 1:
        raise ValueError(f"`{name}` must be one number, got {value!r}.")
    result = float(array.reshape(()))
    if not infinite and not np.isfinite(result):
        raise ValueError(f"`{name}` must be finite, got {result}.")
    return result


def vector(name: str, value: Any, length: int | None = None, *, infinite: bool = False) -> Array:
    """A vector; a number counts as a vector of one entry."""
    array = np.atleast_1d(_floats(name, value))
    if array.ndim != 1 or array.size == 0:
        raise ValueError(f"`{name}` must be a vector, got shape {array.shape}.")
    if length is not None and len(array) != length:
        raise ValueError(f"`{name}` must have {length} entries, got {len(array)}.")
    if not infinite and not np.all(np.isfinite(array)):
        raise ValueError(f"`{name}` must be finite, got {array.tolist()}.")
    return frozen(array)


def matrix(name: str, value: Any, rows: int | None = None, columns: int | None = None) -> Array:
    """A finite matrix of the given size (None: any)."""
    array = _floats(name, value)
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"`{name}` must be a matrix, got shape {array.shape}.")
    wanted = (array.shape[0] if rows is None else rows, array.shape[1] if columns is None else columns)
    if array.shape != wanted:
        raise ValueError(f"`{name}` must have shape {wanted}, got {array.shape}.")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"`{name}` must be finite.")
    return frozen(array)


def symmetric(name: str, value: Any, size: int | None = None) -> Array:
    """A symmetric matrix; what rounding makes of one is averaged away, in units in which its diagonal is 1."""
    array = matrix(name, value, size, size)
    if array.shape[0] != array.shape[1]:
        raise ValueError(f"`{name}` must be square, got shape {array.shape}.")
    scale = np.sqrt(np.abs(np.diag(array)))
    if np.any(np.abs(array - array.T) > _SLACK * (np.outer(scale, scale) + np.abs(array))):
        raise ValueError(f"`{name}` must be symmetric; use (M + M.T) / 2.")
    return frozen((array + array.T) / 2)


def positive_definite(name: str, value: Any, size: int | None = None, *, strict: bool = True) -> Array:
    """A symmetric matrix with positive (``strict=False``: nonnegative) eigenvalues, up to rounding.

    It is judged in units in which its diagonal is 1, so that a large entry hides nothing of a small one; what rounding
    has taken from a semidefinite matrix is added to its diagonal.
    """
    array = symmetric(name, value, size)
    rule = "positive definite" if strict else "positive semidefinite"
    diagonal = np.diag(array)
    if np.any(diagonal < 0) or (strict and not np.all(diagonal > 0)):
        raise ValueError(f"`{name}` must be {rule}, its diagonal has {float(diagonal.min()):.3g}.")
    kept = diagonal > 0
    if np.any(array[~kept]):
        raise ValueError(f"`{name}` must be {rule}: a row whose diagonal entry is 0 must be 0.")
    scale = np.sqrt(diagonal[kept])
    values = np.linalg.eigvalsh(array[np.ix_(kept, kept)] / scale[:, None] / scale)
    smallest = float(values[0]) if len(values) else 0.0
    if smallest <= 0 if strict else smallest < -_SLACK:
        raise ValueError(
            f"`{name}` must be {rule}, its smallest eigenvalue is {smallest:.3g} where its diagonal is scaled to 1."
        )
    return array if smallest > -_ROUNDING else frozen(array + np.diag(_SLACK * diagonal))


def names(name: str, value: Sequence[str], reserved: Iterable[str] = ()) -> tuple[str, ...]:
    """Distinct identifiers."""
    result = tuple(value)
    for entry in result:
        if isinstance(entry, str) and keyword.iskeyword(entry):
            raise ValueError(f"`{name}` must not use {entry!r}, a word of Python's own; {entry}_ would do.")
        if not isinstance(entry, str) or not entry.isidentifier():
            raise ValueError(f"`{name}` must be identifiers (letters, digits, _), got {entry!r}.")
        if entry in set(reserved) | {"t"}:
            raise ValueError(f"`{name}` must not use the name {entry!r}, which is taken; choose another.")
    if len(set(result)) != len(result):
        raise ValueError(f"`{name}` must be distinct, got {list(result)}.")
    return result


_OTHER_NAMES = {
    "normal": "gaussian", "double_exponential": "laplace", "empirical": "histogram", "constants": "parameters",
    "params": "parameters", "variables": "states", "state": "states", "system": "dynamics", "drift": "dynamics",
    "equations": "dynamics", "initial_state": "initial", "x0": "initial", "start": "initial", "safe": "stay",
    "constraints": "stay", "unsafe": "avoid", "obstacle": "avoid", "obstacles": "avoid", "target": "reach",
    "goal": "reach", "T": "horizon", "steps": "horizon", "offset": "bound", "interval": "box", "disturbance":
    "disturbances", "input": "inputs", "functions": "definitions", "where": "definitions", "window": "during",
}  # fmt: skip
"""Words that other tools use, and people, for what is known here by another."""


def nearest(word: str, known: Iterable[str]) -> str:
    """``; did you mean 'x'?`` with the nearest known word, or the list of known words."""
    known = sorted(known)
    close = [_OTHER_NAMES[word]] if _OTHER_NAMES.get(word) in known else difflib.get_close_matches(word, known, 1, 0.6)
    return f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(dict.fromkeys(known)) or 'none'}."


def instance(name: str, value: Any, kind: type) -> None:
    """Refuse what is no ``cb.Problem`` or whatever else is wanted."""
    if not isinstance(value, kind):
        cure = f"; give cb.load({value!r})." if isinstance(value, str) else "."
        raise TypeError(f"`{name}` must be a cb.{kind.__name__}, got {value!r}{cure}")


@contextlib.contextmanager
def located(where: str, names: Iterable[str]) -> Iterator[None]:
    """Say of errors about an argument where in a file it stands: ``radius`` becomes ``avoid.0.ball.radius``."""
    try:
        yield
    except (TypeError, ValueError) as error:
        text = str(error)
        for name in names:
            text = text.replace(f"`{name}`", f"`{where}.{name}`", 1)
        raise type(error)(text) from error


def pick(coordinates: Any, dimension: int) -> tuple[int, ...] | None:
    """Distinct state indices, as many as the set has dimensions."""
    if coordinates is None:
        return None
    try:
        result = tuple(map(operator.index, coordinates))
    except TypeError:
        raise TypeError(f"`coordinates` must be indices of states, counted from 0, got {coordinates!r}.") from None
    if len(result) != dimension or len(set(result)) != len(result) or any(index < 0 for index in result):
        raise ValueError(f"`coordinates` must be {dimension} distinct state indices, got {coordinates!r}.")
    return result
