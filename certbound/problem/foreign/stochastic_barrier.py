"""Benchmarks of StochasticBarrier.jl (github.com/aria-systems-group/StochasticBarrier.jl).

The problem in such a file: x+ = A x + b + v or x+ = f(x) + v with independent v_i ~ N(0, σ_i^2) (src/system.jl: σ holds
standard deviations); unsafe is what lies outside of the state space, and the obstacles (sum_of_squares_barrier.jl). The
lists of A become the columns of the matrix (``hcat(config["A"]...)`` in benchmarks/barrier_synthesis.jl). All else
steers its search.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from certbound.problem.foreign.dialects import JULIA, rewritten
from certbound.problem.foreign.keys import Keys, Restated, boxed, listed, real, reals, sides, whole

TOOL = "StochasticBarrier.jl"
HORIZON = 1  # what it takes where a file says nothing
_SEARCH = [
    "barrier_type", "barrier_degree", "optimization_type", "iteration_δ", "num_iterations", "barrier_guided",
    "distribution_guided", "initial_lr", "decay", "momentum",
]  # fmt: skip


def from_stochastic_barrier(table: Mapping[str, Any]) -> Restated:
    """The problem of a benchmark's file; errors name the key."""
    keys = Keys(table, TOOL)
    flag = keys.take("system_flag")
    if flag not in ("linear", "polynomial"):
        raise ValueError(
            f"`system_flag` must be linear or polynomial, got {flag!r}: the bounds of other dynamics are in a NetCDF "
            "file, without the equations; state those in a TOML file."
        )
    count = whole("dim", keys.take("dim"))
    states = [f"x{k + 1}" for k in range(count)]
    deviations = reals("σ", keys.take("σ"), count)
    if min(deviations) < 0:
        raise ValueError(f"`σ` must not be negative, got {deviations}.")
    content: dict[str, Any] = {"time": "discrete", "states": states}
    content["dynamics"] = (_linear if flag == "linear" else _polynomial)(keys, states)
    content["noise"] = {"law": "gaussian", "std": deviations}
    keys.note("σ", f"[noise] law = 'gaussian', std = {listed(deviations)} (standard deviations)")
    content["stay"] = [{"box": _region(keys, "state_space", count)}]
    keys.note("state_space", f"[[stay]] {boxed(content['stay'][0]['box'])}: leaving it is failing")
    content["initial"] = {"box": _region(keys, "initial_region", count)}
    keys.note("initial_region", f"[initial] {boxed(content['initial']['box'])}")
    content["avoid"] = _obstacles(keys, count)
    content["horizon"] = _horizon(keys)
    keys.leave(["transition_probalities", "probabilities"], "not taken: settings of its search")
    keys.finish()
    return Restated(content=content, notes=tuple(keys.notes))


def _linear(keys: Keys, states: list[str]) -> dict[str, Any]:
    count = len(states)
    lists = keys.take("A")
    if not isinstance(lists, list) or len(lists) != count:
        raise ValueError(f"`A` must be {count} lists of {count} numbers, got {lists!r}.")
    columns = [reals("A", column, count) for column in lists]
    rows = [list(row) for row in zip(*columns)]
    offset = reals("b", keys.take("b"), count)
    own = "" if rows == columns else (
        ": its lists are columns, as the tool reads them; transpose it in the file if rows were meant"
    )
    keys.note("A", f"[dynamics] A = {rows}{own}")
    keys.note("b", f"[dynamics] b = {offset}")
    return {"A": rows, "b": offset}


def _polynomial(keys: Keys, states: list[str]) -> dict[str, Any]:
    lines = keys.take("f")
    if not isinstance(lines, list) or len(lines) != len(states):
        raise ValueError(f"`f` must be a list of {len(states)} expressions, got {lines!r}.")
    texts = [rewritten(line, f"f.{k}", len(states), JULIA) for k, line in enumerate(lines)]
    for name, text in zip(states, texts):
        keys.note("f", f"[dynamics] {name} = {text!r}")
    return dict(zip(states, texts))


def _region(keys: Keys, key: str, count: int) -> list[list[float]]:
    """A box by its ends, or by its centre and half of its side."""
    inner = Keys(keys.take(key), TOOL, keys.name(key))
    if "c" in inner.left:
        center, half = reals(inner.name("c"), inner.take("c"), count), inner.take("r")
        radius = real(inner.name("r"), half[0] if isinstance(half, list) and half else half)
        low, high = [c - radius for c in center], [c + radius for c in center]
    else:
        low, high = (reals(inner.name(name), inner.take(name), count) for name in ("low", "high"))
    inner.finish()
    return sides(keys.name(key), low, high)


def _obstacles(keys: Keys, count: int) -> list[dict[str, Any]]:
    given = keys.take("obstacle_region", None)
    if given is None:
        return []
    inner = Keys(given, TOOL, "obstacle_region")
    number = whole("obstacle_region.num_obstacles", inner.take("num_obstacles"))
    boxes = [_region(inner, f"obstacle_{k + 1}", count) for k in range(number)]
    for key in [key for key in inner.left if str(key).startswith("obstacle_")]:
        raise ValueError(f"`obstacle_region.{key}` stands beside num_obstacles = {number}, which leaves it out.")
    inner.finish()
    keys.note("obstacle_region", f"[[avoid]] {', '.join(map(boxed, boxes))}")
    return [{"box": box} for box in boxes]


def _horizon(keys: Keys) -> int:
    inner = Keys(keys.take("barrier_settings"), TOOL, "barrier_settings")
    given = "time_horizon" in inner.left
    horizon = whole("barrier_settings.time_horizon", inner.take("time_horizon", HORIZON))
    inner.note("time_horizon", f"horizon = {horizon} steps{'' if given else ' (the default of the tool)'}")
    inner.leave(_SEARCH, "not taken: settings of its search")
    inner.finish()
    keys.notes += inner.notes
    return horizon
