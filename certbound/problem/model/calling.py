"""Calling a network: on numbers, on arrays, and on traced values, of which it makes one node for each output."""

from __future__ import annotations

from typing import Any

import numpy as np

from certbound.problem.model import network_rows
from certbound.problem.model.graph import Graph
from certbound.problem.model.network_data import Network, Part
from certbound.problem.model.tracer import Scalar, Traced, UntraceableError


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
