"""One state in continuous time: windows, moving and missing limits, random starts, wrong proposals, the budget."""

from __future__ import annotations

import dataclasses
import math
import time
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.rigor.intervals import Interval
from certbound.values.continuous import exits
from certbound.values.continuous.exits import bound_exits
from certbound.values.continuous.line import ladder
from certbound.values.continuous.line.initial_law import Start, start_of
from certbound.values.continuous.line.joins import Profile, missing_lower, missing_upper
from certbound.values.continuous.line.linked import prove_above, prove_below, spans
from certbound.values.continuous.line.phases import Gate, Phase, pieces
from certbound.values.continuous.shapes import spread
from certbound.values.continuous.surface import Surface
from tests.values.line_truth import bracket
from tests.values.random_problems import check

BOX = cb.Box([-1], [1])
UP = cb.HalfSpace([1.0], 0.9)


def problem(safe: list[Any], start: Any = (0.0,), horizon: float = 1.0, f: Any = None, gain: Any = 0.6) -> cb.Problem:
    system = cb.ContinuousSystem(f or (lambda x: -x), states=1, diffusion=gain)
    return cb.Problem(system, initial=list(start) if isinstance(start, tuple) else start, safe=safe, horizon=horizon)


CASES: dict[str, tuple[cb.Problem, float, float]] = {
    "a window that ends early": (problem([cb.Inside(BOX, during=(0, 0.5))]), 1.1, 1.1),
    "a window that begins late": (problem([cb.Inside(BOX, during=(0.5, 1))]), 1.15, 1.3),
    "a tighter window within": (
        problem([cb.Inside(BOX), cb.Inside(cb.Box([-0.6], [0.6]), during=(0.0, 0.5))]), 1.1, 1.1),
    "an instant": (problem([cb.Inside(BOX), cb.Inside(cb.Box([-0.3], [0.3]), during=(0.5, 0.5))]), 1.1, 1.15),
    "both limits move": (problem([cb.Inside(cb.Box([-1], [1], center=lambda t: [0.3 * np.sin(3 * t)]))]), 1.1, 1.1),
    "one limit moves": (
        problem([cb.Inside(cb.Box([-1], [np.inf])), cb.Inside(cb.Box([-np.inf], [1], center=lambda t: [-0.3 * t]))]),
        1.15, 1.1),
    "one limit is missing": (problem([cb.Inside(UP)]), 1.1, 1.1),
    "an obstacle comes": (
        problem([cb.Inside(cb.Box([-3], [3])), cb.Outside(cb.Ball(lambda t: [1.2 - 0.3 * t], 0.2))]), 1.2, 1.1),
    "a random start": (problem([cb.Inside(BOX)], cb.GaussianStart([0.1], [[0.04]])), 1.1, 1.1),
    "prices": (
        problem([cb.Inside(cb.Box([0.7], [9]))], (1.0,), f=lambda x: 0.1 * x, gain=lambda x: [[0.2 * x[0]]]), 1.1, 1.1),
}  # fmt: skip


LONG = ("an instant", "a window that begins late", "an obstacle comes")


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in LONG else n for n in CASES])
def test_bounds_of_every_kind_of_limit_hold_and_are_close(name: str) -> None:
    asked, above, below = CASES[name]
    found = bound_exits(asked, seconds=0.01)
    least, most = bracket(asked, *((0.2, 6.0) if "prices" in name else (-4.0, 4.0)), 1000, 300)
    assert least * 0.995 <= 10**found.upper <= above * most
    assert found.lower is not None
    assert least / below <= 10**found.lower
    assert found.lower is None or 10**found.lower <= most * 1.005


@pytest.mark.usefixtures("coarse")
def test_before_a_window_the_line_ends_where_the_drift_lets_no_path_pass() -> None:
    """At the cut below, where noise in proportion to the state all but ends, no layer would fit the cells."""
    window = cb.Inside(cb.Box([0.5], [1.8]), during=(0.5, 1))
    asked = problem([window], (1.0,), f=lambda x: 0.5 * (1 - x), gain=lambda x: [[0.3 * x[0]]])
    least, most = bracket(asked, 0.1, 6.0, 1000, 300)
    assert least * 0.995 <= 10 ** bound_exits(asked, seconds=0.01, lower=False).upper <= 1.15 * most


def test_between_two_limits_it_does_not_matter_that_paths_beyond_them_leave_every_bound() -> None:
    """x' = -x + 6 x^3 leaves [-1.2, 1.2] within 1 with a probability in [.0322, .0332] (10^6 simulated paths)."""
    system = cb.ContinuousSystem(lambda x: -x + 6 * x**3, states=1, diffusion=0.3)
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1.2], [1.2]))], horizon=1.0)
    found = bound_exits(problem, seconds=0.2)
    assert found.lower is not None
    assert math.log10(0.031) < found.lower < math.log10(0.0332)
    assert math.log10(0.0322) < found.upper < math.log10(0.0345)


@pytest.mark.usefixtures("coarse")
def test_a_window_may_have_a_limit_on_one_side_alone() -> None:
    asked = problem([cb.Inside(cb.Box([-0.6], [np.inf]), during=(0.3, 0.4)), cb.Inside(BOX, during=(0.8, 1))])
    least, most = bracket(asked, -4.0, 4.0, 1000, 300)
    assert least * 0.995 <= 10 ** bound_exits(asked, seconds=0.01, lower=False).upper <= 1.5 * most


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize("seed", [3, pytest.param(13, marks=pytest.mark.slow)])
def test_random_problems_lie_between_the_bounds(seed: int) -> None:
    assert check("line", seed, seconds=0.01, cells=1200)[0] == ""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["line", "steps", "plane"])
@pytest.mark.parametrize("seed", range(20, 120))
def test_three_hundred_random_problems_lie_between_the_bounds(kind: str, seed: int) -> None:
    try:
        wrong, *numbers = check(kind, seed)
    except InfeasibleError:
        return
    assert wrong == "", numbers


# wrong proposals


def chain_of(asked: cb.Problem, *, inner: bool) -> tuple[list[Any], Start]:
    """The first proposal of one side, with its phases."""
    model, start = exits._model(asked), start_of(asked)
    room = ladder.room_of(asked, model, ladder.cuts_of(asked, model, start), start, inner=inner)
    rough = ladder.sketches(room)
    links = (ladder.surfaces_above if inner else ladder.surfaces_below)(room, start, rough, (0.03, 2.0, 1e-3, 0.03))
    assert links is not None
    return links, start


def spoilt(links: list[Any], rng: np.random.Generator, how: str, size: float) -> list[Any]:
    """The chain with noise on its data, with V scaled, shifted, of another time, or of the wrong noise."""
    changed = []
    for link in links:
        surface = link.surface
        data = {name: getattr(surface, name) for name in ("values", "start_rates", "end_rates")}
        if how == "noise":
            data = {name: part * (1 + size * rng.normal(size=part.shape)) for name, part in data.items()}
        elif how == "scaled":
            data = {name: part * (1 + size) for name, part in data.items()}
        elif how == "shifted":
            data["values"] = data["values"].copy()
            data["values"][:, :, 0] += size
        elif how == "late":  # the surface of a later time
            k = max(1, int(size * surface.slabs))
            data["values"] = np.concatenate([data["values"][k:], np.repeat(data["values"][-1:], k, axis=0)])
        elif how == "steep":
            data["values"] = data["values"].copy()
            data["values"][:, :, 1] *= 1 + size
        changed.append(dataclasses.replace(link, surface=dataclasses.replace(surface, **data)))
    return changed


WRONG = [("noise", 1e-6), ("noise", 1e-2), ("scaled", -0.05), ("scaled", 0.05), ("shifted", -0.5), ("late", 0.2),
         ("steep", 0.05)]  # fmt: skip


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize(("name", "tries"), [
    ("a random start", WRONG), pytest.param("a window that begins late", WRONG[1:4], marks=pytest.mark.slow),
])
def test_a_wrong_proposal_never_passes_the_truth(name: str, tries: list[tuple[str, float]]) -> None:
    _try_wrong(CASES[name][0], np.random.default_rng(0), tries)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_many_wrong_proposals_never_pass_the_truth(name: str) -> None:
    rng = np.random.default_rng(1)
    hows = ["noise", "scaled", "shifted", "late", "steep"]
    tries = [(hows[k % 5], float(rng.choice([-1, 1]) * 10 ** rng.uniform(-4, -0.3))) for k in range(100)]
    _try_wrong(CASES[name][0], rng, [(how, abs(size) if how in ("noise", "late") else size) for how, size in tries])


def _try_wrong(asked: cb.Problem, rng: np.random.Generator, tries: list[tuple[str, float]]) -> None:
    around = (0.2, 6.0) if asked.initial.middle[0] == 1.0 else (-4.0, 4.0)
    least, most = bracket(asked, *around, 1000, 300)
    above, start = chain_of(asked, inner=True)
    below, _ = chain_of(asked, inner=False)
    for how, size in tries:
        assert prove_above(spoilt(above, rng, how, size), start).log >= math.log(least * 0.995)
        payment = prove_below(spoilt(below, rng, how, size), start)
        assert payment is None or payment.log <= math.log(most * 1.005)


def test_a_slope_beyond_floats_gives_no_grid_and_no_surface() -> None:
    asked = problem([cb.Inside(BOX)])
    model, start = exits._model(asked), start_of(asked)
    room = ladder.room_of(asked, model, ladder.cuts_of(asked, model, start), start, inner=True)
    line, rough = room.lines[0], ladder.sketches(room)[0]
    assert spread(line, [(line.low, 5.0)], rough, 1.0) is not None
    for slope in (np.inf, np.nan):
        assert spread(line, [(line.low, slope)], rough, 1.0) is None


def test_a_chain_that_does_not_span_the_horizon_is_seen() -> None:
    links, _ = chain_of(CASES["an instant"][0], inner=True)
    assert spans(links, upper=True)
    assert not spans([links[1], links[0]], upper=True)
    late = dataclasses.replace(links[1].surface, times=links[1].surface.times * 0.9)
    assert not spans([links[0], dataclasses.replace(links[1], surface=late)], upper=True)


# joins


def curve(nodes: np.ndarray, f: Any) -> Surface:
    """A surface of one slab that is f at all times, given by a polynomial."""
    data = np.stack([f(nodes), f.deriv()(nodes), f.deriv(2)(nodes)], axis=-1)[None]
    zero = np.zeros_like(data)
    return Surface(axes=(nodes,), times=np.array([0.0, 1.0]), values=np.concatenate([data, data]), start_rates=zero,
                   end_rates=zero)  # fmt: skip


def test_a_profile_encloses_values_and_slopes() -> None:
    rng = np.random.default_rng(0)
    nodes = np.cumsum(rng.uniform(0.1, 0.4, 8))
    f = np.polynomial.Polynomial(rng.normal(size=6))
    profile = Profile(curve(nodes, f), 0)
    low = rng.uniform(nodes[0], nodes[-1], 300)
    high = np.minimum(low + 10 ** rng.uniform(-6, -0.5, 300), nodes[-1])
    value, slope = profile.over(Interval(low, high))
    for share in np.linspace(0, 1, 7):
        y = low + share * (high - low)
        assert np.all((f(y) >= value.lo - 1e-12) & (f(y) <= value.hi + 1e-12))
        assert np.all((f.deriv()(y) >= slope.lo - 1e-11) & (f.deriv()(y) <= slope.hi + 1e-11))
    narrow = high - low < 1e-4
    assert np.all(value.width[narrow] <= np.abs(slope.mag[narrow]) * (high - low)[narrow] * 1.5 + 1e-12)


@pytest.mark.parametrize("rise", [0.0, 0.1, -0.1])
def test_what_a_join_misses_is_the_largest_gap(rise: float) -> None:
    f = np.polynomial.Polynomial([-1.0, 0.2, -0.3, 0.1])
    here, after = curve(np.linspace(-1, 1, 12), f + rise), curve(np.linspace(-1.2, 1.3, 9), f)
    phases = [Phase(start=0.0, end=1.0, low=a, high=b, closed=(True, True)) for a, b in ((-1.0, 1.0), (-1.2, 1.3))]
    gate = Gate(time=1.0, low=-np.inf, high=np.inf)
    assert missing_upper(here, phases[0], gate, (after, phases[1])) == pytest.approx(max(-rise, 0.0), abs=1e-3)
    assert missing_lower(here, phases[0], gate, after, phases[1]) == pytest.approx(max(rise, 0.0), abs=1e-3)
    narrow = Gate(time=1.0, low=-0.5, high=0.5)
    beyond = float(np.max(-(f + rise)(np.linspace(0.5, 1, 101))))
    below = float(np.max(-(f + rise)(np.linspace(-1, -0.5, 101))))
    assert missing_upper(here, phases[0], narrow, (after, phases[1])) == pytest.approx(max(beyond, below), abs=1e-2)


@pytest.mark.usefixtures("coarse")
def test_coordinates_that_move_are_joined_where_they_meet() -> None:
    asked = problem([
        cb.Inside(cb.Box([-1], [1], center=lambda t: [0.2 * t]), during=(0.0, 0.5)),
        cb.Inside(cb.Box([-0.9], [np.inf], center=lambda t: [0.2 * t]), during=(0.5, 1.0)),
        cb.Inside(cb.Box([-np.inf], [1.0]), during=(0.5, 1.0)),
    ])  # fmt: skip
    phases, gates = pieces(asked, (-3.0, 3.0), inner=True)
    assert [phase.closed for phase in phases] == [(True, True), (True, True)]
    assert phases[0].width is None
    assert phases[1].width is not None
    assert (gates[0].low, gates[0].high) == pytest.approx((-0.8, 1.0))
    for phase in phases:
        y = Interval.point(np.linspace(phase.low, phase.high, 5))
        back = phase.local(phase.place(y, 0.5), 0.5)
        assert np.all((back.lo <= y.lo) & (y.hi <= back.hi))
    found = bound_exits(asked, seconds=0.01)
    least, most = bracket(asked, -4.0, 4.0, 1000, 300)
    assert least * 0.995 <= 10**found.upper <= 1.4 * most


# random starts, refusals, the budget


def test_the_mean_over_a_random_start_is_that_of_the_curve() -> None:
    f = np.polynomial.Polynomial([-2.0, 0.5, 1.0])
    surface = curve(np.linspace(-1, 1, 21), f)
    phase = Phase(start=0.0, end=1.0, low=-1.0, high=1.0, closed=(True, False))
    start = Start(low=0.1, high=0.1, mean=0.1, variance=0.25)
    x = np.linspace(-1, 1, 200_001)
    density = np.exp(-((x - 0.1) ** 2) / 0.5) / math.sqrt(0.5 * math.pi)
    inside = np.trapezoid(np.exp(f(x)) * density, x)
    below, above = (0.5 * math.erfc(z / math.sqrt(0.5)) for z in (1.1, 0.9))
    assert start.highest(surface, phase) == pytest.approx(math.log(inside + below + above), abs=5e-3)
    assert start.lowest(surface, phase) == pytest.approx(math.log(inside + below), abs=5e-3)
    assert start.lowest(surface, phase) <= math.log(inside + below)
    assert start.highest(surface, phase) >= math.log(inside + below + above)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"safe": [cb.Inside(BOX), cb.Outside(cb.Box([0.5], [0.6]), during=(0.5, 1.0))]}, "either side of it"),
        ({"safe": [cb.Inside(BOX), cb.Outside(cb.Box([0.5], [0.6]))], "start": cb.GaussianStart([0.0], [[0.04]])},
         "random start beside"),
        ({"safe": [cb.Inside(UP)], "f": lambda x: x**3, "horizon": 9.0}, "leave every bound"),
        ({"safe": [cb.Inside(cb.Box([-1], [1], center=lambda t: [2 * t])), cb.Inside(BOX)]}, "no interior"),
        ({"safe": [cb.Inside(cb.Box([-1], [1], center=lambda t: [np.where(t < 0.5, 0.0, 0.5)]))]}, "without jumps"),
        ({"safe": [cb.Inside(cb.Box([-1], [1], center=lambda t: [0.5 * np.floor(2 * t)]))]}, "without jumps"),
        ({"safe": [cb.Inside(BOX), cb.Outside(cb.Ball(lambda t: [2 - np.sign(t - 0.5)], 0.1))]}, "without jumps"),
        ({"safe": [cb.Inside(cb.Box([-1], [1], center=lambda t: [np.arctan2(np.sin(7 * t), np.cos(7 * t)) / 10]))]},
         "without jumps"),
        ({"safe": [cb.Inside(BOX), cb.Inside(BOX, during=(0.0, 0.0))]}, "at time 0 alone"),
        ({"safe": [cb.Inside(BOX)], "gain": lambda x: np.array([[x[0]]])}, "noise of full rank"),
    ],
)  # fmt: skip
def test_what_is_not_served_is_refused_in_words(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InfeasibleError, match=message):
        bound_exits(problem(**changes), seconds=0.01)


def test_bounds_do_not_depend_on_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ladder, "LADDER", ((1.0, 1e-2, 0.1), (1.5, 3e-3, 0.05), *ladder.LADDER))
    asked = problem([cb.Inside(BOX)])
    first = bound_exits(asked, seconds=0.1)
    ticks = iter(range(0, 10**9, 1000))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(ticks)))
    second = bound_exits(asked, seconds=0.1)
    assert (first.upper, first.lower, first.words) == (second.upper, second.lower, second.words)
    assert first.words.count(" x ") == 3, "cells x slabs, and of two attempts, of which the clock could have left one"


def test_a_start_in_moving_coordinates_is_read_where_it_is() -> None:
    f = np.polynomial.Polynomial([-2.0, 0.7, 0.3])
    asked = problem([cb.Inside(cb.Box([-1], [1], center=lambda t: [0.3 + 0.2 * t]))])
    (phase,), _ = pieces(asked, (-3.0, 3.0), inner=True)
    surface = curve(np.linspace(-1, 1, 9), f)
    point, wide = Start(low=0.1, high=0.1), Start(low=0.1, high=0.4)
    assert point.highest(surface, phase) == pytest.approx(f(-0.2), abs=1e-12)
    assert point.lowest(surface, phase) == pytest.approx(f(-0.2), abs=1e-12)
    assert f(0.1) <= wide.highest(surface, phase) <= f(0.1) + 0.02
    assert f(0.1) - 0.02 <= wide.lowest(surface, phase) <= f(0.1)
    assert Start(low=2.0, high=2.0).highest(surface, phase) == math.inf


@pytest.mark.usefixtures("coarse")
def test_units_do_not_matter_until_floats_end() -> None:
    """Limits at 1e9 were refused, as if paths left every bound."""

    def bound(unit: float) -> Any:
        system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=0.6 * unit)
        safe = [cb.Inside(cb.Box([-unit], [unit]))]
        return bound_exits(cb.Problem(system, initial=[0.0], safe=safe, horizon=0.5), seconds=0.01)

    assert bound(1e12).upper == pytest.approx(bound(1.0).upper, rel=1e-6)
    with pytest.raises(InfeasibleError, match="another unit"):
        bound(1e100)


def test_a_drift_that_is_undefined_where_paths_may_be_is_refused_in_words() -> None:
    """What a proposal was made of was no number, and a linear solver said so."""
    system = cb.ContinuousSystem(lambda x: [0.1 * np.log(x[0]) - x[0]], states=1, diffusion=[[0.2]])
    with pytest.raises(InfeasibleError, match="undefined somewhere in the safe set"):
        bound_exits(cb.Problem(system, initial=[0.1], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1))
