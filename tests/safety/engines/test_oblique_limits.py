"""Engines in other coordinates: oblique limits as limits of one state, exactly, and what is not exact is refused."""

from __future__ import annotations

import functools
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from flint import ctx

import certbound as cb
from certbound.arrays import Array
from certbound.checker import check_data, parse
from certbound.checker.reading import Record
from certbound.checker.report import Budget
from certbound.checker.statement import read_model
from certbound.checker.statement.turned import turned_model
from certbound.errors import CertificateError, InfeasibleError
from certbound.problem.model import Tape, compile_numpy, turned_tape
from certbound.quadratic.setting import make_setting
from certbound.reach.sets.directions import requirements
from certbound.safety.answers import EngineAnswer, Request, exact
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.engines import Apart, Turned, in_coordinates, linear_engine
from certbound.safety.engines.oblique_limits import axes, eased, straight, turns_of
from certbound.safety.engines.turning import exact_product, scales_of, turned_problem
from certbound.safety.verdict import verdict_of
from experiments.middle import platoon
from tests.reach.sets.test_directions import still


def pair() -> cb.Problem:
    """Two states shaken by one noise in proportion to 1 + state: their difference is shaken in proportion to itself."""
    system = cb.ContinuousSystem(
        lambda x: [-x[0], -x[1]], states=["a", "b"], diffusion=lambda a, b: [[0.2 * (1 + a)], [0.2 * (1 + b)]]
    )
    safe = [cb.Inside(cb.HalfSpace([1.0, -1.0], 0.5))]
    return cb.Problem(system, initial=[0.2, 0.0], safe=safe, horizon=0.25, delta=1e-2)


def oblique() -> cb.Problem:
    """Two states whose difference has a limit."""
    system = cb.ContinuousSystem(lambda x: [-x[0], 0.5 * x[0] - x[1]], states=["a", "b"], diffusion=0.125 * np.eye(2))
    safe = [cb.Inside(cb.HalfSpace([1.0, -1.0], 1.0))]
    return cb.Problem(system, initial=[0.25, 0.0], safe=safe, horizon=1.0, delta=1e-2)


def turned(problem: cb.Problem) -> tuple[Array, Array]:
    found = axes(problem)
    assert found is not None
    return found


def test_distances_and_their_rates_become_states() -> None:
    matrix, inverse = turned(platoon(0.1))
    assert np.array_equal(exact_product(matrix, inverse), np.eye(6))
    assert matrix[[0, 1, 4, 5]].tolist() == [
        [1, 0, -1, 0, 0, 0], [0, 1, 0, -1, 0, 0], [0, 0, -1, 0, 1, 0], [0, 0, 0, -1, 0, 1]
    ]  # fmt: skip


def rotors() -> cb.Problem:
    """Two coupled rotors: what bends is their difference alone, and together they wander."""
    system = cb.ContinuousSystem(
        lambda x: [0.25 - np.sin(x[0] - x[1]), 0.25 + np.sin(x[0] - x[1])], states=["a", "b"],
        diffusion=0.0625 * np.eye(2),
    )
    safe = [cb.Inside(cb.Box([-1.0, -1.0], [1.0, 1.0]))]
    return cb.Problem(system, initial=[0.25, 0.0], safe=safe, horizon=0.5, delta=1e-2)


def spring(size: float) -> cb.Problem:
    """A noisy spring whose speed is stated in other units; in metres and seconds those of an atom's tip are."""
    system = cb.ContinuousSystem(
        lambda x: [size * x[1], -x[0] / size - 0.25 * x[1]], states=["z", "v"], diffusion=[[0.0], [1.25 / size]]
    )
    safe = [cb.Inside(cb.HalfSpace([1.0, 0.0], 6.0))]
    return cb.Problem(system, initial=[0.0, 0.0], safe=safe, horizon=2.0, delta=1e-60)


@functools.cache
def of_one_size() -> EngineAnswer:
    return in_coordinates(linear_engine)(spring(1.0))


@pytest.mark.parametrize("size", [2.0**10, 2.0**16])
def test_states_of_different_sizes_are_asked_in_units_of_their_own(size: float) -> None:
    problem = spring(size)
    found = in_coordinates(linear_engine)(problem)
    assert isinstance(found.details, Turned)
    assert "; with z in units of about" in found.reason
    assert found.log10_delta == pytest.approx(of_one_size().log10_delta, rel=0.01)
    assert linear_engine(problem).log10_delta > found.log10_delta + 0.01


def test_limits_are_said_in_the_units_of_their_states() -> None:
    """60 <= G was `8*G >= 60` and `G >= 7.5` where engines had been asked with G in units of 8."""
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=["G", "I"], diffusion=np.diag([3.0, 1e-5]))
    safe = [cb.Inside(cb.Box([60.0, -np.inf], [160.0, 1e-3])), cb.Inside(cb.HalfSpace([1.0, 1e4], 1e3))]
    plain = cb.Problem(system, initial=[100.0, 0.0], safe=safe, horizon=1.0)
    other = turned_problem(plain, np.diag([0.125, 2.0**14]), np.diag([8.0, 2.0**-14]))
    setting = make_setting(other, np.array([7.5, -16.0]), np.array([20.0, 2.0**14 * 1e-3]))
    names = [setting.name_of(wall) for wall in setting.walls if wall.side is not None]
    assert [name.partition(",")[0] for name in names] == ["G >= 60", "G <= 160", "I >= -0.0009766", "I <= 0.001"]
    found = [one.label for one in requirements(other, still(np.array([12.5, 0.0])))]
    assert found == ["G <= 160", "I <= 0.001", "G >= 60", "G + 10000*I <= 1000"]


def test_states_of_one_size_keep_their_units() -> None:
    assert list(turns_of(spring(4.0), oblique=False)) == []
    exponents = scales_of(spring(2.0**40))
    assert exponents is not None
    assert exponents[0] - exponents[1] == pytest.approx(40, abs=1)


def test_the_sums_along_which_a_model_bends_become_states() -> None:
    problem = rotors()
    assert turned_tape(problem.closed_loop, np.eye(2))[2].tolist() == [[1.0, -1.0]]
    turn = eased(problem)
    assert turn is not None
    bent = turned_tape(turned_problem(problem, *turn).closed_loop, np.eye(2))[2]
    assert np.count_nonzero(bent.any(axis=0)) == 1
    assert eased(oblique()) is None  # a limit alone makes nothing bend less
    assert eased(pair()) is None


def test_where_a_model_bends_along_fewer_sums_than_states_these_coordinates_come_first() -> None:
    problem = rotors()
    asked: list[cb.Problem] = []

    def proves(plain: float, turned: float) -> EngineAnswer:
        def prove(own: cb.Problem, request: Request) -> EngineAnswer:
            asked.append(own)
            return EngineAnswer(log10_delta=plain if own is problem else turned, applicable=True)

        asked.clear()
        return in_coordinates(prove)(problem, Request())

    enough = proves(-9.0, -2.5)
    assert isinstance(enough.details, Turned)
    assert len(asked) == 1
    assert asked[0] is not problem
    better = proves(-0.5, -1.0)  # neither is enough: each is asked once
    assert isinstance(better.details, Turned)
    assert (better.details.plain.log10_delta, better.log10_delta, len(asked)) == (-0.5, -1.0, 2)
    worse = proves(-1.5, -1.0)
    assert (worse.details, worse.log10_delta, len(asked)) == (None, -1.5, 2)
    verdict = verdict_of(problem, {"linear": in_coordinates(linear_engine)(problem, Request())})
    assert verdict.status == "SAFE"
    assert isinstance(verdict.answers["linear"].details, Turned)
    assert check_data(parse(certificate_text(problem, verdict)), problem_data(problem)).valid


def test_what_cancels_is_gone() -> None:
    problem = platoon(0.1)
    other = turned_problem(problem, *turned(problem))
    tape = other.system.diffusion
    assert [tape.describe(output) for output in tape.outputs][:2] == ["0", "(-0.1 * v1)"]


def test_the_model_is_the_same_function_in_other_coordinates_here_and_in_the_checker() -> None:
    system = cb.ContinuousSystem(
        lambda x, y, z: [0.3 * np.sin(x) - y * z, (x + 0.7 * y) / 2 - z**3, x / (2 + y**2) + 0.1 * (0.3 * z - x)],
        states=["x", "y", "z"], diffusion=lambda t, x, y, z: [[0.1 * (1 - x) + t], [0.7 * x * y], [0.1 * (x - z)]],
    )  # fmt: skip
    safe = [cb.Inside(cb.HalfSpace([2.0, 0.0, 1.0], 9.0)), cb.Inside(cb.Polytope([[1.0, -1.0, 0.5]], [9.0]))]
    problem = cb.Problem(system, initial=cb.Box([-0.1] * 3, [0.1, 0.2, 0.3]), safe=safe, horizon=1)
    matrix, inverse = turned(problem)
    other = turned_problem(problem, matrix, inverse)
    proof = Record({"matrix": exact(matrix), "inverse": exact(inverse)}, "proof", ("matrix", "inverse"))
    with ctx.workprec(128):
        model = turned_model(read_model(problem_data(problem), Budget(10)), proof)
    rng = np.random.default_rng(0)
    for y in rng.standard_normal((5, 3)):
        x = inverse @ y
        for own, ours, theirs in (
            (system.dynamics, other.system.dynamics, model.dynamics),
            (system.diffusion, other.system.diffusion, model.noise.diffusion),
        ):
            assert isinstance(theirs, Tape)
            wanted = matrix @ compile_numpy(own)(0.3, *x)
            np.testing.assert_allclose(compile_numpy(ours)(0.3, *y), wanted, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(compile_numpy(theirs)(0.3, *y), wanted, rtol=1e-12, atol=1e-12)
    for mine, its in zip(other.safe, model.constraints):
        assert (mine.region.kind, mine.region.form.normals.tolist()) == (its.region.kind, its.region.faces)
    for k in range(3):
        assert other.initial.low[k] <= model.initial.low[k].upper()
        assert other.initial.high[k] >= model.initial.high[k].lower()


def test_a_linear_response_in_other_coordinates_proves_and_certifies_more() -> None:
    problem = pair()

    def prove(asked: cb.Problem, request: Request) -> EngineAnswer:  # the plain one takes half a second for 10**-0.68
        return EngineAnswer(log10_delta=-0.68) if asked is problem else linear_engine(asked, request)

    verdict = verdict_of(problem, {"linear": in_coordinates(prove)(problem, Request())})
    assert verdict.status == "SAFE"
    found = verdict.answers["linear"].details
    assert isinstance(found, Turned)
    assert "in the coordinates a - b" in verdict.reason
    data = parse(certificate_text(problem, verdict))
    assert data["claim"]["method"] == "coordinates"
    assert check_data(data, problem_data(problem)).valid


def test_limits_that_become_oblique_are_proved_by_themselves_and_the_probabilities_add_up() -> None:
    limits = [*oblique().safe, cb.Inside(cb.Box([-3, -3], [3, 3])), cb.Inside(cb.Ball([0, 0], 9.0))]
    problem = oblique().replace(safe=limits)
    limits = list(problem.safe)
    asked: list[tuple[str, list[str]]] = []

    def proves(name: str, log10_delta: float) -> Callable[[cb.Problem, Request], EngineAnswer]:
        def prove(problem: cb.Problem, request: Request) -> EngineAnswer:
            asked.append((name, [one.label for one in problem.safe]))
            alone = len(problem.safe) < len(limits)
            return EngineAnswer(log10_delta=log10_delta if alone else 0.0, method=name)

        return prove

    answer = in_coordinates(proves("grid", -3.0), beside=proves("barrier", -4.0))(problem, Request())
    assert answer.log10_delta == pytest.approx(np.log10(0.0011), abs=1e-9)
    assert isinstance(answer.details, Apart)
    labels = [one.label for one in limits]
    assert asked == [("grid", labels), ("barrier", labels[1:]), ("grid", labels[:1])]
    nothing = in_coordinates(proves("grid", -3.0), beside=proves("barrier", 0.0))(problem, Request())
    assert nothing.log10_delta == 0.0


@pytest.mark.parametrize("row", [[0.0, 0.0], [0.0, 1.0], [2.0, -1.0]], ids=["no", "singular", "another"])
def test_matrices_that_are_not_inverse_are_refused_everywhere(row: list[float]) -> None:
    problem = oblique()
    matrix, inverse = turned(problem)
    wrong = np.array([row, matrix[1]])
    with pytest.raises(InfeasibleError, match="inverse to each other"):
        turned_problem(problem, wrong, inverse)
    proof = Record({"matrix": exact(wrong), "inverse": exact(inverse)}, "proof", ("matrix", "inverse"))
    with pytest.raises(CertificateError, match="must be the inverse"):
        turned_model(read_model(problem_data(problem), Budget(10)), proof)


def test_the_start_is_enclosed_outward() -> None:
    problem = oblique().replace(initial=[0.3, -0.1])
    start = turned_problem(problem, *turned(problem)).initial
    image = Fraction(0.3) + Fraction(0.1)
    assert Fraction(start.low[0]) <= image <= Fraction(start.high[0])
    assert start.low[0] < start.high[0]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"domain": cb.Box([-9, -9], [9, 9])}, "domain bounds"),
        ({"initial": cb.GaussianStart([0, 0], 0.01 * np.eye(2))}, "plain problems"),
        ({"safe": [*oblique().safe, cb.Inside(cb.Ball([0, 0], 5.0))]}, "round, or moves"),
        ({"system": cb.ContinuousSystem(lambda x: -x, states=2, diffusion=[[0.3], [0.01]])}, "no float"),
    ],
    ids=["domain", "random start", "ball", "noise"],
)
def test_what_is_not_exact_in_other_coordinates_is_refused(change: dict[str, object], why: str) -> None:
    turn = turned(oblique())
    with pytest.raises(InfeasibleError, match=why):
        turned_problem(oblique().replace(**change), *turn)


def test_limits_along_states_need_no_other_coordinates() -> None:
    assert axes(oblique().replace(safe=[cb.Inside(cb.HalfSpace([1.0, 0.0], 1.0))])) is None
    assert axes(oblique().replace(safe=[cb.Inside(cb.HalfSpace([0.3, 0.7], 1.0))])) is None  # no factor to divide by


def test_sums_whose_coefficients_are_no_floats_are_left_as_they_stand() -> None:
    tape = cb.ContinuousSystem(lambda x: [0.1 * x[0], 0.7 * (0.1 * x[0] + x[1])], states=2).dynamics
    found, rows, bent = turned_tape(tape, np.eye(2), np.array([[1.0, 1.0], [0.0, 1.0]]))
    assert rows == [None, None]
    assert bent.any(axis=0).all()
    np.testing.assert_allclose(compile_numpy(found)(0.0, 1.0, 2.0), [0.1 + 0.7 * 2.1, 0.7 * 2.1], rtol=1e-15)


def test_what_is_not_defined_stays_so_where_its_factor_is_zero() -> None:
    tape = cb.ContinuousSystem(lambda x: [0.0 * np.log(x[0]) + x[1], -x[0]], states=2).dynamics
    found = compile_numpy(turned_tape(tape, np.eye(2), np.array([[1.0, 1.0], [0.0, 1.0]]))[0])
    with np.errstate(invalid="ignore"):
        assert np.isnan(found(0.0, -1.0, 2.0)[0]) == np.isnan(compile_numpy(tape)(0.0, -1.0, 2.0)[0])
    np.testing.assert_allclose(found(0.0, 1.0, 2.0), [1.0, -1.0])


def test_a_plane_behind_one_oblique_line_is_asked_along_it_with_noises_apart() -> None:
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=np.diag([0.4, 0.4]))
    line = cb.Inside(cb.HalfSpace([1, -1], 1.2))
    problem = cb.Problem(system, initial=[0.0, 0.0], safe=[line], horizon=0.5, delta=0.05)
    turn = straight(problem)
    assert turn is not None
    np.testing.assert_array_equal(turn[0], [[1, -1], [0.5, 0.5]])
    np.testing.assert_array_equal(turn[0] @ turn[1], np.eye(2))
    asked: list[cb.Problem] = []

    def prove(own: cb.Problem, request: Request) -> EngineAnswer:
        asked.append(own)
        return EngineAnswer(log10_delta=-1.0 if own is problem else -0.5, applicable=True)

    engine = in_coordinates(prove, beside=prove)
    hasty = engine(problem, Request(quick=True))
    assert (hasty.log10_delta, len(asked)) == (-0.5, 1)  # the plain one, which is slow there, is not asked yet
    assert (engine(problem, Request()).log10_delta, len(asked)) == (-1.0, 3)
    for other in (cb.Inside(cb.Box([-1, -1], [1, 1])), cb.Inside(cb.HalfSpace([3, 1], 2))):
        assert straight(problem.replace(safe=[line, other])) is None
    assert straight(problem.replace(safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))])) is None
