"""certbound: certified probabilities that a noisy nonlinear system leaves its safe set.

Every name below is loaded when it is first used, so that reading a certificate imports neither CasADi nor cvxpy.
"""

from __future__ import annotations

import importlib
import logging
from typing import TYPE_CHECKING, Any

from certbound._version import __version__
from certbound.display import connect

if TYPE_CHECKING:  # what mypy and editors read; a test compares it with the table below
    from certbound.constants.bounds import bound_constants as bound_constants
    from certbound.constants.metrics import bound_metrics as bound_metrics
    from certbound.display import load_result as load_result
    from certbound.errors import CertboundError as CertboundError
    from certbound.errors import CertificateError as CertificateError
    from certbound.errors import EnclosureError as EnclosureError
    from certbound.errors import EngineError as EngineError
    from certbound.errors import InfeasibleError as InfeasibleError
    from certbound.errors import SolverError as SolverError
    from certbound.problem.export import export_casadi as export_casadi
    from certbound.problem.export import export_control as export_control
    from certbound.problem.files import load as load
    from certbound.problem.files import save as save
    from certbound.problem.noise import Bounded as Bounded
    from certbound.problem.noise import Gaussian as Gaussian
    from certbound.problem.noise import Rademacher as Rademacher
    from certbound.problem.noise import SubGaussian as SubGaussian
    from certbound.problem.noise import Uniform as Uniform
    from certbound.problem.problem import Problem as Problem
    from certbound.problem.sets import Ball as Ball
    from certbound.problem.sets import Box as Box
    from certbound.problem.sets import Ellipsoid as Ellipsoid
    from certbound.problem.sets import GaussianStart as GaussianStart
    from certbound.problem.sets import HalfSpace as HalfSpace
    from certbound.problem.sets import Inside as Inside
    from certbound.problem.sets import Outside as Outside
    from certbound.problem.sets import Polytope as Polytope
    from certbound.problem.systems import ContinuousSystem as ContinuousSystem
    from certbound.problem.systems import DiscreteSystem as DiscreteSystem
    from certbound.problem.systems import from_control as from_control
    from certbound.problem.systems import linear_system as linear_system
    from certbound.reach import bound_reach as bound_reach
    from certbound.reach.sets import ReachTube as ReachTube
    from certbound.safety.verification import Verdict as Verdict
    from certbound.safety.verification import verify_safety as verify_safety
    from certbound.simulation.estimates import sample_paths as sample_paths
    from certbound.simulation.estimates import simulate_exits as simulate_exits
    from certbound.synthesis.controllers import ConvexPlanner as ConvexPlanner
    from certbound.synthesis.controllers import PredictiveController as PredictiveController
    from certbound.synthesis.controllers import SafetyFilter as SafetyFilter
    from certbound.synthesis.controllers import simulate_closed_loop as simulate_closed_loop
    from certbound.synthesis.plans import synthesize_plan as synthesize_plan
    from certbound.synthesis.terminal import TerminalSet as TerminalSet
    from certbound.tubes.constants import Constants as Constants
    from certbound.tubes.paper import AffineMartingale as AffineMartingale
    from certbound.tubes.paper import estimate_affine_excess as estimate_affine_excess
    from certbound.tubes.paper import log_energy as log_energy
    from certbound.tubes.tube import Tube as Tube
    from certbound.tubes.tuning import bound_exit_probability as bound_exit_probability
    from certbound.tubes.tuning import tune_tube as tune_tube

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
    "Tube": "tubes.tube",
    "tune_tube": "tubes.tuning",
    "bound_exit_probability": "tubes.tuning",
    "AffineMartingale": "tubes.paper",
    "estimate_affine_excess": "tubes.paper",
    "log_energy": "tubes.paper",
    "simulate_exits": "simulation.estimates",
    "sample_paths": "simulation.estimates",
    "bound_constants": "constants.bounds",
    "bound_metrics": "constants.metrics",
    "bound_reach": "reach",
    "ReachTube": "reach.sets",
    "verify_safety": "safety.verification",
    "Verdict": "safety.verification",
    "synthesize_plan": "synthesis.plans",
    "simulate_closed_loop": "synthesis.controllers",
    "PredictiveController": "synthesis.controllers",
    "ConvexPlanner": "synthesis.controllers",
    "SafetyFilter": "synthesis.controllers",
    "TerminalSet": "synthesis.terminal",
    "CertboundError": "errors",
    "CertificateError": "errors",
    "EnclosureError": "errors",
    "EngineError": "errors",
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
