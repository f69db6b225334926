"""What acts in closed loop: predictive control, convex planning, the safety filter; runs of it."""

from __future__ import annotations

from certbound.synthesis.controllers.closed_loop import ClosedLoop, simulate_closed_loop
from certbound.synthesis.controllers.convex import ConvexPlanner
from certbound.synthesis.controllers.filter import SafetyFilter
from certbound.synthesis.controllers.receding import PredictiveController

__all__ = ["ClosedLoop", "ConvexPlanner", "PredictiveController", "SafetyFilter", "simulate_closed_loop"]
