"""Proofs by value functions as data.

In discrete time the grids are all: from them the checker finds the value functions itself, step by step backward, with
polynomials of a higher degree than the engine's, so that its cells may be larger.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertificateError, InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.problem.noise import Law
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces, Inside
from certbound.problem.systems import DiscreteSystem
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.safety.certificates.parts import packed
from certbound.values.chains import Drifting
from certbound.values.continuous import ExitBounds, Lasting, Payment, Rate, Surface, bound_lasting
from certbound.values.discrete import step_grids
from certbound.values.grids import Grid
from certbound.values.sets import active_at

_SHARES = {1: (0.42, 0.3, 0.2), 2: (0.55, 0.4, 0.28), 3: (0.8, 0.6, 0.45)}
_UNIFORM_SHARES = (0.03, 0.01, 0.004)
_ROOMS = (0.05, 0.15, 0.5)
_PARTS = (12, 24, 48)  # of one disturbance; of several, their product
_COARSE = (0.04, 0.01, 0.0)  # of log P, for a smaller file
_MORE_ROOM = 3  # in continuous time and two states
_MORE = 1.02  # of lam, which the checker need not prove
_BITS = {"values": (42, 30, 22), "rates": (24, 18, 14)}  # of a value, a slope, a second derivative and beyond
_MOST_PATCHES = 400_000
_LONGEST = 15 * 2**20  # characters of the packed arrays
_INWARD = 1e-13  # of a side of the grid: its faces must lie in the safe set, whatever has been rounded
_STARTS = ("box", "ball", "ellipsoid")  # sets of which lower bounds state points
_ALONG = {1: 9, 2: 5, 3: 3}  # of these, along each side of a box, by the number of states
_LASTING = (2**9, 2**11, 2**13)  # cells of a function of the state alone
_OFF = 1e-4  # of an eigenfunction's rate and ends, which the checker encloses in its own way
_MEANS = 4000  # parts over which the mean over a random start is taken
_FARTHEST = 60.0  # standard deviations of the noise for which a cell reaches beyond the safe set


def values_proof(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The proof's data, the claimed log10 of the probability, and no assumptions.

    CertificateError where the checker knows no proof of what was bounded.
    """
    if problem.ending:
        raise CertificateError("the checker counts leaving the domain as failing, and this bound does not.")
    if isinstance(answer.details, Lasting):
        return _lasting(problem, attempt, above=True)
    if isinstance(answer.details, Rate):
        return _leaving(problem, answer.details, above=True)
    if isinstance(answer.details, Drifting):
        drift = answer.details
        data = {"engine": "drift", "mirrored": drift.mirrored, "limit": exact(drift.limit), "rate": exact(drift.rate)}
        return data, min(drift.log / math.log(10) * (1 - 1e-12), 0.0), []
    if answer.details is None:
        raise CertificateError("certificates do not state rates of leaving.")
    if problem.endless:
        raise CertificateError("certificates state no bounds of infinite horizons that rest on grids.")
    effort = min(attempt, len(_ROOMS) - 1)
    flat = isinstance(answer.details, ExitBounds) and problem.system.dimension > 1
    room = _ROOMS[effort] * (_MORE_ROOM if flat else 1)
    claim = _claim(answer.log10_delta, problem.delta, room)
    if isinstance(answer.details, ExitBounds):
        return _passage(problem, answer.details, effort), claim, []
    grids = _grids(problem, effort)
    data = _induction(problem, effort, grids, _inward)
    if not problem.initial.random:
        data["splits"] = exact(_splits(problem, grids[0].axes))
    return data, claim, []


def values_proof_below(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The same for the lower bound."""
    effort = min(attempt, len(_ROOMS) - 1)
    if problem.ending:
        raise CertificateError("certificates of lower bounds count leaving the domain as failing.")
    if answer.log10_lower is None:
        raise CertificateError("no lower bound was found.")
    if isinstance(answer.details, Lasting):
        return _lasting(problem, attempt, above=False)
    if isinstance(answer.details, Rate) and answer.details.fast is not None:
        return _leaving(problem, answer.details, above=False)
    if problem.endless:
        raise CertificateError("certificates state lower bounds over infinite horizons in continuous time only.")
    if not problem.initial.random and problem.initial.data(_STARTS)["kind"] not in _STARTS:
        raise CertificateError("lower bounds are stated from starts in a box, a ball or an ellipsoid, or normal ones.")
    if answer.details is None:
        raise CertificateError("certificates do not state rates of leaving.")
    flat = isinstance(answer.details, ExitBounds) and problem.system.dimension > 1
    claim = _claim_below(answer.log10_lower, problem.delta, _ROOMS[effort] * (_MORE_ROOM if flat else 1))
    if isinstance(answer.details, ExitBounds):
        return _crossing(problem, answer.details, effort), claim, []
    data = _induction(problem, effort, _grids(problem, effort), partial(_outward, problem))
    data["side"] = "lower"
    if not problem.initial.random:
        data["starts"] = exact(_some_starts(problem))
    return data, claim, []


def _lasting(problem: Problem, attempt: int, *, above: bool) -> Proof:
    """A function of the state alone: its slopes from one side."""
    found = bound_lasting(problem, cells=_LASTING[min(attempt, len(_LASTING) - 1)])
    low, high = found.slopes
    tail = found.tail if above else None
    data = {
        "engine": "lasting", "mirrored": bool(found.side), "edges": exact(found.edges),
        "slopes": exact(low if above else high),
        "tail": None if tail is None else {"kind": tail[0], "rate": exact(tail[1])},
    } | ({} if above else {"side": "lower"})
    level, room = (found.upper if above else found.lower) / math.log(10), 1e-9 * (1 + abs(found.upper))
    return data, (min(level + room, 0.0) if above else level - room), []


def _leaving(problem: Problem, known: Rate, *, above: bool) -> Proof:
    """How fast paths leave: an eigenfunction, a little less or more of it being claimed than what was proved."""
    found = known.slow if above else known.fast
    assert found is not None
    sign, horizon = -1.0 if above else 1.0, float(problem.horizon)
    start, extreme = (value * (1 + s * _OFF) for value, s in ((found.start, sign), (found.extreme, -sign)))
    rate = found.rate * (1 - sign * _OFF)
    data = {
        "engine": "rate", "low": exact(found.ends[0]), "high": exact(found.ends[1]), "rate": exact(rate),
        "coefficients": exact(found.coefficients), "start": exact(start), "extreme": exact(extreme),
    } | ({} if above else {"side": "lower"})
    still = math.log(start / extreme) - rate * horizon
    level = math.log10(max(-math.expm1(still), 1e-300))
    return data, min(level + 1e-9 if above else level - 1e-9, 0.0), []


def _grids(problem: Problem, effort: int) -> list[Grid]:
    law, shares = _law_of(problem), _SHARES[problem.system.dimension]
    try:
        return step_grids(problem, (shares if law.gaussian else _UNIFORM_SHARES)[effort])
    except InfeasibleError as error:
        raise CertificateError(str(error)) from error


def _induction(
    problem: Problem, effort: int, grids: list[Grid], moved: Callable[[Grid, int], Sequence[Array]]
) -> dict[str, Any]:
    """Discrete time: the grids of the steps that count, one for each that differs."""
    first = 0 if problem.initial.random else 1
    distinct = {id(grid): (grid, step) for step, grid in enumerate(grids) if step >= first}
    place = {key: k for k, key in enumerate(distinct)}
    return {
        "engine": "values",
        "parts": _parts(problem, _PARTS[effort]),
        "grids": [exact(list(moved(grid, step))) for grid, step in distinct.values()],
        "steps": [place[id(grid)] for grid in grids[first:]],
    }


def _passage(problem: Problem, found: ExitBounds, effort: int) -> dict[str, Any]:
    """Continuous time: V and what it is paid with; the coarsest one that costs little."""
    if problem.system.dimension == 3:
        raise CertificateError(
            "no certificate states a value function in continuous time and three states yet; `quadratic` and `barrier` "
            "write certificates of such problems."
        )
    if not found.proposed:
        raise CertificateError(
            "no value function was found that a certificate can state: in two states it states bounded boxes, no "
            "obstacles and no oblique or curved limits."
        )
    best = min(payment.log for _, payment in found.proposed)
    share = _COARSE[effort] * max(1.0, -0.1 * best)
    surface, payment = next(pair for pair in found.proposed if pair[1].log <= best + share)
    return _stated(problem, surface.raised(payment.lift), payment)


def _crossing(problem: Problem, found: ExitBounds, effort: int) -> dict[str, Any]:
    """The same for the lower bound: the sides of the grid must lie beyond those of the safe set."""
    if not found.proposed_below:
        raise CertificateError("no value function was found that the checker knows, from below.")
    best = max(payment.log for _, payment in found.proposed_below)
    share = _COARSE[effort] * max(1.0, -0.1 * best)
    surface, payment = next(pair for pair in found.proposed_below if pair[1].log >= best - share)
    data = _stated(problem, replace(surface, axes=tuple(_spread(axis) for axis in surface.axes)), payment)
    data["side"] = "lower"
    if not problem.initial.random:
        data["starts"] = exact(_some_starts(problem))
    return data


def _stated(problem: Problem, surface: Surface, payment: Payment) -> dict[str, Any]:
    """A value function in continuous time."""
    terms = payment.terms
    if terms is None:
        raise CertificateError("the value function bounds nothing.")
    rates = np.concatenate([surface.start_rates, surface.end_rates[-1:]])
    if surface.slabs * math.prod(surface.cells) > _MOST_PATCHES:
        raise CertificateError(f"the value function has more than {_MOST_PATCHES} patches: too many for a certificate.")
    values, slopes = _packed(surface.values, _BITS["values"]), _packed(rates, _BITS["rates"])
    if len(values) + len(slopes) > _LONGEST:
        raise CertificateError(f"the value function takes over {_LONGEST // 2**20} MiB: too much for a certificate.")
    data = {
        "engine": "values",
        "axes": [exact(axis) for axis in surface.axes],
        "times": exact(surface.times),
        "values": values,
        "rates": slopes,
        "edges": exact(terms.levels.edges),
        "m": exact(terms.levels.m),
        "q": exact(terms.levels.q),
        "lam": exact(terms.lam * _MORE),
        "eps": exact(terms.eps),
    }
    return data | ({"pieces": max(1, min(16, _MEANS // surface.cells[0]))} if problem.initial.random else {})


def _packed(numbers: Array, bits: tuple[int, ...]) -> str:
    """Numbers as one compressed text.

    By the order of the derivative they keep so many bits: V is as smooth with any, and nearly as good with these.
    """
    order = np.zeros(numbers.shape, dtype=int)
    for axis in range(2, numbers.ndim, 2):
        order += np.arange(3).reshape([3 if k == axis else 1 for k in range(numbers.ndim)])
    step = np.frexp(numbers)[1] - np.asarray(bits)[np.minimum(order, len(bits) - 1)]
    rounded = np.ldexp(np.rint(np.ldexp(numbers, -step)), step)
    return packed(rounded)


def _parts(problem: Problem, most: int) -> int:
    count = len(problem.system.disturbance_names)
    return max(2, round((most / problem.system.dimension) ** (1 / count))) if count else 1


def _inward(grid: Grid, step: int) -> list[Array]:
    """The edges, the outermost ones moved inward by next to nothing."""
    return [_stretched(edges, -_INWARD) for edges in grid.axes]


def _stretched(edges: Array, share: float) -> Array:
    """The edges, the outermost ones moved outward by a share of the whole length."""
    step = share * (edges[-1] - edges[0])
    return np.concatenate([[edges[0] - step], edges[1:-1], [edges[-1] + step]])


def _spread(edges: Array) -> Array:
    return _stretched(edges, _INWARD)


def _outward(problem: Problem, grid: Grid, step: int) -> list[Array]:
    """The edges, those at faces moved to where the constraint is broken, and a cell beyond each end."""
    system = problem.system
    assert isinstance(system, DiscreteSystem)
    spread = np.sqrt(np.diag(system.noise_matrix @ system.noise.proxy @ system.noise_matrix.T))
    low, high = _images(problem, grid, step)
    faces = [face for c in active_at(problem.constraints, step) for face in _faces(c, step)]
    found = []
    for i, edges in enumerate(grid.axes):
        length, edges = edges[-1] - edges[0], edges.copy()
        for axis, place, sign in faces:
            if axis == i:
                edges[np.abs(edges - place) <= _INWARD * length] += 2 * sign * _INWARD * length
        most = _FARTHEST * spread[i]
        below, above = (np.clip(most / 6 + gap, most / 6, most) for gap in (edges[0] - low[i], high[i] - edges[-1]))
        found.append(np.concatenate([[edges[0] - below], edges, [edges[-1] + above]]))
    return found


def _faces(constraint: Inside, step: int) -> Iterator[tuple[int, float, int]]:
    """(state, place, side on which the constraint is broken) of its faces across single states."""
    region, form = constraint.region, constraint.region.form
    if not isinstance(form, Faces):
        return
    center, places = region.center_at(step), region.places(region.dimension)
    for normal, bound in zip(form.normals, form.bounds):
        used = np.flatnonzero(normal)
        if len(used) == 1:
            sign = int(np.sign(normal[used[0]])) * (-1 if constraint.outside else 1)
            yield places[used[0]], float(bound / normal[used[0]] + center[used[0]]), sign


def _images(problem: Problem, grid: Grid, step: int) -> tuple[Array, Array]:
    """About the box that the nodes of a grid are led into; of no consequence but for how much is proved."""
    points = np.stack([axis.ravel() for axis in np.meshgrid(*grid.axes, indexing="ij")])
    rows = problem.input_sequence
    inputs = [] if rows is None else list(rows[min(step, len(rows) - 1)])
    box = problem.system.disturbance
    corners = [()] if box is None else itertools.product(*zip(box.low, box.high))
    move = compile_numpy(problem.closed_loop)
    with np.errstate(all="ignore"):
        found = np.concatenate([
            np.broadcast_to(move(float(step), *points, *inputs, *corner), (points.shape[1], len(points)))
            for corner in corners
        ])  # fmt: skip
    found = np.where(np.isfinite(found), found, points.mean())
    return found.min(axis=0), found.max(axis=0)


def _some_starts(problem: Problem) -> list[Array]:
    """Points of the initial set, among them those from which failing is likely: its corners, or all around it."""
    data = problem.initial.data(_STARTS)
    if data["kind"] == "box":
        low, high = np.asarray(data["low"]), np.asarray(data["high"])
        count = _ALONG[len(low)]
        sides = [sorted({a, *np.linspace(a, b, count)[1:-1].tolist(), b}) for a, b in zip(low.tolist(), high.tolist())]
        return [np.array(point) for point in itertools.product(*sides)]
    center = np.asarray(data["center"], dtype=float)
    if data["kind"] == "ball":
        factor = float(data["radius"]) * np.eye(len(center))
    else:
        factor = np.linalg.cholesky(data["shape"])
    rows = np.array(list(itertools.product((-1.0, -0.5, 0.0, 0.5, 1.0), repeat=len(center))))
    sizes = np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1.0)
    return list(center + (1 - 1e-9) * (rows / sizes) @ factor.T)


def _law_of(problem: Problem) -> Law:
    """The law of the noise, which the checker must know."""
    system = problem.system
    if system.dimension > max(_SHARES):
        raise CertificateError(f"the checker knows value functions of at most {max(_SHARES)} states.")
    if not isinstance(system, DiscreteSystem) or not (system.noise.gaussian or system.noise.uniform):
        raise CertificateError("the checker knows value functions for normal and uniform noise only.")
    if system.noise.uniform and system.dimension > 1:
        raise CertificateError("the checker knows value functions for uniform noise in one state only.")
    return system.noise


def _splits(problem: Problem, axes: tuple[Array, ...]) -> list[Any]:
    """Edges of cells that cover the starts, half as wide as those of the grid."""
    around = problem.initial.hull()
    most = {1: 64, 2: 12, 3: 6}[len(axes)]
    found = []
    for low, high, edges in zip(around.lo, around.hi, axes):
        inside = int(np.sum((edges > low) & (edges < high)))
        count = min(2 * (inside + 1), most) if low < high else 1
        row = [float(x) for x in np.linspace(low, high, count + 1)]
        found.append(sorted({float(low), *row, float(high)}) if low < high else [float(low), float(high)])
    return found


def _claim(log10: float, delta: float, share: float) -> float:
    """log10 of a probability a little above, and not above delta where the other was not."""
    room = share * max(1.0, -0.1 * log10)
    left = math.log10(delta) - log10
    return min(log10 + (min(room, left / 2) if left > 0 else room), 0.0)


def _claim_below(log10: float, delta: float, share: float) -> float:
    """log10 of a probability a little below, and above delta where the other was."""
    room = share * max(1.0, -0.1 * log10)
    left = log10 - math.log10(delta)
    return log10 - (min(room, left / 2) if left > 0 else room)
