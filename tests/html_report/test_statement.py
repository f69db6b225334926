"""The report states the problem in full: dynamics typeset, noise, start, disturbance, sets, parameters."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np

import certbound as cb
from certbound.html_report import typeset
from certbound.html_report.statement import problem_section
from certbound.problem.model import jacobian

ROBOT = """
time = "continuous"
horizon = 6.0
states = ["px", "py", "theta_1"]
[parameters]
sigma = 0.015
[disturbances]
d = [-0.1, 0.2]
[dynamics]
px = "cos(theta_1)"
py = "sin(theta_1)/(1 + px**2)"
theta_1 = "-1.2*theta_1 + d"
[noise]
diffusion = [["sigma", 0, 0], [0, "sigma", 0], [0, 0, "sigma*abs(px)"]]
[initial]
box = [[-0.03, 0.03], [-0.03, 0.04], [0, 0]]
[[stay]]
box = { px = [-0.5, 6.5] }
during = [1, 3]
[[avoid]]
polytope = { A = [[-1, 0, 0], [0.6, 0.8, 0], [0, -1, 0]], b = [-0.6, 2.2, -1.3] }
[[avoid]]
ball = { center = { px = "5 + t", py = 3 }, radius = 0.5 }
"""


class Words(HTMLParser):
    """The text, and the tags that are left open."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.text, self.open = "", list[str]()
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("br", "mspace"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def said(problem: cb.Problem) -> str:
    words = Words(problem_section(problem))
    assert words.open == []
    return re.sub(r"\s+", " ", words.text)


def test_everything_that_the_file_states_is_in_the_report(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT)
    text = said(cb.load(path))
    for words in ("px˙=cos(θ1)", "1+px2", "−1.2θ1+d", "σ=0.015", "d∈[-0.1,0.2]", "px∈[-0.03,0.03]", "θ1∈[0,0]", "Ito",
                  "σ|px|", "from 1 to 3 s", "a polytope of 3 faces", "0.6px+0.8py≤2.2", "moving", "6 s",
                  "delta = 0.001"):  # fmt: skip
        assert words in text, words


def test_linear_models_laws_and_large_matrices_are_said_in_words() -> None:
    system = cb.linear_system(0.5 * np.eye(9), b=np.ones(9), noise=cb.Gaussian(std=0.1), time="discrete")
    problem = cb.Problem(system, initial=np.zeros(9), safe=[cb.Inside(cb.Box([-9] * 9, [9] * 9))], horizon=4)
    text = said(problem)
    for words in ("x1+=", "0.5x1", "gaussian std", "9 x 9, 1.0 on the diagonal", "x9=0", "its 18 sides", "4 steps"):
        assert words in text, words


def test_a_model_that_no_file_can_hold_says_so() -> None:
    bent = cb.ContinuousSystem(lambda x: np.minimum(x**2, x), states=1, diffusion=[[0.1]])
    slope = replace(jacobian(bent.dynamics, [1]), shape=(1,))  # the kink of a derivative
    system = cb.ContinuousSystem(lambda x, u: u, states=1, inputs=cb.Box([-9], [9]), diffusion=[[0.1]])
    safe = [cb.Inside(cb.Box([-1], [1]))]
    problem = cb.Problem(system, initial=[0.5], safe=safe, horizon=1, plan=slope)
    assert "does not exist in problem files" in said(problem)


def test_typesetting_keeps_the_order_of_operations() -> None:
    shown = {"a*(b + c)": "a(b+c)", "(a - b)**2": "(a−b)2", "-(a*b)": "−ab", "a - (b - c)": "a−(b−c)"}
    assert {source: Words(typeset.formula(source)).text for source in shown} == shown
    assert "<mfrac>" in typeset.formula("a/b")
    assert typeset.formula("a $ b") == "<mtext>a $ b</mtext>"
    assert typeset.formula("__import__('os')") == "<mtext>__import__(&#x27;os&#x27;)</mtext>"
