"""The report is one page that needs nothing else, says the verdict in words, and draws in a real browser."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import certbound as cb
from certbound.html_report import report_page
from certbound.plotting import Scene, noisy_reach
from certbound.safety.answers import SPARED, EngineAnswer
from certbound.safety.verification import Verdict

BROWSER = next((path for name in ("chromium", "google-chrome", "chrome") if (path := shutil.which(name))), None)
VOID = {"meta", "br", "hr", "img", "link", "input"}


class Outline(HTMLParser):
    """Tags that are left open, references to other files, and the text outside scripts."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []
        self.ids: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        values = dict(attrs)
        self.references += [value for key in ("src", "href") if (value := values.get(key)) is not None]
        if values.get("id") is not None:
            self.ids.append(str(values["id"]))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] not in (["script"], ["style"]):
            self.text += data


@pytest.fixture(scope="module")
def case() -> tuple[Scene, Verdict]:
    system = cb.ContinuousSystem(lambda x: -x, states=["px", "py"], diffusion=0.05 * np.eye(2))
    safe = [cb.Outside(cb.Ball([1.0, 1.0], 0.3)), cb.Inside(cb.Box([-2.0, -2.0], [2.0, 2.0]))]
    problem = cb.Problem(system, initial=[0.5, 0.0], safe=safe, horizon=2.0, name="a <b> & </script>")
    verdict = cb.verify_safety(problem, method="constants")
    times = np.linspace(0, 2, 21)
    paths = cb.sample_paths(problem, paths=5, rng=np.random.default_rng(0), steps=20)
    scene = Scene(problem=problem, reach=verdict.reach, tube=noisy_reach(verdict), times=times, paths=paths)
    return scene, verdict


@pytest.fixture(scope="module")
def page(case: tuple[Scene, Verdict]) -> str:
    return report_page(*case, command="certbound verify my.toml", probability="1e-9")


def test_engines_that_were_not_asked_are_not_said_to_fail(case: tuple[Scene, Verdict]) -> None:
    scene, verdict = case
    answers = {"constants": verdict.answers["constants"], "barrier": EngineAnswer(applicable=False, reason=SPARED)}
    page = report_page(scene, replace(verdict, answers=answers))
    assert "<td>not asked</td>" in page
    assert "does not apply" not in page


def test_the_page_is_well_formed_and_asks_the_network_for_nothing(page: str) -> None:
    outline = Outline()
    outline.feed(page)
    assert outline.open == []
    assert outline.references == ["#verdict"]
    assert "verdict" in outline.ids
    assert page.count('<div class="wide" tabindex="0"><table>') == page.count("<table>") > 2  # scrolled by keyboard
    assert page.count('role="img" aria-label="') == page.count("<figure>")
    assert len(outline.ids) == len(set(outline.ids))


def test_the_page_says_the_verdict_in_words(page: str) -> None:
    outline = Outline()
    outline.feed(page)
    for words in (
        "SAFE",
        "1e-9",
        "proved",
        "a <b> & </script>",
        "certbound verify my.toml",
        cb.__version__,
        "rate (1/s)",
    ):
        assert words in outline.text
    assert "Nominal between" in outline.text


def test_every_constraint_and_the_plane_have_a_picture(page: str) -> None:
    assert len(re.findall(r"Plotly\.newPlot\('plot-", page)) == 5
    assert page.count("<figcaption>") == 5


def test_the_margins_are_what_the_tube_leaves(case: tuple[Scene, Verdict], page: str) -> None:
    """The least margin in the figure agrees with the tube's distance to the constraint."""
    scene, _ = case
    words = r"<figcaption>Room that is certified at the allowed probability, shared evenly\. (.*?)</figcaption>"
    found = re.search(words, page)
    assert found is not None
    numbers = [float(text) for text in re.findall(r"at least ([-+.e\d]+?)(?=[;.](?: |$))", html.unescape(found[1]))]
    assert scene.tube is not None
    distances = [scene.tube.distance_to(constraint) for constraint in scene.problem.safe]
    assert min(numbers) == pytest.approx(min(distances), rel=0.05)
    assert len(numbers) == 3


def test_the_hash_is_that_of_the_certificate(case: tuple[Scene, Verdict], page: str) -> None:
    import hashlib

    assert "none was written" in page
    text = "some certificate\n"
    assert hashlib.sha256(text.encode()).hexdigest() in report_page(*case, certificate=text)


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
@pytest.mark.parametrize("width", [380, 1400])
def test_the_pictures_are_drawn_in_a_browser(page: str, width: int, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(page, encoding="utf-8")
    check = """
    <iframe id="page" src="report.html" width="WIDTH" height="900"></iframe><pre id="found"></pre><script>
    const frame = document.getElementById("page"), errors = [];
    frame.contentWindow.addEventListener("error", event => errors.push(event.message));
    frame.addEventListener("load", () => setTimeout(() => {
      const inner = frame.contentDocument;
      const widths = [...inner.querySelectorAll(".plot")].map(plot => [
        plot.clientWidth, plot.querySelector(".main-svg")?.clientWidth ?? 0,
        plot.querySelectorAll(".scatterlayer .trace").length]);
      const wide = inner.documentElement.scrollWidth;
      document.getElementById("found").textContent = JSON.stringify({widths, wide, errors});
    }, 1500));</script>""".replace("WIDTH", str(width))
    (tmp_path / "frame.html").write_text(f"<!doctype html><body>{check}</body>", encoding="utf-8")
    flags = [
        "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
        "--disable-background-networking", "--disable-component-update", "--allow-file-access-from-files",
        f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1600,1000", "--virtual-time-budget=8000",
        "--dump-dom",
    ]  # fmt: skip
    assert BROWSER is not None
    command = [BROWSER, *flags, f"file://{tmp_path / 'frame.html'}"]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    found = json.loads(html.unescape(re.search(r'<pre id="found">(.*?)</pre>', dom, re.DOTALL)[1]))  # type: ignore[index]
    assert found["errors"] == []
    assert found["wide"] <= width
    assert len(found["widths"]) == 5
    for outer, inner, traces in found["widths"]:
        assert 0 < inner <= outer
        assert traces >= 2
