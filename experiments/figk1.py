"""Fig. K1: how close each tube comes to the exact constant radius, over rate, dimension, horizon and delta."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

import certbound as cb
from experiments.harness import Arrays, Claims, main
from experiments.limits import exact_radius

CASES: tuple[dict[str, Any], ...] = (
    {"rate": -0.5, "n": 1, "T": 5.0, "delta": 1e-3},
    {"rate": -1.0, "n": 1, "T": 5.0, "delta": 1e-6},
    {"rate": -0.5, "n": 6, "T": 5.0, "delta": 1e-3},
    {"rate": -1.0, "n": 3, "T": 500.0, "delta": 1e-4},
    {"rate": 0.0, "n": 1, "T": 2.0, "delta": 1e-3},
    {"gain": 0.9999, "n": 1, "T": 2000, "delta": 1e-2},
    {"gain": 0.99, "n": 1, "T": 2000, "delta": 1e-2},
    {"gain": 0.9, "n": 3, "T": 200, "delta": 1e-3},
    {"gain": 0.5, "n": 1, "T": 100, "delta": 1e-3},
)
METHODS = ("printed", "reading", "paper", "kummer", "auto")
BASE: dict[str, Any] = {"rate": -0.5, "n": 1, "T": 5.0, "delta": 1e-3}
SWEEPS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "n": ((1, 3, 10, 30), (1, 2, 3, 6, 10, 20, 40)),
    "T": ((0.1, 1.0, 10.0, 100.0), (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)),
    "delta": ((1e-1, 1e-3, 1e-6, 1e-9), tuple(10.0**-k for k in range(1, 13))),
}


def constants(case: dict[str, Any]) -> cb.Constants:
    """Isotropic noise of unit level."""
    kind = {key: case[key] for key in ("rate", "gain") if key in case}
    return cb.Constants(**kind, sigma=1.0, dimension=int(case["n"]), isotropic=True)


def largest(case: dict[str, Any], method: str) -> float:
    """The largest radius over the horizon by one of METHODS."""
    known = constants(case)
    steps = {"horizon": case["T"], "delta": case["delta"]}
    contracting = case.get("rate", 0.0) < 0 or case.get("gain", 1.0) < 1
    table = ("thm3" if contracting else "thm2") if known.continuous else ("thm5" if contracting else "thm4")
    if method in ("printed", "reading"):
        fixed: dict[str, float] = {"epsilon": 1 / 16 if method == "printed" else 15 / 16}
        if contracting:
            fixed["step"] = min(0.05, case["T"]) if known.continuous else 1
        return float(cb.tune_tube(known, **steps, method=table, **fixed).maximum)
    name = {"paper": table}.get(method, method)
    return float(cb.tune_tube(known, **steps, method=name).maximum)


def ratios(case: dict[str, Any]) -> list[float]:
    """Largest radius of each of METHODS over the exact limit."""
    kind = {key: case[key] for key in ("rate", "gain") if key in case}
    exact = exact_radius(**kind, n=int(case["n"]), horizon=case["T"], delta=case["delta"])
    return [largest(case, method) / exact for method in METHODS]


def compute(full: bool) -> tuple[Arrays, Claims]:
    """The table of cases, and three sweeps around its first row."""
    table = np.array([ratios(case) for case in CASES])
    arrays: Arrays = {"table": table}
    for name, (quick, whole) in SWEEPS.items():
        values = whole if full else quick
        arrays[f"{name}_values"] = np.array(values)
        arrays[f"{name}_ratios"] = np.array([ratios({**BASE, name: value}) for value in values])
    claims: Claims = {
        "cases": [label(case) for case in CASES],
        "methods": list(METHODS),
        "kummer": [float(value) for value in table[:, METHODS.index("kummer")]],
        "auto": [float(value) for value in table[:, METHODS.index("auto")]],
        "paper": [float(value) for value in table[:, METHODS.index("paper")]],
        "reading": [float(value) for value in table[:, METHODS.index("reading")]],
        "printed": [float(value) for value in table[:, METHODS.index("printed")]],
        "worst_auto": float(table[:, METHODS.index("auto")].max()),
        "below_one": int(np.sum(table < 1 - 2e-4)),
        "auto_never_worse": bool(np.all(table[:, METHODS.index("auto")] <= table[:, METHODS.index("paper")] * 1.0001)),
    }
    return arrays, claims


def label(case: dict[str, Any]) -> str:
    """A case in a few signs."""
    start = f"c={case['rate']:g}" if "rate" in case else f"L={case['gain']:g}"
    return f"{start}, n={case['n']}, T={case['T']:g}, 1e{round(math.log10(case['delta']))}"


if __name__ == "__main__":
    main("figk1", compute)
