"""Normal probabilities and the scalar events, against integrals and simulation-free closed forms."""

from __future__ import annotations

import math

import pytest
from flint import acb, arb, arb_mat

from certbound.checker.balls.eigen import cholesky, largest_eigenvalue
from certbound.checker.balls.matrices import diagonal, identity, is_positive_definite, matrix
from certbound.checker.balls.normal import below_and_above, tail
from certbound.checker.constants.kummer import Kummer, exit_probability
from certbound.checker.linear.events import MOST_ENTRIES, Windows, bounded_drives, chain, sub_gaussian
from certbound.checker.linear.response import continuous_piece, covariances, discrete_piece
from certbound.checker.report import Budget, Unproved


def integral(a: float, b: float, rho: float) -> arb:
    """P(X <= a, Y > b) by quadrature."""
    spread = (1 - arb(rho) ** 2).sqrt()

    def inner(y: acb, _: object) -> acb:
        return (-y * y / 2).exp() * ((y * arb(rho) - a) / (spread * arb(2).sqrt())).erfc() / 2

    return acb.integral(inner, acb(b), acb(max(b, 0) + 14)).real / (2 * arb.pi()).sqrt()


@pytest.mark.parametrize("rho", [0.05, 0.5, 0.9, 0.99])
@pytest.mark.parametrize(("a", "b"), [(0.0, 0.0), (1.0, 1.2), (3.0, 3.0), (2.0, 3.5), (6.0, 6.1), (-1.0, 0.5)])
def test_below_and_above_is_an_upper_bound_close_to_the_integral(a: float, b: float, rho: float) -> None:
    found, exact = below_and_above(arb(a), arb(b), arb(rho)), integral(a, b, rho)
    assert found >= exact.lower()
    assert found <= tail(arb(b)) * (1 + arb(1e-12))
    if exact > 1e-3 * tail(arb(b)):
        assert found < exact * 1.03


def test_correlations_without_use_fall_back_to_the_tail() -> None:
    assert abs(below_and_above(arb(1), arb(2), arb(-0.5)) - tail(arb(2))) < 1e-12
    assert below_and_above(arb(1), arb(2), arb(1)) <= tail(arb(2))


def test_two_steps_of_a_random_walk_have_the_probability_of_their_union() -> None:
    one = identity(1)
    pieces = [discrete_piece(one, one) for _ in range(2)]
    values = covariances(pieces, one * 0, Budget(10))
    level = arb(2)
    found = chain([[arb(1)]] * 3, [level] * 3, [p.transition for p in pieces], values, Budget(10))
    first = tail(level)
    second = integral(2.0, 2.0 / math.sqrt(2.0), 1 / math.sqrt(2.0))
    assert first + second <= found * (1 + arb(1e-9))
    assert found < (first + second) * 1.02


def test_a_level_below_zero_is_certainly_exceeded_and_none_asks_nothing() -> None:
    one = identity(1)
    pieces = [discrete_piece(one, one)]
    values = covariances(pieces, one, Budget(10))
    assert chain([[arb(1)]] * 2, [None, arb(-1)], [one], values, Budget(10)) == 1
    assert chain([[arb(1)]] * 2, [None, None], [one], values, Budget(10)) == 0
    assert sub_gaussian([[arb(1)]] * 2, [None, arb(-1)], values, Budget(10)) == 1
    assert abs(sub_gaussian([[arb(1)]], [arb(2)], values, Budget(10)) - (-arb(2)).exp()) < 1e-12


def test_windows_bound_the_reflection_principle_of_brownian_motion() -> None:
    count, horizon, level = 8, 1.0, 2.0
    zero, one = identity(1) * 0, identity(1)
    pieces = [continuous_piece(zero, zero, arb(horizon) / count, one) for _ in range(count)]
    values = covariances(pieces, zero, Budget(10))
    windows = Windows(pieces, values, [0, 4], Budget(10))
    assert windows.coordinates([[arb(30)]] * 2) < 1e-100
    found = windows.exceedance([[arb(1)]] * count, [arb(level)] * count)
    exact = 2 * tail(arb(level))
    assert exact.lower() <= found < exact * 1.05


@pytest.mark.parametrize("rate", [-2.0, 0.0, 1.5])
def test_linear_data_of_a_scalar_piece_are_their_closed_forms(rate: float) -> None:
    h = arb(0.3)
    piece = continuous_piece(matrix([[rate]]), matrix([[0.0]]), h, matrix([[2.0]]))
    growth = (arb(rate) * h).exp()
    assert abs(piece.transition[0, 0] - growth) < 1e-25
    gathered = h if rate == 0 else (growth - 1) / rate
    assert abs(piece.gathered[0, 0] - gathered) < 1e-25
    noise = 2 * h if rate == 0 else 2 * (growth * growth - 1) / (2 * rate)
    assert abs(piece.noise[0, 0] - noise) < 1e-25
    assert piece.deviation[0, 0] >= abs(growth - 1).lower()


def test_a_drifting_slope_is_integrated() -> None:
    h = arb(0.5)
    piece = continuous_piece(matrix([[0.2]]), matrix([[0.6]]), h, matrix([[0.0]]))
    assert abs(piece.transition[0, 0] - (0.2 * h + 0.3 * h * h).exp()) < 1e-14


def test_matrices_that_are_not_definite_are_told_apart() -> None:
    assert is_positive_definite(matrix([[1.0, 0.5], [0.5, 1.0]]))
    assert not is_positive_definite(matrix([[1.0, 1.0], [1.0, 1.0]]))
    assert not is_positive_definite(arb_mat(1, 1, [arb(0.1, 0.2)]))
    root = cholesky(matrix([[4.0, 2.0], [2.0, 3.0]]))
    assert (root * root.transpose() - matrix([[4.0, 2.0], [2.0, 3.0]])).contains(identity(2) * 0)
    with pytest.raises(Unproved, match="definite"):
        cholesky(matrix([[1.0, 2.0], [2.0, 1.0]]))
    assert 5 <= largest_eigenvalue(diagonal([arb(1), arb(5)])) < 5.00001


def kummer(**changes: object) -> Kummer:
    values = {
        "continuous": True, "bessel": False, "a": arb(0.5), "v0": arb(0.1), "half": arb(0.5), "start": arb(0),
        "slopes": [arb(-0.5)] * 4, "sigmas": [arb(0.3)] * 4, "lengths": [arb(1.25)] * 4, "radii": [arb(1.3)] * 4,
    }  # fmt: skip
    return Kummer(**(values | changes))


@pytest.mark.parametrize("a", [0.0, 1e-9, 0.5, 20.0])
def test_thm_k2_agrees_with_the_prover(a: float) -> None:
    from certbound.tubes.constants import Constants
    from certbound.tubes.kummer.exit import exit_level
    from certbound.tubes.objective import read_clearance
    from certbound.tubes.schedule import make_schedule

    schedule = make_schedule(Constants(rate=-0.5, sigma=0.3, dimension=1), 5.0)
    level = exit_level(schedule, read_clearance(1.3, 5.0), a=a, v0=0.1 / schedule.unit**2)
    found = exit_probability(kummer(a=arb(a)), Budget(10))
    assert abs(float(found.log() / arb(10).log()) - level) < 0.01


@pytest.mark.parametrize("bessel", [False, True])
@pytest.mark.parametrize("continuous", [False, True])
def test_thm_k2_is_monotone(bessel: bool, continuous: bool) -> None:
    form = {"bessel": bessel, "continuous": continuous, "a": arb(2), "v0": arb(0.3), "lengths": [arb(0.5)] * 4}
    if not continuous:
        form |= {"lengths": [arb(1)] * 4, "radii": [None] + [arb(1.3)] * 4, "slopes": [arb(0.9)] * 4}
    base = exit_probability(kummer(**form), Budget(10))
    assert 0 < base < 1
    for worse in ({"sigmas": [arb(0.31)] * 4}, {"start": arb(0.05)}):
        assert exit_probability(kummer(**(form | worse)), Budget(10)) > base
    tight = [None if r is None else r * 0.9 for r in (form.get("radii") or [arb(1.3)] * 4)]
    assert exit_probability(kummer(**(form | {"radii": tight})), Budget(10)) > base


def test_thm_k2_at_the_edges() -> None:
    assert exit_probability(kummer(radii=[None] * 4), Budget(10)) == 0
    assert exit_probability(kummer(radii=[arb(0)] * 4), Budget(10)) == 1
    with pytest.raises(Unproved, match="random start"):
        exit_probability(kummer(start=arb(5)), Budget(10))


def test_a_budget_ends_the_work() -> None:
    budget = Budget(-1.0)
    with pytest.raises(Unproved, match="limit"):
        budget.check()
    with pytest.raises(Unproved, match="sub-boxes"):
        Budget(10, boxes=0).box()


def test_bounded_noise_never_exceeds_what_all_of_it_does_at_most():
    """Z+ = Z/2 + w with |w| <= 1: |Z| <= 0, 1, 1.5, 1.75 at steps 0 to 3."""
    half = [arb_mat([[arb(0.5)]])] * 3
    drives = bounded_drives(half, arb_mat([[arb(1)]]), [arb(1)], Budget(10))
    proxies = [arb_mat([[arb(v)]]) for v in (0, 1, 1.25, 1.3125)]
    rows = [[arb(1)]] * 4
    levels = [arb(0), arb(1) + arb(2) ** -40, arb(1.5) + arb(2) ** -40, arb(1.75) + arb(2) ** -40]
    assert sub_gaussian(rows, levels, proxies, Budget(10), drives) == 0
    short = [*levels[:3], arb(1.74)]
    exact = (-arb(1.74) ** 2 / (2 * arb(1.3125))).exp()
    assert abs(sub_gaussian(rows, short, proxies, Budget(10), drives) - exact) < 1e-12
    assert sub_gaussian(rows, levels, proxies, Budget(10)) > exact
    assert not sub_gaussian(rows, [arb.nan()] * 4, proxies, Budget(10), drives) < 1


def test_too_many_steps_of_bounded_noise_are_not_kept():
    steps = [arb_mat([[arb(0.5)]])] * 1500
    assert MOST_ENTRIES < 1500 * 1501 // 2
    assert bounded_drives(steps, arb_mat([[arb(1)]]), [arb(1)], Budget(10)) is None
