"""The picture of tubes side by side."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.plotting import draw_tubes
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
