"""What importance splitting does with its particles between two runs; here in Python, in the kernels compiled."""

import numpy as np
import pytest

from certbound.simulation.compiled import seed_stream
from certbound.simulation.compiled.particles import branch, hold, place, ranked, read_scores, survive

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("values", [RNG.normal(size=41), RNG.integers(0, 4, 40).astype(float), np.ones(7), np.zeros(1)])
def test_the_entry_of_a_rank_is_that_of_the_sorted_values(values):
    given = values.copy()
    assert [ranked.py_func(values, rank) for rank in range(len(values))] == sorted(values)
    np.testing.assert_array_equal(values, given)


def test_survivors_are_above_the_level_and_who_left_has_a_record_of_one():
    tops, scores, alive = np.array([[0.0, 0.2], [0.5, 1.0], [0.0, 0.7]]), np.empty(3), np.zeros(3, dtype=np.int64)
    assert read_scores.py_func(tops, scores) == 1
    assert scores.tolist() == [0.2, 1.0, 0.7]
    assert survive.py_func(scores, 0.2, alive) == 2
    assert alive[:2].tolist() == [1, 2]


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")  # 64-bit words wrap around
def test_a_branch_copies_its_parent_up_to_the_first_step_above_the_level(own):
    states, signals = RNG.normal(size=(2, 4, 3)), RNG.normal(size=(2, 1))
    frees = RNG.normal(size=(2 if own else 0, 4, 3))
    tops = np.array([[0.0, 0.0, 0.0, 0.0], [0.1, 0.3, 0.6, 0.9]])
    place.py_func(np.full((2, 3), 2.0), 0, states, frees)
    hold.py_func(tops, 0, 1, 0.2)
    assert states[0, 0].tolist() == [2.0] * 3
    assert tops[0].tolist() == [0.0, 0.2, 0.2, 0.2]
    assert branch.py_func(seed_stream(1, 0), np.array([1]), 1, 0.3, 0, signals, states, frees, tops) == 2
    for array in (signals, states[:, :3], frees[:, :3] if own else states[:, :3], tops[:, :3]):
        np.testing.assert_array_equal(array[0], array[1])
    assert tops[0, 3] == 0.2
    assert not np.array_equal(states[0, 3], states[1, 3])
