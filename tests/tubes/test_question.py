"""A question is read and checked once, and every method answers about exactly what was asked."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.tubes.constants import Constants
from certbound.tubes.question import Question, Start
from certbound.tubes.tuning import METHODS, tune_tube

ROUGH = Constants(gain=0.9, sigma=0.3, dimension=3, effective_dimension=1.5)


def test_the_schedule_is_cut_where_the_clearance_changes() -> None:
    constants = Constants(rate=-0.5, sigma=0.3, dimension=1)
    question = Question.of(constants, 4.0, clearance=((0.0, 1.5, 4.0), (1.0, 2.0)))
    assert question.schedule.times.tolist() == [0.0, 4.0]
    assert question.cut.times.tolist() == [0.0, 1.5, 4.0]
    assert question.clearance.values.tolist() == [1.0, 2.0]


def test_full_dimension_is_taken_only_where_a_power_would_not_be_valid() -> None:
    question = Question.of(ROUGH, 5)
    assert question.with_any_power().schedule.nu == 3.0
    assert question.constants.nu == question.schedule.nu == 1.5
    gaussian = Question.of(Constants(gain=0.9, sigma=0.3, dimension=3, effective_dimension=1.5, gaussian=True), 5)
    assert gaussian.with_any_power() is gaussian


def test_a_random_start_needs_the_full_dimension() -> None:
    assert Question.of(ROUGH, 5, start=Start(offset=0.2)).moving
    with pytest.raises(ValueError, match="a random `start` is isotropic and needs nu = n = 3"):
        Question.of(ROUGH, 5, start=Start(sigma=0.1))


@pytest.mark.parametrize("method", [name for name in METHODS if name not in ("auto", "mixture", "exact", "worst_case")])
def test_a_tube_states_what_was_asked(method: str) -> None:
    asked = ([0.0, 2.0, 4.0], [1.0, 2.0])
    known = {"rate": -0.5} if not method.startswith(("prop2", "prop3", "thm4", "thm5")) else {"gain": 0.6}
    constants = Constants(**known, sigma=0.3, dimension=1)
    tube = tune_tube(constants, horizon=4, delta=1e-2, objective=asked, method=method)
    assert (tube.method, tube.delta, tube.horizon, tube.objective) == (method, 1e-2, 4.0, asked)
    assert tube.constants is constants
    assert np.isfinite(tube.maximum)


def test_constants_know_their_metric_and_prove_its_root_once() -> None:
    metric = [[2.0, 0.3], [0.3, 1.0]]
    weighted = Constants(rate=[-0.5, 0.2], sigma=0.1, dimension=2, metric=metric, times=[0, 1, 2])
    assert weighted.worst_slope == 0.2
    assert np.allclose(weighted.inverse @ metric, np.eye(2))
    assert weighted.norm is weighted.norm
    assert np.array_equal(weighted.norm.matrix, weighted.matrix)
    plain = Constants(gain=0.5, sigma=0.1, dimension=2)
    assert plain.slope == plain.worst_slope == 0.5
    assert plain.norm.root is None
    assert np.array_equal(plain.matrix, np.eye(2))
