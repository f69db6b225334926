"""Infinite horizons of one state where failing is not certain: a function of the state alone, from both sides.

A path fails by the end ``a`` of an interval [a, b], and not by b: the target begins there, or (b infinite) nothing is
ever broken. With y = x - a (mirrored where the failing end is the upper one) and any step function psi of y,

    w(x) = int_x^b exp(-Psi) / int_a^b exp(-Psi),   Psi(y) = int_0^y psi,

is 1 at a, 0 at b, falls, and has L w = w' (f - psi g^2/2), w' < 0: a supersolution where psi g^2 <= 2 f for every
disturbance, a subsolution where psi g^2 >= 2 f. Hence P(failing) <= w(x), where b is finite as noise that is positive
on [a, b] makes every path leave it; and P(failing) >= w(x) on any [a, b'] with b' <= b, as w is at most 1 on the paths
that are at a and nothing on those at b'. w' is continuous, so that Ito's formula holds across the steps of psi.

Where b is infinite the last piece goes on for ever: psi = k or psi = k/x from M on, with psi g^2 <= 2 f there since all
coefficients of the difference as a polynomial of x - M are positive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from flint import arb, fmpq, fmpq_poly

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, compile_numpy, sources
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.balls import lower, precision, upper
from certbound.rigor.intervals import Interval
from certbound.values.enclosing import enclose, squared_diffusion
from certbound.values.exact import interval_of, polynomial_of
from certbound.values.room import points_of
from certbound.values.sets import as_stays

_CELLS = 2**13
_ENOUGH = 9.0  # by which Psi has risen from the starts to where the last piece begins
_FARTHEST = 60  # doublings of the distance that are looked at for it
_SHARES = (1 - 1e-9, 0.99, 0.9, 0.7, 0.4)  # of the last rate that the leading terms allow
_MARGIN = 1e-10


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Lasting:
    """Natural logarithms of bounds of P(failing over an infinite horizon), and what they were read from.

    ``edges`` rise from the failing end on (mirrored where ``side`` is 1) and ``slopes`` are psi between them, from
    above and from below; ``tail`` is ("exponential" or "power", k), of psi beyond the last edge (None: it ends there).
    """

    upper: float
    lower: float
    edges: Array
    slopes: tuple[Array, Array]
    tail: tuple[str, float] | None
    side: int


def bound_lasting(problem: Problem, *, cells: int = _CELLS) -> Lasting:
    """Bound P(ever breaking a constraint, or never reaching the target) of one state in continuous time.

    Parameters
    ----------
    problem : Problem
        A model without t, limits and target that stand still, a set of starts between the limit and the target; or a
        limit on one side, no target, and a model that is a polynomial without disturbances.
    cells : int
        Pieces of psi.

    Returns
    -------
    Lasting

    Raises
    ------
    InfeasibleError
        If the problem is none of these, or the noise vanishes somewhere in between; the message says why.

    Examples
    --------
    >>> import certbound as cb
    >>> import numpy as np
    >>> system = cb.ContinuousSystem(lambda x: 0 * x + 1.0, states=["x"], diffusion=1.0)
    >>> safe = [cb.Inside(cb.HalfSpace([-1.0], 0.0))]  # exp(-2 x) from x
    >>> problem = cb.Problem(system, initial=[2.0], safe=safe, horizon=np.inf)
    >>> found = bound_lasting(problem)
    >>> -4.001 < found.lower < -4 < found.upper < -3.999
    True
    """
    square = _model(problem)
    a, b, side = _ends(problem)
    sign = -1.0 if side else 1.0
    line = _Line(problem, square, sign)
    tail: _Tail | None = None
    around = problem.initial.hull()
    start = min(sign * float(around.lo[0]), sign * float(around.hi[0]))
    if not a < start:
        raise InfeasibleError("value functions of infinite horizons need starts within the limit.")
    if math.isinf(b):
        tail = line.tail(a, start)
        b = tail.begin
    share = np.linspace(0.0, 1.0, cells + 1)
    if tail is not None:
        share = np.expm1(share * math.log1p((b - a) / (start - a))) * (start - a) / (b - a)
    edges = a + (b - a) * share
    edges[-1] = b
    low, high = line.slopes(edges)
    with precision():
        points = points_of(problem)  # of a ball the ends of its box need not be starts, by a rounding
        sure = start if points is None else float((sign * points).min(initial=b))
        most, least = _share(edges, low, tail, start), _share(edges, high, None, sure)
        bounds = upper(most.log()), lower(least.log()) if least > 0 else -math.inf
    return Lasting(
        upper=min(bounds[0], 0.0), lower=bounds[1], edges=edges, slopes=(low, high), side=side,
        tail=None if tail is None else (tail.kind, tail.rate),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class _Tail:
    begin: float
    kind: str
    rate: float

    def integral(self) -> arb:
        """int of exp(-(Psi - Psi(begin))) from ``begin`` on."""
        rate = arb(self.rate)
        return 1 / rate if self.kind == "exponential" else arb(self.begin) / (rate - 1)


def _share(edges: Array, slopes: Array, tail: _Tail | None, start: float) -> arb:
    """w at a place: the integral from there on over the whole one."""
    psi, whole, rest = arb(0), arb(0), arb(0)
    for k, slope in enumerate(slopes.tolist()):
        first, last = float(edges[k]), float(edges[k + 1])
        whole += (-psi).exp() * _piece(arb(last) - arb(first), arb(slope))
        if last > start:
            begin = max(first, start)
            rest += (-psi - arb(slope) * (arb(begin) - arb(first))).exp() * _piece(arb(last) - arb(begin), arb(slope))
        psi += arb(slope) * (arb(last) - arb(first))
    if tail is not None:
        end = (-psi).exp() * tail.integral()
        whole += end
        rest += end
    return rest / whole


def _piece(h: arb, slope: arb) -> arb:
    """int_0^h exp(-slope y) dy."""
    return h if slope.is_zero() else -(-slope * h).expm1() / slope


class _Line:
    """Drift and g^2 along y = sign * x."""

    def __init__(self, problem: Problem, square: Tape, sign: float) -> None:
        self.drift, self.square, self.sign, self.box = problem.closed_loop, square, sign, problem.system.disturbance

    def slopes(self, edges: Array) -> tuple[Array, Array]:
        """At most, and at least, 2 f/g^2 over cells, for every disturbance."""
        count = len(edges) - 1
        cells = Interval(edges[:-1], edges[1:]) if self.sign > 0 else Interval(-edges[1:], -edges[:-1])
        time = Interval.point(np.zeros(count))
        sides = [] if self.box is None else zip(self.box.low, self.box.high)
        pushes = [Interval(np.full(count, low), np.full(count, high)) for low, high in sides]
        f, a = enclose(self.drift, [time, cells, *pushes])[0][0], enclose(self.square, [time, cells])[0][0]
        if not np.all(a.lo > 0):
            raise InfeasibleError(
                "value functions of infinite horizons need noise everywhere between the limit and the target; here it "
                "vanishes somewhere."
            )
        ratio = (Interval.point(2 * self.sign) * f / a).broadcast_to((count,))
        if not np.isfinite([ratio.lo, ratio.hi]).all():
            raise InfeasibleError("the dynamics is not defined everywhere between the limit and the target.")
        room = _MARGIN * (1 + ratio.mag)
        return ratio.lo - room, ratio.hi + room

    def tail(self, a: float, start: float) -> _Tail:
        """Where the last piece may begin, and its rate."""
        if self.box is not None:
            raise InfeasibleError("value functions of a line without an end do not serve disturbances; add a target.")
        f, square = polynomial_of(self.drift, self.sign), polynomial_of(self.square, self.sign)
        if f is None or square is None:
            raise InfeasibleError("value functions of a line without an end need a model that is a polynomial.")
        ratio = compile_numpy(self.drift), compile_numpy(self.square)
        distance, last, psi = start - a, start, 0.0
        for _ in range(_FARTHEST):
            place = start + distance
            x = self.sign * np.linspace(last, place, 33)[1:]
            zero = np.zeros_like(x)
            with np.errstate(all="ignore"):
                slope = 2 * self.sign * np.broadcast_to(ratio[0](zero, x)[..., 0], x.shape)
                slope = slope / np.broadcast_to(ratio[1](zero, x)[..., 0, 0], x.shape)
            psi += float(np.mean(slope)) * (place - last)
            last, distance = place, 2 * distance
            found = _last_piece(f, square, place) if psi > _ENOUGH else None
            if found is not None:
                return found
        raise InfeasibleError(
            "no drift was found that takes paths away from the limit for ever: then failing may be certain, and no "
            "bound below 1 is known."
        )


def _last_piece(f: fmpq_poly, square: fmpq_poly, place: float) -> _Tail | None:
    """An exponential or a power that is a supersolution from a place on; None where none is found."""
    at = fmpq_poly([fmpq(*float(place).as_integer_ratio()), 1])
    for kind, moving in (("exponential", 2 * f), ("power", 2 * f * fmpq_poly([0, 1]))):
        if kind == "power" and not place > 0:
            continue
        gap = moving.degree() - square.degree()
        if gap < 0:
            continue
        there = float(moving(at[0])) / float(square(at[0])) if gap else float(moving[moving.degree()]) / float(
            square[square.degree()]
        )
        for share in _SHARES:
            rate = there * share
            room = moving(at) - fmpq(*rate.as_integer_ratio()) * square(at)
            if rate > (0.0 if kind == "exponential" else 1.0) and all(one >= 0 for one in room.coeffs()):
                return _Tail(begin=float(place), kind=kind, rate=rate)
    return None


def _model(problem: Problem) -> Tape:
    """g^2, of one state in continuous time and a model without t."""
    system = problem.system
    if not isinstance(system, ContinuousSystem) or system.dimension != 1:
        raise InfeasibleError("value functions of infinite horizons in continuous time serve one state.")
    square = squared_diffusion(system.diffusion, system.states)
    if problem.input_sequence is not None or any(0 in s for t in (problem.closed_loop, square) for s in sources(t)):
        raise InfeasibleError("value functions of infinite horizons need a model that does not depend on time.")
    if problem.initial.random or problem.ending or len(problem.starts) > 1:
        raise InfeasibleError("value functions of infinite horizons need a set of starts, and no `leaving`.")
    return square


def _ends(problem: Problem) -> tuple[float, float, int]:
    """The failing end and the other one, in y, and the side of the failing one."""
    low, high = -math.inf, math.inf
    for constraint in as_stays(problem.kept) if problem.reach is None else problem.kept:
        if constraint.outside or constraint.during not in (None, (0.0, float(problem.horizon))):
            raise InfeasibleError("value functions of infinite horizons need limits that always hold, no obstacles.")
        first, last = interval_of(constraint.region)
        low, high = max(low, first), min(high, last)
    start = problem.initial.hull()
    first, last = float(start.lo[0]), float(start.hi[0])
    if problem.reach is None:
        if math.isinf(low) == math.isinf(high):
            raise InfeasibleError("value functions of infinite horizons need a target, or a limit on one side only.")
        return (low, math.inf, 0) if math.isfinite(low) else (-high, math.inf, 1)
    if problem.reach.stays or problem.reach.during not in (None, (0.0, float(problem.horizon))):
        raise InfeasibleError("value functions of infinite horizons need a target that always counts, to be met once.")
    near, far = interval_of(problem.reach.region)
    if last < near and math.isfinite(low) and near <= high:
        return low, near, 0
    if first > far and math.isfinite(high) and far >= low:
        return -high, -far, 1
    raise InfeasibleError(
        "value functions of infinite horizons need starts between the target and a limit on the other side."
    )
