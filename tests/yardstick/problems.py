"""The table of problems, and each of them as a `certbound.Problem`."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import certbound as cb
from certbound.problem.files.loading import loads
from certbound.problem.files.toml import toml_text

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
_ASK, _LIMIT = 3.0, 20.0


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One problem of the table.

    Attributes
    ----------
    name, kind : str
    truth : float
        The probability of failing, about.
    ask : float
        delta over the truth, of the question that is to be decided.
    limit : float
        Seconds that each question may take.
    use : str
        ``place:name`` of a problem that is stated elsewhere, or the name of a bundled one; empty for none.
    content : mapping
        The problem file, where there is no ``use``.
    """

    name: str
    kind: str
    truth: float
    ask: float
    limit: float
    use: str
    content: Mapping[str, Any]

    def problem(self) -> cb.Problem:
        """The problem, at the delta that is to be decided."""
        found = _used(self.use) if self.use else loads(toml_text(self.content))
        return found.replace(delta=self.ask * self.truth)


@cache
def entries() -> dict[str, Entry]:
    """The table by name, in its order."""
    tables = tomllib.loads((HERE / "problems.toml").read_text(encoding="utf-8"))
    return {name: _entry(name, dict(table)) for name, table in tables.items()}


def _entry(name: str, table: dict[str, Any]) -> Entry:
    take = table.pop
    return Entry(
        name=name, kind=take("class"), truth=take("truth"), ask=take("ask", _ASK), limit=take("limit", _LIMIT),
        use=take("use", ""), content=table,
    )  # fmt: skip


def _used(source: str) -> cb.Problem:
    place, _, name = source.rpartition(":")
    return PLACES[place](name)


def _of_zoo(name: str) -> cb.Problem:
    from tests.zoo import ZOO

    return ZOO[name](1.0, 1.0)


def _of_values(name: str) -> cb.Problem:
    from experiments.values import CASES

    return next(case.problem() for case in CASES if case.name == name)


PLACES: dict[str, Callable[[str], cb.Problem]] = {
    "": cb.load,
    "zoo": _of_zoo,
    "values": _of_values,
    "gallery": lambda name: cb.load(ROOT / "docs" / "gallery" / f"{name}.toml"),
    "benchmarks": lambda name: cb.load(ROOT / "experiments" / "benchmarks" / f"{name}.toml"),
}
"""What stands before the colon of ``use``, to where the problem comes from."""
