"""The proof by the exact law of an affine model, checked (docs/theory.md, section 9, "Affine models exactly")."""

from __future__ import annotations

from certbound.checker.affine.proof import check_affine

__all__ = ["check_affine"]
