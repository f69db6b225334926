"""The reach room: nominal curves, reach tubes and the engines that prove them.

``bound_reach`` is loaded when it is first used.
"""

from __future__ import annotations

from typing import Any

__all__ = ["bound_reach"]


def __getattr__(name: str) -> Any:
    if name == "bound_reach":
        from certbound.reach.dispatch import bound_reach

        return bound_reach
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
