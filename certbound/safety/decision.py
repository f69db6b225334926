"""The search for a verdict: which engine is asked when, and what is kept once the time is over.

Sketches come first, since they cost next to nothing; then the engines in turn, until one has proved SAFE, those that
have hardly a chance last. Where nothing is decided then, `certbound.safety.search` says who is asked with how much
effort. Under a limit of time an engine that takes long is interrupted, early for first bounds, later for all others,
and goes on with what they leave: none starves.
"""

from __future__ import annotations

import contextlib
import logging
import math
from dataclasses import replace
from functools import cached_property
from time import perf_counter
from types import MappingProxyType
from typing import Any

from certbound.errors import EngineError, contained
from certbound.problem.goals import met_at
from certbound.problem.problem import Problem
from certbound.safety.answers import SPARED, EngineAnswer, Request, is_more_than, may_decide, with_lower
from certbound.safety.averages import average_verdict
from certbound.safety.engines import prove_truncated
from certbound.safety.falsification import Violation, find_violation
from certbound.safety.members import worst_verdict
from certbound.safety.misses import arrival, best_time, find_miss, window_of
from certbound.safety.portfolio import ENGINES, Engine, check_request, engines_of, in_order
from certbound.safety.search import Action, Standing, Turn, is_moving, moving_verdict, next_action
from certbound.safety.verdict import Verdict, best_lower, is_safe, stopped, undone, unfinished, unsafe, verdict_of
from certbound.tubes.constants import Constants
from certbound.watch import OutOfTime, Watch, current_watch

_log = logging.getLogger(__name__)

_LARGE, _LASTING = 60, 100_000  # states beyond which nobody else is asked once one has proved SAFE; steps
_LONG = 1000  # steps of one state beyond which a function of it is asked first
_PATIENCE = 0.4  # of the time that is left, after which the other engines have a turn
_TURN = 0.5  # of the time that is left then, for all of them
_LAST = 0.2  # of the time that is left then, where none of them has much of a chance
_FIRST = 0.1  # of the time that is left, for first bounds where the engine in turn has a good chance
_SOON = 0.5  # seconds after which those that have a first bound soon are asked for it, under a limit
_UNLIKELY = 2.0  # seconds for an engine that has hardly a chance, once there is a bound
_THOROUGH, _LONGER = 120.0, 1.0  # seconds for an engine asked once more without a limit, or times those so far
_HOPED = 10.0  # seconds for a proof that noise leads where noise-free trajectories do not
_BELOW, _BRIEFLY = 0.3, 5.0  # of the time that is left, and seconds, for lower bounds that take little
_ANYWAY, _FEW = (1.0, 2.0), 3  # seconds for others once UNSAFE is proved, more up to so many states: from both sides
_EXTRA = 0.2  # of the time that is left, for a bound that can no longer change the verdict


def decide(
    problem: Problem, *, method: str = "auto", cells: int | None = None, constants: Constants | None = None,
    watch: Watch | None = None, full: bool = True,
) -> Verdict:
    """The verdict that the engines find in the time that a watch leaves; see `verify_safety` for the arguments.

    Without a watch the one that runs already, if any, ends the search. Without ``full``, for one of many problems, an
    engine that left something out is asked again only where that may decide, and never for more.
    """
    if not isinstance(method, str):
        raise TypeError(f"`method` must be the name of one, got {method!r}; leave it out for the best of all engines.")
    plain = "auto" if method in ENGINES else method
    request = Request(method=plain, cells=cells, constants=constants, thorough=method != "auto")
    names = _asked_of(problem, engines_of(method))
    watch = watch or current_watch() or Watch()
    for start in problem.starts:
        check_request(problem.replace(initial=start) if len(problem.starts) > 1 else problem, request)
    options: dict[str, Any] = {"method": method, "cells": cells, "constants": constants, "watch": watch}
    if len(problem.starts) > 1:
        return worst_verdict(problem, watch, lambda member: decide(member, full=full, **options))
    if problem.random:
        return average_verdict(problem, watch, lambda cell: decide(cell, full=False, **options))
    if is_moving(problem):
        return moving_verdict(
            problem, watch, lambda resting: decide(resting, full=full, **options),
            lambda plain: _searched(plain, request, names, watch, method, full=False),
            method=method, stated=constants is not None,
        )  # fmt: skip
    return _searched(problem, request, names, watch, method, full=full)


def _searched(
    problem: Problem, request: Request, names: tuple[str, ...], watch: Watch, method: str, *, full: bool
) -> Verdict:
    """The verdict on a problem as it is."""
    search = _Search(problem, request, watch, full=full)
    try:
        with search.watch.running():
            violation = search.violation()
            if violation is not None and not search.arrives_by_noise(names):
                return unsafe(problem, violation, method)
            if method == "auto":
                search.first_pass(names)
            else:
                search.ask(names[0], request)
                search.below(names)
            search.go_on(names, patient=full and watch.patient and watch.limit is not None)
    except OutOfTime:
        _log.info("the search ended with its time")
    return search.verdict(names)


def _asked_of(problem: Problem, names: tuple[str, ...]) -> tuple[str, ...]:
    """The engines without those that serve random starts alone, where the start is not random."""
    random = any(start.random for start in problem.starts)
    return names if random or len(names) == 1 else tuple(name for name in names if not ENGINES[name].drawn)


class _Search:
    """One problem, one watch, and what each engine has answered so far."""

    def __init__(self, problem: Problem, request: Request, watch: Watch, *, full: bool = True) -> None:
        self.problem, self.request, self.watch, self.full = problem, request, watch, full
        self.answers: dict[str, EngineAnswer] = {}
        self.left_at: dict[str, str] = {}
        self.sketches: dict[str, EngineAnswer] = {}
        self.chances: dict[Any, float] = {}
        self.spent: dict[str, float] = {}
        self.turns: dict[str, list[Turn]] = {}
        self.ended: set[str] = set()  # who came to the end of a request that left nothing out for others' sake
        self._inner = 0.0  # seconds of engines that had a turn inside another one's

    @property
    def settled(self) -> bool:
        """Whether no other engine can change the verdict, or do much better."""
        return self.safe or any(one.conclusive for one in (*self.answers.values(), *self.sketches.values()))

    @property
    def safe(self) -> bool:
        """Whether SAFE is proved."""
        return any(is_safe(answer, self.problem) for answer in (*self.answers.values(), *self.sketches.values()))

    @property
    def refuted(self) -> bool:
        """Whether UNSAFE is proved."""
        return (below := best_lower(self.answers)) is not None and is_more_than(below, self.problem.delta)

    @property
    def bounded(self) -> bool:
        """Whether any probability below 1 is proved."""
        return any(answer.applicable and answer.log10_delta < 0 for answer in self.answers.values())

    def spared(self, name: str) -> bool:
        """Whether an engine may be quick: not where it alone could prove UNSAFE of what is near the truth."""
        return self.settled and (self.safe or self.refuted or ENGINES[name].write_below is None)

    def violation(self) -> Violation | None:
        """A proved violation of the noise-free model; None where there is none, or where the search for one failed."""
        if self.lasting or self.problem.ending or (self.problem.reach is not None and self.problem.reach.stays):
            return None
        self.watch.engine = "noise-free"
        try:
            with contained("noise-free"):
                self.watch.poll("noise-free trajectories")
                return find_violation(self.problem) if self.problem.reach is None else find_miss(self.problem)
        except EngineError as error:
            _log.info("no noise-free trajectory was followed: %s", error)
            return None

    def arrives_by_noise(self, names: tuple[str, ...]) -> bool:
        """Whether a target that noise-free trajectories miss is proved to be met by noise, often enough."""
        if self.problem.reach is None or self.fixed:
            return False
        with contextlib.suppress(OutOfTime), self.watch.share(1.0, _HOPED):
            for name in (name for name in names if ENGINES[name].reaches):
                self.ask(name, self.request)
        return self.safe

    def first_pass(self, names: tuple[str, ...]) -> None:
        """Sketches, and all engines in turn."""
        if self.endlessly(names):
            return
        if self.problem.system.dimension <= _LARGE and self.request.constants is None:
            for name in (name for name in names if ENGINES[name].sketch):
                found = self.sketches[name] = self._asked(name, replace(self.request, quick=True))
                self.watch.noted(found.log10_delta if found.applicable and found.certified else 0.0)
        names = tuple(sorted(names, key=lambda name: not self._likely(name)))
        self.below(names)
        both = sorted(names, key=lambda name: self.refuted and ENGINES[name].write_below is None)  # from both sides
        with self.watch.share(1.0, _ANYWAY[self.problem.system.dimension <= _FEW] if self.refuted else math.inf):
            self._in_turn(tuple(both))

    def go_on(self, names: tuple[str, ...], *, patient: bool) -> None:
        """Ask one engine after the other with as much effort as may still decide, until nothing is left to be asked."""
        while not (self.safe or self.refuted):
            action = next_action(self.standings(names, patient=patient), self.watch.left, patient=patient)
            if action is None:
                return
            self._do(action)

    def _do(self, action: Action) -> None:
        """One more request; where nobody set a limit, only as long as is in proportion to what it all took so far."""
        most = max(_THOROUGH, _LONGER * self.watch.spent) if self.watch.limit is None else math.inf
        first = None if self.request.cells is not None else self.answers.get(action.engine)
        request = replace(self.request, thorough=True, effort=action.effort, before=first and first.details)
        with self.watch.share(1.0, min(action.seconds, most)):
            self.ask(action.engine, request)

    def standings(self, names: tuple[str, ...], *, patient: bool) -> list[Standing]:
        """What each engine has done so far, in their order."""
        return [
            Standing(
                name=name, applicable=name not in self.answers or self.answers[name].applicable,
                waits=self._waits(name, patient=patient), refines=ENGINES[name].refines, last=ENGINES[name].again,
                near=name in self.answers and may_decide(self.answers[name], self.problem.delta),
                log10_delta=self.answers[name].log10_delta if name in self.answers else 0.0,
                turns=tuple(self.turns.get(name, ())),
            )
            for name in names
        ]  # fmt: skip

    def _waits(self, name: str, *, patient: bool) -> bool:
        """Whether an engine left something out that is worth being asked for."""
        row, answer, few = ENGINES[name], self.answers.get(name), self.problem.system.dimension < _FEW
        if any(turn.ended and turn.effort >= 1 for turn in self.turns.get(name, ())):
            return False
        spared = self.problem.system.dimension < row.spares
        refused = answer is not None and not answer.applicable and answer.reason != SPARED and name in self.ended
        if (refused and not spared) or not (spared or row.again or row.refines or name not in self.ended):
            return False
        if patient or answer is None:
            return patient or not (self.bounded or self.settled)
        if may_decide(answer, self.problem.delta):
            return True
        if self.settled or (self.bounded and not self._likely(name)):
            return False
        return self.full or (few and not self.bounded) or (row.again and answer.applicable)

    def below(self, names: tuple[str, ...]) -> None:
        """Ask for lower bounds that take little."""
        for name, below in ((name, ENGINES[name].below) for name in names if not self.safe):
            self.watch.engine = name
            with contextlib.suppress(EngineError), contained(name), self.watch.share(_BELOW, _BRIEFLY):
                asked = self.problem if self.problem.reach is None or not self.fixed else self.meeting[1]
                if below is not None and (found := below(asked)) is not None:
                    found = self._without(found)
                    self.answers[name] = with_lower(self.answers.get(name, found), found)
                    self.watch.noted(0.0, found.log10_lower)

    def endlessly(self, names: tuple[str, ...]) -> bool:
        """Whether a function of one state settles a target without an end, which others meet at some late time.

        Or so many steps that others, which look at all of them, take long.
        """
        system, plain = self.problem.system, self.problem.reach is None
        asked = self.late or (plain and system.time == "discrete" and _LONG < self.problem.horizon < math.inf)
        for name in (name for name in names if asked and system.dimension == 1):
            if ENGINES[name].endless:
                self.ask(name, self.request)
        return asked and self.settled

    def _in_turn(self, names: tuple[str, ...]) -> None:
        """Ask one engine after the other; one that takes long is interrupted for those after it."""
        if not names:
            return
        names, turn, patience = in_order(names, self.problem, self.answers), [], _PATIENCE * self.watch.left
        promising = 1 <= self._chance(names[0]) < math.inf
        share = _TURN if any(map(self._likely, names[1:])) or not self._likely(names[0]) else _LAST

        def others() -> None:
            turn.append(True)
            with self.watch.share(_LAST if promising else share):
                self._in_turn(names[1:])
            if not promising:
                with self.watch.share(share):
                    self.go_on(names[1:], patient=False)
            if self.safe:
                raise OutOfTime

        def first_bounds() -> None:
            if not self.safe:
                self._first_bounds(names[1:], _FIRST if promising else _TURN)
                if self.safe:
                    raise OutOfTime
            self.watch.remind(max(patience - _SOON, 0.0), others)

        early = _SOON < patience < math.inf and not self.bounded
        with self.watch.after(_SOON if early else patience, first_bounds if early else others):
            self._turn_of(names[0])
        if not turn:
            self._in_turn(names[1:])

    def _again(self) -> None:
        """In two states ask those that are done once more, though not thoroughly, if they look at more then."""
        for name in (name for name in tuple(self.spent) if ENGINES[name].again and not self.safe):
            if self.problem.system.dimension == 2 and self.answers[name].applicable and self._likely(name):
                self.ask(name, replace(self.request, before=self.answers[name].details))

    def _first_bounds(self, names: tuple[str, ...], share: float) -> None:
        """Ask those that have a first bound soon for it."""
        for name in (name for name in names if 0 < ENGINES[name].soon <= self.problem.system.dimension):
            if name not in self.answers:
                with self.watch.share(share):
                    self.ask(name, replace(self.request, first=True))

    def _likely(self, name: str) -> bool:
        """Whether no sketch says that an engine has hardly a chance."""
        sketched = self.sketches.get(name)
        return (sketched is not None and sketched.applicable and sketched.log10_delta < 0) or self._chance(name) >= 1

    def _chance(self, name: str) -> float:
        """What a sketch says of an engine's chance; infinite where none says anything."""
        chance = ENGINES[name].chance
        if chance is not None and self.request.constants is None and chance not in self.chances:
            self.chances[chance] = math.inf
            with contextlib.suppress(EngineError), contained(name):
                self.chances[chance] = chance(self.problem)
        return self.chances.get(chance, math.inf)

    def _turn_of(self, name: str) -> None:
        if ENGINES[name].dear and ENGINES[name].spares <= self.problem.system.dimension:
            self._again()  # cells of the start are not dear
        quick = self.spared(name)
        if quick and self.problem.system.dimension > _LARGE:
            return
        if quick and name in self.sketches:
            self.answers[name] = self.sketches[name]
            return
        before = self.answers.get(name)  # of a first turn
        if before is not None and not before.applicable:
            return
        most = _UNLIKELY if self.bounded and not self._likely(name) else math.inf
        most = min(most, _ANYWAY[self.problem.system.dimension <= _FEW]) if self.refuted else most
        with self.watch.share(_EXTRA if self.safe else 1.0, most):
            self.ask(name, replace(self.request, quick=quick, before=before and before.details))

    def ask(self, name: str, request: Request) -> None:
        """Keep the best that an engine finds; ``OutOfTime`` where the time ended it."""

        def found(answer: EngineAnswer) -> None:
            before = self.answers.get(name)
            if before is None or not before.applicable or answer.log10_delta <= before.log10_delta:
                self.answers[name] = with_lower(answer, before)
            if answer.applicable and answer.certified:
                self.watch.noted(answer.log10_delta, answer.log10_lower)

        begun = self.watch.spent
        try:
            answer = self._asked(name, replace(request, found=found))
        except OutOfTime:
            self.left_at[name] = self.watch.phase
            self.answers.setdefault(name, stopped(name, self.watch.phase))
            self._note(name, request, self.watch.spent - begun, None)
            raise
        self.left_at.pop(name, None)
        if answer.applicable or name not in self.answers or not self.answers[name].applicable:
            found(answer)
        self._note(name, request, self.watch.spent - begun, answer)

    def _note(self, name: str, request: Request, seconds: float, answer: EngineAnswer | None) -> None:
        """Keep what a request took, and with which effort the engine came to its end (None: it did not)."""
        if request.quick or request.first:
            return
        if answer is not None:
            self.ended.add(name)
        spent = None if answer is None else answer.effort
        if request.thorough or spent is not None:
            known, effort = self.answers[name], request.effort if spent is None else spent
            lower = -math.inf if known.log10_lower is None else known.log10_lower
            turn = Turn(effort=1.0 if effort is None else effort, seconds=seconds, ended=answer is not None,
                        log10_delta=known.log10_delta, log10_lower=lower)  # fmt: skip
            self.turns.setdefault(name, []).append(turn)

    def _asked(self, name: str, request: Request) -> EngineAnswer:
        """What an engine answers; where it fails, that it does not apply, and why. ``spent`` counts the seconds."""
        self.watch.engine, self.watch.phase = name, ""
        self.watch.poll()
        begun, outer, self._inner = perf_counter(), self._inner, 0.0
        try:
            with contained(name):
                found = request.found
                asked = replace(request, found=lambda answer: found(self._without(answer)))
                row = ENGINES[name]
                if self.lasting and self.problem.reach is None and not row.endless:
                    raise EngineError("this engine needs a finite horizon, and not a very long one.")
                if not row.reaches and self.problem.reach is not None and self.problem.reach.stays:
                    raise EngineError("this engine does not serve targets that are to be stayed in.")
                if self.problem.reach is None or (row.reaches and not self.fixed):
                    return self._without(self._plainly(row, asked) if not self.late else self._in_time(row, asked))
                return self._without(self._meeting(name, asked))
        except EngineError as error:
            return EngineAnswer(applicable=False, reason=str(error), method=name)
        finally:
            whole = perf_counter() - begun
            self.spent[name] = self.spent.get(name, 0.0) + whole - self._inner
            self._inner = outer + whole

    def _plainly(self, row: Engine, request: Request) -> EngineAnswer:
        """What an engine answers; from most of a random start where it serves sets only."""
        answer = row.prove(self.problem, request)
        usual = answer.applicable or not self.problem.initial.random
        return answer if usual else prove_truncated(row.prove, self.problem, request)

    def _without(self, answer: EngineAnswer) -> EngineAnswer:
        """The answer without its lower bound where constants are unknown, or where it counts paths that only ended."""
        system, ends = self.problem.system, self.problem.ending
        ends = ends and system.time == "continuous" and (system.dimension > 1 or answer.method != "values")
        return replace(answer, log10_lower=None, conclusive=False) if ends or self.problem.unknown else answer

    @cached_property
    def lasting(self) -> bool:
        """Whether the horizon is infinite, or of so many steps that none of them can be looked at."""
        return self.problem.endless or (self.problem.system.time == "discrete" and self.problem.horizon > _LASTING)

    @property
    def late(self) -> bool:
        """Whether a target may be met at any time, and time goes on without steps: it is met by some time then."""
        return self.problem.endless and self.problem.reach is not None and self.problem.system.time == "continuous"

    def _in_time(self, row: Engine, request: Request) -> EngineAnswer:
        """What an engine answers about meeting the target by a time; not to meet it by then says nothing from below."""
        found = row.prove(self.problem, request) if row.endless else None
        if found is None or not found.applicable:
            found = row.prove(self.problem.replace(horizon=arrival(self.problem)[0]), request)
            return replace(found, log10_lower=None, conclusive=False)
        return found

    @cached_property
    def fixed(self) -> bool:
        """Whether the target counts at one time only, so that to meet it then is all that is asked."""
        first, last = window_of(self.problem)
        return first == last and not self.problem.reach.stays

    @cached_property
    def meeting(self) -> tuple[float, Problem]:
        """A time, and the plain problem of meeting the target then."""
        time = best_time(self.problem)
        return time, met_at(self.problem, int(time) if self.problem.system.time == "discrete" else time)

    def _meeting(self, name: str, request: Request) -> EngineAnswer:
        """What an engine answers about meeting the target at one time: of more than one no lower bound follows."""
        time, plain = self.meeting

        def of_target(answer: EngineAnswer) -> EngineAnswer:
            words = f"to be in the target at {time:g} is one way of not failing, and {answer.reason}"
            reason = words if answer.applicable and not self.fixed else answer.reason
            if not self.fixed:
                answer = replace(answer, log10_lower=None, conclusive=False)
            return replace(answer, hit=time, reason=reason)

        found = request.found
        return of_target(ENGINES[name].prove(plain, replace(request, found=lambda answer: found(of_target(answer)))))

    def verdict(self, names: tuple[str, ...]) -> Verdict:
        """The best answer, and what was left undone."""
        self.answers = self.sketches | self.answers
        answers = {name: self.answers[name] for name in ENGINES if name in self.answers}
        found = verdict_of(self.problem, answers, names[0] if len(names) == 1 else "auto")
        seconds = MappingProxyType({name: self.spent.get(name, 0.0) for name in answers})
        if found.status == "UNKNOWN":
            found = replace(found, reason=f"{found.reason} {self._end(names)}".strip())
        return replace(found, seconds=seconds)

    def _end(self, names: tuple[str, ...]) -> str:
        """Why the search ended with nothing decided."""
        if self.watch.limit is not None and self.watch.left <= 0:
            return undone(self.watch, self.answers, self.left_at, names)
        return unfinished([one.name for one in self.standings(names, patient=True) if not one.exhausted])
