"""Models as plain data: the tape of a function, how it is recorded, differentiated and evaluated.

Each name is loaded when it is first used, so that the checker reads a tape without NumPy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from certbound.problem.model.analysis import (
        adds_plainly,
        deciding,
        is_zero,
        selected,
        sources,
        varying_outputs,
        watched,
    )
    from certbound.problem.model.derivative import jacobian
    from certbound.problem.model.evaluation import NUMPY, compile_numpy, compile_scalar
    from certbound.problem.model.graph import Graph, substitute
    from certbound.problem.model.tape import BINARY, JUMPS, Node, Tape
    from certbound.problem.model.tracing import trace

_HOME = {
    "adds_plainly": "analysis",
    "BINARY": "tape",
    "compile_numpy": "evaluation",
    "compile_scalar": "evaluation",
    "deciding": "analysis",
    "Graph": "graph",
    "is_zero": "analysis",
    "jacobian": "derivative",
    "JUMPS": "tape",
    "Node": "tape",
    "NUMPY": "evaluation",
    "selected": "analysis",
    "sources": "analysis",
    "substitute": "graph",
    "Tape": "tape",
    "trace": "tracing",
    "varying_outputs": "analysis",
    "watched": "analysis",
}

__all__ = [
    "adds_plainly",
    "BINARY",
    "compile_numpy",
    "compile_scalar",
    "deciding",
    "Graph",
    "is_zero",
    "jacobian",
    "JUMPS",
    "Node",
    "NUMPY",
    "selected",
    "sources",
    "substitute",
    "Tape",
    "trace",
    "varying_outputs",
    "watched",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
