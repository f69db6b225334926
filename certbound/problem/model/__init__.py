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
        edged,
        is_zero,
        selected,
        sources,
        varying_outputs,
        watched,
    )
    from certbound.problem.model.derivative import jacobian
    from certbound.problem.model.evaluation import compile_numpy, compile_scalar
    from certbound.problem.model.graph import Graph, substitute
    from certbound.problem.model.operations import OPERATIONS, arithmetic, enclosed, undefined_where
    from certbound.problem.model.tape import ARITY, JUMPS, Node, Tape, needed
    from certbound.problem.model.tracing import trace

_HOME = {
    "adds_plainly": "analysis",
    "arithmetic": "operations",
    "ARITY": "tape",
    "compile_numpy": "evaluation",
    "compile_scalar": "evaluation",
    "deciding": "analysis",
    "edged": "analysis",
    "enclosed": "operations",
    "Graph": "graph",
    "is_zero": "analysis",
    "jacobian": "derivative",
    "JUMPS": "tape",
    "needed": "tape",
    "Node": "tape",
    "OPERATIONS": "operations",
    "selected": "analysis",
    "sources": "analysis",
    "substitute": "graph",
    "Tape": "tape",
    "trace": "tracing",
    "undefined_where": "operations",
    "varying_outputs": "analysis",
    "watched": "analysis",
}

__all__ = [
    "adds_plainly",
    "arithmetic",
    "ARITY",
    "compile_numpy",
    "compile_scalar",
    "deciding",
    "edged",
    "enclosed",
    "Graph",
    "is_zero",
    "jacobian",
    "JUMPS",
    "needed",
    "Node",
    "OPERATIONS",
    "selected",
    "sources",
    "substitute",
    "Tape",
    "trace",
    "undefined_where",
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
