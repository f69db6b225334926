"""A problem with noise in one of two coordinates, as this room reads it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import Graph, Tape, compile_numpy, sources
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces, Inside, Quadratic, Region
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.intervals import Interval, sq, sqrt
from certbound.values.continuous import faces_of, starts_of
from certbound.values.semilagrangian.confines import Ends, Wall, parts_of

_PATHS, _STEPS = 400, 200
_BEYOND = 0.4  # of the simulated paths' extent, where nothing bounds a coordinate


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Setting:
    """dp = F(p, q) dt, dq = g(p, q) dt + s dW on the box of ``faces``, from the box of ``starts``.

    Attributes
    ----------
    tape : Tape
        (F, g) over ("t", "p", "q"), F free of t.
    noise : float
        s, up to the relative error ``spread``.
    faces, starts : (Ends, Ends)
        Of p and of q: a box within which the safe set lies (or within which its paths hardly stray), and a box around
        the starts.
    beyond : (Ends, Ends)
        Ends beyond which a state surely fails; infinite where ``faces`` only cuts off what hardly a path reaches.
    walls : tuple of Wall
        The rest of the safe set.
    region, order : Region, (int, int)
        The starts themselves, and which states p and q are.
    """

    tape: Tape
    noise: float
    spread: float
    faces: tuple[Ends, Ends]
    starts: tuple[Ends, Ends]
    horizon: float
    beyond: tuple[Ends, Ends] = ((-math.inf, math.inf), (-math.inf, math.inf))
    walls: tuple[Wall, ...] = ()
    region: Region | None = None
    order: tuple[int, int] = (0, 1)

    @property
    def timed(self) -> bool:
        """Whether the model changes with time."""
        return 0 in sources(self.tape)[1]

    def starts_between(self, low: float, high: float) -> Ends:
        """Ends of p among the starts with low <= q <= high, rounded outward; a ball's are narrower than its box's."""
        ends = self.starts[0]
        if self.region is None or not isinstance(self.region.form, Quadratic) or self.region.dimension != 2:
            return ends
        p, q = self.order
        matrix, center = self.region.form.matrix, self.region.center_at()
        if not matrix[q, q] > 0:
            return ends
        away = (low - center[q], high - center[q])
        nearest = max(away[0], -away[1], 0.0) * (1 - 1e-9)
        share = math.sqrt(max(1 - nearest**2 / matrix[q, q], 0.0) + 1e-9)
        across = matrix[p, p] - matrix[p, q] ** 2 / matrix[q, q] + 1e-14 * matrix[p, p]  # a difference of like numbers
        half = math.sqrt(max(across, 0.0)) * share * (1 + 1e-9)
        middle = sorted(center[p] + matrix[p, q] / matrix[q, q] * end for end in away)
        slack = 1e-12 * (1 + abs(center[p]) + half)
        return max(ends[0], middle[0] - half - slack), min(ends[1], middle[1] + half + slack)

    def some_starts(self) -> Array:
        """A few of the starts as (p, q), shape (N, 2): corners of a box, points near the rim of a ball, the middle."""
        middle = np.array([(low + high) / 2 for low, high in self.starts])
        half = np.array([(high - low) / 2 for low, high in self.starts])
        if self.region is None or not isinstance(self.region.form, Quadratic):
            signs = np.array([(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)])
            return np.asarray(np.clip(middle + signs * half, middle - half, middle + half))
        turn = np.linspace(0, 2 * np.pi, 17)
        root = np.linalg.cholesky(self.region.form.matrix + 1e-300 * np.eye(2))
        rim = self.region.center_at() + (1 - 1e-9) * np.stack([np.cos(turn), np.sin(turn)], axis=1) @ root.T
        points = np.concatenate([self.region.center_at()[None], rim])[:, list(self.order)]
        ball = Wall(region=self.region, outside=False, order=self.order)
        sizes = ball.sizes(*(Interval.point(ends) for ends in points.T))
        return np.asarray(points[sizes.hi.max(axis=1) <= 0])  # the rim is in floats: what is kept surely is a start


def serves(problem: Problem) -> bool:
    """Whether a problem has two or three states in continuous time, and noise that surely moves one of them only."""
    system = problem.system
    if not isinstance(system, ContinuousSystem) or system.dimension not in (2, 3) or isinstance(system.diffusion, Tape):
        return False
    moved = np.any(np.asarray(system.diffusion) != 0, axis=1)
    return int(moved.sum()) == 1


def setting_of(problem: Problem) -> Setting:
    """Read a problem.

    Raises
    ------
    InfeasibleError
        Disturbances, time in the drift of the noise-free state, windows, moving sets; the message says which.
    """
    system = problem.system
    if not serves(problem) or not isinstance(system, ContinuousSystem) or system.dimension != 2:
        raise InfeasibleError("steps along the flow serve two states with constant noise in one of them.")
    if system.disturbance is not None or problem.input_sequence is not None:
        raise InfeasibleError(
            "value functions with noise in one coordinate serve neither disturbances nor plans yet; "
            "value functions prove nothing here."
        )
    gain = np.asarray(system.diffusion, dtype=float)
    noisy = int(np.flatnonzero(np.any(gain != 0, axis=1))[0])
    order = (1 - noisy, noisy)
    tape = reordered(problem.closed_loop, order)
    if 0 in sources(tape)[0]:
        raise InfeasibleError(
            "value functions with noise in one coordinate let time act on that coordinate only, and "
            f"`{system.states[order[0]]}` changes with it; value functions prove nothing here."
        )
    size = sqrt(sq(Interval.point(gain[noisy])).sum(axis=-1))
    starts = starts_of(problem)
    bounds, beyond, walls = _limits(problem, order)
    if 0 in sources(tape)[1] and any(wall.ends() is not None for wall in walls):
        raise InfeasibleError(
            "value functions with noise in one coordinate do not take obstacles beside a model that changes with time "
            "yet; value functions prove nothing here."
        )
    ends = (starts[order[0]], starts[order[1]])
    noise = float(size.mid)
    faces = _closed(tape, noise, bounds, walls, ends, float(problem.horizon))
    return Setting(
        tape=tape, noise=noise, spread=float(size.rad / size.mid) + 1e-15, faces=faces, starts=ends,
        horizon=float(problem.horizon), beyond=beyond, walls=walls, region=problem.initial, order=order,
    )  # fmt: skip


def _limits(problem: Problem, order: tuple[int, int]) -> tuple[list[Ends], tuple[Ends, Ends], tuple[Wall, ...]]:
    """Limits of p and q along the coordinates, rounded inward and outward, and the walls.

    Raises
    ------
    InfeasibleError
        Windows, moving sets, balls in one coordinate.
    """
    inner, outer = ([[-math.inf, math.inf], [-math.inf, math.inf]] for _ in range(2))
    walls = []
    for constraint in problem.constraints:
        if constraint.region.moving or constraint.during not in (None, (0.0, float(problem.horizon))):
            raise InfeasibleError(
                "value functions with noise in one coordinate serve neither moving sets nor windows yet "
                f"('{constraint.label}')."
            )
        for region, outside in parts_of(constraint.region, outside=constraint.outside):
            form = region.form
            if isinstance(form, Quadratic) and region.dimension != 2:
                raise InfeasibleError(f"write '{constraint.label}' as a box: it is an interval of one coordinate.")
            if outside or isinstance(form, Quadratic) or np.any(np.count_nonzero(form.normals, axis=1) != 1):
                walls.append(Wall(region=region, outside=outside, order=order))
                continue
            for state, side, near, far in _ends(region, constraint.label):
                place, pick = order.index(state), (max, min)[side]
                inner[place][side] = pick(inner[place][side], near)
                outer[place][side] = pick(outer[place][side], far)
    ends = [(row[0], row[1]) for row in outer]
    return [(row[0], row[1]) for row in inner], (ends[0], ends[1]), tuple(walls)


def _ends(region: Region, label: str) -> list[tuple[int, int, float, float]]:
    """(state, side, inner place, outer place) of faces along the coordinates; exact where a normal is 1 or -1."""
    form = region.form
    if isinstance(form, Faces) and not np.any(region.center_at()) and np.all(np.abs(form.normals).sum(axis=1) == 1):
        rows = region.lifted(form.normals, 2)
        return [
            (int(np.argmax(np.abs(row))), int(row.sum() > 0), *2 * (float(bound * row.sum()),))
            for row, bound in zip(rows, form.bounds)
        ]
    return faces_of(Inside(region, label=label))


def _closed(
    tape: Tape, noise: float, bounds: list[Ends], walls: tuple[Wall, ...], starts: tuple[Ends, Ends], horizon: float
) -> tuple[Ends, Ends]:
    """A bounded box: the limits, ends of sets to stay in, or else places far beyond simulated paths."""
    lows, highs = [row[0] for row in bounds], [row[1] for row in bounds]
    for wall in walls:
        if wall.outside:
            continue
        for place, state in enumerate(wall.order):
            axis = np.eye(2)[state]
            low, high = -float(wall.region.support(-axis)), float(wall.region.support(axis))
            more = 1e-9 * (1 + abs(low) + abs(high)) if math.isfinite(low + high) else 0.0
            lows[place], highs[place] = max(lows[place], low - more), min(highs[place], high + more)
    if not np.isfinite([*lows, *highs]).all():
        least, most = _reach(tape, noise, starts, horizon, np.array([lows, highs]))
        lows = [low if math.isfinite(low) else end for low, end in zip(lows, least)]
        highs = [high if math.isfinite(high) else end for high, end in zip(highs, most)]
    if not all(low < high for low, high in zip(lows, highs)):
        raise InfeasibleError("the safe set has no interior.")
    return (lows[0], highs[0]), (lows[1], highs[1])


def _reach(
    tape: Tape, noise: float, starts: tuple[Ends, Ends], horizon: float, ends: Array
) -> tuple[list[float], list[float]]:
    """Ends of a box that hardly a path leaves, from simulated ones; any box will do, since leaving it counts.

    Paths stop where they leave ``ends``, shape (2, 2), lows and highs: what has failed may run away.
    """
    rng, drift = np.random.default_rng(0), compile_numpy(tape)
    x = np.array([rng.uniform(*places, _PATHS) for places in starts])
    least, most = x.min(axis=1), x.max(axis=1)
    step = horizon / _STEPS
    for k in range(_STEPS):
        with np.errstate(all="ignore"):
            f = np.moveaxis(np.broadcast_to(drift(k * step, *x), (_PATHS, 2)), -1, 0)
        moved = x + step * f
        moved[1] += noise * math.sqrt(step) * rng.standard_normal(_PATHS)
        inside = np.all((x >= ends[0][:, None]) & (x <= ends[1][:, None]) & np.isfinite(moved), axis=0)
        x = np.where(inside, moved, x)
        least, most = np.minimum(least, x.min(axis=1)), np.maximum(most, x.max(axis=1))
    more = _BEYOND * (most - least)
    return (least - more).tolist(), (most + more).tolist()


def reordered(tape: Tape, order: tuple[int, ...]) -> Tape:
    """The drift over time and the states in an order."""
    graph = Graph(("t", *(f"y{place}" for place in range(len(order)))))
    slots = [0] * (len(order) + 1)
    for place, state in enumerate(order):
        slots[1 + state] = 1 + place
    outputs = tape.evaluate(graph.arithmetic(), [graph.input(slot) for slot in slots])
    return graph.tape([outputs[state] for state in order], (len(order),))
