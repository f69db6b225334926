"""The linear-response proof as data (Thm K7'): boxes of the remainder with room to spare, levels, rows and frames.

The engine's search is run again on fewer pieces, since the checker is slower than NumPy; the boxes are widened by a few
per cent, so that the checker needs few sub-boxes; and the events are those that the checker knows: first exceedances
in discrete time, joined by the Gaussian correlation inequality, and martingale windows in continuous time. The stated
probability is what follows from exactly that.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertificateError
from certbound.gaussian.response import StepEvents, WindowEvents, level_scale, logsumexp
from certbound.problem.model import Tape, compile_numpy, jacobian, varying_outputs
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside, Quadratic
from certbound.problem.systems import ContinuousSystem
from certbound.reach.linear import HeldLinearisation, Linearisation, LinearRun, Path, Share, SplitAnswer, correlated
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.safety.certificates.parts import separations

Events = StepEvents | WindowEvents

_STEPS = (0.25, 0.12, 0.06)
_FEWEST, _MOST = 40, (160, 320, 640)
EFFORTS = len(_STEPS)
PADS = ((0.08, 0.03, 0.01), (0.15, 0.05, 0.02), (0.25, 0.1, 0.03))
"""How much boxes are widened, effort by effort: a smaller one where a larger does not close, or costs too much."""
_NEARLY = 1.3
_LEAST = 1e-5  # of a row's largest level: along a singular start Z has but what its covariance was raised by
_ROUNDS = 8
SLACK = 0.01
_NEAR = 0.9  # of the logarithm that the engine proved
_LIKELY = -2.0  # log10 of a probability of which a per cent matters
_LOG10 = math.log(10.0)
_SMALLEST = -1e12  # log10 of a probability that is not told apart from 0


def linear_proof(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The proof's data, the claimed log10 of the probability, and no assumptions.

    CertificateError where the remainder feeds itself once its boxes are widened.
    """
    effort = min(attempt, EFFORTS - 1)
    found = answer.details
    engine = engine_of(answer)
    target = Share.of(problem.delta)
    proved = found.outcome.log_probability <= target.log
    tried = [found.outcome.nonlinear, found.shown.nonlinear, target.stated()]
    if not len(engine.model.active):  # only windows ask for a share
        tried.insert(0, Share(found.outcome.log_probability).stated(linear=True))
    best: tuple[LinearRun, Stated] | None = None
    for grid in grids(engine, effort):
        run = found.run if grid is found.run.engine else LinearRun(grid)
        stated = _search(run, list(dict.fromkeys(tried)), PADS[effort], target, closely=proved)
        if stated is not None and (best is None or stated.log_probability < best[1].log_probability):
            best = run, stated
        if best is not None and best[1].log_probability <= _NEAR * found.outcome.log_probability:
            break
    if best is None:
        raise CertificateError("the remainder feeds itself once its boxes are widened for the checker.")
    log10 = max(best[1].log_probability / _LOG10, _SMALLEST)
    exact_sums = not engine.continuous and effort == 0 and log10 > _LIKELY
    slack = _slack(log10) * (0.01 if exact_sums else 1)
    return proof_data(best[0].engine.problem, *best, cuts_of(answer)), min(log10 + slack, 0.0), []


def _slack(log10: float) -> float:
    """What a claim leaves to the checker's own bounds of events."""
    return SLACK * (1 + 0.1 * abs(log10))


def engine_of(answer: EngineAnswer) -> Linearisation:
    """The linearisation that an answer rests on; CertificateError where it bounds nothing."""
    found = answer.details
    engine: Linearisation = found.engine
    if not engine.pieces or found.outcome.bounds is None:
        raise CertificateError("the linear response bounds nothing here.")
    return engine


def grids(engine: Linearisation, effort: int) -> Iterator[Linearisation]:
    """The same cells on a grid for the checker; then, should the remainder feed itself there, on the engine's own."""
    if engine.continuous:
        size = float(np.linalg.norm(np.nan_to_num(engine.slopes[0]), axis=(-2, -1)).max())
        pieces = int(np.clip(np.ceil(engine.problem.horizon * size / _STEPS[effort]), _FEWEST, _MOST[effort]))
        if not pieces <= engine.pieces <= _NEARLY * pieces:
            yield engine.on_grid(pieces)
        if pieces > engine.pieces:
            return
    yield engine


def _edges(engine: Linearisation, *, whole: bool) -> list[list[float]]:
    """Edges of the cells along every state, or only of the ``whole``: between them lies the initial set."""
    low = np.nextafter(engine.centres - engine.radii, -np.inf)
    high = np.nextafter(engine.centres + engine.radii, np.inf)
    result = []
    for j in range(engine.n):
        centres = np.unique(engine.centres[:, j])
        first, last = low[:, j].min(), high[:, j].max()
        inner = [] if whole else ((centres[1:] + centres[:-1]) / 2).tolist()
        result.append([float(first), *inner, float(last)])
    return result


# ---- the proof's numbers -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Stated:
    """Levels of the inner rows, boxes of the remainder, and what they prove.

    Where the noise depends on the state, ``gaussian`` are the levels of Z alone, ``window_levels`` those of its
    martingale's coordinates, and ``stopped`` what is stated of M, cell by cell.
    """

    levels: Array
    bounds: tuple[Array, Array]
    events: list[Events]
    log_probability: float
    gaussian: Array | None = None
    window_levels: list[Array] | None = None
    stopped: list[dict[str, Any]] | None = None


def _events(run: LinearRun, cell: int, shared: Share) -> Events:
    engine = run.engine
    if isinstance(engine.system, ContinuousSystem):
        return WindowEvents(engine.response, cell, engine.window, shared.log)
    return engine.step_events(cell)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Levels:
    """Levels of the inner rows, what they cost cell by cell, and the bounds of beta that the engine proves for them."""

    levels: Array
    events: list[Events]
    spent: list[list[float]]
    found: tuple[Array, Array]


def _search(
    run: LinearRun, shares: list[Share], pads: Sequence[float], target: Share, *, closely: bool
) -> Stated | None:
    """The first share's proof that reaches the target, or the best one found, with the widest boxes that do.

    Wide boxes are quick to check; narrower ones are tried where these do not close, or (``closely``) prove less than
    the target.
    """
    best: Stated | None = None
    enough = target.log - _slack(target.log / _LOG10) * _LOG10
    for share in shares:
        given = _levels(run, share)
        if given is None:
            continue
        for pad in pads:
            bounds = widened(run, given.levels, given.found, pad)
            if bounds is None:
                continue
            stated = _stated(run, given, bounds)
            if best is None or stated.log_probability < best.log_probability:
                best = stated
            if best.log_probability <= enough:
                return best
            if not closely:
                break
    return best


def _levels(run: LinearRun, nonlinear: Share) -> _Levels | None:
    """Levels that cost a share; None where the remainder feeds itself."""
    cells, pieces, count = run.rows.shape[:3]
    levels = np.zeros((cells, pieces, count))
    share = nonlinear.side(count).log
    events, spent = [], []
    for cell in range(cells):
        own = _events(run, cell, nonlinear.common(count))
        logs = [own.shared_log]
        for d in range(count):
            event = own.along(run.rows[cell, :, d])
            if event.profile.max() > 0:
                profile = np.maximum(event.profile, _LEAST * event.profile.max())
                found = level_scale(event, event.profile, share) * profile
                capped = own.along(run.rows[cell, :, d]).capped if isinstance(own, StepEvents) else np.asarray
                levels[cell, :, d] = capped(found)
            logs.append(math.log(2.0) + event.log_exceedance(levels[cell, :, d]))
        events.append(own)
        spent.append(logs)
    if not np.isfinite(levels).all():
        return None
    found = run.include(levels, 2)
    return None if found is None else _Levels(levels=levels, events=events, spent=spent, found=found)


def _stated(run: LinearRun, given: _Levels, bounds: tuple[Array, Array]) -> Stated:
    """What the levels and the boxes prove."""
    worst = -np.inf
    for cell, own in enumerate(given.events):
        rooms = run.rooms(cell, bounds)
        asked = [own.along(r.rows).log_exceedance(rooms[:, i]) for i, r in enumerate(run.requirements[cell])]
        total = logsumexp(np.array([*given.spent[cell], *asked]))
        if isinstance(own, StepEvents) and own.gaussian:
            shared = logsumexp(np.array(given.spent[cell]))
            total = min(total, correlated(own, run.requirements[cell], rooms, shared, asked))
        worst = max(worst, total)
    return Stated(levels=given.levels, bounds=bounds, events=given.events, log_probability=float(min(worst, 0.0)))


def widened(run: LinearRun, levels: Array, found: tuple[Array, Array], pad: float) -> tuple[Array, Array] | None:
    """Boxes B of beta with a margin of half the padding around beta over what B implies.

    Beta is bounded over the polytope P that wider boxes imply; boxes around these bounds are right once what they imply
    lies in P.
    """
    engine, shape = run.engine, found[0].shape
    extra = run.extra.reshape(shape[0] * shape[1], *run.extra.shape[2:])
    boxes = _padded(engine, found, pad)
    for _ in range(_ROUNDS):
        held = _implied(run, levels, _padded(engine, boxes, pad / 2))
        if held is None:
            return None
        wanted = [part.reshape(-1, engine.n) for part in _padded(engine, found, pad / 2)]
        bound = engine.model.bound(engine.frame, *held, extra, 2, (wanted[0], wanted[1]))
        inner = bound[0].reshape(shape), bound[1].reshape(shape)
        if not all(np.isfinite(part).all() for part in inner):
            return None
        boxes = _padded(engine, inner, pad / 2)
        implied = _implied(run, levels, boxes)
        if implied is None:
            return None
        if np.all(implied[0] >= held[0]) and np.all(implied[1] <= held[1]):
            return boxes
        found = inner
    return None


def _implied(run: LinearRun, levels: Array, boxes: tuple[Array, Array]) -> tuple[Array, Array] | None:
    """The polytope of deviations that boxes of beta imply; None where it is not bounded."""
    reach = [s.remainder(lo, hi)[:2] for s, lo, hi in zip(run.inner_supports, *boxes, strict=True)]
    if not all(np.isfinite(part).all() for pair in reach for part in pair):
        return None
    low, high = run.polytope(levels, reach)
    slack = 1e-12 * (high - low)
    return low - slack, high + slack


def _padded(engine: Linearisation, bounds: tuple[Array, Array], pad: float) -> tuple[Array, Array]:
    low, high = bounds
    size = np.maximum(np.abs(low), np.abs(high))
    room = pad * (high - low) + 1e-9 * size + pad * 1e-11 * engine.remainder_sizes
    return low - room, high + room


# ---- the data ----------------------------------------------------------------------------------------------


def cuts_of(answer: EngineAnswer) -> list[Any] | None:
    """How the initial set was cut into cells, as `certbound.checker` reads it; None: by a grid, if at all."""
    found = answer.details
    return None if not isinstance(found, SplitAnswer) else _cuts(list(zip(found.paths, found.low, found.high)), 0)


def _cuts(cells: list[tuple[Path, Array, Array]], depth: int) -> list[Any]:
    if len(cells) == 1:
        return [None]
    side = cells[0][0][depth][0]
    lower = [cell for cell in cells if not cell[0][depth][1]]
    upper = [cell for cell in cells if cell[0][depth][1]]
    place = max(float(high[side]) for _, _, high in lower)
    return [[side, exact(place)], *_cuts(lower, depth + 1), *_cuts(upper, depth + 1)]


def proof_data(
    problem: Problem, run: LinearRun, stated: Stated, cuts: list[Any] | None = None
) -> dict[str, Any]:
    engine, tape = run.engine, problem.closed_loop
    q = len(engine.d_middle)
    varying = _varying(tape, range(1, engine.n + 1))
    moving = _varying(tape, range(len(tape.inputs) - q, len(tape.inputs)))
    units = [int(j) for j in engine.model.active]
    windows = stated.events[0].bounds if isinstance(stated.events[0], WindowEvents) else None
    return {
        "engine": "linear",
        "splits": exact(_edges(engine, whole=cuts is not None)),
        **({} if cuts is None else {"cuts": cuts}),
        "pieces": engine.pieces,
        "varying": [list(entry) for entry in varying],
        "moving": [list(entry) for entry in moving],
        "units": units,
        "windows": None if windows is None else [int(k) for k in windows[:-1]],
        **({"sampled": [list(entry) for entry in engine.jumping]} if isinstance(engine, HeldLinearisation) else {}),
        "cells": [
            _cell(problem, run, stated, cell, varying=varying, moving=moving) for cell in range(len(engine.centres))
        ],
    }


def _cell(
    problem: Problem, run: LinearRun, stated: Stated, cell: int, *, varying: list[tuple[int, int]],
    moving: list[tuple[int, int]],
) -> dict[str, Any]:
    engine = run.engine
    slope, drift, gain = (part[cell] for part in engine.slopes)
    events = stated.events[cell]
    active = engine.model.active
    extra = run.rows[cell][:, len(active) :][..., active]
    asked = {requirement.constraint: requirement.rows for requirement in reversed(run.requirements[cell])}
    windows = events.coordinate_levels if isinstance(events, WindowEvents) else None
    if stated.window_levels is not None:
        windows = stated.window_levels[cell]

    def chosen(matrices: Array, entries: list[tuple[int, int]]) -> Any:
        return exact([[float(m[i, j]) for i, j in entries] for m in matrices])

    return {
        "nominal": exact(engine.controls[cell] if engine.continuous else engine.nodes[cell]),
        "slopes": chosen(slope, varying),
        "drifts": chosen(drift, varying) if engine.continuous else None,
        "gains": chosen(gain, moving),
        "remainder_low": exact(stated.bounds[0][cell]),
        "remainder_high": exact(stated.bounds[1][cell]),
        "rows": exact(extra),
        "levels": exact((stated.levels if stated.gaussian is None else stated.gaussian)[cell]),
        "window_levels": None if windows is None else exact(windows),
        "frames": _frames(problem, run, stated, cell, varying),
        "separations": separations(problem, lambda number, constraint: _separation(constraint, asked[number])),
        **({} if stated.stopped is None else {"stopped": stated.stopped[cell]}),
        **({"sampled": chosen(engine.jumps[cell], engine.jumping)} if isinstance(engine, HeldLinearisation) else {}),
    }


def _varying(tape: Tape, columns: range) -> list[tuple[int, int]]:
    """Entries of the derivative that depend on an input, row by row."""
    if not columns:
        return []
    varying = varying_outputs(jacobian(tape, list(columns)))
    return [divmod(o, len(columns)) for o, varies in enumerate(varying) if varies]


def _frames(
    problem: Problem, run: LinearRun, stated: Stated, cell: int, varying: list[tuple[int, int]]
) -> list[list[int] | None]:
    """Rows in which each output's Hessian costs least as they stand (None: the coordinates themselves)."""
    engine = run.engine
    active = [int(j) for j in engine.model.active]
    result: list[list[int] | None] = [None] * engine.n
    if run.extra.shape[2] == 0:
        return result
    hessians = _hessians(problem, engine, cell, active)
    rows = run.rows[cell][..., active]
    widths = _widths(run, stated, cell)
    for i in range(engine.n):
        own = [active.index(j) for o, j in varying if o == i]
        if len(own) != len(active):
            continue
        best = math.inf
        for choice in itertools.combinations(range(rows.shape[1]), len(active)):
            cost = _cost(rows[:, choice], hessians[:, i], widths[:, choice])
            if cost < best:
                best, result[i] = cost, [int(row) for row in choice]
        if result[i] == list(range(len(active))):
            result[i] = None
    return result


def _cost(rows: Array, hessian: Array, width: Array) -> float:
    """Mean size of sum |T' H T|_ab w_a w_b for s = T sigma; inf where the rows are nearly dependent."""
    scaled = rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-300)
    if np.abs(np.linalg.det(scaled)).min() < 1e-3:
        return math.inf
    turn = np.linalg.inv(rows)
    turned = np.abs(np.swapaxes(turn, -1, -2) @ hessian @ turn)
    return float(np.einsum("kab,ka,kb->", turned, width, width))


def _widths(run: LinearRun, stated: Stated, cell: int) -> Array:
    reach = [s.remainder(lo, hi)[:2] for s, lo, hi in zip(run.inner_supports, *stated.bounds, strict=True)]
    low, high = run.polytope(stated.levels, reach)
    pieces = run.engine.pieces
    return np.asarray((high - low)[cell * pieces : (cell + 1) * pieces] / 2)


def _hessians(problem: Problem, engine: Linearisation, cell: int, active: list[int]) -> Array:
    """Second derivatives by the active states at the pieces' starts: (pieces, outputs, active, active)."""
    columns = [j + 1 for j in active]
    function = compile_numpy(jacobian(jacobian(problem.closed_loop, columns), columns))
    x = engine.nodes[cell][: engine.pieces]
    slots = [engine.times[: engine.pieces], *x.T, *engine.inputs.T, *(np.full(len(x), d) for d in engine.d_middle)]
    with np.errstate(all="ignore"):
        values = np.asarray(function(*slots))
    return np.nan_to_num(values.reshape(len(x), engine.n, len(active), len(active)))


def _separation(constraint: Inside, rows: Array) -> Any:
    """The direction that keeps an obstacle off on each piece, as the rows of its requirement have it."""
    region = constraint.region
    own = rows[:, region.places(rows.shape[1])]
    if isinstance(region.form, Quadratic):
        return exact(-own)
    faces = region.form.normals
    if region.form.axial:  # every face reads one state: the row tells their weights
        return [exact(row) for row in np.maximum(-own @ faces.T, 0.0)]
    distance = np.abs(faces[None] + own[:, None]).sum(axis=-1)
    return [int(face) for face in np.argmin(distance, axis=1)]
