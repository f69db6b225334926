"""What a certificate claims, in words: whose disturbances, at what probability, under which assumptions.

The assumptions are derived from the proof itself, so that a file cannot hide one; what the file adds of its own is
quoted, and counts as an assumption too. That a disturbance does not see coming noise is part of the model, no
assumption: the claim says for which disturbances it holds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from flint import arb

from certbound.checker.affine import check_affine
from certbound.checker.barrier import check_barrier
from certbound.checker.constants import check_constants
from certbound.checker.endless import (
    check_drift,
    check_lasting,
    check_lasting_below,
    check_leaving,
    check_leaving_below,
    check_surely,
    check_surely_below,
)
from certbound.checker.linear import check_linear
from certbound.checker.reading import Record, number, numbers, wholes
from certbound.checker.report import STEP, Budget, Unproved
from certbound.checker.statement import Model, met_at, restated, weights_of
from certbound.checker.time_pieces import jumps_of, with_time_pieces
from certbound.checker.words import plainly, quoted, rounded
from certbound.errors import CertificateError
from certbound.problem.model import Tape

UNION = "union"
"""The engine that a proof names where the start is a union: it has one proof a member."""

RANDOM = "random"
"""The engine that a proof names where constants are drawn: it has one proof a cell of their values."""

REACH = "reach"
"""The engine that a proof names where the problem has a target: it meets the target at one time."""

OTHER_STATES = ("coordinates", "logarithms")
"""The engines that a proof names whose own proof is about the problem in other coordinates, or in logarithms."""

LIMITS = "limits"
"""The engine that a proof names whose parts are about some of the constraints each, and add up."""

WHOLE = ("lasting", "drift", "rate", "surely")
"""The engines that prove targets and infinite horizons themselves, beside value functions in discrete time."""

STATED = "the stated constants hold"
"""How a certificate's own list names what `assumptions` derives from the proof."""

FINITE = ("values", "backward")
"""Those that prove targets up to a finite horizon."""

MOST_CELLS = 200

MOST_PRINTED = 4
"""States up to which a claim prints the metric of stated constants: 16 numbers."""

_ANY = "for every disturbance in its set, even one that sees coming noise"
_BLIND = "for every disturbance in its set that does not see coming noise"
_SOME = "for some disturbance in its set that reacts to the state and does not see coming noise"


@dataclass(frozen=True, eq=False, kw_only=True)
class Engine:
    """One way to prove a certificate.

    Parameters
    ----------
    words : str
        What it is, for the report.
    prove : callable
        ``prove(model, proof, budget)`` to an upper bound of the probability that a constraint is broken.
    foresees : callable
        ``foresees(model)``: whether the bound covers even disturbances that see coming noise. Bounds that rest on
        supermartingales do not: foresight would spoil these.
    assumes : callable
        ``assumes(model, proof)`` to what the proof takes for granted, in words; None where nothing.
    below : callable, optional
        As ``prove``, to a lower bound of the probability from some start, for some disturbance that reacts to the
        state.
    holds : bool
        Whether it proves anything of inputs that are held. The others do not know that there are any.
    """

    words: str
    prove: Callable[[Model, object, Budget], arb]
    foresees: Callable[[Model], bool] = lambda model: False
    assumes: Callable[[Model, Mapping[str, object]], str | None] = lambda model, proof: None
    below: Callable[[Model, object, Budget], arb] | None = None
    holds: bool = False


def engine_of(proof: object, method: str) -> str:
    """The engine that a proof names, which ``claim.method`` must name too."""
    engine = _named(proof, "proof", (*ENGINES, UNION, RANDOM, REACH, *OTHER_STATES, LIMITS))
    if method != engine:
        raise CertificateError(f"`claim.method` must be \"{engine}\", the proof's engine, got {quoted(method)}.")
    return engine


def _named(proof: object, path: str, known: Sequence[str]) -> str:
    engine = proof.get("engine") if isinstance(proof, Mapping) else None
    if not isinstance(engine, str) or engine not in known:
        raise CertificateError(f"`{path}.engine` must be one of {', '.join(known)}.")
    return engine


def _is(proof: object, engine: str) -> bool:
    return isinstance(proof, Mapping) and proof.get("engine") == engine


def _parts(model: Model, proof: object) -> Iterator[tuple[str, Model, Mapping[str, object]]]:
    """A proof's engine, its plain model and its numbers; where limits are taken apart, those of every part."""
    if _is(proof, LIMITS):
        for one, row, place in _apart(model, proof):
            yield from _plain_parts(one, row, place)
    else:
        yield from _plain_parts(model, proof, "proof")


def _apart(model: Model, proof: object) -> Iterator[tuple[Model, object, str]]:
    """The model with some of its constraints, what proves that they are kept, and where it stands: all of them."""
    if model.members or model.drawn or model.target is not None or model.ends:
        raise CertificateError("`proof.engine` must not be \"limits\" beside unions, drawn constants and targets.")
    rows = Record(proof, "proof", ("engine", "parts")).items("parts", 1, MOST_CELLS)
    records = [Record(row, f"proof.parts[{index}]", ("limits", "proof")) for index, row in enumerate(rows)]
    last = len(model.constraints) - 1
    asked = [wholes(record["limits"], record.at("limits"), 0, last) for record in records]
    if {number for own in asked for number in own} != set(range(last + 1)):
        raise CertificateError("`proof.parts` must name every constraint in some `limits`, the domain as the last one.")
    for record, own in zip(records, asked):
        kept = tuple(model.constraints[number] for number in sorted(set(own)))
        domain = model.domain if last in own else None
        yield replace(model, constraints=kept, domain=domain), record["proof"], record.at("proof")


def _plain_parts(
    model: Model, proof: object, path: str
) -> Iterator[tuple[str, Model, Mapping[str, object]]]:
    """A proof's engine, its plain model and its numbers; where the start is a union, those of every member.

    A target is met at one time, which the proof names. CertificateError where the start is a union, or there is a
    target, and the proof does not say so, or the other way round. In other coordinates the model is another one.
    """
    model.budget.spend(50 * STEP)
    if model.stays and not _is_whole(model, proof) and not (model.members or model.drawn):
        raise CertificateError(f"`{path}.engine` must be \"values\" where a target is to be stayed in.")
    if model.members:
        for one, row, place in _members(model, proof, path):
            yield from _plain_parts(one, row, place)
    elif model.drawn:
        for one, row, place, _ in _cells(model, proof, path):
            if row is not None:
                yield from _plain_parts(one, row, place)
    elif model.target is not None and not _is_whole(model, proof):
        _named(proof, path, (REACH,))
        record = Record(proof, path, ("engine", "time", "proof"))
        yield from _plain_parts(met_at(model, record.number("time")), record["proof"], f"{path}.proof")
    else:
        known = tuple(name for name, row in ENGINES.items() if model.hold is None or row.holds)
        model, proof, path = restated(model, proof, path)
        yield _named(proof, path, known), model, proof  # type: ignore[misc]  # a mapping: it names an engine


def _members(model: Model, proof: object, path: str) -> Iterator[tuple[Model, object, str]]:
    """The model of every member of a union of starts, its proof, and where it stands."""
    _named(proof, path, (UNION,))
    count = len(model.members)
    rows = Record(proof, path, ("engine", "members")).items("members", count, count)
    for index, (member, row) in enumerate(zip(model.members, rows)):
        yield replace(model, initial=member, members=()), row, f"{path}.members[{index}]"


def _is_whole(model: Model, proof: object) -> bool:
    """Whether a proof is of a target and of an infinite horizon, where there are any."""
    engine = proof.get("engine") if isinstance(proof, Mapping) else None
    if model.stays:
        return engine == "values" and not model.continuous
    lasts = model.continuous and math.isinf(model.horizon)
    return engine in WHOLE or (engine in FINITE and not lasts)


def _cells(
    model: Model, proof: object, path: str
) -> Iterator[tuple[Model, object, str, arb]]:
    """The plain model of every cell of what is drawn, its proof (None: it may fail), where it stands, its weight."""
    _named(proof, path, (RANDOM,))
    rows = Record(proof, path, ("engine", "cells")).items("cells", 1, MOST_CELLS)
    records = [Record(row, f"{path}.cells[{index}]", ("low", "high", "proof")) for index, row in enumerate(rows)]
    count = len(model.drawn)
    ranges = [list(zip(record.array("low", count), record.array("high", count))) for record in records]
    if any(low > high for cell in ranges for low, high in cell):
        raise CertificateError(f"`{path}.cells` must have ends that rise.")
    # every pass over the parts asks for the weights
    weights = model.budget.once(proof, (RANDOM, model.drawn), lambda: weights_of(model.drawn, ranges, model.budget))
    for record, cell, weight in zip(records, ranges, weights):
        values = list(model.disturbance)
        for constant, ends in zip(model.drawn, cell):
            least, most = values[constant.place]
            if not least <= ends[0] <= ends[1] <= most:
                raise CertificateError(f"`{path}.cells` must lie in the disturbances' set, beyond which paths fail.")
            values[constant.place] = ends
        yield replace(model, disturbance=values, drawn=()), record["proof"], record.at("proof"), weight


def _knows_ends(model: Model, proof: object) -> bool:
    """Whether a proof by value functions lets a path end where it leaves the domain, from below too."""
    staged = isinstance(proof, Mapping) and "stages" in proof
    return not model.continuous or (model.target is None and model.initial.covariance is None and not staged)


def check_side(model: Model, proof: object, lower: bool) -> None:
    """Lower bounds are proved of one start and without a target, and say so in ``side``; others must not.

    CertificateError where a proof says one thing and the claim another.
    """
    if lower and model.ends and not (_is(proof, "values") and _knows_ends(model, proof)):  # the domain is a limit there
        raise CertificateError("`claim.log10_lower` must not be there where a path ends as it leaves the domain.")
    if lower and model.unknown:
        raise CertificateError("`claim.log10_lower` must not be there for an unknown constant, which does not react.")
    if lower and (model.members or model.drawn):
        raise CertificateError("`claim.log10_lower` must not be there for a union of starts.")
    if lower and any(_is(proof, engine) for engine in OTHER_STATES):
        raise CertificateError("`claim.log10_lower` must not be there in other coordinates, where starts are enclosed.")
    if lower and _is(proof, LIMITS):
        raise CertificateError("`claim.log10_lower` must not be there where limits are taken apart.")
    for engine, _, part in _parts(model, proof):
        if lower and model.target is not None and not _is_whole(model, part):
            raise CertificateError("`claim.log10_lower` must not be there beside a target, but in proofs that know it.")
        side = part.get("side")
        if side is not None and (side != "lower" or ENGINES[engine].below is None):
            raise CertificateError("`proof.side` must be \"lower\", in a proof by value functions, or be left out.")
        if (side is not None) != lower:
            raise CertificateError("`claim.log10_lower` must be there just where `proof.side` is \"lower\".")


def prove(model: Model, proof: object, budget: Budget, *, lower: bool = False) -> arb:
    """The probability that a proof bounds, from above or below: of a union of starts the largest, of limits the sum."""
    check_side(model, proof, lower)
    if _is(proof, LIMITS):
        return sum((prove(one, row, budget) for one, row, _ in _apart(model, proof)), arb(0))
    found = arb(0)
    if model.members:
        for one, row, _ in _members(model, proof, "proof"):
            bound = prove(one, row, budget)
            if not bound.is_finite():
                return bound
            found = found.max(bound)
        return found
    if model.drawn:
        return _average(model, proof, budget)
    for engine, one, part in _parts(model, proof):
        row = ENGINES[engine]
        if math.isinf(one.horizon) and not _is_whole(one, part):
            raise Unproved("this proof needs a finite horizon")
        if engine != "values" and not one.continuous and isinstance(one.noise.diffusion, Tape):
            raise Unproved("only value functions prove anything of noise that the state multiplies in discrete time")
        count, numbers = jumps_of(part)
        one = one if count is None else with_time_pieces(one, count, budget)
        bound = (row.below if lower and row.below is not None else row.prove)(one, numbers, budget)
        if not bound.is_finite() or lower:
            return bound
        found = found.max(bound)
    return found


def _average(model: Model, proof: object, budget: Budget) -> arb:
    """1 - sum P(cell) (1 - b), b the bound that holds for every value of a cell."""
    kept = arb(0)
    for one, row, _, weight in _cells(model, proof, "proof"):
        if row is not None:
            bound = prove(one, row, budget)
            kept += weight * (1 - bound) if bound.is_finite() and bound < 1 else arb(0)
    return arb.max((1 - kept).upper(), arb(0))


def words_of(model: Model, proof: object) -> str:
    """What it was proved by."""
    return ", ".join(dict.fromkeys(ENGINES[engine].words for engine, _, _ in _parts(model, proof)))


def assumptions(model: Model, proof: Mapping[str, object], named: Sequence[str]) -> list[str]:
    """What the proof takes for granted, and what else the file says that it assumes, in quotes."""
    found = (ENGINES[engine].assumes(one, part) for engine, one, part in _parts(model, proof))
    own = list(dict.fromkeys(item for item in found if item is not None))
    return own + [f"as the file says, {quoted(item, 200)}" for item in named if not (own and item == STATED)]


def _additive(model: Model) -> bool:
    """The linear response bounds a Gaussian process that no disturbance moves, and all else path by path."""
    return not isinstance(model.noise.diffusion, Tape) and not model.by_ito


def _stated(model: Model, proof: Mapping[str, object]) -> str | None:
    """The stated constants; rounded down, they are no weaker an assumption than the proof's."""
    if proof.get("assumed") is not True:
        return None
    name, unit = ("rate", f" per {model.unit}" if model.unit != "s" else " 1/s")
    if not model.continuous:
        name, unit = "gain", " per step"
    rate, sigma, nu = (
        rounded(number(proof.get(key), f"proof.{key}"), up=False) for key in ("rate", "sigma", "nu")
    )
    where = "on the model's domain" if proof.get("region") == "domain" else "everywhere"
    return (
        f"{STATED} {where}, for the problem's own states: {name} {rate}{unit}, noise level sigma {sigma}, effective "
        f"dimension {nu}, in the {_norm(model, proof)}"
    )


def _norm(model: Model, proof: Mapping[str, object]) -> str:
    """The norm in which constants are stated, with its metric P in full where that is short."""
    if proof.get("metric") is None:
        return "Euclidean norm"
    n = model.dimension
    if n > MOST_PRINTED:
        return f"norm sqrt(x' P x) with the {n} x {n} matrix `metric` of the proof"
    rows = numbers(proof.get("metric"), "proof.metric", n, n)
    written = ", ".join(f"[{', '.join(map(plainly, row))}]" for row in rows)
    return f"norm sqrt(x' P x) with P = [{written}]"


def claim(model: Model, proof: object, level: float, assumed: Sequence[str]) -> str:
    """The claim as one sentence."""
    start = "a normal start" if model.initial.covariance is not None else "every start in the initial set"
    start += f" (a union of {len(model.members)})" if model.members else ""
    foresees = all(ENGINES[engine].foresees(one) for engine, one, _ in _parts(model, proof))
    whose = f", {_ANY if foresees else _BLIND}," if len(model.disturbance) > len(model.drawn) else ""
    safe = "at most" if arb(level) <= arb(model.delta).log() / arb(10).log() else "more than"
    return _sentence(model, f"{start}{whose}", f"at most 10^{rounded(level, up=True)} ({safe}", assumed)


def claim_below(model: Model, level: float, assumed: Sequence[str]) -> str:
    """The claim of a lower bound as one sentence."""
    start = "a normal start" if model.initial.covariance is not None else "some start in the initial set"
    whose = f", {_SOME}," if model.disturbance else ""
    unsafe = "more than" if arb(level) > arb(model.delta).log() / arb(10).log() else "which need not be more than"
    return _sentence(model, f"{start}{whose}", f"at least 10^{rounded(level, up=False)} ({unsafe}", assumed)


def _sentence(model: Model, start: str, bound: str, assumed: Sequence[str]) -> str:
    count = len(model.constraints) - model.ends  # the domain is none of them where leaving it ends a path
    kept = f"breaks one of its {count} constraints" + (" before it leaves its domain" if model.ends else "")
    if model.drawn:
        kept += f" ({len(model.drawn)} of its constants being drawn)"
    if model.target is not None:
        then = " and stays there" if model.stays else ""
        kept += f" before it is in its target ({quoted(model.target.label)}){then}, or is not in it"
    words = (
        f"from {start} the problem {quoted(model.name)} {kept} "
        f"{_when(model)} with probability {bound} delta = {plainly(model.delta)})"
    )
    return words + "".join(f"; assuming that {item}" for item in assumed)


def _when(model: Model) -> str:
    return "at any time" if math.isinf(model.horizon) else f"within {plainly(model.horizon)} {model.unit}"


def _values(model: Model, proof: object, budget: Budget) -> arb:
    """Loaded when it is needed: NumPy comes with it."""
    from certbound.checker.values import check_values

    return check_values(model, proof, budget)


def _quadratic(model: Model, proof: object, budget: Budget) -> arb:
    from certbound.checker.values import check_quadratic

    return check_quadratic(model, proof, budget)


def _values_below(model: Model, proof: object, budget: Budget) -> arb:
    from certbound.checker.values import check_values_below

    return check_values_below(model, proof, budget)


def _backward(model: Model, proof: object, budget: Budget) -> arb:
    from certbound.checker.values import check_backward

    return check_backward(model, proof, budget)


def _backward_below(model: Model, proof: object, budget: Budget) -> arb:
    from certbound.checker.values import check_backward_below

    return check_backward_below(model, proof, budget)


ENGINES = {
    "linear": Engine(words="linear response (Thm K7)", prove=check_linear, foresees=_additive, holds=True),
    "affine": Engine(words="the exact law of a linear model", prove=check_affine, foresees=_additive),
    "constants": Engine(words="contraction constants (Thms K2, K5)", prove=check_constants, assumes=_stated),
    "barrier": Engine(words="a barrier that is the exponential of a polynomial", prove=check_barrier),
    "values": Engine(words="the value function itself (Thm K8)", prove=_values, below=_values_below),
    "backward": Engine(
        words="a solution of the backward equation, its error included (Thm K10)", prove=_backward,
        below=_backward_below,
    ),
    "lasting": Engine(words="a function of the state alone", prove=check_lasting, below=check_lasting_below),
    "rate": Engine(words="how fast paths leave", prove=check_leaving, below=check_leaving_below),
    "surely": Engine(words="noise that leads every path out", prove=check_surely, below=check_surely_below),
    "drift": Engine(words="a drift away from the limit (Lundberg's inequality)", prove=check_drift),
    "quadratic": Engine(words="quadratic value bounds (Thm K9)", prove=_quadratic),
}
"""By the name that a proof gives: all that the checker knows of an engine."""
