"""From a problem to what all simulations share: grid, step, starts, disturbances."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import instance
from certbound.errors import InfeasibleError
from certbound.problem.goals import check_end
from certbound.problem.model import Tape, compile_scalar
from certbound.problem.problem import Problem
from certbound.simulation.blocks import MEMORY_LIMIT, Work, check_count
from certbound.simulation.stepping import Scenario, StepModel, step_model
from certbound.simulation.stiffness import exponential, jacobians, linear_part, step_error, steps_needed

Starts = Callable[[np.random.Generator, int], Array]
"""``start(rng, count)`` draws starts."""

_DEFAULT_STEPS = 1000
_MOST_STEPS = 64_000  # that are taken unasked
# Share of the error that a mode's rate may have (a fifth), above which Euler's scheme is left: damping that is 1 % less
# raises a probability of 1e-4, about exp(-9), by 9 %.
_ROUGH = 0.05
_LONGEST_NOMINAL = 20_000  # steps; longer paths are advanced by the kernel


@dataclass(frozen=True, eq=False)
class FixedStart:
    """The same start for every path."""

    point: Array

    def __call__(self, rng: np.random.Generator, count: int) -> Array:
        return np.tile(self.point, (count, 1))


@dataclass(frozen=True, eq=False, kw_only=True)
class Setting:
    """Grid, step and starts of a simulation."""

    model: StepModel
    steps: int
    times: Array  # (steps + 1,)
    start: Starts
    fixed: Array | None  # (n,): the start, if all paths share one

    @property
    def shared_nominal(self) -> bool:
        """Whether all paths use one table of the noise-free path."""
        return self.fixed is not None and not self.model.own_disturbance and self.steps <= _LONGEST_NOMINAL

    def nominal(self) -> Array:
        """The noise-free path of the discretised model, shape (steps + 1, n), where all paths share it; else empty."""
        if self.fixed is None or not self.shared_nominal:
            return np.zeros((0, 0))
        model = self.model
        drift = compile_scalar(model.drift)
        path = [self.fixed]
        inputs = model.table.tolist() if model.table.size else [()] * self.steps
        rest = np.zeros(len(self.fixed))

        def force(k: int, time: float, state: Array) -> Array:
            return np.array(drift(time, *state.tolist(), *inputs[k]), dtype=float)

        with np.errstate(all="ignore"):
            for k in range(self.steps):
                time, state, scheme = k * model.interval, path[k], model.exponential
                if scheme is None:
                    value = force(k, time, state)
                    path.append(state + model.step * value if model.step > 0.0 else value)
                    continue
                new = scheme.move @ state
                if (k % model.constant if model.constant else k) % 2 == 0:
                    begin = force(k, time, state) - scheme.base @ state
                    lead = new + scheme.lead @ begin
                    rest = force(k, time + model.step, lead) - scheme.base @ lead
                    path.append(new + scheme.response @ rest - scheme.first @ (rest - begin))
                    continue
                new = new + scheme.response @ rest
                if np.any(scheme.second):
                    change = force(k, time + model.step, new) - scheme.base @ new - rest
                    new = new + scheme.second @ change
                path.append(new)
        return np.array(path, dtype=float)

    def work(self, kernel: tuple[str, Array], kind: type[Work] = Work, **fields: Any) -> Work:
        """A piece of work on this setting, by a kernel's source and parameters; ``fields`` differ from task to task."""
        model, (source, p) = self.model, kernel
        drawn = model.signal is None and model.switching == 0.0
        none = np.zeros(0)
        defaults: dict[str, Any] = {
            "source": source,
            "p": p,
            "sample_start": self.start,
            "low": model.low if drawn and model.disturbance_count else np.zeros(model.disturbance_count),
            "high": model.high if drawn and model.disturbance_count else np.zeros(model.disturbance_count),
            "constants": model.constants if drawn else (),
            "inputs": model.table,
            "moving": np.zeros((0, 0)),
            "nominal": np.zeros((0, 0)),
            "windows": np.zeros((0, 2), dtype=np.int64),
            "profile": none,
            "marks": np.zeros(0, dtype=np.int64),
            "steps": self.steps,
            "interval": model.interval,
            "dimension": model.dimension,
        }
        return kind(**(defaults | fields))


def prepare(problem: Any, steps: int | None = None, scenario: Scenario | None = None) -> Setting:
    """Check the arguments that all simulations share.

    Raises
    ------
    ValueError
        If ``steps`` is malformed or its tables overflow the memory limit, the start lies elsewhere than said,
        or the noise has no law.
    """
    instance("problem", problem, Problem)
    scenario = scenario or Scenario()
    if not isinstance(scenario, Scenario):
        raise TypeError(f"`scenario` must be a certbound.simulation.stepping.Scenario, got {scenario!r}.")
    count = _steps(problem, steps)
    signals = len((problem.closed_loop if problem.hold is None else problem.system.dynamics).inputs)
    columns = 2 + 2 * problem.system.dimension + signals + 4 * (len(problem.safe) + 1)
    fit = MEMORY_LIMIT // (8 * columns)
    if count > fit:
        raise ValueError(
            f"`steps` must be at most {fit} for this problem, got {count}: its tables over time would take "
            f"more than {MEMORY_LIMIT // 2**20} MiB; take a longer step."
        )
    start, fixed = _start(problem, scenario)
    model = step_model(problem, count, scenario)
    if model.step > 0.0:
        model, count = _fine_enough(problem, model, count, scenario, start, fit if steps is None else 0)
    times = np.linspace(0.0, float(problem.horizon), count + 1)
    return Setting(model=model, steps=count, times=times, start=start, fixed=fixed)


def _fine_enough(
    problem: Any, model: StepModel, steps: int, scenario: Scenario, start: Starts, most: int
) -> tuple[StepModel, int]:
    """The scheme and the steps, at most ``most``, that a model's fastest modes need; a warning where these are more.

    The exponential scheme is taken wherever Euler's would be rough with these steps or the default ones: steps that are
    finer than those change the scheme no more.
    """
    horizon = float(problem.horizon)
    looks = jacobians(model, steps, start, lambda state, time: _stays(problem, state, time))
    if not len(looks):  # undefined at the starts
        return model, steps
    coarse = horizon / min(steps, _DEFAULT_STEPS)
    base, rough = None, step_error(looks, coarse, horizon)
    if scenario.scheme == "auto" and rough > _ROUGH:
        base = linear_part(looks, coarse, horizon)
        base = base if rough > step_error(looks, coarse, horizon, base) else None
    needed = steps_needed(looks, steps, horizon, base)
    if base is not None and isinstance(model.noise, Tape):
        needed = max(needed, _noise_steps(base, steps, horizon))
    if steps < needed <= min(most, _MOST_STEPS):
        steps = needed
        model = step_model(problem, steps, scenario)
    elif steps < needed:
        warnings.warn(
            f"{steps} steps are too coarse for the fastest modes of this model, and what is counted may be far from "
            f"the truth; steps={needed} would do.",
            stacklevel=4,
        )
    return (model if base is None else exponential(model, base)), steps


def _stays(problem: Any, state: Array, time: float) -> bool:
    """Whether a state keeps the constraints that hold all the time."""
    held = [constraint for constraint in problem.kept if constraint.during is None]
    return all(bool(constraint.satisfied(state[None], time)[0]) for constraint in held)


def _noise_steps(base: Array, steps: int, horizon: float) -> int:
    """Steps, doubled from ``steps`` on, within which noise that acts in the middle of a step is not damped by its mode.

    A mode of rate -a has a variance of (a h)/sinh(a h) of the right one then: .85 at a h = 1.
    """
    fastest = max(float(-np.linalg.eigvals(base).real.min()), 0.0) * horizon
    return steps << max(math.ceil(math.log2(max(fastest / steps, 1.0))), 0)


def refuse_held(problem: Any, what: str) -> None:
    """Refuse inputs that are held, with an InfeasibleError, where ``what`` knows no sampling times."""
    if problem.hold is not None:
        raise InfeasibleError(f"{what} knows no inputs that are held: count plain paths, simulate_exits.")


def _steps(problem: Any, steps: int | None) -> int:
    check_end(problem, "a simulation")
    if problem.system.time == "discrete":
        horizon = int(problem.horizon)
        if steps is not None and check_count("steps", steps) != horizon:
            raise ValueError(f"`steps` must be {horizon}, the horizon of this discrete-time problem, or left out.")
        return horizon
    if steps is not None:
        return check_count("steps", steps)
    pieces = problem.samples or (1 if problem.input_sequence is None else len(problem.input_sequence))
    return -(-_DEFAULT_STEPS // pieces) * pieces


def _start(problem: Any, scenario: Scenario) -> tuple[Starts, Array | None]:
    initial, n = problem.initial, problem.system.dimension
    if scenario.initial is not None:
        point = np.asarray(scenario.initial, dtype=float)
        if point.shape != (n,) or not np.all(np.isfinite(point)):
            raise ValueError(f"`initial` must hold {n} finite numbers, got {scenario.initial!r}.")
        return FixedStart(point), point
    if initial.is_point:
        return FixedStart(initial.middle), initial.middle
    return initial.sample, None
