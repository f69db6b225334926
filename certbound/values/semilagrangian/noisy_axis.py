"""A problem with noise in one of two coordinates, as this room reads it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.errors import InfeasibleError
from certbound.problem.model import Graph, Tape
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.intervals import Interval, sq, sqrt
from certbound.values.continuous import safe_room, starts_of

Ends = tuple[float, float]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Setting:
    """dp = F(p, q) dt, dq = g(p, q) dt + s dW on the box of ``faces``, from the box of ``starts``.

    Attributes
    ----------
    tape : Tape
        (F, g) over ("t", "p", "q"), free of t.
    noise : float
        s, up to the relative error ``spread``.
    faces, starts : (Ends, Ends)
        Of p and of q.
    """

    tape: Tape
    noise: float
    spread: float
    faces: tuple[Ends, Ends]
    starts: tuple[Ends, Ends]
    horizon: float


def serves(problem: Problem) -> bool:
    """Whether a problem has two states in continuous time, and noise that surely leaves one of them alone."""
    system = problem.system
    if not isinstance(system, ContinuousSystem) or system.dimension != 2 or isinstance(system.diffusion, Tape):
        return False
    moved = np.any(np.asarray(system.diffusion) != 0, axis=1)
    return int(moved.sum()) == 1


def setting_of(problem: Problem) -> Setting:
    """Read a problem.

    Raises
    ------
    InfeasibleError
        Disturbances, time in the model, other safe sets than boxes; the message says which.
    """
    system = problem.system
    if not serves(problem) or not isinstance(system, ContinuousSystem):
        raise InfeasibleError("steps along the flow serve two states with constant noise in one of them.")
    if system.disturbance is not None or problem.input_sequence is not None:
        raise InfeasibleError(
            "value functions with noise in one coordinate serve neither disturbances nor plans yet; "
            "value functions prove nothing here."
        )
    gain = np.asarray(system.diffusion, dtype=float)
    noisy = int(np.flatnonzero(np.any(gain != 0, axis=1))[0])
    order = (1 - noisy, noisy)
    tape = _reordered(problem.closed_loop, order)
    size = sqrt(sq(Interval.point(gain[noisy])).sum(axis=-1))
    room, starts = safe_room(problem), starts_of(problem)
    faces = tuple((room.inner_low[k], room.inner_high[k]) for k in order)
    return Setting(
        tape=tape, noise=float(size.mid), spread=float(size.rad / size.mid) + 1e-15,
        faces=(faces[0], faces[1]), starts=(starts[order[0]], starts[order[1]]), horizon=float(problem.horizon),
    )  # fmt: skip


def _reordered(tape: Tape, order: tuple[int, int]) -> Tape:
    """The drift over ("t", "p", "q")."""
    if any(node.op == "input" and node.args[0] == 0 for node in tape.nodes):
        live = tape.evaluate(_Reads(), [True, False, False])
        if any(live):
            raise InfeasibleError(
                "value functions with noise in one coordinate serve no models that change with time yet; "
                "value functions prove nothing here."
            )
    graph = Graph(("t", "p", "q"))
    slots = [0, 0, 0]
    for place, state in enumerate(order):
        slots[1 + state] = 1 + place
    outputs = tape.evaluate(graph.arithmetic(), [graph.input(slot) for slot in slots])
    return graph.tape([outputs[order[0]], outputs[order[1]]], (2,))


class _Reads(dict):  # type: ignore[type-arg]
    """An arithmetic of "does it depend on t": any operation passes it on."""

    def __missing__(self, key: str) -> object:
        if key == "const":
            return lambda value: False
        if key == "pow":
            return lambda base, exponent: base
        return lambda *args: any(args)
