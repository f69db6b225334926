"""Fills in the commands and the table of engines from the program itself when the site is built."""

from __future__ import annotations

from typing import Any

__all__ = ["command_sections", "engine_table", "on_page_markdown"]


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the placeholders by one section a command, and by one row an engine."""
    for place, text in (("<!-- commands -->", command_sections), ("<!-- engines -->", engine_table)):
        if place in markdown:
            markdown = markdown.replace(place, text())
    return markdown


def engine_table() -> str:
    """What every engine does, and when it is asked, as a Markdown table."""
    from certbound.safety.portfolio import ENGINES

    rows = [f"| `{row.name}` | {_cell(row.words)} | {_cell(row.when)} |" for row in ENGINES.values()]
    return "\n".join(["| engine | what it does | when it is asked |", "|---|---|---|", *rows])


def command_sections() -> str:
    """Summary, arguments, options and examples of every command, as Markdown."""
    import typer

    from certbound.cli.app import app

    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    return "\n".join(_section(name, command) for name, command in commands.items())


def _section(name: str, command: Any) -> str:
    arguments = [entry for entry in command.params if entry.param_type_name == "argument"]
    options = [entry for entry in command.params if entry.param_type_name == "option"]
    usage = " ".join(["certbound", name, *(entry.metavar or entry.name.upper() for entry in arguments), "[OPTIONS]"])
    lines = [f"## {name}", "", command.help or "", "", f"```text\n{usage}\n```", ""]
    lines += ["| | |", "|---|---|"]
    lines += [f"| `{entry.metavar or entry.name.upper()}` | {_cell(entry.help)} |" for entry in arguments]
    for entry in options:
        value = "" if entry.is_flag else f" {entry.metavar or 'VALUE'}"
        names = ", ".join(f"`{option}{value}`" for option in entry.opts)
        default = "" if entry.is_flag or entry.default in (None, "") else f" [{entry.default}]"
        lines.append(f"| {names} | {_cell(entry.help)}{default} |")
    examples = [line.removeprefix("Example:").strip() for line in (command.epilog or "").splitlines() if line.strip()]
    if examples:
        lines += ["", "```text", *examples, "```"]
    return "\n".join([*lines, ""])


def _cell(text: str | None) -> str:
    return (text or "").replace("|", "\\|")
