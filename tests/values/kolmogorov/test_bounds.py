"""Certified bounds of failing by the backward equation: they hold, and a wrong proposal costs width, never truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import chebyshev
from scipy.linalg import expm

import certbound as cb
from certbound.values.kolmogorov import bound_failing
from certbound.values.kolmogorov.box_setting import stages_of
from certbound.values.kolmogorov.door import RATE, Search, largest_at_start, refined, side_of, starts_in
from certbound.values.kolmogorov.equation.mesh import extended
from certbound.values.kolmogorov.face_exits import face_of
from tests.checker.conftest import pushed

SHARES = {"half": 0.5, "nothing": 0.0}


def last(problem: cb.Problem, seconds: float = 1.0, delta: float = 0.0):
    return list(bound_failing(problem, seconds=seconds, delta=delta))[-1]


def survival(sigma: float, start: float, horizon: float, degree: int = 32) -> float:
    """P(|x| stays below 1) of dx = -x dt + sigma dW, by collocation at Chebyshev's points; off by less than 1e-9."""
    places = np.cos(np.pi * np.arange(degree + 1) / degree)
    rows = chebyshev.chebvander(places, degree)
    slope = chebyshev.chebval(places, chebyshev.chebder(np.eye(degree + 1))).T @ np.linalg.inv(rows)
    generator = (sigma**2 / 2 * slope @ slope - places[:, None] * slope)[1:-1, 1:-1]
    kept = np.concatenate([[0.0], expm(horizon * generator).sum(axis=1), [0.0]])
    return float(chebyshev.chebval(start, np.linalg.solve(rows, kept)))


def two_independent(sigma: float = 0.8) -> tuple[cb.Problem, float]:
    """Two copies of one state, and what fails by the product of survivals; coarse grids say something of both sides."""
    system = cb.ContinuousSystem(lambda x, y: [-x, -y], states=["x", "y"], diffusion=sigma * np.eye(2))
    both = cb.Problem(system, initial=[0.2, 0.2], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=2.0)
    return both, 1 - survival(sigma, 0.2, 2.0) ** 2


def oscillator() -> cb.Problem:
    system = cb.ContinuousSystem(lambda x, v: [v, -x - 0.5 * v], states=["x", "v"], diffusion=[[0.0], [0.5]])
    return cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -np.inf], [1, np.inf]))], horizon=4.0)


def test_two_independent_states_fail_as_often_as_the_bounds_say() -> None:
    problem, truth = two_independent()
    found = last(problem, seconds=1.5)
    assert found.lower <= truth <= found.upper
    assert found.upper < 1.15 * truth
    assert found.lower > 0.6 * truth


@pytest.mark.slow
def test_noise_in_the_velocity_alone_is_bounded_from_both_sides() -> None:
    problem = oscillator()
    found = last(problem, seconds=40.0)
    seen = cb.simulate_exits(problem, paths=20000, rng=np.random.default_rng(0), confidence=1 - 1e-6, halve=False)
    assert found.lower <= seen.upper
    assert found.upper >= seen.lower
    assert 0 < found.lower < found.upper < 1


@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize("wrong", ["noise", *SHARES])
def test_a_wrong_proposal_costs_width_and_never_truth(above: bool, wrong: str) -> None:
    problem, truth = two_independent()
    setting, rng = stages_of(problem)[0], np.random.default_rng(7)
    side = side_of([setting], 0.1, 12, above)
    side.propose()
    for rows in (side.values, side.rates):
        for k, row in enumerate(rows):
            rows[k] = row + 0.02 * rng.normal(size=row.shape) if wrong == "noise" else SHARES[wrong] * row
    bound, _, _ = refined(side, starts_in(problem))
    if above:
        assert bound >= truth
    else:
        assert -bound <= truth


@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e200])
def test_a_proposal_that_blew_up_proves_nothing(poison: float) -> None:
    problem, _ = two_independent()
    side = side_of([stages_of(problem)[0]], 0.1, 12, True)
    side.propose()
    side.values[3][7, 7] = poison
    assert refined(side, starts_in(problem))[0] == np.inf


def test_all_starts_of_a_box_are_covered_from_above_and_the_worst_counts_from_below() -> None:
    problem, _ = two_independent()
    at = {place: 1 - survival(0.8, place, 2.0) ** 2 for place in (0.0, 0.4)}
    for above in (True, False):
        side = side_of([stages_of(problem)[0]], 0.1, 12, above)
        side.propose()
        box, center, corner = (
            refined(side, starts_in(problem.replace(initial=start)))[0]
            for start in (cb.Box([0, 0], [0.4, 0.4]), [0.0, 0.0], [0.4, 0.4])
        )
        if above:
            assert box >= max(at[0.4], center, corner)
        else:
            assert at[0.4] >= -box > 0.1
            assert -box >= max(-center, -corner) - 1e-9


def test_the_engine_answers_in_a_verdict_and_says_how() -> None:
    problem, truth = two_independent()
    verdict = cb.verify_safety(problem.replace(delta=1.2 * truth), method="backward")
    assert verdict.status == "SAFE"
    assert "whose error is carried" in verdict.reason
    claim = json.loads(verdict.certificate_text(problem))["claim"]
    assert claim["method"] == "backward"
    assert float.fromhex(claim["log10_delta"]) >= verdict.log10_delta
    verdict = cb.verify_safety(problem.replace(delta=truth / 3), method="backward")
    assert verdict.status == "UNSAFE"
    claim = json.loads(verdict.certificate_text(problem))["claim"]
    assert float.fromhex(claim["log10_lower"]) <= verdict.log10_lower


def test_three_states_are_bounded_from_above() -> None:
    system = cb.ContinuousSystem(lambda x, y, z: [-x, -y, -z], states=["x", "y", "z"], diffusion=0.5 * np.eye(3))
    box = cb.Box([-1] * 3, [1] * 3)
    problem = cb.Problem(system, initial=[0.2] * 3, safe=[cb.Inside(box)], horizon=0.5)
    setting = stages_of(problem)[0]
    side = side_of([setting], 0.15, 7, True)
    side.propose()
    assert 1 - survival(0.5, 0.2, 0.5) ** 3 <= refined(side, starts_in(problem))[0] < 1


@pytest.mark.parametrize("far", [2.0, -2.0, 10.0, -10.0])
@pytest.mark.parametrize("above", [True, False])
def test_a_start_beyond_the_box_of_the_values_is_not_read_off_a_continued_spline(far: float, above: bool) -> None:
    """Where a coordinate has no limit, the box holds nearly all paths, and perhaps not one start out of very many."""
    problem = oscillator()
    side = side_of([stages_of(problem)[0]], 0.2, 8, above)
    side.propose()
    beyond = [side.axes[1].nodes[-1 if far > 0 else 0] + far]
    starts = starts_in(problem.replace(initial=[cb.Box([0, 0], [0, 0]), cb.Box([0, *beyond], [0, *beyond])]))
    found = largest_at_start(side, starts)[1]
    assert found == (1.0 if above else largest_at_start(side, starts_in(problem))[1])


def test_a_drift_that_turns_on_the_face_itself_lets_paths_leave_there() -> None:
    system = cb.ContinuousSystem(
        lambda x, y: [np.where(x < 1, 1.0, -1.0), -y], states=["x", "y"], diffusion=[[0.0], [0.5]]
    )
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=2.0)
    setting = stages_of(problem)[0]
    side = side_of([setting], 0.2, 8, True)
    assert face_of(side.axes, setting.drift, False, 0, 1, 1.0).leaves.all()
    assert not face_of(side.axes, setting.drift, False, 0, 0, 1.0).leaves.any()


@pytest.mark.parametrize("above", [True, False])
def test_the_steps_cover_the_horizon_from_above_and_stay_within_it_from_below(above: bool) -> None:
    from fractions import Fraction

    setting = stages_of(two_independent()[0])[0]
    for horizon in (0.3, 0.7, 1.1, 2.0, 1e-5, 37.7):
        side = side_of([replace(setting, horizon=horizon)], 0.2, 13, above)
        total = sum(map(Fraction, side.steps.tolist()))
        assert total >= Fraction(horizon) if above else total <= Fraction(horizon)


def test_a_state_that_rests_has_a_range_of_its_own() -> None:
    system = cb.ContinuousSystem(
        lambda x, y: [0 * x, -y], states=["x", "y"], diffusion=[[0.0], [0.5]]
    )
    problem = cb.Problem(system, initial=[0.5, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1.0)
    setting = stages_of(problem)[0]
    assert np.all(setting.range[0] < setting.range[1])
    found = last(problem, seconds=0.5)
    assert found.lower <= 1 - survival(0.5, 0.0, 1.0) <= found.upper


def test_a_second_search_goes_on_where_the_first_one_ended() -> None:
    problem, truth = two_independent()
    first = last(problem, seconds=0.8)
    assert first.runs >= 1
    *_, second = bound_failing(problem, seconds=2.5, before=first)
    assert second.runs > first.runs
    assert second.work > first.work
    assert first.lower <= second.lower <= truth <= second.upper <= first.upper
    assert list(bound_failing(problem, seconds=0.8, before=first)) == []
    other = next(bound_failing(problem.replace(horizon=1.9), seconds=0.8, before=first))
    assert other.runs == 1


def test_a_search_does_about_as_much_work_as_it_was_given() -> None:
    """A light swing: coarse grids are given up at once, which says nothing of what the next one takes."""
    swing = cb.ContinuousSystem(
        lambda x, v: [v, -9.12 * x - 0.29 * v], states=["x", "v"], diffusion=[[0.0], [0.1]]
    )
    box = cb.Box([-0.4, -1.0], [0.43, 1.05])
    problem = cb.Problem(swing, initial=[-0.311, 0.0], safe=[cb.Inside(box)], horizon=5.0, delta=0.0131)
    for seconds in (2.0, 4.0):
        *_, found = bound_failing(problem, seconds=seconds, delta=problem.delta)
        assert found.work <= 1.6 * seconds * RATE[2]


def test_passes_end_where_the_work_does() -> None:
    problem, truth = two_independent()
    side = side_of([stages_of(problem)[0]], 0.1, 12, True)
    side.propose()
    bound, _, passes = refined(side, starts_in(problem), most=2.0)
    assert 2.0 <= passes < 3.0
    assert bound >= truth


def test_passes_contract_at_corners_that_paths_leave_within_a_small_part_of_a_step() -> None:
    """A pendulum's lower bound: noise in the velocity alone, cells at the noise-free limits 1e-4 of the range."""
    pendulum = cb.ContinuousSystem(
        lambda x, v: [v, -np.sin(x) - 0.3 * v], states=["x", "v"], diffusion=[[0.0], [0.5]]
    )
    box = cb.Box([-1.5, -2.2], [1.5, 2.2])
    problem = cb.Problem(pendulum, initial=[0.0, 0.0], safe=[cb.Inside(box)], horizon=4.0)
    side = side_of([stages_of(problem)[0]], 0.06, 14, False)
    side.propose()
    left = []
    for _ in range(9):
        residuals = side.residuals(side.begun)
        left.append(float(sum(h * r.max() for h, r in zip(side.steps, residuals))))
        side.correct(residuals)
    # 1.4e-4; 9.5e-4 with a margin of .02 in the end, 6e-4 where sources end at once
    assert left[8] < 3e-4 * left[0]


def test_limits_whose_layer_no_cell_resolves_leave_a_lower_bound_little_error() -> None:
    system = cb.ContinuousSystem(lambda x, y: [4 * (y - x), -y], states=["x", "y"], diffusion=0.3 * np.eye(2))
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    problem = cb.Problem(system, initial=[0.1, 0.1], safe=safe, horizon=1.0)
    side = side_of([stages_of(problem)[0]], 0.12, 7, above=False)
    side.propose()
    for _ in range(3):
        side.correct(side.residuals(side.begun))
    # .063, and .21 where exits count up to a fall by twelve powers of e a cell
    assert largest_at_start(side, starts_in(problem))[1] < 0.1


def test_exits_count_from_below_once_cells_resolve_the_layer_at_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise leads paths over a third of a cell within the layer at the end: what counts exits there at once is paid
    for by more than they are worth."""
    still = cb.ContinuousSystem(lambda x, y: [0.0, 0.0], states=["x", "y"], diffusion=0.1 * np.eye(2))
    problem = cb.Problem(still, initial=[0.3, 0.5], safe=[cb.Inside(cb.Box([0, 0], [1, 1]))], horizon=4.0)

    def lower() -> float:
        side = side_of(stages_of(problem), 0.2, 12, False)
        side.propose()
        return -refined(side, starts_in(problem))[0]

    found = lower()
    assert found > 0.08
    monkeypatch.setattr("certbound.values.kolmogorov.carry._RESOLVED", 1e-9)
    assert lower() < 0.75 * found


def test_exits_that_the_flow_leads_across_a_limit_count_sooner_than_noise_alone_would_resolve_them() -> None:
    """Of .17 that leave .127 were counted where cells had to be resolved by noise alone."""
    system = cb.ContinuousSystem(lambda x, y: [0.5, -y], states=["x", "y"], diffusion=np.diag([0.1, 0.3]))
    problem = cb.Problem(system, initial=[0.4, 0.0], safe=[cb.Inside(cb.Box([-1, -2], [1, 2]))], horizon=1.0)
    side = side_of(stages_of(problem), 0.1, 12, False)
    side.propose()
    assert -largest_at_start(side, starts_in(problem))[0] > 0.15


@pytest.mark.parametrize("build", [lambda: two_independent()[0], pushed], ids=["still", "changing"])
def test_residuals_proved_while_the_error_is_solved_for_are_those_proved_after_it(
    build: Callable[[], cb.Problem], monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    monkeypatch.setattr("certbound.values.kolmogorov.carry._BATCH", 20_000)  # several groups of slabs
    first, second = (side_of(stages_of(build()), 0.2, 12, True) for _ in range(2))
    for side in (first, second):
        side.propose()
        side.correct(side.residuals(True))
    for _ in range(2):
        on_the_way = first.corrected(first.residuals())
        second.correct(second.residuals())
        for own, other in zip(on_the_way, second.residuals(), strict=True):
            np.testing.assert_array_equal(own, other)


def test_an_error_that_overflows_leaves_no_residuals() -> None:
    side = side_of(stages_of(two_independent()[0]), 0.2, 12, True)
    side.propose()
    assert side.corrected([np.full_like(one, 1e130) for one in side.residuals(True)]) == []
    assert not side.finite


def test_a_first_solution_far_above_the_target_leaves_the_upper_side_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = two_independent()
    sides: list[bool] = []
    solved = Search._solved
    monkeypatch.setattr(Search, "_solved", lambda self, side: (sides.append(side.above), solved(self, side))[1])
    found = last(problem, seconds=2.0, delta=truth / 10)
    assert found.lower > truth / 10
    assert True not in sides
    sides.clear()
    last(problem, seconds=2.0, delta=truth / 1.5)
    assert sides[0]


def test_axes_go_on_beyond_their_ends_by_more_nodes_than_they_have():
    nodes = np.array([0.0, 1.0, 3.0])
    assert extended(nodes, 4, 1).tolist() == [-6.0, -5.0, -3.0, -1.0, 0.0, 1.0, 3.0, 5.0]


def test_ranges_do_not_depend_on_units():
    ranges = []
    for unit in (1.0, 1e-7):  # one state, and the way of the other one, that nothing limits above
        system = cb.ContinuousSystem(lambda x, y: [y, -x - y], states=["x", "y"], diffusion=[[0.0], [0.1 * unit]])
        safe = cb.Inside(cb.Box([-unit, -np.inf], [np.inf, np.inf]))
        problem = cb.Problem(system, initial=[0.5 * unit, 0.0], safe=[safe], horizon=1.0)
        ranges.append(stages_of(problem)[0].range / unit)
    assert ranges[1] == pytest.approx(ranges[0], rel=1e-9)
