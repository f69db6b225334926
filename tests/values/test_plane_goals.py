"""Targets, windows and moving limits of two states: proofs hold what simulations find, whatever is proposed."""

import dataclasses
import math

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.problem.goals import until
from certbound.problem.model import compile_numpy
from certbound.values.continuous import bound_exits, exits
from certbound.values.continuous.curved import ramps_for
from certbound.values.continuous.hypotheses import extreme_over
from certbound.values.continuous.plane import frames
from certbound.values.continuous.plane import plane_targets as targets
from certbound.values.continuous.plane import plane_windows as windows
from certbound.values.continuous.plane.target_proposal import bent, propose_to_target
from tests.values.random_goals import KINDS, check

SQUARE = cb.Inside(cb.Box([-1, -1], [1, 1]))
LATE = math.log(0.4161), math.log(0.4281)  # 99.99 % limits from 100,000 simulated paths of `walk` with its target
TOGETHER = math.log(0.2497), math.log(0.2605)  # the same of correlated noise from (.7, .7) into [-.4, .4]^2 within 1
NARROW = math.log(0.3707), math.log(0.3825)  # the same of `walk` for 2 from (.1, .1), |x|, |y| <= .6 from 1 on

SPOILT = ((0.0, -0.5), (1e-3, 0.0))


def walk(**more):
    system = cb.ContinuousSystem(
        lambda x: [-x[0] + 0.3 * x[1], -x[1] - 0.3 * x[0]], states=2, diffusion=0.4 * np.eye(2)
    )
    return cb.Problem(system, **({"initial": [0.5, 0.5], "safe": [SQUARE], "horizon": 1.0} | more))


def spoilt(surface, size, shift):
    """V with noise on its data, moved up or down."""
    rng = np.random.default_rng(0)
    noisy = surface.values + size * rng.standard_normal(surface.values.shape)
    return dataclasses.replace(surface, values=noisy).raised(shift)


# targets


@pytest.fixture(scope="module")
def aimed():
    """Both sides' proposals for a box as a target: the upper one proves something, the lower one not."""
    problem = walk()
    model, target = exits._model(problem), cb.Box([-0.2, -0.2], [0.2, 0.2])
    aims = [targets._aim(problem, model, target, upper=side) for side in (True, False)]
    plans = [dataclasses.replace(targets._plan(1.0, math.log(0.4), n), growth=g) for n, g in ((20, 0.4), (12, 0.6))]
    return [(aim, propose_to_target(aim.plane, plan, target, upper=aim.upper)) for aim, plan in zip(aims, plans)]


@pytest.mark.usefixtures("frugal")
def test_bounds_with_a_target_hold_what_a_simulation_finds(aimed):
    (above, upper), (below, lower) = aimed
    found = targets.prove_failing_above(upper, above)[1].log
    assert LATE[0] <= found < -0.2
    least = targets.prove_failing_below(lower, below)
    assert least is None or least.log <= LATE[1]


@pytest.mark.usefixtures("frugal")
@pytest.mark.parametrize(
    ("size", "shift"), [(0.0, -3.0), (0.0, 0.4), *(pytest.param(*one, marks=pytest.mark.slow) for one in SPOILT)]
)
def test_no_proposal_makes_a_bound_with_a_target_that_is_wrong(aimed, size, shift):
    (above, upper), (below, lower) = aimed
    assert targets.prove_failing_above(spoilt(upper, size, shift), above)[1].log >= LATE[0]
    least = targets.prove_failing_below(spoilt(lower, size, shift), below)
    assert least is None or least.log <= LATE[1]


@pytest.mark.usefixtures("frugal")
@pytest.mark.parametrize("upper", [True, False])
def test_proposals_of_arriving_are_bent_where_noises_go_together_and_hold_simulations(upper):
    gain = [[0.4, 0.25], [0.0, 0.4]]
    system = cb.ContinuousSystem(lambda x: [-x[0] + 0.3 * x[1], -x[1] - 0.3 * x[0]], states=2, diffusion=gain)
    problem = cb.Problem(system, initial=[0.7, 0.7], safe=[SQUARE], horizon=1.0)
    aim = targets._aim(problem, exits._model(problem), cb.Box([-0.4, -0.4], [0.4, 0.4]), upper=upper)
    solver = ramps_for(aim.plane, aim.target, 10, upper)
    assert solver.corners == [(0, 0), (1, 1)]
    surface = solver.failing(None)
    off = surface.values[:, [0, -1], 0, [0, -1], 0]
    assert np.all(off > 0) if upper else np.all(off < 0)
    for shift in (0.0, -0.2 * targets._LITTLE, 50 * targets._LITTLE):
        _, payment, _ = targets._proved(surface.raised(shift), aim)
        assert payment is None or (payment.log >= TOGETHER[0] if upper else payment.log <= TOGETHER[1])


def test_a_start_on_a_line_of_the_grid_is_read_on_that_line(aimed):
    surface = aimed[0][1]
    nodes = surface.axes[0]
    line = [(float(nodes[4]),) * 2, (0.41, 0.43)]
    above = extreme_over(surface, line, upper=True)
    wide = extreme_over(surface, [(float(nodes[3]), float(nodes[5])), line[1]], upper=True)
    seen = surface.floor_at(0, np.column_stack([np.full(9, nodes[4]), np.linspace(0.41, 0.43, 9)]))
    assert seen.max() <= above < wide


@pytest.mark.usefixtures("frugal")
def test_a_start_that_may_lie_in_the_target_has_no_lower_bound(aimed):
    aim, lower = aimed[1]
    assert targets.proved_below(lower, aim) is not None
    inside = dataclasses.replace(aim, plane=dataclasses.replace(aim.plane, starts=((0.15, 0.5), (0.1, 0.5))))
    assert targets.proved_below(lower, inside) is None


@pytest.mark.usefixtures("frugal")
def test_a_horizon_that_is_shorter_does_not_inherit_what_a_longer_one_has(aimed):
    early = dataclasses.replace(aimed[0][1], times=0.5 * aimed[0][1].times)
    aim = dataclasses.replace(aimed[0][0], plane=dataclasses.replace(aimed[0][0].plane, horizon=0.5))
    assert targets.prove_failing_above(early, aim)[1].log >= math.log(0.79)  # simulated: .80


@pytest.mark.parametrize(
    "target", [cb.Box([-0.2, 0.0], [0.4, 1.0]), cb.Box([0.3, -9.0], [9.0, 9.0]), cb.Ball([0.1, 0.0], 0.35)]
)
def test_cells_in_the_target_are_over_and_those_that_hold_it_are_met(target):
    axes = np.linspace(-1, 1, 11).round(1), np.linspace(-1, 1, 11).round(1)
    fate, rng = targets.Fate.of(axes, target), np.random.default_rng(0)
    points = rng.uniform(-1, 1, (4000, 2))
    if isinstance(target, cb.Box):  # faces too
        points = np.vstack([points, np.clip(points, target.low, target.high)])
    cells = tuple(np.clip(np.searchsorted(axis, x) - 1, 0, 9) for axis, x in zip(axes, points.T))
    inside = target.contains(points)
    assert not np.any(~fate.alive[cells] & ~inside)
    met = np.zeros(len(points), dtype=bool)
    for i in range(10):
        for j in range(10):
            here = (points >= [axes[0][i], axes[1][j]]) & (points <= [axes[0][i + 1], axes[1][j + 1]])
            met |= here.all(axis=1) & fate.met[i, j]
    assert np.all(met[inside])


def test_a_target_without_an_interior_is_met_on_the_cells_beside_it():
    axes = np.linspace(-1, 1, 11), np.linspace(-1, 1, 11)
    fate = targets.Fate.of(axes, cb.Box([1.0, -1.0], [2.0, 1.0]))
    assert fate.met[-1].all()
    line = cb.Box([axes[0][4], -1.0], [axes[0][4], 1.0])
    assert targets.Fate.of(axes, line).met[3:5].any(axis=0).all()


def test_nodes_are_bent_to_all_places_that_leave_cells_their_width():
    nodes = np.linspace(0, 1, 11)
    moved = bent(nodes, [0.23, 0.78, 0.781, 1.5])
    assert {0.0, 0.23, 0.78, 1.0} <= set(moved.tolist())
    assert np.all(np.diff(moved) > 0)


# windows


@pytest.fixture(scope="module")
def chains():
    """Both sides' surfaces where a narrower box begins at half time."""
    narrow = cb.Inside(cb.Box([-0.6, -0.6], [0.6, 0.6]), during=(1.0, 2.0))
    problem = walk(initial=[0.1, 0.1], safe=[SQUARE, narrow], horizon=2.0)
    model, starts = exits._model(problem), [(0.1, 0.1)] * 2
    floats = windows.plane_of(problem, model, (0.0, 0.0), (0.0, 0.0), starts)
    found = []
    for upper in (True, False):
        stages = windows.stages_of(problem, floats, inner=upper)
        chain = windows._Chain(plane=floats, model=model, stages=stages, starts=starts, points=None, upper=upper)
        found.append((chain, windows._surfaces(chain, 10, -1.0, passes=1)))
    return found


@pytest.mark.usefixtures("frugal")
def test_bounds_over_windows_hold_what_a_simulation_finds(chains):
    (above, upper), (below, lower) = chains
    assert [stage.high for stage in above.stages] == [(1.0, 1.0), (0.6, 0.6)]
    assert above.stages[0].gate_high == (0.6, 0.6)
    assert NARROW[0] <= windows.prove_chain_above(upper, above)[1].log < -0.3
    least = windows.prove_chain_below(lower, below)
    assert least is not None
    assert -2.5 < least.log <= NARROW[1]


@pytest.mark.usefixtures("frugal")
@pytest.mark.parametrize(("which", "shift"), [(0, -0.7), (1, 0.6)])
def test_no_surface_of_a_stage_makes_a_bound_that_is_wrong(chains, which, shift):
    for chain, surfaces in chains:
        moved = [one.raised(shift) if k == which else one for k, one in enumerate(surfaces)]
        if chain.upper:
            assert windows.prove_chain_above(moved, chain)[1].log >= NARROW[0]
        else:
            least = windows.prove_chain_below(moved, chain)
            assert least is None or least.log <= NARROW[1]


def test_a_path_outside_when_a_window_begins_has_failed(chains):
    chain, surfaces = chains[0]
    low = surfaces[0].raised(-2.0)
    missing = windows.missing_above(low, chain.stages[0], surfaces[1])
    assert missing >= 2.0 - 1e-9  # V >= 0 beyond the gate
    wide = dataclasses.replace(chain.stages[0], gate_low=(-1.0, -1.0), gate_high=(1.0, 1.0))
    assert windows.missing_above(low, wide, surfaces[1]) >= missing  # the next grid ends at the gate
    chain, surfaces = chains[1]
    high = surfaces[0].raised(2.0)
    assert windows.missing_below(high, chain.stages[0], surfaces[1]) >= 2.0 - 0.1


# moving limits


def test_the_model_in_a_moving_frame_is_that_of_the_moved_state():
    safe = [cb.Inside(cb.Box([-1, -1], [1, 2], center=lambda t: [np.sin(t), 0.5 * t]))]
    safe.append(cb.Inside(cb.Box([-3.0], [1.5], coordinates=[1])))
    problem = walk(safe=safe, initial=[0.2, 0.2])
    axes = frames.frames_of(problem, inner=True)
    assert (axes[0].low, axes[0].high, axes[0].width) == (-1.0, 1.0, None)
    moved = frames.model_in(axes, exits._model(problem))
    t, y = 0.4, np.array([0.3, 0.6])
    width = min(0.5 * t + 2, 1.5) - (0.5 * t - 1)
    x = np.array([np.sin(t) + y[0], 0.5 * t - 1 + width * y[1]])
    drift = np.array([-x[0] + 0.3 * x[1], -x[1] - 0.3 * x[0]])
    wanted = [drift[0] - np.cos(t), (drift[1] - 0.5 + 0.5 * y[1]) / width]
    assert np.allclose(compile_numpy(moved.drift.tape)(t, *y), wanted)
    assert np.allclose(compile_numpy(moved.square.tape)(t, *y), 0.16 * np.diag([1, 1 / width**2]))
    starts = frames.starts_in(problem, axes)
    assert all(low <= place <= high for (low, high), place in zip(starts, (0.2, 1.2 / 2.5)))
    assert frames.points_in(problem, axes) is None  # rounding leaves no point that is surely one


# what is refused


def test_what_is_not_served_is_refused_in_words():
    moved = cb.Inside(cb.Box([-1, -1], [1, 1], center=lambda t: [0.1 * t, 0.0]))
    jumping = cb.Inside(cb.Box([-1, -1], [1, 1], center=lambda t: [0.5 * np.floor(2 * t), 0.0]))
    late = cb.Inside(cb.Box([-0.7, -0.7], [0.7, 0.7]), during=(0.5, 1.0))
    ball = cb.Inside(cb.Ball([0, 0], 0.9), during=(0.5, 1.0))
    for changes, message in (
        ({"safe": [moved, late]}, "not both"),
        ({"safe": [jumping]}, "without jumps"),
        ({"safe": [moved, cb.Inside(cb.Ball([0, 0], 0.9))]}, "moving boxes only"),
        ({"safe": [SQUARE, ball]}, "fixed boxes only"),
        ({"safe": [SQUARE, late], "initial": cb.GaussianStart([0.0, 0.0], 0.01 * np.eye(2))}, "random start"),
    ):
        with pytest.raises(InfeasibleError, match=message):
            bound_exits(walk(**changes))
    goal = cb.Box([-0.2, -0.2], [0.2, 0.2], center=lambda t: [0.1 * t, 0.0])
    with pytest.raises(InfeasibleError, match="moving targets"):
        bound_exits(walk(), target=goal)


@pytest.mark.slow
def test_bounds_with_a_target_and_over_windows_are_close():
    goal = bound_exits(walk(), target=cb.Box([-0.2, -0.2], [0.2, 0.2]), seconds=20.0)
    assert LATE[0] / math.log(10) <= goal.upper < math.log10(0.56)
    assert math.log10(0.2) < goal.lower <= LATE[1] / math.log(10)
    narrow = cb.Inside(cb.Box([-0.6, -0.6], [0.6, 0.6]), during=(1.0, 2.0))
    found = bound_exits(walk(initial=[0.1, 0.1], safe=[SQUARE, narrow], horizon=2.0), seconds=10.0)
    assert NARROW[0] / math.log(10) <= found.upper < math.log10(0.5)
    assert math.log10(0.18) < found.lower <= NARROW[1] / math.log(10)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(15))
@pytest.mark.parametrize("kind", KINDS)
def test_random_problems_hold_against_simulation(kind, seed):
    assert check(kind, seed, 4.0).startswith("fine")


def test_the_engine_answers_with_both_bounds(monkeypatch):
    bounds = -1.0, -2.0, "found", ([], [])
    monkeypatch.setattr("certbound.values.continuous.plane.bound_failing", lambda *given: bounds)
    problem = walk(reach=cb.Box([-0.2, -0.2], [0.2, 0.2]))
    found = bound_exits(until(problem, 1.0), target=problem.reach.region)
    assert (found.upper, found.lower) == pytest.approx((-1 / math.log(10), -2 / math.log(10)))
