"""A system with filters: their states, dynamics, noise and starts behind those of the system itself."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import assign, frozen, names
from certbound.problem.filters.filters import Filter
from certbound.problem.model import Graph, Tape
from certbound.problem.noise import Gaussian, Law
from certbound.problem.sets import Box, GaussianStart, StartUnion


@dataclass(frozen=True, eq=False)
class Filters:
    """The filters of a system, in order: what they put behind each of its parts.

    Parameters
    ----------
    members : Filter or sequence of Filter
        No two of their states share a name.
    """

    members: Any = ()

    def __post_init__(self) -> None:
        given = self.members
        found = (given,) if isinstance(given, Filter) else tuple(given) if isinstance(given, Sequence) else given
        if not isinstance(found, tuple) or not all(isinstance(one, Filter) for one in found):
            raise TypeError(f"`filters` must be a list of cb.Filter, got {given!r}.")
        assign(self, members=found)
        names("filters", self.states)

    def __bool__(self) -> bool:
        return bool(self.members)

    def __len__(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of their states, in order."""
        return tuple(name for one in self.members for name in one.states)

    def dynamics(self, own: Tape, inputs: Sequence[str], time: str) -> Tape:
        """The dynamics ``own`` over t, all states and the other signals, with theirs behind.

        ``inputs`` names the inputs that an actuator may follow.
        """
        graph = Graph(own.inputs)
        nodes = {name: graph.input(slot) for slot, name in enumerate(own.inputs)}
        outputs: list[int] = own.evaluate(graph.arithmetic(), [nodes[name] for name in own.inputs])
        for one in self.members:
            if one.shape is None:
                rows, signals = _lag(one, time), [one.state, _followed(one, inputs)]
            else:
                rows, signals = one.shape.rate if time == "continuous" else one.shape.sampled()[0], list(one.states)
            outputs += [_dot(graph, row, [nodes[name] for name in signals]) for row in rows.tolist()]
        return graph.tape(outputs, (len(outputs),))

    def noise(self, own: Array | Tape | None, rows: int, time: str) -> Array | Tape:
        """[[G, 0], [0, B]] of the noise matrix G of the system's own states, if any, and columns for each filter."""
        blocks = [_noise_of(one, time) for one in self.members]
        below = np.zeros((sum(len(block) for block in blocks), sum(block.shape[1] for block in blocks)))
        row = column = 0
        for block in blocks:
            below[row : row + len(block), column : column + block.shape[1]] = block
            row, column = row + len(block), column + block.shape[1]
        n, m = (rows, 0) if own is None else own.shape
        shape = (n + len(below), m + below.shape[1])
        if not isinstance(own, Tape):
            whole = np.zeros(shape)
            whole[:n, :m], whole[n:, m:] = np.zeros((n, 0)) if own is None else own, below
            return frozen(whole if shape[1] else np.zeros((shape[0], 1)))
        graph = Graph(own.inputs)
        entries = np.full(shape, graph.const(0.0))
        inputs = [graph.input(slot) for slot in range(len(own.inputs))]
        entries[:n, :m] = np.reshape(own.evaluate(graph.arithmetic(), inputs), (n, m))
        entries[n:, m:] = np.reshape([graph.const(value) for value in below.flat], below.shape)
        return graph.tape([int(node) for node in entries.flat], shape)

    def law(self, law: Law | None) -> Law:
        """The law of the noise of a system in discrete time, if any, and of theirs behind."""
        count = sum(len(one.states) for one in self.members if one.noisy)
        if law is None:
            return Gaussian(std=1.0 if count else 0.0)
        if not count:
            return law
        if type(law) is not Gaussian:
            raise ValueError(
                f"`noise` must be cb.Gaussian(...) beside filters, which normal noise drives, got "
                f"{type(law).__name__}; in place of the filters give states of their own and one law for all noise."
            )
        level = law.level
        if level != "covariance":
            return Gaussian(**{level: np.concatenate([getattr(law, level), np.ones(count)])})
        whole = np.eye(law.dimension + count)
        whole[: law.dimension, : law.dimension] = law.covariance
        return Gaussian(covariance=whole)

    def start(self, start: Any, inputs: Mapping[str, Sequence[float]], fixed: Mapping[str, float] | None = None) -> Any:
        """A start of the system's own states and, independent of it, of theirs behind.

        Parameters
        ----------
        start : Region, GaussianStart or StartUnion
            Of the states that are not the filters'.
        inputs : mapping
            The two ends of each input, by its name.
        fixed : mapping, optional
            Values of filters' states that do not start stationary, by their names.

        Returns
        -------
        Box, GaussianStart or StartUnion
            A GaussianStart where a filter starts stationary.

        Raises
        ------
        ValueError
            If a filter starts stationary and the start is a set, or 0 is no value of an actuator's input.
        """
        given = fixed or {}
        blocks = [one.covariance * (not set(one.states) <= given.keys()) for one in self.members]
        mean = [given.get(name, 0.0) for one in self.members for name in one.states]
        for one in self.members:
            if not one.noisy and one.state not in given:
                _check_rest(one, inputs)
        if any(block.any() for block in blocks):
            return _stationary(start, mean, self.members, blocks)
        if isinstance(start, StartUnion):
            return StartUnion(tuple(self.start(member, inputs, fixed) for member in start.members))
        if isinstance(start, GaussianStart):
            return _independent(start, mean, blocks)
        if not isinstance(start, Box):
            raise ValueError(
                f"`initial` must be a point, a box or normal beside filters, got a {type(start).__name__}; give a box, "
                f"or the set over all states, with {', '.join(self.states)}."
            )
        return Box([*start.low, *mean], [*start.high, *mean])

    def check_used(self, first: int, read: set[int]) -> None:
        """Refuse a filter of which no state is ``read``; ``first`` is the number of the system's own states."""
        for one in self.members:
            if not read & set(range(first, first + len(one.states))):
                raise ValueError(
                    f"`filters` must not hold {one.state!r}, which nothing uses; write {one.state!r} in the dynamics, "
                    "or leave it out."
                )
            first += len(one.states)


def _lag(one: Filter, time: str) -> Array:
    """What an actuator makes of its state and its input, which is held over a step in discrete time."""
    if time == "continuous":
        return np.array([[-1.0 / one.time, 1.0 / one.time]])
    return np.array([[math.exp(-1 / one.time), -math.expm1(-1 / one.time)]])


def _followed(one: Filter, inputs: Sequence[str]) -> str:
    """The input that an actuator follows."""
    if one.input is None and len(inputs) == 1:
        return inputs[0]
    if one.input not in inputs:
        known = f"among {', '.join(inputs)}" if inputs else "and the system has none: give it inputs"
        raise ValueError(f"`input` of the filter {one.state!r} must be an input, {known}; got {one.input!r}.")
    return str(one.input)


def _dot(graph: Graph, row: Sequence[float], signals: Sequence[int]) -> int:
    total = graph.const(0.0)
    for factor, signal in zip(row, signals):
        total = graph.apply("add", total, graph.apply("mul", graph.const(factor), signal))
    return total


def _noise_of(one: Filter, time: str) -> Array:
    """B, shape (k, 1), or in discrete time (k, k); no columns where no noise drives it."""
    if one.shape is None:
        return np.zeros((1, 0))
    return one.shape.noise[:, None] if time == "continuous" else one.shape.sampled()[1]


def _stationary(start: Any, mean: list[float], filters: Sequence[Filter], blocks: list[Array]) -> GaussianStart:
    if isinstance(start, Box) and start.is_point:
        start = GaussianStart(start.low, np.zeros((start.dimension,) * 2))
    if not isinstance(start, GaussianStart):
        names = [name for one, block in zip(filters, blocks) for name in one.states if block.any()]
        raise ValueError(
            f"`initial` must be a point or normal where filters start stationary, got a {type(start).__name__}; make "
            f"it normal, or give it over all states: {', '.join(names)} then start there."
        )
    return _independent(start, mean, blocks)


def _independent(start: GaussianStart, mean: list[float], blocks: list[Array]) -> GaussianStart:
    n = start.dimension
    covariance = np.zeros((n + len(mean),) * 2)
    covariance[:n, :n] = start.covariance
    for block in blocks:
        covariance[n : n + len(block), n : n + len(block)] = block
        n += len(block)
    return GaussianStart([*start.mean, *mean], covariance)


def _check_rest(one: Filter, inputs: Mapping[str, Sequence[float]]) -> None:
    name = _followed(one, list(inputs))
    low, high = inputs[name]
    if not low <= 0 <= high:
        raise ValueError(
            f"`initial` must give {one.state!r}, the lag of {name!r}, where 0 is no value of that, got "
            f"[{low:g}, {high:g}]; give it over all states."
        )
