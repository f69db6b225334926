"""Value functions in continuous time: enclosures against sampling, bounds against a fine solution of the equation."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_banded

import certbound as cb
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model.tracing import trace
from certbound.rigor.intervals import Interval
from certbound.values.continuous import exits, hypotheses, payment
from certbound.values.continuous.coefficients import Cells, Reader
from certbound.values.continuous.exits import bound_exits
from certbound.values.continuous.hypotheses import Model, extreme_over, prove_lower, prove_upper
from certbound.values.continuous.line import ladder
from certbound.values.continuous.line.initial_law import start_of
from certbound.values.continuous.payment import BIN, Levels, Patched, Terms, pay_lower, pay_upper, repay
from certbound.values.continuous.plane import plane_below, two_sides
from certbound.values.continuous.plane.plane_below import bound_plane_below, plan_below
from certbound.values.continuous.plane.plane_grids import Plan, Source
from certbound.values.continuous.plane.plane_proposal import propose_plane
from certbound.values.continuous.plane.solver import weakened
from certbound.values.continuous.proposal import Splines, through
from certbound.values.continuous.residual import bound_ranges
from certbound.values.continuous.surface import Surface
from certbound.values.enclosing import enclose, squared_diffusion
from certbound.values.polynomials import (
    CUBIC_HERMITE,
    HERMITE,
    basis_at,
    interpolation,
    node_product,
    nodes_of,
    to_bernstein,
)  # fmt: skip
from certbound.values.room import safe_room, starts_of


def exit_probability(f, g, low, high, horizon, start, *, cells=400, steps=200):
    """A fine monotone solution of u_t + f u' + g^2 u'' / 2 = 0, extrapolated from two grids."""

    def solve(n, count):
        x = np.linspace(low, high, n + 1)
        h = x[1] - x[0]
        u = np.where((x == low) | (x == high), 1.0, 0.0)
        tau = horizon * np.concatenate([[0.0], np.geomspace(1e-5, 1.0, count)])
        gamma = 1 - 0.5**0.5
        for begin, end in itertools.pairwise(tau):
            t, step = horizon - 0.5 * (begin + end), end - begin
            a, drift = g(t, x) ** 2, f(t, x)
            drift = np.where(np.gradient(u, x) > 0, drift.max(axis=0), drift.min(axis=0)) if drift.ndim == 2 else drift
            q = 2 * drift * h / a
            ratio = np.where(np.abs(q) < 1e-9, 1.0, q / np.expm1(np.where(np.abs(q) < 1e-9, 1.0, q)))
            left = a / (2 * h * h) * ratio
            right = left + drift / h
            bands = np.zeros((3, n + 1))
            bands[1] = 1.0
            bands[1, 1:-1] += gamma * step * (left + right)[1:-1]
            bands[0, 2:], bands[2, :-2] = -gamma * step * right[1:-1], -gamma * step * left[1:-1]
            stage = solve_banded((1, 1), bands, u)
            u = np.maximum(solve_banded((1, 1), bands, u + (1 / gamma - 1) * (stage - u)), 0.0)
        return float(np.exp(np.interp(start, x, np.log(np.maximum(u, 1e-300)))))

    coarse, fine = solve(cells // 2, steps // 2), solve(cells, steps)
    return fine + (fine - coarse) / 3


def line_problem(f, g, low, high, horizon, start, **options):
    system = cb.ContinuousSystem(f, states=1, diffusion=g, **options)
    return cb.Problem(
        system, initial=cb.Box([start[0]], [start[1]]), safe=[cb.Inside(cb.Box([low], [high]))], horizon=horizon
    )


def read(f, g=None, names=("x1",)):
    drift = trace(f, {"t": ["t"], "x": list(names)})
    square = squared_diffusion(np.eye(len(names)) if g is None else g, names)
    return Model(drift=Reader(drift, len(names) + 1), square=Reader(square, len(names) + 1), branches=((),))


def random_surface(rng, axes, slabs, size=1.0):
    shape = tuple(k for axis in axes for k in (len(axis), 3))
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 0.3, slabs))])
    draw = lambda count: size * rng.normal(size=(count, *shape))  # noqa: E731
    return Surface(axes=axes, times=times, values=draw(slabs + 1), start_rates=draw(slabs), end_rates=draw(slabs))


# enclosures


def test_coefficients_of_two_states_and_their_size_are_those_of_the_hermite_matrices() -> None:
    rng = np.random.default_rng(0)
    axes, times = (np.cumsum(rng.random(4)), np.cumsum(rng.random(3))), np.cumsum(rng.random(3))
    values, *rates = (rng.normal(size=(count, 4, 3, 3, 3)) for count in (3, 2, 2))
    surface = Surface(axes=axes, times=times, values=values, start_rates=rates[0], end_rates=rates[1])
    found = surface.patches(0, 2)
    for patch, (k, i, j) in enumerate(np.ndindex(2, 3, 2)):
        parts = np.array([values[k], rates[0][k], values[k + 1], rates[1][k]])[:, i : i + 2, :, j : j + 2]
        data = parts.reshape(4, 6, 6)
        reference = data[0, 0, 0]
        data[::2, ::3, ::3] -= reference
        data[1::2] *= surface.steps[k]
        x, y = (np.tile(np.diff(axis)[c] ** np.arange(3), 2) for axis, c in zip(axes, (i, j)))
        data *= x[:, None] * y
        matrices = CUBIC_HERMITE, HERMITE, HERMITE
        assert np.allclose(found.coefficients[patch], np.einsum("at,bx,cy,txy->abc", *matrices, data), atol=1e-14)
        size = np.einsum("at,bx,cy,txy->abc", *map(np.abs, matrices), np.abs(data)).max()
        assert found.size[patch] == pytest.approx(size, rel=1e-14)
        assert found.reference[patch] == reference


@pytest.mark.parametrize("count", [1, 5, 9, 11])
def test_bernstein_coefficients_reproduce_a_polynomial_and_its_interpolant(count: int) -> None:
    rng = np.random.default_rng(count)
    values = rng.normal(size=count)
    where = tuple(np.linspace(0, 1, 33))
    direct = np.polynomial.Polynomial.fit(nodes_of(count), values, count - 1)(np.array(where))
    assert np.allclose(basis_at(where, count - 1) @ (to_bernstein(count) @ values), direct, atol=1e-8)
    assert np.allclose(interpolation(count, where) @ values, direct, atol=1e-8)
    fine = np.linspace(0, 1, 20001)[:, None]
    assert np.abs(np.prod(fine - np.array(nodes_of(count)), axis=1)).max() <= node_product(count)


@pytest.mark.parametrize(
    "f",
    [
        lambda t, x: [x[0] - x[0] ** 3],
        lambda t, x: [np.sin(3 * x[0]) * np.exp(-(x[0] ** 2)) + t * x[0]],
        lambda t, x: [np.abs(x[0] - 0.3) + np.cos(5 * t)],
        lambda t, x: [np.where(x[0] > 0.1, 1.0, -2.0) * x[0]],
        lambda t, x: [x[0] / (1 + x[0] ** 2) + np.sqrt(x[0] + 2.0)],
    ],
)
def test_the_interpolant_and_its_remainder_enclose_the_function(f) -> None:
    tape = trace(f, {"t": ["t"], "x": ["x1"]})
    edges = np.linspace(-1, 1, 9)
    low, high = (np.zeros(8), edges[:-1]), (np.full(8, 0.25), edges[1:])
    shares = tuple(np.linspace(0, 1, 21))
    found = Reader(tape, 2).interpolate(Cells(low=low, high=high), (), (shares, shares))
    s = np.array(shares)
    for cell in range(8):
        t = 0.25 * s[:, None] + 0 * s
        x = edges[cell] + (edges[cell + 1] - edges[cell]) * s[None, :] + 0 * t
        truth = np.array([[float(f(a, [b])[0]) for a, b in zip(*row)] for row in zip(t, x)])
        assert np.all(np.abs(truth - found.samples[0, cell]) <= found.remainder[0, cell] + 1e-12)
    assert found.remainder.max() < 3


def test_an_enclosure_names_what_is_undefined() -> None:
    tape = trace(lambda t, x: [1 / x[0]], {"t": ["t"], "x": ["x1"]})
    with pytest.raises(EnclosureError, match="undefined somewhere in the safe set"):
        enclose(tape, [Interval(0.0, 1.0), Interval(-1.0, 1.0)])


def hermite_values(surface, slab, cell, time_share, shares):
    """V, V_t, gradient and second derivatives of one patch from the Hermite data, by plain formulas."""
    n = len(surface.axes)
    step = surface.times[slab + 1] - surface.times[slab]
    widths = [axis[k + 1] - axis[k] for axis, k in zip(surface.axes, cell)]
    parts = [surface.values[slab], surface.start_rates[slab], surface.values[slab + 1], surface.end_rates[slab]]
    matrix = np.array([[1, 0, 0, 0], [1, 1, 1, 1], [0, 1, 0, 0], [0, 1, 2, 3]])
    time_basis = np.linalg.inv(matrix)  # columns: v0, v1, h r0, h r1
    rows = [[math.perm(k, d) * s ** (k - d) if k >= d else 0.0 for k in range(6)] for s in (0.0, 1.0) for d in range(3)]
    space = np.linalg.inv(np.array(rows))
    powers = lambda s, top, d: np.array([math.perm(k, d) * s ** (k - d) if k >= d else 0.0 for k in range(top)])  # noqa: E731

    def value(orders):
        total = 0.0
        weights = powers(time_share, 4, orders[0]) @ time_basis / step ** orders[0]
        for weight, part, scale in zip(weights[[0, 2, 1, 3]], parts, (1, step, 1, step)):
            table = part
            for axis in range(n):
                basis = powers(shares[axis], 6, orders[axis + 1]) @ space / widths[axis] ** orders[axis + 1]
                local = np.take(table, [cell[axis], cell[axis] + 1], axis=0)  # (2, 3, ...)
                h = np.array([1, widths[axis], widths[axis] ** 2])
                table = np.tensordot(basis.reshape(2, 3) * h, local, axes=([0, 1], [0, 1]))
            total += weight * scale * float(table)
        return total

    unit = np.eye(n + 1, dtype=int)
    gradient = np.array([value(unit[i + 1]) for i in range(n)])
    second = np.array([[value(unit[i + 1] + unit[j + 1]) for j in range(n)] for i in range(n)])
    return value(0 * unit[0]), value(unit[0]), gradient, second


@pytest.mark.parametrize(("n", "parts"), [(1, False), (2, False), (2, True)])
def test_ranges_of_the_residual_contain_samples_of_a_random_surface(n: int, parts: bool) -> None:
    rng = np.random.default_rng(5 + n)
    axes = (np.array([-1.0, -0.4, 0.1]), np.array([0.0, 0.5, 0.8]))[:n]
    surface = random_surface(rng, axes, 2)
    f = [lambda t, x: [np.sin(x[0]) + t], lambda t, x: [-x[1] + t, np.sin(x[0]) * x[1]]][n - 1]
    g = [
        lambda t, x: np.array([[0.5 + 0.1 * x[0]]]),
        lambda t, x: np.array([[0.5, 0.2 * x[1]], [0.1, 0.4 + 0.1 * t]]),
    ][n - 1]
    names = ["x1", "x2"][:n]
    model = read(f, trace(g, {"t": ["t"], "x": names}), names)
    from certbound.values.continuous.hypotheses import interpolants

    counts = model.counts()
    drifts, squares = interpolants(surface, model, 0, 2, counts)
    patches = surface.patches(0, 2)
    place = np.arange(len(patches.size))
    ranges = bound_ranges(patches, drifts, squares, place, counts)
    if parts:  # bounds on the quarters of every patch, which are closer
        found = [
            bound_ranges(patches, drifts, squares, place, counts, near=0.0, upper=upper) for upper in (True, False)
        ]
        assert np.all(found[0].residual_high < ranges.residual_high)
        assert np.all(found[1].residual_low > ranges.residual_low)
        ranges = dataclasses.replace(found[0], residual_low=found[1].residual_low)
    for index in range(len(patches.size)):
        slab, *cell = np.unravel_index(index, (2, *surface.cells))
        for _ in range(10):
            shares = rng.uniform(size=n + 1)
            v, rate, gradient, second = hermite_values(surface, slab, cell, shares[0], shares[1:])
            t = surface.times[slab] + shares[0] * surface.steps[slab]
            x = [axis[k] + s * (axis[k + 1] - axis[k]) for axis, k, s in zip(axes, cell, shares[1:])]
            gain = np.array(g(t, x), dtype=float)
            energy = 0.5 * float(np.sum((gain.T @ gradient) ** 2))
            residual = rate + np.array(f(t, x)) @ gradient + 0.5 * np.trace(gain @ gain.T @ second) + energy
            slack = 1e-9 * (1 + abs(residual))
            assert ranges.residual_low[index] - slack <= residual <= ranges.residual_high[index] + slack
            assert ranges.low[index] - 1e-9 <= v <= ranges.high[index] + 1e-9
            assert ranges.energy[index] <= energy + slack


# the last step


@pytest.mark.parametrize("upper", [True, False])
def test_the_repaying_function_satisfies_its_differential_inequality(upper: bool) -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        m = rng.uniform(0, 0.8, 12) * rng.integers(0, 2, 12)
        q = repay(m, upper=upper)
        if q is None:
            continue
        sign = -1 if upper else 1
        for k, rate in enumerate(m):
            inside = np.linspace(q[k], q[k + 1], 50)
            assert np.all((q[k + 1] - q[k]) / BIN >= (1 + sign * inside) * (rate - inside) - 1e-12)
        assert q[0] == 0
        assert q.min() >= 0
        assert not upper or q.max() < 1


def test_the_integral_of_the_repaying_function_is_enclosed() -> None:
    levels = Levels(m=np.array([0.3, 0.5]), q=np.array([0.0, 0.2, 0.1]), edges=np.array([-2 * BIN, -BIN, 0.0]))
    fine = np.linspace(-1.3 * BIN, 0, 200001)
    direct = np.trapezoid(np.interp(fine, levels.edges, levels.q), fine)
    found = levels.above(-1.3 * BIN)
    assert found.lo <= direct + 1e-9
    assert direct - 1e-9 <= found.hi < direct + 1e-8
    assert levels.above(0.0).hi == 0


def test_what_is_paid_covers_every_patch_and_costs_what_the_formula_says() -> None:
    steps = np.array([0.5, 0.5])
    patched = Patched(
        excess=np.array([0.02, 3.0]), low=np.array([-4.0, -9.0]), high=np.array([-3.0, -8.5]),
        energy=np.zeros(2), slab=np.array([0, 1]), steps=steps, spare=0.0,
    )  # fmt: skip
    paid = pay_upper(patched, -5.0, -math.inf)
    # lam = .02 on the first slab, eps e^8.5 = 3 on the second: e^-5 (e^.01 + .5 eps e^5)
    assert paid.log == pytest.approx(-5 + math.log(math.exp(0.01) + 0.5 * 3 * math.exp(-3.5)), abs=5e-4)
    below = pay_lower(patched, -5.0, -8.0)
    expected = math.exp(-0.01) - 0.5 * 3 * math.exp(-3.5) - math.exp(-3)
    assert below is not None
    assert below.log == pytest.approx(-5 + math.log(expected / (1 - math.exp(-8))), abs=5e-4)
    assert pay_upper(patched, -5.0, -8.0).log < paid.log


@pytest.mark.parametrize("bound", [payment.bound_above, payment.bound_below])
def test_terms_in_rows_are_bounded_as_each_alone(bound) -> None:
    m = np.array([[0.3, 0.5], [0.0, 0.2], [0.3, 0.1], [0.1, 0.4]])
    q = np.stack([repay(row, upper=True) for row in m])
    lam, eps = np.full((4, 3), 0.02), np.array([[0.0, 0.1, 0.2], [0.3, 0.1, 0.0], [0.1, np.inf, 0.0], [0.1, 0.2, 0.3]])
    lam[3] = 40.0  # no more is bounded by what this costs, nor by what an infinite eps does
    common = {"steps": np.array([0.5, 0.3, 0.7]), "start": -3.0, "end": -8.0}
    edges = BIN * np.array([-2.0, -1.0, 0.0])
    terms = [Terms(levels=Levels(m=m[k], q=q[k], edges=edges), lam=lam[k], eps=eps[k], **common) for k in range(4)]
    whole = Terms(levels=Levels(m=m, q=q, edges=edges), lam=lam, eps=eps, **common)
    alone = [float(bound(one, np.array(-3.0))) for one in terms]
    assert bound(whole, np.array(-3.0)).tolist() == alone
    assert np.isfinite(alone[:2]).all()
    assert alone[2:] == ([0.0, 0.0] if bound is payment.bound_above else [-np.inf, -np.inf])


def test_the_order_of_the_patches_does_not_matter() -> None:
    rng = np.random.default_rng(1)
    low = rng.uniform(-6, -0.5, 40)
    numbers = {"excess": rng.uniform(0, 0.3, 40), "low": low, "high": low + rng.uniform(0, 1, 40)}
    numbers |= {"energy": rng.uniform(0, 2, 40), "slab": np.repeat(np.arange(4), 10)}
    order, rest = rng.permutation(40), {"steps": np.full(5, 0.2), "spare": 1e-9}  # the last slab has no patch
    sorted_, mixed = (Patched(**{k: v[o] for k, v in numbers.items()}, **rest) for o in (np.arange(40), order))
    assert pay_upper(sorted_, -5.0, -9.0).log == pay_upper(mixed, -5.0, -9.0).log < -4
    below = pay_lower(sorted_, -1.0, -9.0), pay_lower(mixed, -1.0, -9.0)
    assert below[0] is not None
    assert below[0].log == below[1].log


# whole problems

WELL = (lambda x: [x[0] - x[0] ** 3], 0.35, 0.0, 2.5, 10.0, (0.9, 1.1))


@pytest.mark.usefixtures("lighter")
@pytest.mark.parametrize(
    ("f", "g", "low", "high", "horizon", "start"),
    [
        WELL,
        (lambda x: [-(x[0] ** 3)], 0.6, -1.5, 1.5, 10.0, (0.0, 0.0)),
        (lambda x: [-x[0]], 0.4, -1.0, 1.0, 1.0, (0.0, 0.0)),
    ],
)
def test_both_bounds_are_near_the_truth(f, g, low, high, horizon, start) -> None:
    found = bound_exits(line_problem(f, g, low, high, horizon, start), seconds=0.01)
    drift, gain = (lambda t, x: f([x])[0]), (lambda t, x: g + 0 * x)
    truth = math.log10(max(exit_probability(drift, gain, low, high, horizon, x) for x in start))
    assert truth - 1e-4 <= found.upper < truth + math.log10(1.06)
    assert found.lower is not None
    assert truth - math.log10(1.25) < found.lower <= truth + 1e-4


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize("seed", [0, 5, 7, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3, 4, 6))])
def test_random_problems_lie_between_the_bounds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, c, d = rng.normal(size=4) * [0.5, 1.0, 0.5, 0.5]
    e, s = rng.uniform(-0.2, 0.2), rng.uniform(0.3, 0.8)
    f = lambda t, x: [a + b * x[0] + c * np.sin(2 * x[0]) + d * np.cos(3 * t)]  # noqa: E731
    g = lambda t, x: np.array([[s + e * np.tanh(x[0])]])  # noqa: E731
    low, high, horizon, start = -1.0, rng.uniform(0.6, 1.5), rng.uniform(0.3, 2.0), rng.uniform(-0.5, 0.3)
    problem = line_problem(f, g, low, high, horizon, (start, start))
    found = bound_exits(problem, seconds=0.01)
    truth = math.log10(exit_probability(
        lambda t, x: a + b * x + c * np.sin(2 * x) + d * np.cos(3 * t), lambda t, x: s + e * np.tanh(x),
        low, high, horizon, start,
    ))  # fmt: skip
    assert found.upper >= truth - 2e-3
    assert found.lower is None or found.lower <= truth + 2e-3
    assert found.upper < max(0.6 * truth, truth + 0.2)


@pytest.mark.usefixtures("coarse")
def test_the_worst_disturbance_counts_in_both_bounds() -> None:
    problem = line_problem(
        lambda x, d: [-x[0] + d[0]], 0.4, -1.0, 1.0, 1.0, (0.0, 0.0), disturbance=cb.Box([-0.2], [0.2])
    )
    found = bound_exits(problem, seconds=0.01)
    drift = lambda t, x: np.stack([-x - 0.2, -x + 0.2])  # noqa: E731
    truth = math.log10(exit_probability(drift, lambda t, x: 0.4 + 0 * x, -1.0, 1.0, 1.0, 0.0))
    assert truth - 2e-3 <= found.upper < truth + 0.05
    assert found.lower is not None
    assert found.lower <= truth + 2e-3


def spoilt(surface: Surface, rng: np.random.Generator, size: float) -> Surface:
    """The surface with noise on all its data."""
    noisy = {}
    for name in ("values", "start_rates", "end_rates"):
        data = getattr(surface, name)
        noisy[name] = data * (1 + size * rng.normal(size=data.shape))
    return dataclasses.replace(surface, **noisy)


def well_truth(horizon: float, start: float) -> float:
    return exit_probability(lambda t, x: x - x**3, lambda t, x: 0.35 + 0 * x, 0, 2.5, horizon, start)


@functools.cache
def proposals():
    problem = line_problem(*WELL)
    model, start = exits._model(problem), start_of(problem)
    found = []
    for inner, propose in ((True, ladder.surfaces_above), (False, ladder.surfaces_below)):
        room = ladder.room_of(problem, model, (-9.0, 9.0), start, inner=inner)
        (link,) = propose(room, start, ladder.sketches(room), (0.02, 2.0, 1e-3, 0.02))
        found.append(link.surface)
    upper, lower = found
    return model, starts_of(problem), upper, lower


@pytest.mark.usefixtures("coarse")
def test_noise_on_a_proposal_never_passes_the_truth() -> None:
    model, starts, upper, lower = proposals()
    truth = math.log(max(well_truth(10.0, x) for x in WELL[5]))
    rng = np.random.default_rng(0)
    seen = [prove_upper(upper, model, starts).log]
    for size, shift in ((0.0, -2.0), (0.0, 0.3), (1e-6, -0.3), (1e-3, -0.3), (1e-3, 0.3), (0.3, -2.0)):
        bound = prove_upper(spoilt(upper, rng, size).raised(shift), model, starts).log
        assert bound >= truth - 1e-3
        payment = prove_lower(spoilt(lower, rng, size).raised(shift), model, starts)
        assert payment is None or payment.log <= truth + 1e-3
        seen.append(bound)
    assert min(seen) < truth + 1.5  # some of these say something


def test_a_lower_bound_is_proved_of_a_function_that_is_nowhere_positive(monkeypatch: pytest.MonkeyPatch) -> None:
    model, starts, _, lower = proposals()
    seen: list[float] = []
    examine = hypotheses.examine

    def watched(surface: Surface, *rest: Any, **sides: bool) -> Any:
        seen.append(max(float(hypotheses.value_range(surface.patches(*chunk))[1].max()) for chunk in surface.chunks()))
        return examine(surface, *rest, **sides)

    monkeypatch.setattr(hypotheses, "examine", watched)
    for shift in (1e-4, 0.3):
        prove_lower(lower.raised(shift), model, starts)
    assert len(seen) == 2
    assert max(seen) <= 0.0


@pytest.mark.slow
def test_scaled_and_bent_proposals_never_pass_the_truth() -> None:
    model, starts, upper, lower = proposals()
    truth = math.log(max(well_truth(10.0, x) for x in WELL[5]))
    for factor in (0.5, 0.99, 1.01, 1.5):
        def scaled(surface: Surface, factor: float = factor) -> Surface:
            return dataclasses.replace(
                surface, values=factor * surface.values, start_rates=factor * surface.start_rates,
                end_rates=factor * surface.end_rates,
            )  # fmt: skip

        assert prove_upper(scaled(upper), model, starts).log >= truth - 1e-3
        payment = prove_lower(scaled(lower), model, starts)
        assert payment is None or payment.log <= truth + 1e-3
        slower = dataclasses.replace(upper, times=upper.times * factor)
        late = well_truth(10.0 * factor, 0.9)
        assert prove_upper(slower, model, starts).log >= math.log(late) - 1e-3


def test_the_start_counts_with_its_worst_point_above_and_its_best_below() -> None:
    _, _, upper, lower = proposals()
    fine = upper.values[0][(upper.axes[0] >= 0.9) & (upper.axes[0] <= 1.1), 0]
    assert extreme_over(upper, [(0.9, 1.1)], upper=True) >= fine.max()
    inside = lower.values[0][(lower.axes[0] >= 0.9) & (lower.axes[0] <= 1.1), 0]
    assert extreme_over(lower, [(0.9, 1.1)], upper=False) >= inside.max()


def two_free_states() -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=0.5 * np.eye(2))
    return cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1)


TWO_FREE_STATES = math.log10(1 - (1 - exit_probability(lambda t, x: -x, lambda t, x: 0.5 + 0 * x, -1, 1, 1, 0.0)) ** 2)


@pytest.mark.usefixtures("frugal")
def test_two_states_without_coupling_are_as_safe_as_each_alone() -> None:
    found = bound_exits(two_free_states(), seconds=0.01, delta=0.5)
    assert TWO_FREE_STATES <= found.upper < TWO_FREE_STATES + 0.16
    assert found.lower is None  # the bound above is small enough


@pytest.mark.usefixtures("coarse")
def test_a_lower_bound_in_two_states_holds_whatever_is_proposed(monkeypatch: pytest.MonkeyPatch) -> None:
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=0.8 * np.eye(2))
    problem = two_free_states().replace(system=system)
    alone = exit_probability(lambda t, x: -x, lambda t, x: 0.8 + 0 * x, -1, 1, 1, 0.0)
    truth = math.log(1 - (1 - alone) ** 2)
    model, room, starts = exits._model(problem), safe_room(problem), starts_of(problem)
    plane = two_sides.plane_of(problem, model, room.outer_low, room.outer_high, starts)
    plan = dataclasses.replace(plan_below(plane, truth, 1200), cells=10, growth=0.5)
    proposals: list[Any] = []
    monkeypatch.setattr(plane_below, "propose_plane", lambda *given: proposals.append(given) or propose_plane(*given))
    found = bound_plane_below(plane, model, plan, starts, None)
    assert found is not None
    bound = found[1].log
    assert len(proposals) == 3  # none that is not looked at
    with monkeypatch.context() as hopeless:
        hopeless.setattr(plane_below.SketchBelow, "estimate", lambda self: plan.floor - 100)
        hopeless.setattr(plane_below, "prove_lower", lambda *given: pytest.fail("nothing can come of this proof"))
        assert bound_plane_below(plane, model, plan, starts, None) is None
    assert len(proposals) == 4
    assert truth - 1.3 < bound <= truth
    coarse = dataclasses.replace(plan, cells=10, growth=0.6)
    surface, rng = propose_plane(plane, coarse), np.random.default_rng(0)
    assert surface is not None
    for size, shift in ((0.0, -0.3), (0.0, 1.0), (1e-3, 0.0)):
        payment = prove_lower(spoilt(surface, rng, size).raised(shift), model, starts)
        assert payment is None or payment.log <= truth
    early = dataclasses.replace(surface, times=0.3 * surface.times)  # what is true of T = 1, said of T = 0.3
    soon = exit_probability(lambda t, x: -x, lambda t, x: 0.8 + 0 * x, -1, 1, 0.3, 0.0)
    payment = prove_lower(early, model, starts)
    assert extreme_over(early, starts, upper=False) > math.log(1 - (1 - soon) ** 2) + 0.1
    assert payment is None or payment.log <= math.log(1 - (1 - soon) ** 2)


@pytest.mark.usefixtures("coarse")
def test_a_source_of_any_size_never_takes_a_bound_below_the_truth() -> None:
    problem = two_free_states()
    model, room, starts = exits._model(problem), safe_room(problem), starts_of(problem)
    plane = two_sides.plane_of(problem, model, room.inner_low, room.inner_high, starts)
    plan = Plan(cells=10, growth=0.8, lead=0.05, floor=-7.0)
    first = propose_plane(plane, plan)
    assert first is not None
    needed = Source.above(first, 1.1 * two_sides.Sketch.of(first, model, starts).needed(-0.02))
    bounds = {}
    for size in (-1.0, 0.0, 1.0, 3.0):
        source = dataclasses.replace(needed, values=size * needed.values)
        surface = propose_plane(plane, plan, source)
        if surface is not None:
            bounds[size] = prove_upper(surface, model, starts).log / math.log(10)
    assert min(bounds.values()) >= TWO_FREE_STATES
    assert bounds[1.0] < bounds[0.0] - 0.01  # what it is for
    assert bounds[1.0] < TWO_FREE_STATES + 0.4


def test_noise_that_grows_with_the_state_costs_no_rounding_to_speak_of() -> None:
    """R = f.c + c'ac/2 for V = c.x: its bound lies that close although R is given by 13 x 13 coefficients."""
    system = cb.ContinuousSystem(
        lambda x: [x[0] * (1 - x[1]), x[1] * (x[0] - 1)],
        states=2, diffusion=lambda x: [[0.2 * x[0], 0], [0, 0.2 * x[1]]],
    )  # fmt: skip
    problem = cb.Problem(system, initial=[1, 1], safe=[cb.Inside(cb.Box([0.3, 0.3], [2.5, 2.5]))], horizon=1)
    model, axis = exits._model(problem), np.array([0.3, 0.34, 0.4])
    values = np.zeros((2, 3, 3, 3, 3))
    values[:, :, 0, :, 0] = -20 * (axis[:, None] + axis)  # V = -20 (x + y)
    values[:, :, 1, :, 0] = values[:, :, 0, :, 1] = -20.0
    flat = np.zeros((1, 3, 3, 3, 3))
    surface = Surface(axes=(axis, axis), times=np.array([0.0, 1.0]), values=values, start_rates=flat, end_rates=flat)
    drifts, squares = hypotheses.interpolants(surface, model, 0, 1, model.counts())
    found = bound_ranges(surface.patches(0, 1), drifts, squares, np.arange(4), model.counts())
    x, y = np.meshgrid(np.linspace(0.34, 0.4, 50), np.linspace(0.34, 0.4, 50))
    exact = -20 * (x * (1 - y) + y * (x - 1)) + 200 * 0.04 * (x**2 + y**2)
    assert 0 <= found.residual_high[3] - exact.max() < 1e-3
    assert 0 <= exact.min() - found.residual_low[3] < 1e-3


def test_a_source_is_at_least_what_is_needed_on_every_patch() -> None:
    problem = two_free_states()
    model, room, starts = exits._model(problem), safe_room(problem), starts_of(problem)
    plane = two_sides.plane_of(problem, model, room.inner_low, room.inner_high, starts)
    surface = propose_plane(plane, Plan(cells=8, growth=0.8, lead=0.1, floor=-5.0))
    assert surface is not None
    needed = np.random.default_rng(0).uniform(0.0, 1.0, (surface.slabs, *surface.cells))
    source = Source.above(surface, needed)
    points = [np.linspace(axis[0], axis[-1], 57)[1:-1] for axis in surface.axes]
    at_ends = source.at(points)
    cells = [np.searchsorted(axis, place) - 1 for axis, place in zip(surface.axes, points)]
    for slab in range(surface.slabs):
        wanted = needed[slab][np.ix_(*cells)]
        assert np.all(at_ends[slab] >= wanted - 1e-12)
        assert np.all(at_ends[slab + 1] >= wanted - 1e-12)


# what is refused


def test_a_random_start_is_refused_in_two_states() -> None:
    with pytest.raises(InfeasibleError, match="random start"):
        bound_exits(two_free_states().replace(initial=cb.GaussianStart([0.0, 0.0], 0.01 * np.eye(2))))


def test_noise_in_some_coordinates_only_is_refused() -> None:
    system = cb.ContinuousSystem(lambda x: [x[1], -x[0]], states=2, diffusion=[[0.0], [0.3]])
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1)
    with pytest.raises(InfeasibleError, match="noise of full rank"):
        bound_exits(problem)


def test_bad_arguments_are_named() -> None:
    problem = line_problem(lambda x: [-x[0]], 0.4, -1.0, 1.0, 1.0, (0.0, 0.0))
    with pytest.raises(InfeasibleError, match="on one side of the target"):
        bound_exits(problem, target=cb.Box([0], [1]))
    with pytest.raises(ValueError, match="`seconds` must be positive"):
        bound_exits(problem, seconds=0)
    with pytest.raises(TypeError, match="`problem` must be a Problem"):
        bound_exits(3)  # type: ignore[arg-type]
    discrete = cb.DiscreteSystem(lambda x: 0.5 * x, states=1, noise=cb.Gaussian(std=0.1))
    with pytest.raises(InfeasibleError, match="continuous time"):
        bound_exits(cb.Problem(discrete, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3))
    with pytest.raises(ValueError, match="rise strictly"):
        Surface(axes=(np.array([0.0, 0.0]),), times=np.array([0.0, 1.0]), values=np.zeros((2, 2, 3)),
                start_rates=np.zeros((1, 2, 3)), end_rates=np.zeros((1, 2, 3)))  # fmt: skip


@pytest.mark.usefixtures("coarse")
def test_an_obstacle_bounds_the_safe_set_on_its_side() -> None:
    plain = line_problem(lambda x: [-x[0]], 0.4, -1.0, 1.0, 1.0, (0.0, 0.0))
    walls = plain.replace(safe=[cb.Inside(cb.Box([-1], [3])), cb.Outside(cb.Box([1], [2]))])
    first, second = bound_exits(plain, seconds=0.01), bound_exits(walls, seconds=0.01)
    assert first.upper == pytest.approx(second.upper, abs=1e-3)


@pytest.mark.usefixtures("coarse")
def test_a_disturbance_that_counts_between_the_ends_of_its_range_only_is_seen() -> None:
    """A comparison used as a number has slope 0 wherever it has one, so the ends of D do not stand for the rest."""
    system = cb.ContinuousSystem(
        lambda x, d: [-x[0] + 5.0 * (d[0] > 0.2) * (d[0] < 0.5)],
        states=1, disturbance=cb.Box([0], [1]), diffusion=[[0.2]],
    )
    safe = [cb.Inside(cb.Box([-1], [1]))]
    assert bound_exits(cb.Problem(system, initial=[0.0], safe=safe, horizon=0.5), seconds=0.01).upper == 0.0


def test_nodes_are_bent_to_a_start_and_stay_where_a_start_lies_on_an_end():
    nodes = np.linspace(1.0, 2.0, 41)
    assert 1.513 in through(nodes, (1.513, 1.513))
    end = float(np.nextafter(2.0, 0.0))
    kept = through(nodes, (end, end))
    assert np.array_equal(kept, nodes)
    assert np.linalg.cond(Splines(kept).dense[0]) < 1e6


def reversed_van_der_pol(sigma: float) -> two_sides.Plane:
    system = cb.ContinuousSystem(
        lambda x: [-x[1], x[0] + (x[0] ** 2 - 1) * x[1]], states=2, diffusion=sigma * np.eye(2)
    )
    safe = [cb.Inside(cb.Box([-1.2, -1.2], [1.2, 1.2]))]
    problem = cb.Problem(system, initial=cb.Box([-0.2, -0.2], [0.2, 0.2]), safe=safe, horizon=5)
    room = safe_room(problem)
    return two_sides.plane_of(problem, exits._model(problem), room.inner_low, room.inner_high, starts_of(problem))


def test_a_proposal_whose_fronts_are_steeper_than_its_cells_comes_to_an_end() -> None:
    plane = reversed_van_der_pol(0.1)
    surface = propose_plane(plane, Plan(cells=24, growth=0.3, lead=0.2))
    assert surface is not None
    assert surface.values[:, :, 0, :, 0].max() < 0.5
    assert -41 < extreme_over(surface, plane.starts, upper=True) < -30  # -38.4, from far finer grids


def test_drift_is_weakened_beside_faces_only_where_it_points_inward_and_cells_cannot_hold_its_layer() -> None:
    calm, steep = reversed_van_der_pol(2.0), reversed_van_der_pol(0.1)
    line = np.linspace(-1.2, 1.2, 41)
    x, y = np.meshgrid(line, line, indexing="ij")
    changes = []
    for plane in (calm, steep):
        drift, a = plane.drift(0.0, x, y)[0], plane.square(0.0, x, y)
        weak = weakened(plane, Plan(cells=40, growth=0.3, lead=0.2), drift, a, (x, y), 0 * x - 1.0)
        changes.append(weak - drift)
    assert not changes[0].any()
    change, inward = changes[1], -np.sign(y)
    assert np.all(change[1] * inward <= 0)
    assert not change[1][:, 5:-5].any()
    assert np.abs(change[1][:, [0, -1]]).max() > 0.5


def test_a_proposal_of_two_states_that_does_not_span_the_horizon_proves_nothing(monkeypatch) -> None:
    problem = two_free_states()
    model, room, starts = exits._model(problem), safe_room(problem), starts_of(problem)
    plane = two_sides.plane_of(problem, model, room.inner_low, room.inner_high, starts)
    plan, real = Plan(cells=8, growth=0.8, lead=0.1, floor=-5.0), two_sides.propose_plane

    def short(plane, plan, source=None):
        surface = real(plane, plan, source)
        return surface if source is None else dataclasses.replace(surface, times=0.5 * surface.times)

    assert two_sides._promising(plane, model, plan) is not None
    monkeypatch.setattr(two_sides, "propose_plane", short)
    assert two_sides._promising(plane, model, plan) is None
