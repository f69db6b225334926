"""Pieces of time: what is stated of a row over them holds at every time, by matrix exponentials in floats."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from flint import arb, arb_mat, ctx

import certbound as cb
from certbound.checker.affine.affine_limits import affine_of, split_source
from certbound.checker.affine.crossings import rates_over
from certbound.checker.affine.gramians import Transitions
from certbound.checker.affine.row_pieces import Follower, Piece, leaves_of, sources_of
from certbound.checker.balls import matrix
from certbound.checker.report import Budget
from certbound.safety.certificates import law_proof
from tests.checker.affine.models import correlated, linear_problem, oscillator, read

HORIZON = 6.0
LEVELS = (5, 5, 4, 3, 2, 1)
DRAWN = cb.GaussianStart([0.2, -0.1], [[0.2, 0.05], [0.05, 0.1]])
PUSHED: dict[str, Any] = {"gain": [[0.1], [-0.05]], "drift": [0.05, 0.1], "initial": cb.Box([-0.1, 0.0], [0.1, 0.2])}
BUILDS = {
    "smooth": oscillator(horizon=HORIZON), "rough": correlated(horizon=HORIZON),
    "a normal start": correlated(horizon=HORIZON, initial=DRAWN),
    "pushed": linear_problem([[0, 1], [-1, -0.2]], [[0], [0.2]], [9.0, 9.0], horizon=HORIZON, **PUSHED),
}  # fmt: skip


def exact_law(a: Any, g: Any, start: Any, t: float) -> tuple[Any, Any]:
    """exp(A t) and the covariance, by Van Loan's matrix."""
    n = len(a)
    whole = scipy.linalg.expm(np.block([[-a, g @ g.T], [np.zeros((n, n)), a.T]]) * t)
    forward = whole[n:, n:].T
    return forward, forward @ whole[:n, n:] + forward @ start @ forward.T


def followed(name: str, row: list[float]) -> tuple[list[Piece], Any, Any, Any, Any]:
    problem, budget = BUILDS[name], Budget(60.0)
    leaves = leaves_of(LEVELS)
    assert leaves is not None
    with ctx.workprec(192):
        affine = affine_of(read(problem), budget)
        loss = None
        if affine.covariance is not None:
            stated = law_proof(problem)[0]["loss"]
            loss = matrix([[float.fromhex(x) for x in one] for one in stated])
        gain, lost = split_source(affine, loss, budget)
        transitions = Transitions(affine.slope, sources_of(affine, gain, lost), affine.drift, HORIZON, 5, budget)
        pieces = Follower(affine, transitions, budget).pieces(list(map(arb, row)), leaves, smooth=False)
        own = float((arb_mat([row]) * affine.noise * arb_mat([row]).transpose())[0, 0].upper())

    def floats(m: Any) -> Any:
        return np.array([float(x.mid()) for x in m.entries()]).reshape(m.nrows(), m.ncols())

    start = np.zeros((2, 2)) if affine.covariance is None else floats(affine.covariance)
    return pieces, floats(affine.slope), floats(affine.diffusion), start, own


@pytest.mark.parametrize("row", [[1.0, 0.0], [0.3, -0.7]])
@pytest.mark.parametrize("name", BUILDS)
def test_what_is_known_of_a_row_holds_at_every_time(name: str, row: list[float]) -> None:
    pieces, a, g, start, _ = followed(name, row)
    r = np.array(row)
    slack = 1e-9
    assert pieces[0].start == 0
    assert float(pieces[-1].end) == HORIZON
    for piece, following in zip(pieces, [*pieces[1:], None]):
        assert following is None or following.start == piece.end
        for t in np.linspace(float(piece.start), float(piece.end), 7):
            _, v = exact_law(a, g, start, t)
            s2, c, d = r @ v @ r, r @ a @ v @ r, r @ a @ a @ v @ r
            e, top = r @ a @ v @ a.T @ r, r @ a @ a @ a @ v @ (r @ a @ a @ a)
            assert float(piece.s_low) - slack <= s2 <= float(piece.s_high) + slack
            assert float(piece.c_low) - slack <= c <= float(piece.c_high) + slack
            assert float(piece.d_low) - slack <= d
            assert e <= float(piece.e_high) + slack
            assert top <= float(piece.v_high) + slack


def test_the_mean_lies_between_its_bounds_for_the_worst_starts_and_disturbances() -> None:
    row = [0.3, -0.7]
    pieces, a, _, _, _ = followed("pushed", row)
    r, c, e = np.array(row), np.array([0.05, 0.1]), np.array([0.1, -0.05])
    generator = np.random.default_rng(3)
    for _ in range(20):
        x, d = generator.choice([[-0.1, 0.0], [0.1, 0.2], [0.1, 0.0], [-0.1, 0.2]]), generator.choice([-1.0, 1.0])
        whole = np.zeros((3, 3))
        whole[:2, :2], whole[:2, 2] = a, c + d * e
        for piece in pieces:
            for share in (0.0, 0.3, 0.6, 1.0):
                t = float(piece.start) + share * float(piece.length)
                mean = r @ (scipy.linalg.expm(whole * t) @ [*x, 1.0])[:2]
                low, low_last, high, high_last = (float(end) for end in piece.means)
                assert low + share * (low_last - low) - 1e-12 <= mean <= high + share * (high_last - high) + 1e-12


@pytest.mark.parametrize("row", [[1.0, 0.0], [0.3, -0.7]])
@pytest.mark.parametrize("name", ["rough", "a normal start"])
def test_the_correlation_decays_no_faster_than_is_stated(name: str, row: list[float]) -> None:
    pieces, a, g, start, own = followed(name, row)
    r, seen = np.array(row), 0
    for piece in pieces[1:]:
        for length in (0.01, 0.05, 0.1):
            with ctx.workprec(128):
                rates = rates_over(piece, arb(own), arb(length))
            if not rates.decay.is_finite():
                continue
            seen += 1
            for s in np.linspace(float(piece.start), float(piece.end) - length, 5):
                for x in np.linspace(0.0, length, 4):
                    forward, _ = exact_law(a, g, start, x)
                    _, v = exact_law(a, g, start, s)
                    _, later = exact_law(a, g, start, s + x)
                    first, last = r @ v @ r, r @ later @ r
                    correlation = r @ forward @ v @ r / np.sqrt(first * last)
                    assert correlation >= np.exp(-float(rates.decay) * x) - 1e-10
                    assert last <= first * np.exp(2 * float(rates.spread) * x) + 1e-10
    assert seen > 3


@pytest.mark.parametrize("levels", [(1, 2), (1, 2, 1), (2, 1, 2), (0, 0), (1, 1, 1), (3,)])
def test_pieces_that_leave_a_gap_or_overlap_are_none(levels: tuple[int, ...]) -> None:
    assert leaves_of(levels) is None


def test_halves_of_halves_fill_the_horizon() -> None:
    leaves = leaves_of((2, 2, 1))
    assert leaves is not None
    assert [(leaf.place, leaf.level) for leaf in leaves] == [(0, 2), (1, 2), (2, 1)]


@pytest.mark.parametrize("bits", [128, 400])
def test_transitions_gramians_and_drifts_are_those_of_a_stiff_slope(bits: int) -> None:
    slope = [[-1.0, 30.0], [0.0, -1e4]]
    with ctx.workprec(bits):
        source = matrix([[0.0, 0.0], [0.0, 4.0]])
        found = Transitions(matrix(slope), {"gain": source}, matrix([[1.0], [2.0]]), 8.0, 3, Budget(60.0))
        for level in range(4):
            h = arb(8) / 2**level
            exact = (-h).exp()
            decay = found.transitions[level][0, 0]
            assert decay.overlaps(exact)
            assert decay.rad() < 1e-20
            own = (1 - (-20000 * h).exp()) * 4 / 20000
            assert found.gramians["gain"][level][1, 1].overlaps(own)
            assert found.drifts[level][1, 0].overlaps((1 - (-10000 * h).exp()) * 2 / 10000)
