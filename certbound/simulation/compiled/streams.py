"""Random streams of the simulation kernels: SFC64 and the ziggurat, compiled into the kernels.

A stream is the state of NumPy's SFC64 generator, an array of four 64-bit words, so that block k of a run with
entropy s always draws the same numbers: those of ``SFC64(SeedSequence(s, spawn_key=(k, 1)))``. A second
stream of the block, with key (k, 2), drives the noise alone; a kernel holds its four words in local variables
and passes them to the functions ``draw_...``, which give them back, so that they stay in registers. Normal
variates come from the 256-layer ziggurat (Marsaglia and Tsang, 2000) on 53-bit integers; the layer number and
the position use different bits of one word, so a variate costs one word in 98.8 % of the draws.

Importing this module imports numba: import it inside functions.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from numba import int64, njit, uint64
from numpy.typing import NDArray

_UNWRAPPED: Any = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
inner = njit(nogil=True, cache=True, error_model="numpy", **_UNWRAPPED)
"""For functions that only compiled ones call; numba keeps them, and knows them by the date of their own file."""

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

_ONE, _BYTE, _TOP = uint64(1), uint64(255), uint64(1 << 63)
_GOLDEN = uint64(0x9E3779B97F4A7C15)  # 2**64 over the golden ratio, odd
_S3, _S11, _S24, _S40 = uint64(3), uint64(11), uint64(24), uint64(40)


def start_generator(entropy: int, block: int) -> np.random.Generator:
    """The generator that draws the start points and disturbances of a block."""
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(entropy, spawn_key=(block, 0))))


def seed_stream(entropy: int, block: int) -> NDArray[np.uint64]:
    """The two streams of a block, four words each: first the one of uniform variates, then the noise's.

    Examples
    --------
    >>> seed_stream(1, 0).shape
    (8,)
    """
    words = [np.random.SFC64(np.random.SeedSequence(entropy, spawn_key=(block, key))).state for key in (1, 2)]
    return np.array([word for state in words for word in cast(Any, state)["state"]["state"]], dtype=np.uint64)


def _stream_of(stream, path):  # type: ignore[no-untyped-def]
    """Four words of a stream of its own for the noise of a path, made from the block's and mixed as SFC64 mixes a seed.

    Paths of two simulations then meet the same noise, wherever the paths before them have ended.
    """
    a, b, c, w = stream[4], stream[5] ^ stream[7], stream[6] + _GOLDEN * uint64(path + 1), _ONE
    for _ in range(12):
        word = a + b + w
        a, b, c, w = b ^ (b >> _S11), c + (c << _S3), ((c << _S24) | (c >> _S40)) + word, w + _ONE
    return a, b, c, w


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


uniform = njit(nogil=True, cache=True)(_uniform)


def _draw_normal(a, b, c, w):  # type: ignore[no-untyped-def]
    """A standard normal variate, and the stream's four words after it."""
    word = a + b + w
    p, q, r, s = b ^ (b >> _S11), c + (c << _S3), ((c << _S24) | (c >> _S40)) + word, w + _ONE
    layer = word & _BYTE
    position = int64(word) >> int64(11)
    if abs(position) < _INNER[layer]:
        return position * _SCALE[layer], p, q, r, s
    return _slowly(layer, position, p, q, r, s)


def _normal_slowly(layer, position, a, b, c, w):  # type: ignore[no-untyped-def]
    """The rare cases of the ziggurat."""
    stream = np.array([a, b, c, w])
    while True:
        if layer == 0:
            while True:
                x = -math.log(uniform(stream)) / _TAIL
                y = -math.log(uniform(stream))
                if y + y > x * x:
                    value = _TAIL + x if position > 0 else -_TAIL - x
                    return value, stream[0], stream[1], stream[2], stream[3]
        x = position * _SCALE[layer]
        height = _DENSITY[layer] + uniform(stream) * (_DENSITY[layer + 1] - _DENSITY[layer])
        if height < math.exp(-0.5 * x * x):
            return x, stream[0], stream[1], stream[2], stream[3]
        word = next_word(stream)
        layer = word & _BYTE
        position = int64(word) >> int64(11)
        if abs(position) < _INNER[layer]:
            return position * _SCALE[layer], stream[0], stream[1], stream[2], stream[3]


_slowly = inner(_normal_slowly)
draw_normal = inner(_draw_normal)
stream_of = inner(_stream_of)


def _draw_uniform(a, b, c, w):  # type: ignore[no-untyped-def]
    """A variate uniform on (-1, 1), and the stream's four words after it."""
    word = a + b + w
    value = 2.0 * (((word >> _S11) + 0.5) * 2.0**-53) - 1.0
    return value, b ^ (b >> _S11), c + (c << _S3), ((c << _S24) | (c >> _S40)) + word, w + _ONE


draw_uniform = inner(_draw_uniform)


def _draw_sign(a, b, c, w):  # type: ignore[no-untyped-def]
    """-1 or 1, equally likely, and the stream's four words after it."""
    word = a + b + w
    value = 1.0 if word & _TOP else -1.0
    return value, b ^ (b >> _S11), c + (c << _S3), ((c << _S24) | (c >> _S40)) + word, w + _ONE


draw_sign = inner(_draw_sign)
