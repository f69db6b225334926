"""Beyond a face of the noise: what a function must be there (upper bounds), and may be there (lower bounds).

A path that meets the face q = c at the time tau is at the depth d = q_h - c beyond it (d < 0: back inside) at the end
of the step, u = h - tau later. Were its inward drift gamma + k d, with constants gamma and k, d would be normal with
the mean -gamma (1 - e^{-ku})/k and the variance v_u = s^2 (1 - e^{-2ku})/(2k), and its density p would have p(-d) =
e^{rate d} p(d), rate = (2 gamma/s^2) 2/(1 + e^{-ku}). So if m(d) is what is counted at the depth -d inside, and

    1 + e^{rate d} (1 - m(d))

at the depth d beyond, the mean of what is counted is exactly 1. *Upper bounds:* with an inward drift of at most gamma +
k d, gamma >= 0, the largest such rate over u, and m falling with d and below the function inside, this rises with d, so
that a path that comes farther out (it does: compare the two equations) only counts more: the path is counted at least
once. *Lower bounds:* with an inward drift of at least gamma + k d, the least rate and m above the function inside, it
is counted at most once (where this does not rise with d, it is made smaller until it does).

The inside is looked at within a window of y that a path may cross in a step. The drift is bounded within w standard
deviations of the face; a share of at most 6 Phi(-w) of the paths comes farther or leaves the window (after the turn of
the drift by rate s e^{-k(u - r)}, which e^{rate d} is: 6 Phi(-(w - 2 turn)), turn = rate S/2 with S = s sqrt(h) max(1,
e^{-kh}) >= sqrt(v_u)), which a factor makes up for. From above e^{rate d} is cut off at `_MOST`, and what is lost
beyond the last node before is made up for as well. Where that is too much for what is beyond alone, the inside is not
looked at (m = 0): then all that is counted makes up for it. Where this is too much, too, 1/Phi(-turn) stands beyond the
face: the noise of the rest outweighs the drift that often.

Paths that met the face at one place come to several lines of y, and each of these three means holds where all lines
count like that. The drift is at most that of the line where it is least, which is of the first kind among them. So
lines of the later kinds (stronger drifts) also count what the earlier kinds in their window ask for, with m = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.problem.model import jacobian
from certbound.rigor.intervals import Interval
from certbound.values.discrete import evaluate
from certbound.values.semilagrangian.confines import TWICE
from certbound.values.semilagrangian.local_steps import Blocks, Clock
from certbound.values.semilagrangian.noisy_axis import Setting
from certbound.values.semilagrangian.remainders import upper_tail

_WIDE = ((3.5, 0.015), (4.25, 0.025), (5.0, 0.08), (6.0, 0.15))  # and the share that a factor may make up for
_BELOW = (1, 0)  # which of these serve from below
_BLIND = 0.75  # the same where the inside is not looked at, and e^{rate d} is cut off, like levels, at `_MOST`/10
_MOST = 1e5
_UP = 1 + 1e-9
_SLACK = 1e-11  # for nodes that are mirror images up to rounding


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Mirror:
    """One face of q: what happens beyond it is read from inside.

    Attributes
    ----------
    inside, beyond : ndarray of int, shape (K,)
        Nodes of q at the same depths, rising from 0.
    depths : ndarray, shape (K,)
    places : ndarray of int, shape (P,)
        All nodes beyond; what has no image inside takes the value of the last that has.
    rate, factor : ndarray, shape (ny,)
        On every line of y; the rate is nan where nothing is asked or known.
    blind : ndarray of bool, shape (ny,)
        Lines on which the inside is not looked at.
    window : (ndarray of int, ndarray of int), shapes (ny,)
        First and last line (excluded) that a path may come to.
    most : float
        Where e^{rate d} is cut off from above.
    """

    inside: Index
    beyond: Index
    depths: Array
    places: Index
    rate: Array
    factor: Array
    blind: Mask
    window: tuple[Index, Index]
    most: float = _MOST

    def above(self, nodal: Array, bend: Array, dq: Array) -> Array:
        """Values at ``places``, shape (ny, P), for upper bounds."""
        value = self._inside(nodal, bend, dq, sign=-1.0)
        least = np.minimum.accumulate(self._extreme(value, np.minimum), axis=1)
        share = 1 - np.clip(least - _SLACK, 0.0, 1.0)  # beyond, never less than 1: else a larger drift might count less
        share = np.where(self.blind[:, None], 1.0, share)
        rate = np.nan_to_num(self.rate)[:, None]
        power = np.exp(np.minimum(rate * self.depths, math.log(self.most)) * _UP)
        power = np.where(np.isnan(self.rate)[:, None], 0.0, power)
        return self._all((1 + power * share) * self.factor[:, None])

    def below(self, nodal: Array, bend: Array, dq: Array) -> Array:
        """Values at ``places``, shape (ny, P), for lower bounds; ``nodal`` and ``bend`` are L's own."""
        value = self._inside(nodal, bend, dq, sign=1.0)
        most = np.maximum.accumulate(self._extreme(value, np.maximum)[:, ::-1], axis=1)[:, ::-1]
        share = np.maximum(1 - most - _SLACK, 0.0)
        rate = np.nan_to_num(self.rate)[:, None]
        power = np.exp(np.minimum(rate * self.depths, 1.0)) / _UP
        widths = np.diff(self.depths)
        slope = np.diff(share, axis=1) / widths
        steep = 2 * np.abs(rate) * slope + rate**2 * share[:, 1:]
        sag = np.zeros(share.shape)
        sag[:, 1:] = widths**2 / 8 * steep * np.maximum(power[:, 1:], power[:, :-1])
        sag[:, :-1] = np.maximum(sag[:, :-1], sag[:, 1:])
        gain = np.where(np.isnan(self.rate)[:, None], 0.0, np.maximum(power * share - sag * _UP, 0.0))
        gain = np.minimum.accumulate(gain[:, ::-1], axis=1)[:, ::-1]
        return self._all((1 + gain) / self.factor[:, None])

    def _all(self, found: Array) -> Array:
        more = len(self.places) - found.shape[1]
        return np.pad(found, ((0, 0), (0, more)), mode="edge")

    def _inside(self, nodal: Array, bend: Array, dq: Array, *, sign: float) -> Array:
        """The function at the depths, moved by what it may be off its chords towards ``sign``."""
        arch = np.maximum(sign * bend, 0.0) * dq**2 / 8 * _UP
        around = np.zeros(nodal.shape)
        around[:, :-1] = arch
        around[:, 1:] = np.maximum(around[:, 1:], arch)
        return (nodal + sign * around)[:, self.inside]

    def _extreme(self, value: Array, pick: np.ufunc) -> Array:
        """The least (largest) value in the window of every line."""
        found = value.copy()
        for line in np.flatnonzero(~np.isnan(self.rate) & ~self.blind):
            found[line] = pick.reduce(value[self.window[0][line] : self.window[1][line]], axis=0)
        return found


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Face:
    """What paths do that end on the lines of y and have met a face of q in the step, shape (ny,) each.

    Since then q's inward drift at the depth d beyond the face (d < 0: inside) is at most ``most`` + ``pulls[0]`` d and
    at least ``least`` + ``pulls[1]`` d (infinite where that is not known); ``window``: how far apart paths from one
    place end.
    """

    most: Array
    least: Array
    pulls: tuple[Array, Array]
    window: Array


def mirrors_of(
    setting: Setting, clock: Clock, axes: tuple[Array, Array], blocks: Blocks, usable: Mask
) -> tuple[list[Mirror], list[Mirror], Array]:
    """Mirrors for upper and for lower bounds, and the least values where there is none for upper bounds (ny, nq)."""
    y, q = axes
    above, below = [], []
    levels = np.zeros((len(y), len(q)))
    for side, end in enumerate(setting.faces[1]):
        drift = _met(clock, blocks, usable, y, (side, end))
        faces = [_face(setting, clock, y, (side, end), wide) for wide, _ in _WIDE]
        inside, beyond = _pairs(q, end, side)
        places = np.arange(beyond[0], len(q) if side else -1, 1 if side else -1)
        depths = np.abs(q[beyond] - end)
        rates, factors = np.full((3, len(y)), np.nan), np.ones((3, len(y)))  # inside looked at, not looked at; below
        kind, own = np.full(len(y), -1), np.zeros(levels.shape)
        window, span = faces[-1].window.copy(), faces[-1].window.copy()
        for line in np.flatnonzero(np.isfinite(drift)):
            most = [(float(face.most[line]), float(face.pulls[0][line])) for face in faces]
            options = (
                (k, unseen, _paid(most[k], setting.noise, clock.step, depths, _WIDE[k], blind=unseen))
                for unseen in (False, True) for k in range(len(_WIDE))
            )  # fmt: skip
            k, unseen, found = next((option for option in options if option[-1]), (0, False, None))
            if found is None:
                margin, level = _levelled([*most, (float(drift[line]), 0.0)], setting.noise, clock.step)
                own[line, _from(q, end, side, margin)] = level
                kind[line] = 3 if margin > 0 else 2
            else:
                kind[line] = int(unseen)
                rates[kind[line], line], factors[kind[line], line] = found
                window[line] = faces[k].window[line]
            for k in _BELOW:
                found = _granted(faces[k], int(line), _WIDE[k][0], setting.noise, clock.step, depths)
                rates[2, line], factors[2, line] = found
                span[line] = faces[k].window[line]
                if math.isfinite(rates[2, line]):
                    break
        spread = np.maximum.reduce([face.window for face in faces])
        around = _window(y, np.where((kind > 1) & (spread == 0), np.inf, spread))  # 0: not known
        levels = np.maximum(levels, _alike(kind, rates, factors, own, around))
        factors[2] = _most(factors[2], around)  # as what is made up for on one line may be lost on another
        mirror = Mirror(
            inside=inside, beyond=beyond, depths=depths, places=places, rate=rates[0], factor=factors[0],
            blind=kind != 0, window=_window(y, window),
        )  # fmt: skip
        above.append(mirror)
        if not np.isnan(rates[1]).all():
            above.append(replace(mirror, rate=rates[1], factor=factors[1], blind=kind >= 0, most=_MOST / 10))
        if math.isfinite(setting.beyond[1][side]):
            below.append(replace(
                mirror, rate=rates[2], factor=factors[2], blind=kind < -1, window=_window(y, span),
            ))  # fmt: skip
    return above, below, levels


def _window(y: Array, spread: Array) -> tuple[Index, Index]:
    """First and last line (excluded) that a path may be on, if another from the same place is next to a line."""
    before, after = np.concatenate([y[:1], y[:-1]]), np.concatenate([y[1:], y[-1:]])
    first = np.searchsorted(y, before - spread, side="right") - 1
    last = np.searchsorted(y, after + spread) + 1
    return np.maximum(first, 0), np.minimum(last, len(y))


def _alike(kind: Index, rates: Array, factors: Array, levels: Array, around: tuple[Index, Index]) -> Array:
    """Let lines count what those of earlier kinds around them ask for, in ``rates`` and ``factors``; the levels then.

    ``kind``: 0 where the inside is looked at, 1 where it is not, 2 where a level stands beyond the face, 3 where one
    begins before it, -1 where nothing is asked.
    """
    for k in (0, 1):
        top = _most(np.where(kind == k, rates[k], -np.inf), around)
        later = (kind > k) & (top > -np.inf)
        rates[k] = np.where(later, top, rates[k])
        factors[k] = np.where(later | (kind == k), _most(factors[k], around), 1.0)
    return np.where((kind == 3)[:, None], np.maximum(levels, _most(levels * (kind == 2)[:, None], around)), levels)


def _most(values: Array, around: tuple[Index, Index]) -> Array:
    """The largest value on the lines around every line of y."""
    return np.stack([values[first:last].max(axis=0) for first, last in zip(*around)])


def _pairs(q: Array, face: float, side: int) -> tuple[Index, Index]:
    """Nodes inside and beyond a face at equal depths, as far as the grid was made so."""
    start = int(np.searchsorted(q, face))
    step = 1 if side else -1
    beyond = np.arange(start, len(q) if side else -1, step)
    inside = start - step * np.arange(len(beyond))
    fine = (inside >= 0) & (inside < len(q))
    beyond, inside = beyond[fine], inside[fine]
    apart = np.abs(np.abs(q[beyond] - face) - np.abs(q[inside] - face)) <= 1e-13 * (1 + np.abs(face))
    count = len(apart) if apart.all() else int(np.argmin(apart))
    return inside[:count], beyond[:count]


def _from(q: Array, face: float, side: int, margin: float) -> slice:
    """Nodes of all cells that reach beyond the face moved inward."""
    if side:
        return slice(max(int(np.searchsorted(q, face - margin, side="right")) - 1, 0), None)
    return slice(None, int(np.searchsorted(q, face + margin)) + 1)


def _leading(inward: tuple[float, float], s: float, step: float) -> tuple[float, float]:
    """The largest rate over all rests of a step, and S, for an inward drift gamma + k d; gamma counts as 0 at least."""
    gamma, pull = max(inward[0], 0.0), inward[1]
    growth = math.exp(-pull * step)
    return 2 * gamma / s**2 * (2 / (1 + min(growth, 1.0))) * _UP, s * math.sqrt(step) * max(growth, 1.0) * _UP


def _paid(
    inward: tuple[float, float], s: float, step: float, depths: Array, wide: tuple[float, float], *,
    blind: bool = False,
) -> tuple[float, float] | None:  # fmt: skip
    """The rate, and the factor that makes up for what is lost; None where that is too much. ``inward``: gamma and k."""
    if not math.isfinite(inward[0]):
        return None
    rate, size = _leading(inward, s, step)
    turn = rate * size / 2 * _UP
    last = float(depths[rate * depths <= math.log(_MOST / 10 if blind else _MOST)][-1])
    lost = 6 * upper_tail(wide[0]) + 6 * upper_tail(wide[0] - 2 * turn)
    lost += upper_tail(last / size - turn)
    if blind:
        return (rate, _UP / (1 - lost)) if lost < _BLIND else None
    lost /= upper_tail(turn) / _UP**2  # only what is beyond makes up for it, and that counts at least P(d >= 0)
    return (rate, _UP / (1 - lost)) if lost < wide[1] else None


def _levelled(inward: list[tuple[float, float]], s: float, step: float) -> tuple[float, float]:
    """A level, and from how far before the face on, for drifts that hold within `_WIDE`, and (the last) always."""
    best = 0.0
    for drift, wide in zip(inward, [*(wide for wide, _ in _WIDE), 38.0]):
        if math.isfinite(drift[0]):
            rate, size = _leading(drift, s, step)
            best = max(best, upper_tail(rate * size / 2 * _UP) / _UP**2 - 6 * upper_tail(wide))
    if best * _MOST / 10 > 1:
        return 0.0, _UP / best
    return min(max(gamma, 0.0) * max(math.exp(-pull * step), 1.0) for gamma, pull in inward[-2:]) * step * _UP, TWICE


def _granted(face: _Face, line: int, wide: float, s: float, step: float, depths: Array) -> tuple[float, float]:
    """The rate from below and the factor; (nan, 1) where paths may come too far, beyond the mirrored nodes.

    Beyond the face at most 1 + e is counted, so that 6 (1 + e) Phi(-w) bounds what is counted of paths for which the
    drift's bounds do not hold; all others end among the mirrored nodes. It is taken from what lies beyond, where paths
    end at least as often as with the largest drift.
    """
    most, least = float(face.most[line]), float(face.least[line])
    if not math.isfinite(most):
        return math.nan, 1.0
    pulls = [float(part[line]) for part in face.pulls]
    far = max(
        wide * s * math.sqrt(step) * (1 + abs(k) * step * grown) + max(abs(most), abs(least)) * step * grown
        for k in pulls for grown in (math.exp(max(-k * step, 0.0)),)
    )  # fmt: skip
    rate, size = _leading((most, pulls[0]), s, step)
    share = 6 * (1 + math.e) * upper_tail(wide) / upper_tail(rate * size / 2 * _UP) * _UP**2
    if far * _UP > float(depths[-1]) or share > 0.2:
        return math.nan, 1.0
    rate = min(2 * least / s**2, 4 * least / s**2 / (1 + math.exp(-pulls[1] * step)))
    return rate - 1e-9 * abs(rate), 1 / (1 - share)


def _face(setting: Setting, clock: Clock, y: Array, where: tuple[int, float], wide: float) -> _Face:
    """See `_Face`; not finite where the step is too long for the bounds."""
    side, face = where
    h = clock.step
    swing = wide * setting.noise * (1 + setting.spread) * math.sqrt(h) * _UP
    ends = np.concatenate([y[:1], y[:-1]]), np.concatenate([y[1:], y[-1:]])
    along, away = np.full(len(y), 1e-9), np.full(len(y), 1.1 * swing)
    fine = np.zeros(len(y), dtype=bool)
    (p0, p1), (q0, q1) = setting.faces
    farthest = 100 * (p1 - p0), 100 * (q1 - q0 + swing)  # a model that runs away ends here, and is not fine
    for _ in range(12):
        near = Interval(face - away, face + away)
        end = Interval(*ends) + near * clock.shear
        f, good = _rates(setting, clock, Interval(end.lo - along, end.hi + along), near)
        rise, fall = np.maximum(f.hi[:, 0], 0.0), np.minimum(f.lo[:, 0], 0.0)
        travel, needed = (rise - fall) * h * _UP, swing + h * f[:, 1].mag * _UP
        fine = good & (travel <= along) & (needed <= away)
        if fine.all():
            break
        grow = ~fine & good
        along, away = np.where(grow, 1.05 * travel, along), np.where(grow, np.maximum(away, 1.05 * needed), away)
        along, away = np.minimum(along, farthest[0]), np.minimum(away, farthest[1])
    apart = (f.hi[:, 0] - f.lo[:, 0]) * h * _UP
    path = Interval(
        end.lo - np.where(rise > 0, travel, apart), end.hi + np.where(fall < 0, travel, apart)
    )
    f, good = _rates(setting, clock, path, near)
    slopes, bad, _ = evaluate(jacobian(setting.tape, (1, 2)), [clock.times, path, near])
    fine = fine & good & ~bad & np.isfinite(slopes.mag).reshape(len(y), -1).all(axis=1)
    slope, pull, width = slopes[:, 1], -slopes[:, 3], (f.hi[:, 1] - f.lo[:, 1])
    middle = np.abs(slope.mid)
    deviation = setting.noise * np.sqrt(h**3 / 3 * middle**2 + abs(clock.shear) * h**2 * middle + clock.shear**2 * h)
    spread = middle * h**2 / 2 * width + 2 * (wide + 1) * deviation + h * abs(clock.shear) * width
    spread += h * (2 * slopes[:, 0].mag * travel + 2 * slope.rad * away)
    at, good = _rates(setting, clock, path, Interval.point(np.full(len(y), face)))
    inward, start = (-part[:, 1] if side else part[:, 1] for part in (f, at))
    fine = fine & good & np.isfinite(pull.mid)
    k = np.where(fine, pull.mid, 0.0)
    start = start + Interval(-1.0, 1.0) * (pull - k).mag * away
    high = inward.hi < start.hi * 2 / (1 + np.exp(-np.maximum(k, 0.0) * h))  # one bound for all depths does better
    low = inward.lo > start.lo
    return _Face(
        most=np.where(fine, np.where(high, inward.hi, start.hi), np.inf),
        least=np.where(fine, np.where(low, inward.lo, start.lo), -np.inf),
        pulls=(np.where(high, 0.0, k), np.where(low, 0.0, k)), window=np.where(fine, spread, 0.0) * _UP,
    )  # fmt: skip


def _rates(setting: Setting, clock: Clock, p: Interval, q: Interval) -> tuple[Interval, Mask]:
    f, undefined, jumps = evaluate(setting.tape, [clock.times, p, q])
    fine = ~undefined & ~jumps & np.isfinite(f.mag).all(axis=1)
    return Interval(np.where(fine[:, None], f.lo, -1e9), np.where(fine[:, None], f.hi, 1e9)), fine


def _met(clock: Clock, blocks: Blocks, usable: Mask, y: Array, where: tuple[int, float]) -> Array:
    """The largest inward drift on tubes that meet the face, by lines next to which their paths may end; else -inf."""
    side, face = where
    tubes = blocks.strays.tube
    hit = usable & (tubes[1].lo <= face) & (tubes[1].hi >= face)
    around = (tubes[0] - tubes[1] * clock.shear)[hit]
    first = np.searchsorted(y, around.lo, side="right") - 1
    last = np.searchsorted(y, around.hi) + 1
    found = np.full(len(y), -np.inf)
    for a, b, drift in zip(first, last, blocks.strays.inward[side][hit]):
        part = slice(max(int(a), 0), int(b))
        found[part] = np.maximum(found[part], drift)
    return found
