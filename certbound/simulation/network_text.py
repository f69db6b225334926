"""Networks in kernels: loops over the parameter array, which holds the weights column by column.

The inner loop runs over the outputs of a layer, so that it needs no sum across lanes and is vectorised as it stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from certbound.problem.model import Layer, Network

_ACTIVATIONS = {
    "linear": "{0}", "tanh": "tanh({0})", "sigmoid": "0.5 + 0.5 * tanh(0.5 * {0})",
    "softplus": "max({0}, 0.0) + math.log1p(math.exp(-abs({0})))", "sin": "math.sin({0})",
    "elu": "({0} if {0} > 0.0 else math.expm1({0}))", "relu": "({0} if not {0} <= 0.0 else 0.0)",
    "leaky_relu": "({0} if {0} > 0.0 else {1} * {0})",
    "clip": "({1} if {0} < {1} else {2} if {0} > {2} else {0})",
}  # fmt: skip
"""Activation to its text, of the argument and the constants; what is not a number stays so."""


class Numbers(Protocol):
    """Where numbers are kept: ``tape_text.Parameters``."""

    values: list[float]

    def add(self, value: float) -> str: ...


def network_lines(network: Network, name: str, operands: Sequence[str], parameters: Numbers) -> list[str]:
    """Lines after which the array ``name`` holds the outputs of a network at ``operands``."""
    lines = [f"{name} = np.empty({network.inputs})"]
    lines += [f"{name}[{place}] = {operand}" for place, operand in enumerate(operands)]
    for number, layer in enumerate(network.layers):
        lines += _layer_lines(layer, name, f"{name}_{number}", parameters)
    return lines


def _layer_lines(layer: Layer, given: str, made: str, parameters: Numbers) -> list[str]:
    rows, columns = len(layer.bias), len(layer.weights[0])
    first = len(parameters.values)
    for column in zip(*layer.weights):
        parameters.values.extend(column)
    parameters.values.extend(layer.bias)
    text = _ACTIVATIONS[layer.activation].format(f"{made}[i]", *(parameters.add(c) for c in layer.constants))
    lines = [
        f"{made} = p[{first + rows * columns}:{first + rows * columns + rows}].copy()",
        f"for j in range({columns}):",
        f"    {made}_factor = {given}[j]",
        f"    for i in range({rows}):",
        f"        {made}[i] += p[{first} + j * {rows} + i] * {made}_factor",
    ]
    if layer.activation != "linear":
        lines += [f"for i in range({rows}):", f"    {made}[i] = {text}"]
    return [*lines, f"{given} = {made}"]
