"""Stochastic systems: dynamics traced to a tape, with noise, inputs and disturbances.

CT: dX = f(t, X, u, d) dt + g(t, X) dW in the Ito sense, W a Wiener process. DT: X+ = f(t, X, u, d) + G w,
with t the number of the step and w drawn anew at every step. The disturbance d is bounded, unknown, and may
react to the past and the state; it never sees coming noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.checks import assign, frozen, matrix, names, vector
from certbound.errors import InfeasibleError
from certbound.problem import table_laws  # noqa: F401  (its laws enter the list of laws)
from certbound.problem.adapters import import_control, is_control_system, linear_inputs, read_model, symbol_names
from certbound.problem.filters import Filter, Filters
from certbound.problem.model import Tape
from certbound.problem.noise import Gaussian, Law, known_laws
from certbound.problem.sets import Box
from certbound.problem.signals import diffusion_of, signal_box, signal_names, state_names


@dataclass(frozen=True, eq=False, init=False)
class System:
    """What continuous and discrete time share: names of the signals, and where u and d live.

    ``dynamics`` is f, over ``("t", *states, *input_names, *disturbance_names)``, of shape (n,). The last states are
    those of ``filters``. ``turn`` is T where the system is that of y = T x and ``states`` name x: what is said of
    limits is said of x then (`said_of`).
    """

    states: tuple[str, ...]
    inputs: Box | None
    input_names: tuple[str, ...]
    disturbance: Box | None
    disturbance_names: tuple[str, ...]
    dynamics: Tape
    filters: Filters = field(default=Filters(), init=False)
    turn: Array | None = field(default=None, init=False)

    time: ClassVar[str]

    def said_of(self, row: Array) -> Array:
        """A linear function of the system's own coordinates, shape (n,), as one of the states that have names."""
        return row if self.turn is None else np.asarray(row @ self.turn)

    @property
    def dimension(self) -> int:
        """Number of states n."""
        return len(self.states)

    @property
    def own_dimension(self) -> int:
        """Number of states that are not those of filters."""
        return self.dimension - len(self.filters)

    @property
    def noise_dimension(self) -> int:
        """Number of noise entries m."""
        raise NotImplementedError

    def __repr__(self) -> str:
        parts = [f"{type(self).__name__}: states {', '.join(self.states)}"]
        parts += [f"inputs {', '.join(self.input_names)}"] if self.inputs else []
        parts += [f"disturbance {', '.join(self.disturbance_names)}"] if self.disturbance else []
        return "<" + "; ".join(parts) + ">"

    def _common(self, f: Any, states: Any, filters: Any, options: dict[str, Any]) -> None:
        assign(self, filters=Filters(filters))
        imported = import_control(f, self.time) if is_control_system(f) else None
        if imported is not None:
            if self.filters:
                raise ValueError(
                    "`filters` must come with a function that uses their outputs, got a python-control system; put the "
                    "filters into that, or write `f`."
                )
            f, states = imported.function, imported.states if states is None else states
            options = imported.options(options)
        states = symbol_names(states)
        options = {name: symbol_names(value) if name.endswith("names") else value for name, value in options.items()}
        if states is None:
            raise TypeError("`states` must be given: a number, or the states' names.")
        own = state_names(states)
        assign(self, states=(*own, *names("filters", self.filters.states, own)))
        assign(self, inputs=signal_box("inputs", options["inputs"], "u"))
        assign(self, disturbance=signal_box("disturbance", options["disturbance"], "d"))
        if self.disturbance is not None and not self.disturbance.bounded:
            ends = ", ".join(f"[{low:g}, {high:g}]" for low, high in zip(self.disturbance.low, self.disturbance.high))
            raise ValueError(f"`disturbance` must be a bounded box, got the sides {ends}; give each finite ends.")
        input_names = signal_names("input_names", options["input_names"], self.inputs, "u", self.states)
        assign(self, input_names=input_names)
        taken = (*self.states, *input_names)
        given = options["disturbance_names"]
        disturbance_names = signal_names("disturbance_names", given, self.disturbance, "d", taken)
        assign(self, disturbance_names=disturbance_names)
        assign(self, dynamics=self._traced(f))

    def _traced(self, f: Any) -> Tape:
        arguments: dict[str, Sequence[str]] = {"t": ["t"], "x": self.states}
        arguments |= {"u": self.input_names} if self.inputs is not None else {}
        arguments |= {"d": self.disturbance_names} if self.disturbance is not None else {}
        inputs = tuple(name for entries in arguments.values() for name in entries)
        tape = f if isinstance(f, Tape) else read_model(f, arguments)
        if tape.inputs != inputs:
            raise ValueError(f"`dynamics` must be a tape over {inputs}, got {tape.inputs}.")
        n = self.own_dimension
        if tape.shape not in ((n,), (n, 1)):
            beyond = f", without those of filters ({', '.join(self.states[n:])})" if self.filters else ""
            raise ValueError(
                f"`dynamics` must return {n} values, one per state ({', '.join(self.states[:n])}){beyond}, "
                f"got shape {tape.shape}."
            )
        own = Tape(inputs=inputs, nodes=tape.nodes, outputs=tape.outputs, shape=(n,))
        return self.filters.dynamics(own, self.input_names, self.time) if self.filters else own


@dataclass(frozen=True, eq=False, init=False, repr=False)
class ContinuousSystem(System):
    """dX = f(t, X, u, d) dt + g(t, X) dW, in the Ito sense.

    Parameters
    ----------
    f : function, SymPy or CasADi expressions, casadi.Function, Tape, or python-control system
        Takes any of t, x, u, d by name, or of the states, inputs and disturbances by theirs, and returns n values;
        expressions are read by their symbols' names.
    states : int or sequence of str
        Number of states (named x1, x2, ...) or their names; symbols will do.
    inputs : Box, optional
        Bounds of the inputs u (infinite sides allowed); without it the system has none.
    disturbance : Box, optional
        Bounded set of the unknown signal d; without it there is none.
    diffusion : array_like of shape (n, m), or function g(t, x), optional
        G or g; no noise when omitted. For n = 1 a number will do.
    input_names, disturbance_names : sequence of str, optional
        Names; u1, u2, ... and d1, d2, ... when omitted (u and d alone).
    filters : sequence of Filter, optional
        Coloured noise and lags of inputs. Their states stand behind ``states``, and x holds them all; f and
        ``diffusion`` have no rows for them.

    Raises
    ------
    TypeError, ValueError
        If f cannot be traced, sizes disagree, or the diffusion is a scalar where a matrix is meant.

    Examples
    --------
    >>> system = ContinuousSystem(lambda x: -np.sin(x), states=["angle"], diffusion=0.1)
    >>> system.dynamics.inputs, system.diffusion
    (('t', 'angle'), array([[0.1]]))
    """

    diffusion: Array | Tape

    time: ClassVar[str] = "continuous"

    def __init__(
        self,
        f: Any,
        *,
        states: int | Sequence[str] | None = None,
        inputs: Box | None = None,
        disturbance: Box | None = None,
        diffusion: Any = None,
        input_names: Sequence[str] | None = None,
        disturbance_names: Sequence[str] | None = None,
        filters: Sequence[Filter] = (),
    ) -> None:
        options = {
            "inputs": inputs,
            "disturbance": disturbance,
            "input_names": input_names,
            "disturbance_names": disturbance_names,
        }
        self._common(f, states, filters, options)
        own = diffusion_of(diffusion, self.states, rows=self.own_dimension)
        if self.filters:
            own = self.filters.noise(None if diffusion is None else own, self.own_dimension, self.time)
        assign(self, diffusion=own)

    @property
    def noise_dimension(self) -> int:
        return int(self.diffusion.shape[1])


@dataclass(frozen=True, eq=False, init=False, repr=False)
class DiscreteSystem(System):
    """X+ = f(t, X, u, d) + G w, with w drawn anew at every step.

    Parameters
    ----------
    f : function, SymPy or CasADi expressions, casadi.Function, Tape, or python-control system
        Takes any of t, x, u, d by name and returns the n next values; t is the number of the step.
    states : int or sequence of str
        Number of states (named x1, x2, ...) or their names; symbols will do.
    inputs : Box, optional
        Bounds of the inputs u (infinite sides allowed); without it the system has none.
    disturbance : Box, optional
        Bounded set of the unknown signal d; without it there is none.
    noise : Law, optional
        Law of w; no noise when omitted.
    noise_matrix : array_like or function of t, x, shape (n, m), optional
        G; the identity when omitted. One that depends on t or x is ``gain``, and few engines serve it.
    input_names, disturbance_names : sequence of str, optional
        Names; u1, u2, ... and d1, d2, ... when omitted (u and d alone).
    filters : sequence of Filter, optional
        Coloured noise and lags of inputs, whose times count in steps. Their states stand behind ``states``, and x holds
        them all; f and ``noise_matrix`` have no rows for them. Other noise must be Gaussian beside them.

    Raises
    ------
    TypeError, ValueError
        If f cannot be traced, sizes disagree, or the noise is a bare number.

    Examples
    --------
    >>> from certbound.problem.noise import Gaussian
    >>> system = DiscreteSystem(lambda x: 0.5 * x, states=2, noise=Gaussian(std=0.1))
    >>> system.states, system.noise.proxy.diagonal()
    (('x1', 'x2'), array([0.01, 0.01]))
    """

    noise: Law
    gain: Tape | None
    fixed_gain: Array

    time: ClassVar[str] = "discrete"

    def __init__(
        self,
        f: Any,
        *,
        states: int | Sequence[str] | None = None,
        inputs: Box | None = None,
        disturbance: Box | None = None,
        noise: Law | None = None,
        noise_matrix: Any = None,
        input_names: Sequence[str] | None = None,
        disturbance_names: Sequence[str] | None = None,
        filters: Sequence[Filter] = (),
    ) -> None:
        options = {
            "inputs": inputs,
            "disturbance": disturbance,
            "input_names": input_names,
            "disturbance_names": disturbance_names,
        }
        self._common(f, states, filters, options)
        law = Gaussian(std=0.0) if noise is None else noise
        if not isinstance(law, Law):
            raise TypeError(
                f"`noise` must be a law, got {noise!r}; a bare number does not say what it is: use one of "
                f"{known_laws()}."
            )
        n = self.own_dimension
        matrix_value = np.eye(n) if noise_matrix is None else noise_matrix
        gain = diffusion_of(matrix_value, self.states, "noise_matrix", rows=n)
        if self.filters:
            law = self.filters.law(None if noise is None else law.resolve(gain.shape[1]))
            gain = self.filters.noise(None if noise is None else gain, n, self.time)
        moves = isinstance(gain, Tape)
        assign(self, gain=gain if moves else None, fixed_gain=frozen(np.full(gain.shape, np.nan)) if moves else gain)
        assign(self, noise=law.resolve(gain.shape[1]))

    @property
    def noise_matrix(self) -> Array:
        """G, shape (n, m).

        Raises
        ------
        InfeasibleError
            If it depends on t or x.
        """
        if self.gain is not None:
            raise InfeasibleError(
                "the noise matrix depends on t or the states; only value functions of one or two states "
                '(method "values") and simulations serve that.'
            )
        return self.fixed_gain

    @property
    def noise_dimension(self) -> int:
        return int(self.fixed_gain.shape[1])


def linear_system(
    A: ArrayLike,
    B: ArrayLike | None = None,
    b: ArrayLike | None = None,
    *,
    E: ArrayLike | None = None,
    time: str | None = None,
    states: int | Sequence[str] | None = None,
    inputs: Box | None = None,
    **options: Any,
) -> ContinuousSystem | DiscreteSystem:
    """dX = (A X + B u + E d + b) dt + G dW, or X+ = A X + B u + E d + b + G w.

    Parameters
    ----------
    A : array_like, shape (n, n)
        System matrix.
    B : array_like, shape (n, k), optional
        Input matrix; the inputs are unbounded when ``inputs`` is omitted.
    b : array_like, shape (n,), optional
        Constant term.
    E : array_like, shape (n, l), optional
        Disturbance matrix; needs ``disturbance``.
    time : "continuous" or "discrete", optional
        When omitted: discrete if ``noise`` or ``noise_matrix`` is given, continuous otherwise.
    states, inputs, **options
        As for ``ContinuousSystem`` and ``DiscreteSystem``.

    Examples
    --------
    >>> linear_system([[0, 1], [-1, -1]], diffusion=[[0], [0.5]]).time
    'continuous'
    """
    if options.get("filters"):
        raise ValueError(
            "`filters` must come with a function that uses their outputs, got matrices; give cb.ContinuousSystem or "
            "cb.DiscreteSystem `lambda x: A @ x[:n] + F @ x[n:]`."
        )
    a = matrix("A", A)
    a = matrix("A", A, len(a), len(a))
    n = len(a)
    gain = None if B is None else matrix("B", B, rows=n)
    push = None if E is None else matrix("E", E, rows=n)
    offset = np.zeros(n) if b is None else vector("b", b, n)
    if (push is None) != (options.get("disturbance") is None):
        raise ValueError("`E` and `disturbance` must be given together.")
    if gain is None and inputs is not None:
        raise ValueError("`inputs` must come with a matrix `B`.")
    if gain is not None and inputs is None:
        inputs = Box([-np.inf] * gain.shape[1], [np.inf] * gain.shape[1])
    for name, mat, box in (("B", gain, inputs), ("E", push, options.get("disturbance"))):
        if mat is not None and isinstance(box, Box) and box.dimension != mat.shape[1]:
            raise ValueError(f"`{name}` must have {box.dimension} columns, got {mat.shape[1]}.")
    if time is None:
        time = "discrete" if {"noise", "noise_matrix"} & set(options) else "continuous"
    if time not in ("continuous", "discrete"):
        raise ValueError(f"`time` must be 'continuous' or 'discrete', got {time!r}.")
    build = ContinuousSystem if time == "continuous" else DiscreteSystem
    terms: dict[str, Callable[..., Any]] = {
        "": lambda x: a @ x + offset,
        "u": lambda x, u: a @ x + gain @ u + offset,
        "d": lambda x, d: a @ x + push @ d + offset,
        "ud": lambda x, u, d: a @ x + gain @ u + push @ d + offset,
    }
    f = terms[("" if gain is None else "u") + ("" if push is None else "d")]
    return build(f, states=n if states is None else states, inputs=inputs, **options)


def from_control(system: Any, *, input_noise: Any = None, **options: Any) -> ContinuousSystem | DiscreteSystem:
    """A python-control ``StateSpace``, ``TransferFunction`` or ``NonlinearIOSystem``.

    A system with a sampling time becomes a ``DiscreteSystem``. Names of states and inputs are kept as far as
    they are identifiers; inputs are unbounded unless ``inputs`` says otherwise. Of a state-space model the outputs are
    not used. The outputs of a transfer function are states, each the first of its row of transfer functions (less what
    inputs add to it at once); the others are called ``<output>_2`` and so on, and mean nothing by themselves.

    Parameters
    ----------
    system : control.StateSpace, control.TransferFunction or control.NonlinearIOSystem
        A model with states.
    input_noise : array_like of shape (m,) or Law, optional
        Of a linear model: noise on its inputs, u dt + diag(input_noise) dW in continuous time (a number serves each),
        u + w with w of the given law in discrete time. In place of ``diffusion``, ``noise`` and ``noise_matrix``.
    **options
        As for ``ContinuousSystem`` and ``DiscreteSystem``.

    Examples
    --------
    >>> import control
    >>> from_control(control.tf([3], [1, 2, 5]), input_noise=0.1).diffusion.tolist()
    [[0.0], [0.30000000000000004]]
    """
    if not is_control_system(system):
        raise TypeError(f"`system` must be a python-control system with states, got {system!r}.")
    discrete = system.isdtime(strict=True)
    if input_noise is not None:
        options |= _noisy_inputs(linear_inputs(system), input_noise, discrete, options)
    return (DiscreteSystem if discrete else ContinuousSystem)(system, **options)


def _noisy_inputs(b: Array, noise: Any, discrete: bool, options: dict[str, Any]) -> dict[str, Any]:
    for name in ("diffusion", "noise", "noise_matrix"):
        if name in options:
            raise ValueError(f"`{name}` must be omitted beside `input_noise`; give one of the two.")
    if not discrete:
        level = vector("input_noise", noise)
        level = np.broadcast_to(level, (b.shape[1],)) if len(level) == 1 else vector("input_noise", noise, b.shape[1])
        return {"diffusion": b * level}
    if not isinstance(noise, Law):
        raise TypeError(f"`input_noise` must be a law such as cb.Gaussian(std=0.1) in discrete time, got {noise!r}.")
    return {"noise": noise, "noise_matrix": b}
