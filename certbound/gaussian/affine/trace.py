"""A row of an affine law over time: pieces of time, halved where that pays, with enclosures over each whole piece.

For a row a let r(t) = a F(t), q = r A. With xi = a Z: s^2 = Var xi, c = cov(xi, a A Z) and e = Var(a A Z). From a
piece's start t_k on, V changes by D+ - D- with 0 <= D+(t) <= D+(h), the same for D-. So s^2 lies within [s_k^2 - r
Q-(h) r, s_k^2 + r Q+(h) r], e likewise, and c within half of sqrt(r Q+ r . q Q+ q) + sqrt(r Q- r . q Q- q) of the mean
of its ends, since 2 D(t) - D(h) lies between -D(h) and D(h). None of that asks how fast the model is. Rows with noise
of their own ask for two more: d = cov(xi, a A^2 Z), as c with q A in the place of q, and v = Var(a A^3 Z), as e.

The mean u(t) = r(t) x lies within h^(3/2)/sqrt(48) of its chord, times the root of int u''^2 = (q A) Q_x(h) (q A)^T
with the Gramian Q_x of x x^T (Cauchy and Schwarz with Green's function of the chord).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from flint import arb, arb_mat

from certbound.arrays import Array, Integers
from certbound.errors import EngineError
from certbound.gaussian.affine.law import GAIN, LOSS, MEAN, WIDE, AffineLaw, floats, root_up
from certbound.watch import poll

Row = list[arb]

_CHORD = 1 / np.sqrt(48.0) * (1 + 1e-12)
_ACCURATE = 1e-9  # of a variance, by which its ball may be wide
_DEEPEST = 200  # halvings


def dot(first: Row, second: Row) -> arb:
    """The inner product."""
    total = arb(0)
    for x, y in zip(first, second):
        total += x * y
    return total


def rows_of(matrix: arb_mat) -> list[Row]:
    """The rows as lists."""
    columns, entries = matrix.ncols(), matrix.entries()
    return [entries[i : i + columns] for i in range(0, len(entries), columns)]


def square_of(row: Row, image: Row) -> arb:
    """r Q r^T from r and r Q: not negative."""
    value = dot(row, image)
    return value if value >= 0 else arb(0).union(abs(value).upper()) if value.is_finite() else value


@dataclass(eq=False)
class Trace:
    """Pieces [index, index + 1] T/2^level in the order of time, and what is known at their ends."""

    law: AffineLaw
    row: Row
    full: bool = False  # whether d and v are followed
    levels: Integers = field(init=False)
    indices: list[int] = field(init=False)

    def __post_init__(self) -> None:
        law, self.levels, self.indices = self.law, np.zeros(1, dtype=np.intp), [0]
        n = law.dimension
        self.rows = [self.row]
        starts = [arb(0)] * (5 if self.full else 3)
        if law.covariance is not None:
            found, _ = self._moments(arb_mat([self.row]), law.covariance)
            starts = [values[0] for values in found]
        self._matrices = {Fraction(0): (arb_mat(n, n), arb_mat(n, n))}
        self._ends: list[list[arb]] = [starts, []]
        self._means: list[arb] = [self._mean(self.row), arb(0)]
        self._wides: list[arb] = [self._wide(self.row), arb(0)]
        pieces, changes = self._pieces([self.row], 0)
        last = rows_of(arb_mat([self.row]) * law.doubling.transition(0))[0]
        self._ends[1] = [start + more for start, more in zip(starts, changes[0])]
        self._means[1], self._wides[1] = self._mean(last), self._wide(last)
        self.columns = {name: np.array(values) for name, values in pieces.items()}
        self._finish()

    def _mean(self, row: Row) -> arb:
        return arb(0) if self.law.still else dot(row, self.law.mean.entries())

    def _wide(self, row: Row) -> arb:
        if self.law.starts is None:
            return arb(0)
        return sum((abs(x) for x in (arb_mat([row]) * self.law.starts).entries()), arb(0))

    def matrices(self) -> list[tuple[arb_mat, arb_mat]]:
        """V+ and V- at the ends of the pieces; two products of matrices for each that was not asked for before."""
        doubling, known, found = self.law.doubling, self._matrices, [self._matrices[Fraction(0)]]
        for level, index in zip(self.levels.tolist(), self.indices):
            place = Fraction(index + 1, 1 << level)
            if place not in known:
                poll("covariances")
                forward = doubling.transition(level)
                back = forward.transpose()
                gain, loss = found[-1]
                gain = forward * gain * back + doubling.gramian(GAIN, level)
                if LOSS in doubling.sources:
                    loss = forward * loss * back + doubling.gramian(LOSS, level)
                known[place] = gain, loss
            found.append(known[place])
        return found

    def _pieces(self, rows: list[Row], level: int) -> tuple[dict[str, list[float]], list[list[arb]]]:
        """What is known over pieces of a level from the rows at their starts, and how much s^2, c and e change."""
        law, doubling = self.law, self.law.doubling
        matrix = arb_mat(rows)
        moved = matrix * law.slope
        changes = [[arb(0)] * (5 if self.full else 3) for _ in rows]
        balls: dict[str, list[arb]] = {}
        for name, sign in ((GAIN, 1), (LOSS, -1)):
            if name in doubling.sources:
                found, bends = self._moments(matrix, doubling.gramian(name, level))
                for change, *own in zip(changes, *found):
                    for i, value in enumerate(own):
                        change[i] += sign * value
            else:
                found = [[arb(0)] * len(rows)] * (5 if self.full else 3)
                bends = found[0]
            balls[f"{name} s"], balls[f"{name} e"] = found[0], found[2]
            if self.full:
                balls[f"{name} b"], balls[f"{name} v"] = bends, found[4]
        result = {name: floats(values)[1].tolist() for name, values in balls.items()}
        step = float(doubling.step(level)) * (1 + 1e-15)
        turned = moved * law.slope
        for name, factor in ((MEAN, 1.0), (WIDE, 1.0 if law.starts is None else np.sqrt(law.starts.ncols()))):
            error = np.zeros(len(rows))
            if name in doubling.sources:
                images = rows_of(turned * doubling.gramian(name, level))
                squares = [square_of(r, image) for r, image in zip(rows_of(turned), images)]
                error = root_up(floats(squares)[1]) * step**1.5 * _CHORD * factor * (1 + 1e-12)
            result[f"{name} error"] = error.tolist()
        pushed = np.zeros(len(rows))
        for place in range(len(law.disturbances)):
            images = rows_of(matrix * doubling.gramian(f"push{place}", level))
            squares = [square_of(r, image) for r, image in zip(rows, images)]
            pushed += root_up(floats(squares)[1]) * np.sqrt(step) * (1 + 1e-12)
        result["pushed"] = pushed.tolist()
        return result, changes

    def _moments(self, rows: arb_mat, form: arb_mat) -> tuple[list[list[arb]], list[arb]]:
        """s^2, c and e of rows under a covariance, and (``full``) d, v, and Var(a A^2 Z) apart."""
        slope, own = self.law.slope, rows_of(rows)
        moved, images = rows * slope, rows_of(rows * form)
        first = rows_of(moved)

        def squares(matrix: arb_mat) -> list[arb]:
            return [square_of(r, image) for r, image in zip(rows_of(matrix), rows_of(matrix * form))]

        found = [[square_of(r, image) for r, image in zip(own, images)]]
        found.append([dot(image, q) for image, q in zip(images, first)])
        found.append(squares(moved))
        if not self.full:
            return found, []
        again = moved * slope
        found.append([dot(image, q) for image, q in zip(images, rows_of(again))])
        found.append(squares(again * slope))
        return found, squares(again)

    def split(self, places: Integers) -> None:
        """Halve the pieces at these places."""
        chosen = np.unique(places)
        added: dict[int, tuple[list[dict[str, float]], Row, list[arb], arb, arb]] = {}
        doubling = self.law.doubling
        for level in np.unique(self.levels[chosen]).tolist():
            if level >= _DEEPEST:
                raise EngineError("the law of a limit could not be followed on finer pieces of time.")
            poll("the law of a limit")
            own = chosen[self.levels[chosen] == level].tolist()
            rows = [self.rows[k] for k in own]
            middle = rows_of(arb_mat(rows) * doubling.transition(level + 1))
            pieces, changes = self._pieces(rows + middle, level + 1)
            for i, k in enumerate(own):
                ends = [start + more for start, more in zip(self._ends[k], changes[i])]
                halves = [{name: values[j] for name, values in pieces.items()} for j in (i, len(own) + i)]
                added[k] = halves, middle[i], ends, self._mean(middle[i]), self._wide(middle[i])
        levels, indices, rows, ends, means, wides = [], [], [], [], [], []
        columns: dict[str, list[float]] = {name: [] for name in self.columns}
        before = {name: values.tolist() for name, values in self.columns.items()}
        for k, level in enumerate(self.levels.tolist()):
            rows.append(self.rows[k])
            ends.append(self._ends[k])
            means.append(self._means[k])
            wides.append(self._wides[k])
            if k not in added:
                levels.append(level)
                indices.append(self.indices[k])
                for name in columns:
                    columns[name].append(before[name][k])
                continue
            halves, row, end, mean, wide = added[k]
            levels += [level + 1, level + 1]
            indices += [2 * self.indices[k], 2 * self.indices[k] + 1]
            rows.append(row)
            ends.append(end)
            means.append(mean)
            wides.append(wide)
            for name in columns:
                columns[name] += [half[name] for half in halves]
        self.levels, self.indices, self.rows = np.array(levels, dtype=np.intp), indices, rows
        self._ends, self._means = [*ends, self._ends[-1]], [*means, self._means[-1]]
        self._wides = [*wides, self._wides[-1]]
        self.columns = {name: np.array(values) for name, values in columns.items()}
        self._finish()

    def _finish(self) -> None:
        """Ends and pieces as floats."""
        self.s, self.c, self.e, *more = (floats([end[i] for end in self._ends]) for i in range(len(self._ends[0])))
        if self.full:
            self.d, self.v = more
        top = float(np.max(self.s[1]))
        if not (np.isfinite(top) and np.all(self.s[1] - self.s[0] <= _ACCURATE * self.s[1] + 1e-30 * top + 1e-290)):
            raise Inaccurate
        self.mean, self.wide = floats(self._means), floats(self._wides)[1]
        step = self.law.doubling.step
        self.steps = np.array([float(step(int(level))) for level in self.levels])  # exact: halves of halves
        self.times = np.array(
            [float(self.law.doubling.step(int(level)) * index) for level, index in zip(self.levels, self.indices)]
            + [self.law.horizon]
        )
        self.pushed = np.concatenate([[0.0], np.cumsum(self.columns["pushed"]) * (1 + 1e-12)])

    def __len__(self) -> int:
        return len(self.levels)

    def spread_of(self) -> tuple[Array, Array]:
        """Enclosure of s^2 over each piece."""
        return self._lowest(self.s, "s"), self._highest(self.s, "s")

    def speed_of(self) -> tuple[Array, Array]:
        """Enclosure of e over each piece."""
        return self._lowest(self.e, "e"), self._highest(self.e, "e")

    def third_of(self) -> Array:
        """Upper bound of v over each piece, of a trace that is ``full``."""
        return self._highest(self.v, "v")

    def _lowest(self, ends: tuple[Array, Array], name: str) -> Array:
        """Lower bound of a variance, seen from both ends of each piece; not below 0."""
        gain, loss = (self.columns[f"{sign} {name}"] * (1 + 1e-15) for sign in (GAIN, LOSS))
        low = np.maximum(ends[0][:-1] - loss, ends[0][1:] - gain)
        return np.maximum(low - 1e-15 * np.abs(low), 0.0)

    def _highest(self, ends: tuple[Array, Array], name: str) -> Array:
        """Upper bound of a variance, seen from both ends of each piece."""
        gain, loss = (self.columns[f"{sign} {name}"] * (1 + 1e-15) for sign in (GAIN, LOSS))
        return np.asarray(np.minimum(ends[1][:-1] + gain, ends[1][1:] + loss) * (1 + 1e-15))

    def cross_of(self) -> tuple[Array, Array]:
        """Enclosure of c over each piece."""
        return self._crossed(self.c, "e")

    def second_of(self) -> tuple[Array, Array]:
        """Enclosure of d over each piece, of a trace that is ``full``."""
        return self._crossed(self.d, "b")

    def _crossed(self, ends: tuple[Array, Array], name: str) -> tuple[Array, Array]:
        columns = self.columns
        half = 0.5 * sum(root_up(columns[f"{sign} s"]) * root_up(columns[f"{sign} {name}"]) for sign in (GAIN, LOSS))
        low = 0.5 * (ends[0][:-1] + ends[0][1:])
        high = 0.5 * (ends[1][:-1] + ends[1][1:])
        slack = half * (1 + 1e-14) + 4e-16 * (np.abs(low) + np.abs(high)) + 1e-300
        return low - slack, high + slack

    @property
    def chord_error(self) -> Array:
        """By which the mean and what starts add to it may be away from their chords, (K,)."""
        return np.asarray(self.columns[f"{MEAN} error"] + self.columns[f"{WIDE} error"])

    def rooms(self, bound: float, sign: int) -> tuple[Array, Array]:
        """Lower bounds of bound - sign * (mean and starts and disturbances): at the ends of pieces as lines, (K, 2).

        And upper bounds of the same at the ends, (K + 1,), of the start that is worst at each of them.
        """
        low, high = (self.mean if sign > 0 else (-self.mean[1], -self.mean[0]))
        used = high + self.wide
        ends = np.stack([used[:-1], used[1:]], axis=-1)
        error = self.chord_error + self.pushed[1:]
        room = bound - ends - error[:, None]
        room = room - 1e-15 * (abs(bound) + np.abs(ends) + error[:, None]) - 1e-300 * (error[:, None] > 0)
        return room, bound - low


class Inaccurate(ArithmeticError):
    """Balls have become too wide: more bits are needed."""
