"""Random starts with noise after them, or of models that are not linear: bounds from cells of the start, averaged.

X_0 = mean + gains z + e with z standard normal, e normal of covariance Sigma - gains gains' =: R, which is proved to be
positive definite, and both independent. From every z of a cell the linear response (Thm K7) bounds the probability of
failing, with e as part of its deviation: from above and from below. So do the cells' masses times these bounds of all.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertboundError, EngineError
from certbound.problem.jumps_as_plan import in_pieces
from certbound.problem.problem import Problem
from certbound.problem.sets import GaussianStart
from certbound.problem.systems import DiscreteSystem
from certbound.reach.below import least_failing_of
from certbound.reach.linear import Linearisation, depends_on_state, linear_answer
from certbound.reach.nominal import Cells
from certbound.reach.remainder import hidden_jump
from certbound.reach.starts.cell_masses import StartBounds, halved
from certbound.reach.starts.drawn_directions import FAR, StartDirections
from certbound.reach.starts.shared_response import SharedResponse, in_half_spaces
from certbound.reach.starts.silent import effects, unserved
from certbound.rigor.definite import is_positive_definite
from certbound.rigor.intervals import Interval
from certbound.watch import poll

_DIRECTIONS = 2  # that are cut into cells
_KEPT = 1e-3  # of the variance along them, that stays with the deviation: so that R is positive definite
_FIRST = 3.0  # deviations at which the first cells end
_TARGET = 0.1  # of delta: what a cell may cost without a closer look
_LARGEST = 0.3
_NOTHING = (1.0, 0.0)  # bounds that say nothing
_UP, _DOWN = 1 + 1e-12, 1 - 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class _Part:
    """A cell (d,), its mass from both sides, and the bounds that hold from each of its starts.

    It is ``lost`` where nothing is proved of it, nor of its middle or its start nearest to the mean alone.
    """

    low: Array
    high: Array
    mass: tuple[float, float]
    least: float
    most: float
    axis: int
    judged: bool = False
    lost: bool = False

    @property
    def gap(self) -> float:
        """What a closer look may gain."""
        return 0.0 if self.lost else self.mass[1] * (self.most - self.least)


class NoisyStart:
    """The cells of a start, and what is proved of them."""

    def __init__(self, problem: Problem) -> None:
        why = unserved(problem)
        problem = problem if why else in_pieces(problem)
        why = why or hidden_jump(problem)
        if why:
            raise EngineError(why)
        self.problem = problem
        seen = effects(problem, Linearisation.of(problem))
        self.gains, self.rest, self.error = _divided(problem, seen)
        self.weights = np.linalg.norm(seen @ self.gains, axis=0)  # of a deviation along each direction
        count = self.gains.shape[1]
        self.start = StartDirections(
            mean=np.asarray(problem.initial.mean), gains=self.gains, rest=np.zeros((len(self.gains), 0)), reach=0.0,
            slack=np.zeros(len(self.gains)), missed=0.0, distortion=0.0,
        )  # fmt: skip
        self.from_below = gaussian_noise(problem) and not problem.ending
        plain = bool(problem.safe) and in_half_spaces(problem) and gaussian_noise(problem)
        self.shared = SharedResponse(
            problem.replace(initial=GaussianStart(self.start.mean, self.rest)), self.start, self.error
        ) if plain else None  # fmt: skip
        edges = np.array([-FAR, -_FIRST, 0.0, _FIRST, FAR])
        corners = np.stack(np.meshgrid(*[np.arange(4)] * count, indexing="ij"), axis=-1).reshape(-1, count)
        self.parts = [self._untried(edges[corner], edges[corner + 1]) for corner in corners]

    def bounds(self) -> StartBounds:
        """What the cells prove together."""
        lower = math.fsum(part.mass[0] * part.least for part in self.parts) * _DOWN
        upper = math.fsum(part.mass[1] * part.most for part in self.parts) * _UP + self.start.beyond
        return StartBounds(lower=max(lower, 0.0), upper=min(upper, 1.0), cells=len(self.parts), shares=())

    def refine(
        self, most: int, enough: Callable[[StartBounds], bool], found: Callable[[StartBounds], object]
    ) -> StartBounds:
        """Look at the cells that may gain most, and halve them, until the bounds are enough, or there are ``most``."""
        while True:
            now = self.bounds()
            if enough(now) or len(self.parts) >= most:
                return now
            place = max(range(len(self.parts)), key=lambda k: self.parts[k].gap)
            part = self.parts[place]
            if part.gap <= 0:
                return now
            if not part.judged:
                self.parts[place] = self._judged(part)
            else:
                here = np.arange(len(part.low)) == part.axis
                cut = halved(part.low, part.high)
                sides = [self._untried(part.low, np.where(here, cut, part.high), part),
                         self._untried(np.where(here, cut, part.low), part.high, part)]  # fmt: skip
                self.parts[place : place + 1] = [self._judged(side) for side in sides]
            found(self.bounds())

    def _untried(self, low: Array, high: Array, before: _Part | None = None) -> _Part:
        least, most = self.start.mass(low[None], high[None])
        known = (0.0, 1.0) if before is None else (before.least, before.most)
        return _Part(low=low, high=high, mass=(float(least[0]), float(most[0])), least=known[0], most=known[1],
                     axis=int(np.argmax(high - low)))  # fmt: skip

    def _judged(self, part: _Part) -> _Part:
        """The cell with what is proved of it."""
        poll(f"a cell of the random start ({len(self.parts)})")
        middle = (part.low + part.high) / 2
        half = np.maximum(part.high - middle, middle - part.low) * (1 + 1e-15)
        lost = False
        if self.shared is not None and self.shared.serves:
            above, below = self.shared.above(middle, half), self.shared.below(middle, half) if self.from_below else 0.0
        else:
            above, below = self._alone(middle, half)
            nearest = np.clip(0.0, part.low, part.high)
            lost = (above, below) == _NOTHING and all(
                self._alone(point, 0 * half) == _NOTHING for point in (nearest, middle)
            )
        least, most = max(part.least, below), min(part.most, above)
        axis = int(np.argmax(half * self.weights))
        return replace(part, least=min(least, most), most=most, axis=axis, judged=True, lost=lost)

    def _alone(self, middle: Array, half: Array) -> tuple[float, float]:
        """Upper and lower bounds that hold from every start of a cell, by the linear response of its own."""
        centre = self.start.mean + self.gains @ middle
        slack = 1e-13 * (np.abs(self.start.mean) + np.abs(self.gains) @ (np.abs(middle) + half)) + 1e-290
        generators = np.concatenate([(self.gains * half).T, np.diag(slack)])
        reach = np.abs(generators).sum(axis=0) * (1 + 1e-12)
        boxes = Interval(centre - reach, centre + reach)
        cell = Cells(centres=centre[None], boxes=boxes[None], generators=generators[None], start_error=self.error)
        delta = min(max(_TARGET * float(self.problem.delta), 1e-12), _LARGEST)
        problem = self.problem.replace(initial=GaussianStart(centre, self.rest), delta=delta)
        above, below = 1.0, 0.0
        with contextlib.suppress(CertboundError, ArithmeticError):
            above = min(10.0 ** linear_answer(problem, cells=cell, thorough=False, quick=True).log10_delta * _UP, 1.0)
        if above > _TARGET / 10 and self.from_below:
            with contextlib.suppress(CertboundError, ArithmeticError):
                below = least_failing_of(problem, cell) * _DOWN
        return above, below


def gaussian_noise(problem: Problem) -> bool:
    """Whether noise is normal, and does not know the state."""
    system = problem.system
    return not depends_on_state(problem) and (not isinstance(system, DiscreteSystem) or system.noise.gaussian)


def _divided(problem: Problem, seen: Array) -> tuple[Array, Array, Array]:
    """Gains (n, d), the covariance R of what is left in floats, and an entrywise bound of its error.

    ``seen`` (m, n) are rows along which the constraints see the start.
    """
    start = problem.initial
    scale = np.sqrt(np.diag(start.covariance))
    unit = np.where(scale > 0, scale, 1.0)
    random = scale > 0
    values, vectors = np.linalg.eigh(start.covariance / unit[:, None] / unit)
    spread = unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    order = np.linalg.svd(seen @ spread, full_matrices=True)[2][:_DIRECTIONS].T
    gains = spread @ order * math.sqrt(1 - _KEPT)
    gains[~random] = 0.0
    point = Interval.point(gains)
    left = Interval.point(start.covariance) - point @ Interval.point(gains.T)
    rest = np.asarray(left.mid)
    rest = (rest + rest.T) / 2
    rest[~random] = rest[:, ~random] = 0.0
    inner = Interval(left.lo[np.ix_(random, random)], left.hi[np.ix_(random, random)])
    if not bool(np.all(is_positive_definite(inner / (unit[random][:, None] * unit[random])))):
        raise EngineError("cells of a random start with noise after it need a covariance that is not singular.")
    error = np.maximum(left.hi - rest, rest - left.lo) * (1 + 1e-12)
    error[~random] = error[:, ~random] = 0.0
    return gains, rest, error


def bound_noisy_start(
    problem: Problem, *, most: int, enough: Callable[[StartBounds], bool],
    found: Callable[[StartBounds], object] = lambda bounds: None,
) -> StartBounds:
    """Bounds of the probability of failing over a normal start, by the linear response from cells of it.

    Proves: lower <= P(some constraint is broken within the horizon) <= upper. Arguments: see `bound_silent_start`.

    Raises
    ------
    EngineError
        If something does not fit; the message says what.
    """
    return NoisyStart(problem).refine(most, enough, found)
