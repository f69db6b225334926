"""The constants proof, checked (Thms K2 and K5)."""

from __future__ import annotations

from certbound.checker.constants.proof import check_constants

__all__ = ["check_constants"]
