"""Receding-horizon control whose state is the noise-free one: a plan that is made while it is carried out.

At every step the optimal control problem over the next N pieces is solved from the noise-free state, its constraints
tightened by the tube *at those times*, and the noise-free state moves on under the input that was applied. What is
guaranteed:

- The inputs are a function of time alone, like those of a plan: once all steps are done, `PredictiveController.verify`
  proves (or does not) that the noisy system stays safe along the whole trajectory but for a probability of delta.
  Nothing random enters, so the steps can be taken, and verified, before the system starts.
- Planning from a *measured* state instead breaks the argument: the tube bounds the deviation from one noise-free path
  that starts where the system started. ``step(state=...)`` allows it, ``unbroken`` is then False, and ``verify``
  refuses.
- A step whose tightened problem has no point is solved with slack, the terminal set first; its report says by how much,
  and ``unbroken`` is False from there on. ``verify`` may still find the inputs safe.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.constants.matching import check_constants
from certbound.problem.problem import Problem
from certbound.safety.verification import Verdict, verify_safety
from certbound.synthesis.costs import cost_of
from certbound.synthesis.planning import Planner
from certbound.synthesis.plans import Synthesis, synthesize_plan
from certbound.synthesis.terminal import TerminalSet, check_terminal, contraction_terminal, riccati_terminal
from certbound.synthesis.transcription import Solution, Transcription


@dataclass(frozen=True, eq=False, kw_only=True)
class StepReport:
    """One step of the controller."""

    time: float  # when (steps in discrete time)
    input: Array  # (m,): what to apply until the next step
    state: Array  # (n,): noise-free state that it was planned from
    feasible: bool  # the tightened problem had a point; otherwise the input comes from the soft one
    # largest miss of a tightened constraint over the prediction; 0 also where the terminal set alone is missed
    softened: float
    cost: float  # of the prediction
    seconds: float
    iterations: int
    status: str  # the solver's word


class PredictiveController:
    """Nonlinear model predictive control on tightened constraints.

    Parameters
    ----------
    problem : Problem
    horizon : int
        Pieces of the prediction (steps in discrete time).
    plan : Synthesis, optional
        Where the tube, its erosions and the first guess come from; made by ``synthesize_plan`` with ``method`` when
        omitted.
    method : str
        For the plan.
    terminal : "contraction", "riccati", TerminalSet or None
        At the end of every prediction, inside the constraints as tightened at the end of the problem's horizon.
        "riccati" sets the terminal cost as well, "contraction" too; None leaves the stage cost's weight.
    stage_cost : callable, optional
    steps : int, optional
        Pieces of the problem's horizon in continuous time.

    Raises
    ------
    ValueError
        If the horizon is not a positive integer, the system has no inputs, or the terminal set sticks out of the
        tightened constraints.

    Examples
    --------
    >>> import certbound as cb
    >>> system = cb.linear_system(
    ...     [[1, 0.1], [0, 1]], [[0], [0.1]], inputs=cb.Box([-2], [2]), noise=cb.Gaussian(std=0.01))
    >>> problem = cb.Problem(
    ...     system, initial=[1, 0], safe=[cb.Inside(cb.Box([-0.5, -1], [1.5, 1]))], horizon=20, delta=1e-3,
    ...     cost=([1, 1], [0.01]))
    >>> controller = PredictiveController(problem, horizon=10)
    >>> inputs = [controller.step().input for _ in range(20)]
    >>> controller.verify().status
    'SAFE'
    """

    def __init__(
        self,
        problem: Problem,
        *,
        horizon: int,
        plan: Synthesis | None = None,
        method: str = "auto",
        terminal: str | TerminalSet | None = None,
        stage_cost: Callable[..., Any] | None = None,
        steps: int | None = None,
    ) -> None:
        if isinstance(horizon, bool) or int(horizon) != horizon or horizon < 1:
            raise ValueError(f"`horizon` must be a positive number of pieces, got {horizon!r}.")
        self.problem = problem
        self.planner = Planner(problem, stage_cost=stage_cost, steps=steps)
        made = plan is None
        self.plan = synthesize_plan(problem, method=method, stage_cost=stage_cost, steps=steps) if made else plan
        assert self.plan is not None
        if self.plan.feedback is not None or len(self.plan.plan) != self.planner.grid.steps:
            raise ValueError("`plan` must be one of this problem, without a feedback and on the same pieces.")
        if plan is not None and plan.constants is not None:
            check_constants(self.planner.nominal, plan.constants, "plan")
        self.erosion = self.plan.erosion * (1 + 1e-6)
        grid = replace(self.planner.grid, steps=int(horizon))
        ends = self._terminal(terminal)
        cost = cost_of(problem, stage_cost, None if ends is None else ends.cost, None if ends is None else ends.center)
        self.program = Transcription(self.planner.plant, grid, self.planner.faces, cost, terminal=ends, warm=True)
        self.reset()

    def _terminal(self, terminal: str | TerminalSet | None) -> TerminalSet | None:
        assert self.plan is not None
        faces, last, time = self.planner.faces, self.erosion[-1], float(self.problem.horizon)
        if terminal is None:
            return None
        if isinstance(terminal, TerminalSet):
            check_terminal(terminal, faces, last, time)
            return terminal
        if terminal == "riccati":
            return riccati_terminal(self.problem, faces, last, time)
        if terminal != "contraction":
            raise ValueError(f"`terminal` must be 'contraction', 'riccati', a TerminalSet or None, got {terminal!r}.")
        constants = self.plan.constants or self.planner.constants(self.plan.plan)
        return contraction_terminal(self.problem, constants, faces, last, time)

    def reset(self) -> None:
        """Back to the start of the problem."""
        assert self.plan is not None
        self.index = 0
        self.state: Array = np.array(self.planner.start)
        self.unbroken = self.plan.feasible
        self.measured = False
        self.applied: list[Array] = []
        guess = self.plan.plan[: self.program.grid.steps]
        missing = self.program.grid.steps - len(guess)
        self._guess: Array = np.concatenate([guess, np.tile(guess[-1:], (missing, 1))])

    @property
    def time(self) -> float:
        """Of the next step."""
        return self.index * self.planner.grid.step

    def step(self, state: ArrayLike | None = None) -> StepReport:
        """Plan from the noise-free state, and move it on under the first input.

        Parameters
        ----------
        state : array_like, shape (n,), optional
            A measured state to plan from instead. It becomes the noise-free state, and ``unbroken`` False: the tube
            bounds deviations from the path that began at the start.

        Raises
        ------
        ValueError
            If the state has the wrong size or is not finite.
        """
        if state is not None:
            given = np.asarray(state, dtype=float)
            if given.shape != self.state.shape or not np.all(np.isfinite(given)):
                raise ValueError(f"`state` must hold {len(self.state)} finite numbers, got {state!r}.")
            self.state, self.unbroken, self.measured = given, False, True
        erosion = self._window()
        time, start = self.time, self.state
        found = self.program.solve("cost", start, erosion, self._guess, time_=time)
        feasible, seconds, iterations = found.success, found.seconds, found.iterations
        if not feasible:
            found = self.program.solve("soft", start, erosion, self._guess, time_=time)
            seconds, iterations = seconds + found.seconds, iterations + found.iterations
            self.unbroken = False
        self._moved(found)
        return StepReport(
            time=time, input=found.inputs[0], state=start, feasible=feasible,
            softened=0.0 if feasible else float(found.slack.max(initial=0.0)), cost=found.cost, seconds=seconds,
            iterations=iterations, status=found.status,
        )  # fmt: skip

    def _window(self) -> Array:
        """Erosions at the points of the prediction; beyond the problem's horizon those of its end."""
        substeps = self.planner.grid.substeps
        places = self.index * substeps + np.arange(self.program.grid.points)
        return np.asarray(self.erosion[np.minimum(places, len(self.erosion) - 1)])

    def _moved(self, found: Solution) -> None:
        self.applied.append(found.inputs[0])
        self.state = found.states[self.planner.grid.substeps]
        self._guess = np.concatenate([found.inputs[1:], found.inputs[-1:]])
        self.index += 1

    def verify(self) -> Verdict:
        """The verdict on the inputs that were applied.

        Raises
        ------
        ValueError
            If fewer steps were taken than the problem has, or a step began at a measured state.
        """
        assert self.plan is not None
        count = self.planner.grid.steps
        if len(self.applied) < count:
            raise ValueError(f"`verify` needs all {count} steps, got {len(self.applied)}; call step() first.")
        if self.measured:
            raise ValueError("`verify` needs inputs planned from noise-free states only; call reset(), then step().")
        whole = self.problem.replace(plan=np.array(self.applied[:count]))
        return verify_safety(whole, method=self.plan.method, constants=self.plan.constants)
