"""Thm K2 in ball arithmetic: the probability of given clearances, proved between the nodes."""

from __future__ import annotations

import math

from flint import arb

from certbound.rigor.balls import excess_floor, lower, precision, upper
from certbound.tubes.ballpath import ball_path
from certbound.tubes.kummer import Start, excess_function, initial_ball, phi_ball
from certbound.tubes.objective import Clearance
from certbound.tubes.paper import golden
from certbound.tubes.schedule import Schedule
from certbound.tubes.search import log_gain
from certbound.tubes.series import log_excess_one, log_phi_one

__all__ = ["exit_level", "union_level"]

_MOST_UNIONS = 128


def exit_level(
    schedule: Schedule, clearance: Clearance, *, a: float, v0: float, bessel: bool = False, start: Start | None = None
) -> float:
    """log10 of X / min_t [phi(I_t) + e^{a I_t} E_a(r_t^2/(2 v_t))], rounded up, at most 0.

    The schedule must be cut at the ends of the clearance. On a piece I_t falls and v_t is monotone, so that the
    minimum over [s, e] is at least the value with I_e and max(v_s, v_e); pieces where v falls are halved until the
    minimum is found within 2 %.

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


def best_power(half: float, x: float) -> float:
    """k > 0 with about the least (e^k - 1)/(0F1(; half; k x) - 1)."""
    if not 0 < x < 1e18:
        return 1.0

    def level(y: float) -> float:
        k = math.exp(y)
        return log_phi_one(k) - log_excess_one(k, half, x, bessel=True)[0]

    middle = math.log(x)  # 0F1(; half; k x) is about e^{2 sqrt(k x)}
    return math.exp(golden(level, middle - 2.5, middle + 0.5, 1e-2))


class _Gain:
    """phi(I_t) + e^{a I_t} E_a(r_t^2/(2 v_t)) along a schedule."""

    def __init__(
        self, schedule: Schedule, clearance: Clearance, *, a: float, v0: float, bessel: bool, start: Start
    ) -> None:
        self.schedule, self.path = schedule, ball_path(schedule, v0, bessel=bessel)
        self.radii = clearance.at(schedule.times[:-1]).tolist()
        self.power, self.unit = arb(a), arb(schedule.unit)
        self.half, self.bessel = schedule.nu / 2, bessel
        self.excess = excess_function(a, self.half, bessel)
        self.initial = initial_ball(self.path, a, start)
        self.first = 0.0 if schedule.continuous or start.sigma > 0 else 1.0

    def stretch(self, piece: int, s: float, e: float) -> tuple[arb, arb, arb]:
        """(I_e, least z on [s, e], z_e)."""
        radius = self.radii[piece]
        v_end, info = self.path.at(piece, e)
        square = (arb(radius) / self.unit) ** 2 / 2
        v_start = self.path.at(piece, s)[0] if s < e else v_end
        return info, square / arb.max(v_start, v_end), square / v_end

    def value(self, info: arb, z: arb) -> arb:
        """The gain at a given I and z."""
        return phi_ball(self.power, info) + (self.power * info).exp() * self.excess(z)

    def steps(self, piece: int) -> tuple[float, float] | None:
        """Ends of a piece; in DT the whole steps whose clearance is this piece's."""
        times, last = self.schedule.times, len(self.schedule.lengths) - 1
        s, e = max(float(times[piece]), self.first), float(times[piece + 1])
        if not self.schedule.continuous and piece < last:
            e -= 1
        return (s, e) if s <= e else None

    def least(self, gap: float = 0.02, budget: int = 64) -> arb:
        """Lower bound of the minimum over the horizon, within ``gap`` where it is cheap."""
        items: list[tuple[float, int, float, float, arb]] = []
        attained = smallest = math.inf

        def push(piece: int, s: float, e: float) -> None:
            nonlocal attained, smallest
            info, z, z_end = self.stretch(piece, s, e)
            smallest = min(smallest, upper(z))
            bound = self.value(info, z)
            attained = min(attained, log_gain(float(self.power), self.half, float(info), float(z_end), self.bessel))
            items.append((lower(bound.log()), piece, s, e, bound))

        for piece in range(len(self.schedule.lengths) - 1, -1, -1):
            ends = self.steps(piece)
            if ends is None or not math.isfinite(self.radii[piece]):
                continue
            # I falls with time: a later stretch with a smaller z has the smaller gain
            if lower(self.stretch(piece, *ends)[1]) < smallest:
                push(piece, *ends)
        while items:
            low, piece, s, e, bound = min(items, key=lambda item: item[0])
            middle = (s + e) / 2 if self.schedule.continuous else math.floor((s + e) / 2)
            if low >= attained - gap or len(items) > budget + len(self.radii) or not s <= middle < e:
                return bound
            items.remove((low, piece, s, e, bound))
            push(piece, s, middle)
            push(piece, middle if self.schedule.continuous else middle + 1, e)
        return arb.pos_inf()
