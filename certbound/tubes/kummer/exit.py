"""Thm K2 in ball arithmetic: the probability of given clearances, proved between the nodes."""

from __future__ import annotations

import heapq
import itertools
import math
from dataclasses import dataclass

from flint import arb

from certbound.rigor.balls import excess_floor, excess_tangent, lower, precision, upper
from certbound.tubes.ballpath import ball_path
from certbound.tubes.excess import log_excess_one, log_phi_one
from certbound.tubes.kummer.profile import initial_ball, phi_ball
from certbound.tubes.kummer.search import log_gain
from certbound.tubes.line_search import golden
from certbound.tubes.objective import Clearance
from certbound.tubes.question import Start
from certbound.tubes.schedule import Schedule

_MOST_UNIONS = 128
_LOSS = 1e-3  # of a logarithm, from a tangent instead of the function


def exit_level(
    schedule: Schedule, clearance: Clearance, *, a: float, v0: float, bessel: bool = False, start: Start | None = None
) -> float:
    """log10 of X / min_t [phi(I_t) + e^{a I_t} E_a(r_t^2/(2 v_t))], rounded up, at most 0.

    The schedule must be cut at the ends of the clearance. On a piece I_t falls and v_t is monotone, so that the
    minimum over [s, e] is at least the value with I_e and max(v_s, v_e); pieces where v falls are halved until the
    minimum is found within .5 %.

    Source: Thm K2, item 7.5 of docs/theory.md.
    """
    start = start or Start()
    with precision():
        gain = _Gain(schedule, clearance, a=a, v0=v0, bessel=bessel, start=start)
        if not gain.initial.is_finite():
            return 0.0
        if gain.initial.is_zero():
            return -1e12
        least = gain.least()
        if not least.is_finite():
            return -1e12 if least > 0 else 0.0
        return min(0.0, upper((gain.initial / least).log() / arb(10).log()))


def union_level(schedule: Schedule, clearance: Clearance) -> float:
    """log10 of the sum over steps of inf_k (e^k - 1)/(0F1(; nu/2; k r_t^2/(2 V_t)) - 1) (DT), rounded up, at most 0.

    The steps of a piece share its largest V, so that a piece costs one evaluation; nothing is claimed (0) for more
    than 128 pieces. The schedule's nu must be n for sub-Gaussian noise that is not Gaussian (``any_power``).

    Source: items 7.11 and 7.12 of docs/theory.md.
    """
    if schedule.continuous or not schedule.any_power or len(schedule.lengths) > _MOST_UNIONS:
        return 0.0
    radii = clearance.at(schedule.times[:-1]).tolist()
    half, last = schedule.nu / 2, len(radii) - 1
    path = ball_path(schedule, 0.0)
    with precision():
        total = arb(0)
        for piece, radius in enumerate(radii):
            s, e = max(float(schedule.times[piece]), 1.0), float(schedule.times[piece + 1]) - (piece < last)
            if s > e or not math.isfinite(radius):
                continue
            largest = arb.max(path.at(piece, s)[0], path.at(piece, e)[0])
            if not (largest > 0):
                continue  # no noise so far
            x = (arb(radius) / arb(schedule.unit)) ** 2 / (2 * largest)
            power = arb(best_power(half, float(x)))
            total += (e - s + 1) * power.expm1() / (power * excess_floor(power, arb(half), x, bessel=True))
        if total.is_zero():
            return -1e12
        level = total.log() / arb(10).log()
        return min(0.0, upper(level)) if level.is_finite() else 0.0


def union_may_help(schedule: Schedule, clearance: Clearance, level: float) -> bool:
    """Whether :func:`union_level` may lie below ``level``, in floats.

    It counts each step of the last piece by no less than the chance that Gaussian noise is outside at the end.
    """
    from scipy.special import gammaincc

    variance = float(schedule.nodes[1][-1]) * schedule.unit**2
    radius = float(clearance.values[-1])
    if not (variance > 0 and radius < 1e150):
        return True
    chance = float(gammaincc(schedule.nu / 2, radius**2 / (2 * variance)))
    return bool(float(schedule.lengths[-1]) * chance < 10.0**level)


def best_power(half: float, x: float) -> float:
    """k > 0 with about the least (e^k - 1)/(0F1(; half; k x) - 1)."""
    if not 0 < x < 1e18:
        return 1.0

    def level(y: float) -> float:
        k = math.exp(y)
        return log_phi_one(k) - log_excess_one(k, half, x, bessel=True)[0]

    middle = math.log(x)  # 0F1(; half; k x) is about e^{2 sqrt(k x)}
    return math.exp(golden(level, middle - 2.5, middle + 0.5, 1e-2))


class Tangents:
    """Lower bounds of E_a by tangents of log E_a over log z: convex, since the series has no negative coefficient."""

    def __init__(self, a: arb, half: float, bessel: bool) -> None:
        self.a, self.half, self.bessel = a, arb(half), bessel
        self.touched: list[tuple[arb, float, arb, arb, arb | None]] = []

    def touch(self, z: arb) -> bool:
        """Add the tangent at z; False where nothing is known there."""
        value, slope = excess_tangent(self.a, self.half, z, bessel=self.bessel)
        if not (value > 0 and value.is_finite() and z.is_finite()):
            return False
        self.touched.append((z, float(z.log()), z.log(), value.log(), slope))
        return True

    def floor(self, z: arb) -> tuple[arb, float]:
        """(ball below E_a(z), about how much its logarithm loses there); (0, inf) without a tangent."""
        log_z = z.log()
        place = float(log_z)
        near = min(self.touched, key=lambda tangent: (tangent[0] is not z, abs(tangent[1] - place)), default=None)
        if near is None:
            return arb(0), math.inf
        own, there, log_there, value, slope = near
        if own is z:
            return value.exp(), 0.0
        if slope is None:  # log E rises by log z at least; places that floats cannot tell apart have no order
            return ((value + log_z - log_there).exp(), math.inf) if log_z >= log_there else (arb(0), math.inf)
        return (value + slope * (log_z - log_there)).exp(), float(slope) * (there - place) ** 2


class _Gain:
    """phi(I_t) + e^{a I_t} E_a(r_t^2/(2 v_t)) along a schedule."""

    def __init__(
        self, schedule: Schedule, clearance: Clearance, *, a: float, v0: float, bessel: bool, start: Start
    ) -> None:
        self.schedule, self.path = schedule, ball_path(schedule, v0, bessel=bessel)
        self.radii = clearance.at(schedule.times[:-1]).tolist()
        self.power, self.unit = arb(a), arb(schedule.unit)
        self.half, self.bessel = schedule.nu / 2, bessel
        self._states: dict[tuple[int, float], tuple[arb, arb]] = {}
        self.tangents = Tangents(self.power, self.half, bessel)
        self.initial = initial_ball(self.path, a, start)
        self.first = 0.0 if schedule.continuous or start.sigma > 0 else 1.0

    def stretch(self, piece: int, s: float, e: float) -> _Stretch:
        """The part [s, e] of a piece; v is monotone on it."""
        v_end, info = self._state(piece, e)
        square = (arb(self.radii[piece]) / self.unit) ** 2 / 2
        v_start = self._state(piece, s)[0]
        return _Stretch(piece, s, e, info, square / arb.max(v_start, v_end), square / v_end)

    def _state(self, piece: int, t: float) -> tuple[arb, arb]:
        """(v, I) at a time of a piece; halves share their ends."""
        if (piece, t) not in self._states:
            self._states[piece, t] = self.path.at(piece, t)
        return self._states[piece, t]

    def bound(self, item: _Stretch) -> tuple[arb, float]:
        """(lower bound of the gain on a stretch, about how much its logarithm loses to the tangent)."""
        excess, loss = self.tangents.floor(item.z)
        return phi_ball(self.power, item.info) + (self.power * item.info).exp() * excess, loss

    def steps(self, piece: int) -> tuple[float, float] | None:
        """Ends of a piece; in DT the whole steps whose clearance is this piece's."""
        times, last = self.schedule.times, len(self.schedule.lengths) - 1
        s, e = max(float(times[piece]), self.first), float(times[piece + 1])
        if not self.schedule.continuous and piece < last:
            e -= 1
        return (s, e) if s <= e else None

    def least(self) -> arb:
        """Lower bound of the minimum over the horizon: a cover found in floats, proved by tangents."""
        proved = arb.pos_inf()
        for item in self._cover():
            bound, loss = self.bound(item)
            if loss > 0 and not bound >= proved:
                if loss > _LOSS and not self.tangents.touch(item.z):
                    return arb.nan()
                bound = self.bound(item)[0]
            proved = arb.min(proved, bound)
        return proved

    def _cover(self, gap: float = 0.01, budget: int = 64) -> list[_Stretch]:
        """Stretches that cover the horizon, the one with the least gain first; halved until it is near the minimum."""
        heap: list[tuple[float, int, _Stretch]] = []
        attained = smallest = math.inf
        number = itertools.count()

        def gain(item: _Stretch, z: arb) -> float:
            return log_gain(float(self.power), self.half, float(item.info), float(z), self.bessel)

        def push(item: _Stretch) -> None:
            nonlocal attained
            attained = min(attained, gain(item, item.z_end))
            heapq.heappush(heap, (gain(item, item.z), next(number), item))

        for piece in range(len(self.schedule.lengths) - 1, -1, -1):
            ends = self.steps(piece)
            if ends is None or not math.isfinite(self.radii[piece]):
                continue
            item = self.stretch(piece, *ends)
            # I falls with time: a later stretch with a smaller z has the smaller gain
            if lower(item.z) < smallest:
                smallest = min(smallest, upper(item.z))
                push(item)
        for _ in range(budget if heap else 0):
            low, _, item = heap[0]
            s, e = item.start, item.end
            middle = (s + e) / 2 if self.schedule.continuous else math.floor((s + e) / 2)
            if not low < attained - gap or not s <= middle < e:
                break
            heapq.heappop(heap)
            push(self.stretch(item.piece, s, middle))
            push(self.stretch(item.piece, middle if self.schedule.continuous else middle + 1, e))
        return [item for _, _, item in sorted(heap)]


@dataclass(frozen=True, eq=False)
class _Stretch:
    """Part [start, end] of a piece: I at its end, least z on it, z at its end."""

    piece: int
    start: float
    end: float
    info: arb
    z: arb
    z_end: arb
