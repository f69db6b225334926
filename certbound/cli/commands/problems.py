"""``certbound problems``: the bundled problems and the keys that --set changes."""

from __future__ import annotations

import inspect
from typing import Any

from certbound.cli.options import JsonOption, examples
from certbound.cli.output import SETTINGS, console, print_json

__all__ = ["EXAMPLES", "problems"]

EXAMPLES = examples("certbound problems", "certbound problems --quiet")


def problems(as_json: JsonOption = False) -> None:
    """List the bundled problems with their parameters."""
    rows = _rows()
    if as_json:
        print_json({"problems": rows})
        return
    if SETTINGS.quiet:
        print_names(rows)
        return
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for heading in ("problem", "what it is", "--set keys and defaults"):
        table.add_column(heading, overflow="fold")
    for row in rows:
        keys = ", ".join(f"{key}={_short(value)}" for key, value in row["parameters"].items())
        table.add_row(row["name"], row["summary"], keys)
    console().print(table)


def print_names(rows: list[dict[str, Any]]) -> None:
    """One name a line."""
    console().print("\n".join(row["name"] for row in rows))


def _rows() -> list[dict[str, Any]]:
    from certbound.problem.library import DEFAULTS, MODELS

    return [
        {"name": name, "summary": _summary(builder), "parameters": dict(DEFAULTS[name])}
        for name, builder in MODELS.items()
    ]


def _summary(builder: Any) -> str:
    lines = (inspect.getdoc(builder) or "").strip().splitlines()
    return lines[0] if lines else ""


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
