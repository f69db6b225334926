"""Monte Carlo of its own, in the draft's units: nothing of certbound runs here but the limits of Clopper and Pearson.

Starts are corners and random points of the initial set, disturbances are constant vertices and laws that push along a
direction; the worst pair of a pilot run is simulated afresh, so that the choice biases nothing. In continuous time a
step is the drift's flow by Runge and Kutta, which neither damps nor drives a light oscillator, and then noise; between
two steps exits are looked for by Brownian bridges. A contradiction counts only where finer grids confirm it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certbound.simulation.estimates.statistics import bound_binomial
from tests.fuzz.bridges import touched
from tests.fuzz.drafts import Draft, Shape, Wall

__all__ = ["CONFIDENCE", "Count", "Policy", "exits", "follow", "lower_limit", "starts", "worst_case"]

Array = NDArray[np.float64]
Signal = Callable[[float, Array], Array]

CONFIDENCE = 1.0 - 2e-6
"""Each limit misses the truth with chance 1e-6."""
STEPS = 128
EDGE = 1e-9
"""Share of a wall's numbers by which a path must be beyond it."""
CORNERS = 32


@dataclass(frozen=True)
class Policy:
    """A disturbance: a constant, or the end of the box towards which a direction of the state points."""

    low: Array
    high: Array
    constant: Array | None = None
    direction: Array | None = None
    center: Array | None = None

    def __call__(self, t: float, x: Array) -> Array:
        if self.constant is not None:
            return np.broadcast_to(self.constant, (len(x), len(self.low)))
        push = (x - self.center) @ self.direction.T > 0  # type: ignore[union-attr, operator]
        return np.where(push, self.high, self.low)


@dataclass(frozen=True)
class Count:
    """Exits of one start under one policy."""

    paths: int
    exits: int
    start: Array | None
    steps: int

    @property
    def lower(self) -> float:
        """Lower limit of the probability at `CONFIDENCE`, one-sided."""
        return lower_limit(self.exits, self.paths)


def lower_limit(hits: int, paths: int) -> float:
    """Clopper-Pearson, one-sided: missed with chance 1e-6."""
    return float(bound_binomial(hits, paths, CONFIDENCE)[0])


def policies(draft: Draft, rng: np.random.Generator) -> list[Policy | None]:
    """None for a draft without disturbance."""
    if draft.disturbance is None:
        return [None]
    low, high = draft.disturbance
    corners = [np.array(c) for c in itertools.product(*zip(low, high))][:4]
    found: list[Policy | None] = [Policy(low, high, constant=corner) for corner in corners]
    if draft.constant:
        return [*found, Policy(low, high, constant=0.5 * (low + high))]
    center = starts(draft, rng, 1)[0]
    for _ in range(3):
        direction = rng.standard_normal((len(low), draft.dimension))
        found.append(Policy(low, high, direction=direction, center=center))
    return found


def starts(draft: Draft, rng: np.random.Generator, count: int) -> Array:
    """The centre, corners (or points of the surface), and random points of the initial set."""
    points = _points(draft, rng, count)
    return points + np.array(draft.shifts)[np.arange(count) % len(draft.shifts)] if draft.shifts else points


def _points(draft: Draft, rng: np.random.Generator, count: int) -> Array:
    kind, first, second = draft.start
    n = draft.dimension
    if kind == "gaussian":
        values, vectors = np.linalg.eigh(second)
        return first + rng.standard_normal((count, n)) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    if kind == "box":
        signs = np.array(list(itertools.islice(itertools.product((0.0, 1.0), repeat=n), CORNERS)))
        signs = np.vstack([np.full((1, n), 0.5), signs, rng.uniform(size=(max(count - len(signs) - 1, 0), n))])[:count]
        return first + signs * (second - first)
    ball = rng.standard_normal((count, n))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    ball[0] = 0.0
    factor = second * np.eye(n) if kind == "ball" else np.linalg.cholesky(second)
    return first + (1.0 - 1e-12) * ball @ factor.T


def variates(draft: Draft, rng: np.random.Generator, count: int) -> Array:
    """Draws of G w: of the law, or of one that its class allows."""
    noise = draft.noise
    if noise is None:
        return np.zeros((count, draft.dimension))
    m = draft.dimension if noise.matrix is None else noise.matrix.shape[1]
    value = np.asarray(noise.value, dtype=float)
    if noise.level.endswith("covariance"):
        values, vectors = np.linalg.eigh(value)
        w = rng.standard_normal((count, m)) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    elif noise.law in ("gaussian", "subgaussian"):
        w = rng.standard_normal((count, m)) * (np.sqrt(value) if noise.level.endswith("variance") else value)
    elif noise.law == "uniform":
        w = rng.uniform(-1.0, 1.0, (count, m)) * value
    elif noise.law == "triangular":
        w = rng.triangular(-1.0, 0.0, 1.0, (count, m)) * value
    elif noise.law == "laplace":
        w = rng.laplace(size=(count, m)) * value
    elif noise.table is not None:
        places, weights = noise.table
        chosen = rng.choice(len(weights), size=(count, m), p=weights)
        w = places[chosen] if noise.law == "discrete" else rng.uniform(places[chosen], places[chosen + 1])
        w = w * value
    else:
        signs = 2.0 * rng.integers(0, 2, (count, m)) - 1.0
        w = (signs if noise.independent else np.broadcast_to(signs[:, :1], signs.shape)) * value
    return w if noise.matrix is None else w @ noise.matrix.T


class _Model:
    """The draft as functions of (t, x, u, d) with x of shape (paths, n)."""

    def __init__(self, draft: Draft, policy: Signal | None) -> None:
        self.draft, self.policy = draft, policy
        self.row = 0  # of a plan that is an array

    def names(self, t: float, x: Array) -> dict[str, Any]:
        draft = self.draft
        names: dict[str, Any] = {"t": t} | {f"x{k}": x[:, k] for k in range(x.shape[1])}
        if isinstance(draft.plan, np.ndarray):
            names |= {f"u{k}": value for k, value in enumerate(draft.plan[self.row])}
        elif draft.plan is not None:
            names |= {f"u{k}": row.value(names) for k, row in enumerate(draft.plan)}
        if self.policy is not None:
            d = self.policy(t, x)
            names |= {f"d{k}": d[:, k] for k in range(d.shape[1])}
        return names

    def drift(self, t: float, x: Array) -> Array:
        names = self.names(t, x)
        return np.stack([np.broadcast_to(row.value(names), len(x)) for row in self.draft.dynamics], axis=1)

    def diffusion(self, t: float, x: Array) -> Array:
        """g(t, x), shape (paths, n, columns)."""
        names = self.names(t, x)
        rows = [
            np.stack([np.broadcast_to(np.asarray(entry.value(names), dtype=float), len(x)) for entry in row], axis=1)
            for row in self.draft.diffusion
        ]
        return np.stack(rows, axis=1)

    def spread(self, t: float, x: Array, z: Array) -> Array:
        """g(t, x) z."""
        return np.asarray(np.einsum("pnc,pc->pn", self.diffusion(t, x), z))


def follow(
    draft: Draft,
    start: Array,
    rng: np.random.Generator,
    *,
    steps: int = STEPS,
    policy: Signal | None = None,
    noise: bool = True,
) -> Iterator[tuple[float, Array]]:
    """Times and states, shape (paths, n), step by step; the drift by the classical Runge-Kutta scheme."""
    model, x = _Model(draft, policy), np.array(start, dtype=float)
    yield 0.0, x
    if not draft.continuous:
        for k in range(int(draft.horizon)):
            model.row = k
            x = model.drift(float(k), x) + (variates(draft, rng, len(x)) if noise else 0.0)
            yield float(k + 1), x
        return
    pieces = len(draft.plan) if isinstance(draft.plan, np.ndarray) else 1
    steps = -(-steps // pieces) * pieces
    h = draft.horizon / steps
    columns = len(draft.diffusion[0]) if draft.diffusion else 0
    for k in range(steps):
        t, model.row = k * h, k * pieces // steps
        moved = _runge_kutta(model, t, x, h)
        if noise and columns:
            moved = moved + model.spread(t, x, rng.standard_normal((len(x), columns)) * np.sqrt(h))
        x = moved
        yield (k + 1) * h, x


def _runge_kutta(model: _Model, t: float, x: Array, h: float) -> Array:
    a = model.drift(t, x)
    b = model.drift(t + h / 2, x + h / 2 * a)
    c = model.drift(t + h / 2, x + h / 2 * b)
    d = model.drift(t + h, x + h * c)
    return x + h / 6 * (a + 2 * b + 2 * c + d)


def broken(wall: Wall, t: float, x: Array, horizon: float) -> NDArray[np.bool_]:
    """Which states surely break the wall at time t."""
    if wall.during is not None and not wall.during[0] - 1e-9 * horizon <= t <= wall.during[1] + 1e-9 * horizon:
        return np.zeros(len(x), dtype=bool)
    if wall.inside:
        return ~wall.shape.contains(x, t, EDGE)
    return wall.shape.contains(x, t, -EDGE)


def arrived(target: Wall, t: float, x: Array, horizon: float) -> NDArray[np.bool_]:
    """Which states may be in the target at time t."""
    first, last = (0.0, horizon) if target.during is None else target.during
    if not first - 1e-9 * horizon <= t <= last + 1e-9 * horizon:
        return np.zeros(len(x), dtype=bool)
    return target.shape.contains(x, t, EDGE)


class _Between:
    """What happens between two times of the grid: by bridges, where there is noise in continuous time."""

    def __init__(self, draft: Draft, policy: Signal | None, noise: bool, rng: np.random.Generator) -> None:
        self.draft, self.rng = draft, rng
        self.model = _Model(draft, policy) if draft.continuous and noise and draft.diffusion else None
        self.ends: tuple[float, Array, float, Array] | None = None
        self.noise: Array = np.zeros(0)

    def step(self, t: float, x: Array) -> None:
        """Go on to a state, of which a copy is kept."""
        if self.model is None:
            return
        last = (t, x) if self.ends is None else self.ends[2:]
        self.ends = (*last, t, x.copy())
        self.noise = self.model.diffusion(*last) * np.sqrt(max(t - last[0], 0.0))

    def touches(self, shape: Shape, inside: bool, during: tuple[float, float] | None, slack: float) -> Any:
        """Which paths leave a set, or meet it, in between; nobody where it does not hold all the while."""
        if self.model is None or self.ends is None or self.ends[0] == self.ends[2]:
            return False
        edge = 1e-9 * self.draft.horizon
        if during is not None and not (during[0] - edge <= self.ends[0] and self.ends[2] <= during[1] + edge):
            return False
        return touched(shape, inside, self.ends, self.noise, slack, self.rng)


def exits(
    draft: Draft, start: Array, rng: np.random.Generator, *, steps: int, policy: Signal | None, noise: bool = True
) -> NDArray[np.bool_]:
    """Which paths break a wall, or leave the domain; with a target, before they are in it, or are never in it."""
    gone, there = np.zeros((2, len(start)), dtype=bool)
    domain, target, finite = draft.domain, draft.target, np.ones(len(start), dtype=bool)
    walls = list(draft.walls) + ([] if domain is None else [Wall(shape=Shape(kind="box", data=domain))])
    between = _Between(draft, policy, noise, rng)
    with np.errstate(all="ignore"):
        for t, x in follow(draft, start, rng, steps=steps, policy=policy, noise=noise):
            between.step(t, x)
            finite &= np.all(np.isfinite(x), axis=1)
            for wall in walls:  # between two steps first: who has arrived by the end may have failed before
                gone |= finite & ~there & between.touches(wall.shape, wall.inside, wall.during, EDGE)
            if target is not None:
                there |= finite & ~gone & between.touches(target.shape, False, target.during, -EDGE)
                there |= ~gone & arrived(target, t, x, draft.horizon)
            usable = finite & ~there
            for wall in draft.walls:
                gone |= usable & broken(wall, t, x, draft.horizon)
            if domain is not None:
                gone |= usable & np.any((x < domain[0]) | (x > domain[1]), axis=1)
            if np.any(gone):
                x[gone] = start[gone]  # in place: a path that left goes on where it can do no harm
    return gone if target is None else gone | (finite & ~there)


def worst_case(draft: Draft, rng: np.random.Generator, *, paths: int, pilot: int = 1000) -> tuple[Count, Policy | None]:
    """The start and the policy of most exits in a pilot run, simulated afresh."""
    points = starts(draft, rng, 24)
    random = draft.start[0] == "gaussian"
    best: tuple[int, Array | None, Policy | None] = (-1, None, None)
    for policy in policies(draft, rng):
        owner = np.arange(pilot) % len(points)
        initial = starts(draft, rng, pilot) if random else points[owner]
        left = exits(draft, initial, rng, steps=STEPS // 2, policy=policy)
        score = int(left.sum()) if random else int(np.bincount(owner, left, len(points)).max())
        if score > best[0]:
            place = None if random else points[int(np.argmax(np.bincount(owner, left, len(points))))]
            best = score, place, policy
    return recount(draft, best[1], best[2], rng, paths=paths, steps=STEPS), best[2]


def recount(
    draft: Draft, point: Array | None, policy: Signal | None, rng: np.random.Generator, *, paths: int, steps: int
) -> Count:
    """Exits from one start (None: random starts) under one policy."""
    initial = starts(draft, rng, paths) if point is None else np.tile(point, (paths, 1))
    left = exits(draft, initial, rng, steps=steps, policy=policy)
    return Count(paths, int(left.sum()), point, steps if draft.continuous else int(draft.horizon))
