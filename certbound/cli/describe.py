"""Results as plain dictionaries: what --json prints of constants, tubes and verdicts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.display import rounded

if TYPE_CHECKING:
    from certbound.safety.verification import Verdict
    from certbound.tubes.constants import Constants
    from certbound.tubes.tube import Tube


def attributes(found: Any, *names: str) -> dict[str, Any]:
    """Some attributes of a result, by name."""
    return {name: getattr(found, name) for name in names}


def describe_constants(constants: Constants) -> dict[str, Any]:
    """``rate`` or ``gain``, ``sigma``, ``effective_dimension``, ``metric``, and what they rest on."""
    name = "rate" if constants.continuous else "gain"
    return {
        **attributes(constants, name, "sigma"),
        "effective_dimension": constants.nu,
        **attributes(constants, "metric", "isotropic", "times", "certified", "gap"),
        "domain": None if constants.proof is None else constants.proof.domain,
    }


def describe_parameters(tube: Tube) -> dict[str, Any]:
    """The free parameters that the tuning settled on."""
    return {key: np.asarray(value).tolist() for key, value in dict(tube.parameters).items()}


def describe_deviation(verdict: Verdict) -> dict[str, Any] | None:
    """``times``, and per piece an upper bound on the size of X - x and on its half-width in each state.

    Piece k is [times[k], times[k+1]] with both ends; in discrete time it covers the steps k and k + 1. None
    where no tube could be certified.
    """
    return None if verdict.deviation is None else attributes(verdict.deviation, "times", "radius", "extent")


def deviation_text(tube: Mapping[str, Any], names: Sequence[str]) -> str:
    """The largest deviation of a tube: its norm, or by state where it bounds some of the states alone."""
    if math.isfinite(radius := max(tube["radius"])):
        return f"at most {rounded(float(radius), up=True, digits=4)}"
    largest = zip(names, map(max, zip(*tube["extent"])))
    bounded = [f"{rounded(float(size), up=True, digits=4)} in {name}" for name, size in largest if math.isfinite(size)]
    return f"at most {', '.join(bounded)}" if bounded else "not bounded"
