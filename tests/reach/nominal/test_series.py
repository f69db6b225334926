"""Taylor coefficients along a curve."""

from __future__ import annotations

import flint
import numpy as np
import pytest

from certbound.problem.model.tape import Node, Tape
from certbound.reach.nominal.series import expand, polynomial_range, taylor_bounds
from certbound.rigor.intervals import Interval
from certbound.rigor.series import product


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


CASES = {
    "sin": ((-2, 2), lambda s: s.sin()),
    "cos": ((-2, 2), lambda s: s.cos()),
    "tan": ((-1, 1), lambda s: s.tan()),
    "exp": ((-2, 2), lambda s: s.exp()),
    "log": ((0.2, 2), lambda s: s.log()),
    "sqrt": ((0.2, 2), lambda s: s.sqrt()),
    "atan": ((-2, 2), lambda s: s.atan()),
    "asin": ((-0.8, 0.8), lambda s: s.asin()),
    "acos": ((-0.8, 0.8), lambda s: s.acos()),
    "sinh": ((-2, 2), lambda s: (s.exp() - (-s).exp()) / 2),
    "cosh": ((-2, 2), lambda s: (s.exp() + (-s).exp()) / 2),
    "tanh": ((-2, 2), lambda s: ((2 * s).exp() - 1) / ((2 * s).exp() + 1)),
    "sq": ((-2, 2), lambda s: s * s),
    "neg": ((-2, 2), lambda s: -s),
    "abs": ((-2, -0.1), lambda s: -s),
}
BINARY = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: x / y,
    "hypot": lambda x, y: (x * x + y * y).sqrt(),
    "atan2": lambda x, y: (x / y).atan(),
    "max": lambda x, y: y,
    "min": lambda x, y: x,
}


def tape(op: str, arity: int, value: float = 0.0) -> Tape:
    names = ("x", "y")[:arity]
    nodes = (*(Node("input", (k,)) for k in range(arity)), Node(op, tuple(range(arity)), value))
    return Tape(inputs=names, nodes=nodes, outputs=(arity,), shape=(1,))


def thin(values: list[float]) -> list[Interval]:
    return [Interval.point(np.array([v])) for v in values]


def assert_matches(series: list[Interval], reference: object, tolerance: float = 1e-12) -> None:
    for k, coefficient in enumerate(series):
        exact = reference[k]  # type: ignore[index]
        assert np.all(coefficient.lo <= float(exact.upper()))
        assert np.all(coefficient.hi >= float(exact.lower()))
        assert np.all(coefficient.width < tolerance * (1 + abs(float(exact))))


@pytest.mark.parametrize("op", sorted(CASES))
def test_unary_coefficients_enclose_those_of_a_power_series_library_tightly(op, rng, monkeypatch):
    (lo, hi), function = CASES[op]
    values = [rng.uniform(lo, hi), *rng.normal(size=3)]
    with flint.ctx.workprec(200):
        monkeypatch.setattr(flint.ctx, "cap", 7)
        assert_matches(expand(tape(op, 1), [thin(values)], 6)[0], function(flint.arb_series(values, 7)), 1e-10)


@pytest.mark.parametrize("op", sorted(BINARY))
def test_binary_coefficients_enclose_those_of_a_power_series_library(op, rng, monkeypatch):
    first, second = [0.3, *rng.normal(size=3)], [1.4, *rng.normal(size=2)]
    with flint.ctx.workprec(200):
        monkeypatch.setattr(flint.ctx, "cap", 6)
        reference = BINARY[op](flint.arb_series(first, 6), flint.arb_series(second, 6))
        assert_matches(expand(tape(op, 2), [thin(first), thin(second)], 5)[0], reference, 1e-11)


@pytest.mark.parametrize("exponent", [3.0, 2.0, 1.0, 0.0, -2.0, 2.5, -0.5])
def test_powers_with_every_kind_of_exponent(exponent, monkeypatch):
    values = [1.3, 0.7, -0.4]
    with flint.ctx.workprec(200):
        monkeypatch.setattr(flint.ctx, "cap", 6)
        reference = flint.arb_series(values, 6) ** flint.arb(exponent)
        assert_matches(expand(tape("pow", 1, exponent), [thin(values)], 5)[0], reference)


def test_integer_power_passes_through_zero():
    series = expand(tape("pow", 1, 3.0), [thin([0.0, 2.0])], 4)[0]
    assert [float(np.ravel(c.mid)[0]) for c in series] == [0.0, 0.0, 0.0, 8.0, 0.0]


def test_lagrange_form_encloses_the_function_at_every_order():
    half = 0.1
    span = Interval(np.array([-half]), np.array([half]))
    centre = expand(tape("sin", 1), [[Interval.point(np.array([0.5])), Interval.point(1.0)]], 5)[0]
    piece = expand(tape("sin", 1), [[span + 0.5, Interval.point(1.0)]], 5)[0]
    bounds = taylor_bounds(centre, piece, span)
    samples = np.sin(0.5 + np.linspace(-half, half, 41))
    assert len(bounds) == 6
    for bound in bounds:
        assert bound.lo[0] <= samples.min()
        assert samples.max() <= bound.hi[0]
    true_width = samples.max() - samples.min()
    assert bounds[2].width[0] < 1.05 * true_width


def test_an_undecided_kink_keeps_the_first_order_and_drops_the_rest():
    x = [Interval(np.array([-1.0, 1.0]), np.array([1.0, 2.0])), Interval.point(np.array([2.0, 2.0]))]
    series = expand(tape("abs", 1), [x], 3)[0]
    assert series[1].lo.tolist() == [-2.0, 2.0]
    assert series[1].hi.tolist() == [2.0, 2.0]
    quadratic = [*x, Interval.point(np.array([1.0, 1.0]))]
    second = expand(tape("abs", 1), [quadratic], 3)[0][2]
    assert np.isinf(second.hi[0])
    assert second.hi[1] == 1.0


def test_an_undecided_jump_is_unbounded_even_inside_a_bounded_function():
    nodes = (Node("input", (0,)), Node("sign", (0,)), Node("cos", (1,)))
    jump = Tape(inputs=("x",), nodes=nodes, outputs=(2,), shape=(1,))
    x = [Interval(np.array([-1.0, 1.0]), np.array([1.0, 2.0])), Interval.point(1.0)]
    series = expand(jump, [x], 2)[0]
    assert np.isinf(series[1].hi[0])
    assert series[1].hi[1] == 0.0


def test_the_angle_across_its_cut_is_unbounded_although_its_derivative_is_not():
    y = [Interval(np.array([-0.1]), np.array([0.1])), Interval.point(1.0)]
    x = [Interval.point(np.array([-1.0]))]
    series = expand(tape("atan2", 2), [y, x], 2)[0]
    assert all(np.all(np.isinf(c.hi)) for c in series)


def test_polynomial_range_uses_even_powers():
    span = Interval(np.array([-1.0]), np.array([1.0]))
    result = polynomial_range(thin([1.0, 0.0, 2.0]), span)
    assert result.lo[0] >= 1.0 - 1e-12
    assert result.hi[0] <= 3.0 + 1e-12


def test_product_is_the_cauchy_product():
    result = product(thin([1.0, 2.0]), thin([3.0, 4.0]))
    assert [float(np.ravel(c.mid)[0]) for c in result] == [3.0, 10.0, 8.0]
