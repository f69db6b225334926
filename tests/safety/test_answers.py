"""Comparing certified logarithms with a target."""

from __future__ import annotations

import math

import numpy as np
import pytest

from certbound.rigor.norms import Norm
from certbound.safety.answers import Deviation, EngineAnswer, is_at_most, settled, with_lower


@pytest.mark.parametrize("delta", [0.5, 1e-3, 0.002, 1e-12, 0.9999])
def test_comparison_is_decided_in_ball_arithmetic_and_floats_agree(delta):
    target = math.log10(delta)
    for value in (target - 1e-9, math.nextafter(target, -math.inf), target, math.nextafter(target, math.inf), 0.0):
        level = settled(value, delta)
        assert is_at_most(level, delta) == (level <= target)
        assert level <= 0
        if value <= target - 1e-9:
            assert level == value
            assert is_at_most(level, delta)
        if value > target:
            assert not is_at_most(level, delta)
            assert level > target


def test_levels_are_finite_and_at_most_zero():
    assert settled(-math.inf, 1e-3) == -1e12
    assert settled(3.0, 1e-3) == 0.0
    assert math.copysign(1.0, settled(-0.0, 1e-3)) == 1.0


def test_a_ball_gives_euclidean_size_and_extent_per_state():
    metric = np.diag([4.0, 0.25])
    deviation = Deviation.of_ball(np.array([0.0, 1.0, 2.0]), np.array([1.0, 3.0]), Norm(2, metric))
    assert deviation.radius == pytest.approx([2.0, 6.0], rel=1e-9)
    assert deviation.extent == pytest.approx(np.array([[0.5, 2.0], [1.5, 6.0]]), rel=1e-9)
    assert np.all(deviation.extent >= np.array([[0.5, 2.0], [1.5, 6.0]]))


def test_what_shows_a_lower_bound_is_said_once_and_after_the_upper_bound() -> None:
    kept = EngineAnswer(log10_lower=-2.0, reason="it breaks.")
    for number in range(3):
        kept = with_lower(EngineAnswer(log10_delta=-1.0, reason=f"bound {number}."), kept)
    assert kept.log10_lower == -2
    assert kept.reason == "bound 2; it breaks."
