"""Models as plain data: the tape of a function, how it is recorded, differentiated and evaluated.

Each name is loaded when it is first used, so that the checker reads a tape without NumPy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from certbound.lazy import lazily

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
    from certbound.problem.model.comparisons import rounded_comparison
    from certbound.problem.model.derivative import jacobian
    from certbound.problem.model.evaluation import compile_numpy, compile_scalar
    from certbound.problem.model.graph import Graph, substitute
    from certbound.problem.model.network_data import PARTS, Layer, Network, Part
    from certbound.problem.model.network_rows import relaxed, weights_of
    from certbound.problem.model.operations import (
        OPERATIONS,
        ROWS,
        arithmetic,
        enclosed,
        jumps_where,
        kinks_where,
        undefined_where,
    )
    from certbound.problem.model.recombined import in_logarithms, turned_tape, without_own
    from certbound.problem.model.tape import ARITY, JUMPS, Node, Tape, needed
    from certbound.problem.model.time_jumps import Change, between_jumps, cut_at_jumps
    from certbound.problem.model.tracing import call_network, trace

_HOME = {
    "analysis": "adds_plainly deciding edged is_zero reads selected sources varying_outputs watched",
    "derivative": "jacobian",
    "evaluation": "compile_numpy compile_scalar",
    "graph": "Graph substitute",
    "comparisons": "rounded_comparison",
    "network_rows": "relaxed weights_of",
    "network_data": "PARTS Layer Network Part",
    "recombined": "in_logarithms turned_tape without_own",
    "operations": "OPERATIONS ROWS arithmetic enclosed jumps_where kinks_where undefined_where",
    "tape": "ARITY JUMPS Node Tape needed",
    "time_jumps": "between_jumps Change cut_at_jumps",
    "tracing": "call_network trace",
}

__all__ = [
    "adds_plainly",
    "arithmetic",
    "between_jumps",
    "ARITY",
    "call_network",
    "Change",
    "compile_numpy",
    "compile_scalar",
    "cut_at_jumps",
    "deciding",
    "edged",
    "enclosed",
    "Graph",
    "in_logarithms",
    "is_zero",
    "jacobian",
    "JUMPS",
    "jumps_where",
    "kinks_where",
    "Layer",
    "needed",
    "Network",
    "Node",
    "OPERATIONS",
    "Part",
    "PARTS",
    "reads",
    "relaxed",
    "rounded_comparison",
    "ROWS",
    "selected",
    "sources",
    "substitute",
    "Tape",
    "trace",
    "turned_tape",
    "undefined_where",
    "varying_outputs",
    "watched",
    "weights_of",
    "without_own",
]

__getattr__, __dir__ = lazily(__name__, _HOME, __all__)
