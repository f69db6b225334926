"""Cells that paths do not come to are not stepped: what is left out counts against the bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import certbound as cb
from certbound.values.scouting import reached
from certbound.values.semilagrangian import backward, leaving
from certbound.values.semilagrangian.backward import back
from certbound.values.semilagrangian.bands import narrowed, through
from certbound.values.semilagrangian.groundwork import layouts_of
from certbound.values.semilagrangian.local_steps import Plan
from certbound.values.semilagrangian.noisy_axis import Setting, setting_of

PLAN = Plan(count=12, fine=1.5, wide=0.02, cell=0.4, spare=1e-12)


def setting() -> Setting:
    """A noisy oscillator in a box; from 0 a path leaves within 1 with probability .072."""
    system = cb.ContinuousSystem(lambda x: [x[1], -x[0] - x[1]], states=2, diffusion=[[0.0], [1.0]])
    safe = [cb.Inside(cb.Box([-1, -1.5], [1, 1.5]))]
    return setting_of(cb.Problem(system, initial=[0, 0], safe=safe, horizon=1))


@pytest.fixture(scope="module")
def layout() -> backward.Layout:
    return next(layouts_of(setting(), PLAN))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def bounds_on(layout: backward.Layout, chosen) -> tuple[float, float]:
    """Bounds from steps on cells that ``chosen`` picks, step by step, from p and q in their middles."""
    y, q = ((axis[1:] + axis[:-1]) / 2 for axis in (layout.frame.y, layout.frame.q))
    p = y[:, None] + layout.clock.shear * q
    steps = [layout.only(chosen(k, p, np.broadcast_to(q, p.shape))) for k in reversed(range(PLAN.count))]
    values = [leaving.terminal(layout, side) for side in (layout.above, layout.below)]
    for one in steps:
        values = [back(one.frame, one.bands, side, v) for side, v in zip((one.above, one.below), values)]
    places = setting().some_starts()
    return (
        backward.highest(layout.frame, values[0], setting(), layout.clock.shear),
        -backward.lowest(layout.frame, values[1], places, layout.clock.shear),
    )


def test_what_is_left_out_counts_as_failing_above_and_as_not_failing_below(layout) -> None:
    upper, lower = bounds_on(layout, lambda k, p, q: np.ones(p.shape, dtype=bool))
    assert 0.03 < lower < 0.072 < upper < 0.11  # simulated .072; with who comes to q > .5 (from 10/12 on) .51 (.29)
    above, below = bounds_on(layout, lambda k, p, q: q < 0.5)
    assert above > 0.51
    assert 0 < below < 0.034  # simulated without who comes there
    late, early = bounds_on(layout, lambda k, p, q: (q < 0.5) | (k < 10)), bounds_on(layout, lambda k, p, q: k > 0)
    assert 0.29 < late[0] < above
    assert below < late[1] < 0.063
    assert early[0] >= 1
    assert early[1] <= 0


def test_cells_drawn_at_random_only_cost_tightness(layout, rng) -> None:
    upper, lower = bounds_on(layout, lambda k, p, q: np.ones(p.shape, dtype=bool))
    above, below = bounds_on(layout, lambda k, p, q: rng.random(p.shape) < 0.9)
    assert above >= upper
    assert below <= lower


def test_a_band_without_what_is_not_needed_does_the_same(layout, rng) -> None:
    frame = layout.frame
    shape = frame.y.size, frame.q.size
    nodal, bend = rng.uniform(0, 1, shape), rng.uniform(-20, 20, (shape[0], shape[1] - 1))
    value, slopes = backward.Lines(nodal=nodal, bend=bend), tuple(rng.uniform(0, 1, (2, shape[0] - 1, shape[1] - 1)))
    for band in layout.bands:
        i, j = (np.arange(size)[band.live.any(axis=axis)] for size, axis in zip(band.live.shape, (1, 0)))
        cells = np.zeros_like(frame.live)
        cells[band.first + i[len(i) // 3] : band.first + i[len(i) // 2], j[len(j) // 3] : j[len(j) // 2]] = True
        part = narrowed(band, replace(frame, live=frame.live & cells))
        assert part is not None
        assert part.rows.stop - part.rows.start < (band.rows.stop - band.rows.start) / 1.5
        assert part.nodes.stop - part.nodes.start < frame.q.size / 1.5
        whole = through(band, frame, value, slopes)
        found = through(part, frame, value, slopes)
        first = part.first - band.first
        rows = slice(first, first + len(part.live))
        assert np.allclose(found[2][part.live], whole[2][rows][part.live], rtol=1e-9)
        alone = part.live[:-1, :-1] & part.live[1:, :-1] & part.live[:-1, 1:] & part.live[1:, 1:]  # around inner nodes
        assert alone.any()
        inner = slice(first + 1, first + len(part.live))
        assert np.allclose(found[0][1:-1, 1:-1][alone], whole[0][inner, 1:-1][alone], rtol=1e-9)


def test_paths_stay_near_what_is_reached(rng) -> None:
    one = setting()
    drift, broken = leaving._motion(one)
    found = reached(drift, one.noise, one.faces, one.starts, 0.05, 20, broken, overlooked=1e-6)
    assert found is not None
    axes, seen = found.axes, found.seen
    assert seen[0].mean() < 0.1
    assert seen[4].mean() < 0.7
    x = np.zeros((2, 20_000))
    for k in range(1, 6):
        x = x + 0.05 * drift(0.0, *x) + np.array([[0.0], [np.sqrt(0.05)]]) * rng.standard_normal(x.shape[1])
        place = [np.rint((part - axis[0]) / (axis[1] - axis[0])).astype(int) for part, axis in zip(x, axes)]
        inside = np.all([(i >= 0) & (i < len(axis)) for i, axis in zip(place, axes)], axis=0)
        assert seen[k][tuple(i[inside] for i in place)].all()
        x = x[:, inside]


def test_where_the_model_changes_with_time_what_steps_share_is_made_for_their_end_too(monkeypatch) -> None:
    system = cb.ContinuousSystem(
        lambda t, x: [x[1], -3 * x[0] - 0.3 * x[1] + 0.3 * np.cos(2 * t)], states=2, diffusion=[[0.0], [0.25]]
    )
    safe = [cb.Inside(cb.Box([-1, -2], [1, 2]))]
    one = setting_of(cb.Problem(system, initial=[0.6, 0], safe=safe, horizon=0.75))
    plan = replace(PLAN, count=5)
    scout = leaving.scout_of(one)
    upper, lower = leaving.bounds_by_steps(one, plan, scout=scout)
    monkeypatch.setattr(leaving, "_reached", lambda *asked: None)
    assert leaving.bounds_by_steps(one, plan, scout=scout) == pytest.approx((upper, lower), rel=0.01)
    assert upper < 1
