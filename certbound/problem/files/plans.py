"""Input plans as JSON files: what ``synthesize --plan`` writes and a problem file's ``[plan] file`` reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array


def write_plan(path: str | Path, plan: ArrayLike, inputs: tuple[str, ...], **notes: Any) -> None:
    """Write a plan: ``{"inputs": [names], "plan": [[one row a step], ...]}`` and any notes.

    ``plan`` has shape (K, m), with one column for each of the m names of ``inputs``.
    """
    content = {"inputs": list(inputs), "plan": np.asarray(plan, dtype=float).tolist()} | notes
    Path(path).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_plan(path: str | Path, inputs: tuple[str, ...]) -> Array:
    """Read a plan, with its columns in the order of ``inputs``.

    A file that does not exist or does not hold such a plan is a ValueError.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        reason = error.strerror or "no access"
        raise ValueError(f"`plan.file` must be a readable file, got {str(path)!r}: {reason}.") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"`plan.file` must be JSON, got {str(path)!r}: {error}.") from error
    rows = content.get("plan") if isinstance(content, dict) else content
    names = content.get("inputs", list(inputs)) if isinstance(content, dict) else list(inputs)
    if not isinstance(names, list) or sorted(map(str, names)) != sorted(inputs):
        raise ValueError(f"`plan.file` must be for the inputs {', '.join(inputs)}, got {names!r}.")
    try:
        array = np.array(rows, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`plan.file` must hold rows of numbers under 'plan': {error}.") from error
    if array.ndim != 2 or array.shape[1] != len(inputs):
        raise ValueError(f"`plan.file` must hold rows of {len(inputs)} numbers, got shape {array.shape}.")
    return np.asarray(array[:, [names.index(name) for name in inputs]])
