"""One step of a problem's system, as numbers and tapes: what a kernel is written from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.problem.model import Node, Tape, compile_numpy, edged, is_zero, jacobian, substitute, trace
from certbound.problem.noise import Law, check_law
from certbound.problem.random_constants import Random
from certbound.simulation.tape_text import live_nodes
from certbound.simulation.transition import bridge_spread, exact_transition

_LARGEST_EXACT = 16


@dataclass(frozen=True, eq=False, kw_only=True)
class Scenario:
    """How paths are drawn: what the problem leaves open.

    Examples
    --------
    >>> Scenario(scheme="euler", disturbance=[0.1]).bridge
    True
    """

    # Continuous time only. ``auto`` takes the exact transition of a linear system of up to 16 states, Milstein's scheme
    # where the diffusion is diagonal and entry i depends on state i alone, and Euler-Maruyama otherwise; where that
    # would need shorter steps than a thousandth of the horizon, the exponential scheme of ``stiffness``.
    scheme: Literal["auto", "exact", "milstein", "euler"] = "auto"
    bridge: bool = True  # continuous time only: look for exits between two steps with a Brownian bridge
    # (n,): one start for all paths; otherwise X_0 is uniform in the problem's initial set (or drawn from its law)
    initial: ArrayLike | None = None
    # ``constant``: each path draws one value, uniform in the box. ``switching``: jumps between vertices of the box at
    # random times (ten times per horizon on average). An array of shape (q,) or (pieces, q): the same signal for all
    # paths, constant on equal pieces of the horizon. A function d(t, x) reacts to the state of the path (and is cut off
    # at the box).
    disturbance: str | ArrayLike | Callable[..., Any] = "constant"

    def __post_init__(self) -> None:
        if self.scheme not in ("auto", "exact", "milstein", "euler"):
            raise ValueError(f"`scheme` must be auto, exact, milstein or euler, got {self.scheme!r}.")
        if isinstance(self.disturbance, str) and self.disturbance not in ("constant", "switching"):
            raise ValueError(
                f"`disturbance` must be 'constant', 'switching', an array or a function d(t, x), "
                f"got {self.disturbance!r}."
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class Exponential:
    """Matrices (n, n) of the exponential midpoint rule, over one step h; see ``stiffness``.

    Pairs of steps share one rest of the drift, N(x) = f(x) - base x, taken where the first of them ends; on
    modes that die out within a step it is taken where each ends.
    """

    base: Array  # J, 1/s
    move: Array  # e^{h J}
    response: Array  # int_0^h e^{s J} ds: what the rest of the drift adds in a step
    lead: Array  # what it adds to the state where it is taken anew
    # what its change in the first step takes off, and that in the second adds; of modes that die out within a step
    first: Array
    second: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class StepModel:
    """One step of a system, as numbers and tapes."""

    # inputs (t, states, inputs, disturbances). With ``step`` > 0 the state moves by ``step`` times it; otherwise
    # it is the next state
    drift: Tape
    # n, and the numbers of inputs and disturbances among the tape's inputs
    dimension: int
    input_count: int = 0
    disturbance_count: int = 0
    step: float = 0.0  # step h of Euler's scheme in seconds; 0 when ``drift`` gives the next state
    interval: float = 1.0  # time between two states (h, or 1 in discrete time)
    variate: str = "normal"  # law of the m independent variates v: ``normal``, ``uniform`` on (-1, 1), ``sign``
    unit: Tape | None = None  # z as a function of v, entry by entry; without it z = v
    # (n, m): what multiplies z. A tape (inputs t, states; shape (n, m)) is multiplied by sqrt(step) too.
    noise: Array | Tape
    carry: Array | None = None  # (n, n): what a step makes of noise of the step before; None: nothing
    exponential: Exponential | None = None  # how the state moves without noise, where not by Euler's scheme
    pieces: int = 1  # parts of a step, each with variates of its own; of a tape of noise they are added up
    correction: Tape | None = None  # diagonal of d g_ii/d x_i, for Milstein's scheme
    # (n, m): g sqrt(h) of the bridge between two steps; None in discrete time, and where ``noise`` is a tape
    spread: Array | None = None
    rough: Array | None = None  # (n, k): where rows are 0 states are smooth on a step; None: where those of spread are
    bridge: bool = False  # whether exits between steps are looked for
    signal: Tape | None = None  # disturbance as a function of (t, states)
    # (disturbance_count,): the disturbance's box
    low: Array = field(default_factory=lambda: np.zeros(0))
    high: Array = field(default_factory=lambda: np.zeros(0))
    constants: tuple[tuple[int, Random], ...] = ()  # places of the disturbances that are drawn by a law
    switching: float = 0.0  # mean number of steps between two jumps of a switching disturbance; 0: constant
    # (steps, input_count + disturbances given as an array): inputs that all paths share, one row a step
    table: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # inputs that are held, the first ones: a function of (t, states), computed every so many steps
    law: Tape | None = None
    every: int = 0
    constant: int = 0  # steps after which inputs may change, where they do so at equal distances; else 0
    scheme: str = "discrete"  # what was chosen: ``exact``, ``milstein``, ``euler``, ``exponential`` or ``discrete``

    @property
    def noise_count(self) -> int:
        """Number of variates that a step needs."""
        return int(self.noise.shape[1]) * (self.pieces if isinstance(self.noise, Tape) else 1)

    @property
    def held_count(self) -> int:
        """Number of inputs that are held."""
        return 0 if self.law is None else len(self.law.outputs)

    @property
    def own_disturbance(self) -> bool:
        """Whether the disturbance differs from path to path."""
        return self.disturbance_count > 0


def step_model(problem: Any, steps: int, scenario: Scenario) -> StepModel:
    """The step of a problem on a grid of ``steps`` equal pieces of its horizon (discrete time: of its steps).

    Raises
    ------
    ValueError
        If the noise has no law, or the scheme does not fit the system.
    TypeError
        If the noise's law has no name, or its ``unit`` cannot be traced.
    """
    system = problem.system
    held = problem.hold is not None
    tape: Tape = system.dynamics if held else problem.closed_loop
    sequence = problem.input_sequence
    inputs = len(system.input_names) if held else 0 if sequence is None else sequence.shape[1]
    disturbances = len(tape.inputs) - 1 - system.dimension - inputs
    rows = [] if sequence is None else [_table(sequence, steps)]
    fields: dict[str, Any] = {"dimension": system.dimension}
    if held:
        if steps % problem.samples:
            raise ValueError(f"`steps` must be a multiple of the {problem.samples} sampling times, got {steps}.")
        fields |= {"law": problem.plan, "every": steps // problem.samples}
    fields |= _disturbance(system, disturbances, steps, scenario, problem)
    if "row" in fields:
        rows.append(_table(fields.pop("row"), steps))
        inputs, disturbances = inputs + disturbances, 0
    fields |= {"input_count": inputs, "disturbance_count": disturbances}
    fields["table"] = np.hstack(rows) if rows else np.zeros((0, 0))
    pieces = problem.samples if held else len(sequence) if sequence is not None and len(rows) == 1 else 0
    fields["constant"] = steps // pieces if pieces and steps % pieces == 0 else 0
    if system.time == "discrete":
        law: Law = system.noise
        check_law(law, "be simulated")
        law.check_drawable()
        if system.gain is not None:
            noise: Array | Tape = _multiplied(system.gain, law.factor)
        else:
            noise = _without_zeros(np.asarray(system.noise_matrix) @ law.factor)
        return StepModel(drift=tape, variate=law.variate, unit=_unit(law), noise=noise, **fields)
    step = float(problem.horizon) / steps
    return _continuous(tape, system.diffusion, step, scenario, fields)


def _multiplied(gain: Tape, factor: Array) -> Tape:
    """G(t, x) F as a tape."""
    rows, columns = gain.shape
    names = [f"g {k}" for k in range(rows * columns)]

    def entries(g: Any) -> list[list[Any]]:
        return [[sum(g[i * columns + k] * f for k, f in enumerate(column) if f) + 0.0 for column in factor.T]
                for i in range(rows)]  # fmt: skip

    product = trace(entries, {"g": names})
    return substitute(product, gain.inputs, {name: (gain, k) for k, name in enumerate(names)})


def _table(rows: Array, steps: int) -> Array:
    """Rows of equal duration, spread over the steps."""
    pieces = len(rows)
    return np.asarray(rows, dtype=float)[(np.arange(steps) * pieces) // steps]


def _unit(law: Law) -> Tape | None:
    """The law's ``unit`` as a tape; None where it leaves its variate as it is."""
    if type(law).unit is Law.unit:
        return None
    tape = trace(law.unit, {"v": ["v"]})
    if tape.shape != (1,):
        raise ValueError(f"`unit` of {type(law).__name__} must keep the shape of `v`, got {tape.shape} for (1,).")
    return tape


def _disturbance(
    system: Any, count: int, steps: int, scenario: Scenario, problem: Any
) -> dict[str, Any]:
    choice = scenario.disturbance
    if count == 0:
        if not isinstance(choice, str):
            raise ValueError("`disturbance` must be left out: this system has none.")
        return {}
    moving = choice == "switching" if isinstance(choice, str) else callable(choice) or np.ndim(choice) > 1
    for word, names in (("an unknown", problem.unknown), ("a drawn", problem.random)):
        if names and moving:
            raise ValueError(f"`disturbance` must be constant: {', '.join(names)} is {word} constant of the problem.")
    box = system.disturbance
    fields: dict[str, Any] = {"low": np.asarray(box.low), "high": np.asarray(box.high)}
    if isinstance(choice, str):
        fields["constants"] = tuple((system.disturbance_names.index(name), law) for name, law in problem.random.items())
        return fields | {"switching": steps / 10.0 if choice == "switching" else 0.0}
    if callable(choice):
        signal = trace(choice, {"t": ["t"], "x": list(system.states)})
        if signal.shape != (count,):
            raise ValueError(f"`disturbance` must return {count} values, got shape {signal.shape}.")
        return fields | {"signal": signal}
    rows = np.atleast_2d(np.asarray(choice, dtype=float))
    if rows.ndim != 2 or rows.shape[1] != count or not np.all(np.isfinite(rows)):
        raise ValueError(f"`disturbance` must hold {count} finite values a row, got shape {rows.shape}.")
    if not np.all((box.low <= rows) & (rows <= box.high)):
        raise ValueError("`disturbance` must lie in the system's disturbance box; clip it.")
    return {"row": rows}


def _continuous(
    tape: Tape, diffusion: Array | Tape, step: float, scenario: Scenario, fields: dict[str, Any]
) -> StepModel:
    n = fields["dimension"]
    fields |= {"interval": step, "bridge": scenario.bridge}
    wanted = scenario.scheme
    if isinstance(diffusion, Tape):
        correction = _milstein(diffusion, n) if wanted in ("auto", "milstein") else None
        if wanted == "exact" or (wanted == "milstein" and correction is None):
            raise ValueError(
                f"`scheme` {wanted!r} does not fit this diffusion, which depends on the state"
                + ("" if wanted == "exact" else " in another way than entry i on state i alone")
                + "; use 'auto'."
            )
        name = "euler" if correction is None else "milstein"
        return StepModel(drift=tape, step=step, noise=diffusion, correction=correction, scheme=name, **fields)
    spread = _without_zeros(np.asarray(diffusion)) * np.sqrt(step)
    linear = _affine(tape, n) if wanted in ("auto", "exact") else None
    if linear is not None and (n <= _LARGEST_EXACT or wanted == "exact"):
        transition, offset, factor = exact_transition(*linear, np.asarray(diffusion), step)
        drift = _affine_tape(tape.inputs, np.hstack([np.zeros((n, 1)), transition]), offset)
        spread = bridge_spread(linear[0][:, :n], np.asarray(diffusion), step)
        return StepModel(drift=drift, noise=factor, spread=spread, carry=transition[:, :n], scheme="exact", **fields)
    if wanted in ("exact", "milstein"):
        need = "a linear system with constant coefficients" if wanted == "exact" else "a state-dependent diffusion"
        raise ValueError(f"`scheme` {wanted!r} needs {need}; use 'auto'.")
    return StepModel(drift=tape, step=step, noise=spread, spread=spread, scheme="euler", **fields)


def _without_zeros(noise: Array) -> Array:
    """Columns that are all 0 need no variates."""
    return np.ascontiguousarray(noise[:, np.any(noise != 0.0, axis=0)])


def _constant(tape: Tape) -> bool:
    return not any(tape.nodes[index].op == "input" for index in live_nodes(tape))


def _affine(tape: Tape, n: int) -> tuple[Array, Array] | None:
    """(matrix of all inputs but t, offset) of an affine map with constant coefficients, else None."""
    if any(tape.nodes[index] == Node("input", (0,)) for index in live_nodes(tape)):
        return None
    derivative = jacobian(tape, tuple(range(1, len(tape.inputs))))
    if edged(tape) or not _constant(derivative):  # what jumps has derivative 0 between its jumps
        return None
    zeros = [0.0] * len(tape.inputs)
    return compile_numpy(derivative)(*zeros), compile_numpy(tape)(*zeros)


def _affine_tape(inputs: tuple[str, ...], matrix: Array, offset: Array) -> Tape:
    """Tape of offset + matrix (x, u, d), with zero entries left out."""
    nodes = [Node("input", (slot,)) for slot in range(len(inputs))]
    outputs = []
    for row, start in zip(matrix, offset):
        total = -1
        if start != 0.0 or not np.any(row):
            nodes.append(Node("const", (), float(start)))
            total = len(nodes) - 1
        for slot in np.flatnonzero(row):
            nodes.append(Node("const", (), float(row[slot])))
            nodes.append(Node("mul", (len(nodes) - 1, int(slot))))
            if total >= 0:
                nodes.append(Node("add", (total, len(nodes) - 1)))
            total = len(nodes) - 1
        outputs.append(total)
    return Tape(inputs=inputs, nodes=tuple(nodes), outputs=tuple(outputs), shape=(len(outputs),))


def _milstein(diffusion: Tape, n: int) -> Tape | None:
    """The derivatives d g_ii/d x_i if g is diagonal and g_ii depends on t and x_i alone, else None."""
    if diffusion.shape != (n, n):
        return None
    derivative = jacobian(diffusion, tuple(range(1, n + 1)))
    for i in range(n):
        others = [k for k in range(n) if k != i]
        if not all(is_zero(diffusion, i * n + k) and is_zero(derivative, (i * n + i) * n + k) for k in others):
            return None
    outputs = tuple(derivative.outputs[(i * n + i) * n + i] for i in range(n))
    return Tape(inputs=derivative.inputs, nodes=derivative.nodes, outputs=outputs, shape=(n,))
