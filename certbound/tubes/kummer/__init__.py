"""Tubes and exit probabilities from Kummer and Bessel supermartingales, one or a mixture."""

from __future__ import annotations

from certbound.tubes.kummer.exit import exit_level, union_level, union_may_help
from certbound.tubes.kummer.mixing import mixture_level, mixture_tube
from certbound.tubes.kummer.profile import KummerProfile, Start, check_power, check_start
from certbound.tubes.kummer.search import Search

__all__ = [
    "check_power",
    "check_start",
    "exit_level",
    "KummerProfile",
    "mixture_level",
    "mixture_tube",
    "Search",
    "Start",
    "union_level",
    "union_may_help",
]
