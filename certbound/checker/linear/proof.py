"""The linear-response proof (Thm K7'): the certificate's numbers, and the inequalities that make them a proof.

Per cell of the initial set the file gives a nominal curve p, slopes, boxes B for the remainder beta, rows with levels
for the Gaussian part Z along them, and directions that keep obstacles off. From B follow sets of the remainder's
response R; with y (initial set and disturbance) and the levels they bound the deviation s = y + Z + R in a polytope.
Proved here, piece by piece: beta lies in B over that polytope. Then, but for the event that Z leaves its levels, the
constraints hold wherever Z stays below what y and R leave, and the probabilities of all these events are joined
(`families`). Noise that depends on the state adds a martingale M with levels of its own (`stopped`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise

from flint import arb, arb_mat, ctx

from certbound.checker.balls import column, diagonal, identity, magnitude, row_sums, upper
from certbound.checker.linear.diffusion import Along, Asked, StateNoise, Stopped
from certbound.checker.linear.events import Windows, bounded_drives, chain, sub_gaussian
from certbound.checker.linear.families import Family, leaving
from certbound.checker.linear.remainder import OutputRemainder, PieceData, Polytope, remainders
from certbound.checker.linear.response import (
    Load,
    Piece,
    Supports,
    balance,
    continuous_piece,
    covariances,
    discrete_piece,
    over_piece,
    supports,
    work_of_piece,
)
from certbound.checker.linear.samplers import raised
from certbound.checker.linear.shared import Shared
from certbound.checker.reading import Record, number, numbers, wholes
from certbound.checker.reading import entries as listed
from certbound.checker.report import PRODUCT, Budget, Unproved
from certbound.checker.statement import Grid, Model, cells_of, demands, structure_of
from certbound.checker.words import named
from certbound.errors import CertificateError
from certbound.problem.model import Tape

MOST_ROWS = 64
MOST_STATES = 100
MOST_NAMED = 5
"""Inputs that one message names."""
_BITS, _MOST_BITS = 128, 3000
_MILD = 0.25
"""Norm of the slopes times a piece, up to which series run well in the states' own units."""

_PROOF = ("engine", "splits", "pieces", "varying", "moving", "units", "windows", "cells")
_MAY = ("cuts", "sampled")
_CELL = (
    "nominal", "slopes", "drifts", "gains", "remainder_low", "remainder_high", "rows", "levels", "window_levels",
    "frames", "separations",
)  # fmt: skip


def check_linear(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability that a constraint is broken.

    It holds for every start and every disturbance, even one that sees coming noise; where the noise depends on the
    state, for every disturbance that does not. CertificateError where the proof's data are malformed, Unproved where an
    inequality could not be proved.
    """
    record = Record(value, "proof", _PROOF, _MAY)
    model = raised(model)
    if model.continuous and model.dimension > MOST_STATES:
        raise Unproved(f"{model.dimension} states are too many for this proof in continuous time")
    shared = Shared(model, structure_of(model, budget), record, budget)
    boxes = cells_of(model, record)
    entries = record.items("cells", len(boxes), len(boxes))
    outputs = remainders(model, shared.structure, budget)
    worst = arb(0)
    for index, (entry, box) in enumerate(zip(entries, boxes)):
        with budget.passing():
            cell = _Cell(shared, Record(entry, f"proof.cells[{index}]", _CELL, ("stopped", "sampled")), box, budget)
            worst = arb.max(worst, cell.probability(outputs))
    return upper(worst)


class _Cell:
    """One cell of the initial set."""

    def __init__(self, shared: Shared, record: Record, box: list[tuple[arb, arb]], budget: Budget) -> None:
        budget.check()
        self.shared, self.model, self.record, self.budget = shared, shared.model, record, budget
        model, n, count = shared.model, shared.model.dimension, shared.count
        continuous = model.continuous
        varying, moving = len(shared.structure.states.varying), len(shared.structure.disturbances.varying)
        self.nominal = record.array("nominal", *((count, 4, n) if continuous else (count + 1, n)))
        if continuous and any(a[3] != b[0] for a, b in pairwise(self.nominal)):
            raise Unproved("the nominal curve jumps")
        self.slopes = record.array("slopes", count, varying)
        if not continuous and record["drifts"] is not None:
            raise CertificateError(f"`{record.at('drifts')}` must be null in discrete time.")
        self.drifts = record.array("drifts", count, varying) if continuous else [[0.0] * varying] * count
        self.gains = record.array("gains", count, moving)
        if shared.sampler is not None:
            self.sampler, self.sampled = shared.sampler, shared.sampler.slopes(record)
        self.low, self.high = record.array("remainder_low", count, n), record.array("remainder_high", count, n)
        if any(a > b for lows, highs in zip(self.low, self.high) for a, b in zip(lows, highs)):
            raise CertificateError(f"`{record.at('remainder_low')}` must not exceed `remainder_high`.")
        self.rows, self.levels = self._rows()
        self.frames = self._frames()
        start = self.nominal[0][0] if continuous else self.nominal[0]
        self.start = [arb.max(high - p, p - low).upper() for (low, high), p in zip(box, map(arb, start))]
        self.middle = [arb((low + high) / 2) for low, high in model.disturbance]
        self.reach = [arb.max(arb(high) - m, m - arb(low)) for (low, high), m in zip(model.disturbance, self.middle)]
        self.grid = self._grid()
        self.demands = demands(model, self.grid, record.items("separations"), record.at("separations"), budget)
        self.state: StateNoise | None = None
        if record["stopped"] is not None or isinstance(model.noise.diffusion, Tape):
            self.state = StateNoise(
                model, record["stopped"], record.at("stopped"), pieces=count, units=len(shared.units),
                rows=len(self.rows[0]), demands=len(self.demands),
            )

    def _rows(self) -> tuple[list[list[list[arb]]], list[list[arb]]]:
        """Rows of Z's levels on every piece (unit rows first), over all states, and the levels."""
        record, units, n = self.record, self.shared.units, self.model.dimension
        given = record.items("rows", self.shared.count, self.shared.count)
        extra = len(listed(given[0], record.at("rows"), 0, MOST_ROWS))
        rows, zero, one = [], arb(0), arb(1)
        self.budget.hold((len(units) + self.shared.count * extra) * (n // 8 + 1))  # of the same 0
        fixed = [[one if j == unit else zero for j in range(n)] for unit in units]
        for item in numbers(given, record.at("rows"), self.shared.count, extra, len(units)):
            self.budget.balls(1 + extra * (n // 4 + 1))
            self.budget.take(8 * (len(fixed) + extra))
            whole = list(fixed)
            for row in item:
                full = [zero] * n
                for unit, value in zip(units, row):
                    full[unit] = arb(value)
                whole.append(full)
            rows.append(whole)
        levels = [
            [arb(number(x, record.at("levels"), least=0.0)) for x in listed(item, record.at("levels"), 0, 10**4)]
            for item in record.items("levels", self.shared.count, self.shared.count)
        ]
        if any(len(item) != len(units) + extra for item in levels):
            raise CertificateError(f"`{record.at('levels')}` must have one level a row.")
        return rows, levels

    def _frames(self) -> list[list[int]]:
        """Rows that serve as coordinates for each output's remainder; null: the unit rows."""
        record = self.record
        frames, most = [], len(self.rows[0]) - 1
        for i, item in enumerate(record.items("frames", self.model.dimension, self.model.dimension)):
            active = self.shared.structure.states.active(i)
            if item is not None:
                frames.append(wholes(item, f"{record.at('frames')}[{i}]", 0, most))
            else:
                frames.append(self.shared.coordinates(active))
        return frames

    def _grid(self) -> Grid:
        given, times = self.nominal, [self.shared.span(k) for k in range(self.shared.count)]
        if not self.model.continuous:
            times, given = [(arb(k), arb(k)) for k in range(self.shared.count + 1)], [[item] for item in given]
        return Grid(times=times, hulls=[[[arb(x) for x in point] for point in item] for item in given])

    # ---- the proof ---------------------------------------------------------------------------------------

    def probability(self, outputs: Sequence[OutputRemainder]) -> arb:
        """Upper bound of the probability that this cell's paths break a constraint."""
        self.budget.expect(self.shared.count * sum(output.expansion.work for output in outputs))
        self.pieces = self._pieces()
        n = self.model.dimension
        self.budget.products(len(self.pieces), n, n, 2 * n + 12)
        unit, back = diagonal(self.natural), diagonal([1 / value for value in self.natural])
        grown = [row_sums(back * piece.transition * unit) for piece in self.pieces]
        growth = sum(max(0.0, float(factor.log() / arb.const_log2())) for factor in grown)
        if growth <= 20:
            return self._probability(outputs)
        if not growth < math.inf:
            raise Unproved("the slopes are not finite")
        with ctx.workprec(int(min(_BITS + growth, _MOST_BITS))):
            self.pieces = self._pieces()
            return self._probability(outputs)

    def _probability(self, outputs: Sequence[OutputRemainder]) -> arb:
        start = self.model.initial.covariance
        start = identity(self.model.dimension) * 0 if start is None else start
        values = covariances(self.pieces, start, self.budget)
        bounds = self._supports()
        rooms = self._rooms(bounds)
        found = None if self.state is None else self._stopped(self.state, rooms)
        with ctx.workprec(_BITS):  # what a piece leaves over is a matter of that piece: nothing magnifies its balls
            for k in range(self.shared.count):
                levels = self.levels[k]
                if found is not None:
                    levels = [level + part.at(k) for level, part in zip(levels, found[1])]
                self._check_remainder(k, bounds, levels, outputs)
        return self._events(values, rooms, found)

    def _stopped(self, state: StateNoise, rooms: list[list[arb | None]]) -> tuple[arb, list[Along]]:
        """What the coordinates of M cost, and its levels along the rows of levels and along the demands."""
        excess = state.excess(self.shared.units, self.grid.times, self.grid.hulls, self.budget)
        found = Stopped(Windows(self.pieces, [], state.windows, self.budget), excess, state.coordinates, self.budget)
        count = self.shared.count
        asked = [
            Asked(rows=[rows[d] for rows in self.rows], levels=[arb(0)] * count, factors=factors)
            for d, factors in enumerate(state.rows)
        ]
        for number_, demand in enumerate(self.demands):
            given = None if state.rooms is None else state.rooms[number_]
            asked.append(Asked(rows=demand.rows, levels=rooms[number_], factors=given))
        return found.paid, found.along(asked)

    @cached_property
    def natural(self) -> list[arb]:
        """Units of the states in which the slopes' rows and columns are about equal; their own where these serve.

        A bound that is the same for all entries widens in other units wherever states hardly drive each other.
        """
        n = self.model.dimension
        self.budget.products(len(self.slopes), n, n, 24)
        self.budget.products(20, n, n, 12)  # `balance`
        largest = identity(n) * 0
        for slopes in self.slopes:
            largest = largest + magnitude(self.shared.structure.states.matrix(slopes))
        if self.model.continuous and row_sums(largest) * self.shared.length <= _MILD * len(self.slopes):
            return [arb(1)] * n
        return balance(largest)

    def _pieces(self) -> list[Piece]:
        shared, state = self.shared, self.state
        fixed = identity(self.model.dimension) * 0 if state is not None else self.model.noise.covariance()
        self.budget.hold(self.shared.count * self.model.dimension**2 * (8 if self.model.continuous else 4))
        result = []
        jacobian = shared.structure.states
        n = self.model.dimension
        if self.model.continuous and self.shared.sampler is None:
            self.budget.expect(self.shared.count * math.prod(work_of_piece(n)) * PRODUCT)
        for k, (slope, drifts) in enumerate(zip(map(jacobian.matrix, self.slopes), self.drifts)):
            self.budget.products(*(work_of_piece(n) if self.model.continuous else (n, n, 8)))
            noise = fixed if state is None else state.noise(k)
            if (number_ := shared.sampled(k)) is not None:
                result.append(self.sampler.piece(self.sampled[number_]))
            elif self.model.continuous:
                drift = jacobian.matrix(drifts, constants=False)
                result.append(continuous_piece(slope, drift, shared.length, noise, self.natural))
            else:
                result.append(discrete_piece(slope, noise))
        return result

    def _supports(self) -> Supports:
        """Bounds of y and R along the rows of levels and demands, over every piece."""
        n, count, continuous = self.model.dimension, self.shared.count, self.model.continuous
        self.budget.products(count, n, n + 20)  # loads
        self.budget.products(count, n, len(self.reach) * (n + 40) + 1)
        self.budget.take(16 * sum(map(len, self.rows)) + 16 * count * len(self.demands))
        one = identity(n)
        unit = [[one[i, j] for j in range(n)] for i in range(n)]
        inner = self.rows if continuous else [*self.rows, []]
        asked = [[*rows, *(demand.rows[k] for demand in self.demands)] for k, rows in enumerate(inner)]
        if continuous:
            self.budget.hold(n * sum(map(len, asked)))
        loads = [self._load(k) for k in range(count)]
        nodes: list[list[list[arb]]] = []
        for k in range(count + 1):
            own = asked[k] if k < len(asked) else []
            self.budget.products(len(own) + 1, n, n + 20)
            if not continuous:
                nodes.append(own)
            elif k < count:
                ends = [(arb_mat(1, n, row) * self.pieces[k].transition).entries() for row in own]
                nodes.append([*unit, *own, *ends])
            else:
                nodes.append([])
        found = supports([p.transition for p in self.pieces], nodes, loads, self.start, self.budget)
        if not continuous:
            return found
        parts = []
        for k in range(count):
            self.budget.products(len(asked[k]) + 6, n, 2 * len(self.reach) + n + 60)
            gain = self._gain(k)
            parts.append(
                over_piece(self.pieces[k], asked[k], found, k, self._box(k), None if gain is None else gain[1])
            )
        low, high, reach = (list(part) for part in zip(*parts))
        return Supports(low=low, high=high, reach=reach)

    def _box(self, k: int) -> tuple[list[arb], list[arb]]:
        """Middle and radius of B on piece k."""
        pairs = [(arb(a), arb(b)) for a, b in zip(self.low[k], self.high[k])]
        return [(a + b) / 2 for a, b in pairs], [(b - a) / 2 for a, b in pairs]

    def _gain(self, k: int) -> tuple[arb_mat, list[arb]] | None:
        """E with its columns scaled by the disturbance's radii, and the bound of |E (d - d0)|."""
        if not self.reach or self.shared.sampled(k) is not None:
            return None
        gain = self.shared.structure.disturbances.matrix(self.gains[k])
        n, q = self.model.dimension, len(self.reach)
        scaled = arb_mat(n, q, [gain[i, j] * self.reach[j] for i in range(n) for j in range(q)])
        return scaled, [sum((abs(scaled[i, j]) for j in range(q)), arb(0)) for i in range(n)]

    def _load(self, k: int) -> Load:
        piece, n = self.pieces[k], self.model.dimension
        middle, radius = self._box(k)
        gain = self._gain(k)
        zero = [arb(0)] * n
        if not self.model.continuous:
            return Load(centre=column(middle), radius=radius, generators=None if gain is None else gain[0], box=zero)
        h, one = piece.length, identity(n)
        spread = ((one + piece.deviation) * column(radius) * h).entries()
        generators, box = None, zero
        if gain is not None:
            generators = (one + piece.slope * (h / 2)) * gain[0] * h
            box = ((piece.size * (h * h / 4) + piece.second * h) * column(gain[1])).entries()
        return Load(centre=piece.gathered * column(middle), radius=spread, generators=generators, box=box)

    def _check_remainder(
        self, k: int, bounds: Supports, levels: Sequence[arb], outputs: Sequence[OutputRemainder]
    ) -> None:
        """beta lies in B on piece k, where Z and M keep to their levels; s lies in H."""
        self.budget.balls(16 * self.model.dimension + 3 * len(self.slopes[0]) + 8 * len(levels))
        data, hidden_of, scale = self._data(k), self.shared.hidden, arb(1)
        if (number_ := self.shared.sampled(k)) is not None:
            data = self.sampler.data(k, self.nominal[k], self.sampled[number_])
            outputs, hidden_of, scale = self.sampler.outputs, self.sampler.hidden, self.sampler.length
        low, high = [], []
        for d, level in enumerate(levels):
            size = bounds.reach[k][d] + level
            low.append(bounds.low[k][d] - size)
            high.append(bounds.high[k][d] + size)
        if self.state is not None and not self.state.holds(k, low, high):
            raise Unproved(f"the state was not shown to stay in the set over which its noise is bounded on piece {k}")
        sides = {unit: (low[d], high[d]) for d, unit in enumerate(self.shared.units)}
        jumped = self._jumped(k, outputs, sides)
        for i, output in enumerate(outputs):
            output.prepare(data)
            hidden = hidden_of[i]
            bounded = all(slot > self.model.dimension or slot - 1 in sides for slot in hidden)
            if hidden and not (bounded and output.is_decided(sides)):
                raise Unproved(self._jumping(i, hidden))
            frame = self.frames[i] if number_ is None else self.shared.coordinates(output.states)
            polytope = Polytope(rows=self.rows[k], low=low, high=high, frame=frame, sides=sides)
            least = (self.low[k][i] * scale + jumped[i]).upper()
            most = (self.high[k][i] * scale - jumped[i]).lower()
            if not output.prove(polytope, least, most, self.budget):
                name = named(self.model.states[i])
                at = f"piece {k}" if self.model.continuous else f"step {k}"
                raise Unproved(f"the remainder of {name} was not shown to stay in its box on {at}")

    def _jumped(self, k: int, outputs: Sequence[OutputRemainder], sides: Mapping[int, tuple[arb, arb]]) -> list[arb]:
        """How much of B a row of the plan takes that holds on a part of piece k, beside its own pieces.

        There beta misses what the piece's own row gives by at most D. All bounds of R rest on integrals of |beta - m|
        over a piece, m the middle of B: with beta elsewhere as much inside of B as that part times D, they hold.
        """
        if self.model.changes is not None:
            self.budget.balls(10 * (1 + len(self.model.changes[0].low)))
        found = self.shared.beside(k)
        if found is None:
            return [arb(0)] * len(outputs)
        inputs, part = found
        data, widths = self._data(k), []
        values = [*data.values[: len(data.values) - len(inputs)], *inputs]
        for output in outputs:
            widths.append((output.width(replace(data, values=values), sides) * part).upper())
        return widths

    def _jumping(self, i: int, hidden: Sequence[int]) -> str:
        """What is not proved where state i may jump with inputs that it is linear in otherwise."""
        inputs = self.model.dynamics.inputs
        names = ", ".join(named(inputs[slot]) for slot in hidden[:MOST_NAMED])
        more = " and others" if len(hidden) > MOST_NAMED else ""
        return f"{named(self.model.states[i])} may jump with {names}{more}, in which it is linear otherwise"

    def _data(self, k: int) -> PieceData:
        """The parameters of the remainder's expressions."""
        shared, n = self.shared, self.model.dimension
        if self.model.continuous:
            h, (first, last) = shared.length, shared.span(k)
            values = [(first + last) / 2]
            for j in range(n):
                a, b, c, d = (arb(point[j]) for point in self.nominal[k])
                values += [
                    (a + 3 * (b + c) + d) / 8, (d + c - b - a) * 3 / (4 * h),
                    (a - b - c + d) * 3 / (2 * h * h), (d - a + 3 * (b - c)) / (h * h * h),
                ]  # fmt: skip
            values += [arb(a) + arb(b) * h / 2 for a, b in zip(self.slopes[k], self.drifts[k])]
            values += [arb(b) for b in self.drifts[k]]
        else:
            h = arb(0)
            values = [arb(k), *map(arb, self.nominal[k]), *map(arb, self.nominal[k + 1])]
            values += [arb(a) for a in self.slopes[k]]
        values += [*map(arb, self.gains[k]), *self.middle, *shared.inputs(k)]
        return PieceData(values=values, half=h / 2, disturbance=self.middle, disturbance_radius=self.reach)

    def _rooms(self, bounds: Supports) -> list[list[arb | None]]:
        """What y and R leave of every demand, piece by piece."""
        count, inner = self.shared.count, len(self.rows[0])
        result: list[list[arb | None]] = []
        for number_, demand in enumerate(self.demands):
            self.budget.balls(6 * count)
            rooms: list[arb | None] = []
            for k, room in enumerate(demand.rooms):
                place = number_ + (inner if k < count else 0)
                used = bounds.reach[k][place] + bounds.high[k][place]
                rooms.append(None if room is None else (room - used).lower())
            result.append(rooms)
        return result

    def _events(
        self, values: list[arb_mat], rooms: list[list[arb | None]], found: tuple[arb, list[Along]] | None
    ) -> arb:
        """Probability that Z or M leave their levels, or exceed what the demands leave."""
        inner = len(self.rows[0])
        families = [
            Family(label="the levels", rows=[r[d] for r in self.rows], levels=[z[d] for z in self.levels], both=True)
            for d in range(inner)
        ]
        for number_, (demand, left) in enumerate(zip(self.demands, rooms)):
            if found is not None:
                part = found[1][inner + number_]
                left = [None if room is None else (room - part.at(k)).lower() for k, room in enumerate(left)]
            families.append(Family(label=demand.label, rows=demand.rows, levels=left))
        total = self._leaving(values, families)
        if found is None:
            return total
        sizes = [part.probability * (2 if d < inner else 1) for d, part in enumerate(found[1])]
        return upper(sum(sizes, total + found[0]))

    def _drives(self, moves: list[arb_mat]) -> list[arb_mat] | None:
        """What noise of bounded entries does at most; None where these or the start have no bounds."""
        noise = self.model.noise
        if noise.halfwidth is None or self.model.initial.covariance is not None:
            return None
        return bounded_drives(moves, noise.constant(), noise.halfwidth, self.budget)

    def _leaving(self, values: list[arb_mat], families: list[Family]) -> arb:
        """The probability of all families of events together."""
        model, budget = self.model, self.budget
        if not model.continuous:
            if self.record["window_levels"] is not None:
                raise CertificateError(f"`{self.record.at('window_levels')}` must be null in discrete time.")
            moves = [piece.transition for piece in self.pieces]
            if model.noise.gaussian:
                return leaving(families, lambda f: chain(f.rows, f.levels, moves, values, budget), budget, normal=True)
            drives = self._drives(moves)
            return leaving(families, lambda f: sub_gaussian(f.rows, f.levels, values, budget, drives), budget)
        given = self.record.array("window_levels", len(self.shared.windows), model.dimension)
        windows = Windows(self.pieces, values, self.shared.windows, budget)
        paid = windows.coordinates([[arb(x) for x in item] for item in given])
        return leaving(families, lambda family: windows.exceedance(family.rows, family.levels), budget, paid=paid)
