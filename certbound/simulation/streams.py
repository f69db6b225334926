"""Random streams of the simulation kernels: SFC64 and the ziggurat, compiled into the kernels.

A stream is the state of NumPy's SFC64 generator, an array of four 64-bit words, so that block k of a run with
entropy s always draws the same numbers: those of ``SFC64(SeedSequence(s, spawn_key=(k, 1)))``. Normal
variates come from the 256-layer ziggurat (Marsaglia and Tsang, 2000) on 53-bit integers; the layer number and
the position use different bits of one word, so a variate costs one word in 98.8 % of the draws.

Importing this module imports numba: import it inside functions.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import int64, njit, uint64
from numpy.typing import NDArray

__all__ = ["fill_normal", "fill_sign", "fill_uniform", "seed_stream", "start_generator", "uniform"]

_TAIL = 3.6541528853610088  # where the tail of 256 layers of equal area begins


def _layers() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Right ends of the layers (first: the base strip's width, last: 0) and the density there."""
    density = math.exp(-0.5 * _TAIL**2)
    area = _TAIL * density + math.sqrt(math.pi / 2) * math.erfc(_TAIL / math.sqrt(2))
    ends = [area / density, _TAIL]
    while len(ends) < 256:
        ends.append(math.sqrt(-2.0 * math.log(area / ends[-1] + math.exp(-0.5 * ends[-1] ** 2))))
    ends.append(0.0)
    right = np.array(ends)
    return right, np.exp(-0.5 * right**2)


_RIGHT, _DENSITY = _layers()
_SCALE = _RIGHT[:256] * 2.0**-52
_INNER = np.floor(_RIGHT[1:] / _RIGHT[:256] * 2.0**52).astype(np.int64)

_ONE, _BYTE = uint64(1), uint64(255)
_S3, _S11, _S24, _S40 = uint64(3), uint64(11), uint64(24), uint64(40)


def start_generator(entropy: int, block: int) -> np.random.Generator:
    """The generator that draws the start points and disturbances of a block."""
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(entropy, spawn_key=(block, 0))))


def seed_stream(entropy: int, block: int) -> NDArray[np.uint64]:
    """The stream that drives the noise of a block: the four words of its SFC64 generator.

    Examples
    --------
    >>> seed_stream(1, 0).shape
    (4,)
    """
    generator: Any = np.random.SFC64(np.random.SeedSequence(entropy, spawn_key=(block, 1)))
    return np.array(generator.state["state"]["state"], dtype=np.uint64)


def _next_word(stream):  # type: ignore[no-untyped-def]
    a, b, c, w = stream[0], stream[1], stream[2], stream[3]
    word = a + b + w
    stream[0] = b ^ (b >> _S11)
    stream[1] = c + (c << _S3)
    stream[2] = ((c << _S24) | (c >> _S40)) + word
    stream[3] = w + _ONE
    return word


next_word = njit(nogil=True, inline="always")(_next_word)


def _uniform(stream):  # type: ignore[no-untyped-def]
    """One variate uniform on (0, 1): a centred 53-bit fraction, never 0 nor 1 up to rounding."""
    return ((next_word(stream) >> _S11) + 0.5) * 2.0**-53


uniform = njit(nogil=True)(_uniform)


def _fill_uniform(stream, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` with variates uniform on (-1, 1)."""
    for j in range(out.shape[0]):
        out[j] = 2.0 * uniform(stream) - 1.0


fill_uniform = njit(nogil=True)(_fill_uniform)


def _fill_sign(stream, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` with -1 and 1, equally likely; one word serves 64 of them."""
    word = uint64(0)
    for j in range(out.shape[0]):
        if j % 64 == 0:
            word = next_word(stream)
        out[j] = 1.0 if word & _ONE else -1.0
        word = word >> _ONE


fill_sign = njit(nogil=True)(_fill_sign)


def _normal_slowly(stream, layer, position):  # type: ignore[no-untyped-def]
    """The rare cases of the ziggurat; 0 with False asks for a new word."""
    if layer == 0:
        while True:
            x = -math.log(uniform(stream)) / _TAIL
            y = -math.log(uniform(stream))
            if y + y > x * x:
                return (_TAIL + x if position > 0 else -_TAIL - x), True
    x = position * _SCALE[layer]
    height = _DENSITY[layer] + uniform(stream) * (_DENSITY[layer + 1] - _DENSITY[layer])
    return x, height < math.exp(-0.5 * x * x)


_slowly = njit(nogil=True)(_normal_slowly)


def _fill_normal(stream, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` with standard normal variates."""
    a, b, c, w = stream[0], stream[1], stream[2], stream[3]
    j = 0
    while j < out.shape[0]:
        word = a + b + w
        a = b ^ (b >> _S11)
        b = c + (c << _S3)
        c = ((c << _S24) | (c >> _S40)) + word
        w = w + _ONE
        layer = word & _BYTE
        position = int64(word) >> int64(11)
        if abs(position) < _INNER[layer]:
            out[j] = position * _SCALE[layer]
            j += 1
            continue
        stream[0], stream[1], stream[2], stream[3] = a, b, c, w
        value, accepted = _slowly(stream, layer, position)
        a, b, c, w = stream[0], stream[1], stream[2], stream[3]
        if accepted:
            out[j] = value
            j += 1
    stream[0], stream[1], stream[2], stream[3] = a, b, c, w


fill_normal = njit(nogil=True)(_fill_normal)
