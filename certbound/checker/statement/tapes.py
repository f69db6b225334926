"""Tapes as data: reading them and held laws, and whether two are the same function up to the order of their nodes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from certbound.checker.expressions import OPERATIONS
from certbound.checker.reading import Record, number, whole, wholes
from certbound.checker.reading import entries as listed
from certbound.checker.words import shortened
from certbound.errors import CertificateError
from certbound.problem.model import Layer, Network, Node, Part, Tape, needed

MOST_LAYERS, MOST_WIDTH = 32, 4096
MOST_SAMPLES = 1000


@dataclass(frozen=True, eq=False, kw_only=True)
class Hold:
    """Inputs that are held: the law (t, states) that computes them at the beginnings of ``count`` equal parts."""

    count: int
    law: Tape
    names: tuple[str, ...]

    def until(self, time: float, horizon: float) -> Hold:
        """The same up to a sampling time, by the exact values of both floats.

        CertificateError where it is none.
        """
        samples = self.count * Fraction(time) / Fraction(horizon)
        if samples.denominator != 1:
            raise CertificateError("`proof.time` must be a sampling time where inputs are held.")
        return replace(self, count=int(samples))


def read_hold(record: Record, states: tuple[str, ...], inputs: tuple[str, ...]) -> Hold | None:
    """The law of inputs that are held: {"count": sampling times, "law": tape}."""
    if "hold" not in record.value:
        return None
    inner = Record(record["hold"], record.at("hold"), ("count", "law"))
    if record["time"] != "continuous" or record["horizon"] is None or not inputs:
        raise CertificateError(f"`{inner.path}` must be left out in discrete time, without an end, and without inputs.")
    count = inner.whole("count", 1, MOST_SAMPLES)
    return Hold(count=count, law=read_tape(inner["law"], inner.at("law"), ("t", *states), (len(inputs),)), names=inputs)


def read_tape(value: object, path: str, inputs: tuple[str, ...], shape: tuple[int, ...]) -> Tape:
    """A tape over the given inputs: {"nodes": [[op, ...arguments]], "outputs": [...]}.

    ``networks``, where there are any, are lists of layers, and ["network", which, output, ...arguments] is a node.

    CertificateError where it is no straight-line program over known operations, has another number of outputs, or a
    node that no output needs: two tapes are the same function by what they need (`canonical`), and so must be what
    proofs read of them.
    """
    record = Record(value, path, ("nodes", "outputs"), ("networks",))
    networks = _networks(record)
    nodes = []
    known = OPERATIONS.keys() - {"pow", "kink"} | {"input"}  # a kink is part of a derivative only
    for index, entry in enumerate(record.items("nodes", 0, 50_000)):
        items = listed(entry, f"{path}.nodes[{index}]", 1, 3 + MOST_WIDTH)
        op, rest = items[0], items[1:]
        place = f"{path}.nodes[{index}]"
        if op == "const" and len(rest) == 1:
            nodes.append(Node("const", (), number(rest[0], place)))
        elif op == "pow" and len(rest) == 2:
            nodes.append(Node("pow", (whole(rest[0], place, 0, index - 1),), number(rest[1], place)))
        elif op == "network" and networks and len(rest) > 2:
            network = networks[whole(rest[0], place, 0, len(networks) - 1)]
            part = Part(network, whole(rest[1], place, 0, network.outputs - 1))
            nodes.append(Node(part.op, tuple(whole(arg, place, 0, 10**6) for arg in rest[2:]), 0.0, part))
        elif isinstance(op, str) and op in known and len(rest) < 3:
            nodes.append(Node(op, tuple(whole(arg, place, 0, 10**6) for arg in rest)))
        else:
            raise CertificateError(f"`{place}` is no operation.")
    outputs = wholes(record["outputs"], record.at("outputs"), 0, max(len(nodes) - 1, 0))
    count = 1
    for length in shape:
        count *= length
    if len(outputs) != count:
        raise CertificateError(f"`{path}.outputs` must have {count} entries, got {len(outputs)}.")
    try:
        tape = Tape(inputs=inputs, nodes=tuple(nodes), outputs=tuple(outputs), shape=shape)
    except ValueError as error:
        raise CertificateError(f"`{path}` is no tape: {shortened(str(error), 200)}") from error
    used = needed(tape.nodes, tape.outputs)
    if not all(used):
        raise CertificateError(f"`{path}.nodes[{used.index(False)}]` must go: no output needs it.")
    return tape


def _networks(record: Record) -> list[Network]:
    """The networks of a tape."""
    found = []
    for number_, item in enumerate(record.items("networks", 1, 20) if "networks" in record.value else []):
        path = f"{record.path}.networks[{number_}]"
        rows = [
            Record(row, f"{path}[{k}]", ("weights", "bias", "activation", "constants"))
            for k, row in enumerate(listed(item, path, 1, MOST_LAYERS))
        ]
        try:
            found.append(Network(layers=tuple(_layer(row) for row in rows)))
        except ValueError as error:
            raise CertificateError(f"`{path}` is no network: {shortened(str(error), 200)}") from error
    return found


def _layer(row: Record) -> Layer:
    weights = tuple(
        tuple(number(x, row.at("weights")) for x in listed(line, row.at("weights"), 1, MOST_WIDTH))
        for line in row.items("weights", 1, MOST_WIDTH)
    )
    bias, constants = (
        tuple(number(x, row.at(name)) for x in row.items(name, 0, MOST_WIDTH)) for name in ("bias", "constants")
    )
    return Layer(weights, bias, row.text("activation", 20), constants)


def canonical(data: Mapping[str, Any]) -> list[Any]:
    """A tape's data in a form that does not depend on the order of its nodes, nor on unused or repeated ones.

    Examples
    --------
    >>> first = {"nodes": [["input", 0], ["input", 1], ["add", 0, 1]], "outputs": [2]}
    >>> second = {"nodes": [["input", 1], ["input", 0], ["sq", 0], ["add", 1, 0]], "outputs": [3]}
    >>> canonical(first) == canonical(second)
    True
    """
    nodes, outputs = data["nodes"], data["outputs"]
    networks = [json.dumps(network, sort_keys=True) for network in data.get("networks", [])]
    numbers: dict[tuple[Any, ...], int] = {}
    place: list[int] = []
    for op, *rest in nodes:
        if op in ("const", "input"):
            key: tuple[Any, ...] = (op, *rest)
        elif op == "pow":
            key = (op, place[rest[0]], rest[1])
        elif op == "network":
            key = (op, networks[rest[0]], rest[1], *(place[arg] for arg in rest[2:]))
        else:
            key = (op, *(place[arg] for arg in rest))
        place.append(numbers.setdefault(key, len(numbers)))
    keys = list(numbers)
    found: dict[int, int] = {}
    result: list[Any] = []
    for output in outputs:
        stack = [place[output]]
        while stack:
            number_ = stack[-1]
            if number_ in found:
                stack.pop()
                continue
            key = keys[number_]
            args = _arguments(key)
            missing = [arg for arg in args if arg not in found]
            if missing:
                stack.extend(reversed(missing))
            else:
                found[number_] = len(result)
                own = [found[arg] for arg in args]
                result.append([key[0], *own, *_rest(key)])
                stack.pop()
    return [result, [found[place[output]] for output in outputs]]


def _arguments(key: tuple[Any, ...]) -> list[int]:
    """The arguments of an operation by its key."""
    if key[0] in ("const", "input"):
        return []
    return [key[1]] if key[0] == "pow" else list(key[3:] if key[0] == "network" else key[1:])


def _rest(key: tuple[Any, ...]) -> list[Any]:
    """What else makes an operation what it is."""
    if key[0] in ("const", "input"):
        return list(key[1:])
    return [key[2]] if key[0] == "pow" else list(key[1:3]) if key[0] == "network" else []
