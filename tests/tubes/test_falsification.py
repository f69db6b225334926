"""No certified tube is left more often than it says: random systems and noises, a binomial test at 1e-6."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.falsification import CASES, binomial_level, draw_case, exits, tubes_of


def refuted(index, paths, *, slow=False, shrink=1.0):
    case = draw_case(index)
    tubes = tubes_of(case, slow=slow)
    radii = shrink * np.array([tube.radius(case.times) for tube in tubes]) * (1 + 1e-12)
    lost = exits(case, radii, paths, index)
    return [
        f"{case.label}: {tube.method} {count / paths:.4f}"
        for tube, count in zip(tubes, lost.tolist())
        if binomial_level(count, paths, case.delta) < 1e-6
    ]


@pytest.mark.parametrize("index", [pytest.param(2, marks=pytest.mark.slow), 6, 9])
def test_a_few_cases_hold(index):
    assert refuted(index, 4_000) == []


def test_radii_that_are_too_small_are_found_out():
    # a tenth less than what a nearly exact tube says
    assert refuted(2, 40_000, shrink=0.85) != []


@pytest.mark.slow
@pytest.mark.parametrize("index", range(CASES))
def test_no_case_is_refuted_by_a_million_paths(index):
    assert refuted(index, 1_000_000, slow=index % 4 in (1, 2)) == []
