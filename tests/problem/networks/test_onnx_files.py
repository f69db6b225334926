"""ONNX files as PyTorch and Keras export them: the same values as the operations they state, or a refusal in words."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import certbound as cb

onnx = pytest.importorskip("onnx")

RNG = np.random.default_rng(3)
W, V = RNG.normal(size=(4, 2)).astype(np.float32), RNG.normal(size=(1, 4)).astype(np.float32)
B, C = RNG.normal(size=4).astype(np.float32), RNG.normal(size=1).astype(np.float32)
POINTS = RNG.normal(size=(50, 2))


def node(op: str, *inputs: str, **attributes: Any) -> Callable[[str], Any]:
    return lambda output: onnx.helper.make_node(op, inputs, [output], **attributes)


def file(folder: Path, *nodes: Callable[[str], Any], **constants: Any) -> Path:
    """A file whose operations follow each other: "in" is what the one before gave, and "x" the input."""
    made, before = [], "x"
    for number, make in enumerate(nodes):
        one = make(f"y{number}")
        one.input[:] = [before if name == "in" else name for name in one.input]
        made.append(one)
        before = one.output[0] if one.op_type not in ("Constant", "Transpose") else before
    value = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        made, "g", [value("x", onnx.TensorProto.FLOAT, ["batch", 2])], [value(before, onnx.TensorProto.FLOAT, None)],
        [onnx.numpy_helper.from_array(np.asarray(array, dtype=np.float32), name) for name, array in constants.items()],
    )  # fmt: skip
    onnx.save(onnx.helper.make_model(graph), folder / "policy.onnx")
    return folder / "policy.onnx"


def test_linear_layers_as_pytorch_exports_them(tmp_path: Path) -> None:
    layers = [node("Flatten", "in"), node("Gemm", "in", "W", "B", transB=1), node("Tanh", "in"),
              node("Gemm", "in", "V", "C", transB=1)]  # fmt: skip
    policy = cb.network(file(tmp_path, *layers, W=W, V=V, B=B, C=C))
    expected = np.tanh(POINTS @ W.T.astype(float) + B) @ V.T.astype(float) + C
    np.testing.assert_allclose(policy(POINTS), expected, rtol=1e-13, atol=1e-13)
    assert len(policy.data.layers) == 2


def test_dense_layers_as_keras_exports_them(tmp_path: Path) -> None:
    """MatMul and Add, a normalisation in front, and a scaled output."""
    layers = [node("Sub", "in", "mean"), node("Div", "in", "scale"), node("MatMul", "in", "W"), node("Add", "in", "B"),
              node("Relu", "in"), node("MatMul", "in", "V"), node("Add", "C", "in"), node("Sigmoid", "in"),
              node("Mul", "in", "scale0")]  # fmt: skip
    mean, scale = np.array([0.5, -0.25], dtype=np.float32), np.array([2.0, 0.5], dtype=np.float32)
    policy = cb.network(file(tmp_path, *layers, W=W.T, V=V.T, B=B, C=C, mean=mean, scale=scale, scale0=[3.0]))
    inner = np.maximum((POINTS - mean) / scale @ W.T.astype(float) + B, 0) @ V.T.astype(float) + C
    np.testing.assert_allclose(policy(POINTS), 3 / (1 + np.exp(-inner)), rtol=1e-12)


@pytest.mark.parametrize(("make", "function"), [
    (node("LeakyRelu", "in", alpha=0.25), lambda z: np.where(z > 0, z, 0.25 * z)),
    (node("Clip", "in", "low", "high"), lambda z: np.clip(z, -0.5, 0.5)),
    (node("Softplus", "in"), lambda z: np.log1p(np.exp(z))), (node("Sin", "in"), np.sin),
    (node("Elu", "in"), lambda z: np.where(z > 0, z, np.expm1(z))), (node("Identity", "in"), lambda z: z),
])  # fmt: skip
def test_activations(tmp_path: Path, make: Callable[[str], Any], function: Callable[[Any], Any]) -> None:
    source = file(tmp_path, node("Gemm", "in", "W", "B", transB=1), make, W=W, B=B, low=-0.5, high=0.5)
    np.testing.assert_allclose(cb.network(source)(POINTS), function(POINTS @ W.T.astype(float) + B), rtol=1e-12)


def test_constants_in_nodes_are_folded(tmp_path: Path) -> None:
    value = onnx.numpy_helper.from_array(W, "w")
    layers = [node("Constant", value=value), node("Transpose", "y0", perm=[1, 0]), node("MatMul", "in", "y1")]
    np.testing.assert_allclose(cb.network(file(tmp_path, *layers))(POINTS), POINTS @ W.T.astype(float), rtol=1e-13)


@pytest.mark.parametrize(("nodes", "words"), [
    ([node("Softmax", "in")], "Softmax is not supported; supported are Gemm"),
    ([node("Elu", "in", alpha=2.0)], "alpha"),
    ([node("Add", "in", "x")], "beside the chain"), ([node("Div", "B", "in")], "divided by"),
    ([node("MatMul", "in", "W")], "meet"), ([node("Clip", "in", "low")], "one end only"),
    ([node("Cast", "in", to=onnx.TensorProto.INT64)], "which rounds"),
    ([node("Relu", "in", domain="other.company")], "is one of other.company"),
    ([node("Add", "in", "column")], "makes a matrix"),
    ([node("Gemm", "in", "W", alpha=2.0)], "alpha or beta"), ([node("Add", "in", "B")], "4 numbers meets 2"),
])  # fmt: skip
def test_what_is_no_chain_of_layers_is_refused_in_words(tmp_path: Path, nodes: list[Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        cb.network(file(tmp_path, *nodes, W=W, B=B, low=-0.5, column=[[1.0], [2.0]]))


def test_files_that_are_none_and_weights_elsewhere_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.onnx").write_bytes(b"no network")
    with pytest.raises(ValueError, match="must be an ONNX file"):
        cb.network(tmp_path / "a.onnx")
    source = file(tmp_path, node("Gemm", "in", "W", transB=1), W=W)
    model = onnx.load(source)
    model.graph.initializer[0].data_location = onnx.TensorProto.EXTERNAL
    (tmp_path / "b.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(ValueError, match="lies in another file"):
        cb.network(tmp_path / "b.onnx")


def test_values_agree_with_the_runtime(tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    layers = [node("Gemm", "in", "W", "B", transB=1), node("Tanh", "in"), node("Gemm", "in", "V", "C", transB=1)]
    source = file(tmp_path, *layers, W=W, V=V, B=B, C=C)
    model = onnx.load(source)
    model.ir_version, model.opset_import[0].version = 8, 17
    session = runtime.InferenceSession(model.SerializeToString())
    points = RNG.normal(size=(10_000, 2)).astype(np.float32)
    np.testing.assert_allclose(cb.network(source)(points), session.run(None, {"x": points})[0], atol=1e-6)
