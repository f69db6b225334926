"""Certificates of the bundled problems and of the benchmarks: what they cost to find, to hold, and to check.

``python -m experiments.certificates`` prints one row a problem whose verdict is SAFE (``--all``: every one that has a
certificate); further arguments are names of problems. Times are seconds of processor time of this process: the prover's
is the verdict's, and the writer's is the time to state it as a certificate.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import certbound as cb
from certbound.checker import check_data, parse
from certbound.cli.commands.check import ATTEMPTS
from certbound.errors import CertificateError
from certbound.safety.certificate import problem_data

__all__ = ["FACTOR", "LEAST", "Row", "main", "row", "subjects", "table"]

FOLDER = Path(__file__).resolve().parent / "benchmarks"
PROBLEMS = ("ou", "unicycle", "chain", "chain_rest", "pendulum")
NOISES = (0.1, 0.2, 0.3)
FACTOR, LEAST = 10.0, 20.0
"""A check may take FACTOR times the prover's time, or LEAST seconds."""
HEAD = (
    "problem", "status", "engine", "log10 P", "claimed", "proved", "prover s", "writer s", "checker s", "kB", "check",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Row:
    """One problem: its verdict, its certificate, and what the checker says."""

    name: str
    status: str
    engine: str
    log10_delta: float
    claimed: float = 0.0
    proved: float | None = None
    prover: float
    writer: float = 0.0
    checker: float = 0.0
    size: int = 0
    check: str

    @property
    def quick(self) -> bool:
        """Whether the check kept its limit."""
        return self.checker <= max(FACTOR * self.prover, LEAST)

    def cells(self) -> list[str]:
        """The row as text."""
        proved = "" if self.proved is None else f"{self.proved:.4g}"
        return [
            self.name, self.status, self.engine, f"{self.log10_delta:.4g}", f"{self.claimed:.4g}", proved,
            f"{self.prover:.2f}", f"{self.writer:.2f}", f"{self.checker:.2f}", f"{self.size / 1000:.0f}",
            self.check if self.quick else f"{self.check}, too slow",
        ]  # fmt: skip


def subjects() -> dict[str, cb.Problem]:
    """The bundled problems and the benchmarks, the oscillator at smaller noise and the unicycle for longer too."""
    found = {name: cb.load(name) for name in PROBLEMS}
    found["unicycle, 5 s"] = cb.load("unicycle").replace(horizon=5.0)
    for path in sorted(FOLDER.glob("*.toml")):
        found[path.stem] = cb.load(str(path))
    found["van_der_pol_dt, near 0"] = found["van_der_pol_dt"].replace(initial=cb.Box([-0.5, -0.5], [0.5, 0.5]))
    found["contraction_14d, 2 steps"] = found["contraction_14d"].replace(horizon=2)
    found["noise in the state"] = stirred()
    for noise in NOISES:
        found[f"oscillator_cubic, {noise}"] = cb.load(str(FOLDER / "oscillator_cubic.toml"), sigma=noise)
    return found


def stirred() -> cb.Problem:
    """A damped pendulum whose noise grows with its velocity."""
    system = cb.ContinuousSystem(
        lambda x: [x[1], -np.sin(x[0]) - 0.5 * x[1]], states=["angle", "velocity"],
        diffusion=lambda t, x: [[0.0], [0.05 * (1 + 0.5 * np.tanh(x[1]))]],
    )  # fmt: skip
    safe = [cb.Inside(cb.HalfSpace([-1.0, 0.0], 0.3))]
    return cb.Problem(system, initial=cb.Box([0.38, -0.02], [0.4, 0.02]), safe=safe, horizon=2.0, name="stirred")


def row(name: str, problem: cb.Problem) -> Row:
    """Prove, state, and check again with the effort that ``verify --certificate`` needs."""
    started = time.process_time()
    verdict = cb.verify_safety(problem)
    found = time.process_time()
    known = {"name": name, "status": verdict.status, "log10_delta": verdict.log10_delta, "prover": found - started}
    writer = 0.0
    for attempt in range(ATTEMPTS):
        begun = time.process_time()
        try:
            text = verdict.certificate_text(problem, attempt=attempt)
        except CertificateError as error:
            return Row(**known, engine=verdict.method, check=f"none: {error}"[:60])  # type: ignore[arg-type]
        stated = time.process_time()
        writer += stated - begun
        data = parse(text)
        report = check_data(data, problem_data(problem))
        checker = time.process_time() - stated
        if report.valid:
            break
    return Row(
        **known, engine=data["claim"]["method"], claimed=report.log10_delta, proved=report.log10_proved, writer=writer,
        checker=checker, size=len(text), check="valid" if report.valid else f"NOT PROVED: {report.reason}"[:60],
    )  # type: ignore[arg-type]  # fmt: skip


def table(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines of aligned columns."""
    widths = [max(len(line[i]) for line in rows) for i in range(len(rows[0]) - 1)]
    for line in rows:
        yield "  ".join([*(cell.ljust(width) for cell, width in zip(line, widths)), line[-1]])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.certificates")
    parser.add_argument("names", nargs="*", metavar="NAME", help="only these problems")
    parser.add_argument("--all", action="store_true", help="also problems whose verdict is not SAFE")
    options = parser.parse_args()
    lines = [list(HEAD)]
    for name, problem in subjects().items():
        if options.names and name not in options.names:
            continue
        found = row(name, problem)
        if options.all or found.status == "SAFE" or name in options.names:
            lines.append(found.cells())
    print("\n".join(table(lines)))


if __name__ == "__main__":
    main()
