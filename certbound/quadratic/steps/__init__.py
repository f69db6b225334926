"""Quadratic value bounds in discrete time: convex V, any noise with a variance proxy, models with kinks."""

from __future__ import annotations

from certbound.quadratic.steps.step_bounds import StepsBound, bound_steps

__all__ = ["StepsBound", "bound_steps"]
