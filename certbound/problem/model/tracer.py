"""Scalars and arrays that record what a NumPy-style function does to them.

A function is called once with a ``Traced`` array of ``Scalar`` entries. NumPy's operators and functions reach
them through its two dispatch protocols; what cannot be recorded (``if``, ``float()``, ``math.sin``) is
refused with the cure.
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import numpy as np

from certbound.problem.model.graph import Graph
from certbound.problem.model.operations import OPERATIONS


class UntraceableError(TypeError):
    """Raised inside a traced function; ``trace`` adds the place."""


_BRANCH = (
    "a traced value has no truth value, so `if`, `while`, `and`, `or`, `not`, max() and min() cannot act on "
    "it; use np.where(x[0] > 0, a, b), np.maximum, "
    "np.minimum, or `&`, `|`, `~`"
)
_FLOAT = (
    "a traced value is not a number: math.sin(x), float(x), int(x), round(x) and writing it into a float "
    "array cannot work; use np.sin (and np.* throughout), and collect entries with np.array([...])"
)


class Scalar:
    """One traced number: a node of a graph, with Python's and NumPy's operators."""

    __slots__ = ("graph", "index")
    __hash__ = None  # type: ignore[assignment]  # as Python marks it
    __array_priority__ = 1000.0

    def __init__(self, graph: Graph, index: int) -> None:
        self.graph = graph
        self.index = index

    def __repr__(self) -> str:
        return f"<traced {self.graph.tape([self.index], ()).describe(-1)}>"

    def __bool__(self) -> NoReturn:
        raise UntraceableError(_BRANCH)

    def _refuse_number(self, *_: object) -> NoReturn:
        raise UntraceableError(_FLOAT)

    __float__ = __int__ = __index__ = __complex__ = __round__ = __trunc__ = __floor__ = __ceil__ = (
        _refuse_number
    )

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        return _ufunc(ufunc, method, inputs, kwargs)

    def __array_function__(self, func: Callable[..., Any], types: Any, args: Any, kwargs: Any) -> Any:
        return _function(func, args, kwargs)

    def conjugate(self) -> Scalar:
        """The value itself: traced values are real."""
        return self

    @property
    def real(self) -> Scalar:
        """The value itself: traced values are real."""
        return self


class Traced(np.ndarray[Any, np.dtype[Any]]):
    """An object array of traced scalars (and plain numbers)."""

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        return _ufunc(ufunc, method, inputs, kwargs)

    def __array_function__(self, func: Callable[..., Any], types: Any, args: Any, kwargs: Any) -> Any:
        return _function(func, args, kwargs)

    def __bool__(self) -> NoReturn:
        raise UntraceableError(_BRANCH)


def _lift(graph: Graph, value: Any) -> int:
    if isinstance(value, Scalar):
        if value.graph is not graph:
            raise UntraceableError(
                "a value traced in another call is used here; a model must not keep its arguments"
            )
        return value.index
    if isinstance(value, (complex, np.complexfloating)):
        raise UntraceableError(f"a model must be real, got the complex number {value}")
    try:
        return graph.const(float(value))
    except (TypeError, ValueError) as error:
        raise UntraceableError(f"a traced value meets {value!r}: {error}") from None


def _node(op: str) -> Callable[..., Any]:
    def apply(*operands: Any) -> Any:
        graph = next((operand.graph for operand in operands if isinstance(operand, Scalar)), None)
        if graph is None:
            return OPERATIONS[op].numpy(*operands)
        return Scalar(graph, graph.apply(op, *(_lift(graph, operand) for operand in operands)))

    return apply


def _power(base: Any, exponent: Any) -> Any:
    graph = next((operand.graph for operand in (base, exponent) if isinstance(operand, Scalar)), None)
    if graph is None:
        return np.power(base, exponent)
    number = graph.number(_lift(graph, exponent))
    if number is not None:
        return Scalar(graph, graph.pow(_lift(graph, base), number))
    return _exp(_mul(exponent, _log(_like(exponent, base))))


def _like(value: Any, number: Any) -> Any:
    """A constant as a node, so that the logarithm of a number is enclosed, not rounded."""
    return Scalar(value.graph, _lift(value.graph, number)) if isinstance(value, Scalar) else number


_add, _sub, _mul, _div, _neg, _exp, _log, _sqrt = map(_node, ("add", "sub", "mul", "div", "neg", "exp", "log", "sqrt"))
_sq, _abs, _min, _max, _lt, _le, _not, _floor = map(_node, ("sq", "abs", "min", "max", "lt", "le", "not", "floor"))


def _where(condition: Any, x: Any, y: Any) -> Any:
    if not isinstance(condition, Scalar):
        return x if condition else y
    choose = _node("if_else_zero")
    return _add(choose(condition, x), choose(_not(condition), y))


def _clip(value: Any, low: Any, high: Any) -> Any:
    value = value if low is None or _infinite(low) else _max(value, low)
    return value if high is None or _infinite(high) else _min(value, high)


def _infinite(value: Any) -> bool:
    return not isinstance(value, Scalar) and math.isinf(float(value))


def _modulo(x: Any, y: Any) -> Any:
    return _sub(x, _mul(y, _floor(_div(x, y))))


FUNCTIONS: dict[str, Callable[..., Any]] = {
    row.numpy.__name__: _node(op)
    for op, row in OPERATIONS.items()
    if isinstance(row.numpy, np.ufunc) and op != "kink"
} | {
    "true_divide": _div,
    "floor_divide": lambda x, y: _floor(_div(x, y)),
    "remainder": _modulo,
    "mod": _modulo,
    "power": _power,
    "float_power": _power,
    "positive": lambda x: x,
    "conjugate": lambda x: x,
    "fabs": _abs,
    "reciprocal": lambda x: _div(1.0, x),
    "exp2": lambda x: _exp(_mul(_log(_like(x, 2.0)), x)),
    "expm1": lambda x: _sub(_exp(x), 1.0),
    "log1p": lambda x: _log(_add(1.0, x)),
    "log2": lambda x: _div(_log(x), _log(_like(x, 2.0))),
    "log10": lambda x: _div(_log(x), _log(_like(x, 10.0))),
    "logaddexp": lambda x, y: _log(_add(_exp(x), _exp(y))),
    "arcsinh": lambda x: _log(_add(x, _sqrt(_add(_sq(x), 1.0)))),
    "arccosh": lambda x: _log(_add(x, _sqrt(_sub(_sq(x), 1.0)))),
    "arctanh": lambda x: _mul(0.5, _log(_div(_add(1.0, x), _sub(1.0, x)))),
    "deg2rad": lambda x: _mul(math.pi / 180.0, x),
    "radians": lambda x: _mul(math.pi / 180.0, x),
    "rad2deg": lambda x: _mul(180.0 / math.pi, x),
    "degrees": lambda x: _mul(180.0 / math.pi, x),
    "fmin": _min,
    "fmax": _max,
    "ceil": lambda x: _neg(_floor(_neg(x))),
    "heaviside": lambda x, half: _where(_lt(0.0, x), 1.0, _where(_node("eq")(x, 0.0), half, 0.0)),
    "less": _lt,
    "less_equal": _le,
    "greater": lambda x, y: _lt(y, x),
    "greater_equal": lambda x, y: _le(y, x),
    "equal": _node("eq"),
    "not_equal": _node("ne"),
    "logical_and": _node("and"),
    "bitwise_and": _node("and"),
    "logical_or": _node("or"),
    "bitwise_or": _node("or"),
    "logical_not": _not,
    "invert": _not,
    "clip": _clip,
}
"""NumPy function name to its action on traced scalars: the functions of the table, and what is made of them."""


def _plain(value: Any) -> Any:
    """The same value without the classes that dispatch: scalars become object arrays of no dimension."""
    if isinstance(value, Scalar):
        array = np.empty((), dtype=object)
        array[()] = value
        return array
    if isinstance(value, Traced):
        return value.view(np.ndarray)
    if isinstance(value, (list, tuple)):
        return type(value)(_plain(item) for item in value)
    return value


_as_array = np.asarray  # which `traced_arrays` replaces


def _objects(value: Any) -> np.ndarray[Any, np.dtype[Any]]:
    array: np.ndarray[Any, np.dtype[Any]] = _as_array(_plain(value), dtype=object)
    return array


def _wrapped(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype == object:
        return value[()] if value.ndim == 0 else value.view(Traced)
    return [_wrapped(item) for item in value] if isinstance(value, list) else value


def _elementwise(function: Callable[..., Any], *operands: Any) -> Any:
    return _wrapped(np.frompyfunc(function, len(operands), 1)(*(_plain(operand) for operand in operands)))


def _ufunc(ufunc: np.ufunc, method: str, inputs: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    name, out = ufunc.__name__, kwargs.pop("out", None)
    function = FUNCTIONS.get(name) or next((_node(op) for op, row in OPERATIONS.items() if row.numpy is ufunc), None)
    if method == "__call__" and function is not None and not set(kwargs) - {"dtype", "casting"}:
        result = _elementwise(function, *inputs)
    elif method == "__call__" and name in ("matmul", "vecdot", "matvec", "vecmat") and not kwargs:
        result = _wrapped(ufunc(*(_objects(value) for value in inputs)))
    elif method == "reduce" and name in ("add", "multiply", "maximum", "minimum"):
        result = _reduced(FUNCTIONS[name], inputs[0], **kwargs)
    else:
        raise UntraceableError(
            f"np.{name} ({method}) cannot be traced; write it with + - * / ** and np.sin, np.exp, ..."
        )
    if out is None:
        return result
    out[0][...] = result
    return out[0]


def _reduced(
    function: Callable[..., Any],
    value: Any,
    axis: Any = 0,
    keepdims: bool = False,
    initial: Any = None,
    **_: Any,
) -> Any:
    array = _objects(value)
    axes = tuple(range(array.ndim)) if axis is None else tuple(np.atleast_1d(axis) % array.ndim)
    kept = [k for k in range(array.ndim) if k not in axes]
    flat = array.transpose(*kept, *axes).reshape([array.shape[k] for k in kept] + [-1])
    start = [] if initial is None or not isinstance(initial, (int, float)) else [initial]
    result = np.empty(flat.shape[:-1], dtype=object)
    for place in np.ndindex(*result.shape):
        items = [*start, *flat[place]]
        result[place] = functools.reduce(function, items) if items else 0.0
    if keepdims:
        result = result.reshape([1 if k in axes else array.shape[k] for k in range(array.ndim)])
    return _wrapped(result)


def _select(conditions: Sequence[Any], choices: Sequence[Any], default: Any = 0.0) -> Any:
    for condition, choice in zip(reversed(conditions), reversed(choices)):
        default = _elementwise(_where, condition, choice, default)
    return default


def _function(func: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    if func is np.where and len(args) == 3:
        return _elementwise(_where, *args)
    if func is np.select:
        return _select(*args, **kwargs)
    if func is np.clip:
        return _clip_function(*args, **kwargs)
    if func in (np.max, np.min):
        return _reduced(_max if func is np.max else _min, *args, **({"axis": None} | kwargs))
    try:
        return _wrapped(func(*_plain(args), **{key: _plain(value) for key, value in kwargs.items()}))
    except UntraceableError:
        raise
    except (TypeError, ValueError) as error:
        name = getattr(func, "__name__", str(func))
        raise UntraceableError(
            f"np.{name} could not be traced ({error}); write it out with + - * / ** and np.sin, ..."
        ) from None


def _clip_function(a: Any, a_min: Any = None, a_max: Any = None, **kwargs: Any) -> Any:
    low, high = kwargs.pop("min", a_min), kwargs.pop("max", a_max)
    return _elementwise(lambda x, lo, hi: _clip(x, lo, hi), a, *(_boxed(bound) for bound in (low, high)))


def _boxed(value: Any) -> Any:
    """None as an element of an object array."""
    return np.full((), None, dtype=object) if value is None else value


_MAKERS = ("array", "asarray", "asanyarray")
_REPLACED: list[dict[str, Any]] = []
_LOCK = threading.Lock()


@contextmanager
def traced_arrays() -> Iterator[None]:
    """Within it np.array([x, y]) of traced scalars is a traced array, as np.stack makes one.

    NumPy asks its protocols nothing in these functions, so they are replaced while a model is called; what they make of
    anything else stays as it is, in other threads too.
    """
    with _LOCK:
        _REPLACED.append({name: getattr(np, name) for name in _MAKERS})
        if len(_REPLACED) == 1:
            for name, maker in _REPLACED[0].items():
                setattr(np, name, _tracing(maker))
    try:
        yield
    finally:
        with _LOCK:
            kept = _REPLACED.pop()
            if not _REPLACED:
                for name, maker in kept.items():
                    setattr(np, name, maker)


def _tracing(maker: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(maker)
    def make(*args: Any, **kwargs: Any) -> Any:
        made = maker(*args, **kwargs)
        plain = type(made) is np.ndarray and made.dtype == object
        return made.view(Traced) if plain and any(isinstance(entry, Scalar) for entry in made.flat) else made

    return make


def _install() -> None:
    """Give Scalar Python's operators, and the methods by which NumPy reaches the entries of object arrays."""
    unary = {"__neg__": "negative", "__pos__": "positive", "__abs__": "absolute", "__invert__": "invert"}
    binary = {
        "add": "add", "sub": "subtract", "mul": "multiply", "truediv": "divide", "pow": "power",
        "mod": "remainder", "floordiv": "floor_divide", "and": "logical_and", "or": "logical_or",
    }  # fmt: skip
    comparisons = {
        "lt": "less", "le": "less_equal", "gt": "greater", "ge": "greater_equal", "eq": "equal", "ne": "not_equal",
    }  # fmt: skip

    def method(name: str, reflected: bool = False) -> Callable[..., Any]:
        function = FUNCTIONS[name]

        def operator(self: Scalar, *others: Any) -> Any:
            if any(isinstance(other, np.ndarray) for other in others):
                return _elementwise(function, *((*others, self) if reflected else (self, *others)))
            return function(*others, self) if reflected else function(self, *others)

        return operator

    for dunder, name in unary.items():
        setattr(Scalar, dunder, method(name))
    for dunder, name in binary.items():
        setattr(Scalar, f"__{dunder}__", method(name))
        setattr(Scalar, f"__r{dunder}__", method(name, reflected=True))
    for dunder, name in comparisons.items():
        setattr(Scalar, f"__{dunder}__", method(name))
    for name in FUNCTIONS:
        if name not in ("conjugate", "real"):
            setattr(Scalar, name, method(name))


_install()
