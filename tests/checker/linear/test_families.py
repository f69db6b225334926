"""Joining events: sums in general, products where the response is normal and the events are symmetric."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from flint import arb, arb_mat
from scipy.stats import multivariate_normal

import certbound as cb
from certbound.checker import check_data, parse
from certbound.checker.linear.events import chain
from certbound.checker.linear.families import Family, leaving
from certbound.checker.report import Budget, Unproved
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.verification import verify_safety


def contraction(states: int, horizon: int, **changes: object) -> cb.Problem:
    system = cb.DiscreteSystem(
        lambda x: 0.8 * x, states=states, noise=changes.pop("noise", cb.Gaussian(std=0.2))  # type: ignore[arg-type]
    )
    given = {"safe": [cb.Inside(cb.Box([-0.5] * states, [0.5] * states))], "delta": 0.01, **changes}
    return cb.Problem(system, initial=[0.0] * states, horizon=horizon, **given)  # type: ignore[arg-type]


def proved(problem: cb.Problem) -> tuple[float, float]:
    """Failure probabilities: claimed by the certificate, and proved by the checker."""
    verdict = replace(verify_safety(problem, method="linear"), status="UNKNOWN")  # else its lower bound is stated
    report = check_data(parse(certificate_text(problem, verdict)), problem_data(problem))
    assert report.valid, report.reason
    assert report.log10_proved is not None
    return 10**report.log10_delta, 10**report.log10_proved


@pytest.mark.parametrize(("horizon", "least"), [(1, 0.839), (2, 0.431)])
def test_a_contraction_in_14_dimensions_is_certified_as_the_prover_has_it(horizon: int, least: float) -> None:
    claimed, found = proved(contraction(14, horizon))
    assert 1 - claimed >= least
    law = multivariate_normal(cov=0.04 * np.array([[1.0, 0.8], [0.8, 1.64]])[:horizon, :horizon])
    exact = 1 - law.cdf([0.5] * horizon, lower_limit=[-0.5] * horizon) ** 14
    assert exact - 1e-6 <= found <= claimed < exact + 0.002


def test_dependent_states_are_joined_without_going_below_the_truth() -> None:
    """Requirements on x1 and on x1 + x2: the product lies between the truth and the sum."""
    faces = [[1.0, 0.0], [-1.0, 0.0], [1.0, 1.0], [-1.0, -1.0]]
    problem = contraction(2, 1, safe=[cb.Inside(cb.Polytope(faces, [0.3, 0.3, 0.4, 0.4]))])
    claimed, found = proved(problem)
    law = multivariate_normal(cov=0.04 * np.array([[1.0, 1.0], [1.0, 2.0]]))
    truth = 1 - law.cdf([0.3, 0.4], lower_limit=[-0.3, -0.4])
    single = [math.erfc(z / (s * 0.2 * math.sqrt(2))) for z, s in ((0.3, 1.0), (0.4, math.sqrt(2.0)))]
    assert truth <= found <= 1 - (1 - single[0]) * (1 - single[1]) + 1e-9
    assert found <= claimed < sum(single)


def test_what_has_no_partner_is_added() -> None:
    """x1 <= .3 alone, and |x2| <= .3: 1 - P(|x2| <= .3) + P(x1 > .3)."""
    problem = contraction(2, 1, safe=[cb.Inside(cb.Box([-np.inf, -0.3], [0.3, 0.3]))])
    _, found = proved(problem)
    tail = 0.5 * math.erfc(0.3 / (0.2 * math.sqrt(2)))
    assert found == pytest.approx(3 * tail, rel=1e-9)


def test_unequal_rooms_take_the_better_of_both_bounds() -> None:
    """A room of .15 and one of 2: the pair at the smaller room would be paid twice."""
    problem = contraction(1, 1, safe=[cb.Inside(cb.Box([-2.0], [0.15]))])
    _, found = proved(problem)
    assert found == pytest.approx(0.5 * math.erfc(0.15 / (0.2 * math.sqrt(2))), rel=1e-9)


@pytest.mark.parametrize("noise", [cb.SubGaussian(proxy_std=0.2), cb.Uniform(halfwidth=0.2 * math.sqrt(3))])
def test_other_laws_are_only_added(noise: object) -> None:
    problem = contraction(1, 1, noise=noise, safe=[cb.Inside(cb.Box([-0.34], [0.34]))])
    _, found = proved(problem)
    assert found == pytest.approx(2 * math.exp(-(0.34**2) / 0.08), rel=1e-9)


def test_noise_that_is_bounded_is_nowhere_beyond_its_bounds() -> None:
    assert proved(contraction(3, 1, noise=cb.Uniform(halfwidth=0.2 * math.sqrt(3))))[1] == 0


def events(values: list[float], *, normal: bool, opposite: bool = True) -> float:
    """Pairs of half-spaces along independent unit normal coordinates."""
    n = len(values)
    rows = [[arb(1 if i == j else 0) for j in range(n)] for i in range(n)]
    families = []
    for row, level in zip(rows, values):
        families.append(Family(label="up", rows=[row], levels=[arb(level)]))
        other = [-x for x in row] if opposite else row
        families.append(Family(label="down", rows=[other], levels=[arb(level)]))
    one = arb_mat(n, n, [x for row in rows for x in row])
    budget = Budget(60)
    return float(leaving(families, lambda f: chain(f.rows, f.levels, [], [one], budget), budget, normal=normal))


def test_only_exactly_opposite_rows_of_a_normal_response_are_multiplied() -> None:
    tails = [math.erfc(z / math.sqrt(2)) for z in (1.0, 1.5, 2.0)]
    product = 1 - math.prod(1 - tail for tail in tails)
    assert events([1.0, 1.5, 2.0], normal=True) == pytest.approx(product, rel=1e-9)
    assert events([1.0, 1.5, 2.0], normal=False) == pytest.approx(sum(tails), rel=1e-9)
    assert events([1.0, 1.5, 2.0], normal=True, opposite=False) == pytest.approx(sum(tails), rel=1e-9)


def test_a_family_that_leaves_nothing_is_named() -> None:
    family = Family(label="the wall", rows=[[arb(1)]], levels=[arb(-1)])
    with pytest.raises(Unproved, match="the wall"):
        leaving(
            [family], lambda f: chain(f.rows, f.levels, [], [arb_mat(1, 1, [1])], Budget(60)), Budget(60), normal=True
        )
