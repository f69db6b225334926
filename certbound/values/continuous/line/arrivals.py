"""Targets of one state: the probability of getting there in time, before a limit on the other side, from both sides.

Between the limit and the target's face a path that leaves by the face has arrived, and one that leaves by the limit has
failed, as has one that is still there at the horizon. With P the probability of arriving, w + (1 - w) P is 1 on the
face and w on the limit and at the horizon: V is proposed as its logarithm, for either bound with a layer in the corner
of face and horizon. Below, e^V <= w has to hold on the limit and at the horizon; above, V >= 0 on the face and e^V >= w
elsewhere: what ends there counts at least w, which is subtracted.

Where neither model nor limits depend on time, and nothing disturbs, the start that is farthest from the target is the
worst: from there a path passes every other one, with less time left. A model that depends on time has a single start.
"""

from __future__ import annotations

import dataclasses
import math

from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.problem.sets import Outside, Region
from certbound.values.continuous.held_faces import check_noise
from certbound.values.continuous.hypotheses import NEGLIGIBLE, Model, Need, examine, patched_of, up
from certbound.values.continuous.line import ladder
from certbound.values.continuous.line.initial_law import Start, start_of
from certbound.values.continuous.line.linked import Link, prove_below, spans
from certbound.values.continuous.line.phases import Phase, limits_of
from certbound.values.continuous.line.reach import cuts_of
from certbound.values.continuous.payment import Payment, pay_upper
from certbound.values.continuous.surface import Surface
from certbound.watch import OutOfTime

Proposed = tuple[Surface, Payment]
Bounds = tuple[float, float | None, str, ladder.Proposals]

_RUNGS = 3
_FLOOR = math.log(0.3)
"""V at the limit and at the horizon: with w = e^V there, V is log(w + (1 - w) P), and w is subtracted at last."""


def bound_arrival(
    problem: Problem, model: Model, target: Region
) -> tuple[float, float, str, tuple[list[Proposed], list[Proposed]]]:
    """Natural logarithms of an upper and a lower bound of P(failing) from the worst start (0, -inf: none), and words.

    ``problem`` has no target; the arrival has to be within its horizon. What certificates state comes last: V of
    P(arriving), from below for the upper bound and from above for the lower one.

    Raises
    ------
    InfeasibleError
        Limits or targets that depend on time, a model that does with more than one start, disturbances, random starts,
        starts that are not on one side of the target, or a limit between them and it.
    """
    side, start, spread = _placed(problem, model, target)
    aux = problem.replace(safe=[*problem.safe, Outside(target, label="the target")])
    cuts = cuts_of(aux, model, start)
    inner, outer = (ladder.room_of(aux, model, cuts, start, inner=way) for way in (True, False))
    if not ladder.is_plain(inner) or not ladder.is_plain(outer):
        raise InfeasibleError("value functions in continuous time need limits that stand still for a target.")
    _check_face(problem, outer.phases[0], side)
    small = inner.phases[0]
    wide = outer.phases[0]
    check_noise(outer.models[0], (wide.start, wide.end), [(wide.low, wide.high)])
    # below, the limit is rounded inward and the face into the target; above the other way round
    late = _between(outer, (small.low, wide.high) if side == 1 else (wide.low, small.high), side, model, start)
    early = _between(outer, (wide.low, small.high) if side == 1 else (small.low, wide.high), side, model, start)
    limited = wide.closed[1 - side]  # a path that passes a mere cut may come back and arrive
    least, most, done, proposed = _bounds(early if limited else None, late, (start, spread), side)
    words = f"value function in one state for arriving, cells x slabs of time: {_listed(done)}"
    return complement(least, up=True), complement(most, up=False), words, proposed


def bound_ended(problem: Problem, model: Model, seconds: float) -> Bounds | None:
    """The same as `bound_line` of P(failing) where a path ends as it leaves the domain; None where that says nothing.

    Where both limits lie within the domain, it does not matter; where one does, failing is to arrive there before the
    domain's other end, where e^V <= w (above: >= w) has to hold. None for limits that move or have windows, random
    starts, and noise that vanishes between: there leaving the domain counts as failing.
    """
    domain, start = problem.domain, start_of(problem)
    plain = problem.replace(domain=None, leaving="unsafe")
    limits = limits_of(plain, inner=True)
    still = all(limit.center is None and window == (0.0, float(problem.horizon)) for limit, window in limits)
    if domain is None or start.random or not still:
        return None
    ends = float(domain.low[0]), float(domain.high[0])
    failing = [
        side for side, sign in ((0, 1), (1, -1))
        if any(limit.side == side and sign * limit.offset > sign * ends[side] for limit, _ in limits)
    ]  # fmt: skip
    if len(failing) == 2:
        return ladder.bound_line(plain, model, seconds, True)
    if not failing:
        return None
    (side,) = failing
    inner, outer = (ladder.room_of(plain, model, ends, start, inner=way) for way in (True, False))
    if not ladder.is_plain(inner) or not ladder.is_plain(outer):
        return None
    pairs = [(ends[0], room.phases[0].high) if side == 1 else (room.phases[0].low, ends[1]) for room in (inner, outer)]
    early, late = (_between(room, pair, side, model, start) for room, pair in zip((inner, outer), pairs))
    wide = late.phases[0]
    try:
        check_noise(late.models[0], (wide.start, wide.end), [(wide.low, wide.high)])
    except InfeasibleError:
        return None
    least, most, done, (below, above) = _bounds(early, late, (start, start), side, lowered=True)
    if not most < 0 and least == -math.inf:
        return None
    words = f"value function in one state for failing before the domain is left, cells x slabs of time: {_listed(done)}"
    return most, None if least == -math.inf else least, words, (_each(above), _each(below))


def _each(found: list[Proposed]) -> list[ladder.Proposed]:
    return [((surface,), payment) for surface, payment in found]


def _listed(done: list[str]) -> str:
    return ", ".join(done) or "none came to an end"


def _placed(problem: Problem, model: Model, target: Region) -> tuple[int, Start, Start]:
    """The side of the starts on which the target lies, the worst of them rounded outward, and an interval around it."""
    if target.moving or any(c.during is not None for c in problem.constraints):
        raise InfeasibleError("value functions in continuous time need a target and limits without time.")
    if problem.system.disturbance is not None:
        raise InfeasibleError("value functions in continuous time do not serve targets under disturbances.")
    if problem.initial.random:
        raise InfeasibleError("value functions in continuous time need a set of starts for a target.")
    start, around = start_of(problem), target.hull()
    if not model.autonomous and start.low < start.high:
        raise InfeasibleError("value functions of models that depend on time need a single start for a target.")
    if start.high < around.lo[0]:
        return 1, *start.end(-1)
    if start.low > around.hi[0]:
        return 0, *start.end(1)
    raise InfeasibleError("value functions in continuous time need starts on one side of the target.")


def _check_face(problem: Problem, phase: Phase, side: int) -> None:
    """Refuse a limit between the starts and the target's face, or on it."""
    places = [limit.offset for limit, _ in limits_of(problem, inner=True) if limit.side == side]
    if any(place <= phase.high if side == 1 else place >= phase.low for place in places):
        raise InfeasibleError("value functions in continuous time need limits that lie beyond the target's face.")


def _between(
    room: ladder.Room, ends: tuple[float, float], side: int, model: Model, start: Start
) -> ladder.Room:
    phase = dataclasses.replace(room.phases[0], low=ends[0], high=ends[1], closed=(side == 0, side == 1))
    return dataclasses.replace(room, phases=[phase], lines=[ladder.line_of(phase, model, start)])


def _bounds(
    early: ladder.Room | None, late: ladder.Room, starts: tuple[Start, Start], side: int, *, lowered: bool = False
) -> tuple[float, float, list[str], tuple[list[Proposed], list[Proposed]]]:
    """Natural logarithms of bounds of P(arriving): at least (first start), at most (some of the others).

    With ``lowered`` w follows the bound found so far, so that small probabilities are not lost beside it.
    """
    start, spread = starts
    proposed: tuple[list[Proposed], list[Proposed]] = ([], [])
    rough = ladder.sketches(late)
    least, most, done, floor = -math.inf, 0.0, list[str](), _FLOOR
    for fineness, tolerance, lead in ladder.LADDER[:_RUNGS]:
        share = lead / max(rough[0].growth, 1.0)
        try:
            floor = min(floor, most + _FLOOR) if lowered else floor
            links = early and ladder.surface_of_arrival(early, side, rough, (share, fineness, tolerance, lead), floor)
            if links and spans(links, upper=True):
                surface, above = _prove_above(links[0], spread, side)
                proposed[1].extend([(surface, above)] if above.log < most else [])
                most = min(most, above.log)
            links = ladder.surfaces_below(late, start, rough, (share, fineness, 0.5 * tolerance, lead), floor)
            if links is not None and spans(links, upper=False):
                payment = prove_below(links, start)
                done.append(f"{links[0].surface.cells[0]} x {links[0].surface.slabs}")
                if payment is not None and payment.log > least:
                    least = payment.log
                    proposed[0].append((links[0].surface, payment))
        except OutOfTime:
            if not done:
                raise
            break
    return least, most, done, proposed


def _prove_above(link: Link, start: Start, side: int) -> Proposed:
    """An upper bound of log P(arriving), whatever the surface is: V >= 0 on the face, and w = exp(inf V) elsewhere."""
    surface = link.surface
    for _ in range(3):
        missing = -surface.face_range(0, side)[0]
        surface = surface.raised(up(missing)) if missing > 0 else surface
    if surface.face_range(0, side)[0] < 0:
        return surface, Payment(log=0.0)
    level = up(start.highest(surface, link.phase))
    need = Need(spare=NEGLIGIBLE / (link.phase.end - link.phase.start), start=level, top=0.0)
    proof = examine(surface, link.model, need, upper=True)
    floor = min(float(surface.range_at(-1)[0].min()), surface.face_range(0, 1 - side)[0])
    parts = patched_of(proof, proof.ranges.residual_high, need, surface.steps)
    return surface, pay_upper(parts, level, floor - 1e-15 * (1 + abs(floor)))


def complement(log: float, *, up: bool) -> float:
    """log(1 - e^log), rounded up or down."""
    rest = -math.expm1(log) if log > -math.inf else 1.0
    rest = rest * (1 + 1e-13) + 1e-300 if up else rest * (1 - 1e-13)
    return min(math.log(rest), 0.0) + (1e-14 if up and rest < 1 else 0.0) if rest > 0 else -math.inf
