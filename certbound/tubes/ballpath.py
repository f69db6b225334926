"""The scalars v and I of :mod:`certbound.tubes.schedule` in ball arithmetic."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from flint import arb

from certbound.rigor.balls import precision
from certbound.tubes.schedule import Schedule


def integral(rate: arb, length: arb) -> arb:
    """Ball of int_0^length e^{rate s} ds; ``rate`` is exactly 0 or a ball without 0."""
    return length if rate.is_zero() else (rate * length).expm1() / rate


@dataclass(frozen=True, eq=False)
class BallPath:
    """v_t (in units of ``unit``^2) and I_t as balls, for one start v_0."""

    schedule: Schedule  # the data
    start: arb  # v_0 in units of ``schedule.unit``^2
    bessel: bool = False  # v' = 2 c v (Bessel form) instead of v' = 2 c v + sigma^2

    @cached_property
    def pieces(self) -> list[tuple[arb, arb]]:
        """(c, noise) per piece; in DT c = log L and noise = sigma^2 2c/(L^2 - 1)."""
        data, unit, result = self.schedule, arb(self.schedule.unit), []
        cache: dict[tuple[float, float], tuple[arb, arb]] = {}
        for slope, sigma in zip(data.slopes.tolist(), data.sigmas.tolist()):
            if (slope, sigma) not in cache:
                noise = (arb(sigma) / unit) ** 2
                rate = arb(slope)
                if not data.continuous:
                    rate = arb(0) if slope == 1 else arb(slope).log()
                    noise /= integral(2 * rate, arb(1))
                cache[slope, sigma] = (rate, noise)
            result.append(cache[slope, sigma])
        return result

    @cached_property
    def nodes(self) -> tuple[list[arb], list[arb]]:
        """v and I at the times of the schedule."""
        times = self.schedule.times.tolist()
        v, parts = [self.start], []
        for k, (rate, noise) in enumerate(self.pieces):
            length = arb(times[k + 1]) - arb(times[k])
            v.append(self._advance(v[k], rate, noise, length))
            parts.append(self._information(v[k], rate, noise, length))
        info = [arb(0)]
        for part in reversed(parts):
            info.append(info[-1] + part)
        return v, info[::-1]

    def at(self, piece: int, t: float) -> tuple[arb, arb]:
        """(v_t, I_t) at a time of one piece."""
        times = self.schedule.times
        v, info = self.nodes
        begin, end = float(times[piece]), float(times[piece + 1])
        if t == begin:
            return v[piece], info[piece]
        if t == end:
            return v[piece + 1], info[piece + 1]
        rate, noise = self.pieces[piece]
        now = self._advance(v[piece], rate, noise, arb(t) - arb(begin))
        return now, info[piece + 1] + self._information(now, rate, noise, arb(end) - arb(t))

    def _advance(self, v: arb, rate: arb, noise: arb, length: arb) -> arb:
        grown = v * (2 * rate * length).exp()
        return grown if self.bessel else grown + noise * integral(2 * rate, length)

    def _information(self, v: arb, rate: arb, noise: arb, length: arb) -> arb:
        x = noise * integral(-2 * rate, length) / v
        return x if self.bessel else x.log1p()


def ball_path(schedule: Schedule, start: float, *, bessel: bool = False) -> BallPath:
    """A path at the working precision of :func:`certbound.rigor.balls.precision`."""
    with precision():
        path = BallPath(schedule, arb(start), bessel)
        _ = path.nodes
        return path
