"""The same paths under another probability: noise that is pushed along a plan, so that failing is likely.

Theorem (Girsanov; Neyman and Pearson). Let dX = (f + G u) dt + G dW under Q, u a function of time alone, with c^2 the
integral of |u|^2. Whatever has probability q or more under Q, has at least 1 - Phi(Phi^-1(1 - q) + c) under P, where
dX = f dt + G dW: log dP/dQ is normal with variance c^2, and of all events with probability q that where it is least has
the least P. In discrete time with normal noise w the same holds for w + v, c^2 the sum of v' Cov(w)^-1 v.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.gaussian.scalar import log_tail, log_tail_below
from certbound.problem.model import Graph
from certbound.problem.problem import Problem
from certbound.problem.sets import Box
from certbound.problem.systems import ContinuousSystem, DiscreteSystem
from certbound.reach.below.breaches import Breach, breaches
from certbound.reach.linear import FEWEST_PIECES, Linearisation
from certbound.watch import poll

_ROUNDS = 10
_CLOSE = 0.05  # of a standard deviation
_WIDEST = 8.0
_HALVINGS = 60


class Pushed:
    """A problem under pushed noise; its plan is that of the problem, if it has an array, and the pushes beside it."""

    def __init__(self, problem: Problem) -> None:
        system, loop, before = problem.system, problem.closed_loop, problem.input_sequence
        self.problem, self.before = problem, before
        own = loop.inputs[1 + system.dimension : len(loop.inputs) - len(system.disturbance_names)]
        taken = "_".join((*system.states, *loop.inputs))  # longer than each of them
        names = tuple(f"{taken}_{k + 1}" for k in range(system.noise_dimension))
        graph = Graph(("t", *system.states, *own, *names, *system.disturbance_names))
        slots = {name: graph.input(slot) for slot, name in enumerate(graph.inputs)}
        rates = loop.evaluate(graph.arithmetic(), [slots[name] for name in loop.inputs])
        gain = np.asarray(system.diffusion if isinstance(system, ContinuousSystem) else system.noise_matrix)
        for i, j in np.argwhere(gain).tolist():
            term = graph.apply("mul", graph.const(float(gain[i, j])), slots[names[j]])
            rates[i] = graph.apply("add", rates[i], term)
        tape = graph.tape(rates, (system.dimension,))
        wide = np.full(len(own) + len(names), np.inf)
        self.system: ContinuousSystem | DiscreteSystem
        signals: dict[str, Any] = {
            "inputs": Box(-wide, wide), "input_names": (*own, *names), "disturbance": system.disturbance,
            "disturbance_names": system.disturbance_names or None,
        }  # fmt: skip
        if isinstance(system, ContinuousSystem):
            self.system = ContinuousSystem(tape, states=system.states, diffusion=system.diffusion, **signals)
            rows = 1 if before is None else len(before)
            self.count = rows * -(-FEWEST_PIECES // rows)
            self.weight = np.full(len(names), float(problem.horizon) / self.count)
        else:
            self.system = DiscreteSystem(
                tape, states=system.states, noise=system.noise, noise_matrix=system.noise_matrix, **signals)
            self.count = int(problem.horizon)
            self.weight = 1 / np.diag(np.asarray(system.noise.proxy))

    def under(self, pushes: Array) -> Problem:
        """The problem with pushes (count, m)."""
        rows = pushes
        if self.before is not None:
            before = np.repeat(self.before, max(self.count // len(self.before), 1), axis=0)[: self.count]
            rows = np.concatenate([before, pushes], axis=1)
        return self.problem.replace(system=self.system, plan=rows)

    def cost(self, pushes: Array) -> float:
        """c, rounded up."""
        with np.errstate(invalid="ignore"):
            terms = np.where(pushes == 0, 0.0, pushes**2 * self.weight)
        return float(np.sqrt(terms.sum()) * (1 + 1e-11))

    def steered(self, which: tuple[int, int], margin: float) -> tuple[Array, float] | None:
        """The least pushes, nearly, that lead the nominal beyond the breach at a place at the end of the horizon.

        By ``margin`` standard deviations of what decides there. Proposes: None where it does not get there.
        """
        pushes = np.zeros((self.count, self.system.noise_dimension))
        for _ in range(_ROUNDS):
            poll("pushes of the noise")
            engine = Linearisation(self.under(pushes), pieces=self.count if self.continuous else None)
            if engine.lost:
                return None
            breach = next((one for one in breaches(engine) if one.place == which), None)
            if breach is None:  # no time of this grid lies in its window
                return None
            row, missing, size = _missing(engine, breach, margin)
            slopes = self._slopes(engine, row)
            free = np.where(np.isfinite(self.weight), 1 / self.weight, 0.0)
            scale = float((slopes**2 * free).sum())
            if not (np.isfinite(missing) and scale > 0):
                return None
            if abs(missing) <= _CLOSE * size:
                return pushes, self.cost(pushes)
            pushes = slopes * free * (missing + float((slopes * pushes).sum())) / scale
        return None

    @property
    def continuous(self) -> bool:
        """Whether time is."""
        return isinstance(self.system, ContinuousSystem)

    def _slopes(self, engine: Linearisation, row: Array) -> Array:
        """What the row at the end gains by each push, (count, m), in floats."""
        response, system = engine.response, self.system
        found = np.zeros((self.count, system.noise_dimension))
        for k in range(self.count - 1, -1, -1):
            before = row @ response.transition[0, k]
            if isinstance(system, DiscreteSystem):
                found[k] = row @ np.asarray(system.noise_matrix)
            else:
                found[k] = (row + before) / 2 @ engine.diffusion * response.step
            row = before
        return found


def _missing(engine: Linearisation, breach: Breach, margin: float) -> tuple[Array, float, float]:
    """The row that decides at the end, by how much the nominal misses its margin there, and its standard deviation."""
    rows, levels = breach.rows[:, -1], breach.levels[:, -1]
    v = engine.response.covariance[0, -1]
    sizes = np.sqrt(np.maximum(np.einsum("ji,ik,jk->j", rows, v, rows), 0.0))
    lead = int(np.argmax(levels / np.maximum(sizes, 1e-300)))
    return rows[lead], float(levels[lead] + margin * sizes[lead]), float(sizes[lead])


def plainly(probability: float, cost: float) -> float:
    """A lower bound under P of what has so much probability under Q, where the pushes cost c."""
    if not cost:
        return probability
    if not 0 < probability <= 1:
        return 0.0
    low, high = -_WIDEST, _WIDEST
    for _ in range(_HALVINGS):  # the least z with 1 - Phi(z) <= q for sure
        middle = (low + high) / 2
        low, high = (low, middle) if float(log_tail(middle)) <= np.log(probability) * (1 + 1e-12) - 1e-15 else (
            middle, high)
    if float(log_tail(high)) > np.log(probability):
        return 0.0
    return float(np.exp(log_tail_below((high + cost) + 1e-12)) * (1 - 1e-12))
