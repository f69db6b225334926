"""How long a person waits: the seconds until the final answer, until its first bound, and what ``--explain`` adds.

    python -m experiments.waiting [--folder DIR ...] [--seconds S] [--explain] [--limits 2 5 20] [name ...]

The bundled problems, the benchmarks, the cases of `experiments.middle`, the published problems of
``experiments/literature``, and every problem file of the folders. The clock is that of the processor, and so is the
limit that is kept: other work on the machine does not count, but for the solvers' own limits, which are of the clock on
the wall and bite on a crowded machine; seconds by that clock stand beside. The first table says what missed its time:
10 s with at most three states, 30 s with at most six. ``--limits`` asks for the slow problems again under each limit
instead, and prints what was not kept, and every bound that got worse with more time.
"""

from __future__ import annotations

import argparse
import itertools
import resource
import signal
import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


def worked() -> float:
    """Seconds of the processor that this process took, and its copies that have ended."""
    taken = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in taken)


time.perf_counter = worked
signal.ITIMER_REAL, signal.SIGALRM = signal.ITIMER_PROF, signal.SIGPROF

import numpy as np  # noqa: E402  (the clocks come first)

import certbound as cb  # noqa: E402
from certbound.safety.limits import limits_so_far  # noqa: E402
from certbound.watch import OutOfTime, Progress, Watch  # noqa: E402
from experiments import certificates, middle  # noqa: E402

__all__ = ["Answer", "answered", "main", "subjects"]

LITERATURE = Path(__file__).resolve().parent / "literature"
FINAL = {3: 10.0, 6: 30.0}  # seconds, by the largest number of states
EXPLAINED = 20.0  # seconds more
KEPT = (1.1, 1.0)  # a limit is kept to so many times itself, and seconds
WORSE = 1e-9  # of log10
SLOW = (
    "quadrotor 0.6", "quadrotor 1.2", "quadrotor 1.8", "platoon", "cart-pole", "flow .35", "flow .44", "two flows .35",
    "two flows .41", "oscillator_cubic", "oscillator_cubic, 0.3", "van_der_pol_dt", "unicycle, 5 s", "unicycle, loud",
    "steered map", "two wells", "pendulum, loud", "swing", "spring, loud", "wide chain",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What was answered, and the seconds that it took."""

    name: str
    states: int
    status: str
    log10: float
    method: str
    seconds: float
    wall: float
    first: float
    explained: float = 0.0

    @property
    def missed(self) -> bool:
        """Whether it came too late."""
        most = next((seconds for states, seconds in FINAL.items() if self.states <= states), float("inf"))
        return self.seconds > most or self.explained > KEPT[0] * EXPLAINED + KEPT[1]


def subjects(folders: Sequence[Path] = ()) -> dict[str, cb.Problem]:
    """Every problem by name."""
    found = certificates.subjects() | {name: make() for name, make in middle.CASES.items()} | own()
    for folder in (LITERATURE, *folders):
        files = (path for path in sorted(folder.iterdir()) if path.suffix in (".toml", ".yaml"))
        found |= {path.stem: cb.load(str(path)) for path in files}
    return found


def own() -> dict[str, cb.Problem]:
    """Problems at which an engine, or the verdict, once took long."""

    def steered(x: object) -> list[object]:
        turn = np.tanh(-2.0 * x[2] - x[1])  # type: ignore[index]
        return [x[0] + 0.15 * np.cos(x[2]), x[1] + 0.15 * np.sin(x[2]), x[2] + 0.15 * turn]  # type: ignore[index]

    def box(*sides: float) -> cb.Box:
        return cb.Box([-side for side in sides], list(sides))

    def planar(f: object, noise: object, start: object, safe: object, horizon: float) -> cb.Problem:
        system = cb.ContinuousSystem(f, states=2, diffusion=noise)
        return cb.Problem(system, initial=start, safe=[cb.Inside(safe)], horizon=horizon)

    map_ = cb.DiscreteSystem(steered, states=3, noise=cb.Gaussian(std=[0.02, 0.02, 0.05]))
    free = cb.Inside(cb.Box([-1, -0.4, -1.2], [5, 0.4, 1.2]))
    chain = np.diag(np.full(5, -1.0)) + np.diag(np.full(4, 0.5), 1)
    wide = cb.ContinuousSystem(lambda x: list(chain @ x - 0.3 * x**3), states=5, diffusion=0.35 * np.eye(5))
    return {
        "steered map": cb.Problem(map_, initial=box(0.05, 0.05, 0.05), safe=[free], horizon=20),
        "two wells": planar(lambda x: [x[0] - x[0] ** 3, -x[1] + 0.3 * x[0]], 0.3 * np.eye(2),
                            cb.Box([0.9, 0.2], [1.0, 0.3]), cb.Box([-0.4, -1.5], [2, 1.5]), 3.0),
        "pendulum, loud": cb.load("pendulum", sigma=0.4),
        "swing": planar(lambda x: [x[1], -np.sin(x[0]) - 0.4 * x[1]], 0.3 * np.eye(2), box(0.1, 0.1), box(1.5, 1.5), 2),
        "spring, loud": planar(lambda x: [x[1], -x[0] - x[0] ** 3 - x[1]], [[0.1], [0.5]], box(0.1, 0.1),
                               box(1.5, 2), 3),
        "unicycle, loud": cb.load("unicycle", sigma=0.115),
        "unicycle, 5 s, loud": cb.load("unicycle", sigma=0.04).replace(horizon=5.0),
        "wide chain": cb.Problem(wide, initial=box(*[0.1] * 5), safe=[cb.Inside(box(*[1.2] * 5))], horizon=2),
    }  # fmt: skip


def answered(name: str, problem: cb.Problem, limit: float, *, explain: bool = False) -> Answer:
    """The verdict, and where it is UNKNOWN and that is asked for what would be SAFE."""
    told: list[float] = []

    def tell(progress: Progress) -> None:
        if progress.log10_delta < 0 and not told:
            told.append(progress.seconds)

    begun, wall = worked(), time.monotonic()
    verdict = cb.verify_safety(problem, time_limit=limit, progress=tell, patient=False)
    seconds, wall, explained = worked() - begun, time.monotonic() - wall, 0.0
    if explain and verdict.status == "UNKNOWN":
        begun = worked()
        try:
            with Watch(EXPLAINED).running():
                for _ in limits_so_far(verdict):
                    pass
        except OutOfTime:
            pass
        explained = worked() - begun
    return Answer(
        name=name, states=problem.system.dimension, status=verdict.status, log10=verdict.log10_delta,
        method=verdict.method, seconds=seconds, wall=wall, first=told[0] if told else float("nan"), explained=explained,
    )  # fmt: skip


def _final(found: Mapping[str, cb.Problem], limit: float, *, explain: bool) -> Iterator[str]:
    yield "| problem | states | verdict | log10 P | by | first bound, s | final, s | on the wall | explained, s more |"
    yield "|---|---|---|---|---|---|---|---|---|"
    rows = []
    for name, problem in found.items():
        row = answered(name, problem, limit, explain=explain)
        rows.append(row)
        late = " late" if row.missed else ""
        yield (
            f"| {name} | {row.states} | {row.status} | {row.log10:.4g} | {row.method} | {row.first:.1f} "
            f"| {row.seconds:.1f}{late} | {row.wall:.1f} | {row.explained:.1f} |"
        )
    few = [row.seconds for row in rows if row.states <= min(FINAL)]
    late = [row.name for row in rows if row.missed]
    middle = f"{statistics.median(few):.1f} s" if few else "none"
    yield f"\n{len(late)} of {len(rows)} late: {', '.join(late)}; median with at most {min(FINAL)} states {middle}"


def _limited(found: Mapping[str, cb.Problem], limits: Sequence[float]) -> Iterator[str]:
    yield "| problem | " + " | ".join(f"{limit:g} s: used, log10 P" for limit in limits) + " | |"
    yield "|---" * (len(limits) + 2) + "|"
    late = worse = 0
    for name, problem in found.items():
        rows = [answered(name, problem, limit) for limit in limits]
        over = sum(row.seconds > KEPT[0] * limit + KEPT[1] for row, limit in zip(rows, limits))
        lost = sum(after.log10 > before.log10 + WORSE for before, after in itertools.pairwise(rows))
        late, worse = late + over, worse + lost
        words = ", ".join(["late"] * over + ["worse"] * lost)
        yield f"| {name} | " + " | ".join(f"{row.seconds:.1f}, {row.log10:.4g}" for row in rows) + f" | {words} |"
    yield f"\n{late} of {len(found) * len(limits)} late; {worse} of {len(found) * (len(limits) - 1)} worse"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m experiments.waiting")
    parser.add_argument("names", nargs="*", help="problems (all)")
    parser.add_argument("--folder", type=Path, action="append", default=[], help="more problem files")
    parser.add_argument("--seconds", type=float, default=60.0, help="the limit (60)")
    parser.add_argument("--explain", action="store_true", help="also what would be SAFE")
    parser.add_argument("--limits", type=float, nargs="+", default=[], help="the slow problems under these limits")
    asked = parser.parse_args()
    found = subjects(asked.folder)
    names = asked.names or (SLOW if asked.limits else found)
    chosen = {name: found[name] for name in names}
    lines = _limited(chosen, asked.limits) if asked.limits else _final(chosen, asked.seconds, explain=asked.explain)
    for line in lines:
        print(line, flush=True)


if __name__ == "__main__":
    main()
