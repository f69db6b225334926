"""Systems take dynamics by argument name, matrices or python-control models, and refuse what is ambiguous."""

import numpy as np
import pytest

from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.tape import Tape
from certbound.problem.model.tracing import trace
from certbound.problem.noise import Bounded, Gaussian, Uniform
from certbound.problem.sets.regions import Ball, Box
from certbound.problem.systems import ContinuousSystem, DiscreteSystem, from_control, linear_system


def test_arguments_are_passed_by_name_in_signal_order():
    system = ContinuousSystem(
        lambda d, u, x, t: [x[0] + 10 * u[0] + 100 * d[0] + 1000 * t],
        states=["x"],
        inputs=Box([-1], [1]),
        disturbance=Box([-1], [1]),
        diffusion=[[0.1]],
    )
    assert system.dynamics.inputs == ("t", "x", "u", "d")
    assert compile_numpy(system.dynamics)(4, 1, 2, 3) == 4321
    assert (system.time, system.dimension, system.noise_dimension) == ("continuous", 1, 1)


@pytest.mark.parametrize(
    ("function", "options", "inputs"),
    [
        (lambda t, x: x, {}, ("t", "x1", "x2")),
        (lambda t, x, u: x + u, {"inputs": Box([-1, -1], [1, 1])}, ("t", "x1", "x2", "u1", "u2")),
        (lambda t, x, d: x + d[0], {"disturbance": Box([-1], [1])}, ("t", "x1", "x2", "d")),
        (lambda x: x, {"inputs": Box([-1], [1]), "input_names": ["force"]}, ("t", "x1", "x2", "force")),
    ],
)
def test_every_signature_is_accepted(function, options, inputs):
    assert DiscreteSystem(function, states=2, noise=Gaussian(std=1), **options).dynamics.inputs == inputs


def test_default_names_do_not_clash_with_states():
    system = ContinuousSystem(lambda x, u: x + u, states=["u"], inputs=Box([-1], [1]))
    assert system.input_names == ("u_",)


def test_a_disturbance_must_not_have_an_inputs_name():
    box = Box([-1], [1])
    with pytest.raises(ValueError, match="`disturbance_names` must not use the name 'p'"):
        ContinuousSystem(
            lambda x, u, d: x,
            states=1,
            inputs=box,
            input_names=["p"],
            disturbance=box,
            disturbance_names=["p"],
        )


def test_diffusion_may_be_a_matrix_a_function_or_a_number_for_one_state():
    constant = ContinuousSystem(lambda x: -x, states=2, diffusion=[[0], [0.5]])
    np.testing.assert_array_equal(constant.diffusion, [[0], [0.5]])
    varying = ContinuousSystem(lambda x: -x, states=2, diffusion=lambda t, x: [[x[0], t], [0, 1]])
    assert isinstance(varying.diffusion, Tape)
    assert varying.diffusion.inputs == ("t", "x1", "x2")
    np.testing.assert_array_equal(compile_numpy(varying.diffusion)(5, 6, 7), [[6, 5], [0, 1]])
    scalar = ContinuousSystem(lambda x: -x, states=1, diffusion=0.3)
    np.testing.assert_array_equal(scalar.diffusion, [[0.3]])
    local = ContinuousSystem(lambda x: -x, states=1, diffusion=lambda x: 0.1 * x[0])
    assert local.diffusion.shape == (1, 1)
    assert ContinuousSystem(lambda x: -x, states=3).diffusion.shape == (3, 1)


def test_a_diffusion_function_that_is_constant_becomes_a_matrix():
    system = ContinuousSystem(lambda x: -x, states=2, diffusion=lambda t, x: 0.1 * np.eye(2))
    np.testing.assert_array_equal(system.diffusion, 0.1 * np.eye(2))


def test_discrete_noise_is_spread_over_the_noise_matrix():
    system = DiscreteSystem(lambda x: x, states=3, noise=Gaussian(std=2.0), noise_matrix=[[0], [0], [0.1]])
    assert system.noise_dimension == 1
    np.testing.assert_array_equal(system.noise.proxy, [[4.0]])
    quiet = DiscreteSystem(lambda x: x, states=3)
    np.testing.assert_array_equal(quiet.noise.proxy, np.zeros((3, 3)))
    bounded = DiscreteSystem(lambda x: x, states=2, noise=Bounded(halfwidth=1.0, independent=False))
    np.testing.assert_array_equal(bounded.noise.proxy, 2 * np.eye(2))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"diffusion": {"x": 0.1}}, r"`diffusion` must hold numbers, .* got \{'x': 0.1\}; write np.diag"),
        ({"diffusion": [[None], [1.0, 2.0]]}, "`diffusion` must hold numbers, in rows of equal length"),
        ({"disturbance_names": 3}, "`disturbance_names` must be a list of names, got 3"),
    ],
)
def test_what_is_no_matrix_or_list_is_refused_by_its_name(options, message):
    with pytest.raises(TypeError, match=message):
        ContinuousSystem(lambda x: -x, states=2, **options)


def test_noise_in_rows_of_different_lengths_is_refused_by_its_name():
    with pytest.raises(ValueError, match="`std` must be a number or a vector"):
        Gaussian(std=[[1, 2], [3]])
    with pytest.raises(TypeError, match="`halfwidth` must hold numbers"):
        Uniform(halfwidth=[[1, 2], [3]])
    np.testing.assert_array_equal(Gaussian(std=np.array(0.1)).std, [0.1])


def test_twelve_states_from_matrices():
    rng = np.random.default_rng(0)
    a, b, e, c = rng.normal(size=(12, 12)), rng.normal(size=(12, 2)), rng.normal(size=(12, 3)), rng.normal(size=12)
    system = linear_system(a, b, c, E=e, disturbance=Box([-1] * 3, [1] * 3), noise=Gaussian(std=0.1))
    assert system.time == "discrete"
    assert not system.inputs.bounded
    values = rng.normal(size=(18, 20))
    expected = values[1:13].T @ a.T + values[13:15].T @ b.T + values[15:].T @ e.T + c
    np.testing.assert_allclose(compile_numpy(system.dynamics)(*values), expected, rtol=1e-12, atol=1e-12)


def test_the_time_base_of_matrices_follows_the_noise_unless_said():
    assert linear_system([[0.5]], diffusion=0.1).time == "continuous"
    assert linear_system([[0.5]], noise_matrix=[[1.0]]).time == "discrete"
    assert linear_system([[0.5]], time="discrete").time == "discrete"
    with pytest.raises(ValueError, match="`time` must be 'continuous' or 'discrete'"):
        linear_system([[0.5]], time="hybrid")


def test_a_tape_is_accepted_as_dynamics():
    tape = trace(lambda t, x: [-(x[0] ** 3)], {"t": ["t"], "x": ["x1"]})
    assert ContinuousSystem(tape, states=1).dynamics.nodes == tape.nodes
    with pytest.raises(ValueError, match="`dynamics` must be a tape over"):
        ContinuousSystem(tape, states=["y"])


def test_a_state_space_model_is_read():
    control = pytest.importorskip("control")
    a, b = [[0.0, 1.0], [-2.0, -3.0]], [[0.0], [1.0]]
    model = control.ss(a, b, [[1.0, 0.0]], 0.0)
    system = from_control(model, diffusion=np.eye(2))
    assert system.time == "continuous"
    assert system.states == ("x0", "x1")
    np.testing.assert_allclose(compile_numpy(system.dynamics)(0, 1, 2, 3), [2, -2 - 6 + 3])
    direct = ContinuousSystem(model, diffusion=np.eye(2), inputs=Box([-1], [1]), input_names=["force"])
    assert direct.input_names == ("force",)
    assert direct.inputs.high[0] == 1
    free = from_control(control.ss(a, [[0.0], [0.0]], [[1.0, 0.0]], 0.0))
    assert free.inputs is None


def test_a_sampled_model_becomes_a_discrete_system_and_time_counts_steps():
    control = pytest.importorskip("control")
    model = control.nlsys(
        lambda t, x, u, params: [params["k"] * x[0] + t + u[0]], None, states=["level"], inputs=["flow"], dt=0.5,
        params={"k": 3.0},
    )  # fmt: skip
    system = from_control(model, noise=Gaussian(std=0.1))
    assert isinstance(system, DiscreteSystem)
    assert system.dynamics.inputs == ("t", "level", "flow")
    np.testing.assert_allclose(compile_numpy(system.dynamics)(4, 2.0, 1.0), [6.0 + 2.0 + 1.0])
    with pytest.raises(ValueError, match=r"in discrete time \(dt = 0.5\); use cb.DiscreteSystem"):
        ContinuousSystem(model)


def test_a_nonlinear_model_is_traced():
    control = pytest.importorskip("control")
    model = control.nlsys(lambda t, x, u, params: [x[1], -np.sin(x[0]) + u[0]], None, states=2, inputs=1)
    system = ContinuousSystem(model, diffusion=np.eye(2))
    np.testing.assert_allclose(compile_numpy(system.dynamics)(0, 0.5, 2, 3), [2, 3 - np.sin(0.5)])
    autonomous = control.nlsys(lambda t, x, u, params: [-(x[0] ** 3)], None, states=1, inputs=0)
    assert from_control(autonomous).inputs is None


def test_awkward_labels_become_identifiers():
    control = pytest.importorskip("control")
    model = control.ss(np.eye(2), np.eye(2), np.eye(2), 0, states=["a b", "t"], inputs=["in[0]", "in[1]"])
    system = from_control(model)
    assert system.states == ("x1", "x2")
    assert system.input_names == ("in0", "in1")


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: ContinuousSystem(lambda x: -x, states=3, diffusion=0.1),
            r"got the scalar 0\.1; write 0\.1 \* np\.eye\(3\)",
        ),
        (lambda: ContinuousSystem(lambda x: -x, states=3, diffusion=[0.1, 0.2, 0.3]), r"got a vector; write np\.diag"),
        (lambda: ContinuousSystem(lambda x: -x, states=3, diffusion=np.eye(2)), r"must have shape \(3, 2\)"),
        (lambda: ContinuousSystem(lambda x: -x, states=3, diffusion=lambda x: 0.1), "must return a matrix with 3 rows"),
        (lambda: ContinuousSystem(lambda x: -x, states=3, diffusion=lambda x: np.eye(2)), "must return 3 rows"),
        (lambda: ContinuousSystem(lambda x: -x, states=1, diffusion=np.nan), "must not contain nan"),
        (lambda: ContinuousSystem(lambda x: -x[:2], states=3), r"must return 3 values, one per state \(x1, x2, x3\)"),
        (lambda: ContinuousSystem(lambda x: -x, states=0), "`states` must be at least 1"),
        (lambda: ContinuousSystem(lambda x: -x, states=["a", "a"]), "`states` must be distinct"),
        (lambda: ContinuousSystem(lambda x: -x, states=["a b"]), "`states` must be identifiers"),
        (lambda: ContinuousSystem(lambda x: -x, states=["t"]), "must not use the name 't'"),
        (
            lambda: ContinuousSystem(lambda x, u: x, states=["a"], inputs=Box([0], [1]), input_names=["a"]),
            "`input_names` must not use the name 'a'",
        ),
        (
            lambda: ContinuousSystem(lambda x, u: x, states=1, inputs=Box([0], [1]), input_names=["a", "b"]),
            "`input_names` must hold 1 names",
        ),
        (lambda: ContinuousSystem(lambda x: x, states=1, input_names=["a"]), "must come with bounds"),
        (
            lambda: ContinuousSystem(lambda x: x, states=1, disturbance=Box([-np.inf], [1])),
            "`disturbance` must be a bounded box",
        ),
        (
            lambda: DiscreteSystem(lambda x: x, states=2, noise=Gaussian(std=1), noise_matrix=0.1),
            r"`noise_matrix` must be a matrix with 2 rows .* got the scalar 0\.1",
        ),
        (lambda: DiscreteSystem(lambda x: x, states=2, noise=Gaussian(std=[1, 2, 3])), "must be a number or 2 numbers"),
        (lambda: linear_system([[1, 2]]), r"`A` must have shape \(1, 1\)"),
        (lambda: linear_system(np.eye(2), [[1]]), r"`B` must have shape \(2, 1\)"),
        (lambda: linear_system(np.eye(2), b=[1]), "`b` must have 2 entries"),
        (lambda: linear_system(np.eye(2), E=np.eye(2)), "`E` and `disturbance` must be given together"),
        (lambda: linear_system(np.eye(2), inputs=Box([0], [1])), "must come with a matrix `B`"),
        (lambda: linear_system(np.eye(2), np.eye(2), inputs=Box([0], [1])), "`B` must have 1 columns, got 2"),
    ],
)
def test_sizes_and_names_are_checked(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: DiscreteSystem(lambda x: x, states=2, noise=0.1),
            r"`noise` must be a law, got 0\.1; .*cb\.Gaussian\(std=",
        ),
        (lambda: ContinuousSystem(lambda x: x, states=1, diffusion="0.1"), "`diffusion` must hold .* got '0.1'"),
        (lambda: ContinuousSystem(lambda x: x, states=2, diffusion=[[0], [1, 2]]), "in rows of equal length, got"),
        (lambda: ContinuousSystem(lambda x: x), "`states` must be given"),
        (lambda: ContinuousSystem(lambda x: x, states="abc"), "`states` must be a number or a list of names"),
        (lambda: ContinuousSystem(lambda x: x, states=True), "`states` must be a number or a list of names"),
        (lambda: ContinuousSystem(lambda x: x, states=1, inputs=2), "`inputs` must be a Box that bounds u, got 2"),
        (lambda: ContinuousSystem(lambda x: x, states=1, disturbance=Ball([0], 1)), "`disturbance` must be a Box"),
        (lambda: ContinuousSystem(lambda x, u: x, states=1), "a system with u needs `inputs=`"),
        (lambda: from_control(3), "`system` must be a python-control system"),
    ],
)
def test_kinds_are_checked(build, message):
    with pytest.raises(TypeError, match=message):
        build()


def test_a_control_model_without_states_is_refused():
    control = pytest.importorskip("control")
    with pytest.raises(ValueError, match="has no states"):
        from_control(control.ss([], [], [], 2.0))


def test_the_inputs_of_a_control_model_must_fit():
    control = pytest.importorskip("control")
    with pytest.raises(ValueError, match=r"`inputs` must have 1 entries \(the model's inputs\), got 2"):
        from_control(control.ss([[1.0]], [[1.0]], [[1.0]], 0), inputs=Box([0, 0], [1, 1]))


def test_a_system_says_what_it_is():
    system = ContinuousSystem(lambda x, u: x + u, states=["a"], inputs=Box([0], [1]))
    assert repr(system) == "<ContinuousSystem: states a; inputs u>"
