"""``plot`` takes states, times and a style; notebooks get the picture; a GIF moves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import certbound as cb
from certbound.safety.verdict import Verdict


@pytest.fixture(scope="module")
def verdict() -> Verdict:
    system = cb.ContinuousSystem(lambda x: -x, states=["px", "py"], diffusion=0.05 * np.eye(2))
    safe = [cb.Outside(cb.Box([1.0, 1.0], [1.4, 1.4])), cb.Inside(cb.Box([-2.0, -2.0], [2.0, 2.0]))]
    problem = cb.Problem(system, initial=[0.5, 0.0], safe=safe, horizon=2.0)
    return cb.verify_safety(problem, method="linear")


@pytest.fixture
def axes() -> Axes:
    axes: Axes = Figure().subplots()
    return axes


def test_one_state_is_drawn_over_time_with_its_limits(verdict: Verdict, axes: Axes) -> None:
    verdict.plot(axes, states="px", times=(0.5, 1.5))
    assert axes.get_xlim() == (0.5, 1.5)
    assert axes.get_ylabel() == "px"
    assert {-2.0, 2.0} <= {float(np.max(line.get_ydata())) for line in axes.lines if line.get_linestyle() == "--"}


def test_two_states_are_drawn_in_their_plane_and_a_part_of_the_time_is_less(verdict: Verdict, axes: Axes) -> None:
    verdict.plot(axes, states=["px", 1])
    whole = len(axes.collections[0].get_paths())
    other = Figure().subplots()
    verdict.plot(other, states=["px", "py"], times=(0.0, 0.5))
    assert 0 < len(other.collections[0].get_paths()) < whole
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("px", "py")


def test_a_style_holds_for_the_picture_alone(verdict: Verdict, axes: Axes) -> None:
    import matplotlib as mpl

    before = mpl.rcParams["lines.linestyle"]
    verdict.problem.plot(axes, style={"axes.titlesize": 3.0})  # type: ignore[union-attr]
    assert mpl.rcParams["lines.linestyle"] == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"states": "pz"}, "`states` must be among px, py, got 'pz'"),
        ({"states": 7}, "`states` must be below 2, got 7"),
        ({"states": [0, 1, 0]}, "one state over time or two in their plane, got 3"),
        ({"times": (1.0, 0.5)}, r"`times` must be \(first, last\) in order"),
        ({"states": 0, "times": (7.0, 8.0)}, r"`times` must meet \[0, 2\]"),
    ],
)
def test_what_cannot_be_chosen_is_said(verdict: Verdict, axes: Axes, options: dict, message: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(ValueError, match=message):
        verdict.plot(axes, **options)


def test_states_of_a_tube_of_numbers_are_refused(axes: Axes) -> None:
    tube = cb.tune_tube(cb.Constants(rate=-1.0, sigma=0.1, dimension=2), horizon=1.0, delta=1e-3)
    with pytest.raises(ValueError, match="`states` must be omitted for a Tube"):
        tube.plot(axes, states=0)


def test_notebooks_show_the_picture_beside_the_table(verdict: Verdict) -> None:
    picture = verdict._repr_png_()
    assert picture is not None
    assert picture.startswith(b"\x89PNG")
    assert '<img alt="" src="data:image/png;base64,' in verdict._repr_html_()
    assert verdict.problem is not None
    assert verdict.problem._repr_png_() is None  # that would take new work
    assert "<img" not in verdict.problem._repr_html_()


def test_an_animation_is_a_gif_of_so_many_frames(verdict: Verdict, tmp_path: Path) -> None:
    from PIL import Image

    cb.animate(verdict, tmp_path / "run.gif", frames=3, paths=4, seconds=1.0)
    with Image.open(tmp_path / "run.gif") as film:
        assert film.format == "GIF"
        assert film.n_frames == 3  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="`frames` must be at least 2"):
        cb.animate(verdict, tmp_path / "none.gif", frames=1)


def test_an_animation_without_a_plane_runs_over_time(tmp_path: Path) -> None:
    verdict = cb.verify_safety(cb.load("ou"), method="constants")
    cb.animate(verdict, tmp_path / "ou.gif", frames=2, paths=2)
    assert (tmp_path / "ou.gif").stat().st_size > 1000


def test_a_picture_needs_no_limits(axes: Axes) -> None:
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=["level"], noise=cb.Gaussian(std=0.1))
    problem = cb.Problem(system, initial=[0.5], safe=[], horizon=4)
    for shown in (problem, cb.verify_safety(problem, method="constants")):
        axes.clear()
        shown.plot(axes)
        assert len(axes.lines) > 0
