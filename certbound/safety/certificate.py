"""Certificates: a proof as data, for a program that shares nothing with the one that found it.

The file holds the problem (model tape, sets, noise, horizon, delta), the claimed probability and the numbers that
prove it; every number is exact (hexadecimal). `certbound.checker` proves the claim again from the file alone. Its
schema is docs/certificate.md.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from flint import arb

from certbound.errors import CertificateError, EngineError, contained
from certbound.problem.goals import met_at
from certbound.problem.model import Network, Tape
from certbound.problem.noise import Law, check_law
from certbound.problem.problem import Problem
from certbound.problem.random_constants import Random
from certbound.problem.sets import Inside, StartUnion
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.balls import precision, upper
from certbound.safety.answers import Answered, EngineAnswer, Proof, Request, exact, is_at_most, is_more_than
from certbound.safety.portfolio import ENGINES
from certbound.watch import limited_to

FORMAT = "certbound certificate"
VERSION = 1
_OTHERS = ("reach", "coordinates", "logarithms", "limits", "affine", "lasting", "rate", "drift", "surely")
"""Proofs that are not called as their engine."""
_ROUNDING = 1e-6  # other versions of the ball arithmetic may round otherwise
_RESERVED, _RESERVED_BELOW = 30.0, 12.0
"""Seconds of processor time for all engines that only a certificate asks; where UNSAFE was proved in another way.

One that proved SAFE took 23 s on a busy machine; from below two took 85 s and proved nothing, and an upper bound can be
stated instead.
"""
_LEAST = 1.0  # second that an engine has at least
_PART = 0.8  # of what is left of these, for the next engine

def certificate_text(problem: Problem, verdict: Answered, *, attempt: int = 0) -> str:
    """The certificate of a verdict as the text of a JSON file; see `certificate_data`."""
    return certificate_of(problem, verdict, attempt=attempt)[0]


def certificate_of(
    problem: Problem, verdict: Answered, *, attempt: int = 0, reserves: bool = True
) -> tuple[str, str]:
    """The same, and the engine whose proof it states; empty where it is made of several certificates.

    Without ``reserves`` no engine is asked that had not answered.
    """
    data, engine = _certified(problem, verdict, attempt, reserves=reserves)
    return json.dumps(data, separators=(",", ":")) + "\n", engine


def restated(text: str, log10_proved: float, *, lower: bool = False) -> str:
    """The certificate claiming what the checker proved of it, 10**log10_proved (``lower``: as a lower bound).

    The writer leaves itself room, and its own bounds of the events are coarser in places than the checker's. A claim of
    more than was proved is taken back to that, but for an upper bound that would be none.
    """
    data, name = json.loads(text), "log10_lower" if lower else "log10_delta"
    claimed = float.fromhex(data["claim"][name])
    room = _ROUNDING * (1.0 + abs(log10_proved))
    proved = log10_proved - room if lower else log10_proved + room
    stronger, holds = (
        (proved > claimed, claimed <= log10_proved) if lower else (proved < claimed, claimed >= log10_proved)
    )
    if (holds and not stronger) or proved >= 0:
        return text
    data["claim"][name] = exact(proved)
    return json.dumps(data, separators=(",", ":")) + "\n"


def certificate_data(problem: Problem, verdict: Answered, *, attempt: int = 0) -> dict[str, Any]:
    """The certificate of a verdict: P(some constraint is broken) <= 10**claim, with what proves it; >= where UNSAFE.

    The claim rests on inequalities that the checker knows, and may be weaker than the verdict's ``log10_delta``. Where
    it would be weaker than SAFE, other engines are tried.

    Parameters
    ----------
    problem : Problem
    verdict : Verdict
        Of this problem.
    attempt : int
        0, 1, ...: how much effort to spend (finer pieces, wider boxes).

    Raises
    ------
    CertificateError
        If the verdict bounds no probability, or no proof of it can be stated.
    """
    return _certified(problem, verdict, attempt)[0]


def _certified(
    problem: Problem, verdict: Answered, attempt: int, *, reserves: bool = True
) -> tuple[dict[str, Any], str]:
    """The certificate, and the engine whose proof it states."""
    refuse_moving_limits(problem, verdict)
    members, cells = getattr(verdict, "members", ()), getattr(verdict, "cells", ())
    if problem.random and not members:
        if verdict.status == "UNSAFE":
            raise CertificateError("certificates state no lower bounds where constants are drawn.")
        return averaged(problem, cells, [_stated(one, attempt, reserves) for one in cells]), ""
    if verdict.status == "UNSAFE" or any(one.status == "UNSAFE" for one in members):
        try:
            return _lower_data(problem, verdict, attempt)
        except CertificateError:
            if not _cannot_be_written(problem, verdict):
                raise
    if members:
        return united(problem, [_certified(one.problem, one, attempt, reserves=reserves)[0] for one in members]), ""
    refusals: list[str] = []
    best: tuple[str, Proof] | None = None
    for name, answer in _answers(problem, verdict, reserves):
        try:
            write = ENGINES[name].write
            if write is None:
                raise CertificateError("certificates do not state what this engine proves.")
            if answer.truncated:
                raise CertificateError("certificates do not state what an ellipsoid of starts says of a random one.")
            whole = problem.reach is None or (answer.hit is None and ENGINES[name].reaches)
            found = write(problem, answer, attempt) if whole else _met(problem, answer, attempt, write)
        except CertificateError as error:
            refusals.append(f"{name}: {error}")
            continue
        if best is None or found[1] < best[1][1]:
            best = name, found
        if verdict.status != "SAFE" or is_at_most(min(best[1][1], 0.0), problem.delta):
            break
    if best is not None:
        name, (proof, log10, assumptions) = best
        claim = {"log10_delta": exact(min(log10, 0.0)), "method": _method(name, proof), "assumptions": assumptions}
        return _whole(problem, claim, proof), name
    why = " ".join(refusals) or verdict.reason
    raise CertificateError(f"no probability was bounded that a certificate could state: {why}")


def refuse_moving_limits(problem: Problem, verdict: Answered | None = None) -> None:
    """CertificateError where sides move, or where what was proved speaks of coordinates that move with limits."""
    asked = [*problem.safe, *([] if problem.reach is None else [problem.reach])]
    changing = next((one.label for one in asked if one.region.changing), None)
    if changing is None and getattr(verdict, "stated", None) is None:
        return
    what = f" ('{changing}')" if changing else ""
    raise CertificateError(
        f"no certificate states limits that move{what}, since the checker does not know the coordinates in which they "
        "rest; one states centres that move, where the linear response or constants prove enough."
    )


def _stated(cell: Any, attempt: int, reserves: bool) -> dict[str, Any] | None:
    """The certificate of a cell of drawn constants; None where there is none."""
    try:
        return _certified(cell.plain, cell.verdict, attempt, reserves=reserves)[0] if cell.asked else None
    except CertificateError:
        return None


def _method(name: str, proof: Mapping[str, Any]) -> str:
    """What proves: the engine, but for proofs of a target and of all times, which have names of their own."""
    own = proof.get("engine") if isinstance(proof, Mapping) else None
    return own if isinstance(own, str) and own in _OTHERS else name


def _met(
    problem: Problem, answer: EngineAnswer, attempt: int, write: Callable[[Problem, EngineAnswer, int], Proof]
) -> Proof:
    """The proof that the target is met at one time."""
    if answer.hit is None:
        raise CertificateError("certificates state that a target is met at one time, and this engine counts all times.")
    proof, log10, assumptions = write(met_at(problem, answer.hit), answer, attempt)
    return {"engine": "reach", "time": exact(float(answer.hit)), "proof": proof}, log10, assumptions


def united(problem: Problem, members: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The certificate of a problem whose start is a union, from those of its members: the largest of their claims.

    CertificateError where a member has none.
    """
    if len(members) != len(problem.starts):
        raise CertificateError("no probability was bounded for every member of the initial union.")
    levels = [float.fromhex(member["claim"]["log10_delta"]) for member in members]
    assumed = dict.fromkeys(item for member in members for item in member["claim"]["assumptions"])
    claim = {"log10_delta": exact(max(levels)), "method": "union", "assumptions": list(assumed)}
    return _whole(problem, claim, {"engine": "union", "members": [member["proof"] for member in members]})


def averaged(problem: Problem, cells: Sequence[Any], found: Sequence[Mapping[str, Any] | None]) -> dict[str, Any]:
    """The certificate of a problem with drawn constants, from those of the cells of their values (None: none).

    The claim is 1 - sum P(cell) (1 - claim), in balls: what is in no cell, or has no certificate, counts as failing.
    """
    assumed = dict.fromkeys(item for one in found if one is not None for item in one["claim"]["assumptions"])
    rows = []
    with precision():
        kept = arb(0)
        for cell, one in zip(cells, found):
            proof = None if one is None else one["proof"]
            rows.append({"low": exact(cell.low), "high": exact(cell.high), "proof": proof})
            if one is not None:
                kept += cell.weight * (1 - arb(10) ** arb(float.fromhex(one["claim"]["log10_delta"])))
        most = (1 - kept).upper()
        level = min(upper(most.log() / arb(10).log()) + _ROUNDING, 0.0) if most > 0 else 0.0
    if not level < 0:
        raise CertificateError("what is certified of the cells of the drawn constants gives no bound below 1.")
    claim = {"log10_delta": exact(level), "method": "random", "assumptions": list(assumed)}
    return _whole(problem, claim, {"engine": "random", "cells": rows})


def _lower_data(problem: Problem, verdict: Answered, attempt: int) -> tuple[dict[str, Any], str]:
    """The certificate of UNSAFE: P(some constraint is broken) >= 10**claim from some start, for some disturbance.

    And the engine whose proof it states.
    """
    if len(problem.starts) > 1:
        raise CertificateError(
            "certificates state no lower bounds where the start is a union: verify by itself the member that is UNSAFE."
        )
    refusals: list[str] = []
    for name, answer in _answers_below(problem, verdict):
        try:
            write = ENGINES[name].write_below
            if write is None:
                raise CertificateError("certificates do not state the lower bounds of this engine.")
            if answer.hit is not None:
                raise CertificateError("certificates state no lower bounds of targets that count at one time.")
            proof, log10, assumptions = write(problem, answer, attempt)
        except CertificateError as error:
            refusals.append(f"{name}: {error}")
            continue
        claim = {
            "log10_delta": exact(0.0), "log10_lower": exact(log10), "method": _method(name, proof),
            "assumptions": assumptions,
        }  # fmt: skip
        return _whole(problem, claim, proof), name
    why = " ".join(refusals) or verdict.reason
    raise CertificateError(f"no lower bound was found that a certificate could state: {why}")


def _whole(problem: Problem, claim: dict[str, Any], proof: dict[str, Any]) -> dict[str, Any]:
    data = problem_data(problem)
    return {"format": FORMAT, "version": VERSION, "claim": claim, "problem": data, "proof": proof}


def _answers(problem: Problem, verdict: Answered, reserves: bool) -> Iterator[tuple[str, EngineAnswer]]:
    """Engines that bounded a probability, the best first; then those in reserve that were not asked (``reserves``).

    What a certificate states can be weaker than what its engine proved, so that another engine's may be needed.
    """
    useful = [item for item in verdict.answers.items() if item[1].applicable and item[1].log10_delta < 0]
    yield from sorted(useful, key=lambda item: (not item[1].certified, item[1].log10_delta))
    if not reserves:
        return
    kept = _Reserves(problem, verdict, _RESERVED, Request(above=True))
    # on grids an engine does all the work that it may: those that soon say what they can come first
    for name, row in sorted(ENGINES.items(), key=lambda item: item[1].dear and not item[1].soon):
        asked = verdict.answers.get(name)
        if problem.reach is not None or verdict.status != "SAFE" or asked is None or asked.applicable:
            continue
        if row.reserve and row.write:
            answer = kept.ask(name)
            if answer.applicable and answer.log10_delta < 0:
                yield name, answer


def _answers_below(problem: Problem, verdict: Answered) -> Iterator[tuple[str, EngineAnswer]]:
    """Engines with a lower bound, the best first; others are asked where it refutes and cannot be written."""
    found = [item for item in verdict.answers.items() if item[1].applicable and item[1].log10_lower is not None]
    yield from sorted(found, key=lambda item: -(item[1].log10_lower or 0.0))
    if not _cannot_be_written(problem, verdict):
        return
    reserves = _Reserves(problem, verdict, _RESERVED_BELOW, Request(below=True))
    for name, row in ENGINES.items():
        asked = verdict.answers.get(name)
        if row.write_below is not None and (asked is None or asked.log10_lower is None):
            answer = reserves.ask(name)
            if answer.applicable and _refutes(problem, answer):
                yield name, answer


def _cannot_be_written(problem: Problem, verdict: Answered) -> bool:
    """Whether the lower bounds that refute delta are all of engines whose lower bounds certificates do not state."""
    refuting = [name for name, answer in verdict.answers.items() if _refutes(problem, answer)]
    return bool(refuting) and all(ENGINES[name].write_below is None for name in refuting)


def _refutes(problem: Problem, answer: EngineAnswer) -> bool:
    return answer.log10_lower is not None and is_more_than(answer.log10_lower, problem.delta)


class _Reserves:
    """Engines that only a certificate asks: none twice, and all of them within some seconds of processor time."""

    def __init__(self, problem: Problem, verdict: Answered, seconds: float, request: Request) -> None:
        self._problem, self._left, self._request = problem, seconds, request
        self._known: dict[str, EngineAnswer] = getattr(verdict, "reserves", {})

    def ask(self, name: str) -> EngineAnswer:
        """What an engine answers in a part of the time that is left; that it does not apply where it fails."""
        if name not in self._known:
            begun = time.thread_time()
            self._known[name] = self._asked(name)
            self._left = max(self._left - (time.thread_time() - begun), _LEAST)
        return self._known[name]

    def _asked(self, name: str) -> EngineAnswer:
        found = [EngineAnswer(applicable=False, method=name, reason="the time for a certificate was over.")]
        try:
            with contained(name), limited_to(_PART * self._left, _PART):
                found.append(ENGINES[name].prove(self._problem, replace(self._request, found=found.append)))
        except EngineError as error:
            return EngineAnswer(applicable=False, method=name, reason=str(error))
        return max(reversed(found), key=self._worth)

    def _worth(self, answer: EngineAnswer) -> float:
        """How far an answer's bound is from none at all."""
        if not answer.applicable:
            return -math.inf
        below = -math.inf if answer.log10_lower is None else answer.log10_lower
        return below if self._request.below else -answer.log10_delta


# ---- the problem -------------------------------------------------------------------------------------------


def problem_data(problem: Problem) -> dict[str, Any]:
    """The problem as a certificate states it, under its plan.

    Raises
    ------
    ValueError
        If the system has inputs and no plan.
    CertificateError
        If certificates do not state such problems.
    """
    refuse_moving_limits(problem)
    system, held = problem.system, problem.hold is not None
    tape = system.dynamics if held else problem.closed_loop
    continuous = system.time == "continuous"
    rows = problem.input_sequence
    inputs = system.input_names if held or rows is not None else ()
    box = system.disturbance
    return {
        "name": problem.name,
        "time": system.time,
        "horizon": None if problem.endless else exact(float(problem.horizon)),
        "delta": exact(float(problem.delta)),
        "states": list(system.states),
        "inputs": list(inputs),
        "disturbances": list(system.disturbance_names),
        "dynamics": tape_data(tape),
        "plan": None if rows is None else exact(rows if continuous else rows[: int(problem.horizon)]),
        "disturbance_set": [] if box is None else _ranges(zip(box.low, box.high)),
        **({"unknown": list(problem.unknown)} if problem.unknown else {}),
        "noise": _noise(system),
        "initial": initial_data(problem.initial),
        "constraints": [_constraint(constraint) for constraint in problem.safe],
        **({"hold": {"count": problem.samples, "law": tape_data(problem.plan)}} if held else {}),
        **({"units": dict(problem.units)} if problem.units else {}),
        **({"leaving": problem.leaving} if problem.ending else {}),
        "domain": None if problem.domain is None else _ranges(zip(problem.domain.low, problem.domain.high)),
        **({"random": {name: _drawn(one) for name, one in problem.random.items()}} if problem.random else {}),
        **({} if problem.reach is None else {"reach": _constraint(problem.reach)}),
    }


def _drawn(constant: Random) -> dict[str, Any]:
    law = constant.law
    return {
        "law": law.name, "level": law.level, "mean": exact(constant.mean),
        "value": exact(float(np.ravel(getattr(law, law.level))[0])),
        **({"tables": {name: exact(getattr(law, name)) for name in law.tables}} if law.tables else {}),
    }  # fmt: skip


def _constraint(constraint: Inside) -> dict[str, Any]:
    return {
        "kind": constraint.word if not getattr(constraint, "stays", False) else "reach and stay",
        "region": _region(constraint.region.data(_KINDS)),
        "during": None if constraint.during is None else exact([float(end) for end in constraint.during]),
        "label": str(constraint.label),
    }


def tape_data(tape: Tape) -> dict[str, Any]:
    """A tape's operations: [op, ...arguments], ["const", value], ["pow", argument, exponent].

    The output k of a network is ["network", its number in ``networks``, k, ...arguments].
    """
    nodes: list[list[Any]] = []
    networks: list[Network] = []
    for node in tape.nodes:
        if node.op == "const":
            nodes.append(["const", exact(float(node.value))])
        elif node.op == "pow":
            nodes.append(["pow", node.args[0], exact(float(node.value))])
        elif node.part is not None:
            if node.part.network not in networks:
                networks.append(node.part.network)
            nodes.append(["network", networks.index(node.part.network), node.part.output, *node.args])
        else:
            nodes.append([node.op, *node.args])
    called = {"networks": [_layers(network) for network in networks]} if networks else {}
    return {"nodes": nodes, "outputs": list(tape.outputs), **called}


def _layers(network: Network) -> list[dict[str, Any]]:
    return [
        {
            "weights": exact(np.array(layer.weights)), "bias": exact(np.array(layer.bias)),
            "activation": layer.activation, "constants": exact(np.array(layer.constants)),
        }
        for layer in network.layers
    ]  # fmt: skip


def _ranges(pairs: Iterable[tuple[float, float]]) -> list[list[Any]]:
    return [[_end(low), _end(high)] for low, high in pairs]


def _end(value: float) -> str | None:
    """null is an end at infinity."""
    return float(value).hex() if np.isfinite(value) else None


def _noise(system: Any) -> dict[str, Any]:
    if isinstance(system, ContinuousSystem):
        return {"law": "wiener", "diffusion": _drives(system.diffusion)}
    law: Law = system.noise
    check_law(law, "be certified", CertificateError)
    return {
        "law": law.name,
        "level": law.level.removeprefix("proxy_"),
        "values": exact(np.asarray(getattr(law, law.level), dtype=float)),
        "matrix": _drives(system.noise_matrix if system.gain is None else system.gain),
        **{flag: bool(getattr(law, flag)) for flag in law.flags},
        **({"tables": {name: exact(getattr(law, name)) for name in law.tables}} if law.tables else {}),
    }


def _drives(matrix: Any) -> Any:
    """What multiplies the noise: numbers, or a tape over t and the states."""
    if isinstance(matrix, Tape):
        return {"columns": int(matrix.shape[1]), **tape_data(matrix)}
    return exact(np.asarray(matrix, dtype=float))


_KINDS = ("box", "ball", "ellipsoid", "halfspace", "polytope")  # those that the checker has a row for


def initial_data(start: Any) -> dict[str, Any]:
    if isinstance(start, StartUnion):
        return {"kind": "union", "members": [initial_data(member) for member in start.members]}
    data = start.data(_KINDS)
    if data["kind"] == "polytope":  # by a box around it
        around = start.hull()
        data = {"kind": "box", "low": around.lo, "high": around.hi, "around": True}
    return {name: exact(value) for name, value in data.items() if value is not None}


def _region(data: Mapping[str, Any]) -> Mapping[str, Any]:
    def stated(name: str, value: Any) -> Any:
        if name in ("low", "high"):
            return [_end(x) for x in value]
        return tape_data(value) if isinstance(value, Tape) else exact(value)

    return {name: stated(name, value) for name, value in data.items()}
