"""Pictures of verdicts and tubes, with sample paths where the noise has a law to sample from."""

from __future__ import annotations

import logging
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certbound.cli.messages import InputError
from certbound.cli.output import write_file
from certbound.errors import EngineError, contained
from certbound.watch import OutOfTime, Watch

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from certbound.plotting import Scene
    from certbound.problem.problem import Problem
    from certbound.reach.sets import ReachTube
    from certbound.safety.starts import SafeStarts
    from certbound.safety.verification import Verdict

PATHS = 60
_SECONDS = 20.0  # for a tube that only a picture needs
_log = logging.getLogger(__name__)


def check_picture(path: Path | None) -> None:
    """Refuse, before any work, to draw in a format that matplotlib does not write."""
    if path is None or not path.suffix:
        return
    from matplotlib.backend_bases import FigureCanvasBase

    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix[1:].lower() not in known:
        raise InputError(
            f"`{path.name}` ends in {path.suffix}, which is no format of pictures", "end it in .png or .pdf"
        )


def write_picture(path: Path, figure: Figure, *, dpi: int = 150) -> None:
    """Write a figure in the format that the file's name ends in."""
    stream = BytesIO()
    figure.savefig(stream, format=path.suffix.lstrip(".") or "png", dpi=dpi)
    write_file(path, stream.getvalue())


def sampled(problem: Problem, *, deviation: bool = False) -> Any:
    """Sample paths to draw, shape (path, time, state); None for noise without a law."""
    import numpy as np

    from certbound.simulation.estimates import sample_paths

    try:
        return sample_paths(problem, paths=PATHS, rng=np.random.default_rng(0), deviation=deviation)
    except ValueError as error:
        _log.info("no sample paths are drawn: %s", error)
        return None


def values_of(problem: Problem, verdict: Verdict) -> SafeStarts | None:
    """The value function behind a verdict, with its safe starts; None where there is none to draw."""
    from certbound.safety.starts import bound_safe_starts

    try:
        with contained("values"):
            one = problem.replace(initial=problem.starts[0]) if verdict.members else problem
            found = bound_safe_starts(one, verdict.answers, pictured=True) if verdict.answers else None
            return None if found is None else replace(found, problem=problem)
    except EngineError as error:
        _log.info("no value function is drawn: %s", error)
        return None


def drawn_reach(problem: Problem, verdict: Verdict) -> ReachTube | None:
    """The noise-free tube of a verdict: its own, or one proved for the picture alone; None where there is none.

    None too where nothing was proved: then the time that was granted is over, or the model is not served.
    """
    if verdict.reach is not None:
        return verdict.reach
    from certbound.reach import bound_reach

    if len(problem.starts) > 1 or problem.endless or not verdict.log10_delta < 0:
        return None
    try:
        with contained("noise-free"), Watch(_SECONDS).running():
            found: ReachTube = bound_reach(problem, noise=False)
            return found
    except (EngineError, OutOfTime) as error:
        _log.info("no tube is drawn: %s", error)
        return None


def scene_of(problem: Problem, verdict: Verdict, reach: ReachTube | None, title: str) -> Scene:
    """What is drawn of a verdict: limits and sample paths, with the tubes where there are any."""
    import numpy as np

    from certbound.plotting import Scene, measured_rooms, noisy_reach

    paths = sampled(problem)
    times = None if paths is None else np.linspace(0.0, float(problem.horizon), paths.shape[1])
    rooms = measured_rooms(verdict) if verdict.problem is not None and verdict.problem.safe == problem.safe else ()
    return Scene(
        problem=problem, reach=reach, tube=noisy_reach(verdict), times=times, paths=paths, rooms=rooms, title=title
    )
