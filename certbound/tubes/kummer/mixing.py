"""Mixture tubes and mixture probabilities: which program to solve, and the certificate of its answer."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from flint import arb

from certbound.arrays import Array, Index
from certbound.errors import InfeasibleError
from certbound.rigor.balls import precision, upper
from certbound.tubes.kummer.mixture import Component, MixtureProfile, MixtureProgram
from certbound.tubes.objective import Clearance
from certbound.tubes.question import Question
from certbound.tubes.schedule import Schedule
from certbound.tubes.tube import Tube

Pair = tuple[float, float, bool]

_ALL_STEPS = 400


def _rows(cut: Schedule) -> Schedule:
    """One piece per row of the program: every step in DT (up to 400), graded intervals in CT."""
    if not cut.continuous and cut.horizon <= _ALL_STEPS:
        return cut.refined(np.arange(1.0, cut.horizon))
    return cut.graded(256)


def _radii(data: Schedule, clearance: Clearance) -> Array:
    """Clearance of each piece; in DT a piece holds the steps after its start."""
    return clearance.at(data.times[:-1]) if data.continuous else clearance.at(data.times[1:])


def _dictionary(data: Schedule, best: list[Pair]) -> tuple[list[Pair], Index]:
    """Pairs around the best single ones and on a grid, and the candidate ends."""
    count = len(data.lengths)
    cap = math.inf if data.any_power else data.nu / 2
    gain, variance = data.nodes
    finite = np.isfinite(variance) & np.isfinite(gain)
    reference = float(np.max(variance[finite] / np.maximum(gain[finite], 1.0)))
    small = count > 64 and not data.continuous
    powers = [0.0, 0.5, 4.0, 40.0] if small else [0.0, 0.15, 0.5, 1.5, 6.0, 30.0, 300.0]
    spreads = [-2.5, -1.2, -0.4, 0.0, 0.5, 1.5] if small else [-3.0, -2.0, -1.3, -0.8, -0.4, -0.15, 0.05, 0.3, 0.8, 2.0]
    pairs: list[Pair] = [(a, reference * 10**s, False) for a in powers if a < cap for s in spreads]
    if data.any_power:
        pairs += [(k, 0.0, True) for k in (0.5, 2.0, 4.0, 6.0, 8.0, 10.0, 13.0, 17.0, 25.0)]
    if data.continuous or count > 120:
        ends = np.unique(np.linspace(count // 8, count, 9).astype(np.intp))[1:]
    else:
        ends = np.arange(1, count + 1, dtype=np.intp)
    return [*best, *pairs], ends


def mixture_tube(question: Question, delta: float, *, seed: Tube) -> Tube:
    """The tube of Thm K3 whose shape is the objective's clearance (the seed's radii for ``final`` and ``mean``).

    Raises
    ------
    InfeasibleError
        If no mixture of the asked level was found.
    """
    goal = question.goal
    data = _rows(question.cut)
    if goal.kind != "scale":
        shape = np.asarray(seed.radius(data.times[1:]), dtype=float)
        first = 1.0
    else:
        shape = np.ones(len(data.lengths)) if goal.clearance is None else _radii(data, goal.clearance)
        at = seed.bound(data.times[:-1] if data.continuous else data.times[1:], data.times[1:])
        first = float(np.max(at / shape))
    pairs, ends = _dictionary(data, _seed_pairs(seed, data))
    program = MixtureProgram(schedule=data, clearance=shape, ends=ends)
    scale, components = _least_scale(program, pairs, delta, first)
    total = sum(component.weight for component in components)
    shares = tuple(replace(c, weight=c.weight * (delta / total) * (1 - 1e-12)) for c in components)
    profile = MixtureProfile(schedule=data, components=shares, aims=scale * shape / data.unit)
    if not profile.level() <= delta:
        raise InfeasibleError(f"the mixture's weights sum to {profile.level():.6g} > delta = {delta:g}; use 'kummer'.")
    parameters = {
        "scale": scale,
        "components": [
            {"a": c.a, "v0": c.v0 * data.unit**2, "end": c.end, "bessel": c.bessel, "share": c.weight / delta}
            for c in shares
        ],
    }
    return question.tube("mixture", delta, parameters, profile)


def _seed_pairs(seed: Tube, data: Schedule) -> list[Pair]:
    if seed.method == "kummer":
        return [(float(seed.parameters["a"]), float(seed.parameters["v0"]) / data.unit**2, False)]
    return []


def _least_scale(
    program: MixtureProgram, pairs: list[Pair], delta: float, first: float
) -> tuple[float, list[Component]]:
    """Least scale of the clearance with probability delta: secant on log P in the squared scale."""
    target = math.log(delta) - 2e-4
    x, slope = first**2, -max(2.0, -target) / first**2
    best: tuple[float, list[Component]] | None = None
    gap = 0.0
    for k in range(9):
        new = x if k == 0 else min(max(x - gap / slope, 0.25 * x), 2.0 * x)
        value, components, pairs = program.solve(pairs, math.sqrt(new), (3, 2, 2, 1)[min(k, 3)])
        new_gap = math.log(value) - target
        # every round adds columns, so that P falls a little even at the same scale
        if k > 1 and new != x and (new_gap - gap) / (new - x) < 0.5 * slope:
            slope = (new_gap - gap) / (new - x)
        x, gap = new, new_gap
        if gap <= 2e-4 and (best is None or math.sqrt(x) < best[0]):
            best = (math.sqrt(x), components)
        if abs(gap) < 2e-4:
            break
    if best is None:
        raise InfeasibleError("no mixture was found at this level; use 'kummer'.")
    return best


def mixture_level(schedule: Schedule, clearance: Clearance, *, best: list[Pair]) -> float:
    """log10 of the certified probability of Thm K3 for a clearance, at most 0.

    The least certified gain over the rows divides the certified sum of the weights.
    """
    data = _rows(schedule.refined(clearance.ends(schedule)))
    radii = _radii(data, clearance)
    pairs, ends = _dictionary(data, best)
    program = MixtureProgram(schedule=data, clearance=radii, ends=ends)
    _, components, _ = program.solve(pairs, 1.0, 6)
    profile = MixtureProfile(schedule=data, components=tuple(components), aims=radii / data.unit)
    with precision():
        least = arb.pos_inf()
        for piece in np.flatnonzero(np.isfinite(radii)).tolist():
            start, end = float(data.times[piece]), float(data.times[piece + 1])
            start = start if data.continuous else start + 1
            least = arb.min(least, profile.gain(piece, start, end, arb(float(radii[piece])) / arb(data.unit)))
        total = sum((arb(component.weight) for component in components), arb(0))
        level = (total / least).log() / arb(10).log()
        return min(0.0, upper(level)) if level.is_finite() else 0.0
