"""The matrix inequality of a step, what holds beyond walls, sums of windows: proved when so, refused when not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.quadratic.form_matrices import side_forms
from certbound.quadratic.steps import step_bounds, step_proof
from certbound.quadratic.steps.secants import Secants
from certbound.quadratic.steps.step_program import StepProposal, Steps
from certbound.quadratic.steps.step_proof import prove_steps
from certbound.rigor.intervals import Interval

CORNER = np.diag([0.0, 0.0, 1.0])


def by_hand(horizon: int = 1, terms: int = 1, start: float = 0.0) -> Steps:
    """Two states in [-1, 1]^2, and a step that is stated by random numbers."""
    system = cb.DiscreteSystem(lambda x: [0.5 * x[0], 0.5 * x[1]], states=2, noise=cb.Gaussian(std=0.1))
    problem = cb.Problem(
        system, initial=cb.Box([-start, -start], [start, start]), safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))],
        horizon=horizon,
    )  # fmt: skip
    given = step_bounds._steps(problem, next(step_bounds._settings(problem)))
    rng = np.random.default_rng(7)
    matrix, rows = rng.normal(size=(3, 3 + terms)) / 2, rng.normal(size=(terms, 3 + terms))
    rows[:, 3:] = 0.0
    matrix[2] = [0.0, 0.0, 1.0] + [0.0] * terms
    noise = np.vstack([rng.normal(size=(2, 2)) / 4, np.zeros((1, 2))])
    return replace(given, secants=Secants(matrix=Interval.point(matrix), rows=Interval.point(rows)), noise=noise)


def proposed(matrices: Any, window: int = 1, **changes: Any) -> StepProposal:
    matrices = np.array(matrices, dtype=float)
    pieces = len(matrices) - 1
    given = {
        "steps": np.arange(pieces + 1), "window": window, "matrices": matrices, "weights": np.zeros((pieces, 2, 2)),
        "scales": np.zeros((pieces, 2, 1)), "wall_weights": (np.zeros((pieces + 1, 1)),),
    }  # fmt: skip
    return StepProposal(**{**given, **changes})


def image(given: Steps) -> tuple[Any, float]:
    """What the mean of exp(V+) is as a form over (z, p), and log det N."""
    joined, g = given.secants.matrix.mid, given.noise
    free = np.eye(2) - g.T @ AFTER @ g
    assert np.linalg.eigvalsh(free).min() > 0.1
    return joined.T @ (AFTER + AFTER @ g @ np.linalg.inv(free) @ g.T @ AFTER) @ joined, np.log(np.linalg.det(free))


def tight(given: Steps, mu: Any, tau: float) -> Any:
    """The least H_t: what is left of the inequality once p is as bad as it may be has eigenvalue 0."""
    row = given.secants.rows.mid
    form, log = image(given)
    whole = form + tau * row.T @ row
    over = tau - whole[3, 3]
    assert over > 0
    rest = whole[:3, :3] + np.outer(whole[:3, 3], whole[:3, 3]) / over
    return rest - log * CORNER + side_forms(-np.ones(2), np.ones(2)).T @ mu


AFTER = np.array([[1.0, 0.3, 0.2], [0.3, 0.8, -0.1], [0.2, -0.1, -2.0]])


def excess(given: Steps, before: Any, mu: Any, tau: float) -> float:
    proposal = proposed([before, AFTER], weights=np.array([[mu, mu]]), scales=np.full((1, 2, 1), tau))
    return step_proof._excess(given, proposal, np.array([0]))


@pytest.mark.parametrize("mu", [[0.0, 0.0], [0.3, 0.1]])
def test_the_least_function_is_proved_and_none_below(mu: list[float]) -> None:
    given = by_hand()
    least = tight(given, mu, 3.0)
    assert excess(given, least + 1e-9 * np.eye(3), mu, 3.0) < 1e-8
    vectors, row = np.linalg.eigh(least)[1], given.secants.rows.mid[0, :3]
    form, log = image(given)
    for lowered in (1e-3 * CORNER, *(1e-3 * np.outer(v, v) for v in (row, *vectors.T))):
        main = least - lowered + log * CORNER - side_forms(-np.ones(2), np.ones(2)).T @ mu
        whole = np.block([[main, np.zeros((3, 1))], [np.zeros((1, 3)), 3.0]]) - form
        lacking = -np.linalg.eigvalsh(whole - 3.0 * given.secants.rows.mid.T @ given.secants.rows.mid).min()
        assert excess(given, least - lowered, mu, 3.0) > 1.5 * lacking * (1 - 1e-6) > 1e-6


def test_multipliers_below_zero_prove_nothing() -> None:
    given = by_hand()
    for mu, tau in (([-0.3, -0.1], 3.0), ([0.0, 0.0], -3.0)):
        least = tight(given, mu, abs(tau))
        assert excess(given, least + 1e-9 * np.eye(3), mu, tau) > 0.01
    proposal = proposed(np.zeros((2, 3, 3)), steps=np.array([0, 5]))
    parts = np.array([[[1.0, -4.0], [3.0, 8.0]]])
    between = step_proof._between(proposal, parts, np.arange(5))
    assert np.array_equal(between, [[1.0, 0.0], [1.5, 0.0], [2.0, 2.0], [2.5, 5.0], [3.0, 8.0]])


def test_what_is_lacking_is_paid_for_on_the_whole_box() -> None:
    """|(z, p)|^2 is at most 3 and the square of the largest |C z|."""
    given = by_hand()
    least, row = tight(given, [0.0, 0.0], 3.0), given.secants.rows.mid[0, :3]
    lacking = 0.01
    found = excess(given, least - lacking * np.eye(3), [0.0, 0.0], 3.0)
    corners = np.array([[a, b, 1.0] for a in (-1, 1) for b in (-1, 1)])
    form, log = image(given)
    for z in [*corners, *np.hstack([np.random.default_rng(0).uniform(-1, 1, (200, 2)), np.ones((200, 1))])]:
        p = np.linspace(-1, 1, 101) * abs(row @ z)
        zp = np.vstack([np.tile(z, (101, 1)).T, p])
        grown = np.einsum("ip,ij,jp->p", zp, form, zp) / 2 - log / 2
        assert grown.max() <= z @ (least - lacking * np.eye(3)) @ z / 2 + found
    floor = lacking / 2 * (3 + np.abs(row).sum() ** 2)
    assert found >= floor * (1 - 1e-6)


def test_functions_that_are_not_convex_or_whose_mean_is_infinite_prove_nothing() -> None:
    given = by_hand()
    for after in (np.diag([-1e-3, 1.0, -1.0]), np.diag([9.0, 9.0, -1.0]), np.diag([999.0, 999.0, -1.0])):
        proposal = proposed([9e9 * np.eye(3), after], scales=np.full((1, 2, 1), 1e3))
        assert step_proof._excess(given, proposal, np.array([0])) == np.inf


def at_rest(start: float, *constants: float) -> tuple[Steps, StepProposal]:
    """Steps that stay where they are, but for 1e-9, and V_t = x1 - 1 + c_t and a little curvature."""
    given = by_hand(horizon=len(constants) - 1, terms=0, start=start)
    secants = Secants(matrix=Interval.point(np.eye(3)), rows=Interval.point(np.zeros((0, 3))))
    given = replace(given, secants=secants, noise=np.vstack([1e-9 * np.eye(2), np.zeros((1, 2))]))
    tilt = np.array([[0.01, 0, 1.0], [0, 0.01, 0], [1.0, 0, -2.0]])
    proposal = proposed(
        [tilt + 2 * c * CORNER for c in constants], scales=np.zeros((len(constants) - 1, 2, 0)),
        wall_weights=(np.ones((len(constants), 1)),),
    )  # fmt: skip
    return given, proposal


def upper_wall(given: Steps) -> Any:
    return next(wall for wall in given.setting.walls if wall.side == (0, 1))


def test_every_step_of_the_window_has_to_be_above_zero_beyond_the_wall() -> None:
    given, proposal = at_rest(0.0, 0, 0, 0, 0, 0)
    wall = upper_wall(given)
    assert step_proof._gap(given, wall, replace(proposal, window=4), 0) <= 1e-9
    for window, step, gap in ((1, 4, 0.1), (2, 3, 0.1), (4, 1, 0.1), (3, 1, 0.0), (4, 0, 0.0)):
        lower = proposal.matrices.copy()
        lower[step, 2, 2] -= 0.1  # V by .05
        assert step_proof._gap(given, wall, replace(proposal, window=window, matrices=lower), 0) <= max(gap, 1e-9)
        assert gap == 0 or step_proof._gap(given, wall, replace(proposal, window=window, matrices=lower), 0) >= 0.05
        lower[step, 2, 2] -= 0.3
        found = step_proof._gap(given, wall, replace(proposal, window=window, matrices=lower), 0)
        assert (found == np.inf) == (gap > 0)
    sinking = proposal.matrices * np.array([[1, 1, -1], [1, 1, 1], [-1, 1, -1]])
    turned = replace(proposal, matrices=sinking, wall_weights=(-np.ones((5, 1)),))
    assert step_proof._gap(given, wall, turned, 0) == np.inf


def test_all_walls_of_a_group_have_to_hold() -> None:
    given, proposal = at_rest(0.0, 0, 0)
    wall, other = upper_wall(given), next(w for w in given.setting.walls if w.side == (0, 0))
    both = replace(proposal, wall_weights=proposal.wall_weights * 2)
    assert prove_steps(given, [wall], both).excess < 1e-6
    assert prove_steps(given, [wall, other], both).excess == np.inf


@pytest.mark.parametrize("chunk", [1, 256])
def test_gaps_and_excesses_of_all_steps_are_added(monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    """V grows by .2 and then by .3: by .4 and .6 in H, half of which is paid for |z|^2 up to 3."""
    monkeypatch.setattr(step_proof, "_CHUNK", chunk)
    for end, gap in ((0.0, 0.0), (-0.05, 0.05)):
        given, proposal = at_rest(0.0, end - 0.5, end - 0.3, end)
        assert 1.5 + gap <= prove_steps(given, [upper_wall(given)], proposal).excess < 1.5001 + 2 * gap


def test_windows_cover_the_horizon_and_their_bounds_are_added_at_the_worst_start() -> None:
    constants = [-5.0, -4.0, -3.5, -3.2, -3.1, -3.0, -3.0]
    given, proposal = at_rest(0.4, *constants)
    for window in (1, 2, 4, 5, 6):
        proof = replace(prove_steps(given, [upper_wall(given)], replace(proposal, window=window)), excess=0.5)
        values = [np.exp(0.5 + constants[k] - 1 + 0.4 + 0.005 * 0.32) for k in range(0, 6, window)]
        found = [float(value.mid()) for value in proof.at_corners()]
        assert np.isclose(max(found), sum(values), rtol=1e-6)
        assert np.isclose(min(found), sum(values) * np.exp(-0.8), rtol=1e-6)
        worst = min(0.0, np.log10(2 * sum(values)))
        assert np.isclose(step_bounds._level([proof, proof]), worst, rtol=1e-6)


@pytest.mark.parametrize("curve", [[-1e-3, 0.5], [0.5, -1e-3]])
def test_starts_are_largest_at_a_corner_of_convex_functions_alone(curve: list[float]) -> None:
    given, proposal = at_rest(0.4, 0.0, 0.0)
    bent = proposal.matrices.copy()
    bent[0, [0, 1], [0, 1]] = curve
    fixed = replace(proposal, matrices=bent)
    assert np.isfinite(prove_steps(given, [upper_wall(given)], proposal).excess)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(step_proof, "_convex", lambda one: one)
        assert prove_steps(given, [upper_wall(given)], fixed).excess == np.inf


def test_all_numbers_that_a_step_may_have_are_looked_at() -> None:
    given = by_hand()
    least = tight(given, [0.0, 0.0], 3.0) + 1e-9 * np.eye(3)
    for part in ("matrix", "rows"):
        middle = getattr(given.secants, part).mid
        wide = replace(given, secants=replace(given.secants, **{part: Interval.around(middle, 1e-3)}))
        assert excess(given, least, [0.0, 0.0], 3.0) < 1e-8
        assert excess(wide, least, [0.0, 0.0], 3.0) > 1e-3


def test_every_group_of_walls_is_proved_or_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """What serves one side is proved anew at the opposite one, and refused where it says less there."""
    given, proposal = at_rest(0.0, -3.0, -3.0)
    groups, asked = [(wall,) for wall in given.setting.walls], []

    def proved(given: Steps, walls: Any, *_: Any) -> Any:
        asked.append(walls[0].side)
        side, sign = walls[0].side
        tilt = np.array([[0.01, 0, 0], [0, 0.01, 0], [0, 0, -2.0]])
        tilt[side, 2] = tilt[2, side] = 1.0 if sign else -1.0
        return prove_steps(given, walls, replace(proposal, matrices=np.array([tilt, tilt])))

    monkeypatch.setattr(step_bounds, "_proved", proved)
    found = step_bounds._all_proved(given, groups, np.arange(2), 1, np.inf)
    assert len(found) == 4
    assert all(proof is not None and np.isfinite(proof.excess) for proof in found)
    assert asked == [(0, 0), (1, 0)]
    aside = replace(given, corners=Interval.point([[0.3, 0.0, 1.0]]))  # nearer to the upper side
    assert len(step_bounds._all_proved(aside, groups, np.arange(2), 1, np.inf)) == 4
    assert asked[2:] == [(0, 0), (0, 1), (1, 0)]
    half = lambda given, walls, *_: None if walls[0].side[0] else proved(given, walls)  # noqa: E731
    monkeypatch.setattr(step_bounds, "_proved", half)
    assert step_bounds._sum(step_bounds._all_proved(given, groups, np.arange(2), 1, np.inf)) == 0.0
