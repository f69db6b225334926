"""The barrier engine: exp(V) of a polynomial V, found by a convex program and proved by intervals.

Let D be the set where no constraint is broken, and let V be twice differentiable with
    grad V . f + 1/2 tr(g g^T Hess V) + 1/2 |g^T grad V|^2 <= kappa   on [0, T] x D, for every d in its set.
Then exp(V(X) - kappa t), stopped when X leaves D, is a supermartingale (Ito; it is positive), and a path that leaves
does so on the boundary of D, where V >= u; X_0 lies in D, which is proved too. So
    P(leaving within T) <= exp(max over X_0 of V - u + max(kappa, 0) T).
The disturbance may react to the state and the past, but must not see coming noise: Ito's formula needs an adapted d.

The condition is convex in V: for a polynomial each point of a grid gives a second-order cone, and the exponent is
linear, so that the best polynomial is one conic program. What it proposes is then bounded over all of D, from above
and below, by branch and bound with centred forms.

Where noise keeps a system moving about what attracts it, kappa T is large whatever V is. There L w <= c is asked of
w = exp(V - u), L the generator; w is at least 1 where a path leaves, w(X) - c t, stopped, is a supermartingale, and
    P(leaving within T) <= exp(max over X_0 of V - u) + c T.
Near the attractor w is small, so that c is.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array, Integers, Mask
from certbound.constants.enclosures import bound_supremum
from certbound.errors import EngineError
from certbound.problem.model import Tape, compile_numpy, jacobian, substitute, trace
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem
from certbound.reach.nominal import initial_cells
from certbound.rigor.intervals import Interval, exp, log
from certbound.safety.answers import AS_IT_IS, SPARED, EngineAnswer, Request
from certbound.safety.engines.barrier_programs import Polynomials
from certbound.safety.engines.gaps import gaps_of, hull_of, lies_inside, range_over
from certbound.watch import poll

_MOST_STATES = 3
_DEGREES = {1: (4, 6), 2: (4, 6), 3: (4,)}
_MORE_DEGREES = {1: (8, 10), 2: (8, 10), 3: (6,)}  # with efforts that double
_COARSE, _FINE = {1: 51, 2: 21, 3: 7}, {1: 201, 2: 41, 3: 9}  # points along every side
_ROUNDS = 3
_BINDING = 0.2  # of the many points: how many enter the program in every round
_FAR = 1 / 3  # share of the exponent asked for, from which on the next degree is worth its time
_WORTH = 1.15  # times the exponent known: a steady polynomial that misses the target has to hope for more than that
_CLOSE = 0.1  # of log10: what is proved may be that far from what the program hoped for
_BUDGET = 20_000
_TOLERANCE = 0.02  # of kappa T, of V at the start and of V at the boundary: a loss of 0.03 in log10
_HIGHEST = 40.0
_LOWEST = 600.0  # below it no tolerance is a positive float
_LOG10 = math.log(10.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Barrier:
    """A polynomial V and what was proved of it.

    V(x) = sum_k coefficients[k] prod_i ((x_i - center_i)/scale_i)**exponents[k, i]; shapes: exponents (K, n),
    coefficients (K,), center and scale (n,). ``start`` is an upper bound of V over the initial set, ``boundary`` a
    lower one where a constraint is about to be broken, ``growth`` an upper bound kappa of the generator's expression.
    With an ``inflow`` c, which bounds the generator of exp(V - boundary) itself, the growth is 0.
    """

    exponents: Integers
    coefficients: Array
    center: Array
    scale: Array
    start: float
    boundary: float
    growth: float
    inflow: float = 0.0

    def log10_probability(self, horizon: float) -> float:
        """log10 of the bound on the probability of leaving within ``horizon``, rounded up."""
        exponent = Interval.point(self.start) - self.boundary + Interval.point(max(self.growth, 0.0)) * horizon
        if self.inflow > 0:
            exponent = log(exp(exponent) + Interval.point(self.inflow) * horizon)
        value = float(exponent.hi) / _LOG10
        return value + 4e-16 * abs(value)


def barrier_engine(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
    """The smallest probability that an exponential polynomial barrier proves, if no other engine has proved enough.

    It covers the disturbances that do not see coming noise.
    """
    refused = SPARED if asked.quick else _refusal(problem)
    if refused is not None:
        return EngineAnswer(applicable=False, reason=refused, method="barrier")
    assert isinstance(problem.system, ContinuousSystem)
    work = _Work(problem, problem.system)
    if not lies_inside(work.gaps, work.start):
        outside = "the box around the initial set was not proved to lie inside the safe set."
        return EngineAnswer(applicable=False, method="barrier", reason=outside)
    best, level = None, 0.0

    def tell(barrier: Barrier) -> None:
        asked.found(_answer(problem, barrier))

    degrees = _degrees(work.n, asked.effort or 1.0)
    for degree in degrees:
        try:
            found = work.search(degree, tell, known=best is not None)
        except EngineError:
            if best is None:
                raise
            break
        if found is not None and found.log10_probability(problem.horizon) < level:
            best, level = found, found.log10_probability(problem.horizon)
        if level <= math.log10(problem.delta) or (not asked.at_length and 0 > level > _FAR * math.log10(problem.delta)):
            break
    many = work.n == _MOST_STATES and not asked.at_length  # that takes a quarter of a minute
    if level > math.log10(problem.delta) and not many:
        found = work.steady(degrees[0], tell, level, 1.0 if asked.thorough else _WORTH)
        best = found if found is not None else best
    none = EngineAnswer(reason="no polynomial barrier was found.", method="barrier")
    return none if best is None else _answer(problem, best)


def _degrees(states: int, effort: float) -> tuple[int, ...]:
    """The degrees of polynomials that are tried: the usual ones, or for more effort one that is higher."""
    more = _MORE_DEGREES[states]
    return _DEGREES[states] if effort <= 1 else (more[min(int(math.log2(effort)), len(more) - 1)],)


def _answer(problem: Problem, best: Barrier) -> EngineAnswer:
    words = f"grows by at most {max(best.growth, 0.0) * problem.horizon:.3g} in logarithm within the horizon"
    if best.inflow > 0:
        words = f"over that at the boundary grows by at most {best.inflow * problem.horizon:.3g} within the horizon"
    return EngineAnswer(
        log10_delta=min(best.log10_probability(problem.horizon), 0.0),
        reason=f"exp(V) - V a polynomial of degree {int(best.exponents.sum(axis=1).max())} - {words}, from "
        f"{best.start:.3g} to {best.boundary:.3g} at the boundary.",
        method="barrier",
        details=best,
    )


def _refusal(problem: Problem) -> str | None:
    system = problem.system
    if not isinstance(system, ContinuousSystem):
        return "the barrier engine needs continuous time."
    if system.dimension > _MOST_STATES:
        return f"the barrier engine searches in at most {_MOST_STATES} states."
    if problem.input_sequence is not None:
        return "the barrier engine needs a plan without steps in time."
    if problem.initial.random:
        return "the barrier engine needs a bounded initial set."
    for constraint in problem.constraints:
        region = constraint.region
        if constraint.during is not None or region.moving or (region.form.round and not region.form.even):
            return f"the barrier engine does not treat windows, moving sets and ellipsoids ('{constraint.label}')."
    if not np.isfinite(hull_of(gaps_of(problem))).all():
        return "the barrier engine needs safe sets or a domain that bound every state."
    return None


class _Work:
    """One problem: its sets, its tapes, the points that the search asks for."""

    def __init__(self, problem: Problem, system: ContinuousSystem) -> None:
        self.problem, self.system = problem, system
        self.n = system.dimension
        self.gaps = gaps_of(problem)
        low, high = hull_of(self.gaps)
        self.hull = Interval(low, high)
        self.center, self.scale = (low + high) / 2, (high - low) / 2
        self.size = float(np.max(self.scale))
        self.start = initial_cells(problem).boxes[0]
        disturbance = system.disturbance
        free = [(0.0, float(problem.horizon)), *zip(low.tolist(), high.tolist())]
        if disturbance is not None:
            free += list(zip(np.asarray(disturbance.low).tolist(), np.asarray(disturbance.high).tolist()))
        self.ranges = Interval(*(np.array(ends) for ends in zip(*free)))
        self.noises = int(system.diffusion.shape[1])
        self.programs = Polynomials(problem, system, self.center, self.scale)

    # ---- the search ------------------------------------------------------------------------------------------

    def search(self, degree: int, found: Callable[[Barrier], object], *, known: bool = False) -> Barrier | None:
        """The best polynomial of the convex program, and what is proved of it; ``found`` takes better and better ones.

        Few points first: what they hope for says whether more, which take long, are worth it. Where a bound is
        ``known`` already, only the target is.
        """
        exponents = self._exponents(degree)
        horizon, target = self.problem.horizon, math.log10(self.problem.delta)
        points = self._points(_COARSE[self.n])
        fine: tuple[Array, Array, Array] | None = None
        best: Barrier | None = None
        for number in range(1 + _ROUNDS):
            poll(f"a polynomial of degree {degree}, round {number + 1}")
            coefficients, hoped = self.programs.slowest(exponents, points)
            if coefficients is None:
                return best
            proved, worst = self._certified(exponents, coefficients)
            if proved is not None and (
                best is None or proved.log10_probability(horizon) < best.log10_probability(horizon)
            ):
                best = proved
                found(best)
            level = 0.0 if best is None else best.log10_probability(horizon)
            vain = known and (hoped > target or (number > 0 and proved is None))
            vain = vain or (self.n == _MOST_STATES and (hoped > _FAR * target or (number > 1 and proved is None)))
            if level <= target or vain or (number and level <= hoped + _CLOSE):
                return best  # more points only raise what is hoped for, and in many states they take many seconds
            if number == 0 and hoped <= _FAR * target:
                fine = self._points(_FINE[self.n])
                points = points[0], fine[1], fine[2]
            if fine is not None and len(fine[0]):  # of many points, those that bind: each takes its time in the program
                height = self.programs.generated(exponents, coefficients, fine[0])
                binding = height >= np.quantile(height, 1 - _BINDING)
                points = np.concatenate([points[0], fine[0][binding]]), *points[1:]
                fine = fine[0][~binding], *fine[1:]
            points = tuple(np.concatenate([have, tight]) for have, tight in zip(points, worst))  # type: ignore[assignment]  # as many as before
        return best

    def steady(self, degree: int, found: Callable[[Barrier], object], level: float, worth: float = 1) -> Barrier | None:
        """The best barrier with an inflow that proves less than ``level``, a log10; ``found`` takes what it finds.

        It must hope for ``worth`` times that level, or the target.
        """
        exponents, horizon, best = self._exponents(degree), float(self.problem.horizon), None
        wanted = max(worth * level, math.log10(self.problem.delta))
        points, fine = self._points(_COARSE[self.n]), self._points(_FINE[self.n])[0]
        points, begun = (points[0], points[1], self._points(_FINE[self.n])[2]), None
        for number in range(1 + _ROUNDS):
            poll(f"a steady polynomial of degree {degree}, round {number + 1}")
            coefficients, hoped = self.programs.steadiest(exponents, points, begun)
            if coefficients is None or hoped > min(wanted, level) * _LOG10 - math.log(2):
                break
            proved, worst = self._certified(exponents, coefficients, steady=True)
            if proved is not None and proved.log10_probability(horizon) < level:
                best, level = proved, proved.log10_probability(horizon)
                found(best)
            if level <= math.log10(self.problem.delta) or (number > 0 and proved is None):
                break
            height = self.programs.generated(exponents, coefficients, fine)
            value = self.programs.monomials(exponents, fine[:, 1 : self.n + 1], ()) @ coefficients[:-1]
            height -= np.exp(np.clip(hoped - value - coefficients[-1], -_HIGHEST, _HIGHEST)) / horizon
            binding = height >= np.quantile(height, 1 - _BINDING / 2)
            points = np.concatenate([points[0], fine[binding]]), *points[1:]
            points = tuple(np.concatenate([have, tight]) for have, tight in zip(points, worst))  # type: ignore[assignment]  # as many as before
            fine, begun = fine[~binding], (coefficients, hoped)
        return best

    def _exponents(self, degree: int) -> Integers:
        powers = itertools.product(range(degree + 1), repeat=self.n)
        return np.array([power for power in powers if 0 < sum(power) <= degree])

    def _points(self, count: int) -> tuple[Array, Array, Array]:
        """Points (t, x, d) of the safe set, points x of the initial set, points x of the boundary."""
        axes = [np.linspace(a, b, count) for a, b in zip(self.hull.lo, self.hull.hi)]
        grid = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
        inside = self._gap(grid) <= 1e-12 * self.size
        shaped = inside.reshape([count] * self.n)
        boundary = [grid[inside & (self._gap(grid) >= -1e-9 * self.size)]]
        index = np.arange(len(grid)).reshape(shaped.shape)
        for axis in range(self.n):
            first, second = (np.take(index, range(k, count - 1 + k), axis=axis).ravel() for k in (0, 1))
            crossing = inside[first] != inside[second]
            a, b = first[crossing], second[crossing]
            safe, unsafe = grid[np.where(inside[a], a, b)], grid[np.where(inside[a], b, a)]
            for _ in range(30):
                middle = (safe + unsafe) / 2
                held = (self._gap(middle) <= 0)[:, None]
                safe, unsafe = np.where(held, middle, safe), np.where(held, unsafe, middle)
            boundary.append(safe)
        extra = [(a, b) if a < b else (a,) for a, b in zip(self.ranges.lo[self.n + 1 :], self.ranges.hi[self.n + 1 :])]
        times = (0.0, 0.5, 1.0) if self._uses_time() else (0.0,)
        signals = np.array([(t * self.problem.horizon, *d) for t in times for d in itertools.product(*extra)])
        states = np.repeat(grid[inside], len(signals), axis=0)
        signals = np.tile(signals, (int(inside.sum()), 1))
        inner = np.concatenate([signals[:, :1], states, signals[:, 1:]], axis=1)
        start = [np.linspace(a, b, 9 if a < b else 1) for a, b in zip(self.start.lo, self.start.hi)]
        initial = np.stack([axis.ravel() for axis in np.meshgrid(*start, indexing="ij")], axis=1)
        return inner, initial, np.concatenate(boundary)

    def _uses_time(self) -> bool:
        tapes = [self.problem.closed_loop]
        tapes += [self.system.diffusion] if isinstance(self.system.diffusion, Tape) else []
        return any(tape.inputs[0] == "t" and node.op == "input" and node.args[0] == 0
                   for tape in tapes for node in tape.nodes)  # fmt: skip

    def _gap(self, states: Array) -> Array:
        """The largest phi at points."""
        return np.asarray(np.max([gap.over(Interval.point(states)).mid for gap in self.gaps], axis=0))

    # ---- the proof -------------------------------------------------------------------------------------------

    def _certified(
        self, exponents: Integers, coefficients: Array, *, steady: bool = False
    ) -> tuple[Barrier | None, tuple[Array, Array, Array]]:
        """What holds for the polynomial (``steady``: with an inflow), if anything, and where its bounds are tight."""
        names = list(self.system.states)
        powers = np.vstack([exponents, np.zeros((1, self.n), dtype=np.int64)])

        def polynomial(x: Any) -> Any:
            total = 0.0
            for factor, power in zip(coefficients.tolist(), powers.tolist()):
                term = factor
                for i, exponent in enumerate(power):
                    if exponent:
                        term = term * ((x[i] - self.center[i]) / self.scale[i]) ** exponent
                total = total + term
            return total

        value = trace(polynomial, {"x": names})
        generator, horizon = self._generator(value), float(self.problem.horizon)
        start = self._supremum(value, self.start, 0, _anywhere, _TOLERANCE)
        negative = substitute(trace(lambda v: -v[0], {"v": ["v"]}), names, {"v": value})
        exit_ = self._supremum(negative, self.hull, 0, self._leaving, _TOLERANCE)
        share = _TOLERANCE / horizon * (math.exp(max(min(start.upper, 0.0), -_LOWEST)) if steady else 1.0)
        growth = self._supremum(generator, self.ranges, 1, self._safe, share, value if steady else None)
        if not (np.isfinite(growth.upper) or steady):  # V is finite everywhere: no other one would help
            raise EngineError(
                "the dynamics have no finite enclosure near ("
                + ", ".join(f"{x:.4g}" for x in growth.worst.mid[1 : self.n + 1])
                + "), a part of the safe set: they are undefined there, or jump."
            )
        points = growth.point[None], start.point[None], exit_.point[None]
        if not all(np.isfinite([growth.upper, start.upper, exit_.upper])):
            return None, points
        inflow = 0.0
        if steady:  # of exp(V - boundary)
            inflow = float((Interval.point(max(growth.upper, 0.0)) * exp(Interval.point(exit_.upper))).hi)
        found = Barrier(
            exponents=powers, coefficients=coefficients, center=self.center, scale=self.scale,
            start=start.upper, boundary=-exit_.upper, growth=0.0 if steady else growth.upper, inflow=inflow,
        )  # fmt: skip
        return found if found.log10_probability(horizon) < 0 else None, points

    def _generator(self, value: Tape) -> Tape:
        """grad V . f + 1/2 tr(g g^T Hess V) + 1/2 |g^T grad V|^2 over (t, states, disturbances)."""
        n, m = self.n, self.noises
        slope = jacobian(value)
        curvature = jacobian(slope)
        names = {"v": _named("v", n), "h": _named("h", n * n), "f": _named("f", n), "g": _named("g", n * m)}

        def expression(v: Any, h: Any, f: Any, g: Any) -> Any:
            total = sum(v[i] * f[i] for i in range(n))
            for j in range(m):
                column = [g[i * m + j] for i in range(n)]
                total = total + 0.5 * sum(column[i] * v[i] for i in range(n)) ** 2
                total = total + 0.5 * sum(column[i] * column[k] * h[i * n + k] for i in range(n) for k in range(n))
            return total

        replaced: dict[str, Any] = {name: (slope, i) for i, name in enumerate(names["v"])}
        replaced |= {name: (curvature, i) for i, name in enumerate(names["h"])}
        replaced |= {name: (self.problem.closed_loop, i) for i, name in enumerate(names["f"])}
        diffusion = self.system.diffusion
        for i, name in enumerate(names["g"]):
            replaced[name] = (diffusion, i) if isinstance(diffusion, Tape) else float(np.ravel(diffusion)[i])
        return substitute(trace(expression, names), self.problem.closed_loop.inputs, replaced)

    def _supremum(
        self, tape: Tape, box: Interval, first: int, keep: Callable[[Interval], Mask], tolerance: float,
        exponent: Tape | None = None,
    ) -> Any:  # fmt: skip
        """Bound a function over the part of a box that ``keep`` does not rule out; states begin at ``first``.

        With an ``exponent`` V of the states it is e^V times the function, whose sign is then decided without e^V.
        """
        factors = [tape]
        if exponent is not None:
            whole = trace(lambda v, g: np.exp(v[0]) * g[0], {"v": ["v"], "g": ["g"]})
            exponent = substitute(exponent, tape.inputs, {})
            factors = [substitute(whole, tape.inputs, {"v": exponent, "g": tape}), exponent, tape]
        slopes, function = [jacobian(factor) for factor in factors], compile_numpy(factors[0])

        def bound(boxes: Interval, _: float) -> tuple[Array, Array]:
            ranges, weights = zip(*(range_over(factor, slope, boxes) for factor, slope in zip(factors, slopes)))
            upper = ranges[0].hi
            if exponent is not None:
                with np.errstate(invalid="ignore", over="ignore"):
                    upper = np.fmin(upper, (exp(ranges[1]) * ranges[2]).hi)
            held = keep(boxes[:, first : first + self.n])
            return np.where(held, upper, -np.inf), weights[0]

        def value(points: Array) -> Array:
            with np.errstate(all="ignore"):
                found = function(*points.T)[:, 0]
            held = keep(Interval.point(points[:, first : first + self.n]))
            return np.where(held, found, np.nan)

        return bound_supremum(bound, value, box, tolerance=tolerance, budget=_BUDGET)

    def _safe(self, boxes: Interval) -> Mask:
        """Boxes that may meet the safe set."""
        return np.asarray(np.all([gap.over(boxes).lo <= 0 for gap in self.gaps], axis=0))

    def _leaving(self, boxes: Interval) -> Mask:
        """Boxes that may meet the safe set where some constraint is about to be broken."""
        gaps = [gap.over(boxes) for gap in self.gaps]
        near = np.any([gap.hi >= 0 for gap in gaps], axis=0)
        return np.asarray(np.all([gap.lo <= 0 for gap in gaps], axis=0) & near)


def _anywhere(boxes: Interval) -> Mask:
    return np.ones(len(boxes), dtype=bool)


def _named(letter: str, count: int) -> list[str]:
    return [f"{letter} {k}" for k in range(count)]
