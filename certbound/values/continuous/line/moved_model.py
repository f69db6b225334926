"""The model in the coordinate in which moving limits stand still.

With x = o(t) + w(t) y the process Y = (X - o) / w has the drift (f(t, x, d) - o' - w' y) / w and the squared diffusion
a(t, x) / w^2; o and w are Lipschitz, which is all that Ito's formula needs of them.
"""

from __future__ import annotations

from dataclasses import replace

from certbound.problem.model import Graph, Tape, between_jumps, jacobian
from certbound.values.continuous.coefficients import Reader
from certbound.values.continuous.hypotheses import Model
from certbound.values.continuous.line.phases import Phase


def parts_of(model: Model, horizon: float) -> list[tuple[float, Model]]:
    """The model from one jump of its noise that t alone decides to the next: the end of each part, and its model.

    Such a noise has no full rank over the time of a jump, of which nothing but the values on either side is known; on
    either side it is continuous, and a path does not see a single time. Jumps of the drift are jumps of the parts too.
    """
    squares = between_jumps(model.square.tape, 1, horizon)
    if len(squares) == 1:
        return [(horizon, model)]
    drifts = between_jumps(model.drift.tape, 1, horizon)
    found = []
    for end in sorted({end for end, _ in (*squares, *drifts)}):
        drift, square = (next(tape for last, tape in parts if end <= last) for parts in (drifts, squares))
        found.append((end, replace(model, drift=Reader(drift, 2), square=Reader(square, 2))))
    return found


def model_on(phase: Phase, model: Model) -> Model:
    """The model of a phase over ("t", "y", *disturbances)."""
    if phase.origin is None and phase.width is None:
        return model
    return Model(
        drift=Reader(_moved(phase, model.drift.tape, drift=True), 2),
        square=Reader(_moved(phase, model.square.tape, drift=False), 2),
        branches=model.branches,
    )


def _moved(phase: Phase, tape: Tape, *, drift: bool) -> Tape:
    graph = Graph((tape.inputs[0], "y", *tape.inputs[2:]))
    inputs = [graph.input(slot) for slot in range(len(tape.inputs))]
    time, y = inputs[:2]

    def of_time(source: Tape | None, order: int) -> int:
        if source is None:
            return graph.const(0.0)
        function = jacobian(source, [0]) if order else source
        return int(function.evaluate(graph.arithmetic(), [time])[0])

    wide = graph.const(1.0) if phase.width is None else of_time(phase.width, 0)
    x = graph.apply("add", of_time(phase.origin, 0), graph.apply("mul", wide, y))
    value = tape.evaluate(graph.arithmetic(), [time, x, *inputs[2:]])[0]
    if not drift:
        return graph.tape([graph.apply("div", value, graph.apply("sq", wide))], (1, 1))
    speed = graph.apply("add", of_time(phase.origin, 1), graph.apply("mul", of_time(phase.width, 1), y))
    return graph.tape([graph.apply("div", graph.apply("sub", value, speed), wide)], (1,))
