"""Proofs for every horizon at once: functions of the state alone, of one state but where every path leaves."""

from __future__ import annotations

from certbound.checker.endless.eigenfunction import check_leaving, check_leaving_below
from certbound.checker.endless.scale_function import check_drift, check_lasting, check_lasting_below
from certbound.checker.endless.surely import check_surely, check_surely_below

__all__ = [
    "check_drift", "check_lasting", "check_lasting_below", "check_leaving", "check_leaving_below", "check_surely",
    "check_surely_below",
]
