"""Cells of a start of a linear model with noise that is to stay within half-spaces: one response serves all of them.

The deviation of a path from that of its cell's middle does not know the cell, and half-spaces ask the same rows of it:
only what room they leave differs from cell to cell.
"""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array
from certbound.gaussian.response import Exceedances, logsumexp
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces, Inside
from certbound.reach.linear import Linearisation, LinearRun, Share
from certbound.reach.nominal import Cells
from certbound.reach.starts.crossed_limits import Limit
from certbound.reach.starts.drawn_directions import StartDirections
from certbound.reach.starts.drawn_paths import start_paths
from certbound.rigor.intervals import Interval

_SHARE = 0.002  # of delta, for what windows of time cost in common
_EVENTS = 40  # single times and faces that a lower bound counts
_ROUND = 1e-12


def in_half_spaces(problem: Problem) -> bool:
    """Whether every constraint keeps the state within half-spaces that do not move."""
    return all(_stays(one) for one in problem.kept)


def _stays(constraint: Inside) -> bool:
    return isinstance(constraint.region.form, Faces) and not constraint.outside and not constraint.region.moving


class SharedResponse:
    """Bounds of the probability of failing from cells of a start, by the response to noise and to what is not cut."""

    def __init__(self, problem: Problem, start: StartDirections, error: Array) -> None:
        mean = np.asarray(problem.initial.mean)[None]
        cells = Cells(centres=mean, boxes=Interval.point(mean), start_error=error)
        self.engine = Linearisation.of(problem, cells=cells)
        run = LinearRun(self.engine)
        self.serves = not run.curved
        if not self.serves:
            return
        events = run.levels(Share.of(_SHARE * float(problem.delta)))[1][0]
        self.common = float(events.shared_log)
        paths, self.faces = start_paths(self.engine, start), []
        count, nodes, rows, levels, gains = paths.pieces, [], [], [], []
        for number, constraint in enumerate(problem.kept):
            limit = Limit(constraint, paths, float(problem.horizon))
            form = constraint.region.form
            assert isinstance(form, Faces)
            normals = constraint.region.lifted(form.normals, self.engine.n)
            own = limit.points.chosen(limit.at_nodes)
            for m, normal in enumerate(normals):
                event = events.along(np.broadcast_to(normal, (count, len(normal))).copy())
                self.faces.append((limit, m, event))
                if number >= len(problem.safe):
                    continue  # beyond its domain the model says nothing
                bound = float(form.bounds[m])
                nodes.append(limit.nodes)
                rows.append(np.broadcast_to(normal, (len(limit.nodes), len(normal))))
                levels.append(bound - own.value[:, 0, m] + own.slack[:, m])
                gains.append(own.gains[:, 0, m])
        self.events = Exceedances(
            nodes=np.concatenate(nodes), rows=np.concatenate(rows), levels=np.concatenate(levels),
            lost=np.zeros(sum(map(len, levels))),
        )  # fmt: skip
        self.gains = np.concatenate(gains)
        self._thin()

    def _thin(self) -> None:
        """Keep single times that are likely to count, and their correlations."""
        size = np.sqrt(np.maximum(self.engine.response.variance(self.events.rows[None], self.events.nodes)[1][0], 0.0))
        own = np.sqrt(size**2 + (self.gains**2).sum(axis=1))
        with np.errstate(divide="ignore", invalid="ignore"):
            far = np.where((own > 0) & (size > 0), self.events.levels / own, np.inf)
        order = np.flatnonzero(far <= far.min(initial=np.inf) + 1.5) if len(far) else np.zeros(0, dtype=int)
        if len(order) > _EVENTS:
            order = order[np.unique(np.linspace(0, len(order) - 1, _EVENTS).round().astype(int))]
        self.events, self.gains = self.events.chosen(order), self.gains[order]
        self.correlations = self.events.correlations(self.engine.response) if len(order) else np.zeros((0, 0))

    def above(self, middle: Array, half: Array) -> float:
        """An upper bound that holds from every start of a cell (d,)."""
        logs, rooms = [self.common], {}
        for limit, m, event in self.faces:
            if id(limit) not in rooms:
                rooms[id(limit)] = limit.rooms(middle[None], half[None])[0]
            levels = np.full(len(limit.asked), np.inf)
            levels[limit.asked] = rooms[id(limit)][:, m]
            logs.append(event.log_exceedance(levels))
        return min(float(np.exp(logsumexp(np.array(logs)))) * (1 + _ROUND), 1.0)

    def below(self, middle: Array, half: Array) -> float:
        """A lower bound that does."""
        if not len(self.gains):
            return 0.0
        moved = self.gains @ middle - np.abs(self.gains) @ half
        levels = self.events.levels - moved + 1e-13 * (np.abs(self.events.levels) + np.abs(self.gains) @ (
            np.abs(middle) + half))  # fmt: skip
        events = Exceedances(nodes=self.events.nodes, rows=self.events.rows, levels=levels, lost=self.events.lost)
        return max(events.union(self.engine.response, self.correlations) * (1 - _ROUND), 0.0)
