"""What a certificate states: the problem, its constraints, its cells, and what they ask for."""

from __future__ import annotations

from certbound.checker.statement.comparison import first_difference
from certbound.checker.statement.drawn import weights_of
from certbound.checker.statement.partition import cells_of, starts_of
from certbound.checker.statement.problem import Change, Model, met_at, read_model
from certbound.checker.statement.regions import Constraint
from certbound.checker.statement.rooms import Grid, demands, round_demands
from certbound.checker.statement.safe_set import SafeSet, StepSet
from certbound.checker.statement.structure import Structure, structure_of
from certbound.checker.statement.turned import restated

__all__ = [
    "cells_of",
    "Change",
    "Constraint",
    "demands",
    "first_difference",
    "Grid",
    "met_at",
    "Model",
    "read_model",
    "restated",
    "round_demands",
    "SafeSet",
    "starts_of",
    "StepSet",
    "Structure",
    "structure_of",
    "weights_of",
]
