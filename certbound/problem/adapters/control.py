"""Models made with python-control, read without importing it."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.adapters.realization import realized
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
    """True for a python-control system that has a state equation or, a transfer function, can be given one."""
    known = type(value).__module__.partition(".")[0] == "control"
    return known and (hasattr(value, "updfcn") or hasattr(value, "A") or hasattr(value, "num"))


def import_control(system: Any, time: str) -> Imported:
    """Read a ``StateSpace``, ``TransferFunction`` or ``NonlinearIOSystem``.

    One whose time base is not ``time``, or that has no states, is a ValueError.
    """
    block = import_block(system, time)
    if not block.driven:
        return Imported(function=lambda t, x: block.moves(t, x, np.zeros(0)), states=block.states, inputs=())
    return Imported(function=lambda t, x, u: block.moves(t, x, u), states=block.states, inputs=block.inputs)


@dataclass(frozen=True, eq=False, kw_only=True)
class Block:
    """A python-control model with all its signals: its next state or its rate, and its outputs, over (t, x, u)."""

    moves: Callable[[Any, Any, Any], Any]
    shows: Callable[[Any, Any, Any], Any]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    driven: bool  # whether the inputs act on the states


def import_block(system: Any, time: str) -> Block:
    """The same as a block between inputs and outputs; t counts steps in discrete time. Errors are the same."""
    discrete = bool(system.isdtime(strict=True))
    if discrete != (time == "discrete"):
        word, other = ("discrete", "DiscreteSystem") if discrete else ("continuous", "ContinuousSystem")
        raise ValueError(f"the python-control model is in {word} time (dt = {system.dt}); use cb.{other}.")
    if hasattr(system, "A") or hasattr(system, "num"):
        return _linear(linear_model(system))
    states = _identifiers(_with_states(system).state_labels, "x")
    step = float(system.dt) if discrete and system.dt is not True else 1.0
    update, show, parameters = system.updfcn, system.outfcn, dict(system.params)
    return Block(
        moves=lambda t, x, u: update(step * t, x, u, parameters),
        shows=lambda t, x, u: x if show is None else show(step * t, x, u, parameters),
        states=states, inputs=_identifiers(system.input_labels, "u", states), driven=bool(system.ninputs),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearModel:
    """A linear python-control model: x' = A x + B u, y = C x + D u (x+ in discrete time), and its signals' names."""

    A: Array
    B: Array
    C: Array
    D: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]


def linear_model(system: Any) -> LinearModel:
    """The matrices of a ``StateSpace``, or those of a realization of a ``TransferFunction``.

    Of a transfer function every output has states of its own, the first of which is the output itself (less what the
    inputs add to it at once). One without states, or that is improper, is a ValueError.
    """
    if hasattr(system, "num"):
        outputs = _identifiers(system.output_labels, "y")
        a, b, c, d, names = realized(system.num, system.den, outputs, system.input_labels)
        if not names:
            raise ValueError("the python-control model has no states.")
        states = tuple(names)
    else:
        a, b, c, d = (np.asarray(matrix, dtype=float) for matrix in (system.A, system.B, system.C, system.D))
        states = _identifiers(_with_states(system).state_labels, "x")
    return LinearModel(A=a, B=b, C=c, D=d, states=states, inputs=_identifiers(system.input_labels, "u", states))


def linear_inputs(system: Any) -> Array:
    """B, shape (n, m), of a linear model; any other is a ValueError."""
    if not (hasattr(system, "A") or hasattr(system, "num")):
        raise ValueError("`input_noise` is for linear models; give `diffusion` (or `noise` and `noise_matrix`) here.")
    return linear_model(system).B


def _with_states(system: Any) -> Any:
    if not system.nstates:
        raise ValueError("the python-control model has no states.")
    return system


def _linear(model: LinearModel) -> Block:
    a, b, c, d = model.A, model.B, model.C, model.D
    return Block(
        moves=lambda t, x, u: a @ x + b @ u if np.any(b) else a @ x,
        shows=lambda t, x, u: c @ x + d @ u if np.any(d) else c @ x,
        states=model.states, inputs=model.inputs, driven=bool(np.any(b)),
    )  # fmt: skip


def _identifiers(labels: Sequence[str], symbol: str, taken: Sequence[str] = ()) -> tuple[str, ...]:
    """The labels as identifiers (``x[0]`` becomes x0), or numbered symbols where that fails."""
    cleaned = [re.sub(r"\W+", "_", str(label)).strip("_") for label in labels]
    cleaned = [re.sub(r"_(\d+)$", r"\1", label) for label in cleaned]
    usable = all(label.isidentifier() and label not in (*taken, "t") for label in cleaned)
    if usable and len(set(cleaned)) == len(cleaned):
        return tuple(cleaned)
    return tuple(f"{symbol}{k}" for k in range(1, len(cleaned) + 1))
