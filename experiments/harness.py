"""Runs an experiment and writes what it found, the same bytes for the same input.

An experiment is a module with ``compute(full) -> (arrays, claims)``: arrays are what its figure draws, claims
are the numbers that ``paper_figs/expected.json`` speaks of.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import sys
import zipfile
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["Arrays", "Claims", "Compute", "main", "save"]

Arrays = dict[str, np.ndarray]
Claims = dict[str, Any]
Compute = Callable[[bool], tuple[Arrays, Claims]]

ROOT = Path(__file__).resolve().parents[1]
VERSIONS = ("numpy", "scipy", "casadi", "cvxpy", "clarabel", "python-flint", "numba")


def main(stem: str, compute: Compute) -> None:
    """Command line of every experiment."""
    parser = argparse.ArgumentParser(prog=f"python -m experiments.{stem}")
    parser.add_argument("--full", action="store_true", help="the paper's sample sizes")
    parser.add_argument("--out", type=Path, help="folder (default: experiments/out/quick or full)")
    options = parser.parse_args()
    folder = options.out or ROOT / "experiments" / "out" / ("full" if options.full else "quick")
    arrays, claims = compute(options.full)
    save(folder, stem, arrays, claims, full=options.full)


def save(folder: Path, stem: str, arrays: Arrays, claims: Claims, *, full: bool) -> None:
    """Write ``stem.npz``, ``stem.json`` and ``stem.d`` (what a rebuild depends on), whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    record = {"stem": stem, "full": full, "claims": _plain(claims), "versions": _versions()}
    text = json.dumps(record, indent=1, sort_keys=True, allow_nan=False) + "\n"
    _write(folder / f"{stem}.json", text.encode())
    _write(folder / f"{stem}.d", _dependencies(folder / f"{stem}.npz").encode())
    _write(folder / f"{stem}.npz", _npz(arrays))


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    """An .npz archive whose bytes depend on nothing but the arrays."""
    archive = BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as bundle:
        for name in sorted(arrays):
            content = BytesIO()
            np.lib.format.write_array(content, np.asanyarray(arrays[name]), allow_pickle=False)
            bundle.writestr(zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0)), content.getvalue())
    return archive.getvalue()


def _dependencies(target: Path) -> str:
    """A make rule: the data must be computed again when a module that computed it has changed."""
    files = sorted(
        os.path.relpath(module.__file__, ROOT / "paper_figs")
        for module in list(sys.modules.values())
        if getattr(module, "__file__", None)
        and Path(module.__file__).is_relative_to(ROOT)
        and Path(module.__file__).relative_to(ROOT).parts[0] in ("certbound", "experiments")
    )
    rule = f"{os.path.relpath(target, ROOT / 'paper_figs')}: {' '.join(files)}\n"
    return rule + "".join(f"{file}:\n" for file in files)  # a file that is gone is no error


def _versions() -> dict[str, str]:
    import certbound

    found = {name: importlib.metadata.version(name) for name in VERSIONS}
    return {"certbound": certbound.__version__, "python": platform.python_version(), **found}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    return value


def _write(path: Path, content: bytes) -> None:
    temporary = path.with_name(f".{path.name}.part")
    temporary.write_bytes(content)
    temporary.replace(path)
