"""Models made with python-control, read without importing it."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.problem.sets import Box


@dataclass(frozen=True, eq=False, kw_only=True)
class Imported:
    """A python-control model in this package's terms: f(t, x) or f(t, x, u), and the signals' names."""

    function: Callable[..., Any]
    states: tuple[str, ...]
    inputs: tuple[str, ...]

    def options(self, given: dict[str, Any]) -> dict[str, Any]:
        """The user's options, completed: inputs are unbounded unless given."""
        if not self.inputs:
            return given
        count = len(self.inputs)
        box = Box([-np.inf] * count, [np.inf] * count) if given["inputs"] is None else given["inputs"]
        if isinstance(box, Box) and box.dimension != count:
            raise ValueError(f"`inputs` must have {count} entries (the model's inputs), got {box.dimension}.")
        chosen = self.inputs if given["input_names"] is None else given["input_names"]
        return given | {"inputs": box, "input_names": chosen}


def is_control_system(value: Any) -> bool:
    """True for a python-control system with a state equation."""
    known = type(value).__module__.partition(".")[0] == "control"
    return known and (hasattr(value, "updfcn") or hasattr(value, "A"))


def import_control(system: Any, time: str) -> Imported:
    """Read a ``StateSpace`` or ``NonlinearIOSystem``.

    One whose time base is not ``time``, or that has no states, is a ValueError.
    """
    discrete = bool(system.isdtime(strict=True))
    if discrete != (time == "discrete"):
        word, other = ("discrete", "DiscreteSystem") if discrete else ("continuous", "ContinuousSystem")
        raise ValueError(f"the python-control model is in {word} time (dt = {system.dt}); use cb.{other}.")
    if not system.nstates:
        raise ValueError("the python-control model has no states.")
    states = _identifiers(system.state_labels, "x")
    if hasattr(system, "A"):
        return _linear(system, states)
    step = float(system.dt) if discrete and system.dt is not True else 1.0
    update, parameters, count = system.updfcn, dict(system.params), int(system.ninputs or 0)
    if count == 0:
        return Imported(
            function=lambda t, x: update(step * t, x, np.zeros(0), parameters), states=states, inputs=()
        )
    return Imported(
        function=lambda t, x, u: update(step * t, x, u, parameters),
        states=states,
        inputs=_identifiers(system.input_labels, "u", states),
    )


def _linear(system: Any, states: tuple[str, ...]) -> Imported:
    a, b = np.asarray(system.A, dtype=float), np.asarray(system.B, dtype=float)
    if not np.any(b):
        return Imported(function=lambda t, x: a @ x, states=states, inputs=())
    inputs = _identifiers(system.input_labels, "u", states)
    return Imported(function=lambda t, x, u: a @ x + b @ u, states=states, inputs=inputs)


def _identifiers(labels: Sequence[str], symbol: str, taken: Sequence[str] = ()) -> tuple[str, ...]:
    """The labels as identifiers (``x[0]`` becomes x0), or numbered symbols where that fails."""
    cleaned = [re.sub(r"\W+", "_", str(label)).strip("_") for label in labels]
    cleaned = [re.sub(r"_(\d+)$", r"\1", label) for label in cleaned]
    usable = all(label.isidentifier() and label not in (*taken, "t") for label in cleaned)
    if usable and len(set(cleaned)) == len(cleaned):
        return tuple(cleaned)
    return tuple(f"{symbol}{k}" for k in range(1, len(cleaned) + 1))
