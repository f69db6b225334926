"""Windows, groups of walls, sides that move, and time that ends."""

from __future__ import annotations

import itertools
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.quadratic import QuadraticBound, bound_quadratic, refinement
from certbound.quadratic.inequality import prove
from certbound.quadratic.refinement import make_search
from certbound.quadratic.wall_attempts import APART, PIECES, SPLIT, Attempt
from certbound.quadratic.wall_program import propose
from certbound.quadratic.working_boxes import moved_sides, working_box
from certbound.watch import OutOfTime, Watch


def problem_of(horizon: float = 1.0, noise: float = 0.35) -> cb.Problem:
    """A product drives the second of three states; the third has no limit."""
    system = cb.ContinuousSystem(
        lambda x: [-x[0] + 0.5 * x[2], 0.5 * x[0] * x[0] - x[1], -x[2]], states=["a", "b", "c"],
        diffusion=noise * np.eye(3),
    )  # fmt: skip
    box = cb.Box([-1.2, -1.2, -np.inf], [1.2, 1.2, np.inf])
    return cb.Problem(system, initial=cb.Box([-0.1] * 3, [0.1] * 3), safe=[cb.Inside(box)], horizon=horizon)


def first_attempt(horizon: float = 1.0) -> Attempt:
    problem = problem_of(horizon)
    return make_search(problem, *working_box(problem, 4.0), together=True).attempts[0]


def test_pieces_before_a_window_reach_back_to_the_start() -> None:
    attempt = first_attempt(30.0)
    assert attempt.times[1] == 0
    late = attempt.finer(SPLIT)[1].finer(SPLIT)[1].finer(PIECES)[0]
    times, first = late.times
    assert (times[0], times[first], times[-1]) == (0.0, 22.5, 30.0)
    assert np.all(np.diff(times) > 0)
    assert np.all(np.diff(np.diff(times[: first + 1]))[1:] < 0)  # the longer the earlier, but for the first


def test_windows_and_walls_of_what_is_finer_cover_what_was_there() -> None:
    attempt = first_attempt()
    labels = [wall.label for wall in (attempt.wall, *attempt.others)]
    parts = attempt.finer(APART)
    assert sorted(labels) == sorted(wall.label for part in parts for wall in (part.wall, *part.others))
    assert [len(part.others) for part in parts] == [0] * 2 + [3]  # a is curved; b and c are far
    halves = attempt.finer(SPLIT)
    assert [half.during for half in halves] == [(0.0, 0.5), (0.5, 1.0)]


def test_windows_pay_over_long_times() -> None:
    """One exponential grows with the whole horizon; a sum over windows only with its length."""
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=0.33 * np.eye(2))
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=16.0)
    search = make_search(problem, -np.ones(2), np.ones(2))
    whole = search.attempts[0]

    def level(attempt: Attempt) -> float:
        times, first = attempt.times
        cells = search.cells(times, ())
        found = propose(search.setting, attempt.wall, times, cells, seconds=10.0, first=first)
        assert found is not None
        return prove(search.setting, attempt.wall, found, [one.cells for one in cells]).level

    halves = [part for half in whole.finer(SPLIT) for part in half.finer(SPLIT)]
    parts = [part for half in halves for part in half.finer(SPLIT)]
    bound = 4 * np.sum(np.exp([level(part) for part in parts]))
    seen = cb.simulate_exits(problem, paths=20_000, rng=np.random.default_rng(0), halve=False)
    assert seen.lower <= bound < 4 * np.exp(level(whole)) / 2


def test_a_search_refines_in_windows_that_cover_the_horizon() -> None:
    problem = problem_of(6.0)
    search = make_search(problem, *working_box(problem, 4.0))
    assert all(bound.upper < 0 for bound in search.first(0.0, 20.0))
    search.gains = {PIECES: 0.0}  # say that pieces are no use
    for _ in range(2):
        search._refined(search._option(0, np.inf), np.inf)
    windows = sorted(one.during for one in search.attempts if one.wall is search.attempts[0].wall)
    assert len(windows) > 1
    ends = [0.0, *itertools.chain.from_iterable(windows), 6.0]
    assert ends[::2] == ends[1::2]


def test_bends_of_two_coordinates_alike_are_both_cut_before_anything_is_solved() -> None:
    """Two oscillators with cubes: slabs of one alone leave the largest remainder as it is."""
    system = cb.ContinuousSystem(
        lambda x: [x[1], -x[0] - 0.5 * x[0] ** 3 - 1.2 * x[1] + 0.3 * (x[2] - x[0]),
                   x[3], -x[2] - 0.5 * x[2] ** 3 - 1.2 * x[3] + 0.3 * (x[0] - x[2])],
        states=4, diffusion=[[0, 0], [0.45, 0], [0, 0], [0, 0.45]],
    )  # fmt: skip
    free = cb.Box([-1, -np.inf, -1, -np.inf], [1, np.inf, 1, np.inf])
    problem = cb.Problem(system, initial=cb.Box([-0.1] * 4, [0.1] * 4), safe=[cb.Inside(free)], horizon=3)
    search = make_search(problem, *working_box(problem, 4.0), together=True)
    assert search.attempts[0].slabs == (4, 2)


def test_a_refinement_of_what_bounds_nothing_counts_by_how_far_it_is() -> None:
    """Slabs that bring a level nearer to 0 are kept, though both bound nothing."""
    search = make_search(problem_of(4.0, 1.0), *working_box(problem_of(4.0, 1.0), 4.0), together=True)
    attempt = search.attempts[0]
    search._solve(attempt, np.inf)
    assert 0 == attempt.level < attempt.found
    search._adopt(attempt, 0, np.inf)
    assert search.attempts[0].found < attempt.found
    assert attempt.gains[0] == attempt.found - search.attempts[0].found


def told_levels(monkeypatch: pytest.MonkeyPatch, alone: float, together: float) -> list[str]:
    """Every wall has these levels, by itself or with all others; which of them are asked for."""
    asked: list[str] = []

    def solve(self: refinement.Search, attempt: Attempt, until: float) -> None:
        asked.append(attempt.wall.label)
        level = together if len(attempt.others) > 3 else alone
        attempt.proved, attempt.seconds = SimpleNamespace(level=level), 1e-3  # type: ignore[assignment]  # all it has

    monkeypatch.setattr(refinement.Search, "_solve", solve)
    monkeypatch.setattr(refinement.Search, "by_wall", lambda self: (np.full(8, -8.0), -4.0))
    return asked


def test_sides_whose_sum_with_the_obstacle_is_beyond_1_are_taken_apart_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = told_levels(monkeypatch, -4.0, -0.01)
    problem = problem_of()
    ball = cb.Outside(cb.Ball([1.1, 1.1], 0.2, coordinates=[0, 1]))
    problem = problem.replace(safe=[*problem.safe, ball])
    search = make_search(problem, *working_box(problem, 4.0), together=True)
    first, second = (bound.upper for bound in search.first(0.5, 10.0))
    assert first == 0
    assert len(asked) == 2 + 3  # a below, a above, b and c, as the model is affine along them
    assert second < 0


def test_a_bound_that_is_far_from_saying_anything_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = told_levels(monkeypatch, 9.0, 9.0)
    best = bound_quadratic(problem_of(), seconds=100.0)
    assert best.upper == 0
    assert len(asked) == len(refinement.working_boxes(problem_of()))
    assert bound_quadratic(problem_of(), seconds=100.0, before=best).upper == 0
    assert len(asked) == len(refinement.working_boxes(problem_of()))


def test_sides_move_to_where_they_cost_a_share() -> None:
    problem = problem_of()
    low, high = working_box(problem, 4.0)
    setting = make_search(problem, low, high).setting
    names = [wall.label for wall in setting.walls]
    levels = np.full(len(names), -40.0)
    moved = moved_sides(problem, setting, levels, -4.0)
    assert moved is not None
    assert (moved[0] >= low - 1e-12).all()
    assert (moved[1] <= high + 1e-12).all()
    assert moved[1][0] < high[0] - 0.2  # a has a square
    assert moved[1][0] > 0.1  # beyond the starts
    assert moved[1][1:] == pytest.approx(high[1:])  # the others are affine
    assert moved_sides(problem, setting, np.full(len(names), -8.0), -4.5) is None


def test_better_bounds_are_told_and_the_end_of_the_time_is_kept() -> None:
    told: list[QuadraticBound] = []
    now = iter(np.arange(0.0, 1e6, 0.5))
    watch = Watch(14.0, clock=lambda: float(next(now)))
    with pytest.raises(OutOfTime), watch.running():
        bound_quadratic(problem_of(), target=0.0, seconds=60.0, found=told.append)
    uppers = [bound.upper for bound in told]
    assert uppers
    assert all(later < earlier for earlier, later in itertools.pairwise([0.0, *uppers]))
    assert "wall" in watch.phase or "refining" in watch.phase


def test_a_search_goes_on_from_an_earlier_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of the search counts programs here, a second each: to go on takes four of six, on any machine."""
    clock = itertools.count()
    solved = [0.0]

    def counted(*given: Any, seconds: float, **options: Any) -> Any:
        solved[0] += 1.0
        return propose(*given, seconds=600.0, **options)

    monkeypatch.setattr(refinement, "propose", counted)
    monkeypatch.setattr(refinement, "time", SimpleNamespace(perf_counter=lambda: solved[0] + 1e-6 * next(clock)))
    first = bound_quadratic(problem_of(), target=0.999, seconds=20.0)
    monkeypatch.setattr(refinement, "working_boxes", lambda problem: pytest.fail("the first pass was made again"))
    later = bound_quadratic(problem_of(), before=first, target=1e-4, seconds=6.0)
    assert later.upper <= -4 < first.upper < 0


def test_a_timer_does_not_break_the_solver_while_it_loads() -> None:
    """An alarm in the middle of Clarabel's first solution waits until it is loaded; after it programs are solved."""
    script = (
        "import signal\n"
        "from certbound.quadratic import conic\n"
        "from certbound.watch import OutOfTime\n"
        "real = conic.importlib.import_module\n"
        "def stop(*_): raise OutOfTime\n"
        "signal.signal(signal.SIGALRM, stop)\n"
        "def slow(name):\n"
        "    signal.raise_signal(signal.SIGALRM)\n"
        "    return real(name)\n"
        "conic.importlib.import_module = slow\n"
        "try:\n"
        "    conic.Program()\n"
        "except OutOfTime:\n"
        "    print('late')\n"
        "conic.importlib.import_module = real\n"
        "program = conic.Program()\n"
        "import numpy as np\n"
        "x = program.variables(1)\n"
        "program.semidefinite(conic.block(-np.eye(2), [np.eye(2)[:, :, None]]), x)\n"
        "program.minimise(0, seconds=5.0)\n"
        "print('solved')\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == ["late", "solved"]


def test_a_copy_of_the_process_solves_what_is_long_and_ends_with_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    search = make_search(problem_of(), *working_box(problem_of(), 4.0), together=True)
    one = replace(search.attempts[0], pieces=2)
    times, first = one.times
    cells = search.cells(times, one.slabs)

    def matrices(seconds: float) -> object:
        found = propose(search.setting, one.wall, times, cells, seconds=seconds, first=first, others=one.others)
        return found and found.matrices

    here = matrices(20.0)
    assert here is not None
    monkeypatch.setattr("certbound.quadratic.conic._LONG", 0.0)
    there = matrices(20.0)
    assert np.array_equal(here, there)
    monkeypatch.setattr("certbound.quadratic.conic.Program._solved", lambda *_: time.sleep(60))  # one step that lasts
    begin = time.perf_counter()
    assert matrices(0.1) is None
    assert time.perf_counter() - begin < 20


def test_programs_that_take_minutes_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("certbound.quadratic.wall_attempts._LARGEST", 1e3)
    with pytest.raises(InfeasibleError, match=r"a program of \d+ matrix inequalities in 3 states"):
        bound_quadratic(problem_of(), target=1e-3, seconds=5)
