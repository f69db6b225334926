"""No division of a probability spends more than there is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from certbound.reach.linear.shares import Share


@pytest.mark.parametrize("terms", [1, 2])
@pytest.mark.parametrize("rows", [0, 1, 2, 7, 400])
def test_all_sides_of_all_rows_and_what_they_have_in_common_cost_the_whole_at_most(rows: int, terms: int) -> None:
    whole = Share.of(1e-3)
    sides = 2 * terms * rows * math.exp(whole.side(rows, terms=terms).log)
    assert sides + math.exp(whole.common(rows).log) <= 1e-3 * (1 + 1e-12)


@pytest.mark.parametrize("probability", [0.3, 1e-3, 1e-290])
def test_two_halves_are_no_more_than_the_whole(probability: float) -> None:
    whole = Share.of(probability)
    assert whole.half().log <= whole.log - np.log(2.0) + 2.0**-53 * abs(whole.log)  # the rounding of one sum
    assert math.exp(whole.half().log) == pytest.approx(probability / 2)


def test_shares_of_one_size_are_one_share() -> None:
    assert {Share(-4.0): 1}[Share(-4.0)] == 1
    assert Share.of(1e-3).part(0.5) != Share.of(1e-3)
