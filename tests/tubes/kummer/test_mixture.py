"""Mixtures: the certificate in floats by other formulas, the linear program, what it gains, where it is limited."""

from __future__ import annotations

import json
import math
import pickle

import numpy as np
import pytest
from scipy.special import gamma, hyp1f1, iv

from certbound.tubes.constants import Constants
from certbound.tubes.kummer.mixing import mixture_level
from certbound.tubes.kummer.mixture import Component, MixtureProfile, MixtureProgram
from certbound.tubes.objective import read_clearance
from certbound.tubes.schedule import make_schedule
from certbound.tubes.tuning import bound_exit_probability, tune_tube
from tests.tubes.yardstick import estimate_exit_probability, estimate_radius

CHAIN = Constants(gain=0.5, sigma=1.0, dimension=1)
OU = Constants(rate=-1.0, sigma=1.0, dimension=1)


def chain_gain(component, n, gain, step, radius):
    """phi(I) + e^{a I} E(r^2/(2 v)) of one component of a chain with sigma = 1, by its definition."""
    a, v0, end = component["a"], component["v0"], int(component["end"])
    v = [v0]
    for _ in range(end):
        v.append(gain**2 * v[-1] + (0.0 if component["bessel"] else 1.0))
    if component["bessel"]:
        info = [sum(1 / v[k + 1] for k in range(t, end)) for t in (0, min(step, end))]
    else:
        info = [sum(math.log(v[k + 1] / (gain**2 * v[k])) for k in range(t, end)) for t in (0, min(step, end))]

    def whole(i, z):
        if component["bessel"]:
            root = 2 * math.sqrt(a * z)
            f = 1.0 if z == 0 else gamma(n / 2) * (root / 2) ** (1 - n / 2) * iv(n / 2 - 1, root)
            return (math.exp(a * i) * f - 1) / a
        if a == 0:
            k = np.arange(1, 400)
            terms = np.cumsum(np.log(z / (n / 2 + k - 1))) - np.log(k) if z > 0 else np.full(1, -np.inf)
            return i + float(np.exp(terms).sum())
        return (math.exp(a * i) * hyp1f1(a, n / 2, z) - 1) / a

    now = whole(info[1], radius**2 / (2 * v[step])) if step <= end else 0.0
    return now, whole(info[0], 0.0)


@pytest.fixture(scope="module")
def chain_tube():
    return tune_tube(CHAIN, horizon=20, delta=1e-3, method="mixture")


def test_the_weights_prove_the_level_by_other_formulas(chain_tube):
    components = chain_tube.parameters["components"]
    radius = chain_tube.radius(np.arange(21.0))
    assert sum(c["share"] for c in components) <= 1 + 1e-12
    for step in range(1, 21):
        total = 0.0
        for component in components:
            now, start = chain_gain(component, 1, 0.5, step, radius[step])
            total += component["share"] * 1e-3 / start * now
        assert total >= 1 - 1e-7


def test_mixtures_with_end_times_reach_what_item_7_12_says(chain_tube):
    limit = estimate_radius(CHAIN, horizon=20, delta=1e-3)
    kummer = tune_tube(CHAIN, horizon=20, delta=1e-3, method="kummer").maximum
    assert kummer / limit == pytest.approx(1.152, abs=0.006)
    assert chain_tube.maximum / limit == pytest.approx(1.134, abs=0.008)
    assert chain_tube.maximum < tune_tube(CHAIN, horizon=20, delta=1e-3, method="prop3_sharp").maximum


def test_bounds_over_intervals_cover_the_radius(chain_tube):
    for first, last in ((0, 3), (4, 4), (7, 20)):
        steps = np.arange(float(first), last + 1)
        assert chain_tube.bound(first, last) >= np.max(chain_tube.radius(steps)) * (1 - 1e-12)
    assert chain_tube.bound(0, 0) == 0.0


def test_the_record_is_plain_data(chain_tube):
    record = json.loads(json.dumps(chain_tube.to_dict()))
    assert record["profile"]["kind"] == "mixture"
    assert len(record["profile"]["components"]) == len(chain_tube.parameters["components"])
    copy = pickle.loads(pickle.dumps(chain_tube))
    assert copy.radius(7.0) == chain_tube.radius(7.0)


@pytest.mark.slow
def test_a_mixture_beats_single_tubes_on_the_shape_of_the_transient():
    times = np.linspace(0.0, 4.0, 5)
    shape = np.sqrt(1 - np.exp(-2 * times[1:]))
    goal = (times, shape)
    single = tune_tube(OU, horizon=4.0, delta=1e-3, objective=goal, method="kummer")
    mixed = tune_tube(OU, horizon=4.0, delta=1e-3, objective=goal, method="mixture")
    scales = [max(tube.bound(s, e) / w for s, e, w in zip(times, times[1:], shape)) for tube in (single, mixed)]
    assert scales[1] < 0.99 * scales[0]


def test_the_level_of_clearances_is_above_the_truth_and_below_the_single_level():
    held = read_clearance(3.0, 12)
    level = mixture_level(make_schedule(CHAIN, 12), held, best=[])
    truth = math.log10(estimate_exit_probability(CHAIN, horizon=12, radius=3.0))
    assert truth < level < bound_exit_probability(CHAIN, horizon=12, clearance=3.0) + 1e-6


def test_anisotropic_sub_gaussian_noise_keeps_to_small_powers_without_the_bessel_form():
    rough = Constants(gain=0.7, sigma=1.0, dimension=3, effective_dimension=1.5)
    tube = tune_tube(rough, horizon=6, delta=1e-2, method="mixture")
    assert all(c["a"] < 0.75 and not c["bessel"] for c in tube.parameters["components"])


def test_weights_that_add_up_to_too_much_are_seen():
    schedule = make_schedule(CHAIN, 3)
    pair = Component(a=0.5, v0=1.0, end=3.0, weight=0.7e-3)
    profile = MixtureProfile(schedule=schedule, components=(pair, pair), aims=np.array([4.0]))
    assert profile.level() >= 1.4e-3


def test_an_aim_that_is_not_proved_is_not_used():
    schedule = make_schedule(CHAIN, 3)
    pair = Component(a=0.5, v0=1.0, end=3.0, weight=1e-3)
    short = MixtureProfile(schedule=schedule, components=(pair,), aims=np.array([0.5]))
    far = MixtureProfile(schedule=schedule, components=(pair,), aims=np.array([50.0]))
    assert short.rough(0, 0.0, 3.0) == math.inf
    assert short.stretch(0, 0.0, 3.0)[0] > 3.0
    assert far.rough(0, 0.0, 3.0) == pytest.approx(50.0)


def test_the_program_finds_the_best_of_two_columns():
    schedule = make_schedule(CHAIN, 4).refined(np.arange(1.0, 4.0))
    program = MixtureProgram(schedule=schedule, clearance=np.full(4, 3.5), ends=np.array([4]))
    pairs = [(0.5, 1.0, False), (2.0, 1.3, False)]
    alone = [program.solve([pair], 1.0, 0)[0] for pair in pairs]
    both = program.solve(pairs, 1.0, 0)[0]
    assert both <= min(alone) * (1 + 1e-9)
    columns = np.exp([program.columns(pair, 1.0)[0] for pair in pairs])
    weights = np.linspace(0, 1, 2001)
    dense = min(1 / np.min(w * columns[0] + (1 - w) * columns[1]) for w in weights)
    assert both == pytest.approx(dense, rel=1e-3)
