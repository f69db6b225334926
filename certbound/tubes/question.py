"""What every formula of this room is asked: data cut to a horizon, what is minimised, where the deviation begins."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from certbound.checks import instance
from certbound.tubes.constants import Constants
from certbound.tubes.objective import Clearance, Objective, make_objective, read_clearance
from certbound.tubes.schedule import Schedule, make_schedule
from certbound.tubes.tube import Profile, Tube


@dataclass(frozen=True, kw_only=True)
class Start:
    """Deviation at time 0: ||S_0|| <= offset, plus an isotropic sub-Gaussian part of proxy std sigma (item 7.4)."""

    offset: float = 0.0
    sigma: float = 0.0

    def __post_init__(self) -> None:
        for name in ("offset", "sigma"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"`start` {name} must be finite and not negative, got {value}.")


@dataclass(frozen=True, eq=False, kw_only=True)
class Question:
    """All but the probability delta, which is asked for, or found: made once by :meth:`of`, which checks it."""

    constants: Constants  # as stated or proved
    schedule: Schedule  # the constants cut to the horizon
    goal: Objective  # what is minimised; its clearance is what an exit probability is bounded for
    start: Start  # deviation at time 0

    @classmethod
    def of(
        cls, constants: Constants, horizon: float, *, objective: Any = "max", clearance: Any = None,
        start: Start | None = None,
    ) -> Question:
        """Read and check what a user gave; a ``clearance`` takes the place of the objective.

        Raises
        ------
        ValueError, TypeError
            For a horizon, objective or clearance that cannot be, and a random start that nu does not cover.
        """
        instance("constants", constants, Constants)
        schedule, start = make_schedule(constants, horizon), start or Start()
        continuous = schedule.continuous
        if clearance is None:
            goal = make_objective(objective, schedule.horizon, continuous=continuous)
        else:
            goal = Objective(None, "scale", read_clearance(clearance, schedule.horizon, continuous=continuous))
        if start.sigma > 0 and schedule.nu < constants.dimension:
            raise ValueError(
                f"a random `start` is isotropic and needs nu = n = {constants.dimension}, got nu = {schedule.nu:g}; "
                "drop `effective_dimension`."
            )
        return cls(constants=constants, schedule=schedule, goal=goal, start=start)

    @property
    def horizon(self) -> float:
        """T."""
        return self.schedule.horizon

    @property
    def clearance(self) -> Clearance:
        """What the deviation must stay below, where the goal is that."""
        assert self.goal.clearance is not None
        return self.goal.clearance

    @property
    def cut(self) -> Schedule:
        """The schedule with a piece end wherever the clearance changes."""
        return self.goal.cut(self.schedule)

    @property
    def moving(self) -> bool:
        """Whether S_0 is anything but 0."""
        return self.start != Start()

    @property
    def silent(self) -> bool:
        """Whether there is no noise at all."""
        return bool(np.max(self.schedule.sigmas) == 0)

    def with_any_power(self) -> Question:
        """The same with nu = n, of an isotropic proxy, where not every Kummer parameter is valid as it is."""
        if self.schedule.any_power:
            return self
        return replace(self, schedule=replace(self.schedule, nu=float(self.constants.dimension), any_power=True))

    def tube(
        self, method: str, delta: float, parameters: dict[str, Any], profile: Profile, *, level: str = "trajectory",
        certified: bool = True,
    ) -> Tube:
        """The answer of a method, with what was asked."""
        return Tube(
            method=method, parameters=parameters, level=level, certified=certified, delta=delta, horizon=self.horizon,
            constants=self.constants, objective=self.goal.given, profile=profile,
        )  # fmt: skip
