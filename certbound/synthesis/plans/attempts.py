"""Plan and tube for one kind of tube after another: widened to fit, cheapened, verified, or explained away."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertboundError
from certbound.safety.verification import Verdict, verify_safety
from certbound.synthesis.planning import FITTED, Planner, Tightened
from certbound.synthesis.plans.infeasibility import Infeasibility, smallest_delta
from certbound.synthesis.plans.outcome import Synthesis
from certbound.synthesis.plans.relaxation import bound_scale, empty_at_once
from certbound.synthesis.transcription import Solution
from certbound.tubes.constants import Constants
from certbound.tubes.tube import Tube

_LOG = logging.getLogger(__name__)

WIDENING = 6
"""Turns of tube and plan while the room still grows."""
METRICS = 4
"""Times that the metric is chosen anew around a plan that the tube does not fit."""
FIXED_POINT = 5
CLOSE = 1e-3
"""Relative change of the erosions at which plan and tube agree; at most FIXED_POINT turns."""
SLACK = 1e-6
"""Share by which every erosion is enlarged: a proof needs some room."""
REPAIRS = 5
"""Plans that are verified before the one with the most room is taken."""
INPUTS = "inputs within their bounds"
"""What the bounds of the inputs are called."""
ENOUGH = 1.02
"""Room (times the tube) from which no more is looked for."""


class Attempts:
    """One call: what its attempts share."""

    def __init__(
        self, planner: Planner, *, given: Tube | None, parameters: dict[str, Any], constants: Constants | None,
        find_delta: bool, tell: Callable[[str], None],
    ) -> None:  # fmt: skip
        self.planner, self.given, self.parameters, self.stated = planner, given, parameters, constants
        self.find_delta, self.tell = find_delta, tell
        self.delta = float(planner.problem.delta)
        self.refused: dict[str, tuple[Constants | None, Solution]] = {}
        self.trouble = "it could not be verified"

    def attempt(self, name: str, first: Solution) -> Synthesis | None:
        """The best plan for one tube; None where the linear response cannot be computed."""
        self.tell(f"tube {name}: looking for the plan with the most room")
        if name == "linear":
            constants = None
            widest, tightened = self._widen_response(first)
        else:
            constants, widest, tightened = self._widen_metric(name, first)
        if tightened is None:
            return None
        self.planner.settle_terminal(constants, tightened)
        found = self._planned(name, constants, widest, tightened)
        if found is None:
            verdict = self._verified(name, constants, widest, tightened)
            if verdict is not None and verdict.status == "SAFE":  # delta need not be split as the tightening does
                return self._result(name, constants, widest, tightened, widest.scale, verdict, feasible=True)
            return self._refused(name, constants, widest, tightened)
        solution, used, verdict = found
        delta = self._smallest(name, constants, widest) if self.find_delta else None
        result = self._result(name, constants, solution, used, widest.scale, verdict, feasible=True)
        if delta is not None:
            reason = f"{result.reason}. The smallest feasible delta found is {delta:.4g}.".replace("..", ".")
            result = replace(result, smallest_delta=delta, reason=reason)
        return result

    # ---- tubes and room ----------------------------------------------------------------------------------

    def _constants(self, first: Solution) -> Constants:
        if self.given is not None:
            return self.given.constants
        if self.stated is not None:
            return self.stated
        self.tell("constants in one common metric")
        return self.planner.constants(first.inputs)

    def _tube(self, name: str, constants: Constants, solution: Solution, delta: float) -> Tube:
        if self.given is not None and delta == self.delta:
            return self.given
        parameters = {} if self.given is not None else self.parameters
        return self.planner.tube_of(constants, name, delta, solution, parameters)

    def _widen_metric(self, name: str, first: Solution) -> tuple[Constants, Solution, Tightened]:
        """The widest pair of tube and plan; where it does not fit, the metric is chosen anew around that plan."""
        fixed = self.given is not None or self.stated is not None
        constants = self._constants(first)
        widest, tightened = self._widen_tube(name, constants, first)
        for _ in range(0 if fixed else METRICS):
            if widest.scale >= ENOUGH:
                break
            self.tell(f"tube {name}: another metric")
            other = self.planner.constants(widest.inputs)
            found, taken = self._widen_tube(name, other, widest)
            if not found.success or found.scale <= 1.001 * widest.scale:
                break
            constants, widest, tightened = other, found, taken
        return constants, widest, tightened

    def _widen_tube(
        self, name: str, constants: Constants, solution: Solution, delta: float | None = None
    ) -> tuple[Solution, Tightened]:
        """Fit the tube to the plan and the plan to the tube in turns; the widest pair."""
        best: tuple[Solution, Tightened] | None = None
        turns = WIDENING if name in FITTED and self.given is None else 2
        for _ in range(turns):
            tube = self._tube(name, constants, solution, self.delta if delta is None else delta)
            tightened = self.planner.around(tube, solution)
            found = self.planner.plan("scale", tightened, solution.inputs)
            gain = math.inf if best is None else found.scale / max(best[0].scale, 1e-9)
            if best is None or (found.success and found.scale > best[0].scale):
                best = found, tightened
            solution = found
            if (gain < ENOUGH and best[0].scale >= 1) or gain < 1.001:
                break
        assert best is not None
        return best

    def _widen_response(
        self, solution: Solution, delta: float | None = None
    ) -> tuple[Solution, Tightened | None]:
        """Iterate plan and linear response towards the plan with the most room."""
        best: tuple[Solution, Tightened | None] = solution, None
        for _ in range(WIDENING):
            tightened = self.planner.response(solution, self.delta if delta is None else delta)
            if tightened is None:
                break
            found = self.planner.plan("scale", tightened, solution.inputs)
            grown = best[1] is None or found.scale > best[0].scale * (ENOUGH if best[0].scale >= 1 else 1.001)
            if best[1] is None or (found.success and found.scale > best[0].scale):
                best = found, tightened
            if not grown:
                break
            solution = found
        return best

    # ---- plans -------------------------------------------------------------------------------------------

    def _planned(
        self, name: str, constants: Constants | None, widest: Solution, tightened: Tightened
    ) -> tuple[Solution, Tightened, Verdict | None] | None:
        """The cheapest plan that keeps the tightened constraints, and its verdict; None where there is none.

        Where the verdict falls short (between the points, say), the constraint that it names is tightened by as much.
        """
        first: tuple[Solution, Tightened, Verdict | None] | None = None
        if widest.scale < 1:
            return None
        begin = widest, tightened
        extra, factor = np.zeros(tightened.erosion.shape[1]), 1.0 + SLACK
        for turn in range(REPAIRS):
            self.tell(f"tube {name}: the cheapest plan")
            pair = self._agreeing(name, *begin, factor, extra, FIXED_POINT if turn == 0 else 3)
            if pair is None:
                break
            begin = pair
            self.tell(f"tube {name}: verifying the plan")
            verdict = self._verified(name, constants, *pair)
            first = (*pair, verdict) if first is None else first
            if verdict is None or not _short(verdict):
                return (*pair, verdict) if verdict is not None and verdict.status == "SAFE" else first
            if verdict.margin is not None and verdict.margin < 0:
                extra += 1.2 * abs(verdict.margin) * self._named(verdict.constraint)
            else:
                factor *= 1.02
        if first is not None:  # the plan with the most room may be verified where the cheapest is not
            verdict = self._verified(name, constants, widest, tightened)
            if verdict is not None and verdict.status == "SAFE":
                return widest, tightened, verdict
        return first

    def _named(self, constraint: str | None) -> Array:
        """1 for the parts of the faces that a verdict names, shape (parts,)."""
        faces = self.planner.faces
        hit = [constraint == face.label for face in faces]
        if not any(hit):  # an engine may name a side or a direction of its own
            hit = [str(constraint).startswith(face.label.split(" [side")[0]) for face in faces]
        if not any(hit):
            hit = [True] * len(faces)
        return np.concatenate([np.full(face.parts, float(named)) for face, named in zip(faces, hit)])

    def _agreeing(
        self, name: str, widest: Solution, tightened: Tightened, factor: float, extra: Array, turns: int
    ) -> tuple[Solution, Tightened] | None:
        """The cheapest plan for erosions that are the tube's along that very plan."""
        planner = self.planner
        solution, used = widest, tightened
        best: tuple[Solution, Tightened] | None = None
        for _ in range(turns):
            found = planner.plan("cost", used.more(factor, extra), solution.inputs)
            if not found.success:
                return best
            if name == "linear":
                response = planner.response(found, self.delta)
                if response is None:
                    return best
                following = response
            elif used.tube is not None:
                following = planner.around(used.tube, found)
            else:
                following = used
            best = found, following
            change = float(np.max(np.abs(following.erosion - used.erosion), initial=0.0))
            solution, used = found, following
            if change <= CLOSE * float(np.max(used.erosion, initial=1e-300)):
                break
        return best

    def _verified(
        self, name: str, constants: Constants | None, solution: Solution, tightened: Tightened
    ) -> Verdict | None:
        try:
            planned = self.planner.planned(solution, tightened)
            return verify_safety(planned, method=name, constants=constants)
        except (CertboundError, ValueError) as error:
            _LOG.info("the plan could not be verified: %s", error)
            self.trouble = str(error)
            return None

    # ---- answers -----------------------------------------------------------------------------------------

    def _refused(
        self, name: str, constants: Constants | None, widest: Solution, tightened: Tightened
    ) -> Synthesis:
        """The soft plan, with the obstacle to a better one; `explained` adds the rest."""
        self.tell(f"tube {name}: the plan that misses least")
        soft = self.planner.plan("soft", tightened, widest.inputs)
        solution = soft if np.all(np.isfinite(soft.states)) else widest
        verdict = self._verified(name, constants, solution, tightened)
        self.refused[name] = constants, widest
        result = self._result(name, constants, solution, tightened, widest.scale, verdict, feasible=False)
        return replace(result, infeasibility=self._infeasible(name, widest, tightened))

    def explained(self, result: Synthesis) -> Synthesis:
        """A refusal with the smallest delta that would do, in words."""
        assert result.infeasibility is not None
        delta = self._smallest(result.method, *self.refused[result.method])
        found = replace(result.infeasibility, smallest_delta=delta)
        unit = "t =" if self.planner.grid.continuous else "step"
        reason = f"{found.describe(unit)} The plan returned misses the tightened constraints by {result.softened:.3g}."
        return replace(result, infeasibility=found, smallest_delta=delta, reason=reason)

    def _infeasible(self, name: str, widest: Solution, tightened: Tightened) -> Infeasibility:
        planner = self.planner
        times, faces = planner.grid.times(), planner.faces
        point, face = np.unravel_index(int(np.argmax(widest.pressure)), widest.pressure.shape)
        label, at = faces[int(face)].label, float(times[int(point) + 1])
        if widest.input_pressure.max(initial=0.0) > widest.pressure.max(initial=0.0):
            label, at = INPUTS, float(times[int(np.argmax(widest.input_pressure))])
        proved, kind, bound = False, "solver found no point", math.inf
        if name != "linear":  # its erosion depends on the plan: nothing is proved about other plans
            empty = empty_at_once(faces, tightened.erosion, times)
            if empty is not None:
                proved, kind, bound, (label, at) = True, "eroded set empty", 1.0, empty
            elif planner.feedback is None and planner.terminal is None:
                bound = bound_scale(planner.problem, planner.grid, faces, tightened.erosion)
                proved = bound < 1
                kind = "no noise-free trajectory" if proved else kind
        return Infeasibility(
            proved=proved, kind=kind, constraint=label, time=at, scale=widest.scale, scale_bound=bound,
            smallest_delta=None,
        )  # fmt: skip

    def _smallest(self, name: str, constants: Constants | None, widest: Solution) -> float | None:
        """The smallest delta at which the tube fits around some plan (bisection)."""
        self.tell(f"tube {name}: the smallest feasible delta")
        known = [widest]

        def feasible(delta: float) -> bool:
            try:
                if name == "linear":
                    found, tightened = self._widen_response(known[-1], delta)
                else:
                    assert constants is not None
                    found, tightened = self._widen_tube(name, constants, known[-1], delta)
            except (CertboundError, ValueError):
                return False
            return tightened is not None and found.scale >= 1

        return smallest_delta(feasible, self.delta)

    def _result(
        self, name: str, constants: Constants | None, solution: Solution, tightened: Tightened, scale: float,
        verdict: Verdict | None, *, feasible: bool,
    ) -> Synthesis:  # fmt: skip
        planner = self.planner
        own = planner.program.applied_inputs(solution.inputs, solution.states)
        missing = planner.program.missing(solution.states, planner.grid.times(), tightened.erosion)
        missed = planner.program.inputs_missing(solution.inputs, solution.states, tightened.inputs)
        return Synthesis(
            feasible=feasible,
            status="UNKNOWN" if verdict is None else verdict.status,
            log10_delta=0.0 if verdict is None else verdict.log10_delta,
            reason=f"the plan could not be verified: {self.trouble}" if verdict is None else verdict.reason,
            source=planner.problem, problem=planner.planned(solution, tightened), plan=solution.inputs,
            inputs=own[:: planner.grid.substeps],
            states=solution.states, times=planner.grid.times(), erosion=tightened.erosion,
            labels=tuple(face.label for face in planner.faces), method=name, constants=constants,
            feedback=planner.feedback, cost=solution.cost, max_input=float(np.abs(own).max(initial=0.0)), scale=scale,
            softened=0.0 if feasible else float(max(missing.max(initial=0.0), missed)), infeasibility=None,
            smallest_delta=None,
            verdict=verdict, seconds=0.0,
        )  # fmt: skip


def _short(verdict: Verdict) -> bool:
    """Whether a little more room could make the verdict SAFE: one-time bounds never get there."""
    return verdict.status == "UNKNOWN" and all(answer.certified for answer in verdict.answers.values())


