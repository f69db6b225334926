"""Networks that a model writes out, found again in its tape."""

from __future__ import annotations

from certbound.problem.model.networks_found.written_layers import with_layers

__all__ = ["with_layers"]
