"""The linear-response proof as data where the noise depends on the state (Thm K7 for g(t, x)).

The search of `certbound.reach.linear.diffusion` is run again with events that the checker knows (windows for Z), on its
grid, with room to spare: the set H of states, over which g - ghat is bounded, and the boxes of the remainder are
widened until what follows from both lies inside both with a margin.
"""

from __future__ import annotations

import math

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertificateError
from certbound.gaussian.response import MartingaleEvent, SplitEvents, WindowEvents, logsumexp
from certbound.problem.problem import Problem
from certbound.reach.linear import Accepted, DiffusionRun, Reference, Share, depends_on_state
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.safety.certificates.linear import (
    EFFORTS,
    PADS,
    SLACK,
    Stated,
    engine_of,
    grids,
    linear_proof,
    proof_data,
    widened,
)
from certbound.safety.certificates.parts import in_time_pieces

_ROUNDS = 10
_WIDER = 0.03  # H beyond what it must hold, the first time
_INSIDE = 0.005  # what must be left of that in the end
_LARGER = 1 + 1e-6  # the checker's own kappas differ by rounding
_MOVED = 1.005  # its directions differ within a window
_LOG10 = math.log(10.0)
_ALL = 1e3


@in_time_pieces
def response_proof(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The linear response as data: `diffusion_proof` where the noise depends on the state, else `linear_proof`."""
    write = diffusion_proof if depends_on_state(problem) else linear_proof
    return write(problem, answer, attempt)


def diffusion_proof(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The proof's data, the claimed log10 of the probability, and no assumptions beyond the checker's own.

    CertificateError where the state leaves every set over which its noise was bounded.
    """
    effort = min(attempt, EFFORTS - 1)
    found = answer.details
    engine = engine_of(answer)
    target = Share.of(problem.delta)
    shares = list(dict.fromkeys([found.outcome.nonlinear, found.shown.nonlinear, target.stated()]))
    best: tuple[_StatedRun, Stated] | None = None
    for grid in grids(engine, effort):
        run = _StatedRun(grid)
        for share in shares:
            for reference in run.references:
                stated = next((s for pad in PADS[effort] if (s := run.stated(reference, share, pad)) is not None), None)
                if stated is not None and (best is None or stated.log_probability < best[1].log_probability):
                    best = run, stated
            if best is not None and best[1].log_probability <= target.log:
                break
        if best is not None:
            break
    if best is None:
        raise CertificateError("the state leaves every set over which its noise was bounded for the checker.")
    log10 = best[1].log_probability / _LOG10
    return proof_data(problem, *best), min(log10 + SLACK * (1 + 0.1 * abs(log10)), 0.0), []


class _StatedRun(DiffusionRun):
    """`DiffusionRun` with windows as the only events of Z."""

    def _events_of(self, windows: WindowEvents, cell: int) -> WindowEvents:
        return windows

    def stated(self, reference: Reference, nonlinear: Share, pad: float) -> Stated | None:
        """Sets H and boxes of the remainder that hold, with a margin, what follows from them; None: none was found."""
        found = self._close(reference, nonlinear, 2)
        if found is None:
            return None
        self.held = found[0]
        count = len(self.engine.model.active)
        levels, _ = self.levels(nonlinear)
        reached = self.deviations(levels * _MOVED, *found[1])
        if reached is None:
            return None
        low, high = _wider(reached[0][:, :count], reached[1][:, :count], _WIDER)
        for _ in range(_ROUNDS):
            excess = self.excess(reference, low, high)
            if excess is None:
                return None
            self.held = Accepted(reference=reference, excess=excess)
            levels, events = self.levels(nonlinear)
            levels = levels * _MOVED + 1e-280
            bounds = self.include(levels, 2) if np.isfinite(levels).all() else None
            boxes = None if bounds is None else widened(self, levels, bounds, pad)
            reached = None if boxes is None else self.deviations(levels, *boxes)
            if boxes is None or reached is None:
                return None
            needed = _wider(reached[0][:, :count], reached[1][:, :count], _INSIDE)
            if np.all((needed[0] >= low) & (needed[1] <= high)):
                return self._stated(levels, boxes, events, nonlinear, (low, high))
            wider = _wider(reached[0][:, :count], reached[1][:, :count], _WIDER)
            low, high = np.minimum(low, wider[0]), np.maximum(high, wider[1])
        return None

    def _stated(
        self, levels: Array, bounds: tuple[Array, Array], events: list[SplitEvents], nonlinear: Share,
        held: tuple[Array, Array],
    ) -> Stated:
        """The proof's numbers and what they prove: the levels cost exp(nonlinear.log) at most."""
        cells, pieces, count = self.rows.shape[:3]
        share = nonlinear.side(count, terms=2)
        gaussian = np.zeros((cells, pieces, count))
        stopped, worst = [], -np.inf
        for cell, own in enumerate(events):
            rows = [own.martingales.along(self.rows[cell, :, d]) for d in range(count)]
            for d in range(count):
                gaussian[cell, :, d] = self._gaussian_level(own, cell, d, share)
            rooms = self.rooms(cell, bounds)
            asked, granted = [], []
            for i, requirement in enumerate(self.requirements[cell]):
                event = own.along(requirement.rows)
                log, part = event.split(rooms[:, i])
                asked.append(log)
                granted.append(_factors(event.martingale, part))
            worst = max(worst, logsumexp(np.array([nonlinear.log, *asked])))
            part_low, part_high = (x[cell * pieces : (cell + 1) * pieces] for x in held)
            random = self.engine.problem.initial.random
            silent = self.held.reference is self.references[1] and not random
            stopped.append({
                "windows": [int(k) for k in own.martingales.frame.starts],
                "reference": None if self.held.reference is self.references[1]
                else exact(self.held.reference.value[cell]),
                "low": exact(part_low), "high": exact(part_high),
                "coordinates": exact(float(own.martingales.factor * _LARGER)),
                "rows": exact([_factors(event, share.log) for event in rows]),
                "rooms": None if silent else exact(granted),
            })  # fmt: skip
        zeros = np.zeros((1, self.engine.n))
        parts = [own.gaussian for own in events]
        levels_of = [part.coordinate_levels if isinstance(part, WindowEvents) else zeros for part in parts]
        return Stated(
            levels=levels, bounds=bounds, events=[self._windows_of(own, cell) for cell, own in enumerate(events)],
            log_probability=float(min(worst, 0.0)), gaussian=gaussian, window_levels=levels_of, stopped=stopped,
        )

    def _windows_of(self, own: SplitEvents, cell: int) -> WindowEvents:
        """Windows of Z; a single one where Z = 0."""
        if isinstance(own.gaussian, WindowEvents):
            return own.gaussian
        return WindowEvents(self.held.reference.response, cell, self.engine.pieces, -1.0)


def _wider(low: Array, high: Array, share: float) -> tuple[Array, Array]:
    room = share * (high - low) + 1e-12 * (high - low).max(axis=0)
    return low - room, high + room


def _factors(event: MartingaleEvent, granted: float) -> list[float]:
    """Levels of M in units of kappa that cost exp(granted), window by window."""
    factor = event.factor(granted) * _LARGER if granted < 0 else _ALL
    return [float(factor)] * len(event.kappa)
