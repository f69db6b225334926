"""Constraints as a kernel sees them: gaps that are positive while a path is safe, and the test between two
steps.

Between two grid times a path of a continuous system may leave and return. Given its values g and g' of a gap
at both ends, a Brownian bridge of variance v h touches 0 with probability exp(-2 g g'/(v h)): exact for a
half-space and constant diffusion, first-order accurate for smooth boundaries (Gobet, 2000). For a set of the
kind "outside a polytope" the least of its faces' probabilities is taken.

A gap that gets no noise of its own, as that of a position, is smooth: a parabola through its values at three steps has
its least value between them (an error of fourth order in the step), where an oscillation turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.sets import Faces, Inside, Outside, Quadratic, Region
from certbound.simulation.tape_text import Parameters, indent, linear_form, vector
from certbound.simulation.wide_text import product

EXPONENT = 40.0
"""A bridge is looked at only where it exits with probability above exp(-40)."""

_UNROLLED = 8
"""Faces of a set that have lines of their own; more are looked at in a loop, which compiles sooner."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Barrier:
    """One constraint on the steps ``first`` .. ``last``."""

    label: str  # text for humans
    stay: bool  # True: inside the region; False: outside it
    round: bool  # True: the region is {‖matrix x - offset‖ <= radius}; False: it is {matrix x <= offset}
    matrix: Array  # (rows, n)
    # (rows,) or (steps + 1, rows): the second shape: one row per step, for a region that moves. Where the radius moves
    # its values stand in a last column
    offset: Array
    radius: float | None = 0.0  # None: in the last column of ``offset``
    first: int
    last: int
    always: bool = False  # whether these are all steps: then the kernel asks no further

    @property
    def moving(self) -> bool:
        """Whether the region depends on time."""
        return self.offset.ndim == 2

    @property
    def columns(self) -> int:
        """Columns of the table of what moves that it reads."""
        return self.offset.shape[1] if self.moving else 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Bridge:
    """How the noise of one step spreads: the columns are ``spread`` numbers, or variables named by
    ``entries``.

    ``spread`` already holds the factor sqrt(h). Where it is None, ``entries[i][j]`` is the expression of the
    entry (i, j), to be multiplied by the square root of the step.
    """

    spread: Array | None
    entries: Sequence[Sequence[str]] = ()
    rough: Array | None = None  # as ``spread``, of states too that follow noise at once; ``spread`` where omitted

    def variance(self, row: Sequence[float], parameters: Parameters) -> str:
        """Expression of |row . G|^2 h for a fixed row."""
        if self.spread is not None:
            return parameters.add(float(np.sum((np.asarray(row) @ self.spread) ** 2)))
        return self.squares([linear_form(row, column, parameters) for column in zip(*self.entries, strict=True)])

    def moving_variance(self, names: Sequence[str], parameters: Parameters) -> str:
        """Expression of |w . G|^2 h for a row w of variables."""
        if self.spread is not None:
            return self.squares([linear_form(column, names, parameters) for column in self.spread.T])
        columns = zip(*self.entries, strict=True)
        return self.squares(
            [" + ".join(f"{n} * {e}" for n, e in zip(names, column) if e != "0.0") or "0.0" for column in columns]
        )

    def even_variance(self, matrix: Array) -> float:
        """|u . matrix . G|^2 h where it is the same for all unit vectors u, else 0."""
        if self.spread is None:
            return 0.0
        image = matrix @ self.spread
        square = image @ image.T
        even = np.allclose(square, square[0, 0] * np.eye(len(square)), rtol=1e-12, atol=1e-14 * square[0, 0])
        return float(square[0, 0]) if even else 0.0

    def smooth(self, matrix: Array) -> bool:
        """Whether ``matrix . x`` gets no noise of its own, and follows none within a step."""
        if self.spread is not None:
            return not np.any(matrix @ (self.spread if self.rough is None else self.rough))
        rows = np.any(matrix != 0.0, axis=0).tolist()
        return all(entry == "0.0" for row, moves in zip(self.entries, rows, strict=True) if moves for entry in row)

    @staticmethod
    def squares(terms: Sequence[str]) -> str:
        return " + ".join(f"({term}) ** 2" for term in terms if term != "0.0") or "0.0"


def barriers_of(problem: Any, times: Array) -> list[Barrier]:
    """The constraints of a problem on the grid ``times``, its domain (which must not be left either) last.

    A window that holds no grid time is watched at the nearest one.
    """
    return _watched(problem, problem.kept, times)


def goal_of(problem: Any, times: Array) -> Barrier | None:
    """The target of a problem, as an obstacle that a path runs into; None where there is none."""
    if problem.reach is None:
        return None
    target = problem.reach
    found = _watched(problem, [Outside(target.region, target.during, f"not in time: {target.label}")], times)
    if not found:
        raise ValueError(f"the target '{target.label}' has no boundary; leave `reach` out.")
    return found[0]


def keep_of(problem: Any, times: Array) -> Barrier | None:
    """The target of a problem as a set to be stayed in from its first entry on; None where that is not asked."""
    if problem.reach is None or not problem.reach.stays:
        return None
    return _watched(problem, [Inside(problem.reach.region, None, f"left again: {problem.reach.label}")], times)[0]


def _watched(problem: Any, constraints: Sequence[Inside], times: Array) -> list[Barrier]:
    barriers = []
    for constraint in constraints:
        region, last = constraint.region, len(times) - 1
        start, stop = constraint.during if constraint.during is not None else (times[0], times[-1])
        slack = 1e-9 * max(abs(float(times[-1])), 1.0)
        first = int(np.searchsorted(times, start - slack))
        end = int(np.searchsorted(times, stop + slack, side="right")) - 1
        if first > end:
            first = end = int(np.argmin(np.abs(times - 0.5 * (start + stop))))
        embed = np.eye(problem.system.dimension)[region.places(problem.system.dimension)]
        centers = np.array([region.center_at(t) for t in times]) if region.moving else region.center_at()
        window = (min(first, last), min(end, last))
        form = region.at(float(times[window[0]])).form if region.changing else region.form
        match form:
            case Quadratic():
                radii = _over_window(region, times, window) if region.changing else None
                fields = _round_fields(form, embed, centers, radii)
            case Faces() if len(form.bounds):
                bounds = _over_window(region, times, window) if region.changing else form.bounds
                offset = bounds + centers @ form.normals.T
                fields = {"round": False, "matrix": form.normals @ embed, "offset": offset}
            case _:
                continue
        fields |= {"label": constraint.label, "stay": not constraint.outside}
        fields |= {"first": window[0], "last": window[1], "always": first == 0 and end >= last}
        barriers.append(Barrier(**fields))
    return barriers


def _over_window(region: Region, times: Array, window: tuple[int, int]) -> Array:
    """Bounds or radii at all times, as they are in a window; beyond it, where nothing asks for them, as at its ends."""
    first, last = window
    inside = []
    for t in times[first : last + 1].tolist():
        form = region.at(t).form
        inside.append(form.bounds if isinstance(form, Faces) else form.radius)
    return np.array([*[inside[0]] * first, *inside, *[inside[-1]] * (len(times) - 1 - last)], dtype=float)


def tables_of(barriers: Sequence[Barrier]) -> dict[str, Any]:
    """What the kernels read of barriers: ``moving`` offsets (a row a step), and ``windows`` (first and last step)."""
    moving = [barrier.offset for barrier in barriers if barrier.moving]
    return {
        "moving": np.hstack(moving) if moving else np.zeros((0, 0)),
        "windows": np.array([[b.first, b.last] for b in barriers], dtype=np.int64).reshape(-1, 2),
    }


def _round_fields(form: Quadratic, embed: Array, centers: Array, radii: Array | None = None) -> dict[str, Any]:
    """A ball or ellipsoid as ‖matrix x - offset‖ <= radius; an interval, in one dimension, as two faces.

    ``radii``, one a step, are those of a ball whose radius moves.
    """
    root, radius = form.test
    matrix, offset = root @ embed, centers @ root.T
    if form.dimension == 1:
        size = radius if radii is None else radii[:, None]
        both = np.concatenate([size + offset, size - offset], axis=-1)
        return {"round": False, "matrix": np.vstack([matrix, -matrix]), "offset": both}
    if radii is not None:
        columns = np.column_stack([np.broadcast_to(offset, (len(radii), len(matrix))), radii])
        return {"round": True, "matrix": matrix, "offset": columns, "radius": None}
    return {"round": True, "matrix": matrix, "offset": offset, "radius": radius}


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


def window_test(number: int, barrier: Barrier, start: str) -> list[str]:
    """Conditions for a constraint to hold from step ``start`` to step k + 1; none if it always does."""
    if barrier.always:
        return []
    return [f"windows[{number}, 0] <= {start}", f"k + 1 <= windows[{number}, 1]"]


def if_all(*conditions: str, word: str = "if") -> str:
    """``if a and b:``, or ``if True:`` without conditions."""
    return f"{word} {' and '.join(condition for condition in conditions if condition) or 'True'}:"


def starts_at_once(number: int, barrier: Barrier) -> str:
    """Condition for a constraint to hold at the start; none if it always does."""
    return "" if barrier.always else f"windows[{number}, 0] == 0"


def _touch(exponent: str, number: int) -> list[str]:
    """Leave with probability exp(-e)."""
    return [f"if touches(stream, {exponent}):", f"    left = {number}"]


def _cross(old: str, new: str, spread: str, number: int, active: Sequence[str]) -> list[str]:
    """Leave where the bridge between two gaps touches 0."""
    crossed = f"crossed(stream, {old}, {new}, {spread}, {EXPONENT})"
    return [if_all("left < 0", *active, crossed), f"    left = {number}"]


def _faces(
    number: int, barrier: Barrier, bridge: Bridge | None, p: Parameters, column: int
) -> tuple[list[str], list[str], list[str]]:
    rows, dimension = barrier.matrix.shape
    looped = barrier.stay and rows > _UNROLLED
    names = [f"g_{number}", f"n_{number}"]
    old, new = ([f"{name}[{f}]" for f in range(rows)] if looped else vector(name, rows) for name in names)

    def gaps(targets: list[str], state: str, step: str) -> list[str]:
        if looped and p.wide:
            return _gaps_in_loops(barrier, targets[0].split("[")[0], state, f"moving[{step}, {column} + i]", p)
        lines = []
        for f, target in enumerate(targets):
            bound = f"moving[{step}, {column + f}]" if barrier.moving else p.add(float(barrier.offset[f]))
            value = linear_form(barrier.matrix[f].tolist(), vector(state, dimension), p)
            lines.append(f"{target} = " + (f"{bound} - ({value})" if barrier.stay else f"{value} - {bound}"))
        return lines

    def out(names: list[str]) -> str:
        if barrier.stay:
            return " or ".join(f"{name} < 0.0" for name in names)
        return " and ".join(f"{name} <= 0.0" for name in names)  # sets are closed: an edge belongs to the obstacle

    if looped:
        made = [f"{names[0]}, {names[1]} = np.empty({rows}), np.empty({rows})", *gaps(old, "x", "0")]
        made += [if_all(starts_at_once(number, barrier), f"{names[0]}.min() < 0.0"), f"    left = {number}"]
        begin, *others = _many_faces(number, barrier, bridge, gaps(new, "y", "k + 1"), p)
        return made + begin, others[0], others[1]
    start = [*gaps(old, "x", "0"), if_all(starts_at_once(number, barrier), f"({out(old)})"), f"    left = {number}"]
    step = [
        *gaps(new, "y", "k + 1"),
        if_all(f"({out(new)})", *window_test(number, barrier, "k + 1")),
        f"    left = {number}",
    ]
    if bridge is None:
        return start, step, []
    spreads = [bridge.variance(row.tolist(), p) for row in barrier.matrix]
    active = window_test(number, barrier, "k")
    step += (_bridge_stay if barrier.stay else _bridge_avoid)(number, active, old, new, spreads, p)
    end: list[str] = []
    for f, (g, n) in enumerate(zip(old, new)):
        if bridge.smooth(barrier.matrix[f : f + 1]) and (barrier.stay or rows == 1):
            start += [f"o_{number}_{f} = math.nan"]
            step += _turn(f"o_{number}_{f}", g, n, number, barrier)
            end += [f"o_{number}_{f} = {g}"]
        end += [f"{g} = {n}"]
    return start, step, end


def turns(older: str, old: str, new: str) -> str:
    """The condition that a gap is least between three steps; of a first step, whose older gap is nan, it is false."""
    return f"{old} < {older} and {old} <= {new}"


def _turn(older: str, old: str, new: str, number: int, barrier: Barrier) -> list[str]:
    """Leave where the parabola through three gaps, least between them, ends below 0."""
    below = f"8.0 * {old} * ({older} - {old} + {new} - {old}) < ({new} - {older}) ** 2"
    active = window_test(number, barrier, "k - 1")
    return [if_all("left < 0", turns(older, old, new), below, *active), f"    left = {number}"]


def _gaps_in_loops(barrier: Barrier, gap: str, state: str, moving: str, p: Parameters) -> list[str]:
    """Lines that set the array of gaps of a set to be stayed in, where the state is an array too."""
    bound = moving if barrier.moving else f"p[{p.extend(barrier.offset.tolist())} + i]"
    fill = [f"for i in range({len(barrier.matrix)}):", f"    {gap}[i] = {bound}"]
    return [*fill, *product(-barrier.matrix, state, gap, p)]


def _many_faces(
    number: int, barrier: Barrier, bridge: Bridge | None, gaps: list[str], p: Parameters
) -> tuple[list[str], list[str], list[str]]:
    """Further lines of `_faces` for a set of many faces, whose gaps stand in arrays."""
    g, n, spread, faces = f"g_{number}", f"n_{number}", f"v_{number}", len(barrier.matrix)
    step = [*gaps, if_all(f"{n}.min() < 0.0", *window_test(number, barrier, "k + 1")), f"    left = {number}"]
    if bridge is None:
        return [], step, []
    rows = [row.tolist() for row in barrier.matrix]
    if bridge.spread is not None:
        first = p.extend(np.sum((barrier.matrix @ bridge.spread) ** 2, axis=1).tolist())
        step += [f"{spread} = p[{first}:{first + faces}]"]
    else:
        step += [f"{spread} = np.empty({faces})"]
        step += [f"{spread}[{f}] = {bridge.variance(row, p)}" for f, row in enumerate(rows)]
    looks = [f"for face in range({faces}):", *indent(_cross(f"{g}[face]", f"{n}[face]", f"{spread}[face]", number, []))]
    active = window_test(number, barrier, "k")
    step += [if_all(*active), *indent(looks)] if active else looks
    calm = [f for f in range(faces) if bridge.smooth(barrier.matrix[f : f + 1])]
    older, end = f"o_{number}", list[str]()
    for f in calm:
        step += _turn(f"{older}_{f}", f"{g}[{f}]", f"{n}[{f}]", number, barrier)
        end += [f"{older}_{f} = {g}[{f}]"]
    return [f"{older}_{f} = math.nan" for f in calm], step, [*end, f"{g}[:] = {n}"]


def _bridge_stay(
    number: int, active: list[str], old: list[str], new: list[str], spreads: list[str], p: Parameters
) -> list[str]:
    """Each face may be touched."""
    lines = []
    for g, n, spread in zip(old, new, spreads):
        if not p.is_zero(spread):
            lines += _cross(g, n, spread, number, active)
    return lines


def _bridge_avoid(
    number: int, active: list[str], old: list[str], new: list[str], spreads: list[str], p: Parameters
) -> list[str]:
    """All faces must be crossed: the least likely one decides; without one, the straight line does."""
    near = " and ".join(
        f"({n} < 0.0 or {g} * {n} < {0.5 * EXPONENT} * ({spread}))" for g, n, spread in zip(old, new, spreads)
    )
    lines = ["worst, enter, leave = -1.0, 0.0, 1.0"]
    for g, n, spread in zip(old, new, spreads):
        lines += [f"if {g} > 0.0 and {n} > 0.0:", f"    worst = max(worst, 2.0 * {g} * {n} / ({spread}))"]
        lines += [f"elif {g} > 0.0:", f"    enter = max(enter, {g} / ({g} - {n}))"]
        lines += [f"elif {n} > 0.0:", f"    leave = min(leave, {g} / ({g} - {n}))"]
    lines += ["if worst >= 0.0:", *indent(_touch("worst", number))]
    lines += ["elif enter <= leave:", f"    left = {number}"]
    return [if_all(near, "left < 0", *active), *indent(lines)]


def _round(
    number: int, barrier: Barrier, bridge: Bridge | None, p: Parameters, column: int
) -> tuple[list[str], list[str], list[str]]:
    rows, dimension = barrier.matrix.shape
    old, new = f"q_{number}", f"r_{number}"
    moved = f"{column + rows}]"  # where a radius that moves stands
    first, before, radius = (
        [f"moving[{step}, {moved}" for step in ("0", "k", "k + 1")] if barrier.radius is None
        else [p.add(barrier.radius)] * 3
    )  # fmt: skip
    legs = vector(f"e_{number}", rows)

    def distance(target: str, state: str, step: str) -> list[str]:
        lines = []
        for i, leg in enumerate(legs):
            center = f"moving[{step}, {column + i}]" if barrier.moving else p.add(float(barrier.offset[i]))
            value = linear_form(barrier.matrix[i].tolist(), vector(state, dimension), p)
            lines += [f"{leg} = {value} - {center}"]
        return [*lines, f"{target} = {' + '.join(f'{leg} * {leg}' for leg in legs)}"]

    beyond = ">" if barrier.stay else "<="
    start = distance(old, "x", "0")
    start += [if_all(starts_at_once(number, barrier), f"{old} {beyond} {first} * {first}"), f"    left = {number}"]
    step = distance(new, "y", "k + 1")
    out = f"{new} {beyond} {radius} * {radius}"
    step += [if_all(out, *window_test(number, barrier, "k + 1")), f"    left = {number}"]
    end = [f"{old} = {new}"]
    if bridge is None:
        return start, step, []
    if bridge.smooth(barrier.matrix):
        older, gap, after = f"o_{number}", f"g_{number}", f"n_{number}"
        sign = "-" if barrier.stay else ""
        step += [f"{gap}, {after} = {sign}({old} - {before} * {before}), {sign}({new} - {radius} * {radius})"]
        step += _turn(older, gap, after, number, barrier)
        return [*start, f"{older} = math.nan"], step, [f"{older} = {gap}", *end]
    near = _near(barrier, bridge, old, new, p)
    sides = [(before, f"math.sqrt({old})"), (radius, f"math.sqrt({new})")]
    gaps = [f"{size} - {place}" if barrier.stay else f"{place} - {size}" for size, place in sides]
    lines = [f"before, after = {gaps[0]}, {gaps[1]}"]
    weights = [linear_form(column_.tolist(), legs, p) for column_ in barrier.matrix.T]
    lines += [f"w_{i} = {weight}" for i, weight in enumerate(weights)]
    spread = bridge.moving_variance(vector("w", dimension), p)
    lines += [f"spread = ({spread}) / {new} if {new} > 0.0 else 0.0"]
    lines += [f"if before >= 0.0 and before * after < {0.5 * EXPONENT} * spread:"]
    lines += indent(_touch("2.0 * before * after / spread", number))
    test = if_all(near, *window_test(number, barrier, "k"), word="elif")
    return start, [*step, test, *indent(lines)], end


def _near(barrier: Barrier, bridge: Bridge, old: str, new: str, p: Parameters) -> str:
    """Test, on squared radii, whether a bridge can matter; none where the noise depends on the state."""
    if bridge.spread is None or barrier.radius is None:
        return ""
    band = np.sqrt(0.5 * EXPONENT) * np.linalg.norm(barrier.matrix @ bridge.spread, 2)
    near = max(barrier.radius - band, 0.0) if barrier.stay else barrier.radius + band
    limit = p.add(float(near**2))
    return f"max({old}, {new}) > {limit}" if barrier.stay else f"min({old}, {new}) < {limit}"
