"""Semidefinite programs propose good metrics by several routes, and a stall is never read as infeasibility."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest

from certbound.constants.jacobians.affine import AffineSet
from certbound.constants.jacobians.jacobian_sets import UnionSet, VertexPolytope, as_set
from certbound.constants.programs.centers import center_metric, center_multipliers, reachable_value
from certbound.constants.programs.lmi import ErosionProgram, RateProgram, design_feedback, solve
from certbound.constants.programs.proposals import smallest_value, spectral_bound
from certbound.constants.programs.sectors import centred, contraction_value, lmi_blocks
from certbound.constants.recheck import certify_gain, certify_rate
from certbound.errors import InfeasibleError, SolverError
from tests.constants.chain_matrices import DIRECTIONS, NOISE, chain_sector

LOWER = 0.9801937735804832  # squared spectral radius of the chain with slopes 0


def best_by_program(form: str, *, full: bool = False) -> float:
    members = chain_sector(3)
    program = RateProgram(members, continuous=False, form=form, full=full)
    return smallest_value(program, members, continuous=False, lower=LOWER, tolerance=4e-4)[1]


@pytest.mark.parametrize(("form", "full"), [("vertices", False), ("sector", False), ("sector", True)])
def test_vertices_diagonal_and_full_multipliers_reach_the_spectral_bound_of_the_chain(form, full):
    assert LOWER <= best_by_program(form, full=full) <= LOWER + 8e-4


@pytest.mark.parametrize("continuous", [False, True])
def test_the_method_of_centres_agrees_with_the_semidefinite_program(continuous):
    rng = np.random.default_rng(3)
    members = VertexPolytope(matrices=0.4 * rng.normal(size=(1, 3, 3)) + 0.2 * rng.normal(size=(4, 3, 3)))
    lower = spectral_bound(members, continuous=continuous)
    program = RateProgram(members, continuous=continuous)
    _, by_program = smallest_value(program, members, continuous=continuous, lower=lower, tolerance=1e-5)
    center = center_metric(lmi_blocks(members), continuous=continuous, tolerance=1e-6)
    assert center.value == pytest.approx(by_program, abs=2e-4)
    assert lower <= min(center.value, by_program) + 1e-9
    reached = contraction_value(center.metric, members.vertices(), continuous=continuous)
    assert (reached if continuous else reached**2) == pytest.approx(center.value, rel=1e-9, abs=1e-9)


def test_centres_of_sectors_and_vertices_agree_on_the_chain():
    members = chain_sector(3)
    for form in ("sector", "vertices"):
        center = center_metric(lmi_blocks(members, form=form), continuous=False, lower=LOWER, tolerance=4e-4)
        assert LOWER - 1e-12 <= center.value <= LOWER + 4e-4
        metric = (center.metric + center.metric.T) / 2
        assert certify_gain(metric, members) ** 2 <= LOWER + 5e-4


def test_multipliers_of_a_given_metric_lose_little_on_the_chain():
    members = chain_sector(3)
    metric = center_metric(lmi_blocks(members, form="sector"), continuous=False, tolerance=1e-4).metric
    exact = contraction_value(metric, members.vertices(), continuous=False) ** 2
    found = center_multipliers(metric, centred(members), continuous=False)
    assert exact - 1e-12 <= found.value <= exact + 1e-5


def test_equal_slopes_use_block_multipliers_and_beat_independent_ones():
    rotation = np.array([[0.0, 1.0], [-1.0, 0.0]])
    shared = AffineSet(center=-np.eye(2), terms=[rotation], low=[-5.0], high=[5.0])  # mu = -1 throughout
    members = shared.sector()
    program = RateProgram(members, continuous=True, form="sector")
    metric, margin = program.propose(-0.99)
    assert margin > 0
    assert certify_rate(metric, shared) < -0.98
    assert reachable_value(np.eye(2), shared, continuous=True) == pytest.approx(-1.0)


def test_the_condition_number_is_bounded():
    members = as_set([[-1.0, 30.0], [0.0, -1.0]])
    metric, margin = RateProgram(members, continuous=True, max_condition=50.0).propose(-0.9)
    assert np.linalg.cond(metric) <= 50.0 * (1 + 1e-6)
    assert margin < 0
    _, margin = RateProgram(members, continuous=True, max_condition=1e6).propose(-0.9)
    assert margin > 0


def test_a_union_is_served_by_one_metric():
    members = UnionSet(members=[as_set([[-1.0, 2.0], [0.0, -1.0]]), as_set([[-1.0, 0.0], [0.2, -1.0]])])
    metric, margin = RateProgram(members, continuous=True).propose(-0.5)
    assert margin > 0
    assert certify_rate(metric, members) < -0.5


def test_the_margin_is_negative_where_no_metric_exists_and_the_status_is_still_optimal():
    program = RateProgram(as_set([[0.5, 0.0], [0.0, -1.0]]), continuous=True)
    _, margin = program.propose(0.4)
    assert margin < 0
    assert program.status == "optimal"
    assert program.propose(0.6)[1] > 0


def test_the_erosion_program_is_best_for_the_clearances_it_was_given():
    members = chain_sector(3)
    start = center_metric(lmi_blocks(members, form="sector"), continuous=False, tolerance=1e-4).metric
    program = ErosionProgram(members, DIRECTIONS, [NOISE], start, continuous=False)

    def ratios(metric: np.ndarray, weights: np.ndarray) -> np.ndarray:
        squares = np.einsum("ji,ik,jk->j", DIRECTIONS, np.linalg.inv(metric), DIRECTIONS)
        noise = np.linalg.eigvalsh(NOISE.T @ metric @ NOISE)
        return np.sqrt(squares * (0.7 * noise[-1] + 0.3 * noise.sum())) / weights

    choices = np.array([[0.66, 0.56, 0.45, 1.17], [1.0, 1.0, 1.0, 1.0]])
    found = [program.propose(0.9806, 0.7, 0.3, weights) for weights in choices]
    for own, other, weights in zip(found, found[::-1], choices):
        assert certify_gain(own, members) ** 2 <= 0.9806 + 1e-6
        assert ratios(own, weights).max() < 0.99 * ratios(other, weights).max()
    assert np.sort(ratios(found[0], choices[0]))[-2] > 0.999 * ratios(found[0], choices[0]).max()
    for scale in (3, 1e200):
        np.testing.assert_allclose(program.propose(0.9806, 0.7, 0.3, scale * choices[0]), found[0], rtol=1e-6)


def test_a_feedback_and_its_metric_are_designed_together():
    for continuous, matrix, column in (
        (True, [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]),
        (False, [[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]]),
    ):
        members = VertexPolytope(matrices=np.array([matrix, np.array(matrix) * [[1, 1], [1, 0.9]]]))
        design = design_feedback(members, column, continuous=continuous, max_gain=20.0)
        assert np.linalg.norm(design.feedback, 2) <= 20.0 * (1 + 1e-6)
        closed = members.vertices() + np.array(column) @ design.feedback
        certified = (certify_rate if continuous else certify_gain)(design.metric, closed)
        assert certified <= design.value + 1e-9
        assert certified < (-0.5 if continuous else 0.95)


def test_a_feedback_that_is_asked_too_much_is_infeasible_with_the_numbers():
    with pytest.raises(InfeasibleError, match=r"smallest value found is .*raise one of the three bounds"):
        design_feedback(as_set(np.eye(2)), [[0.0], [1.0]], continuous=True, max_gain=1.0, at_most=-1.0)


class Stalling:
    """A program whose solver stalls or raises."""

    def __init__(self, statuses: list[str]) -> None:
        self.statuses, self.calls, self.status = statuses, [], None

    def solve(self, solver: str, **_: object) -> None:
        self.calls.append(solver)
        self.status = self.statuses[len(self.calls) - 1]
        if self.status == "raise":
            raise cp.SolverError("stalled")


def test_a_stall_is_answered_by_another_setting_and_another_solver():
    for statuses in (["optimal"], ["infeasible", "optimal"], ["raise", "optimal_inaccurate", "optimal"]):
        problem = Stalling(statuses)
        assert solve(problem) == "optimal"
        assert len(problem.calls) == len(statuses)


def test_when_every_solver_stalls_the_error_says_what_was_tried():
    with pytest.raises(SolverError, match="CLARABEL: infeasible; CLARABEL: SolverError; SCS: unbounded"):
        solve(Stalling(["infeasible", "raise", "unbounded"]))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: lmi_blocks(as_set(np.eye(2)), form="other"), '"vertices" or "sector"'),
        (lambda: RateProgram(as_set(np.eye(2)), continuous=True, max_condition=1.0), "must exceed 1"),
        (lambda: RateProgram(chain_sector(11), continuous=True, form="sector", full=True), "k = 11 exceeds 10"),
        (lambda: design_feedback(as_set(np.eye(2)), [[1.0]], continuous=True), "input_matrix"),
    ],
)
def test_malformed_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
