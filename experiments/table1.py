"""Table I: which theorem the paper picks in each case, with its radius on an example beside certbound's choice."""

from __future__ import annotations

from typing import Any

import numpy as np

import certbound as cb
from experiments.harness import Arrays, Claims, main
from experiments.limits import exact_radius

DELTA = 1e-3
ROWS: tuple[dict[str, Any], ...] = (
    {"case": "CT, not contracting", "example": "c = 1, T = 2", "pick": "thm2", "rate": 1.0, "horizon": 2.0},
    {"case": "CT, contracting", "example": "c = -0.5, T = 5", "pick": "thm3", "rate": -0.5, "horizon": 5.0},
    {"case": "DT, not contracting", "example": "L = 1.1, T = 20", "pick": "thm4", "gain": 1.1, "horizon": 20},
    {"case": "DT, contracting", "example": "L = 0.9, T = 50", "pick": "thm5", "gain": 0.9, "horizon": 50},
)
PAPER = {"CT": ("thm2", "thm3"), "DT": ("thm4", "thm5")}


def compute(full: bool) -> tuple[Arrays, Claims]:
    """One row a case: largest radius of the pick at eps = 15/16 and at its best, of certbound, and the limit."""
    rows, right = [], []
    for row in ROWS:
        kind = {key: row[key] for key in ("rate", "gain") if key in row}
        known = cb.Constants(**kind, sigma=1.0, dimension=1, isotropic=True)
        common = {"horizon": row["horizon"], "delta": DELTA}
        fixed: dict[str, Any] = {"epsilon": 15 / 16}
        if row["pick"] in ("thm3", "thm5"):
            fixed["step"] = 0.05 if known.continuous else 1
        reading = cb.tune_tube(known, **common, method=row["pick"], **fixed).maximum
        picked = cb.tune_tube(known, **common, method=row["pick"]).maximum
        chosen = cb.tune_tube(known, **common)
        exact = exact_radius(**kind, n=1, **common)
        rows.append([reading, picked, chosen.maximum, exact])
        right.append(picked <= min(_others(known, common, row["case"][:2])) * (1 + 1e-9))
        row["method"] = chosen.method
    claims: Claims = {
        "cases": [row["case"] for row in ROWS],
        "examples": [row["example"] for row in ROWS],
        "picks": [row["pick"] for row in ROWS],
        "methods": [row["method"] for row in ROWS],
        "pick_is_best": right,
        "radii": rows,
        "largest_ratio": float(max(row[2] / row[3] for row in rows)),
    }
    return {"radii": np.array(rows)}, claims


def _others(known: cb.Constants, common: dict[str, Any], kind: str) -> list[float]:
    """Largest radii of the paper's two theorems for this kind of time, where they apply."""
    found = []
    for method in PAPER[kind]:
        try:
            found.append(cb.tune_tube(known, **common, method=method).maximum)
        except ValueError:
            continue  # Theorems 3 and 5 need contraction
    return found


if __name__ == "__main__":
    main("table1", compute)
