"""Cells are halved only where they must be, their answers are joined, and out of reach is noticed early."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.errors import EngineError
from certbound.reach.linear import SplitAnswer, bisection
from certbound.reach.linear.answer import linear_answer
from certbound.watch import OutOfTime


def flattening(reach: float = 0.9, std: float = 0.02, delta: float = 1e-3) -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: 1.3 * x - 0.6 * x**3, states=1, noise=cb.Gaussian(std=std))
    safe = [cb.Inside(cb.Box([-1.05], [1.05]))]
    return cb.Problem(system, initial=cb.Box([-reach], [reach]), safe=safe, horizon=4, delta=delta)


def beside(width: float) -> cb.Problem:
    """Only the first state is bent; the second one drifts along."""
    system = cb.DiscreteSystem(
        lambda x: [1.3 * x[0] - 0.6 * x[0] ** 3, 0.9 * x[1]], states=2, noise=cb.Gaussian(std=0.02)
    )
    safe = [cb.Inside(cb.Box([-1.05, -1], [1.05, 1]))]
    return cb.Problem(system, initial=cb.Box([-0.9, -width], [0.9, width]), safe=safe, horizon=4, delta=1e-3)


@pytest.fixture(scope="module")
def split() -> SplitAnswer:
    found = linear_answer(flattening())
    assert isinstance(found, SplitAnswer)
    return found


def test_unequal_cells_cover_the_starts_and_meet_the_target(split: SplitAnswer) -> None:
    assert split.log10_delta <= -3
    order = np.argsort(split.low[:, 0])
    low, high = split.low[order, 0], split.high[order, 0]
    assert (low[0], high[-1]) == (-0.9, 0.9)
    np.testing.assert_array_equal(low[1:], high[:-1])
    assert len({round(width, 9) for width in high - low}) > 1
    assert split.outcome.log_probability == max(part.outcome.log_probability for part in split.parts)


def test_a_cell_that_was_lost_on_the_way_is_missed(split: SplitAnswer) -> None:
    cells = list(zip(split.paths, split.low, split.high, split.parts))
    assert SplitAnswer.of(cells).outcome is split.outcome
    path, *rest = cells[0]
    other = ((1 - path[-1][0], path[-1][1]),)  # the same half of the other side
    for wrong in (cells[1:], [*cells[1:], cells[1]], [((*path[:-1], *other), *rest), *cells[1:]], []):
        with pytest.raises(EngineError, match="do not cover"):
            SplitAnswer.of(wrong)


def test_less_is_proved_than_on_one_cell_and_than_on_as_many_equal_ones(split: SplitAnswer) -> None:
    problem = flattening()
    assert linear_answer(problem, cells=1).log10_delta > -3
    assert linear_answer(problem, cells=len(split.parts) // 3).log10_delta > split.log10_delta


def test_the_tubes_of_all_cells_are_joined(split: SplitAnswer) -> None:
    tube, reach = split.tube, split.noise_free_reach
    assert tube is not None
    assert reach is not None
    for part in split.parts:
        assert part.tube is not None
        assert np.all(tube.half_widths >= part.tube.half_widths)
        assert tube.log10_delta >= part.tube.log10_delta
    x = np.linspace(-0.9, 0.9, 41)
    for step in range(5):
        assert all(reach.contains(float(step), [value]) for value in x)
        x = 1.3 * x - 0.6 * x**3
    assert np.all(split.extent_along([1.0]) >= split.parts[0].extent_along([1.0]))
    assert split.engine.cells == len(split.parts)
    assert split.margin >= 0


def test_the_side_that_makes_the_deviation_is_halved() -> None:
    found = linear_answer(beside(0.001))
    assert isinstance(found, SplitAnswer)
    assert {side for path in found.paths for side, _ in path} == {0}


def test_in_few_states_cells_come_when_it_is_asked_again_but_not_in_haste(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, asked = flattening(), []

    def in_vain(*_: object) -> None:
        asked.append(1)

    monkeypatch.setattr(bisection.Bisection, "proved", in_vain)
    first = linear_answer(problem, thorough=False)
    linear_answer(problem, thorough=False, quick=True, before=first)
    assert not asked
    for _ in range(2):  # and not a second time
        linear_answer(problem, thorough=False, before=first)
    assert len(asked) == 1


def test_where_one_start_is_out_of_reach_nothing_is_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    original = bisection.run_of

    def counted(*args: Any, **options: Any) -> Any:
        made.append(options["cells"])
        return original(*args, **options)

    monkeypatch.setattr(bisection, "run_of", counted)
    assert linear_answer(flattening(std=0.2)).log10_delta > -3
    assert len(made) == 1


def test_what_time_ended_goes_on_where_it_was(monkeypatch: pytest.MonkeyPatch, split: SplitAnswer) -> None:
    original, seen, ended = bisection._look, [], []

    def look(*args: Any) -> Any:
        if args[-1]:
            seen.append(args[3].path)
        if len(seen) == 4 and not ended:
            ended.append(seen[-1])
            raise OutOfTime
        return original(*args)

    first = linear_answer(flattening(), thorough=False)
    monkeypatch.setattr(bisection, "_look", look)
    with pytest.raises(OutOfTime):
        linear_answer(flattening(), before=first)
    found = linear_answer(flattening(), before=first)
    assert isinstance(found, SplitAnswer)
    assert [path for path in set(seen) if seen.count(path) > 1] == ended
    assert (found.paths, found.log10_delta) == (split.paths, split.log10_delta)


def test_a_smaller_set_of_starts_is_never_worse(split: SplitAnswer) -> None:
    assert linear_answer(flattening(reach=0.6)).log10_delta <= -3


def square(reach: float, std: float) -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: 0.9 * x + 0.1 * x**2, states=1, noise=cb.Gaussian(std=std))
    safe = [cb.Inside(cb.Box([-1.05], [1.05]))]
    return cb.Problem(system, initial=cb.Box([-reach], [reach]), safe=safe, horizon=6, delta=1e-3)


def test_what_meets_the_target_is_halved_where_that_gives_clearly_less(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = square(0.7, 0.015)
    whole, found = linear_answer(problem, cells=1), linear_answer(problem, thorough=False)
    assert isinstance(found, SplitAnswer)
    assert found.log10_delta < 1.25 * whole.log10_delta
    assert (found.low.min(), found.high.max()) == (-0.7, 0.7)
    monkeypatch.setattr(bisection, "_look", None)
    assert linear_answer(problem, thorough=False, quick=True).log10_delta == whole.log10_delta
    assert linear_answer(square(0.3, 0.015), thorough=False).log10_delta < -30


def test_a_cell_is_hopeless_beyond_the_grid_that_may_be_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    original = bisection._look

    def look(*args: Any) -> Any:
        seen.append(len(args[3].path))
        return original(*args)

    monkeypatch.setattr(bisection, "_look", look)
    monkeypatch.setattr(bisection, "_BEYOND", -11)  # of 6 steps the grid has 2**12 cells at most
    assert linear_answer(flattening()).log10_delta > -3
    assert max(seen) == 1


def test_a_grid_that_is_asked_for_is_kept() -> None:
    found = linear_answer(flattening(), cells=8)
    assert not isinstance(found, SplitAnswer)
    assert found.run.engine.cells == 8
