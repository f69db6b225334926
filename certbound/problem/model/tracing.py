"""From a NumPy-style Python function to a tape; and calling a network, on numbers and arrays or on traced values."""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from certbound.problem.model import network_rows
from certbound.problem.model.graph import Graph
from certbound.problem.model.network_data import Network, Part
from certbound.problem.model.networks_found import with_layers
from certbound.problem.model.tape import Tape
from certbound.problem.model.tracer import Scalar, Traced, UntraceableError, traced_arrays


def trace(function: Callable[..., Any], arguments: Mapping[str, Sequence[str]]) -> Tape:
    """Record a NumPy-style function as a tape.

    The function is called once, with traced values. It may use Python's operators, indexing, loops over a
    fixed range, ``@`` with constant matrices, and NumPy's elementary functions (np.sin, np.where, np.maximum,
    np.linalg.norm, ...).

    Parameters
    ----------
    function : callable
        Takes any of the arguments, by name: ``lambda t, x``; or their entries, by theirs: ``lambda angle, speed``.
        Where one is called by the name of an entry, all are that can be. Parameters that have a default and are not
        among ``arguments`` keep it.
    arguments : mapping
        Argument name to the names of its scalar entries. ``t`` is passed as a scalar, everything else as an
        array of one dimension. The order fixes the input slots.

    Returns
    -------
    Tape
        With inputs in the order of ``arguments`` and the shape of what the function returned (``(1,)`` for a
        scalar).

    Raises
    ------
    TypeError
        If the function takes other arguments, or does what cannot be traced (``if x > 0``, ``math.sin(x)``,
        ``float(x)``); the message names the line and the cure.
    ValueError
        If the function returns nothing, a ragged list, or a value that is not finite.

    Examples
    --------
    >>> tape = trace(lambda t, x: [x[1], -np.sin(x[0])], {"t": ["t"], "x": ["angle", "speed"]})
    >>> tape.inputs, tape.shape
    (('t', 'angle', 'speed'), (2,))
    >>> trace(lambda angle, speed: [speed, -np.sin(angle)], {"t": ["t"], "x": ["angle", "speed"]}).shape
    (2,)
    """
    inputs = [name for names in arguments.values() for name in names]
    if len(set(inputs)) != len(inputs):
        repeated = sorted({name for name in inputs if inputs.count(name) > 1})
        raise ValueError(f"names must be distinct, got {repeated} more than once.")
    graph = Graph(inputs)
    values: dict[str, Any] = {}
    scalars: dict[str, Any] = {}
    slot = 0
    for key, names in arguments.items():
        entries = [Scalar(graph, graph.input(slot + k)) for k in range(len(names))]
        slot += len(names)
        scalars |= dict(zip(names, entries))
        values[key] = entries[0] if key == "t" else _array(entries).view(Traced)
    name = getattr(function, "__name__", type(function).__name__)
    names = _parameters(function, name, arguments)
    if any(key not in arguments for key in names):
        values |= scalars
    chosen = {key: values[key] for key in names}
    try:
        with traced_arrays():
            result = function(**chosen)
    except UntraceableError as error:
        raise TypeError(f"`{name}` cannot be traced{_place(error)}: {error}.") from error
    except (TypeError, AttributeError) as error:
        cure = (
            "use NumPy's elementary functions on the entries (np.sin, np.where, np.maximum), or on x itself"
        )
        raise TypeError(f"`{name}` cannot be traced{_place(error)}: {error}; {cure}.") from error
    except (IndexError, ValueError) as error:  # x[2] of two states, a, b = x of three
        sizes = ", ".join(f"{key} of {len(arguments[key])}" for key in names if key != "t" and key in arguments)
        raise ValueError(
            f"`{name}` cannot be traced{_place(error)}: {str(error).rstrip('.')}; it was given {sizes or 'numbers'}."
        ) from error
    return _finish(graph, result, name)


def _array(entries: Sequence[Any]) -> np.ndarray[Any, np.dtype[Any]]:
    array = np.empty(len(entries), dtype=object)
    array[:] = entries
    return array


def _parameters(function: Any, name: str, arguments: Mapping[str, Sequence[str]]) -> list[str]:
    known = list(arguments)
    entries = [entry for names in arguments.values() for entry in names]
    if not callable(function):
        cure = "; expressions in text are for problem files." if isinstance(function, str) else "."
        raise TypeError(f"the model must be a function of {', '.join(known)}, got {function!r}{cure}")
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError) as error:
        raise TypeError(f"`{name}` must be a Python function of {', '.join(known)}: {error}.") from error
    chosen: list[str] = []
    for parameter in signature.parameters.values():
        positional = parameter.kind in (
            parameter.POSITIONAL_ONLY,
            parameter.VAR_POSITIONAL,
            parameter.VAR_KEYWORD,
        )
        needed = parameter.default is parameter.empty
        if not positional and (parameter.name in known or (parameter.name in entries and needed)):
            chosen.append(parameter.name)
        elif positional or needed:
            raise TypeError(
                f"`{name}` must take its arguments by name, from {', '.join(known)} or the names of their entries"
                f"{_named(entries)}; got `{parameter}`"
                + (
                    " (a system with u needs `inputs=`, one with d needs `disturbance=`)."
                    if parameter.name in "ud"
                    else "."
                )
            )
    return chosen


def _named(entries: list[str], most: int = 8) -> str:
    named = [entry for entry in entries if entry != "t"]
    return f" ({', '.join(named[:most])}{', ...' if len(named) > most else ''})"


def _place(error: Exception) -> str:
    """Where in the user's code an error arose."""
    here, numpy = Path(__file__).parent, Path(np.__file__).parent
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if here != path.parent and numpy not in path.parents:
            return f" (line {frame.lineno} of {path.name}: {frame.line})" if frame.line else ""
    return ""


def _finish(graph: Graph, result: Any, name: str) -> Tape:
    array = _collected(result, name)
    outputs: list[int] = []
    for place, entry in enumerate(array.reshape(-1)):
        if isinstance(entry, Scalar):
            if entry.graph is not graph:
                raise TypeError(
                    f"`{name}` returned a value of another call; it must depend on its arguments only."
                )
            outputs.append(entry.index)
            continue
        try:
            outputs.append(graph.const(float(entry)))
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"`{name}` must return finite numbers, got {entry!r} at position {place}."
            ) from error
    return with_layers(graph.tape(outputs, array.shape or (1,)))


def _collected(result: Any, name: str) -> np.ndarray[Any, np.dtype[Any]]:
    if result is None:
        raise ValueError(f"`{name}` must return its value, got None; add a return statement.")
    try:
        array = np.array(_listed(result), dtype=object)
    except ValueError as error:
        raise ValueError(
            f"`{name}` must return a vector or a matrix of scalars, got a ragged list."
        ) from error
    if array.ndim > 2 or any(isinstance(entry, (list, tuple)) for entry in array.reshape(-1)):
        raise ValueError(
            f"`{name}` must return a vector or a matrix of scalars, got a ragged or deeper list."
        )
    return array


def _listed(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist() if value.dtype != object else _listed(list(value) if value.ndim else value[()])
    return [_listed(item) for item in value] if isinstance(value, (list, tuple)) else value


def call_network(network: Network, *args: Any) -> Any:
    """The outputs of a network.

    Parameters
    ----------
    network : Network
        With n inputs and p outputs.
    *args : array_like
        One array (..., n), or n numbers or arrays that broadcast; traced values in a traced function.

    Returns
    -------
    ndarray, shape (..., p)
        Traced, where an argument is.

    Raises
    ------
    ValueError
        If there are not n inputs.
    """
    plain = [arg.view(np.ndarray) if isinstance(arg, Traced) else arg for arg in args]
    whole = len(plain) == 1 and not isinstance(plain[0], Scalar) and np.ndim(plain[0]) > 0
    entries = list(np.moveaxis(np.asarray(plain[0]).view(np.ndarray), -1, 0)) if whole else plain
    if len(entries) != network.inputs:
        raise ValueError(f"`{network.name}` takes {network.inputs} numbers, got {len(entries)}.")
    graph = next((entry.graph for entry in _flat(entries) if isinstance(entry, Scalar)), None)
    if graph is None:
        columns = [network_rows.numpy(*entries, Part(network, output)) for output in range(network.outputs)]
        return np.stack(np.broadcast_arrays(*columns), axis=-1)
    if any(np.ndim(entry) for entry in entries if not isinstance(entry, Scalar)):
        raise UntraceableError(f"{network.name} takes one vector of traced values at a time, or numbers one by one")
    nodes = tuple(_node(graph, entry) for entry in entries)
    result = np.empty(network.outputs, dtype=object)
    for output in range(network.outputs):
        result[output] = Scalar(graph, graph.part(Part(network, output), nodes))
    return result.view(Traced)


def _flat(entries: list[Any]) -> list[Any]:
    return [part for entry in entries for part in (entry.reshape(-1) if isinstance(entry, np.ndarray) else [entry])]


def _node(graph: Graph, entry: Any) -> int:
    entry = entry[()] if isinstance(entry, np.ndarray) else entry
    if isinstance(entry, Scalar):
        if entry.graph is not graph:
            raise UntraceableError("a network meets values of two traced calls")
        return entry.index
    return graph.const(float(entry))
