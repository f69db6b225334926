"""The engines of ``verify_safety``, one row each: whatever asks, explains, certifies or tests engines reads the rows.

An engine from outside is a row too: ``ENGINES["mine"] = Engine(name="mine", ...)``. How one is added: CONTRIBUTING.md.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from certbound.checks import instance
from certbound.problem.model import compile_numpy
from certbound.problem.problem import Problem
from certbound.reach.nominal import initial_cells
from certbound.safety.answers import EngineAnswer, Proof, Request
from certbound.safety.certificates import (
    backward_proof,
    backward_proof_below,
    barrier_proof,
    constants_proof,
    law_proof,
    of_coordinates,
    quadratic_proof,
    response_proof,
    values_proof,
    values_proof_below,
)
from certbound.safety.engines import (
    backward_engine,
    barrier_engine,
    by_logarithms,
    constants_engine,
    in_coordinates,
    linear_below,
    linear_chance,
    linear_engine,
    quadratic_engine,
    starts_engine,
    values_engine,
)
from certbound.safety.laws import by_law, of_laws
from certbound.tubes.constants import Constants


@dataclass(frozen=True, eq=False, kw_only=True)
class Engine:
    """One way to bound the probability that a constraint is broken.

    Parameters
    ----------
    name : str
        What ``method=`` and ``--method`` take, and what certificates call it.
    words : str
        What it does.
    when : str
        When it is asked, and where it says most: with ``words`` the table of the documentation.
    prove : callable
        ``prove(problem, request)`` to an `EngineAnswer`; ``prove(problem)`` asks for nothing but the problem. Loops
        that may be long call `certbound.watch.poll`, and ``request.found`` takes what is proved on the way; an engine
        that does neither loses what it has when the time is over.
    write : callable, optional
        ``write(problem, answer, attempt)`` to a proof that the checker knows; None: no certificate states it.
    write_below : callable, optional
        The same for its lower bound.
    methods : bool
        Whether it takes the tube methods (``kummer``, ``thm3``, ...) as names of its own.
    reserve : bool
        Asked while nothing else has proved SAFE, and for the smallest probability, as its bound knows no delta.
    again : bool
        Where it is not asked thoroughly it leaves something out: it is asked a second time where nothing was proved
        SAFE, after the others of that kind.
    refines : bool
        The same; and its bound falls with the effort that a request names, so that it is asked for more and more where
        nothing is SAFE and a limit of time was given.
    sketch : bool
        Asked before all others, quickly: that takes next to nothing.
    dear : bool
        Too slow to be asked a dozen times for what would be SAFE.
    soon : int
        From so many states on (0: never) it has a first bound after little time, and goes on from it: where the engine
        at work is slow, and there is a limit, it is asked for that in between.
    spares : int
        With fewer states it spares itself, as others say more there; where they prove nothing it is asked in full.
    chance : callable, optional
        ``chance(problem)`` says, from a sketch in floating point that takes next to nothing, how far the constraints
        are away in units of what the engine needs: at less than 1 it comes after those that may do better, and has
        little time of its own once one of them has proved anything.
    below : callable, optional
        ``below(problem)`` to an `EngineAnswer` with a lower bound, None where it finds none: asked before all engines,
        since it takes little, and a problem that fails often is UNSAFE then at once.
    endless : bool
        Whether it takes infinite horizons without a target.
    drawn : bool
        Whether it serves random starts alone: it is asked of no others unless by name.
    reaches : bool
        Whether it takes targets itself; others are asked to meet the target at one time (`certbound.problem.goals`).
    """

    name: str
    words: str
    when: str
    prove: Callable[..., EngineAnswer]
    write: Callable[[Problem, EngineAnswer, int], Proof] | None = None
    write_below: Callable[[Problem, EngineAnswer, int], Proof] | None = None
    methods: bool = False
    reserve: bool = False
    again: bool = False
    refines: bool = False
    sketch: bool = False
    dear: bool = False
    soon: int = 0
    spares: int = 0
    chance: Callable[[Problem], float] | None = None
    below: Callable[[Problem], EngineAnswer | None] | None = None
    reaches: bool = False
    endless: bool = False
    drawn: bool = False


def _polynomials(problem: Problem) -> float:
    """In several states a search for a polynomial takes many seconds, and others are near the truth before it ends."""
    return 0.5 if problem.system.dimension > 1 else math.inf


def _grids(problem: Problem) -> float:
    """In two and three states a solution on a grid is near the truth, if it has most of the time."""
    return 1.0 if problem.system.time == "continuous" and problem.system.dimension in (2, 3) else math.inf


_LINEAR = by_logarithms(in_coordinates(linear_engine), again=True)


ENGINES: dict[str, Engine] = {
    row.name: row
    for row in (
        Engine(
            name="starts",
            words="an average over cells of a random start: of whether all paths of a cell fail, where no noise follows"
            " the start of a linear model; else of what the linear response proves of the cell",
            when="where the start is random; says most where the start decides which paths fail; has lower bounds too",
            prove=starts_engine,
            refines=True,
            drawn=True,
        ),
        Engine(
            name="linear",
            words="the exact Gaussian response of the linearised model with a rigorous remainder (Thm K7)",
            when="always; says most where the noise is small against the curvature of the model, and where there are "
            "many states; has lower bounds too, so that it answers UNSAFE",
            prove=by_law(_LINEAR),
            write=of_laws(of_coordinates(response_proof), _LINEAR, law_proof),
            again=True,
            chance=linear_chance,
            below=linear_below,
        ),
        Engine(
            name="constants",
            words="rate or gain, noise and a metric, a tube by formula, set erosion (Thms K1 to K5, Table I)",
            when="always, but beyond 60 states only while `linear` has not settled the question; takes over where the "
            "noise is too large for a linearisation, and takes constants that you state",
            prove=constants_engine,
            write=constants_proof,
            methods=True,
            sketch=True,
            chance=linear_chance,
        ),
        Engine(
            name="backward",
            words="the backward equation solved in floats, its error bounded cell by cell and carried by the process "
            "(Thm K10, two and three states in continuous time)",
            when="while nothing else has proved SAFE; limits along the coordinates, noise along some states or all; "
            "bounds from both sides",
            prove=in_coordinates(backward_engine),
            write=of_coordinates(backward_proof),
            write_below=of_coordinates(backward_proof_below, below=True),
            reserve=True,
            refines=True,
            dear=True,
            chance=_grids,
            reaches=True,
        ),
        Engine(
            name="barrier",
            words="the exponential of a polynomial that grows slowly in the mean (continuous time, few states)",
            when="while nothing else has proved SAFE",
            prove=by_logarithms(barrier_engine),
            write=of_coordinates(barrier_proof),
            reserve=True,
            refines=True,
            chance=_polynomials,
        ),
        Engine(
            name="quadratic",
            words="one quadratic value bound a wall of the safe set, by semidefinite programming (Thm K9, up to "
            "twelve states)",
            when="while nothing else has proved SAFE; says most in three to ten states where the noise is too "
            "large for a linearisation",
            prove=by_logarithms(in_coordinates(quadratic_engine)),
            write=of_coordinates(quadratic_proof),
            reserve=True,
            refines=True,
            dear=True,
            soon=4,
            spares=3,
        ),
        Engine(
            name="values",
            words="the probability itself as a function on a grid, from both sides (Thm K8, up to three states)",
            when="while nothing else has proved SAFE; bounds from both sides, and certificates of UNSAFE",
            prove=by_logarithms(in_coordinates(values_engine, beside=barrier_engine)),
            write=of_coordinates(values_proof, beside=barrier_proof),
            write_below=of_coordinates(values_proof_below, below=True),
            reserve=True,
            refines=True,
            dear=True,
            reaches=True,
            endless=True,
        ),
    )
}
"""By name, in the order in which they are asked."""


def engine_named(method: str) -> str | None:
    """The engine that a method's name asks for: its own, or the one that takes tube methods; None for no such name."""
    from certbound.tubes.tuning import METHODS

    if method in ENGINES:
        return method
    return next((name for name, row in ENGINES.items() if row.methods), None) if method in METHODS else None


def engines_of(method: str) -> tuple[str, ...]:
    """The engines that a method asks for, in their order; ValueError where there is no such method."""
    if method == "auto":
        return tuple(ENGINES)
    name = engine_named(method)
    if name is not None:
        return (name,)
    from certbound.tubes.tuning import METHODS

    known = ["auto", *ENGINES, *(name for name in METHODS if name != "auto")]
    near = difflib.get_close_matches(str(method), known, n=1)
    cure = f"did you mean {near[0]!r}?" if near else "leave it out for the best of all engines."
    raise ValueError(f"`method` must be one of {', '.join(known)}, got {method!r}; {cure}")


def in_order(names: tuple[str, ...], problem: Problem, answers: Mapping[str, EngineAnswer]) -> tuple[str, ...]:
    """The engines that are left to be asked: last those that repeat what another one has just tried in vain.

    That is to meet a target of an infinite horizon at one time, in discrete time: it can be met at any other as well.
    """
    vain = any(answer.hit is not None and answer.applicable and answer.log10_delta == 0 for answer in answers.values())
    if not (vain and problem.endless and problem.system.time == "discrete"):
        return names
    return tuple(sorted(names, key=lambda name: not ENGINES[name].reaches))


def _check_defined(problem: Problem) -> None:
    """Refuse dynamics that have no finite value at the middle of the start, without disturbance or in its middle."""
    tape, system = problem.closed_loop, problem.system
    middle = np.asarray(problem.initial.middle, dtype=float)
    rows = problem.input_sequence if problem.input_sequence is not None else np.zeros((1, 0))
    box = system.disturbance
    pushes = np.zeros(0) if box is None else (box.low + box.high) / 2
    with np.errstate(all="ignore"):
        value = np.ravel(compile_numpy(tape)(0.0, *middle, *rows[0], *pushes))
    for name, rate in zip(system.states, value.tolist()):
        if not math.isfinite(rate):
            place = ", ".join(f"{one} = {number:g}" for one, number in zip(system.states, middle.tolist()))
            raise ValueError(f"`dynamics` must be defined at the start, got {rate} for {name} at {place}; start "
                             "elsewhere, or mend the expression.")  # fmt: skip


def check_request(problem: Problem, request: Request) -> None:
    """Refuse what is wrong with a request before any engine runs: from then on whatever fails is an engine.

    ValueError where the system has inputs and no plan, ``cells`` cannot be, or the method or the constants do not fit
    it, or the dynamics are not defined at the middle of the start.
    """
    from certbound.tubes.paper import check_method

    initial_cells(problem, request.cells)
    if problem.hold is None and not problem.random:
        _check_defined(problem)
    continuous, n = problem.system.time == "continuous", problem.system.dimension
    check_method(request.method, continuous=continuous, dimension=n)
    constants = request.constants
    if constants is None:
        return
    instance("constants", constants, Constants)
    if constants.continuous != continuous:
        raise ValueError(f"`constants` must state a {'rate' if continuous else 'gain'}, as the problem's time asks.")
    if constants.times is not None and constants.times[-1] < problem.horizon:
        raise ValueError(f"`constants` must reach the horizon {problem.horizon:g}, got {constants.times[-1]:g}.")
    from certbound.constants.stated import refuse_contradiction

    refuse_contradiction(problem, constants)
