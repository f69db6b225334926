"""What the parts of networks are to the readers of a tape: rows like those of the table of operations.

All parts of one network at the same arguments are computed together, and the last few results are kept: a tape asks for
them one after the other.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.model.network_data import Network, Part
from certbound.rigor import layers as ly
from certbound.rigor.arithmetic import Interval
from certbound.rigor.planes import Weights
from certbound.rigor.series import Series

_KEPT = 4
_WEIGHTS: WeakKeyDictionary[Network, list[Weights]] = WeakKeyDictionary()


class _Recent(threading.local):
    """The last results of this thread: what was asked, of which arguments, and the answer."""

    def __init__(self) -> None:
        self.entries: list[tuple[tuple[Any, ...], tuple[Any, ...], Any]] = []

    def of(self, key: tuple[Any, ...], args: tuple[Any, ...], compute: Callable[[], Any]) -> Any:
        """The answer for arguments that are the very same objects, or a new one."""
        for known, held, answer in self.entries:
            if known == key and len(held) == len(args) and all(a is b for a, b in zip(held, args)):
                return answer
        answer = compute()
        self.entries = [(key, args, answer), *self.entries[: _KEPT - 1]]
        return answer


_RECENT = _Recent()


def weights_of(network: Network) -> list[Weights]:
    """The layers as arrays."""
    found = _WEIGHTS.get(network)
    if found is None:
        found = _WEIGHTS[network] = [
            Weights(np.array(layer.weights), np.array(layer.bias), layer.activation, layer.constants)
            for layer in network.layers
        ]
    return found


def stacked(args: Sequence[Interval]) -> Interval:
    """Arguments as the rows of one array, (n, M)."""
    shape = np.broadcast_shapes(*(x.shape for x in args))
    own = [x.broadcast_to(shape).reshape(int(np.prod(shape))) for x in args]
    return Interval(np.stack([x.lo for x in own]), np.stack([x.hi for x in own]))


def _enclosure(args: tuple[Interval, ...], part: Part) -> ly.Enclosure:
    order = len(part.by)
    box = partial(stacked, args)
    found: ly.Enclosure = _RECENT.of(
        (part.network, order), args, lambda: ly.bound_network(weights_of(part.network), box(), order)
    )
    return found


def interval(*given: Any) -> Interval:
    """The range of a part over intervals."""
    *args, part = given
    shape = np.broadcast_shapes(*(x.shape for x in args))
    found = _enclosure(tuple(args), part)
    if not part.by:
        return found.value[part.output].reshape(shape)
    values = found.slopes if len(part.by) == 1 else found.bends
    assert values is not None
    return values[(part.output, *part.by)].reshape(shape)


def relaxed(network: Network, args: Sequence[Interval]) -> tuple[Array, Array, Interval]:
    """Planes around a network over boxes: the middles c (n, ...), slopes (p, n, ...) and rests (p, ...).

    The network lies in slopes . (u - c) + rests; everything is unbounded where a box is.
    """
    shape = np.broadcast_shapes(*(x.shape for x in args))
    box = stacked(args)
    slopes, rests = ly.relax_network(weights_of(network), box)
    p, n = slopes.shape[:2]
    return box.mid.reshape((n, *shape)), slopes.reshape((p, n, *shape)), rests.reshape((p, *shape))


def kinked(*given: Any) -> Mask:
    """Where a kink of the network lies in the box."""
    *args, part = given
    return _enclosure(tuple(args), part).kinked.reshape(np.broadcast_shapes(*(x.shape for x in args)))


def jumps(_: Interval, *given: Any) -> Mask:
    """Where a part may jump, its range being known."""
    return kinked(*given)


def series(*given: Any) -> Series:
    """Taylor coefficients of a part; of derivatives only the first is bounded."""
    *args, part, order = given
    if not part.by:
        found: list[Series] = _RECENT.of(
            (part.network, "series", order), tuple(args),
            lambda: ly.expand_network(weights_of(part.network), args, order),
        )
        return found[part.output]
    first = interval(*(x[0] for x in args), part)
    if all(len(x) == 1 for x in args):
        return [first]
    everything = Interval(np.full(first.shape, -np.inf), np.full(first.shape, np.inf))
    return [first, *[everything] * order]


def slope(place: int, graph: Any, *given: Any) -> int:
    """The node of the derivative by the argument ``place``: arguments, part and the node itself come last."""
    *args, part, _ = given
    found: int = graph.part(part.derivative(place), tuple(args))
    return found


def numpy(*given: Any) -> Any:
    """Values in floats."""
    *args, part = given
    shape = np.broadcast_shapes(*(np.shape(x) for x in args))
    points = np.stack([np.broadcast_to(x, shape).reshape(-1) for x in args]).astype(float)
    columns = _float_columns(weights_of(part.network), points, len(part.by))
    return columns[(part.output, *part.by)].reshape(shape)[()]


def _float_columns(layers: Sequence[Weights], points: Array, order: int) -> Array:
    """Values (p, M), derivatives (p, n, M), or second ones (p, n, n, M), in floats."""
    if order:
        known = np.isfinite(points).all(axis=0)
        points = np.where(known, points, 0.0)
        thin = ly.bound_network(layers, Interval(points, points), order)
        values = thin.slopes if order == 1 else thin.bends
        assert values is not None
        return np.where(known, values.mid, np.nan)
    for layer in layers:
        points = layer.row.numpy(layer.weights @ points + layer.bias[:, None], *layer.constants)
    return points
