"""Lower bounds within curved limits and among obstacles: what is shown against sampling, bounds against the truth."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.values.continuous import bound_exits, exits
from certbound.values.continuous.curved import bounding, near_walls_below, proof, proof_below, walled_ramps
from certbound.values.continuous.curved.boundaries import Walls
from certbound.values.continuous.curved.cuts import Cuts
from certbound.values.continuous.curved.near_walls_below import best_below, bound_near_walls_below, ended_at_limits
from certbound.values.continuous.curved.region import region_of
from certbound.values.continuous.hypotheses import Need, Proof
from certbound.values.continuous.plane import Plane, floats_of, plane_of
from certbound.values.continuous.residual import Ranges
from certbound.values.continuous.surface import Surface
from certbound.values.room import starts_of
from tests.values.test_continuous import hermite_values, read, spoilt
from tests.values.test_curved import REGIONS, cut_up, in_disc, leaving_a_disc, satisfied


def sloping(axes: tuple[np.ndarray, np.ndarray], slope: tuple[float, float], value: float = 0.0) -> Surface:
    """V = value + slope . x at all times."""
    x, y = np.meshgrid(*axes, indexing="ij")
    values = np.zeros((2, len(axes[0]), 3, len(axes[1]), 3))
    values[:, :, 0, :, 0] = value + slope[0] * x + slope[1] * y
    values[:, :, 1, :, 0], values[:, :, 0, :, 1] = slope
    none = np.zeros((1, *values.shape[1:]))
    return Surface(axes=axes, times=np.array([0.0, 1.0]), values=values, start_rates=none, end_rates=none)


@pytest.mark.parametrize("name", REGIONS)
def test_v_is_bounded_from_above_where_it_is_safe_and_lowered_by_what_it_exceeds(name: str) -> None:
    surface, cuts = cut_up(name)
    walls, rng = Walls.of(REGIONS[name]), np.random.default_rng(6)
    highest = proof_below.highest_within(surface, cuts, walls)
    x, y = rng.uniform(-0.9, 0.9, 3000), rng.uniform(-0.8, 0.8, 3000)
    for k in np.flatnonzero(satisfied(REGIONS[name], x, y))[:150]:
        cell = [int(np.searchsorted(axis, p) - 1) for axis, p in zip(surface.axes, (x[k], y[k]))]
        share = [(p - a[c]) / (a[c + 1] - a[c]) for p, a, c in zip((x[k], y[k]), surface.axes, cell)]
        assert hermite_values(surface, int(rng.integers(2)), cell, rng.uniform(), share)[0] <= highest
    assert proof_below.highest_within(proof_below.sunk_within(surface, cuts, walls), cuts, walls) <= 0


AXES = (np.linspace(-1.0, 1.0, 8), np.linspace(-1.0, 1.0, 7))
RISING = {  # what is safe, V's slope, and its largest value there
    "a half-plane": ([cb.Inside(cb.HalfSpace([0.8, 0.6], 0.3))], (1.6, 1.2), 0.6),
    "a ball to keep out of": ([cb.Outside(cb.Ball([0.05, 0.03], 0.6))], (0.0, 0.0), 0.0),
    "a triangle": ([cb.Inside(cb.Polytope([[1.0, 1.0], [-1.0, 1.0], [0.0, -1.0]], [0.4, 0.4, 0.5]))], (0.0, 2.0), 0.8),
    "a box to keep out of": ([cb.Outside(cb.Box([-2.0, -2.0], [0.3, 2.0]))], (-1.0, 0.0), -0.3),
}


@pytest.mark.parametrize("name", RISING)
def test_v_that_rises_beyond_a_wall_is_bounded_by_what_it_is_at_the_wall(name: str) -> None:
    safe, slope, truth = RISING[name]
    walls, surface = Walls.of(safe), sloping(AXES, slope)
    cuts = Cuts.of(AXES, walls)
    raised = surface.raised(1.0 - truth)
    found = proof_below.highest_within(raised, cuts, walls)
    assert 1.0 - 1e-9 <= found <= 1.0 + (0.1 if len(walls.groups[0][0]) == 3 else 5e-3)  # 1/16 of a cell beside corners


def test_the_other_side_of_a_face_of_an_obstacle_is_safe_too() -> None:
    obstacle = [cb.Outside(cb.Box([-0.31, -2.0], [0.33, 2.0]))]
    walls, surface = Walls.of(obstacle), sloping(AXES, (1.0, 0.0))
    assert proof_below.highest_within(surface, Cuts.of(AXES, walls), walls) >= 1.0 - 1e-12


def test_paths_may_end_at_the_horizon_and_at_faces_that_are_no_limits() -> None:
    walls = Walls.of([cb.Inside(cb.HalfSpace([1.0, 0.2], 0.4))])
    surface = sloping(AXES, (1.0, 1.0))
    cuts, none = Cuts.of(AXES, walls), ((False, False), (False, False))
    data = surface.values.copy()
    data[1, :, 0, :, 0] -= 5.0
    falling = replace(surface, values=data)
    assert -3.6 <= proof_below.end_within(falling, cuts, none) <= -3.3  # at most 1.6 - 5, up to a cell
    assert proof_below.end_within(falling, cuts, ((False, True), (False, False))) <= -3.3  # beyond the limit
    top = proof_below.end_within(falling, cuts, ((False, False), (False, True)))
    assert 1.2 <= top <= 1.6  # at y = 1, up to x = .2
    assert proof_below.end_within(falling, cuts, ((True, False), (False, False))) >= 0.0 - 1e-12


@pytest.mark.parametrize("name", ["ball", "strip", "obstacles"])
def test_the_residual_is_enclosed_from_below_where_v_may_be_negative(name: str) -> None:
    surface, cuts = cut_up(name)
    model = read(lambda t, x: [np.sin(x[0]), -x[1] + np.cos(x[0]) * x[1]], 0.4 * np.eye(2), ["x1", "x2"])
    need = Need(spare=1e-12, start=-0.1, top=5e-324, bottom=-1.0)
    seen = proof.examine_within(surface.raised(-0.3), cuts, model, need, upper=False, straight=True)
    assert seen.seen is not None
    found = seen.ranges
    looked = {(int(k), int(c)) for k, c in zip(seen.slab, seen.cell)}
    rng, moved = np.random.default_rng(5), seen.seen[0]
    x, y = rng.uniform(-0.9, 0.9, 4000), rng.uniform(-0.8, 0.8, 4000)
    count = 0
    for k in np.flatnonzero(satisfied(REGIONS[name], x, y))[:150]:
        cell = [int(np.searchsorted(axis, p) - 1) for axis, p in zip(moved.axes, (x[k], y[k]))]
        share = [(p - a[c]) / (a[c + 1] - a[c]) for p, a, c in zip((x[k], y[k]), moved.axes, cell)]
        slab = int(rng.integers(2))
        v, rate, slope, bend = hermite_values(moved, slab, cell, rng.uniform(), share)
        if not need.bottom < v <= 0:
            continue
        number = cell[0] * moved.cells[1] + cell[1]
        assert (slab, number) in looked
        here = (seen.slab == slab) & (seen.cell == number)
        residual = rate + np.array([np.sin(x[k]), -y[k] + np.cos(x[k]) * y[k]]) @ slope + 0.08 * np.trace(bend)
        residual += 0.08 * slope @ slope
        assert found.residual_low[here].min() <= residual + 1e-9
        assert found.low[here].min() <= v
        count += 1
    assert count > 20


def test_the_inequality_is_asked_wherever_v_is_not_above_0() -> None:
    flat = sloping(AXES, (0.0, 0.0))
    values = np.repeat(flat.values[:1], 3, axis=0)
    values[:, :, 0, :, 0] += np.array([-1e-8, -1e-7, -1.0])[:, None, None]
    none = np.zeros((2, *values.shape[1:]))
    falling = Surface(axes=AXES, times=np.array([0.0, 0.5, 1.0]), values=values, start_rates=none, end_rates=none)
    walls = Walls.of([cb.Outside(cb.Ball([0.5, 0.5], 0.2))])
    model = read(lambda t, x: [-x[0], -x[1]], 0.4 * np.eye(2), ["x1", "x2"])
    cuts, points = Cuts.of(AXES, walls), np.array([[0.0, 0.0]])
    seen = proof_below.seen_within(falling, cuts, model, points, 1e-12, ((False, False),) * 2)
    assert set(seen.slab) == {0, 1}
    assert seen.ranges.residual_low[seen.slab == 0].max() < 0


def plane_for(problem: cb.Problem) -> tuple[Plane, Walls, object]:
    model = exits._model(problem)
    region = region_of(problem, *floats_of(model), near=False)
    return plane_of(problem, model, region.low, region.high, starts_of(problem)), region.walls, model


def with_limits(*safe: cb.Inside) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: [-0.2 * x[0], -0.2 * x[1]], states=2, diffusion=0.5 * np.eye(2))
    return cb.Problem(system, initial=[0.1, 0.0], safe=list(safe), horizon=0.5)


def test_sides_of_the_box_are_limits_or_count_as_not_failing() -> None:
    third = 1 / 3
    limit = cb.Inside(cb.Polytope([[3.0, 0.0]], [1.0 + 2.0]))  # x <= 1, rounded
    plane, walls, _ = plane_for(with_limits(limit, cb.Inside(cb.Box([-1.0], [third], coordinates=[1])),
                                            cb.Outside(cb.Ball([0.7, 0.0], 0.2))))  # fmt: skip
    found = ended_at_limits(
        with_limits(limit, cb.Inside(cb.Box([-1.0], [third], coordinates=[1])), cb.Outside(cb.Ball([0.7, 0.0], 0.2))),
        plane, walls, 20,
    )  # fmt: skip
    assert found.cut == ((True, False), (False, False))  # nothing bounds x1 from below
    assert found.high[0] >= 1.0 >= plane.high[0]
    assert found.high[1] == third
    nearer = replace(plane, high=(0.9, third))  # the box ends before the limit
    assert ended_at_limits(with_limits(limit, cb.Outside(cb.Ball([0.7, 0.0], 0.2))), nearer, walls, 20).cut[0][1]


def test_sides_beyond_a_wall_are_met_by_no_path_and_strong_drifts_are_given_up() -> None:
    problem = in_disc()
    plane, walls, _ = plane_for(problem)
    assert ended_at_limits(problem, plane, walls, 20).cut == ((False, False), (False, False))
    system = cb.ContinuousSystem(lambda x: [-9 * x[0], -x[1]], states=2, diffusion=0.5 * np.eye(2))
    boxed = [cb.Inside(cb.Box([-1, -1], [1, 1])), cb.Outside(cb.Ball([0.5, 0.5], 0.2))]
    strong = cb.Problem(system, initial=[0, 0], safe=boxed, horizon=1.0)
    plane, walls, _ = plane_for(strong)
    assert ended_at_limits(strong, plane, walls, 20).cut == ((True, True), (False, False))


@functools.cache
def disc_below() -> tuple[cb.Problem, object, Plane, Walls, Surface, float]:
    problem = in_disc(0.5, 0.7)
    plane, walls, model = plane_for(problem)
    plane = ended_at_limits(problem, plane, walls, 16)
    solver = walled_ramps.WalledRamps(plane, walls, 16, below=leaving_a_disc(0.5, 0.7))
    for _ in range(3):
        surface = solver.surface(None, below=True)
    return problem, model, plane, walls, surface, solver.small


def bound_of(surface: Surface, negligible: float = 1e-9) -> float | None:
    _, model, plane, walls, _, small = disc_below()
    cuts, points = Cuts.of(surface.axes, walls), np.array([[0.0, 0.0]])
    surface = proof_below.sunk_within(surface, cuts, walls)
    seen = proof_below.seen_within(surface, cuts, model, points, negligible, plane.cut)
    return best_below(seen, small * leaving_a_disc(0.5, 0.7))


@pytest.mark.slow
def test_a_proposal_in_a_disc_is_near_the_truth_and_wrong_ones_prove_no_more_than_that() -> None:
    truth, small = math.log(leaving_a_disc(0.5, 0.7)), disc_below()[-1]
    surface, rng = disc_below()[4], np.random.default_rng(3)
    assert truth - 1.0 < (bound_of(surface) or -9.0) <= truth
    wrong = [surface.raised(by * small) for by in (-0.1, 0.1, 0.5)]
    names = ("values", "start_rates", "end_rates")
    wrong += [replace(surface, **{name: factor * getattr(surface, name) for name in names}) for factor in (0.3, 3.0)]
    wrong += [spoilt(surface, rng, size) for size in (1e-8, 1e-6)]
    shifted = surface.values.copy()
    shifted[:-1] += 0.4 * small * np.eye(3)[0][:, None, None] * np.eye(3)[0]  # only before the horizon
    wrong.append(replace(surface, values=shifted))
    for one in wrong:
        assert (bound_of(one) or -np.inf) <= truth


def test_a_larger_w_is_taken_off_again() -> None:
    none = np.zeros(0)
    ranges = Ranges(residual_low=none, residual_high=none, low=none, high=none, energy=none)
    small, flat = 2.0**-16, sloping(AXES, (0.0, 0.0))
    need = Need(spare=1e-12, start=small * (0.1 - 1), top=5e-324, bottom=-small)
    seen = Proof(ranges=ranges, slab=none.astype(int), cell=none.astype(int), seen=(flat, need))
    assert best_below(seen, small * 0.1) == pytest.approx(math.log(0.1), abs=2e-3)
    low, high = (small * (np.array([u]) - 1) for u in (0.0, 0.001))
    patch = Ranges(residual_low=-small * np.array([5.0]), residual_high=none, low=low, high=high, energy=none)
    patch = replace(patch, residual_high=np.zeros(1), energy=np.zeros(1))
    once = Proof(ranges=patch, slab=np.zeros(1, int), cell=np.zeros(1, int), seen=(flat, need))
    assert math.log(0.09) < (best_below(once, small * 0.1) or -9.0) < math.log(0.1) - 0.005  # .001 and a bit for W
    deep = replace(once, ranges=replace(patch, high=small * (np.array([0.5]) - 1)))
    assert best_below(deep, small * 0.1) is None


def test_starts_that_may_have_failed_and_noise_that_vanishes_give_no_lower_bound() -> None:
    problem = in_disc(0.5, 0.7, initial=[1.0, 0.0])
    plane, walls, model = plane_for(in_disc(0.5, 0.7))
    assert bound_near_walls_below(problem, plane, walls, model, 9, 0.5) is None
    assert not len(proof_below.surely_in(walls, np.array([[1.0, 0.0], [0.8, 0.7]])))
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=lambda x: [[x[0], 0], [0, 1]])
    vanishing = in_disc(0.5, 0.7, system=system, initial=[0.3, 0.0])
    plane, walls, model = plane_for(vanishing)
    with pytest.raises(InfeasibleError, match="full rank"):
        bound_near_walls_below(vanishing, plane, walls, model, 9, 0.5)


def test_both_sides_reach_the_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("certbound.values.continuous.curved.near_walls.bound_near_walls", lambda *rest: -0.5)
    monkeypatch.setattr(bounding, "_setting", lambda problem, model: (*setting(problem), -0.7, model))
    monkeypatch.setattr(near_walls_below, "bound_near_walls_below", lambda *rest: -1.0)
    found = bound_exits(in_disc(0.5, 0.7), seconds=10.0)
    assert found.lower == pytest.approx(-1 / math.log(10))
    assert "below" in found.words
    assert bound_exits(in_disc(0.5, 0.7), seconds=10.0, lower=False).lower is None
    assert bound_exits(in_disc(0.5, 0.7), seconds=10.0, delta=0.9).lower is None
    assert bound_exits(in_disc(0.5, 0.7), seconds=5.0).lower is None
    assert bound_exits(in_disc(0.5, 0.7), seconds=5.0, delta=0.55).lower is None  # about .5 fail
    assert bound_exits(in_disc(0.5, 0.7), seconds=5.0, delta=0.3).lower is not None


def setting(problem: cb.Problem) -> tuple[Plane, object]:
    region = region_of(problem, *floats_of(exits._model(problem)), near=False)
    return plane_for(problem)[0], region


def test_an_obstacle_beyond_the_box_has_no_walls_to_propose_at() -> None:
    plane, _, _ = plane_for(with_limits(cb.Inside(cb.Box([-1, -1], [1, 1])), cb.Outside(cb.Ball([0.5, 0.5], 0.2))))
    far = Walls.of([cb.Outside(cb.Ball([50.0, 0.0], 1.0))])
    for below in (None, 0.1):
        assert walled_ramps.WalledRamps(plane, far, 8, below=below).at_walls.shape[0] == 0


@pytest.mark.slow
def test_a_disc_is_left_at_least_as_often_as_bounded() -> None:
    found, truth = bound_exits(in_disc(), seconds=20.0), leaving_a_disc()
    assert found.lower is not None
    assert truth / 1.6 <= 10**found.lower <= truth <= 10**found.upper
