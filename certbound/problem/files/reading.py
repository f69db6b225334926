"""From the content of a problem file to a ``Problem``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import located, nearest
from certbound.problem import sets
from certbound.problem.files.plans import read_plan
from certbound.problem.files.schema import Cost, Specification
from certbound.problem.files.set_reading import SetReader
from certbound.problem.model import Tape, sources
from certbound.problem.noise import LAWS
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem, DiscreteSystem, linear_system

_OUTSIDE = 1e-3  # of delta


def read_problem(spec: Specification, folder: Path | None, source: Mapping[str, Any] | None = None) -> Problem:
    """Build the problem that a validated specification describes; ``source``, the raw content, is kept for saving.

    ``plan.file`` and networks are read from ``folder``; None forbids it. Errors (ValueError, TypeError) name the key,
    the rule and the value.
    """
    return _ProblemReader(spec, folder).problem(source)


class _ProblemReader(SetReader):
    def problem(self, source: Mapping[str, Any] | None) -> Problem:
        spec = self.spec
        system = self.system()
        safe = [one for k, entry in enumerate(spec.stay) for one in self.stays(entry, f"stay.{k}")]
        safe += [self.constraint(sets.Outside, entry, f"avoid.{k}") for k, entry in enumerate(spec.avoid)]
        targets = [self.constraint(sets.Reach, entry, f"reach.{k}") for k, entry in enumerate(spec.reach)]
        return Problem(
            system,
            initial=self.starts(spec.initial),
            safe=safe, unknown=list(spec.uncertain), random=self.random,
            reach=targets[0] if targets else None,
            horizon=self.number(spec.horizon, "horizon"),
            delta=self.number(spec.delta, "delta"),
            plan=self.plan(), hold=self.hold(),
            cost=None if spec.cost is None else self.weights(spec.cost),
            domain=None if spec.domain is None else self.box(spec.domain.box, "domain.box", np.inf),
            leaving="unsafe" if spec.domain is None else spec.domain.leaving,
            name=spec.name, units=spec.units,
            parameters=self.parameters,
            source=source,
        )

    # the system

    def system(self) -> ContinuousSystem | DiscreteSystem:
        spec = self.spec
        options: dict[str, Any] = {
            "states": self.own,
            "filters": self.filters.members,
            "inputs": self.signal(spec.inputs, "inputs"),
            "disturbance": self.signal(self.bounds(), "disturbances"),
            "input_names": self.inputs or None,
            "disturbance_names": self.disturbances or None,
        }
        options |= self.diffusion() if spec.time == "continuous" else self.law()
        keys = set(spec.dynamics)
        if "A" in keys and "A" not in self.states:
            for key in keys - {"A", "B", "b", "E"}:
                raise ValueError(f"unknown key {key!r} in [dynamics]{nearest(key, ['A', 'B', 'b', 'E'])}")
            if self.filters:
                raise ValueError("`dynamics.A` must be omitted beside [[noise.filter]]; write each state's expression.")
            options |= {key: self.matrix(value, f"dynamics.{key}") for key, value in spec.dynamics.items()}
            return linear_system(time=spec.time, **options)
        for key in keys - set(self.own):
            if key in self.states:
                raise ValueError(f"`dynamics.{key}` must be omitted, [[noise.filter]] gives it.")
            raise ValueError(f"unknown key {key!r} in [dynamics]{nearest(key, self.own)}")
        for name in self.own:
            if name not in spec.dynamics:
                raise ValueError(f"`dynamics` must give every state, {name} is missing; write {name} = \"...\".")
            given = spec.dynamics[name]
            if isinstance(given, bool) or not isinstance(given, (str, int, float)):
                got = str(given).lower() if isinstance(given, bool) else repr(given)
                raise ValueError(f"`dynamics.{name}` must be an expression in quotes, got {got}.")
        where = [f"dynamics.{name}" for name in self.own]
        inputs = ("t", *self.states, *self.inputs, *self.disturbances)
        texts = [spec.dynamics[name] for name in self.own]
        tape = self.function(texts, inputs, where, (len(self.own),))
        return (ContinuousSystem if spec.time == "continuous" else DiscreteSystem)(tape, **options)

    def bounds(self) -> dict[str, list[Any]]:
        """Ends of the disturbances; of what is drawn, ends that leave next to nothing outside."""
        tail = _OUTSIDE * self.number(self.spec.delta, "delta")
        drawn = {name: list(law.ends(tail)) for name, law in self.random.items()}
        return {**self.spec.disturbances, **self.spec.uncertain, **drawn}

    def signal(self, table: Mapping[str, list[Any]], where: str) -> sets.Box | None:
        if not table:
            return None
        ends = np.array([self.array(pair, f"{where}.{name}") for name, pair in table.items()])
        for name, (low, high) in zip(table, ends):
            if low > high:
                table_of = "uncertain" if name in self.spec.uncertain else where
                raise ValueError(f"`{table_of}.{name}` must be [low, high], got {low:g} > {high:g}; swap the two.")
        return sets.Box(ends[:, 0], ends[:, 1])

    def diffusion(self) -> dict[str, Any]:
        table = self.spec.noise
        if table is None or (self.filters and not table.white):
            return {}
        extra = sorted({*table.model_fields_set, *(table.model_extra or {})} - {"diffusion", "filter"})
        if extra or table.diffusion is None:
            raise ValueError(
                "`noise` must hold `diffusion` alone in continuous time, a matrix with "
                f"{len(self.own)} rows, and [[noise.filter]], got {', '.join(extra) or 'nothing'}; write "
                "`diffusion = [[...]]`, a row for every state and a column for every Brownian motion: laws and "
                "`matrix` are of discrete time."
            )
        value = table.diffusion
        if isinstance(value, dict):
            for key in value.keys() - set(self.own):
                raise ValueError(f"unknown key {key!r} in `noise.diffusion`{nearest(key, self.own)}")
            noisy = [name for name in self.own if name in value]
            value = [[value[name] if name == column else 0.0 for column in noisy] for name in self.own]
        elif not isinstance(value, list) and len(self.own) == 1:
            value = [[value]]
        if not isinstance(value, list) or not all(isinstance(row, list) for row in value):
            got = f"a list of {len(value)}" if isinstance(value, list) else repr(value)
            table_of = ", ".join(f"{name} = ..." for name in self.own[:2])
            raise ValueError(
                f"`noise.diffusion` must be a matrix with {len(self.own)} rows (one per state), got {got}; write "
                f"diffusion = {{ {table_of} }} for noises of single states that are independent, or a column "
                "[[...], [...]] for one common noise."
            )
        return {"diffusion": self.expressions(value, "noise.diffusion")}

    def expressions(self, value: list[Any], name: str) -> Tape:
        """A matrix of expressions in t and the states."""
        rows: list[list[float | str]] = [list(row) for row in value if isinstance(row, list)]
        texts = [entry for row in rows for entry in row]
        if not texts:
            raise ValueError(f"`{name}` must not be empty; leave [noise] out where there is none.")
        shape = (len(rows), len(rows[0]))
        if len(texts) != shape[0] * shape[1] or any(len(row) != shape[1] for row in rows):
            raise ValueError(f"`{name}` must have rows of equal length.")
        where = [f"{name}.{k // shape[1]}.{k % shape[1]}" for k in range(len(texts))]
        return self.function(texts, ("t", *self.states), where, shape)

    def gain(self, value: Any, name: str) -> Array | Tape:
        """G: numbers, or expressions in t and the states."""
        if not isinstance(value, list) or not all(isinstance(row, list) for row in value):
            return self.matrix(value, name)
        tape = self.expressions(value, name)
        return tape if any(sources(tape)) else self.matrix(value, name)

    def law(self) -> dict[str, Any]:
        table = self.spec.noise
        if table is None or (self.filters and not table.white):
            return {}
        if table.diffusion is not None or table.law not in LAWS:
            cure = nearest(f"{table.law}", LAWS) if table.law else '; write for example law = "gaussian" and std = 0.1.'
            if table.diffusion is not None:
                cure = "; `diffusion` is for continuous time."
            raise ValueError(
                f"`noise.law` must be one of {', '.join(LAWS)} in discrete time, with one level and at most `matrix`, "
                f"got {table.law!r}{cure}"
            )
        build, entries = LAWS[table.law], dict(table.model_extra or {})
        flags = {key: entries.pop(key) for key in list(entries) if any(key in law.flags for law in LAWS.values())}
        tables = {key: self.array(entries.pop(key), f"noise.{key}") for key in build.tables if key in entries}
        if not entries and build.tables:
            entries = {build.levels[0]: 1.0}
        if len(entries) != 1 or not entries.keys() <= set(build.levels):
            raise ValueError(
                f"`noise` with law {table.law!r} needs exactly one of {', '.join(build.levels)}; "
                f"got {list(entries) or 'none'}."
            )
        for flag in flags.keys() - set(build.flags):
            raise ValueError(f"`noise.{flag}` must be omitted for law {table.law!r}.")
        level = {key: self.array(value, f"noise.{key}") for key, value in entries.items()}
        with located("noise", build.levels):
            result: dict[str, Any] = {"noise": build(**level, **tables, **flags)}
        if table.matrix is not None:
            result["noise_matrix"] = self.gain(table.matrix, "noise.matrix")
        return result

    # the plan, the cost

    def plan(self) -> Any:
        table = self.spec.plan
        if table is None:
            return None
        if set(table) == {"file"} and "file" not in self.inputs:
            return read_plan(self.file(table["file"], "plan.file"), self.inputs)
        table = {key: value for key, value in table.items() if key != "hold" or key in self.inputs}
        for key in table:
            if not self.inputs:
                raise ValueError(f"`plan.{key}` must be an input, and the file has none; give an [inputs] table.")
            if key not in self.inputs:
                raise ValueError(f"unknown key {key!r} in [plan]{nearest(key, [*self.inputs, 'file', 'hold'])}")
        for name in self.inputs:
            if name not in table:
                raise ValueError(f"`plan` must give every input, {name!r} is missing.")
        where = [f"plan.{name}" for name in self.inputs]
        texts = [table[name] for name in self.inputs]
        return self.function(texts, ("t", *self.states), where, (len(self.inputs),))

    def hold(self) -> float | None:
        """Seconds between two sampling times, under ``plan.hold``; an input of that name has its law there."""
        table = self.spec.plan or {}
        held = "hold" in table and "hold" not in self.inputs
        return self.number(table["hold"], "plan.hold") if held else None

    def weights(self, cost: Cost) -> tuple[Array, Array]:
        state = self.matrix(cost.Q, "cost.Q")
        return self.widened(state, state.ndim), self.matrix(cost.R, "cost.R")
