"""The error family.

Malformed input raises a plain ``ValueError`` or ``TypeError`` whose message names the argument, the rule, the
value and the cure. The classes below are for work that was understood and could not be done. "Not safe" and
"unknown" are answers, not errors.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator

_LONGEST = 200  # letters of a foreign message that are repeated
_log = logging.getLogger(__name__)


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


class EngineError(CertboundError, ArithmeticError):
    """A method does not carry through a problem that is legal; the message says which, why and what may help."""


@contextlib.contextmanager
def contained(engine: str) -> Iterator[None]:
    """Turn whatever goes wrong in the block into an ``EngineError``; the input has to be checked before it.

    What certbound raises on its own account keeps its words, also from the checks of its inner rooms, whose
    arguments are then certbound's own. Anything else is a defect and called so; its trace is logged. A warning that
    was turned into an error stays what it is.

    Raises
    ------
    EngineError
        For every exception in the block but warnings.

    Examples
    --------
    >>> with contained("linear"):
    ...     raise ZeroDivisionError("division by zero")
    Traceback (most recent call last):
    ...
    certbound.errors.EngineError: the linear engine failed (ZeroDivisionError: division by zero).
    """
    try:
        yield
    except (EngineError, Warning):
        raise
    except (CertboundError, ArithmeticError, ValueError, MemoryError, RecursionError) as error:
        own = isinstance(error, CertboundError) or type(error) is ArithmeticError
        raise EngineError(str(error) if own else _failure(engine, error)) from error
    except Exception as error:  # all of them: one engine's defect must not hide what another one proved
        cause = error.__cause__
        if isinstance(error, SystemError) and cause is not None and not isinstance(cause, Exception):
            raise cause from None  # a time limit, or the user, within compiled code
        _log.debug("the %s engine failed", engine, exc_info=True)
        raise EngineError(f"{_failure(engine, error)} This is a defect of certbound.") from error


def _failure(engine: str, error: Exception) -> str:
    words = " ".join(str(error).split()).rstrip(".")
    short = words if len(words) <= _LONGEST else f"{words[:_LONGEST]}..."
    return f"the {engine} engine failed ({type(error).__name__}{': ' if short else ''}{short})."
