"""The constants proof: contraction in a metric, a reach tube by defect, rooms, and Thm K2.

With J^T P + P J <= 2 c P (or ||J||_P <= L) everywhere, or on the model's domain: every noise-free trajectory stays
within rho_k of the nominal curve (Thm K5), every constraint leaves room for a deviation of r_k around that, and
P(exists t: ||S_t||_P > r_t) is bounded by Thm K2, for disturbances that do not see coming noise. Constants are needed
only until a room is left, and leaving the domain is a broken constraint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

from flint import arb, arb_mat

from certbound.checker.balls import FEWEST_HALVINGS, cholesky, identity, is_positive_definite, matrix
from certbound.checker.constants.kummer import MOST_POWER, Kummer, exit_probability
from certbound.checker.constants.rates import Contraction, Spread
from certbound.checker.constants.reach_tube import CurvePiece, Norm, Tube
from certbound.checker.reading import Record, entries, number
from certbound.checker.report import BALL, Budget, Unproved
from certbound.checker.statement import Grid, Model, cells_of, demands, round_demands, structure_of
from certbound.errors import CertificateError

MOST_PIECES = 20_000
MOST_DEGREE = 12
MOST_STATES = 200
SMALLEST_NU = 1e-6
_PROOF = (
    "engine", "assumed", "metric", "region", "times", "middles", "rate", "sigma", "nu", "start_sigma", "splits",
    "rooms", "kummer", "cells",
)  # fmt: skip
_CELL = ("nominal", "eta", "radius", "separations")

Box = list[tuple[arb, arb]]


def check_constants(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability that a constraint is broken.

    It holds for every start and every disturbance that does not see coming noise (Thm K2 rests on a supermartingale).
    CertificateError where the proof's data are malformed, Unproved where an inequality could not be proved.
    """
    return _Proof(model, Record(value, "proof", _PROOF), budget).probability()


def _none_or_numbers(value: object, path: str, count: int) -> list[arb | None]:
    return [None if x is None else arb(number(x, path)) for x in entries(value, path, count, count)]


class _Proof:
    """The data of the proof, and its inequalities."""

    def __init__(self, model: Model, record: Record, budget: Budget) -> None:
        self.model, self.record, self.budget = model, record, budget
        n = model.dimension
        if n > MOST_STATES:
            raise Unproved(f"{n} states are too many for this proof")
        budget.hold(8 * n * n)
        metric = identity(n) if record["metric"] is None else matrix(record.symmetric("metric", n))
        self.norm = Norm(metric, budget)
        self._read_times()
        self.rate, self.sigma = arb(record.number("rate")), arb(record.number("sigma", least=0.0))
        if not model.continuous and not self.rate > 0:
            raise CertificateError("`proof.rate` must be positive in discrete time, where it is a gain.")
        self.nu = arb(record.number("nu"))
        if not SMALLEST_NU <= self.nu <= n:
            raise CertificateError(f"`proof.nu` must lie in [{SMALLEST_NU}, {n}].")
        self.start_sigma = arb(record.number("start_sigma", least=0.0))
        self.rooms = _none_or_numbers(record["rooms"], "proof.rooms", self.count)
        if record["region"] not in ("everywhere", "domain"):
            raise CertificateError('`proof.region` must be "everywhere" or "domain".')

    def _read_times(self) -> None:
        """Pieces of the curve (continuous time), or the steps 0, ..., T."""
        model, record = self.model, self.record
        if not model.continuous:
            if record["times"] is not None or record["middles"] is not None:
                raise CertificateError("`proof.times` and `proof.middles` must be null in discrete time.")
            self.count = model.steps + 1
            self.ends = [(arb(k), arb(k)) for k in range(self.count)]
            self.middles = [arb(k) for k in range(self.count)]
            return
        times = record.array("times", None)
        if len(times) < 2 or len(times) > MOST_PIECES or any(a >= b for a, b in pairwise(times)):
            raise CertificateError("`proof.times` must rise.")
        if times[0] != 0.0 or times[-1] != model.horizon:
            raise Unproved("the pieces do not cover the horizon")
        self.count = len(times) - 1
        self.ends = [(arb(a), arb(b)) for a, b in pairwise(times)]
        middles = record.array("middles", self.count)
        if not all(a <= x <= b for (a, b), x in zip(pairwise(times), middles)):
            raise Unproved("a nominal polynomial is written about a time outside its piece: nothing bounds its rest")
        self.middles = [arb(x) for x in middles]

    @property
    def steps(self) -> int:
        """Pieces (CT) or transitions (DT) on which rates hold."""
        return self.count if self.model.continuous else self.count - 1

    # ---- the proof ---------------------------------------------------------------------------------------

    def probability(self) -> arb:
        """Every inequality, then Thm K2."""
        model, record = self.model, self.record
        boxes = cells_of(model, record)
        items = record.items("cells", len(boxes), len(boxes))
        self.structure = structure_of(model, self.budget)
        for index, (item, box) in enumerate(zip(items, boxes)):
            with self.budget.passing():
                self._check_cell(Record(item, f"proof.cells[{index}]", _CELL), box, whole=len(boxes) == 1)
        self._check_constants(boxes[0], assumed=record.flag("assumed"))
        return exit_probability(self._kummer(), self.budget)

    def _check_cell(self, cell: Record, box: Box, *, whole: bool) -> None:
        """Reach tube and rooms of one cell."""
        n, count, budget = self.model.dimension, self.count, self.budget
        nominal = cell.array("nominal", count, None, n)
        if any(not 1 <= len(item) <= MOST_DEGREE + 1 for item in nominal):
            raise CertificateError(f"`{cell.at('nominal')}` must hold polynomials of degree at most {MOST_DEGREE}.")
        points = sum(map(len, nominal))
        budget.hold(points * (n + 1) + 4 * count)
        budget.balls(points * n)
        pieces = [
            CurvePiece(
                start=start, end=end, middle=middle, coefficients=[[arb(x) for x in row] for row in item],
            )
            for (start, end), middle, item in zip(self.ends, self.middles, nominal)
        ]
        if not self.model.continuous and any(len(item) != 1 for item in nominal):
            raise CertificateError(f"`{cell.at('nominal')}` must hold points in discrete time.")
        eta = [arb(x) for x in cell.array("eta", self.steps)]
        radii = [arb(x) for x in cell.array("radius", count)]
        tube = Tube(self.model, self.structure, self.norm, pieces, budget)
        first = pieces[0].at(pieces[0].start)
        start = self.norm.start(self.model, [a for a, _ in box], [b for _, b in box], first, whole)
        tube.prove(start, self.rate, eta, radii)
        hulls = []
        for piece in pieces:
            budget.balls(piece.work)
            budget.hold(len(piece.coefficients) * n)
            hulls.append(piece.hull())

        def part(k: int, first: arb, last: arb) -> list[list[arb]]:
            budget.balls(pieces[k].work)
            return replace(pieces[k], start=first, end=last).hull()

        grid = Grid(times=self.ends, hulls=hulls, part=part)
        self._check_rooms(cell, grid, radii)

    def _check_rooms(self, cell: Record, grid: Grid, radii: Sequence[arb]) -> None:
        """Every constraint leaves the stated room around the reach tube."""
        given = demands(
            self.model, grid, cell.items("separations"), cell.at("separations"), self.budget, polygons=False
        )
        asked: list[tuple[str, list[arb | None], list[arb]]] = []
        for demand in given:
            duals: dict[int, arb] = {}
            self.budget.hold(2 * len(demand.rows))
            for row in demand.rows:
                if id(row) not in duals:
                    duals[id(row)] = self.norm.dual(row)
            asked.append((demand.label, demand.rooms, [duals[id(row)] for row in demand.rows]))
        rounds = round_demands(self.model, grid, self.budget)
        sizes = [ball.image.nrows() for ball in rounds]
        self.budget.expect(sum(k * k * k // 3 for k in sizes if k > 1) * FEWEST_HALVINGS * BALL)
        for ball in rounds:
            asked.append((ball.label, ball.rooms, [self.norm.section(ball.image)] * self.count))
        random = self.model.initial.covariance is not None
        for label, rooms, lengths in asked:
            self.budget.balls(4 * self.count)
            for k, (left, length) in enumerate(zip(rooms, lengths)):
                if left is None:
                    continue
                certain = not self.model.continuous and k == 0 and not random  # nothing has deviated from the tube yet
                room = arb(0) if certain else self.rooms[k]
                if room is None:
                    raise Unproved(f"`proof.rooms` states nothing on piece {k}, where \"{label}\" is asked")
                if not (radii[k] + room) * length <= left:
                    raise Unproved(f"\"{label}\" was not shown to leave the stated room on piece {k}")

    def _check_constants(self, start: Box, *, assumed: bool) -> None:
        """Rate or gain, sigma and nu hold on the region; or that is assumed, of a model without jumps there."""
        model = self.model
        box = self._global_box()
        contraction = Contraction(model, self.structure, self.norm.metric, self.budget)
        spread = Spread(model, self.norm.metric, self.budget)
        if assumed:
            contraction.smooth.prove(box, "the dynamics")
            if spread.smooth is not None:
                spread.smooth.prove(box[: 1 + model.dimension], "the noise")
            self._check_assumed(contraction, spread, start)
            return
        contraction.prove(box, self.rate, "rate" if model.continuous else "gain")
        spread.prove(box[: 1 + model.dimension], self.sigma, self.nu)

    def _check_assumed(self, contraction: Contraction, spread: Spread, start: Box) -> None:
        """What is assumed may not contradict the model: its constant noise, its Jacobian and noise at a start.

        A constant noise leaves nothing to assume of sigma and nu, which are proved in the stated metric.
        """
        model = self.model
        point = [(arb(0), arb(0)), *((low, low) for low, _ in start)]
        if spread.contradicts(point, self.sigma, self.nu):
            raise Unproved(
                f"the stated sigma = {float(self.sigma):.9g} and nu = {float(self.nu):.6g} contradict the file's own "
                "noise, which is larger in the stated metric"
            )
        inputs = [] if model.plan is None else [(arb(x), arb(x)) for x in model.plan[0]]
        disturbances = [(arb(low), arb(low)) for low, _ in model.disturbance]
        if contraction.contradicts([*point, *inputs, *disturbances], self.rate):
            raise Unproved(
                f"the stated {'rate' if model.continuous else 'gain'} = {float(self.rate):.9g} contradicts the file's "
                "own dynamics, which expand more at the start in the stated metric"
            )

    def _global_box(self) -> Box:
        """All inputs of the dynamics, everywhere or on the domain."""
        model = self.model
        ends: list[tuple[float | None, float | None]] = [(None, None)] * model.dimension
        if self.record["region"] == "domain":
            if model.domain is None:
                raise Unproved("the problem has no domain that constants could hold on")
            ends = model.domain
        states = [
            (arb.neg_inf() if low is None else arb(low), arb.pos_inf() if high is None else arb(high))
            for low, high in ends
        ]
        rows = [*(model.plan or []), *(row for change in model.changes or [] for row in (change.low, change.high))]
        self.budget.spend(sum(map(len, rows)) * 100)
        columns = list(zip(*rows))
        inputs = [(arb(min(column)), arb(max(column))) for column in columns]
        disturbances = [(arb(a), arb(b)) for a, b in model.disturbance]
        return [(arb(0), arb(model.horizon)), *states, *inputs, *disturbances]

    def _kummer(self) -> Kummer:
        """The scalars of Thm K2."""
        model = self.model
        record = Record(self.record["kummer"], "proof.kummer", ("form", "a", "v0"))
        if record["form"] not in ("kummer", "bessel"):
            raise CertificateError('`proof.kummer.form` must be "kummer" or "bessel".')
        bessel = record["form"] == "bessel"
        a, v0 = arb(record.number("a", least=0.0)), arb(record.number("v0"))
        if not v0 > 0 or not a <= MOST_POWER or (bessel and a.is_zero()):
            raise CertificateError("`proof.kummer` must have v0 > 0 and a in range.")
        n, half = model.dimension, self.nu / 2
        if not model.continuous and not model.noise.gaussian and self.nu < n and (bessel or not a < half):
            raise Unproved("sub-Gaussian noise with nu < n needs a < nu/2")
        covariance = model.initial.covariance
        if covariance is None:
            start = arb(0)
        else:
            start = self.start_sigma
            if not self.nu >= n:
                raise Unproved("a random start needs nu = n")
            self._check_start(covariance, start)
        lengths = [end - begin for begin, end in self.ends] if model.continuous else [arb(1)] * self.steps
        rooms = list(self.rooms)
        if not model.continuous and covariance is None:
            rooms[0] = None
        return Kummer(
            continuous=model.continuous, bessel=bessel, a=a, v0=v0, half=half, start=start,
            slopes=[self.rate] * self.steps, sigmas=[self.sigma] * self.steps, lengths=lengths, radii=rooms,
        )

    def _check_start(self, covariance: arb_mat, sigma: arb) -> None:
        """The random start's covariance is at most sigma^2 P^-1."""
        n = self.model.dimension
        root = cholesky(self.norm.metric, self.budget)
        self.budget.products(2, n, n, n)
        rest = identity(n) * (sigma * sigma) - root.transpose() * covariance * root
        if not is_positive_definite(rest, self.budget):
            raise Unproved("the random start was not shown to have the stated spread")

