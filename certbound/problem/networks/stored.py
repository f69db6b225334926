"""Networks as lists of layers: in Python, in JSON files, and in NumPy's ``.npz`` files.

A JSON file holds ``{"layers": [{"weights": [[...]], "bias": [...], "activation": "tanh"}, ...]}``, or the list alone.
An ``.npz`` file holds ``weights_0``, ``bias_0``, ``weights_1``, ... and ``activations`` (text), with ``constants_k``
where an activation has constants; arrays of objects are refused, so that nothing is executed.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from certbound.checks import nearest
from certbound.problem.model import Layer

_OWN = {"leaky_relu": ("slope",), "clip": ("low", "high")}
_KEYS = ("weights", "bias", "activation", "slope", "low", "high")


def layers_of(rows: Any) -> list[Layer]:
    """Layers from mappings: ValueError where one is no layer."""
    if isinstance(rows, Mapping) or not isinstance(rows, Sequence) or isinstance(rows, str):
        raise ValueError(f"`source` must be a list of layers, got {type(rows).__name__}.")
    return [_layer(row, f"layers.{number}") for number, row in enumerate(rows)]


def _layer(row: Any, where: str) -> Layer:
    if not isinstance(row, Mapping) or "weights" not in row:
        raise ValueError(f"`{where}` must be a table with `weights`, got {type(row).__name__}.")
    for key in row:
        if key not in _KEYS:
            raise ValueError(f"unknown key {key!r} in {where}{nearest(str(key), _KEYS)}")
    activation = str(row.get("activation", "linear"))
    own = _OWN.get(activation, ())
    try:
        weights = np.asarray(row["weights"], dtype=float)
        bias = np.asarray(row.get("bias", np.zeros(len(weights))), dtype=float)
        constants = tuple(float(row[key]) for key in own)
    except KeyError as error:
        raise ValueError(f"`{where}` must give {error} for {activation}.") from None
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{where}` must hold numbers: {error}.") from error
    return made_layer(weights, bias, activation, constants, where)


def made_layer(
    weights: Any, bias: Any, activation: str, constants: tuple[float, ...] = (), where: str = "layers"
) -> Layer:
    """A layer from arrays: ValueError where they are none."""
    if weights.ndim != 2 or bias.ndim != 1 or 0 in weights.shape:
        raise ValueError(f"`{where}` must have a matrix of weights and a vector as bias, got {weights.shape}.")
    rows = tuple(tuple(row) for row in weights.astype(float).tolist())
    try:
        return Layer(rows, tuple(bias.astype(float).tolist()), activation, constants)
    except ValueError as error:
        raise ValueError(f"`{where}`: {error}") from None


def read_json(path: Path) -> list[Layer]:
    """Layers of a JSON file."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"`source` must be a JSON file, {str(path)!r} is none: {error}.") from error
    if isinstance(content, dict) and set(content) == {"layers"}:
        content = content["layers"]
    if not isinstance(content, list):
        raise ValueError(f"`source` must hold a list of layers, or `layers` alone, {str(path)!r} does not.")
    return layers_of(content)


_MOST_BYTES = 64_000_000


def read_npz(path: Path) -> list[Layer]:
    """Layers of an ``.npz`` file."""
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _MOST_BYTES:
                raise ValueError(f"it holds more than {_MOST_BYTES // 10**6} MB.")
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise ValueError(f"`source` must be an .npz file of plain arrays, {str(path)!r} is none: {error}") from error
    names = [str(name) for name in np.atleast_1d(arrays.pop("activations", np.array([])))]
    layers = []
    for number, activation in enumerate(names):
        weights = arrays.pop(f"weights_{number}", np.zeros(0))
        bias = arrays.pop(f"bias_{number}", np.zeros(len(weights)))
        constants = tuple(np.atleast_1d(arrays.pop(f"constants_{number}", np.zeros(0))).astype(float).tolist())
        layers.append(made_layer(weights, bias, activation, constants, f"weights_{number}"))
    if arrays or not layers:
        raise ValueError(
            "`source` must hold weights_0, bias_0, ..., and `activations` with one name a layer; "
            f"{str(path)!r} holds {', '.join(sorted(arrays)[:4]) or 'nothing'} besides."
        )
    return layers


def write_npz(layers: Sequence[Layer], path: Path) -> None:
    """Write layers as `read_npz` reads them."""
    arrays: dict[str, Any] = {"activations": np.array([layer.activation for layer in layers])}
    for number, layer in enumerate(layers):
        arrays |= {f"weights_{number}": np.array(layer.weights), f"bias_{number}": np.array(layer.bias)}
        if layer.constants:
            arrays[f"constants_{number}"] = np.array(layer.constants)
    np.savez(path, **arrays)
