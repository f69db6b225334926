"""A row of an affine law over time: pieces of time, halved where that pays, with enclosures over each whole piece.

For a row a let r(t) = a F(t), q = r A. With xi = a Z: s^2 = Var xi, c = cov(xi, a A Z) and e = Var(a A Z). From a
piece's start t_k on, V changes by D+ - D- with 0 <= D+(t) <= D+(h), the same for D-. So s^2 lies within [s_k^2 - r
Q-(h) r, s_k^2 + r Q+(h) r], e likewise, and c within half of sqrt(r Q+ r . q Q+ q) + sqrt(r Q- r . q Q- q) of the mean
of its ends, since 2 D(t) - D(h) lies between -D(h) and D(h). None of that asks how fast the model is.

The mean u(t) = r(t) x lies within h^(3/2)/sqrt(48) of its chord, times the root of int u''^2 = (q A) Q_x(h) (q A)^T
with the Gramian Q_x of x x^T (Cauchy and Schwarz with Green's function of the chord).
"""

from __future__ import annotations

from dataclasses import dataclass, field

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
    full: bool = False  # whether covariance matrices are kept
    levels: Integers = field(init=False)
    indices: list[int] = field(init=False)

    def __post_init__(self) -> None:
        law, self.levels, self.indices = self.law, np.zeros(1, dtype=np.intp), [0]
        n = law.dimension
        self.rows = [self.row]
        starts = [arb(0), arb(0), arb(0)]
        if law.covariance is not None:
            image = rows_of(arb_mat([self.row]) * law.covariance)[0]
            own = rows_of(arb_mat([self.row]) * law.slope)[0]
            starts = [square_of(self.row, image), dot(image, own),
                      square_of(own, rows_of(arb_mat([own]) * law.covariance)[0])]
        zero = arb_mat(n, n)
        self.matrices = [(zero, zero)] if self.full else []
        self._ends: list[list[arb]] = [starts, []]
        self._means: list[arb] = [self._mean(self.row), arb(0)]
        self._wides: list[arb] = [self._wide(self.row), arb(0)]
        pieces, found = self._pieces([self.row], 0)
        last = rows_of(arb_mat([self.row]) * law.doubling.transition(0))[0]
        self._ends[1] = [start + more for start, more in zip(starts, found[0])]
        self._means[1], self._wides[1] = self._mean(last), self._wide(last)
        if self.full:
            self.matrices.append(self._grown(0, 0))
        self.columns = {name: np.array(values) for name, values in pieces.items()}
        self._finish()

    def _mean(self, row: Row) -> arb:
        return arb(0) if self.law.still else dot(row, self.law.mean.entries())

    def _wide(self, row: Row) -> arb:
        if self.law.starts is None:
            return arb(0)
        return sum((abs(x) for x in (arb_mat([row]) * self.law.starts).entries()), arb(0))

    def _grown(self, node: int, level: int) -> tuple[arb_mat, arb_mat]:
        """V+ and V- a step of that level after a node."""
        doubling = self.law.doubling
        forward = doubling.transition(level)
        back = forward.transpose()
        gain, loss = self.matrices[node]
        gain = forward * gain * back + doubling.gramian(GAIN, level)
        if LOSS in doubling.sources:
            loss = forward * loss * back + doubling.gramian(LOSS, level)
        return gain, loss

    def _pieces(self, rows: list[Row], level: int) -> tuple[dict[str, list[float]], list[list[arb]]]:
        """What is known over pieces of a level from the rows at their starts, and how much s^2, c and e change."""
        law, doubling = self.law, self.law.doubling
        matrix = arb_mat(rows)
        moved = matrix * law.slope
        own = rows_of(moved)
        changes = [[arb(0)] * 3 for _ in rows]
        balls: dict[str, list[arb]] = {}
        for name, sign in ((GAIN, 1), (LOSS, -1)):
            if name in doubling.sources:
                gramian = doubling.gramian(name, level)
                images, own_images = rows_of(matrix * gramian), rows_of(moved * gramian)
                squares = [square_of(r, image) for r, image in zip(rows, images)]
                speeds = [square_of(q, image) for q, image in zip(own, own_images)]
                for change, r2, image, q, q2 in zip(changes, squares, images, own, speeds):
                    change[0] += sign * r2
                    change[1] += sign * dot(image, q)
                    change[2] += sign * q2
            else:
                squares = speeds = [arb(0)] * len(rows)
            balls[f"{name} s"], balls[f"{name} e"] = squares, speeds
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

    def split(self, places: Integers) -> None:
        """Halve the pieces at these places."""
        chosen = np.unique(places)
        added: dict[int, tuple[list[dict[str, float]], Row, list[arb], arb, arb, tuple[arb_mat, arb_mat] | None]] = {}
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
                matrices = self._grown(k, level + 1) if self.full else None
                added[k] = halves, middle[i], ends, self._mean(middle[i]), self._wide(middle[i]), matrices
        levels, indices, rows, ends, means, wides, matrices_ = [], [], [], [], [], [], []
        columns: dict[str, list[float]] = {name: [] for name in self.columns}
        before = {name: values.tolist() for name, values in self.columns.items()}
        for k, level in enumerate(self.levels.tolist()):
            rows.append(self.rows[k])
            ends.append(self._ends[k])
            means.append(self._means[k])
            wides.append(self._wides[k])
            if self.full:
                matrices_.append(self.matrices[k])
            if k not in added:
                levels.append(level)
                indices.append(self.indices[k])
                for name in columns:
                    columns[name].append(before[name][k])
                continue
            halves, row, end, mean, wide, matrices = added[k]
            levels += [level + 1, level + 1]
            indices += [2 * self.indices[k], 2 * self.indices[k] + 1]
            rows.append(row)
            ends.append(end)
            means.append(mean)
            wides.append(wide)
            if matrices is not None:
                matrices_.append(matrices)
            for name in columns:
                columns[name] += [half[name] for half in halves]
        self.levels, self.indices, self.rows = np.array(levels, dtype=np.intp), indices, rows
        self._ends, self._means = [*ends, self._ends[-1]], [*means, self._means[-1]]
        self._wides = [*wides, self._wides[-1]]
        if self.full:
            self.matrices = [*matrices_, self.matrices[-1]]
        self.columns = {name: np.array(values) for name, values in columns.items()}
        self._finish()

    def _finish(self) -> None:
        """Ends and pieces as floats."""
        s, c, e = ([end[i] for end in self._ends] for i in range(3))
        self.s, self.c, self.e = floats(s), floats(c), floats(e)
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
        low = np.minimum(self.s[0][:-1] - self.columns[f"{LOSS} s"] * (1 + 1e-15), self.s[0][1:])
        high = np.maximum(self.s[1][:-1] + self.columns[f"{GAIN} s"] * (1 + 1e-15), self.s[1][1:])
        return np.maximum(low, 0.0), high * (1 + 1e-15)

    def speed_of(self) -> tuple[Array, Array]:
        """Enclosure of e over each piece."""
        low = np.minimum(self.e[0][:-1] - self.columns[f"{LOSS} e"] * (1 + 1e-15), self.e[0][1:])
        high = np.maximum(self.e[1][:-1] + self.columns[f"{GAIN} e"] * (1 + 1e-15), self.e[1][1:])
        return np.maximum(low, 0.0), high * (1 + 1e-15)

    def cross_of(self) -> tuple[Array, Array]:
        """Enclosure of c over each piece."""
        columns = self.columns
        half = 0.5 * sum(root_up(columns[f"{name} s"]) * root_up(columns[f"{name} e"]) for name in (GAIN, LOSS))
        low = 0.5 * (self.c[0][:-1] + self.c[0][1:])
        high = 0.5 * (self.c[1][:-1] + self.c[1][1:])
        slack = half * (1 + 1e-14) + 4e-16 * (np.abs(low) + np.abs(high)) + 1e-300
        return low - slack, high + slack

    def rooms(self, bound: float, sign: int) -> tuple[Array, Array]:
        """Lower bounds of bound - sign * (mean and starts and disturbances): at the ends of pieces as lines, (K, 2).

        And upper bounds of the same at the ends, (K + 1,), of the start that is worst at each of them.
        """
        low, high = (self.mean if sign > 0 else (-self.mean[1], -self.mean[0]))
        used = high + self.wide
        ends = np.stack([used[:-1], used[1:]], axis=-1)
        error = self.columns[f"{MEAN} error"] + self.columns[f"{WIDE} error"] + self.pushed[1:]
        room = bound - ends - error[:, None]
        room = room - 1e-15 * (abs(bound) + np.abs(ends) + error[:, None]) - 1e-300 * (error[:, None] > 0)
        return room, bound - low


class Inaccurate(ArithmeticError):
    """Balls have become too wide: more bits are needed."""
