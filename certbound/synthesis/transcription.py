"""Optimal control of the noise-free system by multiple shooting, from the same tape as everything else.

Decision variables are the inputs u_0 ... u_{N-1} and the states at the ends of the pieces; z_0 is a parameter. In
continuous time a piece is integrated by the classical Runge-Kutta method in ``substeps`` steps, whose ends are where
the constraints are imposed. Three programs over the same variables (h: faces, e: erosions, J: cost):

- ``cost``: min J subject to h >= e;
- ``scale``: max s subject to h >= s e: how many times larger the tube may be, and what it takes from the inputs;
- ``soft``: min J + penalty * xi subject to h >= e - xi, 0 <= xi <= e: xi is reported. What is taken from the inputs and
  the terminal set are softened too; the bounds of the inputs stay hard.

A solver's word counts for nothing here: `Transcription.solve` rolls the inputs out and measures the constraints again.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from certbound.arrays import Array
from certbound.problem.adapters import casadi_module
from certbound.synthesis.costs import Cost
from certbound.synthesis.faces import Face, Facets, with_parts
from certbound.synthesis.plant import Grid, Plant
from certbound.synthesis.terminal import TerminalSet

Mode = Literal["cost", "scale", "soft"]

PENALTY = 1e4
END_PENALTY = 10.0
"""Of missing the terminal set in mode ``soft``: the constraints come first."""
EFFORT = 1e-9
TOLERANCE = 1e-6
ROUNDING = 1e-7
"""Taken from the input bounds where nothing else is: a proof needs some room."""
LARGEST_SCALE = 1e3
_UNBOUNDED = 1e19  # what IPOPT takes for infinity


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """A plan that a solver proposed and a rollout measured."""

    inputs: Array  # (N, m)
    states: Array  # (points + 1, n): rolled out from the inputs
    # the rollout meets every tightened constraint up to `TOLERANCE` (with slack in mode ``soft``: the solver
    # ended well)
    success: bool
    scale: float  # s; 1 outside mode ``scale``
    cost: float
    slack: Array  # (points, faces): by how much each tightened constraint is missed
    pressure: Array  # (points, faces): multipliers of the tightened constraints: where they hold the plan back
    input_pressure: Array  # (points + 1,): the same of the input bounds that a feedback tightens
    status: str  # the solver's word
    seconds: float
    iterations: int


class Transcription:
    """One family of optimal control problems: grid, plant, faces and cost are fixed, start and erosions vary.

    ``terminal`` is where the last state must lie; ``warm``: a solve begins at the multipliers of the last one.
    """

    def __init__(
        self, plant: Plant, grid: Grid, faces: Sequence[Face], cost: Cost, *, terminal: TerminalSet | None = None,
        warm: bool = False,
    ) -> None:  # fmt: skip
        self.plant, self.grid, self.faces, self.cost, self.terminal = plant, grid, tuple(faces), cost, terminal
        self.warm = warm
        self.parts = sum(face.parts for face in self.faces)
        self.weights = sum(face.weights for face in self.faces)
        self._duals: dict[str, tuple[Array, Array]] = {}
        self._solvers: dict[str, Any] = {}

    # ---- the program -------------------------------------------------------------------------------------

    def _build(self, mode: Mode) -> Any:
        """The solver of one mode; variables [u, x] piece by piece, then weights, then s or xi."""
        ca = casadi_module()
        grid, n, m = self.grid, self.plant.dimension, len(self.plant.low)
        start, t0 = ca.SX.sym("z0", n), ca.SX.sym("t0")
        erosion = ca.SX.sym("e", self.parts, grid.points)
        tightening = ca.SX.sym("f", m, grid.points + 1)
        weights = ca.SX.sym("w", self.weights, grid.points)
        scale = ca.SX.sym("s")
        slack = ca.SX.sym("xi", len(self.faces), grid.points)
        freed = ca.SX.sym("xi_u", m, grid.points + 1)
        held = tightening - freed if mode == "soft" else tightening * ca.fmax(scale, 0)
        state, variables = start, []
        dynamics, gaps, choices, inputs_of = [], [], [], []
        total: Any = 0
        for k in range(grid.steps):
            u, following = ca.SX.sym(f"u{k}", m), ca.SX.sym(f"x{k + 1}", n)
            variables += [u, following]
            now = t0 + k * grid.step
            total += grid.step * self.cost.symbolic(ca, now, state, self._applied(ca, u, state))
            inputs_of.append(self._input_rows(ca, u, state, held[:, k * grid.substeps]))
            points = self.plant.symbolic_step(ca, grid, now, state, u)
            for i, point in enumerate(points):
                index = k * grid.substeps + i
                at = now + (i + 1) * grid.step / grid.substeps
                if i < grid.substeps - 1:
                    inputs_of.append(self._input_rows(ca, u, point, held[:, index + 1]))
                else:
                    dynamics.append(following - point)
                    point = following
                    if grid.continuous:
                        inputs_of.append(self._input_rows(ca, u, point, held[:, index + 1]))
                gap, choice = self._gaps(ca, point, at, erosion[:, index] * scale, weights[:, index])
                gaps.append(gap + (slack[:, index] if mode == "soft" else 0))
                choices.append(choice)
            state = following
        total += self.cost.symbolic_end(ca, state)
        last = ca.SX(0, 1) if self.terminal is None else self.terminal.symbolic(ca, state)
        ends = ca.SX.sym("xi_T", last.numel(), 2)  # above and below
        free = [ca.vec(weights)]
        if mode == "scale":
            objective = -scale + EFFORT * sum(ca.sumsqr(u) for u in variables[::2])
            free.append(scale)
        else:
            objective = total
        if mode == "soft":
            objective += PENALTY * (ca.sum1(ca.vec(slack)) + ca.sumsqr(slack))
            objective += PENALTY * ca.sum1(ca.vec(freed)) + END_PENALTY * ca.sum1(ca.vec(ends))
            free += [ca.vec(slack), ca.vec(freed), ca.vec(ends)]
            last = last + ends[:, 0] - ends[:, 1]
        variable = ca.vertcat(*variables, *free)
        constraint = ca.vertcat(*dynamics, *gaps, *choices, *inputs_of, last)
        parameter = ca.vertcat(start, t0, ca.vec(erosion), ca.vec(tightening))
        if mode != "scale":
            constraint, objective = (ca.substitute(part, scale, 1) for part in (constraint, objective))
        program = {"x": variable, "p": parameter, "f": objective, "g": constraint}
        return ca.nlpsol("plan", "ipopt", program, _ipopt(self.warm))

    def _applied(self, ca: Any, u: Any, state: Any) -> Any:
        return u if self.plant.feedback is None else u + ca.DM(self.plant.feedback) @ state

    def _input_rows(self, ca: Any, u: Any, state: Any, tightening: Any) -> Any:
        """Room of the plant's own input below and above; nothing where the decision is the input."""
        if self.plant.feedback is None:
            return ca.SX(0, 1)
        own = self._applied(ca, u, state)
        low, high = self.plant.input_low, self.plant.input_high
        assert low is not None
        assert high is not None
        rows = [own[i] - low[i] - tightening[i] for i in np.flatnonzero(np.isfinite(low))]
        rows += [high[i] - own[i] - tightening[i] for i in np.flatnonzero(np.isfinite(high))]
        return ca.vertcat(*rows) if rows else ca.SX(0, 1)

    def _gaps(self, ca: Any, state: Any, time_: Any, erosion: Any, weights: Any) -> tuple[Any, Any]:
        gaps, choices, weight = [], [], 0
        for face, parts in with_parts(self.faces):
            own = weights[weight : weight + face.weights]
            gaps.append(face.gap(ca, state, time_, erosion[parts], own))
            if face.weights:
                choices.append(ca.sum1(own) - 1)
            weight += face.weights
        return ca.vertcat(*gaps), ca.vertcat(*choices) if choices else ca.SX(0, 1)

    # ---- solving -----------------------------------------------------------------------------------------

    def solve(
        self,
        mode: Mode,
        start: Array,
        erosion: Array,
        guess: Array,
        *,
        time_: float = 0.0,
        tightening: Array | None = None,
    ) -> Solution:
        """Solve one mode from a guess of the inputs.

        Parameters
        ----------
        mode : {"cost", "scale", "soft"}
        start : ndarray, shape (n,)
        erosion : ndarray, shape (points, parts)
        guess : ndarray, shape (N, m)
        time_ : float
            Of the start.
        tightening : ndarray, shape (points + 1, m), optional
            Erosion of the input bounds by the feedback.
        """
        began = time.perf_counter()
        states = self.rollout(start, guess, time_)
        states = np.nan_to_num(np.clip(states, -1e8, 1e8))
        times = self.grid.times(time_)
        taken = np.zeros((self.grid.points + 1, len(self.plant.low))) if tightening is None else tightening
        if mode not in self._solvers:
            self._solvers[mode] = self._build(mode)
        lower, upper = self._bounds(mode, erosion, taken)
        g_lower, g_upper = self._sides(times)
        arguments = {
            "x0": self._variables(mode, guess, states, times, erosion),
            "p": np.concatenate([start, [time_], erosion.ravel(), taken.ravel()]),
            "lbx": lower, "ubx": upper, "lbg": g_lower, "ubg": g_upper,
        }  # fmt: skip
        if self.warm and mode in self._duals:
            arguments["lam_x0"], arguments["lam_g0"] = self._duals[mode]
        solver = self._solvers[mode]
        found = solver(**arguments)
        stats = solver.stats()
        if self.warm and stats["success"]:
            self._duals[mode] = (np.array(found["lam_x"]).ravel(), np.array(found["lam_g"]).ravel())
        multipliers = np.abs(np.array(found["lam_g"]).ravel())
        values = np.array(found["x"]).ravel()
        return self._measured(mode, values, multipliers, start, time_, erosion, taken, stats, began)

    @cached_property
    def _rolled(self) -> Any:
        """The rollout as one function: a tenth of the time of `Plant.rollout`, which it equals up to rounding."""
        ca = casadi_module()
        n, m = self.plant.dimension, len(self.plant.low)
        start, t0, inputs = ca.SX.sym("z", n), ca.SX.sym("t"), ca.SX.sym("u", m, self.grid.steps)
        state, found = start, [start]
        for k in range(self.grid.steps):
            found += self.plant.symbolic_step(ca, self.grid, t0 + k * self.grid.step, state, inputs[:, k])
            state = found[-1]
        return ca.Function("rollout", [start, t0, inputs], [ca.horzcat(*found)])

    def rollout(self, start: Array, inputs: Array, time_: float = 0.0) -> Array:
        """Noise-free states at all points, shape (points + 1, n)."""
        return np.array(self._rolled(start, time_, inputs.T)).T

    def _sizes(self) -> tuple[int, int]:
        n, m = self.plant.dimension, len(self.plant.low)
        return self.grid.steps * (n + m), self.weights * self.grid.points

    def _bounds(self, mode: Mode, erosion: Array, taken: Array) -> tuple[Array, Array]:
        n = self.plant.dimension
        weights = self._sizes()[1]
        piece_low = np.concatenate([self.plant.low, np.full(n, -np.inf)])
        piece_high = np.concatenate([self.plant.high, np.full(n, np.inf)])
        low = [np.tile(piece_low, self.grid.steps), np.zeros(weights)]
        high = [np.tile(piece_high, self.grid.steps), np.ones(weights)]
        if mode == "scale":
            low.append(np.array([-LARGEST_SCALE]))
            high.append(np.array([LARGEST_SCALE]))
        elif mode == "soft":
            ends = np.zeros(0 if self.terminal is None else 2 * self.terminal.rows)
            freed = np.maximum(taken - ROUNDING, 0.0)
            freed[0] = freed[1] if self.grid.continuous else 0.0  # the rest is what the initial set takes
            low += [np.zeros(len(self.faces) * self.grid.points), np.zeros(taken.size), ends]
            high += [self._allowed(erosion).ravel(), freed.ravel(), np.full(ends.size, np.inf)]
        return np.concatenate(low), np.concatenate(high)

    def _allowed(self, erosion: Array) -> Array:
        """Largest slack (points, faces): what the tube takes, so that the constraints themselves stay hard."""
        return np.stack([erosion[:, parts].max(axis=1) for _, parts in with_parts(self.faces)], axis=1)

    def _sides(self, times: Array) -> tuple[Array, Array]:
        asked = np.stack([face.asked(times[1:]) for face in self.faces], axis=1) if self.faces else np.zeros((0, 0))
        gaps = np.where(asked, 0.0, -_UNBOUNDED).ravel()
        equal = self.grid.steps * self.plant.dimension
        unions = sum(1 for face in self.faces if face.weights) * self.grid.points
        rest = self._input_row_count()
        last = np.zeros(0 if self.terminal is None else self.terminal.rows)
        last_high = np.full(len(last), 0.0 if self.terminal is not None and self.terminal.region.is_point else np.inf)
        low = np.concatenate([np.zeros(equal), gaps, np.zeros(unions + rest), last])
        open_ = [np.full(gaps.size, np.inf), np.zeros(unions), np.full(rest, np.inf), last_high]
        return low, np.concatenate([np.zeros(equal), *open_])

    def _input_row_count(self) -> int:
        if self.plant.feedback is None:
            return 0
        finite = np.isfinite(self.plant.input_low).sum() + np.isfinite(self.plant.input_high).sum()  # type: ignore[arg-type]
        return int(finite) * self.grid.steps * (1 + self.grid.substeps - (0 if self.grid.continuous else 1))

    def _variables(self, mode: Mode, inputs: Array, states: Array, times: Array, erosion: Array) -> Array:
        ends, m = states[self.grid.substeps :: self.grid.substeps], len(self.plant.low)
        body = np.concatenate([inputs, ends], axis=1).ravel()
        weights = []
        for face, parts in with_parts(self.faces):
            if isinstance(face, Facets):
                chosen = face.best(states[1:], times[1:], erosion[:, parts])
                weights.append(0.9 * chosen + 0.1 / face.weights)
        extra = [np.concatenate(weights, axis=1).ravel()] if weights else []
        if mode == "scale":
            extra.append(np.zeros(1))
        elif mode == "soft":
            extra.append(np.maximum(self.missing(states, times, erosion), 0.0).ravel())
            extra.append(np.zeros((self.grid.points + 1) * m))
            extra.append(np.zeros(0 if self.terminal is None else 2 * self.terminal.rows))
        return np.concatenate([body, *extra])

    def missing(self, states: Array, times: Array, erosion: Array, scale: float = 1.0) -> Array:
        """e - h at the points, shape (points, faces): positive where a tightened constraint is missed."""
        found = []
        for face, parts in with_parts(self.faces):
            room = face.room(states[1:], times[1:], scale * erosion[:, parts])
            found.append(np.where(face.asked(times[1:]), -room, -np.inf))
        return np.stack(found, axis=1) if found else np.zeros((len(states) - 1, 0))

    def _measured(
        self, mode: Mode, values: Array, multipliers: Array, start: Array, time_: float, erosion: Array, taken: Array,
        stats: dict[str, Any], began: float,
    ) -> Solution:  # fmt: skip
        """Roll the proposed inputs out and measure what they keep."""
        n, m = self.plant.dimension, len(self.plant.low)
        body, _ = self._sizes()
        inputs = np.clip(values[:body].reshape(self.grid.steps, m + n)[:, :m], self.plant.low, self.plant.high)
        scale = float(values[-1]) if mode == "scale" else 1.0
        inputs, states = self._within_bounds(inputs, self.rollout(start, inputs, time_), time_)
        times = self.grid.times(time_)
        missing = np.nan_to_num(self.missing(states, times, erosion, scale), nan=np.inf)
        worst = float(missing.max(initial=-np.inf))
        kept = bool(np.all(np.isfinite(states)) and worst <= TOLERANCE * (1 + np.abs(states).max(initial=0.0)))
        kept = kept and self._inputs_kept(inputs, states, taken * max(scale, 0.0))
        kept = kept and (self.terminal is None or self.terminal.room(states[-1]) >= -TOLERANCE)
        first = self.grid.steps * n
        good = bool(stats["success"]) if mode == "soft" else kept
        return Solution(
            inputs=inputs, states=states, success=good, scale=scale,
            cost=self.cost.total(self.grid, self.plant.feedback, states, inputs, time_),
            slack=np.maximum(missing, 0.0),
            pressure=multipliers[first : first + missing.size].reshape(missing.shape),
            input_pressure=self._input_pressure(multipliers[first + missing.size :]),
            status=str(stats["return_status"]),
            seconds=time.perf_counter() - began, iterations=int(stats["iter_count"]),
        )  # fmt: skip

    def _within_bounds(self, inputs: Array, states: Array, time_: float) -> tuple[Array, Array]:
        """A proposal whose own inputs u = w + K z leave their bounds with these cut off at the starts of its pieces."""
        low, high = self.plant.input_low, self.plant.input_high
        if self.plant.feedback is None or low is None or high is None or not np.all(np.isfinite(states)):
            return inputs, states
        own = self.applied_inputs(inputs, states)[:: self.grid.substeps]
        if np.all((own >= low) & (own <= high)):
            return inputs, states
        inner = np.minimum(ROUNDING, (high - low) / 2)
        found, state, passed = [], states[0], [states[0]]
        for k, given in enumerate(inputs):
            moved = self.plant.feedback @ state
            found.append(np.clip(given + moved, low + inner, high - inner) - moved)
            passed += list(self.plant.step(self.grid, time_ + k * self.grid.step, state, found[-1]))
            state = passed[-1]
        return np.array(found), np.array(passed)

    def _input_pressure(self, multipliers: Array) -> Array:
        """Largest multiplier of the input rows at every point, from those behind the gaps."""
        result, count = np.zeros(self.grid.points + 1), self._input_row_count()
        if count:
            unions = sum(1 for face in self.faces if face.weights) * self.grid.points
            blocks = 1 + self.grid.substeps - (0 if self.grid.continuous else 1)
            rows = multipliers[unions : unions + count].reshape(self.grid.steps, blocks, -1).max(axis=2)
            for piece, block in np.ndindex(*rows.shape):
                point = piece * self.grid.substeps + block
                result[point] = max(result[point], rows[piece, block])
        return result

    def _inputs_kept(self, inputs: Array, states: Array, taken: Array) -> bool:
        if self.plant.feedback is None:
            return True
        own = self.applied_inputs(inputs, states)
        first = taken[:-1]
        low, high = self.plant.input_low, self.plant.input_high
        slack = TOLERANCE * (1 + np.abs(own).max(initial=0.0))
        return bool(np.all(own >= low + first - slack) and np.all(own <= high - first + slack))  # type: ignore[operator]

    def inputs_missing(self, inputs: Array, states: Array, taken: Array) -> float:
        """By how much the plant's own inputs miss their tightened bounds at most; 0 where they keep them."""
        low, high = self.plant.input_low, self.plant.input_high
        if self.plant.feedback is None or low is None or high is None:
            return 0.0
        own, first = self.applied_inputs(inputs, states), taken[:-1]
        return float(max(np.max(low + first - own), np.max(own - (high - first)), 0.0))

    def applied_inputs(self, inputs: Array, states: Array) -> Array:
        """The plant's own nominal input at the start of every substep, shape (points, m)."""
        held = np.repeat(inputs, self.grid.substeps, axis=0)
        if self.plant.feedback is None:
            return held
        return np.asarray(held + states[:-1] @ self.plant.feedback.T)


def _ipopt(warm: bool) -> dict[str, Any]:
    options: dict[str, Any] = {
        "print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 500, "ipopt.tol": 1e-8,
        "ipopt.constr_viol_tol": 1e-8, "ipopt.acceptable_tol": 1e-6, "error_on_fail": False,
    }  # fmt: skip
    if warm:
        options |= {
            "ipopt.max_iter": 150, "ipopt.tol": 1e-6, "ipopt.mu_init": 1e-3, "ipopt.warm_start_init_point": "yes",
            "ipopt.warm_start_bound_push": 1e-6, "ipopt.warm_start_mult_bound_push": 1e-6,
            "ipopt.warm_start_slack_bound_push": 1e-6, "ipopt.mu_strategy": "monotone",
        }  # fmt: skip
    return options
