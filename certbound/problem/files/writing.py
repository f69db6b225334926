"""From a ``Problem`` to the content of a problem file."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem import sets
from certbound.problem.files.formulas import formulas
from certbound.problem.files.parser import RESERVED
from certbound.problem.files.schema import Constraint, Start
from certbound.problem.model import Network, Tape
from certbound.problem.noise import check_law
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem, DiscreteSystem


def content_of(problem: Problem, plan_file: str) -> dict[str, Any]:
    """Content of a problem's file: as it was in its own file, or with the traced model as expressions."""
    if problem.source is None:
        return describe_problem(problem, plan_file)
    content = copy.deepcopy(dict(problem.source))
    if isinstance(problem.plan, np.ndarray):
        content["plan"] = {"file": plan_file}
    if "networks" in content:
        content["networks"] = network_files(problem, plan_file)
    return content


def networks_of(problem: Problem) -> dict[str, Network]:
    """The networks that a problem calls, by names that no two of them share."""
    system = problem.system
    tapes = [system.dynamics, problem.plan, system.diffusion if isinstance(system, ContinuousSystem) else None]
    found: dict[str, Network] = {}
    taken = {*RESERVED, *system.states, *system.input_names, *system.disturbance_names, *problem.parameters}
    for tape in tapes:
        for node in tape.nodes if isinstance(tape, Tape) else ():
            if node.part is not None and not any(known is node.part.network for known in found.values()):
                plain = re.sub(r"\W", "_", node.part.network.name) or "network"
                plain = f"n_{plain}" if plain[0].isdigit() else plain
                name, number = plain, 1
                while name in found or name in taken:
                    number += 1
                    name = f"{plain}_{number}"
                found[name] = node.part.network
    return found


def network_files(problem: Problem, plan_file: str) -> dict[str, str]:
    """Files of the networks, beside that of the plan."""
    stem = plan_file.removesuffix(".plan.json")
    return {name: f"{stem}.{name}.npz" for name in networks_of(problem)}


def describe_problem(problem: Problem, plan_file: str) -> dict[str, Any]:
    """Content of the problem file of any problem, with its model as expressions.

    ``plan_file`` is the name to put under ``plan.file`` where the plan is an array (the caller writes it). A model that
    uses what problem files do not have (the kink of a derivative) is a ValueError.
    """
    content = _Writer(problem, plan_file).content()
    return {key: value for key, value in content.items() if value not in ({}, [], None)}


class _Writer:
    def __init__(self, problem: Problem, plan_file: str) -> None:
        self.problem, self.system, self.plan_file = problem, problem.system, plan_file
        self.states = problem.system.states
        self.networks = {network: name for name, network in networks_of(problem).items()}
        self.definitions: dict[str, str] = {}
        self.fresh = self._fresh()

    def _fresh(self) -> Iterator[str]:
        system = self.system
        taken = {*RESERVED, *self.states, *system.input_names, *system.disturbance_names, *self.networks.values()}
        number = 0
        while True:
            number += 1
            if f"s{number}" not in taken:
                yield f"s{number}"

    def texts(self, tape: Tape) -> list[str]:
        definitions, texts = formulas(tape, self.fresh, self.networks)
        self.definitions |= definitions
        return texts

    def content(self) -> dict[str, Any]:
        problem, system = self.problem, self.system
        dynamics = dict(zip(self.states, self.texts(system.dynamics)))
        noise, plan, cost = self.noise(), self.plan(), problem.cost
        bounded = self.signal(system.disturbance, system.disturbance_names)
        fixed = {*problem.unknown, *problem.random}
        starts = [self.start(member) for member in problem.starts]
        stay = [self.constraint(c) for c in problem.safe if not c.outside]
        avoid = [self.constraint(c) for c in problem.safe if c.outside]
        return {
            "name": problem.name,
            "time": system.time,
            "horizon": problem.horizon,
            "delta": problem.delta,
            "units": dict(problem.units),
            "states": list(self.states),
            "inputs": self.signal(system.inputs, system.input_names),
            "disturbances": {name: ends for name, ends in bounded.items() if not fixed & {name}},
            "uncertain": {name: ends for name, ends in bounded.items() if name in problem.unknown},
            "random": {name: constant.data() for name, constant in problem.random.items()},
            "networks": network_files(problem, self.plan_file),
            "definitions": self.definitions,
            "dynamics": dynamics,
            "plan": plan,
            "cost": cost and {"Q": _rows(cost[0]), "R": _rows(cost[1])},
            "noise": noise,
            "initial": starts[0] if len(starts) == 1 else starts,
            "domain": self.domain(),
            "stay": stay,
            "avoid": avoid,
            "reach": [] if problem.reach is None else [self.constraint(problem.reach)],
        }

    def domain(self) -> dict[str, Any] | None:
        if self.problem.domain is None:
            return None
        ends = {"leaving": self.problem.leaving} if self.problem.ending else {}
        return {"box": self.intervals(self.problem.domain)} | ends

    @staticmethod
    def signal(box: sets.Box | None, names: tuple[str, ...]) -> dict[str, Any]:
        if box is None:
            return {}
        return {name: [low, high] for name, low, high in zip(names, box.low.tolist(), box.high.tolist())}

    def plan(self) -> dict[str, Any] | None:
        plan = self.problem.plan
        if plan is None or isinstance(plan, np.ndarray):
            return None if plan is None else {"file": self.plan_file}
        hold = {} if self.problem.hold is None else {"hold": self.problem.hold}
        if hold and "hold" in self.system.input_names:
            raise ValueError("an input named 'hold' cannot be written beside a hold; give it another name.")
        return dict(zip(self.system.input_names, self.texts(plan))) | hold

    def noise(self) -> dict[str, Any]:
        system = self.system
        if isinstance(system, ContinuousSystem):
            return {"diffusion": self.entries(system.diffusion)}
        assert isinstance(system, DiscreteSystem)
        check_law(system.noise, "be written")
        return system.noise.data() | {"matrix": self.entries(system.fixed_gain if system.gain is None else system.gain)}

    def entries(self, value: Array | Tape) -> list[list[Any]]:
        """A matrix of numbers, or of expressions."""
        if not isinstance(value, Tape):
            return _rows(value)
        texts, columns = self.texts(value), value.shape[1]
        return [texts[k : k + columns] for k in range(0, len(texts), columns)]

    def intervals(self, box: sets.Box) -> dict[str, Any]:
        used = self.states if box.coordinates is None else [self.states[k] for k in box.coordinates]
        return {name: [low, high] for name, low, high in zip(used, self.sides(box.low), self.sides(box.high))}

    def sides(self, value: Any) -> list[Any]:
        """Sides of a set: numbers, and expressions of those that move."""
        return [self.texts(one)[0] if isinstance(one, Tape) else one for one in sets.entries_of(value)]

    def place(self, region: Any) -> dict[str, Any]:
        used = self.states if region.coordinates is None else [self.states[k] for k in region.coordinates]
        moving = isinstance(region.center, Tape)
        return dict(zip(used, self.texts(region.center) if moving else region.center_at().tolist()))

    def region(self, region: Any) -> dict[str, Any]:
        table = region.data(Constraint.choices)
        kind, _ = table.pop("kind"), table.pop("coordinates", None)
        if kind == "box":
            return {"box": self.intervals(region)} | ({} if region.center is None else {"center": self.place(region)})
        if kind == "polytope" and region.kind != kind:
            table = self.resting(region)
        written = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in table.items()}
        for name in written.keys() & region.sides.keys():
            moved = self.sides(written[name])
            written[name] = moved if name == "b" else moved[0]
        if "center" in written:
            written["center"] = self.place(region)
        if "normal" in written:
            written["normal"] = {name: value for name, value in zip(self.states, written["normal"]) if value}
        return {kind: written}

    def resting(self, region: sets.Region) -> dict[str, Any]:
        """A set without a row of its own as a polytope over all states."""
        if region.moving:
            raise ValueError(f"a moving {type(region).__name__} cannot be written; use a Box, Ball or Ellipsoid.")
        normals, bounds = region.halfspaces()
        return {"A": region.lifted(normals, len(self.states)), "b": bounds + normals @ region.center_at()}

    def constraint(self, constraint: sets.Inside) -> dict[str, Any]:
        table = self.region(constraint.region)
        if constraint.during is not None:
            table["during"] = list(constraint.during)
        more = {"then": constraint.then} if isinstance(constraint, sets.Reach) and constraint.stays else {}
        table |= more
        usual = type(constraint)(constraint.region, constraint.during, **more).named(self.states).label
        return table if constraint.label == usual else table | {"label": constraint.label}

    def start(self, start: Any) -> Mapping[str, Any]:
        data = start.data(Start.choices)
        match data["kind"]:
            case "gaussian":
                return {"gaussian": {"mean": data["mean"].tolist(), "covariance": _rows(data["covariance"])}}
            case "box" if start.is_point:
                return {"point": data["low"].tolist()}
            case "box":
                return {"box": [[low, high] for low, high in zip(data["low"].tolist(), data["high"].tolist())]}
            case "polytope":
                name = type(start).__name__
                raise ValueError(f"a {name} cannot be written as a start; use a Box, Ball or Ellipsoid.")
        return self.region(start)


def _rows(matrix: Any) -> list[list[float]]:
    return [[float(entry) for entry in row] for row in np.asarray(matrix)]
