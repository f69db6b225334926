"""Faces that no path crosses: prices, rates and populations, whose noise vanishes at 0."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import certbound as cb
from certbound.errors import EnclosureError, InfeasibleError
from certbound.rigor.intervals import Interval
from certbound.values.continuous import bound_exits, exits, is_confined, proposal
from certbound.values.continuous.held_faces import held_face, rarely_reached, resolved
from certbound.values.continuous.payment import Payment, Terms
from certbound.values.continuous.plane import held_plane, plane_of, released, two_sides
from certbound.values.continuous.plane.two_sides import with_rare
from certbound.values.enclosing import enclose


def line(f, g, safe, *, start=0.5, horizon=2.0, states=("x",)):
    system = cb.ContinuousSystem(f, states=list(states), diffusion=g)
    return cb.Problem(system, initial=np.ravel(start), safe=[cb.Inside(cb.Box(*safe))], horizon=horizon)


def root(x):
    return np.sqrt(np.maximum(x[0], 0.0))


@pytest.mark.usefixtures("lighter")
def test_a_price_reaches_its_limit_as_often_as_the_reflection_principle_says() -> None:
    """dx = x^2's half dt + s x dW: log x is Brownian motion."""
    s = 0.5
    asked = line(lambda x: [0.5 * s**2 * x[0]], lambda t, x: [[s * x[0]]], ([0.0], [1.5]))
    found = bound_exits(asked, seconds=0.01)
    exact = math.erfc(math.log(3) / (s * math.sqrt(2.0)) / math.sqrt(2))
    assert 10**found.lower <= exact <= 10**found.upper < 1.05 * 10**found.lower


@pytest.mark.usefixtures("lighter")
def test_a_rate_whose_noise_is_the_root_of_it_is_bounded_from_both_sides() -> None:
    """The square of Brownian motion in the plane: that its radius reaches sqrt 3 is known as a series."""
    asked = line(lambda x: [2.0], lambda t, x: [[2 * root(x)]], ([-1.0], [3.0]), start=0.25, horizon=0.5)
    found = bound_exits(asked, seconds=0.01)
    zeros = np.array([2.404825557695773, 5.520078110286311, 8.653727912911013, 11.791534439014281])
    first = np.array([0.5191474972894669, -0.3402648065583682, 0.2714522999283819, -0.2324598313647014])  # J_1 there
    r, radius = 0.5, math.sqrt(3)

    def j0(z: float) -> float:
        return sum((-1) ** k * (z / 2) ** (2 * k) / math.factorial(k) ** 2 for k in range(25))

    fades = np.exp(-((zeros / radius) ** 2) * 0.5 / 2)
    stays = sum(2 * j0(z * r / radius) / (z * j) * fade for z, j, fade in zip(zeros, first, fades))
    assert 10**found.lower <= 1 - stays <= 10**found.upper < 1.06 * 10**found.lower


@pytest.mark.usefixtures("frugal")
def test_a_population_that_dies_out_is_bounded_from_both_sides() -> None:
    """dx = sqrt(x) dW, absorbed at 0: less than the martingale's .5/2."""
    found = bound_exits(line(lambda x: [0.0], lambda t, x: [[root(x)]], ([-1.0], [2.0])), seconds=0.01)
    assert 0.03 < 10**found.lower <= 10**found.upper < min(0.25, 1.15 * 10**found.lower)


@pytest.mark.usefixtures("frugal")
@pytest.mark.parametrize("gone", [cb.HalfSpace([1], 0), cb.Box([-1], [0])])
def test_who_is_to_keep_off_a_face_that_no_path_crosses_fails_as_he_touches_it(gone) -> None:
    """dx = sqrt(x) dW from 1/2 has died out by 2 with probability exp(-1/2); a path stays in x >= 0 for ever."""
    asked = line(lambda x: [0.0], lambda t, x: [[root(x)]], ([-1.0], [2.0]))
    found = bound_exits(asked.replace(safe=[*asked.safe, cb.Outside(gone)]), seconds=0.01)
    assert 10**found.upper >= math.exp(-0.5)
    near = bound_exits(asked.replace(safe=[*asked.safe, cb.Outside(cb.HalfSpace([1], 1e-2))]), seconds=0.01)
    assert math.exp(-0.5) < 10**near.upper < 0.9


@pytest.mark.usefixtures("coarse")
def test_in_two_states_who_touches_what_is_to_be_avoided_fails_too() -> None:
    """As before beside another state; who is to stay where x >= 0 reaches 2 first with .25 at most."""
    def noise(x):
        return [[root(x), 0 * x[0]], [0 * x[0], 0.2 + 0 * x[0]]]

    asked = line(lambda x: [0 * x[0], -x[1]], noise, ([-1.0, -1.0], [2.0, 1.0]), start=[0.5, 0.0], states=("x", "y"))
    stays = asked.replace(safe=[*asked.safe, cb.Inside(cb.HalfSpace([-1, 0], 0))])
    assert 10 ** bound_exits(stays, seconds=0.5).upper < 0.5 < math.exp(-0.5)
    with pytest.raises(InfeasibleError, match="full rank"):
        bound_exits(asked.replace(safe=[*asked.safe, cb.Outside(cb.HalfSpace([1, 0], 0))]), seconds=0.5)


@pytest.mark.usefixtures("lighter")
def test_a_share_of_genes_is_bounded_the_same_seen_from_either_end() -> None:
    """The upper face is one at which rounding would leave the root without a value."""
    def g(t, x):
        return [[0.4 * np.sqrt(x[0] * (1 - x[0]))]]

    sides = (([0.2], [1.0], 0.6), ([0.0], [0.8], 0.4))
    found = [bound_exits(line(lambda x: [0.3 * (0.5 - x[0])], g, (low, high), start=start, horizon=1.0), seconds=0.01)
             for low, high, start in sides]  # fmt: skip
    assert math.isclose(found[0].upper, found[1].upper, abs_tol=1e-3)
    assert found[0].lower > found[0].upper - 0.05


@pytest.mark.usefixtures("coarse")
def test_nobody_leaves_where_no_face_can_be_crossed(monkeypatch) -> None:
    """The steps that are granted to the line that ends before the faces lead nowhere, however many they are."""
    monkeypatch.setitem(proposal.propose.__kwdefaults__, "most_steps", 400)
    logistic = line(lambda x: [x[0] * (1 - x[0])], lambda t, x: [[x[0] * (1 - x[0])]], ([0.0], [1.0]))
    assert bound_exits(logistic, seconds=0.01).upper < -100


@pytest.mark.parametrize(
    ("f", "g", "held"),
    [
        (lambda x: [1 - x[0]], lambda t, x: [[x[0]]], 0.0),
        (lambda x: [1 - x[0]], lambda t, x: [[root(x)]], 0.0),
        (lambda x: [1 - x[0]], lambda t, x: [[np.maximum(x[0] - 0.25, 0.0)]], 0.25),
        (lambda x: [-0.1 - x[0]], lambda t, x: [[x[0]]], None),  # the drift leads out
        (lambda x: [1 - x[0]], lambda t, x: [[x[0] + 1e-6]], None),  # some noise is left
        (lambda x: [1 - x[0]], lambda t, x: [[np.sqrt(np.sqrt(np.maximum(x[0], 0)))]], None),  # a too steep
        (lambda x: [np.sign(x[0])], lambda t, x: [[x[0]]], None),  # the drift jumps
    ],
)
def test_a_face_is_held_where_noise_vanishes_linearly_and_the_drift_leads_inside(f, g, held) -> None:
    model = exits._model(line(f, g, ([-1.0], [1.0])))
    assert held_face(model, [(-1.0, 1.0)], (0.5, 0.5), (0.0, 2.0), 0, 0) == held


def test_a_start_beyond_the_face_is_not_held_by_it() -> None:
    asked = line(lambda x: [1 - x[0]], lambda t, x: [[root(x)]], ([-1.0], [3.0]), start=-0.5)
    with pytest.raises(InfeasibleError, match="full rank"):
        bound_exits(asked, seconds=0.2)


def test_in_the_plane_the_noise_along_the_face_does_not_matter() -> None:
    """Stochastic volatility: upper bound of a fall of the log-price."""
    def g(t, x):
        return [[np.sqrt(np.maximum(x[1], 0)), 0.0], [0.0, 0.3 * np.sqrt(np.maximum(x[1], 0))]]

    system = cb.ContinuousSystem(lambda x, v: [-v / 2, 2 * (0.04 - v)], states=["x", "v"], diffusion=g)
    asked = cb.Problem(system, initial=[0, 0.04], safe=[cb.Inside(cb.Box([-0.25, -1], [0.4, 0.3]))], horizon=0.25)
    model = exits._model(asked)
    box = [(-0.25, 0.4), (-1.0, 0.3)]
    assert held_face(model, box, (0.04, 0.04), (0.0, 0.25), 1, 0) == 0.0
    assert held_face(model, box, (0.0, 0.0), (0.0, 0.25), 0, 0) is None
    written = resolved(model, (0.0, 0.25), [(-0.25, 0.4), (0.0, 0.3)])
    assert written.square.degrees == [0, 0, 1]


@pytest.mark.slow
def test_stochastic_volatility_is_bounded_from_above() -> None:
    def g(t, x):
        return [[np.sqrt(np.maximum(x[1], 0)), 0.0], [0.0, 0.3 * np.sqrt(np.maximum(x[1], 0))]]

    system = cb.ContinuousSystem(lambda x, v: [-v / 2, 2 * (0.04 - v)], states=["x", "v"], diffusion=g)
    asked = cb.Problem(system, initial=[0, 0.04], safe=[cb.Inside(cb.Box([-0.25, -1], [0.4, 0.3]))], horizon=0.25)
    assert 0.005 < 10 ** bound_exits(asked, seconds=10).upper < 0.1


def test_the_square_of_a_root_is_what_is_under_it_and_stays_undefined_elsewhere() -> None:
    asked = line(lambda x: [1 - x[0]], lambda t, x: [[-0.5 * np.sqrt(x[0]) / 2]], ([-1.0], [3.0]))
    model = exits._model(asked)
    assert model.square.degrees == [0, 1]
    beyond = [Interval.point(np.zeros(1)), Interval(np.array([-0.1]), np.array([0.1]))]
    with pytest.raises(EnclosureError, match="undefined"):
        enclose(model.square.tape, beyond)


def test_a_face_that_hardly_a_path_reaches_costs_no_less_than_the_reflection_principle() -> None:
    """Brownian motion with drift -1 from .5: 1 is reached with Phi(..) + e^-1 Phi(..); and never less with a mild k."""
    model = exits._model(line(lambda x: [-1.0], lambda t, x: [[0.2]], ([0.0], [1.0])))
    found = rarely_reached(model, [(0.0, 1.0)], (0.5, 0.5), (0.0, 0.25), 0, 1)
    root = 0.2 * math.sqrt(0.25)
    ends = [math.erfc((0.5 + sign * 0.25) / (root * math.sqrt(2))) / 2 for sign in (1, -1)]
    truth = math.log(ends[0] + math.exp(-2 * 0.5 / 0.04) * ends[1])
    assert truth < found < 0.8 * truth
    assert rarely_reached(model, [(0.0, 1.0)], (0.5, 0.5), (0.0, 1.0), 0, 0) == 0.0  # the drift leads there
    assert rarely_reached(model, [(0.0, 1.0)], (0.5, 1.0), (0.0, 1.0), 0, 1) == 0.0  # starts lie on it


def test_the_price_of_a_face_is_paid_and_a_bound_without_room_for_it_is_none() -> None:
    terms = Terms(levels=None, lam=None, eps=None, steps=None, start=-3.0, end=-4.0)
    paid = with_rare(Payment(log=math.log(1e-3), terms=terms), math.log(1e-4))
    assert 1e-3 + 1e-4 / (1 - math.exp(-4.0)) <= math.exp(paid) < 1.2e-3
    assert with_rare(Payment(log=-5.0, terms=replace(terms, end=-0.5)), -9.0) == 0.0


def epidemic(limits) -> cb.Problem:
    def g(t, x):
        new, well = (np.sqrt(np.maximum(rate, 0) / 1000) for rate in (0.3 * x[0] * x[1], 0.25 * x[1]))
        return [[-new, 0.0], [new, -well]]

    def f(x):
        return [-0.3 * x[0] * x[1], 0.3 * x[0] * x[1] - 0.25 * x[1]]

    system = cb.ContinuousSystem(f, states=["S", "I"], diffusion=g)
    return cb.Problem(system, initial=[0.95, 0.05], safe=[cb.Inside(cb.Box(*limits))], horizon=30)


def test_limits_on_those_who_only_grow_fewer_are_left_out_and_paid_for(monkeypatch) -> None:
    monkeypatch.setattr(two_sides, "rough_level", lambda plane: -6.5)
    asked = epidemic(([0.3, 0.0], [1.0, 0.12]))
    model = exits._model(asked)
    whole = plane_of(asked, model, (0.3, 0.0), (1.0, 0.12), [(0.95, 0.95), (0.05, 0.05)])
    plane = held_plane(whole, model)[0]
    assert plane.held == ((False, False), (True, False))
    found, _, price = released(asked, plane, model, -6.5)
    assert found.held == ((False, True), (True, False))
    assert found.low == (0.3, 0.0)  # .3 is where some drift to
    assert -100 < price < -11.5


@pytest.mark.slow
def test_an_epidemic_is_bounded_near_what_simulations_say() -> None:
    """Of 200 000 paths .00095 have .12 infected at some of 600 times."""
    assert 9e-4 < 10 ** bound_exits(epidemic(([-np.inf, -np.inf], [np.inf, 0.12])), seconds=10).upper < 4e-3
    assert 9e-4 < 10 ** bound_exits(epidemic(([0, 0], [1, 0.12])), seconds=10).upper < 4e-3


@pytest.mark.usefixtures("coarse")
def test_where_the_drift_leads_back_a_face_costs_about_what_the_quasipotential_says() -> None:
    """dx = -x dt + .3 dW from 0 to 1 within 5: x^2 / sigma^2 = 11.1 is what -log P is about."""
    asked = line(lambda x: [-x[0]], lambda t, x: [[0.3]], ([-1.0], [1.0]))
    model = exits._model(asked)
    truth = bound_exits(asked.replace(initial=[0.0], horizon=5.0), seconds=0.1).lower * math.log(10)
    for side in (0, 1):
        found = rarely_reached(model, [(-1.0, 1.0)], (0.0, 0.0), (0.0, 5.0), 0, side)
        assert truth - math.log(2) < found < -7.0


def nerve(horizon: float, safe) -> cb.Problem:
    def f(v, w):
        return [v - v**3 / 3 - w, 0.08 * (v + 0.7 - 0.8 * w)]

    system = cb.ContinuousSystem(f, states=["v", "w"], diffusion=[[0.2], [0]])
    return cb.Problem(system, initial=[-1.2, -0.625], safe=[cb.Inside(one) for one in safe], horizon=horizon)


def test_a_state_without_noise_ends_where_the_drift_leads_back() -> None:
    asked = nerve(10, [cb.HalfSpace([1, 0], 0.0)])
    assert is_confined(asked)
    assert not is_confined(nerve(10, [cb.Box([-2.5, -1.2], [0.0, 1.0])]))  # where v is low, w falls below -1.2
    pendulum = cb.ContinuousSystem(lambda x, v: [v, -np.sin(x) - v], states=["x", "v"], diffusion=[[0], [0.5]])
    assert not is_confined(cb.Problem(pendulum, initial=[0, 0], safe=[cb.Inside(cb.HalfSpace([1, 0], 1))], horizon=5))


@pytest.mark.slow
def test_a_spike_of_a_nerve_cell_is_bounded_near_what_simulations_say() -> None:
    """Of 20 000 paths 2250 spike: between .1068 and .1184 (99 %)."""
    assert 0.1068 < 10 ** bound_exits(nerve(10, [cb.HalfSpace([1, 0], 0.0)]), seconds=20).upper < 0.17


@pytest.mark.usefixtures("frugal")
def test_filtered_noise_is_bounded_above_its_closed_form() -> None:
    """v is a process of one state, and x follows it: the bound must not be below that of v alone."""
    system = cb.ContinuousSystem(lambda x, v: [v - x, -v], states=["x", "v"], diffusion=[[0], [0.6]])
    limits = [cb.Inside(cb.HalfSpace([0, 1], 1)), cb.Inside(cb.HalfSpace([0, -1], 1))]
    asked = cb.Problem(system, initial=[0, 0], safe=limits, horizon=0.5)
    alone = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=0.6)
    plain = cb.Problem(alone, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=0.5)
    least = bound_exits(plain, seconds=0.1).lower
    found = bound_exits(asked, seconds=0.1)
    assert least < found.upper < 0.7 * least
    assert not found.proposed  # certificates know of no face that paths do not cross
