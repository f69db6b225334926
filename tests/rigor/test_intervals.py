"""Every interval primitive contains the ball-arithmetic value; a rounding that is left out is noticed."""

from __future__ import annotations

import flint
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from certbound.problem.model.operations import OPERATIONS
from certbound.rigor import arithmetic, elementary
from certbound.rigor import intervals as iv
from certbound.rigor.intervals import Interval

UNARY_BALLS = {
    "neg": lambda x: -x, "sq": lambda x: x * x, "sqrt": lambda x: x.sqrt(), "exp": lambda x: x.exp(),
    "log": lambda x: x.log(), "sin": lambda x: x.sin(), "cos": lambda x: x.cos(), "tan": lambda x: x.tan(),
    "asin": lambda x: x.asin(), "acos": lambda x: x.acos(), "atan": lambda x: x.atan(),
    "sinh": lambda x: x.sinh(), "cosh": lambda x: x.cosh(), "tanh": lambda x: x.tanh(),
    "abs": lambda x: abs(x),
}  # fmt: skip
BINARY_BALLS = {
    "add": lambda x, y: x + y, "sub": lambda x, y: x - y, "mul": lambda x, y: x * y,
    "div": lambda x, y: x / y,
    "atan2": lambda y, x: flint.arb.atan2(y, x), "hypot": lambda x, y: (x * x + y * y).sqrt(),
    "min": lambda x, y: x.min(y), "max": lambda x, y: x.max(y),
}  # fmt: skip
POWERS = {2: lambda x: x**2, 3: lambda x: x**3, 7: lambda x: x**7, -1: lambda x: 1 / x, -4: lambda x: x**-4}
REAL_POWERS = [0.5, 1.5, -0.3]
COUNT = 3300  # times 31 primitives: 1e5 intervals


def random_intervals(rng: np.random.Generator, count: int) -> Interval:
    """Moderate, tiny (down to subnormal), huge, unbounded, zero-touching and point intervals."""
    scale = 10.0 ** rng.choice([0, 0, 0, 1, 3, 7, -5, -200, -310, 150, 300], count)
    centre = rng.normal(size=count) * scale
    width = np.abs(rng.normal(size=count)) * 10.0 ** rng.uniform(-16, 1, count) * np.minimum(scale, 1e300)
    kind = rng.integers(0, 12, count)
    width = np.where(kind == 0, 0.0, width)
    lo, hi = centre - width, centre + width
    lo, hi = np.where(kind == 1, -np.inf, lo), np.where(kind == 2, np.inf, hi)
    lo, hi = np.where(kind == 3, -np.inf, lo), np.where(kind == 3, np.inf, hi)
    lo, hi = np.where(kind == 4, 0.0, lo), np.where(kind == 4, np.abs(hi), hi)
    lo, hi = np.where(kind == 5, -np.abs(lo), lo), np.where(kind == 5, 0.0, hi)
    lo, hi = np.where(kind == 6, 0.0, lo), np.where(kind == 6, 0.0, hi)
    unit = np.sort(rng.uniform(-1, 1, (2, count)), axis=0)  # inside the domain of asin and acos
    lo, hi = np.where(kind >= 10, unit[0], lo), np.where(kind >= 10, unit[1], hi)
    positive = kind == 9
    return Interval(np.where(positive, np.abs(lo), lo), np.where(positive, np.abs(lo) + (hi - lo), hi))


def points_inside(rng: np.random.Generator, x: Interval) -> list[np.ndarray]:
    """Both ends and a random point of each interval, all finite."""
    lo, hi = np.maximum(x.lo, -1e308), np.minimum(x.hi, 1e308)
    share = rng.uniform(size=x.shape)
    inner = np.clip(lo * (1 - share) + hi * share, lo, hi)
    tame = np.clip(rng.normal(size=x.shape) * 3, lo, hi)
    return [lo, hi, np.where(rng.uniform(size=x.shape) < 0.5, inner, tame)]


def escapes(result: Interval, values: list[flint.arb]) -> int:
    """How many ball-arithmetic values lie outside their interval for certain."""
    count = 0
    for lo, hi, value in zip(result.lo.tolist(), result.hi.tolist(), values, strict=True):
        if value.is_finite() and (value < flint.arb(lo) or value > flint.arb(hi)):
            count += 1
    return count


@flint.ctx.workprec(128)
def count_escapes(op: str | float, count: int = COUNT, seed: int = 0) -> int:
    rng = np.random.default_rng(seed)
    x, y = random_intervals(rng, count), random_intervals(rng, count)
    total = 0
    if isinstance(op, (int, float)):
        ball = POWERS.get(op, lambda v: v ** flint.arb(op)) if op != 0.5 else (lambda v: v.sqrt())
        result = iv.pow_(x, op)
    elif op in UNARY_BALLS:
        ball, result = UNARY_BALLS[op], OPERATIONS[op].interval(x)
    else:
        ball, result = BINARY_BALLS[op], OPERATIONS[op].interval(x, y)
    assert not np.isnan(result.lo).any()
    assert not np.isnan(result.hi).any()
    assert np.all(result.lo <= result.hi)
    for px, py in zip(points_inside(rng, x), points_inside(rng, y), strict=True):
        if op in BINARY_BALLS:
            pairs = zip(px.tolist(), py.tolist(), strict=True)
            values = [ball(flint.arb(a), flint.arb(b)) for a, b in pairs]
        else:
            values = [ball(flint.arb(a)) for a in px.tolist()]
        total += escapes(result, values)
    return total


ALL = [*UNARY_BALLS, *BINARY_BALLS, *POWERS, *REAL_POWERS]


@pytest.mark.parametrize("op", ALL)
def test_primitive_contains_the_ball_arithmetic_value(op):
    assert count_escapes(op) == 0


@pytest.mark.parametrize("op", [op for op in ALL if op not in ("neg", "abs", "min", "max")])
def test_a_rounding_left_out_is_noticed(op, monkeypatch):
    for module in (arithmetic, elementary):
        monkeypatch.setattr(module, "lower", lambda value, **_: value)
    monkeypatch.setattr(elementary, "REDUCTION", 0.0)
    with np.errstate(all="ignore"):
        assert count_escapes(op, count=2000) > 0


@pytest.mark.parametrize(
    "op", ["sin", "cos", "tan", "exp", "log", "tanh", "atan", "sinh", "cosh", "asin", "acos"]
)
@flint.ctx.workprec(128)
def test_library_functions_stay_within_half_of_the_granted_margin(op):
    rng = np.random.default_rng(1)
    x = np.concatenate([rng.uniform(-1, 1, 4000), rng.uniform(-20, 20, 4000), rng.uniform(-1e5, 1e5, 4000)])
    x = np.concatenate([x, np.arange(1, 2000) * (np.pi / 2)])
    x = np.abs(x) if op == "log" else np.clip(x, -1, 1) if op in ("asin", "acos") else x
    x = x[np.abs(x) < 700] if op in ("exp", "sinh", "cosh") else x
    name = {"asin": "arcsin", "acos": "arccos", "atan": "arctan"}.get(op, op)
    found = getattr(np, name)(x)
    for value, point in zip(found.tolist(), x.tolist(), strict=True):
        exact = UNARY_BALLS[op](flint.arb(point))
        granted = max(abs(value), 5e-324) * 2.0**-52 * elementary.LIBRARY_ULPS
        assert abs(exact - flint.arb(value)) <= flint.arb(granted / 2), (op, point)


def test_zero_times_unbounded_is_zero_and_unbounded_differences_are_everything():
    everything = Interval(-np.inf, np.inf)
    zero = Interval(np.zeros(1), np.zeros(1))
    product = zero * everything
    assert product.lo.tolist() == [0.0]
    assert product.hi.tolist() == [0.0]
    half = Interval(np.zeros(1), np.full(1, np.inf))
    difference = half - half
    assert (difference.lo[0], difference.hi[0]) == (-np.inf, np.inf)
    ratio = Interval([1.0], [np.inf]) / Interval([1.0], [np.inf])
    assert ratio.lo[0] <= 0 + 1e-300
    assert ratio.hi[0] == np.inf


def test_undefined_operations_give_everything_and_are_reported():
    zero_inside = Interval([-1.0, 1.0], [1.0, 2.0])
    quotient = Interval.point([1.0, 1.0]) / zero_inside
    assert (quotient.lo[0], quotient.hi[0]) == (-np.inf, np.inf)
    assert quotient.hi[1] < 1.1
    assert OPERATIONS["div"].undefined(zero_inside, zero_inside).tolist() == [True, False]
    assert OPERATIONS["sqrt"].undefined(zero_inside).tolist() == [True, False]
    assert OPERATIONS["log"].undefined(Interval([0.0], [1.0])).tolist() == [True]
    assert OPERATIONS["asin"].undefined(zero_inside).tolist() == [False, True]
    assert OPERATIONS["tan"].undefined(Interval([1.5, 1.6], [1.6, 1.7])).tolist() == [True, False]
    assert OPERATIONS["atan2"].undefined(zero_inside, -zero_inside).tolist() == [True, False]
    assert OPERATIONS["pow"].undefined(zero_inside, -1.0).tolist() == [True, False]
    assert OPERATIONS["pow"].undefined(zero_inside, 0.5).tolist() == [True, False]
    assert iv.tan(Interval([1.5], [1.6])).lo[0] == -np.inf


def test_facts_about_ranges_are_kept():
    everything = Interval([-np.inf], [np.inf])
    for function, lo, hi in ((iv.sin, -1, 1), (iv.cos, -1, 1), (iv.tanh, -1, 1), (iv.exp, 0, np.inf)):
        result = function(everything)
        assert (result.lo[0], result.hi[0]) == (lo, hi)
    assert iv.sin(Interval([0.0], [1.0])).lo[0] == 0.0
    assert iv.sqrt(iv.sq(Interval([-1.0], [1.0]))).lo[0] == 0.0
    assert iv.cos(Interval.point([0.0])).hi[0] == 1.0
    assert iv.sin(Interval([1e30], [1e30])).lo[0] == -1.0
    assert iv.cosh(everything).lo[0] == 1.0


def test_critical_points_between_the_ends_are_found():
    assert iv.sin(Interval([1.0], [2.0])).hi[0] == 1.0
    assert iv.cos(Interval([3.0], [3.3])).lo[0] == -1.0
    assert iv.sin(Interval([np.pi / 2], [np.pi / 2])).hi[0] == 1.0
    assert iv.sin(Interval([2.0], [4.0])).hi[0] < 0.91


def test_jumps_are_decided_only_where_the_box_decides_them():
    x = Interval([-2.0, -1.0, 1.0], [-1.0, 1.0, 2.0])
    less = OPERATIONS["lt"].interval(x, Interval.point(0.0))
    assert less.lo.tolist() == [1, 0, 0]
    assert less.hi.tolist() == [1, 1, 0]
    chosen = OPERATIONS["if_else_zero"].interval(less, Interval.point(np.full(3, 5.0)))
    assert chosen.lo.tolist() == [5, 0, 0]
    assert chosen.hi.tolist() == [5, 5, 0]
    assert OPERATIONS["not"].interval(less).lo.tolist() == [0, 0, 1]
    assert OPERATIONS["or"].interval(less, OPERATIONS["not"].interval(less)).lo.tolist() == [1, 0, 1]
    assert OPERATIONS["and"].interval(less, less).hi.tolist() == [1, 1, 0]
    assert OPERATIONS["eq"].interval(x, Interval.point(1.5)).hi.tolist() == [0, 0, 1]
    kink = OPERATIONS["kink"].interval(Interval([-2.0, 0.0, 1.0], [-1.0, 1.0, 2.0]))
    assert kink.lo.tolist() == [-1, -1, 1]
    assert kink.hi.tolist() == [-1, 1, 1]
    assert OPERATIONS["sign"].interval(x).hi.tolist() == [-1, 1, 1]
    assert OPERATIONS["floor"].interval(Interval([0.2], [0.8])).hi.tolist() == [0]


@flint.ctx.workprec(200)
def test_matrix_product_contains_exact_products_and_unbounded_entries():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(20, 3, 5)), rng.normal(size=(20, 5, 2)) * 10.0 ** rng.uniform(-8, 8, (20, 1, 1))
    product = iv.matmul(Interval.point(a), Interval.point(b))
    for k in range(20):
        exact = flint.arb_mat(a[k].tolist()) * flint.arb_mat(b[k].tolist())
        for i in range(3):
            for j in range(2):
                assert flint.arb(product.lo[k, i, j]) <= exact[i, j] <= flint.arb(product.hi[k, i, j])
                assert product.width[k, i, j] < 1e-13 * np.abs(a[k]).max() * np.abs(b[k]).max() * 5
    radius = 0.1
    wide = iv.matmul(Interval.around(a, radius), Interval.around(b, radius))
    sample = (a + rng.uniform(-radius, radius, a.shape)) @ (b + rng.uniform(-radius, radius, b.shape))
    assert wide.contains(sample).all()
    open_matrix = Interval(np.full((2, 2), -np.inf), np.full((2, 2), np.inf))
    mixed = open_matrix @ np.array([[1.0, 0.0], [0.0, 0.0]])
    assert mixed.hi[0].tolist() == [np.inf, 0.0]
    assert (np.ones(5) @ Interval.point(b[0])).shape == (2,)
    assert (Interval.point(a[0]) @ np.ones(5)).shape == (3,)
    assert (Interval.point(np.ones(5)) @ np.ones(5)).shape == ()


@flint.ctx.workprec(200)
def test_matmul_error_bounds_the_rounding_error_and_is_small():
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(1, 40)) * 1e8, rng.normal(size=(40, 1))
    product, bound = iv.matmul_error(a, b)
    exact = sum((flint.arb(x) * flint.arb(y) for x, y in zip(a[0].tolist(), b[:, 0].tolist())), flint.arb(0))
    assert abs(exact - flint.arb(product[0, 0])) <= flint.arb(bound[0, 0])
    assert bound[0, 0] < 1e-14 * np.abs(a).max() * 40


@flint.ctx.workprec(200)
def test_sum_encloses_whatever_the_order():
    rng = np.random.default_rng(4)
    values = rng.normal(size=(7, 1000)) * 10.0 ** rng.uniform(-10, 10, (7, 1000))
    total = Interval.point(values).sum(axis=1)
    for row in range(7):
        exact = sum(map(flint.arb, values[row].tolist()), flint.arb(0))
        assert flint.arb(total.lo[row]) <= exact <= flint.arb(total.hi[row])


def test_midpoint_and_radius_enclose():
    rng = np.random.default_rng(5)
    x = random_intervals(rng, 4000)
    assert np.isfinite(x.mid).all()
    assert Interval.around(x.mid, x.rad).contains(x).all()
    assert x.contains(x.mid).all()


@given(st.floats(-1e6, 1e6), st.floats(0, 10), st.floats(-1e6, 1e6), st.floats(0, 10))
@settings(max_examples=200, deadline=None, derandomize=True)
def test_operators_are_monotone_in_inclusion(a, wa, b, wb):
    x, y = Interval(a - wa, a + wa), Interval(b - wb, b + wb)
    wider_x, wider_y = Interval(a - 2 * wa - 1, a + 2 * wa + 1), Interval(b - 2 * wb - 1, b + 2 * wb + 1)
    for op in ("add", "sub", "mul", "div", "hypot", "atan2", "min", "max"):
        inner, outer = OPERATIONS[op].interval(x, y), OPERATIONS[op].interval(wider_x, wider_y)
        assert inner.lo >= outer.lo - 1e-9 * abs(outer.lo) or np.isinf(inner.lo)
        assert outer.contains(inner) or np.allclose([outer.lo, outer.hi], [inner.lo, inner.hi])


def test_operators_accept_arrays_and_numbers_on_both_sides():
    x = Interval([1.0, 2.0], [1.5, 2.5])
    array = np.array([2.0, 4.0])
    for result, value in (
        (x + array, 3.2), (array + x, 3.2), (x - array, -0.8), (array - x, 0.8), (2 * x, 2.4), (x / 2, 0.6),
        (array / x, 2 / 1.2), (x**2, 1.44), (-x, -1.2), (x**-1, 1 / 1.2), (x**0, 1.0),
    ):  # fmt: skip
        assert result.contains(np.array([value, value]))[0]


@pytest.mark.parametrize(
    ("lo", "hi"), [(1.0, 0.0), (np.nan, 1.0), (0.0, np.nan), (np.inf, np.inf), (-np.inf, -np.inf)]
)
def test_malformed_intervals_are_refused(lo, hi):
    with pytest.raises(ValueError, match="`lo` must be at most `hi`"):
        Interval(lo, hi)


def test_other_malformed_input_is_refused():
    with pytest.raises(ValueError, match="must be finite"):
        Interval.point(np.inf)
    with pytest.raises(ValueError, match="`mid` must be finite"):
        Interval.around(0.0, -1.0)
    with pytest.raises(ValueError, match="must overlap"):
        Interval(0.0, 1.0).intersect(Interval(2.0, 3.0))
    with pytest.raises(TypeError, match="must be an integer"):
        Interval(0.0, 1.0) ** 0.5


def test_set_operations_and_views():
    x, y = Interval([0.0, 0.0], [1.0, 2.0]), Interval([0.5, -1.0], [3.0, 1.0])
    assert x.hull(y).hi.tolist() == [3.0, 2.0]
    assert x.intersect(y).lo.tolist() == [0.5, 0.0]
    assert x.hull(y).contains(x).all()
    assert iv.stack([x, y], axis=1).shape == (2, 2)
    assert iv.concatenate([x, y]).shape == (4,)
    assert iv.stack([x, y]).T.lo.tolist() == [[0.0, 0.5], [0.0, -1.0]]
    assert x.broadcast_to((3, 2)).reshape(6)[0].hi == 1.0
    assert len(x) == 2
    assert "Interval" in repr(x)
    assert x.mig.tolist() == [0.0, 0.0]


def test_bounds_that_overflowed_are_intervals_too():
    found = Interval.at_most([2.0, np.inf, -3.0])
    assert found.hi.tolist() == [2.0, np.inf, -3.0]
    assert found.lo.tolist() == [2.0, np.finfo(float).max, -3.0]
    assert (1.0 - found).lo[1] == -np.inf
    with pytest.raises(ValueError, match="without NaN"):
        Interval.at_most(np.nan)
