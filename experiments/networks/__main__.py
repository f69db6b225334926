"""What is proved with networks, and what it costs: the rows of docs/how-to/networks.md.

    python -m experiments.networks FOLDER [--only linear-sys-tanh64 ...]    policies: verdict, certificate, check
    python -m experiments.networks FOLDER --enclosures --gains              ranges against CROWN's, Lipschitz constants

Policies that are not in the folder are trained there first. Seconds are of the processor, memory is the most that this
process has held so far.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import certbound as cb
from certbound.arrays import Array
from certbound.checker import check_data, parse
from certbound.constants import bound_network_gain
from certbound.problem.model.network_rows import weights_of
from certbound.rigor.intervals import Interval
from certbound.rigor.layers import bound_network
from certbound.safety.certificate import problem_data
from experiments.certificates import table
from experiments.networks.crown import crown
from experiments.networks.training import POLICIES, write

NETWORKS, BOXES, POINTS, GAINS = 50, 200, 100, 20
HEAD = ("policy", "nodes", "status", "log10 P", "prover s", "writer s", "checker s", "check", "another bit", "MB")


def random_network(seed: int, activation: str, sizes: tuple[int, ...]) -> Any:
    """A network with normal weights, as wide at its outputs as at its inputs."""
    rng = np.random.default_rng(seed)
    rows = [
        {"weights": rng.normal(size=(p, k)) * 1.5 / np.sqrt(k), "bias": rng.normal(size=p) * 0.3,
         "activation": activation} for k, p in itertools.pairwise(sizes)
    ]  # fmt: skip
    rows[-1]["activation"] = "linear"
    return cb.network(rows)


def policies(folder: Path, names: list[str]) -> Iterator[list[str]]:
    """A row for every policy: its verdict by the linear response, its certificate, and another problem's."""
    for task, activation, width in POLICIES:
        name = f"{task}-{activation}{width}"
        if names and name not in names:
            continue
        path = folder / f"{name}.toml"
        problem = cb.load(path if path.exists() else write(folder, task, width=width, activation=activation))
        seconds = [time.process_time()]
        verdict = cb.verify_safety(problem, method="linear", time_limit=600.0)
        seconds.append(time.process_time())
        given = problem_data(problem)
        data = parse(verdict.certificate_text(problem))
        seconds.append(time.process_time())
        report = check_data(data, given, seconds=1800.0)
        seconds.append(time.process_time())
        tape = problem.closed_loop if problem.hold is None else problem.plan
        yield [
            name, str(len(tape.nodes)), verdict.status, f"{verdict.log10_delta:.4g}",
            *(f"{spent:.1f}" for spent in np.diff(seconds)), "valid" if report.valid else report.reason,
            "accepted" if check_data(data, turned(given)).valid else "refused",
            f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}",
        ]  # fmt: skip


def turned(given: dict[str, Any]) -> dict[str, Any]:
    """The problem with another last bit of one weight."""
    other = copy.deepcopy(given)
    holder = other["hold"]["law"] if "hold" in other else other["dynamics"]
    row = holder["networks"][0][1]["weights"][0]
    row[0] = float(np.nextafter(float.fromhex(row[0]), np.inf)).hex()
    return other


def enclosures() -> str:
    """Points outside the ranges of boxes, and the widest range by that of CROWN in floats, of one box in 20."""
    outside, widest, rng = 0, 0.0, np.random.default_rng(0)
    for number in range(NETWORKS):
        sizes = ((2, 16, 16, 1), (3, 8, 8, 8, 2))[number % 2]
        layers = weights_of(random_network(number, ("tanh", "relu")[number // 2 % 2], sizes).data)
        centre, radius = rng.normal(size=(sizes[0], BOXES)), 10 ** rng.uniform(-3, 0.3, (1, BOXES))
        box = Interval(centre - radius, centre + radius)
        found = bound_network(layers, box, 0).value
        for _ in range(POINTS):
            value = np.clip(centre + rng.uniform(-1, 1, centre.shape) * radius, box.lo, box.hi)
            for layer in layers:
                value = layer.row.numpy(layer.weights @ value + layer.bias[:, None], *layer.constants)
            slack: Array = 1e-14 * (1 + np.abs(value))
            outside += int(np.any((value < found.lo - slack) | (value > found.hi + slack), axis=0).sum())
        for place in range(0, BOXES, 20):
            low, high = crown(layers, box.lo[:, place], box.hi[:, place])
            widest = max(widest, float((found.width[:, place] / (high - low)).max()))
    return (
        f"{NETWORKS * BOXES * POINTS} points in {NETWORKS * BOXES} boxes over {NETWORKS} networks: {outside} outside; "
        f"widths at most {widest:.4f} times CROWN's"
    )


def gains() -> str:
    """Proved Lipschitz constants by those that the semidefinite program proposes."""
    ratios, started = [], time.process_time()
    for seed in range(GAINS):
        found = bound_network_gain(random_network(seed, "tanh", (2, 32, 32, 1)))
        ratios.append(found.gain / found.proposed)
    seconds = (time.process_time() - started) / GAINS
    return f"{GAINS} networks 2 x 32: proved at most {max(ratios):.6f} times LipSDP's in floats; {seconds:.1f} s each"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.networks")
    parser.add_argument("folder", type=Path, help="where the policies are, or are written")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="these policies")
    parser.add_argument("--enclosures", action="store_true", help="ranges over boxes")
    parser.add_argument("--gains", action="store_true", help="Lipschitz constants")
    options = parser.parse_args()
    if options.enclosures:
        print(enclosures())
    if options.gains:
        print(gains())
    if not (options.enclosures or options.gains):
        print("\n".join(table([list(HEAD), *policies(options.folder, options.only)])))


if __name__ == "__main__":
    main()
