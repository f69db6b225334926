"""Verdicts as moving pictures: the tube's set and the sample paths at one time after the other."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.arrays import Array
from certbound.plotting.asked import panels_of
from certbound.plotting.panels import draw_panel
from certbound.plotting.picture import tightest
from certbound.plotting.plane import draw_plane, outlines, plane_of
from certbound.plotting.scene import BLUE, INK, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from certbound.safety.verdict import Verdict


def animate(
    verdict: Verdict, path: str | Path, *, frames: int = 40, paths: int = 30, seconds: float = 4.0,
    rng: np.random.Generator | None = None,
) -> None:  # fmt: skip
    """Write a GIF of a verdict: in the plane of its constraints, or over time for the tightest of them.

    What moves is where the state is with the proved probability at each time, and sample paths; the picture proves
    nothing of its own.

    Parameters
    ----------
    verdict : Verdict
        With a reach tube (the engines linear and constants have one).
    path : str or Path
        The file, which ends in .gif.
    frames : int
        Pictures, at equal steps of time.
    paths : int
        Sample paths; none for a noise without a law.
    seconds : float
        How long one round takes.
    rng : Generator, optional
        For the paths; the same ones every time when omitted.

    Raises
    ------
    ValueError
        If ``path`` does not end in .gif, ``frames`` is below 2, ``seconds`` is not positive, or nothing was
        proved that could be drawn.
    """
    if frames < 2 or not seconds > 0:
        raise ValueError(f"`frames` must be at least 2 and `seconds` positive, got {frames} and {seconds}.")
    if Path(path).suffix.lower() != ".gif":
        raise ValueError(f"`path` must end in .gif, got {str(path)!r}.")
    from matplotlib.animation import FuncAnimation, PillowWriter
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scene = _scene(verdict, paths, np.random.default_rng(0) if rng is None else rng)
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    moving = _Plane(axes, scene) if plane_of(scene.problem) is not None else _Trace(axes, scene)
    assert scene.reach is not None
    times = np.linspace(float(scene.reach.curve.starts[0]), scene.reach.end, frames)
    film = FuncAnimation(figure, lambda k: moving.show(float(times[k])), frames=frames, blit=False)
    film.save(str(path), writer=PillowWriter(fps=max(1, round(frames / seconds))), dpi=80)


def _scene(verdict: Verdict, paths: int, rng: np.random.Generator) -> Scene:
    from certbound.simulation.estimates import sample_paths  # loads numba, which pictures that stand still do without

    still = Scene.of(verdict)
    try:
        found = sample_paths(still.problem, paths=paths, rng=rng)
    except ValueError:  # the noise has no law to sample from
        return still
    times = np.linspace(0.0, float(still.problem.horizon), found.shape[1])
    return Scene.of(verdict, times=times, paths=found)


class _Plane:
    """The tube's set at one time, and the paths then, over the still picture."""

    def __init__(self, axes: Axes, scene: Scene) -> None:
        plane = plane_of(scene.problem)
        assert plane is not None
        self.axes, self.scene, self.plane = axes, scene, plane
        draw_plane(axes, scene, plane)
        (self.rim,) = axes.plot([], [], color=BLUE, linewidth=1.6, zorder=8)
        (self.dots,) = axes.plot([], [], ".", color=INK, markersize=4, zorder=9)

    def show(self, t: float) -> list[Any]:
        """Move what moves."""
        tube = self.scene.tube or self.scene.reach
        assert tube is not None
        piece = np.array([tube.curve.piece_of(t)])
        shape: Array = outlines(tube, self.plane, piece)[0]
        self.rim.set_data(*np.concatenate([shape, shape[:1]]).T)
        if self.scene.paths is not None and self.scene.times is not None:
            now = int(np.argmin(np.abs(self.scene.times - t)))
            self.dots.set_data(*self.scene.paths[:, now, list(self.plane)].T)
        self.axes.set_title(f"t = {t:.3g}", loc="left", fontsize=9)
        return [self.rim, self.dots]


class _Trace:
    """A line that runs over the tightest constraint's panel."""

    def __init__(self, axes: Axes, scene: Scene) -> None:
        (panel,) = tightest(scene, panels_of(scene.problem), 1)
        draw_panel(axes, scene, panel)
        axes.set_xlabel(scene.problem.time_axis)
        self.line = axes.axvline(0.0, color=BLUE, linewidth=1.6, zorder=8)

    def show(self, t: float) -> list[Any]:
        """Move the line."""
        self.line.set_xdata([t, t])
        return [self.line]
