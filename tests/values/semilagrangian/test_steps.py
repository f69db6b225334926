"""One step along the flow: every majorant against numerics, at random points."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.sparse import csr_array
from scipy.special import ndtr

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.rigor.intervals import Interval
from certbound.values.discrete.dominance import KAPPA
from certbound.values.semilagrangian import bands, landings
from certbound.values.semilagrangian.backward import Bounds, back, limited
from certbound.values.semilagrangian.bands import Band, Frame, through
from certbound.values.semilagrangian.flows import EQUATIONS, augmented, flow, sheared
from certbound.values.semilagrangian.groundwork import layouts_of, nodes_of
from certbound.values.semilagrangian.local_steps import Plan
from certbound.values.semilagrangian.noisy_axis import serves, setting_of
from certbound.values.semilagrangian.obstacles.passings import first_root
from certbound.values.semilagrangian.remainders import bowed, level_of, remainders, upper_tail
from certbound.values.semilagrangian.smoothers import WIDER, across, along
from certbound.values.semilagrangian.smoothing import Lines, smoothed


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def mechanical(force, s: float, low, high, horizon: float = 1.0, start=(0.0, 0.0)) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: [x[1], force(x)], states=2, diffusion=[[0.0], [s]])
    return cb.Problem(system, initial=list(start), safe=[cb.Inside(cb.Box(low, high))], horizon=horizon)


def duffing(s: float = 0.4) -> cb.Problem:
    return mechanical(lambda x: x[0] - x[0] ** 3 - 0.5 * x[1], s, [0, -2], [2, 2], 5.0, (1.0, 0.0))


def test_flow_derivatives_and_covariance_contain_a_numerical_solution(rng) -> None:
    tape = sheared(setting_of(duffing()).tape, 0.05)
    whole = augmented(tape, 0.4, 0.05)
    low = rng.uniform([0.1, -1.0], [1.5, 1.0], size=(6, 2))
    rest = [Interval.point(np.full(6, v)) for v in [1.0, 0, 0, 1.0] + [0.0] * (EQUATIONS - 6)]
    found = flow(whole, [Interval(low[:, 0], low[:, 0] + 0.02), Interval(low[:, 1], low[:, 1] + 0.05), *rest], 0.1, 8)
    assert found.known.all()
    right = compile_numpy(whole)
    for k in range(6):
        start = np.r_[low[k] + rng.uniform(0, 1, 2) * [0.02, 0.05], 1, 0, 0, 1, np.zeros(EQUATIONS - 6)]
        end = solve_ivp(lambda t, z: np.ravel(right(t, *z)), (0, 0.1), start, rtol=1e-12, atol=1e-14).y[:, -1]
        for part, value in zip(found.end, end):
            assert part.lo[k] - 1e-11 <= value <= part.hi[k] + 1e-11
    assert max(float((part.hi - part.lo).max()) for part in found.end[:2]) < 0.08


def test_a_step_too_long_to_be_enclosed_is_not_known() -> None:
    setting = setting_of(mechanical(lambda x: x[0] ** 3 * 50, 0.4, [-3, -3], [3, 3]))
    found = flow(setting.tape, [Interval.point(np.array([0.0, 3.0])), Interval.point(np.array([0.0, 3.0]))], 1.0, 4)
    assert found.known.tolist() == [True, False]


@pytest.mark.parametrize("unit", [1.0, 1e7, 1e10])
def test_bands_are_the_same_in_units_in_which_states_are_millions(unit: float) -> None:
    """All cells of a linear model have one variance, and nothing lies between it and itself."""
    problem = mechanical(lambda x: -x[0] - 0.3 * x[1], 0.3 * unit, [-unit, -3 * unit], [unit, 3 * unit], 0.5)
    layout = next(layouts_of(setting_of(problem), Plan(count=4, fine=2.0, wide=0.05, cell=0.5, spare=1e-9)))
    assert [int(band.live.sum()) for band in layout.bands] == [11700]
    assert not layout.bands[0].share[layout.bands[0].live].any()


def test_what_is_far_away_and_does_not_move_never_arrives() -> None:
    assert first_root(np.array([1e9, 2.0]), np.array([0.0, 1.0]), 0.0)[0] == np.inf


def test_linear_models_leave_no_remainder() -> None:
    setting = setting_of(mechanical(lambda x: -x[0] - x[1], 0.4, [-1, -2], [1, 2]))
    box = Interval(np.array([-0.5]), np.array([0.5]))
    found = remainders(setting.tape, 0.4, box, box, step=0.1, omega=5.0)
    assert found.known.all()
    assert not np.any([found.most, found.mean])


def test_remainder_and_dip_bound_what_simulated_paths_do(rng) -> None:
    setting = setting_of(mechanical(lambda x: x[0] - x[0] ** 3 - 0.5 * x[1] * x[1], 0.5, [0, -2], [2, 2]))
    h, omega = 0.1, level_of(1e-6)
    point = Interval.point(np.array([1.2])), Interval.point(np.array([-0.5]))
    bound = remainders(setting.tape, 0.5, *point, step=h, omega=omega)
    assert bound.known.all()
    count, parts = 4000, 100
    d = h / parts
    p, q = np.full(count, 1.2), np.full(count, -0.5)
    mp, mq, zp, zq = 1.2, -0.5, np.zeros(count), np.zeros(count)
    path = [p]
    for _ in range(parts):
        noise = 0.5 * math.sqrt(d) * rng.standard_normal(count)
        zp, zq = zp + d * zq, zq + d * ((1 - 3 * mp**2) * zp - mq * zq) + noise
        p, q = p + d * q, q + d * (p - p**3 - 0.5 * q * q) + noise
        mp, mq = mp + d * mq, mq + d * (mp - mp**3 - 0.5 * mq * mq)
        path.append(p)
    for left, most, mean in zip((p - mp - zp, q - mq - zq), bound.most[:, 0], bound.mean[:, 0]):
        assert np.abs(left).max() <= most
        assert np.abs(left).mean() <= 3 * mean  # 1 + |e|^2 has mean 3
        assert np.abs(left).mean() > mean / 60
    time = np.linspace(0, 1, parts + 1)[:, None]
    below = ((1 - time) * path[0] + time * path[-1] - np.array(path)).max()
    assert 0.2 * bound.bow[0] < below <= bound.dip[0, 0] + 1.5 * bound.bow[0]


def test_levels_of_rare_events(rng) -> None:
    assert 4 * upper_tail(level_of(1e-9)) <= 1e-9 <= 4 * upper_tail(level_of(1e-9) * 0.999)
    walk = np.cumsum(rng.standard_normal((8000, 400)), axis=1) / 20
    time = np.arange(1, 401) / 400
    bow = time * walk.mean(axis=1, keepdims=True) - np.cumsum(walk, axis=1) / 400
    for near, far in ((0.1, 0.1), (0.3, 0.3), (0.5, 0.2), (1.0, 0.1)):
        seen, bound = (bow > near * (1 - time) + far * time).any(axis=1).mean(), bowed(np.array([near]), far)[0]
        assert seen - 3 * math.sqrt(seen / 8000) <= bound <= 1.6 * seen + 3 * math.sqrt(bound / 8000)
    assert (np.diff(bowed(np.array([0.3, 0.4, 2.0, 30.0]), 0.3)) < 0).all()


Y = np.concatenate([[-1.0, -0.7, -0.5], np.linspace(-0.4, 0.6, 41), [0.7, 0.9, 1.2]])
Q = np.linspace(-3.0, 3.0, 49)
SIGMA = (0.02, 0.2)
ROWS = slice(10, 35)


def random_lines(rng) -> Lines:
    y, q = np.meshgrid(Y, Q, indexing="ij")
    nodal = np.exp(-3 * (y - 0.3 * q) ** 2) + 0.2 * np.abs(y) + 0.02 * rng.uniform(size=y.shape)
    return Lines(nodal=nodal, bend=rng.normal(0, 2, size=(len(Y), len(Q) - 1)))


def at(value: Lines, y, q):
    """The function itself, at arrays of points."""
    i = np.clip(np.searchsorted(Y, y, side="right") - 1, 0, len(Y) - 2)
    j = np.clip(np.searchsorted(Q, q, side="right") - 1, 0, len(Q) - 2)
    t, d = (y - Y[i]) / (Y[i + 1] - Y[i]), Q[j + 1] - Q[j]
    s = (q - Q[j]) / d
    arch = d**2 * s * (1 - s) / 2
    low, high = (
        (1 - s) * value.nodal[k, j] + s * value.nodal[k, j + 1] + arch * value.bend[k, j] for k in (i, i + 1)
    )
    return (1 - t) * low + t * high


def mean(value: Lines, y: float, w: float) -> float:
    """E U(y + s_y z, w + s_q z') by the exact law in y and fine sums in q."""
    z = np.linspace(-8, 8, 1201)
    weight = np.exp(-0.5 * z * z)
    weight /= weight.sum()
    edges = np.linspace(-8, 8, 321)
    cells = np.diff(ndtr(edges))
    points = (edges[1:] + edges[:-1]) / 2
    table = at(value, (y + SIGMA[0] * points)[:, None], (w + SIGMA[1] * z)[None])
    return float(cells @ table @ weight)


def test_the_majorant_of_the_smoothed_function_lies_above_it_and_so_do_its_derivatives(rng) -> None:
    value = random_lines(rng)
    one = along(Y, SIGMA[0], 1e-15, ROWS, slice(0, len(Y)))
    two = across(Q, SIGMA[1], 1e-15, 1.05)
    flat = np.zeros((len(Y) - 1, len(Q) - 1))
    mesh = Y[ROWS]
    rows = smoothed(value, (flat, flat), (Y, Q), (mesh, Q), one, two)
    gain = []
    for _ in range(4):
        y, w = rng.uniform(mesh[2], mesh[-3]), rng.uniform(-0.8, 0.8)
        k, c = int(np.searchsorted(mesh, y)) - 1, int(np.searchsorted(Q, w)) - 1
        t, d = (y - mesh[k]) / (mesh[k + 1] - mesh[k]), Q[c + 1] - Q[c]
        s = (w - Q[c]) / d
        arch = d**2 * s * (1 - s) / 2
        row = [
            (1 - s) * rows.values[r, c] + s * rows.values[r, c + 1] + arch * rows.arch[r, c] for r in (k, k + 1)
        ]
        exact = mean(value, y, w)
        assert exact <= (1 - t) * row[0] + t * row[1] + rows.lift[k, c] + 3e-5
        gain.append((1 - t) * row[0] + t * row[1] + rows.lift[k, c] - exact)
        e = 0.02
        ww = (mean(value, y, w + e) - 2 * exact + mean(value, y, w - e)) / e**2
        yw = (mean(value, y + e / 9, w + e) - mean(value, y - e / 9, w + e)
              - mean(value, y + e / 9, w - e) + mean(value, y - e / 9, w - e)) / (4 * e * e / 9)  # fmt: skip
        yy = (mean(value, y + e / 9, w) - 2 * exact + mean(value, y - e / 9, w)) / (e / 9) ** 2
        assert ww <= rows.bent[k, c] + 0.05
        assert abs(yw) <= rows.mixed[k, c] + 0.05
        assert abs(yy) <= rows.bowed[k, c] + 1.0
    assert np.median(gain) < 0.01


def frame_and_bands(problem: cb.Problem, **plan):
    settings = {"count": 10, "fine": 1.2, "wide": 0.02, "cell": 0.5, "spare": 1e-7} | plan
    setting = setting_of(problem)
    return setting, next(layouts_of(setting, Plan(**settings)))


def near_1(force, horizon: float) -> cb.Problem:
    return mechanical(force, 0.5, [0, -1.5], [1.6, 1.5], horizon, (1.0, 0.0))


@functools.cache
def a_spring():
    return frame_and_bands(near_1(lambda x: -x[0] - 0.5 * x[1], 1.0))


@functools.cache
def a_well():
    return frame_and_bands(near_1(lambda x: x[0] - x[0] ** 3 - 0.5 * x[1], 1.0))


@functools.cache
def a_well_in_long_steps():
    """Cells of a band have variances of their own."""
    problem = near_1(lambda x: x[0] - x[0] ** 3 - 0.5 * x[1], 2.0)
    return frame_and_bands(problem, count=14, wide=0.06, fine=2.0, cell=0.3)


def step_law(setting, clock, x, rng, count: int):
    """Simulated ends of one step in (y, q), by small steps with antithetic noise."""
    drift = compile_numpy(setting.tape)
    parts = 40
    d = clock.step / parts
    p, q = np.full(count, x[0] + clock.shear * x[1]), np.full(count, x[1])
    for _ in range(parts):
        half = rng.standard_normal(count // 2)
        noise = setting.noise * math.sqrt(d) * np.concatenate([half, -half])
        f = drift(0.0, p + d / 2 * q, q)
        p, q = p + d * (q + noise / 2) + d * d / 2 * f[..., 1], q + d * f[..., 1] + noise
    return p - clock.shear * q, q


def spoiled(matrix, mass, size: float, rng):
    """A matrix whose entries are off by ``size`` times the mass, which is what a kernel's error means."""
    dense, wide = (part.toarray() if hasattr(part, "toarray") else part for part in (matrix, mass))
    near = np.zeros(dense.shape)
    rows, columns = min(len(wide), len(near)), min(wide.shape[1], near.shape[1])
    near[:rows, :columns] = wide[:rows, :columns]
    return dense + size * near * rng.choice([-1.0, 1.0], near.shape)


def spoiled_band(band: Band, y, q, size: float, rng) -> Band:
    """All kernels of a band off by ``size`` in their own units."""
    one = band.one
    names = ("rows", "spread")
    bows = one.cells + (spoiled(0 * one.cells, one.mass, size, rng)) * 2 * np.diff(y[band.rows])[:, None]
    others = {name: csr_array(spoiled(getattr(one, name), one.mass, size, rng)) for name in names}
    one = replace(one, cells=csr_array(bows), **others)
    kernels = []
    for two in band.two:
        sigma = 1 / (math.sqrt(2 * math.pi) * two.sup[0].max())
        sizes = [size * sigma**-order for order in range(3)]
        eighth = np.diff(q) ** 2 / 8
        values = tuple(spoiled(matrix, two.mass, off, rng) for matrix, off in zip(two.values, sizes))
        parabolas = tuple(
            matrix + (spoiled(0 * matrix, two.mass, off, rng)) * eighth for matrix, off in zip(two.parabolas, sizes)
        )
        kernels.append(replace(two, values=values, parabolas=parabolas))
    return replace(band, one=one, two=(kernels[0], kernels[1]))


def test_kernels_that_are_off_change_a_step_by_less_than_what_is_paid_for_rounding(rng) -> None:
    _, layout = a_well()
    frame = layout.frame
    shape = frame.y.size, frame.q.size
    value = Lines(nodal=rng.uniform(0, 1, shape), bend=rng.uniform(-20, 20, (shape[0], shape[1] - 1)))
    flat, size, shares = np.zeros((shape[0] - 1, shape[1] - 1)), 1e-7, []
    for band in layout.bands[:2]:
        error = band.one.error + max(two.error for two in band.two) + 1e-13
        error += 8e-16 * (band.lines.stop - band.lines.start + 2 * shape[1])
        price = band.prices[5] * 2 * size / error
        free = replace(band, prices=np.concatenate([band.prices[:5], 0 * band.prices[5:]]))
        paid = replace(band, prices=np.concatenate([band.prices[:5], price[None]]))
        looks = (free, spoiled_band(free, frame.y, frame.q, size, rng), paid)
        exact, wrong, allowed = (through(one, frame, value, (flat, flat)) for one in looks)
        bent = np.abs(wrong[1] - exact[1]) * np.diff(frame.q) ** 2 / 8
        change = np.abs(wrong[0] - exact[0])[:-1, :-1] + np.abs(wrong[2] - exact[2]) + np.maximum(bent[1:], bent[:-1])
        room = allowed[2] - exact[2]
        assert np.all(change[band.live] <= room[band.live])
        shares.append(float((change[band.live] / room[band.live]).max()))
    assert max(shares) > 1e-6  # it is not paid a million times


def test_between_rows_a_concave_kink_costs_at_least_what_it_brings_about_and_little_more() -> None:
    y, sigma = np.cumsum([0.0, *[0.05] * 8, *[0.3] * 8]), 0.1
    rows = slice(4, 13)
    paid = along(y, sigma, 1e-15, rows, slice(0, len(y))).cells.toarray()
    mesh, ratios = y[rows], []
    for i, k in itertools.product(range(len(y)), range(len(mesh) - 1)):
        z = (np.linspace(mesh[k], mesh[k + 1], 41) - y[i]) / sigma
        mean = -sigma * (z * ndtr(z) + np.exp(-z * z / 2) / math.sqrt(2 * math.pi))  # of -max(y + s Z - y_i, 0)
        excess = float((mean - np.linspace(mean[0], mean[-1], 41)).max())
        assert excess <= paid[k, i] + 1e-12
        ratios += [excess / paid[k, i]] if excess > 1e-6 else []
    assert max(ratios) > 0.7


def test_kinks_that_an_image_crosses_cost_at_least_what_they_lift_it_above_its_chord(rng) -> None:
    mesh, tau, ratios = np.array([0.0, 0.3, 0.5, 0.9, 1.4]), np.linspace(0, 1, 201), []
    kinks = rng.uniform(0, 2, size=(len(mesh), 1)) * [[0], [1], [1], [1], [0]]
    window, sums = np.array([0, 3, 0, 0]), np.empty((1, 4))
    for sign, width in itertools.product((1.0, -1.0), (0.0, 0.05, 0.2)):
        for low in np.add(rng.uniform(0.0, 0.4, size=(30, 1)), [[0.0, rng.uniform(0.3, 0.8)]]):
            low = low[::-1] if sign < 0 else low
            ends = np.array([low[0], low[0] + width, low[1], low[1] + width])
            one, two = low + width * rng.uniform(0, 1, 2)
            rates = np.array([ends[2] - ends[1], ends[3] - ends[0], 0, 0, 0, 0])
            line = -(kinks[:, 0] * np.maximum(one + (two - one) * tau[:, None] - mesh, 0)).sum(axis=1)
            excess = float((line - np.linspace(line[0], line[-1], 201)).max())
            landings._crossed(window, kinks[None], mesh, ends, rates, sums)
            paid = sums[0, 0]
            assert excess <= paid + 1e-12
            ratios.append(excess / paid if paid > 0 else 0.0)
    assert max(ratios) > 0.99


def test_rounding_sees_the_lines_that_are_near(rng) -> None:
    lines, mesh = (np.cumsum(rng.uniform(0.01, 1.0, size)) for size in (60, 50))
    image, more = rng.uniform(3, 24, (4, 5)), rng.uniform(0, 2, (3, 4))
    least, ratio = bands._nearby(image, more, lines, mesh, 1.0)
    for i, j in itertools.product(range(3), range(4)):
        corners = image[i : i + 2, j : j + 2]
        ends = corners.min() - more[i, j] - 1.0, corners.max() + more[i, j] + 1.0
        met = [np.diff(x)[(x[1:] > ends[0]) & (x[:-1] < ends[1])] for x in (lines, mesh)]
        assert least[i, j] <= met[0].min()
        assert ratio[i, j] * least[i, j] >= met[1].max() * (1 - 1e-12)


def test_every_cell_of_a_band_has_the_variance_of_its_own_step(rng) -> None:
    setting, layout = a_well_in_long_steps()
    frame, q, k = layout.frame, layout.frame.q, 8.0
    nodal = np.broadcast_to(np.exp(k * q), (frame.y.size, q.size))
    value = Lines(nodal=nodal, bend=np.broadcast_to(-(k**2) * np.exp(k * q[:-1]), (frame.y.size, q.size - 1)))
    flat = np.zeros((frame.y.size - 1, q.size - 1))
    points, found = [], []
    for band in layout.bands:
        nodal, bend, _ = through(replace(band, prices=0 * band.prices), frame, value, (flat, flat))
        i, j = (index[::37] for index in np.nonzero(band.live))
        d, s = np.diff(q)[j], rng.uniform(size=len(j))
        found.append((1 - s) * nodal[i, j] + s * nodal[i, j + 1] + d**2 * s * (1 - s) / 2 * bend[i, j])
        points.append((frame.y[band.first + i], q[j] + s * d))
    y, places = (np.concatenate(part) for part in zip(*points))
    zero, one = np.zeros(len(y)), np.ones(len(y))
    rest = [one, zero, zero, one, *[zero] * (EQUATIONS - 6)]
    tape = augmented(sheared(setting.tape, layout.clock.shear), setting.noise, layout.clock.shear)
    end = flow(tape, [Interval.point(part) for part in (y, places, *rest)], layout.clock.step, 8).end
    exact, apart = np.exp(k * end[1].mid + k**2 / 2 * end[12].mid), np.ptp(end[12].mid)
    ratios = np.concatenate(found) / exact
    assert min(ratios) >= 1 - 1e-9
    assert max(ratios) < 1.02 * min(ratios)
    assert np.exp(k**2 / 2 * apart) > 1.04  # one variance for all would not do


def test_every_cell_pays_for_what_lies_between_two_variances(rng) -> None:
    _, layout = a_well_in_long_steps()
    frame, band = layout.frame, max(layout.bands, key=lambda one: one.apart)
    nodal = np.broadcast_to(rng.uniform(0, 1, frame.q.size), (frame.y.size, frame.q.size))
    value, flat = Lines(nodal=nodal, bend=0 * nodal[:, 1:]), 0 * nodal[1:, 1:]

    def paid(share: float) -> np.ndarray:
        looks = (replace(band, share=0 * band.share + share, apart=apart) for apart in (band.apart, 1e-30))
        first, second = (through(one, frame, value, (flat, flat))[2][band.live] for one in looks)
        return first - second

    least = paid(0.0)
    assert least.max() > 0
    assert np.all(paid(0.75) >= 0.75 * least * (1 - 1e-6))  # T_v, a function f of v, is off by (v - a)(b - v)/2 |f''|


@pytest.mark.parametrize("made", [a_spring, a_well])
def test_a_step_back_lies_above_the_mean_of_any_function_on_the_grid(made, rng) -> None:
    setting, layout = made()
    frame = layout.frame
    y, q = np.meshgrid(frame.y, frame.q, indexing="ij")
    value = Lines(nodal=np.exp(2 * (q - 2 * y)) / 40, bend=np.full((y.shape[0], y.shape[1] - 1), -0.05))
    free = unbound(y.shape, layout.above.reach)
    found = back(frame, layout.bands, free, value)
    ratios = []
    for i, j in zip(*np.nonzero(frame.live)):
        if rng.uniform() > 8 / frame.live.sum():
            continue
        at_, bt = rng.uniform(size=2)
        x = (frame.y[i] + at_ * np.diff(frame.y)[i], frame.q[j] + bt * np.diff(frame.q)[j])
        ends = step_law(setting, layout.clock, x, rng, 20000)
        sample = reading(frame, value, *ends)
        paired = sample.reshape(2, -1).mean(axis=0)
        above = reading(frame, found, np.array([x[0]]), np.array([x[1]]))[0]
        assert above >= paired.mean() - 4 * paired.std() / math.sqrt(len(paired)) - 1e-9
        ratios.append(above / paired.mean())
    assert len(ratios) > 3
    assert np.median(ratios) < 1.3


def reading(frame: Frame, value: Lines, y, q):
    i = np.clip(np.searchsorted(frame.y, y, side="right") - 1, 0, len(frame.y) - 2)
    j = np.clip(np.searchsorted(frame.q, q, side="right") - 1, 0, len(frame.q) - 2)
    t, d = (y - frame.y[i]) / (frame.y[i + 1] - frame.y[i]), frame.q[j + 1] - frame.q[j]
    s = (q - frame.q[j]) / d
    arch = d**2 * s * (1 - s) / 2
    low, high = (
        (1 - s) * value.nodal[k, j] + s * value.nodal[k, j + 1] + arch * value.bend[k, j] for k in (i, i + 1)
    )
    return (1 - t) * low + t * high


def unbound(shape, reach) -> Bounds:
    nowhere = np.zeros(shape, dtype=bool)
    return Bounds(level=np.zeros(shape), fixed=nowhere, free=nowhere, reach=reach)


def test_the_dominating_density_is_wide_enough_for_the_kernels() -> None:
    assert WIDER >= KAPPA


def test_values_are_cut_down_to_one_only_where_all_around_is_at_least_one() -> None:
    _, layout = frame_and_bands(mechanical(lambda x: -x[0], 0.5, [-1, -1], [1, 1]))
    shape = layout.frame.y.size, layout.frame.q.size
    nodal = np.full(shape, 1.5)
    nodal[10, 10] = 0.5
    free = unbound(shape, (1, 1))
    cut = limited(layout.frame, free, nodal, np.full((shape[0], shape[1] - 1), -1.0))
    assert [cut.nodal[10, 10], cut.nodal[9, 10], cut.nodal[8, 8], cut.bend[8, 8]] == [0.5, 1.5, 1.0, 0.0]


def test_between_lines_a_function_that_is_cut_down_is_no_less_than_one() -> None:
    """A line that sags below 1 between its nodes was left so beside one that had been cut down."""
    nodal, bend = np.array([[1.3, 1.3], [1.2, 1.2], [0.5, 0.5]]), np.array([[0.0], [-2.0], [-0.5]])
    axis = np.arange(3.0)
    names = ("image", "radius", "slopes", "bends", "drift", "live")
    frame = Frame(y=axis, q=axis[:2], **dict.fromkeys(names))
    cut = limited(frame, unbound(nodal.shape, (1, 1)), nodal, bend)
    assert cut.nodal.tolist() == [[1.0, 1.0], [1.2, 1.2], [0.5, 0.5]]
    before, middle = (
        reading(frame, lines, np.array([0.5, 1.5]), np.full(2, 0.5)) for lines in (Lines(nodal=nodal, bend=bend), cut)
    )
    assert np.all(middle >= np.minimum(before, 1.0))
    assert cut.bend.tolist() == [[0.0], [0.0], [-0.5]]


def test_which_problems_are_served_and_what_the_others_are_told() -> None:
    assert serves(duffing())
    both = cb.ContinuousSystem(lambda x: [x[1], -x[0]], states=2, diffusion=[[0.1, 0], [0, 0.3]])
    assert not serves(replace(duffing(), system=both))
    box = cb.Inside(cb.Box([-1, -1], [1, 1]))
    clocked = cb.ContinuousSystem(lambda x, t: [x[1] + t, -x[0]], states=2, diffusion=[[0.0], [0.3]])
    with pytest.raises(InfeasibleError, match="`x1` changes with it"):
        setting_of(cb.Problem(clocked, initial=[0, 0], safe=[box], horizon=1))
    driven = cb.ContinuousSystem(lambda x, t: [x[1], -x[0] + t], states=2, diffusion=[[0.0], [0.3]])
    past = cb.Outside(cb.Box([0.5, 0.5], [0.7, 0.7]))
    assert setting_of(cb.Problem(driven, initial=[0, 0], safe=[box], horizon=1)).timed
    with pytest.raises(InfeasibleError, match="obstacles beside a model that changes with time"):
        setting_of(cb.Problem(driven, initial=[0, 0], safe=[box, past], horizon=1))
    lonely = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=[[0.0], [0.3]])
    problem = cb.Problem(lonely, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1)
    with pytest.raises(InfeasibleError, match="hardly reaches"):
        next(layouts_of(setting_of(problem), Plan(count=10, fine=0.7, wide=0.01, cell=0.35, spare=1e-7)))


def test_a_grid_for_steps_that_are_too_long_for_the_safe_set_is_not_made():
    """It would have had nodes at distances of 1e-12, and 35 TiB."""
    system = cb.ContinuousSystem(
        lambda x: [x[1] + 0.1 * x[1] ** 2, -1.2 * x[0] - 0.8 * x[1] + 0.4 * x[0] * x[1]], states=2,
        diffusion=[[0], [0.56]],
    )  # fmt: skip
    box = cb.Box([-0.46, -1.27], [0.46, 1.27])
    problem = cb.Problem(system, initial=[-0.1, 0.4], safe=[cb.Inside(box)], horizon=4.0)
    with pytest.raises(InfeasibleError, match="more than 200000 lines"):
        nodes_of(setting_of(problem), Plan(count=18, fine=0.7, wide=0.005, cell=0.3, spare=1e-9))


def pendulum_of(unit: float):
    return lambda x: [x[1] * unit, -np.sin(x[0] / unit)]


def test_remainders_do_not_depend_on_the_units_of_the_states() -> None:
    """x in units 2^12 times as small: the flow's bounds are the same, in those units."""
    unit = 2.0**12
    kept = []
    for factor in (1.0, unit):
        system = cb.ContinuousSystem(pendulum_of(factor), states=2, diffusion=[[0.0], [0.5]])
        asked = mechanical(lambda x: -x[0], 0.5, [-1, -2], [1, 2])
        tape = setting_of(asked.replace(system=system)).tape
        ends = [np.array([low]) for low in (0.25, 0.5)]
        p, q = (Interval(low, low + 0.125) for low in ends)
        found = remainders(tape, 0.5, p * factor, q, step=0.25, omega=8.0)
        assert found.known.all()
        kept.append(np.concatenate([found.most[:, 0], found.mean[:, 0]]) / np.tile([factor, 1.0], 2))
    assert np.allclose(kept[0], kept[1], rtol=0.02)
