"""Files below 1 MB that ask the checker for hours or for tens of gigabytes, one for each loop or array that does so.

``python -m tests.checker.bombs`` reads the name of one and a number of seconds from each line of its input, and writes
what a check of that file in a process of its own, with so many seconds of work, came to.
"""

from __future__ import annotations

import base64
import json
import os
import resource
import sys
import zlib
from collections.abc import Callable
from functools import partial
from typing import Any
from unittest.mock import patch

from certbound.checker import check, check_data, parse
from certbound.checker.report import Budget
from certbound.errors import CertificateError

Data = dict[str, Any]

MOST_BYTES = 1_500_000_000
"""Of memory that one check may take."""
ZERO, ONE, HALF = "0x0.0p+0", "0x1.0p+0", "0x1.0p-1"

BOMBS: dict[str, tuple[Callable[[], Data | str], str]] = {}
"""Name to what makes the file, and what the checker says of it."""

WORK, MEMORY, MORE = "more work than its limit", "more memory than its limit", "the check needs more"


def bomb(name: str, says: str) -> Callable[[Callable[[], Data | str]], Callable[[], Data | str]]:
    """Enter a file into the table."""

    def enter(make: Callable[[], Data | str]) -> Callable[[], Data | str]:
        assert name not in BOMBS
        BOMBS[name] = make, says
        return make

    return enter


# ---- parts of files ------------------------------------------------------------------------------------------


def hexed(value: Any) -> Any:
    """Numbers as a certificate writes them."""
    if isinstance(value, (list, tuple)):
        return [hexed(item) for item in value]
    digits, exponent = float(value).hex().split("p")
    return f"{digits.rstrip('0') if '.' in digits else digits}p{exponent}".replace(".p", ".0p")


def packed(count: int, word: str = ZERO) -> str:
    """The same number again and again, compressed."""
    machine, (blocks, rest) = zlib.compressobj(9), divmod(max(count - 1, 0), 4096)
    block = (f"{word} " * 4096).encode()
    text = [machine.compress(block) for _ in range(blocks)]
    text.append(machine.compress((f"{word} " * rest + word * (count > 0)).encode()))
    return base64.b64encode(b"".join([*text, machine.flush()])).decode()


def tape(states: int = 1, *more: list[Any]) -> Data:
    """Half of every state, and operations that come before."""
    nodes: list[list[Any]] = [*more, ["const", HALF]]
    half, outputs = len(nodes) - 1, []
    for i in range(states):
        nodes += [["input", 1 + i], ["mul", half, len(nodes)]]
        outputs.append(len(nodes) - 1)
    return {"nodes": nodes, "outputs": outputs}


def chain(op: str, count: int, *rest: Any) -> Data:
    """An operation of its own value, again and again, from the first state on."""
    nodes: list[list[Any]] = [["input", 1]]
    nodes += [[op, place, *(place if item is None else item for item in rest)] for place in range(count)]
    return {"nodes": nodes, "outputs": [count]}


def box(states: int, size: float = 1.0) -> Data:
    region = {
        "kind": "box", "low": hexed([-size] * states), "high": hexed([size] * states), "center": None,
        "coordinates": None,
    }
    return {"kind": "inside", "region": region, "during": None, "label": "a box"}


def faces(states: int, count: int) -> Data:
    """A polytope of many faces."""
    rows = [[ONE] * states] * count
    region = {"kind": "polytope", "A": rows, "b": [ONE] * count}
    return {"kind": "inside", "region": region, "during": None, "label": "many faces"}


def problem(
    states: int = 1, *, steps: float | None = None, horizon: float = 1.0, pushes: int = 0, **parts: Any
) -> Data:
    """x' = x/2 dt + dW, or in discrete time x+ = x/2 + w."""
    identity = hexed([[float(i == j) for j in range(states)] for i in range(states)])
    wiener = {"law": "wiener", "diffusion": identity}
    gaussian = {"law": "gaussian", "level": "std", "values": hexed([0.1] * states), "matrix": identity}
    return {
        "name": "a bomb", "time": "continuous" if steps is None else "discrete",
        "horizon": hexed(horizon if steps is None else steps), "delta": hexed(0.1),
        "states": [f"x{i}" for i in range(states)], "inputs": [], "disturbances": [f"d{i}" for i in range(pushes)],
        "disturbance_set": [[hexed(-0.1), hexed(0.1)]] * pushes, "plan": None, "domain": None,
        "dynamics": tape(states), "noise": wiener if steps is None else gaussian,
        "initial": {"kind": "box", "low": [ZERO] * states, "high": [ZERO] * states}, "constraints": [box(states)],
        **parts,
    }  # fmt: skip


def file(about: Data, proof: Data, *, lower: bool = False) -> Data:
    claim = {"log10_delta": hexed(0.0 if lower else -0.1), "method": proof["engine"], "assumptions": []}
    return {
        "format": "certbound certificate", "version": 1, "problem": about, "proof": proof,
        "claim": claim | ({"log10_lower": hexed(-1.0)} if lower else {}),
    }


def surface(cells: list[int], slabs: int = 1, *, lower: bool = False, **parts: Any) -> Data:
    """A value function that is 0 everywhere."""
    shape = slabs + 1
    for count in cells:
        shape *= 3 * (count + 1)
    axes = [[hexed(-0.5 + k / count) for k in range(count + 1)] for count in cells]
    return {
        "engine": "values", "axes": axes, "times": [hexed(k / slabs) for k in range(slabs + 1)],
        "values": packed(shape), "rates": packed(shape), "edges": hexed([-1.0, 0.0]), "m": [ZERO], "q": [ZERO, HALF],
        "lam": [ZERO] * slabs, "eps": [ZERO] * slabs,
        **({"side": "lower", "starts": [[ZERO] * len(cells)]} if lower else {}), **parts,
    }  # fmt: skip


def induction(edges: list[list[float]], steps: int, **parts: Any) -> Data:
    """Value functions in discrete time, on one grid."""
    return {
        "engine": "values", "parts": 1, "grids": [hexed(edges)], "steps": [0] * steps,
        "splits": [[ZERO, ZERO]] * len(edges), **parts,
    }


def even(count: int, size: float = 2.0) -> list[float]:
    """Edges of cells of one length."""
    return [size * (2 * k / count - 1) for k in range(count + 1)]


def constants(states: int, pieces: int, times: list[float] | None = None, **parts: Any) -> Data:
    """Contraction constants that are stated; pieces are steps where there are no times."""
    nominal = [[[ZERO] * states]] * pieces
    cell = {
        "nominal": nominal, "eta": [hexed(0.125)] * (pieces - (times is None)), "radius": [HALF] * pieces,
        "separations": [None],
    }
    return {
        "engine": "constants", "assumed": True, "metric": None, "region": "everywhere",
        "times": times and hexed(times), "middles": times and hexed(times[:-1]), "rate": hexed(0.6),
        "sigma": hexed(1.5), "nu": hexed(states), "start_sigma": ZERO, "splits": [[ZERO, ZERO]] * states,
        "rooms": [hexed(0.1)] * pieces, "kummer": {"form": "kummer", "a": hexed(1e5), "v0": ONE}, "cells": [cell],
        **parts,
    }  # fmt: skip


def response(states: int, pieces: int, *, discrete: bool, **parts: Any) -> Data:
    """A linear response along the origin."""
    zeros = [ZERO] * states
    cell = {
        "nominal": [zeros] * (pieces + 1) if discrete else [[zeros] * 4] * pieces, "slopes": [[]] * pieces,
        "drifts": None if discrete else [[]] * pieces, "gains": [[]] * pieces, "remainder_low": [zeros] * pieces,
        "remainder_high": [zeros] * pieces, "rows": [[]] * pieces, "levels": [[]] * pieces,
        "window_levels": None if discrete else [zeros], "frames": [None] * states, "separations": [None],
    }  # fmt: skip
    return {
        "engine": "linear", "splits": [[ZERO, ZERO]] * states, "pieces": pieces, "varying": [], "moving": [],
        "units": [], "windows": None if discrete else [0], "cells": [cell | parts],
    }


# ---- value functions in continuous time ----------------------------------------------------------------------


@bomb("a slab of 360,000 patches", WORK)
def _() -> Data:
    dynamics = tape(2, ["input", 1], *[["add", k, 0] for k in range(16_000)])
    dynamics["nodes"].append(["add", 16_000, dynamics["outputs"][0]])
    dynamics["outputs"][0] = len(dynamics["nodes"]) - 1
    return file(problem(2, dynamics=dynamics), surface([600, 600], lower=True), lower=True)


@bomb("monomials in thirty disturbances", MEMORY)
def _() -> Data:
    """V is 0 at the ends and -1 in the middle."""
    words = " ".join([ZERO] * 3 + ["-0x1.0p+0"] + [ZERO] * 5)
    return file(problem(1, pushes=30), surface([2], 2, values=packed(3, words)))


@bomb("corners of forty disturbances", WORK)
def _() -> Data:
    return file(problem(1, pushes=40), surface([2], 2, lower=True), lower=True)


@bomb("values of an operation for every node", MEMORY)
def _() -> Data:
    nodes = [["input", 1], *[["sin", 0]] * 20_000]
    nodes += [["add", 1, 2], *[["add", 20_000 + k, k + 2] for k in range(1, 19_999)]]
    about = problem(1, dynamics={"nodes": nodes, "outputs": [len(nodes) - 1]})
    return file(about, surface([600], 6, lower=True), lower=True)


@bomb("parts of a gate between two stages", MEMORY)
def _() -> Data:
    shared = surface([1, 1])
    shared = {name: shared[name] for name in ("engine", "edges", "m", "q")}
    stages = []
    for k, count in enumerate((600, 599)):
        own = surface([count, count])
        stages.append({name: own[name] for name in ("axes", "values", "rates", "lam", "eps")})
        stages[-1]["times"] = hexed([k / 2, (k + 1) / 2])
    window = box(2) | {"during": hexed([0.0, 1.0])}
    return file(problem(2, constraints=[window]), shared | {"stages": stages})


# ---- value functions in discrete time ------------------------------------------------------------------------


@bomb("monomials in sixty disturbances", MEMORY)
def _() -> Data:
    return file(problem(1, steps=2.0, pushes=60), induction([even(4)], 2))


@bomb("images of a thousand parts of a disturbance", MEMORY)
def _() -> Data:
    return file(problem(2, steps=2.0, pushes=1), induction([even(100), even(100)], 2, parts=1000))


@bomb("a grid of 65,536 cells in a row", MEMORY)
def _() -> Data:
    edges = [[-2 + 4 * k / 2**17 for k in range(65_537)], [-2.0, 2.0], [-2.0, 2.0]]
    noise = problem(3, steps=2.0)["noise"] | {"values": hexed([1.0] * 3)}
    return file(problem(3, steps=2.0, noise=noise, constraints=[]), induction(edges, 2))


@bomb("faces times cells", WORK)
def _() -> Data:
    about = problem(1, steps=2.0, constraints=[faces(1, 17_000)])
    return file(about, induction([[k / 2**15 for k in range(-8_500, 8_501)]], 2))


@bomb("a long tape at every step", WORK)
def _() -> Data:
    timed = tape(1, ["input", 0], *[["sin", k] for k in range(45_000)])
    timed["nodes"].append(["add", 45_000, timed["outputs"][0]])
    timed["outputs"] = [len(timed["nodes"]) - 1]
    return file(problem(1, steps=2000.0, dynamics=timed), induction([even(4)], 2000))


@bomb("pieces of noise beyond all whole numbers of 64 bits", "more than 200000 pieces")
def _() -> Data:
    noise = {"law": "rademacher", "level": "scale", "values": [ONE] * 64, "matrix": [[ONE] * 64]}
    return file(problem(1, steps=2.0, noise=noise), induction([even(4)], 2, pieces=2))


@bomb("pieces of noise in 400 entries", MEMORY)
def _() -> Data:
    noise = {
        "law": "uniform", "level": "halfwidth", "values": [ONE, ONE] + [ZERO] * 398, "matrix": [[ONE] * 400],
    }
    return file(problem(1, steps=2.0, noise=noise), induction([even(4)], 2, pieces=440))


@bomb("pieces of noise times cells", WORK)
def _() -> Data:
    noise = {"law": "uniform", "level": "halfwidth", "values": [ONE] * 2, "matrix": [[ONE, ZERO], [ZERO, ONE]]}
    return file(problem(2, steps=2.0, noise=noise, constraints=[]), induction([even(200)] * 2, 2, pieces=250))


@bomb("what multiplies 400 entries of noise over 100,000 cells", MEMORY)
def _() -> Data:
    noise = {
        "law": "uniform", "level": "halfwidth", "values": [ONE] + [ZERO] * 399, "matrix": [[ONE] * 400] * 2,
    }
    return file(problem(2, steps=2.0, noise=noise, constraints=[]), induction([even(316), even(316)], 2, pieces=2))


# ---- quadratic value bounds ----------------------------------------------------------------------------------


def quadratic(states: int, cells: int, pieces: int = 1, **problem_parts: Any) -> Data:
    """One bound for all walls, held along the first state."""
    n, forms = states + 1, states
    ends = 2 * pieces
    value = {
        "walls": [[-1 - axis, end] for axis in range(states) for end in (0, 1)], "first": 0, "degree": 1, "held": [0],
        "cuts": [hexed([2 * k / cells - 1 for k in range(cells + 1)])],
        "times": hexed([k / pieces for k in range(pieces + 1)]), "matrices": [[[ZERO] * n] * n] * (pieces + 1),
        "moves": packed(0), "weights": packed(ends * 2 * cells * forms),
        "wall_weights": [[[ZERO] * forms] * (pieces + 1)] * (2 * states),
        "wall_rows": [[[ZERO] * n] * (pieces + 1)] * (2 * states), "lam": [ZERO] * pieces, "gap": ONE,
    }  # fmt: skip
    proof = {"engine": "quadratic", "center": [ZERO] * states, "width": [ONE] * states, "bounds": [value]}
    return file(problem(states, **problem_parts), proof)


@bomb("the model over all of 40,000 cells at once", MEMORY)
def _() -> Data:
    return quadratic(12, 40_000)


@bomb("matrices with 400 columns of noise", WORK)
def _() -> Data:
    wide = {"law": "wiener", "diffusion": [[ONE] * 400] * 12}
    return quadratic(12, 4_000, 9, noise=wide)


# ---- horizons without an end ---------------------------------------------------------------------------------


def above() -> Data:
    """x >= 0."""
    region = {"kind": "halfspace", "normal": ["-0x1.0p+0"], "bound": ZERO}
    return {"kind": "inside", "during": None, "label": "above 0", "region": region}


def lasting(dynamics: Data, cells: int = 1) -> Data:
    """A function of the state alone on [0, 1]."""
    about = problem(1, dynamics=dynamics, horizon=1.0) | {"horizon": None}
    about["initial"] = {"kind": "box", "low": [HALF], "high": [HALF]}
    about["constraints"] = [above()]
    edges = [HALF, *(hexed(0.5 + k / 2**17) for k in range(1, cells)), ONE]
    return file(about, {
        "engine": "lasting", "mirrored": False, "edges": edges, "slopes": [ZERO] * cells,
        "tail": {"kind": "exponential", "rate": ONE},
    })


@bomb("polynomials with long coefficients", MEMORY)
def _() -> Data:
    nodes: list[list[Any]] = [["input", 1], ["const", "0x1.123456789abcdp-250"], ["add", 0, 1]]
    nodes += [["mul", k, 2] for k in range(2, 60)]
    last = len(nodes) - 1
    nodes += [["add", last, k % 40 + 3] for k in range(24_000)]
    total = [["add", last + 1, last + 2], *[["add", last + 24_000 + k, last + 2 + k] for k in range(1, 23_999)]]
    dynamics = {"nodes": nodes + total, "outputs": [len(nodes) + len(total) - 1]}
    about = lasting(dynamics)["problem"] | problem(1, steps=2.0, dynamics=dynamics, constraints=[above()])
    return file(about | {"horizon": None}, {
        "engine": "drift", "mirrored": False, "limit": ZERO, "rate": ZERO,
    })  # fmt: skip


@bomb("a long tape on every cell of a line", WORK)
def _() -> Data:
    return lasting(chain("sin", 12_000), 18_000)


@bomb("powers of powers: exponents of a hundred thousand bits", MEMORY)
def _() -> Data:
    return lasting(chain("pow", 13_000, "0x1.388p+13"))


# ---- what stands before a proof ------------------------------------------------------------------------------


@bomb("a model in other coordinates for every member of a union", MEMORY)
def _() -> Data:
    count = 500
    about = problem(2, dynamics=tape(2, *chain("sin", 12_000)["nodes"]))
    about["dynamics"]["nodes"].append(["add", 12_000, len(about["dynamics"]["nodes"]) - 1])
    about["dynamics"]["outputs"][-1] = len(about["dynamics"]["nodes"]) - 1
    about["initial"] = {"kind": "union", "members": [problem(2)["initial"]] * count}
    members = [
        {"engine": "coordinates", "matrix": hexed([[1.0, k], [0.0, 1.0]]), "inverse": hexed([[1.0, -k], [0.0, 1.0]]),
         "proof": {"engine": "barrier"}} for k in range(1, count + 1)
    ]  # fmt: skip
    return file(about, {"engine": "union", "members": members})


@bomb("a model in logarithms for every member of a union", MEMORY)
def _() -> Data:
    n, count = 30, 400
    about = problem(n)
    rate = chain("sin", 9_000)["nodes"]
    about["dynamics"] = {"nodes": rate, "outputs": [9_000] * n}
    about["noise"]["diffusion"] = {"columns": 1, "nodes": [["input", 1 + k] for k in range(n)], "outputs": [*range(n)]}
    about["constraints"] = [{
        "kind": "inside", "during": None, "label": "positive",
        "region": {"kind": "polytope", "A": hexed([[-float(i == j) for j in range(n)] for i in range(n)]),
                   "b": ["-0x1.0p-9"] * n},
    }]  # fmt: skip
    start = {"kind": "box", "low": [ONE] * n, "high": [ONE] * n}
    about["initial"] = {"kind": "union", "members": [start] * count}
    members = [
        {"engine": "logarithms", "states": [k % n, k * k % n, (k // n) % n], "proof": {"engine": "barrier"}}
        for k in range(count)
    ]
    return file(about, {"engine": "union", "members": members})


@bomb("jumps in time on a thousand pieces", WORK)
def _() -> Data:
    return file(problem(1, dynamics=stairs(4_000)), {"engine": "barrier", "jumps": 1000})


def stairs(count: int) -> Data:
    """A sum of comparisons with time."""
    nodes: list[list[Any]] = [["input", 1], ["input", 0]]
    for k in range(count):
        last = len(nodes) - 1 if k else 0
        nodes += [["const", hexed(k / 2**14)], ["lt", 1, len(nodes)], ["add", last, len(nodes) + 1]]
    return {"nodes": nodes, "outputs": [len(nodes) - 1]}


# ---- comparisons that rounding might decide -------------------------------------------------------------------


@bomb("comparisons at a hundred thousand steps, of a hundred moving sets", WORK)
def _() -> Data:
    nodes: list[list[Any]] = [["input", 0], ["sq", 0]]
    nodes += [[("mul", "add")[k % 2], k, 0] for k in range(1, 25)]
    nodes += [["const", ONE], ["lt", len(nodes), len(nodes) - 1]]
    center = {"nodes": nodes, "outputs": [len(nodes) - 1]}
    ball = {"kind": "ball", "center": center, "radius": ONE, "coordinates": None}
    moving = {"kind": "inside", "region": ball, "during": None, "label": ""}
    return file(problem(1, steps=100_000.0, constraints=[moving] * 100), barrier(1))


@bomb("comparisons of what reads 400 states", WORK)
def _() -> Data:
    n, count = 400, 20_000
    nodes: list[list[Any]] = [*[["input", 1 + k] for k in range(n)], ["const", hexed(1.0 + 2**-30)]]
    nodes += [["mul", k, n] for k in range(n)]
    nodes += [["add", len(nodes) + k - 1, n + 1 + k % n] for k in range(count)]
    nodes += [["lt", len(nodes) - 1, 0]]
    about = problem(n, steps=1.0, dynamics={"nodes": nodes, "outputs": [len(nodes) - 1] * n}, noise=single(n))
    return file(about, response(n, 1, discrete=True))


@bomb("two hundred bends of a long line in time", WORK)
def _() -> Data:
    nodes: list[list[Any]] = [["input", 1], ["input", 0]]
    line = 1
    for k in range(190):
        nodes += [["const", hexed((k + 1) / 200 + 2.0**-40 * k)], ["min", line, len(nodes)], ["add", len(nodes) + 1, 1]]
        line = len(nodes) - 1
    for k in range(15_000):
        nodes += [["const", hexed(1 + k * 2.0**-50)], ["add", line, len(nodes)]]
        line = len(nodes) - 1
    nodes += [["const", hexed(1e9)], ["lt", line, len(nodes)], ["mul", 0, len(nodes) + 1]]
    return file(problem(1, dynamics={"nodes": nodes, "outputs": [len(nodes) - 1]}), barrier(1))


@bomb("the words of networks of networks", "comparison that rounding decides")
def _() -> Data:
    wide, layers = 100, [{"weights": [[ONE] * 100], "bias": [ZERO], "activation": "tanh", "constants": []}]
    nodes: list[list[Any]] = [["input", 1 + k] for k in range(wide)]
    for level in range(6):
        first = len(nodes) - wide
        nodes += [["network", 0, 0, *range(first, first + wide)] for _ in range(wide if level < 5 else 1)]
    small, top = hexed(2.0**-60), len(nodes) - 1
    nodes += [
        ["const", small], ["mul", top, top + 1], ["const", hexed(0.1)], ["const", hexed(0.2)],
        ["add", top + 3, top + 4], ["add", top + 5, top + 2], ["const", hexed(0.3)], ["lt", top + 6, top + 7],
    ]
    dynamics = {"networks": [layers], "nodes": nodes, "outputs": [len(nodes) - 1] * wide}
    about = problem(wide, steps=1.0, dynamics=dynamics, noise=single(wide))
    return file(about, response(wide, 1, discrete=True))


# ---- what bounded noise does at most --------------------------------------------------------------------------


@bomb("the reach of bounded noise along many rows", WORK)
def _() -> Data:
    steps, count = 1_400, 60
    noise = {"law": "uniform", "level": "halfwidth", "values": [ONE], "matrix": [[hexed(1e-9)]]}
    wall = {"kind": "halfspace", "normal": [ONE], "bound": ONE}
    about = problem(1, steps=steps, noise=noise)
    about["constraints"] = [{"kind": "inside", "region": wall, "during": None, "label": ""}] * count
    return file(about, response(1, steps, discrete=True, separations=[None] * count))


@bomb("derivatives of a long chain by every state", "more than 400000 operations")
def _() -> Data:
    n = 100
    nodes: list[list[Any]] = [["input", 1 + k] for k in range(n)]
    nodes += [["mul", len(nodes) + k - 1, k % n] for k in range(40_000)]
    about = problem(n, steps=1.0, dynamics={"nodes": nodes, "outputs": [len(nodes) - 1] * n}, noise=single(n))
    return file(about, response(n, 1, discrete=True))


def single(n: int) -> Data:
    """One entry of noise for all states."""
    return {"law": "gaussian", "level": "std", "values": [ONE], "matrix": [[ONE]] * n}


@bomb("second derivatives of a wide network", MEMORY)
def _() -> Data:
    wide, narrow = 250, 4
    first = [[ONE] * wide] * wide
    layers = [
        {"weights": first, "bias": [ZERO] * wide, "activation": "tanh", "constants": []},
        {"weights": [[ONE] * wide] * narrow, "bias": [ZERO] * narrow, "activation": "tanh", "constants": []},
    ]
    about = problem(1)
    about["dynamics"] = {
        "networks": [layers], "nodes": [["input", 1], ["network", 0, 0, *[0] * wide]], "outputs": [1],
    }
    return file(about, barrier(1))


def barrier(states: int, **parts: Any) -> Data:
    """exp(|x|^2) as a barrier."""
    return {
        "engine": "barrier", "center": [ZERO] * states, "scale": [ONE] * states,
        "exponents": [[2 * (i == j) for j in range(states)] for i in range(states)], "coefficients": [ONE] * states,
        "growth": hexed(1e3), "start": HALF, "boundary": hexed(0.875), **parts,
    }


@bomb("boxes on which a sum that is 0 is never seen to be", WORK)
def _() -> Data:
    """f = K (sin^2 + cos^2 - 1) sin(sin(...)) - x, for which the generator of |x|^2 is the number of states."""
    n, length = 6, 2_000
    nodes: list[list[Any]] = [["input", 1 + i] for i in range(n)]
    nodes += [["const", hexed(1e9)], ["const", "-0x1.0p+0"]]
    outputs = []
    for i in range(n):
        first = len(nodes)
        nodes += [["sin", i], ["cos", i], ["sq", first], ["sq", first + 1], ["add", first + 2, first + 3]]
        nodes += [["add", first + 4, n + 1], ["mul", first + 5, n], ["sin", i]]
        nodes += [["sin", first + 7 + k] for k in range(length)]
        last = len(nodes) - 1
        nodes += [["mul", first + 6, last], ["sub", last + 1, i]]
        outputs.append(len(nodes) - 1)
    about = problem(n, dynamics={"nodes": nodes, "outputs": outputs})
    return file(about, barrier(n, growth=hexed(n + 2.0**-30)))


@bomb("a barrier whose generator is no end of operations", "more than 400000 operations")
def _() -> Data:
    n, columns = 6, 400
    powers = [[2 * a, 2 * b, 2 * c, 12, 10, 8] for a in range(6) for b in range(6) for c in range(6)]
    about = problem(n, noise={"law": "wiener", "diffusion": {
        "columns": columns, "nodes": [["input", 1], *[["sin", k] for k in range(6 * columns)]],
        "outputs": list(range(1, 6 * columns + 1)),
    }})  # fmt: skip
    return file(about, barrier(n, exponents=powers, coefficients=["0x1.0p-99"] * len(powers),
                              boundary="-0x1.0p+0"))


# ---- solutions of the backward equation ----------------------------------------------------------------------


def wholes(count: int, word: str = "0") -> str:
    """The same whole number again and again, compressed."""
    return packed(count, word)


def solution(cells: list[int], slabs: int, *, lower: bool = False, **parts: Any) -> Data:
    """A solution that is 0 everywhere, which is more than its ``eta`` allows."""
    count = slabs + 1
    for number in cells:
        count *= number + 5
    return {
        "engine": "backward", "axes": [hexed([-0.5 + k / number for k in range(number + 1)]) for number in cells],
        "times": hexed([k / slabs for k in range(slabs + 1)]), "units": [ONE, ONE], "values": wholes(count),
        "rates": wholes(count), "eta": ["-0x1.0p+0"] * slabs,
        **({"side": "lower", "starts": [[ZERO] * len(cells)]} if lower else {}), **parts,
    }  # fmt: skip


@bomb("patches that are cut again and again", MORE)
def _() -> Data:
    return file(problem(2), solution([300, 300], 30))


@bomb("more coefficients of a solution than are read", "at most 4000000 coefficients")
def _() -> Data:
    return file(problem(3), solution([250, 250, 250], 1, values="", rates=""))


@bomb("whole numbers that unpack to sixty megabytes", "and nothing else")
def _() -> Data:
    return file(problem(2), solution([8, 8], 4, values=wholes(30_000_000)))


@bomb("a long tape on two million cells of a solution", WORK)
def _() -> Data:
    dynamics = tape(2, ["input", 1], *[["add", k, 0] for k in range(16_000)])
    dynamics["nodes"].append(["add", 16_000, dynamics["outputs"][0]])
    dynamics["outputs"][0] = len(dynamics["nodes"]) - 1
    return file(problem(2, dynamics=dynamics), solution([1400, 1400], 1))


@bomb("values of all operations on cells of a solution", MEMORY)
def _() -> Data:
    nodes = [["input", 1], *[["sin", 0]] * 20_000]
    nodes += [["add", 1, 2], *[["add", 20_000 + k, k + 2] for k in range(1, 19_999)]]
    nodes.append(["input", 2])
    dynamics = {"nodes": nodes, "outputs": [len(nodes) - 2, len(nodes) - 1]}
    return file(problem(2, dynamics=dynamics), solution([64, 64], 1))


@bomb("columns of noise on cells of a solution", WORK)
def _() -> Data:
    noise = {"law": "wiener", "diffusion": [[ONE] * 400] * 3}
    return file(problem(3, noise=noise), solution([120, 120, 120], 1))


def raised(dynamics: Data, place: int) -> Data:
    """The rate of the first state plus an operation."""
    dynamics["nodes"].append(["add", dynamics["outputs"][0], place])
    dynamics["outputs"][0] = len(dynamics["nodes"]) - 1
    return dynamics


def staged(many: int, cells: list[int], slabs: int) -> Data:
    """A solution of many stages."""
    stages, length = [], 1.0 / many
    for k in range(many):
        one = solution(cells, slabs)
        del one["engine"]
        one["times"] = hexed([(k + i / slabs) * length for i in range(slabs + 1)])
        stages.append(one)
    return {"engine": "backward", "stages": stages}


@bomb("more stages of a solution than are read", "must have 1 to 50 entries")
def _() -> Data:
    return file(problem(2), staged(64, [1, 1], 1))


@bomb("fifty stages whose patches are cut again and again", MORE)
def _() -> Data:
    return file(problem(2), staged(32, [64, 64], 16))


@bomb("disturbances that are tried on every patch", MORE)
def _() -> Data:
    dynamics = raised(tape(2, ["input", 3]), 0)
    proof = solution([128, 128], 32, lower=True, disturbances=[[ZERO]] * 64)
    return file(problem(2, pushes=1, dynamics=dynamics), proof, lower=True)


@bomb("monomials of four hundred disturbances", WORK)
def _() -> Data:
    dynamics = tape(2, *[["input", 3 + k] for k in range(400)])
    for k in range(400):
        dynamics = raised(dynamics, k)
    return file(problem(2, pushes=400, dynamics=dynamics), solution([8, 8], 4))


@bomb("functions of time on sixteen thousand slabs of a solution", WORK)
def _() -> Data:
    dynamics = raised(tape(2, ["input", 0], *[["sin", k] for k in range(4)]), 4)
    return file(problem(2, dynamics=dynamics), solution([1, 1], 16_384))


@bomb("a target of many faces about the cells of a solution", WORK)
def _() -> Data:
    around = faces(2, 10_000)
    around["kind"], around["region"]["b"] = "reach", [ZERO] * 10_000
    return file(problem(2, reach=around), solution([1024, 512], 1))


@bomb("lists in the axes of a solution", "must be a number")
def _() -> Data:
    return file(problem(2), solution([8, 8], 4, axes=[[[[ZERO]]] * 30_000] * 2))


# ---- contraction constants -----------------------------------------------------------------------------------


@bomb("a tube of 1,024 corners in 90 states", WORK)
def _() -> Data:
    n, steps = 90, 500
    about = problem(n, steps=steps, pushes=10, noise=single(n))
    return file(about, constants(n, steps + 1))


@bomb("faces times steps", MEMORY)
def _() -> Data:
    steps = 5_000
    return file(problem(1, steps=steps, constraints=[faces(1, 18_000)]), constants(1, steps + 1))


@bomb("boxes of many sides, many times", MEMORY)
def _() -> Data:
    n, steps, count = 40, 1_000, 150
    about = problem(n, steps=steps, constraints=[box(n)] * count, noise=single(n))
    proof = constants(n, steps + 1)
    proof["cells"][0]["separations"] = [None] * count
    return file(about, proof)


@bomb("balls over all states, many times", WORK)
def _() -> Data:
    n, steps, count = 60, 900, 1_000
    ball = {"kind": "ball", "center": None, "radius": hexed(100.0), "coordinates": None}
    about = problem(n, steps=steps, noise=single(n))
    about["constraints"] = [{"kind": "inside", "region": ball, "during": None, "label": ""}] * count
    proof = constants(n, steps + 1)
    proof["cells"][0]["separations"] = [None] * count
    return file(about, proof)


@bomb("powers of powers along a curve", MEMORY)
def _() -> Data:
    dynamics = chain("pow", 17_000, "0x1.388p+13")
    return file(problem(1, dynamics=dynamics), constants(1, 2, [0.0, 0.5, 1.0]))


@bomb("vertices of a Jacobian of 95 states", WORK)
def _() -> Data:
    n = 95
    dynamics = tape(n)
    nodes, outputs = dynamics["nodes"], dynamics["outputs"]
    for i in range(12):
        place = nodes.index(["input", 1 + i])
        nodes += [["sin", place], ["add", outputs[i], len(nodes)]]
        outputs[i] = len(nodes) - 1
    metric = hexed([[float(i == j) for j in range(n)] for i in range(n)])
    about = problem(n, steps=1.0, dynamics=dynamics, noise=single(n))
    return file(about, constants(n, 2, assumed=False, metric=metric))


@bomb("sections of a thousand balls in 95 states", WORK)
def _() -> Data:
    n, count = 95, 1_000
    ball = {"kind": "ball", "center": None, "radius": hexed(100.0), "coordinates": None}
    about = problem(n, steps=1.0, noise=single(n))
    about["constraints"] = [{"kind": "inside", "region": ball, "during": None, "label": ""}] * count
    proof = constants(n, 2)
    proof["cells"][0]["separations"] = [None] * count
    return file(about, proof)


# ---- linear responses ----------------------------------------------------------------------------------------


@bomb("transition matrices of 90 states", WORK)
def _() -> Data:
    n, pieces = 90, 100
    about = problem(n, noise={"law": "wiener", "diffusion": [[ONE]] * n})
    return file(about, response(n, pieces, discrete=False))


@bomb("remainders of 99 states over a long chain", MEMORY)
def _() -> Data:
    n = 99
    nodes = [*chain("sin", 15_000)["nodes"]]
    about = problem(n, steps=1.0, dynamics={"nodes": nodes, "outputs": [15_000] * n}, noise=single(n))
    proof = response(n, 1, discrete=True) | {"varying": [[i, 0] for i in range(n)], "units": [0]}
    proof["cells"][0] |= {"slopes": [[HALF] * n]}
    return file(about, proof)


@bomb("a long tape at every piece", WORK)
def _() -> Data:
    steps = 3_500
    nodes = chain("sin", 12_000)["nodes"]
    about = problem(1, steps=steps, dynamics={"nodes": nodes, "outputs": [12_000]})
    proof = response(1, steps, discrete=True) | {"varying": [[0, 0]], "units": [0]}
    proof["cells"][0] |= {"slopes": [[HALF]] * steps, "levels": [[ONE]] * steps}
    return file(about, proof)


@bomb("rows of every piece through all pieces before it", MEMORY)
def _() -> Data:
    steps, count = 4_000, 900
    wall = {"kind": "halfspace", "normal": [ONE], "bound": ONE}
    about = problem(1, steps=steps)
    about["constraints"] = [{"kind": "inside", "region": wall, "during": None, "label": ""}] * count
    proof = response(1, steps, discrete=True, separations=[None] * count)
    return file(about, proof)


@bomb("frames of 300 states", MEMORY)
def _() -> Data:
    n, steps = 300, 90
    about = problem(n, steps=steps, noise=single(n), constraints=[])
    return file(about, response(n, steps, discrete=True, separations=[]))


# ---- exact laws ----------------------------------------------------------------------------------------------


def law(states: int, grids: list[list[int]], limits: int, windows: list[int] | None, bits: int = 128) -> Data:
    plans = [{"grid": k % len(grids), "windows": windows} for k in range(limits)]
    return {"engine": "affine", "bits": bits, "grids": grids, "limits": plans}


@bomb("pieces of time of a row of 200 states", MORE)
def _() -> Data:
    n, count = 200, 2**16
    about = problem(n, constraints=[faces(n, 1)], noise={"law": "wiener", "diffusion": [[ONE]] * n})
    return file(about, law(n, [[16] * count], 1, [1] * count))


@bomb("Gramians of 250 states for 160 halvings", MORE)
def _() -> Data:
    n = 250
    noise = {"law": "wiener", "diffusion": [[ONE]] * n}
    return file(problem(n, noise=noise), law(n, [[160, *range(160, 0, -1)]], 2 * n, [1] * 161))


@bomb("Gramians of many disturbances in 3000 bits", MORE)
def _() -> Data:
    n, pushes = 40, 300
    nodes: list[list[Any]] = [["input", 1 + i] for i in range(n)] + [["input", 1 + n + j] for j in range(pushes)]
    outputs = []
    for i in range(n):
        total = i
        for j in range(pushes):
            nodes.append(["add", total, n + j])
            total = len(nodes) - 1
        outputs.append(total)
    about = problem(n, pushes=pushes, dynamics={"nodes": nodes, "outputs": outputs})
    return file(about, law(n, [[0]], 2 * n, [1], bits=3000))


@bomb("a thousand limits on a long grid", MORE)
def _() -> Data:
    dynamics = {"nodes": [["input", 2], ["input", 1], ["neg", 1]], "outputs": [0, 2]}
    noise = {"law": "wiener", "diffusion": [[ZERO], [ONE]]}
    wall = {"kind": "halfspace", "normal": [ONE, ZERO], "bound": hexed(9.0)}
    walls = [{"kind": "inside", "region": wall, "during": None, "label": ""}] * 1_000
    return file(problem(2, dynamics=dynamics, noise=noise, constraints=walls), law(2, [[16] * 2**16], 1_000, None))


# ---- reading -------------------------------------------------------------------------------------------------


@bomb("a text that unpacks to a gigabyte", "and nothing else")
def _() -> Data:
    machine, block = zlib.compressobj(9), b"0" * 2**20
    text = b"".join([*(machine.compress(block) for _ in range(700)), machine.flush()])
    return file(problem(1), surface([2], 2, values=base64.b64encode(text).decode()))


@bomb("lists in lists in lists", "nested too deeply")
def _() -> str:
    return '{"format": ' + "[" * 900_000


# ---- checks in processes of their own ------------------------------------------------------------------------


def content(name: str) -> bytes:
    """The file."""
    made = BOMBS[name][0]()
    return (made if isinstance(made, str) else json.dumps(made, separators=(",", ":"))).encode()


def checked(text: bytes, seconds: float) -> str:
    """What the checker says of a file with so much work and all the time in the world."""
    limits: Any = partial(Budget, clock=float("inf"))
    with patch.object(check, "Budget", limits):
        try:
            report = check_data(parse(text), seconds=seconds)
        except CertificateError as error:
            return str(error)
    return report.reason if not report.proved else "it is proved"


def _pages() -> tuple[int, int]:
    """Bytes of this process's memory, and of what is there of it."""
    with open("/proc/self/statm", encoding="ascii") as stream:
        whole, there, *_ = stream.read().split()
    return int(whole) * resource.getpagesize(), int(there) * resource.getpagesize()


def alone(name: str, seconds: float) -> Data:
    """The same in a process whose memory is limited: what it says, its size, and the memory and time that it took."""
    text = content(name)
    size, before = _pages()
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_AS, (size + MOST_BYTES, size + MOST_BYTES))
        try:
            found = checked(text, seconds)
        except MemoryError:
            found = "no memory is left"
        with os.fdopen(writer, "w") as stream:
            stream.write(found)
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as stream:
        found = stream.read()
    _, status, used = os.wait4(child, 0)
    return {
        "says": found if status == 0 else f"ended with status {status}", "bytes": len(text),
        "memory": max(1024 * used.ru_maxrss - before, 0), "seconds": used.ru_utime + used.ru_stime,
    }  # fmt: skip


def main() -> None:
    """Answer line by line."""
    import certbound.checker.values  # noqa: F401  # loaded once, for all

    for line in sys.stdin:
        name, seconds = json.loads(line)
        sys.stdout.write(json.dumps(alone(name, seconds)) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
