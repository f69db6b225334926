"""Floating-point Kummer and Bessel excesses: they propose, :mod:`certbound.rigor.balls` proves.

E_a(z) = (1F1(a; b; z) - 1)/a (limit at a = 0) and its Bessel companion (0F1(; b; a z) - 1)/a, the limit of the
former for large a at fixed a z. All terms are positive, so that sums lose no digits; the logarithm is returned.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from certbound.arrays import Array

_DIRECT = 1200
_LARGEST = 700.0  # logarithm of the largest argument that is tried
_CHUNK = 1 << 21


def log_phi(x: Array) -> Array:
    """log((e^x - 1)/x), at any size and sign of x."""
    x = np.asarray(x, dtype=float)
    size = np.abs(x)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        small = np.log1p(x / 2 * (1 + x / 3))
        large = np.maximum(x, 0.0) + np.log(-np.expm1(-size) / np.where(x == 0, 1.0, size))
        return np.where(size < 1e-5, small, large)


def log_excess(a: Array, b: float, z: Array, *, bessel: bool = False) -> tuple[Array, Array]:
    """(log E, d log E/d log z) for a >= 0 and z > 0 of one broadcast shape."""
    a, z = np.broadcast_arrays(np.asarray(a, dtype=float), np.asarray(z, dtype=float))
    shape = z.shape
    a, z = a.ravel(), z.ravel()
    value, slope = np.empty(z.size), np.empty(z.size)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        peak, width = _peak(a, b, z, bessel)
        last = peak + 12 * width + 60
    bad = ~np.isfinite(last) | ~(z > 0)
    value[bad], slope[bad] = np.where(z[bad] == 0, -np.inf, np.inf), 1.0
    direct = ~bad & (last <= _DIRECT)
    for chosen, sum_up in ((direct, _direct), (~bad & ~direct, _strided)):
        index = np.flatnonzero(chosen)
        if not len(index):
            continue
        count = last[index].astype(int) if sum_up is _direct else np.full(len(index), 64)
        size = np.floor(2 * np.log2(count))  # what needs few terms is not summed over as many as what needs most
        for one in np.unique(size):
            alike, terms = index[size == one], int(np.max(count[size == one]))
            for block in np.array_split(alike, -(-len(alike) * terms // _CHUNK)):
                value[block], slope[block] = sum_up(a[block], b, z[block], peak[block], width[block], terms, bessel)
    return value.reshape(shape), slope.reshape(shape)


def _peak(a: Array, b: float, z: Array, bessel: bool) -> tuple[Array, Array]:
    """Index and width of the largest term."""
    if bessel:  # a z = (b + k)(k + 1)
        q = a * z
        root = np.sqrt((b - 1) ** 2 / 4 + q)
        k = np.maximum(root - (b + 1) / 2, 0.0)
        return k, 1 / np.sqrt(1 / (b + k + 1) + 1 / (k + 1))
    half = (z - b - 1) / 2
    square = half**2 + a * z - b
    k = np.where(square > 0, np.maximum(half + np.sqrt(np.maximum(square, 0.0)), 0.0), 0.0)
    curvature = 1 / (b + k) + 1 / (k + 1) - 1 / (np.maximum(a, 0.0) + k + 1e-300)
    return k, 1 / np.sqrt(np.maximum(curvature, 1 / (4 * (k + 4) ** 2)))


def _direct(a: Array, b: float, z: Array, peak: Array, width: Array, terms: int, bessel: bool) -> tuple[Array, Array]:
    """Sum all the terms from the first one."""
    k = np.arange(1, terms + 1, dtype=float)
    denominator = (b + k) * (k + 1)
    ratio = np.empty((len(z), terms + 1))
    ratio[:, 0] = z / b
    with np.errstate(over="ignore", invalid="ignore"):
        np.multiply.outer(z, 1 / denominator, out=ratio[:, 1:])
        ratio[:, 1:] *= a[:, None] if bessel else a[:, None] + k
        term = np.cumprod(ratio, axis=1)
        total = term.sum(axis=1)
        slope = term @ np.arange(1, terms + 2, dtype=float) / total
        value = np.log(total)
    far = ~(np.isfinite(slope) & (total > 0))
    if np.any(far):
        logs = np.cumsum(np.log(ratio[far]), axis=1)
        top = logs.max(axis=1, keepdims=True)
        scaled = np.exp(logs - top)
        total = scaled.sum(axis=1)
        value[far] = top[:, 0] + np.log(total)
        slope[far] = scaled @ np.arange(1, terms + 2, dtype=float) / total
    return value, slope


def _strided(a: Array, b: float, z: Array, peak: Array, width: Array, terms: int, bessel: bool) -> tuple[Array, Array]:
    """Sum the bell around the largest term on a coarser grid (Poisson summation: the error is e^{-2 pi^2 w^2})."""
    from scipy.special import gammaln

    stride = width / 3
    start = np.maximum(peak - 30 * stride, 1.0)
    k = start[:, None] + stride[:, None] * np.arange(terms)
    x = np.log(z)[:, None]
    logs = k * x - gammaln(b + k) + gammaln(b) - gammaln(k + 1)
    logs += (k - 1) * np.log(a)[:, None] if bessel else gammaln(a[:, None] + k) - gammaln(a + 1)[:, None]
    top = logs.max(axis=1, keepdims=True)
    scaled = np.exp(logs - top)
    total = scaled.sum(axis=1)
    return top[:, 0] + np.log(total * stride), (scaled * k).sum(axis=1) / total


def solve_excess(a: Array, b: float, target: Array, *, bessel: bool = False) -> Array:
    """z with log E(z) = target, of the broadcast shape (0 where the target is -inf, inf where it is inf)."""
    a, target = np.broadcast_arrays(np.asarray(a, dtype=float), np.asarray(target, dtype=float))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        big = np.maximum(target, 0.0) + 0.5 * b + 1
        if bessel:
            big = (big + 0.5 * b) ** 2 / np.maximum(4 * a, 1e-300)
        x = np.minimum(target + np.log(b), np.log(big))
        usable = np.isfinite(target) & np.isfinite(x)
        x = np.where(usable, x, 0.0)
        for _ in range(60):
            value, slope = log_excess(a, b, np.exp(x), bessel=bessel)
            step = np.where(usable, (target - value) / slope, 0.0)
            step = np.clip(np.nan_to_num(step), -2.0, 2.0)
            x = x + step
            if np.all(np.abs(step) < 1e-13 * np.maximum(1.0, np.abs(x))):
                break
        return np.where(usable, np.exp(x), np.where(target > 0, np.inf, 0.0))


def log_phi_one(x: float) -> float:
    """Scalar :func:`log_phi`."""
    size = abs(x)
    if size < 1e-5:
        return math.log1p(x / 2 * (1 + x / 3))
    return max(x, 0.0) + math.log(-math.expm1(-size) / size) if size < math.inf else x


def log_excess_one(a: float, b: float, z: float, *, bessel: bool = False, digits: float = 1e-17) -> tuple[float, float]:
    """Scalar :func:`log_excess`, to ``digits``; a plain loop is quicker than arrays here."""
    if not 0 < z < 300 or a > 1e4:
        return _strided_one(a, b, z, bessel)
    if (a + 1.0) * z < 1e-200 * b:  # one term is all, and the others would vanish
        return math.log(z) - math.log(b), 1.0
    term = total = moment = z / b
    k = 1.0
    step = 0.0 if bessel else 1.0
    while True:
        term *= (a + step * k) * z / ((b + k) * (k + 1.0))
        k += 1.0
        total += term
        moment += k * term
        if (term * k < digits * total and (a + k) * z < 0.7 * (b + k) * k) or moment == math.inf:
            break
    if total < math.inf and moment < math.inf:
        return math.log(total), moment / total
    value, slope = log_excess(np.asarray(a), b, np.asarray(z), bessel=bessel)
    return float(value), float(slope)


@cache
def _scipy() -> tuple[Any, Any]:
    """0F1 and 1F1, imported when first asked for."""
    from scipy.special import hyp0f1, hyp1f1

    return hyp0f1, hyp1f1


def log_excess_value(a: float, b: float, z: float, *, bessel: bool = False, digits: float = 1e-17) -> float:
    """The value of :func:`log_excess_one` alone, to 7 digits, from SciPy where that is quicker."""
    if 0.1 <= b <= 50 and ((bessel and 1 <= a * z <= 1e4) or (not bessel and a <= 1e4 and 1e-4 <= z <= 250)):
        hyp0f1, hyp1f1 = _scipy()
        power = a if bessel else max(a, 1e-8)
        value = float(hyp0f1(b, a * z) if bessel else hyp1f1(power, b, z))
        if 1.00001 < value < 1e290:
            return math.log((value - 1) / power)
    return log_excess_one(a, b, z, bessel=bessel, digits=digits)[0]


def log_excess_values(a: float, b: float, z: Array, *, bessel: bool = False) -> Array:
    """:func:`log_excess_value` for an array of z."""
    value = np.zeros_like(z)
    power = a if bessel else max(a, 1e-8)
    if 0.1 <= b <= 50 and (bessel or a <= 1e4):
        hyp0f1, hyp1f1 = _scipy()
        x = a * z if bessel else z
        usable = (x >= 1) & (x <= 1e4) if bessel else (x >= 1e-4) & (x <= 250)
        value[usable] = hyp0f1(b, x[usable]) if bessel else hyp1f1(power, b, x[usable])
    good = (value > 1.00001) & (value < 1e290)
    result = np.empty_like(z)
    result[good] = np.log((value[good] - 1) / power)
    if not np.all(good):
        result[~good] = log_excess(np.asarray(a), b, z[~good], bessel=bessel)[0]
    return result


def _strided_one(a: float, b: float, z: float, bessel: bool) -> tuple[float, float]:
    """Scalar :func:`_strided` where the bell is far from the first term, else :func:`log_excess`."""
    if 0 < z < 1e18 and (a > 0 or not bessel):
        if bessel:
            peak = math.sqrt((b - 1) ** 2 / 4 + a * z) - (b + 1) / 2
            curvature = 1 / (b + max(peak, 0.0) + 1) + 1 / (max(peak, 0.0) + 1)
        else:
            half = (z - b - 1) / 2
            peak = half + math.sqrt(max(half * half + a * z - b, 0.0))
            k = max(peak, 0.0)
            curvature = 1 / (b + k) + 1 / (k + 1) - 1 / (a + k + 1e-300)
        if peak > 200 and curvature > 0 and peak > 15 * (width := curvature**-0.5):
            stride = width / 1.5
            x, lgamma = math.log(z), math.lgamma
            rate = math.log(a) if bessel else 0.0
            base = lgamma(b) - (rate if bessel else lgamma(a + 1))
            ks = [peak + stride * j for j in range(-13, 14)]
            logs = [
                k * (x + rate) - lgamma(b + k) - lgamma(k + 1) + base + (0.0 if bessel else lgamma(a + k)) for k in ks
            ]
            top = max(logs)
            parts = [math.exp(value - top) for value in logs]
            total = sum(parts)
            return top + math.log(total * stride), sum(k * part for k, part in zip(ks, parts)) / total
    value, slope = log_excess(np.asarray(a), b, np.asarray(z), bessel=bessel)
    return float(value), float(slope)


def solve_excess_one(a: float, b: float, target: float, *, bessel: bool = False, guess: float = 0.0) -> float:
    """Scalar :func:`solve_excess`."""
    if not -math.inf < target < 1e100:
        return 0.0 if target == -math.inf else math.inf
    if guess > 0 and math.isfinite(guess):
        x = math.log(guess)
    else:
        big = max(target, 0.0) + 0.5 * b + 1
        if bessel:
            big = (big + 0.5 * b) ** 2 / max(4 * a, 1e-300)
        x = min(target + math.log(b), math.log(big))
    for _ in range(60):
        if x > _LARGEST:
            return math.inf
        value, slope = log_excess_one(a, b, math.exp(x), bessel=bessel)
        step = min(max((target - value) / slope, -2.0), 2.0)
        x += step
        # the next Newton step is about step^2: below this one it is rounding
        if abs(step) < 1e-8 * max(1.0, abs(x)):
            break
    return math.exp(x) if x <= _LARGEST else math.inf
