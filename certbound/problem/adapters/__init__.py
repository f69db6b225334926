"""Models written for other libraries: CasADi, SymPy, python-control."""

from __future__ import annotations

from certbound.problem.adapters.casadi import casadi_module, to_casadi
from certbound.problem.adapters.control import import_block, import_control, is_control_system, linear_inputs
from certbound.problem.adapters.symbolic import is_symbolic, read_model, symbol_names

__all__ = [
    "casadi_module",
    "import_block",
    "import_control",
    "is_control_system",
    "is_symbolic",
    "linear_inputs",
    "read_model",
    "symbol_names",
    "to_casadi",
]
