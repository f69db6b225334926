"""Jacobian sets contain what they say, and the structure found on a tape contains every Jacobian."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import certbound as cb
from certbound.constants.jacobians.affine import AffineSet, SectorSet
from certbound.constants.jacobians.jacobian_sets import IntervalMatrixSet, UnionSet, VertexPolytope, as_set
from certbound.constants.jacobians.structure import affine_set
from certbound.constants.metrics import jacobian_set
from certbound.errors import EnclosureError
from certbound.problem.model.derivative import jacobian
from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.tracing import trace
from certbound.rigor.intervals import Interval
from tests.constants.chain_matrices import chain_sector


def make_sets() -> dict[str, object]:
    rng = np.random.default_rng(1)
    center, terms = rng.normal(size=(3, 3)), rng.normal(size=(2, 3, 3))
    affine = AffineSet(center=center, terms=terms, low=[-1, 0], high=[1, 0.5])
    interval = IntervalMatrixSet(low=center - np.eye(3), high=center + np.eye(3))
    return {
        "vertices": VertexPolytope(matrices=rng.normal(size=(4, 3, 3))),
        "affine": affine,
        "slack": AffineSet(center=center, terms=terms, low=[-1, 0], high=[1, 0.5], slack=np.full((3, 3), 0.1)),
        "sector": affine.sector(),
        "interval": interval,
        "union": UnionSet(members=[affine, interval]),
    }


@pytest.mark.parametrize("name", make_sets())
def test_samples_and_vertices_lie_in_the_set_and_far_matrices_do_not(name):
    members = make_sets()[name]
    assert members.contains(members.sample(np.random.default_rng(0), 6), 1e-8).all()
    assert members.contains(members.vertices()[:4], 1e-8).all()
    assert not members.contains(members.vertices()[0] + 10.0)
    assert members.vertex_count == len(members.vertices())


@pytest.mark.parametrize("name", make_sets())
def test_the_support_is_the_largest_value_over_vertices_and_is_never_exceeded_by_samples(name):
    members = make_sets()[name]
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(5, 3, 3))
    support = members.support(directions)
    at = np.einsum("dij,vij->dv", directions, members.sample(rng, 200))
    assert (at <= support[:, None] + 1e-12).all()
    slack = 0.1 * np.abs(directions).sum(axis=(1, 2)) if name == "slack" else 0.0
    corners = np.einsum("dij,vij->dv", directions, members.vertices()).max(axis=1)
    np.testing.assert_allclose(support, corners + slack, rtol=1e-12)


@pytest.mark.parametrize("name", make_sets())
def test_coordinates_of_a_metric_transform_every_member(name):
    members = make_sets()[name]
    metric = np.diag([1.0, 4.0, 9.0])
    root = np.diag([1.0, 2.0, 3.0])
    moved = root @ members.sample(np.random.default_rng(3), 4) @ np.linalg.inv(root)
    assert members.in_metric(metric).contains(moved, 1e-8).all()


def test_the_sector_form_has_one_entry_per_unit_of_rank_and_shares_parameters():
    full = np.array([[1.0, 0.0], [0.0, 1.0]])
    members = AffineSet(center=np.zeros((2, 2)), terms=[full], low=[-1], high=[2]).sector()
    assert members.groups == (0, 0)
    assert members.vertex_count == 2
    assert not members.contains(np.diag([1.0, -1.0]))
    np.testing.assert_array_equal(members.affine.error, 0.0)


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_the_sector_form_of_a_dense_term_differs_by_no_more_than_its_slack(seed):
    rng = np.random.default_rng(seed)
    term = np.outer(rng.normal(size=4), rng.normal(size=4))  # rank one up to rounding
    members = AffineSet(center=np.zeros((4, 4)), terms=[term], low=[-3], high=[1])
    sector = members.sector()
    assert sector.left.shape == (4, 1)
    product = sector.left @ sector.right
    assert (np.abs(3 * product - 3 * term) <= sector.affine.error + 1e-18).all()
    assert sector.affine.error.max() < 1e-13 * max(1.0, np.abs(term).max())


def test_too_many_vertices_are_refused_with_the_cure():
    with pytest.raises(ValueError, match="sector form"):
        chain_sector(20).vertices()


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: VertexPolytope(matrices=np.zeros((2, 2, 3))), "square matrices"),
        (lambda: VertexPolytope(matrices=[[[1.0, 2.0], [3.0]]]), "rectangular"),
        (lambda: VertexPolytope(matrices=[[np.inf]]), "finite"),
        (lambda: VertexPolytope(matrices=np.zeros((0, 2, 2))), "square matrices"),
        (lambda: AffineSet(center=np.eye(2), terms=[np.eye(2)], low=[1], high=[0]), "must not exceed"),
        (lambda: AffineSet(center=np.eye(2), terms=[np.eye(2)], low=[0], high=[np.inf]), "finite"),
        (lambda: AffineSet(center=np.eye(2), terms=[np.eye(2)], low=[0, 0], high=[1, 1]), "one 2 x 2 matrix"),
        (lambda: AffineSet(center=np.eye(2), terms=[], low=[], high=[], slack=-np.eye(2)), "non-negative"),
        (lambda: SectorSet(A=np.eye(2), B=np.eye(3), C=np.eye(2), low=[0, 0], high=[1, 1]), "shapes"),
        (
            lambda: SectorSet(A=np.eye(2), B=np.eye(2), C=np.eye(2), low=[0, 0], high=[1, 2], groups=(0, 0)),
            "equal range",
        ),
        (lambda: IntervalMatrixSet(low=np.eye(2), high=np.zeros((2, 2))), "must not exceed"),
        (lambda: UnionSet(members=[]), "at least one"),
        (lambda: as_set(np.eye(2)).contains(np.eye(3)), "shape"),
        (lambda: as_set(np.eye(2)).in_metric(-np.eye(2)), "positive definite"),
    ],
)
def test_malformed_sets_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


MODELS = {
    "chain": (None, lambda: cb.load("chain_rest").system),
    "pendulum": (
        cb.Box([-1, -2], [1, 2]),
        lambda: cb.ContinuousSystem(lambda x: [x[1], -np.sin(x[0]) - 0.3 * x[1]], states=2, diffusion=np.eye(2)),
    ),
    "lorenz": (
        cb.Box([-2, -3, 0], [2, 3, 5]),
        lambda: cb.ContinuousSystem(
            lambda x: [10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]],
            states=3,
            diffusion=np.eye(3),
        ),
    ),
    "tanh layer": (
        None,
        lambda: cb.DiscreteSystem(
            lambda x: [0.3 * np.tanh(x[0] + 2 * x[1]) + 0.1 * x[0], np.tanh(0.7 * x[0]) / 3 + np.abs(x[1]) / 7],
            states=2,
            noise=cb.Gaussian(std=1.0),
        ),
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_the_affine_set_contains_the_jacobian_at_random_points(name):
    domain, build = MODELS[name]
    system = build()
    members = jacobian_set(system, domain)
    n = system.dimension
    rng = np.random.default_rng(4)
    low, high = (np.full(n, -30.0), np.full(n, 30.0)) if domain is None else (domain.low, domain.high)
    points = rng.uniform(low, high, (40, n)) * rng.uniform(0, 1, (40, 1))
    tape = system.dynamics
    columns = [tape.inputs.index(state) for state in system.states]
    rest = [np.zeros(40)] * (len(tape.inputs) - 1 - n)
    values = np.broadcast_to(compile_numpy(jacobian(tape, columns))(np.zeros(40), *points.T, *rest), (40, n, n))
    assert members.contains(values, 1e-9).all()


def test_entries_that_share_a_number_stay_correlated_and_coefficients_are_exact():
    system = cb.ContinuousSystem(
        lambda x: [0.1 * np.tanh(x[0]) - x[1], 3 * np.tanh(x[0]) + x[1]], states=2, diffusion=np.eye(2)
    )
    members = jacobian_set(system)
    assert len(members.M) == 1
    ratio = members.M[0][1, 0] / members.M[0][0, 0]
    assert ratio == pytest.approx(30.0, rel=1e-15)
    slopes = members.box[:, 0] * members.M[0][1, 0] + members.J0[1, 0]
    np.testing.assert_allclose(np.sort(slopes), [0.0, 3.0], atol=1e-12)


def test_ranges_are_refined_by_bisection_and_never_cut_off_a_value():
    tape = trace(lambda x: [x[0] * (1 - x[0]), 0.0, 0.0, np.sin(x[0]) ** 2 + np.cos(x[0]) ** 2], {"x": ["a"]})
    square = type(tape)(inputs=tape.inputs, nodes=tape.nodes, outputs=tape.outputs, shape=(2, 2))
    members = affine_set(square, [Interval(np.array(0.0), np.array(1.0))])
    top = members.support(np.array([[1.0, 0.0], [0.0, 0.0]]))
    assert 0.25 <= top <= 0.2503
    assert members.support(np.array([[0.0, 0.0], [0.0, 1.0]])) <= 1.002
    assert members.contains([[[0.25, 0.0], [0.0, 1.0]], [[0.0, 0.0], [0.0, 1.0]]]).all()


def test_an_unbounded_jacobian_is_named():
    system = cb.ContinuousSystem(lambda x: [x[1], -(x[0] ** 3)], states=2, diffusion=np.eye(2))
    with pytest.raises(EnclosureError, match="unbounded on the domain"):
        jacobian_set(system)
    assert jacobian_set(system, cb.Box([-1, -1], [1, 1])).vertex_count == 2


def test_a_jump_on_the_domain_is_refused():
    system = cb.ContinuousSystem(lambda x: [-np.sign(x[0]), -x[1]], states=2, diffusion=np.eye(2))
    with pytest.raises(EnclosureError, match="may jump"):
        jacobian_set(system)
    assert jacobian_set(system, cb.Box([1, -1], [2, 1])).vertex_count == 1


def test_constants_that_are_no_floats_go_into_the_slack():
    system = cb.ContinuousSystem(lambda x: [-x[0] * np.sin(0.3) / 3.0], states=1, diffusion=np.eye(1))
    members = jacobian_set(system)
    assert members.vertex_count == 1
    assert 0 < members.error[0, 0] < 1e-15
