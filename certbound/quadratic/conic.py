"""A semidefinite program as it is written down: blocks of variables, matrix inequalities, one linear objective.

Everything is handed to Clarabel as it stands. What comes back is a proposal; a failure is a None.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple, cast

import numpy as np

from certbound.arrays import Array, Integers
from certbound.parallel import crew, result_of
from certbound.watch import poll, undisturbed

_ROOT = float(np.sqrt(2.0))
_LONG = 4e5  # squared sizes of all inequalities beyond which a copy of this process solves: seconds
_GRACE = 0.3, 0.3  # seconds, and of the limit, after which such a copy is ended: what is nearly found is waited for
_SETTLED = ("Solved", "PrimalInfeasible", "DualInfeasible", "MaxTime")


class Part(NamedTuple):
    """A linear map from some variables to symmetric matrices (k, k, len(columns)), or to vectors."""

    map: Array
    columns: Integers


class Block(NamedTuple):
    """The nonzeros of a matrix inequality over columns of its own, so that it can be stated many times."""

    size: int
    rows: Integers
    columns: Integers
    values: Array
    constant: Array


def block(constant: Array, maps: Sequence[Array]) -> Block:
    """constant + sum of maps (k, k, v) >= 0, the columns of the maps numbered one after the other."""
    size = len(constant)
    place = np.array([(i, j) for j in range(size) for i in range(j + 1)]).T
    scale = np.where(place[0] == place[1], 1.0, _ROOT)
    joined = np.concatenate([part[place[0], place[1]] for part in maps], axis=1) * scale[:, None]
    rows, columns = np.nonzero(joined)
    return Block(size, rows, columns, joined[rows, columns], constant[place[0], place[1]] * scale)


@cache
def _solver_module() -> Any:
    """Clarabel with everything loaded: a timer that interrupts its first solution would leave it broken for good."""
    with undisturbed():
        from scipy import sparse

        clarabel = importlib.import_module("clarabel")
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        eye, one = sparse.csc_matrix(np.eye(3)), np.array([1.0, 0.0, 1.0])
        cone = clarabel.PSDTriangleConeT(2)
        clarabel.DefaultSolver(sparse.csc_matrix((3, 3)), one, -eye, one, [cone], settings).solve()
    return clarabel


class Program:
    """minimise one variable, subject to matrix and scalar inequalities."""

    def __init__(self) -> None:
        self.clarabel: Any = _solver_module()
        self.width, self.height = 0, 0
        self.cones: list[Any] = []
        self.entries: list[tuple[Integers, Integers, Array]] = []
        self.constants: list[Array] = []

    def variables(self, count: int) -> Integers:
        """Places of new free variables."""
        first, self.width = self.width, self.width + count
        return np.arange(first, first + count)

    def nonnegative(self, count: int) -> Integers:
        """Places of new variables that are at least 0."""
        columns = self.variables(count)
        if count:
            self.at_least(np.zeros(count), [Part(np.eye(count), columns)])
        return columns

    def at_least(self, constant: Array, parts: Sequence[Part]) -> None:
        """constant + sum of parts >= 0, entry by entry."""
        for part in parts:
            rows, places = np.nonzero(part.map)
            self.entries.append((rows + self.height, part.columns[places], -part.map[rows, places]))
        self._state(constant, self.clarabel.NonnegativeConeT(len(constant)))

    def semidefinite(self, stated: Block, columns: Integers) -> None:
        """The block with its columns standing for the given variables."""
        self.entries.append((stated.rows + self.height, columns[stated.columns], -stated.values))
        self._state(stated.constant, self.clarabel.PSDTriangleConeT(stated.size))

    def _state(self, constant: Array, cone: Any) -> None:
        self.constants.append(constant)
        self.cones.append(cone)
        self.height += len(constant)

    def minimise(self, column: int, *, seconds: float) -> Array | None:
        """The variables at about the least value of one of them; None where the solver came to nothing."""
        from scipy import sparse

        rows, columns, values = (np.concatenate(parts) for parts in zip(*self.entries))
        matrix = sparse.csc_matrix((values, (rows, columns)), shape=(self.height, self.width))
        objective = np.zeros(self.width)
        objective[column] = 1.0
        right = np.concatenate(self.constants)
        if sum(float(len(one)) ** 2 for one in self.constants) < _LONG:
            return self._solved(objective, matrix, right, seconds)
        until = time.monotonic() + _GRACE[0] + (1.0 + _GRACE[1]) * seconds  # nobody counts what a copy works
        with crew(1) as workers:  # one step of the solver may outlast the limit, and nothing in this process ends it
            workers.begin(0, lambda: self._solved(objective, matrix, right, seconds))
            while True:
                for _, answer in workers.finished():
                    return cast("Array | None", result_of(answer))
                if time.monotonic() > until:
                    return None
                poll()

    def _solved(self, objective: Array, matrix: Any, right: Array, seconds: float) -> Array | None:
        """What Clarabel finds."""
        from scipy import sparse

        nothing = sparse.csc_matrix((self.width, self.width))
        until, found = time.perf_counter() + seconds, None
        for careful in (False, True):
            settings = self._settings(max(until - time.perf_counter(), 0.01), careful=careful)
            solution = self.clarabel.DefaultSolver(nothing, objective, matrix, right, self.cones, settings).solve()
            dead = solution.iterations < 5 or str(solution.status) in ("PrimalInfeasible", "DualInfeasible")
            values = np.array(solution.x)
            if not dead and np.isfinite(values).all():
                found = values
            if str(solution.status) in _SETTLED or time.perf_counter() > until:
                break
        return found

    def _settings(self, seconds: float, *, careful: bool) -> Any:
        """Linear systems are refined only if ``careful``: it takes as long again, and seldom changes the result."""
        settings = self.clarabel.DefaultSettings()
        settings.verbose, settings.max_iter, settings.time_limit = False, 80, float(seconds)
        settings.tol_gap_rel, settings.tol_gap_abs, settings.tol_feas = 1e-4, 1e-4, 1e-7
        settings.max_threads = 1
        settings.equilibrate_enable, settings.static_regularization_constant = False, 1e-7  # else it may break down
        settings.iterative_refinement_enable = careful
        return settings
