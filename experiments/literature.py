"""Problems of the literature, word for word as far as they can be stated: the files in ``experiments/literature``.

Each is verified as it stands, and simulated; the page of benchmarks has them beside what was published.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import certbound as cb
from certbound.display import log10_text

__all__ = ["ENDS", "FOLDER", "LITERATURE", "PATHS", "literature_row"]

FOLDER = Path(__file__).parent / "literature"
PATHS = 200_000
LIMIT = 120.0  # seconds on the clock
ENDS = {"gbm_target": 10, "linear_sys": 100, "walk": 300}
"""Horizons of the simulations where the problem has none."""

LITERATURE = {
    "halfdisc_sde": "moment-SOS, order 6: <= .302",
    "halfdisc_sde_disc": "moment-SOS, order 6: <= .557",
    "halfdisc_steps": "moment-SOS, order 6: <= 6.5e-4",
    "halfdisc_steps_disc": "moment-SOS, order 6: <= .402",
    "santoyo": "sums of squares, degree 14: a curve, no table; what is missing here: noise in one coordinate without a "
    "box around both",
    "neural_barrier": "a table that was not readable",
    "population": "a table that was not readable",
    "polynomial_4d": "none found",
    "gbm_target": "neural supermartingale: <= .1 in 96 to 429 s; then stayed in: not stated here, a path that has just "
    "entered leaves again",
    "linear_sys": "neural supermartingale: <= 1e-6 in 105 s (GPU), of a network; here a saturated linear policy",
    "two_link": "neural supermartingale: <= .2 in 5 to 24 h (GPU), of a network, which cannot be stated; the linear "
    "policy here does not arrive",
    "walk": "linear templates: <= 1e-4; that S <= 100 also holds after the arrival is left out",
}


def literature_row(name: str) -> list[str]:
    """Answer, proved bounds, simulated share of failures, time, and the published numbers of one problem."""
    problem = cb.load(FOLDER / f"{name}.toml")
    begun = time.process_time()
    verdict = cb.verify_safety(problem, time_limit=LIMIT)
    seconds = time.process_time() - begun
    ended = problem.replace(horizon=ENDS[name]) if math.isinf(problem.horizon) else problem
    counts = cb.simulate_exits(ended, paths=PATHS, rng=0)
    least = "" if verdict.log10_lower is None else log10_text(verdict.log10_lower)
    shown = [verdict.status, log10_text(verdict.log10_delta), least, f"{counts.probability:.2g}"]
    return [f"`{name}`", f"{problem.delta:g}", *shown, f"{seconds:.1f}", LITERATURE[name]]
