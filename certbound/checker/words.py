"""Words and numbers of a claim: rounded to the safe side, and nothing of a stranger's file but in quotes."""

from __future__ import annotations

import re
import unicodedata
from decimal import ROUND_CEILING, ROUND_FLOOR, Context

DIGITS = 6
_QUOTES = frozenset(
    '"\u02ba\u02dd\u02ee\u05f4\u201a\u201e\u2033\u2036\u275b\u275c\u275d\u275e\u3003\u301d\u301e\u301f\uff02'
)
"""What looks like a double quote, beside the quotes that Unicode calls initial or final ones."""


def rounded(value: float, *, up: bool, digits: int = DIGITS) -> str:
    """A finite number in ``digits`` decimal digits, never below the number itself (``up``), or never above it.

    Examples
    --------
    >>> rounded(-2.9999997, up=True), rounded(-2.9999997, up=False), rounded(-3.0, up=True)
    ('-2.99999', '-3', '-3')
    """
    context = Context(prec=digits, rounding=ROUND_CEILING if up else ROUND_FLOOR)
    return f"{float(context.create_decimal_from_float(value)):.{digits}g}"


def plainly(value: float) -> str:
    """The shortest decimal number that a float is read from: no other float reads the same.

    Examples
    --------
    >>> plainly(5.0), plainly(0.001), plainly(4.9999999)
    ('5', '0.001', '4.9999999')
    """
    return repr(value).removesuffix(".0")


def quoted(text: str, longest: int = 60) -> str:
    """A stranger's text on one line, in quotes that it cannot leave, and no longer than ``longest``.

    Examples
    --------
    >>> quoted('x" leaves\\nVALID'), quoted("y" * 99, 8), quoted("x\u201d leaves")
    ('"x\\' leaves VALID"', '"yyyyy..."', '"x\\' leaves"')
    """
    return f'"{shortened(text, longest)}"'


def named(key: str, longest: int = 40) -> str:
    """A key of a stranger's file as it stands, in quotes where it is no plain name.

    Examples
    --------
    >>> named("rooms"), named("rooms` was proved")
    ('rooms', '"rooms` was proved"')
    """
    return key if key.isascii() and key.isidentifier() and len(key) <= longest else quoted(key, longest)


def shortened(text: str, longest: int = 60) -> str:
    """A stranger's text on one line, without double quotes and no longer than ``longest``.

    Letters, figures and signs stay. What looks like a double quote becomes an apostrophe; marks that are drawn over
    their neighbours, and what is not printed at all, become blanks.

    Examples
    --------
    >>> shortened("a\\x1b[1m\\r\\nb\\u202e"), shortened("o\\u0308\\u0336 x\\uff02y")
    ('a [1m b', "\u00f6 x'y")
    """
    near = unicodedata.normalize("NFC", text[: 2 * longest])
    line = re.sub("'{2,}", "'", " ".join("".join(map(_shown, near)).split()))
    return line if len(line) <= longest and len(text) <= 2 * longest else f"{line[: longest - 3]}..."


def _shown(letter: str) -> str:
    kind = unicodedata.category(letter)
    if letter in _QUOTES or kind in ("Pi", "Pf"):
        return "'"
    return letter if letter.isprintable() and not kind.startswith("M") else " "
