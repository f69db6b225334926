"""All that can be asked, a row each: saved and loaded, drawn, bounded, simulated, certified, a forged twin refused.

The rows are examples of ``certbound new --example`` and some more. Simulations here are NumPy's own, by what the words
say; the kernels are held against these bounds elsewhere.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import nullcontext
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data
from certbound.cli.commands.check import proved_certificate
from certbound.cli.starters import STARTERS
from certbound.problem.model import compile_numpy
from certbound.safety.answers import exact
from certbound.safety.certificate import problem_data
from certbound.simulation.estimates.statistics import bound_binomial
from certbound.values.continuous.line import ladder
from tests.checker.conftest import coarsely, kept_tables, side_of

__all__ = ["kept_tables"]  # a fixture

PATHS = 4000
STEPS = 200
"""Of Euler's scheme in continuous time, where the exits between them are not seen."""

PLAIN = """
name = "plain"
time = "discrete"
horizon = 6
delta = 0.3
states = ["x"]
[dynamics]
x = "0.8*x"
[noise]
law = "gaussian"
std = 0.3
[initial]
point = [0.2]
[[stay]]
box = { x = [-1, 1] }
"""
FLOW = PLAIN.replace('"discrete"', '"continuous"').replace("horizon = 6", "horizon = 1").replace("0.8*x", "-x")
FLOW = FLOW.replace('law = "gaussian"\nstd = 0.3', "diffusion = [[0.4]]")


def _with(text: str, *pairs: tuple[str, str]) -> str:
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    return text


LOOSE = FLOW.replace("delta = 0.3", "delta = 0.9")
PLANE = _with(
    LOOSE, ('["x"]', '["x", "y"]'), ('x = "-x"', 'x = "-x"\ny = "-y"'), ("[[0.4]]", "[[0.4, 0], [0, 0.4]]"),
    ("[0.2]", "[0.2, 0.1]"), ("[-1, 1]", "[-1, 1], y = [-1, 1]"),
)  # fmt: skip
INSIDE = "box = { x = [-1, 1] }"
ENDS = (INSIDE, "box = { x = [-0.6, 3] }"), ("[init", "[domain]\nbox = { x = [-2, 0.9] }\nleaving = 'ends'\n[init")
QUICK = ("union", "target", "polygon", "packets", "forever", "growth", "staying", "ruin", "sampled")
LAW = 'law = "gaussian"\nstd = 0.3'
ROWS: dict[str, str] = {name: STARTERS[name] for name in QUICK} | {
    "several at once": PLAIN.replace("[initial]", "[[initial]]") + "[[initial]]\nbox = [[-0.1, 0.3]]\n",
    "a constant that is drawn": _with(
        PLAIN, ("0.8*x", "k*x"), ("[dyn", "[random]\nk = { law = 'uniform', halfwidth = 0.1, mean = 0.7 }\n[dyn"),
    ),
    "a constant that is unknown": _with(PLAIN, ("0.8*x", "k*x"), ("[dyn", "[uncertain]\nk = [0.6, 0.7]\n[dyn")),
    "a random start": _with(PLAIN, ("point = [0.2]", "gaussian = { mean = [0.2], std = 0.1 }")),
    "units": _with(PLAIN, ("[dyn", "units = { time = 'h', x = 'K' }\n[dyn")),
    "a model that jumps in time": _with(FLOW, ('"-x"', '"where(t < 0.5, -x, 0.2)"')),
    "windows": PLAIN + "during = [2, 5]\n[[avoid]]\nbox = { x = [0.7, 0.9] }\nduring = [3, 3]\n",
    "target in a window": PLAIN + "[[reach]]\nbox = { x = [-0.2, 0.3] }\nduring = [2, 4]\n",
    "laplace": _with(PLAIN, (LAW, 'law = "laplace"\nscale = 0.1')),
    "histogram": _with(PLAIN, (LAW, 'law = "histogram"\nedges = [-1, 0, 1]\nprobabilities = [0.5, 0.5]\nscale = 0.5')),
    "uniform": _with(PLAIN, (LAW, 'law = "uniform"\nhalfwidth = 0.5')),
    "sign and floor": _with(PLAIN, ("0.8*x", "0.8*x - 0.1*sign(x) + 0.05*floor(2*x)"), ("0.3\n[in", "0.2\n[in")),
    "a long horizon": _with(PLAIN, ("horizon = 6", "horizon = 2500"), ("std = 0.3", "std = 0.14")),
    "windows in continuous time": LOOSE + "[[stay]]\nbox = { x = [-0.6, 0.7] }\nduring = [0.6, 1]\n",
    "target in continuous time": LOOSE + "[[reach]]\nbox = { x = [-0.3, 0.1] }\n",
    "triangular": _with(PLAIN, (LAW, 'law = "triangular"\nhalfwidth = 0.6')),
    "ends": _with(PLAIN, *ENDS),
    "ends in continuous time": _with(FLOW, *ENDS),
    "windows in the plane": PLANE + "[[stay]]\nbox = { x = [-0.6, 0.7], y = [-0.8, 0.8] }\nduring = [0.6, 1]\n",
    "target in the plane": PLANE + "[[reach]]\nbox = { x = [-0.3, 0.1], y = [-0.3, 0.3] }\n",
    "ends in the plane": _with(
        PLANE, ("x = [-1, 1], y = [-1, 1]", "x = [-0.6, 3], y = [-3, 3]"),
        ("[init", "[domain]\nbox = { x = [-2, 0.9], y = [-1, 1] }\nleaving = 'ends'\n[init"),
    ),
    "a target for ever": _with(FLOW, ("horizon = 1", "horizon = inf")) + "[[reach]]\nbox = { x = [-0.3, 0] }\n",
}  # fmt: skip

SLOW = ("a long horizon", "a model that jumps in time", "sampled", *(name for name in ROWS if name.endswith("plane")))
METHODS = {name: "values" for name in ROWS if name.endswith(("continuous time", "for ever", "plane"))}
BELOW = ("ends", "triangular")
METHODS |= {"ruin": "values", "union": "linear"}
OWN = {"discrete": "values", "continuous": "linear"}


# ---- paths of NumPy's own ------------------------------------------------------------------------------------


def _drawn(law: Any, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draws of a law, by its name and level."""
    size = np.asarray(getattr(law, law.level), dtype=float)
    m = len(size)
    if law.name == "gaussian":
        return rng.multivariate_normal(np.zeros(m), law.proxy, count)
    if law.name in ("discrete", "histogram"):
        weights = np.asarray(law.probabilities)
        row = rng.choice(len(weights), (count, m), p=weights)
        if law.name == "discrete":
            return size * np.asarray(law.values)[row]
        edges = np.asarray(law.edges)
        return size * rng.uniform(edges[row], edges[row + 1])
    draw = {
        "uniform": lambda: rng.uniform(-1, 1, (count, m)), "triangular": lambda: rng.triangular(-1, 0, 1, (count, m)),
        "laplace": lambda: rng.laplace(size=(count, m)), "rademacher": lambda: rng.choice([-1.0, 1.0], (count, m)),
    }  # fmt: skip
    return size * draw[law.name]()


def _paths(problem: cb.Problem, start: np.ndarray, rng: np.random.Generator) -> Iterator[tuple[float, np.ndarray]]:
    """Times and states, shape (paths, n)."""
    system, count = problem.system, PATHS
    x = problem.initial.sample(rng, count) if problem.initial.random else np.tile(start, (count, 1))
    pushes = []
    for name, low, high in _ranges(system):
        one = problem.random.get(name)
        pushes.append(np.full(count, high) if one is None else one.mean + _drawn(one.law, count, rng)[:, 0])
        assert one is not None or low < high
    discrete = system.time == "discrete"
    end = min(problem.horizon, (1000 if problem.endless else 2500) if discrete else 5)
    steps = int(end) if discrete else STEPS
    h = 1.0 if discrete else end / steps
    move = compile_numpy(system.dynamics if problem.hold else problem.closed_loop)
    given = (system.noise_matrix if system.gain is None else system.gain) if discrete else system.diffusion
    spread = compile_numpy(given) if hasattr(given, "nodes") else lambda t, *x: np.asarray(given)
    yield 0.0, x
    held: list[np.ndarray] = []
    for k in range(steps):
        t = k * h
        if problem.hold and k % round(problem.hold / h) == 0:
            held = list(np.broadcast_to(compile_numpy(problem.plan)(t, *x.T), (count, problem.plan.shape[0])).T)
        f, g = move(t, *x.T, *held, *pushes), spread(t, *x.T)
        w = _drawn(system.noise, count, rng) if discrete else rng.standard_normal((count, g.shape[-1])) * np.sqrt(h)
        x = (f if discrete else x + h * f) + np.einsum("kij,kj->ki", np.broadcast_to(g, (count, *g.shape[-2:])), w)
        yield t + h, x


def _ranges(system: Any) -> list[tuple[str, float, float]]:
    box = system.disturbance
    return [] if box is None else list(zip(system.disturbance_names, box.low, box.high))


def failing(problem: cb.Problem, start: np.ndarray, rng: np.random.Generator) -> int:
    """How many paths fail, by what the words say."""
    gone, there, over = np.zeros((3, PATHS), dtype=bool)
    target = problem.reach
    for t, x in _paths(problem, start, rng):
        if problem.domain is not None:
            left = ~np.asarray(problem.domain.contains(x, t)) & ~gone & ~there
            over |= left & problem.ending
            gone |= left & (not problem.ending)
        active = ~over & (~there if target is None or not target.stays else True)
        for one in problem.safe:
            if one.during is None or one.during[0] - 1e-9 <= t <= one.during[1] + 1e-9:
                inside = np.asarray(one.region.contains(x[:, one.region.places(x.shape[1])], t))
                gone |= active & (inside if one.outside else ~inside)
        if target is not None:
            met = np.asarray(target.region.contains(x[:, target.region.places(x.shape[1])], t))
            gone |= there & ~met & ~over if target.stays else False
            first, last = target.during or (0, np.inf)
            there |= met & ~gone & ~over & (first <= t <= last)
    return int((gone | (~there & ~over) if target is not None else gone).sum())


# ---- moments of what is drawn --------------------------------------------------------------------------------


def _variance(law: Any) -> np.ndarray:
    """Of the entries of a law whose mean is 0, by hand."""
    size = np.asarray(getattr(law, law.level), dtype=float)
    if law.name == "gaussian":
        return size**2 if law.level == "std" else np.diag(law.proxy)
    if law.name in ("discrete", "histogram"):
        weights = np.asarray(law.probabilities)
        edges = np.asarray(law.edges if law.name == "histogram" else [*law.values, 0])
        a, b = (edges[:-1], edges[1:]) if law.name == "histogram" else (edges[:-1], edges[:-1])
        assert abs(weights @ (a + b)) < 1e-12
        return size**2 * (weights @ (a * a + a * b + b * b)) / 3
    return size**2 * {"uniform": 1 / 3, "triangular": 1 / 6, "laplace": 2.0, "rademacher": 1.0}[law.name]


def hold_moments(problem: cb.Problem, rng: np.random.Generator, count: int = 20_000) -> None:
    """Means and variances of noise, random starts and drawn constants, as simulations draw them."""
    drawn = [(one.sample(rng, count), np.array([one.mean]), _variance(one.law)) for one in problem.random.values()]
    if problem.system.time == "discrete":
        law = problem.system.noise
        drawn.append((law.sample(rng, count), np.zeros(1), _variance(law)))
    if problem.initial.random:
        drawn.append((problem.initial.sample(rng, count), problem.initial.middle, np.diag(problem.initial.covariance)))
    for found, mean, variance in drawn:
        rows = np.asarray(found).reshape(count, -1)
        np.testing.assert_array_less(np.abs(rows.mean(axis=0) - mean), 5 * np.sqrt(variance / count) + 1e-12)
        np.testing.assert_array_less(np.abs(rows.var(axis=0) - variance), 15 * variance / np.sqrt(count) + 1e-12)


# ---- the table -----------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("kept_tables")
@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in ROWS])
def test_a_feature_is_saved_bounded_simulated_and_certified(name: str, tmp_path: Any) -> None:
    path = tmp_path / "problem.toml"
    path.write_text(ROWS[name])
    problem = cb.load(path)
    cb.save(problem, tmp_path / "again.toml")
    data = problem_data(problem)
    assert problem_data(cb.load(tmp_path / "again.toml")) == data
    hold_moments(problem, np.random.default_rng(11))
    with patch.object(ladder, "LADDER", ((1.5, 1e-2, 0.1),)), nullcontext() if name in SLOW else coarsely():
        verdict = cb.verify_safety(problem, method=METHODS.get(name, OWN[problem.system.time]))
    assert verdict.status == "SAFE"
    rng, first = np.random.default_rng(7), problem.starts[0]
    point = len(problem.starts) == 1 and (first.random or np.ptp([first.hull().lo, first.hull().hi]) == 0)
    worst = max(failing(problem, np.asarray(start.middle, dtype=float), rng) for start in problem.starts)
    low, high = bound_binomial(worst, PATHS, 1 - 1e-6)
    assert low <= 10**verdict.log10_delta
    if point and verdict.log10_lower is not None and problem.system.time == "discrete":
        assert 10**verdict.log10_lower <= high
    twin = json.loads(proved_certificate(problem, verdict, []))
    claim = float.fromhex(twin["claim"]["log10_delta"])
    assert claim < 0
    twin["claim"]["log10_delta"] = exact(1.001 * claim - 1e-3)
    assert not check_data(twin, data, allow_assumptions=True).valid
    if name in BELOW:
        twin = json.loads(side_of(problem, dict(verdict.answers), lower=True))
        assert check_data(twin, data).valid
        twin["claim"]["log10_lower"] = exact(0.99 * verdict.log10_delta)
        assert not check_data(twin, data).valid
