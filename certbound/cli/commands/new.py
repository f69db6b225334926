"""``certbound new NAME``: a commented problem file to start from."""

from __future__ import annotations

import difflib
import json
import re
from pathlib import Path
from typing import Annotated

import typer

from certbound.cli.messages import InputError
from certbound.cli.options import JsonOption, check_writable, examples
from certbound.cli.output import SETTINGS, console, show, write_file
from certbound.cli.starters import STARTERS

EXAMPLES = examples(
    "certbound new my_system && certbound verify my_system.toml",
    "certbound new home --example target",
)

SCHEMA = "problem.schema.json"

ExampleOption = Annotated[
    str, typer.Option("--example", metavar="NAME", help=f"One of {', '.join(STARTERS)}: what the file shows.")
]

def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the problem; NAME.toml is written.")],
    example: ExampleOption = "pendulum",
    as_json: JsonOption = False,
) -> None:
    """Write a commented problem file to start from, and beside it the schema that editors complete and check it by."""
    if example not in STARTERS:
        near = next(iter(difflib.get_close_matches(example, STARTERS, n=1)), "target")
        raise InputError(f"`--example` must be one of {', '.join(STARTERS)}, got `{example}`", f"try --example {near}")
    path = Path(name if name.endswith(".toml") else f"{name}.toml")
    if not re.fullmatch(r"[A-Za-z0-9][\w-]*", path.stem):
        raise InputError(
            f"`NAME` must be made of letters, digits, - and _, got `{name}`", "try  certbound new my_system"
        )
    if path.exists():
        raise InputError(f"`{path}` exists already", "choose another name, or remove the file first")
    from certbound.problem.files import json_schema

    schema = path.with_name(SCHEMA)
    check_writable(path)
    text = STARTERS[example].replace("NAME", path.stem.replace("_", " ")).replace("FILE", str(path))
    write_file(path, f"#:schema {SCHEMA}\n{text}")
    write_file(schema, json.dumps(json_schema(), indent=1) + "\n")
    following = "" if SETTINGS.quiet else f"\nnext: edit it, then run  certbound verify {path}"
    result = {"path": str(path), "schema": str(schema)}
    show(result, as_json, lambda: console().print(f"wrote {path}{following}", markup=False))
