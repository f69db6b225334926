"""A one-step safety filter around any controller: the least change that keeps the noise-free state in the eroded set.

The filter carries the noise-free state z along, driven by the inputs that it lets through. At each step it solves

    min ||u - desired||^2  subject to  H_j(z+) >= (1 - decay) H_j(z),  u in its box,   H_j = h_j - e_j,

a quadratic program in u (the faces h_j linearised in u at z+, again after the first solution where they bend), with e_j
what the tube takes at that time: a discrete-time control barrier condition on the eroded set, asked
with slack where only H_j >= 0 can be kept.

What is guaranteed: the inputs may depend on anything in the past, measured states included, as long as z moves under
the same inputs: they act like a disturbance that reacts to the state. With a trajectory-level tube from certified
constants that hold for all inputs, and as long as every step kept H_j(z) >= 0, the noisy state of a discrete-time
system stays safe along the whole trajectory but for a probability of delta (``guaranteed``). In continuous time this
holds at the samples, up to the integrator's error. Nothing promises that the next step has a point: a step without one
is taken with slack, and ends the guarantee. (A system that can stand still has one always with ``steady``.)
"""

from __future__ import annotations

import importlib
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certbound.errors import SolverError
from certbound.problem.problem import Problem
from certbound.problem.sets import GaussianStart
from certbound.problem.trace import casadi_module
from certbound.safety.verification import Verdict, verify_safety
from certbound.synthesis.faces import Face, Round
from certbound.synthesis.planning import Planner
from certbound.tubes.constants import Constants
from certbound.tubes.tube import Tube

__all__ = ["FilterReport", "SafetyFilter"]

Array = NDArray[np.float64]

SLACK_WEIGHT = 1e6
KEPT = 1e-10
"""Room that must be left: more than the rounding of the noise-free state."""
AIM = 1e-7
"""Room that the program asks for on top, for its own tolerance."""
TURNS = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class FilterReport:
    """One step of the filter.

    Parameters
    ----------
    time : float
    input : ndarray, shape (m,)
        What to apply.
    changed : float
        Largest change of an input.
    feasible : bool
        The next noise-free state lies in the eroded set; otherwise it misses it by as little as the inputs allow.
    room : float
        Least H over the faces at the next noise-free state.
    seconds : float
    """

    time: float
    input: Array
    changed: float
    feasible: bool
    room: float
    seconds: float


class SafetyFilter:
    """Filters the inputs of any controller.

    Parameters
    ----------
    problem : Problem
        With inputs, without a disturbance; its delta and horizon are those of the guarantee.
    tube : str or Tube
        A tube method, or a tube.
    constants : Constants, optional
        Stated; certified ones for all inputs in one common metric when omitted.
    decay : float
        In (0, 1]: the share of the room that one step may use; 1 asks only that the next state is in the eroded set.
    steady : bool
        Take the largest tube at all times. The eroded set then does not shrink: a system that can stand still never
        runs out of inputs.
    steps : int, optional
        Samples of the horizon in continuous time.

    Raises
    ------
    ValueError
        If the system has no inputs or a disturbance, ``decay`` is out of range, the Jacobian depends on inputs without
        bounds, or the start lies outside the eroded set at the first step.

    Examples
    --------
    >>> import certbound as cb
    >>> system = cb.DiscreteSystem(lambda x, u: [x[0] + 0.1 * u[0]], states=1, inputs=cb.Box([-1], [1]),
    ...     noise=cb.Gaussian(std=0.001))
    >>> problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=30, delta=1e-3)
    >>> guard = SafetyFilter(problem)
    >>> applied = [float(guard.step([1.0]).input[0]) for _ in range(30)]
    >>> applied[0] == 1.0, applied[-1] < 0.1, guard.guaranteed
    (True, True, True)
    """

    def __init__(
        self,
        problem: Problem,
        *,
        tube: str | Tube = "auto",
        constants: Constants | None = None,
        decay: float = 0.5,
        steady: bool = False,
        steps: int | None = None,
    ) -> None:
        if problem.system.disturbance is not None:
            raise ValueError("`problem` must have no disturbance for the filter: its noise-free state is not known.")
        if isinstance(problem.initial, GaussianStart):
            raise ValueError("`problem` must start in a set for the filter, got a random start.")
        if not 0 < decay <= 1:
            raise ValueError(f"`decay` must lie in (0, 1], got {decay}.")
        self.problem, self.decay = problem, float(decay)
        self.planner = Planner(problem, steps=steps)
        self.tube = tube if isinstance(tube, Tube) else self._tube(tube, constants)
        start = self.planner.rollout(self.planner.guess())
        self._ball = self.planner.ball(self.tube, start)
        substeps = self.planner.grid.substeps
        radii = self._ball.radii[substeps - 1 :: substeps]
        self._radii = np.full_like(radii, self._ball.radii.max()) if steady else radii
        self._rooms, self._step = self._compiled()
        box = problem.system.inputs
        assert box is not None
        self._low, self._high = np.asarray(box.low), np.asarray(box.high)
        self._program = _Program(len(self.planner.faces), self._low, self._high)
        self.reset()

    def _tube(self, name: str, constants: Constants | None) -> Tube:
        """A tube of the metric that takes least where the obstacle may lie in any direction."""
        first = self.planner.first_plan()
        known = [constants] if constants is not None else [self.planner.constants(first.inputs)]
        if constants is None and known[0].metric is not None:
            known.append(self.planner.constants(first.inputs, metric="euclidean"))
        delta = float(self.problem.delta)
        tubes = [self.planner.tube_of(k, name, delta, first, {}) for k in known]
        return min(tubes, key=self._size)

    def _size(self, tube: Tube) -> float:
        """Sum of the logarithms of what a tube takes from the faces at most."""
        metric, last = tube.constants.metric, float(tube.radius(tube.horizon))
        inverse = np.eye(self.planner.plant.dimension) if metric is None else np.linalg.inv(np.asarray(metric))
        found = []
        for face in self.planner.faces:
            if isinstance(face, Round):
                block = inverse[np.ix_(face.coordinates, face.coordinates)]
                found.append(float(np.linalg.eigvalsh(face.matrix @ block @ face.matrix.T)[-1]) ** 0.5)
            else:
                rows = face.rows(np.zeros((1, face.dimension)), np.zeros(1))[0]
                found.append(float(np.einsum("ri,ij,rj->r", rows, inverse, rows).max()) ** 0.5)
        return float(np.sum(np.log(last * np.array(found) + 1e-300)))

    def _compiled(self) -> tuple[Any, Any]:
        """(z, t, r) -> H of all parts for the tube's radius r; (z, u, t, r) -> z+, H at z+, its derivative in u."""
        ca = casadi_module()
        planner = self.planner
        z, u = ca.SX.sym("z", planner.plant.dimension), ca.SX.sym("u", len(planner.plant.low))
        t, radius = ca.SX.sym("t"), ca.SX.sym("r")
        parts = []
        for face in planner.faces:
            taken = radius * _taken(ca, face, self._ball.inverse, z, t)
            for part in range(face.parts):
                choice = ca.DM(np.eye(face.parts)[part]) if face.weights else ca.DM(0, 1)
                parts.append(face.gap(ca, z, t, taken, choice))
        rooms = ca.Function("rooms", [z, t, radius], [ca.vertcat(*parts)])
        following = planner.plant.symbolic_step(ca, planner.grid, t, z, u)[-1]
        stacked = rooms(following, t + planner.grid.step, radius)
        step = ca.Function("step", [z, u, t, radius], [following, stacked, ca.jacobian(stacked, u)])
        return rooms, step

    def reset(self) -> None:
        """Back to the start of the problem."""
        self.index = 0
        self.state: Array = np.array(self.planner.start)
        self.applied: list[Array] = []
        constants = self.tube.constants
        self.guaranteed = constants.certified and self.tube.certified and self.tube.level == "trajectory"
        parts = self._rooms(self.state, 0.0, float(self._radii[0])).full()
        self._room, _ = self._chosen(0, parts.ravel(), np.zeros((len(parts), 0)))

    @property
    def time(self) -> float:
        """Of the next step."""
        return self.index * self.planner.grid.step

    def _asked(self, index: int) -> NDArray[np.bool_]:
        times = np.array([index * self.planner.grid.step])
        return np.concatenate([np.repeat(face.asked(times), face.parts) for face in self.planner.faces])

    def step(self, desired: ArrayLike) -> FilterReport:
        """The input nearest to ``desired`` that keeps the noise-free state in the eroded set.

        Parameters
        ----------
        desired : array_like, shape (m,)
            What the controller wants, from whatever it measured.

        Raises
        ------
        ValueError
            If the input has the wrong size or is not finite.
        """
        began = time.perf_counter()
        wanted = np.asarray(desired, dtype=float)
        if wanted.shape != self._low.shape or not np.all(np.isfinite(wanted)):
            raise ValueError(f"`desired` must hold {len(self._low)} finite inputs, got {desired!r}.")
        u = np.clip(wanted, self._low, self._high)
        known = np.where(np.isfinite(self._room), self._room, 0.0)  # nothing is known of a face not asked before
        needed = np.maximum((1 - self.decay) * known, 0.0)
        radius = float(self._radii[min(self.index, len(self._radii) - 1)])
        best = -np.inf
        for turn in range(TURNS):
            following, values, slope = (part.full() for part in self._step(self.state, u, self.time, radius))
            following = following.ravel()
            rooms, rows = self._chosen(self.index + 1, values.ravel(), slope)
            if turn == 0 or np.min(rooms - needed, initial=np.inf) > best:  # the linearisation may lead astray
                best, chosen = float(np.min(rooms - needed, initial=np.inf)), (u, following, rooms)
            if turn == TURNS - 1 or best >= KEPT:
                break
            kept = np.isfinite(rooms)
            u = self._program.solve(wanted, rows[kept], rows[kept] @ u - rooms[kept] + needed[kept] + AIM)
        u, following, rooms = chosen
        self._move(u, following, rooms)
        return FilterReport(
            time=self.time - self.planner.grid.step, input=u, changed=float(np.max(np.abs(u - wanted), initial=0.0)),
            feasible=bool(np.all(rooms >= KEPT)), room=float(np.min(rooms, initial=np.inf)),
            seconds=time.perf_counter() - began,
        )  # fmt: skip

    def _chosen(self, index: int, parts: Array, slope: Array) -> tuple[Array, Array]:
        """Room and slope of every face at one time: those of the best part; inf where it is not asked."""
        asked = self._asked(index)
        rooms, rows, part = [], [], 0
        for face in self.planner.faces:
            best = part + int(np.argmax(parts[part : part + face.parts]))
            rooms.append(parts[best] if asked[part] else np.inf)
            rows.append(slope[best])
            part += face.parts
        return np.array(rooms), np.array(rows)

    def _move(self, u: Array, following: Array, rooms: Array) -> None:
        self.applied.append(u)
        self.state, self.index, self._room = following, self.index + 1, rooms
        kept = bool(np.all(rooms >= KEPT))
        beyond = self.index * self.planner.grid.step > float(self.problem.horizon) * (1 + 1e-12)
        self.guaranteed = self.guaranteed and kept and not beyond

    def verify(self) -> Verdict:
        """The verdict on the inputs that were let through, as a plan that is carried out blindly.

        Raises
        ------
        ValueError
            If fewer steps were taken than the problem has.
        """
        count = self.planner.grid.steps
        if len(self.applied) < count:
            raise ValueError(f"`verify` needs all {count} steps, got {len(self.applied)}; call step() first.")
        whole = self.problem.replace(plan=np.array(self.applied[:count]))
        return verify_safety(whole, method="linear" if self.tube.method == "linear" else "auto")


class _Program:
    """min ||u - wanted||^2 + penalty * xi subject to rows u >= least - xi, xi >= 0, u in its box; Clarabel.

    All matrices keep one dense pattern, so that a solve costs no more than its numbers.
    """

    def __init__(self, faces: int, low: Array, high: Array) -> None:
        self._solver: Any = importlib.import_module("clarabel")
        sparse: Any = importlib.import_module("scipy.sparse")
        self._low, self._high, self._faces = low, high, faces
        m = len(low)
        above, below = np.isfinite(high), np.isfinite(low)
        self._bounds = np.concatenate([high[above], -low[below], [0.0]])
        self._dense = np.zeros((faces + len(self._bounds), m + 1))
        self._dense[faces:-1, :m] = np.concatenate([np.eye(m)[above], -np.eye(m)[below]])
        self._dense[:faces, m] = self._dense[-1, m] = -1.0
        rows, columns = self._dense.shape
        places = np.tile(np.arange(rows), columns), np.arange(columns + 1) * rows
        self._matrix = sparse.csc_matrix((self._dense.ravel(order="F"), *places), shape=self._dense.shape)
        self._weight = sparse.csc_matrix(np.eye(m + 1))
        self._settings = self._solver.DefaultSettings()
        self._settings.verbose = False
        self._cones = [self._solver.NonnegativeConeT(rows)]

    def solve(self, wanted: Array, rows: Array, least: Array) -> Array:
        """The input; faces that are not asked are left out of ``rows``."""
        m, count = len(wanted), len(rows)
        self._dense[: self._faces, :m] = 0.0
        self._dense[:count, :m] = -rows
        self._matrix.data[:] = self._dense.ravel(order="F")
        right = np.concatenate([-least, np.ones(self._faces - count), self._bounds])
        linear = np.append(-wanted, SLACK_WEIGHT)
        found = self._solver.DefaultSolver(
            self._weight, linear, self._matrix, right, self._cones, self._settings
        ).solve()
        answer = np.asarray(found.x)[:m]
        if not np.all(np.isfinite(answer)):
            raise SolverError(f"the filter's program was not solved ({found.status}); scale the inputs to like sizes.")
        return np.asarray(np.clip(answer, self._low, self._high))


def _taken(ca: Any, face: Face, inverse: Array, state: Any, time: Any) -> Any:
    """What a ball of radius 1 takes from every part of a face at a state."""
    if isinstance(face, Round) and face.outside:
        block = face.matrix @ inverse[np.ix_(face.coordinates, face.coordinates)] @ face.matrix.T
        image = ca.DM(face.matrix) @ face.relative(ca, state, time)
        return ca.sqrt(ca.bilin(ca.DM(block), image, image) / (ca.sumsqr(image) + 1e-300))
    rows = face.rows(np.zeros((1, face.dimension)), np.zeros(1))
    size = np.sqrt(np.einsum("kri,ij,krj->kr", rows, inverse, rows))
    return ca.DM(face.erosion(size)[0])
