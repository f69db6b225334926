"""Tube MPC as a convex program (cvxpy): linear dynamics, or dynamics linearised along the last prediction.

The program is built once with parameters (the state, the erosions, and A, B, c where the dynamics are not linear) and
solved again at every step by Clarabel or OSQP. Constraints that are not convex are linearised: outside a convex
obstacle the face that separates it from the last prediction. All tightened constraints carry a slack with an exact
penalty, so that a step without a point still gives inputs; the report says so. For linear dynamics the answer is that
of the nonlinear program.
"""

from __future__ import annotations

import importlib
import time as clock
import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.errors import SolverError
from certbound.problem.adapters import casadi_module
from certbound.problem.model import Tape, edged, jacobian
from certbound.problem.problem import Problem
from certbound.synthesis.costs import cost_of
from certbound.synthesis.faces import Face, Facets, Plane, Round, with_parts
from certbound.synthesis.feedback import depends_on
from certbound.synthesis.planning import Planner

PENALTY = 1e4
KEPT = 1e-6
SOLVERS = ("CLARABEL", "OSQP")


@dataclass(frozen=True, eq=False, kw_only=True)
class ConvexPlan:
    """Inputs (N, m) and predicted states (N + 1, n); ``softened`` is the largest slack, 0 where it is below 1e-6."""

    inputs: Array
    states: Array
    cost: float
    softened: float
    seconds: float
    status: str

    @property
    def feasible(self) -> bool:
        """The tightened constraints are kept without slack."""
        return self.softened == 0.0


class ConvexPlanner:
    """Tube MPC over N pieces as a quadratic (with round safe sets: second-order cone) program.

    Parameters
    ----------
    problem : Problem
        With inputs and a quadratic cost.
    horizon : int
        Pieces of the prediction.
    solver : "CLARABEL" or "OSQP"
        OSQP solves quadratic programs only: no balls or ellipsoids to stay inside.
    end : array_like, shape (n, n), optional
        End cost; the stage cost's weight when omitted.
    steps : int, optional
        Pieces of the problem's horizon in continuous time.

    Raises
    ------
    ValueError
        If the horizon is not a positive integer, the solver is unknown or does not fit, or the system has no inputs.

    Examples
    --------
    >>> import certbound as cb
    >>> system = cb.linear_system([[1, 0.1], [0, 1]], [[0], [0.1]], inputs=cb.Box([-2], [2]), time="discrete")
    >>> problem = cb.Problem(
    ...     system, initial=[1, 0], safe=[cb.Inside(cb.Box([-0.5, -0.5], [1.5, 0.5]))], horizon=20,
    ...     cost=([1, 1], [0.01]))
    >>> planner = ConvexPlanner(problem, horizon=20)
    >>> bool(planner.solve([1, 0]).states[:, 1].min() >= -0.5 - 1e-6)
    True
    """

    def __init__(
        self, problem: Problem, *, horizon: int, solver: str = "CLARABEL", end: ArrayLike | None = None,
        steps: int | None = None,
    ) -> None:  # fmt: skip
        if isinstance(horizon, bool) or int(horizon) != horizon or horizon < 1:
            raise ValueError(f"`horizon` must be a positive number of pieces, got {horizon!r}.")
        if solver not in SOLVERS:
            raise ValueError(f"`solver` must be one of {', '.join(SOLVERS)}, got {solver!r}.")
        self.problem, self.solver, self.horizon = problem, solver, int(horizon)
        self.planner = Planner(problem, steps=steps)
        self.faces = self.planner.faces
        inside = [face for face in self.faces if isinstance(face, Round) and not face.outside]
        if inside and solver == "OSQP":
            raise ValueError(f"`solver` 'OSQP' cannot keep '{inside[0].label}'; use 'CLARABEL'.")
        self.cost = cost_of(problem, None, None if end is None else np.asarray(end, dtype=float))
        system = problem.system
        n, m = system.dimension, len(system.input_names)
        slots = range(1 + n + m + len(system.disturbance_names))
        bent = depends_on(jacobian(system.dynamics, range(1, 1 + n + m)), slots)
        self.linear = not bent and not edged(system.dynamics) and not depends_on(system.dynamics, [0])
        self._last: tuple[Array, Array] | None = None

    @cached_property
    def _step(self) -> Any:
        """(z, u, t) -> z+, A, B of one piece."""
        ca = casadi_module()
        plant = self.planner.plant
        z, u, t = ca.SX.sym("z", plant.dimension), ca.SX.sym("u", len(plant.low)), ca.SX.sym("t")
        following = plant.symbolic_step(ca, self.planner.grid, t, z, u)[-1]
        return ca.Function("piece", [z, u, t], [following, ca.jacobian(following, z), ca.jacobian(following, u)])

    @cached_property
    def _program(self) -> Any:
        return _Program(self)

    def solve(
        self, state: ArrayLike, *, time: float = 0.0, erosion: Array | None = None, turns: int | None = None
    ) -> ConvexPlan:
        """Plan from a state.

        Parameters
        ----------
        state : array_like, shape (n,)
        time : float
            Of the state.
        erosion : ndarray, shape (N, parts), optional
            What the tube takes at the ends of the pieces (`Planner.tightened`); nothing when omitted.
        turns : int, optional
            Linearisations: 1 for linear dynamics and convex constraints, otherwise 3 at first and then 1.

        Raises
        ------
        ValueError
            If the state or the erosion has the wrong shape.
        SolverError
            If the solver gives no inputs.
        """
        began = clock.perf_counter()
        start = np.asarray(state, dtype=float)
        parts = sum(face.parts for face in self.faces)
        taken = np.zeros((self.horizon, parts)) if erosion is None else np.asarray(erosion, dtype=float)
        n = self.planner.plant.dimension
        if start.shape != (n,) or taken.shape != (self.horizon, parts):
            raise ValueError(
                f"`state` must hold {n} numbers and `erosion` have shape {(self.horizon, parts)}, got shapes "
                f"{start.shape} and {taken.shape}."
            )
        states, inputs = self._guess(start, time)
        bent = not self.linear or any(isinstance(f, Facets) or (isinstance(f, Round) and f.outside) for f in self.faces)
        count = turns if turns is not None else 1 if not bent else 3 if self._last is None else 1
        for _ in range(count):
            states, inputs, slack, status = self._program.solve(start, time, taken, states, inputs)
        self._last = states, inputs
        grid = replace(self.planner.grid, steps=self.horizon, substeps=1)
        return ConvexPlan(
            inputs=inputs, states=states, cost=self.cost.total(grid, None, states, inputs, time),
            softened=slack if slack > KEPT else 0.0, seconds=clock.perf_counter() - began, status=status,
        )  # fmt: skip

    def _guess(self, start: Array, time: float) -> tuple[Array, Array]:
        """The last prediction one piece later, or the noise-free path of the first guess."""
        if self._last is not None:
            states, inputs = self._last
            return np.concatenate([states[1:], states[-1:]]), np.concatenate([inputs[1:], inputs[-1:]])
        guess = self.planner.guess()[: self.horizon]
        inputs = np.concatenate([guess, np.tile(guess[-1:], (self.horizon - len(guess), 1))])
        found = [start]
        for k in range(self.horizon):
            found.append(self.piece(found[-1], inputs[k], time + k * self.planner.grid.step)[0])
        states = np.array(found)
        if not np.all(np.isfinite(states)) or np.abs(states).max() > 1e6:
            states = np.tile(start, (self.horizon + 1, 1))
        return states, inputs

    def piece(self, state: Array, inputs: Array, time: float) -> tuple[Array, Array, Array]:
        """z+, A and B of one piece."""
        following, a, b = (part.full() for part in self._step(state, inputs, time))
        return following.ravel(), a, b


class _Program:
    """The cvxpy program of one planner."""

    def __init__(self, owner: ConvexPlanner) -> None:
        cp: Any = importlib.import_module("cvxpy")
        self.owner, self.cp = owner, cp
        plant, steps = owner.planner.plant, owner.horizon
        n, m = plant.dimension, len(plant.low)
        self.states, self.inputs = cp.Variable((steps + 1, n)), cp.Variable((steps, m))
        self.slack: Any = cp.Variable((steps, len(owner.faces)), nonneg=True)
        self.start = cp.Parameter(n)
        constraints = [self.states[0] == self.start, *self._dynamics(), *self._bounds()]
        self.fixed: dict[int, Any] = {}
        self.moving: dict[int, tuple[Any, Any]] = {}
        for index, face in enumerate(owner.faces):
            constraints += self._face(index, face)
        self.problem = cp.Problem(cp.Minimize(self._objective()), constraints)

    def _dynamics(self) -> list[Any]:
        cp, owner = self.cp, self.owner
        plant, steps = owner.planner.plant, owner.horizon
        n, m = plant.dimension, len(plant.low)
        if owner.linear:
            zero, self.a, self.b = owner.piece(np.zeros(n), np.zeros(m), 0.0)
            moved = self.states[:-1] @ self.a.T + self.inputs @ self.b.T + np.tile(zero, (steps, 1))
            return [self.states[1:] == moved]
        self.slopes = [cp.Parameter((n, n)) for _ in range(steps)]
        self.gains = [cp.Parameter((n, m)) for _ in range(steps)]
        self.offsets = cp.Parameter((steps, n))
        return [
            self.states[k + 1] == self.slopes[k] @ self.states[k] + self.gains[k] @ self.inputs[k] + self.offsets[k]
            for k in range(steps)
        ]

    def _bounds(self) -> list[Any]:
        plant = self.owner.planner.plant
        found = []
        for i in range(len(plant.low)):
            if np.isfinite(plant.low[i]):
                found.append(self.inputs[:, i] >= plant.low[i])
            if np.isfinite(plant.high[i]):
                found.append(self.inputs[:, i] <= plant.high[i])
        return found

    def _face(self, index: int, face: Face) -> list[Any]:
        cp, steps = self.cp, self.owner.horizon
        ahead, slack = self.states[1:], self.slack[:, index]
        room = cp.Parameter(steps)
        if isinstance(face, Round) and not face.outside:
            center = cp.Parameter((steps, len(face.coordinates)))
            self.fixed[index] = (room, center)
            offset = (ahead[:, list(face.coordinates)] - center) @ face.matrix.T
            return [cp.norm(offset, 2, axis=1) <= room + slack]
        if isinstance(face, Facets | Round):
            rows = cp.Parameter((steps, face.dimension))
            self.moving[index] = (rows, room)
            return [cp.sum(cp.multiply(rows, ahead), axis=1) <= room + slack]
        assert isinstance(face, Plane)
        self.fixed[index] = (room, face.row)
        return [ahead @ face.row <= room + slack]

    def _objective(self) -> Any:
        cp, owner = self.cp, self.owner
        stage = owner.cost.stage
        assert not isinstance(stage, Tape)
        weight, effort = (_root(matrix) for matrix in stage)
        total = owner.planner.grid.step * (
            cp.sum_squares(self.states[:-1] @ weight.T) + cp.sum_squares(self.inputs @ effort.T)
        )
        total += cp.sum_squares((self.states[-1] - owner.cost.center) @ _root(owner.cost.end).T)
        return total + PENALTY * cp.sum(self.slack)

    def solve(
        self, start: Array, time: float, taken: Array, states: Array, inputs: Array
    ) -> tuple[Array, Array, float, str]:
        """One solution, linearised along (states, inputs); with the largest slack and the solver's word."""
        owner = self.owner
        self.start.value = start
        step, steps = owner.planner.grid.step, owner.horizon
        times = np.asarray(time + step * np.arange(1, steps + 1), dtype=float)
        if not owner.linear:
            offsets = []
            for k in range(steps):
                following, a, b = owner.piece(states[k], inputs[k], time + k * step)
                self.slopes[k].value, self.gains[k].value = a, b
                offsets.append(following - a @ states[k] - b @ inputs[k])
            self.offsets.value = np.array(offsets)
        for index, (face, parts) in enumerate(with_parts(owner.faces)):
            self._place(index, face, states[1:], times, taken[:, parts])
        first_order = {"eps_abs": 1e-5, "eps_rel": 1e-5, "max_iter": 50_000}
        options = {"warm_start": True} | (first_order if owner.solver == "OSQP" else {})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                self.problem.solve(solver=owner.solver, **options)
            except self.cp.SolverError as error:
                raise SolverError(f"{owner.solver} gave no plan: {error}; scale the states to like sizes.") from error
        if self.inputs.value is None:
            raise SolverError(f"{owner.solver} gave no plan ({self.problem.status}); scale the states to like sizes.")
        plant = owner.planner.plant
        kept = np.clip(np.asarray(self.inputs.value), plant.low, plant.high)
        slack = float(np.max(self.slack.value, initial=0.0))
        return np.asarray(self.states.value), kept, slack, str(self.problem.status)

    def _place(self, index: int, face: Face, states: Array, times: Array, taken: Array) -> None:
        """Numbers of one face: its bound less what the tube takes, and the rows where they move."""
        asked = face.asked(times)
        far = 1e4 * (1 + np.abs(states).max())  # where nothing is asked
        if isinstance(face, Round) and not face.outside:
            room, center = self.fixed[index]
            room.value = np.where(asked, face.size - taken[:, 0], far)
            center.value = states[:, list(face.coordinates)] - face.local(states, times)
            return
        if index in self.fixed:
            room, row = self.fixed[index]
            room.value = np.where(asked, face.room(states, times, taken) + states @ row, far)
            return
        rows, room = self.moving[index]
        candidates = face.rows(states, times)
        if isinstance(face, Facets):
            best = np.argmax(face.best(states, times, taken), axis=1)
            chosen = candidates[np.arange(len(states)), best]
        else:
            chosen = candidates[:, 0]
        rows.value = np.where(asked[:, None], chosen, 0.0)
        room.value = np.where(asked, face.room(states, times, taken) + np.sum(chosen * states, axis=1), far)


def _root(matrix: Array) -> Array:
    """R with R'R = matrix."""
    values, vectors = np.linalg.eigh(np.asarray(matrix, dtype=float))
    kept = values > 0
    return np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T) if kept.any() else np.zeros((1, len(matrix)))
