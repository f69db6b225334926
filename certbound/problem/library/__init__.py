"""The bundled problems: ready to verify, every parameter a ``--set`` key."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from certbound.problem.library import chain, ou, pendulum, unicycle
from certbound.problem.problem import Problem

__all__ = ["DEFAULTS", "MODELS"]

MODELS: Mapping[str, Callable[..., Problem]] = MappingProxyType(
    {
        "chain": chain.chain,
        "chain_rest": chain.chain_rest,
        "ou": ou.ou,
        "pendulum": pendulum.pendulum,
        "unicycle": unicycle.unicycle,
    }
)
"""Name to builder: ``MODELS[name](**parameters)`` is a ``Problem``."""

DEFAULTS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "chain": chain.DEFAULTS,
        "chain_rest": chain.DEFAULTS,
        "ou": ou.DEFAULTS,
        "pendulum": pendulum.DEFAULTS,
        "unicycle": unicycle.DEFAULTS,
    }
)
"""Name to the parameters' default values."""
