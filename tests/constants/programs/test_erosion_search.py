"""The barrier's derivatives are those of its function, and its metrics erode no more than semidefinite programs' do."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.constants.least_eroding import erosion_ratio, noise_matrices
from certbound.constants.metrics import each_metric, model_set
from certbound.constants.model_data import model_of
from certbound.constants.programs import (
    ErosionSearch,
    RadiusModel,
    center_multipliers,
    centred,
    constraint_targets,
    rate_proposals,
    rooms_of,
)
from certbound.constants.programs import erosion_search as searching
from certbound.constants.programs.barrier_blocks import Pairs
from certbound.constants.programs.erosion_barrier import ErosionBarrier
from certbound.constants.programs.least_erosion import tighten

RADIUS = RadiusModel(continuous=False, dimension=6, horizon=50.0, delta=5e-4, gaussian=True)


@pytest.fixture(scope="module")
def chain():
    """Jacobians, noise and the rooms of one constraint of the chain at rest."""
    problem = cb.load("chain_rest")
    model = model_of(problem, None, None)
    times, targets = constraint_targets(problem)
    own = [target for target in targets if target.constraint == 1]
    return model_set(model), noise_matrices(model), rooms_of(times, own)


def test_hessians_by_rows_are_those_of_the_trace():
    rng = np.random.default_rng(0)
    pairs, K, L = Pairs(4), *rng.normal(size=(2, 4, 4))
    first, second = (pairs.matrix(row) for row in rng.normal(size=(2, pairs.size)))
    i, j = pairs.i, pairs.j
    quadratic = first[i, j] @ pairs.hessian(K, L) @ second[i, j]
    assert quadratic == pytest.approx(np.trace(K @ first @ L @ second))


def test_the_derivatives_of_the_barrier_are_those_of_its_function(chain):
    members, noise, rooms = chain
    block = centred(members.sector())
    metric = rate_proposals(members, continuous=False)[0].metric
    center = center_multipliers(metric, block, continuous=False)
    barrier = ErosionBarrier(block, rooms, noise, RADIUS, 0.9802)
    point = barrier.start(center.metric, center.multipliers[0], -2.5)
    tube = barrier._followed(point)
    found = barrier._derivatives(point, tube, 0.1)
    direction = np.random.default_rng(1).normal(size=len(found.gradient))
    direction[: barrier.pairs.size] *= 1e-3

    def at(step: float) -> float:
        return barrier._merit(barrier._moved(point, direction, step), tube, 0.1)

    slope = (at(1e-4) - at(-1e-4)) / 2e-4
    bend = (at(1e-3) - 2 * at(0.0) + at(-1e-3)) / 1e-6
    assert found.gradient @ direction == pytest.approx(slope, rel=1e-5)
    assert direction @ found.hessian @ direction == pytest.approx(bend, rel=1e-3)


def ratio_of(metric: np.ndarray, rooms) -> float:
    constants = cb.bound_constants(cb.load("chain_rest"), metric=metric)
    return erosion_ratio(constants, rooms, 50.0, RADIUS.delta)


def test_the_barrier_erodes_as_little_as_semidefinite_programs(chain):
    members, noise, rooms = chain
    search = ErosionSearch(members, noise, RADIUS)
    by_barrier = search.proposals(rooms)[0]
    assert by_barrier.status == "tightening: barrier"
    by_programs = tighten(members, rooms, noise, RADIUS, search.start.metric, form="vertices")
    assert ratio_of(by_barrier.metric, rooms) <= 1.01 * ratio_of(by_programs.metric, rooms)


def test_beyond_sixty_states_means_of_riccati_metrics_erode_less_than_the_common_metric(chain, monkeypatch):
    members, noise, rooms = chain
    monkeypatch.setattr(searching, "MOST_STATES", 3)
    tightened, start = ErosionSearch(members, noise, RADIUS).proposals(rooms)
    assert tightened.status == "tightening: mean of Riccati metrics"
    assert ratio_of(tightened.metric, rooms) < ratio_of(start.metric, rooms)


def test_metrics_of_single_constraints_come_in_the_order_of_what_they_lose():
    problem = cb.load("chain_rest")
    found = list(each_metric(problem, only=[3, 0]))
    assert sorted(place for place, _ in found) == [0, 3]
    assert all(constants.certified for _, constants in found)
    side_by_side = dict(each_metric(problem, only=[3, 0], jobs=2))
    for place, constants in found:
        assert np.array_equal(constants.metric, side_by_side[place].metric)
