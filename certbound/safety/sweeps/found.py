"""What a sweep found."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

from certbound.display import Shown, name_text

FAILED = "FAILED"
"""The status of a point that has no verdict, for a reason that ``reason`` names."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """The verdict at one point of the grid, and the seconds that it took."""

    parameters: Mapping[str, float]
    status: str
    log10_delta: float
    log10_lower: float | None
    method: str
    reason: str
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """The row as plain data."""
        return asdict(self) | {"parameters": dict(self.parameters)}


@dataclass(frozen=True, kw_only=True)
class Boundary:
    """Where the status changes along one parameter: the last value that is SAFE, and the next one, which is not.

    ``safe`` is None where neither end of the range is SAFE, ``not_safe`` where both are. Values between the ones that
    were tried are taken to follow their neighbours.
    """

    parameters: Mapping[str, float]  # the others
    name: str
    safe: float | None
    not_safe: float | None
    log10_delta: float | None  # at `safe`

    def summary(self) -> str:
        """The boundary in one line."""
        others = ", ".join(f"{name} = {value:.6g}" for name, value in self.parameters.items())
        where = f"{others}: " if others else ""
        if self.safe is None:
            return f"{where}{self.name} is SAFE at neither end"
        if self.not_safe is None:
            return f"{where}{self.name} is SAFE at both ends, up to {self.safe:.6g}"
        end = "largest" if self.safe < self.not_safe else "smallest"
        return f"{where}{end} SAFE {self.name} {self.safe:.6g} (not {self.not_safe:.6g})"


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Sweep(Shown):
    """Verdicts over a grid of parameters.

    Parameters
    ----------
    name : str
        The problem's.
    delta : float or None
        The accepted probability; None where the sweep changes it.
    over : mapping
        Each parameter's values, in increasing order.
    points : tuple of Row
        ``parameters``, ``status``, ``log10_delta``, ``log10_lower``, ``method``, ``reason``, ``seconds`` of each point
        that was proved; the last parameter changes first. The status of a point without a verdict is FAILED.
    boundaries : tuple of Boundary or None
        Where the status changes along one parameter, for every choice of the others; None where that was not asked.
    """

    pictured: ClassVar[bool] = True

    name: str
    delta: float | None
    over: Mapping[str, tuple[float, ...]]
    points: tuple[Row, ...]
    boundaries: tuple[Boundary, ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "over", MappingProxyType(dict(self.over)))

    def summary(self) -> str:
        """How many points have which status."""
        counts = Counter(row.status for row in self.points)
        found = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
        return f"{name_text(self.name)} over {', '.join(self.over)}: {len(self.points)} points, {found}"

    def rows(self) -> list[tuple[str, str]]:
        """The boundaries, where they were asked for."""
        return [("boundary", found.summary()) for found in self.boundaries or ()]

    def to_dict(self) -> dict[str, Any]:
        """What ``certbound sweep --json`` prints, but for the seconds of all."""
        found: dict[str, Any] = {"rows": [row.to_dict() for row in self.points]}
        if self.boundaries is not None:
            found["boundary"] = [asdict(one) | {"parameters": dict(one.parameters)} for one in self.boundaries]
        return found

    def to_columns(self) -> dict[str, list[Any]]:
        """One list a parameter and a key of the verdict, as ``pandas.DataFrame`` takes it."""
        found = {name: [row.parameters[name] for row in self.points] for name in self.over}
        keys = ("status", "log10_delta", "log10_lower", "method", "seconds")
        return found | {key: [getattr(row, key) for row in self.points] for key in keys}

    def to_csv(self, path: str | Path) -> None:
        """Write `table` to a file.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        Path(path).write_text(self.table(), encoding="utf-8", newline="")

    def table(self) -> str:
        """One line a point, or a boundary where these were asked for, as CSV; the seconds stand last."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        if self.boundaries is None:
            columns = self.to_columns()
            writer.writerow(columns)
            writer.writerows(zip(*columns.values(), strict=True))
        else:
            others = [name for name in self.over if name != self.boundaries[0].name]
            writer.writerow([*others, f"{self.boundaries[0].name}_safe", f"{self.boundaries[0].name}_not_safe",
                             "log10_delta"])  # fmt: skip
            for one in self.boundaries:
                writer.writerow([*one.parameters.values(), one.safe, one.not_safe, one.log10_delta])
        return stream.getvalue()
