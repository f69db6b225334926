"""The linear-response engine against closed forms, simulation and itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal, norm

import certbound as cb
from certbound.errors import EngineError
from certbound.reach.linear.answer import linear_answer, linear_reach
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.run import LinearRun
from certbound.reach.linear.shares import Share
from certbound.simulation.estimates.deviations import Measure, sup_deviation

Array = NDArray[np.float64]


def oscillator(sigma: float = 0.1, cubic: float = 0.3, **changes: object) -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda t, x: [x[1], -x[0] - x[1] - cubic * x[0] ** 3], states=["q", "v"], diffusion=np.diag([0.0, sigma])
    )
    box = cb.Box([-2.0, -2.0], [2.0, 2.0])
    given = {"initial": [0.4, 0.0], "safe": [cb.Inside(box)], "horizon": 3.0, "delta": 1e-2}
    return cb.Problem(system, **{**given, **changes})  # type: ignore[arg-type]


def test_a_linear_step_system_gets_its_exact_gaussian_probability() -> None:
    system = cb.linear_system([[0.5]], noise=cb.Gaussian(std=1.0))
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.HalfSpace([1.0], 4.0))], horizon=1, delta=1e-3)
    assert linear_answer(problem).log10_delta == pytest.approx(norm.logsf(4.0) / np.log(10), abs=1e-9)


@pytest.mark.parametrize("steps", [1, 2])
def test_symmetric_constraints_multiply(steps: int) -> None:
    n = 14
    system = cb.linear_system(0.8 * np.eye(n), noise=cb.Gaussian(std=0.2))
    safe = [cb.Inside(cb.Box([-0.5] * n, [0.5] * n))]
    problem = cb.Problem(system, initial=np.zeros(n), safe=safe, horizon=steps, delta=0.01)
    if steps == 1:
        each = 1 - 2 * norm.sf(0.5 / 0.2)
    else:
        law = multivariate_normal(cov=0.04 * np.array([[1.0, 0.8], [0.8, 1.64]]))
        low, high = np.full(2, -0.5), np.full(2, 0.5)
        each = law.cdf(high, lower_limit=low)
    found = 1 - 10 ** linear_answer(problem).log10_delta
    assert each**n * (1 - 3e-3) < found < each**n + 1e-9


def test_a_wide_initial_set_is_split_until_the_remainder_holds() -> None:
    system = cb.ContinuousSystem(lambda x: -x - x**3, states=1, diffusion=[[0.05]])
    safe = [cb.Inside(cb.Box([-2.0], [2.0]))]
    problem = cb.Problem(system, initial=cb.Box([-1.6], [1.6]), safe=safe, horizon=1.0, delta=1e-3)
    found = linear_answer(problem)
    assert len(found.engine.centres) > 1
    assert found.log10_delta <= -3
    assert linear_answer(problem, cells=1).log10_delta == 0


def test_the_tube_holds_the_deviations_of_simulated_paths() -> None:
    problem = oscillator()
    answer = linear_answer(problem)
    tube = answer.tube
    assert tube is not None
    rng = np.random.default_rng(1)
    step, count = 0.002, 4000
    x, nominal = np.tile([0.4, 0.0], (count, 1)), np.array([[0.4, 0.0]])
    outside = np.zeros(count, dtype=bool)

    def drift(z: Array) -> Array:
        return np.stack([z[:, 1], -z[:, 0] - z[:, 1] - 0.3 * z[:, 0] ** 3], axis=1)

    for k in range(1500):
        x = x + step * drift(x) + np.sqrt(step) * np.stack([np.zeros(count), 0.1 * rng.standard_normal(count)], 1)
        nominal = nominal + step * drift(nominal)
        half = np.array([tube.extent(row, min((k + 1) * step, 2.999)) for row in np.eye(2)])
        outside |= (np.abs(x - nominal) > half + 2e-3).any(axis=1)
    assert outside.mean() <= 10**tube.log10_delta + 4 * np.sqrt(10**tube.log10_delta / count) + 1e-3
    # and it is not absurdly wide: the stationary deviation of v is about sigma/sqrt(2)
    assert tube.half_widths[-1, 1] < 8 * 0.1 / np.sqrt(2)


def test_noise_free_trajectories_stay_in_the_noise_free_reach_tube() -> None:
    problem = oscillator(initial=cb.Box([0.2, -0.2], [0.6, 0.2]))
    reach = linear_reach(problem, noise=False)
    from scipy.integrate import solve_ivp

    rng = np.random.default_rng(2)
    for start in rng.uniform([0.2, -0.2], [0.6, 0.2], (20, 2)):
        times = np.linspace(0.0, 3.0, 31)
        path = solve_ivp(
            lambda t, z: [z[1], -z[0] - z[1] - 0.3 * z[0] ** 3], (0.0, 3.0), start, t_eval=times, rtol=1e-10, atol=1e-12
        ).y.T
        assert all(reach.contains(t, z) for t, z in zip(times, path, strict=True))


def test_the_remainder_bound_contains_the_remainder_at_random_points() -> None:
    problem = cb.load("unicycle")
    run = LinearRun(Linearisation(problem, pieces=40))
    engine = run.engine
    levels, _ = run.levels(Share.of(1e-3))
    shape = (1, engine.pieces, engine.n)
    low, high = run.deviations(levels, np.zeros(shape), np.zeros(shape))  # type: ignore[misc]
    extra = run.extra.reshape(engine.pieces, *run.extra.shape[2:])
    lower, upper = engine.model.bound(engine.frame, low, high, extra, 1)
    rng = np.random.default_rng(3)
    controls, (slope, drift, gain) = engine.controls[0], engine.slopes
    h = engine.step
    for k in range(0, engine.pieces, 3):
        s = rng.uniform(low[k, :3], high[k, :3], (4000, 3))
        along = s @ extra[k].T
        s = s[((along <= high[k, 3:]) & (along >= low[k, 3:])).all(axis=1)]
        theta = rng.uniform(0, 1, (len(s), 1))
        b = controls[k]
        rest = 1 - theta
        p = rest**3 * b[0] + 3 * theta * rest**2 * b[1] + 3 * theta**2 * rest * b[2] + theta**3 * b[3]
        speed = 3 / h * (
            rest**2 * (b[1] - b[0]) + 2 * theta * rest * (b[2] - b[1]) + theta**2 * (b[3] - b[2])
        )
        d = rng.uniform(-0.1, 0.1, len(s))
        jacobian = slope[0, k] + h * theta[:, :, None] * drift[0, k]
        x = p + s
        f = np.asarray(engine._compiled(np.zeros(len(s)), *x.T, d))
        beta = f - speed - np.einsum("mij,mj->mi", jacobian, s) - gain[0, k][:, 0] * d[:, None]
        assert np.all(beta >= lower[k] - 1e-12)
        assert np.all(beta <= upper[k] + 1e-12)
        assert np.all(upper[k] - lower[k] <= 6 * (beta.max(axis=0) - beta.min(axis=0)) + 1e-3)


@pytest.mark.parametrize("changes", [{"sigma": 0.05}, {"horizon": 2.0}, {"delta": 0.1}])
def test_an_easier_problem_is_never_judged_worse(changes: dict[str, float]) -> None:
    sigma = changes.pop("sigma", 0.2)
    hard = oscillator(0.2, safe=[cb.Inside(cb.Box([-1.0, -1.2], [1.0, 1.2]))])
    easy = oscillator(sigma, safe=[cb.Inside(cb.Box([-1.0, -1.2], [1.0, 1.2]))], **changes)
    # probabilities far below both targets depend on where the search for them stopped
    level = np.log10(min(easy.delta, hard.delta))
    assert max(linear_answer(easy).log10_delta, level) <= max(linear_answer(hard).log10_delta, level) + 1e-9


def test_too_much_noise_is_an_honest_unknown() -> None:
    answer = linear_answer(oscillator(3.0, cubic=2.0))
    assert answer.log10_delta == 0.0
    assert answer.reason


@pytest.mark.parametrize("sigma", [0.1, 3.0])
def test_a_fixed_point_is_looked_for_along_the_inner_rows_alone(sigma: float) -> None:
    run = LinearRun(Linearisation.of(oscillator(sigma)))
    bounds = run.probability(Share.of(1e-3)).bounds
    assert ("supports" in vars(run)) == (bounds is not None)  # the faces of what is asked only if there is one
    for inner, whole in zip(run.inner_supports, run.supports, strict=True):
        assert inner.y.shape[1] == run.inner < whole.y.shape[1]
        np.testing.assert_allclose(inner.y, whole.y[:, : run.inner], rtol=1e-12)


@pytest.mark.parametrize("discrete", [False, True])
def test_what_is_no_remainder_moves_nothing(discrete: bool) -> None:
    step = cb.DiscreteSystem(lambda x: 0.9 * x - 0.1 * x**3, states=2, noise=cb.Gaussian(std=[0.1, 0.1]))
    problem = oscillator().replace(system=step, horizon=5) if discrete else oscillator()
    run = LinearRun(Linearisation.of(problem))
    none = np.zeros(run.engine.shape[1:])
    for support in (run.supports[0], run.inner_supports[0]):
        found, close = support.remainder(none, none), support.remainder(none, none + 1e-250)
        assert [part.shape for part in found] == [part.shape for part in close]
        assert not any(part.any() for part in found)
        assert all(np.abs(part).max() < 1e-200 for part in close)


def test_twelve_states_in_discrete_time() -> None:
    a = 0.9 * np.eye(12) + 0.05 * np.eye(12, k=1)
    system = cb.DiscreteSystem(
        lambda t, x: a @ x + 0.02 * np.tanh(x), states=12, noise=cb.Gaussian(std=0.01)
    )
    problem = cb.Problem(
        system, initial=cb.Box(-0.05 * np.ones(12), 0.05 * np.ones(12)),
        safe=[cb.Inside(cb.Box(-np.ones(12), np.ones(12)))], horizon=20, delta=1e-3,
    )
    assert linear_answer(problem).log10_delta < -3


def test_a_gaussian_start_adds_its_covariance() -> None:
    tight = oscillator(initial=cb.GaussianStart([0.4, 0.0], 1e-4 * np.eye(2)))
    wide = oscillator(initial=cb.GaussianStart([0.4, 0.0], 4e-2 * np.eye(2)))
    assert linear_answer(tight).log10_delta < linear_answer(wide).log10_delta < 0


@pytest.mark.parametrize("discrete", [False, True])
def test_a_problem_without_constraints_has_a_reach_tube_all_the_same(discrete: bool) -> None:
    noise = {"noise": cb.Gaussian(std=0.1)} if discrete else {"diffusion": [[0.1]]}
    system = cb.linear_system([[0.5 if discrete else -0.5]], **noise)
    problem = cb.Problem(system, initial=[1.0], safe=[], horizon=2, delta=1e-2)
    assert linear_answer(problem).log10_delta <= -2
    assert linear_reach(problem).contains(2.0, [0.25 if discrete else np.exp(-1.0)])


def test_a_trajectory_that_blows_up_is_named() -> None:
    system = cb.ContinuousSystem(lambda x: x**2, states=1, diffusion=[[0.01]])
    problem = cb.Problem(system, initial=cb.Box([1.0], [1.1]), safe=[], horizon=2.0)
    with pytest.raises(EngineError, match=r"trajectory is lost after t = 0\.9.*; shorten the horizon"):
        linear_answer(problem)


def test_one_direction_alone_is_narrower_than_all_at_once_and_still_holds_its_paths() -> None:
    problem = oscillator()
    answer = linear_answer(problem)
    tube, alone = answer.tube, answer.extent_along([0.0, 1.0])
    assert tube is not None
    assert np.all(alone[1:] <= tube.half_widths[1:, 1] * (1 + 1e-9))
    assert alone.max() < 0.97 * tube.half_widths[:, 1].max()
    engine = answer.run.engine
    times = np.linspace(0.0, 3.0, 1001)
    profile = alone[np.clip(np.searchsorted(engine.times, times, side="right") - 1, 0, engine.pieces - 1)]
    measure = Measure(directions=[[0.0, 1.0], [0.0, -1.0]], profile=profile)
    spread = sup_deviation(problem, paths=20_000, rng=np.random.default_rng(5), measure=measure)
    beyond = sum(spread.exceedance(1.0, row=row).value for row in (0, 1))
    assert 0.0005 < beyond <= problem.delta


def test_a_direction_alone_needs_a_proof() -> None:
    with pytest.raises(ArithmeticError, match="feeds itself"):
        linear_answer(oscillator(3.0, cubic=2.0)).extent_along([1.0, 0.0])


@pytest.mark.parametrize("effort", [0, 1, 2])
def test_bounds_of_the_remainder_prove_themselves(effort: int) -> None:
    run = LinearRun(Linearisation.of(cb.load("unicycle").replace(horizon=0.5)))
    levels, _ = run.levels(Share.of(1e-4))
    bounds = run.include(levels, effort)
    assert bounds is not None
    implied = run.deviations(levels, *bounds)
    assert implied is not None
    sample = run.sampled(implied)
    assert np.all(sample[0] >= bounds[0])
    assert np.all(sample[1] <= bounds[1])
    target = bounds[0].reshape(-1, 3), bounds[1].reshape(-1, 3)
    again = run.engine.model.bound(run.engine.frame, *implied, run.flat_extra, 3, target)
    little = 0.04 * (target[1] - target[0])  # other boxes, other bounds
    assert np.all(again[0] >= target[0] - little)
    assert np.all(again[1] <= target[1] + little)


def test_a_piece_that_needs_more_is_tried_again_alone() -> None:
    run = LinearRun(Linearisation.of(cb.load("unicycle").replace(horizon=1.0)))
    levels, _ = run.levels(Share.of(1e-4))
    bounds = run.include(levels, 1)
    assert bounds is not None
    implied = run.deviations(levels, *bounds)
    assert implied is not None
    low, high = (b.copy() for b in run._wider(levels, implied))
    middle = (low[20] + high[20]) / 2
    low[20], high[20] = middle - 1e-3, middle + 1e-3  # what is bounded there first says too little
    asked: list[int] = []
    whole = run.engine.model.bound

    def counted(*arguments: Any) -> Any:
        asked.append(len(arguments[-1]))
        return whole(*arguments)

    object.__setattr__(run.engine.model, "bound", counted)
    found = run._closed(levels, (low, high), bounds, 1)
    assert found is not None
    assert found[0]
    assert asked[0] == run.engine.pieces
    assert 1 <= max(asked[1:]) < run.engine.pieces / 2
    sample = run.sampled(run.deviations(levels, *found[1:]) or implied)
    assert np.all(sample[0] >= found[1])
    assert np.all(sample[1] <= found[2])


def test_more_cells_are_taken_where_one_proves_too_little() -> None:
    problem = oscillator(sigma=0.06, cubic=1.0, initial=cb.Box([0.9, -0.3], [1.5, 0.3]), horizon=2.0, delta=1e-3,
                         safe=[cb.Inside(cb.HalfSpace([0.0, -1.0], 1.7))])
    once = linear_answer(problem, cells=1)
    assert once.outcome.bounds is not None
    assert once.log10_delta > -3
    several = linear_answer(problem)
    assert several.engine.cells > 1
    assert several.log10_delta <= -3


def test_no_room_and_no_level_together_are_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    inside = cb.Inside(cb.Box([-2.0, -2.0], [2.0, 2.0]), during=(1.0, 2.0), label="the window")
    answer = linear_answer(oscillator(safe=[inside]))
    monkeypatch.setattr("certbound.reach.linear.run.level_along", lambda event, _: np.full(len(event.profile), np.inf))
    requirement, piece, left = answer.run.tightest(answer.shown)
    assert requirement is not None
    assert requirement.label.startswith("the window")
    assert (piece + 1) * answer.run.engine.step >= 1.0
    assert piece * answer.run.engine.step <= 2.0
    assert left == -np.inf


def test_a_target_out_of_reach_is_told_by_one_look(monkeypatch: pytest.MonkeyPatch) -> None:
    looks = []

    def promise(run: LinearRun, nonlinear: Share, effort: int, limit: float = 0.0) -> float:
        looks.append((nonlinear.log, effort))
        return limit + 1.0

    monkeypatch.setattr(LinearRun, "promise", promise)
    problem = oscillator(initial=cb.Box([0.3, -0.1], [0.5, 0.1]), delta=1e-3)
    answer = linear_answer(problem, thorough=False)
    assert len(looks) == 2
    assert looks[1] == (pytest.approx(np.log(0.85e-3)), 3)
    assert answer.outcome.bounds is not None


def test_leaving_costs_no_less_than_the_noise_at_one_time() -> None:
    for half in (0.45, 0.7, 1.2):
        box = cb.Box([-half, -2.0], [half, 2.0])
        problem = oscillator(initial=cb.Box([0.3, -0.1], [0.4, 0.1]), safe=[cb.Inside(box)], delta=1e-3)
        run = linear_answer(problem, thorough=False).run
        least = run._one_time(Share.of(1e-4))
        assert -np.inf < least <= run.promise(Share.of(1e-4), 3)
        assert run.promise(Share.of(1e-4), 3, limit=least - 1.0) == least


def test_units_of_time_change_no_bound() -> None:
    """Twenty relaxation times, in units in which they are long or short."""
    found = []
    for rate in (2.0**-4, 2.0**10):
        system = cb.linear_system([[-rate]], diffusion=[[0.1 * rate**0.5]])
        safe = [cb.Inside(cb.Box([-0.5], [0.5]))]
        problem = cb.Problem(system, initial=[0.0], safe=safe, horizon=20.0 / rate, delta=1e-3)
        found.append(linear_answer(problem).log10_delta)
        assert np.isfinite(linear_reach(problem).hull.hi).all()
    assert found[0] == pytest.approx(found[1], rel=1e-3)
    assert found[0] < -5


def test_a_reach_tube_that_nothing_bounds_names_the_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("certbound.reach.linear.answer_tubes.level_scale", lambda *_: np.inf)
    system = cb.linear_system([[-0.5]], diffusion=[[0.1]])
    problem = cb.Problem(system, initial=[1.0], safe=[], horizon=2, delta=1e-2)
    with pytest.raises(ArithmeticError, match=r"no bound of the deviation of x1 was found .*method='contraction'"):
        linear_reach(problem)


def test_what_is_too_stiff_on_the_finest_pieces_is_refused_before_a_path_is_followed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Linearisation, "_followed", property(lambda self: pytest.fail("a path was followed")))
    system = cb.ContinuousSystem(lambda x: -1e5 * x, states=1, diffusion=[[1.0]])
    with pytest.raises(EngineError, match=r"\|\|J\|\| h = 50"):
        Linearisation.of(cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1, delta=0.1))
