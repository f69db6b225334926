"""Which engine is asked next where nothing is decided yet: a function of what all of them have done so far.

An effort is a multiple of the work that an engine does where it is asked alone. Every engine that left something out
is asked with effort 1 first, the one with the smallest bound before the others. After that engines whose bounds fall
with their effort are asked with more and more of it, in turn, each with as much as the time that is left allows at its
own pace. An engine is exhausted once it comes to its end with eight times the effort and neither proves nor does more
than before: less than that may be too little for the next grid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

_PART = 0.8  # of the time that is left, for one engine where others wait
_USED = 0.85  # of the time that is left, which a request is expected to take
_GROWTH = (1.5, 8.0)  # the least and the largest ratio of an effort to the one before
_AS_LONG = (1.25, 0.02)  # times the seconds of the request before, and seconds: no more work than that was done
_GAIN = 1e-6  # of log10: a bound that moved by less did not move


@dataclass(frozen=True, kw_only=True)
class Turn:
    """One request: what it took, and the bounds of the engine after it.

    Parameters
    ----------
    effort : float
        Multiple of the work that the engine does where it is asked alone.
    seconds : float
        That it took.
    ended : bool
        Whether the engine came to its end; if not, time ended it.
    log10_delta, log10_lower : float
        log10 of its bounds; 0 and -inf where it has none.
    """

    effort: float
    seconds: float
    ended: bool
    log10_delta: float
    log10_lower: float


@dataclass(frozen=True, kw_only=True)
class Standing:
    """What one engine has done so far.

    Parameters
    ----------
    name : str
    applicable : bool
        Whether it serves the problem, as far as is known.
    waits : bool
        Whether it has not done yet what it does where it is asked alone.
    refines : bool
        Whether its bound falls with its effort.
    last : bool
        Whether it is asked after those that wait beside it.
    near : bool
        Whether the target lies between its bounds, which are near each other.
    log10_delta : float
        Its smallest bound.
    turns : tuple of Turn
        Requests whose effort is known, the oldest first.
    """

    name: str
    applicable: bool = True
    waits: bool = False
    refines: bool = False
    last: bool = False
    near: bool = False
    log10_delta: float = 0.0
    turns: tuple[Turn, ...] = ()

    @property
    def interrupted(self) -> bool:
        """Whether time ended its last request."""
        return bool(self.turns) and not self.turns[-1].ended

    @property
    def exhausted(self) -> bool:
        """Whether more effort would prove no more."""
        if not self.applicable and not self.waits:
            return True
        if self.waits or self.interrupted:
            return False
        if not self.refines:
            return True
        ended = [turn for turn in self.turns if turn.ended]
        earlier = [turn for turn in ended if turn.effort * _GROWTH[1] <= ended[-1].effort * (1 + 1e-9)]
        if not earlier:
            return False
        before, after = earlier[-1], ended[-1]
        moved = before.log10_delta - after.log10_delta > _GAIN or after.log10_lower - before.log10_lower > _GAIN
        return not moved and after.seconds <= _AS_LONG[0] * before.seconds + _AS_LONG[1]


@dataclass(frozen=True, kw_only=True)
class Action:
    """The next request: of which engine, with which effort, for how many seconds at most.

    Without an effort the engine does as much of what it does alone as it takes to fit into the time.
    """

    engine: str
    effort: float | None
    seconds: float


def next_action(standings: Sequence[Standing], left: float, *, patient: bool) -> Action | None:
    """The next request; None where nothing is left to be asked.

    Parameters
    ----------
    standings : sequence of Standing
        Of all engines, in their order.
    left : float
        Seconds that may be spent; infinite without a limit.
    patient : bool
        Whether engines are asked for more than effort 1.
    """
    waiting = [
        one for one in standings
        if one.waits and not one.interrupted and (not one.turns or _most(one, left) >= _GROWTH[0])
    ]  # fmt: skip
    if waiting:
        chosen = min(waiting, key=lambda one: (one.last, not one.near, one.log10_delta))
        others = len(waiting) > 1 or (patient and any(one.refines and one.applicable for one in standings))
        share = _PART * left if others else left
        known = bool(chosen.turns)
        effort = min(_last(chosen).effort * _most(chosen, share), 1.0) if known else None
        return Action(engine=chosen.name, effort=effort, seconds=share)
    if not patient:
        return None
    unfinished = [one for one in standings if not one.exhausted]
    able = [one for one in unfinished if not one.interrupted and _most(one, left) >= _GROWTH[0]]
    if able:
        chosen = min(able, key=lambda one: (len(one.turns), one.log10_delta))
        share = _PART * left if len(unfinished) > 1 else left
        return Action(engine=chosen.name, effort=_last(chosen).effort * _most(chosen, share), seconds=share)
    if not unfinished:
        return None
    chosen = min(unfinished, key=lambda one: (one.interrupted, one.log10_delta))
    growth = 1.0 if chosen.interrupted else _GROWTH[0]
    return Action(engine=chosen.name, effort=_last(chosen).effort * growth, seconds=left)


def _last(one: Standing) -> Turn:
    """Its last request."""
    first = Turn(effort=1.0, seconds=0.0, ended=True, log10_delta=one.log10_delta, log10_lower=-math.inf)
    return one.turns[-1] if one.turns else first


def _most(one: Standing, left: float) -> float:
    """The ratio of efforts that fills the time that is left at the pace of its last request."""
    seconds = _last(one).seconds
    return min(_USED * left / seconds, _GROWTH[1]) if seconds > 0 else _GROWTH[1]
