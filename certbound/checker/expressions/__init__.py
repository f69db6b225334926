"""Expressions on balls: graphs and their derivatives, programs, Taylor models, upper bounds."""

from __future__ import annotations

from certbound.checker.expressions.arithmetic import Undecided
from certbound.checker.expressions.ceiling import Ceiling, Side
from certbound.checker.expressions.expansion import Expansion
from certbound.checker.expressions.graph import Graph
from certbound.checker.expressions.program import Program
from certbound.checker.expressions.quadratic import Cut, Quadratic
from certbound.checker.expressions.series import expand

__all__ = ["Ceiling", "Cut", "expand", "Expansion", "Graph", "Program", "Quadratic", "Side", "Undecided"]
