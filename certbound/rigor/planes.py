"""Planes below and above the neurons of a layered network, put together backwards to its inputs.

Over the range of its argument z every activation has a line below and one above, of slopes of their own:

    below z + low <= phi(z) <= above z + high.

A neuron of the next layer is c . phi(z): lines enter by the sign of c, z is W a + b with the activations a of the
layer before, and so on down to the inputs. Slopes are proposals in floats, whatever they are: `Activation.rest` proves
what they leave. What rounding takes from the coefficients is bounded by what they meet (`Relaxed.reach`).

Source: Zhang et al., Efficient neural network robustness certification with general activation functions (CROWN),
NeurIPS 2018.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.rigor.activations import ACTIVATIONS, Constants
from certbound.rigor.arithmetic import Interval
from certbound.rigor.rounding import STEP, lower, product_error, upper

_FLOOR = 1e-280  # times what is summed: more than underflow takes, with weights below 1e8


class Weights:
    """A layer's numbers: ``weights`` (p, k), ``bias`` (p,), and its activation by name, with constants."""

    def __init__(self, weights: Array, bias: Array, activation: str, constants: Constants = ()) -> None:
        self.weights, self.bias = np.asarray(weights, dtype=float), np.asarray(bias, dtype=float)
        self.size = np.abs(self.weights)
        self.row, self.constants = ACTIVATIONS[activation], constants

    @property
    def kinked(self) -> bool:
        """Whether its activation has kinks."""
        return self.row.kinks is not None


@dataclass(frozen=True, eq=False, slots=True)
class Relaxed:
    """A layer with lines around its activations over ranges of their arguments z; arrays are (width, M).

    ``reach`` bounds |b| + |W| |a| of the layer's inputs a, and so z; of the first layer it is about the middle of the
    box. ``inputs`` (M,) bounds the sum of all |a|.
    """

    layer: Weights
    below: Array
    above: Array
    low: Array
    high: Array
    reach: Array
    inputs: Array


def relax(layer: Weights, over: Interval, inputs: Array, centre: Interval | None = None) -> Relaxed:
    """Lines around the activations of a layer.

    Parameters
    ----------
    over : Interval, shape (width, M)
        Ranges of the arguments.
    inputs : ndarray, shape (k, M)
        Sizes of what the layer takes; of the first one, half-widths of the boxes.
    centre : Interval, shape (width, M), optional
        Of the first layer, what its activations take at the middles of the boxes; lines count from its own middle.
    """
    row, constants = layer.row, layer.constants
    below, above = row.lines(over.lo, over.hi, *constants)
    low, high = row.rest(over, below, *constants).lo, row.rest(over, above, *constants).hi
    offset = np.abs(layer.bias)[:, None]
    if centre is not None:
        offset = centre.mag
        low = lower(low - np.abs(below) * centre.rad, step=4 * STEP, tiny=_FLOOR)
        high = upper(high + np.abs(above) * centre.rad, step=4 * STEP, tiny=_FLOOR)
    gamma = 4 * product_error(layer.size.shape[1])[0]
    reach = upper(layer.size @ inputs + offset, step=gamma, tiny=_FLOOR)
    return Relaxed(layer, below, above, low, high, reach, upper(inputs.sum(axis=0), step=gamma))


def bound_arguments(layer: Weights, before: Sequence[Relaxed], centre: Interval, radius: Array) -> Interval:
    """Ranges (p, M) of what a layer's activations take, by planes over the inputs; infinite where floats overflow.

    ``before`` are the layers below, from the first; ``centre`` (width, M) is what the first one's activations take at
    the middles of the boxes, ``radius`` (n, M) are the half-widths of these.
    """
    rows = np.concatenate([layer.weights, -layer.weights])  # bounds from above, of z and of -z
    total = np.concatenate([layer.bias, -layer.bias])[:, None]
    size, floor = np.abs(total), 1.0
    factors: Array | None = None
    for number in range(len(before) - 1, -1, -1):
        own = before[number]
        shift = own.layer.bias[:, None] if number else centre.mid
        if factors is None:
            added, grown, factors = _first(rows, own, shift)
        else:
            added, grown, factors = _further(factors, own, shift)
        total, size, floor = total + added, size + grown, floor + own.reach.sum(axis=0) + own.inputs
    assert factors is not None
    spread = np.einsum("rnm,nm->rm", np.abs(factors), radius)
    terms = sum(len(own.reach) for own in before) + len(radius) + 16 * (len(before) + 1)
    error = 4 * product_error(terms)[0] * (size + spread) + _FLOOR * floor
    found = upper(total + spread + error, step=8 * STEP)
    found = np.where(np.isnan(found), np.inf, found)
    count = len(layer.bias)
    return Interval(-found[count:], found[:count])


def _first(rows: Array, own: Relaxed, shift: Array) -> tuple[Array, Array, Array]:
    """The step through the uppermost layer, whose coefficients (R, width) are those of all boxes.

    Returns what is added, the size of all that was summed, (R, M) each, and coefficients (R, k, M) of the inputs.
    """
    plus, minus, size = np.maximum(rows, 0.0), np.minimum(rows, 0.0), np.abs(rows)
    added = plus @ (own.high + own.above * shift) + minus @ (own.low + own.below * shift)
    steepest = np.maximum(np.abs(own.above), np.abs(own.below))
    grown = size @ (np.maximum(np.abs(own.high), np.abs(own.low)) + steepest * own.reach)
    weights = own.layer.weights
    (width, k), count = weights.shape, own.reach.shape[1]
    factors = np.zeros((len(rows), k * count))
    for part, slope in ((plus, own.above), (minus, own.below)):
        factors += part @ (weights[:, :, None] * slope[:, None]).reshape(width, k * count)
    return added, grown, factors.reshape(len(rows), k, count)


def _further(factors: Array, own: Relaxed, shift: Array) -> tuple[Array, Array, Array]:
    """The same through a lower layer, with coefficients (R, width, M) of each box."""
    positive = factors > 0
    held = np.where(positive, own.high, own.low)
    added, grown = (factors * held).sum(axis=1), (np.abs(factors) * np.abs(held)).sum(axis=1)
    turned = factors * np.where(positive, own.above, own.below)
    added += (turned * shift).sum(axis=1)
    grown += (np.abs(turned) * own.reach).sum(axis=1)
    return added, grown, np.swapaxes(np.swapaxes(turned, 1, 2) @ own.layer.weights, 1, 2)
