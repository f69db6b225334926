"""Quadratic value bounds by semidefinite programming (Thm K9): several states, everyday noise, continuous time."""

from __future__ import annotations

from certbound.quadratic.refinement import QuadraticBound, bound_quadratic

__all__ = ["bound_quadratic", "QuadraticBound"]
