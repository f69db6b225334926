"""Proofs for every horizon at once, one state: functions of the state alone."""

from __future__ import annotations

from certbound.checker.endless.eigenfunction import check_leaving, check_leaving_below
from certbound.checker.endless.scale_function import check_drift, check_lasting, check_lasting_below

__all__ = ["check_drift", "check_lasting", "check_lasting_below", "check_leaving", "check_leaving_below"]
