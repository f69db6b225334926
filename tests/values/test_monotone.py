"""Monotone proposals in two states: they come to an end where splines through V do not, and prove nothing wrong."""

from __future__ import annotations

import dataclasses
import functools
import math
import types
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.values.continuous import exits
from certbound.values.continuous.hypotheses import Model, prove_upper
from certbound.values.continuous.plane import two_sides
from certbound.values.continuous.plane.monotone import propose_monotone
from certbound.values.continuous.plane.plane_grids import Plan, Plane
from certbound.values.continuous.plane.plane_proposal import propose_plane
from certbound.values.continuous.surface import Surface
from certbound.values.room import safe_room, starts_of


def seen(problem: cb.Problem) -> tuple[Model, Plane]:
    model, room = exits._model(problem), safe_room(problem)
    return model, two_sides.plane_of(problem, model, room.inner_low, room.inner_high, starts_of(problem))


def decaying(rates: tuple[float, float], noise: np.ndarray) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: [-rates[0] * x[0], -rates[1] * x[1]], states=2, diffusion=noise)
    return cb.Problem(system, initial=[0.1, 0.2], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=2)


@functools.cache
def culture() -> tuple[Model, Plane]:
    """A bioreactor whose layers at the limits are a hundredth as thick as the cells of a grid."""
    def flow(x):
        growth = x[0] / (1 + x[0]) * x[1]
        return [0.3 * (10 - x[0]) - growth, 0.5 * growth - 0.3 * x[1]]

    system = cb.ContinuousSystem(flow, states=2, diffusion=lambda x: np.diag([0.05 * x[0], 0.05 * x[1]]))
    safe = [cb.Inside(cb.Box([0.3, 2.5], [4, 9]))]
    return seen(cb.Problem(system, initial=cb.Box([1.4, 4.2], [1.6, 4.4]), safe=safe, horizon=10))


@pytest.mark.usefixtures("frugal")
def test_layers_much_thinner_than_cells_break_splines_but_not_a_monotone_proposal() -> None:
    model, plane = culture()
    plan = Plan(cells=18, growth=0.35, lead=0.3)
    assert propose_plane(plane, plan) is None
    surface = propose_monotone(plane, plan, None, 1.5)
    assert surface is not None
    assert surface.values[:, :, 0, :, 0].max() <= 1e-9

    def propose(*given: Any) -> Surface | None:
        return surface if given[-1] is None else propose_monotone(*given, raised=1.5)

    best = two_sides._refined(plane, model, plan, None, propose, (-0.1,))
    assert best is not None
    assert prove_upper(best.surface, model, plane.starts).log < math.log(1e-3)  # it is below 1e-6


@pytest.mark.usefixtures("frugal")
def test_noise_on_a_monotone_proposal_never_passes_the_truth() -> None:
    model, plane = seen(decaying((1.0, 2.0), np.diag([0.6, 0.7])))
    surface = propose_monotone(plane, Plan(cells=10, growth=0.8, lead=0.05), None, 0.6)
    assert surface is not None
    truth, rng = math.log(0.235), np.random.default_rng(0)  # 200,000 paths in 2000 steps, which miss some: 0.2357
    bounds = []
    for size, shift in ((0.0, 0.0), (0.0, -1.0), (1e-3, -0.3)):
        spoilt = {
            name: part + size * rng.standard_normal(part.shape) * (np.abs(part) + 1e-3)
            for name, part in ((name, getattr(surface, name)) for name in ("values", "start_rates", "end_rates"))
        }
        bounds.append(prove_upper(dataclasses.replace(surface, **spoilt).raised(shift), model, plane.starts).log)
    assert truth <= min(bounds) < truth + 1.0


@pytest.mark.usefixtures("frugal")
def test_noise_that_is_shared_by_both_states_is_served() -> None:
    model, plane = seen(decaying((1.0, 2.0), np.array([[0.6, 0.0], [0.35, 0.6]])))
    surface = two_sides._promising(plane, model, Plan(cells=10, growth=0.8, lead=0.05))
    assert surface is not None
    assert 0.217 < math.exp(prove_upper(surface, model, plane.starts).log) < 0.4  # 0.2176 of 200,000 paths


def test_eps_pays_for_a_residual_where_v_is_highest_on_a_patch() -> None:
    """V falls by 20 from side to side of a cell: where it is high there is nothing that eps could pay of R = 2.5."""
    system = cb.ContinuousSystem(lambda x: [0.02 + 0 * x[0], 0 * x[1]], states=2, diffusion=0.01 * np.eye(2))
    model, plane = seen(cb.Problem(system, initial=[0.5, 0.5], safe=[cb.Inside(cb.Box([0, 0], [1, 1]))], horizon=1))
    axis = np.linspace(0.0, 1.0, 6)
    values = np.zeros((2, 6, 3, 6, 3))
    values[:, :, 0, :, 0], values[:, :, 1, :, 0] = 100 * (axis[:, None] - 1), 100.0
    flat = np.zeros((1, 6, 3, 6, 3))
    surface = Surface(axes=(axis, axis), times=np.array([0.0, 1.0]), values=values, start_rates=flat, end_rates=flat)
    excess = two_sides.Sketch.of(surface, model, plane.starts, level=-50.0).excess
    assert np.all(excess[:, 2:] > 2.4)
    assert np.all(excess[:, 0] == 0)


def test_what_promises_nothing_beside_another_way_is_not_asked_on_the_next_grid(monkeypatch) -> None:
    model, plane = seen(decaying((1.0, 2.0), np.diag([0.6, 0.7])))
    plan, asked = Plan(cells=10, growth=0.8, lead=0.05), list[str]()
    surface = propose_monotone(plane, plan, None, 0.6)
    promised = {"far": (-9.0, -8.0), "vain": (-9.5, 3.0), "near": (-8.9, -8.5)}

    def refined(_plane, _model, _plan, _level, propose, _tops):
        asked.append(propose)
        start, estimate = promised[propose]
        return types.SimpleNamespace(start=start, estimate=lambda: estimate, surface=surface)

    monkeypatch.setattr(two_sides, "_refined", refined)
    kinds = ["far", "vain", "near"]
    for _ in range(2):
        two_sides._promising(plane, model, plan, kinds=kinds)
    assert asked == ["far", "vain", "near", "far", "near"]
    alone = ["vain"]
    assert two_sides._promising(plane, model, plan, kinds=alone) is None
    assert alone == ["vain"]
