"""The probability itself as a proposal in two states: both bounds beside a truth that is known."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import time

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.safety.answers import Request
from certbound.safety.portfolio import ENGINES
from certbound.values.continuous import exits, residual, straight
from certbound.values.continuous.curved import bounding
from certbound.values.continuous.held_faces import check_noise
from certbound.values.continuous.hypotheses import (
    NEGLIGIBLE,
    Model,
    interpolants,
    prove_lower,
    prove_upper,
    proved_lower,
)  # fmt: skip
from certbound.values.continuous.plane import Plane, plane_of
from certbound.values.continuous.residual import bound_ranges, sample_in_plane
from certbound.values.continuous.straight import near_one, ramps, relative
from certbound.values.continuous.straight.relative import relative_above, relative_below, seen_above, seen_below
from certbound.values.room import safe_room, starts_of
from certbound.watch import OutOfTime


def free() -> cb.Problem:
    """Two Brownian motions."""
    gain = 0.6 * np.eye(2)
    system = cb.ContinuousSystem(lambda x: [0 * x[0], 0 * x[1]], states=2, diffusion=gain)
    return cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1)


def plane(problem: cb.Problem) -> tuple[Plane, Model]:
    model, room = exits._model(problem), safe_room(problem)
    return plane_of(problem, model, room.inner_low, room.inner_high, starts_of(problem)), model


@pytest.mark.usefixtures("frugal")
def test_both_bounds_are_near_the_truth_and_hold_on_spoilt_proposals() -> None:
    odd = 2 * np.arange(30) + 1.0
    stays = 4 / np.pi * float(np.sum((-1.0) ** np.arange(30) / odd * np.exp(-((0.6 * np.pi * odd) ** 2) / 8)))
    truth = math.log(1 - stays**2)
    inner, model = plane(free())
    above = near_one._bounded(inner, model, 8, truth, None, below=False)
    below = near_one._bounded(inner, model, 8, truth, None, below=True)
    assert above is not None
    assert below is not None
    assert truth - 0.5 < below[1].log <= truth <= above[1].log < truth + 0.4
    rng = np.random.default_rng(1)
    spoilt = [
        dataclasses.replace(one, values=one.values * (1 + 1e-6 * rng.normal(size=one.values.shape)))
        for one, _ in (above, below)
    ]
    assert prove_upper(spoilt[0].raised(-1e-3), model, inner.starts).log >= truth
    payment = prove_lower(spoilt[1].raised(1e-3), model, inner.starts)
    assert payment is None or payment.log <= truth


@pytest.mark.usefixtures("frugal")
def test_noises_that_go_together_have_both_bounds() -> None:
    """Without a margin no lower bound is found: second derivatives grow without limit in two of the corners."""
    gain = 0.6 * np.array([[1, 0], [0.7, math.sqrt(0.51)]])
    system = cb.ContinuousSystem(lambda x: [0 * x[0], 0 * x[1]], states=2, diffusion=gain)
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=1)
    inner, model = plane(problem)
    above = near_one._bounded(inner, model, 12, math.log(0.3), None, below=False)
    below = near_one._bounded(inner, model, 12, math.log(0.3), None, below=True)
    assert above is not None
    assert below is not None
    odd = 2 * np.arange(30) + 1.0
    stays = 4 / np.pi * float(np.sum((-1.0) ** np.arange(30) / odd * np.exp(-((0.6 * np.pi * odd) ** 2) / 8)))
    assert above[1].log > math.log(1 - stays)  # of one of them
    assert below[1].log < math.log(1 - stays**2)  # of two that go apart
    assert above[1].log - below[1].log < 0.7
    assert [one.axes[0][-1] for one, _ in (above, below)] == [1.0, 1.0]


def test_noise_that_is_small_beside_a_face_has_full_rank() -> None:
    """A price and its volatility: a's determinant, .09 v^2 (1 - .49), over cells that are wide beside v = .005."""

    def model(low: float) -> Model:
        system = cb.ContinuousSystem(
            lambda x: [-x[1] / 2, 2 * (0.04 - x[1])],
            states=2,
            diffusion=lambda x: [[x[1] ** 0.5, 0 * x[1]], [-0.21 * x[1] ** 0.5, 0.214 * x[1] ** 0.5]],
        )
        box = cb.Inside(cb.Box([-0.4, low], [0.7, 0.3]))
        return exits._model(cb.Problem(system, initial=[0, 0.04], safe=[box], horizon=0.5))

    check_noise(model(0.005), (0.0, 0.5), [(-0.4, 0.7), (0.005, 0.3)])
    with pytest.raises(InfeasibleError, match="full rank"):
        check_noise(model(0.0), (0.0, 0.5), [(-0.4, 0.7), (0.0, 0.3)])


def test_a_face_that_no_upper_proposal_reaches_is_raised() -> None:
    inner, _ = plane(free())
    surface = ramps.Ramps(inner, 8, 0.1).surface(None, below=False)
    low = [surface.face_range(axis, side)[0] for axis in (0, 1) for side in (0, 1)]
    assert min(low) > -1e-9 * ramps.SMALL
    assert surface.times[0] == 0
    assert surface.times[-1] == 1


def test_where_it_does_not_serve_the_logarithm_is_proposed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(near_one, "two_states", lambda *given: "the logarithm")
    swaying = cb.ContinuousSystem(lambda t, x: [-x[0], np.sin(t) - x[1]], states=2, diffusion=0.8 * np.eye(2))
    for problem, seconds in ((free().replace(system=swaying), 60.0), (free(), 0.1)):
        found = straight.bound_plane(
            problem, exits._model(problem), safe_room(problem), time.perf_counter() + seconds, -math.inf
        )
        assert str(found) == "the logarithm"


@pytest.mark.usefixtures("frugal")
def test_a_side_that_is_no_limit_does_not_count_below() -> None:
    cut = ((True, False), (True, False))
    kept = [cb.Inside(cb.HalfSpace([1, 0], 1)), cb.Inside(cb.HalfSpace([0, 1], 1))]
    truth = math.log(1 - math.erf(1 / (0.6 * math.sqrt(2))) ** 2)
    problem = free().replace(safe=kept)
    model = exits._model(problem)
    inner = plane_of(problem, model, (-1.5, -1.5), (1.0, 1.0), starts_of(problem))
    outer = bounding._outer(problem, model, inner)
    assert outer is not None
    assert outer.cut == cut
    below = near_one._bounded(outer, model, 10, truth, None, below=True)
    assert below is not None
    assert truth - 1.0 < below[1].log <= truth
    # a narrow box: where all of its sides counted, more would be proved than is true
    narrow = dataclasses.replace(outer, low=(-0.4, -0.4))
    wrong = near_one._bounded(dataclasses.replace(inner, low=(-0.4, -0.4)), model, 8, truth, None, below=True)
    assert wrong is not None
    assert wrong[1].log > truth
    payment = prove_lower(wrong[0], model, narrow.starts, cut=cut)
    assert payment is None or payment.log <= truth


def test_where_the_drift_leads_back_fast_few_cells_do() -> None:
    system = cb.ContinuousSystem(lambda x: [1.5 - x[0], 3 - 3 * x[1]], states=2, diffusion=0.3 * np.eye(2))
    problem = cb.Problem(system, initial=[1, 1], safe=[cb.Inside(cb.Box([-2, 0], [1.8, 2]))], horizon=2)
    found = [ramps.Ramps(plane(problem)[0], 14, 0.05, eased=one).surface(None, below=False) for one in (False, True)]
    lows = [float(one.range_at(0)[0].min()) / ramps.SMALL + 1 for one in found]
    assert lows[0] < -0.1  # it rings
    assert lows[1] > -0.02


def test_where_failing_is_rare_a_share_of_u_is_paid(monkeypatch) -> None:
    """The same proposal, paid by amounts and by shares: both below the truth, also where starts are spoilt upwards."""
    odd = 2 * np.arange(30) + 1.0
    stays = 4 / np.pi * float(np.sum((-1.0) ** np.arange(30) / odd * np.exp(-((0.6 * np.pi * odd) ** 2) / 8)))
    truth, (inner, model) = math.log(1 - stays**2), plane(free())
    surface = ramps.Ramps(inner, 8, 0.1, below=True).surface(None, below=True)
    found = []
    for lift in (0.0, 2e-4):
        payment, proof = proved_lower(surface.raised(lift), model, inner.starts, negligible=1e-6)
        share = relative_below(proof)
        assert payment is None or payment.log <= truth
        assert share is None or share <= truth
        found.append((payment, share))
    assert found[0][1] is not None
    assert found[0][1] > (-math.inf if found[0][0] is None else found[0][0].log) - 5e-3
    _, proof = proved_lower(surface, model, inner.starts, negligible=1e-6)
    monkeypatch.setattr(relative, "top_of", lambda _: 0.5)
    higher = relative_below(proof)  # where V may be .5, what is missing counts e^.5 times
    assert higher is None or higher < found[0][1] - 1e-3


def test_coarse_bounds_of_what_polynomials_leave_out_are_above_close_ones() -> None:
    inner, _ = plane(free())
    smooth = ramps.Ramps(inner, 4, 0.1, below=True).surface(None, below=True)
    patches = dataclasses.replace(smooth, values=300 * smooth.values).patches(0, smooth.slabs)
    left_out = np.random.default_rng(1).random((4, len(patches.size)))
    _, sizes = residual._errors(patches, left_out, 2)
    assert np.all(residual._coarsely(patches, left_out, sizes) >= residual._diffusive_loss(patches, left_out, 2))
    assert all(np.all(size >= residual._steepest(patches, axis)) for axis, size in enumerate(sizes))


@pytest.mark.slow
def test_a_grid_as_fine_as_a_first_proposal_hopes_for_is_granted() -> None:
    """Prey and hunters who are sated: no grid that is granted in 5 s proves anything, one twice as fine does."""
    system = cb.ContinuousSystem(
        lambda x: [x[0] * (1 - x[0] / 3) - x[0] * x[1] / (1 + x[0]), 0.8 * x[0] * x[1] / (1 + x[0]) - 0.4 * x[1]],
        states=2, diffusion=lambda x: [[0.08 * x[0], 0], [0, 0.08 * x[1]]],
    )  # fmt: skip
    start, safe = cb.Box([0.9, 1.2], [1.1, 1.4]), cb.Inside(cb.Box([0.2, 0.3], [3, 3]))
    problem = cb.Problem(system, initial=start, safe=[safe], horizon=10, delta=0.1)
    assert ENGINES["values"].prove(problem, Request(thorough=False, bounded=True)).log10_delta <= -1


def test_where_failing_is_rare_q2_is_left_out_and_shares_are_paid_on_both_sides() -> None:
    """Both hold, also of proposals that are spoilt on purpose, and neither is far from the truth."""
    odd = 2 * np.arange(30) + 1.0
    stays = 4 / np.pi * float(np.sum((-1.0) ** np.arange(30) / odd * np.exp(-((0.6 * np.pi * odd) ** 2) / 8)))
    truth, (inner, model) = math.log(1 - stays**2), plane(free())
    found: dict[bool, list[float]] = {True: [], False: []}
    for below, spoil in itertools.product((True, False), (0.0, 1e-7)):
        solver = ramps.Ramps(inner, 8, 0.1, below=below, finely=True)
        surface, rng = solver.surface(None, below=below), np.random.default_rng(1)
        surface = dataclasses.replace(surface, values=surface.values + spoil * rng.normal(size=surface.values.shape))
        near = np.zeros((surface.slabs, *surface.cells))
        given = surface, model, inner.starts, NEGLIGIBLE * solver.small * math.exp(truth), near
        proof = seen_below(*given, None, inner.cut) if below else seen_above(*given)
        share = relative_below(proof) if below else relative_above(proof)
        found[below] += [] if share is None else [share]
    assert max(found[True]) <= truth <= min(found[False])
    assert found[True][0] > truth - 1
    assert found[False][0] < truth + 0.5


@pytest.mark.parametrize("below", [True, False])
def test_where_nothing_is_lost_shares_of_u_say_what_the_values_do(below: bool) -> None:
    inner, model = plane(free())
    solver = ramps.Ramps(inner, 8, 0.1, below=below, finely=True)
    surface = solver.surface(None, below=below)
    given = surface, model, inner.starts, 1e-6 * solver.small, np.zeros((surface.slabs, *surface.cells))
    proof = seen_below(*given, None, inner.cut) if below else seen_above(*given)
    nothing = np.zeros(len(proof.slab))
    ranges = dataclasses.replace(proof.ranges, residual_low=nothing, residual_high=nothing)
    proof = dataclasses.replace(proof, ranges=ranges)
    assert proof.seen is not None
    surface, need = proof.seen
    end = need.bottom if below else float(surface.range_at(-1)[0].min())
    said = math.log((math.exp(need.start) - math.exp(end)) / (1 - math.exp(end)))
    found = relative_below(proof) if below else relative_above(proof)
    assert found is not None
    assert 0 <= (said - found if below else found - said) < 1e-3


def test_what_is_bounded_without_q2_holds_with_it() -> None:
    inner, model = plane(free())
    smooth = ramps.Ramps(inner, 4, 0.1, below=True).surface(None, below=True)
    steep = dataclasses.replace(smooth, values=300 * smooth.values)  # so that Q2 is most of R
    patches, place, counts = steep.patches(0, 1), np.arange(16), model.counts()
    full = (patches, *interpolants(steep, model, 0, 1, counts), place, counts)
    part = (patches, *interpolants(steep, model, 0, 1, model.counts(straight=True)), place, model.counts(straight=True))
    found = bound_ranges(*part, near=0.0, straight=True)
    assert np.all(found.residual_high >= sample_in_plane(*full, upper=True))
    assert np.all(found.residual_low <= -sample_in_plane(*full, upper=False))
    assert np.all(found.energy == 0)


def test_what_is_proved_where_failing_is_rare_stays_as_time_ends_and_grids_keep_to_it(monkeypatch) -> None:
    inner, model = plane(free())
    shares = [-1.0]

    def proved(_: object) -> float:
        if not shares:
            raise OutOfTime
        return shares.pop()

    monkeypatch.setattr(near_one, "relative_below", proved)
    assert near_one.rarely(inner, model, 6, 0.0, None, below=True) == -1.0
    with pytest.raises(OutOfTime):
        near_one.rarely(inner, model, 6, 0.0, None, below=True)
    cells, found = list[int](), {False: -9.0, True: -9.5}

    def bounded(plane: Plane, model: Model, count: int, level: float, points: object, *, below: bool) -> float:
        cells.append(count)
        if below not in found:
            raise OutOfTime
        return found[below]

    def ask(guesses: list[float] | None, wanted: float = -10.0) -> tuple[float, float | None]:
        cells.clear()
        other = functools.partial(pytest.fail, "logarithms are not asked")
        return near_one._with_rare(free(), model, (inner, inner), 20.0, -9.1, wanted, other, True, guesses)[:2]

    monkeypatch.setattr(near_one, "rarely", bounded)
    assert ask(None) == (-9.0, -9.5)
    assert near_one._RARELY * sum(count**2 for count in cells) < 1.03 * 20.0
    guesses: list[float] = []
    assert ask(guesses) == (-9.0, None)
    assert (guesses, len(cells)) == ([-9.1], 1)
    del found[True]
    assert ask(None) == (-9.0, None)
    found.clear()
    with pytest.raises(OutOfTime):
        ask(None)


def test_where_time_is_short_logarithms_are_asked_only_where_a_grid_of_rare_failing_says_little(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cells, asked, found = list[int](), list[float](), [-7.1]
    inner, model = plane(free())

    def bounded(plane: Plane, model: Model, count: int, level: float, points: object, *, below: bool) -> float:
        cells.append(count)
        return found[0]

    def other(deadline: float, wanted: float) -> tuple[object, ...]:
        asked.append(wanted)
        return -8.0, None, "cells: 16^2", ([], [])

    def ask() -> float:
        return near_one._with_rare(free(), model, (inner, inner), 5.0, -9.1, -10.0, other, True, None)[0]

    monkeypatch.setattr(near_one, "rarely", bounded)
    assert (ask(), asked) == (-7.1, [])
    assert near_one._RARELY * cells[0] ** 2 == pytest.approx((1 + near_one._FIRST) * 5.0, rel=0.03)
    found[0] = -5.0
    assert (ask(), len(asked)) == (-8.0, 1)
