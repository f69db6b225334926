"""What a certificate states: the problem, its constraints, its cells, and what they ask for."""

from __future__ import annotations

from certbound.checker.statement.by_ito import logarithmic_model
from certbound.checker.statement.comparison import first_difference
from certbound.checker.statement.drawn import weights_of
from certbound.checker.statement.partition import cells_of, starts_of
from certbound.checker.statement.problem import Model, met_at, read_model
from certbound.checker.statement.regions import Constraint
from certbound.checker.statement.rooms import Grid, demands, round_demands
from certbound.checker.statement.safe_set import SafeSet, StepSet
from certbound.checker.statement.structure import Structure, structure_of
from certbound.checker.statement.turned import turned_model

__all__ = [
    "cells_of",
    "Constraint",
    "demands",
    "first_difference",
    "Grid",
    "logarithmic_model",
    "met_at",
    "Model",
    "read_model",
    "round_demands",
    "SafeSet",
    "starts_of",
    "StepSet",
    "Structure",
    "structure_of",
    "turned_model",
    "weights_of",
]
