"""Floating-point proposals of the probability U itself in two states; nothing here is certified.

U_tau = f.grad U + tr(a U'') / 2 + s, tau = T - t, is linear: collocation with quintic splines along both axes, and
steps of the Radau IIA method of three stages (order 5, L-stable; Hairer and Wanner, Solving Ordinary Differential
Equations II, Sec. IV.5), whose three systems are one real and one complex one (Sec. IV.8). They double as tau grows.

*Ramps.* U = 0 at T and 1 on the faces do not go together. So on a face U rises: 1 - U falls at a rate k(tau), and moves
along the face like the process whose motion across the face is left out; in a corner both faces' rates add up. So
1 - U in a corner is the product of what it is along both faces, and the equation holds there too.

*Corners of noises that go together.* In coordinates in which they do not, a corner has another angle, some corners more
than a right one, where second derivatives grow without limit: no source makes up for that. U is that of a box that is
larger by a share of a cell on each side, which is smooth in the corners of the box; the cells around it are left out of
what is proposed. Where the model is not defined there, such corners are given up.

*Given up* (`Plane.counted`) are those corners, and faces at which the box is only cut. U = -d there for lower bounds,
1 + d for upper ones: below 0, and above 1, nothing is asked of it. Ramps of lower bounds weaken towards these places.

*Eased*: U is drawn to that on the way (U_tau = ... - k (U + d) leaves a residual of the right sign), and the drift is
weakened at faces from which it leads back faster than cells can follow.

Lower bounds take U as it is. For upper bounds the ramp is over before T: U starts `SHIFT` ramps earlier, and is divided
by its least value on the faces.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix, diags, eye, kron, vstack
from scipy.sparse.linalg import splu

from certbound.arrays import Array
from certbound.values.continuous.hypotheses import top_of
from certbound.values.continuous.plane import Plan, Plane, Source, spread_nodes
from certbound.values.continuous.proposal import Splines
from certbound.values.continuous.surface import Surface
from certbound.watch import poll

Solve = Callable[[Array], Array]

SHIFT = 2.5
SMALL = 2.0**-8
"""e of V = e (U - 1)."""
_SMALLER = 2.0**-16  # where failing is rare: Q2 is next to nothing then, and left out
_LEAD = 6.0  # over cells^2: a ramp's share of the horizon
_RATE = 8.0  # of 1 - U on faces: at tau = x ramps, times x^2 / (1 + x^3) over a ramp
_GROWTH = 0.5  # a step over tau, at most
_FIRST = 0.2  # of a ramp, the first step
_LONGEST = 8  # steps of the horizon, at least
_FINELY, _SLOWLY = 24, 0.2  # both where failing is rare
_SOONER = 2.0  # ramps that U starts before T then
_CLOSELY = 0.25  # correlated: a wider box
PAST = 0.05  # d: how far beyond 0 and 1 U is where it is given up
_ZONE = 6  # cells at a face where the drift back is weakened

_R = 6**0.5
_STAGES = np.array([(4 - _R) / 10, (4 + _R) / 10, 1.0])
_INVERSE = np.linalg.inv([
    [(88 - 7 * _R) / 360, (296 - 169 * _R) / 1800, (-2 + 3 * _R) / 225],
    [(296 + 169 * _R) / 1800, (88 + 7 * _R) / 360, (-2 - 3 * _R) / 225],
    [(16 - _R) / 36, (16 + _R) / 36, 1 / 9],
])  # fmt: skip
_ROOTS, _TO = np.linalg.eig(_INVERSE)
_REAL = int(np.argmin(np.abs(_ROOTS.imag)))
_PAIR = int(np.argmax(_ROOTS.imag))
_FROM = np.linalg.inv(_TO)
_END = np.vander([0.0, *_STAGES], 4, increasing=True)
_END_RATE = np.array([0.0, 1.0, 2.0, 3.0]) @ np.linalg.inv(_END)


class Ramps:
    """The collocated equation on a grid; U is kept as the coefficients of its splines.

    ``plane`` must not depend on time and have one branch. Where noises go together, the box in which the equation is
    solved is larger by ``margin`` times their correlation, in cells beside a face. ``finely`` asks for shorter steps.
    """

    shift = SHIFT

    def __init__(
        self, plane: Plane, cells: int, lead: float, margin: float = 0.0, *, eased: bool = False, below: bool = False,
        finely: bool = False,
    ) -> None:
        self.plane, self.lead, self.longest = plane, lead, _FINELY if finely else _LONGEST
        self.small, self.growth = (_SMALLER, _SLOWLY) if finely else (SMALL, _GROWTH)
        self.shift, self.begun = _SOONER if finely else self.shift, _FIRST
        nodes = [self.grid(axis, Plan(cells=cells, growth=_GROWTH, lead=lead)) for axis in (0, 1)]
        shared = _correlation(plane, nodes)
        wide = [np.pad(one, 1, "reflect", reflect_type="odd") for one in nodes]
        for one, inner in zip(wide, nodes):
            one[[0, -1]] = inner[[0, -1]] + margin * shared * (one[[0, -1]] - inner[[0, -1]])
        wider = margin > 0 and shared > _CLOSELY and _is_defined(plane, wide)
        self.kept = slice(1, -1) if wider else slice(None)
        nodes = wide if wider else nodes
        self.nodes, self.splines = nodes, [Splines(one) for one in nodes]
        x, y = self.places = np.meshgrid(*(one.points for one in self.splines), indexing="ij")
        (force,), a = plane.drift(0.0, x, y), plane.square(0.0, x, y) * np.ones((2, 2, *x.shape))
        on = np.zeros((2, *x.shape))  # faces across the first and across the second axis
        on[0, [0, -1]] = on[1, :, [0, -1]] = 1
        share, lost = plane.counted(x, y, 0.0 if wider else 1.0)
        led = share if below else np.ones(x.shape)
        plain = force, led
        if eased:
            force, led = self._eased(force, a, led, x, y, below)
        own = [[csr_matrix(table) for table in one.dense] for one in self.splines]

        def part(weight: Array, i: int, j: int) -> csr_matrix:
            return csr_matrix(diags(weight.ravel()) @ kron(own[0][i], own[1][j]))

        self.mass = kron(own[0][0], own[1][0], format="csr")
        self.operator = part((1 - on[0]) * force[0], 1, 0) + part((1 - on[1]) * force[1], 0, 1)
        self.operator += part((1 - on[0]) * a[0, 0] / 2, 2, 0) + part((1 - on[1]) * a[1, 1] / 2, 0, 2)
        self.operator += part((1 - on[0]) * (1 - on[1]) * a[0, 1], 1, 1)
        met = on.sum(axis=0).ravel()
        moves = ((met == 0) | (share.ravel() > 0)).astype(float)  # not on faces that are no limits
        drawn, lost = -PAST if below else 1 + PAST, eased * moves * lost.ravel()
        given = (one * np.ones(np.shape(other)) for one, other in zip(plain, (force, led)))
        self.plain = not lost.any() and all(map(np.array_equal, given, (force, led)))
        self.operator = csr_matrix(diags(moves) @ self.operator - diags(lost) @ self.mass)
        self.count = met * led.ravel() * moves
        self.edge, self.inner = np.flatnonzero(met), np.flatnonzero(met == 0)
        self.moves, self.drawn = moves, drawn * lost
        self.first = splu(csc_matrix(self.mass)).solve(drawn * (1 - share.ravel()))
        self.factors: dict[float, tuple[Solve, Solve]] = {}

    def grid(self, axis: int, plan: Plan) -> Array:
        """The nodes along an axis."""
        return spread_nodes(self.plane, plan, axis)

    def fed(self, source: Source) -> Array:
        """A source where the equation asks for it, shape (K + 1, m)."""
        found = source.at([one.points for one in self.splines])
        return np.asarray(self.moves * found.reshape(len(found), -1))

    def least(self, whole: Surface) -> float:
        """A lower bound of U where paths fail."""
        return min(whole.face_range(axis, side)[0] for axis in (0, 1) for side in (0, 1))

    def top(self, whole: Surface) -> float:
        """An upper bound of U where paths may go: it may rise over 1 beside corners."""
        return top_of(whole)

    def _eased(self, force: Array, a: Array, led: Array, x: Array, y: Array, below: bool) -> tuple[Array, Array]:
        """The drift and what faces count where the drift leads back into the box faster than cells can follow.

        Above, that drift is weakened near faces: U rises towards them, so that the residual falls. Below, such faces
        have U = 0, and it is weakened there too: U falls towards them, so that the residual rises.
        """
        force, place = force * np.ones((2, *x.shape)), (x, y)
        weak, counted = force.copy(), led.copy()
        for axis, side in itertools.product((0, 1), (0, 1)):
            nodes = self.nodes[axis] if side == 0 else self.nodes[axis][::-1]
            zone, away, sign = abs(nodes[_ZONE] - nodes[0]), np.abs(place[axis] - nodes[0]), 1 - 2 * side
            most = a[axis, axis] * _ZONE / zone
            near = np.clip(2 - 2 * away / zone, 0.0, 1.0)
            near = near * near * (3 - 2 * near)
            if below:
                edge = np.take(sign * force[axis] / most, [-side], axis=axis)
                slow = np.clip(2 - edge, 0.0, 1.0) * np.ones(x.shape)
                slow = slow * slow * (3 - 2 * slow)
                own = np.moveaxis(counted, axis, 0)
                own[-side] *= np.moveaxis(slow, axis, 0)[-side]
                near = near * (1 - np.take(counted, [-side], axis=axis))
            weak[axis] -= sign * near * np.maximum(sign * force[axis] - most, 0.0)
        return weak, counted

    def surface(self, source: Source | None, *, below: bool) -> Surface:
        """V = e (U - 1), the source being added to U's equation, or taken off for a lower bound."""
        horizon, shift = self.plane.horizon, 0.0 if below else self.shift * self.lead
        times, first = _times(horizon, shift, (self.lead, self.begun), (self.longest, self.growth))
        sign = -1.0 if below else 1.0
        given = None if source is None else sign * self.fed(source)
        value = self.first
        rate = splu(csc_matrix(self.mass)).solve(self.operator @ value + self.drawn)
        values, rates = [value], [rate]
        for start, end in itertools.pairwise(times):
            poll("a proposal of the value function")
            step = end - start
            stages = [shift + horizon - (start + c * step) for c in _STAGES]
            fed = np.zeros((3, 1))
            if source is not None and given is not None:
                fed = np.stack([_at(source.times, given, t) for t in stages])
            ages = start + _STAGES * step
            found = self._step(value, step, fed, ages)
            rate = _END_RATE @ np.vstack([value, found]) / step
            value = found[2]
            values.append(value)
            rates.append(rate)
        return self._written(times[first:] - times[first], values[first:], rates[first:], below)

    def _step(self, value: Array, step: float, fed: Array, ages: Array) -> Array:
        """U at the three stages: the faces first, which do not depend on what is inside."""
        edges = self.edges(value, step, fed * np.ones(len(value)), ages)
        right = np.outer(stage_rates(step), np.asarray(self.mass @ value)) + fed + self.drawn
        right[:, self.edge] = edges
        return self.solved(step, right)

    def edges(self, value: Array, step: float, fed: Array, ages: Array) -> Array:
        """The coefficients of the faces at the three stages."""
        edge = self.edge
        x = ages / self.lead
        fall = _RATE * x * x / (1 + x**3) / self.lead
        own, moved = self.mass[edge][:, edge], self.operator[edge][:, edge]
        decay = kron(diags(fall), diags(self.count[edge]) @ own)
        system = kron(csr_matrix(_INVERSE / step), own) - kron(eye(3), moved) + decay
        gained = np.outer(stage_rates(step), np.asarray(self.mass @ value)[edge]) + fed[:, edge] + self.drawn[edge]
        gained = gained + np.outer(fall, self.count[edge])
        return np.asarray(splu(csc_matrix(system)).solve(gained.ravel()).reshape(3, -1))

    def solved(self, step: float, right: Array) -> Array:
        """The three stages from their right-hand sides: one real and one complex system."""
        if step not in self.factors:
            self.factors[step] = self.factor(_ROOTS[_REAL].real / step), self.factor(_ROOTS[_PAIR] / step)
        real, pair = self.factors[step]
        turned = _FROM @ right
        parts = np.outer(_TO[:, _REAL], real(np.ascontiguousarray(turned[_REAL].real)))
        parts = parts + 2 * np.outer(_TO[:, _PAIR], pair(turned[_PAIR]))
        return np.asarray(parts.real)

    def factor(self, root: complex) -> Solve:
        """What solves (root - operator) u = r with the coefficients of the faces given."""
        whole = vstack([
            (root * self.mass - self.operator)[self.inner], eye(len(self.count), format="csr")[self.edge]
        ], format="csr")  # fmt: skip
        order = np.argsort(np.concatenate([self.inner, self.edge]))
        solve: Solve = splu(csc_matrix(whole[order]), permc_spec="MMD_ATA").solve  # half the time of the usual order
        return solve

    def _written(self, times: Array, values: list[Array], rates: list[Array], below: bool) -> Surface:
        maps = [np.stack(one.at_nodes, axis=1) for one in self.splines]
        shape = tuple(one.count for one in self.splines)
        tables = np.array([values, rates]).reshape(2, -1, *shape)
        first = np.einsum("iap,rkpq->rkiaq", maps[0], tables, optimize=True)
        data = np.einsum("jbq,rkiaq->rkiajb", maps[1], first, optimize=True)[:, ::-1, self.kept, :, self.kept]
        forward = self.plane.horizon - times[::-1]
        forward[0], forward[-1] = 0.0, self.plane.horizon

        whole = Surface(
            axes=tuple(one[self.kept] for one in self.nodes), times=forward, values=data[0],
            start_rates=-data[1, :-1], end_rates=-data[1, 1:],
        )  # fmt: skip
        return self.scaled(whole, below)

    def scaled(self, whole: Surface, below: bool) -> Surface:
        """V = e (U - 1) from U itself."""
        scale = self.small / (max(1.0, self.top(whole)) if below else max(self.least(whole), 0.5))
        return replace(
            whole, values=scale * whole.values, start_rates=scale * whole.start_rates, end_rates=scale * whole.end_rates
        ).raised(-self.small)


def ramp_of(cells: int) -> float:
    """A ramp's share of the horizon."""
    return min(_LEAD / cells**2, 0.1)


def stage_rates(step: float) -> Array:
    """What the value at a step's beginning adds to the right-hand sides of its three stages."""
    return np.asarray(_INVERSE.sum(axis=1) / step)


def left_at(ages: Array) -> Array:
    """1 - U on a wall along which nothing moves, at ages in units of the ramp: it falls at `_RATE`."""
    return np.asarray((1 + ages**3) ** (-_RATE / 3))


def _correlation(plane: Plane, nodes: list[Array]) -> float:
    """The largest one of the noises across both faces in a corner."""
    a = plane.square(0.0, *np.meshgrid(*(one[[0, -1]] for one in nodes), indexing="ij")) * np.ones((2, 2, 2, 2))
    return float(np.max(np.abs(a[0, 1]) / np.sqrt(np.maximum(a[0, 0] * a[1, 1], 1e-300))))


def _is_defined(plane: Plane, nodes: list[Array]) -> bool:
    """Whether the model is defined, and all directions are noisy, on all of a grid."""
    place = np.meshgrid(*nodes, indexing="ij")
    with np.errstate(all="ignore"):
        a = plane.square(0.0, *place) * np.ones((2, 2, *place[0].shape))
        known = np.isfinite(plane.drift(0.0, *place)).all() and np.isfinite(a).all()
        return bool(known and np.all(a[0, 0] * a[1, 1] > a[0, 1] ** 2) and np.all(a[0, 0] > 0))


def _at(times: Array, values: Array, t: float) -> Array:
    """Linear between the times, and constant beyond them."""
    t = min(max(t, times[0]), times[-1])
    left = min(max(int(np.searchsorted(times, t)) - 1, 0), len(times) - 2)
    share = (t - times[left]) / (times[left + 1] - times[left])
    return np.asarray((1 - share) * values[left] + share * values[left + 1]).ravel()


def _times(
    horizon: float, shift: float, ramp: tuple[float, float], longest: tuple[int, float]
) -> tuple[Array, int]:
    """Ends of the steps, one of them at ``shift`` and the last one at shift + horizon, and the first one's number.

    ``ramp`` is its length and the first step's share of it.
    """
    first_step = ramp[0] * ramp[1]
    step, steps = first_step, [first_step]
    while sum(steps) < horizon + shift:
        while 2 * step <= min(longest[1] * (sum(steps) + 2 * first_step), horizon / longest[0]):
            step *= 2
        steps.append(step)
    times = np.concatenate([[0.0], np.cumsum(steps)])
    first = int(np.argmin(np.abs(times - shift))) if shift else 0
    begun = times[: first + 1] * (shift / times[first] if shift else 1.0)
    rest = (times[first:] - times[first]) * (horizon / (times[-1] - times[first]))
    return np.concatenate([begun[:-1], shift + rest]), first
