"""Kernels written for LLVM line by line: their text is a small language, and numba's way through it is long.

The text of a kernel is straight lines over numbers, with tests, counted loops and entries of arrays. Here each line
becomes its few machine operations directly, in numba's own types, by numba's own functions for all that is called: the
operations are the same ones in the same order, so that every number is, to the bit, what numba makes of the text. Left
out are the search for types, the counting of references, and indices that are negative: two thirds of the time.

A number's type is that of the first value that it is given, a function of the text is written where it is called, and
arrays are those of the arguments, and short ones of a length that the text says. Text with more than that - slices,
states in arrays, networks - goes numba's way.

Importing this module imports numba: import it inside functions.
"""

from __future__ import annotations

import ast
import builtins
import functools
import inspect
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import Signature
from numba.extending import intrinsic
from numba.np import arrayobj

_place: Any = cgutils.alloca_once
_unpacked: Any = cgutils.unpack_tuple
_make_array: Any = arrayobj.make_array
_fill_array: Any = arrayobj.populate_array

_KNOWN = (
    ast.Module, ast.Import, ast.ImportFrom, ast.alias, ast.FunctionDef, ast.arguments, ast.arg, ast.keyword, ast.Return,
    ast.Assign, ast.AugAssign, ast.Expr, ast.If, ast.For, ast.Break, ast.Continue, ast.Pass, ast.Name, ast.Load,
    ast.Store, ast.Constant, ast.Tuple, ast.Subscript, ast.Attribute, ast.Call, ast.BinOp, ast.UnaryOp, ast.BoolOp,
    ast.Compare, ast.IfExp, ast.operator, ast.unaryop, ast.boolop, ast.cmpop,
)  # fmt: skip
_ATTRIBUTES = ("shape", "empty", "floor")  # beside those of ``math``
_OPERATORS = {
    ast.Add: (operator.add, "add", "fadd"), ast.Sub: (operator.sub, "sub", "fsub"),
    ast.Mult: (operator.mul, "mul", "fmul"), ast.Div: (operator.truediv, "", "fdiv"),
    ast.FloorDiv: (operator.floordiv, "", ""), ast.Mod: (operator.mod, "", ""), ast.Pow: (operator.pow, "", ""),
}  # fmt: skip
"""What numba calls it, and what LLVM does for whole numbers and for floats; nothing where numba's way is taken."""
_TESTS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}


class Value(NamedTuple):
    """A number or an array in a kernel: its type, and where LLVM has it."""

    kind: Any
    code: Any


def translatable(tree: ast.Module) -> bool:
    """Whether the text of a kernel is in the language: no slices, no arrays but those of noise and of stretches."""
    for node in ast.walk(tree):
        if not isinstance(node, _KNOWN):
            return False
        if isinstance(node, ast.Compare) and len(node.ops) > 1:
            return False
        if isinstance(node, ast.Attribute) and node.attr not in _ATTRIBUTES and ast.unparse(node.value) != "math":
            return False
    return True


def translated(tree: ast.Module, namespace: dict[str, Any]) -> ast.Module:
    """A module whose ``run`` is one operation, the whole body of the kernel; ``namespace`` gets it."""
    kept = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    run = functions.pop("run")
    names = [argument.arg for argument in run.args.args]

    def typed(_: Any, *kinds: Any) -> tuple[Signature, Callable[..., Any]]:
        def generate(context: Any, builder: Any, _: Signature, codes: Any) -> Any:
            given = {name: Value(kind, code) for name, kind, code in zip(names, kinds, codes)}
            return _Writer(context, builder, functions, namespace, given).whole(run.body)

        return types.int64(*kinds), generate

    order = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in ("typing", *names)]
    cast(Any, typed).__signature__ = inspect.Signature(order)
    namespace["whole"] = cast(Any, intrinsic)(typed)
    short = ast.parse(f"def run({', '.join(names)}):\n    return whole({', '.join(names)})").body[0]
    short = ast.copy_location(short, run)
    cast(ast.FunctionDef, short).decorator_list = run.decorator_list
    return ast.fix_missing_locations(ast.Module([*kept, short], []))


class _Writer:
    """Operations of the lines of a kernel, each appended to ``builder``."""

    def __init__(
        self, context: Any, builder: Any, functions: dict[str, ast.FunctionDef], namespace: dict[str, Any],
        names: dict[str, Value],
    ) -> None:  # fmt: skip
        self.context, self.builder, self.functions, self.namespace, self.names = (
            context, builder, functions, namespace, names,
        )  # fmt: skip
        self.places: dict[str, Value] = {}
        self.loops: list[tuple[Any, Any]] = []
        self.result, self.end = _place(builder, ir.IntType(64)), builder.append_basic_block("end")

    def whole(self, body: Sequence[ast.stmt]) -> Any:
        """The body of a kernel; returns what it returns."""
        self.lines(body)
        self.builder.position_at_end(self.end)
        return self.builder.load(self.result)

    def lines(self, body: Sequence[ast.stmt]) -> None:
        for line in body:
            if not self.builder.block.is_terminated:
                getattr(self, f"_{type(line).__name__.lower()}")(line)

    # Statements

    def _assign(self, line: ast.Assign) -> None:
        values = self.values(line.value)
        for target in line.targets:
            targets = target.elts if isinstance(target, ast.Tuple) else [target]
            for place, value in zip(targets, values, strict=True):
                self.store(place, value)

    def _augassign(self, line: ast.AugAssign) -> None:
        old, new = self.value(cast(ast.expr, line.target)), self.value(line.value)
        self.store(line.target, self.binary(line.op, old, new))

    def _expr(self, line: ast.Expr) -> None:
        self.values(line.value)

    def _return(self, line: ast.Return) -> None:
        assert line.value is not None
        self.builder.store(self.as_kind(self.value(line.value), types.int64), self.result)
        self.builder.branch(self.end)

    def _break(self, _: ast.Break) -> None:
        self.builder.branch(self.loops[-1][1])

    def _continue(self, _: ast.Continue) -> None:
        self.builder.branch(self.loops[-1][0])

    def _if(self, line: ast.If) -> None:
        yes, no, after = (self.builder.append_basic_block(name) for name in ("yes", "no", "after"))
        self.branch(line.test, yes, no)
        for block, body in ((yes, line.body), (no, line.orelse)):
            self.builder.position_at_end(block)
            self.lines(body)
            self.go(after)

    def _for(self, line: ast.For) -> None:
        bounds = [self.as_kind(self.value(bound), types.int64) for bound in cast(ast.Call, line.iter).args]
        start, stop = bounds if len(bounds) > 1 else (ir.Constant(ir.IntType(64), 0), *bounds)
        counter = _place(self.builder, ir.IntType(64))
        self.builder.store(start, counter)
        test, body, step, after = (self.builder.append_basic_block(name) for name in ("test", "body", "step", "after"))
        self.builder.branch(test)
        self.builder.position_at_end(test)
        self.builder.cbranch(self.builder.icmp_signed("<", self.builder.load(counter), stop), body, after)
        self.builder.position_at_end(body)
        self.store(line.target, Value(types.int64, self.builder.load(counter)))
        self.loops.append((step, after))
        self.lines(line.body)
        self.loops.pop()
        self.go(step)
        self.builder.position_at_end(step)
        one = ir.Constant(ir.IntType(64), 1)
        self.builder.store(self.builder.add(self.builder.load(counter), one), counter)
        self.builder.branch(test)
        self.builder.position_at_end(after)

    def go(self, block: Any) -> None:
        """Go on in a block, which stands next unless the lines have gone elsewhere."""
        if not self.builder.block.is_terminated:
            self.builder.branch(block)
        self.builder.position_at_end(block)

    def store(self, target: ast.expr, value: Value) -> None:
        if isinstance(target, ast.Subscript):
            kind, place = self.entry(target)
            self.builder.store(self.as_kind(value, kind), place)
            return
        name = cast(ast.Name, target).id
        if isinstance(value.kind, types.Array):
            self.names[name] = value
            return
        if name not in self.places:
            self.places[name] = Value(value.kind, _place(self.builder, value.code.type))
        kind, place = self.places[name]
        if kind == types.int64 and value.kind == types.float64:
            raise TypeError(f"{name} is a whole number in this kernel, and cannot become a float.")
        self.builder.store(self.as_kind(value, kind), place)

    # Tests

    def branch(self, test: ast.expr, yes: Any, no: Any) -> None:
        """Go to ``yes`` or to ``no``; what stands behind a decision is not looked at."""
        if isinstance(test, ast.BoolOp):
            every = isinstance(test.op, ast.And)
            for part in test.values[:-1]:
                further = self.builder.append_basic_block("further")
                self.branch(part, further if every else yes, no if every else further)
                self.builder.position_at_end(further)
            self.branch(test.values[-1], yes, no)
        elif isinstance(test, ast.UnaryOp):
            self.branch(test.operand, no, yes)
        else:
            self.builder.cbranch(self.value(test).code, yes, no)

    # Values

    def value(self, node: ast.expr) -> Value:
        (value,) = self.values(node)
        return value

    def values(self, node: ast.expr) -> list[Value]:
        return getattr(self, f"_{type(node).__name__.lower()}")(node)  # type: ignore[no-any-return]

    def _tuple(self, node: ast.Tuple) -> list[Value]:
        return [self.value(part) for part in node.elts]

    def _constant(self, node: ast.Constant) -> list[Value]:
        return [self.number(node.value)]

    def number(self, number: Any) -> Value:
        kind = {bool: types.boolean, int: types.int64, float: types.float64}.get(type(number), types.none)
        return Value(kind, self.context.get_constant(kind, number) if kind is not types.none else None)

    def _name(self, node: ast.Name) -> list[Value]:
        if node.id in self.places:
            kind, place = self.places[node.id]
            return [Value(kind, self.builder.load(place))]
        return [self.names[node.id] if node.id in self.names else self.number(self.namespace[node.id])]

    def _attribute(self, node: ast.Attribute) -> list[Value]:
        return [self.number(getattr(self.namespace[ast.unparse(node.value)], node.attr))]

    def _subscript(self, node: ast.Subscript) -> list[Value]:
        if isinstance(node.value, ast.Attribute):
            axis = cast(int, cast(ast.Constant, node.slice).value)
            return [Value(types.int64, self.part(self.value(node.value.value), "shape", axis))]
        kind, place = self.entry(node)
        return [Value(kind, self.builder.load(place))]

    def part(self, array: Value, name: str, *places: int) -> Any:
        """The address of an array's numbers, or one of its sizes."""
        first = self.context.data_model_manager[array.kind].get_field_position(name)
        return self.builder.extract_value(array.code, [first, *places])

    def entry(self, node: ast.Subscript) -> tuple[Any, Any]:
        """The type and the address of an entry of an array whose rows lie one behind the other."""
        array, indices = self.value(node.value), [self.as_kind(index, types.int64) for index in self.values(node.slice)]
        place = indices[0]
        for axis, index in enumerate(indices[1:], start=1):
            place = self.builder.add(self.builder.mul(place, self.part(array, "shape", axis)), index)
        return array.kind.dtype, self.builder.gep(self.part(array, "data"), [place], inbounds=True)

    def _ifexp(self, node: ast.IfExp) -> list[Value]:
        yes, no, after = (self.builder.append_basic_block(name) for name in ("yes", "no", "after"))
        place = _place(self.builder, ir.DoubleType())
        self.branch(node.test, yes, no)
        for block, part in ((yes, node.body), (no, node.orelse)):
            self.builder.position_at_end(block)
            self.builder.store(self.as_kind(self.value(part), types.float64), place)
            self.builder.branch(after)
        self.builder.position_at_end(after)
        return [Value(types.float64, self.builder.load(place))]

    def _compare(self, node: ast.Compare) -> list[Value]:
        kind, (left, right) = self.alike(self.value(node.left), self.value(node.comparators[0]))
        sign = _TESTS[type(node.ops[0])]
        if kind == types.float64:
            compare = self.builder.fcmp_unordered if sign == "!=" else self.builder.fcmp_ordered
        else:
            compare = self.builder.icmp_signed
        return [Value(types.boolean, compare(sign, left, right))]

    def _binop(self, node: ast.BinOp) -> list[Value]:
        left = self.value(node.left)
        if isinstance(node.op, ast.Pow) and isinstance(node.right, ast.Constant):
            if node.right.value != 2:
                raise ValueError(f"constant powers in kernels are squares, got {node.right.value!r}.")
            return [self.binary(ast.Mult(), left, left)]
        return [self.binary(node.op, left, self.value(node.right))]

    def binary(self, op: ast.operator, *operands: Value) -> Value:
        kind, codes = self.alike(*operands)
        function, *ways = _OPERATORS[type(op)]
        way = ways[kind == types.float64]
        if way:
            return Value(kind, getattr(self.builder, way)(*codes))
        return self.called(function, [Value(kind, code) for code in codes])[0]

    def _unaryop(self, node: ast.UnaryOp) -> list[Value]:
        if isinstance(node.operand, ast.Constant):
            return [self.number(-cast(Any, node.operand.value))]
        return self.called(operator.neg, [self.value(node.operand)])

    def _call(self, node: ast.Call) -> list[Value]:
        name = ast.unparse(node.func)
        if name == "np.empty":
            return [self.empty(node.args[0])]
        given = [self.value(argument) for argument in node.args]
        if name in self.functions:
            return self.inlined(self.functions[name], given)
        if name in ("min", "max"):
            return [functools.reduce(functools.partial(self.farther, "<" if name == "min" else ">"), given)]
        if name == "int":
            return [Value(types.int64, self.as_kind(given[0], types.int64))]
        home, _, last = name.rpartition(".")
        function = getattr(self.namespace[home] if home else builtins, last, None)
        return self.called(function if function is not None else self.namespace[last], given)

    def called(self, function: Any, given: Sequence[Value]) -> list[Value]:
        """What numba makes of a call."""
        context = self.context
        kind = context.typing_context.resolve_value_type(function)
        signature = kind.get_call_type(context.typing_context, tuple(value.kind for value in given), {})
        way = context.get_function(kind, signature)
        code = way(self.builder, [self.as_kind(value, to) for value, to in zip(given, signature.args)])
        for library in getattr(way, "libs", ()):
            context.active_code_library.add_linking_library(library)
        made: Any = signature.return_type
        if hasattr(made, "types"):
            return [Value(*pair) for pair in zip(made.types, _unpacked(self.builder, code))]
        return [Value(made, code)]

    def farther(self, sign: str, old: Value, new: Value) -> Value:
        """The larger or smaller of two numbers: the old one unless the new one surpasses it, as in Python."""
        kind, codes = self.alike(old, new)
        compare = self.builder.fcmp_ordered if kind == types.float64 else self.builder.icmp_signed
        return Value(kind, self.builder.select(compare(sign, codes[1], codes[0]), codes[1], codes[0]))

    def inlined(self, function: ast.FunctionDef, given: Sequence[Value]) -> list[Value]:
        """What a function of the text returns, whose lines do not branch."""
        outer, self.names, self.places = (self.names, self.places), {}, {}
        self.names = {argument.arg: value for argument, value in zip(function.args.args, given, strict=True)}
        *body, last = function.body
        self.lines(body)
        values = self.values(cast(ast.expr, cast(ast.Return, last).value))
        self.names, self.places = outer
        return values

    def empty(self, size: ast.expr) -> Value:
        """An array of numbers that lives as long as the kernel runs."""
        number = eval(compile(ast.Expression(size), "<size>", "eval"), self.namespace)  # noqa: S307
        count, kind = ir.Constant(ir.IntType(64), number), types.Array(types.float64, 1, "C")
        data = _place(self.builder, ir.DoubleType(), size=count)
        array = _make_array(kind)(self.context, self.builder)
        eight = ir.Constant(ir.IntType(64), 8)
        _fill_array(array, data, [count], [eight], eight, None)
        return Value(kind, array._getvalue())

    def alike(self, *values: Value) -> tuple[Any, list[Any]]:
        """Numbers as whole ones if all are, else as floats."""
        whole = all(value.kind == types.int64 for value in values)
        kind = types.int64 if whole else types.float64
        return kind, [self.as_kind(value, kind) for value in values]

    def as_kind(self, value: Value, kind: Any) -> Any:
        return value.code if value.kind == kind else self.context.cast(self.builder, value.code, value.kind, kind)
