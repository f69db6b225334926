"""The door in discrete time: an upper bound of the probability that a problem with several states fails.

Every side of the working box, and every other wall, gets a convex quadratic V of its own, in a window of last steps;
the windows before are served by the same V, later. How long a window is best is tried out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from flint import arb

from certbound.arrays import Array, Integers
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.problem.problem import Problem
from certbound.problem.sets import check_start
from certbound.problem.systems import DiscreteSystem
from certbound.quadratic.setting import Setting, Wall, deviation_of, make_setting, refuse, safe_sides
from certbound.quadratic.steps.secants import secants
from certbound.quadratic.steps.step_program import Steps, propose_steps, turned
from certbound.quadratic.steps.step_proof import StepProof, prove_steps
from certbound.rigor.balls import precision, upper
from certbound.rigor.definite import eigenvalue_lower
from certbound.rigor.intervals import Interval, matmul
from certbound.rigor.rounding import quiet
from certbound.watch import poll

MOST_STATES = 12
_WINDOWS = (1, 8)
_MOST_WINDOWS = 4000
_EACH = 8, 24  # steps before a window with an H of their own
_SAME = 0.02  # of log10: what a bound may lose when it is turned to the opposite side
_GROWTH = 1.4  # of the pieces before these
_PATHS, _SEED = 200, 21
_BOXES = (7.0, True), (5.0, False), (4.0, False)
"""Standard deviations beyond sampled paths of the box's sides, and whether the safe set's sides stay as they are."""
_MOST_CORNERS = 8  # log2 of those of the starts
_INFLATED = 1e-12
_SMALLEST = -300.0  # log10 of what is told apart from 0


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class StepsBound:
    """A certified upper bound of the probability of failing in discrete time.

    Attributes
    ----------
    upper : float
        Its log10, for every start and every disturbance that does not see coming noise; 0 says nothing.
    words : str
        What was done.
    complete : bool
        Whether nothing is left to try.
    """

    upper: float = 0.0
    words: str = "no quadratic value bound was found"
    complete: bool = False


def bound_steps(
    problem: Problem, *, target: float = 0.0, seconds: float = 20.0,
    found: Callable[[StepsBound], object] = lambda bound: None,
) -> StepsBound:
    """Bound P(failing within T) in discrete time by Theorem K9: convex quadratic values, one a wall of the safe set.

    Parameters
    ----------
    problem : Problem
        Discrete time; noise of a variance proxy and a constant matrix; boxes, half-spaces, balls and obstacles for the
        whole horizon. The model may have kinks.
    target : float
        The search ends at a bound below this.
    seconds : float
        About what may be spent.
    found : callable
        Takes each better bound while the search goes on.

    Raises
    ------
    InfeasibleError
        The theorem, or this implementation of it, does not apply; the message says why.
    EnclosureError
        The model is undefined somewhere in the working box.

    Examples
    --------
    >>> import numpy as np, certbound as cb
    >>> system = cb.DiscreteSystem(lambda x: 0.5 * np.tanh(x), states=2, noise=cb.Uniform(halfwidth=0.2))
    >>> problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=50)
    >>> bound_steps(problem, target=1e-3, seconds=5).upper < -3
    True
    """
    n = problem.system.dimension
    if n > MOST_STATES:
        raise InfeasibleError(f"quadratic value bounds serve at most {MOST_STATES} states, the problem has {n}.")
    if not isinstance(problem.system, DiscreteSystem):
        raise InfeasibleError("these quadratic value bounds need discrete time; the problem is continuous.")
    if not problem.horizon <= _WINDOWS[-1] * _MOST_WINDOWS:
        raise InfeasibleError(f"these quadratic value bounds serve at most {_WINDOWS[-1] * _MOST_WINDOWS} steps.")
    refuse(problem)
    check_start(problem.initial, problem.safe, apart=True)
    until, best = time.perf_counter() + seconds, StepsBound()
    for setting in _settings(problem):
        given = _steps(problem, setting)
        for groups, window, each in _ways(setting.walls, given.horizon):
            if time.perf_counter() > until:
                return best
            steps, count = _knots(given.horizon, window, each), -(-given.horizon // window)
            level = _sum(_all_proved(given, groups, steps, window, until))
            if level < best.upper:
                many = f"{len(groups)} quadratic value bounds" if groups[1:] else "a quadratic value bound"
                words = f"{many} of {len(setting.walls)} walls, {count} windows of time"
                best = StepsBound(upper=level, words=words)
                found(best)
            if 10.0**best.upper <= target:
                return best
    return replace(best, complete=True)


def _ways(walls: tuple[Wall, ...], horizon: int) -> Iterator[tuple[list[tuple[Wall, ...]], int, int]]:
    """Which walls share a V, how long windows are, and how many steps before have an H of their own: cheap first."""
    windows = sorted({min(length, horizon) for length in _WINDOWS if length * _MOST_WINDOWS >= horizon})
    if len(walls) > 1:
        yield [walls], windows[0], _EACH[0]
    for each in _EACH:
        for window in windows:
            yield [(wall,) for wall in walls], window, each


def _all_proved(
    given: Steps, groups: Sequence[tuple[Wall, ...]], steps: Integers, window: int, until: float
) -> list[StepProof | None]:
    """The bounds of leaving through each group of walls, none where one of them has none.

    What was found at a side of the box is turned about the middle and tried at the opposite one first.
    """
    found: list[StepProof | None] = []
    sides: dict[tuple[int, int], StepProof] = {}
    for group in groups:
        side, proof = group[0].side if len(group) == 1 else None, None
        other = None if side is None else sides.get((side[0], 1 - side[1]))
        if other is not None:
            proof = prove_steps(given, group, turned(other.proposal), until)
            if not (np.isfinite(proof.excess) and _level([proof]) <= (1 - _SAME) * _level([other])):
                proof = None
        proof = _proved(given, group, steps, window, until) if proof is None else proof
        if proof is None:
            return [None]
        found.append(proof)
        if side is not None:
            sides[side] = proof
    return found


def _proved(given: Steps, walls: Sequence[Wall], steps: Integers, window: int, until: float) -> StepProof | None:
    """The bound of leaving through some walls."""
    poll("quadratic value bounds")
    left = until - time.perf_counter()
    if left <= 0:
        return None
    proposal = propose_steps(given, walls, steps, window, seconds=left)
    proof = None if proposal is None else prove_steps(given, walls, proposal, until)
    return proof if proof is not None and np.isfinite(proof.excess) else None


def _knots(horizon: int, window: int, each: int) -> Integers:
    """Steps between which H is linear: each of the last ones, and pieces before that grow."""
    found = list(range(horizon, max(horizon - window - each, -1), -1))
    length = 1.0
    while found[-1] > 0:
        length *= _GROWTH
        found.append(found[-1] - round(length) if found[-1] > 1.5 * length else 0)
    return np.array(found[::-1], dtype=np.int64)


def _sum(proofs: Sequence[StepProof | None]) -> float:
    known = [proof for proof in proofs if proof is not None]
    return _level(known) if len(known) == len(proofs) else 0.0


def _level(proofs: Sequence[StepProof]) -> float:
    """log10 of the sum at the worst corner of the starts: convex functions are largest at one."""
    with precision():
        corners = [sum(column, arb(0)) for column in zip(*(proof.at_corners() for proof in proofs))]
        worst = max(upper(value.log() / arb(10).log()) if value > 0 else 0.0 for value in corners)  # not so only of NaN
    return min(max(worst, _SMALLEST), 0.0)


def _steps(problem: Problem, setting: Setting) -> Steps:
    low, high = setting.start.low, setting.start.high
    wide = np.flatnonzero(low < high)
    if len(wide) > _MOST_CORNERS:
        raise InfeasibleError(f"the starts are wide in {len(wide)} states; at most {_MOST_CORNERS} are served.")
    corners = np.tile(low, (1 << len(wide), 1))
    for bit, axis in enumerate(wide):
        corners[(np.arange(len(corners)) >> bit) & 1 == 1, axis] = high[axis]
    ends = np.hstack([corners, np.ones((len(corners), 1))])
    return Steps(
        setting=setting, secants=secants(problem, setting, _middle(problem, setting)), noise=_columns(problem, setting),
        corners=Interval.point(ends), horizon=int(problem.horizon),
    )  # fmt: skip


def _middle(problem: Problem, setting: Setting) -> Array:
    """Where paths without noise come to, within the box."""
    step, box = compile_numpy(problem.closed_loop), problem.system.disturbance
    x = problem.initial.hull().mid
    d = np.zeros(0) if box is None else (np.asarray(box.low) + np.asarray(box.high)) / 2
    for t in range(min(int(problem.horizon), 500)):
        x = np.nan_to_num(np.ravel(step(float(t), *x, *d)))
        x = np.clip(x, setting.center - setting.width, setting.center + setting.width)
    return np.asarray(np.clip((x - setting.center) / setting.width, -0.9, 0.9))


def _columns(problem: Problem, setting: Setting) -> Array:
    """G with G G' no less than the covariance, or the proxy, of the noise in the box's coordinates."""
    assert isinstance(problem.system, DiscreteSystem)
    law, n = problem.system.noise, setting.dimension
    proxy = law.enclosed_covariance() if law.gaussian else Interval.point(np.asarray(law.proxy))
    gain = Interval.point(np.asarray(problem.system.noise_matrix)) / Interval.point(setting.width).reshape(-1, 1)
    wanted = matmul(gain, matmul(proxy, gain.T))
    used = np.any(np.asarray(law.proxy) != 0, axis=1)
    noisy = np.flatnonzero(np.any(np.asarray(problem.system.noise_matrix)[:, used] != 0, axis=1))  # others have none
    if not len(noisy):
        raise InfeasibleError("these quadratic value bounds need noise; the problem has none.")
    wanted = wanted[noisy][:, noisy]
    wanted = (wanted + wanted.T) * Interval.point(0.5)
    for inflated in (_INFLATED, 1e-9, 1e-6):
        values, vectors = np.linalg.eigh(wanted.mid * (1 + inflated) + inflated * np.diag(np.diag(wanted.mid)))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        have = matmul(Interval.point(root), Interval.point(root.T))
        if eigenvalue_lower(have - wanted) >= 0:
            columns = np.zeros((n + 1, len(noisy)))
            columns[noisy] = root
            return columns
    raise InfeasibleError("the covariance of the noise has no root that is proved.")


def _settings(problem: Problem) -> Iterator[Setting]:
    """Working boxes: the safe set's own sides and sides beyond sampled paths where it has none; then narrower ones."""
    low, high = safe_sides(problem)
    bottom, top, spread = _sampled(problem, low, high)
    for margin, free in _BOXES:
        reach = margin * spread + 0.05 * (top - bottom) + 1e-6 * (1 + np.abs(top))
        own = np.maximum(low, bottom - reach), np.minimum(high, top + reach)
        kept = np.where(np.isfinite(low), low, own[0]), np.where(np.isfinite(high), high, own[1])
        yield make_setting(problem, *(kept if free else own))


@quiet
def _sampled(problem: Problem, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Lowest and highest states on paths in the safe set, and the largest standard deviation of each state."""
    assert isinstance(problem.system, DiscreteSystem)
    rng, step, law = np.random.default_rng(_SEED), compile_numpy(problem.closed_loop), problem.system.noise
    x, box = problem.initial.sample(rng, _PATHS), problem.system.disturbance
    d = np.zeros((_PATHS, 0)) if box is None else np.where(rng.random((_PATHS, len(box.low))) < 0.5, box.low, box.high)
    values, vectors = np.linalg.eigh(np.asarray(law.proxy))
    root = np.asarray(problem.system.noise_matrix) @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    hull, spread = problem.initial.hull(), np.zeros(x.shape[1])
    bottom, top = np.array(hull.lo), np.array(hull.hi)
    for t in range(min(int(problem.horizon), 1000)):
        x = step(float(t), *x.T, *d.T) + rng.standard_normal((_PATHS, root.shape[1])) @ root.T
        x = np.clip(x, low, high)
        bottom, top = np.minimum(bottom, x.min(axis=0)), np.maximum(top, x.max(axis=0))
        spread = np.maximum(spread, deviation_of(x))
    return bottom, top, spread
