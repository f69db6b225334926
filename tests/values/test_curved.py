"""Curved limits and obstacles in two states: geometry and enclosures against sampling, bounds against the truth."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j1, jn_zeros

import certbound as cb
from certbound.errors import CertificateError, InfeasibleError
from certbound.rigor.intervals import Interval
from certbound.safety.certificates.values import values_proof
from certbound.safety.engines.values import values_engine
from certbound.values.continuous import bound_exits, exits
from certbound.values.continuous.curved import bound_region, bounding, near_walls, proof, walled, walled_ramps
from certbound.values.continuous.curved.boundaries import Walls
from certbound.values.continuous.curved.continuation import propose_within
from certbound.values.continuous.curved.cuts import PARTS, Cuts
from certbound.values.continuous.curved.region import region_of
from certbound.values.continuous.hypotheses import Need, Proof, up
from certbound.values.continuous.plane import Plan, floats_of, plane_of
from certbound.values.continuous.residual import Ranges
from certbound.values.continuous.straight import SMALL
from certbound.values.continuous.surface import Surface
from certbound.values.room import starts_of
from tests.values.random_problems import check
from tests.values.test_continuous import hermite_values, random_surface, read, spoilt

REGIONS = {
    "ball": [cb.Inside(cb.Ball([0.1, -0.05], 0.7))],
    "ellipse": [cb.Inside(cb.Ellipsoid([0.0, 0.1], [[0.5, 0.2], [0.2, 0.3]]))],
    "triangle": [cb.Inside(cb.Polytope([[-1, 0.2], [0.6, 1], [0.3, -1]], [0.6, 0.5, 0.6]))],
    "obstacles": [cb.Outside(cb.Ball([0.4, 0.3], 0.25)), cb.Outside(cb.Box([-0.6, -0.5], [-0.2, -0.1]))],
    "strip": [cb.Inside(cb.Ball([0.0], 0.5, coordinates=[1])), cb.Outside(cb.HalfSpace([1.0, 1.0], -0.4))],
}


def in_disc(horizon: float = 1.0, noise: float = 0.5, **changes) -> cb.Problem:
    """A Brownian motion in a disc."""
    system = cb.ContinuousSystem(lambda x: [0 * x[0], 0 * x[1]], states=2, diffusion=noise * np.eye(2))
    safe = [cb.Inside(cb.Ball([0.0, 0.0], 1.0))]
    return cb.Problem(system, initial=[0, 0], safe=safe, horizon=horizon).replace(**changes)


def leaving_a_disc(horizon: float = 1.0, noise: float = 0.5) -> float:
    """Its probability of leaving, by Bessel's series."""
    zeros = jn_zeros(0, 60)
    return float(1 - np.sum(2 * np.exp(-(zeros**2) * noise**2 * horizon / 2) / (zeros * j1(zeros))))


def satisfied(constraints, x, y):
    points = np.stack([x, y], axis=-1)
    return np.all([constraint.satisfied(points) for constraint in constraints], axis=0)


# geometry


@pytest.mark.parametrize("name", REGIONS)
def test_boxes_are_told_apart_rightly(name: str) -> None:
    rng, constraints = np.random.default_rng(1), REGIONS[name]
    walls = Walls.of(constraints)
    low = rng.uniform(-1, 1, (2, 4000))
    high = low + rng.choice([0.01, 0.1, 0.4], 4000)
    box = (Interval(low[0], high[0]), Interval(low[1], high[1]))
    within, away = walls.locate(box)
    touched = np.any([mask for _, mask in walls.touched(box)], axis=0)
    x, y = (a[:, None] + (b - a)[:, None] * rng.uniform(size=(4000, 40)) for a, b in zip(low, high))
    safe = satisfied(constraints, x, y)
    assert np.all(safe[within])
    assert not np.any(safe[away])
    assert within.any()
    assert away.any()
    mixed = safe.any(axis=1) & ~safe.all(axis=1)
    assert np.all(touched[mixed])
    assert np.all(~(within | away)[mixed])
    assert touched.mean() < 0.8


@pytest.mark.parametrize("name", REGIONS)
def test_the_coefficients_of_a_wall_are_its_polynomial(name: str) -> None:
    rng = np.random.default_rng(2)
    low = rng.uniform(-1, 1, (2, 5))
    high = low + 0.3
    ends = tuple((Interval.point(a), Interval.point(b)) for a, b in zip(low, high))
    s, t = rng.uniform(size=(2, 5))
    basis = [np.stack([(1 - u) ** 2, 2 * u * (1 - u), u**2], axis=1) for u in (s, t)]
    for walls, _ in Walls.of(REGIONS[name]).groups:
        for wall in walls:
            table = wall.bernstein(ends)
            place = tuple(Interval.point(a + u * (b - a)) for a, b, u in zip(low, high, (s, t)))
            direct = wall.over(place).mid
            assert np.allclose(np.einsum("ki,kij,kj->k", basis[0], table.mid, basis[1]), direct, atol=1e-13)
            assert np.all(table.rad < 1e-13)


def test_depths_are_distances_of_balls_and_faces_and_fall_to_zero_at_any_wall() -> None:
    ball = Walls.of([cb.Outside(cb.Ball([0.3, 0.0], 0.5))])
    assert ball.depth(np.array([0.3, 1.3, 0.3]), np.array([0.0, 0.0, 0.6])) == pytest.approx([-0.5, 0.5, 0.1])
    ellipse = cb.Ellipsoid([0.0, 0.1], [[0.5, 0.2], [0.2, 0.3]])
    turn = np.linspace(0, 6, 9)
    rim = np.linalg.cholesky(ellipse.shape) @ [np.cos(turn), np.sin(turn)]
    assert Walls.of([cb.Inside(ellipse)]).depth(rim[0], rim[1] + 0.1) == pytest.approx(0, abs=1e-12)


# enclosures on cut cells


def cut_up(name: str, seed: int = 3) -> tuple[Surface, Cuts]:
    axes = (np.linspace(-0.9, 0.9, 7), np.linspace(-0.8, 0.8, 6))
    surface = random_surface(np.random.default_rng(seed), axes, 2)
    return surface, Cuts.of(axes, Walls.of(REGIONS[name]))


@pytest.mark.parametrize("name", REGIONS)
def test_cells_and_parts_hold_all_safe_points_and_the_walls(name: str) -> None:
    surface, cuts = cut_up(name)
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-0.9, 0.9, 20000), rng.uniform(-0.8, 0.8, 20000)
    i, j = (np.searchsorted(axis, place) - 1 for axis, place in zip(surface.axes, (x, y)))
    cell = i * surface.cells[1] + j
    share = [PARTS * (p - axis[k]) / (axis[k + 1] - axis[k]) for p, axis, k in zip((x, y), surface.axes, (i, j))]
    parts = {(int(cuts.cut[c]), int(r), int(q)) for c, r, q in zip(cuts.cell, cuts.row, cuts.column)}
    safe = satisfied(REGIONS[name], x, y)
    for k in np.flatnonzero(safe):
        assert cell[k] in cuts.whole or (int(cell[k]), int(share[0][k]), int(share[1][k])) in parts
    assert np.all(safe[np.isin(cell, cuts.whole)])


def test_an_obstacle_that_no_cell_meets_leaves_whole_cells() -> None:
    surface, _ = cut_up("ball")
    cuts = Cuts.of(surface.axes, Walls.of([cb.Outside(cb.Ball([50.0, 0.0], 1.0))]))
    assert not len(cuts.cut)
    model = read(lambda t, x: [-x[0], -x[1]], 0.3 * np.eye(2), ["x1", "x2"])
    found = proof.examine_within(surface, cuts, model, Need(spare=1e-12, start=-1.0, top=np.inf))
    assert np.array_equal(np.unique(found.cell), cuts.whole)


@pytest.mark.parametrize("name", ["ball", "strip"])
@pytest.mark.parametrize("clock", [0.0, 0.3])
def test_the_residual_is_enclosed_on_parts_of_cut_cells(name: str, clock: float) -> None:
    surface, cuts = cut_up(name)

    def f(t, x):
        return [np.sin(x[0]) + clock * t, -x[1] + np.cos(x[0]) * x[1]]

    model = read(f, np.array([[0.5, 0.1], [0.2, 0.4]]), ["x1", "x2"])
    assert model.autonomous == (clock == 0)
    need = Need(spare=1e-12, start=-1.0, top=np.inf)
    found = proof.examine_within(surface, cuts, model, need)
    assert np.array_equal(np.unique(found.cell), np.unique(np.concatenate([cuts.whole, cuts.cut[cuts.cell]])))
    a, rng = np.array([[0.26, 0.14], [0.14, 0.2]]), np.random.default_rng(5)
    for k in rng.choice(len(cuts.cell), 25):
        place, slab = int(cuts.cut[cuts.cell[k]]), int(rng.integers(2))
        cell = np.unravel_index(place, surface.cells)
        here = (found.slab == slab) & (found.cell == place)
        order = np.flatnonzero(cuts.cut[cuts.cell] == place)
        index = np.flatnonzero(here)[list(order).index(k)]
        shares = [(part + rng.uniform()) / PARTS for part in (cuts.row[k], cuts.column[k])]
        clock_share = rng.uniform()
        v, rate, slope, bend = hermite_values(surface, slab, cell, clock_share, shares)
        t = surface.times[slab] + clock_share * surface.steps[slab]
        x = [axis[c] + s * (axis[c + 1] - axis[c]) for axis, c, s in zip(surface.axes, cell, shares)]
        energy = 0.5 * slope @ a @ slope
        residual = rate + np.array(f(t, x)) @ slope + 0.5 * np.trace(a @ bend) + energy
        ranges = found.ranges
        assert residual <= ranges.residual_high[index] + 1e-9 * (1 + abs(residual))
        assert ranges.low[index] - 1e-9 <= v <= ranges.high[index] + 1e-9
        assert ranges.energy[index] <= energy + 1e-9


@pytest.mark.parametrize("name", REGIONS)
def test_v_is_bounded_from_below_on_the_walls_and_raised_by_what_it_misses(name: str) -> None:
    surface, cuts = cut_up(name)
    least = proof.least_on_walls(surface, cuts)
    rng, walls = np.random.default_rng(6), Walls.of(REGIONS[name])
    x, y = rng.uniform(-0.9, 0.9, 40000), rng.uniform(-0.8, 0.8, 40000)
    close = np.flatnonzero(np.abs(walls.depth(x, y)) < 2e-3)[:60]
    assert len(close) > 10
    for k in close:
        cell = [int(np.searchsorted(axis, p) - 1) for axis, p in zip(surface.axes, (x[k], y[k]))]
        share = [(p - a[c]) / (a[c + 1] - a[c]) for p, a, c in zip((x[k], y[k]), surface.axes, cell)]
        v, _, slope, _ = hermite_values(surface, int(rng.integers(2)), cell, rng.uniform(), share)
        assert least <= v + 3e-3 * np.abs(slope).sum()
    raised = proof.raised_over_walls(surface, cuts)
    assert proof.least_on_walls(raised, cuts) >= 0


# bounds


@functools.cache
def disc_proposals():
    problem = in_disc()
    model = exits._model(problem)
    plane, region, level, _ = bounding._setting(problem, model)
    surface = propose_within(plane, Plan(cells=12, growth=0.4, lead=0.1, floor=level - 4), region.walls)
    assert surface is not None
    return problem, model, region.walls, surface


@pytest.mark.slow
def test_a_disc_is_left_as_often_as_bessels_series_says() -> None:
    truth = leaving_a_disc()
    found = bound_exits(in_disc(), seconds=10.0)
    assert truth <= 10**found.upper <= 1.5 * truth
    assert found.lower is None or 10**found.lower <= truth
    assert "curved limits" in found.words


@pytest.mark.slow
def test_noise_on_a_proposal_never_passes_the_truth_in_a_disc() -> None:
    problem, model, walls, surface = disc_proposals()
    truth, rng = np.log(leaving_a_disc()), np.random.default_rng(7)
    for size, lower in ((0.0, 0.0), (0.0, -2.0), (0.01, -0.2), (0.2, -1.0)):
        one = spoilt(surface, rng, size) if size else surface
        assert proof.prove_within(one.raised(lower), walls, model, problem.initial).log >= truth
    for factor in (0.5, 3.0):
        data = {name: factor * getattr(surface, name) for name in ("values", "start_rates", "end_rates")}
        assert proof.prove_within(replace(surface, **data), walls, model, problem.initial).log >= truth


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_random_curved_problems_are_left_no_more_often_than_bounded(seed: int) -> None:
    assert check("curved", seed, paths=200_000, seconds=5.0)[0] == ""


def half_plane() -> cb.Problem:
    """Two states that do not meet, x1 <= 1."""
    free = cb.ContinuousSystem(lambda x: [-x[0], 0.2 - x[1]], states=2, diffusion=0.5 * np.eye(2))
    return cb.Problem(free, initial=[0, 0], safe=[cb.Inside(cb.HalfSpace([1.0, 0.0], 1.0))], horizon=0.5)


def test_a_state_without_limits_gets_a_box_that_few_paths_leave() -> None:
    problem = half_plane()
    assert walled(problem)
    plane, region, level, _ = bounding._setting(problem, exits._model(problem))
    assert 1 - 1e-12 < plane.high[0] == region.high[0] <= 1.0
    assert not region.walls.groups
    assert plane.low[0] < -1.0
    assert plane.low[1] < -1.0 < 1.0 < plane.high[1]
    assert np.log(2e-4) < level < np.log(2e-3)  # one state alone: 6.1e-4


@pytest.mark.slow
def test_a_half_plane_is_left_as_often_as_one_state_says() -> None:
    found = bound_exits(half_plane(), seconds=2.0)
    line = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=0.5)
    alone = cb.Problem(line, initial=[0], safe=[cb.Inside(cb.Box([-np.inf], [1.0]))], horizon=0.5)
    truth = bound_exits(alone, seconds=1.0)
    assert truth.lower is not None
    assert truth.lower < found.upper < truth.upper + np.log10(2.5)
    assert found.lower is None or found.lower < truth.upper


def test_the_worst_point_of_a_ball_of_starts_counts_and_starts_at_a_wall_are_lost() -> None:
    _problem, _, walls, surface = disc_proposals()
    ball = cb.Ball([0.1, 0.05], 0.4)
    found = proof.highest_over(surface, walls, ball)
    turn = np.linspace(0, 6.3, 50)
    for x, y in zip(0.1 + 0.4 * np.cos(turn), 0.05 + 0.4 * np.sin(turn)):
        cell = [int(np.searchsorted(axis, p) - 1) for axis, p in zip(surface.axes, (x, y))]
        share = [(p - a[c]) / (a[c + 1] - a[c]) for p, a, c in zip((x, y), surface.axes, cell)]
        assert hermite_values(surface, 0, cell, 0.0, share)[0] <= up(found)
    box = proof.highest_over(surface, walls, cb.Box([-0.3, -0.35], [0.5, 0.45]))
    assert found <= box
    assert proof.highest_over(surface, walls, cb.Ball([0.5, 0.0], 0.5)) == np.inf
    assert proof.highest_over(surface, walls, cb.Box([-0.9, -0.9], [0.9, 0.9])) == np.inf


def test_what_is_not_served_is_refused_in_words() -> None:
    moving = cb.Inside(cb.Ball(lambda t: [0.1 * t, 0.0], 1.0))
    window = cb.Inside(cb.Ball([0.0, 0.0], 1.0), during=(0.5, 1.0))
    for safe, message in ((moving, "moving boxes only"), (window, "over windows serve fixed boxes only")):
        with pytest.raises(InfeasibleError, match=message):
            bound_exits(in_disc(safe=[safe]))
    with pytest.raises(InfeasibleError, match="random start"):
        bound_exits(in_disc(initial=cb.GaussianStart([0.0, 0.0], 0.01 * np.eye(2))))
    swing = cb.ContinuousSystem(lambda x: [x[1], -x[0]], states=2, diffusion=[[0.0], [0.3]])
    with pytest.raises(InfeasibleError, match="need noise of full rank"):
        bound_exits(in_disc(system=swing))
    with pytest.raises(InfeasibleError, match="serve boxes only"):
        exits.chart_exits(in_disc(), levels=[-1.0])


def test_noise_that_is_infinite_somewhere_is_refused():
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=lambda x: [[1 / x[0], 0], [0, 1]])
    problem = cb.Problem(system, initial=[0.1, 0.0], safe=[cb.Inside(cb.Ball([0, 0], 1.0))], horizon=1.0)
    with pytest.raises(InfeasibleError, match="no finite size somewhere"):
        bound_exits(problem, seconds=0.5)


def test_a_certificate_that_cannot_state_a_curved_set_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = in_disc(horizon=0.5, noise=0.3)
    assert walled(problem)
    assert not walled(problem.replace(safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))]))
    monkeypatch.setattr(exits, "bound_region", lambda *rest: (-3.0, None, "as proved elsewhere", ([], [])))
    answer = values_engine(problem)
    assert answer.applicable
    assert answer.log10_delta < -1.2
    with pytest.raises(CertificateError, match="no oblique or curved limits"):
        values_proof(problem, answer)
    assert bound_region is not exits.bound_region


@pytest.mark.usefixtures("frugal")
def test_the_probability_itself_is_proposed_within_a_disc_and_its_bound_holds_on_spoilt_proposals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(near_walls, "_FACTORS", (0.9, 1.12))
    monkeypatch.setattr(near_walls, "_SAMPLED", 1)
    problem, truth = in_disc(0.5, 0.7), leaving_a_disc(0.5, 0.7)
    model = exits._model(problem)
    region = region_of(problem, *floats_of(model), near=False)
    plane = plane_of(problem, model, region.low, region.high, starts_of(problem))
    found = near_walls.bound_near_walls(plane, region.walls, model, problem.initial, 9)
    assert math.log(truth) <= found < math.log(truth) + 1.0
    surface = walled_ramps.WalledRamps(plane, region.walls, 7).surface(None, below=False)
    rng = np.random.default_rng(1)
    for size in (0.0, 1e-2):
        wrong = replace(surface, values=surface.values * (1 + size * rng.normal(size=surface.values.shape)))
        sketch = near_walls._Sketch.of(wrong.raised(-0.1 * SMALL), region.walls, model, problem.initial)
        assert sketch.proved(region.walls, model)[0] >= math.log(truth)


def test_a_payment_by_the_logarithm_says_nothing_of_functions_that_fall_far_below_0() -> None:
    none = np.zeros(0)
    ranges = Ranges(residual_low=none, residual_high=none, low=none, high=none, energy=none)
    seen = Proof(ranges=ranges, slab=none.astype(int), cell=none.astype(int))
    still = np.zeros((2, 2, 3, 2, 3))
    flat = Surface(
        axes=(np.array([0.0, 1.0]),) * 2, times=np.array([0.0, 1.0]), values=still, start_rates=still[:1],
        end_rates=still[:1],
    )  # fmt: skip
    start = SMALL * (0.1 - 1)
    paid = [near_walls.relative_payment(seen, flat, start, SMALL * (u - 1), 1e-9).log for u in (0.0, -0.5, -20)]
    assert math.log(0.1) - 1e-9 <= paid[0] < math.log(0.1) + 0.01
    assert math.log(0.4) <= paid[1] < 0 == paid[2]  # P - (1 - P) / 2 <= .1


@pytest.mark.parametrize(
    ("ends", "extra", "least", "most"),
    [  # what paths can gain in all: from .03 they may come to where U is low or where it is high
        ([(0.0, 0.1), (0.1, 0.2)], [0.001, 0.02], 0.036, 0.04),  # 1 by the logarithm of U alone
        ([(0.2, 0.3)], [0.02], 0.033, 0.034),
        ([(0.99, 1.01)], [0.02], 0.03, 0.031),  # U is lifted over 1
    ],
)
def test_residuals_where_u_is_low_are_paid_in_absolute_terms(
    ends: list[tuple[float, float]], extra: list[float], least: float, most: float
) -> None:
    count = 5
    low, high = (SMALL * (np.tile([pair[k] for pair in ends], count) - 1) for k in (0, 1))
    none = np.zeros(len(low))
    ranges = Ranges(
        residual_low=none, residual_high=SMALL * np.tile(extra, count), low=low, high=high, energy=none
    )  # fmt: skip
    seen = Proof(ranges=ranges, slab=np.repeat(np.arange(count), len(ends)), cell=none.astype(int))
    still = np.zeros((count + 1, 2, 3, 2, 3))
    flat = Surface(
        axes=(np.array([0.0, 1.0]),) * 2, times=np.linspace(0, 1, count + 1), values=still, start_rates=still[:-1],
        end_rates=still[:-1],
    )  # fmt: skip
    paid = near_walls.relative_payment(seen, flat, SMALL * (0.03 - 1), -SMALL, 1e-9)
    assert least <= math.exp(paid.log) < most


def test_a_box_without_width_is_refused_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """No simulated path moves along the second state, which has no limits either."""
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=0.1 * np.eye(2))
    wall = cb.Inside(cb.HalfSpace([1.0, 0.0], 1.0))
    problem = cb.Problem(system, initial=[0.1, 0.2], safe=[wall], horizon=0.5)
    still = (np.array([-1.0, 0.2]), np.array([1.0, 0.2]))
    monkeypatch.setattr("certbound.values.continuous.curved.region.reach_of", lambda *_: still)
    answer = values_engine(problem)
    assert not answer.applicable
    assert "no box of any width" in answer.reason
