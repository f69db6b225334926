"""An attempt to break the tubes: random systems and noises, every tube that applies, simulated exits against delta.

Discrete time has nonlinear maps of gain L_t, anisotropic Gaussian, Rademacher and uniform noise (also with an
amplitude that follows the state); continuous time has rotations with an exact transition from one grid time to the
next, so that a path is tested at the grid times. What the claims report is the one-sided binomial level of the
closest call: P(at least as many exits | exit probability delta).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.stats import binom

import certbound as cb
from certbound.errors import CertboundError
from certbound.tubes.kummer.profile import kummer_tube
from certbound.tubes.tube import Tube
from certbound.tubes.tuning import applicable_methods
from experiments.harness import Arrays, Claims, main

__all__ = ["CASES", "Case", "binomial_level", "draw_case", "exits", "tubes_of"]

CASES = 60
LAWS = ("gaussian", "rademacher", "uniform")
_BATCH = 20_000  # paths at a time


@dataclass(frozen=True, kw_only=True)
class Case:
    """One system with its noise; ``steps`` are the matrices of one grid step each.

    ``bend`` is the nonlinearity between matrix and state (0 none, 1 sin, 2 a sawtooth), ``follows`` says that the
    noise shrinks with the state.
    """

    constants: cb.Constants
    horizon: float
    delta: float
    times: np.ndarray
    steps: np.ndarray
    noises: np.ndarray
    start: np.ndarray
    law: int
    bend: int
    follows: bool
    label: str


def draw_case(index: int) -> Case:
    """Case number ``index``: two of three are in discrete time."""
    rng = np.random.default_rng([2026, index])
    return _flow(rng) if index % 3 == 2 else _chain(rng, LAWS[(index // 3) % 3 if index % 3 else rng.integers(3)])


def _orthogonal(rng: np.random.Generator, n: int) -> np.ndarray:
    q, r = np.linalg.qr(rng.standard_normal((n, n)))
    return np.asarray(q * np.sign(np.diag(r)))


def _chain(rng: np.random.Generator, law: str) -> Case:
    n, horizon = int(rng.choice([1, 2, 3, 5])), int(rng.integers(3, 40))
    delta = float(rng.choice([0.1, 0.03, 0.01]))
    ends = np.unique(np.concatenate([[0], rng.integers(1, horizon, size=int(rng.integers(0, 3))), [horizon]]))
    gains = rng.uniform(0.3, 1.05, len(ends) - 1)
    sigmas = rng.uniform(0.3, 1.0, len(ends) - 1)
    shape = np.diag(np.append(1.0, rng.uniform(0.05, 1.0, n - 1))) @ _orthogonal(rng, n)
    if rng.random() < 0.3:
        shape = np.eye(n)
    piece = np.repeat(np.arange(len(gains)), np.diff(ends))
    steps = np.array([gains[k] * _orthogonal(rng, n) for k in piece])
    noises = np.array([sigmas[k] * shape for k in piece])
    bend, follows = int(rng.choice([0, 0, 1, 2])), bool(rng.random() < 0.2)
    nu = min(float(np.sum(shape**2)) * (1 + 1e-9), float(n))
    bounds = None
    if law != "gaussian" and rng.random() < 0.4:
        bounds = sigmas * math.sqrt(n * (3.0 if law == "uniform" else 1.0)) * (1 + 1e-9)
    constants = cb.Constants(
        gain=gains * (1 + 1e-9), sigma=sigmas * (1 + 1e-9), dimension=n, effective_dimension=nu,
        gaussian=law == "gaussian" and not follows, times=ends.astype(float), noise_bound=bounds,
    )  # fmt: skip
    return Case(
        constants=constants, horizon=float(horizon), delta=delta, times=np.arange(horizon + 1.0), steps=steps,
        noises=noises, start=rng.standard_normal(n), law=LAWS.index(law), bend=bend, follows=follows,
        label=f"DT n={n} T={horizon} {law} nu={nu:.2f} bend={bend} follows={follows} delta={delta:g}",
    )  # fmt: skip


def _flow(rng: np.random.Generator) -> Case:
    n, delta = int(rng.choice([1, 2, 3])), float(rng.choice([0.1, 0.03, 0.01]))
    pieces, count = int(rng.integers(1, 4)), 240
    horizon = float(rng.uniform(0.5, 4.0))
    rates, sigmas = rng.uniform(-2.0, 0.5, pieces), rng.uniform(0.3, 1.0, pieces)
    isotropic = bool(rng.random() < 0.4)
    shape = np.eye(n) if isotropic else np.diag(np.append(1.0, rng.uniform(0.05, 1.0, n - 1)))
    turn = rng.standard_normal((n, n))
    turn -= turn.T
    if not isotropic:
        turn *= 0.0  # an exact transition then takes diagonal matrices
    times = np.linspace(0.0, horizon, count + 1)
    piece = np.minimum(np.arange(count) * pieces // count, pieces - 1)
    step = horizon / count
    variance = [step if c == 0 else math.expm1(2 * c * step) / (2 * c) for c in rates]
    steps = np.array([math.exp(rates[k] * step) * expm(turn * step) for k in piece])
    noises = np.array([sigmas[k] * math.sqrt(variance[k]) * shape for k in piece])
    nu = min(float(np.sum(shape**2)) * (1 + 1e-9), float(n))
    ends = np.append(times[np.flatnonzero(np.diff(np.append(-1, piece)))], horizon)
    constants = cb.Constants(
        rate=rates, sigma=sigmas, dimension=n, effective_dimension=None if isotropic else nu, isotropic=isotropic,
        times=ends,
    )  # fmt: skip
    return Case(
        constants=constants, horizon=horizon, delta=delta, times=times, steps=steps, noises=noises,
        start=np.zeros(n), law=0, bend=0, follows=False,
        label=f"CT n={n} T={horizon:.2f} nu={nu:.2f} isotropic={isotropic} pieces={pieces} delta={delta:g}",
    )  # fmt: skip


def tubes_of(case: Case, *, slow: bool) -> list[Tube]:
    """Every method that applies, stated Kummer parameters, and the slow methods on demand."""
    asked: dict[str, Any] = {"horizon": case.horizon, "delta": case.delta}
    names = [*applicable_methods(case.constants)]
    names += ["mixture"] * slow + ["exact"] * (slow and case.constants.isotropic)
    names += ["worst_case"] * (slow and case.constants.continuous)
    tubes = []
    for name in names:
        try:
            tubes.append(cb.tune_tube(case.constants, method=name, **asked))
        except (ValueError, CertboundError):
            continue  # a hypothesis that the constants do not meet, or a level out of reach
    limit = 3.0 if case.constants.continuous or case.constants.gaussian else case.constants.nu / 2 * 0.999
    for a, v0 in ((0.0, 0.01), (0.4 * limit, 0.3), (limit, 2.0)):
        tubes.append(kummer_tube(case.constants, a=a, v0=v0, **asked))
    return tubes


def exits(case: Case, radii: np.ndarray, paths: int, seed: int) -> np.ndarray:
    """Numbers of paths that leave each of the tubes, whose radii at the grid times are (tube, time)."""
    rng = np.random.Generator(np.random.SFC64(seed))
    lost = np.zeros(len(radii), dtype=np.int64)
    for first in range(0, paths, _BATCH):
        lost += _exits(case, radii, min(_BATCH, paths - first), rng)
    return lost


def _exits(case: Case, radii: np.ndarray, paths: int, rng: np.random.Generator) -> np.ndarray:
    nominal, x = case.start[None], np.tile(case.start, (paths, 1))
    out = np.zeros((len(radii), paths), dtype=bool)
    for step, noise, radius in zip(case.steps, case.noises, radii.T[1:]):
        match case.law:
            case 0:
                w = rng.standard_normal(x.shape)
            case 1:
                w = np.where(rng.random(x.shape) < 0.5, 1.0, -1.0)
            case _:
                w = math.sqrt(3.0) * (2.0 * rng.random(x.shape) - 1.0)
        size = 0.3 + 0.7 / (1.0 + x[:, :1] ** 2) if case.follows else 1.0
        x = _bent(x, case.bend) @ step.T + (size * w) @ noise.T
        nominal = _bent(nominal, case.bend) @ step.T
        out |= np.linalg.norm(x - nominal, axis=1) > radius[:, None]
    return out.sum(axis=1)


def _bent(x: np.ndarray, bend: int) -> np.ndarray:
    if bend == 1:
        return np.sin(x)
    return np.abs((x + 1.0) % 4.0 - 2.0) - 1.0 if bend == 2 else x


def binomial_level(lost: int, paths: int, delta: float) -> float:
    """P(at least ``lost`` exits) when each path leaves with probability delta: a small value refutes the tube."""
    return float(binom.sf(lost - 1, paths, delta))


def compute(full: bool, cases: int | None = None) -> tuple[Arrays, Claims]:
    """Exit shares in units of delta for every case and tube."""
    paths = 1_000_000 if full else 20_000
    rows: list[dict[str, Any]] = []
    for index in range(cases or (CASES if full else 12)):
        case = draw_case(index)
        tubes = tubes_of(case, slow=full and index % 4 in (1, 2))
        radii = np.array([tube.radius(case.times) for tube in tubes]) * (1 + 1e-12)
        lost = exits(case, radii, paths, index)
        for tube, count in zip(tubes, lost.tolist()):
            level = binomial_level(count, paths, case.delta)
            rows.append({
                "case": index, "label": case.label, "method": tube.method, "exits": count, "level": level,
                "share": count / paths / case.delta,
            })  # fmt: skip
        worst = max(rows[-len(tubes) :], key=lambda row: row["share"])
        print(f"{index:3d} {case.label}: {len(tubes)} tubes, closest {worst['method']} {worst['share']:.3f} delta")
    closest = max(rows, key=lambda row: row["share"])
    claims: Claims = {
        "paths": paths, "cases": 1 + max(row["case"] for row in rows), "tubes": len(rows), "closest": closest,
        "least_level": min(row["level"] for row in rows), "refuted": sum(row["level"] < 1e-6 for row in rows),
    }  # fmt: skip
    arrays = {"share": np.array([row["share"] for row in rows]), "case": np.array([row["case"] for row in rows])}
    return arrays, claims


if __name__ == "__main__":
    main("falsification", compute)
