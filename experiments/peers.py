"""Other tools for the same problems: which of them pip brings, and what the installed ones say.

None that the index of Python packages holds bounds the probability of leaving: what is there encloses paths without
noise. LUCID comes from an index of its own and reads the ``.yaml`` files of ``experiments/literature`` as they are; its
command is run on each where it is installed.
"""

from __future__ import annotations

import importlib.metadata
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from experiments.literature import FOLDER

__all__ = ["PEERS", "lucid_answers", "peer_rows"]

LIMIT = 600.0  # seconds of each run

PEERS = {
    "LUCID": ("pip, from its own index (its README has the address); `pylucid` on PyPI is a content management system",
              "bounds the probability, from samples"),
    "PRoTECT": ("a repository, no package; a commercial solver for most of its examples", "bounds the probability"),
    "StochasticBarrier.jl": ("Julia, Docker; a commercial solver", "bounds the probability"),
    "IMPaCT, StocHy": ("C++ from source", "bounds the probability"),
    "SySCoRe": ("MATLAB", "bounds the probability"),
    "immrax": ("`pip install immrax`, Python 3.12 on", "nothing: it encloses paths without noise"),
    "do-mpc": ("`pip install do-mpc`", "nothing: it plans, and proves no bound"),
}  # fmt: skip
"""How each is installed, and what it says of a probability of failing."""


def peer_rows() -> list[list[str]]:
    """A row a tool: how it is installed, what it says, and what it said here."""
    found: dict[str, Callable[[], str]] = {"LUCID": lucid_answers}
    here = {name: _installed(name.lower()) for name in ("immrax", "do-mpc")}
    rows = []
    for name, (install, says) in PEERS.items():
        said = found[name]() if name in found else here.get(name, "not asked: pip does not bring it")
        rows.append([name, install, says, said])
    return rows


def _installed(package: str) -> str:
    try:
        return f"version {importlib.metadata.version(package)}"
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def lucid_answers(command: str = "pylucid", files: list[Path] | None = None) -> str:
    """The last line that LUCID prints of each of its files, with the seconds; or that it is not installed."""
    program = shutil.which(command)
    if program is None:
        return "not installed"
    answers = []
    for path in sorted(FOLDER.glob("*.yaml")) if files is None else files:
        begun = time.perf_counter()
        try:
            done = subprocess.run([program, str(path)], capture_output=True, text=True, timeout=LIMIT)
        except subprocess.TimeoutExpired:
            answers.append(f"{path.stem}: more than {LIMIT:g} s")
            continue
        lines = (done.stdout + done.stderr).strip().splitlines() or ["nothing printed"]
        answers.append(f"{path.stem}: {lines[-1].strip()} ({time.perf_counter() - begun:.1f} s)")
    return "; ".join(answers)
