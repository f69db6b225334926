"""certbound: certified probabilities that a noisy nonlinear system leaves its safe set.

Every name below is loaded when it is first used, so that reading a certificate imports neither CasADi nor cvxpy.
"""

from __future__ import annotations

import importlib
import logging
from typing import Any

from certbound._version import __version__
from certbound.display import connect

logging.getLogger(__name__).addHandler(logging.NullHandler())

_HOME = {
    "ContinuousSystem": "problem.systems",
    "DiscreteSystem": "problem.systems",
    "linear_system": "problem.systems",
    "from_control": "problem.systems",
    "Gaussian": "problem.noise",
    "Uniform": "problem.noise",
    "Rademacher": "problem.noise",
    "Bounded": "problem.noise",
    "SubGaussian": "problem.noise",
    "Box": "problem.sets",
    "Ball": "problem.sets",
    "Ellipsoid": "problem.sets",
    "HalfSpace": "problem.sets",
    "Polytope": "problem.sets",
    "GaussianStart": "problem.sets",
    "Inside": "problem.sets",
    "Outside": "problem.sets",
    "Problem": "problem.problem",
    "load": "problem.files",
    "save": "problem.files",
    "export_casadi": "problem.export",
    "export_control": "problem.export",
    "load_result": "display",
    "Constants": "tubes.constants",
    "tune_tube": "tubes.tuning",
    "bound_exit_probability": "tubes.tuning",
    "simulate_exits": "simulation.estimates",
    "sample_paths": "simulation.estimates",
    "bound_constants": "constants.bounds",
    "bound_metrics": "constants.metrics",
    "bound_reach": "reach",
    "verify_safety": "safety.verification",
    "synthesize_plan": "synthesis.plans",
    "simulate_closed_loop": "synthesis.controllers",
    "PredictiveController": "synthesis.controllers",
    "ConvexPlanner": "synthesis.controllers",
    "SafetyFilter": "synthesis.controllers",
    "TerminalSet": "synthesis.terminal",
    "CertboundError": "errors",
    "CertificateError": "errors",
    "EnclosureError": "errors",
    "InfeasibleError": "errors",
    "SolverError": "errors",
}

__all__ = ["__version__", *_HOME]


def _draw(result: Any, axes: Any) -> None:
    from certbound.plotting.results import draw

    draw(result, axes)


def _content(problem: Any, plan_file: str) -> dict[str, Any]:
    from certbound.problem.files import content_of

    return content_of(problem, plan_file)


def _constants(data: dict[str, Any]) -> Any:
    from certbound.tubes.constants import Constants

    return Constants.from_dict(data)


connect(draw=_draw, content=_content, constants=_constants)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
