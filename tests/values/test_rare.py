"""Two states, failing rarer than e^-20: proofs feed the next proposal, and sources lift V above 0 inside of the box."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import certbound as cb
from certbound.values.continuous import exits
from certbound.values.continuous.hypotheses import Proof, prove_upper
from certbound.values.continuous.plane import Source, integrated, plan_above, plane_of, two_sides
from certbound.values.continuous.plane.plane_proposal import propose_plane
from certbound.values.continuous.rare import rare_above
from certbound.values.continuous.residual import Ranges
from certbound.values.continuous.straight import near_one
from certbound.values.room import safe_room, starts_of


def turning(noise: float) -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x: [-x[0] - 2 * x[1], 2 * x[0] - x[1]], states=2, diffusion=noise * np.eye(2)
    )  # fmt: skip
    box, safe = cb.Box([-0.1, -0.1], [0.1, 0.1]), [cb.Inside(cb.Box([-1.0, -1.0], [1.0, 1.0]))]
    return cb.Problem(system, initial=box, safe=safe, horizon=3)


def seen(problem: cb.Problem, cells: int, growth: float = 0.25):
    model, room = exits._model(problem), safe_room(problem)
    plane = plane_of(problem, model, room.inner_low, room.inner_high, starts_of(problem))
    plan = dataclasses.replace(plan_above(plane, -22.0, 1000), cells=cells, growth=growth, lead=2.9 / cells)
    return model, plane, plan


def test_a_source_lifts_v_above_0_and_no_farther_than_it_may() -> None:
    _, plane, plan = seen(turning(0.6), 10, 0.5)
    fed = Source(times=np.array([0.0, 3.0]), axes=(np.linspace(-1, 1, 2),) * 2, values=np.full((2, 2, 2), 5.0))
    surface, plain = integrated(rare_above.Spilling(plane, plan, fed)), propose_plane(plane, plan, fed)
    assert surface is not None
    assert plain is not None
    assert float(plain.values[:, :, 0, :, 0].max()) < 0.05
    assert 0.1 < float(surface.values[:, :, 0, :, 0].max()) < 0.32
    assert abs(surface.face_range(0, 1)[0]) < 1e-12


def test_the_next_source_is_what_bounds_ask_for_but_not_near_0_nor_where_eps_pays() -> None:
    _, plane, plan = seen(turning(0.6), 10, 0.5)
    surface = propose_plane(plane, plan)
    assert surface is not None
    low, high = np.array([-9.0, -0.001, -60.0, -9.0]), np.array([-8.0, 0.0, -58.0, -8.0])
    asked = np.array([0.7, 0.7, 0.7, -1.0])
    ranges = Ranges(residual_low=asked - 1, residual_high=asked, low=low, high=high, energy=np.zeros(4))
    proof = Proof(ranges=ranges, slab=np.array([0, 1, 1, 2]), cell=np.array([3, 5, 6, 7]), seen=None)
    table = rare_above._due(proof, surface, -50.0)
    assert table[0, 0, 3] == pytest.approx(0.7)
    assert table.sum() == pytest.approx(0.7)


def test_logarithms_where_failing_is_rare_are_corrected_and_other_ways_serve_where_that_fails(monkeypatch) -> None:
    asked = []
    monkeypatch.setattr(near_one, "rough_level", lambda _plane: -21.0)
    monkeypatch.setattr(rare_above, "_correct", lambda *rest: asked.append(rest[2].cells))
    monkeypatch.setattr(near_one, "two_states", lambda *_rest: (-7.0, None, "by another way", ([], [])))
    assert exits.bound_exits(turning(0.2), seconds=1).words == "by another way"
    assert len(asked) == 1
    monkeypatch.setattr(near_one, "rough_level", lambda _plane: -19.0)
    exits.bound_exits(turning(0.2), seconds=1)
    assert len(asked) == 1


@pytest.mark.slow
def test_what_proofs_pay_comes_back_as_a_source_and_the_bound_falls() -> None:
    model, plane, plan = seen(turning(0.2), 24)
    proposed = []
    rare_above._correct(plane, model, plan, proposed)
    logs = [payment.log for _, payment in proposed]
    assert len(logs) > 1
    assert logs == sorted(logs, reverse=True)
    surface = two_sides._promising(plane, model, plan)
    assert surface is not None
    assert logs[-1] < prove_upper(surface, model, plane.starts).log


@pytest.mark.slow
def test_the_reversed_van_der_pol_oscillator_where_leaving_has_a_probability_of_1e_17() -> None:
    """The truth is 1.573e-17: differences of order 4 of log u on 360^2 and 480^2 cells."""
    system = cb.ContinuousSystem(lambda x: [-x[1], x[0] + (x[0] ** 2 - 1) * x[1]], states=2, diffusion=0.1 * np.eye(2))
    safe = [cb.Inside(cb.Box([-1.2, -1.2], [1.2, 1.2]))]
    problem = cb.Problem(system, initial=cb.Box([-0.2, -0.2], [0.2, 0.2]), safe=safe, horizon=5)
    found = exits.bound_exits(problem, seconds=20, delta=1.6e-17)
    assert 1.57e-17 < 10**found.upper < 1.3 * 1.573e-17
