"""The reach room: nominal curves, reach tubes and the engines that prove them.

``bound_reach`` is loaded when it is first used.
"""

from __future__ import annotations

from certbound.lazy import lazily

__all__ = ["bound_reach"]

_HOME = {"dispatch": "bound_reach"}

__getattr__, __dir__ = lazily(__name__, _HOME, __all__)
