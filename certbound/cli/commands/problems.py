"""``certbound problems``: the bundled problems and the keys that --set changes."""

from __future__ import annotations

import inspect
from typing import Any

from certbound.cli.options import JsonOption, examples
from certbound.cli.output import SETTINGS, console, show

EXAMPLES = examples("certbound problems", "certbound problems --quiet")


def problems(as_json: JsonOption = False) -> None:
    """List the bundled problems with their parameters."""
    rows = _rows()
    show({"problems": rows}, as_json, lambda: _print(rows))


def _print(rows: list[dict[str, Any]]) -> None:
    if SETTINGS.quiet:
        console().print("\n".join(row["name"] for row in rows))
        return
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for heading in ("problem", "what it is", "--set keys and defaults"):
        table.add_column(heading, overflow="fold")
    for row in rows:
        keys = ", ".join(f"{key}={_short(value)}" for key, value in row["parameters"].items())
        table.add_row(row["name"], row["summary"], keys)
    console().print(table)


def _rows() -> list[dict[str, Any]]:
    from certbound.problem.library import DEFAULTS, MODELS

    texts = {name: inspect.getdoc(builder) or "" for name, builder in MODELS.items()}
    return [
        {"name": name, "summary": text.partition("\n")[0], "parameters": dict(DEFAULTS[name])}
        for name, text in texts.items()
    ]


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
