"""Transfer functions as state equations."""

import control
import numpy as np
import pytest

import certbound as cb
from certbound.problem.adapters.control import linear_model
from certbound.problem.model import compile_numpy

SEVERAL = control.tf(
    [[[1], [2, 1], [4]], [[3, 1, 1], [0], [1]]], [[[1, 2], [1, 2, 3], [2]], [[2, 2, 3], [1], [2, 2, 3]]],
    inputs=["force", "wind", "lift"], outputs=["height", "angle"],
)  # fmt: skip


@pytest.mark.parametrize("system", [
    SEVERAL, control.tf([1], [1, 0.5, 1]), control.tf([2, 1], [4, 3], 0.1), control.zpk([-1], [-2, -3, -3], 5),
])  # fmt: skip
def test_a_realization_has_the_transfer_function_that_it_was_made_of(system):
    model = linear_model(system)
    for point in (0.3j, 1.7j, 2 + 1j):
        found = model.C @ np.linalg.solve(point * np.eye(len(model.A)) - model.A, model.B) + model.D
        np.testing.assert_allclose(found, np.reshape(system(point), found.shape), rtol=1e-12)


def test_the_outputs_are_states_and_keep_their_names():
    system = cb.from_control(SEVERAL)
    assert system.states == ("height", "height_2", "height_3", "angle", "angle_2")
    assert system.input_names == ("force", "wind", "lift")
    assert linear_model(SEVERAL).C.tolist() == [[1, 0, 0, 0, 0], [0, 0, 0, 1, 0]]
    single = cb.from_control(control.tf([1], [1, 0.5, 1]))
    np.testing.assert_allclose(compile_numpy(single.dynamics)(0, 2.0, 3.0, 7.0), [-0.5 * 2 + 3, -2 + 7])


def test_noise_on_the_inputs():
    model = control.ss([[0, 1], [-1, -1]], [[0, 1], [2, 3]], np.eye(2), 0)
    np.testing.assert_allclose(cb.from_control(model, input_noise=[0.1, 0.2]).diffusion, [[0, 0.2], [0.2, 0.6]])
    np.testing.assert_allclose(cb.from_control(model, input_noise=0.5).diffusion, [[0, 0.5], [1, 1.5]])
    steps = cb.from_control(control.tf([2], [1, -0.5], 0.1), input_noise=cb.Uniform(halfwidth=0.1))
    assert isinstance(steps.noise, cb.Uniform)
    assert steps.noise_matrix.tolist() == [[2.0]]


@pytest.mark.parametrize(("build", "kind", "message"), [
    (lambda: cb.from_control(control.tf([1, 2, 3], [1, 1])), ValueError, "must be proper, got degree 2 over 1"),
    (lambda: cb.from_control(control.tf([1], [2])), ValueError, "has no states"),
    (lambda: cb.from_control(control.tf([1], [1, 2]), input_noise=1, diffusion=1), ValueError, "`diffusion` must be"),
    (lambda: cb.from_control(control.tf([1], [1, 2], 1), input_noise=1), TypeError, "`input_noise` must be a law"),
    (lambda: cb.from_control(SEVERAL, input_noise=[1, 2]), ValueError, "`input_noise` must have 3 entries"),
    (lambda: cb.from_control(control.nlsys(lambda t, x, u, params: -x, states=1, inputs=1), input_noise=1), ValueError,
     "`input_noise` is for linear models"),
])  # fmt: skip
def test_what_does_not_fit_is_refused(build, kind, message):
    with pytest.raises(kind, match=message):
        build()
