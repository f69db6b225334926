"""The recheck proves what it returns, refuses what is 1 % wrong, and its two routes agree."""

from __future__ import annotations

import flint
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from certbound.constants import recheck
from certbound.constants.jacobians.affine import AffineSet, SectorSet
from certbound.constants.jacobians.jacobian_sets import IntervalMatrixSet, UnionSet
from certbound.constants.programs.centers import center_metric
from certbound.constants.programs.sectors import contraction_value, lmi_blocks
from certbound.constants.recheck import certify_gain, certify_rate, holds_gain, holds_rate
from certbound.errors import EnclosureError
from tests.constants.chain_matrices import chain_sector


def random_metric(rng: np.random.Generator, n: int, spread: float = 2.0) -> np.ndarray:
    factor = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-spread / 2, spread / 2, n)
    metric = factor @ factor.T + 1e-3 * np.eye(n)
    return (metric + metric.T) / 2


def chain_metric(masses: int, *, continuous: bool = False) -> np.ndarray:
    blocks = lmi_blocks(chain_sector(masses, continuous=continuous), form="sector")
    metric = center_metric(blocks, continuous=continuous, tolerance=1e-3).metric
    return (metric + metric.T) / 2


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 6))
def test_certified_values_bound_every_member_and_are_tight_at_a_vertex(seed, n):
    rng = np.random.default_rng(seed)
    members = AffineSet(
        center=rng.normal(size=(n, n)), terms=rng.normal(size=(2, n, n)), low=[-0.5, 0.0], high=[0.5, 1.0]
    )
    metric = random_metric(rng, n)
    inside = np.concatenate([members.sample(rng, 20), members.vertices()])
    for certify, continuous in ((certify_rate, True), (certify_gain, False)):
        reached = contraction_value(metric, inside, continuous=continuous)
        certified = certify(metric, members)
        size = 1 + np.linalg.norm(inside, axis=(1, 2)).max() * np.linalg.cond(metric)
        assert certified >= reached - 1e-13 * size
        assert certified <= reached + 1e-10 * size


@pytest.mark.parametrize(
    ("certify", "matrix", "value"),
    [
        (certify_rate, [[-3.0]], -3.0),
        (certify_gain, [[-3.0]], 3.0),
        (certify_rate, [[0.0, 1.0], [-1.0, 0.0]], 0.0),
        (certify_gain, [[0.0, 0.5], [-0.5, 0.0]], 0.5),
        (certify_rate, [[-2.0, 0.0], [0.0, -1.0]], -1.0),
        (certify_gain, np.zeros((2, 2)), 0.0),
    ],
)
def test_closed_forms_in_the_identity_metric(certify, matrix, value):
    found = certify(np.eye(len(matrix)), matrix)
    assert value <= found <= value + 1e-13
    if certify is certify_gain:
        assert found > 0


def test_a_number_one_percent_too_small_is_refused():
    metric, members = chain_metric(3), chain_sector(3)
    gain = certify_gain(metric, members)
    assert gain < 0.9907
    assert holds_gain(metric, members, gain)
    assert not holds_gain(metric, members, gain * (1 - 1e-9))
    assert not holds_gain(metric, members, 0.99 * gain)
    slow = chain_sector(3, continuous=True)
    metric = chain_metric(3, continuous=True)
    rate = certify_rate(metric, slow)
    assert holds_rate(metric, slow, rate)
    assert not holds_rate(metric, slow, rate - 0.01 * abs(rate))


def test_a_metric_moved_by_one_percent_no_longer_proves_the_gain():
    metric, members = chain_metric(3), chain_sector(3)
    gain = certify_gain(metric, members)
    wrong = metric.copy()
    wrong[0, 0] *= 1.01
    assert not holds_gain(wrong, members, gain)
    assert certify_gain(wrong, members) > gain


@pytest.mark.parametrize("continuous", [False, True])
def test_the_sector_inequality_and_the_vertices_give_nearly_the_same(continuous, monkeypatch):
    members = chain_sector(3, continuous=continuous)
    metric = chain_metric(3, continuous=continuous)
    certify = certify_rate if continuous else certify_gain
    exact = certify(metric, members)
    monkeypatch.setattr(recheck, "VERTEX_WORK", 0.0)
    sector = certify(metric, members)
    assert exact - 1e-12 <= sector <= exact + 1e-3 * abs(1 - exact)
    assert certify(metric, members.affine) == pytest.approx(sector, rel=1e-9)


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("work", [0.0, 1e9])
def test_the_inequality_holds_in_ball_arithmetic(continuous, work, monkeypatch):
    monkeypatch.setattr(recheck, "VERTEX_WORK", work)
    rng = np.random.default_rng(6)
    for _ in range(3):
        metric = random_metric(rng, 3, 4.0)
        low = rng.normal(size=2)
        parts = rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), rng.normal(size=(2, 3))
        members = SectorSet(A=parts[0], B=parts[1], C=parts[2], low=low, high=low + 0.1)
        value = (certify_rate if continuous else certify_gain)(metric, members)
        for delta in members.affine.corners():
            middle = flint.arb_mat(np.diag(delta).tolist())
            A, B, C = (flint.arb_mat(part.tolist()) for part in parts)
            J, P = A + B * middle * C, flint.arb_mat(metric.tolist())
            c = flint.arb(value)
            S = 2 * c * P - (J.transpose() * P + P * J) if continuous else c * c * P - J.transpose() * P * J
            for k in (1, 2, 3):
                minor = flint.arb_mat([[S[i, j] for j in range(k)] for i in range(k)])
                assert not minor.det() < 0


@pytest.mark.parametrize("continuous", [False, True])
def test_the_sector_inequality_bounds_every_member_in_any_metric(continuous, monkeypatch):
    monkeypatch.setattr(recheck, "VERTEX_WORK", 0.0)
    rng = np.random.default_rng(5)
    for trial in range(4):
        n, k = 4, 3
        low = rng.normal(size=k)
        members = SectorSet(
            A=rng.normal(size=(n, n)),
            B=rng.normal(size=(n, k)),
            C=rng.normal(size=(k, n)),
            low=low,
            high=low + rng.uniform(0, 1, k) * (np.arange(k) != trial % 4),
            slack=np.full((n, n), 1e-3),
        )
        metric = random_metric(rng, n, 1.0)
        certified = (certify_rate if continuous else certify_gain)(metric, members)
        inside = np.concatenate([members.sample(rng, 100), members.vertices()])
        assert certified >= contraction_value(metric, inside, continuous=continuous) - 1e-12


def test_slack_costs_what_it_must(monkeypatch):
    center = np.diag([-1.0, -2.0])
    plain = AffineSet(center=center, terms=[], low=[], high=[])
    loose = AffineSet(center=center, terms=[], low=[], high=[], slack=np.diag([0.25, 0.0]))
    assert certify_rate(np.eye(2), plain) == pytest.approx(-1.0, abs=1e-14)
    assert certify_rate(np.eye(2), loose) == pytest.approx(-0.75, abs=1e-14)
    sector = SectorSet(A=center, B=np.zeros((2, 1)), C=np.ones((1, 2)), low=[0], high=[1], slack=np.diag([0.25, 0.0]))
    monkeypatch.setattr(recheck, "VERTEX_WORK", 0.0)
    assert -0.75 <= certify_rate(np.eye(2), sector) <= -0.749


def test_interval_matrices_and_unions_are_bounded_member_by_member():
    box = IntervalMatrixSet(low=[[-1.0, 0.0], [0.0, -3.0]], high=[[-1.0, 1.0], [0.0, -2.0]])
    worst = np.linalg.eigvalsh(np.array([[-1.0, 0.5], [0.5, -2.0]]))[-1]
    assert certify_rate(np.eye(2), box) == pytest.approx(worst, abs=1e-13)
    both = UnionSet(members=[box, AffineSet(center=np.eye(2), terms=[], low=[], high=[])])
    assert certify_rate(np.eye(2), both) == pytest.approx(1.0, abs=1e-13)


def test_ten_masses_contract_with_a_thousand_vertices_by_one_inequality():
    members = chain_sector(10)
    lower = 0.9977661652450247
    blocks = lmi_blocks(members, form="sector")
    center = center_metric(blocks, continuous=False, lower=lower, tolerance=2e-5)
    gain = certify_gain((center.metric + center.metric.T) / 2, members)
    assert np.sqrt(lower) <= gain < 0.99890


@pytest.mark.parametrize(
    ("metric", "message"),
    [
        (-np.eye(2), "positive definite"),
        (np.array([[1.0, 0.1], [0.0, 1.0]]), "exactly symmetric"),
        (np.eye(3), "2 x 2"),
        (np.array([[1.0, 1.0], [1.0, 1.0]]), "positive definite"),
        (np.zeros((2, 3)), "square"),
        (np.full((2, 2), np.nan), "finite"),
    ],
)
def test_malformed_metrics_are_refused(metric, message):
    with pytest.raises(ValueError, match=message):
        certify_gain(metric, np.eye(2))


def test_what_cannot_be_proved_is_an_error_or_a_no(monkeypatch):
    monkeypatch.setattr(recheck, "_member_value", lambda *_, **__: np.inf)
    with pytest.raises(EnclosureError, match="no finite contraction bound"):
        certify_gain(np.eye(2), np.eye(2))
    assert not holds_gain(np.eye(2), np.eye(2), 2.0)
