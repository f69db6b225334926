"""The dynamics over cells of the working box as corners of linear maps.

On a cell, f is its second-order Taylor polynomial about the middle plus a remainder e (half the spread of the second
derivatives over the cell). With the coordinates N that carry every second-order term held at a value s, the polynomial
is A(s, d) z, affine in each of s, d: its values at the cell's corners contain it in their convex hull, and
z' D(s) z = 0 for the free splittings D of `splitting`. The diffusion is likewise affine in each of s where it is
polynomial of that kind; what is left of it goes into columns of its own:
    |(G + E)' p|^2 <= (1 + a)|G' p|^2 + (1 + 1/a) (sum_i rho_i) sum_i rho_i p_i^2,   |E_i.| <= rho_i.
Remainders are columns too: |e| <= sum_b r_b |eta_b|, with eta_b the coordinate b of the cell scaled to [-1, 1] and a
last one equal to 1, gives |e p| <= sum_b r_b (q eta_b^2 + p^2/q)/2 for any q > 0: a remainder that vanishes with a
coordinate costs nothing near its zero.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.constants.enclosures import enclose
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, edged, is_zero, jacobian
from certbound.problem.problem import Problem
from certbound.quadratic.noise_columns import EXACT, SLOPE, padded, with_columns, with_small
from certbound.quadratic.setting import Setting, diffusion_of
from certbound.rigor.intervals import Interval, stack

MOST_CORNERS = 256
_ROOM = 1.01  # of remainders: a check by other enclosures of the second derivatives finds about the same


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Cells:
    """What f and g may be on each cell.

    Attributes
    ----------
    low, high : ndarray, shape (C, n)
        The cells in xi.
    held : tuple of int
        N, the coordinates that are held at corners.
    values : ndarray, shape (V, C, len(held))
        Their values there.
    drift : Interval, shape (V, C, n + 1, n + 1)
        A, the last row 0.
    spread : Interval, shape (V, C, n + 1, m)
        Columns of the diffusion, the last row 0.
    affine : Interval, shape (m, n + 1, n + 1), or None
        G_c with g = (G_1 z, ..., G_m z) where the diffusion is affine.
    square : Interval, shape (C, n, n)
        g g' over the cells.
    toll : Interval, shape (C,)
        What the remainders that are columns add to R besides, and
    bend : Interval, shape (C, n + 1, n + 1)
        the part of it that depends on the place, as forms.
    """

    low: Array
    high: Array
    held: tuple[int, ...]
    values: Array
    drift: Interval
    spread: Interval
    affine: Interval | None
    square: Interval
    toll: Interval
    bend: Interval


class Dynamics:
    """Drift and diffusion of a problem in the coordinates of a setting."""

    def __init__(self, problem: Problem, setting: Setting) -> None:
        tape, diffusion = problem.closed_loop, diffusion_of(problem)
        tapes = [tape] + ([diffusion] if isinstance(diffusion, Tape) else [])
        if any(edged(one) for one in tapes):
            raise InfeasibleError("quadratic value bounds need a smooth model; this one has kinks or jumps.")
        self.setting, self.horizon = setting, float(problem.horizon)
        self.n, self.noises = setting.dimension, int(diffusion.shape[1])
        self.drift = _Jet(tape, self.n)
        self.noise = _Jet(diffusion, self.n) if isinstance(diffusion, Tape) else None
        self.constant = None if self.noise is not None else Interval.point(np.asarray(diffusion, dtype=float))
        box = problem.system.disturbance
        self.disturbed = Interval.point(np.zeros(0)) if box is None else Interval(box.low, box.high)
        self.held = self._held()

    @property
    def autonomous(self) -> bool:
        """Whether neither drift nor diffusion reads the time."""
        return self.drift.autonomous and (self.noise is None or self.noise.autonomous)

    def bending(self, row: int) -> set[int]:
        """Coordinates that carry second-order terms of a state's drift."""
        return {a for pair in self.drift.pairs_of(row) for a in pair if a < self.n}

    def _held(self) -> tuple[int, ...]:
        """Coordinates that meet every second-order term of f, and all that g depends on: a greedy cover."""
        pairs = self.drift.pairs
        if self.noise is not None:
            pairs = pairs | self.noise.pairs | {(a, a) for a in self.noise.used}
        found = {a for a, b in pairs if a == b and a < self.n}
        left = {(a, b) for a, b in pairs if a < self.n and b < self.n and not {a, b} & found}
        while left:
            best = max(range(self.n), key=lambda a: sum(a in pair for pair in left))
            found.add(best)
            left = {pair for pair in left if best not in pair}
        return tuple(sorted(found))

    def remainder(self, low: Array, high: Array) -> float:
        """The largest remainders of the drift over cells at time 0, in working boxes within the horizon: their norm."""
        cells = _Boxes(low, high, Interval.point(0.0), self.setting, self.disturbed)
        rows = np.max(self._drift_parts(cells)[-1].sum(axis=-1).hi, axis=0)
        return float(np.linalg.norm(rows)) * self.horizon

    def over(self, low: Array, high: Array, start: float, end: float) -> Cells:
        """The cells [low, high], shape (C, n), of the working box during [start, end].

        Raises
        ------
        InfeasibleError
            More corners than are practical.
        EnclosureError
            The model is undefined somewhere in a cell.
        """
        cells = _Boxes(low, high, Interval(start, end), self.setting, self.disturbed)
        base, by_state, by_disturbance, shares = self._drift_parts(cells)
        rest = shares.sum(axis=-1)
        small = [i for i in range(self.n) if np.max(rest.hi[:, i]) > EXACT]
        count = len(self.held) + len(self.disturbed)
        if 2**count > MOST_CORNERS:
            raise InfeasibleError(
                f"the slopes of the dynamics take {2**count} extreme cases over a box; at most {MOST_CORNERS} are "
                "served."
            )
        worst = Interval(np.zeros(self.n), np.max(rest.hi, axis=0))
        values, drifts, spreads = [], [], []
        noise = self._noise_parts(cells)
        for corner in itertools.product((0, 1), repeat=count):
            held, shaken = np.split(np.array(corner), [len(self.held)])
            at = np.where(held, high[:, self.held], low[:, self.held])
            step = [Interval.point(at[:, k]) - Interval.point(cells.middle[:, a]) for k, a in enumerate(self.held)]
            matrix = base
            for part, shift in zip(by_state, step):
                matrix = matrix + part * shift.reshape(-1, 1, 1)
            signs = [2.0 * bit - 1.0 for bit in shaken]
            for part, sign, radius in zip(by_disturbance, signs, cells.sway):
                matrix = matrix + part * (radius * Interval.point(sign))
            drifts.append(self._widened(matrix, rest, small))
            values.append(at)
            spreads.append(with_small(noise(step), worst, small))
        return Cells(
            low=low, high=high, held=self.held, values=np.array(values), drift=stack(drifts), spread=stack(spreads),
            affine=self._affine(cells), square=self._square(cells), toll=self._toll(shares, small),
            bend=self._bend(shares, small, cells),
        )  # fmt: skip

    def _toll(self, shares: Interval, small: Sequence[int]) -> Interval:
        """sum r q/2 over what is constant of the remainders that are columns, shape (C,)."""
        return Interval.point(shares.hi[:, list(small), self.n]).sum(axis=-1) * Interval.point(SLOPE / 2)

    def _bend(self, shares: Interval, small: Sequence[int], cells: _Boxes) -> Interval:
        """sum r_b (q/2) eta_b^2 over the rest of them, as forms over z, shape (C, n + 1, n + 1)."""
        many, n = len(cells.low), self.n
        weight = Interval.point(shares.hi[:, list(small), :n]).sum(axis=1) * Interval.point(SLOPE / 2)
        total: Interval = Interval.point(np.zeros((many, n + 1, n + 1)))
        for b in np.flatnonzero(weight.hi.max(axis=0) > 0):
            slope = Interval.point(1.0) / Interval.point(cells.size.hi[:, b])
            offset = -(Interval.point(cells.middle[:, b]) * slope)
            lo, hi = np.zeros((2, many, n + 1))
            lo[:, b], hi[:, b], lo[:, n], hi[:, n] = slope.lo, slope.hi, offset.lo, offset.hi
            eta = Interval(lo, hi)
            square = eta.reshape(many, -1, 1) * eta.reshape(many, 1, -1)
            total = total + square * weight[:, b].reshape(-1, 1, 1)
        return total

    def _widened(self, matrix: Interval, rest: Interval, small: Sequence[int]) -> Interval:
        """The constant column widened by the remainders that are no columns: those of rounding."""
        wide = np.zeros(matrix.shape)
        wide[:, : self.n, -1] = rest.hi
        wide[:, list(small), -1] = 0.0
        return matrix + Interval(-wide, wide)

    def _drift_parts(self, cells: _Boxes) -> tuple[Interval, list[Interval], list[Interval], Interval]:
        """A at the middle, its slopes along N and d, and bounds of the remainder: r_b, shape (C, n, n + 1)."""
        n = self.n
        value, slope, curve = self.drift.at(cells)
        size = cells.size  # (C, q): half widths of xi and d
        shares = _Shares(len(cells.low), n)
        value, first = self._noted(value, 0, size)
        slope, second = self._noted(slope, 1, size)
        shares.add(n, first + second)
        base, owned = _linear(value, slope[..., :n], cells.middle), [_empty(cells, n) for _ in self.held]
        shaken = [_linear(slope[..., n + b], None, cells.middle) for b in range(len(self.disturbed))]
        for a, b in sorted(self.drift.pairs):
            both = curve[:, :, a, b]
            factor = 1.0 if a != b else 0.5
            middle = Interval.point(both.mid)
            wide = Interval(np.zeros(both.shape), both.rad)
            owner, other = (a, b) if a in self.held or b >= n else (b, a)
            along = min(a, n) if b >= n else other  # a product of disturbances has no place
            shares.add(along, wide * Interval.point(factor) * (size[:, a] * size[:, b]).reshape(-1, 1))
            if b < n:
                place = self.held.index(owner)
                owned[place] = owned[place] + _along(middle * Interval.point(factor), other, cells.middle)
            elif a < n:
                shaken[b - n] = shaken[b - n] + _along(middle, a, cells.middle)
            else:  # a product of disturbances
                bent = Interval(np.zeros(both.shape), middle.mag) * Interval.point(factor)
                shares.add(n, bent * (size[:, a] * size[:, b]).reshape(-1, 1))
        return base, owned, shaken, shares.whole

    def _noted(self, part: Interval, order: int, size: Interval) -> tuple[Interval, Interval]:
        """A coefficient as a narrow one, and what its width (from the time) adds to the remainder (C, n)."""
        if self.drift.autonomous:
            return part, Interval.point(np.zeros(part.shape[:2]))
        wide = Interval(np.zeros(part.shape), part.rad)
        extra = wide if order == 0 else (wide * size.reshape(-1, 1, size.shape[-1])).sum(axis=-1)
        return Interval.point(part.mid), extra

    def _noise_parts(self, cells: _Boxes) -> Callable[[Sequence[Interval]], Interval]:
        """A function from the steps along N to the columns of the diffusion."""
        n, m = self.n, self.noises
        width = Interval.point(self.setting.width).reshape(1, -1, 1)
        if self.noise is None:
            fixed = padded((self.constant.reshape(1, n, m) / width).broadcast_to((len(cells.low), n, m)))  # type: ignore[union-attr]
            return lambda step: fixed
        value, slope, curve = self.noise.at(cells)
        size = cells.size
        rest = Interval(np.zeros(value.shape), value.rad)
        rest = rest + (Interval(np.zeros(slope.shape), slope.rad) * size[:, None, : n]).sum(axis=-1)
        value, slope = Interval.point(value.mid), Interval.point(slope.mid)
        cross = []
        for a, b in sorted(self.noise.pairs):
            both, factor = curve[:, :, a, b], 1.0 if a != b else 0.5
            grown = Interval(np.zeros(both.shape), both.rad if a != b else both.mag)
            rest = rest + grown * Interval.point(factor) * (size[:, a] * size[:, b]).reshape(-1, 1)
            if a != b:
                cross.append((self.held.index(a), self.held.index(b), Interval.point(both.mid)))
        rest = Interval(np.zeros(rest.shape), rest.hi).reshape(-1, n, m).sum(axis=-1)

        def columns(step: Sequence[Interval]) -> Interval:
            total = value
            for k, a in enumerate(self.held):
                total = total + slope[:, :, a] * step[k].reshape(-1, 1)
            for first, second, part in cross:
                total = total + part * (step[first] * step[second]).reshape(-1, 1)
            return with_columns(total.reshape(-1, n, m), rest)

        return columns

    def _affine(self, cells: _Boxes) -> Interval | None:
        """G_c with g = (G_c z)_c, where the diffusion is affine and does not change with time."""
        n, m = self.n, self.noises
        if self.noise is None:
            width = Interval.point(self.setting.width).reshape(-1, 1)
            columns = self.constant / width  # type: ignore[operator]
            slopes: Interval = Interval.point(np.zeros((n, m, n)))
            middle = np.zeros(n)
        else:
            if self.noise.pairs or not self.noise.autonomous:
                return None
            value, slope, _ = self.noise.at(cells)
            columns, slopes, middle = value[0].reshape(n, m), slope[0].reshape(n, m, n), cells.middle[0]
        last = columns - (slopes * Interval.point(middle)).sum(axis=-1)
        lo, hi = np.zeros((m, n + 1, n + 1)), np.zeros((m, n + 1, n + 1))
        for array, part, end in ((lo, slopes.lo, last.lo), (hi, slopes.hi, last.hi)):
            array[:, :n, :n], array[:, :n, n] = part.transpose(1, 0, 2), end.T
        return Interval(lo, hi)

    def _square(self, cells: _Boxes) -> Interval:
        n, m = self.n, self.noises
        width = Interval.point(self.setting.width).reshape(1, -1, 1)
        if self.noise is None:
            columns = (self.constant.reshape(1, n, m) / width).broadcast_to((len(cells.low), n, m))  # type: ignore[union-attr]
        else:
            columns = self.noise.whole(cells).reshape(-1, n, m)
        return columns @ columns.T


def grid(n: int, held: Sequence[int], slabs: Sequence[int]) -> tuple[Array, Array]:
    """Cells that cover [-1, 1]^n: slabs of the held coordinates."""
    cuts = [np.linspace(-1.0, 1.0, slabs[held.index(axis)] + 1 if axis in held else 2) for axis in range(n)]
    low = np.stack([axis.ravel() for axis in np.meshgrid(*(cut[:-1] for cut in cuts), indexing="ij")], axis=1)
    high = np.stack([axis.ravel() for axis in np.meshgrid(*(cut[1:] for cut in cuts), indexing="ij")], axis=1)
    return low, high


def curved_axes(problem: Problem) -> set[int]:
    """Coordinates on which the drift does not depend affinely, or the diffusion at all."""
    n, diffusion = problem.system.dimension, diffusion_of(problem)
    found = {a for pair in _Jet(problem.closed_loop, n).pairs for a in pair if a < n}
    return found | (_Jet(diffusion, n).used if isinstance(diffusion, Tape) else set())


class _Shares:
    """Bounds of the remainder's parts, by the coordinate with which each vanishes (the last: none)."""

    def __init__(self, cells: int, n: int) -> None:
        self.parts: list[Interval] = [Interval.point(np.zeros((cells, n)))] * (n + 1)

    def add(self, place: int, bound: Interval) -> None:
        self.parts[place] = self.parts[place] + bound * Interval.point(_ROOM)

    @property
    def whole(self) -> Interval:
        return Interval(np.stack([p.lo for p in self.parts], -1), np.stack([p.hi for p in self.parts], -1))


class _Boxes:
    """Cells as inputs of tapes: their middles and whole extents in x, and half widths in xi and d."""

    def __init__(self, low: Array, high: Array, span: Interval, setting: Setting, disturbed: Interval) -> None:
        self.low, self.high, self.span, self.setting = low, high, span, setting
        self.middle = (low + high) / 2
        half = Interval(np.zeros(low.shape), (Interval(low, high) - Interval.point(self.middle)).mag)
        self.disturbed = disturbed
        still = Interval.point(disturbed.mid)
        radius = Interval(np.zeros(len(disturbed)), (disturbed - still).mag)
        self.sway = [Interval.point(end) for end in radius.hi]
        many = radius.reshape(1, -1).broadcast_to((len(low), len(disturbed)))
        self.size = Interval(np.zeros((len(low), low.shape[1] + len(disturbed))), np.hstack([half.hi, many.hi]))
        self.at_middle = self._inputs(setting.over(self.middle, self.middle), still)
        self.at_all = self._inputs(setting.over(low, high), disturbed)

    def _inputs(self, x: Interval, d: Interval) -> list[Interval]:
        return [self.span, *(x[:, i] for i in range(x.shape[1])), *(d[k] for k in range(len(d)))]


class _Jet:
    """A tape with its first and second derivatives, in xi and d; values divided by the widths of the states."""

    def __init__(self, tape: Tape, n: int) -> None:
        self.tape, self.n = tape, n
        count = len(tape.inputs)
        self.slots = list(range(1, count))
        self.slope = jacobian(tape, self.slots)
        self.curve = jacobian(self.slope, self.slots)
        self.outputs = len(tape.outputs)
        q = count - 1
        self.pairs = {pair for i in range(self.outputs) for pair in self.pairs_of(i)}
        self.used = {a for i in range(self.outputs) for a in range(q) if not is_zero(self.slope, i * q + a)}
        moving = jacobian(tape, [0])
        self.autonomous = all(is_zero(moving, i) for i in range(self.outputs))

    def pairs_of(self, i: int) -> set[tuple[int, int]]:
        """Pairs of inputs along which an output bends."""
        q = len(self.slots)
        both = itertools.product(range(q), repeat=2)
        return {(min(a, b), max(a, b)) for a, b in both if not is_zero(self.curve, (i * q + a) * q + b)}

    def at(self, cells: _Boxes) -> tuple[Interval, Interval, Interval]:
        """Value (C, k) and slope (C, k, q) at the middles, second derivatives (C, k, q, q) over the cells."""
        q, batch = len(self.slots), len(cells.low)
        middle, whole = cells.at_middle[: q + 1], cells.at_all[: q + 1]
        value = enclose(self.tape, middle).reshape(batch, self.outputs)
        slope = enclose(self.slope, middle).reshape(batch, self.outputs, q)
        curve = enclose(self.curve, whole).reshape(batch, self.outputs, q, q)
        rows = np.repeat(cells.setting.width, self.outputs // self.n)
        scale = Interval.point(np.concatenate([cells.setting.width, np.ones(q - self.n)]))
        value = value / Interval.point(rows).reshape(1, -1)
        slope = slope * scale / Interval.point(rows).reshape(1, -1, 1)
        curve = curve * scale.reshape(1, 1, -1, 1) * scale / Interval.point(rows).reshape(1, -1, 1, 1)
        return value, slope, curve

    def whole(self, cells: _Boxes) -> Interval:
        """The values over the cells, shape (C, k)."""
        rows = np.repeat(cells.setting.width, self.outputs // self.n)
        found = enclose(self.tape, cells.at_all[: len(self.slots) + 1])
        return found.reshape(len(cells.low), self.outputs) / Interval.point(rows)


def _empty(cells: _Boxes, n: int) -> Interval:
    return Interval.point(np.zeros((len(cells.low), n + 1, n + 1)))


def _linear(value: Interval, slope: Interval | None, middle: Array) -> Interval:
    """value + slope (xi - middle) as matrices over z, shape (C, n + 1, n + 1)."""
    batch, n = value.shape
    last = value if slope is None else value - (slope * Interval.point(middle[:, None, :])).sum(axis=-1)
    lo, hi = np.zeros((batch, n + 1, n + 1)), np.zeros((batch, n + 1, n + 1))
    lo[:, :n, n], hi[:, :n, n] = last.lo, last.hi
    if slope is not None:
        lo[:, :n, :n], hi[:, :n, :n] = slope.lo, slope.hi
    return Interval(lo, hi)


def _along(value: Interval, axis: int, middle: Array) -> Interval:
    """value (xi_axis - middle) as matrices over z."""
    batch, n = value.shape
    lo, hi = np.zeros((batch, n + 1, n + 1)), np.zeros((batch, n + 1, n + 1))
    last = -(value * Interval.point(middle[:, axis]).reshape(-1, 1))
    lo[:, :n, axis], hi[:, :n, axis], lo[:, :n, n], hi[:, :n, n] = value.lo, value.hi, last.lo, last.hi
    return Interval(lo, hi)
