"""The affine model that a problem states: dX = (A X + c + E d) dt + G dW with constant coefficients, and its limits.

That the dynamics are affine is proved by the checker's own derivatives: they depend on nothing, no jump and no
boundary of where an operation is defined depends on a state or a disturbance, and nothing depends on time. The drift at
the middle of the start and of the disturbances then determines the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flint import arb, arb_mat

from certbound.checker.balls import column, is_positive_definite
from certbound.checker.expressions import Graph, Program, Undecided
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Constraint, Model, structure_of
from certbound.problem.model import Tape

_SLACK = arb(2) ** -38
"""Part of a variance by which reading a start's covariance may have raised it (`statement.problem`), and more."""

@dataclass(frozen=True, eq=False, kw_only=True)
class Affine:
    """dX = (A X + c + E d) dt + G dW from X_0 = m + e + N, in balls that hold the exact numbers.

    Parameters
    ----------
    slope : arb_mat
        A, (n, n).
    drift : arb_mat
        A m + c with the disturbances in the middle of their set, (n, 1): the mean's slope at time 0.
    disturbances : tuple of arb_mat
        E_j times the radius of the j-th disturbance, each (n, 1), of those that move a state.
    diffusion, noise : arb_mat
        G, (n, m), and G G^T, (n, n).
    middle, radius : arb_mat
        m and bounds of |e_i|, each (n, 1).
    covariance : arb_mat or None
        Of the normal N; None where the start is a set.
    """

    slope: arb_mat
    drift: arb_mat
    disturbances: tuple[arb_mat, ...]
    diffusion: arb_mat
    noise: arb_mat
    middle: arb_mat
    radius: arb_mat
    covariance: arb_mat | None


@dataclass(frozen=True, eq=False, kw_only=True)
class Limit:
    """row . X <= bound, at all times or ``during`` a window of time."""

    label: str
    row: list[float]
    bound: arb
    during: tuple[float, float] | None


def affine_of(model: Model, budget: Budget) -> Affine:
    """The affine model; Unproved where the problem is not shown to be one, in continuous time and without a target."""
    _refuse_others(model)
    structure, n = structure_of(model, budget), model.dimension
    jacobians = (structure.states, structure.disturbances)
    if any(one.varying for one in jacobians) or any(structure.hidden(model, i) for i in range(n)):
        raise Unproved("this proof needs dynamics that are affine in the states and the disturbances")
    if any(structure.graph.masks[output] & 1 for output in structure.outputs):
        raise Unproved("this proof needs dynamics that do not change with time")
    budget.hold(n * (4 * n + 2 * len(model.disturbance)))
    slope, gains = (one.matrix([]) for one in jacobians)
    initial = model.initial
    middle = [((a + b) / 2).mid() for a, b in zip(initial.low, initial.high)]
    radius = [arb.max(b - m, m - a).upper() for a, b, m in zip(initial.low, initial.high, middle)]
    centre = [((arb(a) + arb(b)) / 2).mid() for a, b in model.disturbance]
    reach = [arb.max(arb(b) - m, m - arb(a)).upper() for (a, b), m in zip(model.disturbance, centre)]
    disturbances = [[gains[i, j] * value for i in range(n)] for j, value in enumerate(reach)]
    budget.products(n, n, 8)
    origin = column(_values(model, [arb(0)] * n, centre, budget))
    covariance = initial.covariance
    return Affine(
        slope=slope, drift=slope * column(middle) + origin, diffusion=model.noise.constant(),
        noise=model.noise.covariance(), middle=column(middle),
        radius=column(radius if covariance is None else [arb(0)] * n),
        disturbances=tuple(column(one) for one in disturbances if not all(x.is_zero() for x in one)),
        covariance=None if covariance is None else _as_stated(covariance),
    )  # fmt: skip


def _refuse_others(model: Model) -> None:
    if not model.continuous or model.target is not None or model.hold is not None:
        raise Unproved("this proof needs continuous time, no target, and no inputs that are held")
    if isinstance(model.noise.diffusion, Tape):
        raise Unproved("this proof needs noise that depends neither on the state nor on time")
    if model.changes is not None or (model.plan is not None and any(row != model.plan[0] for row in model.plan)):
        raise Unproved("this proof needs inputs that do not change")


def _as_stated(covariance: arb_mat) -> arb_mat:
    """A covariance as a ball that holds the stated one too, should reading it have raised its variances."""
    n = covariance.nrows()
    entries = covariance.entries()
    for i in range(n):
        value = entries[i * n + i]
        entries[i * n + i] = value.union(value * (1 - _SLACK))
    return arb_mat(n, n, entries)


def _values(model: Model, states: Sequence[arb], disturbances: Sequence[arb], budget: Budget) -> list[arb]:
    """The dynamics at a point, under the plan's only row."""
    graph = Graph(budget)
    slots = [graph.input(slot) for slot in range(len(model.dynamics.inputs))]
    nodes = graph.include(model.dynamics, slots)
    program = Program(graph, [nodes[output] for output in model.dynamics.outputs], variables=0)
    inputs = [] if model.plan is None else [arb(x) for x in model.plan[0]]
    program.prepare([arb(0), *states, *inputs, *disturbances])
    try:
        return program.run([])
    except Undecided as error:
        raise Unproved("the dynamics are not defined at 0") from error


def limits_of(model: Model, budget: Budget) -> list[Limit]:
    """The limits in the order of the constraints and their faces; Unproved of what is no fixed half-space."""
    found = []
    for constraint in model.constraints:
        budget.check()
        found += _faces(constraint, model.dimension, budget)
    return found


def _faces(constraint: Constraint, n: int, budget: Budget) -> list[Limit]:
    region = constraint.region
    if isinstance(region.center, Tape):
        raise Unproved(f"this proof needs limits that do not move, and \"{constraint.label}\" does")
    if region.round or (not constraint.inside and len(region.bounds) != 1):
        raise Unproved(f"this proof needs limits that are half-spaces, and \"{constraint.label}\" is something else")
    count = len(region.bounds)
    budget.balls(count * (4 + 2 * len(region.coordinates) + n // 4))
    budget.hold(count * (n + 2))
    sign = 1 if constraint.inside else -1  # an obstacle a x <= b is kept off where -a x <= -b
    found = []
    for number, bound in enumerate(region.bounds):
        face = region.faces[number]
        offset = arb(bound) + sum((arb(a) * arb(x) for a, x in zip(face, region.center)), arb(0))
        row = [0.0] * n
        for place, value in zip(region.coordinates, face):
            row[place] = sign * value
        found.append(Limit(label=constraint.label, row=row, bound=sign * offset, during=constraint.during))
    return found


def split_source(affine: Affine, loss: arb_mat | None, budget: Budget) -> tuple[arb_mat, arb_mat | None]:
    """M+ and M- (None: 0), both positive semidefinite, with dV/dt = F (M+ - M-) F^T; Unproved where M+ is not.

    Without a random start M+ = G G^T. Else M- = L L^T with the file's L, and M+ = A V_0 + V_0 A^T + G G^T + M-.
    """
    if affine.covariance is None:
        if loss is not None:
            raise Unproved("`loss` is of a normal start")
        return affine.noise, None
    if loss is None:
        raise Unproved("a normal start needs `loss`")
    n = affine.slope.nrows()
    budget.products(n, n, 4 * n)
    moved = affine.slope * affine.covariance
    lost = loss * loss.transpose()
    gained = moved + moved.transpose() + affine.noise + lost
    if not is_positive_definite(gained, budget):
        raise Unproved("what the variance gains was not shown to be positive")
    return gained, lost
