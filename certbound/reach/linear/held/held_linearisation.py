"""The linear response where inputs are computed at sampling times and held: a linear model with jumps.

The state is z = (x, u). Every hold is cut into equal pieces, on which u rests, and before the first of them stands a
piece without any length: the sampling time, at which z jumps to (x, k(t, x)). Its transition matrix is that of the
linearised law, it has no noise, and what the law leaves over is a remainder as on every other piece, divided by the
pieces' step. Bounds over such a piece hold before the jump, after it, and in between; rows along which the noise is
bounded read what is there after it, which for the states x is the same.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from certbound.arrays import Array, Integers
from certbound.gaussian.response import Jumps, LinearResponse, balanced, continuous_response
from certbound.problem.held import HeldLoop
from certbound.problem.model import compile_numpy
from certbound.reach.linear.linearisation import FEWEST_PIECES, MOST_PIECES, OWN_STEP, STEP, Linearisation
from certbound.reach.nominal import Cells, initial_cells
from certbound.reach.remainder import Frame, HeldFrame, HeldRemainder, Remainder
from certbound.rigor.intervals import Interval

_FEWEST = 200
"""Pieces between sampling times, at least: so many windows are needed."""
_WINDOW = 0.005
"""Share of the horizon."""


class HeldLinearisation(Linearisation):
    """`Linearisation` of a `HeldLoop`, in the states (x, u).

    ``pieces`` asks for at least so many between sampling times; sampling times are pieces too.
    """

    model: HeldRemainder  # type: ignore[assignment]  # the same questions, asked of two remainders

    def __init__(
        self, loop: HeldLoop, *, cells: int | Cells | None = None, pieces: int | None = None, noise: bool = True,
    ) -> None:
        self.loop, self.states = loop, loop.plain.system.dimension
        super().__init__(loop.flow, cells=_raised(loop, cells), pieces=pieces, noise=noise)
        self.step = float(loop.flow.horizon) / (loop.count * self.parts)
        self.lasting = self.flowing
        self.model = HeldRemainder(flow=Remainder(loop.flow), sample=Remainder(loop.sample))

    def _pieces(self, pieces: int | None) -> int:
        self.parts = int(np.ceil(max(_FEWEST, pieces or 0) / self.loop.count))
        return self.loop.count * (self.parts + 1)

    @classmethod
    def of_loop(cls, loop: HeldLoop, *, cells: int | None = None, noise: bool = True) -> HeldLinearisation:
        """The linearisation on a grid that resolves the nominal Jacobians."""
        trial = cls(loop, noise=noise)
        while trial.lost and 4 * trial.pieces <= MOST_PIECES:
            trial = cls(loop, pieces=4 * trial.pieces, noise=noise)
        slopes = np.nan_to_num(trial.slopes[0])
        own, whole = (float(np.linalg.norm(found, axis=(-2, -1)).max()) for found in (balanced(slopes), slopes))
        wanted = loop.flow.horizon * min(whole / STEP, own / OWN_STEP)
        return cls(loop, cells=cells, pieces=int(np.clip(np.ceil(wanted), FEWEST_PIECES, MOST_PIECES)), noise=noise)

    def on_grid(self, pieces: int) -> HeldLinearisation:
        """The same cells and correction on another grid of pieces."""
        other = HeldLinearisation(self.loop, cells=self.split, pieces=pieces, noise=self.noise)
        if self.correction is None:
            return other
        found = np.empty((self.cells, other.pieces, self.n, self.n))
        found[:, other.sampling] = self.correction[:, self.sampling]
        hold, part = np.divmod(np.arange(other.loop.count * other.parts), other.parts)
        same = hold * self.parts + part * self.parts // other.parts
        found[:, other.flowing] = self.correction[:, self.flowing[same]]
        return other.fitted(found)

    def fitted(self, found: Array) -> HeldLinearisation:
        """The same with ``found`` (B, N, n, n) added to the slopes of the pieces and of the sampling times."""
        other = self.corrected(found if self.correction is None else self.correction + found)
        assert isinstance(other, HeldLinearisation)
        vars(other).pop("jumps", None)
        vars(other).pop("diffusion", None)
        return other

    @cached_property
    def slopes(self) -> tuple[Array, Array, Array]:
        """A, K and E of every piece."""
        first, drift, gain = self.tangents
        if self.correction is None:
            return first, drift, gain
        extra = self.correction.copy()
        extra[:, self.sampling] = 0.0
        return first + extra, drift, gain

    @property
    def window(self) -> int:
        """Pieces of a martingale window: what is held makes rows turn, so that these are short."""
        return max(1, min(round(_WINDOW * self.loop.count * self.parts), self.parts // 2))

    @cached_property
    def sampling(self) -> Integers:
        """The pieces that are sampling times."""
        return np.arange(0, self.pieces, self.parts + 1)

    @cached_property
    def flowing(self) -> Integers:
        """All others."""
        return np.setdiff1d(np.arange(self.pieces), self.sampling)

    @cached_property
    def times(self) -> Array:
        """Nodes; a sampling time has two."""
        hold, part = np.divmod(np.arange(self.pieces), self.parts + 1)
        count = np.append(hold * self.parts + np.maximum(part - 1, 0), self.loop.count * self.parts)
        return np.asarray(count * self.step, dtype=float)

    def _advance(self, k: int, x: Array) -> Array:
        if k % (self.parts + 1):
            return super()._advance(k, x)
        return np.asarray(compile_numpy(self.loop.sample.closed_loop)(self.times[k], *x.T), dtype=float)

    @cached_property
    def controls(self) -> Array:
        """Bezier points of the nominal curve, (B, N, 4, n): a chord at sampling times."""
        controls = np.array(super().controls)
        own = controls[:, self.sampling]
        chord = np.linspace(own[:, :, 0], own[:, :, 3], 4, axis=2)
        controls[:, self.sampling, 1:3] = chord[:, :, 1:3]
        return controls

    @cached_property
    def tangents(self) -> tuple[Array, Array, Array]:
        """A, K and E of every piece along the nominal; 0 at sampling times."""
        found = tuple(np.array(part) for part in super().tangents)
        for part in found:
            part[:, self.sampling] = 0.0
        return found[0], found[1], found[2]

    @cached_property
    def jumps(self) -> Array:
        """Slopes of what sampling times do: (B, J, n, n)."""
        cells, count = self.cells, len(self.sampling)
        nodes = self.nodes[:, self.sampling].reshape(cells * count, self.n)
        times = np.tile(self.times[self.sampling], cells)
        found = self.model.sample.reference_slope(times, nodes, np.zeros((len(nodes), 0)), np.zeros(0))
        found = found.reshape(cells, count, self.n, self.n)
        return found if self.correction is None else found + self.correction[:, self.sampling]

    @property
    def jumping(self) -> list[tuple[int, int]]:
        """Entries of these slopes that depend on t or the states."""
        return self.model.sample.entries

    @cached_property
    def diffusion(self) -> Array:
        """g on every piece, (B, N, n, m): there is no noise at sampling times."""
        plain = np.asarray(super().diffusion)
        found = np.broadcast_to(plain, (self.cells, self.pieces, *plain.shape)).copy()
        found[:, self.sampling] = 0.0
        return found

    @cached_property
    def response(self) -> LinearResponse:
        """Linear data of all cells."""
        slope, drift, _ = self.slopes
        jumps = Jumps(places=tuple(self.sampling.tolist()), matrices=self.jumps, error=self.slope_error)
        return continuous_response(
            slope, drift, self.step, self.diffusion, self.start_covariance, slope_error=self.slope_error, jumps=jumps
        )

    @cached_property
    def frame(self) -> HeldFrame:  # type: ignore[override]  # of two kinds of pieces
        """Enclosures of the nominal data."""
        offset = self.pieces * np.arange(self.cells)[:, None]
        flowing, sampling = ((offset + own).ravel() for own in (self.flowing, self.sampling))
        return HeldFrame(
            flow=super().frame.taken(flowing), flowing=flowing, sample=self._at_samples(), sampling=sampling,
            step=self.step,
        )

    def _at_samples(self) -> Frame:
        n, none = self.n, np.zeros(0)
        before, after = (self.nodes[:, self.sampling + shift].reshape(-1, n) for shift in (0, 1))
        zero = np.zeros(before.shape)
        rest = Interval.point(zero)
        slope = self.jumps.reshape(-1, n, n)
        exact = self.model.sample.constant_slope
        slip = np.full(len(before), 8e-16 * float(self.problem.horizon))
        time = Interval.around(np.tile(self.times[self.sampling], self.cells), slip)
        return Frame(
            half=0.0, middle_time=time, span=time, middle=Interval.point(before), spread=zero,
            middle_velocity=Interval.point(after), velocity=rest, middle_acceleration=rest, acceleration=rest,
            jerk=rest, slope=Interval.point(slope) + (exact - exact.mid), drift=np.zeros(slope.shape),
            input_gain=np.zeros((len(before), n, 0)), inputs=np.zeros((len(before), 0)), disturbance_middle=none,
            disturbance_low=none, disturbance_high=none,
        )


def _raised(loop: HeldLoop, cells: int | Cells | None) -> Cells:
    """The cells of the initial set, with held inputs of 0."""
    if isinstance(cells, Cells):
        return cells
    plain = initial_cells(loop.plain, cells)
    nothing = np.zeros((len(plain.centres), loop.held))
    low, high = (np.concatenate([ends, nothing], axis=1) for ends in (plain.boxes.lo, plain.boxes.hi))
    return Cells(centres=np.concatenate([plain.centres, nothing], axis=1), boxes=Interval(low, high))
