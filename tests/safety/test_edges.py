"""States exactly on faces, edges and corners: sets to stay in, to reach and to avoid are closed.

A row is a problem whose probability of failing is known exactly, most of it carried by a path that ends exactly on a
boundary, at places that floats compute without rounding. Every engine, the simulation and every valid certificate have
to agree with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom, norm

import certbound as cb
from certbound.checker import check_data
from certbound.problem.sets import polygon
from certbound.safety.engines import values
from certbound.safety.portfolio import ENGINES

Inside, Outside, Box, HalfSpace = cb.Inside, cb.Outside, cb.Box, cb.HalfSpace
INF, TINY = math.inf, 1e-9
"""Where a wide limit is kept with noise of its own, failing has a probability between 0 and this."""
PATHS, CONFIDENCE = 400, 1e-6


@dataclass(frozen=True, kw_only=True)
class Row:
    """A problem, the probability of failing between two numbers, and the steps of a simulation (0: none)."""

    name: str
    problem: Callable[[], cb.Problem]
    least: float
    most: float
    steps: int | None = None


def steps_of(f: Any, noise: Any, start: Any, safe: list[Any], horizon: int, **more: Any) -> Callable[[], cb.Problem]:
    kept = {key: more.pop(key) for key in ("noise_matrix", "disturbance") if key in more}
    states = len(start) if isinstance(start, list) else start.dimension
    return lambda: cb.Problem(
        cb.DiscreteSystem(f, states=states, noise=noise, **kept), initial=start, safe=safe, horizon=horizon, **more
    )


def flow_of(f: Any, g: Any, start: list[float], safe: list[Any], horizon: float) -> Callable[[], cb.Problem]:
    system = lambda: cb.ContinuousSystem(f, states=len(start), diffusion=g)  # noqa: E731
    return lambda: cb.Problem(system(), initial=start, safe=safe, horizon=horizon)


def row(name: str, problem: Callable[[], cb.Problem], least: float, most: float | None = None, **more: Any) -> Row:
    return Row(name=name, problem=problem, least=least, most=least if most is None else most, **more)


# ---- one state, and coins ------------------------------------------------------------------------------------

UP_TO_ONE = {
    "half-space": HalfSpace([1.0], 1.0),
    "long normal": HalfSpace([2.0], 2.0),
    "box without end": Box([-INF], [1.0]),
    "box": Box([-3.0], [1.0]),
    "box about a centre": Box([-4.0], [0.0], center=[1.0]),
    "ball": cb.Ball([-1.0], 2.0),
    "ellipsoid": cb.Ellipsoid([-1.0], [[4.0]]),
    "polytope": cb.Polytope([[1.0], [-1.0]], [1.0, 3.0]),
    "moving ball": cb.Ball(lambda t: [0 * t - 1.0], 2.0),
}
FROM_ONE = {
    "half-space": HalfSpace([-1.0], -1.0),
    "long normal": HalfSpace([-2.0], -2.0),
    "box without end": Box([1.0], [INF]),
    "box": Box([1.0], [3.0]),
    "box about a centre": Box([0.0], [2.0], center=[1.0]),
    "ball": cb.Ball([3.0], 2.0),
    "ellipsoid": cb.Ellipsoid([3.0], [[4.0]]),
    "polytope": cb.Polytope([[-1.0], [1.0]], [-1.0, 3.0]),
    "moving ball": cb.Ball(lambda t: [0 * t + 3.0], 2.0),
    "point": Box([1.0], [1.0]),
    "ball without radius": cb.Ball([1.0], 0.0),
}
COINS = {
    "rademacher": (cb.Rademacher(scale=1.0), 0.5),
    "bounded": (cb.Bounded(halfwidth=1.0), 0.5),
    "discrete": (cb.Discrete(values=[-1.0, 0.0, 1.0], probabilities=[0.25, 0.5, 0.25]), 0.25),
}


def coin_rows(laws: list[str]) -> Iterator[Row]:
    wide = Inside(Box([-40.0], [40.0]))
    for law in laws:
        noise, share = COINS[law]
        for shape, region in UP_TO_ONE.items():
            yield row(f"{law} stay {shape}", steps_of(lambda x: 0 * x, noise, [0.0], [Inside(region)], 1), 0)
            yield row(f"{law} start stay {shape}", steps_of(lambda x: 0 * x, noise, [1.0], [Inside(region)], 1), 0)
        for shape, region in FROM_ONE.items():
            safe = [Outside(region), wide]
            timed = [Outside(region, during=(1, 1)), wide]
            yield row(f"{law} avoid {shape}", steps_of(lambda x: 0 * x, noise, [0.0], safe, 1), share)
            yield row(f"{law} window avoid {shape}", steps_of(lambda x: 0 * x, noise, [0.0], timed, 2), share)
            yield row(f"{law} start avoid {shape}", steps_of(lambda x: 0 * x, noise, [1.0], safe, 1), 1)


def null_rows() -> Iterator[Row]:
    """Laws with a density up to their limits: an edge has no mass, but a start on one counts."""
    laws = {"uniform": cb.Uniform(halfwidth=1.0), "triangular": cb.Triangular(halfwidth=1.0),
            "histogram": cb.Histogram(edges=[-1, 0, 1], probabilities=[0.5, 0.5])}  # fmt: skip
    wide = Inside(Box([-5.0], [5.0]))
    for law, noise in laws.items():
        for shape in ("half-space", "box"):
            stay, avoid = [Inside(UP_TO_ONE[shape]), wide], [Outside(FROM_ONE[shape]), wide]
            yield row(f"{law} stay {shape}", steps_of(lambda x: 0 * x, noise, [1.0], stay, 2), 0)
            yield row(f"{law} avoid {shape}", steps_of(lambda x: 0 * x, noise, [0.0], avoid, 2), 0)
            yield row(f"{law} start avoid {shape}", steps_of(lambda x: 0 * x, noise, [1.0], avoid, 2), 1)


# ---- two states: corners, and targets ------------------------------------------------------------------------

ABOUT_ZERO = {
    "box": Box([-3.0, -4.0], [3.0, 4.0]),
    "ball": cb.Ball([0.0, 0.0], 5.0),
    "ellipsoid": cb.Ellipsoid([0.0, 0.0], [[25.0, 0.0], [0.0, 25.0]]),
    "long ellipsoid": cb.Ellipsoid([0.0, 0.0], [[18.0, 0.0], [0.0, 32.0]]),
    "polytope": cb.Polytope([[4.0, 3.0], [4.0, -3.0], [-4.0, 3.0], [-4.0, -3.0]], [24.0] * 4),
    "polygon": polygon([[3, 4], [-3, 4], [-3, -4], [3, -4]], outward=False),
    "moving ball": cb.Ball(lambda t: [0 * t, 0 * t], 5.0),
}
AT_THE_CORNER = {
    "box": Box([3.0, 4.0], [5.0, 6.0]),
    "point": Box([3.0, 4.0], [3.0, 4.0]),
    "ball": cb.Ball([6.0, 8.0], 5.0),
    "ellipsoid": cb.Ellipsoid([6.0, 8.0], [[25.0, 0.0], [0.0, 25.0]]),
    "half-space": HalfSpace([-4.0, -3.0], -24.0),
    "polytope": cb.Polytope([[-4.0, -3.0], [1.0, 0.0], [0.0, 1.0]], [-24.0, 9.0, 9.0]),
    "polygon": polygon([[3, 4], [5, 4], [5, 6], [3, 6]], outward=True),
}
WIDE = Inside(Box([-40.0, -40.0], [40.0, 40.0]))


def corner_rows() -> Iterator[Row]:
    coins = cb.Rademacher(scale=[3.0, 4.0])
    for shape, region in ABOUT_ZERO.items():
        yield row(f"corners stay {shape}", steps_of(lambda x: 0 * x, coins, [0.0, 0.0], [Inside(region)], 2), 0)
    for shape, region in AT_THE_CORNER.items():
        safe = [Outside(region), WIDE]
        yield row(f"corners avoid {shape}", steps_of(lambda x: 0 * x, coins, [0.0, 0.0], safe, 1), 0.25)
        yield row(f"corners start avoid {shape}", steps_of(lambda x: 0 * x, coins, [3.0, 4.0], safe, 1), 1)
    two = [Outside(Box([3.0, 4.0], [5.0, 6.0])), Outside(cb.Ball([-6.0, -8.0], 5.0)), WIDE]
    yield row("corners of a union", steps_of(lambda x: 0 * x, coins, [0.0, 0.0], two, 1), 0.5)
    both = [Inside(Box([-3.0, -9.0], [9.0, 4.0])), Inside(Box([-9.0, -4.0], [3.0, 9.0]))]
    yield row("corners of an intersection", steps_of(lambda x: 0 * x, coins, [0.0, 0.0], both, 2), 0)


def target_rows() -> Iterator[Row]:
    coins, targets = cb.Rademacher(scale=[3.0, 4.0]), {shape: (ABOUT_ZERO[shape], 0.0) for shape in ABOUT_ZERO}
    targets |= {"side": (Box([3.0], [9.0], coordinates=[0]), 0.5), "point": (Box([3.0, 4.0], [3.0, 4.0]), 0.75)}
    for shape, (region, failing) in targets.items():
        for during in (None, (1, 1)):
            for then in (None, "stay"):
                reach = cb.Reach(region, during=during, then=then)
                problem = steps_of(lambda x: 0 * x, coins, [20.0, 0.0], [WIDE], 1, reach=reach)
                yield row(f"reach {shape} during {during} then {then}", problem, failing)
    touched = {"safe": [WIDE, Outside(Box([3.0, -9.0], [5.0, 9.0]))], "reach": cb.Reach(Box([-5.0, -9.0], [3.0, 9.0]))}
    yield row("target and obstacle meet", steps_of(lambda x: 0 * x, coins, [20.0, 0.0], horizon=1, **touched), 0.5)


def domain_rows() -> Iterator[Row]:
    coin, domain = cb.Rademacher(scale=1.0), Box([-1.0], [1.0])
    yield row("domain", steps_of(lambda x: 0 * x, coin, [0.0], [], 1, domain=domain), 0)
    ends = {"domain": domain, "leaving": "ends"}
    yield row("domain ends", steps_of(lambda x: 0 * x, coin, [0.0], [Inside(Box([-0.5], [3.0]))], 1, **ends), 0.5)
    pushed = {"disturbance": Box([-1.0], [1.0])}
    still = cb.Rademacher(scale=[0.0])
    for shape in ("half-space", "box"):
        for word, constraint, truth in (("avoid", Outside(FROM_ONE[shape]), 1), ("stay", Inside(UP_TO_ONE[shape]), 0)):
            problem = steps_of(lambda x, d: d + 0 * x, still, [0.0], [constraint], 1, **pushed)
            yield row(f"pushed {word} {shape}", problem, truth, steps=0)


# ---- a state without noise beside one with noise -------------------------------------------------------------

ALONG = {"noise_matrix": np.array([[0.0], [1.0]])}
P_FROM_ONE = {
    "half-space": HalfSpace([-1.0, 0.0], -1.0),
    "long normal": HalfSpace([-2.0, 0.0], -2.0),
    "box with one side": Box([1.0, -INF], [INF, INF]),
    "box of one state": Box([1.0], [INF], coordinates=[0]),
    "box about a centre": Box([0.0], [INF], coordinates=[0], center=[1.0]),
    "moving box": Box([0.0], [INF], coordinates=[0], center=lambda t: [1 + 0 * t]),
    "box": Box([1.0, -50.0], [2.0, 50.0]),
    "polytope": cb.Polytope([[-1.0, 0.0]], [-1.0]),
    "ball of one state": cb.Ball([2.0], 1.0, coordinates=[0]),
}
P_UP_TO_ONE = {
    "half-space": HalfSpace([1.0, 0.0], 1.0),
    "box with one side": Box([-INF, -INF], [1.0, INF]),
    "box of one state": Box([-1.0], [1.0], coordinates=[0]),
    "box": Box([-1.0, -50.0], [1.0, 50.0]),
    "polytope": cb.Polytope([[1.0, 0.0], [-1.0, 0.0]], [1.0, 3.0]),
    "ball of one state": cb.Ball([0.0], 1.0, coordinates=[0]),
}


def jump(test: Any, high: float = 1.0) -> Callable[[Any], list[Any]]:
    return lambda x: [np.where(test(x[1]), 0.0, high), 0.9 * x[1]]


def line_rows(shapes: list[str]) -> Iterator[Row]:
    """What one state does is p+ = 1, or p+ = where(q < 1, 0, 1), or p+ = floor(q), sign(q)."""
    noise, wide, exceeds = cb.Gaussian(std=[2.0]), Inside(Box([-INF, -40.0], [INF, 40.0])), norm.sf(0.5)
    for shape in shapes:
        safe = [Outside(P_FROM_ONE[shape]), wide]
        one = steps_of(lambda x: [1 + 0 * x[0], 0.9 * x[1]], noise, [0.0, 0.0], safe, 2, **ALONG)
        start = steps_of(lambda x: [0.5 * x[0], 0.9 * x[1]], noise, [1.0, 0.0], safe, 2, **ALONG)
        there = steps_of(jump(lambda q: q < 1), noise, [0.0, 0.0], safe[:1], 2, **ALONG)
        yield row(f"line avoid {shape}", one, 1)
        yield row(f"line start avoid {shape}", start, 1)
        yield row(f"line where avoid {shape}", there, exceeds)
        if shape not in P_UP_TO_ONE:
            continue
        safe = [Inside(P_UP_TO_ONE[shape]), wide]
        one = steps_of(lambda x: [1 + 0 * x[0], 0.9 * x[1]], noise, [1.0, 0.0], safe, 2, **ALONG)
        yield row(f"line stay {shape}", one, 0, TINY)
        there = steps_of(jump(lambda q: q < 1), noise, [0.0, 0.0], safe, 2, **ALONG)
        yield row(f"line where stay {shape}", there, 0, TINY)


def jump_rows() -> Iterator[Row]:
    noise, wide, exceeds = cb.Gaussian(std=[2.0]), Inside(Box([-INF, -40.0], [INF, 40.0])), norm.sf(0.5)
    avoid, stay = Outside(HalfSpace([-1.0, 0.0], -1.0)), Inside(HalfSpace([1.0, 0.0], 1.0))

    def of(name: str, f: Any, safe: list[Any], *truth: float, start: Any = (0.0, 0.0)) -> Row:
        return row(name, steps_of(f, noise, list(start), safe, 2, **ALONG), *truth)

    there = jump(lambda q: q < 1)
    yield of("both of one face", there, [avoid, stay, wide], exceeds)
    yield of("an obstacle in a window", there, [Outside(avoid.region, during=(2, 2)), wide], exceeds)
    yield of("an obstacle that is gone", there, [Outside(avoid.region, during=(0, 1)), stay, wide], 0, TINY)
    yield of("beside an obstacle", jump(lambda q: q < 1, 1 - 2.0**-53), [avoid, wide], 0, TINY)
    low = lambda x: [np.where(x[1] < 1, 0.0, -1.0), 0.9 * x[1]]  # noqa: E731
    yield of("from below", low, [Outside(HalfSpace([1.0, 0.0], -1.0)), wide], exceeds)
    moving = Outside(Box([0.0], [INF], coordinates=[0], center=lambda t: [3 - t]))
    yield of("met by an obstacle", there, [moving, wide], exceeds)
    floor = lambda x: [np.floor(x[1]), 0.9 * x[1]]  # noqa: E731
    yield of("floor avoid", floor, [avoid, wide], norm.sf((1 - 0.45) / 2), start=(0.0, 0.5))
    yield of("floor stay", floor, [stay, wide], norm.sf((2 - 0.45) / 2), start=(0.0, 0.5))
    sign = lambda x: [np.sign(x[1] - 1), 0.9 * x[1]]  # noqa: E731
    yield of("sign avoid", sign, [avoid, wide], exceeds, start=(-1.0, 0.0))
    yield of("sign stay", sign, [stay, wide], 0, TINY, start=(-1.0, 0.0))


def full_rows() -> Iterator[Row]:
    """Noise on every state: only a start can lie on an edge."""
    wide = Inside(Box([-8.0, -8.0], [8.0, 8.0]))
    still = cb.GaussianStart([1.0, 0.0], [[0.0, 0.0], [0.0, 0.01]])
    starts = {"point": [1.0, 0.0], "box": Box([0.0, 0.0], [1.0, 0.1]), "ball": cb.Ball([0.5, 0.0], 0.5)}
    noises = {"full": (cb.Gaussian(std=[0.1, 0.1]), {}), "line": (cb.Gaussian(std=[0.1]), ALONG)}
    for kind, (noise, more) in noises.items():
        for name, start in (starts | {"random": still}).items():
            for shape in ("half-space", "box", "ball of one state"):
                both = (("avoid", Outside(P_FROM_ONE[shape]), (1,)), ("stay", Inside(P_UP_TO_ONE[shape]), (0, TINY)))
                for word, constraint, truth in both:
                    safe = [constraint, wide]
                    problem = steps_of(lambda x: [0 * x[0], 0.5 * x[1]], noise, start, safe, 2, **more)
                    drawn = None if name in ("point", "random") else 0
                    yield row(f"{kind} {name} {word} {shape}", problem, *truth, steps=drawn)


# ---- continuous time -----------------------------------------------------------------------------------------


def flow_rows(motions: list[str], shapes: list[str]) -> Iterator[Row]:
    """p arrives at 1 at the horizon, or stays there, or leaves it at once; q is a diffusion far from its limits."""
    spread, near = np.array([[0.0], [0.5]]), Inside(Box([-3.0, -40.0], [3.0, 40.0]))
    known = {
        "arrive": (lambda x: [1 + 0 * x[0], -x[1]], 0.0, 64), "rest": (lambda x: [0 * x[0], -x[1]], 1.0, 64),
        "decay": (lambda x: [-x[0], -x[1]], 1.0, 64),
        "peak": (lambda t, x: [2 - 2 * t + 0 * x[0], -x[1]], 0.0, 0),
    }  # fmt: skip
    for motion in motions:
        f, start, count = known[motion]
        horizon = 2.0 if motion == "peak" else 1.0
        for shape in shapes:
            problem = flow_of(f, spread, [start, 0.0], [Outside(P_FROM_ONE[shape]), near], horizon)
            yield row(f"{motion} avoid {shape}", problem, 1, steps=count)
            if shape in P_UP_TO_ONE:
                problem = flow_of(f, spread, [start, 0.0], [Inside(P_UP_TO_ONE[shape]), near], horizon)
                yield row(f"{motion} stay {shape}", problem, 0, TINY, steps=count)


def vanishing_rows() -> Iterator[Row]:
    """dx = .5 sqrt(x) dW ends in 0: by time 1 with probability exp(-8 x). It never passes it."""
    g, wide = (lambda x: [[0.5 * np.sqrt(x[0])]]), Inside(Box([-INF], [40.0]))
    for name, region in {"half-space": HalfSpace([1.0], 0.0), "box": Box([-1.0], [0.0])}.items():
        avoid = flow_of(lambda x: 0 * x, g, [0.125], [Outside(region), wide], 1.0)
        yield row(f"vanishing avoid {name}", avoid, math.exp(-1.0), steps=0)
        yield row(f"vanishing start avoid {name}", flow_of(lambda x: 0 * x, g, [0.0], [Outside(region), wide], 1.0), 1)
    stay = Inside(Box([0.0], [40.0]))
    yield row("vanishing stay", flow_of(lambda x: 0 * x, g, [0.125], [stay], 1.0), 0, TINY, steps=0)
    yield row("vanishing start stay", flow_of(lambda x: 0 * x, g, [0.0], [stay], 1.0), 0)


def curved_rows() -> Iterator[Row]:
    """A start on the edge of what full noise leaves at once, and velocities that lead away from a face."""
    near, shift = Inside(Box([-4.0, -4.0], [4.0, 4.0])), (lambda x: [-x[0], -x[1]])
    for shape, region in {"ball": cb.Ball([2.0, 0.0], 1.0), "corner": Box([1.0, 0.0], [2.0, 1.0])}.items():
        yield row(f"plane avoid {shape}", flow_of(shift, 0.3 * np.eye(2), [1.0, 0.0], [Outside(region), near], 0.5), 1)
    inner = [Inside(Box([-1.0, -1.0], [1.0, 1.0]))]
    yield row("plane stay", flow_of(shift, 0.3 * np.eye(2), [1.0, 0.0], inner, 0.5), 1, steps=0)
    fast, mass = np.array([[0.0], [0.1]]), (lambda x: [x[1], -x[1]])
    near = Inside(Box([-4.0, -6.0], [4.0, 6.0]))
    avoid, stay = [Outside(HalfSpace([-1.0, 0.0], -1.0)), near], [Inside(HalfSpace([1.0, 0.0], 1.0)), near]
    yield row("velocity avoid", flow_of(mass, fast, [1.0, -2.0], avoid, 0.5), 1)
    yield row("velocity stay", flow_of(mass, fast, [1.0, -2.0], stay, 0.5), 0, TINY)


# ---- the columns ---------------------------------------------------------------------------------------------


def check_engine(problem: cb.Problem, row: Row, engine: str) -> bool:
    """Whether an engine says anything of a row; what it says has to be true, and what its certificate proves."""
    verdict = cb.verify_safety(problem, method=engine)
    about = f"{row.name}, by {engine}: {verdict.reason}"
    upper, lower = verdict.log10_delta, -INF if verdict.log10_lower is None else verdict.log10_lower
    assert 10**upper >= row.least * (1 - 1e-12), about
    assert 10**lower <= row.most * (1 + 1e-12), about
    assert verdict.status != "SAFE" or row.least <= problem.delta, about
    assert not verdict.status.startswith("UNSAFE") or row.most > problem.delta, about
    data = verdict.certificate
    if data is not None and check_data(data).valid:
        claim = data["claim"]
        if claim.get("log10_delta") is not None:
            assert 10 ** float.fromhex(claim["log10_delta"]) >= row.least * (1 - 1e-12), f"certificate of {about}"
        if claim.get("log10_lower") is not None:
            assert 10 ** float.fromhex(claim["log10_lower"]) <= row.most * (1 + 1e-12), f"certificate of {about}"
    return bool(upper < 0 or lower > -300)


def check_simulation(problem: cb.Problem, row: Row) -> None:
    if row.steps == 0:
        return
    found = cb.simulate_exits(problem, paths=PATHS, rng=np.random.default_rng(5), steps=row.steps, halve=False)
    assert binom.sf(found.exits - 1, PATHS, row.most) >= CONFIDENCE, f"{row.name}: {found.exits} exits"
    assert binom.cdf(found.exits, PATHS, row.least) >= CONFIDENCE, f"{row.name}: {found.exits} exits"


def check_rows(rows: Iterator[Row], said: set[str], *, among: tuple[str, ...] = tuple(ENGINES)) -> None:
    """Every engine and the simulation on every row; these engines have to say something somewhere."""
    heard: set[str] = set()
    for one in rows:
        problem = one.problem()
        heard |= {engine for engine in among if check_engine(problem, one, engine)}
        check_simulation(problem, one)
    assert said <= heard, f"only {heard} said anything"


@pytest.fixture(autouse=True)
def _coarse_grids(monkeypatch: pytest.MonkeyPatch) -> None:
    """Value functions on grids that take little: rows ask on which side of the truth a bound lies."""
    monkeypatch.setattr(values, "_SECONDS", 1.0)
    monkeypatch.setattr(values, "_BACKWARD", 2.0)


def one_of_each_kind() -> Iterator[Row]:
    """Some rows of every group, for a look at all of them in seconds."""
    wanted = {
        "rademacher avoid half-space", "rademacher start avoid box", "rademacher stay ball", "uniform start avoid box",
        "corners stay polygon", "corners avoid ball", "target and obstacle meet", "domain ends", "floor avoid",
        "line avoid half-space", "line start avoid box with one side", "line stay half-space",
    }  # fmt: skip
    groups = [coin_rows(["rademacher"]), null_rows(), corner_rows(), target_rows(), domain_rows(), jump_rows(),
              line_rows(["half-space", "box with one side"])]  # fmt: skip
    found = [one for group in groups for one in group if one.name in wanted]
    assert {one.name for one in found} == wanted
    return iter(found)


def test_no_engine_is_wrong_about_a_path_that_ends_on_an_edge() -> None:
    among = tuple(name for name in ENGINES if name != "quadratic")  # it has a test of its own, of starts on an edge
    check_rows(one_of_each_kind(), {"values", "linear"}, among=among)


GROUPS: dict[str, tuple[Callable[[], Iterator[Row]], set[str]]] = {
    **{law: (lambda law=law: coin_rows([law]), {"linear", "quadratic" if law == "bounded" else "values"})  # type: ignore[misc]
       for law in COINS},  # the value functions serve no law of which its limits alone are known
    "densities": (null_rows, {"values"}),
    "corners": (corner_rows, {"values", "linear", "constants", "quadratic"}),
    "targets": (target_rows, {"values"}),
    "domains": (domain_rows, {"values"}),
    **{shape: (lambda shape=shape: line_rows([shape]), set()) for shape in P_FROM_ONE},  # type: ignore[misc]
    "jumps": (jump_rows, {"values"}),
    "noise on every state": (full_rows, {"values", "constants"}),
    **{motion: (lambda motion=motion: flow_rows([motion], list(P_FROM_ONE)), set())  # type: ignore[misc]
       for motion in ("arrive", "rest", "decay", "peak")},
    "vanishing": (vanishing_rows, set()),
    "curved": (curved_rows, {"values"}),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_no_engine_is_wrong_about_any_edge(group: str) -> None:
    rows, said = GROUPS[group]
    check_rows(rows(), said)
