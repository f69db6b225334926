"""Layered networks as plain data: what a tape's network nodes refer to.

A network is a list of layers phi(W x + b), whole: a tape has one node for each of its outputs (and, in derivatives, for
each derivative of one), whatever the number of weights. Reading this needs nothing but this module.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from certbound.errors import EnclosureError

KINKED = frozenset(["relu", "leaky_relu", "clip"])
"""Activations whose slope jumps."""
CONSTANTS: dict[str, int] = {
    "linear": 0, "tanh": 0, "sigmoid": 0, "softplus": 0, "elu": 0, "sin": 0, "relu": 0, "leaky_relu": 1, "clip": 2,
}  # fmt: skip
"""Activations, and how many constants each has (``leaky_relu`` its slope left of 0, ``clip`` its ends)."""
MOST_LAYERS, MOST_WIDTH, MOST_WEIGHTS, LARGEST = 32, 4096, 300_000, 1e8
"""Limits of what a network may hold: layers, outputs of a layer, numbers, and their size."""


@dataclass(frozen=True, eq=False, slots=True)
class Layer:
    """phi(W x + b): ``weights`` row by row, and the activation by name with its constants."""

    weights: tuple[tuple[float, ...], ...]
    bias: tuple[float, ...]
    activation: str = "linear"
    constants: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        rows = len(self.weights)
        if not 1 <= rows <= MOST_WIDTH or not 1 <= len(self.weights[0]) <= MOST_WIDTH:
            raise ValueError(f"a layer must have 1 to {MOST_WIDTH} inputs and outputs, got {rows} outputs.")
        if any(len(row) != len(self.weights[0]) for row in self.weights) or len(self.bias) != rows:
            raise ValueError(f"a layer must have as many rows of weights as entries of its bias, {len(self.bias)}.")
        wanted = CONSTANTS.get(self.activation)
        if wanted is None:
            raise ValueError(f"a layer's activation must be one of {', '.join(CONSTANTS)}, got {self.activation!r}.")
        if len(self.constants) != wanted:
            raise ValueError(f"{self.activation} must have {wanted} constants, got {len(self.constants)}.")
        for values in (*self.weights, self.bias, self.constants):
            if not all(math.isfinite(value) and abs(value) <= LARGEST for value in values):
                raise ValueError(f"a layer's numbers must be finite and at most {LARGEST:g}.")
        if self.activation == "clip" and not self.constants[0] <= self.constants[1]:
            raise ValueError(f"clip must have a lower end at most the upper one, got {self.constants}.")


@dataclass(frozen=True, eq=False, slots=True, weakref_slot=True)
class Network:
    """Layers, each of which takes what the one before gives; two networks are the same only if they are one object."""

    layers: tuple[Layer, ...]
    name: str = "network"

    def __post_init__(self) -> None:
        if not 1 <= len(self.layers) <= MOST_LAYERS:
            raise ValueError(f"a network must have 1 to {MOST_LAYERS} layers, got {len(self.layers)}.")
        for before, layer in zip(self.layers, self.layers[1:]):
            if len(layer.weights[0]) != len(before.bias):
                raise ValueError(
                    f"a layer must take what the one before gives: {len(before.bias)}, not {len(layer.weights[0])}."
                )
        count = sum(len(layer.bias) * (len(layer.weights[0]) + 1) for layer in self.layers)
        if count > MOST_WEIGHTS:
            raise ValueError(f"a network must have at most {MOST_WEIGHTS} numbers, got {count}.")

    @property
    def inputs(self) -> int:
        """How many numbers it takes."""
        return len(self.layers[0].weights[0])

    @property
    def outputs(self) -> int:
        """How many numbers it gives."""
        return len(self.layers[-1].bias)

    @property
    def smooth(self) -> bool:
        """Whether its slopes are continuous."""
        return not any(layer.activation in KINKED for layer in self.layers)


class Part(NamedTuple):
    """One output of a network, or its derivative by the inputs ``by`` (in rising order; at most two)."""

    network: Network
    output: int
    by: tuple[int, ...] = ()

    @property
    def op(self) -> str:
        """The operation of its nodes: ``network``, with kinks ``bent``, or ``jumping`` where these make it jump."""
        return "network" if self.network.smooth else "jumping" if len(self.by) > 1 else "bent"

    def derivative(self, place: int) -> Part:
        """The derivative by one more input."""
        if len(self.by) > 1:
            raise EnclosureError("third derivatives of a network are not enclosed; a method that asks for them fails.")
        return self._replace(by=tuple(sorted((*self.by, place))))


PARTS = frozenset(["network", "bent", "jumping"])
"""Operations of nodes that are parts of networks."""
