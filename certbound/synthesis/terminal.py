"""Terminal sets and costs: from the contraction metric, from the Riccati equation, or the user's own.

- Contraction: with ||f(x) - f(y)||_P <= L ||x - y||_P, L < 1, and an equilibrium c = f(c) under constant inputs, every
  {||z - c||_P <= r} is mapped into itself by those inputs, and the cost beta ||z - c||_P^2 with beta (1 - L^2) P >= Q
  falls by at least the stage cost (CT: -2 c beta P >= Q with the rate c < 0). The largest r that fits into the
  tightened constraints serves.
- Riccati: the infinite-horizon cost and gain of the linearisation at c (python-control's ``lqr`` and ``dlqr``); the
  terminal set is a level set of that cost within the tightened constraints and the input bounds. Nothing is proved
  about it; the plan is verified as a whole.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.problem.model import compile_numpy, jacobian
from certbound.problem.problem import Problem
from certbound.problem.sets import Ellipsoid, Quadratic, Region
from certbound.synthesis.faces import Face, Facets, Round, with_parts
from certbound.synthesis.plant import middle_of
from certbound.tubes.constants import Constants


@dataclass(frozen=True, eq=False, kw_only=True)
class TerminalSet:
    """Where the last nominal state must lie, and what it costs there.

    Parameters
    ----------
    region : Box, Ball, Ellipsoid or Polytope
        Fixed; a box with low == high is a point.
    cost : ndarray, shape (n, n), optional
        End cost (z - center)' cost (z - center); the stage cost's weight when omitted.
    center : ndarray, shape (n,), optional
        The origin when omitted.
    """

    region: Region
    cost: Array | None = None
    center: Array | None = None

    @property
    def rows(self) -> int:
        """Number of scalar constraints."""
        form = self.region.form
        if self.region.is_point:
            return form.dimension
        return 1 if isinstance(form, Quadratic) else len(form.bounds)

    def symbolic(self, ca: Any, state: Any) -> Any:
        """Scalar constraints as CasADi expressions: >= 0, and = 0 for a point."""
        region, form = self.region, self.region.form
        local = ca.vertcat(*[state[i] for i in region.places(state.numel())])
        if region.is_point:
            return local - ca.DM(region.middle)
        offset = local if region.center is None else local - ca.DM(region.center_at())
        if isinstance(form, Quadratic):
            return 1 - ca.bilin(ca.DM(np.linalg.inv(form.matrix)), offset, offset)
        return ca.DM(form.bounds) - ca.DM(form.normals) @ offset

    def room(self, state: Array) -> float:
        """At least 0 inside; a small negative number just outside."""
        region, form = self.region, self.region.form
        if region.is_point:
            return -float(np.max(np.abs(region.local(state) - region.middle)))
        offset = region.local(state) - region.center_at()
        if isinstance(form, Quadratic):
            return 1.0 - float(offset @ np.linalg.solve(form.matrix, offset))
        return float(np.min(form.bounds - form.normals @ offset))


def check_terminal(terminal: TerminalSet, faces: Sequence[Face], erosion: Array, time: float) -> None:
    """Refuse a terminal set that sticks out of the constraints as ``erosion`` (parts,) tightens them at the last time.

    Raises
    ------
    ValueError
        Naming the constraint and by how much it is missed.
    """
    for face, parts in with_parts(faces):
        own = erosion[parts]
        if not face.asked(np.array([time]))[0]:
            continue
        room = _room_of_region(terminal.region, face, own, time)
        if room < -1e-9:
            raise ValueError(
                f"`terminal` must lie inside the tightened constraints at t = {time:g}, but it misses '{face.label}' "
                f"by {-room:.4g} (the tube takes {float(np.max(own)):.4g}); choose a smaller set, or move it."
            )


def _room_of_region(region: Region, face: Face, erosion: Array, time: float) -> float:
    """Least room of the tightened face over the region (a lower bound for round faces)."""
    middle = _middle(region, face.dimension)[None]
    rows = face.rows(middle, np.array([time]))[0]
    room = face.room(middle, np.array([time]), erosion[None])
    if isinstance(face, Facets):
        spread = np.array([float(region.support(a)) - float(a @ middle[0]) for a in rows])
        return float(np.max(face.values(middle, np.array([time]), erosion)[0] - spread))
    reach = max(float(region.support(a)) - float(a @ middle[0]) for a in rows)
    if isinstance(face, Round) and not face.outside:
        reach *= 1.0 if rows.shape[0] == 2 else float(np.sqrt(len(face.coordinates)))
    return float(room[0]) - reach


def _middle(region: Region, dimension: int) -> Array:
    eye = np.eye(region.dimension)
    low, high = -region.local_support(-eye, 0.0), region.local_support(eye, 0.0)
    bounded = np.isfinite(low) & np.isfinite(high)
    ends = np.where(bounded, low, 0.0), np.where(bounded, high, 0.0)
    return region.lifted(np.where(bounded, (ends[0] + ends[1]) / 2, np.clip(0.0, low, high)), dimension)


def linearise(problem: Problem, state: ArrayLike, inputs: ArrayLike) -> tuple[Array, Array]:
    """D_x f and D_u f at a point, with the disturbance in its middle: shapes (n, n), (n, m)."""
    system = problem.system
    n, m = system.dimension, len(system.input_names)
    slopes = compile_numpy(jacobian(system.dynamics, range(1, 1 + n + m)))
    point = [*np.asarray(state, dtype=float), *np.asarray(inputs, dtype=float), *middle_of(system.disturbance)]
    value = slopes(0.0, *point)
    return np.asarray(value[:, :n]), np.asarray(value[:, n:])


def riccati(problem: Problem, state: ArrayLike | None = None) -> tuple[Array, Array, Array]:
    """S (n, n), K (m, n) with u = K z, and A + B K of the linear-quadratic regulator at a state without inputs.

    Without a cost of the problem, Q = I and R = I.

    S is the cost-to-go matrix (python-control).

    Raises
    ------
    ValueError
        If the linearisation cannot be stabilised.
    """
    control = importlib.import_module("control")
    n, m = problem.system.dimension, len(problem.system.input_names)
    a, b = linearise(problem, np.zeros(n) if state is None else state, np.zeros(m))
    weight, effort = problem.cost if problem.cost is not None else (np.eye(n), np.eye(m))
    solve = control.lqr if problem.system.time == "continuous" else control.dlqr
    try:
        gain, value, _ = solve(a, b, np.asarray(weight), np.asarray(effort))
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise ValueError(
            f"`feedback` needs a linearisation that can be stabilised: {error}; check the inputs and the cost's Q."
        ) from error
    return np.asarray(value), -np.asarray(gain), np.asarray(a - b @ gain)


def contraction_terminal(
    problem: Problem, constants: Constants, faces: Sequence[Face], erosion: Array, time: float
) -> TerminalSet:
    """The largest ball of the contraction metric that fits into the tightened constraints, with its cost.

    The constants must contract (a gain below 1, a rate below 0); the erosion is that of the last time.

    Raises
    ------
    ValueError
        If the constants do not contract, or the origin is no equilibrium or lies outside the tightened constraints.
    """
    n = problem.system.dimension
    worst = constants.worst_slope
    if worst >= (0 if constants.continuous else 1):
        raise ValueError(
            f"`terminal` from the contraction metric needs a {'negative rate' if constants.continuous else 'gain < 1'},"
            f" got {worst:.4g}; use terminal='riccati', or a feedback."
        )
    c = _equilibrium(problem)
    metric = constants.matrix
    radius = _largest_level(metric, c, faces, erosion, time)
    weight = np.asarray(problem.cost[0]) if problem.cost is not None else np.zeros((n, n))
    root = np.linalg.inv(np.linalg.cholesky(metric))
    fall = -2 * worst if constants.continuous else 1 - worst**2
    share = float(np.linalg.eigvalsh(root @ weight @ root.T)[-1]) / fall
    region = Ellipsoid(c, np.linalg.inv(metric) * radius**2)
    return TerminalSet(region=region, cost=share * metric, center=c)


def riccati_terminal(problem: Problem, faces: Sequence[Face], erosion: Array, time: float) -> TerminalSet:
    """A level set of the Riccati cost on which the tightened constraints and the regulator's inputs are kept.

    Raises
    ------
    ValueError
        As ``contraction_terminal``, or if the linearisation cannot be stabilised.
    """
    c = _equilibrium(problem)
    value, gain, _ = riccati(problem, c)
    radius = _largest_level(value, c, faces, erosion, time)
    box = problem.system.inputs
    assert box is not None
    reach = np.sqrt(np.einsum("ij,jk,ik->i", gain, np.linalg.inv(value), gain))
    with np.errstate(divide="ignore"):
        room = np.minimum(box.high, -box.low) / reach
    radius = min(radius, float(np.min(room)))
    if radius <= 0:
        raise ValueError("`terminal` needs an equilibrium whose inputs lie inside their bounds.")
    return TerminalSet(region=Ellipsoid(c, np.linalg.inv(value) * radius**2), cost=value, center=c)


def _equilibrium(problem: Problem) -> Array:
    """The origin, at which the system is found to stand still without inputs."""
    system = problem.system
    c = np.zeros(system.dimension)
    idle = np.zeros(len(system.input_names))
    moved = float(np.max(np.abs(compile_numpy(system.dynamics)(0.0, *c, *idle, *middle_of(system.disturbance)))))
    if moved > 1e-6:
        raise ValueError(
            f"`terminal` needs an equilibrium, but at the origin without inputs the state moves by {moved:.3g}; give a "
            "set instead."
        )
    return c


def _largest_level(metric: Array, center: Array, faces: Sequence[Face], erosion: Array, time: float) -> float:
    """Largest r with {||z - c||_P <= r} inside the tightened constraints."""
    inverse = np.linalg.inv(metric)
    best = np.inf
    for face, parts in with_parts(faces):
        own = erosion[parts]
        if not face.asked(np.array([time]))[0]:
            continue
        rows = face.rows(center[None], np.array([time]))[0]
        reach = np.sqrt(np.einsum("ij,jk,ik->i", rows, inverse, rows))
        if isinstance(face, Facets):
            level = float(np.max(face.values(center[None], np.array([time]), own)[0] / reach))
        else:
            taken = face.erosion(reach[None])[0, 0] if isinstance(face, Round) else float(np.max(reach))
            level = float(face.room(center[None], np.array([time]), own[None])[0]) / float(taken)
        if level <= 0:
            raise ValueError(
                f"`terminal` must have its centre inside the tightened constraints, but '{face.label}' is missed there "
                f"at t = {time:g}; the tube takes {float(np.max(own)):.4g}."
            )
        best = min(best, level)
    return float(min(best, 1e6)) * (1 - 1e-9)


