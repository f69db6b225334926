"""Obstacles along the coordinates: what is paid for passing them within a step, against simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import ndtr

import certbound as cb
from certbound.rigor.intervals import Interval
from certbound.values.semilagrangian import leaving
from certbound.values.semilagrangian.backward import back
from certbound.values.semilagrangian.groundwork import layouts_of
from certbound.values.semilagrangian.local_steps import Plan
from certbound.values.semilagrangian.noisy_axis import setting_of
from certbound.values.semilagrangian.obstacles.passings import meeting, passed, passing


def test_one_step_counts_who_meets_an_obstacle_and_ends_beside_it() -> None:
    """p falls, q is driven up: past the right upper corner of a box, in below it and out above it in one step."""
    s, count, parts = 0.1, 3000, 60
    system = cb.ContinuousSystem(lambda x: [x[1], 0.7 - 0.5 * x[0] - x[1] - 0.75], states=2, diffusion=[[0.0], [s]])
    safe = [cb.Outside(cb.Box([-0.6, -1.2], [0.0, -0.75])), cb.Inside(cb.Box([-0.4, -1.15], [0.2, -0.35]))]
    setting = setting_of(cb.Problem(system, initial=[0.1, -0.6], safe=safe, horizon=0.1))
    layout = next(layouts_of(setting, Plan(count=1, fine=3.0, wide=0.05, cell=0.35, spare=1e-6)))
    value = back(layout.frame, layout.bands, layout.above, leaving.terminal(layout, layout.above))
    under = back(layout.frame, layout.bands, layout.below, leaving.terminal(layout, layout.below))
    y, q, h, rng = layout.frame.y, layout.frame.q, layout.clock.step, np.random.default_rng(3)
    ratios, caught = [], []
    for p, height in ((0.05, -0.02), (0.05, -0.05), (0.02, 0.01), (0.03, 0.0), (-0.2, 0.02)):
        x, v, met = np.full(count, p), np.full(count, height - 0.75), np.zeros(count, dtype=bool)
        for _ in range(parts):
            kick = s * math.sqrt(h / parts) * rng.standard_normal(count)
            x, v = x + h / parts * (v + kick / 2), v + h / parts * (0.7 - 0.5 * x - v - 0.75) + kick
            met |= (x <= 0) & (v <= -0.75) & (v >= -1.2)
        seen = met.mean()
        place = p - layout.clock.shear * (height - 0.75)
        i, j = np.searchsorted(y, place) - 1, np.searchsorted(q, height - 0.75 + 1e-12, side="right") - 1
        share, part = (place - y[i]) / (y[i + 1] - y[i]), (height - 0.75 - q[j]) / (q[j + 1] - q[j])
        weights = np.outer([1 - share, share], [1 - part, part])
        bow = (q[j + 1] - q[j]) ** 2 * part * (1 - part) / 2
        found, least = (
            float((weights * one.nodal[i : i + 2, j : j + 2]).sum() + one.bend[i : i + 2, j] @ [1 - share, share] * bow)
            for one in (value, under)
        )
        assert -least - 4 * math.sqrt(seen * (1 - seen) / count) <= seen
        assert found >= seen - 4 * math.sqrt(seen * (1 - seen) / count)
        ratios.append(found / seen)
        caught.append(max(catch.chance[0, i, j] for catch in layout.below.catches))
        assert caught[-1] <= seen + 4 * math.sqrt(seen * (1 - seen) / count)
    assert max(ratios) < 2.8  # 2 is what walls of other shapes count at least, all around
    assert np.median(ratios) < 1.9  # half a cell more on either side: 2.1
    assert max(caught) > 0.05


@pytest.mark.parametrize(("push", "pull"), [(0.7, 0.0), (0.7, 1.5), (-0.3, 0.4), (0.5, -2.0)])
def test_who_is_driven_away_meets_an_end_at_most_as_often_as_is_said(push: float, pull: float) -> None:
    s, step, top, count, parts = 0.1, 0.1, 0.3, 4000, 400
    y, chance = meeting(push, pull, top, s, step)
    assert np.all(np.diff(chance) < 0)
    assert chance[-1] == 0
    if pull == 0:
        root = s * math.sqrt(step)
        exact = ndtr(-(y + push * step) / root) + np.exp(-2 * push * y / s**2) * ndtr((push * step - y) / root)
        assert np.all(chance[:-1] >= exact[:-1])
        assert chance[20] < 1.2 * exact[20]
        return
    rng, k = np.random.default_rng(4), 8
    z, least = np.full(count, y[k]), np.full(count, y[k])
    for _ in range(parts):
        z = z + step / parts * (push - pull * z) + s * math.sqrt(step / parts) * rng.standard_normal(count)
        least = np.minimum(least, z)
    seen = (least <= 0).mean()
    assert seen - 4 * math.sqrt(seen / count) <= chance[k] < 1.6 * seen + 0.1


def test_who_may_come_in_time_counts_although_most_do_not() -> None:
    """Most end below the obstacle's end without having reached it: nothing is taken off for them."""
    tape = cb.ContinuousSystem(lambda x: [x[1], 0 * x[0]], states=2, diffusion=[[0.0], [0.1]])
    problem = cb.Problem(tape, initial=[0, 0], safe=[cb.Inside(cb.Box([-9, -9], [9, 9]))], horizon=1)
    ends, point = ((-5.0, 0.0), (-8.0, 0.0)), np.zeros(1)
    tube = Interval(point - 0.2, point + 0.2), Interval(point - 1.5, point - 0.5)
    found = passing(ends, setting_of(problem).tape, tube, Interval.point(point + 0.12), point == 0, 1)
    assert found.stays[0]
    low, step = point - 1.0, 0.1
    free = Interval.point(np.full(1, -1.0)), Interval.point(np.array(0.01 * step)), 0.1, step
    far, near = (
        passed(found, 0, low, point, (point + away, point - 5), Interval.point(point - 1.0), *free)[0]
        for away in (0.12, 0.09)
    )
    assert 1e-300 < far < 1e-3  # .12 away at the speed 1: nearly none, but not none
    assert near < 1e-8  # who comes there ends within
    assert passed(found, 0, low, point, (point + 0.2, point - 5), Interval.point(point - 1.0), *free)[0] < 1e-290
