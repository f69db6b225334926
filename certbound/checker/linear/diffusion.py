"""Noise that depends on the state: M' = Jhat M dt + (g(t, X) - ghat) dW, stopped when s leaves a set H (Thm K7).

H is a box of the states that enter f or g, one a piece. Over it g - ghat lies in a ball matrix G, and for a window that
ends at t_e the martingale r . Phi(t_e, t) M_t exceeds q kappa with probability at most 2 Q(q), where

    kappa^2 = int_0^{t_e} sup_G |r Phi(t_e, tau) G|^2 dtau.

The row r Phi(t_e, .) lies on a chord over every piece up to a bulge; the squared size is convex along the chord, so
that its integral is at most that of its ends (trapezoid). That s stays strictly inside H is proved from the levels.
A martingale needs an integrand that does not see coming noise: the claim says so of the disturbance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from flint import arb, arb_mat

from certbound.checker.balls import identity, magnitude, matrix, tail, upper
from certbound.checker.expressions import Graph, Program, Undecided
from certbound.checker.linear.events import Windows
from certbound.checker.linear.response import Piece
from certbound.checker.reading import Record, entries, number, wholes
from certbound.checker.report import STEP, Budget, Unproved
from certbound.checker.statement import Model
from certbound.errors import CertificateError
from certbound.problem.model import Tape

_FIELDS = ("windows", "reference", "low", "high", "coordinates", "rows", "rooms")


class StateNoise:
    """What a certificate states about noise that depends on the state, for one cell (its entry ``stopped``).

    ``pieces``, ``units``, ``rows`` and ``demands`` are numbers: of pieces, of states with levels, of rows with levels,
    of demands. ``reference`` is ghat of every piece (None: 0); ``low`` and ``high`` are H, piece by piece and state by
    state. Levels are in units of kappa: ``coordinates`` of M's coordinates; ``rows`` and ``rooms`` along the rows and
    the demands, window by window (no ``rooms``: all room is M's).
    """

    def __init__(
        self, model: Model, value: object, path: str, *, pieces: int, units: int, rows: int, demands: int
    ) -> None:
        if not isinstance(model.noise.diffusion, Tape):
            raise CertificateError(f"`{path}` must be null: the noise does not depend on the state.")
        record = Record(value, path, _FIELDS)
        self.diffusion = model.noise.diffusion
        self.windows = wholes(record["windows"], record.at("windows"), 0, pieces - 1)
        if self.windows[:1] != [0] or any(a >= b for a, b in pairwise(self.windows)):
            raise CertificateError(f"`{record.at('windows')}` must rise from 0.")
        self.reference: list[arb_mat] | None = None
        if record["reference"] is not None:
            self.reference = [matrix(item) for item in record.array("reference", pieces, *self.diffusion.shape)]
        self.low, self.high = record.array("low", pieces, units), record.array("high", pieces, units)
        self.coordinates = arb(record.number("coordinates", least=0.0))
        self.rows = self._factors(record, "rows", rows)
        self.rooms: list[list[arb]] | None = None
        if record["rooms"] is not None:
            self.rooms = self._factors(record, "rooms", demands)
        elif self.reference is not None or model.initial.covariance is not None:
            raise CertificateError(f"`{record.at('rooms')}` may be null where all noise is in M only.")

    def _factors(self, record: Record, name: str, count: int) -> list[list[arb]]:
        windows, path = len(self.windows), record.at(name)
        return [
            [arb(number(x, path, least=0.0)) for x in entries(item, path, windows, windows)]
            for item in record.items(name, count, count)
        ]

    def noise(self, k: int) -> arb_mat:
        """ghat ghat^T on a piece."""
        if self.reference is None:
            return identity(self.diffusion.shape[0]) * 0
        return self.reference[k] * self.reference[k].transpose()

    def excess(
        self, units: Sequence[int], times: Sequence[tuple[arb, arb]], hulls: Sequence[Sequence[Sequence[arb]]],
        budget: Budget,
    ) -> list[arb_mat]:
        """g - ghat over the nominal curve plus H, piece by piece."""
        n, columns = self.diffusion.shape
        graph = Graph(budget)
        nodes = graph.include(self.diffusion, [graph.input(slot) for slot in range(n + 1)])
        outputs = [nodes[output] for output in self.diffusion.outputs]
        read = 0
        for output in outputs:
            read |= graph.masks[output]
        if any(read >> 1 + j & 1 and j not in units for j in range(n)):
            raise Unproved("`proof.units` lacks a state that the noise depends on")
        program = Program(graph, outputs, outputs, variables=n + 1)
        program.prepare([])
        found = []
        budget.hold(len(times) * n * columns)
        for k, ((start, end), hull) in enumerate(zip(times, hulls)):
            budget.balls(n * (2 + len(hull)) + 2 * n * columns)
            inputs = [start.union(end)]
            for j in range(n):
                value = hull[0][j]
                for point in hull[1:]:
                    value = value.union(point[j])
                inputs.append(value)
            for d, j in enumerate(units):
                inputs[1 + j] += arb(self.low[k][d]).union(arb(self.high[k][d]))
            try:
                values = arb_mat(n, columns, program.run(inputs))
            except Undecided as error:
                raise Unproved(f"the noise is not defined on all of its set on piece {k}, or may jump there") from error
            found.append(values if self.reference is None else values - self.reference[k])
        return found

    def holds(self, k: int, low: Sequence[arb], high: Sequence[arb]) -> bool:
        """Whether bounds of the units' states on a piece lie strictly inside H."""
        return all(
            a > arb(first) and b < arb(last) for a, b, first, last in zip(low, high, self.low[k], self.high[k])
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Asked:
    """A family of rows, the levels that w . (Z + M) must keep on every piece (None: not asked), and what M is granted.

    ``factors`` are M's levels in units of kappa, window by window; None: all of ``levels``.
    """

    rows: Sequence[Sequence[arb]]
    levels: Sequence[arb | None]
    factors: Sequence[arb] | None


@dataclass(frozen=True, eq=False, kw_only=True)
class Along:
    """Levels of M along a family of rows (None: not asked, or all there is), and P(M exceeds them), to one side."""

    levels: list[arb | None]
    probability: arb

    def at(self, k: int) -> arb:
        """The level on a piece."""
        level = self.levels[k]
        return arb(0) if level is None else level


class Stopped:
    """Levels of the stopped martingales.

    Of ``windows`` the covariances are not used; ``excess`` is g - ghat on every piece, ``factor`` the levels of the
    coordinates in units of kappa.
    """

    def __init__(self, windows: Windows, excess: Sequence[arb_mat], factor: arb, budget: Budget) -> None:
        self.windows, self.excess, self.budget = windows, excess, budget
        width = windows.n + (excess[0].ncols() if excess else 0)
        budget.hold(len(excess) * windows.n * width)
        budget.products(len(excess), windows.n, 2 * windows.n * windows.n + 12 * width)
        self.sizes = [magnitude(g) for g in excess]
        one = identity(windows.n)
        self.bends = [_bend(piece) for piece in windows.pieces]
        unit = [[one[i, j] for j in range(windows.n)] for i in range(windows.n)]
        kappa = self.kappas([unit] * len(windows.starts))
        windows.levels = [[factor * value for value in row] for row in kappa]
        count = sum(1 for row in kappa for value in row if not value.is_zero())
        self.paid = upper(4 * count * tail(factor))

    def kappas(self, directions: Sequence[Sequence[Sequence[arb]]]) -> list[list[arb]]:
        """Kappa of every window along each of its directions."""
        windows, n = self.windows, self.windows.n
        result: list[list[arb]] = []
        for end, rows in zip(windows.ends, directions):
            count = len(rows)
            if not count:
                result.append([])
                continue
            late = arb_mat(count, n, [x for row in rows for x in row])
            main, rest = [arb(0)] * count, [arb(0)] * count
            for k in range(end - 1, -1, -1):
                self.budget.products(count, n, 2 * n + 3 * self.excess[k].ncols() + 40)
                early = late * windows.pieces[k].transition
                half = windows.pieces[k].length / 2
                ends = [_squares(row * self.excess[k]) for row in (late, early)]
                bulge = _squares(magnitude(late) * self.bends[k] * self.sizes[k])
                for i in range(count):
                    main[i] += (ends[0][i] + ends[1][i]) * half
                    rest[i] += 2 * half * bulge[i]
                late = early
            result.append([(a.upper().sqrt() + b.upper().sqrt()).upper() for a, b in zip(main, rest)])
        return result

    def along(self, families: Sequence[Asked]) -> list[Along]:
        """Levels along rows, on the pieces where they are asked."""
        spans = [self.windows.spans(item.rows, [level is not None for level in item.levels]) for item in families]
        chosen = []
        self.budget.spend(STEP * len(self.windows.starts) * (1 + len(families)))
        for w in range(len(self.windows.starts)):
            chosen.append([number for number, (directions, _) in enumerate(spans) if directions[w] is not None])
        rows = [
            [direction for number in numbers if (direction := spans[number][0][w]) is not None]
            for w, numbers in enumerate(chosen)
        ]
        found = [dict(zip(numbers, values)) for numbers, values in zip(chosen, self.kappas(rows))]
        result = []
        for place, ((_, costs), item) in enumerate(zip(spans, families)):
            levels: list[arb | None] = [None] * len(item.levels)
            total = arb(0)
            for w, (start, end) in enumerate(zip(self.windows.starts, self.windows.ends)):
                kappa = found[w].get(place)
                if kappa is None:
                    continue
                self.budget.balls(len(costs), 150)
                pieces = [k for k in costs if start <= k < end]
                if item.factors is None:
                    total += _beyond(item.levels, costs, pieces, kappa)
                    continue
                factor = item.factors[w]
                total += arb(0) if kappa.is_zero() else 2 * tail(factor)
                for k in pieces:
                    levels[k] = (factor * kappa + costs[k]).upper()
            result.append(Along(levels=levels, probability=upper(total)))
        return result


def _beyond(levels: Sequence[arb | None], costs: dict[int, arb], pieces: Sequence[int], kappa: arb) -> arb:
    """P(a window's martingale exceeds what its pieces leave)."""
    least = arb.pos_inf()
    for k in pieces:
        level = levels[k]
        if level is not None:
            least = arb.min(least, (level - costs[k]).lower())
    if not least >= 0:
        return arb(1)
    return arb(0) if kappa.is_zero() else 2 * tail(least / kappa)


def _squares(values: arb_mat) -> list[arb]:
    """Upper bounds of the squared length of every row."""
    columns = values.ncols()
    sizes = [x.abs_upper() for x in values.entries()]
    return [
        sum((x * x for x in sizes[i * columns : (i + 1) * columns]), arb(0)).upper() for i in range(values.nrows())
    ]


def _bend(piece: Piece) -> arb_mat:
    """h^2/8 sup |d^2 Phi(t_{k+1}, tau)/dtau^2|: how far a row bulges from its chord, per unit of its late end."""
    whole = piece.size + piece.drift * piece.length
    one = identity(whole.nrows())
    return (one + piece.deviation) * (whole * whole + piece.drift) * (piece.length * piece.length / 8)
