"""The recipe of CONTRIBUTING.md, followed: an engine with its certificate, a row here and one in the checker."""

from __future__ import annotations

import json
import runpy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from flint import arb

import certbound as cb
from certbound.checker import check_data, claims, parse
from certbound.checker.balls import upper
from certbound.checker.expressions import Graph, Program, Undecided
from certbound.checker.reading import Record
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model, SafeSet
from certbound.cli.app import run
from certbound.constants.enclosures import enclose
from certbound.errors import CertificateError
from certbound.reach.nominal import initial_cells
from certbound.rigor import balls
from certbound.rigor.intervals import Interval, matmul, sqrt
from certbound.safety.answers import AS_IT_IS, EngineAnswer, Proof, Request, exact
from certbound.safety.certificate import problem_data
from certbound.safety.engines.gaps import gaps_of, hull_of, lies_inside
from certbound.safety.limits import find_limits
from certbound.safety.portfolio import ENGINES, Engine, engine_named
from tests.docs.blocks import DOCS
from tests.safety import test_portfolio
from tests.zoo import ZOO

# ---- what an author writes: an engine, the writer of its certificates, a row ---------------------------------------
#
# (G w)_i is sub-Gaussian with proxy S_ii, S = G proxy G'. So |(G w)_i| <= a sqrt(S_ii) holds in all of n states at all
# of N steps but for a probability of 2 n N exp(-a^2/2), and then every path stays in boxes that interval arithmetic
# takes from step to step: whatever the disturbance does, even one that sees coming noise. The largest a that keeps
# these boxes safe is found by bisection.

MOST = 40.0  # standard deviations


def boxes_engine(problem: cb.Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
    """The probability that noise leaves the largest box with which no path can leave the safe set."""
    refused = refusal(problem)
    if refused is not None:
        return EngineAnswer(applicable=False, reason=refused, method="boxes")
    low, high = 0.0, MOST
    for _ in range(14):
        middle = (low + high) / 2
        low, high = (middle, high) if stays(problem, middle) else (low, middle)
    return EngineAnswer(
        log10_delta=min(log10_outside(problem, low), 0.0), foresight=True, details=low, method="boxes",
        reason=f"no path leaves while the noise stays within {low:.3g} standard deviations, in every state.",
    )  # fmt: skip


def refusal(problem: cb.Problem) -> str | None:
    if problem.system.time != "discrete":
        return "boxes are followed in discrete time only."
    if problem.input_sequence is not None or problem.initial.random:
        return "boxes need a bounded initial set, and a plan without steps in time."
    for constraint in problem.constraints:
        form = constraint.region.form
        if constraint.during is not None or constraint.region.moving or (form.round and not form.even):
            return f"boxes do not treat windows, moving sets and ellipsoids ('{constraint.label}')."
    return None if np.isfinite(hull_of(gaps_of(problem))).all() else "boxes need constraints that bound every state."


def stays(problem: cb.Problem, level: float) -> bool:
    """Whether every path is proved to stay safe while the noise stays within ``level`` standard deviations."""
    system, gaps = problem.system, gaps_of(problem)
    gain = system.noise_matrix
    variances = np.diagonal(matmul(matmul(gain, system.noise.proxy), gain.T).hi)
    reach = (sqrt(Interval.point(np.maximum(variances, 0.0))) * level).hi
    box = initial_cells(problem).boxes[0]
    free = system.disturbance
    ends = [] if free is None else [Interval(low, high) for low, high in zip(free.low, free.high)]
    for step in range(problem.horizon):
        if not lies_inside(gaps, box):
            return False
        inputs = [Interval.point(float(step)), *(box[i] for i in range(len(box))), *ends]
        box = enclose(problem.closed_loop, inputs, undefined="infinite") + Interval(-reach, reach)
    return lies_inside(gaps, box)


def log10_outside(problem: cb.Problem, level: float) -> float:
    """log10 of 2 n N exp(-level^2/2), rounded up."""
    with balls.precision():
        count = arb(2 * problem.system.dimension * int(problem.horizon))
        return balls.upper((count.log() - arb(level) ** 2 / 2) / arb(10).log())


def boxes_proof(problem: cb.Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The level, a little lower: the checker's own boxes are wider."""
    level = float(answer.details) * (0.999, 0.98, 0.8)[min(attempt, 2)]
    log10 = log10_outside(problem, level) * (1 - 1e-12)
    if not log10 < 0:
        raise CertificateError("the boxes bound nothing.")
    return {"engine": "boxes", "level": exact(level)}, log10, []


BOXES = Engine(
    name="boxes",
    words="noise held in a box by a union bound, and intervals from step to step (discrete time)",
    when="always; says most for few steps of large noise",
    prove=boxes_engine,
    write=boxes_proof,
)

# ---- and in the checker: its proof, a row --------------------------------------------------------------------------


def check_boxes(model: Model, value: object, budget: Budget) -> arb:
    """The same boxes again, in ball arithmetic."""
    level = arb(Record(value, "proof", ("engine", "level")).number("level", least=0.0))
    if model.continuous or model.plan is not None or model.initial.covariance is not None:
        raise Unproved("this proof treats discrete time, bounded initial sets and no plans")
    covariance, safe, graph = model.noise.covariance(), SafeSet(model), Graph(budget)
    n, count = model.dimension, len(model.dynamics.inputs)
    nodes = graph.include(model.dynamics, [graph.input(slot) for slot in range(count)])
    step = Program(graph, [nodes[output] for output in model.dynamics.outputs], variables=count)
    step.prepare([])
    noise = [level * covariance[i, i].sqrt().upper() for i in range(n)]
    free = [arb(low).union(arb(high)) for low, high in model.disturbance]
    box = [low.union(high) for low, high in zip(model.initial.low, model.initial.high)]
    for k in range(model.steps + 1):
        if not safe.contains([(side.lower(), side.upper()) for side in box], budget):
            raise Unproved(f"at step {k} the box was not shown to lie in the safe set")
        try:
            box = [x + arb(0, w.upper()) for x, w in zip(step.run([arb(k), *box, *free]), noise)]
        except Undecided as error:
            raise Unproved(f"the dynamics are undefined in the box of step {k}") from error
    return upper(2 * n * model.steps * (-level * level / 2).exp())


PROOF = claims.Engine(words="boxes around every step", prove=check_boxes, foresees=lambda model: True)


@pytest.fixture
def boxes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ENGINES, "boxes", BOXES)


@pytest.fixture
def known(boxes: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(claims.ENGINES, "boxes", PROOF)


# ---- what users then have ------------------------------------------------------------------------------------------

FILE = """
name = "a pushed walk"
time = "discrete"
horizon = 3
delta = 0.01
states = ["x"]
[dynamics]
x = "0.5*x + 0.1*sin(d)"
[disturbances]
d = [-1, 1]
[noise]
law = "gaussian"
std = [0.1]
[initial]
box = [[-0.1, 0.1]]
[[stay]]
box = { x = [-1, 1] }
"""


@pytest.fixture
def file(tmp_path: Any) -> str:
    (tmp_path / "walk.toml").write_text(FILE)
    return str(tmp_path / "walk.toml")


def asked(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    run([*words, "--json"])
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_its_bound_is_the_one_that_theory_gives(boxes: None) -> None:
    system = cb.DiscreteSystem(lambda x: 0 * x, states=2, noise=cb.Gaussian(std=[0.1, 0.2]))
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=5)
    verdict = cb.verify_safety(problem, method="boxes")
    assert verdict.log10_delta == pytest.approx(np.log10(2 * 2 * 5) - 5**2 / 2 / np.log(10), abs=1e-2)
    assert verdict.method == "boxes"


@pytest.mark.parametrize("name", ["decay", "pushed", "spiral", "swing"])
def test_the_tests_of_all_engines_hold_for_it(known: None, name: str) -> None:
    test_portfolio.test_a_bound_holds_and_is_certified_and_grows_with_what_it_must("boxes", name)
    test_portfolio.test_every_row_says_what_it_is()
    problem = ZOO[name](1.0, 1.0)
    report = check_data(parse(cb.verify_safety(problem, method="boxes").certificate_text(problem)))
    assert report.valid
    assert report.log10_proved < -0.3


def test_what_it_refuses_says_why(boxes: None) -> None:
    for name, reason in (("sine", "bound every state"), ("relaxation", "discrete time only")):
        verdict = cb.verify_safety(ZOO[name](1.0, 1.0), method="boxes")
        assert not verdict.answers["boxes"].applicable
        assert reason in verdict.reason


def test_the_verdict_asks_it_among_the_others(boxes: None, file: str) -> None:
    problem = cb.load(file)
    verdict = cb.verify_safety(problem)
    assert list(verdict.answers) == [name for name, row in ENGINES.items() if not row.drawn]
    assert engine_named("boxes") == "boxes"
    alone = cb.verify_safety(problem, method="boxes")
    assert alone.status == "SAFE"
    assert alone.reason.endswith("even one that sees coming noise.")
    assert verdict.log10_delta <= alone.log10_delta
    with pytest.raises(ValueError, match=r"must be one of auto, starts, linear, .*, boxes, .*got 'boxen'"):
        cb.verify_safety(problem, method="boxen")


def test_the_command_line_asks_it_and_explains_what_it_found(
    known: None, file: str, tmp_path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    found = asked(capsys, "verify", file, "--explain", "--time-limit", "60")
    assert "boxes" in [row["engine"] for row in found["engines"]]
    path = tmp_path / "walk.json"
    found = asked(capsys, "verify", file, "--method", "boxes", "--certificate", str(path))
    assert (found["status"], found["method"]) == ("SAFE", "boxes")
    assert json.loads(path.read_text())["claim"]["method"] == "boxes"
    checked = asked(capsys, "check", str(path), "--problem", file)
    assert checked["valid"]
    assert "even one that sees coming noise" in checked["claim"]


def test_limits_are_sought_with_it(boxes: None, file: str) -> None:
    problem = cb.load(file)
    limits = find_limits(cb.verify_safety(problem.replace(delta=1e-12), method="boxes"))
    assert limits.delta == pytest.approx(10 ** cb.verify_safety(problem, method="boxes").log10_delta, rel=1e-6)
    assert limits.noise is not None
    assert 0.3 < limits.noise < 1


def test_the_documentation_lists_it(boxes: None) -> None:
    fill: Callable[[str], str] = runpy.run_path(str(DOCS / "hooks" / "commands.py"))["on_page_markdown"]
    page = fill((DOCS / "explanation.md").read_text(encoding="utf-8"))
    assert f"| `boxes` | {BOXES.words} | {BOXES.when} |" in page


def test_a_forged_level_is_not_proved_and_without_a_row_nothing_is(
    known: None, file: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = cb.load(file)
    text = cb.verify_safety(problem, method="boxes").certificate_text(problem)
    assert check_data(parse(text), problem_data(problem)).valid
    for change in (lambda level: 1.01 * level, lambda level: 0.99 * level):  # beyond the safe set; less than is claimed
        forged = parse(text)
        forged["proof"]["level"] = change(float.fromhex(forged["proof"]["level"])).hex()
        assert not check_data(forged).valid
    monkeypatch.delitem(claims.ENGINES, "boxes")
    with pytest.raises(CertificateError, match=r"`proof\.engine` must be one of linear, affine, constants, barrier"):
        check_data(parse(text))


def test_without_its_row_it_is_unknown(file: str) -> None:
    assert "boxes" not in ENGINES
    with pytest.raises(ValueError, match="`method` must be one of auto"):
        cb.verify_safety(cb.load(file), method="boxes")
