"""Obstacles along the coordinates: what is paid for passing them within a step, against simulation."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

import certbound as cb
from certbound.rigor.intervals import Interval
from certbound.values.semilagrangian import leaving
from certbound.values.semilagrangian.backward import back
from certbound.values.semilagrangian.groundwork import layouts_of
from certbound.values.semilagrangian.local_steps import Plan
from certbound.values.semilagrangian.noisy_axis import setting_of
from certbound.values.semilagrangian.obstacles.passings import passed, passing
from certbound.values.semilagrangian.obstacles.reflections import Arrival, Motion, dipped


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
    (toll,), none, falling = layout.above.tolls, np.zeros(len(q)), np.clip(1 - (q + 0.75) / 0.03, 0.0, 1.0)
    owed = [
        toll.due(np.tile(row, (len(y), 1)), np.zeros((len(y), len(q) - 1)), np.diff(q)) for row in (none, falling)
    ]  # fmt: skip
    assert np.all(owed[0][0] >= toll.nodal[0])
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

        def weighted(nodal: np.ndarray, i: int = i, j: int = j, weights: np.ndarray = weights) -> float:
            return float((weights * nodal[i : i + 2, j : j + 2]).sum())

        found, least = (
            float((weights * one.nodal[i : i + 2, j : j + 2]).sum() + one.bend[i : i + 2, j] @ [1 - share, share] * bow)
            for one in (value, under)
        )
        assert -least - 4 * math.sqrt(seen * (1 - seen) / count) <= seen
        assert found >= seen - 4 * math.sqrt(seen * (1 - seen) / count)
        ratios.append(found / seen)
        caught.append(max(weighted(catch.nodal[0]) - catch.lacks[0, i, j] for catch in layout.below.catches))
        assert caught[-1] <= seen + 4 * math.sqrt(seen * (1 - seen) / count)
        counted = [np.where(met & (v > -0.75), 1 - np.interp(v, q, row), 0.0) for row in (none, falling)]
        for part, (paid, lacks) in zip(counted, owed):
            assert weighted(paid) + lacks[i, j] >= part.mean() - 4 * part.std() / math.sqrt(count)
        assert weighted(owed[1][0]) < 0.985 * weighted(owed[0][0])
    assert max(ratios) < 2.8  # 2 is what walls of other shapes count at least, all around
    assert np.median(ratios) < 1.9  # half a cell more on either side: 2.1
    assert max(caught) > 0.05


@pytest.mark.parametrize(("pull", "rate", "start", "lean"), [
    (1.0, 0.8, -0.02, 1.0), (0.0, 0.0, 0.01, 1.0), (-2.0, -3.0, 0.004, -1.0), (3.0, 2.0, 0.03, 0.5),
])  # fmt: skip
def test_who_dips_below_an_end_and_ends_above_it_is_bounded_from_both_sides(
    pull: float, rate: float, start: float, lean: float
) -> None:
    """Against simulated paths, whose lowest points are corrected for what they do between their times."""
    s, h, count, parts, drift, t = 0.1, 0.08, 20_000, 400, 0.7, 0.05
    rng, above = np.random.default_rng(5), np.array([0.0, 0.005, 0.02])
    step, place = h / parts, round(t / h * parts)
    z, noise, low, mixed = np.full(count, start), np.zeros(count), np.full(count, np.inf), np.zeros(count)
    for i in range(parts):
        kick = math.sqrt(step) * rng.standard_normal(count)
        z = z + step * (drift + rate * i * step - pull * z) + s * kick
        noise += math.exp(pull * (i + 0.5) * step) * kick
        if i + 1 == place:
            tau = t if pull == 0 else math.expm1(2 * pull * t) / (2 * pull)
            mixed, before = lean * noise / math.sqrt(tau) + 0.6 * rng.standard_normal(count), z.copy()
        if i + 1 >= place:
            low = np.minimum(low, z)
    one = np.ones(1)
    motion = Motion(
        start=Interval.point(start * one), drift=Interval.point(drift * one), rate=Interval.point(rate * one),
        pull=pull, s=s, step=h,
    )  # fmt: skip
    met = low <= 0.5826 * s * math.sqrt(step)
    for gap, upper in itertools.product((-1.5, -0.5), (False, True)):
        gap = -gap if upper else gap
        arrival = Arrival(t=t * one, gap=gap * one, lean=lean * one, loose=0.6 * one)
        late = mixed + gap > 0
        found = dipped(motion, arrival, above, upper=upper)[:, 0]
        for bound, height in zip(found, above):
            kept = met & (z > height)
            seen = kept.mean() + (~late & (before > 0)).mean() if upper else (kept & ~late).mean()
            error = 4 * math.sqrt(max(seen * (1 - seen), 1e-4) / count) + 1e-4
            assert (bound >= seen - error) if upper else (bound <= seen + error)
            assert abs(bound - seen) < 0.1 * seen + error + 0.02
    never = Arrival(t=t * one, gap=-np.inf * one, lean=0 * one, loose=0 * one), Arrival(
        t=t * one, gap=np.inf * one, lean=0 * one, loose=0 * one
    )
    pair = [float(dipped(motion, never[upper], above[1:2], upper=bool(upper))[0, 0]) for upper in (0, 1)]
    seen = (met & (z > above[1])).mean()
    assert pair[0] <= pair[1] < (1.04 if abs(pull) < 2 else 1.3) * pair[0] + 2e-3
    assert abs(pair[1] - seen) < 0.03 * seen + 4 * math.sqrt(seen / count) + 1e-3


def test_who_comes_just_before_the_end_of_a_step_is_not_told_from_who_comes_in_time() -> None:
    one, h = np.ones(1), 0.08
    motion = Motion(start=Interval.point(one), drift=Interval.point(one), rate=Interval.point(0 * one), pull=0.0, s=0.1,
                    step=h)  # fmt: skip
    never = Arrival(t=h * (1 - 1e-8) * one, gap=np.inf * one, lean=0 * one, loose=0 * one)
    above, below = (dipped(motion, never, np.zeros(1), upper=upper)[0, 0] for upper in (True, False))
    assert (above, below) == (1.0, 0.0)


def test_who_may_come_in_time_counts_although_most_do_not() -> None:
    """Most end below the obstacle's end without having reached it: nothing is taken off for them."""
    tape = cb.ContinuousSystem(lambda x: [x[1], 0 * x[0]], states=2, diffusion=[[0.0], [0.1]])
    problem = cb.Problem(tape, initial=[0, 0], safe=[cb.Inside(cb.Box([-9, -9], [9, 9]))], horizon=1)
    ends, point = ((-5.0, 0.0), (-8.0, 0.0)), np.zeros(1)
    tube = Interval(point - 0.2, point + 0.2), Interval(point - 1.5, point - 0.5)
    found = passing(ends, setting_of(problem).tape, tube, Interval.point(point + 0.12), point == 0, 1, 9.0)
    assert found.stays[0]
    low, drift, step = Interval.point(point - 1.0), Interval.point(point), 0.1
    free = Interval.point(np.full(1, -1.0)), Interval.point(np.array(0.01 * step)), np.array([0.01]), 0.1, step
    far, near = (
        passed(found, 0, low, drift, (point + away, point - 5), Interval.point(point - 1.0), *free)[0, 0]
        for away in (0.12, 0.09)
    )
    assert 1e-300 < far < 1e-3  # .12 away at the speed 1: nearly none, but not none
    assert near < 1e-8  # who comes late ends within
    assert passed(found, 0, low, drift, (point + 0.2, point - 5), Interval.point(point - 1.0), *free)[0, 0] < 1e-17
