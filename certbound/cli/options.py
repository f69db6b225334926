"""Arguments and options that several commands share, and how a problem is loaded from them."""

from __future__ import annotations

import contextlib
import difflib
import math
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certbound.cli.messages import InputError, for_files, place_in_module, split_cure
from certbound.cli.output import SETTINGS

if TYPE_CHECKING:
    import numpy as np

    from certbound.problem.problem import Problem


def duration(text: str) -> float:
    """A number, or ``inf``."""
    return math.inf if text.strip().lower() in ("inf", "+inf") else number(text)


def number(text: str) -> float:
    """A finite number from the command line; ``1e6`` is one, ``nan`` is not.

    Examples
    --------
    >>> number("1e6")
    1000000.0
    """
    try:
        value = float(text)
    except ValueError:
        raise typer.BadParameter(f"must be a number such as 0.5 or 1e6, got `{text}`") from None
    if not math.isfinite(value):
        raise typer.BadParameter(f"must be a finite number, got `{text}`")
    return value


def integer(text: str) -> int:
    """A whole number from the command line, also written as ``1e6``."""
    value = number(text)
    if value != int(value):
        raise typer.BadParameter(f"must be a whole number, got `{text}`")
    return int(value)


def complete_problem(incomplete: str) -> list[str]:
    """Names of bundled problems for the shell's completion."""
    from certbound.problem.library import MODELS

    return sorted(name for name in MODELS if name.startswith(incomplete))


def option(flag: str, metavar: str, text: str, parser: Callable[[str], Any] | None = None) -> Any:
    """An option that takes a value and may be left out."""
    return typer.Option(flag, metavar=metavar, help=text, parser=parser, show_default=False)


ProblemArgument = Annotated[
    str,
    typer.Argument(
        metavar="PROBLEM",
        help="A bundled problem's name, a TOML file (or YAML of LUCID or StochasticBarrier.jl), or module:name.",
        autocompletion=complete_problem,
        show_default=False,
    ),
]
SetOption = Annotated[
    list[str] | None, option("--set", "KEY=VALUE", "Change a parameter of the problem; repeat for more.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]
HorizonOption = Annotated[float | None, option("--horizon", "T", "Seconds, or steps; inf is for ever.", duration)]
DeltaOption = Annotated[float | None, option("--delta", "D", "Allowed exit probability.", number)]
SeedOption = Annotated[int | None, option("--seed", "S", "The same seed gives the same runs.", integer)]
ClusterOption = Annotated[str | None, option("--cluster", "ADDRESS", "A dask scheduler, tcp://host:port.")]
PlotOption = Annotated[Path | None, option("--plot", "FILE", "Draw what was found: tubes, sets and paths, or curves.")]


def settings_of(pairs: Sequence[str] | None) -> dict[str, float]:
    """The ``--set key=value`` pairs as a mapping.

    Examples
    --------
    >>> settings_of(["sigma=2e-2", "v = 1"])
    {'sigma': 0.02, 'v': 1.0}
    """
    found: dict[str, float] = {}
    for pair in pairs or ():
        key, sign, value = (part.strip() for part in pair.partition("="))
        if not sign or not key or not value:
            raise InputError(f"`--set` takes key=value, got `{pair}`", "write for example --set sigma=0.02")
        if key in found:
            raise InputError(f"`--set {key}` is given twice", "give each key once")
        try:
            found[key] = number(value)
        except typer.BadParameter as error:
            raise InputError(f"the value of `--set {key}` {error}", f"write for example --set {key}=0.02") from None
    return found


def generator(seed: int | None) -> np.random.Generator:
    """Random numbers from ``--seed``, or from the system."""
    if seed is not None and seed < 0:
        raise InputError(f"`--seed` must not be negative, got {seed}", "give a whole number such as 1")
    import numpy as np

    return np.random.default_rng(seed)


def load_problem(
    source: str, pairs: Sequence[str] | None, *, horizon: float | None = None, delta: float | None = None
) -> Problem:
    """The problem that the arguments name, with its parameters, horizon and delta changed as asked."""
    from certbound.problem.files import load

    kind = Path(source).suffix
    if kind == ".py":
        words = f"`PROBLEM` must be module:name for a problem in Python, got `{source}`"
        raise InputError(words, f"write {Path(source).stem}:problem with the name that the problem has in it")
    if kind and ":" not in source and not Path(source).exists():
        folder = Path(source).parent
        every = sorted(path.name for path in folder.glob("*.[ty]*ml")) if folder.is_dir() else []
        here = difflib.get_close_matches(Path(source).name, every, n=3, cutoff=0.4) or every[:3]
        cure = f"there is {', '.join(here)} in that folder" if here else "check the path"
        raise InputError(f"`{source}`: No such file or directory", f"{cure}; `certbound new NAME` writes one")
    parameters: dict[str, Any] = dict(settings_of(pairs))
    for name in ("horizon", "delta"):
        if name in parameters and Path(source).is_file():
            cure = f"write --{name} {parameters[name]:g}"
            raise InputError(f"`--set` changes parameters, and `{name}` is none", cure)
    changes: dict[str, Any] = {} if delta is None else {"delta": delta}
    with _as_input_error(_cure(source), module=":" in source):
        problem = load(source, **parameters)
        _tell_taken(source)
    if horizon is not None:
        changes["horizon"] = _whole(horizon) if problem.system.time == "discrete" else horizon
    for name, value in changes.items():
        like = "a probability such as --delta 1e-3" if name == "delta" else "a positive --horizon, such as 5"
        with _as_input_error(f"give {like}"):
            problem = problem.replace(**{name: value})
    return problem


def _tell_taken(source: str) -> None:
    """Say on standard error what was taken for what in a file of another tool."""
    if SETTINGS.quiet or not source.endswith((".yaml", ".yml")):
        return
    from certbound.problem.files import notes

    first, *lines = notes(source)
    sys.stderr.write("".join([f"{first}\n", *(f"  {line}\n" for line in lines)]))
    sys.stderr.flush()


def _cure(source: str) -> str:
    if source.endswith((".yaml", ".yml")):
        return "mend the file"
    if source.endswith(".toml") or Path(source).is_file():
        return "mend the file; `certbound new NAME` writes one that works"
    if ":" in source:
        return "mend the module"
    return "run `certbound problems` for the bundled problems and their keys"


@contextlib.contextmanager
def _as_input_error(cure: str, *, module: bool = False) -> Iterator[None]:
    """Whatever a problem refuses while it is built, or the user's own module raises, is the user's to mend."""
    try:
        yield
    except (InputError, SyntaxError):
        raise
    except (ValueError, TypeError, ArithmeticError) as error:
        if module and (place := place_in_module(error)):
            raise InputError(_raised(error, place), cure) from error
        why, own = split_cure(for_files(str(error)) if not module else str(error))
        raise InputError(why.replace("`source`", "`PROBLEM`"), own or _about(why, cure)) from error
    except Exception as error:  # a user's module may raise anything; what is ours is raised again
        if not module:
            raise
        raise InputError(_raised(error, place_in_module(error)), cure) from error
    except SystemExit as error:  # its code would be taken for an answer
        if not module:
            raise
        raise InputError("the module ended the program", "leave `sys.exit()` out where it is imported") from error


def _raised(error: Exception, place: str) -> str:
    """That the user's own module raised an error, and where."""
    return f"the module raised {type(error).__name__}{place}: {' '.join(str(error).split())}"


def _about(why: str, cure: str) -> str:
    """A cure that names the key which the reason names."""
    if "`source` must be a text file" in why:
        return "save the file as UTF-8 text"
    if "`source` must" in why:
        return "check the name; files and modules are looked for from the folder where you are"
    named = re.search(r"`([\w.\[\]]+)`", why)
    return cure.replace("mend the file", f"change `{named[1]}` in the file") if named else cure


def check_writable(*paths: Path | None, problem: str = "") -> None:
    """Refuse, before any work, to write where no file can be written, twice, or over the problem's own file."""
    named = [path for path in paths if path is not None]
    for place, path in enumerate(named):
        if path in named[:place]:
            raise InputError(f"`{path}` is to be written twice", "name two files")
        if path.is_file() and Path(problem).is_file() and path.samefile(problem):
            raise InputError(f"`{path}` is the problem's own file, and would be lost", "name another file")
        if path.is_dir():
            raise InputError(f"`{path}` is a directory", "name a file")
        if str(path).startswith("--"):
            raise InputError(f"`{path}` stands where a file has to be named", f"name a file; ./{path} is one, too")
        if not path.parent.is_dir():
            raise InputError(f"the directory `{path.parent}` does not exist", f"run mkdir -p {path.parent}")
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise InputError(f"`{path}` cannot be written", "choose another place, or change the permissions")


@contextlib.contextmanager
def cluster_at(address: str | None) -> Iterator[Any]:
    """A dask client for the address, closed again; None without one."""
    if address is None:
        yield None
        return
    from certbound.parallel import connect

    client = connect(address)
    try:
        yield client
    finally:
        client.close()


def examples(*lines: str) -> str:
    """The examples at the end of a command's help."""
    return "\n\n".join(f"Example: {line}" for line in lines)


def _whole(horizon: float) -> float:
    if math.isinf(horizon):
        return horizon
    if horizon != int(horizon):
        raise InputError(f"`--horizon` counts steps here and must be whole, got {horizon:g}", "give whole steps")
    return int(horizon)
