"""Models whose law is known exactly, asked before the engines that know them as any other."""

from __future__ import annotations

from certbound.safety.laws.affine_models import by_law, of_laws

__all__ = ["by_law", "of_laws"]
