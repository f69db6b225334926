"""What goes wrong where the printed paper is followed to the letter (E1 to E18 of docs/theory.md).

E1, E2, E3, E6 and E18 are tested in test_baselines, E7 in test_martingale.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import certbound as cb
from certbound.problem.library.unicycle import GOAL
from certbound.problem.model.derivative import jacobian
from certbound.problem.model.evaluation import compile_numpy
from certbound.tubes.constants import Constants
from certbound.tubes.tuning import tune_tube
from experiments import errata


def test_every_row_stands_in_the_documentation():
    text = (Path(__file__).parents[2] / "docs" / "theory.md").read_text(encoding="utf-8")
    for number in range(1, 19):
        assert f"\n| E{number} |" in text


def test_e4_the_bound_on_the_noise_must_not_mix_units():
    # vartheta_t <= vartheta^2 with vartheta_t = .5 allows vartheta = .5^.5 = .71, but in other units, w -> 10 w, it
    # reads 5 <= vartheta^2 and allows 2.24 < 5: the tube then is left far too often
    rng = np.random.default_rng(0)
    w = 5.0 * rng.standard_normal(20_000)
    mixed = Constants(gain=0.5, sigma=math.sqrt(5.0), dimension=1)
    right = Constants(gain=0.5, sigma=5.0, dimension=1)
    shares = [np.mean(np.abs(w) > tune_tube(c, horizon=1, delta=0.01).radius(1)) for c in (mixed, right)]
    assert shares[0] > 0.1 > 0.01 > shares[1]


def test_e5_the_window_that_holds_t_starts_at_the_floor():
    step = 0.5
    for t in (0.1, 0.7, 1.3):
        assert math.floor(t / step) * step <= t < math.ceil(t / step) * step
    # with the ceiling the "window" would start after t, and its length t - k step would be negative
    tube = tune_tube(Constants(rate=-1.0, sigma=1.0, dimension=1), horizon=2.0, delta=0.01, method="thm3", step=0.5)
    roots = math.sqrt((1 - math.exp(-0.2)) / 2) + math.sqrt((math.exp(1.0) - 1) / 2)
    epsilon, level = tube.parameters["epsilon"], math.log(8 / 0.01)
    size = -math.log1p(-(epsilon**2)) / epsilon**2 + 2 / epsilon**2 * level
    assert tube.radius(0.1) == pytest.approx(roots * math.sqrt(size))


def test_e8_the_scaled_state_needs_the_power_of_the_time():
    # with L^{-t} x the noise-free part is constant; with L^{-1} x it still moves
    gain, x = 0.5, [1.0]
    for _ in range(4):
        x.append(gain * x[-1])
    assert np.ptp([value * gain**-t for t, value in enumerate(x)]) == 0.0
    assert np.ptp([value / gain for value in x]) > 1.8


def test_e9_and_e10_no_bound_for_the_unicycle_on_the_whole_plane_and_none_below_zero():
    assert errata.unicycle_rate(500) >= -1e-12
    problem = cb.load("unicycle")
    columns = [problem.closed_loop.inputs.index(state) for state in problem.system.states]
    derivative = compile_numpy(jacobian(problem.closed_loop, columns))
    sizes = [np.linalg.norm(derivative(0.0, GOAL[0] - 0.3 * e, GOAL[1] - 0.8 * e, 0.4, 0.0)) for e in (1e-2, 1e-4)]
    assert sizes[1] > 30 * sizes[0] > 30


def test_e11_the_chain_does_not_contract_in_the_euclidean_norm():
    assert errata.chain_gain() >= 1.0


def test_e12_the_printed_safe_set_excludes_the_origin():
    problem = cb.load("chain_rest")
    origin = np.zeros(problem.system.dimension)
    assert all(bool(np.all(constraint.satisfied(origin, 0.0))) for constraint in problem.constraints)
    assert not origin[0] >= 1.2  # what is printed


def test_e13_without_reaction_the_first_mass_does_not_feel_the_others():
    def pull(reaction):
        problem = cb.load("chain_rest", reaction=reaction)
        names = problem.closed_loop.inputs
        states = list(problem.system.states)
        columns = [names.index(state) for state in states]
        matrix = compile_numpy(jacobian(problem.closed_loop, columns))(*([0.0] * len(names)))
        first = matrix[states.index("v1")]
        others = [np.abs(first[states.index(name)]) for name in states if name not in ("p1", "v1")]
        last = matrix[states.index("v3")]
        return max(others), max(np.abs(last[states.index(name)]) for name in states if name not in ("p3", "v3"))

    one_way, both_ways = pull(0), pull(1)
    assert min(one_way) == 0.0 < max(one_way)
    assert min(both_ways) > 0.0


def test_e14_the_two_printed_levels_differ_in_what_they_erode():
    c = Constants(gain=0.98, sigma=1.0, dimension=6)
    radii = [tune_tube(c, horizon=50, delta=delta).maximum for delta in (0.005, 0.002)]
    assert radii[1] > 1.01 * radii[0]
    assert cb.load("chain").delta == 0.002


def test_e15_a_disturbance_that_sees_the_noise_leaves_every_tube():
    assert errata.anticipating(200) > 0.95


def test_e16_radii_grow_with_the_root_of_the_logarithm():
    c = Constants(rate=-1.0, sigma=1.0, dimension=1)
    radii = np.array([tune_tube(c, horizon=5.0, delta=10.0**-k).maximum for k in (20, 80, 280)])
    np.testing.assert_allclose(radii[1:] / radii[:-1], [2.0, math.sqrt(3.5)], rtol=0.04)


def test_e17_the_constraint_of_the_next_step_needs_the_next_radius():
    # a chain that starts still: eroding the constraint at t + 1 by r_t leaves nothing for the first noise
    c = Constants(gain=0.9, sigma=1.0, dimension=1)
    tube = tune_tube(c, horizon=5, delta=0.05)
    w = np.random.default_rng(2).standard_normal(10_000)
    assert tube.bound(0, 0) == 0.0
    assert np.mean(np.abs(w) > 0.0) > 0.9  # what r_0 would promise for X_1
    assert np.mean(np.abs(w) > tube.radius(1)) < 0.05


@pytest.mark.slow
def test_the_pointwise_minimum_of_tubes_is_no_tube():
    assert errata.pointwise_minimum(2_000) > 0.03  # delta is .01
