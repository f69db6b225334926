"""Answers of the linear-response engine: the least probability found, its reach tube and its deviation tube."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certbound.gaussian.response import level_along, level_scale, logsumexp
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem
from certbound.reach.linear import shares
from certbound.reach.linear.deviation_tube import DeviationTube
from certbound.reach.linear.diffusion import DiffusionRun, depends_on_state
from certbound.reach.linear.fit import fitted
from certbound.reach.linear.inclusion import Supports
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.run import LinearRun, Outcome
from certbound.reach.linear.shares import Share
from certbound.reach.nominal import Curve
from certbound.reach.sets import ReachTube, Requirement
from certbound.rigor.intervals import Interval

__all__ = ["LinearAnswer", "linear_answer", "linear_reach", "refusal"]

Array = NDArray[np.float64]

_REFINEMENTS = 3
_FEW = 20  # states up to which each has an event of its own in the deviation tube
_MANY = 20  # nonlinear coordinates beyond which a probability below the target is not refined
_NOTHING = -0.1  # log of a probability that says nothing
_PARTS = (2, 4, 8)  # cells along each side, tried one after the other
_NEAR = 3.5  # log of how many times the target one cell may prove for more cells to be tried
_MOST_PIECES = 4000  # pieces of time times cells
_LEAST = -1e12  # log10 of the smallest probability that is told apart from 0


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearAnswer:
    """Best certified probability of the engine, and what stands in the way of a smaller one.

    ``outcome`` holds the least probability found; ``shown`` the run whose tube fits the problem's own delta.
    """

    run: LinearRun
    outcome: Outcome
    shown: Outcome

    @property
    def log10_delta(self) -> float:
        """log10 of a bound on the probability of leaving the safe set: finite, at most 0."""
        value = max(self.outcome.log_probability / np.log(10.0), _LEAST)
        return float(min(value + 1e-15 * abs(value), 0.0))

    @property
    def exact(self) -> bool:
        """Whether the model is linear and its noise Gaussian: only the union over constraints and times is lost."""
        system = self.run.engine.system
        return not self.run.curved and (
            isinstance(system, ContinuousSystem) or bool(system.noise.gaussian)
        )

    @cached_property
    def _tightest(self) -> tuple[Requirement | None, int, float]:
        return self.run.tightest(self.shown)

    @property
    def margin(self) -> float:
        """Room left at the problem's delta, in the units of the tightest constraint.

        It is not negative where that delta is proved: the tube shares delta evenly between the constraints, the
        probability does not need to.
        """
        left = self._tightest[2]
        return max(left, 0.0) if self.log10_delta <= np.log10(self.run.engine.problem.delta) else left

    @property
    def time(self) -> float:
        """Where the room is least, or where the remainder begins to feed itself."""
        return float(self._tightest[1] * self.run.engine.step)

    @property
    def constraint(self) -> str | None:
        """The tightest requirement."""
        return None if self._tightest[0] is None else self._tightest[0].label

    @property
    def reason(self) -> str:
        """Why nothing smaller was proved, in words."""
        if self.outcome.bounds is None:
            what = "the remainder of the linearisation feeds itself"
            if self.run.engine.model.jumping:
                what = f"the dynamics may jump inside the tube, or {what},"
            return (
                f"{what} from t = {self.time:.4g} on; split the initial set (cells), shorten the horizon or lower "
                "the noise"
            )
        if self.margin == -np.inf:
            return f"no bound of the deviation was found that the room of '{self.constraint}' could be compared with"
        return f"the room of '{self.constraint}' at t = {self.time:.4g} is {self.margin:.4g}"

    @cached_property
    def tube(self) -> DeviationTube | None:
        """Deviation tube at the problem's delta (None when nothing was proved)."""
        bounds = self.shown.bounds
        return None if bounds is None else _deviation_tube(self.run, self.shown, bounds)

    def extent_along(self, direction: ArrayLike) -> Array:
        """Bounds of |a . (X_t - x_t)| over every piece for one direction a alone: shape (K,).

        They hold for all pieces at once with probability at least 1 - delta, the whole of delta spent on this direction
        and on the remainder; `tube` holds for all states at once.

        Raises
        ------
        ArithmeticError
            If the remainder feeds itself, or was bounded at the whole of delta or more only.
        """
        run, outcome, bounds = self.run, self.shown, self.shown.bounds
        left = run.engine.problem.delta - np.exp(outcome.nonlinear.log) * (1 + 1e-12)
        if bounds is None or left <= 0:
            raise ArithmeticError(self.reason)
        engine = run.engine
        count = engine.pieces if engine.continuous else engine.pieces + 1
        rows = np.broadcast_to(np.asarray(direction, dtype=float), (count, engine.n))
        share = Share.of(0.49 * left).log
        silent, result = _silent(run), np.zeros(count)
        _, events = run.levels(outcome.nonlinear)
        for cell in range(len(engine.centres)):
            event = events[cell].along(rows)
            level = level_along(event, share) if event.profile.max() > 0 else np.zeros(count)
            support = _coordinates(run, cell, rows)
            found = level + _apart(support, cell, bounds, silent)[:, 0]
            result = np.maximum(result, found * (1 + 1e-15))
        return result

    @cached_property
    def reach(self) -> ReachTube | None:
        """Sets that contain the state with probability at least 1 - delta (None when nothing was proved)."""
        bounds, tube = self.shown.bounds, self.tube
        if bounds is None or tube is None:
            return None
        return _reach_tube(self.run, bounds, tube.log10_delta, _levels_of_coordinates(self.run, self.shown)[0])

    @cached_property
    def noise_free_reach(self) -> ReachTube | None:
        """Sets that contain every associated trajectory (its remainder lies in the noisy one's set)."""
        bounds = self.shown.bounds
        return None if bounds is None else _reach_tube(self.run, bounds, -np.inf, None)


def refusal(problem: Problem) -> str | None:
    """Why the deviation's law does not follow from the plan alone, as synthesis needs it; None where it does."""
    if depends_on_state(problem):
        return "the noise depends on the state, and the linear response to it on the plan's own tube"
    return None


def linear_answer(
    problem: Problem, *, cells: int | None = None, thorough: bool = True, before: LinearAnswer | None = None
) -> LinearAnswer:
    """Bound the probability of leaving the safe set by the linear response (Thm K7').

    Parameters
    ----------
    problem : Problem
    cells : int, optional
        Cells along each side of the initial set; as few as serve when omitted.
    thorough : bool
        False: one cell when omitted, and no larger shares where nothing was proved.
    before : LinearAnswer, optional
        What was found for the same problem without ``thorough`` and ``cells``; it is not looked for again.
    """
    target = Share.of(problem.delta)
    run = _run(problem, cells=1 if cells is None else cells) if before is None else before.run
    best, effort = _best(run, target) if before is None else (before.outcome, shares.HOPED[-1][1])
    closes = best.bounds is not None
    near = best.log_probability < target.log + _NEAR and run.curved and not isinstance(run, DiffusionRun)
    if thorough and cells is None and best.log_probability > target.log and (near or not closes):
        for finer in _splits(problem, run):
            if _promising(finer, target) if closes else _tried(finer, target, shares.HOPED[0]).bounds is not None:
                other = _best(finer, target)
                if not closes or other[0].log_probability < best.log_probability:
                    run, (best, effort) = finer, other
                break
    if thorough and best.log_probability > _NOTHING and run.curved:
        for likelier in (share for share in map(Share.of, shares.LIKELIER) if target.log < share.log):
            best = _least(best, run.probability(likelier, 2))
            if best.bounds is not None:
                break
    shown = best
    above = best.log_probability - best.nonlinear.log
    if best.log_probability <= target.log and above > -3.0 and (above < 2.0 or run.curved):
        coupled = max((len(group[0]) for group in run.engine.model.blocks), default=1) > 1
        for _ in range(0 if coupled or len(run.engine.model.active) > _MANY else _REFINEMENTS):
            outcome = run.probability(Share(2 * best.nonlinear.log), effort)
            if outcome.log_probability >= best.log_probability:
                break
            best = outcome
    return LinearAnswer(run=run, outcome=best, shown=shown)


def _run(problem: Problem, *, cells: int | None, noise: bool = True) -> LinearRun:
    """The engine for the problem's noise."""
    engine = fitted(Linearisation.of(problem, cells=cells, noise=noise), Share.of(problem.delta * shares.FITTED))
    return DiffusionRun(engine) if noise and depends_on_state(problem) else LinearRun(engine)


def _best(run: LinearRun, target: Share) -> tuple[Outcome, int]:
    """The least probability over a few shares of the target for delta_N, and the last effort.

    Where a guess of the remainder tells which of them has a chance, only those are proved, and the last one if none.
    """
    guessed = run.curved and not isinstance(run, DiffusionRun)
    parts = shares.GUESSED if guessed else shares.HOPED if run.curved else shares.HOPED_LINEAR
    best: Outcome | None = None
    for hope in _hopes(run, target) if guessed else parts:
        found = _tried(run, target, hope)
        best = found if best is None else _least(best, found)
        if best.log_probability <= target.log or not (run.curved or run.engine.continuous):
            return best, hope[1]
    return best or _tried(run, target, parts[-1]), parts[-1][1]


def _tried(run: LinearRun, target: Share, hope: tuple[float, int]) -> Outcome:
    """What a part of the target proves, with its effort."""
    return run.probability(target.part(hope[0]), hope[1])


def _hopes(run: LinearRun, target: Share) -> Iterator[tuple[float, int]]:
    """The shares of the target with which a guess of the remainder says that it is within reach.

    Of all of them the last one has the least levels, and so the least remainder. Where the first has no chance, it is
    looked at next: if the noise takes more than the target with it as well, the others need no look.
    """
    for index, (share, effort) in enumerate(shares.GUESSED):
        if run.promise(target.part(share), effort, limit=target.log) <= target.log:
            yield share, effort
        elif index == 0 and not _within_reach(run, target):
            return


def _within_reach(run: LinearRun, target: Share) -> bool:
    """Whether the noise alone, next to the least remainder that is tried, may cost no more than the target."""
    share, effort = shares.GUESSED[-1]
    limit = target.log + float(np.log1p(share))
    return run.promise(target.part(share), effort, limit=limit) <= limit


def _splits(problem: Problem, run: LinearRun) -> Iterator[LinearRun]:
    """Engines on more and more cells of the initial set, as long as they are not too many."""
    wide = int(np.count_nonzero(run.engine.radii[0]))
    for parts in _PARTS if wide else ():
        if parts**wide * run.engine.pieces > _MOST_PIECES:
            return
        yield _run(problem, cells=parts)


def _promising(run: LinearRun, target: Share) -> bool:
    """Whether a guess of the remainder says that the target is within reach."""
    return _within_reach(run, target) and any(True for _ in _hopes(run, target))


def _least(first: Outcome, second: Outcome) -> Outcome:
    return second if second.log_probability < first.log_probability else first


def linear_reach(problem: Problem, *, noise: bool = True, cells: int | None = None) -> ReachTube:
    """Reach tube of the linear-response engine; with ``noise=False`` of the associated trajectories.

    Raises
    ------
    ArithmeticError
        If the remainder feeds itself before the horizon ends, or no bound of the noise along some state was found.
    """
    run = _run(problem, cells=cells, noise=noise)
    outcome = run.probability(Share.of(problem.delta / 2), 2 if noise else 1)
    if outcome.bounds is None:
        raise ArithmeticError(LinearAnswer(run=run, outcome=outcome, shown=outcome).reason)
    if noise:
        answer = LinearAnswer(run=run, outcome=outcome, shown=outcome)
        tube = answer.tube
        assert tube is not None
        for name, half in zip(problem.system.states, tube.half_widths.T, strict=True):
            if not np.all(np.isfinite(half)):
                raise ArithmeticError(
                    f"no bound of the deviation of {name} was found at delta = {problem.delta:.3g}; "
                    "shorten the horizon, or use method='contraction'."
                )
        reach = answer.reach
        assert reach is not None
        return reach
    return _reach_tube(run, outcome.bounds, -np.inf, None)


def _coordinates(run: LinearRun, cell: int, row: Array | None = None) -> Supports:
    """Supports along the coordinates over every piece, or along one row (K, n)."""
    engine = run.engine
    count = engine.pieces if engine.continuous else engine.pieces + 1
    rows = np.broadcast_to(np.eye(engine.n), (count, engine.n, engine.n)) if row is None else row[:, None]
    radii = engine.radii[cell]
    return Supports(
        engine.response, engine.gathering.of_cell(cell), cell, rows, np.diag(radii)[radii > 0],
        continuous=engine.continuous, outputs=engine.moved,
    )


def _levels_of_coordinates(run: LinearRun, outcome: Outcome) -> tuple[list[Array], float]:
    """Levels of |Z_i| over every piece, one array (K, n) a cell, and the log probability of the whole event."""
    engine = run.engine
    n, cells = engine.n, len(engine.centres)
    count = engine.pieces if engine.continuous else engine.pieces + 1
    active = [int(state) for state in engine.model.active]
    nonlinear = outcome.nonlinear if active else Share.of(engine.problem.delta / 10)
    levels, events = run.levels(nonlinear)
    left = engine.problem.delta - np.exp(nonlinear.log)
    again = n <= _FEW and left >= 0.5 * engine.problem.delta  # room for events of the active states alone
    rest = [i for i in range(n) if again or i not in active]
    budget = 0.99 * left if again else 0.5 * engine.problem.delta
    share = Share.of(budget / (2 * max(len(rest), 1))).log
    result, worst = [], -np.inf
    for cell in range(cells):
        values, logs = np.zeros((count, n)), [nonlinear.log]
        for i in range(n):
            event = events[cell].along(np.broadcast_to(np.eye(n)[i], (count, n)))
            own = np.full(count, np.inf)
            kept = levels[cell, :, active.index(i)] if i in active else own[:0]
            if event.profile.max() <= 0:
                own = np.zeros(count)
            elif i in rest:
                factor = level_scale(event, event.profile, share)
                own = np.where(event.profile > 0, factor, 0.0) * event.profile if np.isfinite(factor) else own
                logs.append(share + np.log(2.0))
            elif len(kept) < count:  # the last step does not enter the dynamics: an event of its own
                last = np.where(np.arange(count) == count - 1, event.profile, np.inf)
                own[-1] = level_scale(event, last, share) * event.profile[-1]
                logs.append(share + np.log(2.0))
            own[: len(kept)] = np.minimum(own[: len(kept)], kept)
            values[:, i] = own
        result.append(values * (1 + 1e-15))
        worst = max(worst, logsumexp(np.array(logs)))
    return result, worst


def _silent(run: LinearRun) -> tuple[Array, Array] | None:
    """Bounds of the remainder of the associated trajectory from a fixed start without disturbance: next to nothing."""
    engine = run.engine
    alone = not engine.radii.any() and not engine.d_radius.any() and run.curved
    return run.include(np.zeros(run.rows.shape[:3]), 1) if alone else None


def _apart(support: Supports, cell: int, bounds: tuple[Array, Array], silent: tuple[Array, Array] | None) -> Array:
    """How far the remainders of X and of x may be apart, along the rows of ``support`` over every piece.

    Both lie in R's set; where x has one of its own, that counts.
    """
    low, high, _ = support.remainder(bounds[0][cell], bounds[1][cell])
    wide = high - low
    if silent is not None:
        still = support.remainder(silent[0][cell], silent[1][cell])
        wide = np.minimum(wide, np.maximum(high - still[0], still[1] - low))
    return np.asarray(np.maximum(wide, 0.0) * (1 + 1e-15))


def _deviation_tube(run: LinearRun, outcome: Outcome, bounds: tuple[Array, Array]) -> DeviationTube:
    """|X - x|_i <= level of |Z_i| plus how far both remainders may be apart."""
    engine = run.engine
    silent = _silent(run)
    levels, log_probability = _levels_of_coordinates(run, outcome)
    half = np.zeros_like(levels[0])
    for cell, level in enumerate(levels):
        half = np.maximum(half, (level + _apart(_coordinates(run, cell), cell, bounds, silent)) * (1 + 1e-15))
    count = len(half)
    times = engine.times if engine.continuous else np.arange(count + 1.0)
    log10 = min(max(log_probability / np.log(10.0), _LEAST) * (1 - 1e-15), 0.0)
    return DeviationTube(times=times, half_widths=half, log10_delta=float(log10))


def _reach_tube(
    run: LinearRun, bounds: tuple[Array, Array], log10_delta: float, levels: list[Array] | None
) -> ReachTube:
    """Nominal curve plus a box around it on every piece."""
    engine = run.engine
    cells, n = engine.centres.shape
    boxes = []
    for cell in range(cells):
        support = _coordinates(run, cell)
        low, high, _ = support.remainder(bounds[0][cell], bounds[1][cell])
        level = 0.0 if levels is None else levels[cell]
        boxes.append((low - support.y - level, high + support.y + level))
    if engine.continuous:
        c = engine.controls
        h = engine.step
        exact = [Interval.point(c[:, :, i]) for i in range(4)]
        # Bezier points about the middle of the piece, s in [-h/2, h/2]
        powers = [
            (exact[0] + 3.0 * (exact[1] + exact[2]) + exact[3]) / 8.0,
            0.75 * (exact[3] + exact[2] - exact[1] - exact[0]) / h,
            1.5 * (exact[0] - exact[1] - exact[2] + exact[3]) / (h * h),
            (exact[3] - exact[0] + 3.0 * (exact[1] - exact[2])) / (h * h * h),
        ]
        coefficients = np.stack([p.mid for p in powers], axis=2)
        slack = sum(p.rad * (0.6 * h) ** j for j, p in enumerate(powers))
        # the pieces' ends are floats within a rounding of k h
        size = np.abs(coefficients)
        speed = size[:, :, 1] + 2 * h * size[:, :, 2] + h * h * size[:, :, 3]
        slack = np.asarray(slack) * (1 + 1e-12) + speed * 4e-15 * (1 + engine.times[-1])
        starts, ends = engine.times[:-1], engine.times[1:]
    else:
        coefficients = engine.nodes[:, :, None, :]
        slack = np.zeros((cells, engine.pieces + 1, n))
        starts = ends = np.arange(engine.pieces + 1.0)
    low = np.stack([b[0] for b in boxes]) - slack
    high = np.stack([b[1] for b in boxes]) + slack
    curve = Curve(continuous=engine.continuous, starts=starts, ends=ends, coefficients=coefficients)
    return ReachTube(
        curve=curve, box=Interval(np.nextafter(low, -np.inf), np.nextafter(high, np.inf)),
        noise=levels is not None, log10_delta=log10_delta, method="linear",
    )
