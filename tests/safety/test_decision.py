"""What is asked when, what a limit of time leaves of it, and what is told meanwhile: by a clock of its own."""

from __future__ import annotations

import ctypes
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.safety import decision
from certbound.safety.answers import EngineAnswer, Request
from certbound.safety.decision import decide
from certbound.safety.engines import linear_chance
from certbound.safety.limits import Limits
from certbound.safety.portfolio import ENGINES
from certbound.safety.verdict import Verdict
from certbound.watch import OutOfTime, Progress, Watch, poll, seconds_left, undisturbed

Steps = list[tuple[float, float]]
"""Seconds that an engine works, and the log10 that it has proved then."""


class Time:
    """A clock that only goes on when somebody works."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def work(self, seconds: float, phase: str) -> None:
        for _ in range(round(10 * seconds)):
            self.now += 0.1
            poll(phase)


@pytest.fixture
def clock() -> Time:
    return Time()


def problem() -> cb.Problem:
    system = cb.linear_system([[0.5]], noise=cb.Gaussian(std=0.1))
    return cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3, delta=1e-3)


def scripted(monkeypatch: pytest.MonkeyPatch, clock: Time, scripts: dict[str, Steps], **flags: Any) -> list[str]:
    """Engines that work and prove as they are told, and leave nothing out for later; what was asked, in order."""
    asked: list[str] = []

    def row(name: str, steps: Steps) -> Any:
        def prove(problem: cb.Problem, request: Request) -> EngineAnswer:
            asked.append(name)
            best = EngineAnswer(method=name)
            for index, (seconds, level) in enumerate(steps):
                clock.work(seconds, f"step {index}")
                best = replace(best, log10_delta=min(best.log10_delta, level))
                request.found(best)
            return best

        plain = {"sketch": False, "again": False, "reserve": False, "soon": 0, "chance": None}
        plain |= {"refines": False, "spares": 0}
        return replace(ENGINES[name], prove=prove, **plain | flags)

    for name in ENGINES:
        monkeypatch.setitem(ENGINES, name, row(name, scripts.get(name, [])))
    return asked


def served() -> list[str]:
    """The engines that are asked of a fixed start."""
    return [name for name, row in ENGINES.items() if not row.drawn]


def run(clock: Time, limit: float | None, told: list[Progress] | None = None) -> tuple[Verdict, float]:
    watch = Watch(limit, clock=clock, progress=None if told is None else told.append)
    return decide(problem(), watch=watch), clock.now - watch.started


def test_without_a_limit_every_engine_is_asked_in_order(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    asked = scripted(monkeypatch, clock, {"linear": [(3, -1)], "barrier": [(2, -2)]})
    verdict, seconds = run(clock, None)
    assert asked == served()
    assert (verdict.status, verdict.log10_delta, verdict.method) == ("UNKNOWN", -2, "barrier")
    assert seconds == pytest.approx(5)
    assert "stopped" not in verdict.reason


def test_what_was_proved_before_the_time_was_over_stands(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    scripted(monkeypatch, clock, {"linear": [(1, -1), (1, -2), (50, -9)]})
    verdict, seconds = run(clock, 10)
    assert verdict.log10_delta == -2
    assert seconds == pytest.approx(10, abs=0.2)
    assert verdict.reason.endswith("stopped after 10 s. More time would go on with linear (step 2).")


def test_an_engine_that_takes_long_is_interrupted_and_goes_on(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    asked = scripted(monkeypatch, clock, {"linear": [(7, -5)], "constants": [(1, -1)]})
    verdict, seconds = run(clock, 10)
    assert asked == served()
    assert (verdict.status, verdict.method) == ("SAFE", "linear")
    assert seconds == pytest.approx(8, abs=0.3)


def test_once_another_one_is_safe_the_one_that_takes_long_ends(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    scripted(monkeypatch, clock, {"linear": [(500, -5)], "constants": [(1, -4)]})
    verdict, seconds = run(clock, 10)
    assert (verdict.status, verdict.method) == ("SAFE", "constants")
    assert seconds < 7


def test_no_engine_keeps_the_others_from_their_turn(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    asked = scripted(monkeypatch, clock, {name: [(500, -5)] for name in served()})
    verdict, seconds = run(clock, 20)
    assert set(asked) == set(served())
    assert seconds == pytest.approx(20, abs=0.2)
    assert (verdict.status, verdict.log10_delta) == ("UNKNOWN", 0.0)
    assert all(f"{name} (step 0)" in verdict.reason for name in served())


def test_what_an_engine_was_at_is_its_own(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    scripted(monkeypatch, clock, {"linear": [(1, -0.5), (500, -5)], "constants": [(500, -5)]})
    verdict, _ = run(clock, 10)
    assert "linear (step 1), then constants (step 0)" in verdict.reason


@pytest.mark.parametrize("limit", [0.5, 1, 2, 4, 8, 16, 32])
def test_a_longer_limit_is_never_worse(monkeypatch: pytest.MonkeyPatch, clock: Time, limit: float) -> None:
    scripts: dict[str, Steps] = {
        "linear": [(1, -0.5), (6, -2)], "constants": [(2, -1)],
        "barrier": [(1, -0.7), (3, -1.5)], "values": [(4, -2.5)],
    }  # fmt: skip
    scripted(monkeypatch, clock, scripts)
    verdict, seconds = run(clock, limit)
    longer, _ = run(clock, 2 * limit)
    assert longer.log10_delta <= verdict.log10_delta
    assert seconds <= limit + 0.2


def test_a_sketch_that_proves_safe_spares_the_others(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    asked = scripted(monkeypatch, clock, {"constants": [(0.1, -4)]}, sketch=True)
    verdict, _ = run(clock, None)
    assert asked == served()  # each for its sketch, none a second time
    assert verdict.status == "SAFE"


def test_a_slow_engine_is_interrupted_early_for_a_first_bound(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    asked = scripted(monkeypatch, clock, {"linear": [(7, -5)], "quadratic": [(1, -1)]})
    monkeypatch.setitem(ENGINES, "quadratic", replace(ENGINES["quadratic"], soon=1))
    told: list[Progress] = []
    verdict, _ = run(clock, 30, told)
    assert asked[:2] == ["linear", "quadratic"]
    assert next(p.seconds for p in told if p.log10_delta < 0) < 2
    assert (verdict.status, verdict.method) == ("SAFE", "linear")


def test_a_first_bound_that_is_safe_ends_the_slow_engine(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    scripted(monkeypatch, clock, {"linear": [(500, -5)], "quadratic": [(1, -4)]})
    monkeypatch.setitem(ENGINES, "quadratic", replace(ENGINES["quadratic"], soon=1))
    verdict, seconds = run(clock, 30)
    assert (verdict.status, verdict.method) == ("SAFE", "quadratic")
    assert seconds < 3


def test_what_is_safe_already_is_finished_before_others_are_asked(
    monkeypatch: pytest.MonkeyPatch, clock: Time
) -> None:
    """The first bound of an engine has no margin and no tube: both come with its last."""
    scripted(monkeypatch, clock, {"linear": [(0.2, -4), (2, -5)], "quadratic": [(1, -1)]})
    monkeypatch.setitem(ENGINES, "quadratic", replace(ENGINES["quadratic"], soon=1))
    verdict, _ = run(clock, 10)
    assert (verdict.status, verdict.method, verdict.log10_delta) == ("SAFE", "linear", -5)


def test_an_engine_without_a_chance_comes_last_and_is_brief(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    asked = scripted(monkeypatch, clock, {"linear": [(100, -2)], "barrier": [(2, -1)]})
    hopeless = replace(ENGINES["linear"], chance=lambda problem: 0.5)
    monkeypatch.setitem(ENGINES, "linear", hopeless)
    verdict, seconds = run(clock, None)
    assert asked[-1] == "linear"
    assert (verdict.method, verdict.log10_delta) == ("barrier", -1)
    assert seconds < 5


def test_an_engine_without_a_chance_has_all_the_time_where_nothing_else_proves_anything(
    monkeypatch: pytest.MonkeyPatch, clock: Time
) -> None:
    scripted(monkeypatch, clock, {"linear": [(100, -2)]})
    monkeypatch.setitem(ENGINES, "linear", replace(ENGINES["linear"], chance=lambda problem: 0.5))
    verdict, seconds = run(clock, None)
    assert verdict.log10_delta == -2
    assert seconds == pytest.approx(100, abs=1)


@pytest.mark.parametrize(("other", "full", "count"), [(0, True, 2), (-1, True, 2), (0, False, 2), (-1, False, 1)])
def test_who_spares_itself_is_asked_in_full_where_nothing_is_decided(
    monkeypatch: pytest.MonkeyPatch, clock: Time, other: float, full: bool, count: int
) -> None:
    """Of one problem always, or it would be proved less than by naming the engine; of many where nothing is proved."""
    asked = scripted(monkeypatch, clock, {"quadratic": [(1, 0)], "linear": [(1, other)]})
    monkeypatch.setitem(ENGINES, "quadratic", replace(ENGINES["quadratic"], spares=2))
    decide(problem(), watch=Watch(None, clock=clock), full=full)
    assert asked.count("quadratic") == count


def test_what_takes_no_grids_is_asked_before_what_does(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    scripted(monkeypatch, clock, {"quadratic": [(0.5, -1.5)], "values": [(9, -1)]})
    told: list[Progress] = []
    verdict, _ = run(clock, 60, told)
    assert next(p.seconds for p in told if p.log10_delta < 0) < 1
    assert verdict.method == "quadratic"


def test_once_unsafe_is_proved_nobody_is_asked_in_full(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    asked = scripted(monkeypatch, clock, {"linear": [(1, 0)], "values": [(1, 0)], "quadratic": [(1, 0)]})
    proves = ENGINES["values"].prove

    def from_below(problem: cb.Problem, request: Request) -> EngineAnswer:
        return replace(proves(problem, request), log10_lower=-1.0)

    monkeypatch.setitem(ENGINES, "linear", replace(ENGINES["linear"], again=True))
    monkeypatch.setitem(ENGINES, "quadratic", replace(ENGINES["quadratic"], spares=2))
    run(clock, 60)
    assert [asked.count(name) for name in ("linear", "quadratic")] == [2, 2]
    asked.clear()
    monkeypatch.setitem(ENGINES, "values", replace(ENGINES["values"], prove=from_below))
    verdict, _ = run(clock, 60)
    assert verdict.status == "UNSAFE"
    assert [asked.count(name) for name in ("linear", "quadratic")] == [1, 1]


@pytest.mark.parametrize(("lower", "full", "count"), [(-3.2, False, 2), (-3.5, False, 1), (-3.5, True, 2)])
def test_bounds_that_are_near_what_is_asked_are_made_better(
    monkeypatch: pytest.MonkeyPatch, clock: Time, lower: float, full: bool, count: int
) -> None:
    asked = scripted(monkeypatch, clock, {})

    def near(problem: cb.Problem, request: Request) -> EngineAnswer:
        asked.append("near")
        return EngineAnswer(method="values", log10_delta=-2.8, log10_lower=-2.9 if request.thorough else lower)

    monkeypatch.setitem(ENGINES, "values", replace(ENGINES["values"], prove=near, refines=True))
    verdict = decide(problem(), watch=Watch(60, clock=clock), full=full)
    assert asked.count("near") == count
    assert verdict.status == ("UNSAFE" if count == 2 else "UNKNOWN")


def test_without_a_limit_a_second_asking_is_in_proportion_to_the_first(
    monkeypatch: pytest.MonkeyPatch, clock: Time
) -> None:
    for first, most in ((1.0, 120.0), (200.0, 200.0)):
        scripted(monkeypatch, clock, {"constants": [(first, -1)]})

        def endless(problem: cb.Problem, request: Request) -> EngineAnswer:
            if request.thorough:
                clock.work(1e4, "halving")
            return EngineAnswer(method="linear", log10_delta=-0.5)

        monkeypatch.setitem(ENGINES, "linear", replace(ENGINES["linear"], prove=endless, again=True))
        verdict, seconds = run(clock, None)
        assert (verdict.status, verdict.log10_delta) == ("UNKNOWN", -1)
        assert seconds == pytest.approx(first + most, abs=0.5)


def test_what_a_sketch_proves_is_told(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    def sketched(problem: cb.Problem, request: Request) -> EngineAnswer:
        return EngineAnswer(method="constants", log10_delta=-1.0)

    scripted(monkeypatch, clock, {"linear": [(3, -2)]})
    monkeypatch.setitem(ENGINES, "constants", replace(ENGINES["constants"], prove=sketched, sketch=True))
    told: list[Progress] = []
    run(clock, 30, told)
    assert next(p.seconds for p in told if p.log10_delta == -1.0) < 0.5


def test_a_sketch_of_the_remainder_tells_where_the_linear_response_has_a_chance() -> None:
    def flow(noise: float) -> cb.Problem:
        system = cb.ContinuousSystem(
            lambda x: [2 * (x[1] - x[0]), x[0] * (0.5 - x[2]) - x[1], x[0] * x[1] - x[2]], states=3,
            diffusion=noise * np.eye(3),
        )  # fmt: skip
        room = cb.Inside(cb.Box([-1.5] * 3, [1.5] * 3))
        return cb.Problem(system, initial=cb.Box([-0.2] * 3, [0.2] * 3), safe=[room], horizon=2)

    assert linear_chance(flow(0.05)) > 1 > linear_chance(flow(0.35))
    assert linear_chance(problem()) == np.inf  # discrete time: nothing speaks against it


def test_progress_tells_who_is_at_what_and_the_bound(monkeypatch: pytest.MonkeyPatch, clock: Time) -> None:
    scripted(monkeypatch, clock, {"linear": [(1, -1), (1, -2)], "barrier": [(0.5, -1.5)]})
    told: list[Progress] = []
    run(clock, 10, told)
    rows = [(p.engine, p.phase, p.log10_delta) for p in told]
    for row in (("linear", "step 0", 0.0), ("linear", "step 1", -1.0), ("barrier", "step 0", -2.0)):
        assert row in rows
    assert all(p.limit == 10 and 0 <= p.seconds <= 10 for p in told)
    assert [p.log10_delta for p in told] == sorted((p.log10_delta for p in told), reverse=True)


def test_a_share_of_time_ends_quietly_and_the_whole_does_not(clock: Time) -> None:
    watch = Watch(10, clock=clock)
    with watch.running():
        with watch.share(0.5):
            assert seconds_left() == pytest.approx(5)
            clock.work(50, "long")
        assert seconds_left() == pytest.approx(5, abs=0.2)
        clock.now += 50
        with pytest.raises(OutOfTime), watch.share(0.5), watch.share(1.0):
            poll()
    assert seconds_left() == float("inf")


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan"), float("inf")])
def test_a_limit_must_be_positive(limit: float) -> None:
    with pytest.raises(ValueError, match="`time_limit` must be a positive number of seconds"):
        cb.verify_safety(problem(), time_limit=limit)


def test_the_callback_may_be_all_that_is_given() -> None:
    told: list[Progress] = []
    verdict = cb.verify_safety(problem(), progress=told.append)
    assert verdict.status == "SAFE"
    assert {"noise-free", "linear"} <= {found.engine for found in told}


def test_limits_are_found_as_far_as_time_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    from certbound.safety import verification

    def partly(*_: Any, **__: Any) -> Iterator[Limits]:
        yield Limits(delta=0.5, horizon=None, noise=None, widening=None)
        raise OutOfTime

    monkeypatch.setattr(verification, "limits_so_far", partly)
    wide = problem().replace(delta=1e-40)
    limits = cb.verify_safety(wide, method="constants", explain=True).limits
    assert limits is not None
    assert limits.delta == 0.5


def test_a_row_that_does_not_poll_is_ended_by_a_timer_that_leaves_no_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    def deaf(problem: cb.Problem, request: Request) -> EngineAnswer:
        request.found(EngineAnswer(log10_delta=-1.0, method="linear"))
        while True:
            pass

    monkeypatch.setitem(ENGINES, "linear", replace(ENGINES["linear"], prove=deaf))
    before = signal.getsignal(signal.SIGALRM)
    verdict = cb.verify_safety(problem(), method="linear", time_limit=0.1)
    assert (verdict.status, verdict.log10_delta) == ("UNKNOWN", -1.0)
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert signal.getsignal(signal.SIGALRM) is before


def test_a_timer_that_goes_off_in_a_callback_of_compiled_code_goes_off_again_without_a_word() -> None:
    before, lose = sys.unraisablehook, ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGALRM))
    with pytest.raises(OutOfTime), Watch(0.01).running():
        time.sleep(5 if lose() is None else 0)
    assert sys.unraisablehook is before


def test_a_timer_that_another_thread_hears_waits_until_what_must_not_be_interrupted_is_over() -> None:
    """A mask is of one thread; the handler runs in the main one all the same, and left numba's registries broken."""
    begun, done = threading.Event(), []
    other = threading.Thread(target=lambda: begun.wait() and signal.raise_signal(signal.SIGALRM))
    other.start()

    def work() -> None:
        with undisturbed():
            begun.set()
            other.join()
            done.append("whole")
        time.sleep(5)

    with pytest.raises(OutOfTime), Watch(20.0).running():
        work()
    assert done == ["whole"]


def test_an_upper_bound_near_the_truth_that_is_too_large_is_answered_from_below() -> None:
    """Linear response of a linear Gaussian problem ends the search for smaller bounds, not that for larger ones."""
    system = cb.linear_system([[0.5]], noise=cb.Gaussian(std=0.4))
    found = cb.verify_safety(problem().replace(system=system))
    assert found.answers["linear"].conclusive
    assert found.status == "UNSAFE"
    assert found.log10_lower is not None
    assert -3 < found.log10_lower <= found.log10_delta
    assert not cb.verify_safety(problem()).answers["values"].applicable  # what is SAFE needs no more


def test_who_spared_itself_is_asked_in_full_before_others_are_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing is proved: the second turn of the linear response may take all of the time that is left."""
    asked: list[tuple[str, bool]] = []

    def answer(self: Any, name: str, request: Request) -> EngineAnswer:
        asked.append((name, request.thorough))
        return EngineAnswer(method=name, details=object(), applicable=name == "linear")

    monkeypatch.setattr(decision._Search, "_asked", answer)
    system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=0.1 * np.eye(2))
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1)
    assert cb.verify_safety(problem).status == "UNKNOWN"
    again = [name for name, thorough in asked if thorough]
    assert again.index("quadratic") < again.index("linear")


@pytest.mark.parametrize("patient", [True, False])
def test_what_is_left_of_a_limit_of_ones_own_goes_to_who_refines(
    monkeypatch: pytest.MonkeyPatch, clock: Time, patient: bool
) -> None:
    scripted(monkeypatch, clock, {"linear": [(1, -1)], "quadratic": [(1, -1.5)]})
    asked: list[float] = []

    def refine(problem: cb.Problem, request: Request) -> EngineAnswer:
        if request.at_length:
            asked.append(seconds_left())
        clock.work(5 if request.at_length else 1, "refining")
        return EngineAnswer(method="values", log10_delta=-4 if request.at_length else -2)

    monkeypatch.setitem(ENGINES, "values", replace(ENGINES["values"], prove=refine, refines=True))
    verdict = decide(problem(), watch=Watch(30, clock=clock, patient=patient))
    assert verdict.status == ("SAFE" if patient else "UNKNOWN")
    assert len(asked) == patient  # quadratic, which was farther off, has no need to go on
    assert all(20 < left < 27 for left in asked)


@pytest.mark.parametrize(("other", "full"), [(0.0, True), (-1.0, True), (0.0, False), (-1.0, False)])
def test_where_nothing_is_decided_who_refines_is_asked_thoroughly_at_last(
    monkeypatch: pytest.MonkeyPatch, clock: Time, other: float, full: bool
) -> None:
    """An epidemic in persons was UNKNOWN with 1 after 20 of 60 s; more of a grant than the first 5 s proved SAFE."""
    scripted(monkeypatch, clock, {"linear": [(1, other)]})

    def refine(problem: cb.Problem, request: Request) -> EngineAnswer:
        clock.work(1, "refining")
        return EngineAnswer(method="values", log10_delta=-4.0 if request.thorough else 0.0)

    monkeypatch.setitem(ENGINES, "values", replace(ENGINES["values"], prove=refine, refines=True))
    verdict = decide(problem(), watch=Watch(60, clock=clock, patient=False), full=full)
    assert verdict.status == ("SAFE" if full or other == 0 else "UNKNOWN")


@pytest.mark.parametrize(("horizon", "first"), [(2000, "values"), (900, "linear")])
def test_of_very_many_steps_a_function_of_one_state_is_asked_first(
    monkeypatch: pytest.MonkeyPatch, clock: Time, horizon: int, first: str
) -> None:
    """A queue for 1e5 steps was UNKNOWN after 60 s, all of them of engines that look at every step."""
    asked = scripted(monkeypatch, clock, {"linear": [(50, -4)], "values": [(1, -4)]})
    verdict = decide(problem().replace(horizon=horizon), watch=Watch(60, clock=clock))
    assert verdict.status == "SAFE"
    assert asked[0] == first
    assert (len(asked) == 1) == (first == "values")
