"""Stated constants may be assumed, but not against the problem itself: its own noise, its Jacobian where it starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from certbound.arrays import Array
from certbound.constants.bounds import bound_constants
from certbound.constants.enclosures import enclose
from certbound.constants.matching import implies
from certbound.constants.model_data import model_of
from certbound.display import rounded
from certbound.errors import CertboundError
from certbound.problem.model import Tape, compile_numpy, jacobian
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem, DiscreteSystem
from certbound.tubes.constants import Constants

_ROUNDING = 1e-9  # what floating-point evaluations of the problem's own numbers may be wrong by, and more


def refuse_contradiction(problem: Problem, constants: Constants) -> None:
    """Refuse constants that the problem's own numbers contradict, with a ValueError.

    sigma and nu are compared with the constant noise in the constants' metric, g g^T <= sigma^2 P^-1 and tr(P g g^T) <=
    nu sigma^2 (G S G^T with the variance proxy S in discrete time), or with g(0, x) where g depends on the state; rate
    or gain with the Jacobian at x, the middle of the initial set (but for inputs without a plan); the kind of noise
    with what the constants assert. What agrees is not proved by that.
    """
    system = problem.system
    if constants.dimension != system.dimension:
        raise ValueError(f"`constants` must have dimension {system.dimension}, got {constants.dimension}.")
    if isinstance(system, DiscreteSystem) and constants.gaussian and not system.noise.gaussian:
        raise ValueError("`constants` assert Gaussian noise, and the problem's is not; leave `gaussian` out.")
    metric = constants.matrix
    point = problem.initial.middle
    varies = isinstance(system, ContinuousSystem) and isinstance(system.diffusion, Tape)
    sigma = float(np.ravel(constants.sigma)[0]) if varies else float(np.min(constants.sigma))
    _check_noise(constants, sigma, metric @ _covariance(system, point))
    if problem.system.inputs is None or problem.plan is not None:
        _check_jacobian(problem, constants, metric, point)


def refuse_jumps(problem: Problem) -> None:
    """Refuse a model that jumps or is undefined somewhere on its domain (or all of R^n), with an EnclosureError.

    No slope bounds how far two values are apart there, whatever constants are stated; those that are proved are refused
    the same box.
    """
    model = model_of(problem, None, None)
    ranges = [model.ranges[slot] for slot in range(len(model.dynamics.inputs))]
    enclose(model.dynamics, ranges)
    system = problem.system
    if isinstance(system, ContinuousSystem) and isinstance(system.diffusion, Tape):
        enclose(system.diffusion, ranges[: 1 + system.dimension])


def proved_or_stated(problem: Problem, constants: Constants) -> Constants:
    """The constants; without their proof unless they are proved of this very problem.

    A proof knows its numbers and not the problem that it speaks of: constants of another one would be taken for
    certified. They are bounded again in the same metric, and keep their proof where they are no smaller.
    """
    if not constants.certified:
        return constants
    metric = "euclidean" if constants.metric is None else constants.metric
    try:
        again = bound_constants(problem, metric=metric)
    except (CertboundError, ValueError):
        return replace(constants, proof=None)
    return constants if implies(again, constants) else replace(constants, proof=None)


def _covariance(system: ContinuousSystem | DiscreteSystem, point: Array) -> Array:
    """g g^T at the start, or G S G^T."""
    if isinstance(system, DiscreteSystem):
        return np.asarray(system.noise_matrix @ system.noise.proxy @ system.noise_matrix.T)
    g = system.diffusion
    if isinstance(g, Tape):
        with np.errstate(all="ignore"):
            g = np.asarray(compile_numpy(g)(0.0, *point), dtype=float).reshape(system.dimension, -1)
    return np.asarray(g @ g.T)


def _check_noise(constants: Constants, sigma: float, product: Array) -> None:
    """P g g^T, whose eigenvalues are those of P^1/2 g g^T P^1/2."""
    if not np.isfinite(product).all():
        return
    n, values = constants.dimension, np.linalg.eigvals(product).real
    needed = float(np.sqrt(max(values.max(), 0.0)))
    if sigma * (1 + _ROUNDING) < needed:
        least = rounded(needed * (1 - 1e-12), up=True)
        raise ValueError(
            f"`constants.sigma` must be at least {least}, which the problem's own noise has in their metric, "
            f"got {sigma!r}; state a larger one, or leave `constants` out."
        )
    trace = float(np.trace(product))
    if constants.nu * sigma**2 * (1 + 3 * _ROUNDING) < trace:
        least = rounded(trace / sigma**2 * (1 - 1e-12), up=True)
        raise ValueError(
            f"`constants.effective_dimension` must be at least {least}, which the problem's own noise has at "
            f"their sigma, got {constants.nu!r}; leave it out for {n}."
        )
    if constants.isotropic and not np.allclose(product, sigma**2 * np.eye(n), rtol=1e-6, atol=1e-9 * sigma**2):
        raise ValueError("`constants` assert isotropic noise, and the problem's is not; leave `isotropic` out.")


def _check_jacobian(problem: Problem, constants: Constants, metric: Array, point: Array) -> None:
    """mu_P or the norm of D_x f at the start of the horizon."""
    system, n = problem.system, problem.system.dimension
    slope = jacobian(problem.closed_loop, range(1, n + 1))
    rows = problem.input_sequence
    inputs = [] if rows is None else list(rows[0])
    box = system.disturbance
    middle = [] if box is None else list((np.asarray(box.low) + np.asarray(box.high)) / 2)
    with np.errstate(all="ignore"):
        found = np.asarray(compile_numpy(slope)(0.0, *point, *inputs, *middle), dtype=float)
    matrix = found.reshape(n, n)
    if not np.isfinite(matrix).all():
        return
    root = np.linalg.cholesky(metric).T
    turned = root @ matrix @ np.linalg.inv(root)
    if constants.continuous:
        name, needed = "rate", float(np.linalg.eigvalsh((turned + turned.T) / 2)[-1])
    else:
        name, needed = "gain", float(np.linalg.norm(turned, 2))
    given = float(np.ravel(getattr(constants, name))[0])
    if given + 1e-6 * (1 + abs(given)) < needed:
        least = rounded(needed - 1e-9 * (1 + abs(needed)), up=True)
        raise ValueError(
            f"`constants.{name}` must be at least {least}, which the problem's own dynamics have at "
            f"the middle of the initial set in their metric, got {given!r}; state a larger one, or leave `constants` "
            "out."
        )
