"""Changes of single fields of a certificate: some that take away what a claim rests on, some that do no harm."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Iterator
from typing import Any

from certbound.checker import check_data
from certbound.errors import CertificateError

Data = dict[str, Any]
Change = Callable[[Data, random.Random], str | None]


def rejected(data: Data, problem: Data | None = None) -> bool:
    """Whether the checker refuses or refutes a certificate."""
    try:
        return not check_data(data, problem).valid
    except CertificateError:
        return True


def mutated(data: Data, changes: list[Change], count: int, seed: int) -> Iterator[tuple[str, Data]]:
    """``count`` changed copies, each with the name of its change; changes take turns."""
    rng = random.Random(seed)
    made = tried = 0
    while made < count:
        altered = copy.deepcopy(data)
        name = changes[tried % len(changes)](altered, rng)
        tried += 1
        if tried > 50 * count + 100:
            raise AssertionError("too few of the changes apply to this certificate")
        if name is not None:
            made += 1
            yield name, altered


def _scaled(text: str, factor: float, shift: float = 0.0) -> str:
    return (float.fromhex(text) * factor + shift).hex()


def _pick(items: list[Any], rng: random.Random) -> int:
    return rng.randrange(len(items))


# ---- what every certificate rests on -----------------------------------------------------------------------


def stronger_claim(proved: float) -> Change:
    """A probability below the one that follows."""

    def change(data: Data, rng: random.Random) -> str | None:
        data["claim"]["log10_delta"] = (proved * (1 + rng.uniform(0.001, 0.5)) - 1e-6).hex()
        return "claim"

    return change


def other_problem(data: Data, rng: random.Random) -> str | None:
    """A change of the problem's data, to be compared with the problem itself."""
    problem = data["problem"]
    places = [(problem, "horizon"), (problem, "delta")]
    places += [(region, key) for c in problem["constraints"] for region in [c["region"]] for key in _numbers_in(region)]
    initial, noise = problem["initial"], problem["noise"]
    places += [(initial, key) for key in _numbers_in(initial)]
    places += [(noise, key) for key in _numbers_in(noise)]
    places += [(pair, i) for pair in problem["disturbance_set"] for i in (0, 1)]
    places += [(row, i) for row in problem["plan"] or [] for i in range(len(row))]
    holder, key = rng.choice(places)
    return _perturbed(holder, key, rng)


def _numbers_in(record: Data) -> list[str]:
    names = ("low", "high", "center", "radius", "shape", "normal", "bound", "A", "b", "values", "matrix", "diffusion")
    return [name for name in (*names, "mean", "covariance") if isinstance(record.get(name), (str, list))]


def _perturbed(holder: Any, key: Any, rng: random.Random) -> str | None:
    value = holder[key]
    while isinstance(value, list):
        if not value:
            return None
        holder, key = value, _pick(value, rng)
        value = holder[key]
    if not isinstance(value, str):
        return None
    holder[key] = _scaled(value, 1 + rng.choice((-1, 1)) * 1e-6, rng.choice((-1, 1)) * 1e-9)
    return "problem"


def other_dynamics(data: Data, rng: random.Random) -> str | None:
    """Another operation, another argument or another constant in the tape."""
    nodes = data["problem"]["dynamics"]["nodes"]
    used, stack = set(), list(data["problem"]["dynamics"]["outputs"])
    while stack:
        index = stack.pop()
        if index not in used:
            used.add(index)
            op, *rest = nodes[index]
            stack += [] if op in ("input", "const") else [arg for arg in rest if isinstance(arg, int)]
    node = nodes[rng.choice(sorted(used))]
    if node[0] == "const":
        node[1] = _scaled(node[1], 1 + 1e-9, 1e-12)
    elif node[0] == "input":
        node[1] = node[1] + 1 if node[1] == 0 else node[1] - 1
    elif len(node) == 3 and node[0] != "pow":
        swaps = {"add": "sub", "sub": "add", "mul": "div", "div": "mul"}
        node[0] = swaps.get(node[0], "add")
    else:
        node[0] = "sin" if node[0] != "sin" else "cos"
        del node[2:]
    return "dynamics"


# ---- the linear response -----------------------------------------------------------------------------------


def lower_level(data: Data, rng: random.Random) -> str | None:
    """A level that the Gaussian part exceeds far more often."""
    levels = rng.choice(data["proof"]["cells"])["levels"]
    piece = rng.randrange(1, len(levels)) if len(levels) > 1 else 0
    if not levels[piece]:
        return None
    place = _pick(levels[piece], rng)
    if float.fromhex(levels[piece][place]) == 0.0:
        return None
    levels[piece][place] = _scaled(levels[piece][place], rng.uniform(0.05, 0.3))
    return "level"


def lower_window_level(data: Data, rng: random.Random) -> str | None:
    """The same for a coordinate in a window."""
    levels = rng.choice(data["proof"]["cells"])["window_levels"]
    if levels is None:
        return None
    window = _pick(levels, rng)
    place = _pick(levels[window], rng)
    if float.fromhex(levels[window][place]) < 1e-9:
        return None
    levels[window][place] = _scaled(levels[window][place], rng.uniform(0.05, 0.3))
    return "window level"


def moved_nominal(data: Data, rng: random.Random) -> str | None:
    """A nominal point that the dynamics does not reach."""
    nominal = rng.choice(data["proof"]["cells"])["nominal"]
    point = nominal[_pick(nominal, rng)]
    if isinstance(point[0], list):  # a power of the time within a short piece may change without any effect
        point = point[0 if data["proof"]["engine"] == "constants" else _pick(point, rng)]
    place = _pick(point, rng)
    point[place] = _scaled(point[place], 1.0, rng.choice((-1, 1)) * rng.uniform(0.5, 2.0))
    return "nominal"


def wrong_slope(data: Data, rng: random.Random) -> str | None:
    """A slope far from the Jacobian."""
    slopes = rng.choice(data["proof"]["cells"])["slopes"]
    row = slopes[_pick(slopes, rng)]
    if not row:
        return None
    place = _pick(row, rng)
    row[place] = _scaled(row[place], 1.0, rng.choice((-1, 1)) * rng.uniform(1.0, 3.0))
    return "slope"


def missing_box(data: Data, rng: random.Random) -> str | None:
    """A box of the remainder that lies beside it."""
    cell = rng.choice(data["proof"]["cells"])
    piece = _pick(cell["remainder_low"], rng)
    place = _pick(cell["remainder_low"][piece], rng)
    low, high = (float.fromhex(cell[name][piece][place]) for name in ("remainder_low", "remainder_high"))
    if rng.random() < 0.5:
        cell["remainder_low"][piece][place] = (high + (high - low)).hex()
        cell["remainder_high"][piece][place] = (high + 2 * (high - low)).hex()
    else:
        cell["remainder_high"][piece][place] = (low - (high - low)).hex()
        cell["remainder_low"][piece][place] = (low - 2 * (high - low)).hex()
    return "remainder"


def fewer_starts(data: Data, rng: random.Random) -> str | None:
    """Cells that leave out a part of the initial set."""
    edges = data["proof"]["splits"][_pick(data["proof"]["splits"], rng)]
    low, high = float.fromhex(edges[0]), float.fromhex(edges[-1])
    if not high - low > 1e-9:
        edges[-1] = edges[0] = (high + 1e-3).hex()
    elif rng.random() < 0.5:
        edges[0] = (low + 0.01 * (high - low)).hex()
    else:
        edges[-1] = (high - 0.01 * (high - low)).hex()
    return "splits"


def flipped_direction(data: Data, rng: random.Random) -> str | None:
    """A direction that points into the obstacle."""
    given = [item for item in rng.choice(data["proof"]["cells"])["separations"] if isinstance(item, list)]
    if not given:
        return None
    rows = rng.choice(given)
    row = rows[_pick(rows, rng)]
    if not isinstance(row, list):
        return None
    row[:] = [_scaled(x, -1.0) for x in row]
    return "direction"


def wrong_structure(data: Data, rng: random.Random) -> str | None:
    """Entries of the Jacobian declared constant that are not, or a grid that does not fit."""
    proof = data["proof"]
    kind = rng.choice(("varying", "units", "pieces"))
    if kind == "pieces":
        proof["pieces"] += 1
    elif proof[kind]:
        del proof[kind][_pick(proof[kind], rng)]
    else:
        return None
    return kind


LINEAR: list[Change] = [
    other_problem, other_dynamics, lower_level, lower_window_level, moved_nominal, wrong_slope, missing_box,
    fewer_starts, flipped_direction, wrong_structure,
]  # fmt: skip


# ---- noise that depends on the state -----------------------------------------------------------------------


def smaller_set(data: Data, rng: random.Random) -> str | None:
    """A set over which the noise is bounded, and which the state may leave."""
    stopped = rng.choice(data["proof"]["cells"])["stopped"]
    piece = _pick(stopped["low"], rng)
    place = _pick(stopped["low"][piece], rng)
    low, high = (float.fromhex(stopped[name][piece][place]) for name in ("low", "high"))
    if rng.random() < 0.5:
        stopped["low"][piece][place] = (low + rng.uniform(0.2, 2.0) * (high - low)).hex()
    else:
        stopped["high"][piece][place] = (high - rng.uniform(0.2, 2.0) * (high - low)).hex()
    return "set"


def other_reference(data: Data, rng: random.Random) -> str | None:
    """A diffusion matrix far from the noise on some piece."""
    reference = rng.choice(data["proof"]["cells"])["stopped"]["reference"]
    if reference is None:
        return None
    rows = reference[_pick(reference, rng)]
    row = rows[_pick(rows, rng)]
    place = _pick(row, rng)
    row[place] = _scaled(row[place], 1.0, rng.choice((-1, 1)) * rng.uniform(5.0, 50.0))
    return "reference"


def no_reference(data: Data, rng: random.Random) -> str | None:
    """All noise in the martingale, whose levels were written for a part of it."""
    stopped = rng.choice(data["proof"]["cells"])["stopped"]
    if stopped["reference"] is None:
        return None
    stopped["reference"] = None
    return "no reference"


def lower_factor(data: Data, rng: random.Random) -> str | None:
    """A level of the martingale that it exceeds far more often."""
    stopped = rng.choice(data["proof"]["cells"])["stopped"]
    name = rng.choice(("coordinates", "rows", "rooms"))
    if stopped[name] is None:
        return None
    holder, key = stopped, name
    while isinstance(holder[key], list):
        holder, key = holder[key], _pick(holder[key], rng)
    holder[key] = _scaled(holder[key], rng.uniform(0.05, 0.3))
    return name


def dropped_row(data: Data, rng: random.Random) -> str | None:
    """A row, a demand, a window or a piece left out of what is said of the martingale."""
    stopped = rng.choice(data["proof"]["cells"])["stopped"]
    name = rng.choice(("rows", "rooms", "windows", "low", "high", "reference"))
    if not stopped[name]:
        return None
    del stopped[name][_pick(stopped[name], rng)]
    return f"dropped {name}"


def nothing_stated(data: Data, rng: random.Random) -> str | None:
    """Noise that depends on the state, treated as if it did not."""
    cell = rng.choice(data["proof"]["cells"])
    if rng.random() < 0.5:
        del cell["stopped"]
    else:
        cell["stopped"] = None
    return "nothing"


STATE: list[Change] = [
    other_problem, other_dynamics, lower_level, lower_window_level, missing_box, smaller_set, other_reference,
    no_reference, lower_factor, dropped_row, nothing_stated,
]  # fmt: skip


# ---- the constants -----------------------------------------------------------------------------------------


def smaller(name: str, low: float, high: float) -> Change:
    """A number of the proof reduced by a share between ``low`` and ``high`` of its size."""

    def change(data: Data, rng: random.Random) -> str | None:
        value = float.fromhex(data["proof"][name])
        data["proof"][name] = (value - rng.uniform(low, high) * abs(value)).hex()
        return name

    return change


def smaller_in_cell(name: str) -> Change:
    """A defect or a radius reduced below what the pieces before prove."""

    def change(data: Data, rng: random.Random) -> str | None:
        values = rng.choice(data["proof"]["cells"])[name]
        place = _pick(values, rng)
        if float.fromhex(values[place]) < 1e-6:
            return None
        values[place] = _scaled(values[place], rng.uniform(0.3, 0.9))
        return name

    return change


def larger_room(data: Data, rng: random.Random) -> str | None:
    """More room than a constraint leaves."""
    rooms = data["proof"]["rooms"]
    place = _pick(rooms, rng)
    if rooms[place] is None:
        return None
    rooms[place] = _scaled(rooms[place], 1 + rng.uniform(0.01, 0.5))
    return "room"


def other_metric(data: Data, rng: random.Random) -> str | None:
    """A metric far from the stated one."""
    metric = data["proof"]["metric"]
    if metric is None:
        return None
    place = _pick(metric, rng)
    metric[place][place] = _scaled(metric[place][place], rng.choice((0.2, 3.0)))
    return "metric"


def other_parameters(data: Data, rng: random.Random) -> str | None:
    """Kummer parameters that prove less."""
    kummer = data["proof"]["kummer"]
    kummer["v0"] = _scaled(kummer["v0"], rng.choice((1e6, 1e9)))  # a small v0 may prove far-off claims as well
    return "kummer"


CONSTANTS: list[Change] = [
    other_problem, other_dynamics, smaller("rate", 0.001, 0.5), smaller("sigma", 0.01, 0.5), smaller("nu", 0.01, 0.5),
    smaller_in_cell("eta"), smaller_in_cell("radius"), larger_room, other_metric, other_parameters, moved_nominal,
    fewer_starts, flipped_direction,
]  # fmt: skip


# ---- the barrier -------------------------------------------------------------------------------------------


def tighter(name: str, sign: int) -> Change:
    """A level of the barrier moved by more than the room it was written with, to the side that proves more."""

    def change(data: Data, rng: random.Random) -> str | None:
        proof = data["proof"]
        value, horizon = float.fromhex(proof[name]), float.fromhex(data["problem"]["horizon"])
        step = rng.uniform(0.1, 2.0) + 0.01 * abs(value)
        if name == "growth":
            step /= horizon
            if value < step:
                return None
        proof[name] = (value + sign * step).hex()
        return name

    return change


def other_coefficient(data: Data, rng: random.Random) -> str | None:
    """A coefficient of the polynomial that matters, changed by more than the levels leave."""
    values = data["proof"]["coefficients"]
    largest = max(abs(float.fromhex(value)) for value in values)
    place = _pick(values, rng)
    step = rng.choice((-1, 1)) * rng.uniform(0.1, 0.5) * largest
    values[place] = _scaled(values[place], 1.0, step)
    return "coefficient"


def other_monomial(data: Data, rng: random.Random) -> str | None:
    """Another power of a state in a term that matters."""
    proof = data["proof"]
    largest = max(abs(float.fromhex(value)) for value in proof["coefficients"])
    place = _pick(proof["exponents"], rng)
    if abs(float.fromhex(proof["coefficients"][place])) < 0.05 * largest:
        return None
    power = proof["exponents"][place]
    state = _pick(power, rng)
    power[state] += 1
    return "monomial"


def other_frame(data: Data, rng: random.Random) -> str | None:
    """A moved centre or another scale of the polynomial."""
    proof = data["proof"]
    place = _pick(proof["center"], rng)
    if rng.random() < 0.5:
        step = rng.choice((-1, 1)) * rng.uniform(0.2, 0.6) * float.fromhex(proof["scale"][place])
        proof["center"][place] = _scaled(proof["center"][place], 1.0, step)
    else:
        proof["scale"][place] = _scaled(proof["scale"][place], rng.choice((0.6, 1.6)))
    return "frame"


BARRIER: list[Change] = [
    other_problem, other_dynamics, tighter("growth", -1), tighter("start", -1), tighter("boundary", 1),
    other_coefficient, other_monomial, other_frame,
]  # fmt: skip


# ---- value functions ---------------------------------------------------------------------------------------


def lost_cells(data: Data, rng: random.Random) -> str | None:
    """A grid without its last cells, beyond which everything counts as failed."""
    for grid in data["proof"]["grids"]:
        for row in grid:
            del row[len(row) - max(2, len(row) // 3) :]
    return "lost"


def coarse_cells(data: Data, rng: random.Random) -> str | None:
    """A grid of so large cells that polynomials are of no use."""
    for grid in data["proof"]["grids"]:
        for row in grid:
            row[1:-1] = []
    return "coarse"


def unordered_cells(data: Data, rng: random.Random) -> str | None:
    """Edges that fall, or a cell of no width."""
    row = rng.choice(rng.choice(data["proof"]["grids"]))
    k = rng.randrange(len(row) - 1)
    if rng.random() < 0.5:
        row[k], row[k + 1] = row[k + 1], row[k]
    else:
        row[k] = row[k + 1]
    return "unordered"


def other_steps(data: Data, rng: random.Random) -> str | None:
    """One step more or less than the horizon has."""
    steps = data["proof"]["steps"]
    if rng.random() < 0.5:
        steps.pop()
    else:
        steps.append(steps[-1])
    return "steps"


VALUES: list[Change] = [
    other_problem, other_dynamics, fewer_starts, lost_cells, coarse_cells, unordered_cells, other_steps,
]


def start_elsewhere(data: Data, rng: random.Random) -> str | None:
    """A start of a lower bound moved out of the initial set."""
    row = rng.choice(data["proof"]["starts"])
    place = _pick(row, rng)
    row[place] = _scaled(row[place], 1.0, rng.choice((-1, 1)) * rng.uniform(0.5, 3.0))
    return "start"


def larger_claim(data: Data, rng: random.Random) -> str | None:
    """A lower bound above the one that follows, or of the other side."""
    if rng.random() < 0.3:
        data["claim"]["log10_delta"] = data["claim"].pop("log10_lower")
    else:
        data["claim"]["log10_lower"] = _scaled(data["claim"]["log10_lower"], rng.uniform(0.2, 0.9))
    return "claim"


VALUES_BELOW: list[Change] = [
    other_problem, other_dynamics, start_elsewhere, lost_cells, coarse_cells, unordered_cells, other_steps,
]  # fmt: skip



# ---- changes that do no harm -------------------------------------------------------------------------------


def reordered(data: Data, rng: random.Random) -> str | None:
    """Other orders of the keys."""

    def shuffled(value: Any) -> Any:
        if isinstance(value, dict):
            items = [(key, shuffled(item)) for key, item in value.items()]
            rng.shuffle(items)
            return dict(items)
        return [shuffled(item) for item in value] if isinstance(value, list) else value

    replaced = shuffled(data)
    data.clear()
    data.update(replaced)
    return "order"


def other_names(data: Data, rng: random.Random) -> str | None:
    """Names for humans."""
    data["problem"]["name"] = f"name {rng.random()}"
    for constraint in data["problem"]["constraints"]:
        constraint["label"] = "renamed"
    return "names"


def weaker_claim(data: Data, rng: random.Random) -> str | None:
    """A larger probability."""
    data["claim"]["log10_delta"] = _scaled(data["claim"]["log10_delta"], rng.uniform(0.5, 0.999))
    return "weaker claim"


def wider(data: Data, rng: random.Random) -> str | None:
    """A little more of a number that may grow."""
    if data["proof"]["engine"] == "barrier":
        name = rng.choice(("growth", "start"))
        data["proof"][name] = _scaled(data["proof"][name], 1.0, 1e-9)
        return "wider"
    if data["proof"]["engine"] == "values":
        return None
    cell = rng.choice(data["proof"]["cells"])
    names = [name for name in ("eta", "radius", "remainder_high", "levels") if name in cell]
    values = cell[rng.choice(names)]
    while isinstance(values[0], list):
        values = values[_pick(values, rng)]
        if not values:
            return None
    place = _pick(values, rng)
    values[place] = _scaled(values[place], 1.0, 1e-9 * abs(float.fromhex(values[place])))
    return "wider"


HARMLESS: list[Change] = [reordered, other_names, weaker_claim, wider]
