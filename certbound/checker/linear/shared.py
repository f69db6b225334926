"""What the cells of a linear-response proof share."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise

from flint import arb

from certbound.checker.linear.samplers import sampler_of
from certbound.checker.reading import Record, wholes
from certbound.checker.report import STEP, Budget, Unproved
from certbound.checker.statement import Model, Structure
from certbound.errors import CertificateError

MOST_PIECES = 4000


class Shared:
    """What all cells have in common: the grid, the windows, which entries of the Jacobians the file states."""

    def __init__(self, model: Model, structure: Structure, record: Record, budget: Budget) -> None:
        self.model, self.structure = model, structure
        self.count = record.whole("pieces", 1, MOST_PIECES)
        if not model.continuous and self.count != model.steps:
            raise CertificateError("`proof.pieces` must be the number of steps.")
        if model.continuous and model.plan is not None and self.count % len(model.plan):
            raise CertificateError("`proof.pieces` must be a multiple of the plan's rows.")
        for name, expected in (("varying", structure.states.varying), ("moving", structure.disturbances.varying)):
            given = [tuple(wholes(item, record.at(name), 0, 10**6)) for item in record.items(name)]
            if given != expected:
                raise Unproved(f"`proof.{name}` does not list the entries of the Jacobian that vary")
        self.units = wholes(record["units"], record.at("units"), 0, model.dimension - 1)
        budget.spend(4 * STEP * model.dimension * (model.dimension + len(model.disturbance)))  # for `hidden`
        if len(set(self.units)) != len(self.units):
            raise CertificateError("`proof.units` must be different states.")
        self.hidden = [structure.hidden(model, output) for output in range(model.dimension)]
        self.windows: list[int] = []
        if model.continuous:
            self.windows = wholes(record["windows"], record.at("windows"), 0, self.count - 1)
            if self.windows[:1] != [0] or any(a >= b for a, b in pairwise(self.windows)):
                raise CertificateError("`proof.windows` must rise from 0.")
        elif record["windows"] is not None:
            raise CertificateError("`proof.windows` must be null in discrete time.")

        self.sampler = sampler_of(model, record, self.count, budget)

    @property
    def length(self) -> arb:
        """Length of a piece."""
        if self.sampler is not None:
            return self.sampler.length
        return arb(self.model.horizon) / self.count if self.model.continuous else arb(1)

    def coordinates(self, active: Sequence[int]) -> list[int]:
        """The unit rows of states."""
        if any(j not in self.units for j in active):
            raise Unproved("`proof.units` lacks a state that enters nonlinearly")
        return [self.units.index(j) for j in active]

    def span(self, k: int) -> tuple[arb, arb]:
        """Both ends of a piece, in continuous time."""
        if self.sampler is not None:
            return self.sampler.span(k)
        return self.length * k, self.length * (k + 1)

    def sampled(self, k: int) -> int | None:
        """Which sampling time a piece is; None for a piece that lasts."""
        return None if self.sampler is None else self.sampler.number(k)

    def inputs(self, k: int) -> list[arb]:
        """The plan's inputs on piece k."""
        plan = self.model.plan
        if plan is None:
            return []
        return [arb(x) for x in plan[k * len(plan) // self.count if self.model.continuous else k]]

    def beside(self, k: int) -> tuple[list[arb], arb] | None:
        """Inputs on a part of piece k that a row of the plan reaches beside its own end, and that part; None: no such.

        Each input as a ball that also holds what it is on the rest of the piece.
        """
        changes = self.model.changes
        if changes is None:
            return None
        found, part, (edge, rest) = self.inputs(k), Fraction(0), divmod(k * (len(changes) - 1), self.count)
        horizon = Fraction(self.model.horizon)
        last = rest + len(changes) - 1 == self.count
        for place in [*([edge] if rest == 0 else []), *([edge + 1] if last else [])]:
            change, end = changes[place], horizon * place / (len(changes) - 1)
            missed = max(change.last, end) - min(change.first, end)
            if missed:
                part += missed * self.count / horizon
                found = [a.union(arb(b)).union(arb(c)) for a, b, c in zip(found, change.low, change.high)]
        return (found, arb(part.numerator) / part.denominator) if part else None
