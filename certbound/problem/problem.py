"""A safety problem: a system, where it starts, what it must respect, for how long, and how surely."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import assign, nearest
from certbound.display import Shown, amount, ask_later_room, name_text, unit_text
from certbound.errors import InfeasibleError
from certbound.problem.ingredients import (
    check_dimension,
    checked_cost,
    checked_delta,
    checked_hold,
    checked_horizon,
    checked_random,
    checked_rows,
    checked_start,
    checked_units,
    checked_unknown,
    described,
    samples_of,
)
from certbound.problem.model import Tape, rounded_comparison, sources, substitute, trace
from certbound.problem.sets import (
    Box,
    GaussianStart,
    Inside,
    Outside,
    Reach,
    Region,
    StartUnion,
    check_over_time,
    check_start,
    check_target,
)
from certbound.problem.systems import ContinuousSystem, DiscreteSystem, System

MOST_STEPS = 2**20  # after which comparisons are not looked at
DOMAIN = "the model's domain"
"""Label of the constraint to stay in it."""


@dataclass(frozen=True, eq=False, repr=False)
class Problem(Shown):
    """Does the state satisfy every constraint over the horizon, but for a probability delta?

    Parameters
    ----------
    system : ContinuousSystem or DiscreteSystem
        The model.
    initial : Box, Ball, Ellipsoid, GaussianStart, array_like of shape (n,), or a list of sets
        Every start in a set counts (also one chosen by an adversary who does not see coming noise); a point is stored
        as a degenerate box. A list or tuple of sets is their union: the worst of them counts.
    safe : sequence of Inside and Outside
        Constraints, each over its own window.
    horizon : float or int
        Seconds (CT) or steps (DT); positive. Infinity is for ever, which few engines serve.
    delta : float
        Accepted probability of leaving the safe set, in (0, 1).
    reach : Reach or a set, optional
        A target: then a path fails if it breaks a constraint before it has entered the target, or never enters it.
    unknown : sequence of str, optional
        Names of disturbances that are constants: unknown, but the same at all times.
    random : mapping of str to Random, optional
        Disturbances that are constants drawn once, independent of each other and of the noise. What is drawn outside
        of the disturbance's box counts as failing.
    plan : array_like of shape (K, m), function u(t, x), or Tape, optional
        Inputs: one row a step (DT; rows beyond the horizon are ignored), constant on K equal pieces of the
        horizon (CT), or a feedback law. A system with inputs may go without, for synthesis.
    hold : float, optional
        Seconds between two sampling times (continuous time, a plan that is a law): the inputs are computed at 0, hold,
        2 hold, ... from the state at that time, and kept in between. The horizon is a whole number of holds.
    cost : (Q, R), optional
        Weights of x' Q x + u' R u: matrices, or vectors of their diagonals.
    domain : Box, optional
        Where the model is meant; leaving it is never counted as safe (see ``constraints``).
    leaving : str
        "unsafe", or "ends": a path that leaves the domain ends there, and does not fail. Value functions in discrete
        time and simulations count that; other bounds, which hold all the same, count it as failing.
    units : mapping of str to str, optional
        For humans: the unit of ``time`` and of states, inputs and disturbances, by name.
    name : str
        For humans.
    parameters : mapping, optional
        Parameters that the problem was built with, for the record.
    changes : sequence of Change, optional
        When the rows of an array plan change, where that is not just at the ends of equal pieces (CT): one entry for
        0, for every end between two pieces, and for the horizon. For problems that are made of others.
    source : mapping, optional
        The content of the problem file it came from, for saving it as written; dropped by ``replace``.

    Raises
    ------
    TypeError, ValueError
        If sizes disagree, numbers are out of range, or the start violates a constraint that is due at time 0;
        the message names the argument, the rule and the cure.

    Examples
    --------
    >>> import numpy as np
    >>> from certbound.problem.sets import Box
    >>> system = ContinuousSystem(lambda x: -x, states=2, diffusion=0.1 * np.eye(2))
    >>> problem = Problem(system, initial=[0, 0], safe=[Inside(Box([-1, -1], [1, 1]))], horizon=5)
    >>> problem.safe[0].label
    '-1 <= x1 <= 1, -1 <= x2 <= 1'
    """

    system: ContinuousSystem | DiscreteSystem
    initial: Any = field(kw_only=True)
    safe: Any = field(kw_only=True)
    horizon: Any = field(kw_only=True)
    delta: Any = field(default=1e-3, kw_only=True)
    reach: Any = field(default=None, kw_only=True)
    unknown: Any = field(default=(), kw_only=True)
    random: Any = field(default=None, kw_only=True)
    plan: Any = field(default=None, kw_only=True)
    hold: Any = field(default=None, kw_only=True)
    cost: Any = field(default=None, kw_only=True)
    domain: Any = field(default=None, kw_only=True)
    leaving: str = field(default="unsafe", kw_only=True)
    units: Any = field(default=None, kw_only=True)
    name: str = field(default="problem", kw_only=True)
    parameters: Any = field(default=None, kw_only=True)
    changes: Any = field(default=None, kw_only=True, repr=False)
    source: Any = field(default=None, kw_only=True, repr=False)
    _closed_loop: Tape | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.system, System):
            raise TypeError(f"`system` must be a ContinuousSystem or DiscreteSystem, got {self.system!r}.")
        if not isinstance(self.name, str):
            raise TypeError(f"`name` must be text, got {self.name!r}.")
        assign(self, units=checked_units(self.units, self.system))
        discrete = self.system.time == "discrete"
        assign(self, horizon=checked_horizon(self.horizon, discrete))
        assign(self, delta=checked_delta(self.delta))
        assign(self, safe=self._constraints())
        assign(self, domain=self._domain())
        assign(self, reach=self._target())
        assign(self, initial=checked_start(self.initial, self.system))
        constants = self.system.disturbance_names
        assign(self, parameters=dict(self.parameters or {}), unknown=checked_unknown(self.unknown, constants))
        assign(self, random=checked_random(self.random, constants, self.unknown))
        assign(self, plan=self._checked_plan())
        assign(self, hold=checked_hold(self.hold, self.plan, self.system, self.horizon))
        assign(self, cost=checked_cost(self.cost, self.system))
        self._check_sides()
        for member in self.starts:
            check_start(member, self.kept)
        if self.reach is not None:
            check_target(self.reach.region, self.kept, self.system.dimension)
        if self.hold is None and (self.plan is not None or self.system.inputs is None):
            assign(self, _closed_loop=self._closed())
        self._refuse_rounding()
        self.system.filters.check_used(self.system.own_dimension, self._read())

    def _read(self) -> set[int]:
        """The states that the system's own dynamics, the noise, the plan or a limit depends on."""
        system, n = self.system, self.system.own_dimension
        noise = system.diffusion if isinstance(system, ContinuousSystem) else system.gain
        own = Tape(inputs=system.dynamics.inputs, nodes=system.dynamics.nodes, outputs=system.dynamics.outputs[:n],
                   shape=(n,))
        tapes = [tape for tape in (own, noise, self.plan) if isinstance(tape, Tape)]
        found = {slot - 1 for tape in tapes for slot in set[int]().union(*sources(tape))}
        for constraint in (*self.safe, *([] if self.reach is None else [self.reach])):
            found |= constraint.region.touched(system.dimension)
        return found

    @property
    def constraints(self) -> tuple[Inside, ...]:
        """Everything that a path respects that does not fail: ``safe``, and staying in the domain where there is one.

        Raises
        ------
        InfeasibleError
            If the problem has a target (these constraints do not say what failing is then, ``kept`` has them), or
            constants that are drawn, over which only ``verify_safety`` and simulations average.
        """
        if self.random:
            what = f"the problem has constants that are drawn ({', '.join(self.random)})"
            raise InfeasibleError(f"{what}; only verify_safety and simulate_exits average over them: give them values.")
        if self.reach is not None:
            raise InfeasibleError(
                f"the problem has a target ('{self.reach.label}'), and this serves constraints only; leave `reach` "
                "out, or use verify_safety or simulate_exits."
            )
        return self.kept

    @property
    def endless(self) -> bool:
        """Whether the horizon is infinite."""
        return math.isinf(self.horizon)

    @property
    def span(self) -> str:
        """The horizon in words."""
        return "at any time" if self.endless else f"within {amount(self.horizon, self.time_unit)}"

    @property
    def time_unit(self) -> str:
        """The unit of time as sentences name it: ``s`` or ``steps``, unless another one is given."""
        usual = "s" if self.system.time == "continuous" else "steps"
        return unit_text(str(self.units.get("time", usual)))

    @property
    def time_axis(self) -> str:
        """What stands at an axis of time."""
        return f"time ({self.time_unit})"

    def axis(self, name: str) -> str:
        """A state's name with its unit, where it has one."""
        return f"{name} ({self.units[name]})" if name in self.units else name

    @property
    def failing(self) -> str:
        """What is bounded, in a word."""
        return "leaving" if self.reach is None else "failing"

    @property
    def kept(self) -> tuple[Inside, ...]:
        """What a path respects until it is in the target, where there is one; otherwise ``constraints``."""
        if self.domain is None:
            return tuple(self.safe)
        return (*self.safe, Inside(self.domain, label=DOMAIN))

    @property
    def ending(self) -> bool:
        """Whether a path that leaves the domain ends there, without failing."""
        return self.leaving == "ends"

    @property
    def starts(self) -> tuple[Region | GaussianStart, ...]:
        """The initial set, or the members of a union."""
        return self.initial.members if isinstance(self.initial, StartUnion) else (self.initial,)

    @property
    def closed_loop(self) -> Tape:
        """The dynamics under the plan, shape (n,).

        Over ``("t", *states, *disturbance_names)``; the inputs' names stand before the disturbances' when the
        plan is an array, which ``input_sequence`` holds.

        Raises
        ------
        ValueError
            If the system has inputs and no plan.
        InfeasibleError
            If the inputs are held: they are no function of the present state.
        """
        if self.hold is not None:
            raise InfeasibleError(
                f"the inputs are held for {self.hold:g} {self.time_unit}: only the linear response, its certificates "
                "and simulations of exits serve that; leave `hold` out for inputs that follow the state at once."
            )
        if self._closed_loop is None:
            names = ", ".join(self.system.input_names)
            raise ValueError(
                f"the system has inputs ({names}) and no plan; give `plan=` ([plan] in a problem file), "
                "or use synthesize."
            )
        return self._closed_loop

    @property
    def samples(self) -> int:
        """How often inputs that are held are computed; 0 where none are."""
        return 0 if self.hold is None else samples_of(self.hold, self.horizon) or 0

    @property
    def input_sequence(self) -> Array | None:
        """The plan's rows, shape (K, m), where the plan is an array."""
        return self.plan if isinstance(self.plan, np.ndarray) else None

    @property
    def fixed_start(self) -> bool:
        """True when the initial set is a single point."""
        return bool(self.initial.is_point)

    def summary(self) -> str:
        """The problem in one line."""
        count = {"state": self.system.dimension, "constraint": len(self.safe)}
        what = ", ".join(f"{number} {word}{'' if number == 1 else 's'}" for word, number in count.items())
        return f"{name_text(self.name)}, {what}, {self.span.removeprefix('within ')}, delta {self.delta!r}"

    def rows(self) -> list[tuple[str, str]]:
        """Signals, start and constraints."""
        return described(self)

    def to_dict(self) -> dict[str, Any]:
        """The content of the problem file that ``cb.save`` writes.

        Raises
        ------
        ValueError
            If the model uses what problem files do not have (the kink of a derivative).
        """
        content: dict[str, Any] = ask_later_room("content", self, f"{self.name}.plan.json")
        return content

    def replace(self, **changes: Any) -> Problem:
        """The same problem with other values of some arguments; everything is checked again.

        Raises
        ------
        TypeError
            If a name is not an argument of ``Problem``.
        ValueError
            If only the horizon of a continuous-time problem with an array plan changes: its pieces would
            change too.
        """
        known = {entry.name for entry in dataclasses.fields(self) if entry.init} - {"source"}
        for name in changes:
            if name not in known:
                raise TypeError(f"`{name}` is no argument of Problem{nearest(name, known)}")
        stretched = isinstance(self.plan, np.ndarray) and self.system.time == "continuous"
        if stretched and changes.get("horizon", self.horizon) != self.horizon and "plan" not in changes:
            raise ValueError(
                "`horizon` must not change alone when the plan is an array over it; give `plan=` as well."
            )
        values = {name: getattr(self, name) for name in known}
        if "horizon" in changes and "changes" not in changes:
            values["changes"] = None
        if "system" in changes and "cost" not in changes and changes["system"].inputs is None:
            values["cost"] = None
        return Problem(**(values | changes))

    def _refuse_rounding(self) -> None:
        """Refuse comparisons of which a program that rounds takes another side than exact arithmetic does."""
        steps = int(min(self.horizon, MOST_STEPS)) if self.system.time == "discrete" else 0
        noise = self.system.diffusion if isinstance(self.system, ContinuousSystem) else self.system.gain
        when = "a step" if steps else "some time"
        given = [(self._closed_loop or self.system.dynamics, steps, when), (noise, steps, when)]
        if self.hold is not None:
            given.append((self.plan, self.samples, "a sampling time"))
        sets = [constraint.region for constraint in (*self.safe, *([self.reach] if self.reach is not None else []))]
        given += [(tape, steps, when) for region in sets for tape in (region.center, *region.sides.values())]
        for tape, samples, when in given:
            found = rounded_comparison(tape, float(steps or self.horizon), samples) if isinstance(tape, Tape) else None
            if found is not None:
                raise ValueError(
                    f"the model must not hold a comparison that rounding decides, got {found}: a program takes another "
                    f"side of it at {when} than exact arithmetic does. Compare with one number (t < 0.3, not "
                    "t - 0.1 < 0.2), away from steps and sampling times (t < 8.5, not 0.1*t <= 0.9)."
                )

    def _check_sides(self) -> None:
        """Refuse sides that move and describe no set at some time of their window."""
        named = [(f"safe[{place}]", constraint) for place, constraint in enumerate(self.safe)]
        for name, constraint in [*named, *([("reach", self.reach)] if self.reach is not None else [])]:
            window = constraint.during or (0.0, float(self.horizon))
            check_over_time(name, constraint.region, window, self.system.time == "discrete")

    def _constraints(self) -> tuple[Inside, ...]:
        safe = [self.safe] if isinstance(self.safe, Inside) else self.safe
        if not isinstance(safe, Sequence):
            raise TypeError(f"`safe` must be a list of cb.Inside and cb.Outside, got {safe!r}.")
        result = []
        for place, constraint in enumerate(safe):
            if isinstance(constraint, Reach):
                raise TypeError(f"`safe[{place}]` must be cb.Inside or cb.Outside, got a target; give it as `reach=`.")
            if type(constraint) not in (Inside, Outside):
                raise TypeError(f"`safe[{place}]` must be cb.Inside or cb.Outside itself, got {constraint!r}.")
            check_dimension(f"safe[{place}]", constraint.region, self.system.dimension)
            if constraint.during is not None:
                self._check_window(f"safe[{place}]", constraint.during)
            result.append(constraint.named(self.system.states))
        return tuple(result)

    def _check_window(self, name: str, window: tuple[float, float]) -> None:
        if self.endless:
            raise ValueError(
                f"`{name}` must have no `during` where the horizon is infinite, got {list(window)}; give a finite "
                "horizon, or leave the window out."
            )
        if window[1] > self.horizon:
            raise ValueError(
                f"`{name}` must have `during` within [0, {self.horizon:g}], got {list(window)}; "
                "change the window or the horizon."
            )
        if self.system.time == "discrete" and any(end != int(end) for end in window):
            raise ValueError(f"`{name}` must have whole steps in `during`, got {list(window)}; round them.")

    def _target(self) -> Reach | None:
        target: Any = Reach(self.reach) if isinstance(self.reach, Region) else self.reach
        if target is None:
            return None
        if type(target) is not Reach:
            raise TypeError(f"`reach` must be cb.Reach or a set, got {target!r}.")
        check_dimension("reach", target.region, self.system.dimension)
        if target.during is not None:
            self._check_window("reach", target.during)
            if target.during[1] <= 0:
                raise ValueError(f"`reach` must have a time after 0 in `during`, got {list(target.during)}.")
        if target.stays and (self.system.time == "continuous" or self.endless):
            raise ValueError(
                '`reach` must not have `then = "stay"` in continuous time, where a path that has just entered leaves '
                "again, or for ever; state a constraint with `during` from a time on."
            )
        named: Reach = target.named(self.system.states)
        return named

    def _domain(self) -> Box | None:
        if self.leaving not in ("unsafe", "ends"):
            raise ValueError(f'`leaving` must be "unsafe" or "ends", got {self.leaving!r}.')
        if self.domain is None:
            if self.leaving == "ends":
                raise ValueError('`leaving` must be "unsafe" without a `domain`, got "ends"; give a domain.')
            return None
        if not isinstance(self.domain, Box) or self.domain.moving or self.domain.coordinates is not None:
            raise TypeError(f"`domain` must be a fixed Box over all states, got {self.domain!r}.")
        check_dimension("domain", self.domain, self.system.dimension)
        if self.leaving == "ends" and not np.isfinite([self.domain.low, self.domain.high]).any():
            raise ValueError("`domain` must have a bound where leaving it ends a path.")
        return self.domain

    def _checked_plan(self) -> Array | Tape | None:
        system, plan = self.system, self.plan
        if plan is None:
            return None
        if system.inputs is None:
            raise ValueError(
                "`plan` must be omitted for a system without inputs; "
                "give the system `inputs=` ([inputs] in a problem file)."
            )
        count = len(system.input_names)
        if callable(plan) or isinstance(plan, Tape):
            tape = plan if isinstance(plan, Tape) else trace(plan, {"t": ["t"], "x": system.states})
            if tape.inputs != ("t", *system.states) or tape.shape != (count,):
                raise ValueError(
                    f"`plan` must return {count} values ({', '.join(system.input_names)}) from t and x, "
                    f"got shape {tape.shape} over {tape.inputs}."
                )
            return tape
        return checked_rows(plan, system, self.horizon)

    def _closed(self) -> Tape:
        system = self.system
        if not isinstance(self.plan, Tape):
            return system.dynamics
        inputs = ("t", *system.states, *system.disturbance_names)
        law = {name: (self.plan, place) for place, name in enumerate(system.input_names)}
        return substitute(system.dynamics, inputs, law)
