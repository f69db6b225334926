"""certbound: certified probabilities that a noisy nonlinear system leaves its safe set.

Every name below is loaded when it is first used, so that reading a certificate imports neither CasADi nor cvxpy.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from certbound._version import __version__
from certbound.display import connect
from certbound.lazy import lazily, names_in

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
    from certbound.plotting import animate as animate
    from certbound.problem.export import export_casadi as export_casadi
    from certbound.problem.export import export_control as export_control
    from certbound.problem.files import load as load
    from certbound.problem.files import save as save
    from certbound.problem.filters import Filter as Filter
    from certbound.problem.loops import estimate_loop as estimate_loop
    from certbound.problem.networks import network as network
    from certbound.problem.noise import Bounded as Bounded
    from certbound.problem.noise import Gaussian as Gaussian
    from certbound.problem.noise import Rademacher as Rademacher
    from certbound.problem.noise import SubGaussian as SubGaussian
    from certbound.problem.noise import Triangular as Triangular
    from certbound.problem.noise import Uniform as Uniform
    from certbound.problem.problem import Problem as Problem
    from certbound.problem.random_constants import Random as Random
    from certbound.problem.sets import Ball as Ball
    from certbound.problem.sets import Box as Box
    from certbound.problem.sets import Ellipsoid as Ellipsoid
    from certbound.problem.sets import GaussianStart as GaussianStart
    from certbound.problem.sets import HalfSpace as HalfSpace
    from certbound.problem.sets import Inside as Inside
    from certbound.problem.sets import Outside as Outside
    from certbound.problem.sets import Polytope as Polytope
    from certbound.problem.sets import Reach as Reach
    from certbound.problem.systems import ContinuousSystem as ContinuousSystem
    from certbound.problem.systems import DiscreteSystem as DiscreteSystem
    from certbound.problem.systems import from_control as from_control
    from certbound.problem.systems import linear_system as linear_system
    from certbound.problem.table_laws import Discrete as Discrete
    from certbound.problem.table_laws import Histogram as Histogram
    from certbound.problem.table_laws import Laplace as Laplace
    from certbound.reach import bound_reach as bound_reach
    from certbound.reach.sets import ReachTube as ReachTube
    from certbound.safety.first_exits import bound_exit_times as bound_exit_times
    from certbound.safety.sweeps import Sweep as Sweep
    from certbound.safety.sweeps import sweep as sweep
    from certbound.safety.verdict import Verdict as Verdict
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
    "problem.systems": "ContinuousSystem DiscreteSystem linear_system from_control",
    "problem.filters": "Filter",
    "problem.loops": "estimate_loop",
    "problem.random_constants": "Random",
    "problem.noise": "Gaussian Uniform Triangular Rademacher Bounded SubGaussian",
    "problem.table_laws": "Discrete Histogram Laplace",
    "problem.sets": "Box Ball Ellipsoid HalfSpace Polytope GaussianStart Inside Outside Reach",
    "problem.networks": "network",
    "problem.problem": "Problem",
    "problem.files": "load save",
    "problem.export": "export_casadi export_control",
    "display": "load_result",
    "tubes.constants": "Constants",
    "tubes.tube": "Tube",
    "tubes.tuning": "tune_tube bound_exit_probability",
    "tubes.paper": "AffineMartingale estimate_affine_excess log_energy",
    "simulation.estimates": "simulate_exits sample_paths",
    "constants.bounds": "bound_constants",
    "constants.metrics": "bound_metrics",
    "reach": "bound_reach",
    "reach.sets": "ReachTube",
    "safety.verification": "verify_safety",
    "safety.sweeps": "sweep Sweep",
    "safety.verdict": "Verdict",
    "safety.first_exits": "bound_exit_times",
    "synthesis.plans": "synthesize_plan",
    "synthesis.controllers": "simulate_closed_loop PredictiveController ConvexPlanner SafetyFilter",
    "synthesis.terminal": "TerminalSet",
    "plotting": "animate",
    "errors": "CertboundError CertificateError EnclosureError EngineError InfeasibleError SolverError",
}

__all__ = ["__version__", *names_in(_HOME)]


def _draw(result: Any, axes: Any, states: Any, times: Any) -> None:
    from certbound.plotting.results import draw_chosen

    draw_chosen(result, axes, states, times)


def _content(problem: Any, plan_file: str) -> dict[str, Any]:
    from certbound.problem.files import content_of

    return content_of(problem, plan_file)


def _constants(data: dict[str, Any]) -> Any:
    from certbound.tubes.constants import Constants

    return Constants.from_dict(data)


connect(draw=_draw, content=_content, constants=_constants)

__getattr__, __dir__ = lazily(__name__, _HOME, __all__)
