"""Tubes and exit probabilities from Kummer and Bessel supermartingales, one or a mixture."""

from __future__ import annotations

from certbound.tubes.kummer.exit import exit_level, union_level, union_may_help
from certbound.tubes.kummer.mixing import mixture_level, mixture_tube
from certbound.tubes.kummer.profile import KummerProfile, check_power
from certbound.tubes.kummer.search import Search, moderate_parameters

__all__ = [
    "check_power",
    "exit_level",
    "KummerProfile",
    "mixture_level",
    "moderate_parameters",
    "mixture_tube",
    "Search",
    "union_level",
    "union_may_help",
]
