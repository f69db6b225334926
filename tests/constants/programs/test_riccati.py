"""Riccati metrics reach what the spectrum allows, with many states too, and wrong ones certify nothing wrong."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.constants.jacobians import SectorSet, VertexPolytope
from certbound.constants.metrics import model_set
from certbound.constants.model_data import model_of
from certbound.constants.programs import centred, rate_proposals
from certbound.constants.programs import proposals as proposing
from certbound.constants.programs.proposals import Proposal, spectral_bound
from certbound.constants.programs.riccati import least_value, pencil
from certbound.constants.recheck import certify_gain, certify_rate


def random_sector(continuous: bool, n: int = 5, k: int = 2) -> SectorSet:
    """A stable matrix with two small uncertain entries of rank one."""
    rng = np.random.default_rng(3)
    A = rng.normal(size=(n, n))
    if continuous:
        A -= (np.linalg.eigvals(A).real.max() + 1) * np.eye(n)
    else:
        A *= 0.6 / np.abs(np.linalg.eigvals(A)).max()
    return SectorSet(
        A=A, B=0.2 * rng.normal(size=(n, k)), C=0.2 * rng.normal(size=(k, n)), low=-np.ones(k), high=np.ones(k)
    )


@pytest.mark.parametrize("continuous", [True, False])
def test_the_extreme_metrics_solve_their_equations(continuous):
    block, value, multipliers = centred(random_sector(continuous)), -0.5 if continuous else 0.8, np.array([1.0, 2.0])
    found = pencil(block, multipliers, value, continuous=continuous, residual=1e-13)
    A, B, C = block.A, block.B, block.C
    for P in (found.smallest, found.largest):
        known = C.T @ (multipliers[:, None] * C)
        if continuous:
            rest = A.T @ P + P @ A - 2 * value * P + known + P @ (B / multipliers) @ B.T @ P
        else:
            inner = np.linalg.inv(np.diag(multipliers) - B.T @ P @ B)
            rest = A.T @ P @ A - value * P + known + A.T @ P @ B @ inner @ B.T @ P @ A
        assert np.abs(rest).max() < 1e-8 * np.abs(P).max()
    assert np.linalg.eigvalsh(found.largest - found.smallest)[0] > 0


@pytest.mark.parametrize("continuous", [True, False])
def test_every_mean_of_the_extreme_metrics_reaches_the_value(continuous):
    members = random_sector(continuous)
    value = -0.5 if continuous else 0.8
    found = pencil(centred(members), np.ones(2), value, continuous=continuous)
    for share in (1e-3, 0.3, 0.999):
        if continuous:
            assert certify_rate(found.mean(share), members) <= value + 1e-9
        else:
            assert certify_gain(found.mean(share), members) ** 2 <= value + 1e-9


def test_no_metric_is_found_below_the_spectrum():
    members = random_sector(True)
    lower = spectral_bound(members, continuous=True)
    block = centred(members)
    assert pencil(block, np.ones(2), lower - 0.01, continuous=True) is None
    assert least_value(block, np.ones(2), continuous=True, lower=lower, tolerance=1e-3).value > lower


@pytest.mark.parametrize("masses", [8, 40])
def test_the_chain_contracts_as_fast_as_its_spectrum_lets_it(masses):
    members = model_set(model_of(cb.load("chain_rest", masses=masses), None, None))
    lower = np.sqrt(spectral_bound(members, continuous=False))
    (found,) = rate_proposals(members, continuous=False)
    assert found.status == "Riccati equation"
    assert lower <= certify_gain(found.metric, members) <= 1 - 0.99 * (1 - lower)
    assert np.linalg.cond(found.metric) < 300


def spoilt(kind: str, metric: np.ndarray) -> np.ndarray:
    """A proposal that is wrong on purpose."""
    n = len(metric)
    noise = np.random.default_rng(0).uniform(-0.1, 0.1, (n, n))
    return {
        "perturbed": metric * (1 + (noise + noise.T) / 2),
        "indefinite": metric - 2 * np.linalg.eigvalsh(metric)[-1] * np.outer(np.eye(n)[0], np.eye(n)[0]),
        "singular": metric - np.linalg.eigvalsh(metric)[0] * np.eye(n),
        "scaled": 1e12 * metric,
        "badly scaled": metric * np.outer(*(np.where(np.arange(n) % 2, 1e6, 1.0),) * 2),
        "not finite": np.full((n, n), np.nan),
    }[kind]


KINDS = ["perturbed", "indefinite", "singular", "scaled", "badly scaled", "not finite"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_proposal_never_gives_an_uncertified_number(kind, monkeypatch):
    problem = cb.load("chain_rest", masses=6)
    members = model_set(model_of(problem, None, None))
    extremes = VertexPolytope(matrices=members.vertices())
    right = proposing.rate_proposals

    def wrong(*arguments, **options):
        return [Proposal(metric=spoilt(kind, right(*arguments, **options)[0].metric), status="wrong")]

    monkeypatch.setattr("certbound.constants.metrics.rate_proposals", wrong)
    found = cb.bound_constants(problem)
    assert found.certified
    root = np.linalg.cholesky(found.matrix).T
    reached = np.linalg.norm(root @ extremes.vertices() @ np.linalg.inv(root), 2, axis=(1, 2)).max()
    assert found.gain >= reached * (1 - 1e-12)
    if kind in ("indefinite", "singular", "not finite"):
        assert found.metric is None
    if kind == "scaled":
        assert found.gain < 1
