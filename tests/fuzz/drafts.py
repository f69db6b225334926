"""A random problem before it has units: plain data that becomes a ``Problem`` in any units, by any route.

Everything is stated in units of its own, of size about 1. ``Draft.problem(units)`` states it again with every state
and the time measured otherwise: the same problem, which must get the same verdict.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

import certbound as cb
from certbound.problem.files.loading import loads
from certbound.problem.files.toml import toml_text
from tests.fuzz.formulas import Formula, number

__all__ = ["Draft", "Noise", "Shape", "Units", "Wall"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Units:
    """What one unit of the draft is: of every state, and of the time."""

    state: Array
    time: float = 1.0

    def times(self, factor: float, time: float = 1.0) -> Units:
        """Units that are smaller by a factor (so that numbers are larger)."""
        return Units(state=self.state * factor, time=self.time * time)

    @property
    def common(self) -> bool:
        """Whether all states have one unit."""
        return bool(np.all(self.state == self.state[0]))


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A set: ``box`` (low, high), ``ball`` (radius), ``ellipsoid`` (matrix), ``halfspace`` and ``polytope`` (A, b)."""

    kind: str
    data: tuple[Any, ...]
    center: tuple[Formula, ...] | None = None
    coordinates: tuple[int, ...] | None = None

    @property
    def moving(self) -> bool:
        """Whether the centre depends on time."""
        return self.center is not None and any(entry.symbols() for entry in self.center)

    def middle(self, t: float, size: int) -> Array:
        """The centre at time t."""
        if self.center is None:
            return np.zeros(size)
        return np.array([float(entry.value({"t": t})) for entry in self.center])

    def contains(self, states: Array, t: float, slack: float = 0.0) -> NDArray[np.bool_]:
        """Which states, shape (..., n), lie in the set grown by a share ``slack`` of its numbers."""
        x = states if self.coordinates is None else states[..., list(self.coordinates)]
        y = x - self.middle(t, x.shape[-1])
        if self.kind == "box":
            low, high = self.data
            room = slack * (1.0 + np.abs(np.where(np.isfinite(low), low, 0.0)))
            above = slack * (1.0 + np.abs(np.where(np.isfinite(high), high, 0.0)))
            return np.all((y >= low - room) & (y <= high + above), axis=-1)
        if self.kind == "ball":
            return np.asarray(np.linalg.norm(y, axis=-1) <= self.data[0] * (1.0 + slack))
        if self.kind == "ellipsoid":
            return np.asarray(np.einsum("...i,...i->...", y, y @ np.linalg.inv(self.data[0])) <= 1.0 + slack)
        faces, bounds = self.data
        return np.all(y @ faces.T <= bounds + slack * (1.0 + np.abs(bounds)), axis=-1)

    def build(self, units: Units) -> Any:
        """The same set in units."""
        picked = units.state if self.coordinates is None else units.state[list(self.coordinates)]
        options: dict[str, Any] = {} if self.coordinates is None else {"coordinates": list(self.coordinates)}
        center: Any = None
        if self.center is not None:
            center = self._moving_center(picked, units.time) if self.moving else self.middle(0.0, len(picked)) * picked
        if self.kind == "box":
            low, high = self.data
            return cb.Box(low * picked, high * picked, center=center, **options)
        if self.kind in ("ball", "ellipsoid"):
            if self.kind == "ball" and np.all(picked == picked[0]):
                return cb.Ball(center, self.data[0] * picked[0], **options)
            shape = self.data[0] ** 2 * np.eye(len(picked)) if self.kind == "ball" else self.data[0]
            return cb.Ellipsoid(center, shape * np.outer(picked, picked), **options)
        faces, bounds = self.data
        if self.kind == "halfspace":
            largest = np.max(np.abs(faces[0] / picked))
            return cb.HalfSpace(faces[0] / picked / largest, bounds[0] / largest)
        largest = np.max(np.abs(faces / picked), axis=1)
        return cb.Polytope(faces / picked / largest[:, None], bounds / largest)

    def _moving_center(self, picked: Array, time: float) -> Any:
        center = self.center
        assert center is not None

        def place(t: Any) -> list[Any]:
            return [entry.value({"t": t if time == 1.0 else t / time}) * scale for entry, scale in zip(center, picked)]

        return place


@dataclass(frozen=True, kw_only=True)
class Wall:
    """A constraint: stay inside a shape, or outside it, during a window."""

    shape: Shape
    inside: bool = True
    during: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Discrete-time noise: a law's name, its level's name and value, the matrix G (None: the identity) and a table.

    The table of a ``discrete`` law is (values, probabilities), that of a ``histogram`` (edges, probabilities).
    """

    law: str
    level: str
    value: Array
    matrix: Array | None = None
    independent: bool = True
    table: tuple[Array, Array] | None = None

    def build(self, units: Units) -> dict[str, Any]:
        """Arguments of a discrete-time system."""
        value, matrix = self.value, self.matrix
        if matrix is not None:
            matrix = units.state[:, None] * matrix
        elif self.level.endswith("covariance"):
            value = value * np.outer(units.state, units.state)
        else:
            value = value * (units.state**2 if self.level.endswith("variance") else units.state)
        kinds = {
            "gaussian": cb.Gaussian, "uniform": cb.Uniform, "rademacher": cb.Rademacher, "bounded": cb.Bounded,
            "subgaussian": cb.SubGaussian, "triangular": cb.Triangular, "laplace": cb.Laplace, "discrete": cb.Discrete,
            "histogram": cb.Histogram,
        }  # fmt: skip
        options: dict[str, Any] = {self.level: value}
        if self.table is not None:
            options |= {"edges" if self.law == "histogram" else "values": self.table[0], "probabilities": self.table[1]}
        if self.law == "bounded":
            options["independent"] = self.independent
        found: dict[str, Any] = {"noise": kinds[self.law](**options)}
        return found if matrix is None else found | {"noise_matrix": matrix}


@dataclass(frozen=True, kw_only=True)
class Draft:
    """A random problem: the model's formulas over t, x0.., u0.., d0.., and everything around it.

    Where ``shifts`` are given the start is a union: the set ``start`` moved by each of them. Where ``constant`` is true
    the disturbance is unknown but the same at all times. A ``target`` is to be reached before a wall is broken.
    """

    seed: int
    family: str
    continuous: bool
    dynamics: tuple[Formula, ...]
    start: tuple[str, Any, Any]
    walls: tuple[Wall, ...]
    horizon: float
    delta: float
    diffusion: tuple[tuple[Formula, ...], ...] = ()
    noise: Noise | None = None
    disturbance: tuple[Array, Array] | None = None
    constant: bool = False
    shifts: tuple[Array, ...] = ()
    target: Wall | None = None
    inputs: tuple[Array, Array] | None = None
    plan: Any = None
    domain: tuple[Array, Array] | None = None
    matrices: tuple[Array, Array, Array | None] | None = None
    route: str = "python"
    units: Units
    features: frozenset[str] = field(default_factory=frozenset)

    @property
    def dimension(self) -> int:
        """Number of states."""
        return len(self.dynamics)

    # ---- the problem -----------------------------------------------------------------------------------------

    def problem(self, units: Units | None = None) -> cb.Problem:
        """The problem in units (its own when omitted).

        Raises
        ------
        ValueError
            Where certbound refuses it.
        """
        units = self.units if units is None else units
        system = self._linear(units) if self.route == "linear" else self._system(units)
        plan = self.plan
        if plan is not None and not isinstance(plan, np.ndarray):
            plan = self._function(plan, units, np.ones(len(plan)), 1.0, "tx")
        domain = self.domain
        problem = cb.Problem(
            system,
            initial=self._start(units),
            safe=[self._wall(wall, units) for wall in self.walls],
            horizon=self.horizon * units.time,
            delta=self.delta,
            reach=None if self.target is None else self._wall(self.target, units, cb.Reach),
            unknown=system.disturbance_names if self.constant else (),
            plan=plan,
            domain=None if domain is None else cb.Box(domain[0] * units.state, domain[1] * units.state),
            name=f"fuzz {self.seed}",
        )
        return self._through_a_file(problem, units) if self.route == "file" else problem

    def _system(self, units: Units) -> Any:
        arguments = "tx" + ("u" if self.inputs is not None else "") + ("d" if self.disturbance is not None else "")
        f = self._function(self.dynamics, units, units.state, units.time, arguments)
        options: dict[str, Any] = {"states": self.dimension, **self._signals()}
        if self.continuous:
            return cb.ContinuousSystem(f, diffusion=self._diffusion(units), **options)
        return cb.DiscreteSystem(f, **({} if self.noise is None else self.noise.build(units)), **options)

    def _linear(self, units: Units) -> Any:
        assert self.matrices is not None
        a, b, e = self.matrices
        scale = units.state[:, None]
        options: dict[str, Any] = {} if e is None else {"E": scale * e / units.time, **self._signals()}
        noise: dict[str, Any] = {"diffusion": self._diffusion(units)} if self.continuous else {}
        if not self.continuous and self.noise is not None:
            noise = self.noise.build(units)
        time = "continuous" if self.continuous else "discrete"
        matrix = scale * a / units.state / units.time
        return cb.linear_system(matrix, b=units.state * b / units.time, time=time, **noise, **options)

    def _signals(self) -> dict[str, Any]:
        found = {}
        if self.inputs is not None:
            found["inputs"] = cb.Box(*self.inputs)
        if self.disturbance is not None:
            found["disturbance"] = cb.Box(*self.disturbance)
        return found

    def _function(self, rows: tuple[Formula, ...], units: Units, out: Array, per: float, arguments: str) -> Any:
        def values(t: Any, x: Any, u: Any = (), d: Any = ()) -> list[Any]:
            names: dict[str, Any] = {"t": t if units.time == 1.0 else t / units.time}
            names |= {f"x{k}": x[k] if s == 1.0 else x[k] / s for k, s in enumerate(units.state)}
            names |= {f"u{k}": entry for k, entry in enumerate(u)} | {f"d{k}": entry for k, entry in enumerate(d)}
            found = [row.value(names) for row in rows]
            return [value if scale / per == 1.0 else value * (scale / per) for value, scale in zip(found, out)]

        return {
            "tx": lambda t, x: values(t, x),
            "txu": lambda t, x, u: values(t, x, u=u),
            "txd": lambda t, x, d: values(t, x, d=d),
            "txud": lambda t, x, u, d: values(t, x, u=u, d=d),
        }[arguments]

    def _diffusion(self, units: Units) -> Any:
        if not self.diffusion:
            return None
        columns = len(self.diffusion[0])
        scale = np.repeat(units.state, columns)
        entries = tuple(entry for row in self.diffusion for entry in row)
        if not any(entry.symbols() for entry in entries):
            flat = np.array([float(entry.value({})) for entry in entries]) * scale / np.sqrt(units.time)
            return flat.reshape(-1, columns)
        flat_function = self._function(entries, units, scale, float(np.sqrt(units.time)), "tx")

        def matrix(t: Any, x: Any) -> list[list[Any]]:
            values = flat_function(t, x)
            return [values[k : k + columns] for k in range(0, len(values), columns)]

        return matrix

    def _start(self, units: Units) -> Any:
        if self.shifts:
            return [self._start_at(shift, units) for shift in self.shifts]
        return self._start_at(np.zeros(self.dimension), units)

    def _start_at(self, shift: Array, units: Units) -> Any:
        kind, first, second = self.start
        first, scale = first + shift, units.state
        if kind == "box":
            return cb.Box(first * scale, (second + shift) * scale)
        if kind == "gaussian":
            return cb.GaussianStart(first * scale, second * np.outer(scale, scale))
        if kind == "ball" and units.common:
            return cb.Ball(first * scale, second * scale[0])
        shape = second**2 * np.eye(len(scale)) if kind == "ball" else second
        return cb.Ellipsoid(first * scale, shape * np.outer(scale, scale))

    @staticmethod
    def _wall(wall: Wall, units: Units, word: Any = None) -> Any:
        during = None if wall.during is None else (wall.during[0] * units.time, wall.during[1] * units.time)
        word = word or (cb.Inside if wall.inside else cb.Outside)
        return word(wall.shape.build(units), during=during)

    # ---- by way of a problem file ----------------------------------------------------------------------------

    def _through_a_file(self, problem: cb.Problem, units: Units) -> cb.Problem:
        """The problem as a reader of its file gets it: model, noise and plan as text, the rest as it is written."""
        content = problem.to_dict()
        content["dynamics"] = dict(
            zip(problem.system.states, self._texts(self.dynamics, units, units.state, units.time))
        )
        if self.continuous and self.diffusion:
            columns, root = len(self.diffusion[0]), float(np.sqrt(units.time))
            entries = tuple(entry for row in self.diffusion for entry in row)
            texts = self._texts(entries, units, np.repeat(units.state, columns), root)
            content["noise"] = {"diffusion": [texts[k : k + columns] for k in range(0, len(texts), columns)]}
        if self.plan is not None:
            texts = self._texts(self.plan, units, np.ones(len(self.plan)), 1.0)
            content["plan"] = dict(zip(problem.system.input_names, texts))
        return loads(toml_text(content))

    def _texts(self, rows: tuple[Formula, ...], units: Units, out: Array, per: float) -> list[str]:
        names = self._names(units)
        factors = [float(scale / per) for scale in out]
        return [(row if f == 1.0 else number(f) * row).text(names) for row, f in zip(rows, factors)]

    def _names(self, units: Units) -> Mapping[str, str]:
        count = {
            "u": len(self.inputs[0]) if self.inputs else 0,
            "d": len(self.disturbance[0]) if self.disturbance else 0,
        }
        names = {"t": "t" if units.time == 1.0 else f"(t/{units.time!r})"}
        for k, scale in enumerate(units.state.tolist()):
            names[f"x{k}"] = f"x{k + 1}" if scale == 1.0 else f"(x{k + 1}/{scale!r})"
        for letter, size in count.items():
            names |= {f"{letter}{k}": letter if size == 1 else f"{letter}{k + 1}" for k in range(size)}
        return names
