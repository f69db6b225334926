"""The proof over a chain of surfaces, one a phase: Theorem K8-CT with jumps of V at the gates.

Upper bounds: V >= 0 on all faces, V >= 0 where a path may not pass a gate, V >= min(V_next, 0) where it may. Lower
bounds: V <= 0 everywhere, V <= V_next where a path may pass; W bounds e^V at the end, and on faces at which the line is
only cut. The surfaces are shifted by what they miss, the last one first. A mean over the start takes the place of V's
extreme over it, and then the whole integral of q (of p) is paid.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from certbound.values.continuous.hypotheses import (
    NEGLIGIBLE,
    Model,
    Need,
    chained,
    examine,
    patched_of,
    raised_above,
    top_of,
    up,
)  # fmt: skip
from certbound.values.continuous.line.initial_law import Start
from certbound.values.continuous.line.joins import highest_inside, missing_lower, missing_upper
from certbound.values.continuous.line.phases import Gate, Phase
from certbound.values.continuous.payment import Payment, pay_lower, pay_upper
from certbound.values.continuous.surface import Surface

_LIFTS = (0.0, 0.003, 0.02, 0.1)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Link:
    """A phase, what holds at its end, its model, and the surface proposed for it."""

    phase: Phase
    gate: Gate
    model: Model
    surface: Surface

    @property
    def held(self) -> tuple[bool, bool]:
        """The ends of the surface that no path crosses."""
        nodes, phase = self.surface.axes[0], self.phase
        return phase.held[0] and nodes[0] == phase.low, phase.held[1] and nodes[-1] == phase.high


def spans(links: Sequence[Link], *, upper: bool) -> bool:
    """Whether every surface spans its phase, within the phase's box (upper) or around it (lower)."""
    for link in links:
        times, nodes, phase = link.surface.times, link.surface.axes[0], link.phase
        if times[0] != phase.start or times[-1] != phase.end:
            return False
        if upper and not (phase.low <= nodes[0] and nodes[-1] <= phase.high):
            return False
        if not upper and not (nodes[0] <= phase.low and phase.high <= nodes[-1]):
            return False
    return all(a.phase.end == b.phase.start for a, b in itertools.pairwise(links))


def raised_links(links: Sequence[Link]) -> list[Link]:
    """The chain with every surface raised by what it lacks; nothing where that is without bounds."""
    ready: list[Link] = []
    for link in reversed(links):
        after = ready[0] if ready else None
        surface = raised_above(link.surface, [link.held])
        missing = missing_upper(surface, link.phase, link.gate, (after.surface, after.phase) if after else None)
        if not math.isfinite(missing):
            return []
        ready.insert(0, replace(link, surface=surface.raised(up(missing)) if missing else surface))
    return ready


def prove_above(links: Sequence[Link], start: Start) -> Payment:
    """An upper bound of log P over a chain, whatever its surfaces are."""
    ready = raised_links(links)
    if not ready:
        return Payment(log=0.0)
    level = up(start.highest(ready[0].surface, ready[0].phase))
    need = Need(spare=NEGLIGIBLE / (links[-1].phase.end - links[0].phase.start), start=level, top=0.0)
    proofs = [examine(link.surface, link.model, need, upper=True) for link in ready]
    steps = np.concatenate([link.surface.steps for link in ready])
    floor = float(ready[-1].surface.range_at(-1)[0].min())
    best = Payment(log=0.0)
    for lift in _LIFTS:
        if level + lift >= best.log:
            break
        parts = [patched_of(proof, proof.ranges.residual_high, need, steps, lift) for proof in proofs]
        lowest = floor + lift - 1e-15 * (1 + abs(floor))
        joined = chained(parts, [link.surface for link in ready], need)
        payment = pay_upper(joined, up(level + lift), lowest, whole=start.random)
        best = min(best, replace(payment, lift=lift), key=lambda one: one.log)
    return best


def prove_below(links: Sequence[Link], start: Start) -> Payment | None:
    """A lower bound of log P over a chain, whatever its surfaces are; None where none is positive."""
    ready: list[Link] = []
    for link in reversed(links):
        surface, highest = link.surface, top_of(link.surface)
        if ready:
            missing = missing_lower(surface, link.phase, link.gate, ready[0].surface, ready[0].phase)
            highest = max(highest, missing)
        if not math.isfinite(highest):
            return None
        lowered = surface.raised(-highest - 1e-12 * (1 + highest)) if highest > 0 else surface
        ready.insert(0, replace(link, surface=lowered))
    level = start.lowest(ready[0].surface, ready[0].phase)
    if level == -math.inf:
        return None
    level = -up(-level)
    need = Need(spare=NEGLIGIBLE / (links[-1].phase.end - links[0].phase.start), start=level, top=np.inf)
    proofs = [examine(link.surface, link.model, need, upper=False) for link in ready]
    if any(np.any(proof.ranges.high > 0) for proof in proofs):
        return None
    steps = np.concatenate([link.surface.steps for link in ready])
    parts = [patched_of(proof, -proof.ranges.residual_low, need, steps) for proof in proofs]
    ceiling = highest_inside(ready[-1].surface, ready[-1].phase, ready[-1].gate)
    for link in ready:
        cut = [side for side in (0, 1) if not (link.phase.closed[side] or link.phase.held[side])]
        ends = [link.surface.face_range(0, side)[1] for side in cut]
        ceiling = max([ceiling, *ends])
    return pay_lower(chained(parts, [link.surface for link in ready], need), level, ceiling, whole=start.random)
