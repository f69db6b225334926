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
from certbound.rigor.activations import ACTIVATIONS, Constants, chord
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


def relax(
    layer: Weights, over: Interval, inputs: Array, centre: Interval | None = None, *, parallel: bool = False
) -> Relaxed:
    """Lines around the activations of a layer.

    Parameters
    ----------
    over : Interval, shape (width, M)
        Ranges of the arguments.
    inputs : ndarray, shape (k, M)
        Sizes of what the layer takes; of the first one, half-widths of the boxes.
    centre : Interval, shape (width, M), optional
        Of the first layer, what its activations take at the middles of the boxes; lines count from its own middle.
    parallel : bool
        Whether both lines have the slope of the chord.
    """
    row, constants = layer.row, layer.constants
    below, above = (_chord(layer, over),) * 2 if parallel else row.lines(over.lo, over.hi, *constants)
    below, above = (np.where(np.isfinite(slope), slope, 0.0) for slope in (below, above))
    rest = row.rest(over, below, *constants)
    low, high = rest.lo, rest.hi if parallel else row.rest(over, above, *constants).hi
    offset = np.abs(layer.bias)[:, None]
    if centre is not None:
        offset = centre.mag
        low = lower(low - np.abs(below) * centre.rad, step=4 * STEP, tiny=_FLOOR)
        high = upper(high + np.abs(above) * centre.rad, step=4 * STEP, tiny=_FLOOR)
    gamma = 4 * product_error(layer.size.shape[1])[0]
    reach = upper(layer.size @ inputs + offset, step=gamma, tiny=_FLOOR)
    return Relaxed(layer, below, above, low, high, reach, upper(inputs.sum(axis=0), step=gamma))


def _chord(layer: Weights, over: Interval) -> Array:
    """The slope of the chord, in floats; that at the middle where the range is thin."""
    slope = chord(layer.row.numpy, over.lo, over.hi, *layer.constants)
    thin = over.hi - over.lo < 1e-9 * (1 + np.abs(over.lo))
    if thin.any():
        slope = np.where(thin, layer.row.slope(Interval.point(over.mid), *layer.constants).mid, slope)
    return np.where(np.abs(slope) > 1e-9, slope, 0.0)


def bound_arguments(layer: Weights, before: Sequence[Relaxed], centre: Interval, radius: Array) -> Interval:
    """Ranges (p, M) of what a layer's activations take, by planes over the inputs; infinite where floats overflow.

    ``before`` are the layers below, from the first; ``centre`` (width, M) is what the first one's activations take at
    the middles of the boxes, ``radius`` (n, M) are the half-widths of these.
    """
    rows = np.concatenate([layer.weights, -layer.weights])  # bounds from above, of z and of -z
    factors, top = _planes_above(rows, np.concatenate([layer.bias, -layer.bias]), before, centre, radius)
    spread = np.einsum("rnm,nm->rm", np.abs(factors), radius)
    return _ends(upper(top + spread, step=4 * product_error(len(radius))[0], tiny=_FLOOR))


def parallel_planes(before: Sequence[Relaxed], centre: Interval, radius: Array) -> tuple[Array, Interval]:
    """Slopes (p, n, M) of planes around the last layer's activations, and what is left of these (p, M).

    ``before`` are all layers, with parallel lines; where floats overflow slopes are 0 and what is left is unbounded.
    """
    count = len(before[-1].layer.bias)
    factors, top = _planes_above(
        np.concatenate([np.eye(count), -np.eye(count)]), np.zeros(2 * count), before, centre, radius
    )
    slopes = factors[:count]
    turned = np.einsum("rnm,nm->rm", np.abs(factors[count:] + slopes), radius)  # products may differ by their order
    top[count:] = upper(top[count:] + turned, step=4 * product_error(len(radius))[0], tiny=_FLOOR)
    lost = ~np.isfinite(slopes).all(axis=(0, 1))
    top[:, lost] = np.inf
    return np.where(lost, 0.0, slopes), _ends(top)


def _ends(top: Array) -> Interval:
    """Intervals from bounds of z and of -z, one below the other."""
    top = np.where(np.isnan(top), np.inf, top)
    count = len(top) // 2
    return Interval(-top[count:], top[:count])


def _planes_above(
    rows: Array, bias: Array, before: Sequence[Relaxed], centre: Interval, radius: Array
) -> tuple[Array, Array]:
    """factors (R, n, M) and top (R, M): rows . a + bias <= factors . (x - c) + top, of the last activations a."""
    total = bias[:, None]
    size, floor = np.abs(total), 1.0
    # few rows are those of each box from the start
    factors: Array | None = rows[:, :, None] if len(rows) < before[-1].layer.weights.shape[1] else None
    for number in range(len(before) - 1, -1, -1):
        own = before[number]
        shift = own.layer.bias[:, None] if number else centre.mid
        if factors is None:
            added, grown, factors = _first(rows, own, shift)
        else:
            added, grown, factors = _further(factors, own, shift)
        total, size, floor = total + added, size + grown, floor + own.reach.sum(axis=0) + own.inputs
    assert factors is not None
    # roundings that meet a summand of one layer: those of its sums, of its lines, and of adding the layers up
    terms = max(max(own.layer.weights.shape) for own in before) + 8 * (len(before) + 1)
    error = product_error(terms)[0] * size + _FLOOR * floor
    return factors, upper(total + error, step=4 * STEP)


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
    """The same with coefficients (R, width, M) of each box."""
    positive = factors > 0
    held = np.where(positive, own.high, own.low)
    added, grown = (factors * held).sum(axis=1), (np.abs(factors) * np.abs(held)).sum(axis=1)
    turned = factors * np.where(positive, own.above, own.below)
    added += (turned * shift).sum(axis=1)
    grown += (np.abs(turned) * own.reach).sum(axis=1)
    return added, grown, np.swapaxes(np.swapaxes(turned, 1, 2) @ own.layer.weights, 1, 2)
