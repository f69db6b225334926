"""Random legal problems: no crash, no warning, no contradiction, the same verdict in other units.

The default run takes a few cheap problems and checks the fuzzer itself; ``-m slow`` takes two thousand.
"""

import json
import os
from dataclasses import replace

import numpy as np
import pytest

import certbound as cb
from tests.fuzz import commands, oracle
from tests.fuzz.campaign import finished_seeds, run_campaign
from tests.fuzz.commands import Run
from tests.fuzz.drafts import Draft, Noise, Shape, Units, Wall
from tests.fuzz.formulas import apply, number, symbol
from tests.fuzz.generator import draw
from tests.fuzz.runner import run_seed
from tests.fuzz.summary import SOFT, summarize

QUICK = (5, 9, 18, 19, 42, 70, 198, 795, 822, 1434)
BATCH = 100


def hard(record):
    """Findings that count, as one-liners."""
    found = [finding for finding in record["findings"] if finding["kind"] not in SOFT]
    return [f"python -m tests.fuzz --show {record['seed']}: {f['command']} {f['kind']} {f['signature']}" for f in found]


@pytest.mark.parametrize("seed", QUICK)
def test_a_random_problem_passes_every_command(seed):
    assert hard(run_seed(seed, units=1)) == []


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 2000, BATCH))
def test_two_thousand_random_problems_pass_every_command(first):
    records = []
    run_campaign(range(first, first + BATCH), jobs=os.cpu_count() or 1, limit=120.0, finished=records.append)
    assert len(records) == BATCH
    assert [line for record in records for line in hard(record)] == []


# ---- the generator -------------------------------------------------------------------------------------------------


def test_a_seed_is_one_problem():
    first, second = draw(3)[0], draw(3)[0]
    assert first.features == second.features
    assert [row.text({"t": "t", "x0": "a", "x1": "b", "x2": "c", "x3": "d"}) for row in first.dynamics] == [
        row.text({"t": "t", "x0": "a", "x1": "b", "x2": "c", "x3": "d"}) for row in second.dynamics
    ]


def test_two_hundred_seeds_cover_the_language():
    features = {feature for seed in range(200) for feature in draw(seed)[0].features}
    for law in ("gaussian std", "gaussian covariance", "uniform halfwidth", "rademacher scale", "bounded halfwidth"):
        assert f"noise: {law}" in features
    for kind in ("box", "ball", "ellipsoid", "halfspace", "polytope"):
        assert {f"wall: inside {kind}", f"wall: outside {kind}"} <= features
    assert {f"start: {kind}" for kind in ("point", "box", "ball", "ellipsoid", "gaussian")} <= features
    assert {f"states: {n}" for n in range(1, 7)} <= features
    assert {"model: kink", "model: jump", "model: in t", "noise: g(t, x)", "disturbance", "domain"} <= features
    assert {"plan: array", "plan: feedback", "units: common", "units: mixed", "units: time"} <= features
    assert {"start: union", "target", "target: window", "disturbance: constant"} <= features
    assert {f"noise: {law}" for law in ("triangular halfwidth", "discrete scale", "histogram scale")} <= features
    assert {"route: python", "route: file", "route: linear", "wall: moving", "wall: window"} <= features


def test_every_draft_means_the_same_by_file_and_by_function():
    checked = 0
    for seed in range(40):
        draft, problem = draw(seed)
        if draft.route != "file":
            continue
        twin = replace(draft, route="python").problem()
        names = problem.closed_loop.inputs
        values = np.random.default_rng(seed).uniform(0.3, 0.9, len(names))
        values[1 : 1 + draft.dimension] *= draft.units.state
        both = [cb.problem.model.evaluation.compile_numpy(p.closed_loop)(*values) for p in (problem, twin)]
        np.testing.assert_allclose(*both, rtol=1e-9, atol=1e-9 * np.max(draft.units.state))
        checked += 1
    assert checked >= 5


# ---- it finds what it looks for --------------------------------------------------------------------------------------


def walk(**changes):
    """X+ = X / 2 + w, |X| <= 0.2 over 4 steps: left with a probability of about a tenth."""
    wall = Wall(shape=Shape(kind="box", data=(np.array([-0.2]), np.array([0.2]))))
    fields = {
        "seed": 7, "family": "walk", "continuous": False, "dynamics": (0.5 * symbol("x0"),), "walls": (wall,),
        "start": ("box", np.zeros(1), np.zeros(1)), "horizon": 4.0, "delta": 1e-3, "units": Units(state=np.ones(1)),
        "noise": Noise(law="gaussian", level="std", value=np.array([0.1])),
    }  # fmt: skip
    return Draft(**(fields | changes))


def run_of(draft):
    return Run(draft, draft.problem())


def kinds(run):
    return {(finding.command, finding.kind) for finding in run.findings}


def test_a_probability_below_the_truth_is_a_contradiction():
    run = run_of(walk())
    run.verdict = replace(cb.verify_safety(run.problem), status="SAFE", log10_delta=-4.0)
    run.simulate()
    assert kinds(run) == {("simulate", "contradiction")}
    run = run_of(walk())
    run.verify()
    run.simulate()
    assert kinds(run) == set()
    assert run.facts["ratio"] >= 1


def test_a_lower_bound_above_the_truth_is_a_contradiction():
    run = run_of(walk(delta=1e-2))
    run.verify()
    assert run.verdict.log10_lower is not None
    run.simulate()
    assert kinds(run) == set()
    run = run_of(walk())
    run.verdict = replace(cb.verify_safety(run.problem), log10_lower=np.log10(0.3), log10_delta=0.0)
    run.simulate()
    assert kinds(run) == {("simulate", "contradiction")}


def test_paths_that_never_reach_their_target_fail():
    around = Wall(shape=Shape(kind="box", data=(np.array([-0.05]), np.array([0.04]))))
    draft = walk(target=around, start=("box", np.full(1, 0.1), np.full(1, 0.1)), delta=1e-2)
    count, _ = oracle.worst_case(draft, np.random.default_rng(0), paths=20_000)
    both = cb.verify_safety(draft.problem())
    assert 10**both.log10_lower - 0.02 < count.exits / count.paths < 10**both.log10_delta + 0.02
    assert both.log10_delta - both.log10_lower < 0.02


def test_every_member_of_a_union_and_every_law_is_simulated():
    apart = walk(shifts=(np.zeros(1), np.array([0.15])))
    rng = np.random.default_rng(0)
    assert sorted(set(np.round(oracle.starts(apart, rng, 10)[:, 0], 6))) == [0.0, 0.15]
    levels = {"triangular": "halfwidth", "discrete": "scale", "histogram": "scale", "laplace": "scale"}
    shares = [0.1, 0.3, 0.6, 0.95]
    for law, level in levels.items():
        table = {"discrete": ([-1.0, 0.5], [1 / 3, 2 / 3]), "histogram": ([-1.0, 0.5, 1.0], [0.75, 0.25])}.get(law)
        noise = Noise(law=law, level=level, value=np.array([0.1]), table=table and tuple(map(np.array, table)))
        drawn = oracle.variates(walk(noise=noise), rng, 50_000)[:, 0]
        own = noise.build(Units(state=np.ones(1)))["noise"].resolve(1).sample(rng, 50_000)[:, 0]
        assert np.quantile(drawn, shares) == pytest.approx(np.quantile(own, shares), abs=0.004)


def test_a_contradiction_in_continuous_time_must_survive_finer_steps():
    run = run_of(walk(continuous=True, noise=None, dynamics=(-1.0 * symbol("x0"),), diffusion=((number(0.1),),)))
    asked = []

    def fading(steps):
        asked.append(steps)
        return (500 if steps < 1000 else 0), 1000

    run._compare("simulate", 1e-3, fading)
    assert (kinds(run), asked) == (set(), [128, 512, 2048])
    run._compare("simulate", 1e-3, lambda steps: (500, 1000))
    assert kinds(run) == {("simulate", "contradiction")}


def test_a_nominal_that_stays_inside_contradicts_unsafe_nominal():
    run = run_of(walk())
    run.verdict = replace(cb.verify_safety(run.problem), status="UNSAFE_NOMINAL", log10_delta=0.0)
    run.simulate()
    assert kinds(run) == {("verify", "contradiction")}


def test_a_nominal_that_leaves_between_two_steps_as_a_window_begins_contradicts_nothing():
    late = Wall(shape=Shape(kind="box", data=(np.array([-1.0]), np.array([0.5]))), during=(0.6885, 2.0))
    one = ("box", np.ones(1), np.ones(1))  # above 0.5 until log 2 = 0.6931; a 512th of the horizon is 0.0078
    run = run_of(walk(continuous=True, noise=None, dynamics=(-symbol("x0"),), start=one, walls=(late,)))
    run.verify()
    assert run.verdict.status == "UNSAFE_NOMINAL"
    run._leaves_without_noise()
    assert kinds(run) == set()


def test_warnings_errors_and_slow_answers_are_findings(monkeypatch):
    run = run_of(walk())
    run._attempt("verify", lambda: np.float64(np.inf) - np.float64(np.inf))
    run._attempt("tune", lambda: 1 / 0)
    monkeypatch.setitem(commands.BUDGETS, "reach", -1.0)
    run._attempt("reach", lambda: 1)
    assert kinds(run) == {("verify", "warning"), ("tune", "error"), ("reach", "slow")}


def test_another_verdict_in_other_units_is_a_finding():
    run = run_of(walk())
    run.verdict = replace(cb.verify_safety(run.problem), status="SAFE", log10_delta=-9.0)
    run.units("1e8", 1e8)
    assert kinds(run) == {("units", "units")}


def test_paths_outside_a_reach_tube_are_a_contradiction(monkeypatch):
    run = run_of(walk())
    narrow = cb.bound_reach(run.problem.replace(delta=0.999), noise=True)
    monkeypatch.setattr(cb, "bound_reach", lambda problem, noise: narrow.altered(log10_delta=-6.0))
    run.reach()
    assert ("reach", "contradiction") in kinds(run)


def test_paths_outside_a_tuned_tube_are_a_contradiction():
    run = run_of(walk(delta=1e-2))
    sound = cb.bound_constants(run.problem)
    run.tune(sound)
    assert kinds(run) == set()
    tube = cb.tune_tube(cb.Constants(gain=0.5, sigma=0.02, dimension=1), horizon=4, delta=1e-2)
    hits, paths = run._outside_tube(tube, sound, 1)
    assert oracle.lower_limit(hits, paths) > 0.5


def test_the_oracle_knows_the_truth_of_one_step():
    draft = walk(horizon=1.0, dynamics=(0.0 * symbol("x0"),))
    count, _ = oracle.worst_case(draft, np.random.default_rng(0), paths=20_000)
    assert count.exits / count.paths == pytest.approx(0.0455, abs=0.008)  # two standard deviations, two sides


def test_the_oracle_finds_the_disturbance_that_hurts():
    pushed = walk(dynamics=(0.5 * symbol("x0") + symbol("d0"),), disturbance=(np.array([-0.1]), np.array([0.1])))
    rng = np.random.default_rng(0)
    quiet, _ = oracle.worst_case(walk(), rng, paths=5000)
    worst, policy = oracle.worst_case(pushed, rng, paths=5000)
    assert worst.exits > 3 * quiet.exits
    assert policy is not None


def test_formulas_are_read_alike_as_text_and_as_numbers():
    x, y = symbol("x0"), symbol("x1")
    formula = apply("min", apply("hypot", x, y) ** 1.5, 2 / (1 + apply("exp", -x))) - (-3.0) * apply("atan2", y, 2.0)
    values = (0.4, -0.7)
    from certbound.problem.files.parser import parse
    from certbound.problem.model.graph import Graph

    graph = Graph(["x0", "x1"])
    node = parse(formula.text({"x0": "x0", "x1": "x1"}), graph, {"x0": graph.input(0), "x1": graph.input(1)}, "f")
    read = cb.problem.model.evaluation.compile_numpy(graph.tape([node], (1,)))(*values)[0]
    assert read == pytest.approx(formula.value(dict(zip(("x0", "x1"), values))), rel=1e-13)


# ---- the campaign ----------------------------------------------------------------------------------------------------


def test_a_hang_is_reported_and_the_next_seed_is_run(monkeypatch):
    records = []
    run_campaign([0, 1], jobs=1, limit=0.01, finished=records.append)
    assert [(record["seed"], record["findings"][0]["kind"]) for record in records] == [(0, "hang"), (1, "hang")]


def test_finished_seeds_are_not_run_again(tmp_path):
    path = tmp_path / "results.jsonl"
    path.write_text(json.dumps({"seed": 4, "findings": []}) + "\n" + '{"seed": 5, "fin', encoding="utf-8")
    assert list(finished_seeds(path)) == [4]
    assert finished_seeds(tmp_path / "none.jsonl") == {}


def test_the_summary_names_signatures_with_a_seed():
    row = {
        "seed": 12, "family": "walk", "features": ["domain"], "answers": {"verify": "SAFE"}, "seconds": {"verify": 1.0},
        "facts": {"ratio": 3.0, "ratio to estimate": 2.0},
        "findings": [{"command": "verify", "kind": "error", "signature": "ValueError", "message": ""}],
    }  # fmt: skip
    text = summarize([row])
    assert "verify error: ValueError  (seeds 12)" in text
    assert "2 to the estimate (seed 12)" in text
    assert "1 of 1 problems with a finding" in text
