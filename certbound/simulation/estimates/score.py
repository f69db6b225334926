"""How close a path has come to leaving: the reaction coordinate of importance splitting.

The score of a constraint is 1 - gap/(gap of the noise-free path): 0 on the noise-free path, 1 on the
boundary. A path's score is the largest over constraints and time, so that it leaves exactly when its score
reaches 1. Between two steps the smallest gap of a Brownian bridge is drawn where it can raise the record, as
in `gap_tests`, or that of a smooth gap is found. Outside its window a constraint guides the splitting too, with a
score that stays below 1."""

from __future__ import annotations

from collections.abc import Sequence

from certbound.simulation.gap_tests import EXPONENT, Barrier, Bridge, if_all, starts_at_once, turns, window_test
from certbound.simulation.tape_text import Parameters, indent, linear_form, vector

_ALMOST = 1.0 - 1e-9  # score of a path beyond a constraint that does not hold yet


def score_source(
    barriers: Sequence[Barrier], bridge: Bridge | None, p: Parameters
) -> tuple[list[str], list[str], list[str]]:
    """Lines before the first step (state x_i), within a step (new states y_i, noise-free b_i), and at its
    end.

    They keep the record in ``top``. The lines before the first step also serve to go on from a stored state:
    they set the old gaps, at step ``first``."""
    begin: list[str] = []
    within: list[str] = []
    end: list[str] = []
    column = 0
    for number, barrier in enumerate(barriers):
        units = 1 if barrier.round or not barrier.stay else len(barrier.matrix)
        old, new, free = (vector(f"{letter}_{number}", units) for letter in "gnc")
        begin += _gaps(barrier, old, "x", "first", column, p)
        for g in old:
            begin += [if_all("first == 0", starts_at_once(number, barrier), f"{g} < 0.0"), "    top = 2.0"]
        within += _gaps(barrier, free, "b", "k + 1", column, p) + _gaps(barrier, new, "y", "k + 1", column, p)
        active = " and ".join(window_test(number, barrier, "k + 1"))
        bridged = " and ".join(window_test(number, barrier, "k"))
        for unit in range(units):
            spread = _spread(barrier, unit, column, bridge, p) if bridge else ([], "0.0")
            older, rows = f"o_{number}_{unit}", barrier.matrix[unit : unit + 1] if units > 1 else barrier.matrix
            if bridge is not None and bridge.smooth(rows):
                spread = _turn(older, old[unit], new[unit], window_test(number, barrier, "k - 1")), "0.0"
                begin += [f"{older} = math.nan"]
                end += [f"{older} = {old[unit]}"]
            within += _unit((old[unit], new[unit], free[unit]), (active, bridged), *spread, p)
        end += [f"{g} = {n}" for g, n in zip(old, new)]
        column += barrier.columns
    return begin, within, end


def _unit(
    gaps: tuple[str, str, str], windows: tuple[str, str], spread_lines: list[str], spread: str, p: Parameters
) -> list[str]:
    """Raise the record by one gap (names of its old, new and noise-free value)."""
    (g, n, free), (active, bridged) = gaps, windows
    lines = [f"low, floor = {n}, (1.0 - top) * {free}"]
    if not p.is_zero(spread):
        draw = [
            *spread_lines,
            f"floor = min(floor, {g}, {n})",
            f"if ({g} - floor) * ({n} - floor) < {0.5 * EXPONENT} * ({spread}):",
            f"    low = fall_between(stream, {g}, {n}, floor, {spread}, low)",
        ]
        lines += [if_all(f"{free} > 0.0", bridged), *indent(draw)]
    else:
        lines += spread_lines
    lines += [
        f"if {free} > 0.0:",
        f"    if low < (1.0 - top) * {free}:",
        f"        score = 1.0 - low / {free}",
        f"        top = max(top, {f'score if {active} else min(score, {_ALMOST})' if active else 'score'})",
        if_all("low < 0.0", active, word="elif"),
        "    top = max(top, 2.0)",
    ]
    return lines


def _turn(older: str, old: str, new: str, active: list[str]) -> list[str]:
    """Lines that lower the least gap to that of the parabola through three gaps, where it is least between them."""
    least = f"{old} - ({new} - {older}) ** 2 / (8.0 * ({older} - {old} + {new} - {old}))"
    return [if_all(turns(older, old, new), *active), f"    low = min(low, {least})"]


def _gaps(barrier: Barrier, targets: list[str], state: str, step: str, column: int, p: Parameters) -> list[str]:
    """Lines that set a barrier's gaps at a state."""
    rows, dimension = barrier.matrix.shape
    names = vector(state, dimension)
    values = []
    for i in range(rows):
        offset = f"moving[{step}, {column + i}]" if barrier.moving else p.add(float(barrier.offset[i]))
        values.append(f"{linear_form(barrier.matrix[i].tolist(), names, p)} - {offset}")
    if barrier.round:
        legs = [f"({value}) ** 2" for value in values]
        moved = f"moving[{step}, {column + rows}]"
        distance, radius = f"math.sqrt({' + '.join(legs)})", moved if barrier.radius is None else p.add(barrier.radius)
        return [f"{targets[0]} = " + (f"{radius} - {distance}" if barrier.stay else f"{distance} - {radius}")]
    if barrier.stay:
        return [f"{target} = -({value})" for target, value in zip(targets, values)]
    lines = [f"{targets[0]} = {values[0]}"]
    return lines + [f"{targets[0]} = max({targets[0]}, {value})" for value in values[1:]]


def _spread(barrier: Barrier, unit: int, column: int, bridge: Bridge, p: Parameters) -> tuple[list[str], str]:
    """Variance of a gap over a step: lines, and the expression that they make valid."""
    rows = barrier.matrix
    if not barrier.round and (barrier.stay or len(rows) == 1):
        return [], bridge.variance(rows[unit].tolist(), p)
    even = bridge.even_variance(rows) if barrier.round else 0.0
    if even > 0.0:
        return [], p.add(even)
    if not barrier.round:  # the face that is farthest decides; the largest variance errs on the side of leaving
        return [], "max(" + ", ".join(f"{bridge.variance(row.tolist(), p)}" for row in rows) + ")"
    lines, dimension = list[str](), rows.shape[1]
    legs = vector("e", len(rows))
    for i, (leg, row) in enumerate(zip(legs, rows)):
        offset = f"moving[k + 1, {column + i}]" if barrier.moving else p.add(float(barrier.offset[i]))
        lines += [f"{leg} = {linear_form(row.tolist(), vector('y', dimension), p)} - {offset}"]
    weights = [linear_form(part.tolist(), legs, p) for part in rows.T]
    lines += [f"w_{i} = {weight}" for i, weight in enumerate(weights)]
    square = " + ".join(f"{leg} * {leg}" for leg in legs)
    variance = bridge.moving_variance(vector("w", dimension), p)
    return [*lines, f"spread = ({variance}) / max({square}, 1e-300)"], "spread"
