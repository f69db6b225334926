"""Random problems with a target, one and two states, discrete and continuous time: both bounds beside the truth.

    python -m tests.safety.reach_avoid [first] [last] [seconds]

Of every seed one problem is drawn whose probability of failing lies between .005 and .9 (simulated from the corners and
the middle of its starts, the worst of them), kind by kind in turn. The verdict is asked at delta = that probability,
which neither bound can settle; where the noise-free path fails, value functions are asked by themselves. Seconds are
those of the processor.
"""

from __future__ import annotations

import itertools
import sys
import time

import numpy as np

import certbound as cb
from certbound.safety.answers import EngineAnswer, Request
from certbound.safety.engines import values_engine
from certbound.watch import Watch
from experiments.literature import processor_clock
from tests.values.random_goals import GRANTED, targets

KINDS = {"flow 1": (1, 0.0), "steps 1": (1, 0.2), "flow 2": (2, 0.0), "steps 2": (2, 0.2)}
RANGE = 0.005, 0.9
PATHS, ROUGH, FINELY = 100_000, 4_000, 1000


def truth_of(problem: cb.Problem, paths: int) -> tuple[float, float, float]:
    """The share of failing paths from the worst of some starts, and its limits at 99.99 %."""
    box = problem.initial
    ends = [sorted({low, high, (low + high) / 2}) for low, high in zip(box.low, box.high)]
    more = {"steps": FINELY} if problem.system.time == "continuous" else {}
    found = []
    for place in itertools.product(*ends):
        counts = cb.simulate_exits(problem.replace(initial=place), paths=paths, rng=1, confidence=0.9999, **more)
        found.append((counts.probability, counts.lower, counts.upper))
    return max(found)


def drawn(seed: int) -> tuple[str, cb.Problem, tuple[float, float, float]]:
    """The kind of a seed's problem, the problem, and the truth with its limits."""
    rng = np.random.default_rng([seed, 78])
    kind = list(KINDS)[seed % len(KINDS)]
    while True:
        problem = targets(rng, *KINDS[kind])
        starts = problem.initial
        corners = np.array(list(itertools.product(*zip(starts.low, starts.high))))
        if problem.reach.region.contains(corners).any():
            continue
        if RANGE[0] <= truth_of(problem, ROUGH)[0] <= RANGE[1]:
            return kind, problem, truth_of(problem, PATHS)


def _asked(problem: cb.Problem, seconds: float) -> cb.Verdict | EngineAnswer:
    """What a verdict says, or the value functions alone where the noise-free path fails and settles the verdict."""
    found = cb.verify_safety(problem, time_limit=seconds)
    if found.status != "UNSAFE_NOMINAL":
        return found
    with Watch(seconds).running():
        return values_engine(problem, Request(effort=max(seconds / 20, 1.0)))


def check(seed: int, seconds: float) -> tuple[str, float, float, str]:
    """The kind, upper bound over lower one (over the truth if there is none) and over the truth, and a line."""
    kind, problem, (truth, least, most) = drawn(seed)
    begun = time.process_time()
    with processor_clock():
        found = _asked(problem.replace(delta=truth), seconds)
    spent = time.process_time() - begun
    upper, lower = 10**found.log10_delta, 0.0 if found.log10_lower is None else 10**found.log10_lower
    granted = GRANTED * truth if problem.system.time == "continuous" else 0.0
    bad = upper < least - granted or lower > most + granted
    words = f"{lower:.4g} <= {truth:.4g} <= {upper:.4g}, upper / truth {upper / truth:.3f}"
    words += f", upper / lower {upper / lower:.3f}" if lower else ", no lower bound"
    line = f"{'DEFECT ' if bad else ''}{kind} {seed}: {words}, {found.method or '-'}, {spent:.1f} s"
    return kind, upper / (lower or truth), upper / truth, line


def main() -> None:
    """A line a problem, and the medians, of all kinds and of each."""
    first, last, seconds = (*sys.argv[1:], *("0", "30", "20")[len(sys.argv) - 1 :])
    rows = []
    for seed in range(int(first), int(last)):
        rows.append(check(seed, float(seconds)))
        sys.stdout.write(rows[-1][3] + "\n")
        sys.stdout.flush()
    for name in (*KINDS, ""):
        some = [row[1:3] for row in rows if row[0].startswith(name)]
        if some:
            medians = " and ".join(f"{value:.3f}" for value in np.median(some, axis=0))
            words = f"upper / lower (truth where there is none), and upper / truth: medians {medians}"
            sys.stdout.write(f"{name or 'all'}, {len(some)}: {words}\n")


if __name__ == "__main__":
    main()
