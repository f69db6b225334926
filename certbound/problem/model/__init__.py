"""Models as plain data: the tape of a function, how it is recorded, differentiated and evaluated.

Each name is loaded when it is first used, so that the checker reads a tape without NumPy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from certbound.lazy import load_name

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
    "analysis": "adds_plainly deciding is_zero selected sources varying_outputs watched",
    "derivative": "jacobian",
    "evaluation": "compile_numpy compile_scalar NUMPY",
    "graph": "Graph substitute",
    "tape": "BINARY JUMPS Node Tape",
    "tracing": "trace",
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
    return load_name(__name__, _HOME, name)


def __dir__() -> list[str]:
    return sorted(__all__)
