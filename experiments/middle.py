"""Four to six states at everyday noise: what is certified beside what simulation finds.

Quadratic value bounds are asked, and of the platoon, whose limits are oblique, the linear response.

    python -m experiments.middle [--seconds S] [--random N] [name ...]

prints a table in Markdown: the certified bound, the truth with 99 % limits (paths from the worst corner of the starts
that a small simulation finds, where there are several), and the processor time until the bound. ``--random N`` runs N
random systems of four to six states instead, their noise such that about one path in a thousand fails, and prints how
many bounds are below 1 and the median of bound over frequency. Run on purpose: minutes.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Callable
from functools import cache

import numpy as np

import certbound as cb
from certbound.arrays import Array
from certbound.quadratic import bound_quadratic

__all__ = ["CASES", "cart_pole", "flows", "platoon", "quadrotor", "random_system", "truth"]

PATHS = 200_000
GRAVITY = 9.81


def quadrotor(noise: float) -> cb.Problem:
    """Planar quadrotor: horizontal place x, height z, attitude th, speeds, and a gust w that is an OU state.

    It holds its height and its place, and must keep out of a box-shaped pillar. Noise 1 shakes the attitude by .1, the
    vertical speed by .2 and the gust by .5.
    """

    def dynamics(x: Array) -> list[object]:
        place, z, th, vx, vz, w = x
        lift = GRAVITY - 2.0 * z - 1.8 * vz
        return [vx, vz, -4.0 * th + place + 1.4 * vx, -lift * np.sin(th) + w, lift * np.cos(th) - GRAVITY, -w]

    shaken = noise * np.array([[0, 0, 0.1, 0, 0, 0], [0, 0, 0, 0, 0.2, 0], [0, 0, 0, 0, 0, 0.5]]).T
    system = cb.ContinuousSystem(dynamics, states=["x", "z", "th", "vx", "vz", "w"], diffusion=shaken)
    free = [np.inf] * 3
    room = cb.Inside(cb.Box([-1, -0.7, -0.6, *(-np.array(free))], [1, 0.7, 0.6, *free]))
    pillar = cb.Outside(cb.Box([0.7, -0.7], [1.0, -0.2], coordinates=[0, 1]))
    return cb.Problem(system, initial=cb.Box([-0.05] * 6, [0.05] * 6), safe=[room, pillar], horizon=4, delta=1e-3)


def platoon(noise: float) -> cb.Problem:
    """Three vehicles on springs, shaken by one noise in proportion to 1 - v; they must keep their order."""

    def dynamics(x: Array) -> list[object]:
        p1, v1, p2, v2, p3, v3 = x
        front, back = p2 - p1 - 0.5, 0.75 * (p3 - p2 - 0.7)
        return [v1, front - v1, v2, -p2 - v2 - front + back, v3, -back - v3]

    def diffusion(x: Array) -> list[list[object]]:
        return [[0.0] if k % 2 == 0 else [noise * (1 - x[k])] for k in range(6)]

    system = cb.ContinuousSystem(dynamics, states=["p1", "v1", "p2", "v2", "p3", "v3"], diffusion=diffusion)
    order = [cb.Inside(cb.HalfSpace(normal, 0.0)) for normal in ([1, 0, -1, 0, 0, 0], [0, 0, 1, 0, -1, 0])]
    return cb.Problem(system, initial=[-1, 0.3, 0.5, 0.3, 1, -0.1], safe=order, horizon=8, delta=0.1)


@cache
def balancing_gain() -> tuple[float, ...]:
    """The LQR gain of the cart-pole below, by python-control."""
    import control

    a = np.array([[0, 1, 0, 0], [0, 0, -0.2 * GRAVITY, 0], [0, 0, 0, 1], [0, 0, 2.4 * GRAVITY, 0]])
    b = np.array([[0.0], [1.0], [0.0], [-2.0]])
    gain, _, _ = control.lqr(a, b, np.diag([1.0, 1.0, 10.0, 1.0]), np.array([[0.1]]))
    return tuple(float(entry) for entry in np.asarray(gain)[0])


def cart_pole(noise: float) -> cb.Problem:
    """A pole of .2 kg and half a metre on a cart of 1 kg, held upright by LQR between limits of the cart."""
    mass, length, gain = 0.2, 0.5, balancing_gain()

    def dynamics(x: Array) -> list[object]:
        _, v, th, w = x
        force = -sum(k * value for k, value in zip(gain, x))
        sine, cosine = np.sin(th), np.cos(th)
        heavy = 1.0 + mass * sine**2
        push = (force + mass * length * w**2 * sine - mass * GRAVITY * sine * cosine) / heavy
        turn = (-force * cosine - mass * length * w**2 * sine * cosine + (1.0 + mass) * GRAVITY * sine) / heavy
        return [v, push, w, turn / length]

    shaken = noise * np.array([[0, 0], [0.15, 0], [0, 0], [0, 0.3]])
    system = cb.ContinuousSystem(dynamics, states=["p", "v", "th", "w"], diffusion=shaken)
    limits = [0.5, np.inf, 0.5, np.inf]
    safe = [cb.Inside(cb.Box([-end for end in limits], limits))]
    return cb.Problem(system, initial=cb.Box([-0.01] * 4, [0.01] * 4), safe=safe, horizon=3, delta=1e-2)


def flows(noise: float, count: int) -> cb.Problem:
    """Lorenz-like flows of three states, each drawn a little to the next."""
    n = 3 * count

    def dynamics(x: Array) -> list[object]:
        rows: list[object] = []
        for k in range(0, n, 3):
            a, b, c = x[k], x[k + 1], x[k + 2]
            rows += [2 * (b - a) + (0.1 * (x[(k + 3) % n] - a) if count > 1 else 0.0), a * (0.5 - c) - b, a * b - c]
        return rows

    system = cb.ContinuousSystem(dynamics, states=n, diffusion=noise * np.eye(n))
    safe = [cb.Inside(cb.Box([-1.5] * n, [1.5] * n))]
    return cb.Problem(system, initial=cb.Box([-0.2] * n, [0.2] * n), safe=safe, horizon=2, delta=1e-3)


CASES: dict[str, Callable[[], cb.Problem]] = {
    "quadrotor 0.6": lambda: quadrotor(0.6),
    "quadrotor 1.2": lambda: quadrotor(1.2),
    "quadrotor 1.8": lambda: quadrotor(1.8),
    "platoon": lambda: platoon(0.1),
    "cart-pole": lambda: cart_pole(0.8),  # at 1 about 5e-3 of the paths fail
    "flow .35": lambda: flows(0.35, 1),
    "flow .44": lambda: flows(0.44, 1),
    "two flows .35": lambda: flows(0.35, 2),
    "two flows .41": lambda: flows(0.41, 2),
}
OBLIQUE = ("platoon",)


def truth(problem: cb.Problem, seed: int = 0) -> tuple[float, float]:
    """99 % limits of the probability of failing from the worst corner of the starts, as far as 4000 paths each tell."""
    rng, hull = np.random.default_rng(seed), problem.initial.hull()
    corners = {tuple(ends) for ends in itertools.product(*zip(hull.lo.tolist(), hull.hi.tolist()))}
    if len(corners) > 1:

        def failures(corner: tuple[float, ...]) -> int:
            return cb.simulate_exits(problem.replace(initial=list(corner)), paths=4000, rng=rng).exits

        problem = problem.replace(initial=list(max(sorted(corners), key=failures)))
    seen = cb.simulate_exits(problem, paths=PATHS, rng=rng)
    return seen.lower, seen.upper


def random_system(seed: int) -> cb.Problem:
    """A stable system of four to six states with products and sines, its noise such that some 1e-3 of paths fail."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 7))
    linear = 0.4 * rng.standard_normal((n, n)) - 1.3 * np.eye(n)
    bent, places = 0.25 * rng.standard_normal((n, 2)), rng.integers(0, 3, (n, 3))
    bent[rng.random((n, 2)) < 0.5] = 0.0
    columns = rng.standard_normal((n, n)) * 0.15 + 0.3 * np.eye(n)

    def dynamics(x: Array) -> list[object]:
        rows: list[object] = []
        for i, (a, b, c) in enumerate(places):
            rows.append(linear[i] @ x + bent[i, 0] * x[a] * x[b] + bent[i, 1] * (np.sin(x[c]) - x[c]))
        return rows

    def problem(size: float) -> cb.Problem:
        return cb.Problem(
            cb.ContinuousSystem(dynamics, states=n, diffusion=size * columns), horizon=2, delta=1e-12,
            initial=cb.Box([-0.05] * n, [0.05] * n), safe=[cb.Inside(cb.Box([-1.0] * n, [1.0] * n))],
        )  # fmt: skip

    low, high = 0.05, 4.0
    for _ in range(8):
        middle = math.sqrt(low * high)
        many = cb.simulate_exits(problem(middle), paths=4000, rng=np.random.default_rng(seed)).exits
        low, high = (low, middle) if many > 4 else (middle, high)
    return problem(high)


def measure(name: str, problem: cb.Problem, seconds: float) -> tuple[float, tuple[float, float]]:
    """The bound and the limits of the truth, printed as a line of the table."""
    begin, told = time.process_time(), []

    def found(bound: object) -> None:
        told.append(time.process_time() - begin)

    if name in OBLIQUE:
        bound = 10 ** cb.verify_safety(problem, method="linear").log10_delta
    else:
        bound = 10 ** bound_quadratic(problem, seconds=seconds, found=found).upper
    spent, first = time.process_time() - begin, told[0] if told else math.nan
    ends = truth(problem)
    print(f"| {name} | {bound:.2g} | {ends[0]:.2g} to {ends[1]:.2g} | {first:.1f} | {spent:.1f} |", flush=True)
    return bound, ends


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("names", nargs="*", help="cases (all)")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--random", type=int, default=0)
    asked = parser.parse_args()
    print("| case | certified | simulated, worst corner | first bound, s | all, s |\n|---|---|---|---|---|")
    if not asked.random:
        for name in asked.names or CASES:
            measure(name, CASES[name](), asked.seconds)
        return
    pairs = [measure(f"random {seed}", random_system(seed), asked.seconds) for seed in range(asked.random)]
    ratios = [bound / math.sqrt(max(ends[0], 1e-6) * ends[1]) for bound, ends in pairs]
    below = sum(bound < 1 for bound, _ in pairs)
    print(f"\n{below} of {len(pairs)} below 1; median of certified over simulated {np.median(ratios):.1f}")


if __name__ == "__main__":
    main()
