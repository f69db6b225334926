"""Plans for stochastic control: a deterministic optimal control problem with eroded constraints, then a verdict.

The optimiser sees the noise-free state z and constraints tightened by what the tube takes, h(t, z) >= e. What is
guaranteed is only what ``verify_safety`` proves of the plan that comes out: with it, P(some constraint is broken at
some time) <= delta for the noisy system under the same inputs.

- Tubes from constants (by name): c, L, sigma in one common metric; the Kummer tube is fitted to the room that the plan
  leaves, and the plan to the tube, in turns.
- The linear response depends on the plan: plan and tube are iterated to a fixed point.

Source: Thm 1 and eq. (controller condition) of Sec. VII-B (paper); Thms K1, K4, K7 (theory).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.checks import instance
from certbound.constants.bounds import bound_constants
from certbound.errors import InfeasibleError
from certbound.problem.goals import check_end
from certbound.problem.model import jacobian
from certbound.problem.problem import Problem
from certbound.problem.sets import Region
from certbound.synthesis.costs import Cost, cost_of
from certbound.synthesis.faces import Face, faces_of, with_parts
from certbound.synthesis.feedback import close_loop, constrain_inputs, depends_on, resolve_feedback
from certbound.synthesis.plant import Grid, Plant, middle_of
from certbound.synthesis.terminal import TerminalSet, check_terminal, contraction_terminal, riccati_terminal
from certbound.synthesis.tightening import (
    BallTube,
    Tightening,
    ball_tube,
    linear_tube,
    nominal_spread,
    spread_tube,
    tighten,
)
from certbound.synthesis.transcription import ROUNDING, Mode, Solution, Transcription
from certbound.tubes.constants import Constants
from certbound.tubes.tube import Tube
from certbound.tubes.tuning import tune_tube

PIECES = 40
SUBSTEPS = 2
FITTED = ("kummer", "bessel")
"""Tubes that are fitted to the room of the plan."""


def check_tube(problem: Problem, tube: Tube) -> None:
    """Refuse a tube that ends before the problem, and what is no tube."""
    if not isinstance(tube, Tube):
        raise TypeError(f"`tube` must be a cb.Tube, got {tube!r}; the name of one goes under `method`.")
    if tube.horizon < problem.horizon:
        raise ValueError(f"`tube` must cover the horizon {problem.horizon:g}, got one up to {tube.horizon:g}.")


@dataclass(frozen=True, eq=False, kw_only=True)
class Tightened:
    """A tube along a plan and what it takes."""

    erosion: Array  # (points, parts)
    inputs: Array  # (points + 1, m): taken from the input bounds by the feedback
    tube: Tube | None = None  # where it comes from constants

    def more(self, factor: float, extra: Array) -> Tightened:
        """Everything larger by a factor, and the erosions by ``extra`` (parts,) on top."""
        return replace(self, erosion=self.erosion * factor + extra, inputs=self.inputs * factor)


@dataclass(frozen=True, eq=False, kw_only=True)
class Path:
    """Inputs (N, m), and the noise-free states (points + 1, n) that they lead to."""

    inputs: Array
    states: Array


class Planner:
    """One problem, one grid, one cost; plans for any tube.

    Parameters
    ----------
    problem : Problem
        With inputs; its plan, if any, is the first guess.
    stage_cost : callable, optional
        stage(t, x, u); the problem's quadratic cost when omitted.
    terminal : "contraction", "riccati", TerminalSet, Region or None
    feedback : "riccati", "lmi", array_like of shape (m, n) or None
    steps : int, optional
        Pieces of the horizon (continuous time).
    """

    def __init__(
        self,
        problem: Problem,
        *,
        stage_cost: Callable[..., Any] | None = None,
        terminal: str | TerminalSet | Region | None = None,
        feedback: str | ArrayLike | None = None,
        steps: int | None = None,
    ) -> None:
        instance("problem", problem, Problem)
        system = problem.system
        if system.inputs is None:
            raise ValueError(
                "`problem` must have inputs to plan; give the system `inputs=` ([inputs] in a problem file)."
            )
        self.problem = problem
        self.grid = _grid(problem, steps)
        self.start = problem.initial.middle
        self.feedback = None if feedback is None else resolve_feedback(problem, feedback, self.start)
        if self.feedback is not None:
            self._check_start(self.feedback)
        self.system = system if self.feedback is None else close_loop(system, self.feedback)
        self.plant = _plant(problem, self.system.dynamics, self.feedback)
        self.faces: tuple[Face, ...] = faces_of(problem)
        if not self.faces:
            raise ValueError("`problem` must have a constraint that bounds something.")
        self.terminal_name = terminal
        self.terminal = _given_terminal(problem, terminal)
        self.stage_cost = stage_cost
        self.cost = self._cost()
        self.program = self._program()
        self._factors: dict[float, dict[object, float]] = {}

    def _cost(self) -> Cost:
        end = None if self.terminal is None else self.terminal.cost
        center = None if self.terminal is None else self.terminal.center
        return cost_of(self.problem, self.stage_cost, end, center)

    def _program(self) -> Transcription:
        return Transcription(self.plant, self.grid, self.faces, self.cost, terminal=self.terminal)

    @property
    def nominal(self) -> Problem:
        """The problem with the closed loop's system, without a plan."""
        cost = self.problem.cost if self.feedback is None else None
        return self.problem.replace(system=self.system, plan=None, cost=cost)

    def planned(self, solution: Solution, tightened: Tightened) -> Problem:
        """The problem that the verdict is about: the closed loop under a plan, its input bounds included."""
        if self.feedback is None:
            return self.problem.replace(plan=solution.inputs)
        moved = solution.states @ self.feedback.T
        used = np.concatenate([moved + tightened.inputs, -moved + tightened.inputs], axis=1)
        per_piece = [
            used[k * self.grid.substeps : (k + 1) * self.grid.substeps + (1 if self.grid.continuous else 0)].max(axis=0)
            for k in range(self.grid.steps)
        ]
        bounds = constrain_inputs(self.problem, self.feedback, solution.inputs, np.array(per_piece))
        safe = [*self.problem.safe, *bounds]
        return self.problem.replace(system=self.system, plan=solution.inputs, cost=None, safe=safe)

    # ---- tubes -------------------------------------------------------------------------------------------

    def tightened(self, tube: Tightening, states: Array, source: Tube | None = None) -> Tightened:
        """What a tube takes from every face, and from the inputs."""
        times = self.grid.times()
        inputs = np.zeros((len(times), len(self.plant.low)))
        if self.feedback is not None:
            gain = self.feedback
            two = np.concatenate([gain, -gain])

            def rows(x: Array, t: Array) -> Array:
                return np.broadcast_to(two, (len(x), *two.shape))

            both = tube.extents(rows, states[1:], times[1:], "inputs")
            inputs[1:] = np.maximum(both[:, : len(gain)], both[:, len(gain) :])
            inputs[0] = self._initial_inputs(gain) + (inputs[1] if self.grid.continuous else ROUNDING)
        return Tightened(erosion=tighten(tube, self.faces, states, times), inputs=inputs, tube=source)

    def _initial_inputs(self, gain: Array) -> Array:
        initial = self.problem.initial
        if initial.random:
            return np.zeros(len(gain))
        return np.asarray(np.maximum(initial.support(gain) - gain @ self.start, 0.0))

    def _check_start(self, gain: Array) -> None:
        """Refuse a feedback that alone takes more of the first input than there is, over the initial set."""
        box, moved = self.problem.system.inputs, self._initial_inputs(gain)
        assert box is not None
        for name, taken, room in zip(self.problem.system.input_names, moved, (box.high - box.low) / 2):
            if taken + ROUNDING > room:
                raise ValueError(
                    f"`feedback` must leave the first input room: over the initial set K x alone moves {name} by "
                    f"{taken:.4g} to either side, and its bounds allow {room:.4g}; choose a smaller initial set, or a "
                    "smaller gain."
                )

    def first_plan(self) -> Solution:
        """The plan with the most room, in standard deviations of the linearised noise."""
        guess = self.guess()
        best: Solution | None = None
        for _ in range(2):
            states = self.program.rollout(self.start, guess)
            if not np.all(np.isfinite(states)) or np.abs(states).max() > 1e6:
                states = np.tile(self.start, (self.grid.points + 1, 1))
            shape = self.tightened(spread_tube(self.problem, self.plant, self.grid, states, guess), states)
            found = self.plan("scale", shape, guess)
            if not np.all(np.isfinite(found.states)):
                break
            best = found
            guess = found.inputs
        if best is None:
            raise InfeasibleError("no finite noise-free path was found; check the dynamics, or give a `plan`.")
        return best

    def guess(self) -> Array:
        """A first plan: the problem's own, or inputs in the middle of their bounds."""
        rows = self.problem.input_sequence
        if rows is not None:
            held = rows[np.arange(self.grid.steps) * len(rows) // self.grid.steps]
            if self.feedback is None:
                return np.asarray(held)
            plain = replace(self.plant, dynamics=self.problem.system.dynamics, feedback=None)
            states = plain.rollout(self.grid, self.start, held)[:: self.grid.substeps]
            return np.asarray(held - np.nan_to_num(states[:-1]) @ self.feedback.T)
        box = self.problem.system.inputs
        assert box is not None
        bounded = np.isfinite(box.low) & np.isfinite(box.high)
        low, high = np.where(bounded, box.low, 0.0), np.where(bounded, box.high, 0.0)
        middle = np.where(bounded, (low + high) / 2, np.clip(0.0, box.low, box.high))
        if self.feedback is not None:
            middle = middle - self.feedback @ self.start
        return np.tile(middle, (self.grid.steps, 1))

    def constants(self, plan: Array, *, metric: Any = None) -> Constants:
        """Certified constants in the one common metric, for every input that the problem allows.

        The metric is chosen around ``plan`` (N, m), unless ``metric`` names one: "euclidean", or a matrix (n, n).

        Raises
        ------
        ValueError
            If the Jacobian depends on inputs without bounds.
        """
        nominal = self.nominal
        dynamics = self.system.dynamics
        n, m = self.system.dimension, len(self.system.input_names)
        slots = range(1 + n, 1 + n + m)
        involved = depends_on(jacobian(dynamics, range(1, 1 + n)), slots)
        box = self.system.inputs
        assert box is not None
        if involved and not box.bounded:
            raise ValueError(
                "`inputs` must be bounded: the Jacobian depends on them, so that no constants hold for all inputs; "
                "give cb.Box(low, high), or method='linear'."
            )
        if n == 1 or metric is not None:
            return bound_constants(nominal, metric="euclidean" if metric is None else metric)
        proposed = bound_constants(nominal.replace(plan=plan), objective="erosion")
        if not involved:
            return proposed
        return bound_constants(nominal, metric="euclidean" if proposed.metric is None else proposed.metric)

    def tube_of(
        self, constants: Constants, method: str, delta: float, solution: Solution, parameters: Mapping[str, Any]
    ) -> Tube:
        """A tube by name; a fitted one serves the room that a plan leaves."""
        objective: Any = "max"
        if method in FITTED:
            objective = self._clearance(constants, solution)
        horizon = self.problem.horizon
        return tune_tube(constants, horizon=horizon, delta=delta, objective=objective, method=method, **parameters)

    def _clearance(self, constants: Constants, solution: Solution) -> Any:
        """Room of a plan in the metric, as a clearance profile; 'max' where it leaves none."""
        times = self.grid.times()
        unit = BallTube(radii=np.ones(self.grid.points), inverse=constants.inverse)
        factor = self.tightened(unit, solution.states)
        room = np.full(self.grid.points, np.inf)
        for face, parts in with_parts(self.faces):
            own = factor.erosion[:, parts].max(axis=1)
            value = face.room(solution.states[1:], times[1:]) / np.maximum(own, 1e-300)
            room = np.minimum(room, np.where(face.asked(times[1:]), value, np.inf))
        spread = nominal_spread(self.problem, self.plant, self.grid, constants, solution.states, solution.inputs)
        room = room - spread[1:]
        if not np.any(np.isfinite(room)):
            return "max"
        room = np.maximum(room, 0.05 * float(np.median(room[np.isfinite(room)])))
        if not np.all(room > 0):
            return "max"
        if self.grid.continuous:
            return times, room
        held = np.concatenate([[np.inf], room[:-1]])
        held[-1] = min(held[-1], room[-1])
        return times, held

    def ball(self, tube: Tube, path: Path | Solution) -> BallTube:
        """A tube from constants around a path, as balls of its metric."""
        spread = nominal_spread(self.problem, self.plant, self.grid, tube.constants, path.states, path.inputs)
        return ball_tube(tube, self.grid, spread)

    def around(self, tube: Tube, path: Path | Solution) -> Tightened:
        """What a tube from constants takes along a path."""
        return self.tightened(self.ball(tube, path), path.states, tube)

    def rollout(self, inputs: Array) -> Path:
        """The noise-free path of a plan."""
        return Path(inputs=inputs, states=self.program.rollout(self.start, inputs))

    def response(self, solution: Solution, delta: float) -> Tightened | None:
        """The linear response along a plan; None where its remainder feeds itself."""
        rows = sum(face.rows(solution.states[:1], np.zeros(1)).shape[1] for face in self.faces)
        rows += 0 if self.feedback is None else 2 * len(self.feedback)
        planned = self.nominal.replace(plan=solution.inputs)
        found = linear_tube(planned, rows, delta, self._factors.setdefault(delta, {}))
        return None if found is None else self.tightened(found, solution.states)

    # ---- plans -------------------------------------------------------------------------------------------

    def settle_terminal(self, constants: Constants | None, tightened: Tightened) -> None:
        """Build or check the terminal set once the erosion at the end is known."""
        if self.terminal_name is None:
            return
        last, horizon = tightened.erosion[-1], float(self.problem.horizon)
        if isinstance(self.terminal_name, str):
            if self.terminal_name == "riccati":
                self.terminal = riccati_terminal(self.problem, self.faces, last, horizon)
            else:
                known = constants if constants is not None else self.constants(self.guess())
                self.terminal = contraction_terminal(self.problem, known, self.faces, last, horizon)
            self.cost = self._cost()
            self.program = self._program()
        else:
            assert self.terminal is not None
            check_terminal(self.terminal, self.faces, last, horizon)

    def plan(self, mode: Mode, tightened: Tightened, guess: Array) -> Solution:
        """The best plan in the tightened constraints, by a mode of `certbound.synthesis.transcription`."""
        return self.program.solve(mode, self.start, tightened.erosion, guess, tightening=tightened.inputs)


def _grid(problem: Problem, steps: int | None) -> Grid:
    if steps is not None and (isinstance(steps, bool) or int(steps) != steps or steps < 1):
        raise ValueError(f"`steps` must be a positive integer, got {steps!r}.")
    check_end(problem, "a plan")
    if problem.system.time == "discrete":
        if steps is not None and steps != problem.horizon:
            raise ValueError(f"`steps` must be the horizon, {problem.horizon}, in discrete time; leave it out.")
        return Grid(steps=int(problem.horizon), step=1.0, substeps=1, continuous=False)
    rows = problem.input_sequence
    count = int(steps) if steps is not None else PIECES if rows is None else len(rows)
    return Grid(steps=count, step=float(problem.horizon) / count, substeps=SUBSTEPS, continuous=True)


def _plant(problem: Problem, dynamics: Any, feedback: Array | None) -> Plant:
    system, middle = problem.system, middle_of(problem.system.disturbance)
    assert system.inputs is not None
    low, high = np.asarray(system.inputs.low), np.asarray(system.inputs.high)
    if feedback is None:
        return Plant(dynamics=dynamics, dimension=system.dimension, disturbance=middle, low=low, high=high)
    free = np.full(len(low), np.inf)
    return Plant(
        dynamics=dynamics, dimension=system.dimension, disturbance=middle, low=-free, high=free, feedback=feedback,
        input_low=low, input_high=high,
    )  # fmt: skip


def _given_terminal(problem: Problem, terminal: Any) -> TerminalSet | None:
    if terminal is None or isinstance(terminal, TerminalSet):
        return terminal
    if isinstance(terminal, str):
        if terminal not in ("contraction", "riccati"):
            raise ValueError(f"`terminal` must be 'contraction', 'riccati', a set or None, got {terminal!r}.")
        return None
    if not isinstance(terminal, Region) or terminal.moving:
        raise TypeError(f"`terminal` must be 'contraction', 'riccati', a fixed set or None, got {terminal!r}.")
    size = problem.system.dimension if terminal.coordinates is None else max(terminal.coordinates) + 1
    if (terminal.coordinates is None and terminal.dimension != size) or size > problem.system.dimension:
        raise ValueError(f"`terminal` must have dimension {problem.system.dimension} (the states).")
    return TerminalSet(region=terminal)
