"""Chains: bounds around closed forms and simulations, for what other value functions do not serve."""

import itertools
import json
import math

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data
from certbound.checker.reading import parse
from certbound.cli.commands.check import proved_certificate
from certbound.errors import InfeasibleError
from certbound.problem.files.loading import loads, save
from certbound.problem.goals import until
from certbound.simulation.estimates import bound_binomial
from certbound.values.chains import abstraction, bound_chain
from certbound.values.chains.extremes import Extremes, places
from certbound.values.chains.pieces import pieces_of
from certbound.values.discrete import bound_failure

LAWS = {
    "gaussian": cb.Gaussian(std=0.2),
    "uniform": cb.Uniform(halfwidth=0.4),
    "triangular": cb.Triangular(halfwidth=0.5),
    "laplace": cb.Laplace(scale=0.1),
    "rademacher": cb.Rademacher(scale=0.2),
    "discrete": cb.Discrete(values=[-0.9, 0.1], probabilities=[0.1, 0.9]),
    "histogram": cb.Histogram(edges=[-2, -1, 1, 2], probabilities=[0.25, 0.5, 0.25], scale=0.2),
}


def contraction(law, **more):
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=["x"], noise=law, **more)
    return cb.Problem(system, initial=[0.2], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=8)


@pytest.mark.parametrize("name", LAWS)
def test_every_law_is_bounded_around_its_simulation(name):
    problem = contraction(LAWS[name])
    found = bound_chain(problem, seconds=0.2)
    rng, x, failed = np.random.default_rng(0), np.full(50_000, 0.2), np.zeros(50_000, dtype=bool)
    for _ in range(8):
        x = 0.9 * x + LAWS[name].sample(rng, len(x))[:, 0]
        failed |= np.abs(x) > 1
    least, most = bound_binomial(int(failed.sum()), len(x), 0.9999)
    assert found.lower <= most
    assert least <= found.upper <= 4 * found.lower


@pytest.mark.parametrize("name", LAWS)
def test_pieces_cover_the_law(name):
    pieces = pieces_of(LAWS[name].resolve(1), 40)
    assert pieces.least.sum() <= 1 <= pieces.most.sum() + pieces.rest
    assert pieces.rest < 1e-8
    assert np.all(pieces.least <= pieces.most)
    drawn = LAWS[name].resolve(1).sample(np.random.default_rng(0), (50_000,))[:, 0]
    for low, high, p in list(zip(pieces.boxes.lo[:, 0], pieces.boxes.hi[:, 0], pieces.most))[::5]:
        inside = np.mean((drawn >= low) & (drawn <= high))
        assert abs(inside - p) < 6 * math.sqrt((p + 1e-4) / len(drawn))


def test_two_entries_are_boxes_and_an_entry_without_noise_is_one_piece():
    pieces = pieces_of(cb.Gaussian(std=[0.2, 0.0]).resolve(2), 10)
    assert pieces.boxes.shape == (10, 2)
    assert not pieces.boxes.mag[:, 1].any()
    with pytest.raises(InfeasibleError, match="independent entries"):
        pieces_of(cb.Gaussian(covariance=[[1, 0.5], [0.5, 1]]).resolve(2), 10)
    with pytest.raises(InfeasibleError, match="one or two entries, not 3"):
        pieces_of(cb.Gaussian(std=1).resolve(3), 10)
    with pytest.raises(InfeasibleError, match="do not know the law Bounded"):
        pieces_of(cb.Bounded(halfwidth=1).resolve(1), 10)


def test_extremes_are_those_of_the_boxes():
    rng = np.random.default_rng(0)
    table = rng.normal(size=(13, 22))
    first = np.stack([rng.integers(0, 13, 300), rng.integers(0, 22, 300)])
    last = np.minimum(first + rng.integers(0, 22, (2, 300)), [[12], [21]])
    for pick, reduce in ((np.maximum, np.max), (np.minimum, np.min)):
        wanted = [reduce(table[a : c + 1, b : d + 1]) for (a, b), (c, d) in zip(first.T, last.T)]
        np.testing.assert_array_equal(Extremes(table, pick).over(places(table.shape, first, last)), wanted)


MULTIPLIED = """
time = "discrete"
horizon = 5
states = ["x", "y"]
delta = 0.1

[dynamics]
x = "0.8*x + 0.1*y"
y = "0.6*y"

[noise]
law = "gaussian"
std = 1
matrix = [["0.5*x*y + 0.1"], ["0.2*x"]]

[initial]
point = [0.6, 0.5]

[[stay]]
box = { x = [-1, 1], y = [-1, 1] }
"""


def test_noise_that_multiplies_the_state(tmp_path):
    problem = loads(MULTIPLIED)
    assert problem.system.gain.inputs == ("t", "x", "y")
    bounds = bound_chain(problem, seconds=0.8)
    counts = cb.simulate_exits(problem, paths=50_000, rng=0, confidence=0.9999)
    rng = np.random.default_rng(1)
    x = np.tile([0.6, 0.5], (50_000, 1))
    safe = np.ones(len(x), dtype=bool)
    for _ in range(5):
        w = rng.standard_normal(len(x))
        gain = np.stack([0.5 * x[:, 0] * x[:, 1] + 0.1, 0.2 * x[:, 0]], axis=1)
        x = np.stack([0.8 * x[:, 0] + 0.1 * x[:, 1], 0.6 * x[:, 1]], axis=1) + gain * w[:, None]
        safe &= (np.abs(x) <= 1).all(axis=1)
    assert counts.lower <= 1 - safe.mean() <= counts.upper
    assert bounds.lower <= counts.upper
    assert counts.lower <= bounds.upper <= 2.5 * counts.probability
    save(problem.replace(name="again"), tmp_path / "again.toml")
    assert cb.load(tmp_path / "again.toml").system.gain.nodes == problem.system.gain.nodes


def test_other_engines_refuse_such_noise_and_certificates_state_it():
    problem = loads(MULTIPLIED).replace(horizon=1)
    verdict = cb.verify_safety(problem, time_limit=20)
    assert "the noise matrix depends on t or the states" in verdict.answers["linear"].reason
    assert verdict.answers["values"].applicable
    stated = json.loads(proved_certificate(problem, verdict))["problem"]["noise"]["matrix"]
    assert stated["columns"] == problem.system.gain.shape[1]
    with pytest.raises(InfeasibleError, match="depends on t or the states"):
        problem.system.noise_matrix  # noqa: B018  (it refuses)
    with pytest.raises(ValueError, match="`noise_matrix` must return a matrix with 2 rows"):
        cb.DiscreteSystem(lambda x: x, states=2, noise=cb.Gaussian(std=1), noise_matrix=lambda x: [x[0]])


STAYING = """
time = "discrete"
horizon = 10
states = ["x"]
delta = 0.4

[dynamics]
x = "0.6*x"

[noise]
law = "gaussian"
std = 0.1

[initial]
point = [0.8]

[[stay]]
box = { x = [-1, 1] }

[[reach]]
box = { x = [-0.25, 0.25] }
then = "stay"
"""


def staying_truth(horizon=10):
    """P(left again, or never arrived, or out of [-1, 1]) by Gauss's rule."""
    nodes, weights = np.polynomial.legendre.leggauss(120)
    inner, outer = 0.25 * nodes, np.concatenate([0.625 + 0.375 * nodes, -0.625 + 0.375 * nodes])
    small, wide = 0.25 * weights, 0.375 * np.concatenate([weights, weights])

    def density(y, x):
        return np.exp(-0.5 * ((x[None, :] - 0.6 * y[:, None]) / 0.1) ** 2) / (0.1 * math.sqrt(2 * math.pi))

    kept, arriving = np.ones(len(inner)), np.zeros(len(outer))
    start = np.array([0.8])
    for step in range(horizon):
        y = start if step == horizon - 1 else outer
        arriving = density(y, inner) * small @ kept + density(y, outer) * wide @ arriving
        kept = density(inner, inner) * small @ kept
    return 1 - float(arriving[0])


def test_a_target_that_is_to_be_stayed_in(tmp_path):
    problem, truth = loads(STAYING), staying_truth()
    found = bound_chain(problem, seconds=1)
    assert found.lower <= truth <= found.upper <= 1.5 * found.lower
    counts = cb.simulate_exits(problem, paths=50_000, rng=0, confidence=0.9999)
    assert counts.lower <= truth <= counts.upper
    assert any(label.startswith("left again") and count > 0 for label, count in counts.by_constraint.items())
    passing = cb.simulate_exits(problem.replace(reach=cb.Reach(cb.Box([-0.25], [0.25]))), paths=20_000, rng=0)
    assert passing.upper < found.lower
    save(problem.replace(name="again"), tmp_path / "again.toml")
    again = cb.load(tmp_path / "again.toml")
    assert (again.reach.then, again.reach.label) == ("stay", "reach and stay -0.25 <= x <= 0.25")


def test_smooth_functions_say_more_of_a_target_that_is_to_be_stayed_in():
    problem = loads(STAYING)
    plain, target = until(problem, problem.horizon), problem.reach.region
    for first, last in ((0, 10), (2, 4)):
        fine = bound_failure(plain, target=target, since=first, until=last, seconds=1)
        coarse = bound_chain(problem.replace(reach=cb.Reach(target, during=(first, last), then="stay")), seconds=0.5)
        assert coarse.lower < fine.lower <= fine.upper < coarse.upper
        if last == 10:
            assert fine.lower <= staying_truth() <= fine.upper <= 1.02 * fine.lower
    with pytest.raises(InfeasibleError, match="no start in a target"):
        bound_failure(plain.replace(initial=[0.1]), target=target, until=10)


def test_arriving_late_or_before_the_window_does_not_count():
    problem = loads(STAYING)
    late = problem.replace(reach=cb.Reach(cb.Box([-0.25], [0.25]), during=(6, 10), then="stay"))
    early = problem.replace(reach=cb.Reach(cb.Box([-0.25], [0.25]), during=(0, 3), then="stay"))
    for case in (late, early):
        found = bound_chain(case, seconds=0.3)
        counts = cb.simulate_exits(case, paths=30_000, rng=0, confidence=0.9999)
        assert found.lower <= counts.upper
        assert counts.lower <= found.upper


def test_staying_is_refused_where_it_cannot_be():
    problem = loads(STAYING)
    verdict = cb.verify_safety(problem.replace(delta=0.1), time_limit=20)
    assert verdict.status == "UNSAFE"
    assert "to be stayed in" in verdict.answers["linear"].reason
    proved = float.fromhex(json.loads(proved_certificate(problem, verdict))["claim"]["log10_lower"])
    assert math.log10(0.999 * staying_truth()) < proved <= math.log10(staying_truth())
    with pytest.raises(ValueError, match='`then` must be "stay" or omitted'):
        cb.Reach(cb.Box([0], [1]), then="leave")
    with pytest.raises(ValueError, match=r"`stay\.0\.then` must be omitted"):
        loads(STAYING.replace("box = { x = [-1, 1] }", 'box = { x = [-1, 1] }\nthen = "stay"'))
    with pytest.raises(ValueError, match="in continuous time, where a path that has just entered"):
        cb.Problem(
            cb.ContinuousSystem(lambda x: -x, states=1, diffusion=0.1), initial=[0.8], safe=[], horizon=1,
            reach=cb.Reach(cb.Box([-0.2], [0.2]), then="stay"),
        )  # fmt: skip


def test_targets_disturbances_and_domains_agree_with_finer_functions():
    system = cb.DiscreteSystem(
        lambda x, d: 0.7 * x + d, states=["x"], disturbance=cb.Box([-0.05], [0.05]), noise=cb.Gaussian(std=0.15)
    )
    problem = cb.Problem(
        system, initial=[0.8], safe=[cb.Inside(cb.HalfSpace([1], 0.9))], horizon=4, domain=cb.Box([-1], [1]),
        leaving="ends", reach=cb.Box([-0.1], [0.1]),
    )  # fmt: skip
    exact = cb.verify_safety(problem, method="values", time_limit=5)
    found = bound_chain(problem, seconds=0.3)
    assert found.lower <= 10**exact.log10_delta
    assert 10**exact.log10_lower <= found.upper <= 1.7 * found.lower


@pytest.mark.parametrize("then", [None, "stay"])
def test_who_misses_a_target_has_failed_as_its_window_ends_and_not_later(then):
    system = cb.DiscreteSystem(lambda x: x + 1.0, states=["x"], noise=cb.Uniform(halfwidth=0.1))
    problem = cb.Problem(
        system, initial=[0], safe=[], horizon=4, domain=cb.Box([-1], [1.5]), leaving="ends",
        reach=cb.Reach(cb.Box([-0.5], [-0.4]), during=(0, 1), then=then),
    )  # fmt: skip
    found = bound_chain(problem, seconds=0.1)
    assert found.lower == pytest.approx(1, abs=1e-9)
    assert found.upper == 1
    assert cb.simulate_exits(problem, paths=1000, rng=0).probability == 1


def test_where_the_model_is_undefined_nothing_is_known():
    system = cb.DiscreteSystem(lambda x: 0.1 * np.sqrt(x), states=["x"], noise=cb.Triangular(halfwidth=0.5))
    problem = cb.Problem(
        system, initial=[0.01], safe=[cb.Inside(cb.HalfSpace([1], 5))], horizon=2, domain=cb.Box([-1], [1]),
        leaving="ends",
    )  # fmt: skip
    found = bound_chain(problem, seconds=0.2)
    negative = (1 - 0.01 / 0.5) ** 2 / 2  # P(0.01 + w < 0)
    assert found.upper >= negative
    assert found.lower == 0


def test_what_chains_do_not_serve():
    with pytest.raises(InfeasibleError, match="random start"):
        bound_chain(contraction(LAWS["triangular"]).replace(initial=cb.GaussianStart([0], [[0.01]])))
    three = cb.DiscreteSystem(lambda x: 0.5 * x, states=3, noise=cb.Gaussian(std=0.1))
    with pytest.raises(InfeasibleError, match="one or two states"):
        bound_chain(cb.Problem(three, initial=[0, 0, 0], safe=[cb.Inside(cb.Ball([0, 0, 0], 1))], horizon=2))


def halved(law=None, **options):
    """x gains or loses half of itself: below .3 within three steps only by two losses first, with probability 1/4."""
    system = cb.DiscreteSystem(
        lambda x: 1.0 * x, states=["x"], noise=law or cb.Rademacher(scale=0.5), noise_matrix=lambda x: [[x[0]]])
    given = {"initial": [1.0], "safe": [cb.Inside(cb.HalfSpace([-1.0], -0.3))], "horizon": 3, "delta": 0.3}
    return cb.Problem(system, **(given | options))


def test_a_state_with_a_limit_on_one_side_is_followed_far_beyond_where_paths_are():
    found = bound_chain(halved(), seconds=1.0)
    assert 0.2499 < found.lower <= 0.25 <= found.upper < 0.2501
    late = [cb.Inside(cb.Box([0.3], [3.0]), during=(2, 3))]  # two losses first, or three gains
    found = bound_chain(halved(safe=late), seconds=1.0)
    assert 0.37 < found.lower <= 0.375 <= found.upper < 0.38


def test_where_the_grid_ends_is_of_no_consequence_but_for_the_bounds(monkeypatch):
    monkeypatch.setattr(abstraction, "_FAR", 0.0)
    monkeypatch.setattr(abstraction, "_RARE", 0.4)
    cut = bound_chain(halved(horizon=5), seconds=0.1)
    paths = [np.cumprod(1 + 0.5 * np.array(signs)) for signs in itertools.product([1, -1], repeat=5)]
    truth = np.mean([path.min() < 0.3 for path in paths])
    assert cut.lower < truth - 0.01
    assert cut.upper > truth + 0.01


def test_a_random_walk_on_one_side_is_safe_with_a_certificate():
    problem = halved(cb.Triangular(halfwidth=0.3), horizon=2)
    verdict = cb.verify_safety(problem, method="values")
    assert verdict.status == "SAFE"
    assert check_data(parse(proved_certificate(problem, verdict))).valid
