"""What compiled kernels call, and where they are kept."""

from __future__ import annotations

from certbound.simulation.compiled.cache import load_kernel, write_atomically
from certbound.simulation.compiled.streams import seed_stream, start_generator

__all__ = ["load_kernel", "seed_stream", "start_generator", "write_atomically"]
