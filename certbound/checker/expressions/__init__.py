"""Expressions on balls: graphs and their derivatives, programs, Taylor models, upper bounds."""

from __future__ import annotations

from certbound.checker.expressions.arithmetic import Undecided
from certbound.checker.expressions.ceiling import Ceiling, Side
from certbound.checker.expressions.expansion import Expansion
from certbound.checker.expressions.graph import Graph
from certbound.checker.expressions.operations import OPERATIONS, is_partial
from certbound.checker.expressions.program import Program, expand
from certbound.checker.expressions.quadratic import Cut, Quadratic

__all__ = [
    "Ceiling", "Cut", "expand", "Expansion", "Graph", "is_partial", "OPERATIONS", "Program", "Quadratic", "Side",
    "Undecided",
]  # fmt: skip
