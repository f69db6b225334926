"""The reach room: nominal curves, reach tubes and the engines that prove them.

``bound_reach`` is loaded when it is first used.
"""

from __future__ import annotations

from typing import Any

from certbound.lazy import load_name

__all__ = ["bound_reach"]

_HOME = {"dispatch": "bound_reach"}


def __getattr__(name: str) -> Any:
    return load_name(__name__, _HOME, name)
