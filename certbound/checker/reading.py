"""Reading a stranger's JSON: sizes first, then shapes, and one line for whatever is wrong.

Nothing in the file is executed, imported or evaluated. Numbers are strings in exact hexadecimal notation
(``float.hex``), so that the checker speaks of the very numbers that the prover used; JSON's own decimal and
non-finite numbers are refused, whole numbers serve as counts and indices.
"""

from __future__ import annotations

import base64
import binascii
import itertools
import json
import os
import re
import zlib
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, Protocol

from certbound.checker.words import named
from certbound.errors import CertificateError

LARGEST_FILE = 16 * 2**20
"""Bytes."""
MOST_ENTRIES = 2_000_000
_LONGEST_WHOLE = 9
_LONGEST = 24  # characters of a packed number, with the space after it
_LONGEST_PACKED = 17  # of a packed whole number: a sign, 15 digits, which a float holds exactly, and the space
_PER_NUMBER = 2_000
"""Units of work of a packed number; reading one takes about 900 ns."""
_BLOCK = 2**18
"""Bytes that are unpacked at once."""
_WHOLE = re.compile(r"-?[0-9]{1,15}\Z")
_NUMBER = re.compile(r"-?0x[01]\.[0-9a-f]{1,13}p[+-][0-9]{1,4}\Z")


class Counter(Protocol):
    """What counts memory and work before they are taken and done: ``report.Budget``."""

    def take(self, size: int) -> None: ...
    def spend(self, units: int) -> None: ...


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The JSON object in a file.

    Raises
    ------
    CertificateError
        If the file is larger than 16 MiB or is not one JSON object as described above.
    OSError
        If it cannot be read.
    """
    place = Path(path)
    size = place.stat().st_size
    if size > LARGEST_FILE:
        raise CertificateError(
            f"the certificate has {size / 2**20:.0f} MiB, more than the {LARGEST_FILE // 2**20} that a check accepts."
        )
    with place.open("rb") as stream:
        return parse(stream.read(LARGEST_FILE + 1))


def parse(content: str | bytes) -> dict[str, Any]:
    """The JSON object in a text.

    Raises
    ------
    CertificateError
        If it is longer than 16 MiB, has more than two million entries, is no JSON, nested too deeply, not finite, or
        no object.

    Examples
    --------
    >>> parse('{"version": 1}')
    {'version': 1}
    """
    if len(content) > LARGEST_FILE:
        raise CertificateError(f"the certificate is longer than {LARGEST_FILE // 2**20} MiB.")
    commas = content.count(b",") if isinstance(content, bytes) else content.count(",")
    if commas > MOST_ENTRIES:
        raise CertificateError(f"the certificate has more than {MOST_ENTRIES} entries.")
    try:
        text_ = content.decode("utf-8") if isinstance(content, bytes) else content
        value = json.loads(
            text_, parse_constant=_no_constant, parse_float=_no_float, parse_int=_whole, object_pairs_hook=_unique
        )
    except UnicodeDecodeError as error:
        raise CertificateError("the certificate is no UTF-8 text.") from error
    except RecursionError as error:
        raise CertificateError("the certificate is nested too deeply.") from error
    except json.JSONDecodeError as error:
        raise CertificateError(
            f"the certificate is no JSON: {error.msg} at character {error.pos}; give a file that "
            "`certbound verify --certificate` wrote."
        ) from error
    if not isinstance(value, dict):
        raise CertificateError("the certificate must be one JSON object.")
    return value


def _no_constant(name: str) -> NoReturn:
    raise CertificateError(f"the certificate holds {name}; numbers must be finite.")


def _no_float(written: str) -> NoReturn:
    raise CertificateError(f"the certificate holds the decimal number {written[:20]}; numbers are hexadecimal strings.")


def _whole(written: str) -> int:
    if len(written) > _LONGEST_WHOLE:
        raise CertificateError(f"the certificate holds a whole number of {len(written)} digits.")
    return int(written)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise CertificateError("the certificate holds an object with the same key twice.")
    return result


class Record:
    """A JSON object whose keys are all known.

    Parameters
    ----------
    value : object
    path : str
        Where it stands, for messages.
    required, optional : sequence of str
    """

    def __init__(self, value: object, path: str, required: Sequence[str], optional: Sequence[str] = ()) -> None:
        if not isinstance(value, Mapping):
            raise CertificateError(f"`{path}` must be an object.")
        missing = [name for name in required if name not in value]
        if missing:
            raise CertificateError(f"`{path}` must have `{missing[0]}`.")
        unknown = [str(name) for name in value if name not in required and name not in optional]
        if unknown:
            raise CertificateError(f"`{path}` has the unknown entry `{named(unknown[0])}`.")
        self.value, self.path = value, path

    def __getitem__(self, name: str) -> Any:
        return self.value.get(name)

    def at(self, name: str) -> str:
        """The path of an entry; a name that the file chose stands there in quotes."""
        return f"{self.path}.{named(name)}"

    def number(self, name: str, *, least: float | None = None) -> float:
        """An entry that is a number."""
        return number(self[name], self.at(name), least=least)

    def whole(self, name: str, low: int, high: int) -> int:
        """An entry that is a whole number."""
        return whole(self[name], self.at(name), low, high)

    def text(self, name: str, longest: int = 1000) -> str:
        """An entry that is text."""
        return text(self[name], self.at(name), longest)

    def flag(self, name: str) -> bool:
        """An entry that is true or false."""
        if not isinstance(self[name], bool):
            raise CertificateError(f"`{self.at(name)}` must be true or false.")
        return bool(self[name])

    def array(self, name: str, *shape: int | None) -> Any:
        """An entry that is an array of numbers of the given shape (None: any length)."""
        return numbers(self[name], self.at(name), *shape)

    def symmetric(self, name: str, n: int) -> list[list[float]]:
        """An entry that is a symmetric matrix of numbers."""
        rows: list[list[float]] = self.array(name, n, n)
        if any(rows[i][j] != rows[j][i] for i in range(n) for j in range(i)):
            raise CertificateError(f"`{self.at(name)}` must be symmetric.")
        return rows

    def items(self, name: str, low: int = 0, high: int = 100_000) -> list[Any]:
        """An entry that is a list of ``low`` to ``high`` entries."""
        return entries(self[name], self.at(name), low, high)


def number(value: object, path: str, *, least: float | None = None) -> float:
    """A finite number written in hexadecimal."""
    if not isinstance(value, str) or not _NUMBER.match(value):
        raise CertificateError(f"`{path}` must be a number in hexadecimal notation, such as \"0x1.8p+1\".")
    try:
        result = float.fromhex(value)
    except OverflowError as error:
        raise CertificateError(f"`{path}` must be a finite number.") from error
    if least is not None and not result >= least:
        raise CertificateError(f"`{path}` must be at least {least:g}, got {result:g}.")
    return result


def numbers(value: object, path: str, *shape: int | None) -> Any:
    """Nested lists of numbers; ``shape`` gives the length of every axis (None: any)."""
    if not shape:
        return number(value, path)
    items = entries(value, path, 0, 1_000_000)
    if shape[0] is not None and len(items) != shape[0]:
        raise CertificateError(f"`{path}` must have {shape[0]} entries, got {len(items)}.")
    return [numbers(item, f"{path}[{index}]", *shape[1:]) for index, item in enumerate(items)]


def entries(value: object, path: str, low: int, high: int) -> list[Any]:
    """A list whose length lies in [low, high]."""
    if not isinstance(value, list):
        raise CertificateError(f"`{path}` must be a list.")
    if not low <= len(value) <= high:
        raise CertificateError(f"`{path}` must have {low} to {high} entries, got {len(value)}.")
    return value


def whole(value: object, path: str, low: int, high: int) -> int:
    """A whole number in [low, high]."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise CertificateError(f"`{path}` must be a whole number.")
    if not low <= value <= high:
        raise CertificateError(f"`{path}` must lie in {low}..{high}, got {value}.")
    return value


def wholes(value: object, path: str, low: int, high: int) -> list[int]:
    """A list of whole numbers in [low, high]."""
    return [whole(item, f"{path}[{i}]", low, high) for i, item in enumerate(entries(value, path, 0, 100_000))]


def text(value: object, path: str, longest: int) -> str:
    """Printable text of at most ``longest`` characters."""
    if not isinstance(value, str) or len(value) > longest or not value.isprintable():
        raise CertificateError(f"`{path}` must be printable text of at most {longest} characters.")
    return value


def unpacked(value: object, path: str, count: int, budget: Counter, *, whole: bool = False) -> array[float]:
    """Numbers with single spaces between them, compressed and written in base 64; ``whole``: decimal whole numbers.

    Nothing beyond what so many numbers need is ever unpacked, however small the text, and never more than a block of it
    at once.
    """
    if not isinstance(value, str) or not value.isascii():
        raise CertificateError(f"`{path}` must be text in base 64.")
    budget.take(8 * count)
    budget.spend(count * _PER_NUMBER)
    found, rest, longest = array("d"), b"", _LONGEST_PACKED if whole else _LONGEST
    try:
        packed = base64.b64decode(value, validate=True)
        length, spaces = 0, 0
        for block in _blocks(packed):
            length, spaces = length + len(block), spaces + block.count(b" ")
            if length > count * longest:
                break
    except (binascii.Error, ValueError, zlib.error) as error:
        raise CertificateError(f"`{path}` must be compressed text in base 64.") from error
    if length > count * longest:
        raise CertificateError(f"`{path}` must hold {count} numbers, and nothing else.")
    words = spaces + 1 if length else 0
    if words != count:
        raise CertificateError(f"`{path}` must hold {count} numbers, got {words}.")
    convert = _whole_floats if whole else _floats
    for block in itertools.chain(_blocks(packed), [b" "]) if length else ():
        *ended, rest = (rest + block).split(b" ")
        found.extend(convert(ended, path))
    return found


def _whole_floats(words: Sequence[bytes], path: str) -> list[float]:
    texts = [word.decode("ascii", "replace") for word in words]
    if not all(map(_WHOLE.match, texts)):
        raise CertificateError(f"`{path}` must hold whole numbers of at most {_LONGEST_PACKED - 2} digits.")
    return list(map(float, texts))


def _floats(words: Sequence[bytes], path: str) -> list[float]:
    texts = [word.decode("ascii", "replace") for word in words]
    if not all(map(_NUMBER.match, texts)):
        raise CertificateError(f"`{path}` must hold numbers in hexadecimal notation, such as \"0x1.8p+1\".")
    try:
        return list(map(float.fromhex, texts))
    except OverflowError as error:
        raise CertificateError(f"`{path}` must hold finite numbers.") from error


def _blocks(packed: bytes) -> Iterator[bytes]:
    """What is unpacked, a block after the other; zlib.error where it does not end with the text."""
    machine = zlib.decompressobj()
    block = machine.decompress(packed, _BLOCK)
    while block:
        yield block
        block = machine.decompress(machine.unconsumed_tail, _BLOCK)
    if not machine.eof or machine.unused_data:
        raise zlib.error
