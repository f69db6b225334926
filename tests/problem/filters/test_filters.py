"""Filters are what their formulas say, stand behind a system's own states, and start as they are at all times."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.html_report import report_page
from certbound.problem.files.loading import load, loads, save
from certbound.problem.filters.filters import KINDS
from certbound.safety.certificate import certificate_text, problem_data
from tests.problem.toml_files import changed, same

GUST = {"std": 1.5, "length": 200.0, "speed": 50.0}
TAU = 4.0  # length / speed
NOISES = {
    "ou": cb.Filter("ou", state="w", std=1.5, time=TAU),
    "dryden u": cb.Filter("dryden", state="w", axis="u", **GUST),
    "dryden w": cb.Filter("dryden", state="w", axis="w", **GUST),
    "von_karman u": cb.Filter("von_karman", state="w", axis="u", **GUST),
    "von_karman v": cb.Filter("von_karman", state="w", axis="v", **GUST),
    "band": cb.Filter("band", state="w", density=2.0, low=0.5, high=0.8),
    "band from 0": cb.Filter("band", state="w", density=2.0, low=0.0, high=0.8),
}
TEXT = """
time = "continuous"
horizon = 5
states = ["v"]
[parameters]
s = 0.5
[dynamics]
v = "-v + w"
[noise]
diffusion = [[0.1]]
[[noise.filter]]
state = "w"
kind = "ou"
std = "s"
time = 2
[initial]
point = [0]
[[stay]]
box = { v = [-1.5, 1.5] }
"""
BY_HAND = """
time = "continuous"
horizon = 5
states = ["v", "w"]
[dynamics]
v = "-v + w"
w = "-w/2"
[noise]
diffusion = { v = 0.1, w = "0.5*sqrt(2/2)" }
[initial]
gaussian = { mean = [0, 0], std = [0, 0.5] }
[[stay]]
box = { v = [-1.5, 1.5] }
"""


def density(one, omega):
    """Two-sided spectral density of the output, from its state equations."""
    shape, eye = one.shape, np.eye(len(one.states))
    response = [np.linalg.solve(1j * w * eye - shape.rate, shape.noise)[0] for w in omega]
    return np.abs(response) ** 2


def plant(one, **options):
    return cb.ContinuousSystem(lambda x, w: [-x[0] + w], states=["v"], filters=[one], **options)


@pytest.mark.parametrize("one", NOISES.values(), ids=list(NOISES))
def test_the_stationary_covariance_solves_lyapunovs_equation_and_the_samples_keep_it(one):
    a, b, p = one.shape.rate, one.shape.noise, one.covariance
    np.testing.assert_allclose(a @ p + p @ a.T + np.outer(b, b), 0, atol=1e-14)
    step, noise = one.shape.sampled()
    np.testing.assert_allclose(step @ p @ step.T + noise @ noise.T, p, rtol=1e-13, atol=1e-14)
    assert np.all(np.linalg.eigvals(a).real < 0)


@pytest.mark.parametrize("length", [1e-6, 1e6])
def test_samples_are_right_where_a_step_is_long_or_short_against_the_filter(length):
    one = cb.Filter("von_karman", state="w", axis="v", std=1, length=length, speed=1)
    _, noise = one.shape.sampled()
    p, spread = one.covariance, noise @ noise.T
    if length < 1:
        np.testing.assert_allclose(spread, p, rtol=1e-12)
    else:  # the step is B B' to first order, which P - F P F' would lose in the lagged states
        np.testing.assert_allclose(spread[0, 0], one.shape.noise[0] ** 2, rtol=1e-4)
        rate = one.shape.rate
        np.testing.assert_allclose(spread[1, 1], (rate[1, 0] * one.shape.noise[0]) ** 2 / 3, rtol=1e-4)


def test_the_standard_deviation_and_the_correlation_are_those_stated():
    for name, one in NOISES.items():
        stated = np.sqrt(2.0 * (one.high - one.low) / 2) if name.startswith("band") else 1.5
        assert np.sqrt(one.covariance[0, 0]) == pytest.approx(stated, rel=1e-14)
    step, _ = NOISES["ou"].shape.sampled()
    assert step[0, 0] == pytest.approx(np.exp(-1 / TAU), rel=1e-14)


def test_spectra_are_those_of_the_specification():
    omega = np.array([0.01, 0.1, 0.3, 1.0, 3.0])
    y, unit = omega * TAU, 1.5**2 * TAU  # one-sided in radians per second: two-sided over pi
    along = unit * 2 / (1 + y**2)
    np.testing.assert_allclose(density(NOISES["ou"], omega), along, rtol=1e-12)
    np.testing.assert_allclose(density(NOISES["dryden u"], omega), along, rtol=1e-12)
    np.testing.assert_allclose(density(NOISES["dryden w"], omega), unit * (1 + 3 * y**2) / (1 + y**2) ** 2, rtol=1e-12)


def test_von_karman_is_within_seven_percent_up_to_what_is_said():
    y = 1.339 * np.geomspace(0.01, 13, 40)
    ratio = density(NOISES["von_karman u"], y / 1.339 / TAU) / (1.5**2 * TAU * 2 / (1 + y**2) ** (5 / 6))
    assert ratio.min() > 0.998
    assert ratio.max() < 1.07
    y = 1.339 * np.geomspace(0.01, 20, 40)
    exact = 1.5**2 * TAU * (1 + 8 / 3 * y**2) / (1 + y**2) ** (11 / 6)
    ratio = density(NOISES["von_karman v"], y / 1.339 / TAU) / exact
    assert ratio.min() > 0.99
    assert ratio.max() < 1.06


def test_a_band_has_its_density_in_the_middle_and_half_of_it_at_the_ends():
    band = density(NOISES["band"], np.array([0.5, np.sqrt(0.4), 0.8]))
    np.testing.assert_allclose(band, [1.0, 2.0, 1.0], rtol=1e-12)
    np.testing.assert_allclose(density(NOISES["band from 0"], np.array([0.0, 0.8])), [2.0, 1.0], rtol=1e-12)


@pytest.mark.parametrize("name", ["ou", "dryden w", "band"])
def test_simulated_outputs_have_the_variance_the_correlation_and_the_spectrum(name):
    one, horizon, count = NOISES[name], 40.0, 4000
    problem = cb.Problem(plant(one), initial=[0.0], safe=[], horizon=horizon)
    paths = cb.sample_paths(problem, paths=count, rng=np.random.default_rng(0), points=200)[:, :, 1]
    variance, lag = one.covariance[0, 0], 0.2
    seen = np.mean(paths**2, axis=0)
    np.testing.assert_allclose(seen, variance, rtol=6 * np.sqrt(2 / count))
    lags = 20
    from scipy.linalg import expm

    correlation = (expm(one.shape.rate * lag * lags) @ one.covariance)[0, 0]
    assert np.mean(paths[:, lags:] * paths[:, :-lags]) == pytest.approx(correlation, abs=0.04 * variance)
    times = np.arange(paths.shape[1]) * lag
    for omega in (0.3, 0.7):
        found = np.mean(np.abs(np.trapezoid(paths * np.exp(-1j * omega * times), times, axis=1)) ** 2) / horizon
        around = np.linspace(omega - 1, omega + 1, 4001)  # a window of 40 s sees the spectrum through its own
        seen_through = horizon * np.sinc((around - omega) * horizon / 2 / np.pi) ** 2 / (2 * np.pi)
        expected = np.trapezoid(density(one, around) * seen_through, around)
        assert found == pytest.approx(expected, rel=0.1)


def test_a_file_with_a_filter_is_the_file_that_states_it_by_hand(tmp_path):
    problem, plain = loads(TEXT), loads(BY_HAND)
    assert same(problem, plain)
    assert ("filter", "w = ou (std 0.5, time 2)") in problem.rows()
    save(problem, tmp_path / "own.toml")
    kept = load(tmp_path / "own.toml", s=1)
    assert kept.initial.covariance[1, 1] == 1
    assert 'kind = "ou"' in (tmp_path / "own.toml").read_text()
    save(problem.replace(delta=0.01), tmp_path / "plain.toml")
    assert same(load(tmp_path / "plain.toml").replace(delta=1e-3), problem)


def test_python_says_the_same_as_a_file():
    ou = cb.Filter("ou", state="w", std=0.5, time=2)
    for f in (lambda x, w: [-x[0] + w], lambda v, w: -v + w, lambda x: [-x[0] + x[1]]):
        system = cb.ContinuousSystem(f, states=["v"], diffusion=0.1, filters=[ou])
        box = cb.Box([-1.5], [1.5], coordinates=(0,))
        problem = cb.Problem(system, initial=[0], safe=[cb.Inside(box, label="-1.5 <= v <= 1.5")], horizon=5)
        assert same(problem, loads(TEXT))


def test_verdicts_certificates_and_reports_are_of_the_system_with_its_filters():
    problem = loads(TEXT)
    verdict = cb.verify_safety(problem, method="linear")
    by_hand = cb.verify_safety(loads(BY_HAND), method="linear")
    assert verdict.log10_delta == pytest.approx(by_hand.log10_delta, abs=1e-6)
    assert check_data(parse(certificate_text(problem, verdict)), problem_data(problem)).valid
    page = report_page(problem, verdict)
    assert "filter ou" in page
    assert "starts from its stationary law" in page


def test_noise_that_depends_on_the_state_keeps_its_columns():
    ou = cb.Filter("ou", state="w", std=0.5, time=2)
    system = cb.ContinuousSystem(lambda x, w: -x[0] + w, states=["v"], diffusion=lambda x: [[x[0], x[1]]], filters=[ou])
    from certbound.problem.model import compile_numpy

    matrix = compile_numpy(system.diffusion)(0.0, 3.0, 4.0).reshape(system.diffusion.shape)
    np.testing.assert_allclose(matrix, [[3, 4, 0], [0, 0, 0.5]])


def test_starts_may_give_the_filters_states_too():
    gust = '[[noise.filter]]\nstate = "g"\nkind = "dryden"\naxis = "v"\nstd = 1\nlength = 1\nspeed = 1\n'
    two = changed(changed(TEXT, '"-v + w"', '"-v + w + g"'), "[initial]", gust + "[initial]")

    def start(text):
        return loads(changed(two, "point = [0]", text)).initial

    mixed = start("point = { v = 1, w = 0.5 }")
    assert mixed.mean.tolist() == [1, 0.5, 0, 0]
    assert mixed.covariance.diagonal().tolist() == pytest.approx([0, 0, 1, 0.25])
    assert start("point = { v = 1, w = 0.5, g = 0, g_2 = 0.1 }").middle.tolist() == [1, 0.5, 0, 0.1]
    assert start("point = [1, 0, 0, 0]").is_point
    assert start("gaussian = { mean = [1], std = 0.1 }").covariance.diagonal().tolist() == pytest.approx(
        [0.01, 0.25, 1, 0.25]
    )
    with pytest.raises(ValueError, match=r"`initial.point` must give every state, g_2 is missing"):
        start("point = { v = 1, g = 0 }")
    with pytest.raises(ValueError, match=r"must be a point or normal where filters start stationary, got a Box"):
        start("box = [[-1, 1]]")


def test_lists_by_state_may_leave_the_filters_out():
    limits = ("polytope = { A = [[1]], b = [1.5] }", "ball = { center = [0], radius = 1.5 }", "box = [[-1.5, 1.5]]")
    for limit in limits:
        safe = loads(changed(TEXT, "box = { v = [-1.5, 1.5] }", limit)).safe[0]
        assert safe.satisfied([[1.4, 9.0], [1.6, 0.0]]).tolist() == [True, False]
    gust = loads(TEXT + "[[stay]]\nbox = { w = [-2, 2] }\n")
    assert gust.safe[1].satisfied([0.0, 2.1]).tolist() is False


def test_in_discrete_time_an_ou_filter_is_an_exact_autoregression():
    ou = cb.Filter("ou", state="w", std=0.5, time=5)
    for noise, own in ((None, 0.0), (cb.Gaussian(std=0.1), 0.1), (cb.Gaussian(covariance=[[0.01]]), 0.1)):
        system = cb.DiscreteSystem(lambda x, w: 0.8 * x[0] + w, states=["v"], noise=noise, filters=[ou])
        spread = system.noise_matrix @ system.noise.proxy @ system.noise_matrix.T
        np.testing.assert_allclose(np.sqrt(spread.diagonal()), [own, 0.5 * np.sqrt(1 - np.exp(-2 / 5))])
    with pytest.raises(ValueError, match=r"must be cb.Gaussian\(...\) beside filters"):
        cb.DiscreteSystem(lambda x, w: w, states=["v"], noise=cb.Uniform(halfwidth=1), filters=[ou])


@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_an_actuator_follows_its_input_with_a_lag(time):
    lag = cb.Filter("actuator", state="force", time=0.5)
    build = cb.ContinuousSystem if time == "continuous" else cb.DiscreteSystem
    system = build(lambda x, force: [force], states=["v"], inputs=cb.Box([-1], [1]), filters=[lag])
    problem = cb.Problem(system, initial=cb.Box([1], [2]), safe=[], horizon=1, plan=lambda x: -0.5 * x[0])
    assert (problem.initial.low.tolist(), problem.initial.high.tolist()) == ([1, 0], [2, 0])
    from certbound.problem.model import compile_numpy

    moved = compile_numpy(problem.closed_loop)(0.0, 1.5, 0.1)[1]
    kept = np.exp(-2)
    assert moved == pytest.approx((-0.75 - 0.1) * 2 if time == "continuous" else kept * 0.1 - (1 - kept) * 0.75)
    with pytest.raises(ValueError, match=r"`input` of the filter 'force' must be an input, among a, b; got None"):
        build(lambda x, u: u, states=2, inputs=cb.Box([0, 0], [1, 1]), input_names=["a", "b"], filters=[lag])
    away = build(lambda x, force: [force], states=["v"], inputs=cb.Box([1], [2]), filters=[lag])
    with pytest.raises(ValueError, match="`initial` must give 'force', the lag of 'u', where 0 is no value of that"):
        cb.Problem(away, initial=[0], safe=[], horizon=1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": "dryde"}, "`kind` must be a kind of filter, got 'dryde'; did you mean 'dryden'?"),
        ({"std": -1}, "`std` must not be negative, got -1"),
        ({"time": 0}, "`time` must be positive, got 0"),
        ({"time": None}, "`time` must be given for the filter 'w': 'ou' wants std, time"),
        ({"axis": "u"}, "`axis` must be omitted for 'ou', which is stated by std and time"),
        ({"time": 1e-60}, "must lie between 1e-50 and 1e+50"),
        ({"state": "2w"}, "`state` must be identifiers"),
        ({"kind": "dryden", "time": None, **GUST, "axis": "x"}, "`axis` must be one of u, v, w, got 'x'"),
        ({"kind": "band", "std": None, "time": None, "density": 1, "low": 2, "high": 1}, "`low` must be below `high`"),
    ],
)
def test_what_is_no_filter_is_told(change, said):
    with pytest.raises(ValueError) as told:
        cb.Filter(**({"kind": "ou", "state": "w", "std": 1, "time": 1} | change))
    assert said in str(told.value)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('std = "s"', "std = -1", "`noise.filter.0.std` must not be negative, got -1"),
        ('state = "w"', 'state = "v"', "`noise.filter` must not use the name 'v', which is taken"),
        ('state = "w"', 'state = "s"', "`noise.filter` must not use the name 's', which is taken"),
        ('"-v + w"', '"-v"', "`filters` must not hold 'w', which nothing uses"),
        ('"-v + w"', '"-v + w"\nw = "0"', "`dynamics.w` must be omitted, [[noise.filter]] gives it"),
        ('v = "-v + w"', "A = [[1]]", "`dynamics.A` must be omitted beside [[noise.filter]]"),
        ("[noise]", '[definitions]\nw = "v"\n[noise]', "`definitions` must not use the name 'w', which is taken"),
        ("point = [0]", "point = [0, 0, 0]", "`initial.point` must have 2 or 1 entries, got 3"),
        ("time = 2", "time = 2\nwidth = 1", "unknown key 'width' in [[noise.filter]]"),
    ],
)
def test_faults_of_files_are_told_where_they_stand(old, new, said):
    with pytest.raises(ValueError) as told:
        loads(changed(TEXT, old, new))
    assert said in str(told.value)


def test_faults_in_python_are_told():
    ou = cb.Filter("ou", state="w", std=1, time=1)
    with pytest.raises(TypeError, match=r"`filters` must be a list of cb.Filter, got \['w'\]"):
        cb.ContinuousSystem(lambda x: x, states=1, filters=["w"])
    with pytest.raises(ValueError, match="`filters` must be distinct"):
        cb.ContinuousSystem(lambda x: x[:1], states=1, filters=[ou, ou])
    with pytest.raises(ValueError, match="`filters` must come with a function"):
        cb.linear_system([[-1.0]], filters=[ou])
    with pytest.raises(ValueError, match=r"`dynamics` must return 1 values, one per state \(v\), without those of"):
        cb.ContinuousSystem(lambda x: x, states=["v"], filters=[ou])
    with pytest.raises(ValueError, match=r"`initial` must have 1 entries, or 2 with those of the filters \(w\), got 3"):
        cb.Problem(plant(ou), initial=[0, 0, 0], safe=[], horizon=1)
    import control

    block = control.ss([[-1.0]], [[1.0]], [[1.0]], 0)
    with pytest.raises(ValueError, match="got a python-control system"):
        cb.ContinuousSystem(block, filters=[ou])
    lag = cb.Filter("actuator", state="f", time=1)
    lagged = cb.ContinuousSystem(lambda x, f: f, states=["v"], inputs=cb.Box([-1], [1]), filters=[lag])
    with pytest.raises(ValueError, match="must be a point, a box or normal beside filters, got a Ball"):
        cb.Problem(lagged, initial=cb.Ball([0], 1), safe=[], horizon=1)
    two = cb.Problem(lagged, initial=[cb.Box([0], [1]), cb.Box([2], [3])], safe=[], horizon=1)
    assert [member.high.tolist() for member in two.initial.members] == [[1, 0], [3, 0]]
    with pytest.raises(ValueError, match="got a StartUnion"):
        cb.Problem(plant(ou), initial=[cb.Box([0], [0]), cb.Box([1], [1])], safe=[], horizon=1)


def test_every_kind_is_documented():
    for kind in KINDS:
        assert f'"{kind}"' in (cb.Filter.__doc__ or "")
