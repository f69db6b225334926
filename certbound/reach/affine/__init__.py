"""Affine models with additive noise, exactly: no remainder, and a deviation whose law is known."""

from __future__ import annotations

from certbound.reach.affine.answer import AffineAnswer, AffineFailing, affine_answer, affine_failing
from certbound.reach.affine.reading import AffineModel, affine_model

__all__ = ["affine_answer", "affine_failing", "affine_model", "AffineAnswer", "AffineFailing", "AffineModel"]
