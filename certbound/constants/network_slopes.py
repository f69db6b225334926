"""Constants of a loop with a network in it, from what the slopes of its activations may be (LipSDP in a metric).

f(x) = g(x, y), y = network(h(x)): a Jacobian is A + B N C with A, B the derivatives of g, C that of h (constant), and N
any product of the layers' weights and of slopes in [a_i, b_i], which the domain narrows. With v = (dx, da_1, ...), the
differences of states and of the layers' values, and G v the difference of f, any multipliers t >= 0 for which

    2 c dx^T P dx - 2 dx^T P G v - sum_i t_i (da_i - a_i dz_i)(b_i dz_i - da_i)

is a positive definite form of v prove the rate c in the metric P; L^2 dx^T P dx - |G v|_P^2 in its place proves the
gain L. Intervals multiply the widths of all layers; this keeps what the neurons of a layer share. The form is convex in
(A, B), so that the corners of what varies in them suffice. A semidefinite program proposes, intervals prove.

Source: Fazlyab et al. (LipSDP), NeurIPS 2019; Sec. 6 of docs/theory.md.
"""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.constants.enclosures import enclose
from certbound.constants.model_data import Model
from certbound.constants.programs import solve
from certbound.errors import SolverError
from certbound.problem.model import Network, Node, Tape, jacobian, weights_of
from certbound.rigor.definite import is_positive_definite
from certbound.rigor.intervals import Interval, matmul, up
from certbound.rigor.planes import Weights

_MOST_NEURONS, _MOST_VARYING = 64, 4
_ROOM = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
_LEAST, _NARROW = 1e-7, 1e-9
_ANYWHERE = Interval(np.array([-np.inf]), np.array([np.inf]))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Loop:
    """Corners (A, B) of the derivatives of g, C, and the layers with the slopes (lo, hi) of every neuron."""

    corners: list[tuple[Interval, Interval]]
    inner: Interval
    layers: list[Weights]
    slopes: list[Interval]
    linear: bool  # whether the last layer has no activation


def bound_by_slopes(model: Model, metric: Array | None) -> float:
    """A rate c (continuous time) or gain L in a metric; infinite where no such form was found and proved.

    It takes one network of at most 64 neurons, called with arguments that are affine in the states.
    """
    loop = _loop(model)
    if loop is None:
        return np.inf
    p = np.eye(model.dimension) if metric is None else np.asarray(metric)
    try:
        value, multipliers = _proposed(loop, p, model.continuous)
    except SolverError:
        return np.inf
    scale = max(abs(value), 1e-3)
    for room in _ROOM:
        larger = float(value + room * scale)
        forms = _forms(loop, p, Interval.point(larger), multipliers, model.continuous)
        if all(bool(is_positive_definite(form)) for form in forms):
            return larger if model.continuous else float(up(np.sqrt(max(larger, 0.0))))
    return np.inf


def _loop(model: Model) -> _Loop | None:
    split = _split(model.dynamics)
    if split is None:
        return None
    outer, arguments, network = split
    layers = weights_of(network)
    if sum(len(layer.bias) for layer in layers) > _MOST_NEURONS:
        return None
    n, slots = model.dimension, list(model.state_slots)
    given = [model.ranges[slot].reshape(1) for slot in range(len(model.ranges))]
    ends = enclose(arguments, given, undefined="infinite").reshape(len(arguments.outputs))
    inner = enclose(jacobian(arguments, slots), given, undefined="infinite").reshape(len(arguments.outputs), n)
    places = list(range(len(given), len(outer.inputs)))
    whole = [*given, *[_ANYWHERE] * len(places)]
    a = enclose(jacobian(outer, slots), whole, undefined="infinite").reshape(n, n)
    b = enclose(jacobian(outer, places), whole, undefined="infinite").reshape(n, len(places))
    if not all(np.isfinite(part.mag).all() for part in (inner, a, b)) or np.any(inner.rad > _NARROW * inner.mag):
        return None
    both = Interval(np.concatenate([a.lo, b.lo], 1), np.concatenate([a.hi, b.hi], 1))
    wide = list(zip(*np.nonzero(both.rad > _NARROW * (1 + both.mag))))
    if len(wide) > _MOST_VARYING:
        return None
    corners = [(corner[:, :n], corner[:, n:]) for corner in _corners(both, wide)]
    linear = _slope_of(layers[-1], _ANYWHERE).mag.max() == 1 == _slope_of(layers[-1], _ANYWHERE).lo.min()
    return _Loop(corners=corners, inner=inner, layers=layers, slopes=_ranged(layers, ends), linear=bool(linear))


def _split(tape: Tape) -> tuple[Tape, Tape, Network] | None:
    """g over the inputs and the network's outputs, and h; None without a network, or with several calls."""
    calls = [index for index, node in enumerate(tape.nodes) if node.part is not None]
    parts = [tape.nodes[index].part for index in calls]
    if not parts or any(part is None or part.by for part in parts):
        return None
    if len({tape.nodes[index].args for index in calls}) > 1 or len({part.network for part in parts if part}) > 1:
        return None
    first = parts[0]
    assert first is not None
    count, nodes = len(tape.inputs), list(tape.nodes)
    for index, part in zip(calls, parts):
        assert part is not None
        nodes[index] = Node("input", (count + part.output,))
    names = (*tape.inputs, *(f"network {k}" for k in range(first.network.outputs)))
    outer = Tape(inputs=names, nodes=tuple(nodes), outputs=tape.outputs, shape=tape.shape)
    args = tape.nodes[calls[0]].args
    return outer, Tape(inputs=tape.inputs, nodes=tape.nodes, outputs=args, shape=(len(args),)), first.network


def _corners(both: Interval, wide: list[tuple[int, int]]) -> Iterator[Interval]:
    for ends in itertools.product((0, 1), repeat=len(wide)):
        low, high = both.lo.copy(), both.hi.copy()
        for place, end in zip(wide, ends):
            low[place] = high[place] = (both.lo, both.hi)[end][place]
        yield Interval(low, high)


def _slope_of(layer: Weights, z: Interval) -> Interval:
    return layer.row.slope(z, *layer.constants)


def _ranged(layers: list[Weights], ends: Interval) -> list[Interval]:
    """Slopes of every neuron over what the layers before it may say; all there are where that is unbounded."""
    found, values = [], ends
    for layer in layers:
        if np.isfinite(values.mag).all():
            z = matmul(Interval.point(layer.weights), values.reshape(-1, 1)).reshape(len(layer.bias)) + layer.bias
            found.append(_slope_of(layer, z))
            values = layer.row.value(z, *layer.constants)
        else:
            found.append(_slope_of(layer, _ANYWHERE).broadcast_to((len(layer.bias),)))
            values = layer.row.value(Interval(np.full(len(layer.bias), -1e300), np.full(len(layer.bias), 1e300)),
                                     *layer.constants)  # fmt: skip
    return found


def _rows(loop: _Loop) -> tuple[list[tuple[Interval, Interval]], Interval]:
    """Over v: per hidden layer the rows of da - a dz and of b dz - da; and those of the network's output."""
    n, hidden = loop.inner.shape[1], loop.layers[:-1] if loop.linear else loop.layers
    size = n + sum(len(layer.bias) for layer in hidden)
    pairs, start, width = [], 0, n
    for number, layer in enumerate(hidden):
        own, count = np.zeros((len(layer.bias), size)), len(layer.bias)
        own[:, start + width : start + width + count] = np.eye(count)
        moved = _placed(_weights(loop, number), start, size)
        slopes = loop.slopes[number]
        low, high = (Interval.point(end)[:, None] for end in (slopes.lo, slopes.hi))
        pairs.append((Interval.point(own) - moved * low, moved * high - own))
        start, width = start + width, count
    if loop.linear:
        return pairs, _placed(_weights(loop, len(hidden)), start, size)
    last = np.zeros((width, size))
    last[:, start:] = np.eye(width)
    return pairs, Interval.point(last)


def _weights(loop: _Loop, number: int) -> Interval:
    own = Interval.point(loop.layers[number].weights)
    return own if number else matmul(own, loop.inner)


def _placed(rows: Interval, start: int, size: int) -> Interval:
    low, high = np.zeros((len(rows.lo), size)), np.zeros((len(rows.lo), size))
    low[:, start : start + rows.shape[1]], high[:, start : start + rows.shape[1]] = rows.lo, rows.hi
    return Interval(low, high)


def _moved(corner: tuple[Interval, Interval], last: Interval) -> Interval:
    """G over v."""
    return _placed(corner[0], 0, last.shape[1]) + matmul(corner[1], last)


def _proposed(loop: _Loop, p: Array, continuous: bool) -> tuple[float, Array]:
    """c or L^2, and the multipliers, in floats."""
    cp: Any = importlib.import_module("cvxpy")
    pairs, last = _rows(loop)
    size, n = last.shape[1], len(p)
    unit = np.zeros((size, size))
    unit[:n, :n] = p
    value = cp.Variable()
    multipliers = [cp.Variable(len(first.lo), nonneg=True) for first, _ in pairs]
    spent = 0
    for t, (first, second) in zip(multipliers, pairs):
        product = first.mid.T @ cp.diag(t) @ second.mid
        spent += (product + product.T) / 2
    asked = []
    for corner in loop.corners:
        g = _moved(corner, last).mid
        if continuous:
            half = unit[:, :n] @ g
            main = 2 * value * unit - half - half.T
        else:
            main = value * unit - g.T @ p @ g
        asked.append(main - spent >> _LEAST * np.eye(size))
    solve(cp.Problem(cp.Minimize(value), asked))
    return float(value.value), np.concatenate([np.maximum(t.value, 0.0) for t in multipliers])


def _forms(loop: _Loop, p: Array, value: Interval, multipliers: Array, continuous: bool) -> Iterator[Interval]:
    """The forms that have to be positive definite, one a corner."""
    pairs, last = _rows(loop)
    size, n = last.shape[1], len(p)
    unit = np.zeros((size, size))
    unit[:n, :n] = p
    spent, start = Interval.point(np.zeros((size, size))), 0
    for first, second in pairs:
        own = multipliers[start : start + len(first.lo)]
        start += len(own)
        product = matmul((first * own[:, None]).T, second)
        spent = spent + (product + product.T) / 2.0
    for corner in loop.corners:
        g = _moved(corner, last)
        if continuous:
            half = matmul(Interval.point(unit[:, :n]), g)
            form = Interval.point(unit) * (value * 2.0) - (half + half.T)
        else:
            form = Interval.point(unit) * value - matmul(g.T, matmul(Interval.point(p), g))
        form = form - spent
        yield (form + form.T) / 2.0
