"""Laws by tables: their samples and moments, their proxies, files, certificates, and tables that are refused."""

import numpy as np
import pytest
from scipy.stats import kstest, laplace, triang

import certbound as cb
from certbound.checker import check_data, parse
from certbound.errors import CertificateError, InfeasibleError
from certbound.problem.files import load, save

LOST = cb.Discrete(values=[-0.9, 0.1], probabilities=[0.1, 0.9], scale=[0.5, 0.2])
SKEWED = cb.Histogram(edges=[-1.0, 0.0, 2.0], probabilities=[2 / 3, 1 / 3], scale=0.1)
ALL = [LOST, SKEWED, cb.Triangular(halfwidth=[0.5, 0.2]), cb.Laplace(scale=[0.1, 0.2])]


def moments(law):
    """Exact standard deviation and fourth moment of z."""
    match law:
        case cb.Discrete():
            return [float(np.sum(law.probabilities * law.values**k)) for k in (1, 2, 4)]
        case cb.Histogram():
            weights, edges = law.probabilities / np.diff(law.edges), law.edges
            return [float(np.sum(weights * np.diff(edges ** (k + 1)) / (k + 1))) for k in (1, 2, 4)]
        case cb.Triangular():
            return [0.0, 1 / 6, 1 / 15]
    return [0.0, 2.0, 24.0]


def walk(law, states=2, horizon=6, delta=0.2):
    system = cb.DiscreteSystem(lambda x: 0.8 * x + 0.05 * np.sin(x), states=states, noise=law)
    safe = [cb.Inside(cb.Box([-1.0] * states, [1.0] * states))]
    return cb.Problem(system, initial=[0.0] * states, safe=safe, horizon=horizon, delta=delta)


@pytest.mark.parametrize("law", ALL, ids=lambda law: law.name)
@pytest.mark.parametrize("compiled", [False, True])
def test_samples_have_the_moments_of_the_law(law, compiled):
    full = law.resolve(2)
    if compiled:
        system = cb.DiscreteSystem(lambda x: 0 * x, states=2, noise=law)
        problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-9, -9], [9, 9]))], horizon=1)
        draws = cb.sample_paths(problem, paths=100_000, rng=1)[:, 1]
    else:
        draws = full.sample(np.random.default_rng(1), 100_000)
    z = draws / np.diag(full.factor)
    mean, square, fourth = moments(law)
    assert abs(mean) < 1e-12
    assert np.mean(z, axis=0) == pytest.approx([0, 0], abs=4 * np.sqrt(square / 1e5))
    assert np.mean(z**2, axis=0) == pytest.approx([square] * 2, abs=5 * np.sqrt(fourth / 1e5))
    assert abs(np.corrcoef(z.T)[0, 1]) < 0.015


def test_the_distributions_are_the_stated_ones():
    rng = np.random.default_rng(2)
    assert set(np.unique(LOST.resolve(2).sample(rng, 1000)[:, 0].round(12))) == {-0.45, 0.05}
    assert np.mean(LOST.resolve(2).sample(rng, 100_000)[:, 0] < 0) == pytest.approx(0.1, abs=0.004)
    assert kstest(cb.Laplace(scale=0.3).resolve(1).sample(rng, 20_000)[:, 0], laplace(scale=0.3).cdf).pvalue > 1e-3
    assert kstest(cb.Triangular(halfwidth=0.3).resolve(1).sample(rng, 20_000)[:, 0],
                  triang(0.5, loc=-0.3, scale=0.6).cdf).pvalue > 1e-3  # fmt: skip
    z = SKEWED.resolve(1).sample(rng, 20_000)[:, 0] / 0.1
    assert kstest(z, lambda x: np.interp(x, SKEWED.edges, [0, 2 / 3, 1])).pvalue > 1e-3


@pytest.mark.parametrize("law", ALL[:3], ids=lambda law: law.name)
def test_the_proxy_bounds_the_moment_generating_function(law):
    full = law.resolve(2)
    rows = {
        "discrete": lambda s: np.log(np.sum(law.probabilities * np.exp(s * law.values))),
        "histogram": lambda s: np.log(np.diff(np.exp(s * law.edges)) / np.diff(law.edges) @ law.probabilities / s),
        "triangular": lambda s: 2 * np.log(np.sinh(s / 2) / (s / 2)),
    }
    for k, size in enumerate(np.diag(full.factor)):
        for slope in [*np.linspace(-40, -0.05, 60), *np.linspace(0.05, 40, 60)]:
            assert rows[law.name](slope * size) <= full.proxy[k, k] * slope**2 / 2 + 1e-12
    assert np.all(np.abs(full.sample(np.random.default_rng(0), 10_000)) <= full.bound)


@pytest.mark.parametrize("law", ALL[:3], ids=lambda law: law.name)
def test_certified_bounds_lie_above_simulation_and_are_proved_again(law):
    problem = walk(law)
    verdict = cb.verify_safety(problem, method="linear")
    data = parse(verdict.certificate_text(problem))
    report = check_data(data)
    assert report.valid, report.reason
    assert cb.simulate_exits(problem, paths=50_000, rng=3, halve=False).lower < 10**report.log10_proved < 1


def test_a_forged_table_is_refused():
    problem = walk(SKEWED)
    data = parse(cb.verify_safety(problem, method="linear").certificate_text(problem))
    tables = data["problem"]["noise"]["tables"]
    tables["edges"][2] = (4.0).hex()
    assert not check_data(data).valid
    for name, value, message in (
        ("edges", [(2.0).hex(), (0.0).hex(), (-1.0).hex()], "must rise"),
        ("probabilities", [(0.5).hex(), (0.25).hex()], "must sum to 1"),
        ("probabilities", [(1.5).hex(), (-0.5).hex()], "must not be empty or negative"),
        ("probabilities", [(1.0).hex()], "must have 2 entries, got 3"),
    ):
        forged = {**tables, name: value}
        data["problem"]["noise"]["tables"] = forged
        with pytest.raises(CertificateError, match=message):
            check_data(data)


@pytest.mark.parametrize("law", ALL, ids=lambda law: law.name)
def test_it_is_saved_and_loaded(law, tmp_path):
    save(walk(law), tmp_path / "walk.toml")
    again = load(tmp_path / "walk.toml").system.noise
    assert type(again) is type(law)
    for name in (*law.levels, *law.tables):
        found = getattr(again, name)
        np.testing.assert_array_equal(found, np.broadcast_to(getattr(law, name), found.shape))
    text = (tmp_path / "walk.toml").read_text()
    assert f'law = "{law.name}"' in text


def test_a_table_without_a_scale_is_read(tmp_path):
    save(walk(LOST), tmp_path / "walk.toml")
    text = (tmp_path / "walk.toml").read_text()
    (tmp_path / "walk.toml").write_text(text.replace("scale = [0.5, 0.2]\n", ""))
    np.testing.assert_array_equal(load(tmp_path / "walk.toml").system.noise.scale, [1, 1])


def test_laplace_noise_is_bounded_by_value_functions_alone():
    problem = walk(cb.Laplace(scale=0.1))
    verdict = cb.verify_safety(problem.replace(delta=1e-9), time_limit=60)
    assert verdict.status == "UNSAFE"
    assert verdict.log10_lower <= verdict.log10_delta < 0
    assert "Laplace noise has no variance proxy" in verdict.answers["linear"].reason
    with pytest.raises(InfeasibleError, match="tails are exponential"):
        _ = problem.system.noise.proxy


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: cb.Discrete(values=[-1, 1], probabilities=[0.5, 0.4]), "must sum to 1 within 1e-12, got 0.9"),
        (lambda: cb.Discrete(values=[-1, 1], probabilities=[0.5, 0.5 + 1e-11]), "must sum to 1 within 1e-12"),
        (lambda: cb.Discrete(values=[0, 1], probabilities=[0.5, 0.5]), "must have mean 0 .* got 0.5; subtract"),
        (lambda: cb.Discrete(values=[-1, 1], probabilities=[1.5, -0.5]), "must not be negative"),
        (lambda: cb.Discrete(values=[1, -1], probabilities=[0.5, 0.5]), "`values` must rise"),
        (lambda: cb.Discrete(values=[-1, 1], probabilities=[1.0]), "one for each of `values`, got 1 for 2"),
        (lambda: cb.Histogram(edges=[-1, 1], probabilities=[0.5, 0.5]), "one for each of `edges` but one, got 2 for 2"),
        (lambda: cb.Histogram(edges=[-1, 0, 1], probabilities=[0.5, 0.49]), "must sum to 1"),
        (lambda: cb.Histogram(edges=np.linspace(-1, 1, 202), probabilities=np.full(201, 1 / 201)),
         "at most 200 entries, since every draw .* goes through all of them, got 201; join neighbouring bins"),
        (lambda: cb.Discrete(values=np.linspace(-1, 1, 201), probabilities=np.full(201, 1 / 201)),
         "at most 200 entries, since .*, got 201; round values to fewer"),
        (lambda: cb.Histogram(edges=[-1, 0, 2], probabilities=[0.5, 0.5]), "must have mean 0"),
        (lambda: cb.Histogram(edges=[-1, -1, 1], probabilities=[0.5, 0.5]), "`edges` must rise"),
        (lambda: cb.Triangular(halfwidth=-1), "`halfwidth` must not be negative"),
        (lambda: cb.Laplace(scale=-1), "`scale` must not be negative"),
    ],
)
def test_bad_tables_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
