"""Problems of the literature, word for word as far as they can be stated: the files in ``experiments/literature``.

Where tools have different problems under one name, each has its own file. Those of LUCID are in its own format.

Each is verified as it stands, and simulated; the page of benchmarks has them beside what was published.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from pathlib import Path

import certbound as cb
from certbound.display import log10_text
from certbound.watch import Watch

__all__ = [
    "ENDS", "FOLDER", "LIMIT", "LITERATURE", "PATHS", "literature_row", "measured", "path_of", "processor_clock",
    "simulated",
]  # fmt: skip

FOLDER = Path(__file__).parent / "literature"
PATHS = 200_000
LIMIT = 10.0  # seconds of search, of processor time
ENDS = {
    "gbm_target": 10, "linear_sys": 100, "walk": 300, "collision": 100, "pendulum_rasm": 100,
    **dict.fromkeys(("patrol_impact", "patrol_julia", "vehicle_impact", "vehicle_julia"), 200),
    **dict.fromkeys(("delivery_impact", "delivery_julia", "delivery_syscore"), 200),
    **dict.fromkeys(("van_der_pol_arch", "van_der_pol_impact"), 500),
}  # fmt: skip
"""Horizons of the simulations where the problem has none."""

LITERATURE = {
    "halfdisc_sde": "moment-SOS, order 6: <= .302",
    "halfdisc_sde_disc": "moment-SOS, order 6: <= .557; missing: closer bounds beside walls where a velocity alone is "
    "noisy",
    "halfdisc_steps": "moment-SOS, order 6: <= 6.5e-4",
    "halfdisc_steps_disc": "moment-SOS, order 6: <= .402",
    "santoyo": "sums of squares, degree 14: a curve, no table",
    "neural_barrier": "a table that was not readable",
    "population": "a table that was not readable",
    "polynomial_4d": "none found",
    "gbm_target": "neural supermartingale: <= .1 in 96 to 429 s; then stayed in: not stated here, a path that has just "
    "entered leaves again",
    "linear_sys": "neural supermartingale: <= 1e-6 in 105 s (GPU), of a network; here a saturated linear policy",
    "two_link": "neural supermartingale: <= .2 in 5 to 24 h (GPU), of a network, which cannot be stated; here a "
    "saturated linear policy; missing: an engine for four states and kinks from so wide a set of starts",
    "walk": "linear templates: <= 1e-4; that S <= 100 also holds after the arrival is left out",
    "pendulum_rasm": "neural supermartingale: <= 1e-6 in 138 s (GPU), of a network; here a saturated linear policy",
    "collision": "neural supermartingale: <= 1e-6 in 137 s (GPU), of a network; here a saturated linear policy",
    "triple_integrator": "neural supermartingale: <= .05 (a threshold), of a network; here a saturated linear policy "
    "and 100 steps",
    "patrol_impact": "times of a synthesis only; here start and policy of our own",
    "patrol_julia": "the same, with 10 for 2 and other sets",
    "delivery_impact": "none found; here the second leg, start and policy of our own",
    "delivery_julia": "the same, with ten times the variance and inputs without bounds",
    "delivery_syscore": "the same, with ten times the variance and other matrices",
    "van_der_pol_arch": "none found; here the target is met once, not again and again; missing: cells as small as this "
    "noise in so wide a box, or starts in parts that arrive at times of their own",
    "van_der_pol_impact": "the same, with (1 - x)^2 for 1 - x^2 and other noise",
    "vehicle_impact": "IMPaCT: 286 s of synthesis; here start and policy of our own",
    "vehicle_julia": "the same, without x + 0.1 times the rest",
    "lucid_linear": "LUCID: none found",
    "lucid_barrier2": "LUCID: a table that was not readable",
    "lucid_barrier3": "LUCID: a table that was not readable",
}


def path_of(name: str) -> Path:
    """The file of a problem."""
    found = FOLDER / f"{name}.toml"
    return found if found.exists() else found.with_suffix(".yaml")


def literature_row(name: str) -> list[str]:
    """Answer, proved bounds, simulated share of failures, time, and the published numbers of one problem."""
    problem = cb.load(path_of(name))
    status, proved, least, seconds = measured(problem)
    ended = problem.replace(horizon=ENDS[name]) if math.isinf(problem.horizon) else problem
    shown = [status, proved, least, *simulated(ended), seconds]
    return [f"`{name}`", f"{problem.delta:g}", *shown, LITERATURE[name]]


def measured(problem: cb.Problem) -> list[str]:
    """Answer, proved bounds from both sides, and seconds of processor time."""
    begun = time.process_time()
    with processor_clock():
        verdict = cb.verify_safety(problem, time_limit=LIMIT)
    seconds = time.process_time() - begun
    least = "" if verdict.log10_lower is None else log10_text(verdict.log10_lower)
    return [verdict.status, log10_text(verdict.log10_delta), least, f"{seconds:.1f}"]


def simulated(problem: cb.Problem) -> list[str]:
    """The share of failures among ``PATHS`` paths, and limits of the probability at 99 % confidence."""
    counts = cb.simulate_exits(problem, paths=PATHS, rng=0)
    return [f"{counts.probability:.2g}", f"{counts.lower:.2g} to {counts.upper:.2g}"]


@contextlib.contextmanager
def processor_clock() -> Iterator[None]:
    """Limits of time count seconds of this process in the block, so that answers do not depend on other work."""
    defaults = Watch.__init__.__kwdefaults__
    before = defaults["clock"]
    defaults["clock"] = time.process_time
    try:
        yield
    finally:
        defaults["clock"] = before
