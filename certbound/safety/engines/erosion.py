"""Set erosion: what the reach tube leaves of every constraint, piece by piece, for the stochastic deviation.

A state X = x + S with x in the reach tube keeps every constraint while ||S||_P <= r_k on piece k, where r_k is the
least room of the constraints asked there. The rooms are proved lower bounds (`certbound.reach.sets.clearance`); at t =
0 no deviation has happened yet, so that a discrete-time clearance owes nothing at step 0.

Source: Thm 1 and Prop 4 (paper); Thm K2 (theory) for what the rooms are used for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside
from certbound.reach.sets import ReachTube, constraint_clearance
from certbound.rigor.norms import Norm


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Tightest:
    """Where the least room is left: a Euclidean distance (negative: too much is asked), the constraint, the time."""

    margin: float
    constraint: int
    label: str
    time: float
    piece: int


    @property
    def place(self) -> dict[str, Any]:
        """As fields of an answer."""
        return {"margin": self.margin, "time": self.time, "constraint": self.label or None}


@dataclass(frozen=True, eq=False, kw_only=True)
class Erosion:
    """Rooms of all constraints (J of them) over the pieces (K) of a reach tube, in one metric.

    ``labels`` are the constraints in words, the model's domain last where there is one. ``starts`` and ``ends``, shape
    (K,), are the pieces; in discrete time steps, starts = ends. ``radius``, shape (J, K), is the proved r, inf where
    the constraint is not asked; ``factor``, shape (J, K), the Euclidean distance per unit of r (for people).
    """

    labels: tuple[str, ...]
    continuous: bool
    starts: Array
    ends: Array
    radius: Array
    factor: Array

    @property
    def least(self) -> Array:
        """Least room over the constraints, shape (K,); inf where nothing is asked."""
        return np.asarray(np.min(self.radius, axis=0, initial=np.inf))

    def only(self, constraint: int) -> Erosion:
        """The same for one constraint."""
        chosen = slice(constraint, constraint + 1)
        return replace(
            self, labels=self.labels[chosen], radius=self.radius[chosen], factor=self.factor[chosen]
        )

    def capped(self, limit: Array) -> Erosion:
        """Rooms cut to ``limit``, shape (K,): what local constants allow."""
        return replace(self, radius=np.minimum(self.radius, limit))

    def profile(self, *, random_start: bool = False) -> tuple[Array, Array]:
        """Clearance as (times, values), values[k] on [times[k], times[k + 1]), for ``bound_exit_probability``.

        In discrete time the last value holds for the last two steps, and step 0 owes nothing unless S_0 is random.
        """
        values = self.least
        if self.continuous:
            return np.append(self.starts, self.ends[-1]), values
        owed = values[1:]
        steps = len(owed)
        per_step = np.concatenate([[values[0] if random_start else np.inf], owed[:-1]])
        per_step[-1] = min(per_step[-1], owed[-1])
        return np.arange(steps + 1, dtype=float), per_step

    def broken(self, *, random_start: bool = False) -> bool:
        """Whether the reach tube alone leaves no room somewhere.

        At t = 0 of discrete time none is needed, unless S_0 is random.
        """
        values = self.least
        if self.continuous or random_start:
            return bool(np.any(values <= 0))
        return bool(values[0] < 0 or np.any(values[1:] <= 0))

    def tightest(self, needed: Array | None = None) -> Tightest:
        """The constraint and time with the least Euclidean room after a deviation ``needed``, shape (K,), is taken."""
        taken = np.zeros(len(self.starts)) if needed is None else np.asarray(needed, dtype=float)
        with np.errstate(invalid="ignore"):
            margins = (self.radius - taken) * self.factor
        margins = np.where(np.isnan(margins), -np.inf, margins)
        if margins.size == 0 or not np.any(np.isfinite(self.radius) | (self.radius < 0)):
            return Tightest(margin=np.inf, constraint=-1, label="", time=float(self.ends[-1]), piece=len(self.ends) - 1)
        j, k = np.unravel_index(int(np.argmin(margins)), margins.shape)
        at = self.ends[k] if k == len(self.ends) - 1 else 0.5 * (self.starts[k] + self.ends[k])
        return Tightest(
            margin=float(margins[j, k]), constraint=int(j), label=self.labels[int(j)], time=float(at), piece=int(k)
        )


def erode(reach: ReachTube, problem: Problem, norm: Norm) -> Erosion:
    """Rooms of every constraint of ``problem`` (its domain included) around the sets of ``reach``, in ``norm``.

    Proves: the set of piece k plus {||y||_P <= radius[j, k]} keeps constraint j while it is asked on the piece.
    """
    constraints: tuple[Inside, ...] = problem.constraints
    rooms = [constraint_clearance(reach, constraint, norm) for constraint in constraints]
    shape = (len(rooms), reach.curve.pieces)
    return Erosion(
        labels=tuple(constraint.label for constraint in constraints),
        continuous=reach.curve.continuous,
        starts=reach.curve.starts,
        ends=reach.curve.ends,
        radius=np.array([room.radius for room in rooms]).reshape(shape),
        factor=np.array([room.factor for room in rooms]).reshape(shape),
    )
