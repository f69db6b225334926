"""Bounds of crossings beside the truth: simulation, other formulas, and laws that are known."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from flint import arb, ctx

from certbound.checker.affine.crossings import Level, crossing, crude, positive_part, rice
from certbound.checker.affine.row_pieces import Means, Piece
from certbound.checker.report import Budget
from certbound.gaussian.scalar import log_line_crossing


@pytest.mark.parametrize("level", [0.5, 2.0, 4.7])
@pytest.mark.parametrize("clock", [0.01, 0.2, 1.0])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_an_ornstein_uhlenbeck_process_crosses_as_the_prover_has_it(level: float, clock: float, share: float) -> None:
    last = level * math.exp(-share * clock)
    with ctx.workprec(128):
        found = float(crossing(arb(level), arb(last), arb(clock), Budget(10.0)))
    other = math.exp(float(log_line_crossing(level, last, clock)))
    assert other * 0.999 <= found <= other * 1.05


def test_a_wiener_process_follows_the_reflection_principle() -> None:
    """With D = k the line is level: P(W_1 <= l, sup of W over [1, E] > l) = 2 P(W_1 <= l, W_E > l)."""
    clock, level = 0.3, 2.0
    size = math.exp(clock)
    generator = np.random.default_rng(1)
    first = generator.standard_normal(2_000_000)
    last = first + math.sqrt(size**2 - 1) * generator.standard_normal(first.size)
    truth = 2 * np.mean((first <= level) & (last > level))
    with ctx.workprec(128):
        found = float(crossing(arb(level), arb(level) * arb(-clock).exp().lower(), arb(clock), Budget(10.0)))
    assert 0.98 * truth <= found <= 1.03 * truth


def test_the_mean_of_a_positive_part_is_that_of_a_normal() -> None:
    with ctx.workprec(128):
        assert float(positive_part(arb(0), arb(1))) == pytest.approx(1 / math.sqrt(2 * math.pi))
        assert float(positive_part(arb(3), arb(0))) == 3.0
        assert 0 <= float(positive_part(arb(-40), arb(1))) < 1e-300
        assert float(positive_part(arb(50), arb(1))) == pytest.approx(50.0)


def piece(**changes: float) -> Piece:
    """One of length 1 over which everything stands still: s = 1, c = 0, e = 4."""
    values = {
        "length": 1.0, "first_high": 1.0, "last_low": 1.0, "s_low": 1.0, "s_high": 1.0, "c_low": 0.0, "c_high": 0.0,
        "e_high": 4.0, "d_low": -4.0, "v_high": 64.0,
    } | changes  # fmt: skip
    balls = {name: arb(value) for name, value in values.items()}
    return Piece(start=Fraction(0), end=Fraction(1), means=Means(*[arb(0)] * 4), **balls)


def test_a_stationary_row_crosses_at_the_rate_of_rice() -> None:
    with ctx.workprec(128):
        cost = rice(Level(arb(3), arb(3)), piece(), Budget(10.0))
    assert cost is not None
    assert float(cost.probability) == pytest.approx(2.0 / (2 * math.pi) * math.exp(-4.5))


@pytest.mark.parametrize("name", ["s_low", "c_low", "c_high", "s_high", "e_high"])
def test_wider_enclosures_never_cost_less(name: str) -> None:
    change = {"s_low": 0.8, "c_low": -0.3, "c_high": 0.3, "s_high": 1.3, "e_high": 5.0}
    with ctx.workprec(128):
        plain = rice(Level(arb(2), arb(2)), piece(), Budget(10.0))
        wide = rice(Level(arb(2), arb(2)), piece(**{name: change[name]}), Budget(10.0))
    assert plain is not None
    assert wide is not None
    assert wide.probability >= plain.probability


def test_where_the_variance_may_vanish_only_what_is_sure_from_any_start_is_said() -> None:
    with ctx.workprec(128):
        level = Level(arb(3), arb(3))
        assert rice(level, piece(s_low=0.0), Budget(10.0)) is None
        still = crude(level, piece(first_high=0.0, e_high=0.0), arb(0), Budget(10.0))
        assert still.probability == 0
        assert still.enters is None
        moved = crude(level, piece(first_high=0.0, e_high=0.09), arb(0), Budget(10.0))
        assert float(moved.probability) == pytest.approx(2 * math.exp(-9 / 0.18), rel=1e-6)


def test_the_crude_bound_holds_for_a_wiener_process() -> None:
    with ctx.workprec(128):
        found = crude(Level(arb(3), arb(3)), piece(first_high=0.0, e_high=0.0), arb(1), Budget(10.0))
    truth = math.erfc(3 / math.sqrt(2))  # 2 Q(3)
    assert truth <= float(found.probability) <= 1.2 * truth
