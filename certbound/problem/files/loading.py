"""Problems from files, by bundled name, or from Python modules; and back to files."""

from __future__ import annotations

import importlib
import math
import sys
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from certbound.checks import instance, nearest, number
from certbound.problem.files.plans import write_plan
from certbound.problem.files.toml import toml_text
from certbound.problem.foreign import restate
from certbound.problem.networks import NetworkFunction, write_network
from certbound.problem.problem import Problem

YAML = (".yaml", ".yml")
"""Files of other tools."""

_LARGEST = 20_000_000


def load(source: str | Path, **parameters: Any) -> Problem:
    """A problem from a file, by bundled name, or from a Python module.

    A TOML file is only read, never run: its expressions are parsed by a small language that has nothing but
    arithmetic. So are YAML files of LUCID and of StochasticBarrier.jl; ``notes`` says what was taken for what. A module
    is imported, which runs it.

    Parameters
    ----------
    source : str or Path
        ``file.toml`` (or ``file.yaml`` of those tools); a bundled name such as ``unicycle``; or
        ``package.module:name``, where the name is a
        ``Problem`` or a function that returns one. Modules in the current folder are found.
    **parameters
        Values for the file's ``[parameters]``, or arguments of the bundled problem or function.

    Raises
    ------
    ValueError
        If there is no such problem or parameter (the nearest is named), or the file is wrong: key, rule and
        value. What a module raises itself is passed on.
    TypeError
        If a module's name is neither a problem nor a function that returns one.

    Examples
    --------
    >>> load("ou", radius=2).safe[0].region.radius
    2.0
    """
    text = str(source)
    if text.endswith((".toml", *YAML)) or isinstance(source, Path):
        return _load_file(Path(source), parameters)
    if ":" in text and not Path(text).exists():
        return _load_module(text, parameters)
    from certbound.problem.library import MODELS

    if text in MODELS:
        return MODELS[text](**parameters)
    if Path(text).is_file():
        return _load_file(Path(text), parameters)
    hint = nearest(text, MODELS).rstrip(".")
    raise ValueError(f"no bundled problem is called {text!r}{hint} (or give a file.toml, or module:name).")


def loads(text: str, *, folder: Path | None = None, **parameters: Any) -> Problem:
    """A problem from the text of a problem file; ``plan.file`` and networks are read from ``folder`` only.

    Errors are those of ``load``.
    """
    try:
        content = tomllib.loads(text.removeprefix("\ufeff"), parse_float=_decimal)
    except tomllib.TOMLDecodeError as error:
        twice = "; a key or a table stands there twice" if "overwrite" in f"{error}" or "twice" in f"{error}" else ""
        raise ValueError(f"the problem file is not TOML: {error}{twice}.") from error
    except RecursionError as error:
        raise ValueError("the problem file is nested too deeply.") from error
    if not content:
        raise ValueError("the problem file is empty; `certbound new NAME` writes one that works.")
    return _built(content, folder, parameters)


def _decimal(written: str) -> float:
    """A TOML number with a point or an exponent: one that is too large is not what ``inf`` says."""
    value = float(written)
    if math.isinf(value) and not written.endswith("inf"):
        raise ValueError(f"the problem file must not hold {written[:40]}, which is too large; write inf for no end.")
    return value


def notes(source: str | Path) -> tuple[str, ...]:
    """What ``load`` takes for what in a file of another tool, a line for each of its keys; nothing for any other."""
    path = Path(source)
    return restate(_text_of(path), path.stem).notes if path.suffix in YAML else ()


def _built(content: dict[str, Any], folder: Path | None, parameters: Mapping[str, Any]) -> Problem:
    from pydantic import ValidationError

    from certbound.problem.files.reading import read_problem
    from certbound.problem.files.schema import Specification, explain

    _set_parameters(content, parameters)
    try:
        specification = Specification.model_validate(content)
    except ValidationError as error:
        raise ValueError(f"the problem file is wrong: {explain(error)}") from error
    return read_problem(specification, folder, content)


def save(problem: Problem, path: str | Path) -> None:
    """Write a problem file that ``load`` reads back as the same problem.

    A problem that came from a file is written as it was there, with the parameters that were set; any other
    one with its traced model turned into expressions. An array plan goes to ``<stem>.plan.json`` beside the
    file, a network to ``<stem>.<name>.npz``.

    Parameters
    ----------
    problem : Problem
        What to write.
    path : str or Path
        File to write, ending in ``.toml``.

    Raises
    ------
    ValueError
        If the path does not end in ``.toml``, or the model uses what problem files do not have (the
        kink of a derivative).
    """
    from certbound.problem.files.writing import content_of, networks_of

    instance("problem", problem, Problem)
    target = Path(path)
    if target.suffix != ".toml":
        raise ValueError(f"`path` must end in .toml, got {str(path)!r}.")
    plan_file = f"{target.stem}.plan.json"
    content = content_of(problem, plan_file)
    if isinstance(problem.plan, np.ndarray):
        write_plan(target.with_name(plan_file), problem.plan, problem.system.input_names)
    for name, network in networks_of(problem).items():
        write_network(NetworkFunction(network), target.with_name(f"{target.stem}.{name}.npz"))
    target.write_text(toml_text(content), encoding="utf-8")


def _load_file(path: Path, parameters: Mapping[str, Any]) -> Problem:
    text = _text_of(path)
    if path.suffix in YAML:
        return _built(restate(text, path.stem).content, None, parameters)
    return loads(text, folder=path.parent, **parameters)


def _text_of(path: Path) -> str:
    try:
        if path.stat().st_size > _LARGEST:
            raise ValueError(f"`source` must be smaller than {_LARGEST // 10**6} MB, {str(path)!r} is not.")
        return path.read_text(encoding="utf-8")
    except OSError as error:
        reason = error.strerror or "no access"
        raise ValueError(f"`source` must be a readable file, got {str(path)!r}: {reason}.") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"`source` must be a text file in UTF-8, got {str(path)!r}.") from error


def _set_parameters(content: dict[str, Any], given: Mapping[str, Any]) -> None:
    known = content.get("parameters", {})
    for name, value in given.items():
        if not isinstance(known, dict) or name not in known:
            raise ValueError(f"`{name}` is no parameter of this problem{nearest(name, known)}")
        known[name] = number(name, value)


def _load_module(text: str, parameters: Mapping[str, Any]) -> Problem:
    module_name, _, name = text.partition(":")
    parts = module_name.split(".")
    if not all(part.isidentifier() for part in parts):
        raise ValueError(f"`source` must be package.module:name, got {text!r}.")
    try:
        module = _import(module_name)
    except ModuleNotFoundError as error:  # one that the module itself imports is an error inside it
        if error.name not in {".".join(parts[: k + 1]) for k in range(len(parts))}:
            raise
        raise ValueError(f"`source` must name an importable module, got {text!r}: {error}.") from error
    if not hasattr(module, name):
        public = [entry for entry in vars(module) if not entry.startswith("_")]
        raise ValueError(f"module {module_name!r} has no {name!r}{nearest(name, public)}")
    value = getattr(module, name)
    if isinstance(value, Problem):
        if parameters:
            raise ValueError(
                f"{text!r} is a finished problem without parameters; make it a function of them."
            )
        return value
    problem = value(**parameters) if isinstance(value, Callable) else None  # type: ignore[arg-type]  # Callable is no type to mypy
    if not isinstance(problem, Problem):
        got = f"a function that returned {problem!r}" if problem is not value and callable(value) else repr(value)
        cure = "; make it the `system` of a cb.Problem." if hasattr(value, "disturbance") else "."
        raise TypeError(f"{text!r} must be a cb.Problem or a function that returns one, got {got}{cure}")
    return problem


def _import(name: str) -> Any:
    """Import a module, also from the current folder."""
    sys.path.insert(0, str(Path.cwd()))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.pop(0)
