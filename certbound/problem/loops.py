"""A plant and what closes its loop as one system: the states of an observer, or of a controller, beside the plant's.

CT: dX = f(t, X, u, d) dt + G dW, measured by dY = h(t, X) dt + V dB. DT: X+ = f(t, X, u, d) + G w, Y = h(t, X) + v. The
estimate Z of an observer with gain L and model m obeys

    dZ = m(t, Z, u) dt + L (dY - h(t, Z) dt),    Z+ = m(t, Z, u) + L (Y - h(t, Z)),    u = k(t, Z),

so that the loop is a system over (X, Z) in the same sense of Ito, with drift (f, m + L (h(t, X) - h(t, Z))) and noise
(G dW, L V dB). Nothing is left out, and nothing approximated.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import matrix, vector
from certbound.problem.adapters import is_control_system
from certbound.problem.model import Tape, sources
from certbound.problem.noise import Law
from certbound.problem.observers import Part, Wires, as_tape, controller, function_of, measurements, observer_of
from certbound.problem.signals import diffusion_of
from certbound.problem.systems import ContinuousSystem, DiscreteSystem, System


def estimate_loop(
    system: ContinuousSystem | DiscreteSystem,
    observer: Any,
    *,
    output: Any,
    feedback: Any = None,
    model: Any = None,
    sensor_diffusion: Any = None,
    sensor_noise: Law | None = None,
) -> ContinuousSystem | DiscreteSystem:
    """The plant with an observer or a dynamic controller in the loop, as one system without inputs.

    Its states are the plant's and, behind them, those of the observer: ``<state>_hat``, or as python-control names
    them. Disturbances stay the plant's; the observer does not see them.

    Parameters
    ----------
    system : ContinuousSystem or DiscreteSystem
        The plant. ``feedback`` has to respect the bounds of its inputs (``np.clip``).
    observer : array_like of shape (n, p), function L(t, x), or python-control system
        The gain, as ``control.lqe`` and ``control.place`` give it, in discrete time that of the predictor
        (``control.dlqe``); a function of the estimate (of t, x or the plant's names) makes an extended observer. A
        ``StateSpace``, ``TransferFunction`` or ``NonlinearIOSystem`` takes the measurements and, where it has more
        inputs, the plant's inputs behind them; its outputs are estimates, or the plant's inputs where there is no
        ``feedback``. A minus sign is never added.
    output : array_like of shape (p, n), or function h(t, x)
        What is measured.
    feedback : function k(t, x), optional
        The plant's inputs from the estimate (by the plant's names or as x), or from the outputs x of a python-control
        observer. Left out for a plant without inputs, and where a python-control system is the controller.
    model : function m(t, x, u), optional
        What an observer given by its gain takes the plant for; when omitted the plant itself, with its disturbances in
        the middle of their bounds.
    sensor_diffusion : array_like of shape (p, q) or (p,), optional
        Continuous time: V, or its diagonal; a number serves one measurement.
    sensor_noise : Law, optional
        Discrete time: the law of v, independent of the plant's noise and of the same kind.

    Raises
    ------
    TypeError, ValueError
        If sizes disagree, the plant has inputs that nothing gives, the observer is not affine in noisy measurements or
        passes them on to the inputs at once, or the two laws are of different kinds.

    Examples
    --------
    >>> from certbound.problem.sets import Box
    >>> plant = ContinuousSystem(lambda x, u: [x[1], u[0] - np.sin(x[0])], states=["angle", "speed"],
    ...                          inputs=Box([-9], [9]), diffusion=[[0], [0.1]])
    >>> loop = estimate_loop(plant, [[2], [3]], output=[[1, 0]], feedback=lambda x: -2 * x[0] - 3 * x[1],
    ...                      sensor_diffusion=0.01)
    >>> loop.states, loop.diffusion.tolist()
    (('angle', 'speed', 'angle_hat', 'speed_hat'), [[0.0, 0.0], [0.1, 0.0], [0.0, 0.02], [0.0, 0.03]])
    """
    if not isinstance(system, ContinuousSystem | DiscreteSystem):
        raise TypeError(f"`system` must be a ContinuousSystem or DiscreteSystem, got {system!r}.")
    measured = function_of("output", output, system.states)
    if is_control_system(observer):
        if model is not None:
            raise ValueError("`model` must be omitted where `observer` is a python-control system, which has its own.")
        part = controller(system, observer, len(measured.outputs), feedback)
    else:
        part = observer_of(system, observer, measured, feedback, model)
    sensor, law = _sensor(system, len(measured.outputs), sensor_diffusion, sensor_noise)
    if sensor is not None:
        _check_noisy(part)
    return _built(system, measured, part, sensor, law)


def _sensor(system: System, count: int, diffusion: Any, law: Law | None) -> tuple[Array | None, Law | None]:
    """V, shape (p, q), and the law of v in discrete time; None where there is no noise."""
    if isinstance(system, DiscreteSystem):
        if diffusion is not None:
            raise ValueError("`sensor_diffusion` must be omitted in discrete time; give `sensor_noise`, a law.")
        if law is None:
            return None, None
        if not isinstance(law, Law):
            raise TypeError(f"`sensor_noise` must be a law such as cb.Gaussian(std=0.01), got {law!r}.")
        return np.eye(count), law.resolve(count)
    if law is not None:
        raise ValueError("`sensor_noise` must be omitted in continuous time; give `sensor_diffusion`, a matrix.")
    if diffusion is None:
        return None, None
    if np.ndim(diffusion) < 2:
        return np.diag(vector("sensor_diffusion", diffusion, count)), None
    return matrix("sensor_diffusion", diffusion, rows=count), None


def _check_noisy(part: Part) -> None:
    """Noise enters the observer's states only, by a gain that the measurements do not change."""
    if part.law is not None and any(slot > len(part.states) for slot in set[int]().union(*sources(part.law))):
        raise ValueError(
            "`observer` must not pass noisy measurements on to the inputs at once; multiply the controller by a "
            "filter, such as 1/(0.01 s + 1), or leave the sensor's noise out."
        )
    if part.slope is None:
        raise ValueError("`observer` must be affine in noisy measurements; leave the noise out, or use a gain.")


def _built(
    system: ContinuousSystem | DiscreteSystem, measured: Tape, part: Part, sensor: Array | None, law: Law | None
) -> ContinuousSystem | DiscreteSystem:
    states = (*system.states, *part.states)
    wires = Wires(("t", *states, *system.disturbance_names))
    seen = dict(zip(measurements(measured), wires.run(measured)))
    inputs = {} if part.law is None else dict(zip(system.input_names, wires.run(part.law, seen)))
    moved = wires.run(system.dynamics, inputs) + wires.run(part.moves, seen | inputs)
    tape = wires.graph.tape(moved, (len(states),))
    names = system.disturbance_names or None
    if isinstance(system, ContinuousSystem):
        noise = _beside(system, system.diffusion, part, sensor)
        return ContinuousSystem(
            tape, states=states, disturbance=system.disturbance, disturbance_names=names, diffusion=noise
        )
    own: Array | Tape = system.fixed_gain if system.gain is None else system.gain
    if law is None:
        law = system.noise
    elif not np.any(getattr(system.noise, system.noise.level)):  # the plant has no noise
        own = np.zeros((len(system.states), 0))
    else:
        law = _joined(system.noise, law)
    noise = _beside(system, own, part, sensor)
    return DiscreteSystem(
        tape, states=states, disturbance=system.disturbance, disturbance_names=names, noise=law, noise_matrix=noise
    )


def _beside(system: System, own: Array | Tape, part: Part, sensor: Array | None) -> Array | Tape:
    """[[G, 0], [0, L V]], numbers where they are constant."""
    states = (*system.states, *part.states)
    wires = Wires(("t", *states))
    n, columns = len(system.states), own.shape[1]
    entries = np.full((len(states), columns + (0 if sensor is None else sensor.shape[1])), wires.graph.const(0.0))
    entries[:n, :columns] = np.reshape(wires.run(as_tape(own)), (n, columns))
    if sensor is not None:
        assert part.slope is not None
        gain = np.reshape(wires.run(part.slope), (len(part.states), len(sensor))).tolist()
        entries[n:, columns:] = [[wires.dot(row, wires.numbers(column)) for column in sensor.T] for row in gain]
    return diffusion_of(wires.graph.tape([int(node) for node in entries.flat], entries.shape), states, "noise")


def _joined(own: Law, other: Law) -> Law:
    """The law of two independent noises, one behind the other."""
    kind = type(own)
    rest = {name: getattr(own, name) for name in (*own.flags, *own.tables)}
    if type(other) is not kind or not all(np.array_equal(value, getattr(other, name)) for name, value in rest.items()):
        raise ValueError(
            f"`sensor_noise` must be of the kind of the plant's noise, got {type(other).__name__} beside "
            f"{kind.__name__}; state both as cb.SubGaussian(proxy_std=...), which covers bounded and Gaussian ones."
        )
    if own.level == other.level and not own.level.endswith("covariance"):
        return kind(**{own.level: np.concatenate([getattr(own, own.level), getattr(other, own.level)])}, **rest)
    wide = [level for level in kind.levels if level.endswith("covariance")]
    first, second = own.proxy, other.proxy
    both = np.zeros((len(first) + len(second),) * 2)
    both[: len(first), : len(first)] = first
    both[len(first) :, len(first) :] = second
    return kind(**{wide[0]: both}, **rest)
