"""What a tube is tuned for: the largest radius, the final one, the mean, or the least scale of a clearance profile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.tubes.schedule import Schedule


@dataclass(frozen=True, eq=False)
class Clearance:
    """Piecewise-constant lower bounds on a distance: ``values[k]`` holds on [times[k], times[k+1])."""

    times: Array
    values: Array

    def at(self, t: Array, *, side: str = "right") -> Array:
        """Value at each time; ``side="left"`` takes the piece that ends there."""
        piece = np.searchsorted(self.times, t, side="right" if side == "right" else "left") - 1
        return self.values[np.clip(piece, 0, len(self.values) - 1)]

    def ends(self, schedule: Schedule) -> Array:
        """Times at which a schedule must be cut; in DT the last steps of the pieces as well."""
        inner = self.times[1:-1]
        if schedule.continuous:
            return inner
        first = np.ceil(inner)
        return np.unique(np.concatenate([first, first - 1]))


def read_clearance(value: Any, horizon: float, name: str = "clearance", *, continuous: bool = False) -> Clearance:
    """A number or a pair (times, values), checked and cut at the horizon.

    A pair may go on beyond the horizon T: a smaller value that begins at T holds there, and is asked from step T - 1
    (in continuous time T - T/1000) on.

    Raises
    ------
    TypeError
        For a callable: nothing could be proved between its samples.
    ValueError
        For values that are not positive, or times that do not rise from 0 to the horizon.
    """
    if callable(value):
        raise TypeError(
            f"`{name}` must be a number or a pair (times, values), got a callable: nothing can be proved between "
            "its samples; give lower bounds that hold on pieces."
        )
    pair = isinstance(value, tuple | list)
    if pair and len(value) != 2:
        raise ValueError(f"`{name}` must be a number or a pair (times, values), got {len(value)} entries.")
    try:
        parts = [np.asarray(part, dtype=float) for part in (value if pair else [value])]
    except (TypeError, ValueError) as error:
        raise TypeError(f"`{name}` must hold numbers, got {value!r}.") from error
    times, values = parts[0], parts[-1]
    if not pair:
        if values.ndim != 0:
            raise ValueError(f"`{name}` must be a number or a pair (times, values), got shape {values.shape}.")
        times, values = np.array([0.0, horizon]), values[None]
    if times.ndim != 1 or values.ndim != 1 or len(times) != len(values) + 1:
        raise ValueError(
            f"`{name}` needs one entry more in times than in values, got shapes {times.shape} and {values.shape}."
        )
    if not np.all(np.isfinite(times)) or times[0] != 0 or np.any(np.diff(times) <= 0) or times[-1] < horizon:
        raise ValueError(f"times of `{name}` must rise strictly from 0 to the horizon {horizon:g} or beyond.")
    if not np.all(values > 0):
        raise ValueError(f"`{name}` must be positive everywhere, its least value is {np.min(values):g}.")
    times, values = _until(times, values, horizon, continuous=continuous)
    times.setflags(write=False)
    values.setflags(write=False)
    return Clearance(times, values)


def _until(times: Array, values: Array, horizon: float, *, continuous: bool) -> tuple[Array, Array]:
    """The pieces up to the horizon; what is asked at the horizon is asked over the last step (T/1000) as well."""
    kept = int(np.searchsorted(times, horizon, side="left"))
    starts, held = times[:kept], values[:kept]
    begins = kept < len(values) and times[kept] == horizon
    if continuous and not begins:
        return np.append(starts, horizon), held.copy()
    asked = values[kept] if begins else held[-1]
    cut = horizon - (1e-3 * horizon if continuous else 1.0)
    place = int(np.searchsorted(starts, cut, side="right"))
    if place and starts[place - 1] < cut and held[place - 1] > asked:
        starts, held = np.insert(starts, place, cut), np.insert(held, place, held[place - 1])
    return np.append(starts, horizon), np.where(starts >= cut, np.minimum(held, asked), held)


@dataclass(frozen=True, eq=False)
class Objective:
    """``given`` as stated; ``kind`` is ``"scale"``, ``"final"`` or ``"mean"``; ``clearance`` belongs to a scale."""

    given: Any
    kind: str
    clearance: Clearance | None = None

    def roots(self, schedule: Schedule, *, scaled: bool = False) -> tuple[Array, Array]:
        """(sqrt(V) or e^C sqrt(W_T), weight) at the times that decide, in the schedule's unit."""

        def root(data: Schedule) -> Array:
            gain, variance = data.nodes
            if scaled:
                gain, info = data.path(np.asarray(1.0), bessel=True)
                variance = gain * info[0]
            return np.sqrt(np.maximum(variance, 0.0))

        with np.errstate(over="ignore", invalid="ignore"):
            if self.kind == "mean":
                fine = schedule.graded(64)
                return np.array([mean_over_time(fine, root(fine))]), np.ones(1)
            if self.kind == "final":  # e^C sqrt(W_T) is sqrt(V_T) there
                return np.sqrt(schedule.nodes[1][-1:]), np.ones(1)
            if self.clearance is None:
                return root(schedule), np.ones(1)
            cut = self.cut(schedule)
            side = "left" if schedule.continuous else "right"
            return root(cut)[1:], self.clearance.at(cut.times[1:], side=side)

    def pieces(self, schedule: Schedule) -> tuple[Schedule, Any]:
        """Schedule cut for the clearance, and the clearance as a function of piece starts (None without one)."""
        if self.kind in ("mean", "final"):
            return schedule, None
        if self.clearance is None:
            return schedule, lambda grid: np.ones(len(grid.lengths))
        held = self.clearance
        return self.cut(schedule), lambda grid: held.at(grid.times[:-1])

    def cut(self, schedule: Schedule) -> Schedule:
        """The schedule with a piece end wherever the clearance changes."""
        return schedule if self.clearance is None else schedule.refined(self.clearance.ends(schedule))

    def weights(self, schedule: Schedule) -> Array:
        """Clearance at the nodes of a schedule: the smaller one where two pieces meet in CT."""
        if self.clearance is None:
            return np.ones(len(schedule.times))
        right = self.clearance.at(schedule.times)
        if not schedule.continuous:
            return right
        return np.minimum(right, self.clearance.at(schedule.times, side="left"))


def mean_over_time(schedule: Schedule, values: Array) -> float:
    """Mean of a function with these values at the nodes, in DT over the steps from 1 on."""
    times = schedule.times
    if schedule.continuous:
        return float(np.trapezoid(values, times) / times[-1])
    return float(np.mean(np.interp(np.arange(1.0, times[-1] + 1), times, values)))


def make_objective(given: Any, horizon: float, *, continuous: bool = False) -> Objective:
    """Read ``objective``.

    Raises
    ------
    ValueError
        If it is no known name and no pair (times, values).
    """
    if isinstance(given, str):
        if given not in ("max", "final", "mean"):
            raise ValueError(f"`objective` must be 'max', 'final', 'mean' or a pair (times, values), got {given!r}.")
        return Objective(given, "scale" if given == "max" else given)
    if not isinstance(given, tuple | list):
        if callable(given):
            read_clearance(given, horizon, "objective")
        raise ValueError(f"`objective` must be 'max', 'final', 'mean' or a pair (times, values), got {given!r}.")
    return Objective(given, "scale", read_clearance(given, horizon, "objective", continuous=continuous))
