"""Models written as SymPy or CasADi expressions, read without importing either before it is met."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from certbound.problem.adapters.casadi import casadi_module, from_casadi
from certbound.problem.adapters.sympy import from_sympy
from certbound.problem.model import Tape, trace

_CASADI = ("SX", "MX", "Function")


def is_symbolic(value: Any) -> bool:
    """True for SymPy and CasADi expressions, matrices and lists of them, and CasADi functions."""
    return _package(value) is not None


def symbol_names(value: Any) -> Any:
    """Names where SymPy or CasADi symbols are given for them; everything else as it is.

    Examples
    --------
    >>> symbol_names(["angle", "speed"])
    ['angle', 'speed']
    """
    if _package(value, 0) == "casadi":
        return [str(value[k]) for k in range(value.numel())]
    if isinstance(value, (list, tuple)) or _package(value, 0) == "sympy":
        return [str(entry.func) if _applied(entry) else _name(entry) for entry in value]
    return value


def read_model(f: Any, arguments: Mapping[str, Sequence[str]], *, matrix: bool = False) -> Tape:
    """The tape of a model, given as a NumPy-style function (``trace``) or as expressions (``symbolic_tape``)."""
    return symbolic_tape(f, arguments, matrix=matrix) if is_symbolic(f) else trace(f, arguments)


def symbolic_tape(f: Any, arguments: Mapping[str, Sequence[str]], *, matrix: bool = False) -> Tape:
    """The tape of a model given as expressions: the right-hand side (n,), or a matrix.

    Symbols are recognised by their names: those in ``arguments`` (argument name to the names of its scalar entries, as
    for ``trace``). In CasADi, ``x = SX.sym("x", n)`` stands for all states at once, and so do ``u`` and ``d``; a
    ``casadi.Function`` takes its inputs by the names t, x, u, d. ``matrix``: a column keeps its two dimensions, (n, 1).
    A symbol that is none of the arguments, or an operation that a tape cannot hold, is a ValueError.
    """
    names = [name for entries in arguments.values() for name in entries]
    if _package(f) == "sympy":
        return from_sympy(f, names, matrix=matrix)
    return _from_casadi(f, arguments, names, matrix)


def _from_casadi(f: Any, arguments: Mapping[str, Sequence[str]], names: Sequence[str], matrix: bool) -> Tape:
    ca = casadi_module()
    symbols = {key: ca.SX.sym(key, len(entries)) for key, entries in arguments.items()}
    if isinstance(f, ca.Function):
        expression = _called(ca, f, symbols)
    else:
        expression = _substituted(ca, _stacked(ca, f), symbols, arguments)
    rows, columns = expression.shape
    shape = (rows,) if columns == 1 and not matrix else (rows, columns)
    return from_casadi(expression, list(symbols.values()), names, shape)


def _called(ca: Any, function: Any, symbols: Mapping[str, Any]) -> Any:
    wanted = [function.name_in(k) for k in range(function.n_in())]
    unknown = [name for name in wanted if name not in symbols]
    if unknown or function.n_out() != 1:
        raise ValueError(
            f"`f` must be a casadi.Function with one output and inputs among {', '.join(symbols)}, got inputs "
            f"{', '.join(wanted)}; name them: casadi.Function('f', [x], [xdot], ['x'], ['xdot'])."
        )
    for k, name in enumerate(wanted):
        if function.numel_in(k) != symbols[name].numel():
            raise ValueError(
                f"`f` must take {symbols[name].numel()} entries as {name}, got {function.numel_in(k)}; "
                "mend the number of states, inputs or disturbances."
            )
    shaped = [ca.reshape(symbols[name], *function.size_in(k)) for k, name in enumerate(wanted)]
    return ca.SX(function.expand()(*shaped))


def _stacked(ca: Any, value: Any) -> Any:
    if isinstance(value, (ca.SX, ca.MX)):
        return value
    rows = [ca.horzcat(*row) if isinstance(row, (list, tuple, np.ndarray)) else row for row in value]
    return ca.vertcat(*rows)


def _substituted(ca: Any, expression: Any, symbols: Mapping[str, Any], arguments: Mapping[str, Sequence[str]]) -> Any:
    """The expression over our own symbols, found by the names of the user's."""
    scalars = {name: symbols[key][k] for key, entries in arguments.items() for k, name in enumerate(entries)}
    scalars = {f"{key}_{k}": symbol[k] for key, symbol in symbols.items() for k in range(symbol.numel())} | scalars
    found = ca.symvar(expression)
    values = []
    for symbol in found:
        name, count = symbol.name(), symbol.numel()
        if name in scalars and count == 1:
            values.append(scalars[name])
        elif name in symbols and count == symbols[name].numel():
            values.append(ca.reshape(symbols[name], *symbol.shape))
        else:
            raise ValueError(
                f"`f` contains the symbol {name} with {count} entries, which is none of {', '.join(scalars)}; "
                "substitute its number first, or name it among the states, inputs or disturbances."
            )
    return ca.SX(ca.Function("model", found, [expression]).expand()(*values)) if found else ca.SX(expression)


def _package(value: Any, depth: int = 2) -> str | None:
    for base in type(value).__mro__:
        root = (base.__module__ or "").partition(".")[0]
        if root == "sympy" or (root == "casadi" and base.__name__ in _CASADI):
            return root
    if depth and (isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.dtype == object)):
        return next((found for entry in value if (found := _package(entry, depth - 1)) is not None), None)
    return None


def _applied(entry: Any) -> bool:
    """True for SymPy's functions of time such as ``angle(t)``."""
    return _package(entry, 0) == "sympy" and bool(getattr(entry, "args", ()))


def _name(entry: Any) -> Any:
    return str(entry) if _package(entry, 0) is not None else entry
