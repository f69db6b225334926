"""Sweeps: the verdict at every point of a grid of parameters, or where it changes."""

from __future__ import annotations

from certbound.safety.sweeps.found import Sweep
from certbound.safety.sweeps.running import sweep

__all__ = ["Sweep", "sweep"]
