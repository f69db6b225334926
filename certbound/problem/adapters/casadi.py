"""Tapes to CasADi expressions and back (CasADi is imported on use)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

from certbound.problem.model import Graph, Tape

__all__ = ["casadi_module", "from_casadi", "to_casadi"]


def casadi_module() -> Any:
    """The casadi module, with its NumPy mode chosen (legacy, silent) unless the user chose one before."""
    import casadi

    options = casadi.GlobalOptions
    if hasattr(options, "setNumpyMode") and options.getNumpyMode() == 0:
        options.setNumpyMode(-1)
    return casadi


def to_casadi(tape: Tape, inputs: Sequence[Any]) -> Any:
    """The CasADi expression of a tape, of shape ``tape.shape``.

    Parameters
    ----------
    tape : Tape
        The function.
    inputs : sequence of casadi.SX or casadi.MX
        One scalar expression per input slot, or vectors whose entries make up the slots in order.
    """
    ca = casadi_module()
    scalars = [entry for value in inputs for entry in _entries(ca, value)]
    values = tape.evaluate(_casadi_arithmetic(), scalars)
    stacked = ca.vertcat(*values) if values else ca.SX(0, 1)
    if len(tape.shape) < 2:
        return stacked
    return ca.reshape(stacked, tape.shape[1], tape.shape[0]).T


def _entries(ca: Any, value: Any) -> list[Any]:
    count = value.numel() if hasattr(value, "numel") else 1
    return [value] if count == 1 else [ca.vec(value)[k] for k in range(count)]


@lru_cache(maxsize=1)
def _casadi_arithmetic() -> dict[str, Callable[..., Any]]:
    ca = casadi_module()
    names = {
        "sqrt": "sqrt", "exp": "exp", "log": "log", "sin": "sin", "cos": "cos", "tan": "tan",
        "asin": "asin", "acos": "acos", "atan": "atan", "sinh": "sinh", "cosh": "cosh", "tanh": "tanh",
        "abs": "fabs", "sign": "sign", "kink": "sign", "floor": "floor", "not": "logic_not",
        "atan2": "atan2", "hypot": "hypot", "min": "fmin", "max": "fmax", "lt": "lt", "le": "le",
        "eq": "eq", "ne": "ne", "and": "logic_and", "or": "logic_or", "add": "plus", "sub": "minus",
        "mul": "times", "div": "rdivide",
    }  # fmt: skip
    table: dict[str, Callable[..., Any]] = {op: getattr(ca, name) for op, name in names.items()}
    return table | {
        "neg": lambda a: -a,
        "sq": lambda a: a * a,
        "if_else_zero": lambda condition, value: ca.if_else(condition, value, 0),
        "const": float,
        "pow": lambda base, exponent: ca.power(base, exponent),
    }


def from_casadi(expression: Any, inputs: Sequence[Any], names: Sequence[str], shape: tuple[int, ...]) -> Tape:
    """The tape of a CasADi SX expression.

    Parameters
    ----------
    expression : casadi.SX
        Expression whose entries, read row by row, are the outputs.
    inputs : sequence of casadi.SX
        Symbols (scalars or vectors) that the expression depends on.
    names : sequence of str
        Name of each scalar input, in order.
    shape : tuple of int
        Shape of the tape's output.

    Raises
    ------
    ValueError
        If the expression uses an operation that a tape cannot hold (erf, calls of other functions), or the
        sizes disagree.
    """
    ca = casadi_module()
    columns = ca.densify(ca.vec(ca.SX(expression).T))
    sizes = [value.numel() for value in inputs]
    if sum(sizes) != len(names):
        raise ValueError(f"`names` must name the {sum(sizes)} scalar inputs, got {len(names)} names.")
    function = ca.Function("tape", list(inputs), [columns])
    graph = Graph(names)
    read = _readers(ca, graph)
    work: dict[int, int] = {}
    outputs = [graph.const(0.0)] * columns.numel()
    for k in range(function.n_instructions()):
        op, args = function.instruction_id(k), function.instruction_input(k)
        targets = function.instruction_output(k)
        if op == ca.OP_INPUT:
            work[targets[0]] = graph.input(sum(sizes[: args[0]]) + args[1])
        elif op == ca.OP_OUTPUT:
            outputs[targets[1]] = work[args[0]]
        elif op == ca.OP_CONST:
            work[targets[0]] = graph.const(function.instruction_constant(k))
        elif op in read:
            work[targets[0]] = read[op](*(work[arg] for arg in args))
        else:
            name = next(
                (key for key, value in vars(ca).items() if key.startswith("OP_") and value == op), str(op)
            )
            raise ValueError(
                f"`expression` uses {name}, which a tape cannot hold; write it with elementary functions."
            )
    return graph.tape(outputs, shape)


def _readers(ca: Any, graph: Graph) -> dict[int, Callable[..., int]]:
    def simple(op: str) -> Callable[..., int]:
        return lambda *args: graph.apply(op, *args)

    def power(base: int, exponent: int) -> int:
        number = graph.number(exponent)
        if number is not None:
            return graph.pow(base, number)
        return graph.apply("exp", graph.apply("mul", exponent, graph.apply("log", base)))

    one = graph.const(1.0)
    names = {
        "ADD": "add", "SUB": "sub", "MUL": "mul", "DIV": "div", "NEG": "neg", "EXP": "exp", "LOG": "log",
        "SQRT": "sqrt", "SQ": "sq", "SIN": "sin", "COS": "cos", "TAN": "tan", "ASIN": "asin",
        "ACOS": "acos", "ATAN": "atan", "LT": "lt", "LE": "le", "EQ": "eq", "NE": "ne", "NOT": "not",
        "AND": "and", "OR": "or", "FLOOR": "floor", "FABS": "abs", "SIGN": "sign",
        "IF_ELSE_ZERO": "if_else_zero", "FMIN": "min", "FMAX": "max", "SINH": "sinh", "COSH": "cosh",
        "TANH": "tanh", "ATAN2": "atan2", "HYPOT": "hypot",
    }  # fmt: skip
    table: dict[int, Callable[..., int]] = {
        getattr(ca, f"OP_{name}"): simple(op) for name, op in names.items()
    }
    return table | {
        ca.OP_ASSIGN: lambda a: a,
        ca.OP_TWICE: lambda a: graph.apply("mul", graph.const(2.0), a),
        ca.OP_INV: lambda a: graph.apply("div", one, a),
        ca.OP_POW: power,
        ca.OP_CONSTPOW: power,
        ca.OP_CEIL: lambda a: graph.apply("neg", graph.apply("floor", graph.apply("neg", a))),
        ca.OP_LOG1P: lambda a: graph.apply("log", graph.apply("add", one, a)),
        ca.OP_EXPM1: lambda a: graph.apply("sub", graph.apply("exp", a), one),
        ca.OP_ASINH: lambda a: graph.apply(
            "log", graph.apply("add", a, graph.apply("sqrt", graph.apply("add", graph.apply("sq", a), one)))
        ),
    }
