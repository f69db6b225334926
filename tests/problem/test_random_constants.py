"""Constants that are drawn once: their laws, files, simulation, averages of bounds and certificates of these."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scipy.stats

import certbound as cb
from certbound.checker import check_data, parse
from certbound.errors import CertificateError, InfeasibleError
from certbound.problem.files.loading import load, loads, save
from certbound.problem.files.schema import json_schema
from certbound.reach.nominal import Flow
from certbound.safety.certificate import certificate_text, problem_data
from certbound.simulation.stepping import Scenario

TEXT = """
time = "discrete"
horizon = 8
delta = 0.05
states = ["x"]
[random]
gain = { GAIN }
[dynamics]
x = "gain*x"
[noise]
law = "gaussian"
std = 0.25
[initial]
point = [0.3]
[[stay]]
box = { x = [-1, 1] }
"""
UNIFORM = 'law = "uniform", halfwidth = 0.2, mean = 0.6'
MODES = 'law = "discrete", values = [0.2, 0.9], probabilities = [0.75, 0.25]'
LAWS = [
    (cb.Gaussian(std=0.3), scipy.stats.norm(scale=0.3)),
    (cb.Gaussian(variance=0.09), scipy.stats.norm(scale=0.3)),
    (cb.Uniform(halfwidth=0.5), scipy.stats.uniform(-0.5, 1.0)),
    (cb.Triangular(halfwidth=0.5), scipy.stats.triang(0.5, -0.5, 1.0)),
    (cb.Laplace(scale=0.2), scipy.stats.laplace(scale=0.2)),
]


def given(gain: str) -> cb.Problem:
    return loads(TEXT.replace("GAIN", gain))


@pytest.mark.parametrize(("law", "known"), LAWS)
def test_probabilities_and_draws_are_those_of_the_law(law, known):
    constant = cb.Random(law=law, mean=1.25)
    for low, high in ((0.9, 1.1), (1.25, 1.7), (-3.0, 1.3), (1.0, 1.0)):
        least, most = constant.probability(low, high)
        truth = known.cdf(high - 1.25) - known.cdf(low - 1.25)
        assert least <= most
        assert least == pytest.approx(truth, abs=1e-12)
        assert most == pytest.approx(truth, abs=1e-12)
        assert constant.outside(low, high) == pytest.approx(1 - truth, abs=1e-12)
    draws = constant.sample(np.random.default_rng(0), 40_000)
    assert draws.mean() == pytest.approx(1.25, abs=5 * known.std() / 200)
    assert draws.std() == pytest.approx(known.std(), rel=0.05)
    low, high = constant.ends(1e-6)
    assert constant.outside(low, high) <= 1e-6


def test_tables_keep_their_values_and_their_means():
    problem = given(MODES)
    constant = problem.random["gain"]
    assert [value for value, _ in constant.atoms] == pytest.approx([0.2, 0.9], abs=1e-15)
    draws = constant.sample(np.random.default_rng(1), 20_000)
    assert np.mean(draws > 0.5) == pytest.approx(0.25, abs=0.02)
    bins = cb.Random(law=cb.Histogram(edges=[-2, 0, 2], probabilities=[0.5, 0.5]))
    assert bins.probability(-2, 1)[1] == pytest.approx(0.75)
    tossed = cb.Random(law=cb.Rademacher(scale=0.5), mean=1.0)
    assert tossed.hull(0.0, 1.2) == (0.5, 0.5)
    assert tossed.probability(0.5, 1.5) == (1.0, 1.0)


@pytest.mark.parametrize("gain", [UNIFORM, MODES, 'law = "gaussian", std = 0.05, mean = 0.5'])
def test_files_state_what_is_drawn(gain, tmp_path):
    for problem in (given(gain), given(gain).replace(name="traced")):
        save(problem, tmp_path / "walk.toml")
        again = load(tmp_path / "walk.toml")
        assert again.random["gain"].data() == problem.random["gain"].data()
        assert problem_data(again)["random"] == problem_data(problem)["random"]
    assert "random" in json_schema()["properties"]


def test_the_average_holds_against_simulation_from_both_sides_where_values_are_single():
    problem = given(MODES).replace(delta=0.02)
    verdict = cb.verify_safety(problem, method="values")
    found = cb.simulate_exits(problem, paths=100_000, rng=2, halve=False)
    assert verdict.status == "UNSAFE"
    assert 10**verdict.log10_lower <= found.upper
    assert found.lower <= 10**verdict.log10_delta
    assert 10 ** (verdict.log10_delta - verdict.log10_lower) < 1.04
    alone = cb.simulate_exits(problem, paths=50_000, rng=3, scenario=Scenario(disturbance=[0.9]), halve=False)
    assert alone.probability > 1.5 * found.probability


def test_lower_bounds_of_values_are_not_added_where_each_has_another_worst_start():
    pushed = """
        time = "discrete"\nhorizon = 1\ndelta = 0.2\nstates = ["p"]
        [random]\npush = { law = "rademacher", scale = 0.5 }
        [dynamics]\np = "p + push"
        [noise]\nlaw = "gaussian"\nstd = 0.1
        [initial]\nbox = [[-0.45, 0.45]]
        [[stay]]\nbox = { p = [-1, 1] }
    """
    problem = loads(pushed)
    verdict = cb.verify_safety(problem, method="values")
    truth = 0.5 * scipy.stats.norm.sf(0.05 / 0.1)  # from 0.45, and by 0.5 only
    assert verdict.status == "UNKNOWN"
    assert 0.98 * truth < 10**verdict.log10_lower <= truth
    alone = cb.verify_safety(problem.replace(initial=[0.45]), method="values")
    assert 0.98 * truth < 10**alone.log10_lower <= truth <= 10**alone.log10_delta < 1.02 * truth


def test_the_average_is_better_than_the_worst_value_and_never_below_simulation():
    problem = given(UNIFORM).replace(delta=0.022)
    verdict = cb.verify_safety(problem, method="values")
    found = cb.simulate_exits(problem, paths=100_000, rng=4, halve=False)
    unknown = cb.verify_safety(problem.replace(random=None, unknown=["gain"]), method="values")
    assert found.lower < 10**verdict.log10_delta < 10**unknown.log10_delta
    assert verdict.status == "SAFE"
    assert len(verdict.cells) > 1
    assert verdict.log10_lower is None


def test_a_certificate_states_cells_and_a_forged_one_is_refused():
    problem = given(UNIFORM).replace(horizon=3, delta=0.01)
    verdict = cb.verify_safety(problem, method="values")
    text = certificate_text(problem, verdict)
    report = check_data(parse(text), json.loads(json.dumps(problem_data(problem))))
    assert report.valid, report.reason
    assert verdict.log10_delta < report.log10_proved < np.log10(0.01)
    lost, wider, other = parse(text), parse(text), parse(text)
    lost["proof"]["cells"].pop()
    assert not check_data(lost).valid
    other["problem"]["random"]["gain"]["mean"] = (0.62).hex()
    assert not check_data(other).valid
    cells = wider["proof"]["cells"]
    assert len(cells) > 1
    first = min(cells, key=lambda cell: float.fromhex(cell["low"][0]))
    first["high"] = [(0.8).hex()]
    with pytest.raises(CertificateError, match="overlap"):
        check_data(wider)


@pytest.mark.parametrize(
    ("gain", "message"),
    [
        ('law = "gauss", std = 1', "random.gain.law.*gaussian"),
        ('law = "gaussian"', "needs exactly one of"),
        ('law = "gaussian", std = 0.1, halfwidth = 1', "unknown key 'halfwidth'"),
        ('law = "gaussian", std = 0', "positive std"),
        ('law = "subgaussian", proxy_std = 0.1', "`law` must be one of"),
        ('law = "uniform", halfwidth = [0.1, 0.2]', "1 numbers"),
        ('law = "discrete", values = [0, 1], probabilities = [0.5, 0.4]', "sum to 1"),
    ],
)
def test_what_is_no_law_of_one_constant_is_refused(gain, message):
    with pytest.raises((ValueError, TypeError), match=message):
        given(gain)


def test_what_cannot_average_says_so():
    problem = given(UNIFORM)
    for ask in (lambda: Flow(problem), lambda: problem.constraints, lambda: cb.bound_exit_times(problem)):
        with pytest.raises(InfeasibleError, match="drawn"):
            ask()
    with pytest.raises(ValueError, match="must name disturbances"):
        problem.replace(random={"gian": cb.Random(law=cb.Uniform(halfwidth=1))})
    with pytest.raises(ValueError, match="one or the other"):
        problem.replace(unknown=["gain"])
    with pytest.raises(TypeError, match=r"cb\.Random"):
        problem.replace(random={"gain": 0.3})
    with pytest.raises(ValueError, match="constant"):
        cb.simulate_exits(problem, paths=10, scenario=Scenario(disturbance="switching"))


def test_a_law_that_reaches_beyond_all_numbers_is_refused_in_words():
    with pytest.raises(ValueError, match=r"`random` must hold constants of a moderate size, got .*1e\+308"):
        given('law = "gaussian", std = 1e308, mean = 1')
