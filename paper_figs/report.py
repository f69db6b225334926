"""Binds every figure, its caption and the table of claims into one HTML page and one PDF.

``python -m paper_figs.report quick`` writes ``out/quick/report.html`` (the pictures inside it, nothing fetched) and
``out/quick/report.pdf``: the same bytes for the same figures.
"""

from __future__ import annotations

import argparse
import base64
import html
import json
import re
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from paper_figs.binding import bind
from paper_figs.check import DATA, HERE, STATUSES, Row, check, load_claims, show, summary
from paper_figs.style import replace

TITLE = "Probabilistic tubes: the paper's figures, and what certbound adds"

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #111; background: #fff; max-width: 52rem; margin: 2rem auto;
  padding: 0 1rem; }
figure { margin: 2.5rem 0; }
img { display: block; width: 100%; max-width: 36rem; height: auto; margin: 0 auto; }
figcaption { font-size: 0.92rem; }
nav a { margin-right: 0.8rem; white-space: nowrap; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.8rem; }
th, td { text-align: left; vertical-align: top; padding: 0.25rem 0.6rem; border-bottom: 1px solid #ccc; }
.fail td:first-child { background: #000; color: #fff; font-weight: bold; }
"""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One figure: its picture and what is said of it, paragraph by paragraph (``**bold**`` is the only markup)."""

    stem: str
    picture: bytes
    paragraphs: tuple[str, ...]

    @property
    def name(self) -> str:
        """What the caption calls the figure: "Fig. 2", "Table I"."""
        found = re.match(r"\*\*(.+?)\.\*\*", self.paragraphs[0])
        return found.group(1) if found else self.stem


def place(stem: str) -> tuple[int, int]:
    """The paper's figures, then its tables, then ours."""
    kinds = ("fig", "table", "figk")
    found = re.fullmatch(rf"({'|'.join(kinds)})(\d+)", stem)
    return (kinds.index(found.group(1)), int(found.group(2))) if found else (len(kinds), 0)


def entries(folder: Path) -> list[Entry]:
    """Every figure that was drawn, in reading order."""
    stems = sorted((path.stem for path in folder.glob("*.md")), key=lambda stem: (*place(stem), stem))
    return [
        Entry(
            stem=stem,
            picture=(folder / f"{stem}.png").read_bytes(),
            paragraphs=tuple(
                " ".join(part.split()) for part in (folder / f"{stem}.md").read_text(encoding="utf-8").split("\n\n")
            ),
        )
        for stem in stems
    ]


def opening(rows: Sequence[Row], mode: str, versions: str) -> list[str]:
    """What stands above the figures."""
    counts = Counter(row.status for row in rows if row.passed)
    parts = ", ".join(f"{counts[status]} {status}" for status in STATUSES if counts[status])
    sizes = "the paper's sample sizes" if mode == "full" else "smaller samples than the paper's"
    return [
        f"Every figure is computed, with {sizes}. Beside what the paper printed stands what is right and what "
        "certbound adds; each caption says which parameters were used, how eps is read, and what was reconstructed.",
        f"Claims: {summary(rows)}. Of those that passed: {parts}. A claim counts as passed when the number came "
        "out, or, where the paper's number is wrong, when its refutation did.",
        f"Computed with {versions}.",
    ]


def page(figures: Sequence[Entry], rows: Sequence[Row], lines: Sequence[str]) -> str:
    """The HTML page."""
    links = " ".join(f'<a href="#{figure.stem}">{html.escape(figure.name)}</a>' for figure in figures)
    body = [f"<h1>{html.escape(TITLE)}</h1>", *(f"<p>{html.escape(line)}</p>" for line in lines)]
    body.append(f'<nav>{links} <a href="#claims">Claims</a></nav>')
    for figure in figures:
        picture = base64.b64encode(figure.picture).decode()
        said = "\n".join(f"<p>{_bold(paragraph)}</p>" for paragraph in figure.paragraphs)
        body.append(
            f'<figure id="{figure.stem}"><img alt="{html.escape(figure.name)}" '
            f'src="data:image/png;base64,{picture}">\n<figcaption>{said}</figcaption></figure>'
        )
    body.append(_table(rows))
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(TITLE)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def _bold(text: str) -> str:
    return re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", html.escape(text))


def _table(rows: Sequence[Row]) -> str:
    heads = ("", "place", "wanted", "found", "status", "note", "claim")
    lines = [f"<tr>{''.join(f'<th>{head}</th>' for head in heads)}</tr>"]
    for row in rows:
        mark = "pass" if row.passed else "FAIL"
        cells = (mark, row.place, show(row.expected), show(row.found), row.status, row.note, row.name)
        lines.append(f'<tr class="{mark.lower()}">{"".join(f"<td>{html.escape(cell)}</td>" for cell in cells)}</tr>')
    return (
        '<h2 id="claims">Claims</h2>\n<div class="wide"><table>\n'
        + "\n".join(lines)
        + f"\n</table></div>\n<p>{summary(rows)}</p>"
    )


def versions(mode: str) -> str:
    """What computed the data, as the experiments wrote it down."""
    found: dict[str, str] = {}
    for path in sorted((DATA / mode).glob("*.json")):
        found.update(json.loads(path.read_text(encoding="utf-8")).get("versions", {}))
    return ", ".join(f"{name} {version}" for name, version in sorted(found.items())) or "unknown versions"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write both documents; a claim that failed is shown in them, and is not this command's failure."""
    parser = argparse.ArgumentParser(prog="python -m paper_figs.report")
    parser.add_argument("mode", nargs="?", choices=["quick", "full"], default="quick")
    options = parser.parse_args(arguments)
    folder = HERE / "out" / options.mode
    expected = json.loads((HERE / "expected.json").read_text(encoding="utf-8"))["claims"]
    rows = check(expected, load_claims(options.mode), options.mode)
    figures = entries(folder)
    lines = opening(rows, options.mode, versions(options.mode))
    replace(folder / "report.pdf", bind(TITLE, figures, rows, lines))
    replace(folder / "report.html", page(figures, rows, lines).encode())
    print(f"report: {len(figures)} figures; {summary(rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
