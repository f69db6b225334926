"""The linear response where inputs are computed at sampling times and held."""

from __future__ import annotations

from certbound.reach.linear.held.held_linearisation import HeldLinearisation

__all__ = ["HeldLinearisation"]
