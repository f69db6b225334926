"""Configurations of LUCID (github.com/TendTo/lucid): bindings/pylucid/configuration_schema.json, cli.py and parser.py.

The problem in such a file: x+ = f(x) + noise_scale * N(0, I), drawn anew in each state (lucid/main.cpp and
benchmarks/integration/montecarlo_baseline.py); X_unsafe must not be met in steps 1 to time_horizon; a path that leaves
X_bounds ends there and is safe (lucid/verification/MontecarloSimulation.cpp). Everything else steers its search.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from certbound.problem.foreign.dialects import LUCID, rewritten
from certbound.problem.foreign.keys import Keys, Restated, boxed, listed, real, reals, sides, whole

HORIZON, NOISE = 5, 0.01  # what LUCID takes where a file says nothing

_SETTINGS = [
    "$schema", "verbose", "seed", "epsilon", "b_kappa", "set_scaling", "b_norm", "gamma", "C_coeff", "lambda",
    "num_samples", "sigma_f", "sigma_l", "feature_sigma_l", "num_frequencies", "oversample_factor", "plot", "verify",
    "lattice_resolution", "print_stats", "problem_log_file", "iis_log_file", "estimator", "kernel", "feature_map",
    "optimiser", "output_file", "input", "x_samples",
]  # fmt: skip
_SET = re.compile(r"\s*(RectSet|SphereSet|EllipseSet)\s*\(\s*(\[[^\]]*\])\s*,\s*(\[[^\]]*\]|[^\[\](),]+)\s*\)\s*")
_FIELDS = {"SphereSet": ("center", "radius"), "EllipseSet": ("center", "radii"), "RectSet": ("lower", "upper")}


def from_lucid(table: Mapping[str, Any]) -> Restated:
    """The problem of a configuration; errors name the key."""
    keys = Keys(table, "LUCID")
    if "system_dynamics" not in keys.left and "xp_samples" in keys.left:
        raise ValueError("`xp_samples` are of a system without equations; give `system_dynamics`, or a TOML file.")
    if "xp_samples" in keys.left or "f_xp_samples" in keys.left:
        raise ValueError("`xp_samples` cannot be taken for anything beside `system_dynamics`; leave them out.")
    lines = keys.take("system_dynamics")
    lines = [lines] if isinstance(lines, str) else lines
    if not isinstance(lines, list) or not lines:
        raise ValueError(f"`system_dynamics` must be a list of expressions, one per state, got {lines!r}.")
    states = [f"x{k + 1}" for k in range(len(lines))]
    texts = [rewritten(line, f"system_dynamics.{k}", len(lines), LUCID) for k, line in enumerate(lines)]
    for name, text in zip(states, texts):
        keys.note("system_dynamics", f"[dynamics] {name} = {text!r}")
    content: dict[str, Any] = {"time": "discrete", "states": states, "dynamics": dict(zip(states, texts))}
    content["horizon"] = whole("time_horizon", keys.take("time_horizon", HORIZON))
    content["noise"] = {"law": "gaussian", "std": real("noise_scale", keys.take("noise_scale", NOISE))}
    for key, became in (
        ("time_horizon", f"horizon = {content['horizon']} steps"),
        ("noise_scale", f"[noise] law = 'gaussian', std = {content['noise']['std']:g}, independent in each state"),
    ):
        keys.note(key, became if key in table else f"{became} (LUCID's default)")
    content |= _sets(keys, len(states))
    keys.leave(_SETTINGS, "not taken: settings of LUCID's search")
    keys.finish()
    return Restated(content=content, notes=tuple(keys.notes))


def _sets(keys: Keys, count: int) -> dict[str, Any]:
    bounds = _members("X_bounds", keys.take("X_bounds"), count)
    if len(bounds) != 1 or "box" not in bounds[0]:
        raise ValueError("`X_bounds` must be one RectSet; a model's domain is a box here.")
    box = bounds[0]["box"]
    keys.note("X_bounds", f"[domain] {boxed(box)}, leaving = 'ends': a path that leaves it ends there, and is safe")
    starts = _members("X_init", keys.take("X_init"), count)
    keys.note("X_init", f"[[initial]] {', '.join(map(_told, starts))}")
    unsafe = _members("X_unsafe", keys.take("X_unsafe"), count)
    for entry in unsafe:
        if any(low < lower or high > upper for (low, high), (lower, upper) in zip(_extent(entry), box)):
            raise ValueError(
                f"`X_unsafe` must lie within `X_bounds`, got {_told(entry)}: LUCID counts a path that is in both as "
                "failing, and one that has left as safe."
            )
    keys.note("X_unsafe", f"[[avoid]] {', '.join(map(_told, unsafe))}")
    return {"domain": {"box": box, "leaving": "ends"}, "initial": starts, "avoid": unsafe}


def _members(key: str, value: Any, count: int) -> list[dict[str, Any]]:
    entries = value if isinstance(value, list) else [value]
    found = [member for entry in entries for member in _texts(key, entry)]
    if not found:
        raise ValueError(f"`{key}` must hold a set, got {value!r}.")
    return [_shape(key, member, count) for member in found]


def _texts(key: str, entry: Any) -> list[Any]:
    """The sets of a text such as ``MultiSet([RectSet([0], [1]), RectSet([2], [3])])``, or the entry itself."""
    if not isinstance(entry, str):
        return [entry]
    inner = re.fullmatch(r"\s*MultiSet\s*\(\s*\[(.*)\]\s*\)\s*", entry, flags=re.DOTALL)
    text, found, place = (inner[1] if inner else entry), list[Any](), 0
    while match := _SET.match(text, place):
        kind, first, second = match.groups()
        values = [_numbers(key, part) for part in (first, second)]
        found.append({kind: dict(zip(_FIELDS[kind], (values[0], values[1] if second[0] == "[" else values[1][0])))})
        place = match.end()
        if inner and text[place : place + 1] == ",":
            place += 1
        elif place < len(text):
            break
    if place < len(text) or not found:
        raise ValueError(f"`{key}` must be RectSet([...], [...]) or the like, got {entry!r}.")
    return found


def _numbers(key: str, text: str) -> list[float]:
    return [real(key, part) for part in text.strip("[] ").split(",")]


def _shape(key: str, entry: Any, count: int) -> dict[str, Any]:
    """One set as a table of problem files."""
    if not isinstance(entry, Mapping) or len(entry) != 1 or next(iter(entry)) not in _FIELDS:
        raise ValueError(f"`{key}` must hold RectSet, SphereSet or EllipseSet, got {entry!r}.")
    kind, value = next(iter(entry.items()))
    where = f"{key}.{kind}"
    if kind == "RectSet" and isinstance(value, list):
        if len(value) != count:
            raise ValueError(f"`{where}` must have {count} pairs, one per state, got {len(value)}.")
        pairs = [reals(where, pair, 2) for pair in value]
        return {"box": sides(where, [low for low, _ in pairs], [high for _, high in pairs])}
    fields = Keys(value, "LUCID", where)
    first, second = (fields.take(name) for name in _FIELDS[kind])
    fields.finish()
    center = reals(fields.name(_FIELDS[kind][0]), first, count)
    if kind == "SphereSet":
        return {"ball": {"center": center, "radius": real(f"{where}.radius", second)}}
    other = reals(fields.name(_FIELDS[kind][1]), second, count)
    if kind == "RectSet":
        return {"box": sides(where, center, other)}
    shape = [[radius**2 if i == k else 0.0 for i in range(count)] for k, radius in enumerate(other)]
    return {"ellipsoid": {"center": center, "shape": shape}}


def _extent(shape: Mapping[str, Any]) -> list[tuple[float, float]]:
    if "box" in shape:
        return [(low, high) for low, high in shape["box"]]
    ((kind, table),) = shape.items()
    radii = [table["radius"]] * len(table["center"]) if kind == "ball" else [
        row[k] ** 0.5 for k, row in enumerate(table["shape"])
    ]
    return [(middle - radius, middle + radius) for middle, radius in zip(table["center"], radii)]


def _told(shape: Mapping[str, Any]) -> str:
    if "box" in shape:
        return boxed(shape["box"])
    ((kind, table),) = shape.items()
    middle = listed(table["center"])
    if kind == "ball":
        return f"the ball of radius {table['radius']:g} around ({middle})"
    return f"the ellipsoid with radii {listed(row[k] ** 0.5 for k, row in enumerate(table['shape']))} around ({middle})"
