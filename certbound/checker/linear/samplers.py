"""Inputs that are held: the model in the states (x, u), and what happens at sampling times.

Between two sampling times x' = f(t, x, u, d) and u' = 0; at one of them (x, u) jumps to (x, k(t, x)), which is a step
of discrete time with a remainder of its own. A proof has a piece without any length for every sampling time, before the
pieces that follow it; the boxes of its remainder are stated as those of a rate over one piece, as all others are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from flint import arb, arb_mat

from certbound.checker.linear.remainder import OutputRemainder, PieceData, remainders
from certbound.checker.linear.response import Piece, jump_piece
from certbound.checker.reading import Record, wholes
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model, Structure, structure_of
from certbound.errors import CertificateError
from certbound.problem.model import Node, Tape


def raised(model: Model) -> Model:
    """The model between sampling times, in the states (x, u); itself where nothing is held."""
    hold = model.hold
    if hold is None:
        return model
    tape, count, n = model.dynamics, len(hold.names), model.dimension
    nodes = (*tape.nodes, Node("const", (), 0.0))
    outputs = (*tape.outputs, *[len(tape.nodes)] * count)
    diffusion, initial, zeros = model.noise.constant(), model.initial, (arb(0),) * count
    covariance = initial.covariance
    if covariance is not None:
        covariance = arb_mat(n + count, n + count, [
            covariance[i, j] if max(i, j) < n else arb(0) for i in range(n + count) for j in range(n + count)
        ])  # fmt: skip
    m = diffusion.ncols()
    return replace(
        model, dynamics=Tape(inputs=tape.inputs, nodes=nodes, outputs=outputs, shape=(len(outputs),)),
        states=(*model.states, *hold.names),
        noise=replace(model.noise, diffusion=arb_mat(n + count, m, [*diffusion.entries(), *[arb(0)] * (count * m)])),
        initial=replace(initial, kind="box", low=(*initial.low, *zeros), high=(*initial.high, *zeros),
                        covariance=covariance),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Sampler:
    """Sampling times among the pieces of a proof, and the step that one of them is.

    ``parts`` equal pieces of the ``horizon`` follow each of the ``count`` sampling times.
    """

    count: int
    parts: int
    horizon: float
    structure: Structure
    outputs: list[OutputRemainder]
    hidden: list[list[int]]

    @property
    def length(self) -> arb:
        """Of a piece, at the working precision: transition matrices are as exact as it is."""
        return arb(self.horizon) / (self.count * self.parts)

    @property
    def varying(self) -> list[tuple[int, int]]:
        """Entries of the step's Jacobian that are no constants."""
        return self.structure.states.varying

    def number(self, k: int) -> int | None:
        """Which sampling time a piece is; None for a piece that lasts."""
        hold, part = divmod(k, self.parts + 1)
        return None if part else hold

    def span(self, k: int) -> tuple[arb, arb]:
        """Both ends of a piece."""
        hold, part = divmod(k, self.parts + 1)
        first = hold * self.parts
        return self.length * (first + max(part - 1, 0)), self.length * (first + part)

    def slopes(self, record: Record) -> list[list[float]]:
        """What a cell states of the entries that vary, one row a sampling time."""
        found: list[list[float]] = record.array("sampled", self.count, len(self.varying))
        return found

    def piece(self, slopes: Sequence[float]) -> Piece:
        """The linear data of a sampling time."""
        return jump_piece(self.structure.states.matrix(slopes), self.length)

    def data(self, k: int, nominal: Sequence[Sequence[float]], slopes: Sequence[float]) -> PieceData:
        """The parameters of piece k, a sampling time: when it is, the nominal before and after it, and the slopes."""
        values = [self.span(k)[0], *map(arb, nominal[0]), *map(arb, nominal[3]), *map(arb, slopes)]
        return PieceData(values=values, half=arb(0), disturbance=[], disturbance_radius=[])


def sampler_of(model: Model, record: Record, pieces: int, budget: Budget) -> Sampler | None:
    """The sampling times of a proof of a `raised` model; None where nothing is held."""
    hold = model.hold
    if hold is None:
        if record["sampled"] is not None:
            raise CertificateError(f"`{record.at('sampled')}` must be left out where no inputs are held.")
        return None
    parts, rest = divmod(pieces, hold.count)
    if rest or parts < 2:
        raise CertificateError("`proof.pieces` must be a multiple of the sampling times, and more of them than these.")
    law, n = hold.law, len(hold.law.inputs) - 1
    nodes = (*law.nodes, *(Node("input", (1 + j,)) for j in range(n)))
    outputs = (*range(len(law.nodes), len(nodes)), *law.outputs)
    tape = Tape(inputs=(*law.inputs, *hold.names), nodes=nodes, outputs=outputs, shape=(len(outputs),))
    step = replace(model, continuous=False, dynamics=tape, disturbance=[], plan=None)
    structure = structure_of(step, budget)
    given = [tuple(wholes(item, record.at("sampled"), 0, 10**6)) for item in record.items("sampled")]
    if given != structure.states.varying:
        raise Unproved("`proof.sampled` does not list the entries of the law's Jacobian that vary")
    return Sampler(
        count=hold.count, parts=parts - 1, horizon=model.horizon, structure=structure,
        outputs=remainders(step, structure, budget),
        hidden=[structure.hidden(step, output) for output in range(step.dimension)],
    )
