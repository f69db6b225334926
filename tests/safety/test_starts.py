"""Safe starts: what is in the set is safe by simulation, what is drawn and printed is what was proved."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import certbound as cb
from certbound.cli.app import run
from certbound.errors import InfeasibleError
from certbound.html_report import report_page
from certbound.plotting import draw_values
from certbound.plotting.value_maps import coarser, outline_of
from certbound.problem.problem import Problem
from certbound.safety.starts import SafeStarts, bound_safe_starts
from certbound.values.charts import Chart, Charts
from certbound.values.continuous.line import ladder

Make = Callable[[], Problem]


def logistic() -> Problem:
    system = cb.DiscreteSystem(lambda x: 2.8 * x * (1 - x), states=1, noise=cb.Gaussian(std=0.04))
    return Problem(system, initial=cb.Box([0.6], [0.7]), safe=[cb.Inside(cb.Box([0.35], [0.95]))], horizon=20)


def disc() -> Problem:
    """Around a ball in the plane, with a disturbance."""
    system = cb.DiscreteSystem(
        lambda x, d: [0.9 * x[0] + 0.1 * x[1] + d[0], 0.9 * x[1]], states=["x", "y"], noise=cb.Gaussian(std=0.15),
        disturbance=cb.Box([-0.05], [0.05]),
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1.5, -1.5], [1.5, 1.5])), cb.Outside(cb.Ball([0.9, 0.7], 0.3))]
    return Problem(system, initial=[-0.3, -0.3], safe=safe, horizon=4, delta=0.05)


def well() -> Problem:
    system = cb.ContinuousSystem(lambda x: [x[0] - x[0] ** 3], states=1, diffusion=0.5)
    return Problem(system, initial=cb.Box([0.9], [1.1]), safe=[cb.Inside(cb.Box([0], [2.5]))], horizon=2, delta=0.06)


def swirl() -> Problem:
    system = cb.ContinuousSystem(
        lambda x: [-x[0] + x[1], -x[0] - x[1]], states=["x", "y"], diffusion=np.diag([0.4, 0.5])
    )
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    return Problem(system, initial=[0.1, 0.0], safe=safe, horizon=1, delta=0.05)


@pytest.fixture(autouse=True)
def _coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Proposals of one state that cost a tenth."""
    monkeypatch.setattr(ladder, "LADDER", ((1.5, 1e-3, 0.03), (1.5, 1e-3, 0.03)))


def starts_of(problem: Problem, **options: bool) -> SafeStarts:
    """Without asking for a verdict first."""
    return bound_safe_starts(problem, {}, **options)


@pytest.mark.parametrize(
    "make", [logistic, disc, *(pytest.param(make, marks=pytest.mark.slow) for make in (well, swirl))]
)
def test_from_every_safe_start_simulation_fails_no_more_often_than_delta(make: Make) -> None:
    problem = make()
    found = starts_of(problem, pictured=make is well)
    boxes = found.boxes
    assert len(boxes)
    low, high = boxes[..., 0], boxes[..., 1]
    rng = np.random.default_rng(3)
    inner = low + (high - low) * rng.uniform(size=low.shape)
    worst = np.argsort(found.bound(inner))[-1:]
    for point in [*inner[worst], low[0], high[-1]]:  # the rim, where the bound is all but used up
        assert found.contains(point)
        asked = problem.replace(initial=point)
        counts = cb.simulate_exits(asked, paths=10_000, rng=rng, confidence=0.998, halve=False)
        assert counts.lower <= 10.0 ** float(found.bound(point)[0]) <= problem.delta * (1 + 1e-12)
        if found.charts.lower and problem.system.disturbance is None:  # it bounds the worst disturbance
            assert counts.upper >= 10.0 ** float(found.charts.lower[0].at(point[None], up=False)[0])


def test_the_bounds_lie_close_above_and_below_the_truth() -> None:
    problem = logistic()
    charts = starts_of(problem, pictured=True).charts
    assert [chart.time for chart in charts.upper] == [0.0, 5.0, 10.0, 15.0]
    rng = np.random.default_rng(5)
    for point in ([0.42], [0.5], [0.8]):
        asked = problem.replace(initial=point)
        counts = cb.simulate_exits(asked, paths=200_000, rng=rng, confidence=0.998, halve=False)
        above, below = charts.upper[0].at(np.array([point]), up=True), charts.lower[0].at(np.array([point]), up=False)
        assert counts.lower <= 10.0 ** above[0] <= 1.15 * counts.upper
        assert counts.upper >= 10.0 ** below[0] >= counts.lower / 1.15


def test_a_verdict_offers_them_and_covers_its_own_start_when_it_is_safe() -> None:
    problem = logistic()
    verdict = cb.verify_safety(problem, method="values")
    found = verdict.safe_starts()
    assert verdict.status == "SAFE"
    assert found.holds_initial
    assert found.contains(0.65) is True
    assert found.contains([[0.65], [0.5], [0.94], [2.0]]).tolist() == [True, False, False, False]
    assert not verdict.safe_starts(5e-4).holds_initial
    assert verdict.safe_starts(1e-2).measure > found.measure


@pytest.mark.slow
def test_a_wider_delta_gives_a_larger_set_in_continuous_time() -> None:
    tight, wide = starts_of(well()), starts_of(well().replace(delta=0.1))
    inside = tight.boxes[:, 0].ravel()
    assert tight.measure < wide.measure < 2.5
    assert np.all(wide.contains(inside[:, None]))


def test_cells_share_their_faces_and_what_lies_outside_the_grid_is_not_safe() -> None:
    axes = (np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0]))
    charts = Charts(upper=(Chart(time=0.0, axes=axes, log10=np.array([[-3.0], [-1.0]])),))
    found = SafeStarts(problem=disc(), delta=1e-2, charts=charts)
    assert found.contains([1.0, 0.5])
    assert not found.contains([1.0 + 1e-12, 0.5])
    assert not found.contains([0.5, -1e-300])
    assert found.measure == pytest.approx(1.0, abs=1e-12)
    assert found.measure <= 1.0
    assert found.boxes.tolist() == [[[0.0, 1.0], [0.0, 1.0]]]
    assert found.bound([[1.0, 1.0], [3.0, 0.0]]).tolist() == [-3.0, 0.0]
    assert {name: list(column) for name, column in found.to_columns().items()} == {
        "x_low": [0.0], "x_high": [1.0], "y_low": [0.0], "y_high": [1.0], "log10_delta": [-3.0],
    }  # fmt: skip
    assert not found.holds_initial
    inner = SafeStarts(problem=disc().replace(initial=cb.Box([0.1, 0.5], [0.5, 0.5])), delta=1e-2, charts=charts)
    assert inner.holds_initial


def test_joined_charts_take_the_smaller_bound_and_keep_the_larger_room() -> None:
    wide = Chart(time=0.0, axes=(np.array([0.0, 2.0, 4.0]),), log10=np.array([-1.0, -2.0]))
    short = Chart(time=0.0, axes=(np.array([1.0, 3.0]),), log10=np.array([-1.5]))
    assert wide.joined(short).axes[0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert wide.joined(short).log10.tolist() == [-1.0, -1.5, -2.0, -2.0]
    assert short.joined(wide).log10.tolist() == [-1.0, -1.5, -2.0, -2.0]


def test_the_threshold_is_delta_itself() -> None:
    axes = (np.array([0.0, 1.0]),)
    for level, inside in ((-3.0 - 1e-12, True), (math.log10(2e-3), False), (-3.0 + 1e-12, False)):
        chart = Chart(time=0.0, axes=axes, log10=np.array([level]))
        assert SafeStarts(problem=well(), delta=1e-3, charts=Charts(upper=(chart,))).contains(0.5) is inside


def test_no_start_is_safe_for_a_problem_with_a_target_whose_paths_end_at_the_domain() -> None:
    """Not to get to the target is to fail, which a chart of the limits alone does not count."""
    system = cb.DiscreteSystem(lambda x: 1.0 * x, states=["x"], noise=cb.Gaussian(std=0.3))
    problem = cb.Problem(
        system, initial=[0.1], safe=[cb.Inside(cb.Box([-5], [5]))], reach=cb.Box([1.0], [1.5]), horizon=4, delta=0.1,
        domain=cb.Box([-2], [3]), leaving="ends",
    )  # fmt: skip
    with pytest.raises(InfeasibleError, match="has a target"):
        bound_safe_starts(problem, {})


def test_pictures_have_no_lower_bounds_where_paths_end_at_the_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaving the domain counts as failing in the value function: a bound from above alone."""
    system = cb.ContinuousSystem(lambda x: 0.0 * x, states=1, diffusion=0.5)
    problem = cb.Problem(
        system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=0.2, delta=0.1,
        domain=cb.Box([-0.5], [2]), leaving="ends",
    )  # fmt: skip
    asked = []

    def charted(problem: Problem, *, levels: list[float], times: int, lower: bool) -> Charts:
        asked.append(lower)
        return Charts(upper=(), lower=())

    monkeypatch.setattr("certbound.safety.starts.chart_exits", charted)
    bound_safe_starts(problem, {}, pictured=True)
    bound_safe_starts(problem.replace(leaving="unsafe"), {}, pictured=True)
    assert asked == [False, True]


def test_what_cannot_be_had_is_said_with_the_cure() -> None:
    problem = logistic()
    with pytest.raises(InfeasibleError, match=r'none was proved: .*method="values"'):
        cb.verify_safety(problem, method="linear").safe_starts()
    with pytest.raises(ValueError, match=r"`delta` must lie in \(0, 1\), got 1.5"):
        cb.verify_safety(problem, method="values").safe_starts(1.5)
    with pytest.raises(ValueError, match="`points` must have shape"):
        starts_of(problem).contains([0.1, 0.2])
    system = cb.ContinuousSystem(lambda x: -x, states=3, diffusion=np.eye(3))
    space = Problem(system, initial=np.zeros(3), safe=[cb.Inside(cb.Box([-1] * 3, [1] * 3))], horizon=1)
    with pytest.raises(InfeasibleError, match="one or two states"):
        starts_of(space)


@pytest.mark.parametrize("make", [logistic, pytest.param(disc, marks=pytest.mark.slow)])
def test_pictures_and_report_show_the_set(make: Make) -> None:
    problem = make()
    found = starts_of(problem, pictured=True)
    figure = draw_values(found, "a title")
    assert isinstance(figure, Figure)
    labels = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert any(label.startswith("safe starts") for label in labels)
    axes = found.plot(Figure().subplots())
    assert axes.get_xlabel() == problem.system.states[0]
    page = report_page(found, cb.verify_safety(logistic(), method="values"))
    assert "holds the stated initial set" in page
    assert ('"type": "heatmap"' in page) == (problem.system.dimension == 2)


def test_three_states_are_shown_as_slices() -> None:
    system = cb.DiscreteSystem(lambda x: 0.7 * x, states=3, noise=cb.Gaussian(std=0.3))
    safe = [cb.Inside(cb.Box([-1, -1, -1], [1, 1, 1]))]
    found = starts_of(Problem(system, initial=[0, 0, 0.2], safe=safe, horizon=1, delta=0.01))
    assert found.holds_initial == bool(found.contains([0, 0, 0.2]))
    titles = [axes.get_title(loc="left") for axes in draw_values(found).axes]
    assert titles[:3] == ["x3 = 0.2", "x2 = 0", "x1 = 0"]


def test_a_coarser_map_never_shows_less_than_its_cells() -> None:
    rng = np.random.default_rng(0)
    chart = Chart(time=0.0, axes=(np.arange(8.0), np.arange(4.0)), log10=-rng.uniform(size=(7, 3)))
    coarse = coarser(chart, 3)
    assert coarse.log10.shape == (3, 3)
    assert coarse.axes[0].tolist() == [0.0, 3.0, 6.0, 7.0]
    points = rng.uniform([0, 0], [7, 3], size=(200, 2))
    assert np.all(coarse.at(points, up=True) >= chart.at(points, up=True))


def test_the_outline_closes_around_the_chosen_cells() -> None:
    edges = outline_of((np.arange(4.0), np.arange(3.0)), np.array([[True, False], [True, True], [False, False]]))
    assert len(edges) == 8
    assert np.abs(edges[:, 1] - edges[:, 0]).sum() == 8.0


def test_verify_draws_and_reports_the_value_function_behind_its_verdict(tmp_path: Path) -> None:
    problem, picture, page = tmp_path / "map.toml", tmp_path / "map.png", tmp_path / "page.html"
    problem.write_text(
        'time = "discrete"\nhorizon = 5\nstates = ["x"]\n[dynamics]\nx = "0.9*x"\n'
        '[noise]\nlaw = "gaussian"\nstd = 0.2\n[initial]\npoint = [0]\n[[stay]]\nbox = [[-1, 1]]\n'
    )
    words = ["verify", str(problem), "--method", "values", "--plot", str(picture), "--report", str(page), "--json"]
    assert run(words) in (0, 1)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "Safe starts" in page.read_text(encoding="utf-8")
