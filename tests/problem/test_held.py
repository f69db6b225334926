"""Inputs that are held: what a problem refuses, what its files say, and the states that they become."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.problem.held import held_loop


def cart(**changes: object) -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x, u: [x[1], u[0]], states=["p", "v"], inputs=cb.Box([-4], [4]), diffusion=[[0.0], [0.1]]
    )
    given: dict[str, object] = {
        "initial": [0.1, 0], "safe": [cb.Inside(cb.Box([-1, -1], [1, 1]))], "horizon": 2.0, "hold": 0.1,
        "plan": lambda x: -2 * x[0] - 2 * x[1],
    }
    return cb.Problem(system, **(given | changes))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"hold": 0.0}, "`hold` must be positive"),
        ({"hold": 3.0}, "at most the horizon 2"),
        ({"hold": 0.3}, "`hold` must fit into the horizon a whole number of times, got 0.3 in 2; a horizon"),
        ({"hold": 0.001}, "`hold` must make at most 1000 sampling times, got 2000"),
        ({"plan": np.zeros((4, 1))}, "`hold` must come with a `plan` that is a law"),
        ({"plan": None}, "`hold` must come with a `plan` that is a law"),
    ],
)
def test_a_hold_that_makes_no_sense_is_refused(changes: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        cart(**changes)


def test_steps_of_discrete_time_hold_nothing() -> None:
    system = cb.DiscreteSystem(lambda x, u: x + u, states=["x"], inputs=cb.Box([-1], [1]))
    safe = [cb.Inside(cb.Box([-1], [1]))]
    with pytest.raises(ValueError, match="`hold` must be left out in discrete time"):
        cb.Problem(system, initial=[0], safe=safe, horizon=4, plan=lambda x: -x, hold=2)


def test_a_horizon_is_a_whole_number_of_holds_up_to_rounding() -> None:
    assert cart(horizon=0.3, hold=0.1).samples == 3  # in floats 0.3 / 0.1 is less
    assert cart(hold=None).samples == 0
    with pytest.raises(ValueError, match="must fit into the horizon"):
        cart(hold=0.1 * (1 + 1e-12))


@pytest.mark.parametrize(("time", "refused"), [(0.1, True), (0.15, False), (0.5, False)])
def test_a_law_that_jumps_at_a_sample_is_refused_where_rounding_decides(time: float, *, refused: bool) -> None:
    """A tenth of a second is before the float 0.1, and a program that reads its clock then says it is not."""
    changes = {"horizon": 1.0, "plan": lambda t, x: -2 * x[0] + np.where(t < time, 0.5, 0.0)}
    if refused:
        with pytest.raises(ValueError, match=r"rounding decides, got \(t < 0.1\): .* at a sampling time"):
            cart(**changes)
    else:
        assert cart(**changes).samples == 10


def test_who_knows_no_sampling_times_does_not_get_a_closed_loop() -> None:
    with pytest.raises(InfeasibleError, match=r"the inputs are held for 0\.1 s"):
        _ = cart().closed_loop
    with pytest.raises(InfeasibleError, match="the inputs are held"):
        cb.bound_constants(cart())
    assert cart(hold=None).closed_loop.shape == (2,)


def test_between_sampling_times_inputs_rest_and_at_them_states_do() -> None:
    loop = held_loop(cart())
    assert loop.flow.system.states == loop.sample.system.states == ("p", "v", "u")
    names = loop.flow.closed_loop.inputs
    flow, sample = (
        [float(x) for x in np.ravel(_value(problem, names))] for problem in (loop.flow, loop.sample)
    )
    assert flow == [0.5, 0.7, 0.0]
    assert sample == [0.25, 0.5, -1.5]


def _value(problem: cb.Problem, names: tuple[str, ...]) -> object:
    from certbound.problem.model import compile_numpy

    assert problem.closed_loop.inputs == names
    return compile_numpy(problem.closed_loop)(0.0, 0.25, 0.5, 0.7)


def test_constraints_are_the_same_in_the_states_with_inputs() -> None:
    faces = np.array([[1.0, 1.0], [-1.0, 0.5]])
    safe = [
        cb.Inside(cb.HalfSpace([1, 2], 3)), cb.Outside(cb.Polytope(faces, [-2, -2])),
        cb.Inside(cb.Box([-1], [1], coordinates=[1]), during=(0, 1)), cb.Outside(cb.Ball([3, 3], 0.5)),
    ]
    flow = held_loop(cart(safe=safe, domain=cb.Box([-5, -5], [5, 5]))).flow
    rng = np.random.default_rng(0)
    for point in rng.uniform(-4, 4, (200, 2)):
        own = [one.region.contains(point) for one in safe]
        assert own == [one.region.contains(np.append(point, 9.0)) for one in flow.safe]
    assert flow.safe[2].during == (0, 1)
    assert flow.domain is not None
    assert flow.domain.high.tolist() == [5, 5, np.inf]


def test_targets_and_noise_of_the_state_are_refused() -> None:
    with pytest.raises(InfeasibleError, match="targets are not served where inputs are held"):
        held_loop(cart(reach=cb.Ball([0, 0], 0.5)))
    system = cb.ContinuousSystem(
        lambda x, u: u, states=["x"], inputs=cb.Box([-1], [1]), diffusion=lambda x: [[0.1 * x[0]]]
    )
    safe = [cb.Inside(cb.Box([-1], [1]))]
    with pytest.raises(InfeasibleError, match="noise that depends on the state"):
        held_loop(cb.Problem(system, initial=[0.1], safe=safe, horizon=1, plan=lambda x: -x, hold=0.5))


def test_a_file_says_how_long_under_the_plan(tmp_path: Path) -> None:
    path = tmp_path / "cart.toml"
    cb.save(cart(), path)
    assert "[plan]" in path.read_text()
    assert "hold = 0.1" in path.read_text()
    assert cb.load(path).hold == 0.1
    path.write_text(path.read_text().replace("hold = 0.1", 'hold = "0.2/2"'))
    assert cb.load(path).hold == 0.1
    path.write_text(path.read_text().replace("hold =", "held ="))
    with pytest.raises(ValueError, match=r"unknown key 'held' in \[plan\]; did you mean 'hold'"):
        cb.load(path)
