"""Words and numbers of a claim: rounded to the safe side, and nothing of a stranger's file but in quotes."""

from __future__ import annotations

from decimal import ROUND_CEILING, ROUND_FLOOR, Context

DIGITS = 6


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
    >>> quoted('x" leaves\\nVALID'), quoted("y" * 99, 8)
    ('"x\\' leaves VALID"', '"yyyyy..."')
    """
    line = " ".join("".join(letter if letter.isprintable() else " " for letter in text).split()).replace('"', "'")
    return f'"{line}"' if len(line) <= longest else f'"{line[: longest - 3]}..."'
