"""Upper bounds of random problems in the plane, in space and beyond lie above what simulation finds."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.errors import EnclosureError, InfeasibleError
from tests.values.random_systems import KINDS, bounds, check, steps, worst_frequency


def test_a_bound_that_is_too_small_would_be_seen() -> None:
    problem = steps(np.random.default_rng([4, 10 + KINDS.index("steps")]))
    low, high = worst_frequency(problem, 20_000, np.random.default_rng(0))
    lower, upper = bounds("steps", problem, 0.1)
    assert 0 < lower <= upper
    assert 0.6 * upper < low < upper
    assert low < high


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(5))
def test_random_systems_fail_no_more_often_than_bounded(kind: str, seed: int) -> None:
    try:
        assert check(kind, seed, paths=40_000)[0] == ""
    except (InfeasibleError, EnclosureError) as error:
        pytest.skip(str(error))
