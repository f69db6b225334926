"""Networks as functions that models call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from inspect import Parameter, Signature
from pathlib import Path
from typing import Any

from certbound.problem.model import Network, call_network
from certbound.problem.networks.onnx_files import read_onnx
from certbound.problem.networks.stored import layers_of, read_json, read_npz, write_npz

_READERS = {".onnx": read_onnx, ".npz": read_npz, ".json": read_json}
_LARGEST = 64_000_000


class NetworkFunction:
    """A network, to be called in a model: ``policy(x)`` on a vector, or ``policy(x[0], x[1])`` on its entries.

    Made by :func:`network`. On arrays it computes in floats, (..., inputs) to (..., outputs). As a plan or a model
    itself it is a function of all states, ``x``.

    Attributes
    ----------
    data : Network
        Its layers, as plain data.
    """

    __signature__ = Signature([Parameter("x", Parameter.POSITIONAL_OR_KEYWORD)])

    def __init__(self, data: Network) -> None:
        self.data = data

    def __call__(self, *args: Any, **named: Any) -> Any:
        return call_network(self.data, *args, *named.values())

    @property
    def inputs(self) -> int:
        """How many numbers it takes."""
        return self.data.inputs

    @property
    def outputs(self) -> int:
        """How many numbers it gives."""
        return self.data.outputs

    def __repr__(self) -> str:
        sizes = [self.inputs, *(len(layer.bias) for layer in self.data.layers)]
        kinds = ", ".join(layer.activation for layer in self.data.layers)
        return f"<network {self.data.name}: {' -> '.join(map(str, sizes))} ({kinds})>"


def network(source: str | Path | Sequence[Mapping[str, Any]], *, name: str = "") -> NetworkFunction:
    """A neural network as a function that models call, kept whole in tapes, enclosures, kernels and certificates.

    Parameters
    ----------
    source : str, Path or sequence of mappings
        A file (``.onnx``, ``.npz`` or ``.json``), or the layers themselves: each a mapping with ``weights`` (p, k),
        ``bias`` (p,) [zeros] and ``activation`` [linear], one of linear, tanh, sigmoid, softplus, elu, sin, relu,
        leaky_relu (with ``slope``) and clip (with ``low`` and ``high``). A file is only read, never run.
    name : str, optional
        What messages call it; by default the file's name.

    Raises
    ------
    ValueError
        If the file cannot be read, is too large, or holds what is not supported (which is named).
    ImportError
        If ONNX files are asked for without the package ``onnx`` (the extra ``certbound[onnx]``).

    Examples
    --------
    >>> policy = network([{"weights": [[-1.2, -0.5]], "activation": "tanh"}])
    >>> [round(float(value), 6) for value in policy([0.1, 0.2])]
    [-0.216518]
    """
    if isinstance(source, (str, Path)):
        path = Path(source)
        reader = _READERS.get(path.suffix.lower())
        if reader is None:
            raise ValueError(f"`source` must end in {', '.join(_READERS)}, got {str(source)!r}.")
        try:
            size = path.stat().st_size
        except OSError as error:
            reason = error.strerror or "no access"
            raise ValueError(f"`source` must be a readable file, got {str(path)!r}: {reason}.") from error
        if size > _LARGEST:
            raise ValueError(f"`source` must be at most {_LARGEST // 10**6} MB, {str(path)!r} has {size // 10**6}.")
        layers, default = reader(path), path.stem
    else:
        layers, default = layers_of(source), "network"
    return NetworkFunction(Network(layers=tuple(layers), name=name or default))


def write_network(function: NetworkFunction, path: str | Path) -> None:
    """Write a network to an ``.npz`` file, which :func:`network` reads back as the same numbers."""
    if Path(path).suffix != ".npz":
        raise ValueError(f"`path` must end in .npz, got {str(path)!r}.")
    write_npz(function.data.layers, Path(path))
