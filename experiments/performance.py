"""How tight and how fast: measures, and writes docs/performance.md and docs/benchmarks.md.

``python -m experiments.performance`` takes some minutes. Times are seconds of processor time of this process, so that
other work on the machine does not count.
"""

from __future__ import annotations

import argparse
import datetime
import functools
import math
import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import certbound as cb
from certbound.display import log10_text
from experiments.limits import exact_radius
from experiments.literature import LIMIT, LITERATURE, PATHS, literature_row, measured, simulated
from experiments.peers import peer_rows

__all__ = ["BENCHMARKS", "benchmark_row", "equal_strength", "machine", "main", "power", "table"]

ROOT = Path(__file__).resolve().parents[1]
CONFIDENCE = 0.99
DELTAS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-9)
DIMENSIONS = (1, 2, 5, 10, 20)
MASSES = (3, 5, 10)
PROBLEMS = ("ou", "pendulum", "unicycle", "chain_rest", "chain")
BENCHMARKS = {
    "two_tanks": "PRoTECT: safe with 0.99999988 in 1.2 s (commercial solver; its free one fails)",
    "room_3d": "PRoTECT: safe with 0.999999997 in 29 s",
    "room_1d": "PRoTECT: safe with > 0.99999 in 0.2-0.3 s, with jumps that are left out here",
    "van_der_pol_dt": "PRoTECT: safe with 0.88 in 15 s, not counting paths that leave the domain",
    "oscillator_cubic": "PRoTECT: safe with 0.72 (degree 6, 1.7 s)",
    "contraction_14d": "IMPaCT: 987 s; StocHy: more than a day",
    "ou_radius": "the paper, eq. (R >=): radius 1.3208 at delta = 1e-3",
}
PEER_HEADING = ["tool", "how it is installed", "what it says of these problems", "on this machine"]
HEAD = "*Written by `python -m experiments.performance` on {date}, {machine}, certbound {version}.*\n"

Rows = list[list[str]]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.performance")
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder of the two pages (default: docs)")
    parser.add_argument("--page", choices=("benchmarks", "performance"), help="only this page (default: both)")
    parser.add_argument("--compare", action="store_true", help="only print what other tools answer on this machine")
    options = parser.parse_args()
    if options.compare:
        print(table(PEER_HEADING, peer_rows()))
        return
    head = HEAD.format(date=datetime.date.today().isoformat(), machine=machine(), version=cb.__version__)
    for name, write in {"benchmarks": _benchmarks, "performance": _performance}.items():
        if options.page in (None, name):
            (options.out / f"{name}.md").write_text(write(head), encoding="utf-8")


# ---- pages -------------------------------------------------------------------------------------------------------


def _performance(head: str) -> str:
    tightness = table(
        ["delta", "Theorem 3, tuned", "Kummer (K1)", "mixture (K3)", "exact tube", "exact radius"], _tightness()
    )
    dimensions = table(["states", "Theorem 3, tuned", "Kummer (K1)", "exact radius", "seconds (Kummer)"], _dimensions())
    masses = table(["masses", "states", "gain", "seconds (constants)", "verdict", "proved", "seconds"], _masses())
    heading = [
        "problem", "verdict", "proved: P <=", "seconds", "paths of equal strength", "path-steps / s", "their time",
    ]  # fmt: skip
    against = table(heading, _against_simulation())
    return f"""# Performance

{head}
Times are seconds of processor time.

## How tight the tubes are

The largest radius over the horizon for `ou` (rate -0.5, sigma^2 = 0.1, 5 s) in one dimension, divided by the constant
radius that is left with probability exactly delta (the last column; a first-passage calculation that shares no code
with the package). The exact tube is that radius, certified.

{tightness}

## A proof against a simulation of equal strength

A simulation without a single exit supports P <= p at {100 * CONFIDENCE:g} % confidence after
log(2/{1 - CONFIDENCE:.2g})/p paths. The last column is the time that the simulator of certbound would need for that
many on all cores, at the speed measured here; the proof uses one core. (The simulation would then have said something
about one law of starts, one kind of disturbance and the model in discrete steps; the proof speaks of every start, every
disturbance and continuous time.)

{against}

Against the published times of other tools: [the benchmarks](benchmarks.md).

## How it grows with the dimension

The same ratios for dX = -X/2 dt + 0.1^0.5 dW in n dimensions, 5 s, delta = 1e-3:

{dimensions}

The chain of masses at rest (`chain_rest`), with 2 states a mass: constants with a metric from semidefinite programs,
and the whole verdict.

{masses}
"""


def _benchmarks(head: str) -> str:
    rows = [benchmark_row(name) for name in BENCHMARKS]
    heading = [
        "problem", "asked", "answer", "proved: P <=", ">=", "simulated", "its 99 % limits", "seconds", "published",
    ]  # fmt: skip
    found = table(heading, rows)
    stated = table([*heading[:-1], "published: P(failing)"], [literature_row(name) for name in LITERATURE])
    return f"""# Benchmarks of other tools

{head}
Each problem is a file in `experiments/benchmarks/`, with its source in a comment; run one with
`certbound verify experiments/benchmarks/room_3d.toml`. The published numbers are those of the tools' own papers, on
their machines and with their solvers. Where the true probability of leaving is large the right answer is UNSAFE, or
UNKNOWN with what could be proved. Leaving the model's domain counts as leaving here, and does not there. Every search
has {LIMIT:g} seconds of processor time. `simulated` is the share of failures in {PATHS} paths, whose starts are drawn
from the set; what is proved holds for the worst of them. `>=` is what is proved from below, where something is.

{found}

- `contraction_14d`: the true probability of staying is 0.840 for one step; SAFE at delta = 0.01 would be wrong.
- `van_der_pol_dt`: from the corner (5, 5) the noise-free next state (5.5, -7.5) lies outside the domain, which is what
  is proved from below; most starts of the set are safe.
- `oscillator_cubic`: about 2e-5 of simulated runs fail; a polynomial barrier proves it safe, where the linear response
  and the constants prove nothing.

## Word for word

The files in `experiments/literature/` state published problems as they were asked, as far as certbound can: targets,
unions of starts, infinite horizons, noise that multiplies the state, domains whose leaving ends a path. Simulations of
an infinite horizon end after some hundred steps. Where tools have different problems under one name (four of ARCH),
each has its own file, and its comment says what differs; those of LUCID are in [its own format](how-to/other-tools.md).

{stated}

What cannot be stated: the anaesthesia of ARCH (modes that are drawn, and a specification that its authors call
unfinished), the overtaking of LUCID (samples without equations), the pendulum, unicycle, cart-pole and aircraft of
StochasticBarrier.jl (bounds of the dynamics in NetCDF files), and the policies of the neural tools, whose weights are
not in a file of [the formats that are read](how-to/networks.md): those problems have a saturated linear policy here.

## Other tools on your machine

`python -m experiments.performance --compare` says which of them pip brings, and asks those that are installed.

{table(PEER_HEADING, peer_rows())}
"""


# ---- measurements ------------------------------------------------------------------------------------------------


def _timed(function: Callable[[], Any]) -> tuple[Any, float]:
    started = time.process_time()
    return function(), time.process_time() - started


def _radii(constants: cb.Constants, delta: float, methods: Sequence[str]) -> Iterator[float]:
    for method in methods:
        yield cb.tune_tube(constants, horizon=5.0, delta=delta, method=method).maximum


def _tightness() -> Iterator[list[str]]:
    constants = cb.Constants(rate=-0.5, sigma=0.1**0.5, dimension=1, isotropic=True)
    for delta in DELTAS:
        exact = exact_radius(rate=-0.5, n=1, horizon=5.0, delta=delta, sigma=0.1**0.5)
        found = _radii(constants, delta, ("thm3", "kummer", "mixture", "exact"))
        yield [f"{delta:g}", *(f"{radius / exact:.3f}" for radius in found), f"{exact:.4f}"]


def _dimensions() -> Iterator[list[str]]:
    for n in DIMENSIONS:
        constants = cb.Constants(rate=-0.5, sigma=0.1**0.5, dimension=n, isotropic=True)
        (kummer,), seconds = _timed(lambda: list(_radii(constants, 1e-3, ("kummer",))))  # noqa: B023  (used at once)
        exact = exact_radius(rate=-0.5, n=n, horizon=5.0, delta=1e-3, sigma=0.1**0.5)
        ratios = (f"{radius / exact:.3f}" for radius in (*_radii(constants, 1e-3, ("thm3",)), kummer))
        yield [str(n), *ratios, f"{exact:.4f}", f"{seconds:.2f}"]


def _masses() -> Iterator[list[str]]:
    for count in MASSES:
        problem = cb.load("chain_rest", masses=count)
        constants, first = _timed(lambda: cb.bound_constants(problem))  # noqa: B023  (used at once)
        verdict, second = _timed(lambda: cb.verify_safety(problem))  # noqa: B023
        gain = f"{float(np.max(constants.gain)):.4f}"
        row = [str(count), str(2 * count), gain, f"{first:.1f}", verdict.status, log10_text(verdict.log10_delta)]
        yield [*row, f"{second:.1f}"]


def _against_simulation() -> Iterator[list[str]]:
    for name in PROBLEMS:
        problem = cb.load(name)
        verdict, seconds = _timed(lambda: cb.verify_safety(problem))  # noqa: B023  (used at once)
        cb.simulate_exits(problem, paths=100, rng=np.random.default_rng(1))  # compiles
        simulate = functools.partial(cb.simulate_exits, problem, paths=100_000, rng=np.random.default_rng(1))
        counts, spent = _timed(simulate)
        rate = counts.paths * counts.steps / spent * (os.cpu_count() or 1)
        paths = equal_strength(verdict.log10_delta)
        needed = paths + math.log10(counts.steps / rate)
        row = [f"`{name}`", verdict.status, log10_text(verdict.log10_delta), f"{seconds:.1f}", power(paths)]
        row.append(f"{rate:.2g}")
        yield [*row, _duration(needed)]


def benchmark_row(name: str) -> list[str]:
    """Answer, proved and simulated probabilities, time and the published numbers of one benchmark."""
    problem = cb.load(ROOT / "experiments" / "benchmarks" / f"{name}.toml")
    status, proved, least, seconds = measured(problem)
    shown = [status, proved, least, *simulated(problem), seconds]
    return [f"`{name}`", f"{problem.delta:g}", *shown, BENCHMARKS[name]]


def equal_strength(log10: float) -> float:
    """log10 of the number of paths without exit after which P <= 10**log10 is supported at the confidence."""
    return math.log10(math.log(2 / (1 - CONFIDENCE))) - log10


# ---- text --------------------------------------------------------------------------------------------------------


def power(log10: float) -> str:
    """A positive number given by its logarithm, in two digits, also where no float holds it."""
    if -2 < log10 < 4:
        return f"{10**log10:.2g}"
    exponent = math.floor(log10)
    return f"{10 ** (log10 - exponent):.1f}e{exponent}"


def _duration(log10_seconds: float) -> str:
    for unit, seconds in (("years", 3.156e7), ("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if log10_seconds > math.log10(2 * seconds):
            return f"{power(log10_seconds - math.log10(seconds))} {unit}"
    return f"{power(log10_seconds)} s"


def table(heading: Sequence[str], rows: Iterator[list[str]] | Rows) -> str:
    """A Markdown table."""
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def machine() -> str:
    """Processor, cores and Python, without names of computers or people."""
    name = platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = [line for line in cpuinfo.read_text(encoding="utf-8").splitlines() if line.startswith("model name")]
        name = lines[0].partition(":")[2].strip() if lines else name
    return f"{os.cpu_count()} cores ({name}), Python {platform.python_version()}"


if __name__ == "__main__":
    main()
