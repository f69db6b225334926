"""Proposed metrics are certified, and reach what they must on the chain of masses."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.constants.metrics import erosion_ratio, propose_metrics, split_delta
from certbound.constants.programs.least_erosion import RadiusModel, Rooms
from certbound.constants.programs.targets import constraint_targets, nominal_paths, rooms_of
from certbound.constants.recheck import certify_gain, certify_rate
from certbound.errors import EnclosureError
from tests.constants.chain_matrices import DIRECTIONS, NOISE, chain_sector

TARGETS = np.array([0.66, 0.56, 0.45, 1.17])


def test_the_chain_contracts_globally_in_a_proposed_metric():
    constants = cb.bound_constants(cb.load("chain_rest"))
    assert constants.certified
    assert 0.9900 < constants.gain <= 0.9906
    assert constants.gap < 1e-9
    assert constants.metric is not None
    assert constants.proof.status == "method of centres"
    assert constants.sigma < 0.13


@pytest.fixture(scope="module")
def common() -> np.ndarray:
    """The tightened metric of the chain at rest."""
    return propose_metrics(
        cb.load("chain_rest"), objective="erosion", directions=list(DIRECTIONS), clearances=TARGETS, horizon=50,
        delta=0.002,
    )[0]  # fmt: skip


def test_one_common_metric_keeps_the_erosions_of_the_chain_small(common):
    constants = cb.bound_constants(cb.load("chain_rest"), metric=common)
    erosion = cb.tune_tube(constants, horizon=50, delta=0.002).extent(DIRECTIONS, 50)
    assert constants.certified
    assert np.all(erosion <= 0.93 * TARGETS)


def test_the_bundled_plan_is_kept_with_one_common_metric():
    problem = cb.load("chain")
    constants = cb.bound_constants(problem, objective="erosion")
    times, targets = constraint_targets(problem)
    assert erosion_ratio(constants, rooms_of(times, targets), 50, problem.delta) < 0.95
    assert constants.proof.status.startswith("tightening")


@pytest.mark.slow
def test_a_metric_per_constraint_keeps_each_erosion_of_the_chain_small():
    problem = cb.load("chain_rest")
    constants = cb.bound_metrics(problem)
    tubes = [cb.tune_tube(k, horizon=50, delta=0.0005) for k in constants]
    erosion = [tube.extent(a, 50) for tube, a in zip(tubes, DIRECTIONS)]
    assert np.all(erosion <= 0.95 * np.array([0.65, 0.34, 0.35, 1.24]))


def test_each_constraint_gets_its_own_metric_and_a_share_of_delta():
    system = cb.ContinuousSystem(
        lambda x: [-x[0] + 0.5 * x[1], -x[1] - 0.5 * np.tanh(x[0])], states=2, diffusion=0.1 * np.eye(2)
    )
    safe = [cb.Inside(cb.HalfSpace([1, 0], 1.0)), cb.Inside(cb.Box([-5, -2], [5, 2]))]
    problem = cb.Problem(system, initial=[0, 0], safe=safe, horizon=5, delta=1e-3)
    constants = cb.bound_metrics(problem)
    assert len(constants) == 2
    assert all(k.certified for k in constants)
    shares = split_delta(problem, constants)
    assert shares.sum() <= 1e-3
    assert shares[0] > 0.9e-3 > 1e-6 > shares[1] > 0  # the far constraint needs next to nothing
    with pytest.raises(ValueError, match="must hold 2 records"):
        split_delta(problem, constants[:1])
    with pytest.raises(TypeError, match="must be a Problem"):
        cb.bound_metrics(system)


def test_a_metric_is_not_used_where_the_identity_is_as_good():
    constants = cb.bound_constants(cb.load("ou", dimension=2))
    assert constants.metric is None
    assert constants.isotropic


def test_proposals_for_bare_sets_are_normalised_and_worth_certifying():
    members = chain_sector(3)
    (metric,) = propose_metrics(members, continuous=False)
    assert np.linalg.eigvalsh(metric)[0] == pytest.approx(1.0)
    assert certify_gain(metric, members) < 0.9906
    (metric,) = propose_metrics(np.array([[0.0, 1.0], [-1.0, -1.0]]), continuous=True)
    assert certify_rate(metric, [[0.0, 1.0], [-1.0, -1.0]]) == pytest.approx(-0.5, abs=0.01)


def test_a_smaller_delta_never_erodes_less_and_each_metric_is_best_for_its_own_delta(common):
    members = chain_sector(3)
    other = propose_metrics(
        members, objective="erosion", continuous=False, gaussian=True, noise=[NOISE], directions=list(DIRECTIONS),
        clearances=TARGETS, horizon=50, delta=1e-9,
    )[0]  # fmt: skip
    rooms = Rooms(directions=tuple(DIRECTIONS[:, :, None]), times=np.array([50.0]), rooms=TARGETS[:, None])

    def ratio(metric: np.ndarray, delta: float) -> float:
        inner = np.linalg.eigvalsh(NOISE.T @ metric @ NOISE)
        stated = cb.Constants(
            gain=certify_gain(metric, members), sigma=np.sqrt(inner[-1]), dimension=6, metric=metric, gaussian=True,
            effective_dimension=inner.sum() / inner[-1],
        )  # fmt: skip
        return erosion_ratio(stated, rooms, 50, delta)

    assert ratio(common, 2e-3) <= ratio(other, 2e-3) * 1.002
    assert ratio(other, 1e-9) <= ratio(common, 1e-9) * 1.002
    assert ratio(common, 2e-3) < ratio(other, 1e-9)


def test_a_short_window_beside_a_tighter_direction_keeps_a_time():
    times = np.linspace(0.025, 10.0, 400)
    window = np.where(np.abs(times - 5.0) < 0.03, 2.0 - 0.1 * times, np.inf)
    rooms = Rooms(directions=tuple(np.eye(2)[:, :, None]), times=times, rooms=np.stack([np.ones(400), window]))
    coarse = rooms.coarse()
    assert len(coarse.times) <= 25
    assert np.all(np.diff(coarse.times) > 0)
    assert coarse.rooms[1].min() == window.min()


def test_a_radius_that_leaves_all_floats_behind_erodes_endlessly():
    times = np.linspace(1e-3, 1.0, 400)
    rooms = Rooms(directions=(np.array([[1.0]]),), times=times, rooms=np.full((1, 400), 1e-9))
    assert erosion_ratio(cb.Constants(rate=1e3, sigma=1.0, dimension=1), rooms, 1.0, 1e-3) == np.inf


@pytest.mark.parametrize("continuous", [True, False])
@pytest.mark.parametrize("value", [-0.3, 0.02])
def test_the_fitted_radius_agrees_with_the_tuned_kummer_tube(continuous, value):
    square = value if continuous else 1 + value
    model = RadiusModel(continuous=continuous, dimension=4, horizon=20, delta=1e-3, gaussian=True)
    times = np.arange(1.0, 21.0)
    room = np.linspace(1.0, 3.0, 20)
    fit = model.fit(square, 2.5, times, room)
    constants = cb.Constants(
        rate=square if continuous else None, gain=None if continuous else np.sqrt(square), sigma=1.0, dimension=4,
        effective_dimension=2.5, gaussian=True,
    )  # fmt: skip
    if continuous:
        held = (np.concatenate([[0.0], times]), np.concatenate([room[:1], room[:-1]]))
    else:
        held = (np.arange(22.0), np.concatenate([[np.inf], room]))
    tube = cb.tune_tube(constants, horizon=20, delta=1e-3, method="kummer", objective=held)
    reached = float(np.max(tube.radius(times) / room))
    assert np.sqrt(fit.square) == pytest.approx(reached, rel=0.06)
    assert 0 < fit.slope < 1


def test_rooms_follow_the_constraints_the_windows_and_the_moving_centres():
    system = cb.ContinuousSystem(lambda x: [1.0 + 0 * x[0], -x[1]], states=2, diffusion=0.1 * np.eye(2))
    safe = [
        cb.Inside(cb.Box([-1, -2], [np.inf, 3])),
        cb.Outside(cb.Ball(lambda t: [5 + t, 0.0], 1.0), during=(0, 2)),
        cb.Inside(cb.Ellipsoid([0, 0], [[400, 0], [0, 25]])),
        cb.Outside(cb.Polytope([[1, 0], [-1, 0], [0, 1], [0, -1]], [8, -7, 1, 1])),
    ]
    problem = cb.Problem(system, initial=[0, 1], safe=safe, horizon=4)
    times, targets = constraint_targets(problem)
    _, paths = nominal_paths(problem)
    np.testing.assert_allclose(paths[0, 1:, 0], times, atol=1e-9)
    np.testing.assert_allclose(paths[0, 1:, 1], np.exp(-times), rtol=1e-7)
    kinds = [target.constraint for target in targets]
    assert kinds == [0, 0, 1, 2, 3]
    faces = {tuple(np.abs(t.direction[:, 0])): t for t in targets if t.constraint == 0}
    np.testing.assert_allclose(faces[(1.0, 0.0)].rooms, times + 1, atol=1e-9)
    np.testing.assert_allclose(faces[(0.0, 1.0)].rooms[-1], 2 + np.exp(-4), atol=1e-6)
    obstacle = targets[2]
    distance = np.hypot(5.0, np.exp(-times)) - 1
    np.testing.assert_allclose(obstacle.rooms[times <= 2], distance[times <= 2], atol=1e-6)
    assert np.all(np.isinf(obstacle.rooms[times > 2 + 1e-9]))
    assert targets[3].direction.shape == (2, 2)
    np.testing.assert_allclose(targets[4].rooms, np.maximum(7 - times, 0), atol=0.05)
    assert np.all(rooms_of(times, targets).rooms > 0)


def test_an_unbounded_jacobian_has_no_proposals_and_the_identity_stays():
    system = cb.ContinuousSystem(lambda x: [x[1], -np.sin(x[0]) - x[1]], states=2, diffusion=np.eye(2))
    cubic = cb.ContinuousSystem(lambda x: [x[1], -(x[0] ** 3)], states=2, diffusion=np.eye(2))
    with pytest.raises(EnclosureError, match="unbounded"):
        propose_metrics(cubic)
    assert propose_metrics(cubic, domain=cb.Box([-1, -1], [1, 1]))
    constants = cb.bound_constants(system, metric="auto")
    assert constants.certified


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"objective": "speed"}, '"rate" or "erosion"'),
        ({"continuous": None}, "`continuous` must be given"),
        ({"objective": "erosion"}, "needs `horizon=`"),
        ({"objective": "erosion", "horizon": 5.0}, "needs `delta=`"),
        ({"objective": "erosion", "horizon": 5.0, "delta": 2.0}, "must lie in"),
        ({"objective": "erosion", "horizon": -5.0, "delta": 0.1}, "must be positive"),
        ({"objective": "erosion", "horizon": 5.0, "delta": 0.1}, "directions="),
        ({"objective": "erosion", "horizon": 5.0, "delta": 0.1, "directions": [[1.0]]}, "2 entries"),
        (
            {"objective": "erosion", "horizon": 5.0, "delta": 0.1, "directions": [[1.0, 0]], "clearances": [-1.0]},
            "positive numbers",
        ),
        ({"objective": "erosion", "horizon": 5.0, "delta": 0.1, "directions": [[1.0, 0]]}, "`noise`"),
    ],
)
def test_what_is_missing_or_malformed_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        propose_metrics(-np.eye(2), **{"continuous": True, **options})


def test_erosion_needs_a_problem_horizon_and_delta():
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=np.eye(2))
    with pytest.raises(ValueError, match="needs `horizon=`"):
        cb.bound_constants(system, objective="erosion")
    with pytest.raises(ValueError, match="needs a Problem"):
        cb.bound_constants(system, objective="erosion", horizon=5.0, delta=1e-3)
