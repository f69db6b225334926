"""Constraints as a kernel sees them: gaps that are positive while a path is safe, and the test between two
steps.

Between two grid times a path of a continuous system may leave and return. Given its values g and g' of a gap
at both ends, a Brownian bridge of variance v h touches 0 with probability exp(-2 g g'/(v h)): exact for a
half-space and constant diffusion, first-order accurate for smooth boundaries (Gobet, 2000). For a set of the
kind "outside a polytope" the least of its faces' probabilities is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certbound.problem.sets import Outside
from certbound.simulation.expressions import Parameters, linear_form

__all__ = ["Barrier", "Bridge", "barrier_source", "barriers_of"]

Array = NDArray[np.float64]

EXPONENT = 40.0
"""A bridge is looked at only where it exits with probability above exp(-40)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Barrier:
    """One constraint on the steps ``first`` .. ``last``.

    Parameters
    ----------
    label : str
        Text for humans.
    stay : bool
        True: inside the region; False: outside it.
    round : bool
        True: the region is {‖matrix x - offset‖ <= radius}; False: it is {matrix x <= offset}.
    matrix : ndarray, shape (rows, n)
    offset : ndarray, shape (rows,) or (steps + 1, rows)
        The second shape: one row per step, for a region that moves.
    radius : float
    first, last : int
    """

    label: str
    stay: bool
    round: bool
    matrix: Array
    offset: Array
    radius: float = 0.0
    first: int
    last: int

    @property
    def moving(self) -> bool:
        """Whether the region depends on time."""
        return self.offset.ndim == 2


@dataclass(frozen=True, eq=False, kw_only=True)
class Bridge:
    """How the noise of one step spreads: the columns are ``spread`` numbers, or variables named by
    ``entries``.

    ``spread`` already holds the factor sqrt(h). Where it is None, ``entries[i][j]`` is the expression of the
    entry (i, j), to be multiplied by the square root of the step.
    """

    spread: Array | None
    entries: Sequence[Sequence[str]] = ()

    def variance(self, row: Sequence[float], parameters: Parameters) -> str:
        """Expression of |row . G|^2 h for a fixed row."""
        if self.spread is not None:
            return parameters.add(float(np.sum((np.asarray(row) @ self.spread) ** 2)))
        return self.squares(
            [linear_form(row, column, parameters) for column in zip(*self.entries, strict=True)]
        )

    def moving_variance(self, names: Sequence[str], parameters: Parameters) -> str:
        """Expression of |w . G|^2 h for a row w of variables."""
        if self.spread is not None:
            return self.squares([linear_form(column, names, parameters) for column in self.spread.T])
        columns = zip(*self.entries, strict=True)
        return self.squares(
            [
                " + ".join(f"{n} * {e}" for n, e in zip(names, column) if e != "0.0") or "0.0"
                for column in columns
            ]
        )

    @staticmethod
    def squares(terms: Sequence[str]) -> str:
        return " + ".join(f"({term}) ** 2" for term in terms if term != "0.0") or "0.0"


def barriers_of(problem: Any, times: Array) -> list[Barrier]:
    """The constraints of a problem on the grid ``times``, its domain (which must not be left either) last.

    A window that holds no grid time is watched at the nearest one.
    """
    barriers = []
    for constraint in problem.constraints:
        region, last = constraint.region, len(times) - 1
        start, stop = constraint.during if constraint.during is not None else (times[0], times[-1])
        slack = 1e-9 * max(abs(float(times[-1])), 1.0)
        first = int(np.searchsorted(times, start - slack))
        end = int(np.searchsorted(times, stop + slack, side="right")) - 1
        if first > end:
            first = end = int(np.argmin(np.abs(times - 0.5 * (start + stop))))
        embed = np.eye(problem.system.dimension)
        if region.coordinates is not None:
            embed = embed[list(region.coordinates)]
        centers = np.array([region.center_at(t) for t in times]) if region.moving else region.center_at()
        fields = _round_region(region, embed, centers) if region.kind in _ROUND else None
        if fields is None:
            faces, bounds = region.halfspaces()
            if len(bounds) == 0:
                continue
            fields = {"round": False, "matrix": faces @ embed, "offset": bounds + centers @ faces.T}
        stay = not isinstance(constraint, Outside)
        barriers.append(
            Barrier(label=constraint.label, stay=stay, first=min(first, last), last=min(end, last), **fields)
        )
    return barriers


_ROUND = ("ball", "ellipsoid")


def _round_region(region: Any, embed: Array, centers: Array) -> dict[str, Any]:
    if region.kind == "ball":
        return {"round": True, "matrix": embed, "offset": centers, "radius": float(region.radius)}
    whiten = np.linalg.inv(np.linalg.cholesky(region.shape))
    return {"round": True, "matrix": whiten @ embed, "offset": centers @ whiten.T, "radius": 1.0}


def barrier_source(
    number: int, barrier: Barrier, bridge: Bridge | None, parameters: Parameters, column: int
) -> tuple[list[str], list[str], list[str]]:
    """Source lines (before the first step, within a step, at the end of a step) that watch one constraint.

    The lines read the old state ``x_i``, the new state ``y_i`` and the step number ``k``, and set ``left`` to
    the number of the constraint when the path leaves. ``column`` is the first column of ``moving`` that it
    may use.
    """
    if barrier.round:
        return _round(number, barrier, bridge, parameters, column)
    return _faces(number, barrier, bridge, parameters, column)


def _active(number: int, old: bool) -> str:
    end = f"k + 1 <= windows[{number}, 1]"
    return f"windows[{number}, 0] <= k and {end}" if old else f"windows[{number}, 0] <= k + 1 and {end}"


def _names(letter: str, count: int) -> list[str]:
    return [f"{letter}_{i}" for i in range(count)]


def _faces(
    number: int, barrier: Barrier, bridge: Bridge | None, p: Parameters, column: int
) -> tuple[list[str], list[str], list[str]]:
    rows, dimension = barrier.matrix.shape
    faces = range(rows)
    old, new = [f"g_{number}_{f}" for f in faces], [f"n_{number}_{f}" for f in faces]
    sign = 1.0 if barrier.stay else -1.0

    def gaps(targets: list[str], state: str, step: str) -> list[str]:
        lines = []
        for f in faces:
            bound = f"moving[{step}, {column + f}]" if barrier.moving else p.add(float(barrier.offset[f]))
            value = linear_form(barrier.matrix[f].tolist(), _names(state, dimension), p)
            lines.append(
                f"{targets[f]} = {bound} - ({value})" if sign > 0 else f"{targets[f]} = ({value}) - {bound}"
            )
        return lines

    start = gaps(old, "x", "0")
    out = " or ".join(f"{g} < 0.0" for g in old) if barrier.stay else " and ".join(f"{g} < 0.0" for g in old)
    start += [f"if windows[{number}, 0] == 0 and ({out}):", f"    left = {number}"]
    step = gaps(new, "y", "k + 1")
    end = [f"{g} = {n}" for g, n in zip(old, new)]
    out = out.replace("g_", "n_")
    step += [f"if ({out}) and {_active(number, old=False)}:", f"    left = {number}"]
    if bridge is None:
        return start, step, end
    variances = [bridge.variance(barrier.matrix[f].tolist(), p) for f in faces]
    if barrier.stay:
        for f in faces:
            if variances[f] != "0.0" and p_value(p, variances[f]) != 0.0:
                near = f"0.0 <= {old[f]} and 2.0 * {old[f]} * {new[f]} < {EXPONENT} * ({variances[f]})"
                step += [f"if left < 0 and {near} and {_active(number, old=True)}:"]
                step += [f"    if uniform(stream) < math.exp(-2.0 * {old[f]} * {new[f]} / ({variances[f]})):"]
                step += [f"        left = {number}"]
        return start, step, end
    step += [f"if left < 0 and {_active(number, old=True)}:", "    exponent = -1.0"]
    for f in faces:
        step += [f"    if {old[f]} > 0.0 and {new[f]} > 0.0:"]
        step += [f"        exponent = max(exponent, 2.0 * {old[f]} * {new[f]} / ({variances[f]}))"]
    step += [f"    if 0.0 <= exponent < {EXPONENT} and uniform(stream) < math.exp(-exponent):"]
    step += [f"        left = {number}"]
    return start, step, end


def p_value(p: Parameters, expression: str) -> float:
    """The number behind ``p[i]``, nan for any other expression."""
    return (
        p.values[int(expression[2:-1])]
        if expression.startswith("p[") and expression.endswith("]")
        else np.nan
    )


def _round(
    number: int, barrier: Barrier, bridge: Bridge | None, p: Parameters, column: int
) -> tuple[list[str], list[str], list[str]]:
    rows, dimension = barrier.matrix.shape
    old, new = f"q_{number}", f"r_{number}"
    radius = p.add(barrier.radius)
    legs = [f"e_{number}_{i}" for i in range(rows)]

    def distance(target: str, state: str, step: str) -> list[str]:
        lines = []
        for i in range(rows):
            centre = f"moving[{step}, {column + i}]" if barrier.moving else p.add(float(barrier.offset[i]))
            lines.append(
                f"{legs[i]} = {linear_form(barrier.matrix[i].tolist(), _names(state, dimension), p)} - {centre}"
            )
        return [*lines, f"{target} = {' + '.join(f'{leg} * {leg}' for leg in legs)}"]

    beyond = ">" if barrier.stay else "<"
    start = distance(old, "x", "0")
    start += [f"if windows[{number}, 0] == 0 and {old} {beyond} {radius} * {radius}:", f"    left = {number}"]
    step = distance(new, "y", "k + 1")
    step += [
        f"if {new} {beyond} {radius} * {radius} and {_active(number, old=False)}:",
        f"    left = {number}",
    ]
    end = [f"{old} = {new}"]
    if bridge is None:
        return start, step, end
    near = _near_radius(barrier, bridge, p)
    if near:
        worst = "max" if barrier.stay else "min"
        step += [f"elif {worst}({old}, {new}) {beyond} {near} and {_active(number, old=True)}:"]
    else:
        step += [f"elif {_active(number, old=True)}:"]
    gap = f"{radius} - math.sqrt({{0}})" if barrier.stay else f"math.sqrt({{0}}) - {radius}"
    step += [f"    before, after = {gap.format(old)}, {gap.format(new)}"]
    gradient = []
    for i in range(dimension):
        weights = barrier.matrix[:, i].tolist()
        step += [f"    w_{i} = {linear_form(weights, legs, p)}"]
        gradient.append(f"w_{i}")
    step += [f"    spread = ({bridge.moving_variance(gradient, p)}) / {new} if {new} > 0.0 else 0.0"]
    step += [f"    if before >= 0.0 and 2.0 * before * after < {EXPONENT} * spread:"]
    step += ["        if uniform(stream) < math.exp(-2.0 * before * after / spread):"]
    step += [f"            left = {number}"]
    return start, step, end


def _near_radius(barrier: Barrier, bridge: Bridge, p: Parameters) -> str:
    """Squared radius beyond which a bridge can matter; empty where the noise depends on the state."""
    if bridge.spread is None:
        return ""
    band = np.sqrt(0.5 * EXPONENT) * np.linalg.norm(barrier.matrix @ bridge.spread, 2)
    near = max(barrier.radius - band, 0.0) if barrier.stay else barrier.radius + band
    return p.add(float(near**2))
