"""A noise law is added by its class and its row in the checker: the arc sine law, defined here, does all the rest."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.special import i0
from scipy.stats import arcsine, kstest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.checker.statement import laws
from certbound.errors import CertificateError
from certbound.problem.files import load, save
from certbound.problem.noise import LAWS, BoxLaw, Law
from certbound.simulation.estimates import simulate_rare_exits
from certbound.values.discrete.shocks import Inapplicable, shocks_of


@dataclass(frozen=True, eq=False, kw_only=True)
class ArcSine(BoxLaw):
    """Independent entries h_i sin(phase) with a phase that is uniform: the density is 1/(pi sqrt(h_i^2 - w^2)).

    E exp(l w) = I_0(l h) = sum of (l h/2)^(2k)/k!^2 <= exp(l^2 h^2/4), so that h^2/2 is a proxy: the variance.
    """

    halfwidth: Any

    name = "arcsine"
    levels = ("halfwidth",)
    variate = "uniform"

    @property
    def proxy(self) -> np.ndarray:
        return super().proxy / 2

    def unit(self, v):
        return np.sin(0.5 * np.pi * v)


ROW = laws.Law(levels=("halfwidth",), proxies=lambda squares, data: [square / 2 for square in squares],
               bounded=True)  # fmt: skip
"""The checker's row: what it proves itself."""


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(laws.LAWS, "arcsine", ROW)


del LAWS["arcsine"]  # for other tests there is no such law


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    before = dict(LAWS)
    LAWS["arcsine"] = ArcSine
    yield
    LAWS.clear()
    LAWS.update(before)


def walk(law: Law, states: int = 1, horizon: int = 10, delta: float = 0.2) -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: 0.8 * x + 0.05 * np.sin(x), states=states, noise=law)
    safe = [cb.Inside(cb.Box([-1.0] * states, [1.0] * states))]
    return cb.Problem(system, initial=[0.0] * states, safe=safe, horizon=horizon, delta=delta)


def test_its_proxy_bounds_the_moment_generating_function():
    h, proxy = 0.7, ArcSine(halfwidth=0.7).resolve(1).proxy[0, 0]
    slopes = np.linspace(0.01, 60, 400)
    assert np.all(np.log(i0(slopes * h)) <= proxy * slopes**2 / 2)
    assert proxy == pytest.approx(h**2 / 2, rel=1e-15)


@pytest.mark.parametrize("compiled", [False, True])
def test_it_is_drawn_by_numpy_and_in_kernels_as_its_class_says(compiled):
    law, h = ArcSine(halfwidth=[0.5, 0.2]), np.array([0.5, 0.2])
    if compiled:
        system = cb.DiscreteSystem(lambda x: 0 * x, states=2, noise=law)
        everywhere = [cb.Inside(cb.Box([-9, -9], [9, 9]))]
        problem = cb.Problem(system, initial=[0, 0], safe=everywhere, horizon=1)
        draws = cb.sample_paths(problem, paths=50_000, rng=1)[:, 1]
    else:
        draws = law.resolve(2).sample(np.random.default_rng(1), 50_000)
    assert np.all(np.abs(draws) <= h)
    assert abs(np.corrcoef(draws.T)[0, 1]) < 0.02
    for entry, width in zip(draws.T, h):
        assert kstest(entry, arcsine(loc=-width, scale=2 * width).cdf).pvalue > 1e-3


@pytest.mark.parametrize("method", ["linear", "constants"])
def test_its_certified_bound_lies_above_its_simulation_and_is_proved_again(known, method):
    problem = walk(ArcSine(halfwidth=0.3))
    verdict = cb.verify_safety(problem, method=method)
    exits = cb.simulate_exits(problem, paths=100_000, rng=2, halve=False)
    rare = simulate_rare_exits(problem, rng=3)
    assert 0 < max(exits.lower, rare.lower) < 10**verdict.log10_delta < 1
    assert verdict.log10_delta < cb.verify_safety(walk(cb.Bounded(halfwidth=0.3)), method=method).log10_delta
    result = check_data(parse(verdict.certificate_text(problem)))
    assert result.valid, result.reason
    assert exits.lower < 10**result.log10_proved < 1


def test_it_is_saved_and_loaded_under_its_name(tmp_path):
    save(walk(ArcSine(halfwidth=[0.5, 0.2]), states=2), tmp_path / "walk.toml")
    loaded = load(tmp_path / "walk.toml").system.noise
    assert isinstance(loaded, ArcSine)
    np.testing.assert_array_equal(loaded.halfwidth, [0.5, 0.2])
    assert 'law = "arcsine"' in (tmp_path / "walk.toml").read_text()


def test_without_a_row_the_checker_refuses_it():
    problem = walk(ArcSine(halfwidth=0.1))
    text = cb.verify_safety(problem, method="linear").certificate_text
    with pytest.raises(CertificateError, match=r"`problem\.noise\.law` must be one of gaussian, .*got \"arcsine\""):
        check_data(parse(text(problem)))


def test_the_row_alone_decides_what_is_proved(known, monkeypatch):
    problem = walk(ArcSine(halfwidth=0.3))
    data = parse(cb.verify_safety(problem, method="linear").certificate_text(problem))
    worse = laws.Law(levels=("halfwidth",), proxies=lambda squares, data: squares)
    monkeypatch.setitem(laws.LAWS, "arcsine", worse)
    assert not check_data(data).valid
    data["problem"]["noise"]["independent"] = True
    with pytest.raises(CertificateError, match="unknown entry `independent`"):
        check_data(data)


def test_value_functions_say_that_they_do_not_apply():
    with pytest.raises(Inapplicable, match=r"exactly Gaussian or uniform so far.*got ArcSine"):
        shocks_of(ArcSine(halfwidth=0.1).resolve(1), np.eye(1))


def test_what_a_law_lacks_is_said_when_its_class_is_defined():
    with pytest.raises(TypeError, match="the law 'bare' must state levels and proxy; Bare does not"):
        type("Bare", (Law,), {"name": "bare"})
    proxied = {"name": "half", "levels": ("level",), "proxy": property(lambda law: np.eye(1))}
    with pytest.raises(TypeError, match="must state factor"):
        type("Half", (Law,), proxied | {"variate": "normal"})
    with pytest.raises(TypeError, match="must state exact_covariance and enclosed_covariance"):
        type("Half", (Law,), proxied | {"gaussian": True})
    with pytest.raises(TypeError, match="`variate` must be one of normal, uniform, sign, got 'cauchy'"):
        type("Half", (BoxLaw,), proxied | {"variate": "cauchy"})
    with pytest.raises(TypeError, match="`name` 'uniform' is that of the law Uniform; give another"):
        type("Other", (BoxLaw,), proxied | {"name": "uniform"})


@pytest.mark.parametrize(
    ("facts", "error", "message"),
    [
        ({}, ValueError, "has no `variate` and cannot be simulated"),
        ({"variate": "normal", "unit": lambda law, v: v[0] if v[0] > 0 else v}, TypeError, "cannot be traced"),
        ({"variate": "normal", "unit": lambda law, v: [v[0], v[0]]}, ValueError, "must keep the shape of `v`"),
    ],
)
def test_a_law_that_cannot_be_drawn_is_not_simulated(facts, error, message):
    made: Any = type("Vague", (ArcSine,), {"name": "vague", **facts})
    with pytest.raises(error, match=message):
        cb.simulate_exits(walk(made(halfwidth=0.1)), paths=10, rng=0)


def test_what_a_law_is_does_not_pass_to_the_classes_made_from_it():
    class Skewed(cb.Uniform):
        """Draws otherwise than its parent, and does not say how."""

    law = Skewed(halfwidth=0.1).resolve(1)
    assert (law.name, law.variate, law.uniform) == ("", "", False)
    with pytest.raises(Inapplicable, match="got Skewed"):
        shocks_of(law, np.eye(1))
    assert not cb.verify_safety(walk(Skewed(halfwidth=0.1)), method="values").log10_delta < 0


def test_a_flag_is_true_or_false():
    with pytest.raises(ValueError, match="`independent` must be true or false, got 'no'"):
        cb.Bounded(halfwidth=0.1, independent="no")
    data = json.loads(json.dumps(cb.Bounded(halfwidth=0.1, independent=False).resolve(1).data()))
    assert data == {"law": "bounded", "halfwidth": [0.1], "independent": False}
