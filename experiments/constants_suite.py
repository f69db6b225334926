"""Certified Euclidean constants on a suite of models: value, gap, time, boxes, and enclosures per second.

Every model comes with the domain on which its constants are asked for; ``None`` is all of R^n. The quick run
checks 1e4 random points per model against the certified value, the full run 1e6.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import certbound as cb
from certbound.constants.enclosures import Metric
from certbound.constants.model_data import model_of
from certbound.constants.state_jacobian import StateJacobian
from certbound.rigor.intervals import Interval
from experiments.harness import Arrays, Claims, main

Suite = dict[str, tuple[Any, Any]]


def unicycle(x, d):  # type: ignore[no-untyped-def]
    """Closed loop towards (0.5, 0) (gamma 0.5, k 1), as in the bundled problem."""
    px, py, heading = x
    dx, dy = 0.5 - px, -py
    c, s = np.cos(heading), np.sin(heading)
    dot, cross = dx * c + dy * s, c * dy - s * dx
    speed = 0.5 * dot
    return [speed * c, speed * s, np.arctan2(cross, dot) + 0.5 * cross * dot / (dx**2 + dy**2) + d[0]]


def pendulum(x):  # type: ignore[no-untyped-def]
    """Damped, gravity 9.81, length 1."""
    return [x[1], -9.81 * np.sin(x[0]) - 0.5 * x[1]]


def van_der_pol(x):  # type: ignore[no-untyped-def]
    """mu = 1."""
    return [x[1], -x[0] + (1 - x[0] ** 2) * x[1]]


def lorenz(x):  # type: ignore[no-untyped-def]
    """sigma 10, rho 28, beta 8/3."""
    return [10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]]


def double_integrator(x):  # type: ignore[no-untyped-def]
    """Saturating feedback."""
    return [x[1], -np.tanh(2 * x[0] + 3 * x[1])]


def dubins(x):  # type: ignore[no-untyped-def]
    """Unit speed, heading steered to 0."""
    return [np.cos(x[2]), np.sin(x[2]), -0.5 * x[2]]


def quadrotor(x, u):  # type: ignore[no-untyped-def]
    """Planar, mass 1, inertia 0.1, arm 0.25; u are the two thrusts."""
    thrust = u[0] + u[1]
    return [x[3], x[4], x[5], -thrust * np.sin(x[2]), thrust * np.cos(x[2]) - 9.81, 2.5 * (u[0] - u[1])]


def cart_pole(x, u):  # type: ignore[no-untyped-def]
    """Cart 1 kg, pole 0.1 kg, 0.5 m; u is the force."""
    s, c = np.sin(x[2]), np.cos(x[2])
    share = 1 + 0.1 * s**2
    push = u[0] + 0.1 * s * (0.5 * x[3] ** 2 - 9.81 * c)
    turn = -u[0] * c - 0.05 * x[3] ** 2 * c * s + 1.1 * 9.81 * s
    return [x[1], push / share, x[3], turn / (0.5 * share)]


def brusselator(x):  # type: ignore[no-untyped-def]
    """A = 1, B = 3."""
    return [1 + x[0] ** 2 * x[1] - 4 * x[0], 3 * x[0] - x[0] ** 2 * x[1]]


def robot_arm(x, u):  # type: ignore[no-untyped-def]
    """Two links with gravity and viscous friction; u are the joint torques."""
    s2, c2 = np.sin(x[1]), np.cos(x[1])
    m11, m12, m22 = 1.55 + c2, 0.25 + 0.5 * c2, 0.35
    first = u[0] + 0.5 * s2 * (2 * x[2] * x[3] + x[3] ** 2) - x[2]
    first = first - 9.81 * np.cos(x[0]) - 4.905 * np.cos(x[0] + x[1])
    second = u[1] - 0.5 * s2 * x[2] ** 2 - 4.905 * np.cos(x[0] + x[1]) - x[3]
    det = m11 * m22 - m12**2
    return [x[2], x[3], (m22 * first - m12 * second) / det, (m11 * second - m12 * first) / det]


def network() -> Callable[..., Any]:
    """dx = -x + W2 tanh(W1 x + b), width 16, fixed random weights."""
    rng = np.random.default_rng(0)
    inner, bias, outer = rng.normal(size=(16, 3)), rng.normal(size=16), rng.normal(size=(3, 16)) / 16
    return lambda x: -x + outer @ np.tanh(inner @ x + bias)


def oscillator(x):  # type: ignore[no-untyped-def]
    """Cubic spring."""
    return [x[1], -x[0] - x[1] - 0.5 * x[0] ** 3]


def suite() -> Suite:
    """Name to (system or problem, domain)."""
    box, ct = cb.Box, cb.ContinuousSystem
    return {
        "unicycle": (
            ct(unicycle, states=["px", "py", "th"], disturbance=box([-0.1], [0.1])),
            box([3.0, 3.0, -2.9], [6.0, 6.0, -1.8]),
        ),
        "pendulum": (ct(pendulum, states=["th", "w"]), None),
        "van_der_pol": (ct(van_der_pol, states=2), box([-3, -3], [3, 3])),
        "lorenz": (ct(lorenz, states=3), box([-20, -30, 0], [20, 30, 50])),
        "chain": (cb.load("chain_rest").system, None),
        "double_integrator": (ct(double_integrator, states=2), None),
        "dubins": (ct(dubins, states=["px", "py", "th"]), None),
        "quadrotor": (ct(quadrotor, states=6, inputs=box([0, 0], [10, 10])), None),
        "cart_pole": (ct(cart_pole, states=4, inputs=box([-10], [10])), box([-2, -5, -1, -3], [2, 5, 1, 3])),
        "brusselator": (ct(brusselator, states=2), box([0, 0], [4, 5])),
        "robot_arm": (
            ct(robot_arm, states=4, inputs=box([-10, -10], [10, 10])),
            box([-3.2, -2, -2, -2], [3.2, 2, 2, 2]),
        ),
        "network": (ct(network(), states=3), box([-3, -3, -3], [3, 3, 3])),
        "oscillator": (ct(oscillator, states=2), box([-2, -2], [2, 2])),
    }


def sample(source: Any, domain: Any, count: int, rng: np.random.Generator) -> tuple[float, float]:
    """Largest sampled measure (CT) or norm (DT), and largest norm, over random points, many of them at the ends."""
    model = model_of(source, domain, None)
    jacobian = StateJacobian(model.dynamics, model.state_slots, model.ranges)
    norm = Metric(None, model.dimension)
    lo, hi = np.maximum(jacobian.box.lo, -30.0), np.minimum(jacobian.box.hi, 30.0)
    largest = size = -np.inf
    for start in range(0, count, 100_000):
        shape = (min(100_000, count - start), len(lo))
        points = rng.uniform(lo, hi, shape)
        ends = np.where(rng.uniform(size=shape) < 0.5, lo, hi)
        points = np.where(rng.uniform(size=shape) < 0.25, ends, points)
        matrices = jacobian.values(points)
        norms = norm.sample_norm(matrices)
        values = norm.sample_measure(matrices) if model.continuous else norms
        largest, size = max(largest, float(values.max())), max(size, float(norms.max()))
    return largest, size


def boxes_per_second(count: int = 100_000) -> float:
    """Unicycle Jacobians enclosed per second, boxes of width 0.04 around random states."""
    source, domain = suite()["unicycle"]
    model = model_of(source, domain, 5.0)
    jacobian = StateJacobian(model.dynamics, model.state_slots, model.ranges)
    rng = np.random.default_rng(0)
    centre = rng.uniform(jacobian.box.lo, jacobian.box.hi, (count, len(jacobian.active)))
    boxes = Interval(centre - 0.02, centre + 0.02)
    jacobian.enclose(boxes[:1000])
    start = time.perf_counter()
    enclosed = jacobian.enclose(boxes)
    seconds = time.perf_counter() - start
    if not np.isfinite(enclosed.lo).all():
        raise RuntimeError("a Jacobian of the unicycle is unbounded")
    return count / seconds


def compute(full: bool) -> tuple[Arrays, Claims]:
    """One row per model."""
    rng = np.random.default_rng(1)
    rows, claims = [], Claims()
    for name, (source, domain) in suite().items():
        start = time.process_time()
        k = cb.bound_constants(source, domain, metric="euclidean")
        seconds = time.process_time() - start
        value = float(k.gain if k.rate is None else k.rate)
        found, size = sample(source, domain, 1_000_000 if full else 10_000, rng)
        allowed = 0.01 * max(1.0, size)
        rows.append((value, k.gap, allowed, seconds, k.proof.boxes, found))
        claims[f"{name}_sound"] = found <= value
        claims[f"{name}_tight"] = k.gap <= allowed
        print(f"{name:18s} {value:10.5f}  gap {k.gap:.5f} (allowed {allowed:.3f})  {seconds:6.2f} s  {k.proof.boxes}")
    # times differ from run to run: they are printed, not stored
    print(f"slowest: {max(row[3] for row in rows):.2f} s of processor time")
    print(f"unicycle: {boxes_per_second():.3g} Jacobian boxes per second")
    return {"certified": np.array([[r[0], r[1], r[2], r[4], r[5]] for r in rows])}, claims


if __name__ == "__main__":
    main("constants_suite", compute)
