"""Lipschitz constants of layered networks, proved: |f(x) - f(y)| <= gain |x - y| for all x and y, in Euclidean norms.

Every activation has slopes in [a, b], so that with v = (dx, da_1, ..., da_{L-1}) the differences of inputs and of the
layers' values, and z_k = W_k a_{k-1}, any multipliers t >= 0 give

    sum_k (da_k - a dz_k)^T diag(t_k) (b dz_k - da_k) >= 0.

If rho |dx|^2 - |W_L da_{L-1}|^2 minus that sum is a positive definite form of v, the gain is sqrt(rho). A semidefinite
program proposes rho and t; the form is proved in intervals for a rho a little larger.

Source: Fazlyab, Robey, Hassani, Morari, Pappas, Efficient and accurate estimation of Lipschitz constants for deep
neural networks (LipSDP), NeurIPS 2019.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import frozen
from certbound.constants.programs import solve
from certbound.errors import CertificateError
from certbound.problem.model import weights_of
from certbound.problem.networks import NetworkFunction
from certbound.rigor.definite import is_positive_definite
from certbound.rigor.intervals import Interval, matmul
from certbound.rigor.planes import Weights
from certbound.rigor.rounding import up

_ROOM = (1e-5, 1e-4, 1e-3, 3e-3, 1e-2, 0.1, 1.0)
"""By how much rho may exceed what was proposed, in the order in which it is tried."""
_MOST_NEURONS = 200
_LEAST = 1e-7


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class NetworkGain:
    """A proved Lipschitz constant.

    Attributes
    ----------
    gain : float
        |f(x) - f(y)| <= ``gain`` |x - y|.
    multipliers : ndarray, shape (hidden neurons,)
        What proves it.
    proposed : float
        What the semidefinite program found, in floats.
    """

    gain: float
    multipliers: Array
    proposed: float


def bound_network_gain(function: NetworkFunction) -> NetworkGain:
    """A Lipschitz constant of a network over all inputs, in Euclidean norms.

    Proves |f(x) - f(y)| <= gain |x - y| for all x and y (LipSDP, with one multiplier a neuron).

    Raises
    ------
    ValueError
        If the network has more than 200 hidden neurons: the program grows with their fourth power.
    SolverError, CertificateError
        If no multipliers were found, or none that can be proved.

    Examples
    --------
    >>> import certbound as cb
    >>> policy = cb.network([{"weights": [[3.0], [4.0]], "activation": "tanh"}, {"weights": [[1.0, -1.0]]}])
    >>> 4.0 <= bound_network_gain(policy).gain < 4.1
    True
    """
    layers = weights_of(function.data)
    hidden = sum(len(layer.bias) for layer in layers[:-1])
    if hidden > _MOST_NEURONS:
        raise ValueError(f"`function` must have at most {_MOST_NEURONS} hidden neurons, got {hidden}.")
    outer = float(_slopes(layers[-1]).mag[0])
    # the output in units in which the product of all norms is about 1: powers of two are exact
    size = sum(np.log2(max(float(np.linalg.norm(layer.weights, 2)), 1e-30)) for layer in layers)
    scale = 2.0 ** float(np.clip(np.round(size), -500, 500))
    if not np.array_equal(layers[-1].weights / scale * scale, layers[-1].weights):
        scale = 1.0
    pairs, last = _differences(layers[:-1]), _last(layers, scale)
    if pairs:
        rho, multipliers = _proposal(pairs, last, layers[0].weights.shape[1])
    else:
        rho, multipliers = float(np.linalg.norm(layers[0].weights / scale, 2) ** 2), np.zeros(0)
    for room in _ROOM:
        larger = max(rho, _LEAST**2) * (1 + room)
        if _is_proved(pairs, last, layers[0].weights.shape[1], larger, multipliers):
            gain = float(up(up(up(np.sqrt(larger)) * scale) * outer))
            proposed = float(np.sqrt(max(rho, 0.0)) * scale * outer)
            return NetworkGain(gain=gain, multipliers=frozen(multipliers), proposed=proposed)
    raise CertificateError("the multipliers of a Lipschitz constant were not proved; scale the inputs to like sizes.")


def _slopes(layer: Weights) -> Interval:
    """All slopes of the activation, whatever its argument."""
    return layer.row.slope(Interval(np.array([-np.inf]), np.array([np.inf])), *layer.constants)


def _differences(layers: Sequence[Weights]) -> list[tuple[Interval, Interval]]:
    """For every hidden layer the rows of da - a dz and of b dz - da, over v."""
    size = layers[0].weights.shape[1] + sum(len(layer.bias) for layer in layers) if layers else 0
    found, start = [], 0
    for layer in layers:
        width, k = layer.weights.shape
        own, moved = np.zeros((width, size)), np.zeros((width, size))
        own[:, start + k : start + k + width] = np.eye(width)
        moved[:, start : start + k] = layer.weights
        start += k
        slopes = _slopes(layer)
        low, high = float(slopes.lo[0]), float(slopes.hi[0])
        found.append((Interval.point(own) - Interval.point(moved) * low, Interval.point(moved) * high - own))
    return found


def _last(layers: Sequence[Weights], scale: float) -> Array:
    """The rows of W_L da_{L-1} over v, in units of ``scale``."""
    weights = layers[-1].weights / scale
    before = sum(layer.weights.shape[1] for layer in layers[:-1])
    return np.concatenate([np.zeros((len(weights), before)), weights], axis=1)


def _proposal(pairs: Sequence[tuple[Interval, Interval]], last: Array, inputs: int) -> tuple[float, Array]:
    """rho and multipliers, in floats."""
    cp: Any = importlib.import_module("cvxpy")
    rho = cp.Variable(nonneg=True)
    multipliers = [cp.Variable(len(first.lo), nonneg=True) for first, _ in pairs]
    unit = np.zeros((last.shape[1],) * 2)
    unit[:inputs, :inputs] = np.eye(inputs)
    form = rho * unit - last.T @ last
    for t, (first, second) in zip(multipliers, pairs):
        product = first.mid.T @ cp.diag(t) @ second.mid
        form -= (product + product.T) / 2
    problem = cp.Problem(cp.Minimize(rho), [form >> _LEAST * np.eye(last.shape[1])])
    solve(problem)
    return float(rho.value), np.concatenate([np.maximum(t.value, 0.0) for t in multipliers])


def _is_proved(
    pairs: Sequence[tuple[Interval, Interval]], last: Array, inputs: int, rho: float, multipliers: Array
) -> bool:
    """Whether the form is positive definite."""
    unit = np.zeros((last.shape[1],) * 2)
    unit[:inputs, :inputs] = rho * np.eye(inputs)
    form, start = Interval.point(unit) - matmul(last.T, last), 0
    for first, second in pairs:
        own = multipliers[start : start + len(first.lo)]
        start += len(own)
        product = matmul((first * own[:, None]).T, second)
        form = form - (product + product.T) / 2.0
    return bool(is_positive_definite(form))
