"""Where the paths of a proof by quadratic value bounds may go: forms over z = (xi, 1), walls, and the starts.

x = center + width xi, and the working box is [-1, 1]^n. A form Q stands for z' Q z. S is the part of the box on which
the forms of ``inside`` are at least 0 and that no obstacle covers; it lies in the safe set, and a path that leaves S
does so through a wall. On a wall the wall's own forms are at least 0, and ``row . z`` is 0 where it has a row.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

from flint import arb, arb_mat

from certbound.checker.balls import matrix
from certbound.checker.reading import Record
from certbound.checker.report import Unproved
from certbound.checker.statement import Model
from certbound.checker.values.second_order import Flow
from certbound.errors import CertificateError
from certbound.problem.model import Tape

Key = tuple[int, int]


@dataclass(frozen=True, eq=False, kw_only=True)
class Wall:
    """A part of the boundary of S."""

    row: list[arb] | None
    forms: list[arb_mat] = field(default_factory=list)


class WorkingBox:
    """The working box, what else bounds S, and the walls by what they are.

    A wall's key is (constraint, face), faces counted from 0 and only 0 where it is a ball or an obstacle, or
    (-1 - state, 0 or 1) of the lower or upper side of the working box. Walls that no path can reach are not there.
    """

    def __init__(self, model: Model, record: Record, flow: Flow) -> None:
        self.n, self.model, self.flow = model.dimension, model, flow
        center, width = record.array("center", self.n), record.array("width", self.n)
        if not all(value > 0 for value in width):
            raise CertificateError("`proof.width` must be positive.")
        self.center, self.width = [arb(x) for x in center], [arb(x) for x in width]
        self.inside: list[arb_mat] = []
        self.walls: dict[Key, Wall] = {}
        self._start()
        for number, constraint in enumerate(model.constraints):
            if constraint.during is not None or isinstance(constraint.region.center, Tape):
                raise Unproved(f"\"{constraint.label}\" has a window or moves, which this proof does not treat")
            if constraint.region.round:
                self._ball(number)
            elif constraint.inside:
                self._faces(number)
            else:
                rows = [self._row(number, face) for face in range(len(constraint.region.faces))]
                self.walls[number, 0] = Wall(row=None, forms=[linear(row, -1) for row in rows])
        for axis, end in itertools.product(range(self.n), (0, 1)):
            self._side(axis, end)

    # ---- constraints -----------------------------------------------------------------------------------------

    def _row(self, number: int, face: int) -> list[arb]:
        """face . (x - its centre) - bound over z."""
        region = self.model.constraints[number].region
        self.model.budget.balls(3 * (self.n + 2) ** 2)
        self.model.budget.hold((self.n + 1) ** 2)
        normal = region.lift(region.face(face), self.n)
        assert isinstance(region.center, list)
        middle = region.lift([arb(x) for x in region.center], self.n)
        offset = sum((a * (c - m) for a, c, m in zip(normal, self.center, middle)), -arb(region.bounds[face]))
        return [a * w for a, w in zip(normal, self.width)] + [offset]

    def _faces(self, number: int) -> None:
        """A polyhedron to stay in: faces across one state lie beyond the box, others are walls."""
        label = self.model.constraints[number].label
        for face, normal in enumerate(self.model.constraints[number].region.faces):
            row = self._row(number, face)
            if sum(value != 0 for value in normal) == 1:
                if not sum((abs(x) for x in row[:-1]), row[-1]) <= 0:
                    raise Unproved(f"the working box was not shown to keep \"{label}\"")
                continue
            form = linear(row, -1)
            self._check_start(form, label)
            self.inside.append(form)
            self._flat((number, face), row, None)

    def _ball(self, number: int) -> None:
        constraint = self.model.constraints[number]
        region = constraint.region
        if region.shape is not None or not region.radius > 0 or not isinstance(region.center, list):
            raise Unproved(f"\"{constraint.label}\" is no ball, which this proof asks for")
        limit = arb(region.radius) ** 2
        rows = [[arb(0)] * (self.n + 1) for _ in range(self.n + 1)]
        rows[-1][-1] = arb(1)
        for place, about in zip(region.coordinates, region.center):
            side, shift = self.width[place], self.center[place] - arb(about)
            rows[place][place] = -side * side / limit
            rows[place][-1] = rows[-1][place] = -side * shift / limit
            rows[-1][-1] -= shift * shift / limit
        form = matrix(rows) if constraint.inside else -matrix(rows)
        self._check_start(form, constraint.label)
        self.inside.append(form)
        self.walls[number, 0] = Wall(row=None, forms=[-form])

    # ---- walls -----------------------------------------------------------------------------------------------

    def _side(self, axis: int, end: int) -> None:
        """A side of the working box, unless it lies where some form is negative."""
        row = [arb(0)] * self.n + [arb(-1)]
        row[axis] = arb(2 * end - 1)
        self.model.budget.balls(4 * len(self.inside) * (self.n + 1) ** 2)
        z = [arb(0, 1)] * self.n + [arb(1)]
        z[axis] = row[axis]
        if not any(value(form, z) < 0 for form in self.inside):
            self._flat((-1 - axis, end), row, z)

    def _flat(self, key: Key, row: list[arb], z: list[arb] | None) -> None:
        """A flat wall; without noise across it only where the drift points outward, and none where it nowhere does."""
        drift = self.flow.rate(row, self.center, self.width)
        if drift is not None and z is not None and sum((a * b for a, b in zip(drift, z)), arb(0)) < 0:
            return
        self.walls[key] = Wall(row=row, forms=[] if drift is None else [linear(drift, 1)])

    # ---- starts ----------------------------------------------------------------------------------------------

    def _start(self) -> None:
        initial = self.model.initial
        if initial.covariance is not None:
            raise Unproved("this proof needs a bounded initial set")
        sides = list(zip(initial.low, initial.high, self.center, self.width))
        self.start = [((low - c) / w, (high - c) / w) for low, high, c, w in sides]
        if not all(low > -1 and high < 1 for low, high in self.start):
            raise Unproved("the starts were not shown to lie in the working box")

    def _check_start(self, form: arb_mat, label: str) -> None:
        self.model.budget.balls(4 * (self.n + 1) ** 2)
        self.model.budget.hold(2 * (self.n + 1) ** 2)
        if not value(form, [*(low.union(high) for low, high in self.start), arb(1)]) >= 0:
            raise Unproved(f"the starts were not shown to keep \"{label}\"")


def linear(row: Sequence[arb], sign: int) -> arb_mat:
    """The form of sign * row . z."""
    size = len(row)
    rows = [[arb(0)] * size for _ in range(size)]
    for i, x in enumerate(row):
        rows[i][-1] += sign * x / 2
        rows[-1][i] += sign * x / 2
    return matrix(rows)


def value(form: arb_mat, z: Sequence[arb]) -> arb:
    """z' Q z over a box of z."""
    total, size = arb(0), len(z)
    for i in range(size):
        total += form[i, i] * z[i] * z[i]
        total += sum((2 * form[i, j] * z[i] * z[j] for j in range(i)), arb(0))
    return total
