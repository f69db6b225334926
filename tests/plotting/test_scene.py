"""Pictures show what they are given, without pyplot and without warnings."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from io import BytesIO

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.patches import Circle

import certbound as cb
from certbound.plotting import Scene, draw_scene, noisy_reach
from certbound.plotting.asked import panels_of
from certbound.plotting.certified import bounds_of, room_of, supports
from certbound.plotting.plane import outlines, plane_of
from certbound.problem.problem import Problem
from certbound.reach.nominal.curve import Curve
from certbound.reach.sets.reach_tube import ReachTube

PIECES = 20


def tubes(problem: Problem, start: list[float], end: list[float]) -> tuple[ReachTube, ReachTube]:
    """A straight nominal with a ball of 0.1 around it, and one of up to 0.3 with noise."""
    a, b = np.array(start), np.array(end)
    if problem.system.time == "continuous":
        times = np.linspace(0.0, problem.horizon, PIECES + 1)
        middles = (times[:-1] + times[1:]) / 2
        centres = a + np.outer(middles / problem.horizon, b - a)
        slopes = np.broadcast_to((b - a) / problem.horizon, centres.shape)
        curve = Curve(
            continuous=True,
            starts=times[:-1],
            ends=times[1:],
            coefficients=np.stack([centres, slopes], 1)[None],
        )
    else:
        steps = np.arange(problem.horizon + 1.0)
        centres = a + np.outer(steps / problem.horizon, b - a)
        curve = Curve(continuous=False, starts=steps, ends=steps, coefficients=centres[None, :, None])
    share = np.linspace(0.0, 0.2, curve.pieces)
    inner = ReachTube(curve=curve, radius=np.full((1, curve.pieces), 0.1))
    return inner, ReachTube(curve=curve, radius=0.1 + share[None], noise=True, log10_delta=-3.0)


@pytest.fixture
def course() -> Problem:
    system = cb.ContinuousSystem(
        lambda x: np.array([1.0 - x[0], -x[1], -x[2]]), states=["px", "py", "th"], diffusion=0.1 * np.eye(3)
    )
    safe = [
        cb.Outside(cb.Ball([1.0, 1.5], 0.4, coordinates=(0, 1))),
        cb.Inside(cb.Box([-2.0, -2.0], [4.0, 2.5], coordinates=(0, 1))),
        cb.Inside(cb.HalfSpace([0.0, 0.0, 1.0], 2.0), during=(1.0, 2.0)),
    ]
    return cb.Problem(system, initial=[0.0, 0.0, 0.0], safe=safe, horizon=2.0, name="course")


def test_an_obstacle_course_shows_its_plane_and_every_constraint(course: Problem) -> None:
    inner, outer = tubes(course, [0.0, 0.0, 0.0], [2.0, 0.0, 0.5])
    times = np.linspace(0.0, 2.0, 11)
    paths = np.zeros((4, 11, 3)) + times[:, None]
    figure = draw_scene(
        Scene(problem=course, reach=inner, tube=outer, times=times, paths=paths, title="course: SAFE")
    )
    stream = BytesIO()
    figure.savefig(stream, format="png")
    assert stream.getvalue().startswith(b"\x89PNG")
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["", "distance to the ball around (1, 1.5)", "px", "py", "th"]
    plane = figure.axes[0]
    radii = sorted(patch.radius for patch in plane.patches if isinstance(patch, Circle))
    assert radii[0] == 0.4
    assert radii[1] == pytest.approx(0.6, abs=1e-6)
    assert sum(isinstance(item, PolyCollection) for item in plane.collections) == 2
    (limit,) = [line for line in figure.axes[4].lines if line.get_linestyle() == "--"]
    assert list(limit.get_xdata()) == [1.0, 2.0]
    assert list(limit.get_ydata()) == [2.0, 2.0]


def test_opposite_faces_share_a_panel(course: Problem) -> None:
    panels = {panel.label: (panel.low, panel.high) for panel in panels_of(course)}
    assert panels["px"] == (-2.0, 4.0)
    assert panels["py"] == (-2.0, 2.5)
    assert panels["th"] == (-np.inf, 2.0)


def test_the_outline_touches_the_support_in_every_direction(course: Problem) -> None:
    inner, _ = tubes(course, [0.0, 0.0, 0.0], [2.0, 0.0, 0.5])
    shapes = outlines(inner, (0, 1))
    assert shapes.shape[0] == PIECES
    for angle in (0.0, 0.7, 2.0, 4.0):
        row = np.array([np.cos(angle), np.sin(angle), 0.0])
        reach = (shapes @ row[:2]).max(axis=1)
        height = supports(inner, row)
        assert np.all(reach >= height - 1e-9)
        assert np.all(reach <= height + 0.02)


def test_a_twelve_dimensional_chain_without_a_plane_gets_panels_only() -> None:
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=12, noise=cb.Gaussian(std=0.1))
    high = np.full(12, np.inf)
    high[:9] = 1.0
    problem = cb.Problem(system, initial=np.zeros(12), safe=[cb.Inside(cb.Box(-high, high))], horizon=10)
    assert plane_of(problem) is None
    inner, outer = tubes(problem, [0.0] * 12, [0.5] * 12)
    figure = draw_scene(Scene(problem=problem, reach=inner, tube=outer, title="chain"))
    assert [axes.get_title(loc="left") for axes in figure.axes] == [f"x{k + 1}" for k in range(9)]


def test_of_more_constraints_than_fit_those_with_the_least_room_are_drawn() -> None:
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=20, noise=cb.Gaussian(std=0.1))
    high = np.linspace(3.0, 1.0, 20)
    problem = cb.Problem(system, initial=np.zeros(20), safe=[cb.Inside(cb.Box(-high, high))], horizon=10)
    inner, outer = tubes(problem, [0.0] * 20, [0.5] * 20)
    figure = draw_scene(Scene(problem=problem, reach=inner, tube=outer, title="many"))
    assert [axes.get_title(loc="left") for axes in figure.axes] == [f"x{k}" for k in range(9, 21)]
    assert "12 constraints with the least room, of 20" in figure.get_suptitle()


def test_the_certified_bound_of_a_panel_agrees_with_the_verdict() -> None:
    verdict = cb.verify_safety(cb.load("chain_rest"), method="linear")
    scene = Scene.of(verdict)
    rooms = [room_of(scene, panel) for panel in panels_of(scene.problem)]
    assert min(float(np.min(room)) for room in rooms if room is not None) == pytest.approx(verdict.margin, abs=1e-12)
    (bound, room), *_ = bounds_of(scene, panels_of(scene.problem)[0])
    assert np.allclose(bound - room, -1.2)  # p1 stays above -1.2 by its room
    assert scene.tube is not None
    assert np.all(room >= 1.2 - supports(scene.tube, np.eye(6)[0] * -1) - 1e-9)


def test_drawing_touches_neither_pyplot_nor_compilers() -> None:
    code = """
import sys
import numpy as np
import certbound as cb
from certbound.plotting import Scene, draw_scene
from certbound.reach.nominal import Curve
from certbound.reach.sets import ReachTube

system = cb.DiscreteSystem(lambda x: 0.5 * x, states=2, noise=cb.Gaussian(std=0.1))
problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=2)
steps = np.arange(3.0)
curve = Curve(continuous=False, starts=steps, ends=steps, coefficients=np.zeros((1, 3, 1, 2)))
draw_scene(Scene(problem=problem, reach=ReachTube(curve=curve))).savefig(sys.argv[1])
assert not {"matplotlib.pyplot", "numba"} & set(sys.modules)
"""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-W", "error", "-c", code, f"{folder}/a.pdf"], check=True)


def test_the_noisy_tube_of_a_random_start_has_its_spread_at_step_0():
    system = cb.DiscreteSystem(lambda x: [0.5 * x[0]], states=1, noise=cb.Gaussian(std=0.1))
    start = cb.GaussianStart([0.0], covariance=[[0.01]])
    problem = cb.Problem(system, initial=start, safe=[cb.Inside(cb.Box([-2], [2]))], horizon=2, delta=0.1)
    tube = noisy_reach(cb.verify_safety(problem, method="constants"))
    assert tube is not None
    assert tube.radius[0, 0] > 0.1
    quiet = problem.replace(system=cb.DiscreteSystem(lambda x: [0.5 * x[0]], states=1, noise=cb.Gaussian(std=1e-5)))
    assert not np.isinf(getattr(noisy_reach(cb.verify_safety(quiet, method="constants")), "radius", 0.0)).any()
