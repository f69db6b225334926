"""The metric of least erosion of a model's constraints: proposed, certified, and compared by the tubes themselves.

`Tightening` shares between the constraints of one model what does not depend on them: the sets of Jacobians, the metric
of least c or L and its proof, and where the search for each constraint begins.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.constants.certification import certify
from certbound.constants.enclosures import random_points
from certbound.constants.jacobians import AffineSet, JacobianSet, affine_set
from certbound.constants.model_data import Model
from certbound.constants.programs import (
    ErosionSearch,
    Proposal,
    RadiusModel,
    Rooms,
    erosion_factors,
    sampled_polytope,
)
from certbound.constants.state_jacobian import StateJacobian
from certbound.errors import EnclosureError, InfeasibleError, SolverError
from certbound.problem.model import Tape, compile_numpy, jacobian
from certbound.problem.systems import ContinuousSystem, DiscreteSystem
from certbound.tubes.constants import Constants
from certbound.watch import poll

_MOST = 60
"""States beyond which samples propose nothing: each is a vertex, and no semidefinite program takes so many."""
_SAMPLES, _SMALL = 2000, 40
"""Jacobians that are sampled, up to so many states; fewer beyond, for each has n^2 numbers."""


class Tightening:
    """Certified constants of least erosion, for one set of constraints after the other.

    ``euclidean`` are the certified constants in the identity metric, which is always among the candidates.
    """

    def __init__(self, model: Model, euclidean: Constants, *, horizon: float, delta: float) -> None:
        self.model, self.euclidean, self.horizon, self.delta = model, euclidean, horizon, delta
        self.noise = noise_matrices(model)
        self._proved: dict[int, list[Constants]] = {}

    @cached_property
    def searches(self) -> list[ErosionSearch]:
        """One for each candidate set whose metric of least c or L was found."""
        model = self.model
        if model.dimension == 1 or not any(G.any() for G in self.noise):
            return []
        radius = RadiusModel(
            continuous=model.continuous, dimension=model.dimension, horizon=self.horizon, delta=self.delta,
            gaussian=is_gaussian(model),
        )  # fmt: skip

        def begun(members: JacobianSet) -> list[ErosionSearch]:
            return [ErosionSearch(members, self.noise, radius)]

        return [search for members in candidate_sets(model) for search in tried(partial(begun, members))]

    def best(self, targets: Rooms) -> Constants:
        """The constants whose tube erodes the targets least, among the identity metric and the proposals."""
        found = [self.euclidean]
        for search in self.searches:
            poll()
            for proposal in tried(partial(search.proposals, targets)):
                found += self._certified(proposal)
        if len(found) == 1:
            return self.euclidean
        return min(found, key=lambda constants: erosion_ratio(constants, targets, self.horizon, self.delta))

    def promise(self, targets: Rooms) -> float:
        """How much of its room a constraint loses beside others, in the metric that their searches start from."""
        metric = self.searches[0].start.metric if self.searches else np.eye(self.model.dimension)
        return float(np.max(erosion_factors(metric, targets.directions) / targets.rooms.min(axis=1)))

    def _certified(self, proposal: Proposal) -> list[Constants]:
        """The constants of a proposal; those of the searches' common start are proved once."""
        if all(proposal is not search.start for search in self.searches):
            return certified(self.model, proposal)
        if id(proposal) not in self._proved:
            self._proved[id(proposal)] = certified(self.model, proposal)
        return self._proved[id(proposal)]


def erosion_ratio(constants: Constants, rooms: Rooms, horizon: float, delta: float) -> float:
    """Largest erosion over room of the best quick tube, in floating point."""
    from certbound.tubes.tuning import tune_tube

    if constants.continuous:
        rooms = rooms.coarse(12)
    room = (rooms.rooms / erosion_factors(constants.matrix, rooms.directions)[:, None]).min(axis=0)
    if constants.continuous:  # both ends of a piece count
        times = np.concatenate([[0.0], rooms.times[:-1], [horizon]])
        values = np.minimum(room, np.concatenate([room[:1], room[:-1]]))
    else:
        steps = np.arange(1, int(horizon) + 1)
        values = np.concatenate([[np.inf], room[np.searchsorted(rooms.times, steps)]])
        times = np.arange(int(horizon) + 2.0)
    tube = tune_tube(constants, horizon=horizon, delta=delta, objective=(times, values))
    asked = np.isfinite(room)  # elsewhere nothing is asked, and an endless radius is no erosion
    with np.errstate(over="ignore"):  # a ratio beyond all floats is endless
        ratios = np.asarray(tube.radius(rooms.times))[asked] / room[asked]
    return float(np.max(ratios, initial=0.0))


def candidate_sets(model: Model) -> list[JacobianSet]:
    """Sets to propose for: all Jacobians, structured; and samples of them, where that set is loose or missing."""
    try:
        structured = model_set(model)
    except EnclosureError:
        structured = None
    given: list[JacobianSet] = [] if structured is None else [structured]
    slots = StateJacobian(model.dynamics, model.state_slots, model.ranges)
    bounded = bool(np.isfinite(slots.box.lo).all() and np.isfinite(slots.box.hi).all())
    if not bounded or not slots.active or (given and model.dimension > _MOST):
        return given
    count = int(_SAMPLES * min(1.0, (_SMALL / model.dimension) ** 2))
    matrices = slots.values(random_points(np.random.default_rng(0), slots.box, count))
    matrices = matrices[np.isfinite(matrices).all(axis=(1, 2))]
    if not len(matrices):
        return given
    sampled = sampled_polytope(matrices)
    if structured is None:
        return [sampled]
    directions = np.random.default_rng(1).normal(size=(16, model.dimension, model.dimension))
    widths = [members.support(directions) + members.support(-directions) for members in (structured, sampled)]
    loose = bool(np.any(widths[0] > 1.1 * widths[1] + 1e-12 * np.abs(structured.J0).max()))
    return [*given, sampled] if loose else given


def tried(propose: Callable[[], list[Any]]) -> list[Any]:
    """The proposals, or none where every solver stalls or overflows: the identity metric is there already."""
    try:
        return propose()
    except (SolverError, np.linalg.LinAlgError):
        return []


def certified(model: Model, proposal: Proposal) -> list[Constants]:
    try:
        return [certify(model, proposal.metric, status=proposal.status, tolerance=2e-3, budget=60_000)]
    except (EnclosureError, InfeasibleError, ValueError):  # whatever proposed it, a metric that is none is no candidate
        return []


def noise_matrices(model: Model) -> list[Array]:
    """Noise matrices at unit proxy: the constant one, or samples of a state-dependent diffusion."""
    system = model.system
    if isinstance(system, DiscreteSystem):
        values, vectors = np.linalg.eigh(np.asarray(system.noise.proxy, dtype=float))
        return [np.asarray(system.noise_matrix @ (vectors * np.sqrt(np.maximum(values, 0.0))))]
    assert isinstance(system, ContinuousSystem)
    if not isinstance(system.diffusion, Tape):
        return [np.asarray(system.diffusion, dtype=float)]
    points = random_points(np.random.default_rng(0), model.ranges[: model.dimension + 1], 16)
    with np.errstate(all="ignore"):
        values = np.broadcast_to(compile_numpy(system.diffusion)(*points.T), (16, *system.diffusion.shape))
    return [np.asarray(G) for G in values if np.all(np.isfinite(G))]


def is_gaussian(model: Model) -> bool:
    return not isinstance(model.system, DiscreteSystem) or bool(model.system.noise.gaussian)


def model_set(model: Model, *, tolerance: float = 1e-3) -> AffineSet:
    """The affine set of all Jacobians of a model over its ranges."""
    tape = jacobian(model.dynamics, model.state_slots)
    return affine_set(tape, [model.ranges[slot] for slot in range(len(model.ranges))], tolerance=tolerance)
