"""Three states in continuous time: enclosures against sampling, bounds against closed forms, wrong proposals."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.problem.model.tracing import trace
from certbound.values.continuous.coefficients import Reader
from certbound.values.continuous.exits import bound_exits
from certbound.values.continuous.hypotheses import Model, interpolants, sampled
from certbound.values.continuous.plane import Plan, integrated
from certbound.values.continuous.residual import bound_ranges, coarse_size
from certbound.values.continuous.space import space_bounds
from certbound.values.continuous.space.space_box import closed_room
from certbound.values.continuous.space.space_solver import SpaceSolver
from certbound.values.continuous.surface import Surface
from certbound.values.enclosing import squared_diffusion

NAMES = ("x", "y", "z")
GAIN = np.array([[0.5, 0.0, 0.0], [0.2, 0.4, 0.0], [0.0, -0.1, 0.6]])


def lorenz(t, x):
    return [2 * (x[1] - x[0]), x[0] * (0.5 - x[2]) - x[1] + 0.1 * t, x[0] * x[1] - x[2]]


def read(f, gain):
    drift = trace(f, {"t": ["t"], "x": list(NAMES)})
    square = squared_diffusion(gain, NAMES)
    return Model(drift=Reader(drift, 4), square=Reader(square, 4), branches=((),))


def random_surface(rng, cells=2, slabs=2):
    axes = tuple(np.sort(rng.uniform(-1, 1, cells + 1)) for _ in range(3))
    shape = tuple(k for axis in axes for k in (len(axis), 2))
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 0.3, slabs))])
    draw = lambda count: rng.normal(size=(count, *shape))  # noqa: E731
    return Surface(axes=axes, times=times, values=draw(slabs + 1), start_rates=draw(slabs), end_rates=draw(slabs))


def hermite(share, width):
    """Weights of (v, v') at the left and the right end in the value, the first and the second derivative."""
    rows = ([1, 0, -3, 2], [0, 1, -2, 1], [0, 0, 3, -2], [0, 0, -1, 1])
    scale = np.array([1, width, 1, width])
    found = [[np.polynomial.Polynomial(row).deriv(k)(share) if k else np.polynomial.Polynomial(row)(share)
              for row in rows] for k in range(3)]  # fmt: skip
    return [np.array(row) * scale / width**k for k, row in enumerate(found)]


def derivatives(surface, slab, cell, shares):
    """V_t, grad V and V'' at a point, straight from the Hermite data."""
    pick = [slab] + [slice(None)] * 6
    data = np.stack([surface.values[tuple(pick)], surface.start_rates[slab], surface.values[slab + 1],
                     surface.end_rates[slab]])  # fmt: skip
    for axis in range(3):
        data = np.take(data, [cell[axis], cell[axis] + 1], axis=1 + axis)
        data = np.moveaxis(data, (1 + axis, 2 + axis), (-2, -1))
        data = np.moveaxis(data.reshape(*data.shape[:-2], 4), -1, 1 + axis)
    widths = [surface.steps[slab], *(axis[k + 1] - axis[k] for axis, k in zip(surface.axes, cell))]
    base = [hermite(share, width) for share, width in zip(shares, widths)]

    def at(*orders):
        return np.einsum("abcd,a,b,c,d", data, *(base[k][order] for k, order in enumerate(orders)))

    unit = np.eye(3, dtype=int)
    bend = [[at(0, *(unit[i] + unit[j])) for j in range(3)] for i in range(3)]
    return at(1, 0, 0, 0), np.array([at(0, *unit[i]) for i in range(3)]), np.array(bend), at(0, 0, 0, 0)


@pytest.mark.parametrize("gain", [GAIN, 0.35 * np.eye(3)])
def test_the_residual_of_any_surface_is_enclosed(gain) -> None:
    rng = np.random.default_rng(1)
    surface, model = random_surface(rng), read(lorenz, gain)
    counts = model.counts()
    patches = surface.patches(0, 2)
    place = np.arange(len(patches.size))
    drifts, squares = interpolants(surface, model, 0, 2, counts)
    found = bound_ranges(patches, drifts, squares, place, counts)
    halves = bound_ranges(patches, drifts, squares, place, counts, near=0.0)
    rough, (samples, *_) = coarse_size(patches, drifts, squares, place), sampled(surface, model)
    cells = list(itertools.product(range(2), repeat=4))
    for k, (slab, *cell) in enumerate(cells):
        for shares in (*itertools.product((0.0, 1.0), repeat=4), *rng.uniform(size=(4, 4))):
            rate, slope, bend, value = derivatives(surface, slab, cell, shares)
            x = [axis[i] + s * (axis[i + 1] - axis[i]) for axis, i, s in zip(surface.axes, cell, shares[1:])]
            t = surface.times[slab] + shares[0] * surface.steps[slab]
            a = gain @ gain.T
            energy = 0.5 * slope @ a @ slope
            residual = rate + np.dot(lorenz(t, x), slope) + 0.5 * np.sum(a * bend) + energy
            for one in (found, halves):
                assert one.residual_low[k] <= residual <= one.residual_high[k]
                assert one.low[k] <= value <= one.high[k]
                assert one.energy[k] <= energy
            assert abs(residual) <= rough[k]
    assert np.all(halves.residual_high <= found.residual_high)
    assert np.median(halves.residual_high - samples.ravel()) < np.median(found.residual_high - samples.ravel())


def test_slices_are_the_surface() -> None:
    surface = random_surface(np.random.default_rng(2), cells=4)
    parts = list(surface.rows(limit=16))
    assert [first for first, _ in parts] == [0, 1, 2, 3]
    for side in (0, 1):
        whole = surface.range_at(1)[side]
        assert np.array_equal(np.concatenate([part.range_at(1)[side] for _, part in parts]), whole)


def stays(sigma, horizon, side=1.0):
    """The probability that sigma W has not left [-side, side] by the horizon."""
    k = np.arange(60)
    odd = 2 * k + 1
    return float(4 / np.pi * np.sum((-1.0) ** k / odd * np.exp(-((odd * np.pi * sigma / side) ** 2) * horizon / 8)))


def brownian(sigmas=(0.6, 0.6, 0.6), horizon=0.5):
    system = cb.ContinuousSystem(lambda x: [0 * x[0], 0 * x[1], 0 * x[2]], states=3, diffusion=np.diag(sigmas))
    return cb.Problem(system, initial=[0, 0, 0], safe=[cb.Inside(cb.Box([-1] * 3, [1] * 3))], horizon=horizon)


@functools.cache
def proposal():
    problem = brownian()
    model = read(lambda t, x: [0 * x[0], 0 * x[1], 0 * x[2]], np.diag([0.6] * 3))
    space = space_bounds._space(problem, model)
    return model, space, integrated(SpaceSolver(space, Plan(cells=4, growth=0.6, lead=0.05), None))


@pytest.mark.usefixtures("frugal")
@pytest.mark.parametrize(("size", "factor"), [(0.0, 1.0), (0.03, 1.0), (0.3, 1.0), (0.0, 1.3), (0.0, 3.0)])
def test_wrong_proposals_only_cost_tightness(size: float, factor: float) -> None:
    model, space, surface = proposal()
    rng = np.random.default_rng(3)
    values = factor * surface.values + size * rng.normal(size=surface.values.shape)
    wrong = dataclasses.replace(
        surface, values=values, start_rates=factor * surface.start_rates, end_rates=factor * surface.end_rates
    )
    truth = 1 - stays(0.6, 0.5) ** 3
    found = math.exp(space_bounds.prove_in_space(wrong, model, space.starts).log)
    assert found >= truth
    assert found < 5 * truth or size + factor > 1


@pytest.mark.usefixtures("frugal")
def test_a_product_of_lines_is_bounded_within_its_factor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(space_bounds, "_FEWEST", 6)
    sigmas = (0.7, 0.5, 0.3)
    truth = 1 - math.prod(stays(sigma, 0.5) for sigma in sigmas)
    found = bound_exits(brownian(sigmas), seconds=0.3)
    assert truth <= 10**found.upper <= 2.8 * truth
    assert found.lower is None
    assert "three states" in found.words


def test_a_proposal_that_runs_off_proves_nothing() -> None:
    system = cb.ContinuousSystem(
        lambda x: [2 * (x[1] - x[0]), x[0] * (0.5 - x[2]) - x[1], x[0] * x[1] - x[2]], states=3,
        diffusion=0.2 * np.eye(3),
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1.5] * 3, [1.5] * 3))]
    problem = cb.Problem(system, initial=cb.Box([-0.2] * 3, [0.2] * 3), safe=safe, horizon=2)
    assert bound_exits(problem, seconds=1.0).upper == 0  # a matrix without an inverse ended it


def test_a_state_without_limits_gets_ends_beyond_simulated_paths() -> None:
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1], 0 * x[2]], states=3, diffusion=0.4 * np.eye(3))
    safe = [cb.Inside(cb.Box([-1, -1, -np.inf], [1, 1, 2]))]
    problem = cb.Problem(system, initial=[0, 0, 0], safe=safe, horizon=1)
    drift, square = (lambda t, *x: np.array([[-x[0], -x[1], 0 * x[2]]])), (lambda t, *x: 0.16 * np.eye(3)[..., None])
    low, high = closed_room(problem, drift, square)
    assert low[:2] == (-1, -1)
    assert high == (1, 1, 2)
    assert -3 < low[2] < -1


def test_no_bound_without_noise_along_a_state_is_said_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(space_bounds, "_FEWEST", 6)
    noise = [[0.0], [0.0], [1.0]]
    system = cb.ContinuousSystem(lambda x: [np.cos(x[2]), np.sin(x[2]), 0 * x[0]], states=3, diffusion=noise)
    safe = [cb.Inside(cb.Box([-1, -1, -np.inf], [3, 1, np.inf]))]
    problem = cb.Problem(system, initial=[0, 0, 0], safe=safe, horizon=1.5)
    with pytest.raises(InfeasibleError, match="no noise of its own"):
        bound_exits(problem, seconds=0.1)


@pytest.mark.parametrize(
    ("safe", "match"),
    [
        (cb.Ball([0, 0, 0], 1.0), "in three states serve boxes only"),
        (cb.Box([-1] * 3, [1] * 3), "up to three states here, the problem has 4"),
    ],
)
def test_what_is_not_served_is_refused_in_words(safe, match: str) -> None:
    n = 4 if "4" in match else 3
    system = cb.ContinuousSystem(lambda x: [-x[k] for k in range(n)], states=n, diffusion=0.3 * np.eye(n))
    box = safe if n == 3 else cb.Box([-1] * 4, [1] * 4)
    with pytest.raises(InfeasibleError, match=match):
        bound_exits(cb.Problem(system, initial=np.zeros(n), safe=[cb.Inside(box)], horizon=1))


def test_what_a_rough_guess_puts_out_of_reach_may_be_left_out() -> None:
    """Noise as strong as the box is wide: far above delta."""
    system = cb.ContinuousSystem(lambda x: -x, states=3, diffusion=np.eye(3))
    safe = [cb.Inside(cb.Box([-1] * 3, [1] * 3))]
    problem = cb.Problem(system, initial=[0, 0, 0], safe=safe, horizon=0.5)
    with pytest.raises(InfeasibleError, match=r"rough guess .* more than is asked"):
        bound_exits(problem, seconds=1.0, delta=1e-3, spare=True)
