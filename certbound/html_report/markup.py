"""Pieces of HTML: text is escaped, tables scroll by keyboard, mathematics is MathML."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence


class Markup(str):
    """A text that is HTML already."""

    __slots__ = ()


def text(value: object) -> str:
    """A value as HTML text.

    Examples
    --------
    >>> text("a < b"), text(Markup("<b>a</b>"))
    ('a &lt; b', '<b>a</b>')
    """
    return str(value) if isinstance(value, Markup) else html.escape(str(value))


def math(inner: str) -> Markup:
    """MathML in a line of text."""
    return Markup(f"<math><mrow>{inner}</mrow></math>")


def table(heading: Sequence[object] | None, rows: Iterable[Sequence[object]]) -> str:
    """A table whose first column names its rows."""
    head = ""
    if heading is not None:
        head = "<thead><tr>" + "".join(f'<th scope="col">{text(cell)}</th>' for cell in heading) + "</tr></thead>"
    lines = []
    for first, *rest in rows:
        cells = "".join(f"<td>{text(cell)}</td>" for cell in rest)
        lines.append(f'<tr><th scope="row">{text(first)}</th>{cells}</tr>')
    return f'<div class="wide" tabindex="0"><table>{head}<tbody>{"".join(lines)}</tbody></table></div>'
