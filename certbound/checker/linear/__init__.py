"""The linear-response proof, checked (Thm K7)."""

from __future__ import annotations

from certbound.checker.linear.proof import check_linear

__all__ = ["check_linear"]
