"""Affine models with additive noise, exactly: no remainder, and a deviation whose law is known."""

from __future__ import annotations

from certbound.reach.affine.exit_bounds import (
    AffineAnswer,
    AffineFailing,
    affine_answer,
    affine_failing,
    affine_pieces,
)

__all__ = ["affine_answer", "affine_failing", "affine_pieces", "AffineAnswer", "AffineFailing"]
