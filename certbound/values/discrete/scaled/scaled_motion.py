"""One step x -> N(m(t, x), diag(S(t, x))) on a grid: mean, variances and their derivatives, at nodes and over cells."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.model import Tape, compile_numpy, jacobian, substitute, trace
from certbound.problem.problem import Problem
from certbound.problem.systems import DiscreteSystem
from certbound.rigor.intervals import Interval
from certbound.values.discrete.shocks import Inapplicable, Shocks, shocks_of
from certbound.values.discrete.steps import Dynamics, evaluate
from certbound.values.grids import Grid
from certbound.values.sets import active_at, box_around

Alpha = tuple[int, ...]

_MOST_NODES = 20_000  # of the tapes of fourth derivatives
_SAMPLES = 33
_LEAST = 0.02  # of the typical noise
_UNIT = 2.0**-53
_ORDERS = [a for a in itertools.product(range(5), repeat=2) if sum(a) <= 4 and sorted(a) != [1, 3]]
"""Derivatives that fourth derivatives d_jj d_ii of a function of m and S are made of."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Jets:
    """Derivatives of (m_1 ... m_n, S_1 ... S_n) on some boxes, shape (boxes, 2 n) each, and where all of them hold."""

    parts: dict[Alpha, Interval]
    sure: Mask


class ScaledDynamics(Dynamics):
    """The closed loop of a problem in two states whose Gaussian noise depends on t or the state.

    Parameters
    ----------
    problem : Problem
        In discrete time, without disturbances; every entry of the noise moves one state at most.

    Raises
    ------
    Inapplicable
        If the problem is none of these; the message says why.
    """

    def __init__(self, problem: Problem, parts: int = 4) -> None:
        system = problem.system
        assert isinstance(system, DiscreteSystem)
        assert system.gain is not None
        if system.dimension != 2 or system.disturbance_names or not system.noise.gaussian:
            raise Inapplicable(
                "smooth value functions take a noise matrix that depends on t or the states in two states, with "
                "Gaussian noise and without disturbances."
            )
        super().__init__(problem, parts)
        self.gain, self.covariance = system.gain, system.noise.enclosed_covariance()
        self._check_entries()
        variances = self._variances()
        clock = {index for index, node in enumerate(variances.nodes) if node.op == "input" and node.args[0] == 0}
        used = {arg for node in variances.nodes if node.op != "input" for arg in node.args} | set(variances.outputs)
        self.steady = self.steady and not clock & used
        self.tapes = {alpha: [_derived(self.tape, alpha), _derived(variances, alpha)] for alpha in _ORDERS}
        if max(len(tape.nodes) for pair in self.tapes.values() for tape in pair) > _MOST_NODES:
            raise Inapplicable("value functions cannot follow so long a model with noise that the state multiplies.")

    def _check_entries(self) -> None:
        apart = "value functions need noise entries that are independent and move one state each, where the noise "
        apart += "matrix depends on t or the states."
        off = [self.covariance.mag[j, k] for j, k in itertools.permutations(range(len(self.covariance)), 2)]
        rows, columns = self.gain.shape
        nothing = [self.gain.nodes[output] for output in self.gain.outputs]
        zero = np.array([node.op == "const" and node.value == 0.0 for node in nothing]).reshape(rows, columns)
        if np.any(off) or np.any((~zero).sum(axis=0) > 1):
            raise Inapplicable(apart)

    def _variances(self) -> Tape:
        """S as a tape over (t, x); the law's variances are rounded, which `spread` pays for."""
        rows, columns = self.gain.shape
        names = [f"g {k}" for k in range(rows * columns)]
        size = np.diagonal(self.covariance.mid)
        square = trace(lambda g: [sum(float(size[j]) * g[i * columns + j] ** 2 for j in range(columns))
                                  for i in range(rows)], {"g": names})  # fmt: skip
        return substitute(square, self.gain.inputs, {name: (self.gain, k) for k, name in enumerate(names)})

    @property
    def spread(self) -> float:
        """How far the law's variances may be from their floats, relative to them."""
        radius, middle = np.diagonal(self.covariance.rad), np.diagonal(self.covariance.mid)
        return float(np.max(radius / np.where(middle > 0, middle, 1.0))) + 4 * _UNIT

    def sizes(self, points: Array) -> Array:
        """Standard deviations at points (P, n) at step 0, in plain floats."""
        found = compile_numpy(self.tapes[0, 0][1])(0.0, *points.T)
        return np.asarray(np.sqrt(np.maximum(np.nan_to_num(np.broadcast_to(found, points.shape)), 0.0)))

    def jets(self, t: int, boxes: Interval, order: int) -> Jets:
        """All derivatives that are needed, up to an order, over some boxes."""
        arguments = self.arguments(t, boxes, Interval.point(np.zeros(0)))
        sure = np.ones(len(boxes), dtype=bool)
        parts = {}
        for alpha, pair in self.tapes.items():
            if sum(alpha) > order:
                continue
            found = [evaluate(tape, arguments if k == 0 else arguments[: 1 + self.n]) for k, tape in enumerate(pair)]
            ends = [np.concatenate([np.broadcast_to(getattr(one[0], end), (len(boxes), self.n)) for one in found],
                                   axis=1) for end in ("lo", "hi")]  # fmt: skip
            sure &= np.isfinite(ends).all(axis=(0, 2))
            for _, undefined, jumps in found:
                sure &= ~undefined & ~jumps
            parts[alpha] = Interval(*ends)
        return Jets(parts=parts, sure=sure)


def _derived(tape: Tape, alpha: Alpha) -> Tape:
    """A vector's partial derivative by the states."""
    for axis, count in enumerate(alpha):
        for _ in range(count):
            tape = jacobian(tape, [1 + axis])
            tape = Tape(inputs=tape.inputs, nodes=tape.nodes, outputs=tape.outputs, shape=(len(tape.outputs),))
    return tape


def cells_and_nodes(dynamics: ScaledDynamics, t: int, grid: Grid) -> tuple[Jets, Jets]:
    """Jets over the cells, and at the nodes up to order 2."""
    return dynamics.jets(t, grid.cells(), 4), dynamics.jets(t, Interval.point(grid.nodes()), 2)


def dynamics_of(problem: Problem, parts: int) -> Dynamics:
    """The closed loop, with its noise where that depends on t or the state."""
    system = problem.system
    scaled = isinstance(system, DiscreteSystem) and system.gain is not None
    return ScaledDynamics(problem, parts) if scaled else Dynamics(problem, parts)


def noise_of(problem: Problem, dynamics: Dynamics) -> Shocks:
    """The noise of one step; where it depends on the state, what grids need to know of it, in plain floats."""
    system = problem.system
    assert isinstance(system, DiscreteSystem)
    if not isinstance(dynamics, ScaledDynamics):
        return shocks_of(system.noise, system.noise_matrix)
    ends = box_around(active_at(problem.safe if problem.ending else problem.kept, 0), dynamics.n, 0)
    low, high = (problem.domain.low, problem.domain.high) if problem.ending else ends
    if not np.isfinite([low, high]).all():
        raise Inapplicable("value functions need limits on both sides of every state where the state multiplies noise.")
    coarse = Grid(axes=tuple(np.linspace(a, b, _SAMPLES) for a, b in zip(low, high)))
    least = dynamics.jets(0, coarse.cells(), 0).parts[0, 0].lo[:, dynamics.n :]
    middle = np.median(dynamics.sizes(coarse.nodes()), axis=0)
    if not np.all(least > (_LEAST * middle) ** 2):
        raise Inapplicable(
            "smooth value functions need noise of its own on every state, and nowhere in the safe set much less of it "
            "than elsewhere."
        )
    return Shocks(sigma=Interval.point(middle), factor=Interval.point(np.zeros(dynamics.n)), sizes=dynamics.sizes)
