"""Tapes of derivatives, cut down to what is needed, and what their outputs depend on."""

from __future__ import annotations

from certbound.problem.model.network_data import Part
from certbound.problem.model.operations import ROWS
from certbound.problem.model.tape import JUMPS, Node, Tape, needed


def selected(tape: Tape, outputs: list[int], function: Tape | None) -> Tape:
    """Some outputs of a derivative of ``function``: its own nodes, those that are needed, and no node twice.

    Without ``function`` only what the outputs need is kept: jumps elsewhere are no longer seen.
    """
    base = 0 if function is None else len(function.nodes)
    live = needed(tape.nodes, [tape.outputs[output] for output in outputs], base)
    moved: dict[int, int] = {}
    seen: dict[tuple[str, tuple[int, ...], str | Part], int] = {}
    nodes: list[Node] = []
    for index, node in enumerate(tape.nodes):
        if not live[index]:
            continue
        args = node.args if node.op == "input" else tuple(moved[arg] for arg in node.args)
        if node.op in ("add", "mul"):
            args = tuple(sorted(args))
        key = (node.op, args, node.part or (float(node.value).hex() if node.op in ("const", "pow") else ""))
        if index < base or key not in seen:
            seen.setdefault(key, len(nodes))
            moved[index] = len(nodes)
            nodes.append(node._replace(args=args))
        else:
            moved[index] = seen[key]
    return Tape(inputs=tape.inputs, nodes=tuple(nodes), outputs=tuple(moved[tape.outputs[o]] for o in outputs),
                shape=(len(outputs),))


def watched(tape: Tape) -> Tape:
    """The tape with its first node as one more output, which is infinite where the tape is refused."""
    outputs = (*tape.outputs, 0)
    return Tape(inputs=tape.inputs, nodes=tape.nodes, outputs=outputs, shape=(len(outputs),))


def varying_outputs(tape: Tape) -> list[bool]:
    """Whether each output depends on any input."""
    depends: list[bool] = []
    for node in tape.nodes:
        depends.append(node.op == "input" or any(depends[arg] for arg in node.args))
    return [depends[output] for output in tape.outputs]


def reads(tape: Tape) -> list[set[int]]:
    """Input slots that each node depends on."""
    found: list[set[int]] = []
    for node in tape.nodes:
        found.append({node.args[0]} if node.op == "input" else set().union(*(found[arg] for arg in node.args)))
    return found


def sources(tape: Tape) -> list[set[int]]:
    """Input slots that each output depends on."""
    found = reads(tape)
    return [found[output] for output in tape.outputs]


def deciding(tape: Tape) -> dict[int, set[int]]:
    """The nodes that may jump, and the input slots that decide whether they do."""
    found = reads(tape)
    return {
        index: found[node.args[0]] if node.op == "if_else_zero" else found[index]
        for index, node in enumerate(tape.nodes) if node.op in JUMPS
    }  # fmt: skip


def edged(tape: Tape) -> bool:
    """Whether a node may jump (but for ``atan2``) or have a kink: derivatives do not tell all of such a function."""
    return any(
        node.op in JUMPS or (node.op in ROWS and ROWS[node.op].kink is not None) for node in tape.nodes
    )


def adds_plainly(tape: Tape, gain: Tape, count: int) -> bool:
    """Whether a function is one without its last ``count`` inputs plus a constant matrix times them, node by node.

    That ``gain``, its derivative by them, is constant does not say so alone: that of a jump is 0.
    """
    if any(varying_outputs(gain)):
        return False
    first = len(tape.inputs) - count
    depends: list[bool] = []
    for node in tape.nodes:
        own = node.args[0] >= first if node.op == "input" else any(depends[arg] for arg in node.args)
        if own and node.op not in ("input", "add", "sub", "neg", "mul"):
            return False
        depends.append(own)
    return True


def is_zero(tape: Tape, output: int) -> bool:
    node = tape.nodes[tape.outputs[output]]
    return node.op == "const" and node.value == 0
