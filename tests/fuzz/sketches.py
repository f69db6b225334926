"""Random models: a grammar of formulas, and the systems that people type first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.fuzz.formulas import Formula, apply, number, symbol

__all__ = ["FAMILIES", "Sketch", "sketch"]

Array = NDArray[np.float64]
Random = np.random.Generator


@dataclass(frozen=True, kw_only=True)
class Sketch:
    """A model with a usual start, a usual size of noise per state and a usual horizon; constraints come later."""

    continuous: bool
    dynamics: list[Formula]
    center: list[float]
    width: float
    noise: list[float]
    horizon: float
    diffusion: list[list[Formula]] | None = None
    domain: tuple[list[float], list[float]] | None = None
    disturbance: int = 0
    matrices: tuple[Array, Array, Array | None] | None = None


FAMILIES: dict[str, Callable[[Random], Sketch]] = {}
LATER: dict[str, Callable[[Random], Sketch]] = {}
"""Families that are drawn from numbers of their own, so that a seed that draws none is the problem that it was."""


def family(function: Callable[[Random], Sketch]) -> Callable[[Random], Sketch]:
    """Enter a model into the table under its function's name."""
    FAMILIES[function.__name__] = function
    return function


def sketch_of(name: str, rng: Random) -> Sketch:
    """A model of a family."""
    return (FAMILIES | LATER)[name](rng)


def sketch(rng: Random) -> tuple[str, Sketch]:
    """A model of the grammar about every other time, else one of the usual systems."""
    name = "grammar" if rng.random() < 0.4 else str(rng.choice(sorted(FAMILIES)))
    return name, FAMILIES[name](rng)


def x(k: int) -> Formula:
    """State k."""
    return symbol(f"x{k}")


T, D = symbol("t"), symbol("d0")


def sin(a: Any) -> Formula:
    return apply("sin", a)


def cos(a: Any) -> Formula:
    return apply("cos", a)


def log_uniform(rng: Random, low: float, high: float) -> float:
    """10 to a uniform power, rounded as a person would write it."""
    return float(f"{10 ** rng.uniform(np.log10(low), np.log10(high)):.3g}")


def between(rng: Random, low: float, high: float) -> float:
    """A number of three digits."""
    return float(f"{rng.uniform(low, high):.3g}")


# ---- the grammar ---------------------------------------------------------------------------------------------------

SMOOTH: list[Callable[[Formula, Formula], Formula]] = [
    lambda a, b: sin(a),
    lambda a, b: cos(a),
    lambda a, b: apply("tanh", a),
    lambda a, b: apply("atan", a),
    lambda a, b: a * b,
    lambda a, b: a**2,
    lambda a, b: a**3,
    lambda a, b: a**4 * 0.3,
    lambda a, b: apply("exp", -(a**2)),
    lambda a, b: 1 / (1 + a**2),
    lambda a, b: a / (1 + b**2),
    lambda a, b: apply("sqrt", 1 + a**2),
    lambda a, b: apply("log", 1 + a**2),
    lambda a, b: (1 + a**2) ** 0.75,
    lambda a, b: apply("asin", 0.9 * sin(a)),
    lambda a, b: apply("acos", 0.9 * apply("tanh", a)),
    lambda a, b: apply("hypot", a, 1.0),
    lambda a, b: apply("atan2", a, 1.5 + cos(b)),
    lambda a, b: apply("sinh", apply("tanh", a)),
    lambda a, b: apply("cosh", 0.5 * apply("tanh", a)),
    lambda a, b: apply("tan", 0.5 * apply("tanh", a)),
    lambda a, b: apply("exp", 0.3 * apply("tanh", b)) * a,
    lambda a, b: a * apply("tanh", b),
    lambda a, b: 1 / (1 + apply("exp", -4 * a)),
    lambda a, b: apply("exp", 0.5 * a),
    lambda a, b: sin(a * b),
]
KINKED: list[Callable[[Formula, Formula], Formula]] = [
    lambda a, b: apply("abs", a),
    lambda a, b: apply("min", apply("max", a, -0.5), 0.5),
    lambda a, b: apply("max", a, 0.0),
    lambda a, b: apply("min", a, b),
    lambda a, b: apply("abs", a) * a,
    lambda a, b: apply("hypot", a, b),
    lambda a, b: apply("abs", a) ** 1.5,
]
JUMPING: list[Callable[[Formula, Formula], Formula]] = [
    lambda a, b: apply("where", a - 0.3, 0.4, -0.2),
    lambda a, b: apply("where", a, a * 0.5, b * 0.2),
    lambda a, b: apply("sign", a),
    lambda a, b: apply("floor", 2 * a),
    lambda a, b: apply("atan2", a, b) * 0.2,
]
POSITIVE: list[Callable[[Formula, Formula], Formula]] = [
    lambda a, b: apply("log", a),
    lambda a, b: apply("sqrt", a),
    lambda a, b: 1 / a,
    lambda a, b: a**1.5,
    lambda a, b: b / a,
    lambda a, b: apply("exp", apply("log", a) * apply("sin", b)),
]
"""Defined for positive a only: with a domain."""
TIMED: list[Callable[[float], Formula]] = [
    lambda h: sin(6.28 / h * T),
    lambda h: apply("exp", -T / h),
    lambda h: apply("min", T / h, 0.5),
    lambda h: T / h,
]


@family
def grammar(rng: Random) -> Sketch:
    """Linear part, mostly stable, and some nonlinear terms in every row."""
    continuous = bool(rng.random() < 0.5)
    n = int(rng.choice([1, 2, 3, 4, 5, 6], p=[0.3, 0.36, 0.15, 0.09, 0.05, 0.05]))
    positive = rng.random() < 0.1
    kinks, jumps, timed = rng.random() < 0.2, rng.random() < 0.12, rng.random() < 0.25
    disturbed = int(rng.choice([0, 1, 2], p=[0.75, 0.19, 0.06]))
    horizon = between(rng, 0.2, 2.5) if continuous else float(rng.integers(1, 16))
    size = log_uniform(rng, 0.05, 1.0)
    rows = []
    for i in range(n):
        own = between(rng, -2.0, 0.4) if continuous else between(rng, -0.9, 1.05)
        row = own * x(i)
        for _ in range(int(rng.integers(0, 3)) if n > 1 else 0):
            row = row + between(rng, -0.5, 0.5) * x(int(rng.integers(n)))
        terms = int(rng.integers(0, 3)) if n <= 3 else int(rng.random() < 0.3)  # many states, few curvatures: quick
        for _ in range(terms):
            pool = SMOOTH
            if positive and rng.random() < 0.6:
                pool = POSITIVE
            elif jumps and rng.random() < 0.5:
                pool = JUMPING
            elif kinks and rng.random() < 0.5:
                pool = KINKED
            a, b = x(int(rng.integers(n))), x(int(rng.integers(n)))
            row = row + between(rng, -size, size) * pool[int(rng.integers(len(pool)))](a, b)
        if timed and rng.random() < 0.5:
            row = row + between(rng, -0.5, 0.5) * TIMED[int(rng.integers(len(TIMED)))](horizon)
        rows.append(row)
    rows = _disturbed(rng, rows, disturbed)
    center = [between(rng, 0.6, 1.4) if positive else between(rng, -0.6, 0.6) for _ in range(n)]
    noise = [0.0 if n > 1 and rng.random() < 0.2 else log_uniform(rng, 3e-3, 0.3) for _ in range(n)]
    return Sketch(
        continuous=continuous, dynamics=rows, center=center, width=log_uniform(rng, 1e-3, 0.3), noise=noise,
        horizon=horizon, disturbance=disturbed, diffusion=_random_diffusion(rng, n, horizon) if continuous else None,
        domain=([0.2] * n, [4.0] * n) if positive else None,
    )  # fmt: skip


def _disturbed(rng: Random, rows: list[Formula], count: int) -> list[Formula]:
    """Disturbances d0.. of size 1, added to a row or multiplied with a state."""
    rows = list(rows)
    for k in range(count):
        i = int(rng.integers(len(rows)))
        factor = log_uniform(rng, 1e-3, 0.2)
        way = rng.random()
        signal = symbol(f"d{k}")
        term = signal if way < 0.6 else signal * x(i) if way < 0.85 else apply("tanh", signal * x(i) + signal)
        rows[i] = rows[i] + factor * term
    return rows


def _random_diffusion(rng: Random, n: int, horizon: float) -> list[list[Formula]] | None:
    """Now and then a g(t, x); otherwise None, for a constant one."""
    if rng.random() < 0.65:
        return None
    zero = number(0.0)
    size = log_uniform(rng, 3e-3, 0.2)
    kinds: list[Callable[[int], Formula]] = [
        lambda i: size * x(i),
        lambda i: size * apply("sqrt", 1 + x(i) ** 2),
        lambda i: size * (1 + 0.5 * sin(x((i + 1) % n))),
        lambda i: size * (1 + T / horizon),
        lambda i: size * apply("abs", x(i)),
        lambda i: size * x(i) * x((i + 1) % n),
    ]
    if rng.random() < 0.3:  # one common noise
        return [[kinds[int(rng.integers(len(kinds)))](i)] for i in range(n)]
    kind = kinds[int(rng.integers(len(kinds)))]
    return [[kind(i) if i == j else zero for j in range(n)] for i in range(n)]


# ---- what people type ----------------------------------------------------------------------------------------------


def _discrete(rows: list[Formula], center: list[float], noise: list[float], horizon: float, **more: Any) -> Sketch:
    return Sketch(
        continuous=False, dynamics=rows, center=center, noise=noise, horizon=horizon, **({"width": 0.05} | more)
    )


def _flow(rows: list[Formula], center: list[float], noise: list[float], horizon: float, **more: Any) -> Sketch:
    return Sketch(
        continuous=True, dynamics=rows, center=center, noise=noise, horizon=horizon, **({"width": 0.05} | more)
    )


@family
def logistic_map(rng: Random) -> Sketch:
    r = between(rng, 1.5, 3.9)
    return _discrete([r * x(0) * (1 - x(0))], [between(rng, 0.3, 0.7)], [log_uniform(rng, 1e-3, 0.06)], 10.0)


@family
def ricker_map(rng: Random) -> Sketch:
    return _discrete(
        [x(0) * apply("exp", between(rng, 0.2, 1.8) * (1 - x(0)))], [0.9], [log_uniform(rng, 1e-3, 0.1)], 8.0
    )


@family
def henon_map(rng: Random) -> Sketch:
    a = between(rng, 0.2, 1.4)
    return _discrete([1 - a * x(0) ** 2 + x(1), 0.3 * x(0)], [0.3, 0.1], [0.01, 0.01], float(rng.integers(2, 8)))


@family
def tent_map(rng: Random) -> Sketch:
    return _discrete([between(rng, 0.8, 1.8) * (1 - apply("abs", 2 * x(0) - 1)) * 0.5], [0.4], [0.02], 6.0)


@family
def threshold_model(rng: Random) -> Sketch:
    row = apply("where", x(0) - 0.2, 0.4 * x(0) + 0.1, 0.8 * x(0) - 0.05)
    return _discrete([row], [between(rng, -0.3, 0.5)], [log_uniform(rng, 3e-3, 0.1)], 8.0)


@family
def constant_map(rng: Random) -> Sketch:
    n = int(rng.integers(1, 4))
    values = [between(rng, -1, 1) for _ in range(n)]
    return _discrete([number(v) for v in values], values, [log_uniform(rng, 1e-2, 0.3)] * n, float(rng.integers(1, 6)))


@family
def random_walk(rng: Random) -> Sketch:
    n, near = int(rng.integers(1, 4)), float(rng.choice([1.0, 1 - 1e-9, 1 + 1e-6, 0.999]))
    return _discrete([near * x(i) for i in range(n)], [0.0] * n, [0.1] * n, float(rng.integers(2, 30)))


@family
def rotation_map(rng: Random) -> Sketch:
    a, r = between(rng, 0.01, 3.0), float(rng.choice([1.0, 0.98, 1.02]))
    c, s = float(r * np.cos(a)), float(r * np.sin(a))
    return _discrete([c * x(0) - s * x(1), s * x(0) + c * x(1)], [0.5, 0.0], [0.02, 0.02], float(rng.integers(3, 20)))


@family
def pendulum_map(rng: Random) -> Sketch:
    h = 0.1
    rows = [x(0) + h * x(1), x(1) - h * (between(rng, 1, 9.81) * sin(x(0)) + 0.5 * x(1))]
    return _discrete(rows, [0.4, 0.0], [0.0, log_uniform(rng, 1e-3, 0.05)], float(rng.integers(5, 20)))


@family
def saturated_map(rng: Random) -> Sketch:
    u = apply("min", apply("max", -0.8 * x(0) - 1.1 * x(1), -0.5), 0.5)
    return _discrete([x(0) + 0.2 * x(1), x(1) + 0.2 * u], [0.5, 0.0], [0.01, 0.02], float(rng.integers(4, 16)))


@family
def large_sine(rng: Random) -> Sketch:
    return _discrete(
        [between(rng, 0.3, 1.5) * sin(x(0))], [0.3], [log_uniform(rng, 0.01, 0.3)], float(rng.integers(2, 12))
    )


@family
def unstable_map(rng: Random) -> Sketch:
    return _discrete([2.0 * x(0) + 0.1 * sin(x(0))], [0.0], [log_uniform(rng, 1e-3, 0.1)], float(rng.integers(2, 11)))


@family
def heading_map(rng: Random) -> Sketch:
    rows = [0.8 * x(0) + 0.1 * apply("atan2", x(1), x(0)), 0.8 * x(1)]
    return _discrete(rows, [between(rng, -1, 1), between(rng, -1, 1)], [0.02, 0.02], 5.0)


@family
def linear_chain(rng: Random) -> Sketch:
    return _linear(rng, int(rng.integers(1, 7)))


@family
def linear_pair(rng: Random) -> Sketch:
    return _linear(rng, 2)


def _linear(rng: Random, n: int) -> Sketch:
    continuous, count = bool(rng.random() < 0.5), int(rng.random() < 0.25)
    a = rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.7)
    radius = max(float(np.max(np.abs(np.linalg.eigvals(a)))), 0.1)
    a = a / radius * between(rng, 0.3, 1.1)
    if continuous:
        a = a - between(rng, 0.0, 1.5) * np.eye(n)
    a, b = np.round(a, 3), np.round(0.1 * rng.standard_normal(n) * (rng.random() < 0.5), 3)
    e = np.round(0.1 * rng.standard_normal((n, 1)), 3) if count else None
    rows = []
    for i in range(n):
        row = number(float(b[i]))
        for j in range(n):
            row = row + float(a[i, j]) * x(j)
        rows.append(row if e is None else row + float(e[i, 0]) * D)
    make = _flow if continuous else _discrete
    horizon = between(rng, 0.3, 3.0) if continuous else float(rng.integers(1, 25))
    center = [between(rng, -0.5, 0.5) for _ in range(n)]
    noise = [0.0 if n > 1 and rng.random() < 0.2 else log_uniform(rng, 1e-3, 0.2) for _ in range(n)]
    return make(rows, center, noise, horizon, disturbance=count, matrices=(a, b, e), width=log_uniform(rng, 1e-3, 0.3))


@family
def oscillator(rng: Random) -> Sketch:
    w = log_uniform(rng, 0.3, 12.0)
    rows = [x(1) * w, -w * x(0) - between(rng, 0.0, 0.5) * x(1)]
    return _flow(rows, [0.5, 0.0], [0.0, log_uniform(rng, 0.01, 0.2)], between(rng, 0.3, 3.0))


@family
def van_der_pol(rng: Random) -> Sketch:
    mu = between(rng, 0.2, 1.2)
    if rng.random() < 0.5:  # backward in time: stable
        return _flow([-x(1), x(0) + mu * (x(0) ** 2 - 1) * x(1)], [0.1, 0.1], [0.0, log_uniform(rng, 0.02, 0.3)], 1.0)
    return _flow([x(1), mu * (1 - x(0) ** 2) * x(1) - x(0)], [0.8, 0.2], [0.0, log_uniform(rng, 0.01, 0.1)], 1.0)


@family
def pendulum(rng: Random) -> Sketch:
    rows = [x(1), -between(rng, 1, 9.81) * sin(x(0)) - between(rng, 0.1, 1.0) * x(1)]
    rows[1] = rows[1] + 0.05 * D
    return _flow(rows, [0.3, 0.0], [0.0, log_uniform(rng, 0.005, 0.1)], between(rng, 0.3, 1.5), disturbance=1)


@family
def lotka_volterra(rng: Random) -> Sketch:
    rows = [x(0) * (1 - x(1)), x(1) * (x(0) - 1)]
    s = log_uniform(rng, 3e-3, 0.1)
    diffusion = [[s * x(0), number(0.0)], [number(0.0), s * x(1)]] if rng.random() < 0.6 else None
    return _flow(rows, [1.1, 0.9], [s, s], between(rng, 0.3, 2.0), diffusion=diffusion)


@family
def sir(rng: Random) -> Sketch:
    beta, gamma, s = between(rng, 0.3, 2.0), between(rng, 0.1, 0.6), log_uniform(rng, 3e-3, 0.2)
    flow = beta * x(0) * x(1)
    rows = [-flow, flow - gamma * x(1)]
    diffusion = [[-s * x(0) * x(1)], [s * x(0) * x(1)]]
    return _flow(rows, [0.9, 0.1], [s, s], between(rng, 0.5, 3.0), diffusion=diffusion, width=0.01)


@family
def sis_growth(rng: Random) -> Sketch:
    s = log_uniform(rng, 5e-3, 0.3)
    return _flow([x(0) * (1 - x(0))], [between(rng, 0.3, 1.2)], [s], 1.5, diffusion=[[s * x(0) * (1 - x(0))]])


@family
def ornstein_uhlenbeck(rng: Random) -> Sketch:
    n, c = int(rng.integers(1, 4)), log_uniform(rng, 1e-3, 10.0)
    return _flow([-c * x(i) for i in range(n)], [0.0] * n, [0.2] * n, between(rng, 0.2, 4.0))


@family
def brownian_motion(rng: Random) -> Sketch:
    n = int(rng.integers(1, 4))
    return _flow([number(0.0)] * n, [0.0] * n, [0.2] * n, between(rng, 0.2, 4.0))


@family
def geometric_brownian(rng: Random) -> Sketch:
    s = log_uniform(rng, 0.01, 0.4)
    return _flow([between(rng, -1, 0.3) * x(0)], [1.0], [s], 1.0, diffusion=[[s * x(0)]])


@family
def square_root_process(rng: Random) -> Sketch:
    s, mean = log_uniform(rng, 0.01, 0.2), between(rng, 0.8, 1.2)
    diffusion = [[s * apply("sqrt", x(0))]]
    return _flow([2 * (mean - x(0))], [1.0], [s], 1.0, diffusion=diffusion, domain=([0.2], [5.0]))


@family
def double_well(rng: Random) -> Sketch:
    return _flow([x(0) - x(0) ** 3], [float(rng.choice([-1.0, 0.0, 0.9]))], [log_uniform(rng, 0.02, 0.5)], 1.0)


@family
def cubic_damping(rng: Random) -> Sketch:
    return _flow([-x(0) - x(0) ** 3 + between(rng, 0, 0.3) * sin(3 * T)], [0.2], [log_uniform(rng, 0.02, 0.6)], 2.0)


@family
def stiff_rates(rng: Random) -> Sketch:
    fast = log_uniform(rng, 30.0, 1e4)
    row = -fast * (x(0) - cos(x(1))) if rng.random() < 0.5 else -fast * x(0)
    return _flow([row, -1.0 * x(1)], [0.9, 0.3], [0.05, 0.05], between(rng, 0.05, 0.5))


@family
def duffing(rng: Random) -> Sketch:
    rows = [x(1), x(0) - x(0) ** 3 - 0.3 * x(1) + 0.2 * cos(T)]
    return _flow(rows, [0.9, 0.0], [0.0, log_uniform(rng, 0.01, 0.1)], 1.0)


@family
def lorenz(rng: Random) -> Sketch:
    rows = [10 * (x(1) - x(0)), x(0) * (28 - 25 * x(2)) - x(1), 25 * x(0) * x(1) - 2.67 * x(2)]
    return _flow(rows, [0.1, 0.1, 1.0], [0.01] * 3, between(rng, 0.05, 0.3), width=0.01)


@family
def unicycle(rng: Random) -> Sketch:
    rows = [cos(x(2)), sin(x(2)), between(rng, -0.5, 0.5) + 0 * x(2)]
    return _flow(rows, [0.0, 0.0, 0.3], [0.02, 0.02, 0.02], between(rng, 0.3, 1.5))


@family
def relay(rng: Random) -> Sketch:
    return _flow([-0.5 * apply("sign", x(0)) - x(0)], [0.2], [log_uniform(rng, 0.02, 0.2)], 1.0)


@family
def saturated_flow(rng: Random) -> Sketch:
    u = apply("min", apply("max", -2 * x(0) - 2 * x(1), -1.0), 1.0)
    return _flow([x(1), u], [0.4, 0.0], [0.0, log_uniform(rng, 0.01, 0.1)], 1.0)


@family
def phase_oscillators(rng: Random) -> Sketch:
    n = int(rng.integers(2, 4))
    rows = [between(rng, -0.3, 0.3) + sum((0.5 / n) * sin(x(j) - x(i)) for j in range(n) if j != i) for i in range(n)]
    return _flow(rows, [between(rng, -0.5, 0.5) for _ in range(n)], [0.05] * n, 1.0)


@family
def springs(rng: Random) -> Sketch:
    n = int(rng.integers(2, 4))
    rows = []
    for i in range(n):
        left = x(i - 1) if i else number(0.0)
        right = x(i + 1) if i < n - 1 else number(0.0)
        rows.append(-2 * x(i) + left + right - 0.2 * x(i) ** 3 - 0.6 * x(n + i))
    return _flow([*(x(n + i) for i in range(n)), *rows], [0.1] * (2 * n), [0.0] * n + [0.05] * n, 1.0, width=0.02)


@family
def disturbed_decay(rng: Random) -> Sketch:
    return _flow([-x(0) + 0.3 * D * x(0), -2 * x(1) + 0.1 * D], [0.3, 0.0], [0.05, 0.05], 1.0, disturbance=1)


# ---- drawn from numbers of their own ---------------------------------------------------------------------------------


def light_oscillator(rng: Random) -> Sketch:
    """A swing with a damping of .001 to .3 of its rate, for up to eight periods; soft, hard or linear springs."""
    w, count = log_uniform(rng, 0.5, 6.0), int(rng.choice([1, 2], p=[0.8, 0.2]))
    soft, rows, speeds = float(rng.choice([0.0, 0.3, -0.3])), [], []
    for i in range(count):
        damping = log_uniform(rng, 1e-3, 0.3)
        force = -(w**2) * x(i) - 2.0 * damping * w * x(count + i)
        if soft:
            force = force + soft * w**2 * (x(i) ** 3 if rng.random() < 0.5 else x(i) - sin(x(i)))
        if count > 1:
            force = force + 0.1 * w**2 * (x(1 - i) - x(i))
        rows.append(force)
        speeds.append(log_uniform(rng, 0.01, 0.1) * w**1.5)
    center = [between(rng, -0.4, 0.4)] + [0.0] * (2 * count - 1)
    horizon = float(f"{rng.uniform(1.0, 8.0) * 6.283 / w:.3g}")
    return _flow([*(x(count + i) for i in range(count)), *rows], center, [0.0] * count + speeds, horizon)


LATER["light_oscillator"] = light_oscillator

DECIMALS = [(0.1, 0.2, 0.3), (0.3, 0.1, 0.2), (0.7, 0.1, 0.8), (0.1, 0.7, 0.8), (1.1, 2.2, 3.3), (0.25, 0.5, 0.75)]
"""Sums that are equal as decimals; as floats the first is larger than the third, smaller, or equal to it."""


def compared(rng: Random, horizon: float, continuous: bool) -> Formula:
    """A comparison of constants, alone or beside the time, between two small numbers."""
    a, b, c = DECIMALS[int(rng.integers(len(DECIMALS)))]
    margin = number(a) + b - c if rng.random() < 0.5 else number(c) - a - b
    yes, no = between(rng, -0.3, 0.3), between(rng, -0.3, 0.3)
    roll = rng.random()
    if roll < 0.4:
        return apply("where", margin, yes, no)
    at = between(rng, 0.2, 0.8) * horizon if continuous else float(rng.integers(0, int(horizon) + 1)) + 0.5
    jump = apply("where", T - at, yes, no)
    if roll < 0.7:
        return jump
    return jump + apply("where", (T + a) - (T + b) + (b - a) + float(rng.choice([-0.05, 0.05])), no, yes)
