"""What is proved, kept in a file line by line: a run that was killed goes on where it was."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from certbound._version import __version__
from certbound.problem.problem import Problem
from certbound.safety.sweeps.family import Grid, Point
from certbound.safety.sweeps.found import Row

_KIND = "certbound sweep"
_IN_LINE = ("status", "log10_delta", "log10_lower", "method", "reason", "seconds")


class Record:
    """Rows by point; with a file, those of an earlier run, and each new one at once.

    Parameters
    ----------
    path : Path, optional
        The file; it is begun where there is none.
    grid, settings
        What the file must have been written for.
    """

    def __init__(self, path: Path | None, grid: Grid, settings: Mapping[str, Any]) -> None:
        self.rows: dict[Point, Row] = {}
        self._digests: dict[Point, str] = {}
        self._grid = grid
        self._path = path
        if path is None:
            return
        self._head = {
            "file": _KIND,
            "certbound": __version__,
            "grid": {name: list(values) for name, values in zip(grid.names, grid.values)},
            "settings": dict(settings),
        }
        if not path.exists() or not path.stat().st_size:
            self._append(self._head)
        else:
            self._read(path)

    def has(self, point: Point, problem: Problem) -> bool:
        """Whether a point is proved; ValueError where that was of another problem."""
        if point not in self.rows:
            return False
        if self._digests.get(point) not in (None, digest_of(problem)):
            raise ValueError(
                f"`resume` {self._path} belongs to another problem, at {self._grid.words(point)}; choose another file, "
                "or delete it."
            )
        return True

    def add(self, point: Point, row: Row, problem: Problem) -> None:
        """Keep a row, on the disk before anything else happens."""
        self.rows[point] = row
        if self._path is not None:
            line = {"point": list(point), "problem": digest_of(problem)}
            self._append(line | {name: getattr(row, name) for name in _IN_LINE})

    def _append(self, line: Mapping[str, Any]) -> None:
        assert self._path is not None
        with self._path.open("ab") as stream:
            stream.write(json.dumps(line).encode() + b"\n")
            stream.flush()
            os.fsync(stream.fileno())

    def _read(self, path: Path) -> None:
        """The whole lines of a file; what a killed run left of one is cut off."""
        content = path.read_bytes()
        kept = content.rfind(b"\n") + 1
        lines = content[:kept].splitlines()
        head = _parsed(lines[0]) if lines else None
        if not isinstance(head, dict) or head.get("file") != _KIND:
            if not lines and json.dumps(self._head).encode().startswith(content):  # killed at the first line
                os.truncate(path, 0)
                self._append(self._head)
                return
            raise ValueError(f"`resume` {path} was not written by a sweep; choose another file.")
        for name, mine in self._head.items():
            if head.get(name) != mine:
                raise ValueError(
                    f"`resume` {path} belongs to another {'version of certbound' if name == 'certbound' else name} "
                    f"({_short(head.get(name))}, here {_short(mine)}); choose another file, or delete it."
                )
        for number, line in enumerate(lines[1:], 2):
            found = _parsed(line)
            try:
                point = tuple(float(value) for value in found["point"])
                row = Row(parameters=self._grid.named(point), **{name: found[name] for name in _IN_LINE})
                self.rows[point], self._digests[point] = row, str(found["problem"])
            except (TypeError, KeyError, ValueError) as error:
                raise ValueError(f"`resume` {path} is damaged in line {number}; choose another file.") from error
        if kept < len(content):
            os.truncate(path, kept)


def digest_of(problem: Problem) -> str:
    """A digest of everything that a verdict on the problem may depend on."""
    left_out = ("name", "parameters", "source")
    parts = {field.name: getattr(problem, field.name) for field in dataclasses.fields(problem)}
    state = hashlib.sha256()
    _feed(state, {name: value for name, value in parts.items() if name not in left_out})
    return state.hexdigest()[:32]


def _feed(state: Any, value: Any) -> None:
    """Add a value, and what it is made of, to a digest."""
    if isinstance(value, np.ndarray):
        state.update(f"array {value.dtype} {value.shape} {value.ravel().tolist()!r};".encode())
    elif isinstance(value, Mapping):
        for key in sorted(value, key=repr):
            state.update(f"{key!r}:".encode())
            _feed(state, value[key])
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        state.update(f"({len(value)}".encode())
        for entry in value:
            _feed(state, entry)
    elif value is None or isinstance(value, str | bytes | bool | int | float | np.generic):
        state.update(f"{value!r};".encode())
    else:
        state.update(f"{type(value).__qualname__} ".encode())
        slots = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
        inner = {name: getattr(value, name) for name in slots if hasattr(value, name)}
        _feed(state, inner | getattr(value, "__dict__", {}))


def _parsed(line: bytes) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
