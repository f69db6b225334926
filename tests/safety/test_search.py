"""Who is asked next where nothing is decided: engines by script, and small problems with the engines themselves."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.safety.answers import EngineAnswer, Request
from certbound.safety.decision import decide
from certbound.safety.portfolio import ENGINES
from certbound.safety.search import Action, Standing, Turn, next_action
from certbound.watch import Watch, poll


@dataclass(frozen=True)
class Script:
    """An engine whose bounds are steps of its effort: (effort, log10) rising in effort; and its seconds an effort."""

    steps: tuple[tuple[float, float], ...]
    pace: float
    refines: bool = True

    def bound(self, effort: float) -> float:
        return min((level for least, level in self.steps if effort >= least), default=0.0)

    def seconds(self, effort: float) -> float:
        """No more than its last step takes, as it ends there."""
        return self.pace * min(effort, max((least for least, _ in self.steps), default=1.0))


def played(scripts: dict[str, Script], limit: float) -> tuple[list[Standing], list[Action], float]:
    """Where all of them stand once nothing is left to be asked or time is over, what was asked, and the time left."""
    left, asked = limit, list[Action]()
    standings = [Standing(name=name, waits=True, refines=one.refines) for name, one in scripts.items()]
    while left > 0 and (action := next_action(standings, left, patient=True)) is not None:
        place = list(scripts).index(action.engine)
        one, script = standings[place], scripts[action.engine]
        effort = 1.0 if action.effort is None else action.effort
        needed, granted = script.seconds(effort), min(action.seconds, left)
        ended = needed <= granted
        level = min(one.log10_delta, script.bound(effort)) if ended else one.log10_delta
        turn = Turn(effort=effort, seconds=min(needed, granted), ended=ended, log10_delta=level,
                    log10_lower=-math.inf)  # fmt: skip
        standings[place] = replace(one, waits=one.waits and not ended, log10_delta=level, turns=(*one.turns, turn))
        left -= turn.seconds
        asked.append(action)
        assert len(asked) < 200
    return standings, asked, left


@pytest.mark.parametrize("seed", range(200))
def test_the_search_ends_once_all_are_exhausted_or_time_is_over(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scripts = {
        f"engine {k}": Script(
            steps=tuple(zip([1.0, *np.cumprod(rng.uniform(1.2, 6, 3))], np.cumsum(-rng.exponential(1, 4)))),
            pace=float(10 ** rng.uniform(-1, 2)), refines=bool(rng.random() < 0.7),
        )
        for k in range(rng.integers(1, 6))
    }  # fmt: skip
    limit = float(10 ** rng.uniform(0, 3))
    standings, _, left = played(scripts, limit)
    assert left < 1e-9 or all(one.exhausted for one in standings)
    for one, script in zip(standings, scripts.values()):
        if left > 1e-9:  # nothing that an engine can prove is left
            assert one.log10_delta == script.bound(math.inf if script.refines else 1.0)


def test_who_waits_comes_first_the_nearest_before_the_others_and_has_not_all_of_the_time() -> None:
    one, two = (Standing(name=name, waits=True, log10_delta=level) for name, level in (("a", -1.0), ("b", -2.0)))
    assert next_action([one, two], 10.0, patient=True) == Action(engine="b", effort=None, seconds=8.0)
    assert next_action([replace(one, near=True), two], 10.0, patient=False).engine == "a"  # type: ignore[union-attr]
    assert next_action([one, replace(two, last=True)], 10.0, patient=True).engine == "a"  # type: ignore[union-attr]
    assert next_action([one], 10.0, patient=True) == Action(engine="a", effort=None, seconds=10.0)


def test_an_engine_that_did_a_part_of_what_it_does_alone_is_asked_for_the_whole_at_its_pace() -> None:
    """A grant that was cut to the time of a turn counted as the whole: the next one was many times too large."""
    part = Turn(effort=0.2, seconds=2.0, ended=True, log10_delta=-1.0, log10_lower=-3.0)
    one = Standing(name="a", waits=True, refines=True, log10_delta=-1.0, turns=(part,))
    assert next_action([one], 60.0, patient=True) == Action(engine="a", effort=1.0, seconds=48.0)
    assert next_action([one], 8.0, patient=True).effort == pytest.approx(0.2 * 0.85 * 0.8 * 8 / 2)  # type: ignore[union-attr]
    assert next_action([one], 8.0, patient=False).effort == pytest.approx(0.2 * 0.85 * 8 / 2)  # type: ignore[union-attr]
    assert next_action([one], 3.0, patient=False) is None
    assert next_action([one], 20.0, patient=False) == Action(engine="a", effort=1.0, seconds=20.0)


def test_an_effort_is_what_fits_into_the_time_that_is_left_at_the_pace_so_far() -> None:
    turn = Turn(effort=1.0, seconds=10.0, ended=True, log10_delta=-1.0, log10_lower=-3.0)
    one = Standing(name="a", refines=True, log10_delta=-1.0, turns=(turn,))
    assert next_action([one], 40.0, patient=True) == Action(engine="a", effort=pytest.approx(3.4), seconds=40.0)
    assert next_action([one], 400.0, patient=True).effort == 8.0  # type: ignore[union-attr]
    assert next_action([one], 5.0, patient=True).effort == 1.5  # type: ignore[union-attr]
    assert next_action([one], 40.0, patient=False) is None


def test_an_engine_is_exhausted_once_more_effort_proves_and_does_no_more() -> None:
    first = Turn(effort=1.0, seconds=10.0, ended=True, log10_delta=-1.0, log10_lower=-3.0)
    one = Standing(name="a", refines=True, turns=(first,))
    assert not one.exhausted
    same = replace(first, effort=8.0)
    assert replace(one, turns=(first, same)).exhausted
    less = replace(same, effort=7.9 * first.effort)  # may be too little for a finer grid
    assert not replace(one, turns=(first, less)).exhausted
    assert not replace(one, turns=(first, replace(same, seconds=30.0))).exhausted  # it works on something
    assert not replace(one, turns=(first, replace(same, log10_lower=-2.0))).exhausted
    assert not replace(one, turns=(first, same, replace(same, ended=False))).exhausted  # time ended it
    assert replace(one, refines=False).exhausted
    assert not replace(one, waits=True, turns=()).exhausted
    assert replace(one, applicable=False).exhausted


# ---- the same with verdicts, by a clock of its own -----------------------------------------------------------------


class Time:
    """A clock that only goes on when somebody works."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def work(self, seconds: float) -> None:
        for _ in range(round(10 * seconds)):
            self.now += 0.1
            poll("working")


def walk() -> cb.Problem:
    system = cb.linear_system([[0.5]], noise=cb.Gaussian(std=0.1))
    return cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3, delta=1e-3)


def scripted(monkeypatch: pytest.MonkeyPatch, clock: Time, scripts: dict[str, Script]) -> None:
    """Engines by script; where they are not asked thoroughly they leave out half of their work, and what it proves."""
    plain: dict[str, Any] = {"sketch": False, "again": False, "soon": 0, "spares": 0, "chance": None, "below": None,
                             "drawn": False}

    def row(name: str, script: Script | None) -> Any:
        def prove(problem: cb.Problem, request: Request) -> EngineAnswer:
            if script is None:
                return EngineAnswer(method=name, applicable=False, reason="it does not serve this.")
            effort = 1.0 if request.effort is None else request.effort
            clock.work(script.seconds(effort) if request.thorough else 0.5 * script.pace)
            level = script.bound(effort) if request.thorough else 0.5 * script.bound(1.0)
            return EngineAnswer(method=name, log10_delta=level)

        refines = script is not None and script.refines
        return replace(ENGINES[name], prove=prove, **plain | {"refines": refines})

    for name in ENGINES:
        monkeypatch.setitem(ENGINES, name, row(name, scripts.get(name)))


@pytest.mark.parametrize("name", ENGINES)
@pytest.mark.parametrize(("proves", "status"), [(-4.0, "SAFE"), (-2.0, "UNKNOWN")])
def test_whoever_proves_more_with_more_effort_is_asked_for_it(
    monkeypatch: pytest.MonkeyPatch, name: str, proves: float, status: str
) -> None:
    """With time left, and another engine whose bound is nearer at first."""
    clock, other = Time(), next(other for other in ENGINES if other != name)
    scripts = {name: Script(((1.0, -0.5), (3.0, proves)), 2.0), other: Script(((1.0, -1.0),), 1.0)}
    scripted(monkeypatch, clock, scripts)
    verdict = decide(walk(), watch=Watch(60, clock=clock, patient=True))
    assert (verdict.status, verdict.log10_delta) == (status, proves)
    assert clock.now - 100 < 60
    assert ("Nothing more can be tried" in verdict.reason) == (status == "UNKNOWN")


@pytest.mark.parametrize("name", ENGINES)
def test_an_engine_that_goes_on_ends_with_the_time(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    clock = Time()
    scripted(monkeypatch, clock, {name: Script(tuple((1.4**k, -0.01 * k - 0.1) for k in range(40)), 1.0)})
    verdict = decide(walk(), watch=Watch(60, clock=clock, patient=True))
    assert verdict.status == "UNKNOWN"
    assert clock.now - 100 == pytest.approx(60, abs=0.3)
    assert f"More time would go on with {name}" in verdict.reason


@pytest.mark.parametrize("name", ENGINES)
@pytest.mark.parametrize("limit", [None, 60.0])
def test_what_an_engine_alone_proves_is_proved_without_naming_it(
    monkeypatch: pytest.MonkeyPatch, name: str, limit: float | None
) -> None:
    """The others are nearer as long as it leaves something out; nobody waits for more than that."""
    scripts = {other: Script(((1.0, -1.5),), 1.0, refines=False) for other in ENGINES}
    scripts[name] = Script(((1.0, -2.5), (2.0, -4.0)), 1.0)
    clock = Time()
    scripted(monkeypatch, clock, scripts)
    verdict = decide(walk(), watch=Watch(limit, clock=clock))
    alone = decide(walk(), method=name, watch=Watch(limit, clock=clock))
    assert verdict.log10_delta == alone.log10_delta == -2.5
    assert verdict.reason.endswith(f"A time limit of your own lets {name} go on.")


def test_an_engine_named_alone_has_all_of_a_limit_too(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Time()
    scripted(monkeypatch, clock, {"values": Script(((1.0, -2.5), (4.0, -4.0)), 2.0)})
    assert decide(walk(), method="values", watch=Watch(60, clock=clock, patient=True)).status == "SAFE"


def test_members_of_a_start_that_are_undecided_have_the_time_that_others_left(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Time()
    scripted(monkeypatch, clock, {})

    def prove(problem: cb.Problem, request: Request) -> EngineAnswer:
        wide = float(problem.initial.middle[0]) > 0.1
        clock.work(20.0 if wide else 0.1)
        return EngineAnswer(method="linear", log10_delta=-4.0)

    monkeypatch.setitem(ENGINES, "linear", replace(ENGINES["linear"], prove=prove))
    starts = [cb.Box([0.2], [0.3]), cb.Box([-0.1], [0.0]), cb.Box([-0.2], [0.0])]
    union = walk().replace(initial=starts)
    assert decide(union, watch=Watch(36, clock=clock, patient=True)).status == "SAFE"


# ---- the engines themselves ------------------------------------------------------------------------------------------


def cubic(delta: float) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: [-x[0] - x[0] ** 3], states=1, diffusion=[[0.4]])
    return cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1.0, delta=delta)


def steps(delta: float) -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: 0.8 * np.sin(x), states=1, noise=cb.Gaussian(std=0.3))
    return cb.Problem(system, initial=[0.1], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=5, delta=delta)


def firms(delta: float) -> cb.Problem:
    """Two correlated walks above their floors: undecided by the usual grid, decided by the one that values takes."""
    diffusion = np.array([[0.4, 0.0], [0.16, 0.4 * math.sqrt(0.84)]])
    system = cb.ContinuousSystem(lambda x: 0 * x, states=2, diffusion=diffusion)
    safe = [cb.Inside(cb.HalfSpace([-1, 0], 0)), cb.Inside(cb.HalfSpace([0, -1], 0))]
    return cb.Problem(system, initial=[math.log(1.8)] * 2, safe=safe, horizon=5.0, delta=delta)


CASES = [
    pytest.param(steps(2e-2), id="steps"), pytest.param(steps(7e-3), id="steps, less"),
    pytest.param(cubic(2e-2), id="cubic", marks=pytest.mark.slow),
    pytest.param(cubic(1e-5), id="cubic, less", marks=pytest.mark.slow),
    pytest.param(firms(0.75), id="firms", marks=pytest.mark.slow),
]  # fmt: skip


@pytest.mark.parametrize("problem", CASES)
def test_no_engine_named_alone_proves_more_where_nothing_is_decided(problem: cb.Problem) -> None:
    found = cb.verify_safety(problem)
    alone = {name: cb.verify_safety(problem, method=name) for name in ENGINES}
    decided = {verdict.status for verdict in alone.values()} - {"UNKNOWN"}
    if decided:
        assert {found.status} == decided
        return
    assert found.status == "UNKNOWN"
    assert found.log10_delta <= min(verdict.log10_delta for verdict in alone.values()) + 1e-9
