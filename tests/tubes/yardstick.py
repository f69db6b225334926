"""Exit probability of the radial process, solved numerically: the yardstick of tightness (an estimate, not a bound).

For dS = c S dt + sigma dW the probability p(R) = P(sup_{t <= T} ||S_t|| > R) is u(T, 0) with
u_tau = c s u_s + (sigma^2/2)(u_ss + (n - 1) u_s/s), u(tau, R) = 1, u(0, s) = 0; for S+ = L S + w, w ~ N(0, sigma^2 I),
it is 1 - u_T(0) with u_{k+1}(s) = int_0^R q(s -> s') u_k(s') ds', q the noncentral chi density (Sec. 5 of
docs/theory.md). Certified bounds of the same numbers stand in :mod:`certbound.tubes.exact.supersolution` (CT) and
:mod:`certbound.tubes.exact.recursion` (DT).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from certbound.tubes.constants import Constants
from certbound.tubes.schedule import Schedule, make_schedule

__all__ = ["estimate_exit_probability", "estimate_radius", "solve_radius"]

Array = NDArray[np.float64]


def estimate_exit_probability(
    constants: Constants, *, horizon: float, radius: float, cells: int = 1500, steps: int = 600
) -> float:
    """P(exists t <= T: ||S_t|| > radius) for the linear isotropic Gaussian system with these constants.

    An estimate to about 4 digits (finite volumes and Crank-Nicolson steps in CT, Gauss-Legendre in DT).

    Examples
    --------
    >>> constants = Constants(rate=-0.5, sigma=0.1**0.5, dimension=1)
    >>> round(estimate_exit_probability(constants, horizon=5.0, radius=1.2858), 5)
    0.001
    """
    schedule = make_schedule(constants, horizon)
    scale = radius / schedule.unit
    if schedule.continuous:
        outward = float(np.max(schedule.rates / np.maximum(schedule.noise, 1e-300), initial=0.0)) * scale**2
        cells = max(cells, min(12_000, math.ceil(50 * outward)))
        return _diffusion(schedule, constants.dimension, scale, cells, steps)
    return _chain(schedule, constants.dimension, scale)


def estimate_radius(constants: Constants, *, horizon: float, delta: float, **options: int) -> float:
    """Constant radius whose estimated exit probability is delta: the exact limit of every tube.

    Examples
    --------
    >>> constants = Constants(rate=-0.5, sigma=0.1**0.5, dimension=1)
    >>> round(estimate_radius(constants, horizon=5.0, delta=1e-3), 4)
    1.2858
    """
    schedule = make_schedule(constants, horizon)
    variance = schedule.unit**2 * float(np.max(schedule.nodes[1]))

    def log_probability(radius: float) -> float:
        return math.log(max(estimate_exit_probability(constants, horizon=horizon, radius=radius, **options), 1e-300))

    half = constants.dimension / 2
    guess = math.sqrt(variance * (2 * half - 2 * math.log(delta)))
    return solve_radius(log_probability, math.log(delta), guess)


def solve_radius(function: Callable[[float], float], target: float, guess: float) -> float:
    """Radius where a falling function (log P, about quadratic in the radius) meets the target: secant in r^2."""
    x, step = guess**2, 0.06 * guess**2
    fx = function(math.sqrt(x)) - target
    other = x + (step if fx > 0 else -step)
    fo = function(math.sqrt(other)) - target
    for _ in range(30):
        if fo == fx:
            break
        slope = (fo - fx) / (other - x)
        new = other - fo / slope if slope < 0 else other * (1.2 if fo > 0 else 0.8)
        new = min(max(new, 0.4 * other), 2.5 * other)
        x, fx = other, fo
        other, fo = new, function(math.sqrt(new)) - target
        if abs(other - x) < 1e-7 * x:
            break
    return math.sqrt(other)


def _diffusion(schedule: Schedule, dimension: int, radius: float, cells: int, steps: int) -> float:
    """Finite volumes with the weight s^{n-1} e^{c s^2/sigma^2}; steps grow with the time to go."""
    faces = radius * np.linspace(0.0, 1.0, cells + 1)
    centres = (faces[1:] + faces[:-1]) / 2
    h = faces[1] - faces[0]
    p = np.zeros(cells)
    horizon = schedule.horizon
    ends = schedule.times
    for k in range(len(schedule.lengths) - 1, -1, -1):
        rate, noise = float(schedule.rates[k]), float(schedule.noise[k])
        to_go = horizon - float(ends[k + 1])
        share = max(20, int(steps * schedule.lengths[k] / horizon))
        grid = np.linspace(0.0, 1.0, share + 1) ** 2 * float(schedule.lengths[k])
        if noise == 0:
            continue
        lower, diag, upper, source = _volumes(faces, centres, h, rate, noise, dimension)
        for j, step in enumerate(np.diff(grid)):
            substeps = ([step / 4] * 4, 1.0) if to_go == 0 and j < 4 else ([step], 0.5)
            for size in substeps[0]:
                p = _theta_step(p, lower, diag, upper, source, size, substeps[1])
    return float(p[0])


def _volumes(
    faces: Array, centres: Array, h: float, rate: float, noise: float, dimension: int
) -> tuple[Array, Array, Array, Array]:
    """Tridiagonal generator; the volume of each cell by Simpson's rule on the weight."""
    from scipy.special import xlogy

    def log_weight(s: Array) -> Array:
        return np.asarray(xlogy(dimension - 1, s) + rate / noise * s**2)

    middle = log_weight(centres)
    left = np.exp(log_weight(faces[:-1]) - middle)
    right = np.exp(log_weight(faces[1:]) - middle)
    volume = (left + 4 + right) / 6
    a = noise / 2 * left / (volume * h * h)
    b = noise / 2 * right / (volume * h * h)
    a[0] = 0.0
    b[-1] *= 2  # half a cell to the boundary
    source = np.zeros(len(centres))
    source[-1] = b[-1]
    lower, upper = np.append(a[1:], 0.0), np.append(0.0, b[:-1])
    return lower, -(a + b), upper, source


def _theta_step(p: Array, lower: Array, diag: Array, upper: Array, source: Array, step: float, theta: float) -> Array:
    """One step of (I - theta k A) p' = (I + (1 - theta) k A) p + k source."""
    from scipy.linalg import solve_banded

    right = p + step * source
    if theta < 1:
        moved = diag * p
        moved[:-1] += upper[1:] * p[1:]
        moved[1:] += lower[:-1] * p[:-1]
        right = right + (1 - theta) * step * moved
    bands = np.stack([-theta * step * upper, 1 - theta * step * diag, -theta * step * lower])
    return np.asarray(solve_banded((1, 1), bands, right, check_finite=False))


def chi_kernel(start: Array, end: Array, dimension: int) -> Array:
    """Density at ``end`` of ||start e_1 + N(0, I)||, on the outer grid."""
    from scipy.special import gammaln, ive

    x, y = start[:, None], end[None, :]
    if dimension == 1:
        return (np.exp(-((y - x) ** 2) / 2) + np.exp(-((y + x) ** 2) / 2)) / math.sqrt(2 * math.pi)
    order = dimension / 2 - 1
    product = x * y
    with np.errstate(divide="ignore", invalid="ignore"):
        bessel = np.log(ive(order, product)) - order * np.log(product)
    small = product < 1e-6 * (order + 1)
    bessel = np.where(small | ~np.isfinite(bessel), -order * math.log(2) - gammaln(order + 1) - product, bessel)
    return np.asarray(np.exp((dimension - 1) * np.log(y) - (y - x) ** 2 / 2 + bessel))


def _chain(schedule: Schedule, dimension: int, radius: float) -> float:
    """Gauss-Legendre panels of at most one sigma."""
    sigma = schedule.sigmas / schedule.unit
    panels = max(4, math.ceil(radius / (float(np.min(sigma[sigma > 0])))))
    nodes, weights = np.polynomial.legendre.leggauss(10)
    width = radius / panels
    s = ((nodes[None, :] + 1) / 2 + np.arange(panels)[:, None]).ravel() * width
    w = np.tile(weights / 2 * width, panels)
    survival = np.ones(len(s))
    cache: dict[tuple[float, float], Array] = {}
    steps = np.diff(schedule.times).astype(int)
    for k in range(len(steps) - 1, -1, -1):
        gain, noise = float(schedule.slopes[k]), float(sigma[k])
        key = (gain, noise)
        if key not in cache:
            points = np.append(gain * s, 0.0)
            cache[key] = chi_kernel(points / noise, s / noise, dimension) * (w / noise)
        kernel = cache[key]
        for j in range(steps[k]):
            last = k == 0 and j == steps[k] - 1
            if last:
                return float(1 - kernel[-1] @ survival)
            survival = kernel[:-1] @ survival
    raise AssertionError("a schedule has at least one step")
