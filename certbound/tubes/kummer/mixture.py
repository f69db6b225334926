"""Mixtures of Kummer and Bessel supermartingales, weighted by a linear program (Thm K3, items 7.5 and 7.12).

Component i has parameters (a_i, v0_i), or the Bessel form, and an end time T_i after which it is dropped to 0. With
g^i_t(s) = phi_i(I_t) + e^{a_i I_t} E_i(s^2/(2 v^i_t)), I running to T_i, and X_i = g^i_0(0), every choice of weights
w_i >= 0 with sum_i w_i g^i_t(r_t) >= 1 for all t <= T proves P(exists t: ||S_t|| > r_t) <= sum_i w_i X_i. The least
bound is a linear program; its dual prices the next component. One component is Thm K1, a Bessel component per step is
the union bound. The program only proposes: the weights are certified in ball arithmetic, on whole intervals of time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from flint import arb

from certbound.arrays import Array, Index, Mask
from certbound.errors import SolverError
from certbound.rigor.balls import lower, precision, upper
from certbound.tubes.ballpath import BallPath, ball_path
from certbound.tubes.excess import log_excess, log_phi
from certbound.tubes.kummer.profile import excess_function, phi_ball
from certbound.tubes.kummer.search import simplex
from certbound.tubes.piecewise import PiecewiseProfile
from certbound.tubes.schedule import Schedule

Pair = tuple[float, float, bool]


@dataclass(frozen=True, kw_only=True)
class Component:
    """One supermartingale; ``v0`` in units of ``schedule.unit``^2."""

    a: float
    v0: float
    end: float
    bessel: bool = False
    weight: float = 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class MixtureProgram:
    """The linear program for one schedule whose pieces are the intervals of time to cover."""

    schedule: Schedule  # refined data: one row per piece
    clearance: Array  # (K,): r_t on each piece (infinite where nothing is asked)
    ends: Index  # candidate end times, among the schedule's times

    @cached_property
    def _squares(self) -> Array:
        return (self.clearance / self.schedule.unit) ** 2

    def _rows(self, a: float, v0: float, scale: float) -> tuple[Array, Array, Array]:
        """(log E on each piece, I at its end, I at the nodes) of one pair, up to the horizon."""
        v, info = self.schedule.path(np.asarray(v0))
        top = np.maximum(v[:-1], v[1:]) if self.schedule.continuous else v[1:]
        if not self.schedule.continuous:
            wide = self.schedule.lengths > 1
            top = np.where(wide, np.maximum(v[:-1], v[1:]), top)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            z = scale**2 * self._squares / (2 * top)
            log_e = log_excess(np.asarray(a), self.schedule.nu / 2, np.nan_to_num(z, nan=np.inf))[0]
        return log_e, info[1:], info

    @cached_property
    def _scaled(self) -> tuple[Array, Array]:
        """(gain, W = int sigma^2/gain) at the nodes, for the Bessel form."""
        gain = self.schedule.nodes[0]
        with np.errstate(over="ignore", invalid="ignore"):
            return gain, np.append(0.0, np.cumsum(self.schedule.backward[0] / gain[:-1]))

    def columns(self, pair: Pair, scale: float) -> Array:
        """log of g^i_t(r_t)/X_i on the pieces for every candidate end, shape (ends, K); -inf after the end.

        A Bessel pair (k, 0, True) stands for v_0 = W at the end, where its exponent a I_0 is k.
        """
        a, v0, bessel = pair
        if bessel:
            gain, spent = self._scaled
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                top = np.maximum(gain[:-1], gain[1:]) if self.schedule.continuous else gain[1:]
                z = scale**2 * self._squares / (2 * top * spent[self.ends][:, None])
                rest = 1 - spent[1:] / spent[self.ends][:, None]
                z = np.where(rest >= 0, np.nan_to_num(z, nan=np.inf), 1.0)
                log_e = log_excess(np.asarray(a), self.schedule.nu / 2, z, bessel=True)[0]
            whole = np.ones((len(self.ends), 1))
        else:
            log_e, left, info = self._rows(a, v0, scale)
            rest = left[None, :] - info[self.ends][:, None]
            whole = (info[0] - info[self.ends])[:, None]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            base = np.log(np.maximum(rest, 0.0)) + log_phi(a * np.maximum(rest, 0.0))
            result = np.logaddexp(base, a * rest + log_e) - np.log(whole) - log_phi(a * whole)
        covered = np.arange(result.shape[1])[None, :] < self.ends[:, None]
        return np.where(covered & np.isfinite(result), result, -np.inf)

    def solve(self, pairs: Sequence[Pair], scale: float, rounds: int) -> tuple[float, list[Component], list[Pair]]:
        """(probability, weighted components, pairs with the ones that were generated)."""
        pairs = list(pairs)
        asked = np.isfinite(self.clearance)
        columns = np.concatenate([self.columns(pair, scale)[:, asked] for pair in pairs])
        labels = [(pair, int(end)) for pair in pairs for end in self.ends]
        value, u, dual = self._program(columns)
        for _ in range(rounds):
            active = np.flatnonzero(u > 1e-9 * value)
            fresh = []
            for j in active[np.argsort(-u[active])][:6].tolist():
                pair, _ = labels[j]
                better = self._improve(pair, dual, scale, asked)
                if better is not None:
                    fresh.append(better)
            if not fresh:
                break
            for pair in fresh:
                columns = np.concatenate([columns, self.columns(pair, scale)[:, asked]])
                labels += [(pair, int(end)) for end in self.ends]
                pairs.append(pair)
            before, (value, u, dual) = value, self._program(columns)
            if value > before * (1 - 1e-4):
                break
        times = self.schedule.times
        used = np.flatnonzero(u > 1e-13 * value)
        components = []
        for j in used.tolist():
            (a, v0, bessel), last = labels[j]
            v0 = float(self._scaled[1][last]) if bessel else v0
            components.append(Component(a=a, v0=v0, bessel=bessel, end=float(times[last]), weight=float(u[j])))
        return value, components, pairs

    def _program(self, columns: Array) -> tuple[float, Array, Array]:
        """min sum u s.t. sum_i u_i g_i/X_i >= 1 on every row, in the unit of the best single column."""
        from scipy.optimize import linprog

        with np.errstate(over="ignore"):
            worst = columns.min(axis=1)
        unit = float(np.max(np.where(np.isfinite(worst), worst, -np.inf)))
        unit = unit if math.isfinite(unit) else float(np.median(columns.max(axis=0)))
        # a smaller gain only makes the bound larger: the range is cut to what the solver handles
        matrix = np.exp(np.minimum(columns - unit, math.log(1e6)))
        matrix[matrix < 1e-7] = 0.0
        kept = np.flatnonzero(matrix.max(axis=1) > 1e-3)
        for solver in ("highs-ds", "highs-ipm"):
            result = linprog(
                np.ones(len(kept)),
                A_ub=-matrix[kept].T,
                b_ub=-np.ones(matrix.shape[1]),
                bounds=(0, None),
                method=solver,
            )
            if result.success:
                break
        else:
            raise SolverError(f"the linear program of the mixture failed: {result.message}")
        u = np.zeros(len(columns))
        u[kept] = np.asarray(result.x) * math.exp(-unit)
        return float(u.sum()), u, -np.asarray(result.ineqlin.marginals) * math.exp(-unit)

    def _improve(self, pair: Pair, dual: Array, scale: float, asked: Mask) -> Pair | None:
        """A pair near ``pair`` with a smaller reduced cost 1 - sum_j dual_j g_j/X, over all ends."""
        a, v0, bessel = pair
        cap = 1e4 if self.schedule.any_power else self.schedule.nu / 2 * (1 - 1e-9)
        live = dual > 0

        def point(p: Sequence[float]) -> Pair:
            return (math.exp(p[0]), v0, True) if bessel else (math.expm1(p[0]), math.exp(p[1]), False)

        def worth(p: Sequence[float]) -> float:
            columns = self.columns(point(p), scale)[:, asked][:, live]
            with np.errstate(over="ignore"):
                return -float(np.max(np.exp(np.minimum(columns, 700.0)) @ dual[live]))

        start = [math.log(a)] if bessel else [math.log1p(a), math.log(v0)]
        ends = (-650.0 if bessel else 0.0, -650.0), (650.0 if bessel else math.log1p(cap), 650.0)
        value, best = simplex(worth, start, 0.3, tolerance=1e-4, budget=40, low=ends[0], high=ends[1])
        return point(best) if value < -1 - 1e-3 and not np.allclose(best, start, atol=1e-4) else None


@dataclass(frozen=True, eq=False, kw_only=True)
class _Held:
    """A component in ball arithmetic."""

    path: BallPath
    excess: Callable[[arb], arb]
    power: arb
    weight: arb
    last: int


@dataclass(frozen=True, eq=False, kw_only=True)
class MixtureProfile(PiecewiseProfile):
    """Radius r_t with sum_i w_i g^i_t(r_t) = 1; sum_i w_i X_i <= delta is checked by :meth:`level`.

    ``weight`` of a component is w_i X_i, its share of the probability; ``aims`` (K,) are the radii per piece, in
    units, that the program was solved for.
    """

    components: tuple[Component, ...]
    aims: Array
    splits: ClassVar[int] = 2  # a stretch is costly, and the pieces are short

    def to_dict(self) -> dict[str, Any]:
        """Parameters as plain data."""
        return {
            "kind": "mixture", "unit": self.schedule.unit, "times": self.schedule.times.tolist(),
            "components": [vars(component) for component in self.components],
        }  # fmt: skip

    @cached_property
    def _balls(self) -> list[_Held]:
        result = []
        with precision():
            for component in self.components:
                last = int(np.searchsorted(self.schedule.times, component.end))
                path = ball_path(self.schedule.until(last), component.v0, bessel=component.bessel)
                power = arb(component.a)
                weight = arb(component.weight) / phi_ball(power, path.nodes[1][0])
                excess = excess_function(component.a, self.schedule.nu / 2, component.bessel)
                result.append(_Held(path=path, excess=excess, power=power, weight=weight, last=last))
        return result

    def level(self) -> float:
        """Upper bound of sum_i w_i X_i."""
        with precision():
            return upper(sum((arb(component.weight) for component in self.components), arb(0)))

    def gain(self, piece: int, start: float, end: float, radius: arb) -> arb:
        """Lower bound of sum_i w_i g^i_t(radius) over [start, end] in one piece (radius in units)."""
        total = arb(0)
        square = radius**2 / 2
        for held in self._balls:
            if piece >= held.last:
                continue
            v, info = held.path.at(piece, end)
            if start < end:
                v = arb.max(v, held.path.at(piece, start)[0])
            value = phi_ball(held.power, info) + (held.power * info).exp() * held.excess(square / v)
            total += held.weight * value
        return total

    def stretch(self, piece: int, start: float, end: float) -> tuple[float, float]:
        """The aim of the piece where it is proved; else the least radius found with the gain at least 1 proved."""
        aim = self.rough(piece, start, end)
        if math.isfinite(aim):
            return aim, aim
        if not self.schedule.continuous and start == self.schedule.times[piece]:
            # a piece holds the steps after its start
            if start == end:
                return (0.0, 0.0) if piece == 0 else self._stretch(piece - 1, start, end)
            first = self._stretch(piece - 1, start, start)[0] if piece > 0 else 0.0
            bound, value = self._stretch(piece, start + 1, end)
            return max(first, bound), max(first, value)
        return self._stretch(piece, start, end)

    def _stretch(self, piece: int, start: float, end: float) -> tuple[float, float]:
        with precision():
            unit = arb(self.schedule.unit)
            guess = float(self._solve(np.array([piece]), np.array([end]), np.array([start]))[0])
            guess, step = guess * (1 + 2e-12), 1e-12
            while math.isfinite(guess) and not self.gain(piece, start, end, arb(guess)) >= 1:
                guess *= 1 + step
                step *= 8
            bound = upper(arb(guess) * unit) if math.isfinite(guess) else math.inf
            value = (
                bound if start == end else float(self._solve(np.array([piece]), np.array([end]), np.array([end]))[0])
            )
            return bound, min(bound, lower(arb(value) * unit) if start < end else bound)

    def rough(self, piece: int, start: float, end: float) -> float:
        """The radius that the program aimed at, where it is proved."""
        if self.schedule.continuous or start > self.schedule.times[piece]:
            return self._aimed(piece)
        before = self._aimed(piece - 1) if piece > 0 else 0.0
        return before if start == end else max(before, self._aimed(piece))

    def _aimed(self, piece: int) -> float:
        """Aim of a piece if the gain is proved there to be at least 1 (in DT at the steps after its start)."""
        if piece not in self._proved:
            begin, end = float(self.schedule.times[piece]), float(self.schedule.times[piece + 1])
            with precision():
                aim = arb(float(self.aims[piece]))
                gain = self.gain(piece, begin if self.schedule.continuous else begin + 1, end, aim)
                self._proved[piece] = upper(aim * arb(self.schedule.unit)) if gain >= 1 else math.inf
        return self._proved[piece]

    @cached_property
    def _proved(self) -> dict[int, float]:
        return {}

    def radius(self, t: Array) -> Array:
        """Floating-point radius."""
        flat = np.ravel(np.asarray(t, dtype=float))
        radius = self.schedule.unit * self._solve(self._piece(flat), flat, flat)
        if not self.schedule.continuous:
            radius = np.where(flat == 0, 0.0, radius)
        return np.asarray(radius.reshape(np.shape(t)))

    def _piece(self, t: Array) -> Index:
        """In DT a step belongs to the piece that ends there or holds it inside."""
        times = self.schedule.times
        after = np.searchsorted(times, t, side="right") if self.schedule.continuous else np.searchsorted(times, t)
        return np.clip(after - 1, 0, len(times) - 2)

    def _solve(self, piece: Index, t: Array, start: Array) -> Array:
        """Radius in units with gain 1, in floating point, by bisection on its logarithm and Newton steps."""
        rows = []
        for component in self.components:
            last = int(np.searchsorted(self.schedule.times, component.end))
            data = self.schedule.until(last)
            v, rest = data.path_at(component.v0, np.minimum(t, data.horizon), bessel=component.bessel)
            first = data.path_at(component.v0, np.minimum(start, data.horizon), bessel=component.bessel)[0]
            whole = float(data.path(np.asarray(component.v0), bessel=component.bessel)[1][0])
            log_w = math.log(component.weight) - math.log(whole) - float(log_phi(np.asarray(component.a * whole)))
            rows.append((component, np.maximum(v, first), np.maximum(rest, 0.0), log_w, piece < last))
        x = np.full(t.shape, 0.5 * math.log(max(float(np.max(r[1])) for r in rows) * 20))
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(80):
                total, slope = np.full(t.shape, -np.inf), np.zeros(t.shape)
                for component, v, rest, log_w, live in rows:
                    log_e, rise = log_excess(
                        np.asarray(component.a), self.schedule.nu / 2, np.exp(2 * x) / (2 * v), bessel=component.bessel
                    )
                    base = log_w + np.log(rest) + log_phi(component.a * rest)
                    part = log_w + component.a * rest + log_e
                    value = np.where(live, np.logaddexp(base, part), -np.inf)
                    new = np.logaddexp(total, value)
                    share = np.where(np.isfinite(new), np.exp(np.where(live, part, -np.inf) - new), 0.0)
                    slope = slope * np.where(np.isfinite(new), np.exp(total - new), 0.0) + 2 * rise * share
                    total = new
                step = np.clip(np.nan_to_num(-total / np.maximum(slope, 1e-300)), -0.7, 0.7)
                x = x + step
                if np.all(np.abs(step) < 1e-12):
                    break
        return np.where(np.isfinite(total), np.exp(x), np.inf)
