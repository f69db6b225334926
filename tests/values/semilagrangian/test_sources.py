"""Supersolutions by their sources, for drifts with kinks."""

from __future__ import annotations

from math import comb

import numpy as np
import pytest
from scipy.interpolate import BSpline

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.values.semilagrangian.noisy_axis import setting_of
from certbound.values.semilagrangian.sources import bound_sourced_exits, kinked
from certbound.values.semilagrangian.sources.drift_cells import drift_cells
from certbound.values.semilagrangian.sources.ground import Ground, ground_of
from certbound.values.semilagrangian.sources.marching import march, payment
from certbound.values.semilagrangian.sources.residuals import residual_bounds
from certbound.values.semilagrangian.sources.spline_axes import Axis


def clip(u, a):
    return np.minimum(np.maximum(u, -a), a)


def setting(drift, *, s=0.6, side=0.5, speed=np.inf, start=(0.2, 0.6), horizon=1.0, **more):
    system = cb.ContinuousSystem(drift, states=2, diffusion=[[0.0], [s]])
    box = cb.Inside(cb.Box([-side, -speed], [side, speed]))
    return setting_of(cb.Problem(system, initial=list(start), safe=[box, *more.get("also", [])], horizon=horizon))


def servo(x):
    return [x[1], clip(-20 * x[0] - 6 * x[1], 3)]


def bent(x):
    return [x[1] + 0.3 * x[0] * abs(x[1]), clip(-20 * x[0] - 6 * x[1], 3) + np.sin(x[0] * x[1])]


def model(drift, p, q):
    return [np.asarray(part, dtype=float) + 0 * p for part in drift([p, q])]


def test_pieces_are_the_spline() -> None:
    rng = np.random.default_rng(0)
    for degree in (2, 3):
        axis = Axis(knots=np.sort(rng.uniform(0, 1, 9)), degree=degree)
        values = rng.normal(size=axis.size)
        spline = BSpline(axis.clamped, values, degree)
        cell, wide = np.repeat(np.arange(8), 2), np.repeat(np.diff(axis.knots), 2)
        low = axis.knots[cell] + np.tile([0.0, 0.3], 8) * wide
        high = low + 0.6 * wide
        own = np.stack([values[k : k + degree + 1] for k in cell])
        found = np.einsum("nij,nj->ni", axis.pieces(cell, low, high), own)
        for t in (0.0, 0.3, 1.0):
            mean = sum(comb(degree, i) * t**i * (1 - t) ** (degree - i) * found[:, i] for i in range(degree + 1))
            assert np.abs(mean - spline(low + t * (high - low))).max() < 1e-13


@pytest.mark.parametrize("drift", [servo, bent, lambda x: [x[1], -np.sign(x[1] + 0.2 * x[0]) - x[0] ** 3]])
def test_drifts_lie_within_what_cells_say(drift) -> None:
    p, q = np.linspace(-0.5, 0.5, 21), np.linspace(-2, 2, 26)
    cells, rng = drift_cells(setting(drift).tape, p, q), np.random.default_rng(1)
    i, j = (part.ravel() for part in np.meshgrid(np.arange(20), np.arange(25), indexing="ij"))
    for _ in range(20):
        t, r = rng.uniform(0, 1, (2, len(i)))
        exact = model(drift, p[i] + t * np.diff(p)[i], q[j] + r * np.diff(q)[j])
        for k in (0, 1):
            ends = cells.corners[k, i, j]
            value = (1 - t) * ((1 - r) * ends[:, 0, 0] + r * ends[:, 0, 1]) + t * (
                (1 - r) * ends[:, 1, 0] + r * ends[:, 1, 1]
            )
            assert (np.abs(value - exact[k]) <= cells.remainder[k, i, j] + 1e-12).all()
    crossed = cells.remainder[1] > 1e-9
    if drift is servo:  # kinks cost something on the cells that they cross, and nothing elsewhere
        assert 0.05 < crossed.mean() < 0.4
        assert cells.remainder[0].max() < 1e-12


def ground() -> Ground:
    return ground_of(setting(bent), 3.0)


def sampled(ground: Ground, values, orders, share):
    parts = []
    for axis, order, places in zip((ground.p, ground.q), orders, share):
        basis = BSpline(axis.clamped, np.eye(axis.size), axis.degree)
        parts.append(basis(places, nu=order))
    return parts[0] @ values @ parts[1].T


def test_residuals_are_bounded_closely() -> None:
    found, rng, many = ground(), np.random.default_rng(2), 7
    shape = found.shape
    values = np.sin(5 * found.p.places)[:, None] * np.cos(4 * found.q.places) + 0.02 * rng.normal(size=shape)
    rates, source = rng.normal(size=shape), rng.uniform(0, 2, shape)
    cell, low, high = found.parts
    inner = np.linspace(1e-7, 1 - 1e-7, many)
    p = (low[:, None] + inner * (high - low)[:, None]).ravel()
    q = (found.q.knots[:-1, None] + inner * np.diff(found.q.knots)[:, None]).ravel()
    f, g = model(bent, *np.meshgrid(p, q, indexing="ij"))
    u, slope, across, bend = (sampled(found, values, k, (p, q)) for k in ((0, 0), (1, 0), (0, 1), (0, 2)))
    exact = sampled(found, rates, (0, 0), (p, q)) + f * slope + g * across + found.noise / 2 * bend

    def largest(part):
        return part.reshape(len(cell), many, found.q.cells, many).max(axis=(1, 3))

    most, bare, least, tallest = found.measure()(values, rates, source, 0.01)
    for bound, true in ((most, exact), (bare, exact + sampled(found, source, (0, 0), (p, q)))):
        gap = bound - largest(true)
        assert (gap >= -1e-9).all()
        assert np.median(gap) < 0.1 * np.median(np.abs(true))
    assert (least <= -largest(-u) + 1e-12).all()
    assert (tallest >= largest(u) - 1e-12).all()


def test_each_term_of_the_residual_counts() -> None:
    axes = Axis(knots=np.linspace(0, 1, 3), degree=2), Axis(knots=np.linspace(0, 2, 4), degree=3)
    zero = np.zeros((axes[0].size, axes[1].size))
    linear, square = np.broadcast_to(axes[0].places[:, None], zero.shape), zero.copy()
    t = axes[1].clamped  # coefficients of q^2: mean products of knots
    square += [(t[k + 1] * t[k + 2] + t[k + 1] * t[k + 3] + t[k + 2] * t[k + 3]) / 3 for k in range(axes[1].size)]
    corners = np.zeros((2, 2, 3, 2, 2))
    corners[0], corners[1] = 2.0, -3.0
    widths, remainder = (np.full(2, 0.5), np.full(3, 2 / 3)), np.zeros((2, 2, 3))

    def bounds(values, remainder=remainder):
        rows, columns = axes[0].whole, axes[1].whole
        return residual_bounds(
            np.ascontiguousarray(values), zero, zero, rows, columns, np.arange(2), widths, corners, remainder, 0.5, 0.1
        )[0]

    assert np.allclose(bounds(linear), 2.0)
    assert np.allclose(bounds(square), -6 * axes[1].knots[:-1] + 0.5, atol=1e-9)  # -3 2q + .5 2/2 at its largest
    assert np.allclose(bounds(linear, remainder + 0.25), 2.25)
    assert np.allclose(bounds(square, remainder + 0.25), -6 * axes[1].knots[:-1] + 0.5 + 0.5 * axes[1].knots[1:])


def test_paths_leave_where_the_drift_leads_outward() -> None:
    found = ground_of(setting(servo), 3.0)
    middle = (found.q.knots[1:] + found.q.knots[:-1]) / 2
    assert 0.0 in found.q.knots
    assert (found.exits[0] == (middle < 0)).all()
    assert (found.exits[1] == (middle > 0)).all()
    still = ground_of(setting(lambda x: [0 * x[1], -abs(x[1])]), 3.0)
    assert still.exits[0].all()  # who does not move may touch the face
    led = ground_of(setting(lambda x: [x[1] - 9 * np.sign(x[0] - 0.5), -x[0]], side=0.5, speed=2.0), 3.0)
    assert led.exits[1].all()  # its drift points outward up to the face, if not on it
    outside = found.outside()
    for row, leaving in zip((0, -1), found.exits):
        for k in np.flatnonzero(leaving):
            assert outside[row, k : k + 4].all()
    assert (found.levels()[outside] >= 1).all()


def test_payments_cover_what_is_lacking() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        low = rng.uniform(-0.1, 1.3, 200) * rng.choice([1, 1e-3], 200)
        lacking = rng.normal(size=200)
        rate, amount = payment(lacking, low, 1e-2)
        asked = low < 1
        assert (lacking[asked] <= rate * low[asked] + amount + 1e-12).all()
    assert payment(np.array([5.0]), np.array([1.0]), 1e-2) == (0.0, 0.0)


def test_what_is_stepped_is_a_supersolution(monkeypatch) -> None:
    found, asked = ground_of(setting(servo, horizon=0.5), 3.0), []
    bounds = found.measure()

    def watched(values, rates, source, step):
        asked.append((values, rates, step))
        return bounds(values, rates, source, step)

    monkeypatch.setattr(Ground, "measure", lambda self: watched)
    proved = march(found, 0.5, 1e-2)
    asked = asked[1:]
    assert len(asked) % 2 == 0
    slabs = list(zip(asked[::2], asked[1::2]))
    total, rate, amount = 0.0, 0.0, 0.0
    for (late, speed, step), (early, same, _) in reversed(slabs):  # from the present to the horizon
        assert np.array_equal(speed, same)
        assert np.abs(late - early - step * speed).max() < 1e-12
        worst = [np.where(bounds(early, speed, speed, step)[2] >= 1, 0, bounds(part, speed, speed, step)[0])
                 for part in (late, early)]  # fmt: skip
        low = np.minimum(bounds(late, speed, speed, step)[2], bounds(early, speed, speed, step)[2])
        paid = payment(np.where(low >= 1, 0.0, np.maximum(*worst)), low, 1e-2)
        total, rate, amount = total + step, rate + paid[0] * step, amount + paid[1] * step
        outside = found.outside()
        assert (early[outside] >= 1).all()
        if total >= 0.5 * (1 - 1e-13):
            break
    assert total >= 0.5
    assert proved.rate >= rate * (1 - 1e-9)
    assert proved.amount >= amount * (1 - 1e-9) + max(0.0, -bounds(late, speed, speed, step)[2].min()) * (1 - 1e-9)


def test_both_ends_of_a_step_are_paid(monkeypatch) -> None:
    found, calls = ground_of(setting(servo, horizon=0.2), 3.0), []
    bounds, guess = found.measure(), 1e-2

    def proved(extra):
        def watched(*inputs):
            calls.append(inputs[3])
            most, *rest = bounds(*inputs)
            return most + (0.5 if len(calls) == extra else 0.0), *rest

        calls.clear()
        monkeypatch.setattr(Ground, "measure", lambda self: watched)
        paid = march(found, 0.2, guess)
        return paid.rate + paid.amount

    plain = proved(0)
    count = len(calls)
    for last in (count - 1, count):  # the ends of the last step
        assert proved(last) > plain + 0.1 * calls[-1]


def test_what_is_less_than_0_at_the_horizon_is_paid(monkeypatch) -> None:
    found = ground_of(setting(servo, horizon=0.2), 3.0)
    bounds = found.measure()

    def sunk(*inputs):
        _, bare, low, high = bounds(*inputs)
        return np.zeros(low.shape), np.minimum(bare, 0.0), low - 0.3, high

    monkeypatch.setattr(Ground, "measure", lambda self: sunk)
    paid = march(found, 0.2, 1e3)
    assert paid.rate == 0
    assert 0.3 <= paid.amount < 0.4


@pytest.mark.slow
def test_servo_that_saturates() -> None:
    found = bound_sourced_exits(setting(servo, start=(0.3, 0.9)), seconds=5.0)
    assert 0.198 < 10**found.upper < 0.4  # .199 simulated


def test_what_is_refused() -> None:
    assert kinked(setting(servo).tape)
    assert not kinked(setting(lambda x: [x[1], -x[0]]).tape)
    with pytest.raises(InfeasibleError, match="along the coordinates"):
        bound_sourced_exits(setting(servo, also=[cb.Inside(cb.Ball([0, 0], 3.0))]), seconds=0.5)
