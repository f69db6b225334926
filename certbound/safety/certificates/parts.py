"""What writers of a proof share: a direction for every obstacle that asks for one, and many numbers as one text."""

from __future__ import annotations

import base64
import re
import zlib
from collections.abc import Callable
from functools import wraps
from typing import Any

from certbound.arrays import Array
from certbound.problem.jumps_as_plan import in_pieces
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside
from certbound.safety.answers import EngineAnswer, Proof


def separations(problem: Problem, stated: Callable[[int, Inside], Any]) -> list[Any]:
    """What is stated of every obstacle to keep it off, piece by piece, by its number; null for other constraints."""
    found = [
        stated(number, constraint) if constraint.outside and constraint.region.kind != "halfspace" else None
        for number, constraint in enumerate(problem.safe)
    ]
    return found if problem.domain is None else [*found, None]


def packed(numbers: Array) -> str:
    """Numbers as exact hexadecimal notation, compressed and in base 64.

    Without zeros at their ends a quick search finds what repeats; that zlib looks further takes ten times as long.
    """
    words = " ".join(value.hex() for value in numbers.ravel().tolist())
    return base64.b64encode(zlib.compress(re.sub("(?<=[0-9a-f])0+p", "p", words).encode("ascii"))).decode("ascii")


Writer = Callable[[Problem, EngineAnswer, int], Proof]


def in_time_pieces(write: Writer) -> Writer:
    """A writer for a model that jumps at known times: ``jumps`` is the number of pieces that end there."""

    @wraps(write)
    def written(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
        pieces = in_pieces(problem)
        proof, log10, assumptions = write(pieces, answer, attempt)
        return (proof if pieces is problem else proof | {"jumps": len(pieces.plan)}), log10, assumptions

    return written
