"""Tapes to CasADi expressions and back (CasADi is imported on use)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from certbound.problem.model import OPERATIONS, PARTS, Graph, Tape


def casadi_module() -> Any:
    """The casadi module, with its NumPy mode chosen (legacy, silent) unless the user chose one before."""
    import casadi

    options = casadi.GlobalOptions
    if hasattr(options, "setNumpyMode") and options.getNumpyMode() == 0:
        options.setNumpyMode(-1)
    return casadi


def to_casadi(tape: Tape, inputs: Sequence[Any]) -> Any:
    """The CasADi expression of a tape, of shape ``tape.shape``.

    ``inputs`` are one scalar expression (SX or MX) per input slot, or vectors whose entries make up the slots in order.
    """
    ca = casadi_module()
    scalars = [entry for value in inputs for entry in _entries(ca, value)]
    values = tape.evaluate(_casadi_arithmetic(ca), scalars)
    stacked = ca.vertcat(*values) if values else ca.SX(0, 1)
    if len(tape.shape) < 2:
        return stacked
    return ca.reshape(stacked, tape.shape[1], tape.shape[0]).T


def _entries(ca: Any, value: Any) -> list[Any]:
    count = value.numel() if hasattr(value, "numel") else 1
    return [value] if count == 1 else [ca.vec(value)[k] for k in range(count)]


_NAMES = {
    "abs": "fabs", "kink": "sign", "not": "logic_not", "and": "logic_and", "or": "logic_or", "min": "fmin",
    "max": "fmax", "add": "plus", "sub": "minus", "mul": "times", "div": "rdivide",
}  # fmt: skip
"""What CasADi calls operations that have another name on a tape."""


def _casadi_arithmetic(ca: Any) -> dict[str, Callable[..., Any]]:
    table = {op: getattr(ca, _NAMES.get(op, op), _refused(op)) for op in OPERATIONS}
    return table | {
        "neg": lambda a: -a,
        "sq": lambda a: a * a,
        "if_else_zero": lambda condition, value: ca.if_else(condition, value, 0),
        "const": float,
        "pow": lambda base, exponent: ca.power(base, exponent),
        **dict.fromkeys(PARTS, lambda *given: _network_output(ca, *given)),
    }


def _network_output(ca: Any, *given: Any) -> Any:
    """An output of a network (its derivatives are CasADi's own affair)."""
    *args, part = given
    if part.by:
        return _refused(part.op)()
    column = ca.vertcat(*args)
    for layer in part.network.layers:
        column = ca.DM(layer.weights) @ column + ca.DM(layer.bias)
        column = _ACTIVATIONS[layer.activation](ca, column, *layer.constants)
    return column[part.output]


_ACTIVATIONS: dict[str, Callable[..., Any]] = {
    "linear": lambda ca, z: z, "tanh": lambda ca, z: ca.tanh(z), "sin": lambda ca, z: ca.sin(z),
    "sigmoid": lambda ca, z: 0.5 + 0.5 * ca.tanh(0.5 * z), "relu": lambda ca, z: ca.fmax(z, 0),
    "softplus": lambda ca, z: ca.fmax(z, 0) + ca.log1p(ca.exp(-ca.fabs(z))),
    "elu": lambda ca, z: ca.fmax(z, 0) + ca.expm1(ca.fmin(z, 0)),
    "leaky_relu": lambda ca, z, left: ca.fmax(z, 0) + left * ca.fmin(z, 0),
    "clip": lambda ca, z, low, high: ca.fmin(ca.fmax(z, low), high),
}  # fmt: skip


def _refused(op: str) -> Callable[..., Any]:
    def refuse(*_: Any) -> Any:
        raise ValueError(f"`tape` uses {op}, which CasADi does not have; write the model without it to plan with it.")

    return refuse


def from_casadi(expression: Any, inputs: Sequence[Any], names: Sequence[str], shape: tuple[int, ...]) -> Tape:
    """The tape of a CasADi SX expression, whose entries are read row by row.

    ``inputs`` are the symbols (scalars or vectors) that it depends on, ``names`` the names of their scalar entries in
    order, ``shape`` is that of the tape's output. An operation that a tape cannot hold (erf, calls of other functions),
    or sizes that disagree, are a ValueError.
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
    def power(base: int, exponent: int) -> int:
        number = graph.number(exponent)
        if number is not None:
            return graph.pow(base, number)
        return graph.apply("exp", graph.apply("mul", exponent, graph.apply("log", base)))

    one = graph.const(1.0)
    table: dict[int, Callable[..., int]] = {}
    for op in OPERATIONS:
        name = f"OP_{_NAMES[op] if op in ('abs', 'min', 'max') else op}".upper()
        if hasattr(ca, name):
            table[getattr(ca, name)] = partial(graph.apply, op)
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
