"""An observer or a controller in the loop: the same equations as written by hand, and refusals."""

import control
import numpy as np
import pytest

import certbound as cb
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.noise import Law

A, B, C = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.005], [0.1]]), np.array([[1.0, 0.0]])
K, L = np.array([[-2.0, -2.5]]), np.array([[0.4], [0.6]])
POINT = np.array([0.3, -0.7, 0.2, 0.5])


def sampled(noise: Law | None = None, **options):
    return cb.linear_system(
        A, B, time="discrete", states=["p", "v"], noise=cb.Gaussian(std=0.01) if noise is None else noise,
        noise_matrix=[[0], [1]], **options,
    )  # fmt: skip


def swing(**options):
    return cb.ContinuousSystem(
        lambda x, u, d: [x[1], u[0] - np.sin(x[0]) + d[0]], states=["angle", "speed"], inputs=cb.Box([-9], [9]),
        disturbance=cb.Box([0.1], [0.3]), diffusion=[[0], [0.1]], **options,
    )  # fmt: skip


def at(tape: Tape, *values: float) -> np.ndarray:
    return compile_numpy(tape)(*values)


def test_a_linear_loop_is_the_block_matrix_of_the_textbook():
    loop = cb.estimate_loop(sampled(), L, output=C, feedback=lambda x: K @ x, sensor_noise=cb.Gaussian(std=0.02))
    matrix = np.block([[A, B @ K], [L @ C, A + B @ K - L @ C]])
    assert loop.states == ("p", "v", "p_hat", "v_hat")
    np.testing.assert_allclose(at(loop.dynamics, 0, *POINT), matrix @ POINT, rtol=1e-14)
    np.testing.assert_array_equal(loop.noise_matrix, [[0, 0], [1, 0], [0, 0.4], [0, 0.6]])
    np.testing.assert_array_equal(loop.noise.std, [0.01, 0.02])


def test_an_extended_observer_follows_the_nonlinear_plant_and_not_its_disturbance():
    loop = cb.estimate_loop(
        swing(), lambda x: [[2.0], [3 + x[0]]], output=lambda x: np.sin(x[0]), feedback=lambda angle: -4 * angle,
        sensor_diffusion=0.5,
    )  # fmt: skip
    x, z, d = (0.3, -0.2), (0.5, 0.7), 0.15
    u, miss = -4 * z[0], np.sin(x[0]) - np.sin(z[0])
    drift = [x[1], u - np.sin(x[0]) + d, z[1] + 2 * miss, u - np.sin(z[0]) + 0.2 + (3 + z[0]) * miss]
    np.testing.assert_allclose(at(loop.dynamics, 0, *x, *z, d), drift, rtol=1e-14)
    noise = at(loop.diffusion, 0, *x, *z)
    np.testing.assert_allclose(noise, [[0, 0], [0.1, 0], [0, 1.0], [0, 0.5 * 3.5]], rtol=1e-14)


def test_the_model_of_the_observer_may_differ_from_the_plant():
    loop = cb.estimate_loop(
        swing(), [[2], [3]], output=C, feedback=lambda x: -x[0], model=lambda x, u: [x[1], u[0] - x[0]]
    )
    np.testing.assert_allclose(at(loop.dynamics, 0, 0, 0, 0.5, 0.25, 0)[2:], [0.25 - 1, -0.5 - 0.5 - 1.5])


def test_without_noise_anywhere_a_path_of_the_loop_is_python_controls():
    plant = control.ss([[0, 1], [2, 0]], [[0], [1]], [[1, 0]], 0)
    gain, _, _ = control.lqr(plant.A, plant.B, np.eye(2), np.eye(1))
    kalman, _, _ = control.lqe(plant.A, np.eye(2), plant.C, np.eye(2), np.eye(1))
    loop = cb.estimate_loop(cb.from_control(plant), kalman, output=plant.C, feedback=lambda x: -gain @ x)
    regulator = control.ss(plant.A - plant.B @ gain - kalman @ plant.C, kalman, -gain, 0)
    closed = control.feedback(plant, regulator, sign=1)
    rates = [at(loop.dynamics, 0, *row) for row in np.eye(4)]
    np.testing.assert_allclose(np.transpose(rates), closed.A, atol=1e-12)
    direct = cb.estimate_loop(cb.from_control(plant), regulator, output=plant.C)
    assert direct.states == ("x0", "x1", "x0_hat", "x1_hat")
    np.testing.assert_allclose([at(direct.dynamics, 0, *row) for row in np.eye(4)], rates, atol=1e-12)


def test_a_transfer_function_closes_the_loop_of_a_nonlinear_plant():
    lead = control.tf([-20.0, -40.0], [1.0, 20.0])
    loop = cb.estimate_loop(swing(), lead, output=C)
    assert loop.states == ("angle", "speed", "y0")
    np.testing.assert_allclose(at(loop.dynamics, 0, 0.1, 0, 0, 0)[1:], [-2.0 - np.sin(0.1), -20 * -2.0 + 0.1 * -40])
    with pytest.raises(ValueError, match=r"must not pass noisy measurements on .* multiply the controller by a filter"):
        cb.estimate_loop(swing(), lead, output=C, sensor_diffusion=0.01)


def test_an_estimator_that_takes_the_inputs_behind_the_measurements():
    watch = control.nlsys(
        lambda t, x, u, params: [x[1] + 2 * (u[0] - x[0]), u[1] - np.sin(x[0]) + 3 * (u[0] - x[0])],
        lambda t, x, u, params: x, states=["a", "b"], inputs=["y", "torque"], outputs=2,
    )  # fmt: skip
    loop = cb.estimate_loop(swing(), watch, output=C, feedback=lambda x: -4 * x[1], sensor_diffusion=[0.5])
    by_gain = cb.estimate_loop(
        swing(), [[2], [3]], output=C, feedback=lambda x: -4 * x[1], sensor_diffusion=0.5,
        model=lambda x, u: [x[1], u[0] - np.sin(x[0])],
    )  # fmt: skip
    assert loop.states == ("angle", "speed", "a", "b")
    np.testing.assert_allclose(at(loop.dynamics, 0, *POINT, 0.2), at(by_gain.dynamics, 0, *POINT, 0.2), rtol=1e-14)
    np.testing.assert_allclose(loop.diffusion, by_gain.diffusion)


@pytest.mark.parametrize(
    ("own", "other", "proxy"),
    [
        (cb.Gaussian(variance=4.0), cb.Gaussian(std=0.5), [4.0, 0.25]),
        (cb.Gaussian(covariance=[[4.0]]), cb.Gaussian(std=0.5), [4.0, 0.25]),
        (cb.Uniform(halfwidth=3.0), cb.Uniform(halfwidth=6.0), [3.0, 12.0]),
        (cb.Bounded(halfwidth=3.0), cb.Bounded(halfwidth=4.0), [9.0, 16.0]),
        (cb.Bounded(halfwidth=3.0, independent=False), cb.Bounded(halfwidth=4.0, independent=False), [25.0, 25.0]),
        (cb.SubGaussian(proxy_std=3.0), cb.SubGaussian(proxy_variance=4.0), [9.0, 4.0]),
    ],
)
def test_the_two_noises_stand_beside_each_other(own, other, proxy):
    loop = cb.estimate_loop(sampled(own), L, output=C, feedback=lambda x: K @ x, sensor_noise=other)
    np.testing.assert_allclose(loop.noise.proxy, np.diag(proxy), rtol=1e-12)


def test_a_plant_without_noise_takes_the_law_of_its_sensor():
    plant = cb.linear_system(A, time="discrete")
    loop = cb.estimate_loop(plant, L, output=C, sensor_noise=cb.Uniform(halfwidth=0.1))
    assert isinstance(loop.noise, cb.Uniform)
    np.testing.assert_array_equal(loop.noise_matrix, [[0], [0], [0.4], [0.6]])


def test_noise_without_a_proxy_stands_beside_its_own_kind():
    own, other = cb.Laplace(scale=3.0), cb.Laplace(scale=4.0)
    loop = cb.estimate_loop(sampled(own), L, output=C, feedback=lambda x: K @ x, sensor_noise=other)
    np.testing.assert_array_equal(loop.noise.scale, [3.0, 4.0])


def test_what_is_proved_of_a_loop_holds_in_simulations_of_the_recursion():
    loop = cb.estimate_loop(sampled(), L, output=C, feedback=lambda x: K @ x, sensor_noise=cb.Gaussian(std=0.02))
    safe = [cb.Inside(cb.Box([-0.03], [0.03], coordinates=(0,)))]
    problem = cb.Problem(loop, initial=np.zeros(4), safe=safe, horizon=15, delta=0.5)
    verdict = cb.verify_safety(problem, method="linear")
    rng, paths = np.random.default_rng(3), 20_000
    x, z, left = np.zeros((paths, 2)), np.zeros((paths, 2)), np.zeros(paths, dtype=bool)
    for _ in range(15):  # by hand: plant, sensor, observer
        u, y = z @ K.T, x @ C.T + 0.02 * rng.standard_normal((paths, 1))
        x, z = x @ A.T + u @ B.T + [0, 0.01] * rng.standard_normal((paths, 1)), z @ A.T + u @ B.T + (y - z @ C.T) @ L.T
        left |= np.abs(x[:, 0]) > 0.03
    share, slack = left.mean(), 4 * np.sqrt(left.mean() / paths)
    assert 0.02 < share < 10**verdict.log10_delta + slack


def loop_with(update):
    block = control.nlsys(update, inputs=1, states=1, outputs=1)
    return cb.estimate_loop(swing(), block, output=C, sensor_diffusion=0.1)


CASES = {
    "`system` must be a Continuous": lambda: cb.estimate_loop(3, L, output=C),
    "must have 1 columns, one per measurement": lambda: cb.estimate_loop(sampled(), np.eye(2), output=C),
    r"`output` must have shape \(1, 2\)": lambda: cb.estimate_loop(sampled(), L, output=[[1.0]]),
    "`feedback` must give the plant's inputs": lambda: cb.estimate_loop(sampled(), L, output=C),
    r"write its sign: lambda x: -K @ x": lambda: cb.estimate_loop(sampled(), L, output=C, feedback=K),
    "`feedback` must return 1 values": lambda: cb.estimate_loop(sampled(), L, output=C, feedback=lambda x: x),
    "`feedback` must be omitted": lambda: cb.estimate_loop(
        cb.linear_system(A, time="discrete"), L, output=C, feedback=lambda x: x
    ),
    "`model` must return 2 values": lambda: cb.estimate_loop(
        sampled(), L, output=C, feedback=lambda x: K @ x, model=lambda x: x[0]
    ),
    "`model` must be omitted": lambda: cb.estimate_loop(
        swing(), control.tf([1], [1, 2]), output=C, model=lambda x: x
    ),
    "`sensor_noise` must be a law": lambda: cb.estimate_loop(
        sampled(), L, output=C, feedback=lambda x: K @ x, sensor_noise=0.1
    ),
    "give `sensor_noise`, a law": lambda: cb.estimate_loop(
        sampled(), L, output=C, feedback=lambda x: K @ x, sensor_diffusion=0.1
    ),
    "give `sensor_diffusion`, a matrix": lambda: cb.estimate_loop(
        swing(), L, output=C, feedback=lambda x: K @ x, sensor_noise=cb.Gaussian(std=0.1)
    ),
    "of the kind of the plant's noise, got Uniform beside Gaussian": lambda: cb.estimate_loop(
        sampled(), L, output=C, feedback=lambda x: K @ x, sensor_noise=cb.Uniform(halfwidth=0.1)
    ),
    r"must have 1 inputs \(the measurements\), or 2": lambda: cb.estimate_loop(
        swing(), control.ss([[-1]], [[1, 1, 1]], [[1]], 0), output=C
    ),
    r"must have 1 outputs \(the plant's inputs\), got 2": lambda: cb.estimate_loop(
        swing(), control.ss([[-1]], [[1]], [[1], [1]], 0), output=C
    ),
    "must not pass the plant's inputs on": lambda: cb.estimate_loop(
        swing(), control.ss([[-1]], [[1, 0]], [[1]], [[0, 1]]), output=C
    ),
    "in discrete time": lambda: cb.estimate_loop(swing(), control.tf([1], [1, 0.5], 0.1), output=C),
    "must be affine in noisy measurements": lambda: loop_with(lambda t, x, u, params: [u[0] ** 2 - x[0]]),
    "must be affine in noisy measurements; leave": lambda: loop_with(lambda t, x, u, params: [np.sign(u[0] - x[0])]),
    "must be affine in noisy": lambda: loop_with(lambda t, x, u, params: [np.abs(u[0] - x[0])]),
}  # fmt: skip


@pytest.mark.parametrize("message", CASES)
def test_what_does_not_fit_is_refused(message):
    with pytest.raises((TypeError, ValueError), match=message):
        CASES[message]()
