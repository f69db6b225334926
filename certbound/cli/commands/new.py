"""``certbound new NAME``: a commented problem file to start from."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from certbound.cli.messages import InputError
from certbound.cli.options import JsonOption, check_writable, examples
from certbound.cli.output import SETTINGS, console, show, write_file

EXAMPLES = examples("certbound new my_system && certbound verify my_system.toml")
TEMPLATE = """\
# A certbound problem: a noisy system, where it starts, where it must stay, for how long, and how surely.
# Check it with:  certbound verify {file}
name = "{name}"
time = "continuous"        # or "discrete": [dynamics] then gives the next state, and [noise] has a law
horizon = 4.0              # seconds (steps in discrete time)
delta = 1e-3               # allowed probability of leaving the safe set at any time up to the horizon
states = ["angle", "speed"]

[parameters]               # numbers used below; change them with  --set damping=0.8
gravity = 9.81
length = 1.0
damping = 0.5
sigma = 0.05

[disturbances]             # bounded, unknown, may depend on the past: name = [low, high]
push = [-0.02, 0.02]

[dynamics]                 # d(state)/dt: t + - * / **, sin cos tan tanh exp log sqrt abs min max ..., pi
angle = "speed"
speed = "-gravity/length*sin(angle) - damping*speed + push"

[noise]                    # g of  dx = f dt + g dW, one row a state
diffusion = [[0], ["sigma"]]

[initial]                  # exactly one of point, box, ball, gaussian
box = [[0.25, 0.35], [-0.05, 0.05]]

[[stay]]                   # the state stays inside each [[stay]] ...
box = {{ angle = [-1.0, 1.0] }}

[[stay]]
halfspace = {{ normal = {{ speed = 1 }}, bound = 4 }}   # speed <= 4

[[avoid]]                  # ... and outside each [[avoid]]
ball = {{ center = {{ angle = 0.9, speed = 2.5 }}, radius = 0.3 }}
during = [0, 2]            # seconds; leave it out for the whole horizon
"""


def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the problem; NAME.toml is written.")],
    as_json: JsonOption = False,
) -> None:
    """Write a commented problem file to start from."""
    path = Path(name if name.endswith(".toml") else f"{name}.toml")
    if not re.fullmatch(r"[A-Za-z0-9][\w-]*", path.stem):
        raise InputError(
            f"`NAME` must be made of letters, digits, - and _, got `{name}`", "try  certbound new my_system"
        )
    if path.exists():
        raise InputError(f"`{path}` exists already", "choose another name, or remove the file first")
    check_writable(path)
    write_file(path, TEMPLATE.format(name=path.stem.replace("_", " "), file=path))
    following = "" if SETTINGS.quiet else f"\nnext: edit it, then run  certbound verify {path}"
    show({"path": str(path)}, as_json, lambda: console().print(f"wrote {path}{following}", markup=False))
