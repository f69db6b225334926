"""ONNX files: a chain of layers as PyTorch, Keras and scikit-learn export it, read without running anything.

The network that is read is the real function of the file's numbers: every float32 is a float64 exactly. Only a scaling
by 1/s (Div) is rounded. What a runtime rounds when it evaluates the network in float32 is no part of the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import Layer
from certbound.problem.networks.stored import made_layer

_PLAIN = {
    "Relu": "relu", "Tanh": "tanh", "Sigmoid": "sigmoid", "Softplus": "softplus", "Sin": "sin", "Elu": "elu",
    "LeakyRelu": "leaky_relu", "Clip": "clip",
}  # fmt: skip
_PASSED = ("Identity", "Flatten", "Reshape", "Squeeze", "Unsqueeze", "Dropout", "Cast")
_AFFINE = ("Gemm", "MatMul", "Add", "Sub", "Mul", "Div")
_MOST_NODES = 1000


def read_onnx(path: Path) -> list[Layer]:
    """Layers of an ONNX file with one chain of operations from its input to its output."""
    try:
        import onnx
    except ImportError as error:
        raise ImportError("ONNX files need the package onnx: pip install 'certbound[onnx]'.") from error
    try:
        model = onnx.load(str(path), load_external_data=False)
    except Exception as error:
        raise ValueError(f"`source` must be an ONNX file, {str(path)!r} is none ({type(error).__name__}).") from error
    return _Chain(model.graph, str(path), onnx).layers()


class _Chain:
    """The walk from the input to the output: what is affine is collected until an activation closes the layer."""

    def __init__(self, graph: Any, path: str, onnx: Any) -> None:
        self.graph, self.path, self.onnx = graph, path, onnx
        self.constants: dict[str, Array] = {tensor.name: self.array(tensor) for tensor in graph.initializer}
        inputs = [value for value in graph.input if value.name not in self.constants]
        if len(inputs) != 1 or len(graph.output) != 1 or len(graph.node) > _MOST_NODES:
            raise self.fail(f"it has {len(inputs)} inputs and {len(graph.output)} outputs, not one of each")
        self.current = inputs[0].name
        sizes = [int(side.dim_value) for side in inputs[0].type.tensor_type.shape.dim]
        self.width = int(np.prod([side for side in sizes[1:] if side] or sizes[-1:] or [0]))
        self.found: list[Layer] = []
        self.weights: Array | None = None  # of the layer under way
        self.bias: Array | None = None

    def fail(self, why: str) -> ValueError:
        return ValueError(f"`source` must be a network that is a chain of layers; in {self.path!r} {why}.")

    def array(self, tensor: Any) -> Array:
        if tensor.data_location == self.onnx.TensorProto.EXTERNAL:
            raise self.fail(f"{tensor.name} lies in another file; save the network as one file")
        return np.asarray(self.onnx.numpy_helper.to_array(tensor))

    def layers(self) -> list[Layer]:
        for node in self.graph.node:
            self.take(node)
        if self.current != self.graph.output[0].name:
            raise self.fail("the output is not what the chain ends with")
        if self.weights is not None or not self.found:
            self.close("linear")
        return self.found

    def take(self, node: Any) -> None:
        given = {entry.name: self.onnx.helper.get_attribute_value(entry) for entry in node.attribute}
        if node.op_type == "Constant":
            self.constants[node.output[0]] = self.constant(given)
            return
        if node.domain not in ("", "ai.onnx"):
            raise self.fail(f"{node.op_type} is one of {node.domain}, and not of ONNX")
        known = [self.constants.get(name) for name in node.input]
        if node.op_type == "Transpose" and known[0] is not None:
            self.constants[node.output[0]] = np.transpose(known[0], given.get("perm"))
            return
        if [name for name in node.input if name and name not in self.constants] != [self.current]:
            raise self.fail(f"{node.op_type} {node.name!r} has inputs beside the chain")
        if node.op_type == "Cast" and given["to"] not in (self.onnx.TensorProto.FLOAT, self.onnx.TensorProto.DOUBLE):
            raise self.fail("a Cast leads to numbers that are no float32 or float64, which rounds")
        if node.op_type in _AFFINE:
            self.affine(node, known, given)
        elif node.op_type in _PLAIN:
            self.close(_PLAIN[node.op_type], self.own_constants(node.op_type, known, given))
        elif node.op_type not in _PASSED:
            raise self.fail(
                f"{node.op_type} is not supported; supported are {', '.join([*_AFFINE, *_PLAIN, *_PASSED])}"
            )
        self.current = node.output[0]

    def constant(self, given: Mapping[str, Any]) -> Array:
        (name, value), *_ = given.items()
        if name == "value":
            return self.array(value)
        if name not in ("value_float", "value_floats", "value_int", "value_ints"):
            raise self.fail(f"a Constant holds {name}")
        return np.asarray(value)

    def own_constants(self, op: str, known: list[Array | None], given: Mapping[str, Any]) -> tuple[float, ...]:
        if op == "Elu" and float(given.get("alpha", 1.0)) != 1.0:
            raise self.fail(f"Elu has alpha {given['alpha']}, and only 1 is supported")
        if op == "LeakyRelu":
            return (float(given.get("alpha", np.float32(0.01))),)
        if op != "Clip":
            return ()
        ends = [given.get("min"), given.get("max")]
        for place, value in enumerate(known[1:3]):
            ends[place] = ends[place] if value is None else float(np.asarray(value).reshape(-1)[0])
        if ends[0] is None or ends[1] is None:
            raise self.fail("Clip has one end only; use Relu, or give both")
        return float(ends[0]), float(ends[1])

    def affine(self, node: Any, known: list[Array | None], given: Mapping[str, Any]) -> None:
        op, first = node.op_type, known[0] is None
        numbers = np.asarray(next(value for value in known if value is not None), dtype=float)
        if op == "Gemm":
            if not first or given.get("transA", 0) or given.get("alpha", 1.0) != 1 or given.get("beta", 1.0) != 1:
                raise self.fail("a Gemm has transA, alpha or beta, or its weights on the left")
            offset = None if len(known) < 3 else known[2]
            self.linear(numbers if given.get("transB", 0) else numbers.T, offset)
        elif op == "MatMul":
            if numbers.ndim != 2:
                raise self.fail(f"a MatMul has weights of shape {numbers.shape}, and not a matrix")
            self.linear(numbers.T if first else numbers, None)
        elif op == "Add" or (op == "Sub" and first):
            self.shift(numbers if op == "Add" else -numbers)
        elif op == "Sub":
            self.scale(np.array(-1.0))
            self.shift(numbers)
        elif op == "Mul" or (op == "Div" and first):
            self.scale(numbers if op == "Mul" else 1.0 / numbers)
        else:
            raise self.fail("a number is divided by the network's value")

    def row(self, numbers: Array) -> Array:
        """A constant as a vector of the chain's width."""
        flat = np.asarray(numbers, dtype=float).reshape(-1)
        if np.ndim(numbers) == 2 and len(numbers) > 1:
            raise self.fail(f"a constant of shape {np.shape(numbers)} makes a matrix of the network's values")
        if len(flat) not in (1, self.width):
            raise self.fail(f"a constant of {len(flat)} numbers meets {self.width}")
        return np.broadcast_to(flat, (self.width,)).copy()

    def linear(self, weights: Array, offset: Array | None) -> None:
        if self.weights is not None:
            self.close("linear")
        if weights.shape[1] != self.width:
            raise self.fail(f"weights for {weights.shape[1]} numbers meet {self.width}")
        self.weights, self.bias, self.width = weights, None, weights.shape[0]
        if offset is not None:
            self.bias = self.row(offset)

    def shift(self, numbers: Array) -> None:
        if self.weights is None or self.bias is not None:  # a second bias is a layer of its own: sums are not rounded
            self.linear(np.eye(self.width), None)
        self.bias = self.row(numbers)

    def scale(self, numbers: Array) -> None:
        self.linear(np.diag(self.row(numbers)), None)

    def close(self, activation: str, constants: tuple[float, ...] = ()) -> None:
        """End the layer under way (none: the identity)."""
        weights = np.eye(self.width) if self.weights is None else self.weights
        bias = np.zeros(len(weights)) if self.bias is None else self.bias
        self.found.append(made_layer(weights, bias, activation, constants, f"{self.path}, layer {len(self.found)}"))
        self.weights = self.bias = None


