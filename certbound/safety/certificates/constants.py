"""The constants proof as data: metric, constants, nominal curves, defects, radii, rooms, Kummer parameters (Thm K2).

Every stated number has a little room, so that the checker's own enclosures need not be the same as the prover's. The
stated probability is Thm K2's for exactly these numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.constants.certification import BY_SLOPES
from certbound.errors import CertificateError
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside, Quadratic
from certbound.reach.contraction import bound_forcing, integrate_radius, jump_sizes, random_start
from certbound.reach.nominal import Curve, Flow, initial_cells
from certbound.reach.sets import ReachTube, polyhedral_weights, round_directions
from certbound.rigor.norms import Norm
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.safety.certificates.parts import in_time_pieces, separations
from certbound.safety.engines import Erosion, erode, joined
from certbound.tubes.constants import Constants
from certbound.tubes.kummer import Search, exit_level, moderate_parameters
from certbound.tubes.question import Question, Start

STATED = "the stated constants hold"
"""The assumption as a certificate names it; the checker derives which constants those are."""

_TINY = (1e-7, 1e-5, 1e-3)
_ROOM = (1e-3, 0.1, 3.0)
_SLACK = 0.005


@in_time_pieces
def constants_proof(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The proof's data, the claimed log10 of the probability, and the assumptions it rests on.

    CertificateError where the constants are local, or leave no room once they have been rounded for the checker.
    """
    given = answer.constants
    if given is None:
        raise CertificateError("no constants were found.")
    if given.times is not None:
        raise CertificateError("constants along a tube are not stated in certificates; use --method linear.")
    if given.proof is not None and given.proof.status.startswith(BY_SLOPES):
        raise CertificateError(f"bounds by the {BY_SLOPES} are not stated in certificates; use --method linear.")
    effort = min(attempt, len(_TINY) - 1)
    slack = _TINY[effort]
    start = random_start(problem, given)
    if start != Start():
        given = given.with_full_dimension()
    constants = _rounded(given, slack)
    flow = Flow(problem)
    reach = answer.reach
    if reach is None:
        raise CertificateError("there is no reach tube.")
    curve = reach.curve
    norm = constants.norm
    cells = initial_cells(problem, _cells_along(curve))
    eta = bound_forcing(flow, curve, norm) * (1 + _ROOM[effort]) + _smallest(curve, norm, answer) * slack
    slope = constants.worst_slope
    rho = cells.radii(norm, curve.initial())
    slopes = np.full(curve.pieces, slope)
    radius, _ = integrate_radius(curve, jump_sizes(curve, norm), rho, slopes, eta)
    radius = radius * (1 + 10 * slack) + 1e-300
    tube = ReachTube(curve=curve, radius=radius, metric=constants.metric)
    erosion = erode(tube, problem, norm)
    rooms = np.where(np.isfinite(erosion.least), erosion.least * (1 - 10 * slack), np.inf)
    if np.any(rooms[0 if flow.continuous else 1 :] <= 0):
        raise CertificateError("the reach tube leaves no room once its numbers have been rounded for the checker.")
    stated = replace(erosion, labels=("all",), radius=rooms[None], factor=np.ones((1, len(rooms))))
    log10, kummer = _search(constants, stated, flow.horizon, start)
    log10 += _SLACK * (1 + 0.1 * abs(log10))
    data = {
        "engine": "constants",
        "assumed": not given.certified,
        "metric": None if constants.metric is None else exact(constants.metric),
        "region": "everywhere" if problem.domain is None else "domain",
        "times": exact(np.append(curve.starts, curve.ends[-1])) if flow.continuous else None,
        "middles": exact(curve.middles) if flow.continuous else None,
        "rate": exact(slope),
        "sigma": exact(float(np.max(constants.sigma))),
        "nu": exact(float(constants.nu)),
        "start_sigma": exact(float(start.sigma)),
        "splits": exact(_edges(cells.boxes.lo, cells.boxes.hi)),
        "rooms": [None if not np.isfinite(room) else exact(float(room)) for room in rooms],
        "kummer": kummer,
        "cells": [_cell(problem, tube, eta, cell) for cell in range(curve.cells)],
    }
    return data, min(log10, 0.0), [] if given.certified else [STATED]


def _cell(problem: Problem, tube: ReachTube, eta: Array, cell: int) -> dict[str, Any]:
    """What is stated of one cell."""
    curve, points = tube.curve, tube.curve.coefficients[cell, :, 0]
    return {
        "nominal": exact(curve.coefficients[cell]),
        "eta": exact(eta[cell] if curve.continuous else eta[cell][: curve.pieces - 1]),
        "radius": exact(tube.radius[cell]),
        "separations": separations(problem, lambda _, constraint: _separation(constraint, points, curve, tube.norm)),
    }


def _rounded(given: Constants, slack: float) -> Constants:
    """Slightly larger constants: strict inequalities are what a positive-definiteness test can prove."""
    rate = gain = None
    if given.rate is not None:
        largest = float(np.max(given.rate))
        rate = largest + slack * (1e-3 + abs(largest))
    else:
        gain = float(np.max(np.asarray(given.gain, dtype=float))) * (1 + slack)
    return Constants(
        rate=rate,
        gain=gain,
        sigma=float(np.max(given.sigma)) * (1 + slack),
        dimension=given.dimension,
        effective_dimension=given.effective_dimension,
        metric=given.metric,
        gaussian=given.gaussian,
    )


def _smallest(curve: Curve, norm: Norm, answer: EngineAnswer) -> float:
    """A unit for what is nearly 0: the size of the nominal states and of the deviation from them."""
    deviation = 0.0 if answer.deviation is None else float(np.max(answer.deviation.radius, initial=0.0))
    return 1e-3 * float(np.max(norm.dual(np.eye(curve.dimension)))) * (
        float(np.abs(curve.coefficients[..., 0, :]).max()) + deviation or 1.0
    )


def _cells_along(curve: Curve) -> int:
    first = curve.coefficients[:, 0, 0]
    return max(len(np.unique(first[:, j])) for j in range(curve.dimension))


def _edges(low: Array, high: Array) -> list[list[float]]:
    """Edges of the cells along every state."""
    result = []
    for j in range(low.shape[1]):
        inner = np.unique(low[:, j])[1:]
        result.append([float(low[:, j].min()), *inner.tolist(), float(high[:, j].max())])
    return result


def _search(constants: Constants, erosion: Erosion, horizon: float, start: Start) -> tuple[float, dict[str, Any]]:
    """log10 of Thm K2's bound at the best parameters found, and these parameters."""
    profile = joined(erosion.profile(random_start=start != Start()), 1e-9)
    if not np.any(np.isfinite(profile[1])):
        return -1e12, {"form": "kummer", "a": exact(1.0), "v0": exact(1.0)}
    question = Question.of(constants, horizon, clearance=profile, start=start)
    cut = question.cut
    best, chosen = 0.0, None
    for bessel, a, v0 in _candidates(question):
        level = exit_level(cut, question.clearance, a=a, v0=v0, bessel=bessel, start=start)
        if level < best:
            best, chosen = level, (bessel, a, v0 * cut.unit**2)
    if chosen is None:
        raise CertificateError("Thm K2 bounds nothing for the rounded constants.")
    bessel, a, v0 = chosen
    # in the Bessel form a belongs to squares in units of `unit`, as v0 does: a z is the same number
    return best, {"form": "bessel" if bessel else "kummer", "a": exact(float(a)), "v0": exact(float(v0))}


def _candidates(question: Question) -> Iterator[tuple[bool, float, float]]:
    """Parameters to try: what a search finds, and a coarse grid in case it loses its way."""
    cut = question.cut
    graded = cut.graded(6)
    for bessel in (False, True) if np.max(cut.rates) >= 0 and cut.any_power else (False,):
        yield (bessel, *Search.of(question, graded, bessel=bessel).solve())
    yield from ((False, a, v0) for a, v0 in moderate_parameters(cut))


def _separation(constraint: Inside, points: Array, curve: Curve, norm: Norm) -> Any:
    """The direction with the most room in the metric, piece by piece."""
    region = constraint.region
    states = region.places(points.shape[1])
    centres = np.array([region.center_at(float(t)) for t in curve.middles])
    offsets = points[:, states] - centres
    matrices = [norm.shape[np.ix_(states, states)], np.eye(len(states))]
    if isinstance(region.form, Quadratic):
        shape = region.form.matrix
        options = [round_directions(offsets, shape, m) for m in matrices]
        rooms = [_room(a, offsets, np.sqrt(np.einsum("ki,ij,kj->k", a, shape, a)), matrices[0]) for a in options]
        return exact(np.array(options)[np.argmax(rooms, axis=0), np.arange(len(offsets))])
    faces, bounds = region.form.normals, region.form.bounds
    options = [w for m in matrices for w in polyhedral_weights(offsets, faces, bounds, m)]
    rooms = [_room(w @ faces, offsets, w @ bounds, matrices[0]) for w in options]
    best = np.argmax(rooms, axis=0)
    return exact(np.array(options)[best, np.arange(len(offsets))])


def _room(rows: Array, offsets: Array, heights: Array, inverse: Array) -> Array:
    """(a . offset - height)/|a|_P* for one row a a piece."""
    length = np.sqrt(np.einsum("ki,ij,kj->k", rows, inverse, rows))
    return np.asarray(((rows * offsets).sum(axis=1) - heights) / np.maximum(length, 1e-300))
