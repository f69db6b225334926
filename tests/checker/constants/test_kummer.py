"""The scalars of Thm K2: lower bounds of the series for large arguments too."""

from __future__ import annotations

from pathlib import Path

import pytest
from flint import arb, ctx

import certbound as cb
from certbound.checker import check_data, parse
from certbound.checker.constants.kummer import Kummer, lower_excess, partial_excess
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.verification import verify_safety

BENCHMARKS = Path(__file__).resolve().parents[3] / "experiments" / "benchmarks"


def scalars(a: float, half: float, *, bessel: bool) -> Kummer:
    return Kummer(
        continuous=False, bessel=bessel, a=arb(a), v0=arb(1), half=arb(half), start=arb(0), slopes=[], sigmas=[],
        lengths=[], radii=[],
    )  # fmt: skip


@pytest.mark.parametrize("bessel", [False, True])
@pytest.mark.parametrize(
    ("a", "half", "z"), [(0.5, 1, 3), (3, 1, 50), (30, 0.5, 5e3), (2, 3, 1e6), (1e4, 1, 8e5), (1e5, 1, 1e7)]
)
def test_a_part_of_the_series_is_below_it_and_close(a: float, half: float, z: float, bessel: bool) -> None:
    data = scalars(a, half, bessel=bessel)
    with ctx.workprec(4000):
        series = (data.a * z).hypgeom_0f1(data.half) if bessel else arb(z).hypgeom_1f1(data.a, data.half)
        exact = ((series - 1) / data.a).log()
    assert exact.is_finite()
    for found in (partial_excess(data, arb(z)), lower_excess(data)(arb(z))):
        assert found.log() <= exact + arb(10) ** -25 * exact
        assert found.log() >= exact - 2


def test_the_limit_a_to_0_of_a_part_of_the_series() -> None:
    near = scalars(1e-12, 1.5, bessel=False)
    for z in (0.5, 40.0, 2e4):
        limit = partial_excess(scalars(0.0, 1.5, bessel=False), arb(z))
        assert abs(limit.log() - partial_excess(near, arb(z)).log()) < 1e-9


def test_a_probability_of_1e_minus_49000_is_proved_again() -> None:
    problem = cb.load(str(BENCHMARKS / "two_tanks.toml"))
    verdict = verify_safety(problem, method="constants")
    report = check_data(parse(certificate_text(problem, verdict)), problem_data(problem))
    assert report.valid, report.reason
    assert report.log10_delta < -49_000
