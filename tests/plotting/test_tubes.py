"""The picture of tubes side by side."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.constants.fitted import MovingConstants
from certbound.plotting import draw_constants, draw_tubes
from certbound.tubes.constants import Constants
from certbound.tubes.tuning import tune_tube


@pytest.mark.parametrize("slope", [{"rate": -0.5}, {"gain": 0.8}])
def test_every_tube_is_drawn_and_the_chosen_one_stands_out(slope):
    constants = Constants(sigma=1.0, dimension=2, **slope)
    names = ("kummer", "bessel", "markov")
    tubes = {name: tune_tube(constants, horizon=4, delta=1e-2, method=name) for name in names}
    figure = draw_tubes(tubes, "kummer", np.ones((5, 9)))
    (axes,) = figure.axes
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert {"kummer: chosen", "bessel", "markov (one time)"} <= set(lines)
    np.testing.assert_allclose(lines["kummer: chosen"].get_ydata()[-1], tubes["kummer"].radius(4))
    assert lines["kummer: chosen"].get_linewidth() > lines["bessel"].get_linewidth()
    assert len(axes.get_lines()) == 8
    assert axes.get_ylim()[1] == pytest.approx(3 * tubes["kummer"].maximum)


def test_without_paths_the_tubes_stand_alone():
    tube = tune_tube(Constants(rate=-1.0, sigma=1.0, dimension=1), horizon=2.0, delta=0.1)
    assert len(draw_tubes({"auto": tube}, "auto").axes[0].get_lines()) == 1


def test_the_command_writes_the_picture(tmp_path, monkeypatch):
    from certbound.cli.app import run
    from certbound.tubes import tuning

    monkeypatch.setattr(tuning, "METHODS", ("auto", "kummer", "thm3"))
    target = tmp_path / "tubes.png"
    assert run(["tune", "ou", "--plot", str(target), "--json"]) == 0
    assert target.read_bytes().startswith(b"\x89PNG")


def test_rates_metrics_and_entries_of_the_jacobian_are_drawn():
    problem = cb.load("pendulum")
    times = np.array([0.0, 2.0, 5.0])
    still = Constants(rate=[1.0, -1.0], sigma=1.0, dimension=2, times=times)
    frames = np.array([np.eye(2), np.diag([2.0, 1.0]), np.eye(2)])
    ones = np.ones(2)
    moving = MovingConstants(
        times=times, frames=frames, rate=-ones, sigma=ones, effective_dimension=2.0, sampled=-ones,
        _inverse=frames[1:], _error=ones,
    )  # fmt: skip
    rates, spectra, entries = draw_constants(problem, {"all in one": still}, moving).axes
    assert [text.get_text() for text in rates.get_legend().get_texts()] == ["one metric", "moving coordinates"]
    np.testing.assert_allclose(spectra.get_lines()[1].get_ydata(), [1.0, 4.0, 1.0])
    np.testing.assert_array_equal(entries.get_images()[0].get_array(), [[0, 1], [2, 1]])
    single = Constants(rate=-1.0, sigma=1.0, dimension=2, metric=np.diag([4.0, 1.0]))
    rates, spectra, entries = draw_constants(problem, {"all in one": single, "th <= 1.2": single}).axes
    assert [label.get_text() for label in rates.get_yticklabels()] == ["all in one", "th <= 1.2"]
    np.testing.assert_allclose(spectra.collections[1].get_offsets(), [[1.0, 1.0], [4.0, 1.0]])
