"""A problem linearised along nominal curves: the data of Thm K7, for a batch of cells of the initial set."""

from __future__ import annotations

import copy
from collections.abc import Callable
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np

from certbound.arrays import Array, Integers
from certbound.errors import EngineError
from certbound.gaussian.response import (
    LinearResponse,
    StepEvents,
    balanced,
    continuous_response,
    discrete_response,
)
from certbound.problem.model import Tape, compile_numpy, compile_scalar
from certbound.problem.noise import BoxLaw
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem, DiscreteSystem
from certbound.reach.linear.inclusion import Gathering, Supports, gathering_of
from certbound.reach.nominal import Cells, initial_cells
from certbound.reach.remainder import Frame, Remainder
from certbound.reach.sets import NominalPieces
from certbound.rigor.intervals import Interval
from certbound.watch import poll

FEWEST_PIECES, MOST_PIECES = 50, 2000
STEP, OWN_STEP = 0.1, 0.03
"""||J|| h of a piece: in the states' own units; and in those that balance J, where fewer pieces do."""
_LARGE = 40  # states
WINDOW, WINDOW_TURN, WINDOW_SPAN = 0.02, 0.1, 8.0
"""The martingale windows that bound rows which turn: their share of the horizon; ||J|| times their time in balanced
units, beyond which they know little of such a row; and in the states' own, since a window's transition matrix is
inverted."""


class Linearisation:
    """Thm K7 for one problem, on a grid of pieces, for a batch of cells of the initial set.

    Parameters
    ----------
    problem : Problem
        Additive noise (a constant diffusion matrix, or any discrete-time law).
    cells : int or Cells, optional
        Cells along each side of the initial set, or the cells themselves.
    pieces : int, optional
        Pieces of the horizon (continuous time).
    noise : bool
        False: the noise-free reachable set.
    """

    states: int | None = None  # how many tubes tell of, and on which pieces, where inputs are held
    lasting: Integers | slice = slice(None)

    def __init__(
        self, problem: Problem, *, cells: int | Cells | None = None, pieces: int | None = None, noise: bool = True,
    ) -> None:
        self.problem, self.noise = problem, noise
        self.correction: Array | None = None
        self.system = problem.system
        self.continuous = self.system.time == "continuous"
        self.n = self.system.dimension
        self.model = Remainder(problem)
        self.pieces = self._pieces(pieces)
        self.step = float(problem.horizon) / self.pieces if self.continuous else 1.0
        self.split = initial_cells(problem, cells)
        self.centres = np.asarray(self.split.centres)
        self.radii = np.asarray((self.split.boxes - self.centres).mag)
        random = noise and problem.initial.random
        self.start_covariance = (
            np.asarray(problem.initial.covariance) if random else np.zeros((self.n, self.n))
        )
        low, high = (
            (self.system.disturbance.low, self.system.disturbance.high)
            if self.system.disturbance is not None else (np.zeros(0), np.zeros(0))
        )
        self.d_low, self.d_high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
        self.d_middle = (self.d_low + self.d_high) / 2
        self.d_radius = np.maximum(self.d_high - self.d_middle, self.d_middle - self.d_low) * (1 + 1e-15)

    def _pieces(self, pieces: int | None) -> int:
        if not self.continuous:
            return int(self.problem.horizon)
        count = FEWEST_PIECES if pieces is None else pieces
        if self.problem.input_sequence is not None:
            rows = len(self.problem.input_sequence)
            count = rows * int(np.ceil(count / rows))
        return count

    @classmethod
    def of(cls, problem: Problem, *, cells: int | Cells | None = None, noise: bool = True) -> Linearisation:
        """The linearisation on a grid that resolves the nominal Jacobians: see ``STEP``."""
        if problem.system.time == "discrete":
            return cls(problem, cells=cells, noise=noise)
        trial = cls(problem, noise=noise)
        if problem.input_sequence is None:
            trial._refuse_stiff()
        while trial.lost and 4 * trial.pieces <= MOST_PIECES:  # a coarse grid loses a stiff system's nominal at once
            trial = cls(problem, pieces=4 * trial.pieces, noise=noise)
        slopes = np.nan_to_num(trial.slopes[0])
        own, whole = (float(np.linalg.norm(found, axis=(-2, -1)).max()) for found in (balanced(slopes), slopes))
        wanted = problem.horizon * min(whole / STEP, own / OWN_STEP)
        pieces = int(np.clip(np.ceil(wanted), FEWEST_PIECES, MOST_PIECES))
        alike = (cells is None or cells == 1) and trial._pieces(pieces) == trial.pieces
        return trial if alike else cls(problem, cells=cells, pieces=pieces, noise=noise)

    # ---- nominal data ------------------------------------------------------------------------------------

    @property
    def cells(self) -> int:
        """Number B of cells of the initial set."""
        return len(self.centres)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells, pieces and states: (B, N, n)."""
        return self.cells, self.pieces, self.n

    @cached_property
    def inputs(self) -> Array:
        """Input of every piece: shape (N, m)."""
        sequence = self.problem.input_sequence
        if sequence is None:
            return np.zeros((self.pieces, 0))
        return np.repeat(sequence, self.pieces // len(sequence), axis=0)

    @cached_property
    def times(self) -> Array:
        """Nodes."""
        return np.asarray(np.arange(self.pieces + 1) * self.step, dtype=float)

    def _evaluate(self, k: int, time: float, state: Array) -> Array:
        run, slopes = compile_scalar(self.problem.closed_loop), np.empty(state.shape)
        for place, value in enumerate(run(np.float64(time), *state.T, *self.inputs[k], *self.d_middle)):
            slopes[:, place] = value
        return slopes

    @cached_property
    def _compiled(self) -> Callable[..., Array]:
        return compile_numpy(self.problem.closed_loop)

    @cached_property
    def lost(self) -> bool:
        """Whether the nominal overflows on this grid."""
        return not bool(np.isfinite(self._followed).all())

    @cached_property
    def _followed(self) -> Array:
        """The nominal states, finite or not."""
        states = [x := np.array(self.centres)]
        with np.errstate(all="ignore"):
            for k in range(self.pieces):
                poll("nominal trajectory")
                x = self._advance(k, x) if self.continuous else self._evaluate(k, float(k), x)
                states.append(x)
        return np.stack(states, axis=1)

    @cached_property
    def nodes(self) -> Array:
        """Nominal states at the nodes: shape (B, N + 1, n)."""
        nodes, lost = self._followed, ~np.isfinite(self._followed).all(axis=(0, 2))
        if lost.any():
            last, sizes = int(np.argmax(lost)) - 1, np.abs(nodes).max(axis=(0, 2))
            with np.errstate(over="ignore"):
                while last > 0 and sizes[last] > 100 * (1 + sizes[last - 1]):  # finite, but no longer meant
                    last -= 1
            raise EngineError(
                f"the noise-free trajectory is lost after t = {last * self.step:.4g}, before the horizon "
                f"{self.problem.horizon:g}; shorten the horizon, or check the model there."
            )
        return nodes

    def _advance(self, k: int, x: Array) -> Array:
        """Two steps of the classical Runge-Kutta method."""
        h = self.step / 2
        for t in (self.times[k], self.times[k] + h):
            k1 = self._evaluate(k, t, x)
            k2 = self._evaluate(k, t + h / 2, x + h / 2 * k1)
            k3 = self._evaluate(k, t + h / 2, x + h / 2 * k2)
            k4 = self._evaluate(k, t + h, x + h * k3)
            x = x + h / 6 * (k1 + 2 * (k2 + k3) + k4)
        return x

    def _refuse_stiff(self) -> None:
        """EngineError, before anything is followed, where the first piece would be refused on the finest grid."""
        slope = self.model.reference_slope(self.times[:1], self.centres[:1], self.inputs[:1], self.d_middle)
        slope, silent = np.nan_to_num(slope)[None], np.zeros((self.n, self.n))
        step = float(self.problem.horizon) / MOST_PIECES
        continuous_response(slope, np.zeros_like(slope), step, silent, silent)

    @cached_property
    def controls(self) -> Array:
        """Bezier points of the nominal curve (CT, shape (B, N, 4, n)) or its nodes (DT, (B, N + 1, 1, n))."""
        x = self.nodes
        if not self.continuous:
            return x[:, :, None, :]
        start, end = (
            self._compiled(t, *np.moveaxis(ends, -1, 0), *self.inputs.T, *self.d_middle)
            for t, ends in ((self.times[:-1], x[:, :-1]), (self.times[1:], x[:, 1:])))
        third = self.step / 3
        return np.stack([x[:, :-1], x[:, :-1] + third * start, x[:, 1:] - third * end, x[:, 1:]], axis=2)

    def nominal(self, cell: int) -> NominalPieces:
        """The nominal curve of one cell, with about the spread of the noise and of the initial set along it."""
        count = len(self.controls[cell])
        extent, reached = np.empty((count, self.n)), np.diag(self.radii[cell])
        for k in range(count):
            extent[k] = np.abs(reached).sum(axis=1)
            reached = self.response.transition[cell, min(k, self.pieces - 1)] @ reached
        covariance = self.response.covariance[cell, self.continuous :][:count]
        return NominalPieces(
            times=self.times, controls=self.controls[cell], continuous=self.continuous, covariance=covariance,
            extent=extent,
        )  # fmt: skip

    def on_grid(self, pieces: int) -> Linearisation:
        """The same cells and correction on another grid of pieces (continuous time)."""
        other = Linearisation(self.problem, cells=self.split, pieces=pieces, noise=self.noise)
        if self.correction is None:
            return other
        place = np.clip(other.times / self.step, 0.0, self.pieces)
        left = np.minimum(place.astype(int), self.pieces - 1)
        weight = (place - left)[:, None, None]
        return other.corrected((1 - weight) * self.correction[:, left] + weight * self.correction[:, left + 1])

    def corrected(self, correction: Array) -> Linearisation:
        """The same with ``correction`` added to the slope: (B, N + 1, n, n) at the nodes, linear in between.

        In discrete time the last node counts for nothing.
        """
        other = copy.copy(self)
        for name in ("slopes", "response", "frame", "gathering", "sizes", "window"):
            vars(other).pop(name, None)
        other.correction = correction
        return other

    def fitted(self, found: Array) -> Linearisation:
        """The same with what the pieces' slopes lack, (B, N, n, n), added at the nodes."""
        ends = np.concatenate([found, found[:, -1:]], axis=1)
        ends[:, 1:-1] = (found[:, 1:] + found[:, :-1]) / 2 if self.continuous else found[:, 1:]
        return self.corrected(ends if self.correction is None else self.correction + ends)

    @cached_property
    def slopes(self) -> tuple[Array, Array, Array]:
        """A, K and E of every piece: shapes (B, N, n, n), (B, N, n, n), (B, N, n, q)."""
        first, drift, gain = self.tangents
        extra = self.correction
        if extra is None:
            return first, drift, gain
        if not self.continuous:
            return first + extra[:, :-1], drift, gain
        return first + extra[:, :-1], drift + (extra[:, 1:] - extra[:, :-1]) / self.step, gain

    @cached_property
    def tangents(self) -> tuple[Array, Array, Array]:
        """The same without the correction: derivatives along the nominal curve."""
        cells, x = self.cells, self.nodes
        inputs = np.broadcast_to(self.inputs, (cells, *self.inputs.shape))

        def at(nodes: Array, times: Array) -> Array:
            shape = nodes.shape[:2]
            value = self.model.reference_slope(
                np.broadcast_to(times, shape).ravel(), nodes.reshape(-1, self.n),
                inputs.reshape(cells * self.pieces, -1), self.d_middle,
            )
            return value.reshape(*shape, self.n, self.n)

        first = at(x[:, :-1], self.times[:-1])
        gain = self.model.reference_gain(
            np.broadcast_to(self.times[:-1], (cells, self.pieces)).ravel(), x[:, :-1].reshape(-1, self.n),
            inputs.reshape(cells * self.pieces, -1), self.d_middle,
        ).reshape(cells, self.pieces, self.n, len(self.d_middle))
        if not self.continuous:
            return first, np.zeros_like(first), gain
        last = at(x[:, 1:], self.times[1:])
        return first, (last - first) / self.step, gain

    @property
    def slope_error(self) -> float:
        """Entrywise bound of |Jhat - its floats|: the model's constant entries need not be floats."""
        return float(self.model.constant_slope.rad.max(initial=0.0))

    @cached_property
    def diffusion(self) -> Array:
        """g of a continuous-time problem (0 without noise); along the nominal, (B, N, n, m), where it is a function."""
        assert isinstance(self.system, ContinuousSystem)
        g = self.system.diffusion
        if isinstance(g, Tape):
            shape = (self.cells, self.pieces, *g.shape)
            middle = (self.nodes[:, :-1] + self.nodes[:, 1:]) / 2
            time = np.broadcast_to((self.times[:-1] + self.times[1:]) / 2, shape[:2])
            with np.errstate(all="ignore"):
                g = np.broadcast_to(compile_numpy(g)(time, *np.moveaxis(middle, -1, 0)), shape)
            g = np.where(np.isfinite(g), g, 0.0)
        return np.asarray(g, dtype=float) * (1.0 if self.noise else 0.0)

    @cached_property
    def response(self) -> LinearResponse:
        """Linear data of all cells."""
        slope, drift, _ = self.slopes
        start = self.start_covariance
        if isinstance(self.system, ContinuousSystem):
            return continuous_response(slope, drift, self.step, self.diffusion, start,
                                       slope_error=self.slope_error, start_error=self.split.start_error)
        g = np.asarray(self.system.noise_matrix, dtype=float)
        proxy = np.asarray(self.system.noise.proxy, dtype=float) * (1.0 if self.noise else 0.0)
        covariance = g @ proxy @ g.T
        covariance = (covariance + covariance.T) / 2
        bound = 8 * (len(proxy) + 2) * 2.0**-53 * float((np.abs(g) @ np.abs(proxy) @ np.abs(g).T).max(initial=0.0))
        return discrete_response(
            slope, covariance, bound, start, slope_error=self.slope_error, start_error=self.split.start_error)

    def step_events(self, cell: int) -> StepEvents:
        """Scalar events of one cell in discrete time."""
        assert isinstance(self.system, DiscreteSystem)
        law = self.system.noise
        still = isinstance(law, BoxLaw) and not np.any(self.start_covariance)
        bounded = (self.system.noise_matrix, law.bound) if still and law.bound is not None else None
        return StepEvents(self.response, cell, bool(law.gaussian), bounded)

    @property
    def _slope_slack(self) -> Interval:
        return self.model.constant_slope - self.model.constant_slope.mid

    @cached_property
    def frame(self) -> Frame:
        """Enclosures of the nominal data, cells and pieces in one batch (piece index fastest)."""
        slope, drift, gain = self.slopes
        cells, pieces, n = self.shape

        def flat(a: Array) -> Array:
            return a.reshape(cells * pieces, *a.shape[2:])

        if self.continuous:
            c = [Interval.point(flat(self.controls[:, :, i])) for i in range(4)]
            h = Interval(np.nextafter(self.step, 0), np.nextafter(self.step, np.inf))
            middle = (c[0] + 3.0 * (c[1] + c[2]) + c[3]) / 8.0
            spread = np.max([(p - middle).mag for p in c], axis=0)
            velocities = [3.0 * (c[i + 1] - c[i]) / h for i in range(3)]
            accelerations = [6.0 * (c[i + 2] - 2.0 * c[i + 1] + c[i]) / (h * h) for i in range(2)]
            jerk = 6.0 * (c[3] - c[0] + 3.0 * (c[1] - c[2])) / (h * h * h)
            velocity = velocities[0].hull(velocities[1]).hull(velocities[2])
            middle_velocity = (velocities[0] + 2.0 * velocities[1] + velocities[2]) / 4.0
            acceleration = accelerations[0].hull(accelerations[1])
            middle_acceleration = (accelerations[0] + accelerations[1]) / 2.0
            half = float(np.nextafter(h.hi / 2, np.inf))
            middle_slope = Interval.point(flat(slope)) + (h * 0.5) * flat(drift) + self._slope_slack
            slip = 8e-16 * float(self.problem.horizon)
            middles = np.tile((self.times[:-1] + self.times[1:]) / 2, cells)
            time = Interval.around(middles, np.full(cells * pieces, slip))
            span = Interval(time.lo - half - slip, time.hi + half + slip)
        else:
            zero = np.zeros((cells * pieces, n))
            middle = Interval.point(flat(self.nodes[:, :-1]))
            middle_velocity = Interval.point(flat(self.nodes[:, 1:]))
            velocity = acceleration = middle_acceleration = jerk = Interval.point(zero)
            spread, half = zero, 0.0
            middle_slope = Interval.point(flat(slope)) + self._slope_slack
            time = span = Interval.point(np.tile(self.times[:-1], cells))
        return Frame(
            half=half, middle_time=time, span=span, middle=middle, spread=spread, middle_velocity=middle_velocity,
            velocity=velocity, middle_acceleration=middle_acceleration, acceleration=acceleration, jerk=jerk,
            slope=middle_slope, drift=flat(drift), input_gain=flat(gain),
            inputs=np.tile(self.inputs, (cells, 1)), disturbance_middle=self.d_middle,
            disturbance_low=self.d_low, disturbance_high=self.d_high, **self._beside,
        )

    @property
    def _beside(self) -> dict[str, Any]:
        """What a frame holds of rows that do not change just at the ends of their pieces."""
        changes, count = self.problem.changes, self.pieces
        if changes is None:
            return {}
        horizon, rows = Fraction(self.problem.horizon), len(changes) - 1
        ends = [horizon * edge / rows for edge in range(rows + 1)]
        missed = [max(one.last, end) - min(one.first, end) for one, end in zip(changes, ends)]
        if not any(missed):
            return {}
        low, high, own = self.inputs.copy(), self.inputs.copy(), len(changes[0].low)
        for edge, (change, miss) in enumerate(zip(changes, missed)):
            place = edge * (count // rows)
            for piece in (place - 1, place):
                if miss and 0 <= piece < count:
                    low[piece, :own] = np.minimum(low[piece, :own], change.low)
                    high[piece, :own] = np.maximum(high[piece, :own], change.high)
        beside = Interval(np.tile(low, (self.cells, 1)), np.tile(high, (self.cells, 1)))
        return {"beside": beside, "part": float(2 * max(missed) * count / horizon) * (1 + 1e-12)}

    @cached_property
    def sizes(self) -> Array:
        """A typical size of every state, (n,): of the nominal, the initial set and the noise; always positive."""
        variance = np.diagonal(self.response.covariance, axis1=-2, axis2=-1).max(axis=(0, 1))
        deviation = np.sqrt(np.maximum(np.where(np.isfinite(variance), variance, 0.0), 0.0))
        found = np.abs(self.nodes).max(axis=(0, 1)) + self.radii.max(axis=0) + deviation
        return np.asarray(np.maximum(found, max(1e-6 * float(found.max()), 1e-100)))

    @property
    def remainder_sizes(self) -> Array:
        """The same for the dynamics: in continuous time a tenth of the size in the time of a piece."""
        return self.sizes * (0.1 / self.step if self.continuous else 1.0)

    @cached_property
    def window(self) -> int:
        """Pieces of a martingale window."""
        slope = np.nan_to_num(self.slopes[0], nan=0.0, posinf=0.0, neginf=0.0)
        own, whole = (
            max(float(np.abs(found).sum(axis=-1).max()) * self.step, 1e-9) for found in (balanced(slope), slope)
        )
        return max(1, min(round(WINDOW * self.pieces), int(WINDOW_TURN / own), int(WINDOW_SPAN / whole)))

    # ---- supports ----------------------------------------------------------------------------------------

    @cached_property
    def gathering(self) -> Gathering:
        """How a disturbance and a remainder on one piece reach its end."""
        slope, _, gain = self.slopes
        return gathering_of(self.response, slope, gain, self.d_radius, continuous=self.continuous)

    def supports(self, cell: int, rows: Array, outputs: Integers | None = None) -> Supports:
        """Bounds of y and R of one cell along ``rows``; see `Supports`."""
        radii, own = self.radii[cell], self.split.generators
        generators = np.diag(radii)[radii > 0] if own is None else own[cell]
        return Supports(
            self.response, self.gathering.of_cell(cell), cell, rows, generators,
            continuous=self.continuous, outputs=outputs,
        )

    @cached_property
    def moved(self) -> Integers | None:
        """States that the remainder or a disturbance moves by more than a rounding error; None for all."""
        if self.continuous or self.n < _LARGE:
            return None
        found = {i for i, _ in self.model.entries} | set(np.flatnonzero((self.slopes[2] != 0).any(axis=(0, 1, 3))))
        return np.array(sorted(found), dtype=np.int64)
