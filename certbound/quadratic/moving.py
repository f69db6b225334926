"""A working box that moves along a noise-free path: x = p(t) + width xi.

p is a piecewise polynomial with exact coefficients; what it misses of the dynamics, p' - f(p, d0, t), is enclosed, and
so are its jumps at the nodes. A flat wall that stands still in x moves in xi: its row is linear in p, and lies within
h^2/8 sup |row p''| of its chord over a piece.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside, Quadratic
from certbound.quadratic.form_matrices import as_forms, ball_form, linear_form
from certbound.quadratic.setting import Condition, Setting, Start, Wall, outward_drift, refuse
from certbound.quadratic.surroundings import deviations
from certbound.reach.nominal import Curve, Flow, bound_defect, nominal_curve
from certbound.rigor.intervals import Interval, concatenate, stack

PAD = 1e-9
"""By how much more than the working box is looked at: jumps of the path must stay below."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Path:
    """A noise-free path.

    Attributes
    ----------
    times : ndarray, shape (K + 1,)
    disturbance : ndarray
        d0.
    range, nodes : Interval, shapes (K, n) and (K, 2, n)
        p over the pieces, and at their ends.
    bend, defect : Interval, shape (K, n)
        p'' and p' - f(p, d0, t) over the pieces.
    jumps : ndarray, shape (K - 1, n)
        Bounds of |p(t_k+) - p(t_k-)|.
    """

    times: Array
    disturbance: Array
    range: Interval
    nodes: Interval
    bend: Interval
    defect: Interval
    jumps: Array


def make_path(problem: Problem, pieces: int) -> Path:
    """The noise-free path from the middle of the starts under the middle disturbance.

    Raises
    ------
    InfeasibleError
        It could not be followed closely.
    """
    times = np.linspace(0.0, float(problem.horizon), pieces + 1)
    flow = Flow(problem)
    curve = nominal_curve(flow, problem.initial.middle, times=times)
    defect = bound_defect(flow, curve)[0]
    if not np.all(np.isfinite(defect.mag)):
        raise InfeasibleError("the noise-free path could not be followed closely.")
    ends = [curve.range(curve.offset(Interval.point(at)))[0] for at in (curve.starts, curve.ends)]
    return Path(
        times=np.append(curve.starts, curve.ends[-1]), disturbance=np.asarray(flow.centre_disturbance),
        range=curve.range()[0], nodes=stack(ends, axis=1), bend=_bend(curve), defect=defect, jumps=curve.jumps()[0].mag,
    )  # fmt: skip


def _bend(curve: Curve) -> Interval:
    """p'' over the pieces."""
    second = [series[2] for series in curve.series_over(curve.span)]
    return stack([part[0] for part in second], axis=-1) * Interval.point(2.0)


def moving_setting(problem: Problem, pieces: int, margin: float) -> Setting:
    """A box about the noise-free path, ``margin`` standard deviations beyond sampled deviations.

    Raises
    ------
    InfeasibleError
        The constraints or the path are of a kind that is not served.
    """
    refuse(problem)
    path = make_path(problem, pieces)
    reach, spread = deviations(problem, _nominal(problem, path))
    width = reach + margin * spread
    width = np.maximum(width, 1e-3 * max(float(np.max(width)), 1e-9))
    n = len(width)
    if np.any(path.jumps > 0.5 * PAD * width):
        raise InfeasibleError("the noise-free path has large jumps.")
    walls = [_side(problem, path, axis, sign) for axis, sign in itertools.product(range(n), (-1.0, 1.0))]
    for constraint in problem.constraints:
        walls += _walls(problem, path, constraint, width)
    start = _start(problem, path, width)
    return Setting(center=np.zeros(n), width=width, walls=tuple(walls), inside=as_forms([], n + 1), start=start,
                   path=path, pad=PAD)  # fmt: skip


def _nominal(problem: Problem, path: Path) -> Array:
    """The path at equal steps, in floating point, from Euler steps within the pieces."""
    drift, points = compile_numpy(problem.closed_loop), []
    for k, step in enumerate(np.diff(path.times)):
        x, part = path.nodes.mid[k, 0], step / 20
        for j in range(20):
            points.append(x)
            x = x + part * drift(path.times[k] + j * part, *x, *path.disturbance)
    return np.array(points)


def _start(problem: Problem, path: Path, width: Array) -> Start:
    region, first = problem.initial, path.nodes[0, 0]
    box = (region.hull() - first) / Interval.point(width)
    if not (np.all(box.lo > -1) and np.all(box.hi < 1)):
        raise InfeasibleError("the starts reach the boundary of the moving box.")
    for constraint in problem.constraints:
        if not constraint.outside:
            _check_inside(region.hull(), constraint)
    return Start(low=box.lo, high=box.hi, forms=as_forms([], len(width) + 1))


def _check_inside(box: Interval, constraint: Inside) -> None:
    n, region = len(box), constraint.region
    if isinstance(region.form, Quadratic):
        values = _ball(constraint, n)
        z = concatenate([box, Interval.point(np.ones(1))])
        held = bool((z.reshape(-1, 1) * values * z.reshape(1, -1)).sum().lo >= 0)
    else:
        held = all(((row * box).sum() + at).hi <= 0 for row, at in _functionals(constraint, n))
    if not held:
        raise InfeasibleError(f"the starts may touch the boundary of '{constraint.label}'.")


Functional = tuple[Interval, Interval]
"""normal (n,) and offset: x |-> normal . x + offset."""


def _functionals(constraint: Inside, n: int) -> list[Functional]:
    """The faces of a region, at most 0 inside it."""
    region = constraint.region
    normals, bounds = region.halfspaces()
    found = []
    for normal, bound in zip(normals, bounds):
        shift = (Interval.point(normal) * Interval.point(region.center_at())).sum() + Interval.point(bound)
        found.append((Interval.point(region.lifted(normal, n)), -shift))
    return found


def _rows(path: Path, width: Array, functional: Functional) -> Interval:
    """Rows over z at both ends of every piece, shape (K, 2, n + 1), widened by the bend of the path in between."""
    normal, offset = functional
    steps = Interval.point(path.times[1:]) - Interval.point(path.times[:-1])
    bend = Interval.point((path.bend * normal).sum(axis=-1).mag) * steps * steps * Interval.point(0.125)
    last = (path.nodes * normal).sum(axis=-1) + offset
    last = last + Interval(-bend.hi, bend.hi).reshape(-1, 1)
    sides = (normal * Interval.point(width)).reshape(1, 1, -1).broadcast_to((*last.shape, len(width)))
    return Interval(np.concatenate([sides.lo, last.lo[..., None]], axis=-1),
                    np.concatenate([sides.hi, last.hi[..., None]], axis=-1))  # fmt: skip


def _largest(rows: Interval, *, least: bool = False) -> Array:
    """The largest (least) value of rows . z over the padded box at both ends of the pieces, shape (K,)."""
    size = rows[..., :-1].mag.sum(axis=-1) * (1 + 2 * PAD) * (1 + 1e-14)
    if least:
        return np.asarray((rows[..., -1].lo - size).min(axis=1))
    return np.asarray((rows[..., -1].hi + size).max(axis=1))


def _side(problem: Problem, path: Path, axis: int, sign: float) -> Wall:
    """A side of the moving box: the same row at all times."""
    n = path.range.shape[1]
    low, high = np.zeros(n + 1), np.zeros(n + 1)
    low[axis] = high[axis] = sign
    low[n], high[n] = -1.0 - PAD, -1.0
    conditions = [Condition(k, Interval(low, high), as_forms([], n + 1), k) for k in range(len(path.times))]
    label = f"{problem.system.states[axis]} {'above' if sign > 0 else 'below'} its noise-free path"
    return Wall(label=label, row=None, forms=as_forms([], n + 1), moving=tuple(conditions))


def _walls(problem: Problem, path: Path, constraint: Inside, width: Array) -> list[Wall]:
    """The walls of a constraint, as far as the moving box reaches them."""
    n, region = len(width), constraint.region
    if isinstance(region.form, Quadratic):
        if _far(path, constraint, width):
            return []
        raise InfeasibleError(f"a moving box does not serve balls that it meets ('{constraint.label}').")
    functionals = _functionals(constraint, n)
    if constraint.outside:
        faces = [_rows(path, width, functional) for functional in functionals]
        met = np.all([_largest(face, least=True) <= 0 for face in faces], axis=0)
        conditions = [
            Condition(k + side, None, as_forms([-linear_form(face[k, side]) for face in faces], n + 1), k)
            for k in np.flatnonzero(met).tolist() for side in (0, 1)
        ]  # fmt: skip
        return [_wall(constraint.label, conditions, n)] if conditions else []
    walls = []
    for functional in functionals:
        rows = _rows(path, width, functional)
        drift = outward_drift(problem, *functional)
        forms = None if drift is None else _rows(path, width, drift)
        met = _largest(rows) >= 0
        conditions = [
            Condition(k + side, rows[k, side],
                      as_forms([] if forms is None else [linear_form(forms[k, side])], n + 1), k)
            for k in np.flatnonzero(met).tolist() for side in (0, 1)
        ]  # fmt: skip
        walls += [_wall(constraint.label, conditions, n)] if conditions else []
    return walls


def _wall(label: str, conditions: list[Condition], n: int) -> Wall:
    return Wall(label=label, row=None, forms=as_forms([], n + 1), moving=tuple(conditions))


def _far(path: Path, constraint: Inside, width: Array) -> bool:
    """Whether the moving box surely stays off the boundary of a ball."""
    n = len(width)
    form = _ball(constraint, n)
    whole = path.range + Interval.point(width * (1 + 2 * PAD)) * Interval(-1.0, 1.0)
    z = Interval(np.pad(whole.lo, [(0, 0), (0, 1)], constant_values=1.0),
                 np.pad(whole.hi, [(0, 0), (0, 1)], constant_values=1.0))  # fmt: skip
    values = (z[:, :, None] * form * z[:, None, :]).sum(axis=(-1, -2))
    return bool(np.all(values.hi < 0) if constraint.outside else np.all(values.lo > 0))


def _ball(constraint: Inside, n: int) -> Interval:
    """The form over (x, 1) that is at least 0 in a ball."""
    region = constraint.region
    radius = region.form.radius if isinstance(region.form, Quadratic) else 0.0
    return ball_form(region.center_at(), radius, region.places(n), np.zeros(n), np.ones(n))
