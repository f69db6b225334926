"""What was found at one wall serves its mirror images, and nothing is believed of it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import certbound as cb
from certbound.quadratic import conic, refinement
from certbound.quadratic.conic import Part, Program, block
from certbound.quadratic.mirror_images import Mirror, mirrors
from certbound.quadratic.refinement import Search, make_search
from certbound.quadratic.wall_attempts import APART, PAIRS, PIECES, Attempt

BOX = np.full(2, 1.0)


def problem_of(push: float = 0.0, sway: float = 0.0) -> cb.Problem:
    """A product of two states, odd in the first; a push along it breaks that, a disturbance of the second does not."""

    def dynamics(x: object, d: object) -> list[object]:
        return [push - x[0] + 0.4 * x[0] * x[1], -x[1] + d[0]]  # type: ignore[index]

    system = cb.ContinuousSystem(
        dynamics, states=["a", "b"], disturbance=cb.Box([-sway], [sway]), diffusion=0.3 * np.eye(2)
    )
    safe = [cb.Inside(cb.Box(-BOX, BOX))]
    return cb.Problem(system, initial=cb.Box([-0.1, -0.1], [0.1, 0.1]), safe=safe, horizon=1.0)


def search_of(problem: cb.Problem) -> Search:
    return make_search(problem, -BOX, BOX)


def found(search: Search, slabs: tuple[int, ...]) -> list[Mirror]:
    return mirrors(search.setting, search.cells(np.array([0.0, 1.0]), slabs)[0].cells)


@cache
def solved(slabs: tuple[int, ...]) -> tuple[Search, Attempt]:
    search = search_of(problem_of(sway=0.05))
    attempt = next(one for one in search.attempts if one.wall.label == "a above")._changed(slabs=slabs, pieces=2)
    search._solve(attempt, np.inf)
    return search, attempt


def test_signs_that_keep_the_dynamics_are_found() -> None:
    search = search_of(problem_of(sway=0.05))
    assert [one.signs.tolist() for one in found(search, (2,))] == [[-1, 1, 1]]
    # of one cell the corners do not tell a product from its negative
    assert [one.signs.tolist() for one in found(search_of(problem_of()), (1,))] == [[-1, 1, 1], [-1, -1, 1]]


def test_a_push_breaks_the_symmetry() -> None:
    assert found(search_of(problem_of(push=0.05)), (2,)) == []


@pytest.mark.parametrize("slabs", [(1,), (3,)])
def test_a_mirrored_proposal_proves_the_same(slabs: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    search, attempt = solved(slabs)
    image = next(one for one in search.attempts if one.wall.label == "a below")._changed(slabs=slabs, pieces=2)
    monkeypatch.setattr(refinement, "propose", None)  # nothing is solved
    search._solve(image, np.inf)
    assert image.level == pytest.approx(attempt.level, abs=1e-6)
    assert -20 < image.level < -2


def test_a_wrong_mirror_costs_time_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problem_of(push=0.3)
    honest, misled = search_of(problem), search_of(problem)
    known = found(search_of(problem_of()), (2,))
    monkeypatch.setattr(refinement, "mirrors", lambda setting, cells: known)
    levels = []
    for search in (honest, misled):
        labels = ("a above", "a below") if search is misled else ("a below",)
        sides = [one for label in labels for one in search.attempts if one.wall.label == label]
        tried = [one._changed(slabs=(2,), pieces=2) for one in sides]
        for one in tried:
            search._solve(one, np.inf)
        levels.append(tried[-1].level)
    assert levels[0] == pytest.approx(levels[1], abs=1e-9)


def test_what_gains_at_a_wall_is_done_at_its_images() -> None:
    search = search_of(problem_of())
    for attempt in search.attempts:
        search._solve(attempt, np.inf)
    search.attempts[0].gains = {PIECES: 1.0}
    place = search.attempts.index(search.attempts[0])
    option = search._option(place, np.inf)
    assert search._refined(option._replace(kind=PIECES), np.inf)
    label = search.attempts[place].wall.label
    axis = label.split()[0]
    assert {one.wall.label: one.pieces for one in search.attempts if one.wall.label.startswith(axis)} == {
        f"{axis} below": 8, f"{axis} above": 8,
    }  # fmt: skip


def test_pairs_are_opposite_sides() -> None:
    attempt = make_search(problem_of(), -BOX, BOX, together=True).attempts[0]
    pairs = [sorted(wall.label for wall in (one.wall, *one.others)) for one in attempt.finer(PAIRS)]
    assert pairs == [["a above", "a below"], ["b above", "b below"]]
    assert attempt.paired == len(attempt.finer(APART)) - 2 == 2
    assert attempt.finer(PAIRS)[0].paired == 0


def test_a_solver_that_comes_to_nothing_is_asked_again_with_care(monkeypatch: pytest.MonkeyPatch) -> None:
    settings, asked = Program._settings, []

    def hasty(self: Program, seconds: float, *, careful: bool) -> object:
        given = settings(self, seconds, careful=careful)
        asked.append(careful)
        given.max_iter = 80 if careful else 6
        return given

    monkeypatch.setattr(conic.Program, "_settings", hasty)
    program = Program()
    level = program.variables(1)
    stated = block(np.array([[0.0, 1.0], [1.0, 2.0]]), [np.array([[1.0, 0.0], [0.0, 0.0]])[..., None]])
    program.semidefinite(stated, level)
    program.at_least(np.array([9.0]), [Part(np.eye(1), level)])
    least = program.minimise(int(level[0]), seconds=60.0)
    assert least is not None
    assert least[0] == pytest.approx(0.5, abs=1e-3)
    assert asked == [False, True]
