"""Problem files of other tools, restated as this package's: what each key became is said, what is unknown refused."""

from __future__ import annotations

from certbound.problem.foreign.yaml_files import restate

__all__ = ["restate"]
