"""Tightness of every method over a grid: largest radius over the exact constant radius, worst, median and best.

The grid runs over rate or gain, dimension, horizon and delta; noise is isotropic and Gaussian, so that every method
applies and the exact radius (``experiments.limits``, which shares no code with the package) is the yardstick. The
choice of ``auto`` is set against every other method for the objectives max, final and mean.
"""

from __future__ import annotations

import itertools
import time
from typing import Any

import numpy as np

import certbound as cb
from certbound.errors import CertboundError
from certbound.tubes.objective import make_objective
from certbound.tubes.tube import Tube
from certbound.tubes.tuning import applicable_methods, tube_objective
from experiments.figk1 import constants, label
from experiments.harness import Arrays, Claims, main
from experiments.limits import exact_radius

__all__ = ["compute", "grid"]

SLOW = ("mixture", "exact", "worst_case")
PAPER = ("thm2", "thm3", "prop3", "thm4", "thm5")
OBJECTIVES = ("max", "final", "mean")


def grid(full: bool) -> list[dict[str, Any]]:
    """Cases as in ``experiments.figk1``; an expansion is followed over at most two of its time constants."""
    deltas = (1e-2, 1e-3, 1e-6) if full else (1e-3,)
    flow = itertools.product((-2.0, -0.5, -0.1, 0.0, 0.5), (1, 3, 10) if full else (1, 3), (1.0, 5.0, 50.0), deltas)
    chain = itertools.product((0.1, 0.5, 0.9, 0.99, 1.0, 1.05), (1, 3), (5, 50, 300) if full else (5, 50), deltas)
    cases = [{"rate": c, "n": n, "T": t, "delta": d} for c, n, t, d in flow if c * t <= 2.5]
    return cases + [{"gain": g, "n": n, "T": t, "delta": d} for g, n, t, d in chain if (g - 1) * t <= 2.5]


def tubes(case: dict[str, Any], objective: str, *, slow: bool) -> dict[str, tuple[Tube, float]]:
    """Tube and seconds of every method that applies."""
    known, found = constants(case), {}
    names = ["auto", *applicable_methods(known), *PAPER]
    if slow:
        names += [name for name in SLOW if name != "worst_case" or known.continuous]
    for name in dict.fromkeys(names):
        begin = time.perf_counter()
        try:
            tube = cb.tune_tube(
                known, horizon=case["T"], delta=case["delta"], objective=objective, method=name
            )
        except (ValueError, CertboundError):
            continue  # a theorem whose hypotheses fail, or a level out of reach of a slow method
        found[name] = tube, time.perf_counter() - begin
    return found


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Ratios (case, method), and what they say."""
    cases = grid(full)
    kinds = ("paper", "kummer", "bessel", "auto", *SLOW)
    ratios, seconds = np.full((len(cases), len(kinds)), np.nan), np.full((len(cases), len(kinds)), np.nan)
    excess = 0.0
    for row, case in enumerate(cases):
        kind = {key: case[key] for key in ("rate", "gain") if key in case}
        exact = exact_radius(**kind, n=case["n"], horizon=case["T"], delta=case["delta"])
        for objective in OBJECTIVES:
            found = tubes(case, objective, slow=objective == "max" and (full or row % 6 == 0))
            goal = make_objective(objective, case["T"])
            least = min(tube_objective(tube, goal) for name, (tube, _) in found.items() if name not in (*SLOW, "auto"))
            excess = max(excess, tube_objective(found["auto"][0], goal) / least - 1)
            if objective != "max":
                continue
            for column, name in enumerate(kinds):
                group = [found[m] for m in (PAPER if name == "paper" else (name,)) if m in found]
                if group:
                    ratios[row, column] = min(tube.maximum for tube, _ in group) / exact
                    seconds[row, column] = sum(spent for _, spent in group)
        print(label(case), " ".join(f"{name} {value:.4f}" for name, value in zip(kinds, ratios[row])), flush=True)
    thorough = np.fmin(ratios[:, kinds.index("auto")], np.fmin.reduce(ratios[:, -len(SLOW) :], axis=1))
    tried = np.any(np.isfinite(ratios[:, -len(SLOW) :]), axis=1)
    table = {name: summary(column) for name, column in zip(kinds, ratios.T)}
    table["thorough"] = summary(np.where(tried, thorough, np.nan))
    for name, (worst, median, best, count) in table.items():
        print(f"{name:>12}: worst {worst:.4f}  median {median:.4f}  best {best:.4f}  ({count} cases)")
    claims: Claims = {
        "cases": [label(case) for case in cases], "methods": list(kinds), "table": table, "auto_excess": excess,
        "median_seconds": {name: float(np.nanmedian(column)) for name, column in zip(kinds, seconds.T)},
        "worst_thorough": label(cases[int(np.nanargmax(np.where(tried, thorough, np.nan)))]),
    }  # fmt: skip
    for name in ("paper", "kummer", "auto", "thorough"):
        claims[f"worst_{name}_ratio"], claims[f"median_{name}_ratio"] = table[name][:2]
    return {"ratios": ratios, "thorough": np.where(tried, thorough, np.nan)}, claims


def summary(column: np.ndarray) -> tuple[float, float, float, int]:
    """(worst, median, best, number) of the finite entries."""
    kept = column[np.isfinite(column)]
    return float(kept.max()), float(np.median(kept)), float(kept.min()), len(kept)


if __name__ == "__main__":
    main("tightness", compute)
