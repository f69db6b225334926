"""Many numbers as one text: exact hexadecimal numbers, compressed and written in base 64, unpacked within bounds."""

from __future__ import annotations

import base64
import binascii
import math
import re
import zlib

import numpy as np

from certbound.checker.values.batches import Array
from certbound.errors import CertificateError

LONGEST = 24
"""Characters of a number, with the space after it."""
_NUMBER = re.compile(r"-?0x[01]\.[0-9a-f]{1,13}p[+-][0-9]{1,4}\Z")


def unpacked(value: object, path: str, shape: tuple[int, ...]) -> Array:
    """The numbers of an array, row by row.

    Nothing beyond what the shape needs is ever unpacked, however small the text.
    """
    if not isinstance(value, str) or not value.isascii():
        raise CertificateError(f"`{path}` must be text in base 64.")
    count = math.prod(shape)
    try:
        packed = base64.b64decode(value, validate=True)
        machine = zlib.decompressobj()
        text = machine.decompress(packed, count * LONGEST + 1)
    except (binascii.Error, ValueError, zlib.error) as error:
        raise CertificateError(f"`{path}` must be compressed text in base 64.") from error
    if not machine.eof or machine.unused_data or len(text) > count * LONGEST:
        raise CertificateError(f"`{path}` must hold {count} numbers, and nothing else.")
    words = text.decode("ascii", "replace").split(" ") if text else []
    if len(words) != count:
        raise CertificateError(f"`{path}` must hold {count} numbers, got {len(words)}.")
    if not all(_NUMBER.match(word) for word in words):
        raise CertificateError(f"`{path}` must hold numbers in hexadecimal notation, such as \"0x1.8p+1\".")
    try:
        numbers = [float.fromhex(word) for word in words]
    except OverflowError as error:
        raise CertificateError(f"`{path}` must hold finite numbers.") from error
    return np.array(numbers).reshape(shape)
