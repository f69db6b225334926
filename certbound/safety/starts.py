"""Safe starts: the states from which failing is proved to be no more likely than delta, by value functions (Thm K8)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from certbound.arrays import Array, Mask
from certbound.checks import matrix
from certbound.display import Shown, rounded
from certbound.errors import EngineError, InfeasibleError, contained
from certbound.problem.problem import Problem
from certbound.problem.systems import DiscreteSystem
from certbound.rigor.intervals import Interval
from certbound.safety.answers import EngineAnswer, is_at_most
from certbound.values.charts import Chart, Charts
from certbound.values.continuous import chart_exits
from certbound.values.discrete import FailureBounds, bound_failure, chart_failures
from certbound.values.sets import contains

_ENGINE = "values"
_DECADES = (-6.0, -5.0, -4.0, -3.0, -2.0, -1.0)
_DEEPEST = -9.0  # log10 of the least probability that a picture is sharp at


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class SafeStarts(Shown):
    """A set of starts from each of which P(a constraint is broken by the horizon) <= delta, proved.

    A union of closed cells of a grid, each with a bound that holds for every start in it and every disturbance that
    does not see coming noise. What lies outside may be safe too: its bound is larger, or no bound was proved.

    Parameters
    ----------
    problem : Problem
        What is asked; its own initial set does not matter.
    delta : float
        The probability that no start in the set exceeds.
    charts : Charts
        Certified bounds on all cells.
    """

    problem: Problem
    delta: float
    charts: Charts

    @property
    def chart(self) -> Chart:
        """Upper bounds from the cells at the beginning."""
        return self.charts.upper[0]

    @property
    def cells(self) -> Mask:
        """Which cells belong to the set, shape (N_1, ..., N_n)."""
        return self.safe(self.chart)

    def safe(self, chart: Chart) -> Mask:
        """The cells of a chart of upper bounds from which failing is proved to be at most as probable as delta."""
        return np.asarray(chart.log10 <= _threshold(self.delta))

    @property
    def boxes(self) -> Array:
        """The set as boxes, shape (K, n, 2): its cells, neighbours along the last state joined."""
        return self.chart.boxes(self.cells)

    @property
    def measure(self) -> float:
        """Length, area or volume of the set, rounded down."""
        boxes = self.boxes
        widths = Interval.point(boxes[..., 1]) - Interval.point(boxes[..., 0])
        sizes = Interval.point(np.ones(len(boxes)))
        for axis in range(boxes.shape[1]):
            sizes = sizes * widths[:, axis]
        return max(float(sizes.sum().lo), 0.0)

    @property
    def holds_initial(self) -> bool:
        """Whether the problem's initial set lies in it (of a random start: its mean)."""
        return all(self._holds(start) for start in self.problem.starts)

    def _holds(self, start: Any) -> bool:
        good: Mask = self.cells
        around = Interval.point(start.mean) if start.random else start.hull()
        if not start.random and np.all(around.lo < around.hi):
            cells = Interval(*(np.stack([end.ravel() for end in side], axis=1) for side in self._ends()))
            good = good | contains(start, cells, 0, interiors=True)[1].reshape(good.shape)
        for place, (axis, low, high) in enumerate(zip(self.chart.axes, around.lo, around.hi)):
            if low < axis[0] or high > axis[-1]:
                return False
            met = (axis[:-1] < high) & (axis[1:] > low) if low < high else (axis[:-1] <= high) & (axis[1:] >= low)
            good = np.compress(met, good, axis=place)
            good = good if low < high else np.any(good, axis=place, keepdims=True)
        return bool(good.all())

    def _ends(self) -> tuple[list[Array], list[Array]]:
        """Lower and upper ends of all cells in each state."""
        low = np.meshgrid(*(axis[:-1] for axis in self.chart.axes), indexing="ij")
        return list(low), list(np.meshgrid(*(axis[1:] for axis in self.chart.axes), indexing="ij"))

    def bound(self, points: Any) -> Array:
        """log10 of a certified upper bound of the probability of failing from each point.

        Parameters
        ----------
        points : array_like, shape (n,) or (P, n)
            Starts; of one state also a number.

        Returns
        -------
        ndarray, shape (P,)
            0 outside the grid.

        Raises
        ------
        ValueError
            If the points do not have as many entries as the problem has states.
        """
        n = len(self.chart.axes)
        rows = matrix("points", np.atleast_2d(np.asarray(points, dtype=float)), columns=n)
        return self.chart.at(rows, up=True)

    def contains(self, points: Any) -> bool | Mask:
        """Whether failing from a point is proved to be at most as probable as delta; an array of answers for several.

        Parameters
        ----------
        points : array_like, shape (n,) or (P, n)
            Starts; of one state also a number.

        Raises
        ------
        ValueError
            If the points do not have as many entries as the problem has states.
        """
        found = np.asarray(self.bound(points) <= _threshold(self.delta))
        return found if np.ndim(points) == 2 else bool(found[0])

    def summary(self) -> str:
        """The size of the set, in one line."""
        word = ("length", "area", "volume")[min(len(self.chart.axes), 3) - 1]
        size = rounded(self.measure, up=False, digits=4)
        return f"safe starts: {word} at least {size}, P(leaving) <= {self.delta!r} from each"

    def rows(self) -> list[tuple[str, str]]:
        """Cells, the range of each state, and whether the stated initial set is covered."""
        boxes, names = self.boxes, self.problem.system.states
        found = [("cells", f"{int(self.cells.sum())} of {self.cells.size}, as {len(boxes)} boxes")]
        if len(boxes):
            ends = zip(names, boxes[..., 0].min(axis=0), boxes[..., 1].max(axis=0))
            found += [(f"range of {name}", f"{low:.4g} ... {high:.4g}") for name, low, high in ends]
        return [*found, ("holds the stated initial set", "yes" if self.holds_initial else "no")]

    def to_dict(self) -> dict[str, Any]:
        """``delta``, ``measure``, ``holds_initial`` and the ``boxes``."""
        names = ("delta", "measure", "holds_initial")
        return {name: getattr(self, name) for name in names} | {"boxes": self.boxes.tolist()}

    def to_columns(self) -> dict[str, Array]:
        """A row a cell of the set: its ends in each state and its bound, as ``pandas.DataFrame`` takes them."""
        chosen = self.cells
        columns: dict[str, Array] = {}
        for name, low, high in zip(self.problem.system.states, *self._ends()):
            columns |= {f"{name}_low": low[chosen], f"{name}_high": high[chosen]}
        return columns | {"log10_delta": self.chart.log10[chosen]}


def bound_safe_starts(
    problem: Problem, answers: Mapping[str, EngineAnswer], delta: float | None = None, *, pictured: bool = False
) -> SafeStarts:
    """Prove from which starts failing is at most as probable as delta; about as much work as the engine's own bound.

    Parameters
    ----------
    problem : Problem
        With up to three states in discrete time, one or two in continuous time.
    answers : mapping
        What the engines answered about it, by name; without any, value functions are computed anew.
    delta : float, optional
        The problem's own where it is left out.
    pictured : bool
        Chart more times in one state, and be sharp at 1e-1 ... 1e-6 too, where otherwise delta alone counts.

    Raises
    ------
    InfeasibleError
        If no value function was proved, or value functions do not apply; the message says why and what to do.
    ValueError
        If ``delta`` does not lie in (0, 1).
    """
    target = problem.delta if delta is None else problem.replace(delta=delta).delta
    answer = answers.get(_ENGINE)
    if answers and (answer is None or not answer.applicable):
        why = "the verdict did not ask for one" if answer is None else answer.reason.rstrip(".")
        raise InfeasibleError(
            f"safe starts are read off a value function, and none was proved: {why}. "
            f'Ask for one: verify_safety(problem, method="{_ENGINE}").safe_starts().'
        )
    try:
        with contained(_ENGINE):
            charts = _charted(problem, answer, target, pictured)
    except EngineError as error:
        raise InfeasibleError(f"safe starts could not be proved: {error}") from error
    return SafeStarts(problem=problem, delta=target, charts=charts)


def _charted(problem: Problem, answer: EngineAnswer | None, target: float, pictured: bool) -> Charts:
    times = 4 if pictured and problem.system.dimension == 1 else 1
    if isinstance(problem.system, DiscreteSystem):
        details = None if answer is None else answer.details
        found = details if isinstance(details, FailureBounds) else bound_failure(problem, delta=target)
        charts = chart_failures(problem, share=found.share, times=times)
        return replace(charts, lower=()) if problem.unknown else charts
    levels = [math.log10(target)]
    if pictured:
        proved = [] if answer is None else [answer.log10_delta]
        levels += [*_DECADES, *(max(level, _DEEPEST) for level in proved if level < 0)]
    return chart_exits(problem, levels=levels, times=times, lower=pictured and not (problem.unknown or problem.ending))


def _threshold(delta: float) -> float:
    """The largest float close to log10 of delta up to which a bound is proved to be at most delta."""
    level = math.log10(delta)
    while not is_at_most(level, delta):
        level = math.nextafter(level, -math.inf)
    return level


