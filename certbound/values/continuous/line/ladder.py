"""Both bounds in one state, refined until the work is spent or nothing is gained."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.problem.problem import Problem
from certbound.rigor.intervals import Interval
from certbound.values.continuous.held_faces import check_noise, held_face, resolved
from certbound.values.continuous.hypotheses import Model, raised_above
from certbound.values.continuous.line.initial_law import Start, start_of
from certbound.values.continuous.line.linked import Link, prove_above, prove_below, raised_links, spans
from certbound.values.continuous.line.moved_model import model_on, parts_of
from certbound.values.continuous.line.phases import (
    Gate,
    Phase,
    check_room,
    held_at,
    last_instant,
    limits_of,
    pieces,
)
from certbound.values.continuous.line.profiles import (
    End,
    propose_above,
    propose_arrival,
    propose_below,
    shifted,
    values_of,
)
from certbound.values.continuous.line.reach import cuts_of
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.proposal import Line, Sketch, sketch
from certbound.values.continuous.shapes import before_held, sealed
from certbound.values.continuous.surface import Surface
from certbound.watch import OutOfTime

LADDER = ((4.0, 1e-4, 0.008), (4.5, 3e-5, 0.005), (6.0, 1e-5, 0.003), (8.0, 3e-6, 0.002))
"""Cells a bend, error a step, and lead (a share of the horizon, by d log P / d log T): one attempt after another."""
_DEARER = 2.0  # what the next attempt costs, in units of the last one
_SMALL_GAIN = 0.005
_ASIDE = 4.0  # how far from starts and limits faces that no path crosses are looked for, in units of these
_RATE = 80_000.0
"""Patches of 63 samples that are taken for a second: measured once, so that a grant of seconds is one of work."""
_USUAL_SAMPLES = 63.0


Proposed = tuple[tuple[Surface, ...], Payment]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Room:
    """One side's phases with their gates, models and lines."""

    phases: list[Phase]
    gates: list[Gate]
    models: list[Model]
    lines: list[Line]


@dataclass(slots=True)
class _Found:
    """The best bounds so far (natural logarithms), and the patches that were proved."""

    upper: float = 0.0
    lower: float | None = None
    done: list[str] = field(default_factory=list)
    work: float = 0.0
    proposed: list[Proposed] = field(default_factory=list)
    below: list[Proposed] = field(default_factory=list)


Held = tuple[float | None, float | None]
Proposals = tuple[list[Proposed], list[Proposed]]


def bound_line(
    problem: Problem, model: Model, seconds: float, lower: bool
) -> tuple[float, float | None, str, Proposals]:
    """Natural logarithms of an upper and a lower bound (None: there is none), words, and what certificates state.

    Raises
    ------
    InfeasibleError
        Constraints at time 0 alone, obstacles that appear later, noise that vanishes, or paths beyond every bound.
    """
    start = start_of(problem)
    if not problem.constraints or any(c.during == (0.0, 0.0) for c in problem.constraints):
        raise InfeasibleError("value functions do not serve constraints at time 0 alone.")
    held = held_in(problem, model, start)
    cuts = cuts_of(problem, model, start, held)
    inner, outer = (room_of(problem, model, cuts, start, held, inner=side) for side in (True, False))
    for phase, one in zip(outer.phases, outer.models):
        check_noise(one, (phase.start, phase.end), [(phase.low, phase.high)], [phase.held])
    lower = lower and (held == (None, None) or len(model.branches) == 1)
    rough = sketches(inner)
    leak = _leak(outer, model, cuts, start) if lower and len(outer.phases) > 1 else -math.inf
    if leak > -math.inf:
        outer = dataclasses.replace(
            outer, phases=[dataclasses.replace(phase, closed=(True, True)) for phase in outer.phases]
        )
    found = _Found()
    for fineness, tolerance, lead in LADDER:
        before = found.work
        share = lead / max(rough[0].growth, 1.0)
        try:
            gain = _raise_upper(found, inner, start, rough, (share, fineness, tolerance, lead))
            if lower:
                gain = max(gain, _raise_lower(found, outer, start, rough, (share, fineness, 0.5 * tolerance, lead)))
        except OutOfTime:
            if found.upper < 0:
                break
            raise
        if gain < _SMALL_GAIN or found.work + _DEARER * (found.work - before) > seconds * _RATE:
            break
    found.lower = _less(found.lower, leak)
    if leak > -math.inf:  # of which certificates state nothing
        found.below.clear()
    words = f"value function in one state, cells x slabs of time: {', '.join(found.done) or 'none came to an end'}"
    return found.upper, found.lower, words, (found.proposed, found.below)


def held_in(problem: Problem, model: Model, start: Start) -> Held:
    """Below and above the starts the nearest places that no path crosses; None where there are none."""
    if start.random:  # it may be beyond any face
        return None, None
    ends, last = (start.low, start.high), last_instant(problem)
    offsets = [[limit.offset for limit, _ in limits_of(problem, inner=True) if limit.side == side] for side in (0, 1)]
    room = _ASIDE * max(1.0, *(abs(place) for place in (*ends, *offsets[0], *offsets[1])))
    box = (min([ends[0] - room, *offsets[0]]), max([ends[1] + room, *offsets[1]]))
    low, high = (held_face(model, [box], ends, (0.0, last), 0, side) for side in (0, 1))
    return low, high


def room_of(
    problem: Problem, model: Model, cuts: tuple[float, float], start: Start, held: Held = (None, None), *, inner: bool
) -> Room:
    parts = parts_of(model, float(problem.horizon))
    phases, gates = pieces(problem, cuts, inner=inner, breaks=[end for end, _ in parts])
    phases = [held_at(phase, held) for phase in phases]
    check_room(phases)
    models = [model_on(phase, next(one for end, one in parts if phase.end <= end)) for phase in phases]
    if held != (None, None):
        models = [resolved(one, (phase.start, phase.end), [(phase.low, phase.high)])
                  for phase, one in zip(phases, models)]  # fmt: skip
    lines = [line_of(phase, one, start) for phase, one in zip(phases, models)]
    return Room(phases=phases, gates=gates, models=models, lines=lines)


def _leak(room: Room, model: Model, cuts: tuple[float, float], start: Start) -> float:
    """log of a bound of the probability that a path passes a cut while the line is cut there; -inf without cuts.

    Behind a gate V is 0 up to the face, which no small value on that face would allow: so there lower bounds count
    paths through a cut as failing, and take this off.
    """
    ends = [phase.end for phase in room.phases if not all(phase.closed)]
    if not ends:
        return -math.inf
    phase = Phase(start=0.0, end=max(ends), low=cuts[0], high=cuts[1], closed=(True, True))
    alone = Room(
        phases=[phase], gates=[Gate(time=phase.end, low=-math.inf, high=math.inf)], models=[model],
        lines=[line_of(phase, model, start)],
    )  # fmt: skip
    rough = sketches(alone)
    fineness, tolerance, lead = LADDER[0]
    links = surfaces_above(alone, start, rough, (lead / max(rough[0].growth, 1.0), fineness, tolerance, lead))
    return 0.0 if links is None or not spans(links, upper=True) else prove_above(links, start).log


def _less(lower: float | None, leak: float) -> float | None:
    """log(e^lower - e^leak), rounded down; None where nothing is left."""
    if lower is None or leak == -math.inf:
        return lower
    left = -math.expm1(min(leak - lower, 0.0))
    return lower + math.log(left) - 1e-12 * (1 + abs(lower)) if left > 1e-3 else None


def line_of(phase: Phase, model: Model, start: Start) -> Line:
    """The line of a phase, in plain floats."""
    drift, square = compile_numpy(model.drift.tape), compile_numpy(model.square.tape)
    corners = [[float(value.mid) for value in branch] for branch in model.branches]

    def drifts(t: float, y: Array) -> Array:
        return np.array([np.broadcast_to(drift(t, y, *corner)[..., 0], np.shape(y)) for corner in corners])

    ends = phase.local(Interval(start.low, start.high), phase.start)
    starts = (float(ends.lo), float(ends.hi)) if start.low < start.high else (float(ends.mid), float(ends.mid))
    starts = (float(np.clip(starts[0], phase.low, phase.high)), float(np.clip(starts[1], phase.low, phase.high)))
    line = Line(
        low=phase.low, high=phase.high, horizon=phase.end - phase.start, drift=drifts,
        square=lambda t, y: np.broadcast_to(square(t, y)[..., 0, 0], np.shape(y)),
        starts=starts, autonomous=model.autonomous, held=phase.held,
    )  # fmt: skip
    return shifted(line, phase.start)


def sketches(room: Room) -> list[Sketch]:
    """Rough solutions of all phases, the last one first; the level is that of the start."""
    found: list[Sketch] = []
    for k in reversed(range(len(room.phases))):
        begin = None
        if found or is_gated(room, k):
            later = found[0] if found else None

            def begin(y: Array, k: int = k, later: Sketch | None = later) -> Array:
                x, gate = _x_of(room.phases[k], y, room.gates[k].time), room.gates[k]
                inside = (x >= gate.low) & (x <= gate.high)
                if later is None:
                    return np.where(inside, 0.0, 1.0)
                there = _y_of(room.phases[k + 1], x, gate.time)
                u = np.exp(np.interp(there, later.nodes, later.values, left=0.0, right=0.0))
                return np.where(inside, u, 1.0)

        found.insert(0, sketch(room.lines[k], begin=begin))
    return [dataclasses.replace(one, level=found[0].level) for one in found]


def is_gated(room: Room, k: int) -> bool:
    gate, phase = room.gates[k], room.phases[k]
    ends = _y_of(phase, np.array([gate.low, gate.high]), gate.time)
    slack = 1e-9 * (phase.high - phase.low)
    return bool(ends[0] > phase.low + slack or ends[1] < phase.high - slack)


def _x_of(phase: Phase, y: Array, t: float) -> Array:
    return np.asarray(phase.place(Interval.point(y), t).mid)


def _y_of(phase: Phase, x: Array, t: float) -> Array:
    finite = np.clip(x, -1e300, 1e300)
    return np.where(np.isfinite(x), phase.local(Interval.point(finite), t).mid, x)


def _end(room: Room, k: int, later: Surface | None) -> End:
    phase, gate = room.phases[k], room.gates[k]
    ends = _y_of(phase, np.array([gate.low, gate.high]), gate.time)
    after = None
    if later is not None:
        values = values_of(later)

        def after(y: Array) -> Array:
            return values(_y_of(room.phases[k + 1], _x_of(phase, y, gate.time), gate.time))

    return End(gate=(float(ends[0]), float(ends[1])), after=after)


def _placed(surface: Surface, phase: Phase) -> Surface:
    """The surface with its clock set to the phase."""
    times = phase.start + surface.times
    times[0], times[-1] = phase.start, phase.end
    return dataclasses.replace(surface, times=times)


def _raise_upper(
    found: _Found, room: Room, start: Start, rough: list[Sketch], effort: tuple[float, float, float, float]
) -> float:
    """One attempt at the upper bound; what it gained."""
    links = surfaces_above(room, start, rough, effort)
    if links is None or not spans(links, upper=True):
        return 0.0
    found.done.append(" + ".join(f"{link.surface.cells[0]} x {link.surface.slabs}" for link in links))
    found.work += _patches_in(links)
    payment = prove_above(links, start)
    gain = found.upper - payment.log
    if gain > 0 and stands_still(room) and not any(links[0].held):
        found.proposed.append((tuple(link.surface for link in raised_links(links)), payment))
    if any(links[0].held) and is_plain(room):
        _raise_shorter(found, room, start, rough, effort)
    found.upper = min(found.upper, payment.log)
    return gain


def _raise_shorter(
    found: _Found, room: Room, start: Start, rough: list[Sketch], effort: tuple[float, float, float, float]
) -> None:
    """A bound on a line that ends before the faces that no path crosses: certificates state nothing of such faces."""
    links = surfaces_above(room, start, rough, effort, cut=True)
    if links is None or not spans(links, upper=True) or any(links[0].held):
        return
    found.work += _patches_in(links)
    payment = prove_above(links, start)
    if payment.log < min([0.0, *(one.log for _, one in found.proposed)]):
        found.proposed.append(((raised_above(links[0].surface),), payment))
        found.upper = min(found.upper, payment.log)


def is_plain(room: Room) -> bool:
    """Whether one surface in the state itself says all: limits that stand still over the whole horizon."""
    phase = room.phases[0]
    return len(room.phases) == 1 and phase.origin is None and phase.width is None and not is_gated(room, 0)


def stands_still(room: Room) -> bool:
    """Whether certificates state such stages: in the state itself, of one model."""
    return all(
        phase.origin is None and phase.width is None and model is room.models[0]
        for phase, model in zip(room.phases, room.models)
    )


def _raise_lower(
    found: _Found, room: Room, start: Start, rough: list[Sketch], effort: tuple[float, float, float, float]
) -> float:
    """One attempt at the lower bound; what it gained."""
    links = surfaces_below(room, start, rough, effort)
    if links is None or not spans(links, upper=False):
        return 0.0
    found.work += _patches_in(links)
    payment = prove_below(links, start)
    if payment is None:
        return 0.0
    gain = math.inf if found.lower is None else payment.log - found.lower
    if gain > 0 and stands_still(room) and not any(links[0].held):
        found.below.append((tuple(link.surface for link in links), payment))
    found.lower = payment.log if found.lower is None else max(found.lower, payment.log)
    return gain


def surfaces_above(
    room: Room, start: Start, rough: list[Sketch], effort: tuple[float, float, float, float], *, cut: bool = False
) -> list[Link] | None:
    """Surfaces for the upper bound, the last phase first; ``cut`` ends the line before held faces."""
    share, fineness, tolerance, sharpness = effort
    links: list[Link] = []
    for k in reversed(range(len(room.phases))):
        line = room.lines[k]
        if k == 0 and not start.random:
            line = sealed(line, rough[0].level, gated=cut or len(room.phases) > 1)[0]
            line = before_held(line) if cut else line
        surface = propose_above(
            line, _end(room, k, links[0].surface if links else None), rough[k], share * line.horizon, sharpness,
            fineness=fineness, tolerance=tolerance,
        )  # fmt: skip
        if surface is None:
            return None
        links.insert(0, _link(room, k, _placed(surface, room.phases[k])))
    return links


def surfaces_below(
    room: Room, start: Start, rough: list[Sketch], effort: tuple[float, float, float, float],
    floor: float | None = None,
) -> list[Link] | None:
    """Surfaces for the lower bound; V at the horizon and where the line is cut is ``floor``, if that is given."""
    share, fineness, tolerance, sharpness = effort
    links: list[Link] = []
    for k in reversed(range(len(room.phases))):
        line, phase = room.lines[k], room.phases[k]
        far = (False, False)
        if len(room.phases) == 1 and not start.random:
            far = sealed(line, rough[0].level)[1]
            far = (far[0] and phase.closed[0], far[1] and phase.closed[1])
        surface = propose_below(
            line, _end(room, k, links[0].surface if links else None), rough[k], 2 * share * line.horizon, sharpness,
            phase.closed, far, fineness=fineness, tolerance=tolerance, floor=floor,
        )  # fmt: skip
        if surface is None:
            return None
        links.insert(0, _link(room, k, _placed(surface, phase)))
    return links


def surface_of_arrival(
    room: Room, side: int, rough: list[Sketch], effort: tuple[float, float, float, float], floor: float
) -> list[Link] | None:
    """A surface for the upper bound of leaving by one face only; see `propose_arrival`."""
    share, fineness, tolerance, _ = effort
    line = room.lines[0]
    surface = propose_arrival(
        line, side, rough[0], share * line.horizon, floor, fineness=fineness, tolerance=tolerance
    )
    return None if surface is None else [_link(room, 0, _placed(surface, room.phases[0]))]


def _link(room: Room, k: int, surface: Surface) -> Link:
    return Link(phase=room.phases[k], gate=room.gates[k], model=room.models[k], surface=surface)


def _patches_in(links: list[Link]) -> float:
    """Patches of the surfaces, each worth as many as its samples and branches make of it."""
    return sum(
        link.surface.slabs * link.surface.cells[0] * math.prod(link.model.counts()) * len(link.model.branches)
        for link in links
    ) / _USUAL_SAMPLES
