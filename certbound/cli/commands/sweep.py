"""``certbound sweep``: the verdict over a grid of parameters, or the boundary of what is SAFE."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from certbound.cli.clock import VerdictLimitOption
from certbound.cli.commands.verify import DEFAULT_LIMIT, CellsOption, MethodOption, SmallestOption
from certbound.cli.messages import FAILED, InputError
from certbound.cli.options import (
    ClusterOption,
    JsonOption,
    ProblemArgument,
    SetOption,
    check_writable,
    cluster_at,
    examples,
    integer,
    number,
    option,
    settings_of,
)
from certbound.cli.output import SETTINGS, console, print_status, show, spinner, write_file
from certbound.cli.pictures import check_picture, write_picture
from certbound.cli.progress import progress
from certbound.display import log10_text, one_line

_MOST = 1_000_000  # values of one range

if TYPE_CHECKING:
    from certbound.safety.sweeps import Sweep

EXAMPLES = examples(
    "certbound sweep ou --over sigma=0.1:0.5:5 --over horizon=1,5 --out sweep.csv --plot sweep.png",
    "certbound sweep my_system.toml --over sigma=0.01:1:30:log --resume sweep.jsonl --jobs 4",
    "certbound sweep unicycle --over sigma=0.01:0.2:96 --over horizon=1,2 --boundary sigma",
)
SHOWN = 60  # rows that are printed

OverOption = Annotated[
    list[str],
    typer.Option(
        "--over", metavar="KEY=VALUES", show_default=False,
        help="Values of a parameter, of horizon or of delta: 1,2,5 or low:high:count (:log); repeat for more.",
    ),
]  # fmt: skip
BoundaryOption = Annotated[
    str | None, option("--boundary", "KEY", "Only look for the largest value of this key that is SAFE, by bisection.")
]
JobsOption = Annotated[int | None, option("--jobs", "N", "Processes side by side [all cores].", integer)]
ResumeOption = Annotated[Path | None, option("--resume", "FILE", "Keep each point here at once, and go on from it.")]
OutOption = Annotated[Path | None, option("--out", "FILE", "Write a CSV table.")]
MapOption = Annotated[Path | None, option("--plot", "FILE", "Draw the bounds, or the boundary.")]


def sweep(
    problem: ProblemArgument,
    over: OverOption,
    boundary: BoundaryOption = None,
    pairs: SetOption = None,
    method: MethodOption = "auto",
    cells: CellsOption = None,
    smallest: SmallestOption = False,
    time_limit: VerdictLimitOption = None,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    resume: ResumeOption = None,
    out: OutOption = None,
    plot: MapOption = None,
    as_json: JsonOption = False,
) -> None:
    """Verify a problem at every point of a grid of parameters; the time limit is that of each point."""
    check_writable(resume, out, plot, problem=problem)
    check_picture(plot)
    files = [path.resolve() for path in (resume, out, plot) if path is not None]
    if len(set(files)) < len(files):
        raise InputError("`--resume`, `--out` and `--plot` name the same file", "give each a name of its own")
    if jobs is not None and cluster is not None:
        raise InputError("`--jobs` and `--cluster` exclude each other", "leave one of them out")
    grid, fixed = axes_of(over), settings_of(pairs)
    started = time.perf_counter()
    with cluster_at(cluster) as executor, progress("sweeping") as tell:
        import certbound as cb

        found = cb.sweep(
            problem, grid, boundary=boundary, parameters=fixed, method=method, cells=cells, smallest=smallest,
            time_limit=DEFAULT_LIMIT if time_limit is None else time_limit, jobs=jobs, executor=executor,
            resume=resume, progress=tell,
        )  # fmt: skip
    if out is not None:
        write_file(out, found.table())
    if plot is not None:
        from certbound.plotting import draw_sweep

        with spinner("drawing"):
            write_picture(plot, draw_sweep(found))
    failed = any(row.status == "FAILED" for row in found.points)
    result = {"over": {name: list(values) for name, values in found.over.items()}, **found.to_dict()}
    show(result | {"seconds": time.perf_counter() - started}, as_json, lambda: _print(found))
    raise typer.Exit(FAILED if failed else 0)


def axes_of(pairs: Sequence[str]) -> dict[str, list[float]]:
    """The ``--over key=values`` pairs as a mapping.

    Examples
    --------
    >>> axes_of(["horizon=1,2,5", "sigma=0.1:0.3:3", "delta=1e-6:1e-2:3:log"])
    {'horizon': [1.0, 2.0, 5.0], 'sigma': [0.1, 0.2, 0.3], 'delta': [1e-06, 0.0001, 0.01]}
    """
    found: dict[str, list[float]] = {}
    for pair in pairs:
        key, sign, text = (part.strip() for part in pair.partition("="))
        if not sign or not key or not text:
            raise InputError(f"`--over` takes key=values, got `{pair}`", "write for example --over sigma=0.01:0.2:20")
        if key in found:
            raise InputError(f"`--over {key}` is given twice", "give each key once, with all its values")
        try:
            found[key] = _range(text) if ":" in text else [number(value) for value in text.split(",")]
        except typer.BadParameter as error:
            cure = f"write for example --over {key}=0.01:0.2:20 or --over {key}=1,2,5"
            raise InputError(f"the values of `--over {key}`, `{text}`: {error}", cure) from None
    return found


def _range(text: str) -> list[float]:
    low, high, count, *scale = [*text.split(":"), "", ""][: max(3, text.count(":") + 1)]
    if not count or scale not in ([], ["log"]):
        raise typer.BadParameter("a range is low:high:count, or low:high:count:log")
    first, last, parts = number(low), number(high), number(count)
    if parts != int(parts) or parts < 2:
        raise typer.BadParameter(f"a range has a whole number of values, at least 2, got `{count}`")
    if parts > _MOST:
        raise typer.BadParameter(f"a range has at most {_MOST} values, got `{count}`")
    if not first < last:
        raise typer.BadParameter(f"the range is empty: {low} is not below {high}")
    if scale and first <= 0:
        raise typer.BadParameter(f"a logarithmic range begins above 0, got `{low}`")
    begin, end = (math.log10(first), math.log10(last)) if scale else (first, last)
    shares = [k / (int(parts) - 1) for k in range(int(parts))]
    inner = [(1 - share) * begin + share * end for share in shares[1:-1]]
    return [first, *(float(f"{10**value if scale else value:.12g}") for value in inner), last]


def _print(found: Sweep) -> None:
    screen = console()
    if found.boundaries is not None:
        for one in found.boundaries:
            screen.print(one_line(one.summary()), markup=False)
    elif len(found.points) <= SHOWN and not SETTINGS.quiet:
        for row in found.points:
            print_status(screen, row.status)
            where = ", ".join(f"{name} = {value:.6g}" for name, value in row.parameters.items())
            screen.print(f"{where}: P <= {log10_text(row.log10_delta)}", end="", markup=False)
            screen.print(f"  ({row.method}, {row.seconds:.1f} s)", markup=False)
    for row in found.points:
        if row.status == "FAILED" and not SETTINGS.quiet:
            where = ", ".join(f"{name} = {value:.6g}" for name, value in row.parameters.items())
            screen.print(f"no verdict at {where}: {one_line(row.reason)}", markup=False)
    screen.print(found.summary(), markup=False)
