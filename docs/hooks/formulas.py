"""Formulas as MathML when the site is built: pages show them without a script and without the network."""

from __future__ import annotations

import html
import re
from typing import Any

__all__ = ["on_page_content"]

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(html_text: str, **_: Any) -> str:
    """Replace what arithmatex marked; TeX that cannot be converted stops the build."""
    return _FORMULA.sub(_converted, html_text)


def _converted(found: re.Match[str]) -> str:
    from latex2mathml.converter import convert

    source = html.unescape(re.sub(r"<[^>]+>", "", found[3])).strip()
    shown = convert(source, display="block" if found[2] == "[" else "inline")
    return f'<{found[1]} class="formula">{shown}</{found[1]}>'
