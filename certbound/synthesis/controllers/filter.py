"""A one-step safety filter around any controller: the least change that keeps the noise-free state in the eroded set.

The filter carries the noise-free state z along, driven by the inputs that it lets through. At each step it solves

    min ||u - desired||^2  subject to  H_j(z+) >= (1 - decay) H_j(z),  u in its box,   H_j = h_j - e_j,

a quadratic program in u (the faces h_j linearised in u at z+, again after the first solution where they bend), with e_j
what the tube takes at that time: a discrete-time control barrier condition on the eroded set, asked
with slack where only H_j >= 0 can be kept.

What is guaranteed: the inputs may depend on anything in the past, measured states included, as long as z moves under
the same inputs: they act like a disturbance that reacts to the state. With a trajectory-level tube from certified
constants that hold for all inputs, and as long as every step was proved (`certbound.synthesis.controllers.held_steps`:
the program above only proposes), the noisy state stays safe along the whole trajectory but for a probability of delta
(``guaranteed``); in continuous time between the samples as well, for inputs that are held from one to the next. Where
the proof misses what the program found, the program is asked for more room. Nothing promises that the next step has a
point: a step without one is taken with slack, and ends the guarantee. (A system that can stand still has one always
with ``steady``.)
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.checks import instance
from certbound.constants.matching import check_constants
from certbound.errors import CertboundError
from certbound.problem.adapters import casadi_module
from certbound.problem.model import compile_numpy, jacobian
from certbound.problem.problem import Problem
from certbound.safety.verification import Verdict, verify_safety
from certbound.synthesis.controllers.held_steps import SPARE, HeldSteps, Link, ProvedStep
from certbound.synthesis.controllers.nearest_input import NearestInput
from certbound.synthesis.faces import Face, Round
from certbound.synthesis.planning import Planner, check_tube
from certbound.tubes.constants import Constants
from certbound.tubes.tube import Tube

KEPT = 1e-10
"""Room that must be left: more than the rounding of the noise-free state."""
AIM = 1e-7
"""Room that the program asks for on top, for its own tolerance."""
TURNS = 4
ATTEMPTS = 4
"""Proofs of one step that are tried, each with more room than the last."""
AHEAD = 1.5
"""Times the room that a proof missed, which the next attempt asks for."""
FORGET = 0.5
"""Share of such room that is asked for at the next step again."""
ANGLE = 0.25
"""||D_x f|| times a Runge-Kutta step of the program, at most."""
MOST_SUBSTEPS = 16


@dataclass(frozen=True, eq=False, kw_only=True)
class FilterReport:
    """One step of the filter."""

    time: float
    input: Array  # (m,): what to apply
    changed: float  # largest change of an input
    # The step is proved: everything within the tube around the noise-free path keeps the constraints up to the next
    # sample. Otherwise they are missed by as little as the program found.
    feasible: bool
    room: float  # least H over the faces at the next noise-free state, in floating point
    seconds: float


class SafetyFilter:
    """Filters the inputs of any controller.

    Parameters
    ----------
    problem : Problem
        With inputs, without a disturbance; its delta and horizon are those of the guarantee.
    method : str
        Of the tube, as in `certbound.tune_tube`.
    tube : Tube, optional
        One for the problem's delta (or less) and horizon (or more), of its own constants, in place of a method.
    constants : Constants, optional
        Stated, or certified for this problem; certified ones for all inputs in one common metric when omitted.
    decay : float
        In (0, 1]: the share of the room that one step may use; 1 asks only that the next state is in the eroded set.
    steady : bool
        Take the largest tube at all times. The eroded set then does not shrink: a system that can stand still never
        runs out of inputs.
    steps : int, optional
        Samples of the horizon in continuous time.

    Attributes
    ----------
    guaranteed : bool
    reason : str
        Why it is not; empty while it is.

    Raises
    ------
    ValueError
        If the system has no inputs or a disturbance, ``decay`` is out of range, the Jacobian depends on inputs without
        bounds, or the tube or the constants do not belong to the problem.

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
        method: str = "auto",
        tube: Tube | None = None,
        constants: Constants | None = None,
        decay: float = 0.5,
        steady: bool = False,
        steps: int | None = None,
    ) -> None:
        instance("problem", problem, Problem)
        if problem.system.disturbance is not None:
            raise ValueError("`problem` must have no disturbance for the filter: its noise-free state is not known.")
        if problem.initial.random:
            raise ValueError("`problem` must start in a set for the filter, got a random start.")
        if not 0 < decay <= 1:
            raise ValueError(f"`decay` must lie in (0, 1], got {decay}.")
        self.problem, self.decay = problem, float(decay)
        self.planner = Planner(problem, steps=steps)
        guess = self.planner.guess()
        whole = problem.replace(plan=None)
        if tube is not None:
            check_tube(whole, tube)
            if tube.delta > whole.delta:
                raise ValueError(f"`tube` must have delta <= {whole.delta:g}, got {tube.delta:g}; tune it for that.")
            check_constants(whole, tube.constants, "tube")
        elif constants is not None:
            check_constants(whole, constants)
        self.tube = self._tube(method, constants) if tube is None else tube
        self._radii = self._floating_radii(steady)
        self._grid = replace(self.planner.grid, substeps=self._substeps(guess[0]))
        self._rooms, self._step = self._compiled()
        box = problem.system.inputs
        assert box is not None
        self._low, self._high = np.asarray(box.low), np.asarray(box.high)
        self._program = NearestInput(len(self.planner.faces) * self._grid.substeps, self._low, self._high)
        times = np.linspace(0.0, float(problem.horizon), self._grid.steps + 1)
        self._proofs = HeldSteps(problem=problem.replace(plan=guess), tube=self.tube, times=times)
        self._start = self._proofs.start(self.planner.start)
        self.reset()

    def _floating_radii(self, steady: bool) -> Array:
        """Radius of the tube and the initial set together over every step, for the program."""
        self._ball = self.planner.ball(self.tube, self.planner.rollout(self.planner.guess()))
        radii = self._ball.radii.reshape(self.planner.grid.steps, -1).max(axis=1)
        if self.planner.grid.continuous:  # the next step begins where this one ends
            radii = SPARE * np.maximum(radii, np.append(radii[1:], 0.0))
        return np.full_like(radii, radii.max()) if steady else radii

    def _substeps(self, inputs: Array) -> int:
        """Runge-Kutta steps of the program in one sample."""
        grid, plant = self.planner.grid, self.planner.plant
        if not grid.continuous:
            return 1
        slopes = compile_numpy(jacobian(plant.dynamics, range(1, 1 + plant.dimension)))
        slope = slopes(0.0, *self.planner.start, *inputs)
        turn = np.nan_to_num(np.linalg.norm(np.nan_to_num(slope), 2)) * grid.step
        return int(np.clip(np.ceil(turn / ANGLE), grid.substeps, MOST_SUBSTEPS))

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
        last, inverse = float(tube.radius(tube.horizon)), tube.constants.inverse
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
        """(z, t, r) -> H of all parts for radii r of the faces; (z, u, t, r) -> z+, H at all points, its slope in u."""
        ca = casadi_module()
        planner, grid = self.planner, self._grid
        z, u = ca.SX.sym("z", planner.plant.dimension), ca.SX.sym("u", len(planner.plant.low))
        t, radii = ca.SX.sym("t"), ca.SX.sym("r", len(planner.faces))
        parts = []
        for index, face in enumerate(planner.faces):
            taken = radii[index] * _taken(ca, face, self._ball.inverse, z, t)
            for part in range(face.parts):
                choice = ca.DM(np.eye(face.parts)[part]) if face.weights else ca.DM(0, 1)
                parts.append(face.gap(ca, z, t, taken, choice))
        rooms = ca.Function("rooms", [z, t, radii], [ca.vertcat(*parts)])
        points = planner.plant.symbolic_step(ca, grid, t, z, u)
        length = grid.step / grid.substeps
        stacked = ca.vertcat(*(rooms(point, t + (i + 1) * length, radii) for i, point in enumerate(points)))
        step = ca.Function("step", [z, u, t, radii], [points[-1], stacked, ca.jacobian(stacked, u)])
        return rooms, step

    def reset(self) -> None:
        """Back to the start of the problem."""
        self.index = 0
        self.state: Array = np.array(self.planner.start)
        self.applied: list[Array] = []
        self._link: Link | None = self._start[0]
        self._extra = np.zeros(len(self.planner.faces))
        self.reason = self._reason_at_start(self._start[1])
        self._room = self._room_at(self.state, 0)

    def _reason_at_start(self, kept: bool) -> str:
        if not self.tube.constants.certified:
            return "the constants are stated, not proved"
        if not self.tube.certified or self.tube.level != "trajectory":
            return f"the tube {self.tube.method} bounds no whole trajectory with a proof"
        return "" if kept else "the initial set is not proved to keep the constraints at step 0"

    @property
    def guaranteed(self) -> bool:
        """Whether P(a constraint is broken up to the time reached) <= delta is proved."""
        return not self.reason

    @property
    def time(self) -> float:
        """Of the next step."""
        return self.index * self.planner.grid.step

    def _radius(self, index: int) -> float:
        return float(self._radii[min(index, len(self._radii) - 1)])

    def _room_at(self, state: Array, index: int) -> Array:
        """H of every face at the sample ``index``, with the tube's radius over the step before."""
        radii = np.full(len(self.planner.faces), self._radius(max(index - 1, 0)))
        parts = self._rooms(state, index * self.planner.grid.step, radii).full().ravel()
        return self._chosen([index * self.planner.grid.step], parts, np.zeros((len(parts), 0)))[0]

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
        now = self.time
        u, following, found, why = self._attempted(wanted)
        self._move(u, following, found, why)
        return FilterReport(
            time=now, input=u, changed=float(np.max(np.abs(u - wanted), initial=0.0)), feasible=not why,
            room=float(np.min(self._room, initial=np.inf)), seconds=time.perf_counter() - began,
        )  # fmt: skip

    def _attempted(self, wanted: Array) -> tuple[Array, Array, ProvedStep | None, str]:
        """An input, the state that the program expects, the proof of the step, and why there is none ('' if proved)."""
        known = np.where(np.isfinite(self._room), self._room, 0.0)  # nothing is known of a face not asked before
        needed = np.maximum((1 - self.decay) * known, 0.0)
        best: tuple[Array, Array, ProvedStep | None, str] | None = None
        extra = FORGET * self._extra
        for _ in range(ATTEMPTS):
            u, following, fits = self._proposed(wanted, needed, self._radius(self.index) + extra)
            found, why = self._proved(u)
            if best is None or _better(found, best[2]):
                best, self._extra = (u, following, found, why), extra
            if not fits or found is None or np.all(found.room >= 0):
                break
            missed = np.maximum(-found.room, 0.0)
            extra = extra + AHEAD * missed[[face.constraint for face in self.planner.faces]]
        assert best is not None
        return best

    def _proved(self, u: Array) -> tuple[ProvedStep | None, str]:
        """The proof of the next step under an input, and what it lacks."""
        when = f"the step from t = {self.time:.6g}"
        if self.index >= self._grid.steps:
            return None, "the horizon is over"
        if self._link is None:
            return None, "the noise-free path was lost at an earlier step"
        try:
            found = self._proofs.advance(self._link, self.state, self.index, u)
        except (CertboundError, ValueError) as error:
            return None, f"{when} could not be proved: {error}"
        if found.proved:
            return found, ""
        return found, f"{when} is not proved to keep '{self.problem.constraints[int(np.argmin(found.room))].label}'"

    def _proposed(self, wanted: Array, needed: Array, radii: Array) -> tuple[Array, Array, bool]:
        """Input, state that follows, and whether H >= needed up to rounding, by the program in floating point."""
        u = np.clip(wanted, self._low, self._high)
        needed = np.tile(needed, self._grid.substeps)
        length = self._grid.step / self._grid.substeps
        times = self.time + length * np.arange(1, self._grid.substeps + 1)
        best, chosen = -np.inf, (u, self.state)
        for turn in range(TURNS):
            following, values, slope = (part.full() for part in self._step(self.state, u, self.time, radii))
            rooms, rows = self._chosen(times, values.ravel(), slope)
            least = float(np.min(rooms - needed, initial=np.inf))
            if turn == 0 or least > best:  # the linearisation may lead astray
                best, chosen = least, (u, following.ravel())
            if turn == TURNS - 1 or best >= KEPT or not np.all(np.isfinite(slope)):
                break
            kept = np.isfinite(rooms)
            u = self._program.solve(wanted, rows[kept], rows[kept] @ u - rooms[kept] + needed[kept] + AIM)
        return *chosen, best >= KEPT

    def _chosen(self, times: ArrayLike, parts: Array, slope: Array) -> tuple[Array, Array]:
        """Room and slope of every face at every time: those of the best part; inf where it is not asked."""
        at = np.asarray(times, dtype=float)
        asked = [face.asked(at) for face in self.planner.faces]
        rooms, rows, part = [], [], 0
        for k in range(len(at)):
            for face, due in zip(self.planner.faces, asked):
                best = part + int(np.argmax(parts[part : part + face.parts]))
                rooms.append(parts[best] if due[k] else np.inf)
                rows.append(slope[best])
                part += face.parts
        return np.array(rooms), np.array(rows)

    def _move(self, u: Array, following: Array, found: ProvedStep | None, why: str) -> None:
        self.applied.append(u)
        self.state, self.index = following if found is None else found.state, self.index + 1
        self._link = None if found is None else found.link
        self._room = self._room_at(self.state, self.index)
        self.reason = self.reason or why

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


def _better(found: ProvedStep | None, best: ProvedStep | None) -> bool:
    """Whether one attempt leaves more than another."""
    if found is None or best is None:
        return best is None and found is not None
    return (found.proved, found.room.min(initial=np.inf)) > (best.proved, best.room.min(initial=np.inf))


def _taken(ca: Any, face: Face, inverse: Array, state: Any, time: Any) -> Any:
    """What a ball of radius 1 takes from every part of a face at a state."""
    if isinstance(face, Round) and face.outside:
        block = face.matrix @ inverse[np.ix_(face.coordinates, face.coordinates)] @ face.matrix.T
        image = ca.DM(face.matrix) @ face.relative(ca, state, time)
        return ca.sqrt(ca.bilin(ca.DM(block), image, image) / (ca.sumsqr(image) + 1e-300))
    rows = face.rows(np.zeros((1, face.dimension)), np.zeros(1))
    size = np.sqrt(np.einsum("kri,ij,krj->kr", rows, inverse, rows))
    return ca.DM(face.erosion(size)[0])
