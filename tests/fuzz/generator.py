"""A random legal problem from a seed: a model, and around it noise, a start, constraints, inputs and units.

Constraints are drawn around a few simulated paths, so that exits are neither certain nor out of the question.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import certbound as cb
from tests.fuzz.drafts import Draft, Noise, Shape, Units, Wall
from tests.fuzz.formulas import JUMPS, KINKS, Formula, apply, number, symbol
from tests.fuzz.oracle import Policy, follow, starts
from tests.fuzz.sketches import Sketch, between, compared, log_uniform, sketch, sketch_of

__all__ = ["draw"]

Array = NDArray[np.float64]
Random = np.random.Generator

PILOT, PILOT_STEPS = 200, 40
LARGEST = 1e3
"""Size beyond which a pilot run has exploded, and the horizon is cut."""
TRIES = 40
_MISPLACED = ("`initial` must satisfy every constraint", "`reach` must meet the safe set")


def draw(seed: int) -> tuple[Draft, cb.Problem]:
    """The draft of a seed, and its problem; what certbound refuses at the start is drawn again.

    Raises
    ------
    ValueError
        If certbound refuses a draft for another reason than a start outside its constraints.
    """
    refusal: ValueError | None = None
    for attempt in range(TRIES):
        draft = _draft(seed, np.random.default_rng([seed, attempt]))
        if draft is None:
            continue
        try:
            return draft, draft.problem()
        except ValueError as error:
            if not any(words in str(error) for words in _MISPLACED):
                raise
            refusal = error
    raise ValueError(f"no problem was drawn from seed {seed}.") from refusal


def _draft(seed: int, rng: Random) -> Draft | None:
    own = np.random.default_rng([seed, 47])  # what is drawn from these leaves the other numbers as they are
    name, model = sketch(rng)
    roll = own.random(3)
    if roll[0] < 0.12:
        name, model = "light_oscillator", sketch_of("light_oscillator", rng)
    if roll[1] < 0.12:
        model = _with_comparison(own, model)
    n = len(model.dynamics)
    dynamics, inputs, plan = _inputs(rng, model)
    half = rng.choice([1e-3, 0.1, 1.0]) * np.array([0.2] * model.disturbance)
    start = _start(rng, model, own if roll[2] < 0.12 else None)
    draft = Draft(
        seed=seed, family=name, continuous=model.continuous, dynamics=dynamics, start=start, walls=(),
        horizon=model.horizon, delta=log_uniform(rng, *((1e-9, 1e-3) if rng.random() < 0.4 else (1e-3, 0.3))),
        diffusion=_diffusion(rng, model), noise=_noise(rng, model),
        disturbance=(-half, half * rng.choice([0.0, 0.5, 1.0])) if model.disturbance else None,
        inputs=inputs, plan=plan,
        domain=None if model.domain is None else (np.array(model.domain[0]), np.array(model.domain[1])),
        matrices=model.matrices if inputs is None else None, units=Units(state=np.ones(n)),
    )  # fmt: skip
    with np.errstate(all="ignore"):
        draft, times, states = _pilot(draft, rng)
    if states is None:
        return None
    if draft.domain is None and rng.random() < 0.1:
        low, high = states.min(axis=(0, 1)), states.max(axis=(0, 1))
        room = rng.choice([0.1, 1.0, 5.0]) * (high - low + 1e-3)
        draft = replace(draft, domain=(low - room, high + room))
    count = int(rng.choice([1, 2, 3], p=[0.65, 0.25, 0.1]))
    draft = replace(draft, walls=tuple(_wall(rng, draft, times, states) for _ in range(count)))
    draft = _asked(rng.spawn(1)[0], draft, times, states)
    draft = replace(draft, route=_route(rng, draft), units=_units(rng, draft))
    return replace(draft, features=_features(draft))


def _asked(rng: Random, draft: Draft, times: Array, states: Array) -> Draft:
    """Now and then a union of starts, a target, a constant that is unknown, and a law from a table."""
    n, roll = draft.dimension, rng.random(4)
    if roll[0] < 0.15 and draft.start[0] != "gaussian":
        size = float(np.median(np.std(states[-1], axis=0))) + 1e-4
        more = tuple(np.round(size * rng.standard_normal(n), 4) for _ in range(int(rng.integers(1, 3))))
        draft = replace(draft, shifts=(np.zeros(n), *more))
    if roll[1] < 0.15:
        draft = replace(draft, target=_target(rng, draft, times, states))
    if draft.disturbance is not None and roll[2] < 0.3:
        draft = replace(draft, constant=True)
    if draft.noise is not None and draft.noise.law in ("uniform", "rademacher") and roll[3] < 0.7:
        draft = replace(draft, noise=_tabled(rng, draft.noise))
    return draft


def _target(rng: Random, draft: Draft, times: Array, states: Array) -> Wall:
    """A box or a ball about where paths are at some time, to be reached by the end, in a window, or at the end."""
    k = int(rng.integers(len(times) // 2, len(times)))
    spread = np.std(states[k], axis=0) + 1e-3
    center = states[k].mean(axis=0) + spread * rng.normal(size=draft.dimension) * rng.choice([0.3, 1.5])
    during = _window(rng, draft, times)
    if during == (0.0, 0.0):  # of a start nothing is left to be asked
        during = None
    if rng.random() < 0.3:
        shape = Shape(kind="ball", data=(float(2.0 * spread.max() * rng.uniform(0.5, 2.0)),), center=tuple(
            number(float(c)) for c in center
        ))  # fmt: skip
        return Wall(shape=shape, during=during)
    half = spread * rng.uniform(0.5, 4.0, draft.dimension)
    low, high = center - half, center + half
    if rng.random() < 0.3:
        open_side = int(rng.integers(draft.dimension))
        high[open_side] = np.inf
    return Wall(shape=Shape(kind="box", data=(low, high)), during=during)


def _tabled(rng: Random, noise: Noise) -> Noise:
    """The same size of another law: triangular, of a table, or with the tails of an exponential."""
    law = str(rng.choice(["triangular", "discrete", "histogram", "laplace"], p=[0.35, 0.3, 0.3, 0.05]))
    if law == "triangular":
        return replace(noise, law=law, level="halfwidth")
    if law == "laplace":
        return replace(noise, law=law, level="scale")
    count = int(rng.integers(2, 5))
    weights = np.round(0.05 + (1 - 0.05 * count) * rng.dirichlet(np.full(count, 2.0)), 6)
    weights[-1] = 1.0 - weights[:-1].sum()
    places = np.sort(rng.uniform(-1.0, 1.0, count + (law == "histogram")))
    middles = 0.5 * (places[1:] + places[:-1]) if law == "histogram" else places
    return replace(noise, law=law, level="scale", table=(places - weights @ middles, weights))


def _inputs(rng: Random, model: Sketch) -> tuple[tuple[Formula, ...], Any, Any]:
    """Now and then an input in some row, with a plan."""
    rows, n = list(model.dynamics), len(model.dynamics)
    if rng.random() > 0.12:
        return tuple(rows), None, None
    i = int(rng.integers(n))
    rows[i] = rows[i] + between(rng, 0.1, 0.5) * symbol("u0")
    box = (np.array([-2.0]), np.array([2.0]))
    if rng.random() < 0.5:
        count = int(rng.integers(1, 4)) if model.continuous else int(model.horizon)
        return tuple(rows), box, np.round(rng.uniform(-0.5, 0.5, (count, 1)), 3)
    law = between(rng, -0.8, 0.0) * symbol(f"x{int(rng.integers(n))}")
    if rng.random() < 0.4:
        law = law + 0.1 * symbol("t") / model.horizon
    return tuple(rows), box, (law,)


def _with_comparison(rng: Random, model: Sketch) -> Sketch:
    """The model with a comparison of constants in one of its rows."""
    rows, i = list(model.dynamics), int(rng.integers(len(model.dynamics)))
    rows[i] = rows[i] + compared(rng, model.horizon, model.continuous)
    return replace(model, dynamics=rows, matrices=None)


def _start(rng: Random, model: Sketch, gaussian: Random | None) -> tuple[str, Any, Any]:
    """A start of any kind; with ``gaussian`` a normal one, whose correlations and size are drawn from these numbers."""
    center, n = np.array(model.center), len(model.center)
    width = model.width * rng.choice([1e-6, 0.1, 1.0, 2.0], p=[0.05, 0.25, 0.5, 0.2])
    kind = str(rng.choice(["point", "box", "ball", "ellipsoid", "gaussian"], p=[0.35, 0.35, 0.1, 0.1, 0.1]))
    if gaussian is not None:
        turn = np.linalg.qr(gaussian.standard_normal((n, n)))[0]
        stds = model.width * 10.0 ** gaussian.uniform(-1.0, 1.0, n) * (gaussian.random(n) < 0.85)
        return "gaussian", center, turn @ np.diag(stds**2) @ turn.T
    if kind == "point":
        return "box", center, center
    if kind == "box":
        half = width * rng.uniform(0.2, 1.0, n) * (rng.random(n) < 0.85)
        return "box", center - half, center + half
    if kind == "ball":
        return "ball", center, float(width)
    factor = width * (np.eye(n) + 0.3 * np.tril(rng.standard_normal((n, n)), -1))
    covariance = factor @ factor.T
    if kind == "gaussian" and rng.random() < 0.2 and n > 1:
        covariance = width**2 * np.diag([1.0] * (n - 1) + [0.0])
    return kind, center, covariance


def _diffusion(rng: Random, model: Sketch) -> tuple[tuple[Formula, ...], ...]:
    if not model.continuous or rng.random() < 0.02:
        return ()
    if model.diffusion is not None:
        return tuple(tuple(row) for row in model.diffusion)
    n = len(model.noise)
    way = rng.random()
    matrix = np.diag(model.noise)
    if way < 0.15:
        matrix = np.array(model.noise)[:, None]
    elif way < 0.3:
        matrix = matrix @ np.round(np.eye(n) + 0.5 * rng.standard_normal((n, n)), 3)
    elif way < 0.35:
        matrix = np.hstack([matrix, 0.5 * matrix])
    return tuple(tuple(number(float(entry)) for entry in row) for row in matrix)


def _noise(rng: Random, model: Sketch) -> Noise | None:
    if model.continuous or rng.random() < 0.02:
        return None
    std = np.array(model.noise)
    n = len(std)
    matrix = None
    if rng.random() < 0.25:
        columns = int(rng.integers(1, n + 1))
        matrix = np.round(rng.standard_normal((n, columns)), 2) * std[:, None]
        std = np.ones(columns)
    law = str(
        rng.choice(["gaussian", "uniform", "rademacher", "bounded", "subgaussian"], p=[0.5, 0.16, 0.11, 0.13, 0.1])
    )
    if law in ("gaussian", "subgaussian"):
        prefix = "" if law == "gaussian" else "proxy_"
        level = str(rng.choice(["std", "variance", "covariance"]))
        factor = np.diag(std) @ (np.eye(len(std)) + 0.4 * np.tril(rng.standard_normal((len(std), len(std))), -1))
        value = {"std": std, "variance": std**2, "covariance": factor @ factor.T}[level]
        return Noise(law=law, level=prefix + level, value=value, matrix=matrix)
    level = "scale" if law == "rademacher" else "halfwidth"
    independent = law != "bounded" or bool(rng.random() < 0.5)
    return Noise(law=law, level=level, value=1.7 * std, matrix=matrix, independent=independent)


def _pilot(draft: Draft, rng: Random) -> tuple[Draft, Array, Array | None]:
    """Times, and states of shape (times, paths, n); the horizon is cut where they explode."""
    policy = None
    if draft.disturbance is not None:
        low, high = draft.disturbance
        policy = Policy(low, high, constant=high)
    initial = starts(draft, rng, PILOT)
    with np.errstate(all="ignore"):
        run = list(
            follow(draft, initial, rng, steps=PILOT_STEPS * (20 if draft.family == "stiff_rates" else 1), policy=policy)
        )
    good = 0
    domain = draft.domain
    while good < len(run) and np.all(np.isfinite(run[good][1])) and np.max(np.abs(run[good][1])) < LARGEST:
        if domain is not None and np.any((run[good][1] < domain[0]) | (run[good][1] > domain[1])):
            break
        good += 1
    if good < len(run):
        horizon = run[max(good - 1, 0)][0]
        if horizon <= 0:
            return draft, np.zeros(0), None
        horizon = float(f"{0.9 * horizon:.3g}") if draft.continuous else float(horizon)
        draft = replace(draft, horizon=horizon)
        if isinstance(draft.plan, np.ndarray) and not draft.continuous:
            draft = replace(draft, plan=draft.plan[: int(horizon)])
        run = [entry for entry in run[:good] if entry[0] <= horizon]
    return draft, np.array([t for t, _ in run]), np.stack([states for _, states in run])


# ---- constraints ---------------------------------------------------------------------------------------------------


def _wall(rng: Random, draft: Draft, times: Array, states: Array) -> Wall:
    """A constraint that the pilot's paths respect, with some or no room to spare."""
    during = _window(rng, draft, times)
    first, last = (0.0, draft.horizon) if during is None else during
    used = (times >= first - 1e-12) & (times <= last + 1e-12)
    if not np.any(used):
        used[np.argmin(np.abs(times - first))] = True
    times, states = times[used], states[used]
    spread = float(np.median(np.std(states[-1], axis=0))) + 1e-4
    room = float(rng.choice([0.0, 0.2, 1.0, 3.0, 10.0], p=[0.1, 0.2, 0.35, 0.25, 0.1])) * spread
    if rng.random() < 0.08:
        room = -0.5 * spread
    inside = bool(rng.random() < 0.75)
    n = states.shape[2]
    coordinates = None
    if n > 1 and rng.random() < 0.3:
        picked = rng.choice(n, size=int(rng.integers(1, n)), replace=False)
        coordinates = tuple(int(k) for k in picked)
    moving = bool(rng.random() < 0.15)
    kind = str(rng.choice(["box", "ball", "ellipsoid", "halfspace", "polytope"], p=[0.45, 0.15, 0.1, 0.2, 0.1]))
    if kind in ("halfspace", "polytope"):
        coordinates, moving = None, False
    local = states if coordinates is None else states[..., list(coordinates)]
    if kind in ("halfspace", "polytope"):
        shape = _flat(rng, kind, local, room, inside)
    elif inside:
        shape = _around(rng, kind, times, local, room, moving)
    else:
        shape = _obstacle(rng, kind, times, local, room, moving)
    return Wall(shape=replace(shape, coordinates=coordinates), inside=inside, during=during)


def _window(rng: Random, draft: Draft, times: Array) -> tuple[float, float] | None:
    way = rng.random()
    if way < 0.7:
        return None
    horizon = draft.horizon
    if way < 0.8:
        return (horizon, horizon)
    ends = np.sort(rng.uniform(0.0, horizon, 2))
    if not draft.continuous:
        ends = np.round(ends)
    return (0.0 if way < 0.85 else float(ends[0]), float(ends[1]))


def _flat(rng: Random, kind: str, states: Array, room: float, inside: bool) -> Shape:
    n = states.shape[2]
    if kind == "halfspace":
        normal = np.round(rng.standard_normal(n), 2) if rng.random() < 0.5 else np.eye(n)[int(rng.integers(n))]
        normal = normal if np.any(normal) else np.eye(n)[0]
        along, size = states @ normal, float(np.linalg.norm(normal))
        bound = float(along.max() + room * size) if inside else float(along.min() - room * size)
        return Shape(kind=kind, data=(normal[None], np.array([bound])))
    slanted = np.round(rng.standard_normal((2, n)), 2)
    faces = np.vstack([np.eye(n), -np.eye(n), np.where(np.any(slanted, axis=1, keepdims=True), slanted, 1.0)])
    along, size = states @ faces.T, np.linalg.norm(faces, axis=1)
    if inside:
        return Shape(kind=kind, data=(faces, along.max(axis=(0, 1)) + max(room, 0.0) * size))
    center = states.mean(axis=(0, 1)) + _away(rng, states, room)
    reach = np.max((states - center) @ faces.T / size, axis=-1).min() - room  # in the gauge of the faces
    return Shape(kind=kind, data=(faces, faces @ center + max(reach, 1e-3) * size))


def _center(rng: Random, times: Array, middle: Array, drift: Array, moving: bool) -> tuple[Formula, ...]:
    if not moving:
        return tuple(number(float(m)) for m in middle)
    start = float(times[0])
    wave = 0.05 * float(np.linalg.norm(drift)) + 0.01
    line = [float(m) + float(v) * (symbol("t") - start) for m, v in zip(middle, drift)]
    if rng.random() < 0.4:
        line[0] = line[0] + wave * apply("sin", symbol("t"))
    return tuple(line)


def _relative(times: Array, states: Array, center: tuple[Formula, ...]) -> Array:
    middles = np.array([[float(entry.value({"t": t})) for entry in center] for t in times])
    return np.asarray(states - middles[:, None, :])


def _trend(times: Array, states: Array) -> tuple[Array, Array]:
    """Where the mean is at first, and its mean speed."""
    mean = states.mean(axis=1)
    span = times[-1] - times[0]
    return mean[0], (mean[-1] - mean[0]) / span if span > 0 else np.zeros(mean.shape[1])


def _around(rng: Random, kind: str, times: Array, states: Array, room: float, moving: bool) -> Shape:
    begin, drift = _trend(times, states)
    middle = begin if moving else 0.5 * (states.max(axis=(0, 1)) + states.min(axis=(0, 1)))
    center = _center(rng, times, middle, drift, moving)
    y = _relative(times, states, center)
    if kind == "box":
        room = np.maximum(room, -0.2 * np.ptp(y, axis=(0, 1)))
        low, high = y.min(axis=(0, 1)) - room, y.max(axis=(0, 1)) + room
        if not moving:
            low, high = low + middle, high + middle
        open_sides = rng.random((2, len(low))) < (0.2 if len(low) > 1 else 0.15)
        open_sides[:, 0] &= not open_sides[:, 0].all()
        low, high = np.where(open_sides[0], -np.inf, low), np.where(open_sides[1], np.inf, high)
        return Shape(kind=kind, data=(low, high), center=center if moving else None)
    if kind == "ball":
        return Shape(kind=kind, data=(float(np.linalg.norm(y, axis=-1).max() + max(room, 1e-4)),), center=center)
    axes = np.max(np.abs(y), axis=(0, 1)) + max(room, 1e-3)
    gauge = np.sum((y / axes) ** 2, axis=-1).max()
    turn = np.eye(len(axes))
    shape = np.diag(axes**2 * max(gauge, 0.1))
    if rng.random() < 0.4 and len(axes) > 1:
        turn = np.linalg.qr(rng.standard_normal((len(axes), len(axes))))[0]
        shape = shape + 0.1 * float(np.min(axes)) ** 2 * turn @ np.diag(np.arange(1.0, len(axes) + 1)) @ turn.T
    return Shape(kind=kind, data=(0.5 * (shape + shape.T),), center=center)


def _away(rng: Random, states: Array, room: float) -> Array:
    direction = rng.standard_normal(states.shape[2])
    size = np.max(states, axis=(0, 1)) - np.min(states, axis=(0, 1))
    return np.asarray(direction / np.linalg.norm(direction) * (float(np.max(size)) * 1.5 + 2.0 * max(room, 0.0) + 0.05))


def _obstacle(rng: Random, kind: str, times: Array, states: Array, room: float, moving: bool) -> Shape:
    begin, drift = _trend(times, states)
    middle = (begin if moving else states.mean(axis=(0, 1))) + _away(rng, states, room)
    center = _center(rng, times, middle, drift, moving)
    y = _relative(times, states, center)
    if kind == "box":
        half = max(float(np.max(np.abs(y), axis=-1).min()) - room, 1e-3) * np.ones(y.shape[-1])
        low, high = (-half, half) if moving else (middle - half, middle + half)
        return Shape(kind=kind, data=(low, high), center=center if moving else None)
    radius = max(float(np.linalg.norm(y, axis=-1).min()) - room, 1e-3)
    if kind == "ball":
        return Shape(kind=kind, data=(radius,), center=center)
    axes = radius * rng.uniform(0.5, 1.0, y.shape[-1])
    return Shape(kind=kind, data=(np.diag(axes**2),), center=center)


# ---- units, route, features ----------------------------------------------------------------------------------------


def _units(rng: Random, draft: Draft) -> Units:
    n, way = draft.dimension, rng.random()
    state = np.ones(n)
    if way > 0.85:
        state = 10.0 ** rng.uniform(-8, 8, n)
    elif way > 0.7:
        state = np.full(n, 10.0 ** float(rng.integers(-8, 9)))
    elif way > 0.6:
        state = 10.0 ** rng.integers(-3, 4, n).astype(float)
    time = float(10.0 ** rng.uniform(-4, 4)) if draft.continuous and rng.random() < 0.15 else 1.0
    return Units(state=np.array([float(f"{s:.3g}") for s in state]), time=float(f"{time:.3g}"))


def _formulas(draft: Draft) -> list[Formula]:
    plan = [] if draft.plan is None or isinstance(draft.plan, np.ndarray) else list(draft.plan)
    return [*draft.dynamics, *plan, *(entry for row in draft.diffusion for entry in row)]


def _route(rng: Random, draft: Draft) -> str:
    if draft.matrices is not None and rng.random() < 0.6:
        return "linear"
    allowed = not any(_jumps(row) for row in _formulas(draft)) and not isinstance(draft.plan, np.ndarray)
    return "file" if allowed and rng.random() < 0.4 else "python"


def _features(draft: Draft) -> frozenset[str]:
    used = set().union(*(row.operations() for row in _formulas(draft)))
    g = set().union(*(entry.symbols() for row in draft.diffusion for entry in row))
    found = {
        "time: continuous" if draft.continuous else "time: discrete",
        f"states: {draft.dimension}",
        f"start: {'point' if _is_point(draft) else draft.start[0]}",
        f"route: {draft.route}",
        "model: smooth" if not used & (JUMPS | KINKS) else "",
        "model: kink" if used & KINKS else "",
        "model: jump" if used & JUMPS else "",
        "model: comparison of constants" if any(_compares(row) for row in _formulas(draft)) else "",
        "model: in t" if any("t" in row.symbols() for row in draft.dynamics) else "",
        "noise: none" if not draft.diffusion and draft.noise is None else "",
        f"noise: {draft.noise.law} {draft.noise.level}" if draft.noise else "",
        "noise: dependent entries" if draft.noise and not draft.noise.independent else "",
        "noise: matrix" if draft.noise and draft.noise.matrix is not None else "",
        "noise: g(t, x)" if g - {"t"} else "noise: g(t)" if g else "noise: constant g" if draft.diffusion else "",
        ("disturbance: constant" if draft.constant else "disturbance") if draft.disturbance else "",
        "start: union" if draft.shifts else "",
        "target" if draft.target else "",
        "target: window" if draft.target and draft.target.during else "",
        "plan: " + ("array" if isinstance(draft.plan, np.ndarray) else "feedback") if draft.inputs else "",
        "domain" if draft.domain else "",
        "units: 1" if np.all(draft.units.state == 1) else "units: common" if draft.units.common else "units: mixed",
        "units: time" if draft.units.time != 1 else "",
        f"constraints: {len(draft.walls)}",
    }
    for wall in draft.walls:
        found.add(f"wall: {'inside' if wall.inside else 'outside'} {wall.shape.kind}")
        found |= {"wall: moving"} if wall.shape.moving else set()
        found |= {"wall: some coordinates"} if wall.shape.coordinates is not None else set()
        if wall.during is not None:
            found.add("wall: at the end" if wall.during[0] == draft.horizon else "wall: window")
    return frozenset(found - {""})


def _compares(formula: Formula) -> bool:
    """Whether a decision somewhere rests on no state."""
    return _known(formula) or any(_compares(argument) for argument in formula.args)


def _known(formula: Formula) -> bool:
    return formula.op == "where" and not formula.args[0].symbols() - {"t"}


def _jumps(formula: Formula) -> bool:
    """Whether something jumps by the state."""
    return (formula.op in JUMPS and not _known(formula)) or any(_jumps(argument) for argument in formula.args)


def _is_point(draft: Draft) -> bool:
    return draft.start[0] == "box" and bool(np.array_equal(draft.start[1], draft.start[2]))
