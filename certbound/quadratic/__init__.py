"""Quadratic value bounds by semidefinite programming (Thm K9): several states, everyday noise."""

from __future__ import annotations

from certbound.quadratic.refinement import QuadraticBound, bound_quadratic
from certbound.quadratic.steps import StepsBound, bound_steps

__all__ = ["QuadraticBound", "StepsBound", "bound_quadratic", "bound_steps"]
