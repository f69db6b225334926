"""The door: an upper bound of the probability that a continuous-time problem with several states fails."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from certbound.arrays import Array
from certbound.display import rounded
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.quadratic.corners import Dynamics
from certbound.quadratic.inequality import Proved, corner_levels, prove
from certbound.quadratic.setting import Setting, Wall, make_setting, refuse
from certbound.quadratic.surroundings import working_box
from certbound.quadratic.wall_program import StatedCells, propose
from certbound.rigor.balls import precision, upper

_PIECES = 8
_MOST_STATES = 12
_LOOSE = 0.1  # remainder, in working boxes within the horizon, that is small
_FIRST_SLABS, _FEWER_SLABS, _SMALL_DIMENSION = 8, 4, 4  # at first, up to so many states and beyond
_MOST_BLOCKS = 12_000
_MARGINS = (4.0, 7.0, 2.5)
_GAIN = 0.03  # of a wall's logarithm: a refinement that gains less is not repeated
_DONE = 1e-3  # share of the bound that a wall may have without being looked at again
_SMALLEST = -300.0


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class QuadraticBound:
    """A certified upper bound of the probability of failing.

    Attributes
    ----------
    upper : float
        Its log10, for every start and every disturbance that does not see coming noise; 0 says nothing.
    words : str
        What was done.
    seconds : float
    setting : Setting or None
        Working box and walls.
    walls : tuple of Attempt
        What is proved at each wall.
    """

    upper: float
    words: str
    seconds: float
    setting: Setting | None = None
    walls: tuple[Attempt, ...] = ()


@dataclass(eq=False, kw_only=True, slots=True)
class Attempt:
    """The best bound of one wall so far, how finely it was found, and what refinements gained."""

    wall: Wall
    pieces: int = _PIECES
    slabs: tuple[int, ...] = ()
    proved: Proved | None = None
    corners: Array | None = None
    seconds: float = 0.0
    gains: dict[int, float] = field(default_factory=dict)
    held: tuple[int, ...] = ()
    large: tuple[int, ...] = ()

    @property
    def level(self) -> float:
        """Bound of log P for the worst start."""
        return 0.0 if self.proved is None else min(self.proved.level, 0.0)


def bound_quadratic(problem: Problem, *, target: float = 0.0, seconds: float = 20.0) -> QuadraticBound:
    """Bound P(failing within T) by Theorem K9: one time-varying quadratic value bound a wall of the safe set.

    Parameters
    ----------
    problem : Problem
        Continuous time; a smooth model; boxes, half-spaces, balls and obstacles for the whole horizon.
    target : float
        The refinement ends at a bound below this.
    seconds : float
        About what may be spent.

    Returns
    -------
    QuadraticBound

    Raises
    ------
    InfeasibleError
        The theorem, or this implementation of it, does not apply; the message says why.
    EnclosureError
        The model is undefined somewhere in the working box.

    Examples
    --------
    >>> import numpy as np, certbound as cb
    >>> system = cb.ContinuousSystem(lambda x: [x[1], -x[0] - x[1]], states=2, diffusion=[[0.1], [0.2]])
    >>> problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1)
    >>> bound_quadratic(problem, target=1e-3, seconds=5).upper < -3
    True
    """
    begin = time.perf_counter()
    n = problem.system.dimension
    if n > _MOST_STATES:
        raise InfeasibleError(f"quadratic value bounds serve at most {_MOST_STATES} states, the problem has {n}.")
    best: QuadraticBound | None = None
    chosen: Search | None = None
    failure: InfeasibleError | None = None
    refuse(problem)
    for low, high in _boxes(problem):
        left = begin + seconds - time.perf_counter()
        if best is not None and (left <= seconds / 2 or best.upper <= _log10(target)):
            break
        try:
            search = make_search(problem, low, high)
        except InfeasibleError as error:
            failure = error
            continue
        found = search.run(target, left / 2)
        if best is None or found.upper < best.upper:
            best, chosen = found, search
        if not search.complete:
            break
    if best is None or chosen is None:
        raise failure or InfeasibleError("no working box was found.")
    best = chosen.run(target, begin + seconds - time.perf_counter())
    return QuadraticBound(upper=best.upper, words=best.words, seconds=time.perf_counter() - begin,
                          setting=best.setting, walls=best.walls)  # fmt: skip


def _boxes(problem: Problem) -> list[tuple[Array, Array]]:
    """Different working boxes, in the order in which they are tried."""
    found: dict[bytes, tuple[Array, Array]] = {}
    for margin in _MARGINS:
        low, high = working_box(problem, margin)
        found.setdefault(low.tobytes() + high.tobytes(), (low, high))
    return list(found.values())


def make_search(problem: Problem, low: Array, high: Array) -> Search:
    """The search on the working box [low, high]; for errors see `bound_quadratic`."""
    return Search(problem, make_setting(problem, low, high))


class Search:
    """One working box: its walls, refined where the bound is made of."""

    def __init__(self, problem: Problem, setting: Setting) -> None:
        self.setting, self.horizon = setting, float(problem.horizon)
        self.dynamics = Dynamics(problem, setting)
        self.kept: dict[tuple[int, ...], list[StatedCells]] = {}
        self.gains: dict[int, float] = {}  # of more pieces, at the wall that had them last
        slabs = self._first_slabs()
        self.attempts = [Attempt(wall=wall, slabs=slabs) for wall in setting.walls]

    @property
    def complete(self) -> bool:
        """Whether every wall was tried."""
        return all(attempt.seconds > 0 for attempt in self.attempts)

    def _first_slabs(self) -> tuple[int, ...]:
        """Slabs that make the remainder small, as far as a few do: without them many a bound is 1."""
        held, n = self.dynamics.held, self.setting.dimension
        slabs = [1] * len(held)
        least, most = self.dynamics.remainder(*_grid(n, held, slabs)), _FIRST_SLABS
        if n > _SMALL_DIMENSION:
            most = _FEWER_SLABS
        while least > _LOOSE and math.prod(slabs) < most:
            trials = [[2 * count if k == axis else count for k, count in enumerate(slabs)] for axis in range(len(held))]
            values = [self.dynamics.remainder(*_grid(n, held, trial)) for trial in trials]
            if not values or min(values) > 0.9 * least:
                break
            slabs, least = trials[int(np.argmin(values))], min(values)
        return tuple(slabs)

    def run(self, target: float, share: float) -> QuadraticBound:
        """Bound every wall, then refine the one that counts most until the target or the time is reached."""
        until = time.perf_counter() + share
        for attempt in self.attempts:
            if attempt.seconds == 0.0 and time.perf_counter() < until:
                self._solve(attempt, attempt.pieces, attempt.slabs, until)
        while True:
            level, parts = total(self.attempts)
            if level / math.log(10) <= _log10(target) or time.perf_counter() > until:
                break
            if not self._refine(parts, level, until):
                break
        return self._answer(level)

    def _answer(self, level: float) -> QuadraticBound:
        finest = max(self.attempts, key=lambda attempt: attempt.pieces * math.prod(attempt.slabs), default=None)
        where = "" if finest is None else f", up to {finest.pieces} pieces of time"
        slabs = "" if finest is None or math.prod(finest.slabs) == 1 else f" and {math.prod(finest.slabs)} slabs"
        upper_ = log10_up(level)
        words = f"quadratic value bounds of {len(self.attempts)} walls{where}{slabs}"
        worst = max(self.attempts, key=lambda attempt: attempt.level, default=None)
        if worst is not None:
            words += f"; the largest part is {rounded(math.exp(worst.level), up=True)} ({worst.wall.label})"
        return QuadraticBound(upper=upper_, words=words, seconds=0.0, setting=self.setting, walls=tuple(self.attempts))

    def _refine(self, parts: Array, level: float, until: float) -> bool:
        """One refinement of the wall that counts most and may gain by it; False where none is left."""
        for place in np.argsort(-parts):
            if parts[place] < level + math.log(_DONE):
                return False
            attempt = self.attempts[place]
            hopes = {k: attempt.gains.get(k, self.gains.get(k, math.inf)) for k in range(-1, len(attempt.slabs))}
            sizes = {k: self._blocks(*_finer(attempt, k)) for k in hopes}
            grown = {k: 1.3 * sizes[k] / self._blocks(attempt.pieces, attempt.slabs) for k in hopes}
            left = until - time.perf_counter()
            options = [k for k in hopes if hopes[k] > _GAIN and sizes[k] <= _MOST_BLOCKS]
            options = [k for k in options if grown[k] * attempt.seconds < left]
            if not options:
                continue
            option = max(options, key=lambda k: hopes[k] / grown[k])
            before = attempt.level
            worked = self._solve(attempt, *_finer(attempt, option), until)
            attempt.gains[option] = before - attempt.level if worked else 0.0
            if option < 0:  # which coordinate's slabs help differs from wall to wall
                self.gains[option] = attempt.gains[option]
            return True
        return False

    def _blocks(self, pieces: int, slabs: tuple[int, ...]) -> int:
        return int(2 * pieces * math.prod(slabs) * 2 ** len(slabs))

    def cells(self, pieces: int, slabs: tuple[int, ...]) -> list[StatedCells]:
        """The cells of every piece of time."""
        key = (0 if self.dynamics.autonomous else pieces, *slabs)
        if key not in self.kept:
            low, high = _grid(self.setting.dimension, self.dynamics.held, slabs)
            times = _times(self.horizon, pieces)
            spans = [(0.0, self.horizon)] if self.dynamics.autonomous else list(itertools.pairwise(times))
            cells = [self.dynamics.over(low, high, *span) for span in spans]
            self.kept[key] = [StatedCells(self.setting, one) for one in cells]
        found = self.kept[key]
        return found * pieces if self.dynamics.autonomous else found

    def _solve(self, attempt: Attempt, pieces: int, slabs: tuple[int, ...], until: float) -> bool:
        """Try finer pieces or slabs and keep what is better; whether anything was gained."""
        begin = time.perf_counter()
        cells, times = self.cells(pieces, slabs), _times(self.horizon, pieces)
        left = max(until - begin, 1.0)
        proposal = propose(self.setting, attempt.wall, times, cells, seconds=left)
        proved = None
        if proposal is not None:
            proved = prove(self.setting, attempt.wall, proposal, [one.cells for one in cells])
        attempt.seconds = time.perf_counter() - begin
        if proved is None or not proved.level < attempt.level:
            return False
        attempt.proved, attempt.corners = proved, corner_levels(self.setting, proved)
        attempt.pieces, attempt.slabs = pieces, slabs
        attempt.held, attempt.large = cells[0].cells.held, cells[0].cells.large
        return True


def _finer(attempt: Attempt, option: int) -> tuple[int, tuple[int, ...]]:
    """Twice as many pieces (option -1), or twice as many slabs of a held coordinate, of which two are seldom enough."""
    if option < 0:
        return 2 * attempt.pieces, attempt.slabs
    factor = 4 if math.prod(attempt.slabs) == 1 and len(attempt.slabs) < 3 else 2
    return attempt.pieces, tuple(factor * count if k == option else count for k, count in enumerate(attempt.slabs))


def _times(horizon: float, pieces: int) -> Array:
    times = np.linspace(0.0, horizon, pieces + 1)
    times[-1] = horizon
    return times


def _grid(n: int, held: Sequence[int], slabs: Sequence[int]) -> tuple[Array, Array]:
    """Cells that cover [-1, 1]^n: slabs of the held coordinates."""
    cuts = [np.linspace(-1.0, 1.0, slabs[held.index(axis)] + 1 if axis in held else 2) for axis in range(n)]
    low = np.stack([axis.ravel() for axis in np.meshgrid(*(cut[:-1] for cut in cuts), indexing="ij")], axis=1)
    high = np.stack([axis.ravel() for axis in np.meshgrid(*(cut[1:] for cut in cuts), indexing="ij")], axis=1)
    return low, high


def total(attempts: Sequence[Attempt]) -> tuple[float, Array]:
    """log of the bound of P for the worst start, and what each wall contributes to it (logarithms).

    The sum over the walls of the worst corner, or of each wall's own worst start.
    """
    worst = np.array([attempt.level for attempt in attempts])
    if not len(attempts):
        return -math.inf, worst
    best = _log_sum(worst)
    if all(attempt.corners is not None for attempt in attempts):
        # as they are: cut off at the walls' own suprema they would no longer be the corners of convex functions
        table = np.array([attempt.corners for attempt in attempts])
        rough = table.max(axis=0) + np.log(np.exp(table - table.max(axis=0)).sum(axis=0))
        level = max(_log_sum(column) for column in table.T)
        if level < best:
            return level, table[:, int(np.argmax(rough))]
    return best, worst


def _log_sum(levels: Array) -> float:
    """Upper bound of log sum exp, at most 0."""
    from flint import arb

    with precision():
        found = sum((arb(float(level)).exp() for level in levels), arb(0))
        return min(0.0, upper(found.log()))


def _log10(target: float) -> float:
    return math.log10(max(target, 10**_SMALLEST))


def log10_up(level: float) -> float:
    """log10 of exp(level), rounded up, between -300 and 0."""
    value = max(level / math.log(10), _SMALLEST)
    return min(value + 1e-14 * abs(value) + 1e-15, 0.0)
