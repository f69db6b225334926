"""The report holds every figure, every caption and every claim, fetches nothing, and is the same on every run."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from paper_figs import check, report

STEMS = ("figk1", "table1", "fig10", "fig2")
NAMES = {"fig2": "Fig. 2", "fig10": "Fig. 10", "table1": "Table I", "figk1": "Fig. K1"}
CLAIM = {"claim": "fig2.radius", "place": "Sec. 0 <R>", "value": 3.32, "tolerance": 0.01, "status": "reproduced"}
LABELS = ("Parameters.", "Reading of eps.", "Reconstructed.", "Added by certbound.")


@pytest.fixture
def built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A build of four small figures; the folder where the report comes to lie."""
    out, data = tmp_path / "out" / "quick", tmp_path / "data" / "quick"
    out.mkdir(parents=True)
    data.mkdir(parents=True)
    for shade, stem in enumerate(STEMS):
        matplotlib.image.imsave(out / f"{stem}.png", np.full((90, 120, 3), 0.2 * shade), metadata={"Software": None})
        (out / f"{stem}.md").write_text(f"**{NAMES[stem]}.** What is seen & why.\n\n**Parameters.** c < 0.\n")
    record = {"claims": {"radius": 3.3271}, "versions": {"numpy": "1.2.3"}}
    (data / "fig2.json").write_text(json.dumps(record))
    (tmp_path / "expected.json").write_text(json.dumps({"claims": [CLAIM]}))
    monkeypatch.setattr(report, "HERE", tmp_path)
    monkeypatch.setattr(report, "DATA", tmp_path / "data")
    monkeypatch.setattr(check, "DATA", tmp_path / "data")
    return out


class Page(HTMLParser):
    """Pictures and everything that a page would fetch."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.pictures: list[str] = []
        self.fetched: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("src", "href", "data", "srcset") and value and not value.startswith("#"):
                (self.pictures if value.startswith("data:image/png;base64,") else self.fetched).append(value)
        if tag in ("script", "link", "iframe", "object"):
            self.fetched.append(tag)


def test_the_page_holds_every_figure_and_fetches_nothing(built: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert report.main(["quick"]) == 0
    assert capsys.readouterr().out == "report: 4 figures; 1 passed, 0 failed\n"
    text = (built / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert len(page.pictures) == len(STEMS)
    assert page.fetched == []
    assert "url(" not in text
    assert "@import" not in text
    assert re.findall(r'<figure id="(\w+)"', text) == ["fig2", "fig10", "table1", "figk1"]
    assert "<strong>Table I.</strong> What is seen &amp; why." in text
    assert "numpy 1.2.3" in text


def test_the_claims_stand_in_the_page_with_what_was_found(built: Path) -> None:
    report.main(["quick"])
    text = (built / "report.html").read_text(encoding="utf-8")
    assert "<td>Sec. 0 &lt;R&gt;</td><td>3.32</td><td>3.3271</td><td>reproduced</td>" in text
    assert "1 passed, 0 failed" in text


def test_a_claim_that_failed_is_shown_as_failed(built: Path) -> None:
    expected = built.parents[1] / "expected.json"
    expected.write_text(json.dumps({"claims": [{**CLAIM, "value": 3.52}]}))
    assert report.main(["quick"]) == 0
    text = (built / "report.html").read_text(encoding="utf-8")
    assert '<tr class="fail"><td>FAIL</td>' in text
    assert "0 passed, 1 failed" in text


def test_both_documents_are_the_same_bytes_on_every_run(built: Path) -> None:
    found = []
    for _ in range(2):
        report.main(["quick"])
        found.append([(built / f"report.{end}").read_bytes() for end in ("html", "pdf")])
    assert found[0] == found[1]
    assert b"CreationDate" not in found[0][1]


def test_the_pdf_has_a_page_for_each_figure_between_opening_and_claims(built: Path) -> None:
    report.main(["quick"])
    content = (built / "report.pdf").read_bytes()
    assert content.startswith(b"%PDF-")
    assert len(re.findall(rb"/Type /Page\b", content)) == len(STEMS) + 2


@pytest.mark.parametrize(
    "caption",
    sorted(path for kind in ("fig", "table") for path in (check.HERE / "captions").glob(f"{kind}*.md")),
    ids=lambda path: path.stem,
)
def test_every_caption_says_parameters_reading_reconstruction_and_addition(caption: Path) -> None:
    parts = caption.read_text(encoding="utf-8").split("\n\n")
    assert re.match(r"\*\*(Fig\. K?\d+|Table [IV]+)\.\*\* ", parts[0])
    assert tuple(re.findall(r"^\*\*(.+?)\*\*", part)[0] for part in parts[1:]) == LABELS
    assert all(len(part) > len(label) + 9 for part, label in zip(parts[1:], LABELS))
