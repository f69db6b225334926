"""The language of problem files computes what Python computes, and has nothing else to reach for."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from certbound.problem.files.parser import constant, parse
from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.graph import Graph

NAMES = ("x", "y", "z")
FUNCTIONS = {"sin": math.sin, "cos": math.cos, "exp": math.exp, "tanh": math.tanh, "abs": abs, "atan": math.atan}


def evaluate(text, *values):
    graph = Graph(NAMES)
    node = parse(text, graph, {name: graph.input(slot) for slot, name in enumerate(NAMES)}, "dynamics.x")
    return float(compile_numpy(graph.tape([node], (1,)))(*(values or (0.0, 0.0, 0.0)))[0])


def texts():
    leaves = st.one_of(st.sampled_from(NAMES), st.sampled_from(["2", "0.5", ".25", "1e-1", "3.", "pi"]))

    def deeper(inner):
        pair = st.tuples(inner, st.sampled_from(["+", "-", "*", " + ", " - "]), inner)
        return st.one_of(
            pair.map("".join),
            inner.map(lambda text: f"({text})"),
            inner.map(lambda text: f"-({text})"),
            st.tuples(st.sampled_from(sorted(FUNCTIONS)), inner).map(lambda pair: f"{pair[0]}(atan({pair[1]}))"),
            inner.map(lambda text: f"({text})**2"),
        )

    return st.recursive(leaves, deeper, max_leaves=8)


@settings(derandomize=True, deadline=None, max_examples=150)
@given(text=texts(), values=st.tuples(*[st.floats(-2, 2)] * 3))
def test_an_expression_means_what_python_means(text, values):
    scope = dict(zip(NAMES, values)) | FUNCTIONS | {"pi": math.pi}
    expected = eval(text, {"__builtins__": {}}, scope)  # noqa: S307
    assert evaluate(text, *values) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("-2**2", -4),
        ("2**-1", 0.5),
        ("2**3**2", 512),
        ("-2**-2", -0.25),
        ("6/3/2", 1),
        ("6 - 3 - 2", 1),
        ("2*-3", -6),
        ("+3 - -2", 5),
        ("8**(1/3)", 2),
        ("min(3, 1, 2) + max(1, 2)", 3),
        ("hypot(3, 4)", 5),
        ("atan2(1, -1)", 3 * math.pi / 4),
        ("sinh(0) + cosh(0) + asin(0) + acos(1) + tan(0) + log(exp(2)) + sqrt(4)", 5),
        (" 1e3\n*\t2 ", 2000),
        ("2**x", 1),
        ("sign(-3) + floor(2.7) + floor(-0.5)", 0),
        ("1 + 2 > 2 and not 3 <= 2 or 1 == 2", 1),
        ("not 1 == 2 and 1 != 1", 0),
        ("where(x > 0, 7, where(y >= x, 2, 3))", 2),
        ("clip(-7, -2, 5) + 10*clip(7, -2, 5) + 100*clip(1, -2, 5)", 148),
    ],
)
def test_precedence_and_functions(text, value):
    assert evaluate(text) == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x.real", r"\(position 2\): attribute access does not exist here"),
        ("().__class__", "attribute access|expected a value"),
        ("x[0]", "indexing does not exist here"),
        ("{x}", "braces do not exist here"),
        ("x^2", r"write \*\* for powers"),
        ("x = 2", "an expression has no assignment"),
        ("'x'", "text does not exist here"),
        ("x; y", "such a character does not exist here"),
        ("1%", "percent signs do not exist here .*write 0.01 for 1 %"),
        ("1 second", "unexpected 'second'; write 1 without a unit"),
        ("x ** lambda", "unknown name 'lambda'"),
        ("__import__('os')", "text does not exist here"),
        ("__import__(x)", "unknown function '__import__'"),
        ("eval(x)", "unknown function 'eval'; known: abs,"),
        ("open(x)", "unknown function 'open'"),
        ("sine(x)", "unknown function 'sine'; did you mean 'sin'"),
        ("w", "unknown name 'w'; known: pi, x, y, z"),
        ("sin", r"sin is a function; write sin\(\.\.\.\)"),
        ("x(y)", r"'x' is not a function; write \* to multiply"),
        ("pi(2)", "'pi' is not a function"),
        ("2 x", "unexpected 'x'"),
        ("(x", r"expected '\)', got 'the end'"),
        ("x)", r"unexpected '\)'"),
        ("x +", "expected a value, got 'the end'"),
        ("* x", r"expected a value, got '\*'"),
        ("", "expected a value"),
        ("   ", "expected a value"),
        ("sin()", "expected a value"),
        ("sin(x, y)", "sin takes 1 argument, got 2"),
        ("atan2(x)", "atan2 takes 2 arguments, got 1"),
        ("min(x)", "min takes 2 arguments, got 1"),
        ("1/0", "division by 0"),
        ("x/(2 - 2)", "division by 0"),
        ("1e999", "1e999 is too large"),
        ("1_000", "unexpected '_000'"),
        ("x // y", "expected a value, got '/'"),
        ("x if y else z", "unexpected 'if'"),
        ("x and", "expected a value, got 'the end'"),
        ("and(x, y)", "expected a value, got 'and'"),
        ("x < y < z", r"a chain of comparisons does not exist here; write a < b and b < c"),
        ("x <> y", "expected a value, got '>'"),
        ("where(x > 0, y)", "where takes 3 arguments, got 2"),
        ("clip(x, 1)", "clip takes 3 arguments, got 2"),
        ("where", r"where is a function; write where\(\.\.\.\)"),
        ("\u03c0", "unknown name .\u03c0."),
        ("\u0663", "such a character does not exist here"),
        ("x \u2212 y", "such a character does not exist here"),
        ("inf", "unknown name 'inf'"),
        ("(" * 100_000 + "x", "must have at most 20000 characters"),
        ("(" * 5000 + "x" + ")" * 5000, "nested deeper than 60 levels"),
        ("-" * 5000 + "x", "nested deeper than 60 levels"),
        ("x**" * 5000 + "2", "nested deeper than 60 levels"),
        ("sin(" * 500 + "x" + ")" * 500, "nested deeper than 60 levels"),
    ],
)
def test_anything_else_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        evaluate(text)


def test_a_message_names_the_place_and_cuts_the_text():
    with pytest.raises(ValueError, match=r"`dynamics\.x` must be an expression, got 'x \+ \+{60}.*\.\.\.'"):
        evaluate("x + " + "+" * 300)


def test_long_flat_sums_are_read():
    assert evaluate(" + ".join(["x"] * 3000), 2.0, 0.0, 0.0) == 6000


def test_a_name_may_be_made_on_first_use():
    graph = Graph(["x"])
    calls = []

    def made():
        calls.append(1)
        return graph.apply("sq", graph.input(0))

    node = parse("s + 1", graph, {"s": made, "unused": made}, "here")
    assert len(calls) == 1
    assert graph.tape([node], (1,)).describe(-1) == "(x**2 + 1)"


def test_the_value_of_a_constant_and_only_of_a_constant():
    graph = Graph(["x"])
    assert constant(graph, parse("2*pi/4", graph, {}, "here")) == np.pi / 2
    assert constant(graph, graph.input(0)) is None
