"""Random networks that tests share."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

import certbound as cb

CONSTANTS: dict[str, dict[str, float]] = {"leaky_relu": {"slope": 0.1}, "clip": {"low": -0.5, "high": 0.7}}


def random_layers(
    activation: str, seed: int = 0, *, sizes: tuple[int, ...] = (2, 8, 8, 2), scale: float = 1.5
) -> list[dict[str, Any]]:
    """Layers of the given sizes, the last one linear."""
    rng = np.random.default_rng(seed)
    rows = []
    for number, (k, p) in enumerate(itertools.pairwise(sizes)):
        last = number == len(sizes) - 2
        rows.append({
            "weights": rng.normal(size=(p, k)) * scale / np.sqrt(k), "bias": rng.normal(size=p) * 0.3,
            "activation": "linear" if last else activation, **({} if last else CONSTANTS.get(activation, {})),
        })  # fmt: skip
    return rows


def random_network(activation: str, seed: int = 0, **options: Any) -> Any:
    """The same as a function."""
    return cb.network(random_layers(activation, seed, **options), name="policy")
