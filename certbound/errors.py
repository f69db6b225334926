"""The error family.

Malformed input raises a plain ``ValueError`` or ``TypeError`` whose message names the argument, the rule, the
value and the cure. The classes below are for work that was understood and could not be done. "Not safe" and
"unknown" are answers, not errors.
"""

from __future__ import annotations

__all__ = ["CertboundError", "CertificateError", "EnclosureError", "InfeasibleError", "SolverError"]


class CertboundError(Exception):
    """Base of everything that certbound raises on its own account."""


class InfeasibleError(CertboundError, ValueError):
    """No admissible point exists (or none was found); the message says which, and what to change."""


class SolverError(CertboundError, RuntimeError):
    """A numerical solver gave no usable answer; the message says what was tried."""


class CertificateError(CertboundError, ValueError):
    """A certificate file is malformed, or claims what could not be proved again."""


class EnclosureError(CertboundError, ArithmeticError):
    """A function has no finite enclosure on a box: the message names the expression and the box."""
