"""The report as a PDF: a page with what it is, a page for each figure, and the claims as text."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from io import BytesIO
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")

import matplotlib.image
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from paper_figs.check import Row, show, summary

if TYPE_CHECKING:
    from paper_figs.report import Entry

WIDE, HIGH = 8.27, 11.69  # inches: A4
MARGIN, MAGNIFIED = 0.9, 1.6
POINT = 1 / 72
RC = {"font.family": "DejaVu Sans", "pdf.fonttype": 42}


class Sheet:
    """A page that is written from the top down, in inches."""

    def __init__(self) -> None:
        self.figure = Figure(figsize=(WIDE, HIGH))
        self.height = HIGH - MARGIN

    def write(self, text: str, *, size: float, left: float = MARGIN, bold: bool = False, grey: bool = False) -> None:
        """One line."""
        self.height -= 1.35 * size * POINT
        look = {"fontsize": size, "weight": "bold" if bold else "normal", "color": "#555555" if grey else "black"}
        self.figure.text(left / WIDE, self.height / HIGH, text, parse_math=False, **look)

    def paragraph(self, text: str, *, size: float) -> None:
        """Lines filled to the margins; a label in bold at its beginning stays a line of its own style."""
        width = round((WIDE - 2 * MARGIN) / (0.55 * size * POINT))
        label, rest = _label(text)
        if label:
            self.write(label, size=size, bold=True)
        for line in textwrap.wrap(rest, width):
            self.write(line, size=size)
        self.height -= 0.5 * size * POINT

    def picture(self, content: bytes) -> None:
        """A picture in the middle, magnified from column width, no higher than what is left for it."""
        pixels = matplotlib.image.imread(BytesIO(content), format="png")[..., :3]
        high, wide = (side / 300 for side in pixels.shape[:2])
        scale = min(MAGNIFIED, (WIDE - 2 * MARGIN) / wide, 0.6 * HIGH / high)
        self.height -= scale * high
        box = ((WIDE - scale * wide) / 2 / WIDE, self.height / HIGH, scale * wide / WIDE, scale * high / HIGH)
        axes = self.figure.add_axes(box)
        axes.imshow(pixels, interpolation="none", aspect="auto")
        axes.set_axis_off()
        self.height -= 0.15


def _label(text: str) -> tuple[str, str]:
    found = re.match(r"\*\*(.+?)\*\*\s*", text)
    return (found.group(1), text[found.end() :].replace("**", "")) if found else ("", text.replace("**", ""))


def bind(title: str, figures: Sequence[Entry], rows: Sequence[Row], lines: Sequence[str]) -> bytes:
    """The bytes of the PDF, without date or program name."""
    target = BytesIO()
    nothing = {"CreationDate": None, "Creator": None, "Producer": None}
    with matplotlib.rc_context(RC), PdfPages(target, metadata=nothing) as pages:
        for sheet in (_opening(title, lines), *(_figure(entry) for entry in figures), *_claims(rows)):
            pages.savefig(sheet.figure)
    return target.getvalue()


def _opening(title: str, lines: Sequence[str]) -> Sheet:
    sheet = Sheet()
    for line in textwrap.wrap(title, 48):
        sheet.write(line, size=17, bold=True)
    sheet.height -= 0.2
    for line in lines:
        sheet.paragraph(line, size=10)
    return sheet


def _figure(entry: Entry) -> Sheet:
    sheet = Sheet()
    sheet.picture(entry.picture)
    for paragraph in entry.paragraphs:
        sheet.paragraph(paragraph, size=8.5)
    return sheet


def _claims(rows: Sequence[Row]) -> Iterator[Sheet]:
    sheet = Sheet()
    sheet.write(f"Claims: {summary(rows)}", size=12, bold=True)
    for row in rows:
        if sheet.height < MARGIN + 0.5:
            yield sheet
            sheet = Sheet()
        sheet.height -= 3 * POINT
        mark = "pass" if row.passed else "FAIL"
        sheet.write(f"{mark}   {row.place}", size=7.5, bold=not row.passed)
        wanted = f"wanted {show(row.expected)}, found {show(row.found)} - {row.status}"
        for line in textwrap.wrap(f"{wanted}{'; ' if row.note else ''}{row.note} [{row.name}]", 118):
            sheet.write(line, size=6.5, left=MARGIN + 0.35, grey=True)
    yield sheet
