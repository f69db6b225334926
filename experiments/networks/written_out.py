"""What a network costs that a model writes out in NumPy, beside `cb.network` of the same weights.

    python -m experiments.networks.written_out [--only 2x64-tanh-discrete ...] [--limit 120] [--repeats 2]

Each row: constants and a verdict by ``auto`` of an oscillator that a network pushes, in a process of its own, the two
forms in turn, so that what else the machine does falls on both. Seconds are of the processor and without imports,
memory is the most that the process held, imports (about 130 MB) included; of repeated runs the least counts.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import certbound as cb
from experiments.certificates import table

CASES = {
    f"2x{width}-{activation}-{kind}": (width, activation, kind)
    for width, activation, kind in (
        (16, "tanh", "discrete"), (64, "tanh", "discrete"), (128, "tanh", "discrete"), (16, "tanh", "continuous"),
        (64, "tanh", "continuous"), (128, "tanh", "continuous"), (64, "relu", "discrete"), (64, "sigmoid", "discrete"),
        (64, "relu", "continuous"), (64, "sigmoid", "continuous"),
    )
}  # fmt: skip
"""Two hidden layers as wide as said."""
FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "tanh": np.tanh, "relu": lambda v: np.maximum(0, v), "sigmoid": lambda v: 1 / (1 + np.exp(-v)),
}  # fmt: skip
FORMS = ("written", "called")
STEPS = 100


def policy(width: int, activation: str, form: str) -> Callable[[Any], Any]:
    """The same weights, written out or called."""
    rng, f = np.random.default_rng(width), FUNCTIONS[activation]
    sizes = list(itertools.pairwise((2, width, width, 1)))
    weights = [rng.normal(size=(p, k)) / math.sqrt(k) for k, p in sizes]
    bias = [0.1 * rng.normal(size=p) for _, p in sizes]
    if form == "called":
        named = [activation, activation, "linear"]
        return cb.network([{"weights": w, "bias": b, "activation": a} for w, b, a in zip(weights, bias, named)])
    (w1, w2, w3), (b1, b2, b3) = weights, bias
    return lambda z: w3 @ f(w2 @ f(w1 @ z + b1) + b2) + b3


def problem(width: int, activation: str, kind: str, form: str) -> cb.Problem:
    """A damped oscillator, 100 steps of 0.05 s or 5 s, in a box."""
    push = policy(width, activation, form)

    def rates(x: Any) -> Any:
        return np.array([x[1], -3.0 * x[0] - 1.5 * x[1] + 0.3 * push(x)[0]])

    h, noise = 0.05, np.array([0.005, 0.02])
    asked: dict[str, Any] = {
        "initial": cb.Box([0.05, -0.01], [0.06, 0.01]), "safe": [cb.Inside(cb.Box([-0.5, -0.9], [0.5, 0.9]))],
        "delta": 1e-3, "domain": cb.Box([-1.0, -2.0], [1.0, 2.0]),  # slopes of wide networks are not bounded on R^n
    }  # fmt: skip
    if kind == "continuous":
        system: Any = cb.ContinuousSystem(rates, states=["x", "v"], diffusion=np.diag(noise))
        return cb.Problem(system, horizon=h * STEPS, **asked)
    spread = cb.Gaussian(std=noise * math.sqrt(h))
    system = cb.DiscreteSystem(lambda x: x + h * rates(x), states=["x", "v"], noise=spread)
    return cb.Problem(system, horizon=STEPS, **asked)


def measured(name: str, form: str, limit: float) -> dict[str, Any]:
    """In this process: processor seconds of the model, the constants and the verdict, and megabytes."""
    seconds = [time.process_time()]
    made = problem(*CASES[name], form)
    seconds.append(time.process_time())
    constants = cb.bound_constants(made)
    seconds.append(time.process_time())
    verdict = cb.verify_safety(made, time_limit=limit)
    seconds.append(time.process_time())
    return {
        "seconds": [b - a for a, b in itertools.pairwise(seconds)], "nodes": len(made.closed_loop.nodes),
        "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, "slope": constants.worst_slope,
        "status": verdict.status, "log10_delta": verdict.log10_delta, "method": verdict.method,
    }  # fmt: skip


def compared(name: str, limit: float, repeats: int) -> list[str]:
    """A row: the two forms in turn, in fresh processes."""
    runs: dict[str, list[dict[str, Any]]] = {form: [] for form in FORMS}
    for _, form in itertools.product(range(repeats), FORMS):
        command = [sys.executable, "-m", __spec__.name, "--measure", name, form, "--limit", str(limit)]
        said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        runs[form].append(json.loads(said.splitlines()[-1]))
    time_of = {form: min(sum(run["seconds"]) for run in runs[form]) for form in FORMS}
    memory = {form: min(run["megabytes"] for run in runs[form]) for form in FORMS}
    cells = [name]
    for form in FORMS:
        best = min(runs[form], key=lambda run: sum(run["seconds"]))
        parts = " + ".join(f"{part:.2f}" for part in best["seconds"])
        cells += [parts, f"{memory[form]:.0f}", f"{best['status']} {best['log10_delta']:.4f} ({best['method']})"]
    return [*cells, *(f"{of['written'] / of['called']:.2f}" for of in (time_of, memory))]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.networks.written_out")
    parser.add_argument("--only", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--limit", type=float, default=120.0, help="seconds for a verdict")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--measure", nargs=2, metavar=("CASE", "FORM"), help="one of them, in this process")
    options = parser.parse_args()
    if options.measure:
        sys.stdout.write(json.dumps(measured(*options.measure, options.limit)) + "\n")
        return
    head = ["network", *(f"{form} {what}" for form in FORMS for what in ("s", "MB", "answer")), "time", "memory"]
    rows = [head, *(compared(name, options.limit, options.repeats) for name in options.only)]
    sys.stdout.write("\n".join(table(rows)) + "\n")


if __name__ == "__main__":
    main()
