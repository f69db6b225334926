"""Branch and bound never returns less than the supremum, closes the gap where it can, and stops where it cannot."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.constants.enclosures.branching import bound_supremum, random_points, split_boxes
from certbound.rigor import intervals as iv
from certbound.rigor.intervals import Interval


def wavy(boxes: Interval) -> Interval:
    x, y = boxes[:, 0], boxes[:, 1]
    return iv.sin(3 * x) * iv.cos(2 * y) - 0.1 * iv.sq(x - y)


def bound(boxes: Interval, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    return wavy(boxes).hi, boxes.width


def value(points: np.ndarray) -> np.ndarray:
    x, y = points.T
    return np.sin(3 * x) * np.cos(2 * y) - 0.1 * (x - y) ** 2


def test_the_gap_closes_around_the_true_supremum():
    box = Interval([-2.0, -2.0], [2.0, 2.0])
    grid = np.stack(np.meshgrid(np.linspace(-2, 2, 801), np.linspace(-2, 2, 801)), axis=-1).reshape(-1, 2)
    truth = value(grid).max()
    found = bound_supremum(bound, value, box, tolerance=1e-3)
    assert found.sampled <= found.upper <= found.sampled + 1e-3
    assert found.upper >= truth
    assert found.sampled >= truth - 1e-3
    assert abs(value(found.point[None])[0] - found.sampled) < 1e-12


@pytest.mark.parametrize("budget", [1, 10, 300])
def test_a_small_budget_still_gives_an_upper_bound(budget):
    box = Interval([-2.0, -2.0], [2.0, 2.0])
    small = bound_supremum(bound, value, box, tolerance=1e-9, budget=budget)
    large = bound_supremum(bound, value, box, tolerance=1e-3)
    assert small.upper >= large.sampled
    assert small.boxes <= budget + 2 * 2048


def test_an_infinite_box_is_searched():
    found = bound_supremum(
        lambda b, _: ((1 / (1 + iv.sq(b[:, 0] - 3))).hi, b.width),
        lambda p: 1 / (1 + (p[:, 0] - 3) ** 2),
        Interval([-np.inf], [np.inf]),
        tolerance=1e-4,
    )
    assert 1.0 <= found.upper < 1.0002
    assert abs(found.point[0] - 3) < 0.1


def test_an_unbounded_function_gives_infinity_and_the_box_where():
    found = bound_supremum(
        lambda b, _: ((1 / b[:, 0]).hi, b.width), lambda p: 1 / p[:, 0], Interval([-1.0], [1.0]), tolerance=0.1
    )
    assert found.upper == np.inf
    assert found.worst.contains(np.zeros(1)).all()
    assert found.worst.width[0] < 1e-6


def test_a_point_box_and_an_empty_set_of_coordinates_need_one_evaluation():
    point = bound_supremum(bound, value, Interval([0.5, 0.5], [0.5, 0.5]), tolerance=1e-6)
    assert point.boxes == 1
    assert point.upper >= value(np.array([[0.5, 0.5]]))[0]
    none = bound_supremum(
        lambda b, _: (np.full(len(b), 2.0), np.zeros((len(b), 0))),
        lambda p: np.full(len(p), 2.0),
        Interval(np.zeros(0), np.zeros(0)),
        tolerance=1e-6,
    )
    assert none.upper == 2.0


def test_known_ceilings_and_starting_boxes_are_used():
    box = Interval([-2.0, -2.0], [2.0, 2.0])
    assert bound_supremum(bound, value, box, tolerance=1e-9, budget=1, ceiling=1.0).upper == 1.0
    part = Interval([[0.0, -0.5]], [[1.0, 0.5]])
    assert bound_supremum(bound, value, box, tolerance=1e-3, starts=part).upper < 1.01


def test_halves_cover_the_box_and_random_points_stay_inside():
    boxes = Interval([[0.0, -np.inf], [1.0, 2.0]], [[4.0, np.inf], [1.0, 3.0]])
    halves = split_boxes(boxes, np.array([[1.0, 2.0], [5.0, 1.0]]))
    assert halves.lo[:, 1].tolist() == [-np.inf, 2.0, 0.0, 2.5]
    assert halves.hi[:, 1].tolist() == [0.0, 2.5, np.inf, 3.0]
    box = Interval([0.0, -np.inf, -np.inf, 3.0], [1.0, np.inf, 2.0, np.inf])
    points = random_points(np.random.default_rng(0), box, 400)
    assert box.contains(points).all()
    assert np.isfinite(points).all()


def test_boxes_that_are_ruled_out_do_not_end_the_search():
    def ruled(boxes, _):  # x + y on the circle of radius 1 alone, which hardly a point lies on
        size = iv.sq(boxes).sum(axis=-1)
        upper = boxes.hi.sum(axis=-1)
        return np.where((size.lo <= 1) & (size.hi >= 1), upper, -np.inf), boxes.rad

    def seen(points):
        on = np.abs((points**2).sum(axis=-1) - 1) < 1e-12
        return np.where(on, points.sum(axis=-1), np.nan)

    found = bound_supremum(ruled, seen, Interval([-1.3, -1.2], [1.1, 1.4]), tolerance=1e-3, budget=20_000)
    assert np.sqrt(2) <= found.upper < np.sqrt(2) + 0.02


def test_a_tolerance_must_be_positive():
    with pytest.raises(ValueError, match="`tolerance` must be positive"):
        bound_supremum(bound, value, Interval([0.0, 0.0], [1.0, 1.0]), tolerance=0.0)


def hump(boxes: Interval, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    x, y = boxes[:, 0], boxes[:, 1]
    return (x * (1.0 - x) - x * y + y * (1.0 - y)).hi, boxes.width


def height(points: np.ndarray) -> np.ndarray:
    x, y = points.T
    return x * (1 - x) - x * y + y * (1 - y)


def test_a_search_that_ran_out_of_its_budget_goes_on_where_it_stopped():
    box = Interval([-1.0, -1.0], [2.0, 2.0])  # largest at (1/3, 1/3): 1/3
    first = bound_supremum(hump, height, box, tolerance=1e-3, budget=200)
    assert first.upper > 1 / 3 + 0.1
    assert max(first.settled, hump(first.rest, -np.inf)[0].max()) == first.upper
    again = bound_supremum(hump, height, box, tolerance=1e-3, earlier=first)
    assert first.sampled <= again.sampled <= 1 / 3 + 1e-15
    assert 1 / 3 <= again.upper <= again.sampled + 1e-3
    assert again.boxes > first.boxes
    capped = bound_supremum(hump, height, box, tolerance=1e-3, budget=1, earlier=first, ceiling=0.34)
    assert capped.upper == 0.34
