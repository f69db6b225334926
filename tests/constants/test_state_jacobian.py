"""State Jacobians over boxes: mean-value forms enclose, angles are folded, affine coordinates reduced to ends."""

from __future__ import annotations

import numpy as np

from certbound.constants.state_jacobian import StateJacobian
from certbound.problem.model.tracing import trace
from certbound.rigor.intervals import Interval


def jacobian_of(function, low, high, states=2) -> StateJacobian:
    names = [f"x{k}" for k in range(states)]
    tape = trace(function, {"t": ["t"], "x": names, "u": ["u"]})
    return StateJacobian(tape, range(1, states + 1), Interval(low, high))


def bend(t, x, u):
    return [np.sin(x[0]) * x[1] + u[0] * x[0], np.tanh(x[1]) - x[0] * x[1] ** 2]


def test_only_what_the_jacobian_depends_on_is_a_coordinate():
    assert jacobian_of(lambda t, x, u: [x[1] + u[0], -x[1]], [0, -1, -1, -5], [1, 1, 1, 5]).active == ()
    assert jacobian_of(bend, [0, -1, -1, -5], [1, 1, 1, 5]).active == (1, 2, 3)


def test_enclosures_and_mean_value_forms_contain_the_jacobian():
    rng = np.random.default_rng(0)
    jacobian = jacobian_of(bend, [0, -2, -2, -5], [1, 2, 2, 5])
    centre, width = rng.uniform(-1, 1, (50, 3)), 10 ** rng.uniform(-4, 0, (50, 3))
    boxes = Interval(centre - width, centre + width)
    direct = jacobian.enclose(boxes)
    middle, spread = jacobian.spread(boxes)
    for _ in range(50):
        points = centre + rng.uniform(-1, 1, centre.shape) * width
        values = jacobian.values(points)
        assert np.all((direct.lo - 1e-12 <= values) & (values <= direct.hi + 1e-12))
        reach = np.einsum("nk,nkij->nij", spread.reach, spread.slopes.mag)
        assert np.all(np.abs(values - middle.mid) <= reach + 1e-12)


def test_an_angle_is_folded_to_one_period_and_other_coordinates_are_not():
    wide = [0, -np.inf, -np.inf, -1], [1, np.inf, np.inf, 1]
    angle = jacobian_of(lambda t, x, u: [np.sin(2 * x[0] - x[1]), np.cos(x[1]) - x[0]], *wide)
    assert np.isfinite(angle.box.lo).all()
    assert 6.28318530717958 < angle.box.hi[0] - angle.box.lo[0] < 6.2831854
    for function in (
        lambda t, x, u: [np.sin(0.5 * x[0]), 0.0 * x[1]],
        lambda t, x, u: [np.sin(x[0]) * x[0], x[1]],
        lambda t, x, u: [np.sin(x[0]) + np.where(x[0] > 3.5, 1.0, 0.0), x[1]],
        lambda t, x, u: [np.sin(x[0]) * np.sqrt(x[0]), x[1]],
    ):
        assert jacobian_of(function, *wide).box.lo[0] == -np.inf
    turned = jacobian_of(lambda t, x, u: [np.cos(x[0]), x[1] / np.cos(x[0])], *wide)
    assert np.isfinite(turned.box.lo[0])
    assert np.isinf(turned.box.lo[1])


def test_affine_coordinates_are_reduced_to_their_ends():
    box = [0, -1, -1, -5], [1, 2, 1, 5]
    affine = jacobian_of(lambda t, x, u: [u[0] * x[0] * x[1], np.sin(x[1]) * x[0]], *box)
    starts = affine.starts()
    column = affine.active.index(3)
    assert sorted(set(starts.lo[:, column])) == [-5.0, 5.0]
    assert np.array_equal(starts.lo[:, column], starts.hi[:, column])
    assert starts.width[:, affine.active.index(2)].max() > 1.9
    for function in (
        lambda t, x, u: [u[0] ** 2 * x[0], x[1]],
        lambda t, x, u: [np.sign(u[0]) * x[0] + u[0] * x[1], x[1]],
        lambda t, x, u: [u[0] * x[0] + 1 / (u[0] + 9), x[1]],
        lambda t, x, u: [abs(u[0]) * x[0], x[1]],
    ):
        assert len(jacobian_of(function, *box).starts()) == 1
    unbounded = jacobian_of(lambda t, x, u: [u[0] * x[0], x[1]], [0, -1, -1, -np.inf], [1, 2, 1, np.inf])
    assert len(unbounded.starts()) == 1


def test_an_unbounded_entry_is_explained():
    jacobian = jacobian_of(lambda t, x, u: [x[0] ** 3, x[1]], [0, -np.inf, -1, 0], [1, np.inf, 1, 1])
    text = jacobian.explain(Interval([1.0], [np.inf]))
    assert text == "entry d f_x0 / d x0 = (3 * x0**2) on x0 in [1, inf]"
