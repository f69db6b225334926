"""Two states in discrete time with normal noise along one direction: bounds against closed forms and simulations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import ndtr

import certbound as cb
from certbound.errors import CertificateError, InfeasibleError
from certbound.safety.answers import EngineAnswer
from certbound.safety.certificates import values_proof
from certbound.safety.engines.values import values_engine
from certbound.values.directed import bound_directed_failure
from certbound.values.directed.cell_landings import landing_of
from certbound.values.directed.directed_grids import Layout
from certbound.values.directed.hats import hat_error, hat_means, ranges_of
from certbound.values.directed.means import means_of
from certbound.values.directed.noise_directions import directed
from certbound.values.directed.overshoots import Lines
from certbound.values.grids import Grid

HALF_SPACES = [cb.Inside(cb.HalfSpace([1, 0], 1)), cb.Inside(cb.HalfSpace([-1, 0], 1))]


def servo(h=0.1, std=0.1, horizon=20, initial=(0.2, 0.0), safe=None, push=0.8, **changes):
    """A position that a saturated actuator holds."""

    def step(x):
        return [x[0] + h * x[1], x[1] + h * np.clip(-8 * x[0] - 4 * x[1], -push, push)]

    system = cb.DiscreteSystem(step, states=2, noise=cb.Gaussian(std=[0, std]))
    kept = [cb.Inside(cb.HalfSpace([1, 0], 0.4)), cb.Inside(cb.HalfSpace([-1, 0], 0.4))] if safe is None else safe
    return cb.Problem(system, initial=list(initial), safe=kept, horizon=horizon, **changes)


def mean_along(u, y, q, ends, place, m, s):
    """E U(place, m + w): U linear in y, linear between the nodes of q, constants beyond; by the normal distribution."""
    i = min(max(np.searchsorted(y, place, side="right") - 1, 0), len(y) - 2)
    share = min(max((place - y[i]) / (y[i + 1] - y[i]), 0.0), 1.0)
    row = (1 - share) * u[i] + share * u[i + 1]
    z = (q - m) / s
    phi, mass = np.exp(-z * z / 2) / math.sqrt(2 * math.pi), ndtr(z)
    part, slope = np.diff(mass), np.diff(row) / np.diff(q)
    inner = (row[:-1] + slope * (m - q[:-1])) * part - slope * s * np.diff(phi)
    return inner.sum() + ends[0] * mass[0] + ends[1] * (1 - mass[-1])


def simulated(problem, paths, seed=0):
    """The share of paths that leave, by a loop of its own."""
    rng, tape = np.random.default_rng(seed), cb.problem.model.compile_numpy(problem.closed_loop)
    gain = problem.system.noise_matrix @ problem.system.noise.factor
    x = np.tile(np.asarray(problem.initial.hull().mid, dtype=float), (paths, 1))
    for t in range(problem.horizon):
        x = np.asarray(tape(float(t), *x.T)) + rng.standard_normal((len(x), gain.shape[1])) @ gain.T
        due = [one for one in problem.safe if one.during is None or one.during[0] <= t + 1 <= one.during[1]]
        x = x[np.all([one.region.contains(x) != one.outside for one in due], axis=0)] if due else x
    return 1 - len(x) / paths


def test_means_of_hats_are_integrals():
    rng = np.random.default_rng(0)
    nodes, s = np.cumsum(rng.uniform(0.1, 0.6, 12)), 0.5
    places = np.concatenate([rng.uniform(-3, 9, 40), nodes])
    found = hat_means(nodes, places, s, np.zeros(len(places), dtype=np.intp), len(nodes))
    for row, m in zip(found, places):
        wanted = [mean_along(np.eye(12)[[j, j]], np.array([0.0, 1]), nodes, (0, 0), 0.5, m, s) for j in range(12)]
        assert np.abs(row - wanted).max() < 1e-13 + hat_error(nodes, s)


def test_tables_hold_their_functions_on_cells():
    rng = np.random.default_rng(1)
    nodes, s = np.cumsum(rng.uniform(0.1, 0.6, 10)), 0.4
    ranges = ranges_of(nodes, s)
    m = rng.uniform(ranges.mesh[0], ranges.mesh[-1], 4000)
    cell = np.searchsorted(ranges.mesh, m) - 1
    z = (nodes[:, None] - m) / s
    phi = np.exp(-z * z / 2) / math.sqrt(2 * math.pi)
    hats = hat_means(nodes, m, s, np.zeros(len(m), dtype=np.intp), len(nodes)).T
    for table, values in ((ranges.hats, hats), (ranges.densities, phi / s), (ranges.masses, np.diff(ndtr(z), axis=0))):
        assert np.all(table.low[:, cell] <= values)
        assert np.all(values <= table.high[:, cell])
        weights = rng.normal(size=(3, len(values)))
        assert np.all(weights @ values <= table.largest(weights)[:, cell])
    edge = (z * phi / s**2)[[0, -1]]
    assert np.all(ranges.edges[0][:, cell] <= edge)
    assert np.all(edge <= ranges.edges[1][:, cell])
    assert np.median(ranges.hats.high / np.maximum(ranges.hats.low, 1e-3)) < 5


def turned(kind):
    """Maps of different kinds, with noise on v or along (h, 1)."""
    maps = {
        "shift": lambda x: [x[0] + 0.2 * x[1], 0.9 * x[1] - 0.3 * x[0]],
        "still": lambda x: [x[0], 0.8 * x[1]],
        "kink": lambda x: [x[0] + 0.3 * abs(x[1]), x[1] + np.clip(-3 * x[0] - 2 * x[1], -0.3, 0.3)],
        "smooth": lambda x: [x[0] + 0.3 * np.sin(3 * x[1]), np.tanh(x[0] - 2 * x[1])],
        "steep": lambda x: [3 * x[0] - 2 * x[1], 2 * x[1] * abs(x[0])],
        "jump": lambda x: [x[0] + 0.2 * x[1], x[1] - 0.2 * np.sign(x[0])],
    }
    along = kind == "oblique"
    step = (lambda x: [x[0] + 0.2 * (0.9 * x[1] - np.sin(x[0])), 0.9 * x[1] - np.sin(x[0])]) if along else maps[kind]
    gain = [[0.2 if along else 0], [1]]
    system = cb.DiscreteSystem(step, states=2, noise=cb.Gaussian(std=[0.3]), noise_matrix=gain)
    return cb.Problem(system, initial=[0, 0], safe=HALF_SPACES, horizon=2), step


@pytest.mark.parametrize("kind", ["shift", "still", "kink", "smooth", "steep", "jump", "oblique"])
@pytest.mark.parametrize("ends", [(1.0, 1.0), (-1.0, 0.0)])
def test_one_step_back_lies_above_the_mean_everywhere(kind, ends):
    rng = np.random.default_rng(len(kind))
    problem, step = turned(kind)
    work = directed(problem)
    y, q = np.sort(np.append(rng.uniform(-1, 1, 15), [-1, 1])), np.linspace(-1.1, 1.2, 21)
    grid = Grid(axes=(y, q))
    smooth = np.cos(3 * y)[:, None] * np.sin(4 * q) if ends[0] > 0 else -np.exp(-4 * (y[:, None] + q) ** 2)
    value = Lines(nodal=smooth + rng.uniform(-0.05, 0.05, grid.node_shape), below=ends[0], above=ends[1])
    means = means_of(work, 0, grid, grid, ranges_of(q, work.noise))
    free = np.zeros(means.landing.live.size, dtype=bool)
    free[means.landing.live] = True
    cap = 1.0 if ends[0] > 0 else 0.0
    found = means.back(value, np.where(free, np.nan, cap), cap)
    live = np.flatnonzero(free)
    loose = []
    for cell in rng.choice(live, 150):
        i, j = divmod(int(cell), len(q) - 1)
        a, b = rng.choice([0.0, 0.5, 1.0, *rng.uniform(0, 1, 3)], 2)
        place, m = y[i] + a * (y[i + 1] - y[i]), q[j] + b * (q[j + 1] - q[j])
        corner = found[i : i + 2, j : j + 2]
        above = np.array([1 - a, a]) @ corner @ np.array([1 - b, b])
        end = step([place + work.shear * m, m])
        mean = mean_along(value.nodal, y, q, ends, end[0] - work.shear * end[1], end[1], work.noise)
        assert min(mean, cap) <= above + 1e-13
        loose.append(above - mean)
    assert kind in ("steep", "jump") or np.median(loose) < 0.6


ALONE = {
    "twist": (lambda y, q: -y * q, lambda x: [0.5 * (x[0] + x[1]), 0.5 * (x[0] + x[1])]),
    "bend": (lambda y, q: -q * q, lambda x: [0.5 * x[0], 0.7 * x[1]]),
    "kink of m": (lambda y, q: q + 0 * y, lambda x: [0.5 * x[0], -abs(x[1])]),
    "kink of y": (lambda y, q: y + 0 * q, lambda x: [-0.5 * abs(x[1]), 0.5 * x[1]]),
    "kinks of lines": (lambda y, q: -abs(y - 0.05) + 0 * q, lambda x: [0.9 * x[0] + 0.02, 0.5 * x[1]]),
}


@pytest.mark.parametrize("name", list(ALONE))
def test_what_cells_pay_is_needed(name):
    """Functions for which one payment alone is due: without it the middle of a cell would lie above the corners."""
    function, step = ALONE[name]
    system = cb.DiscreteSystem(step, states=2, noise=cb.Gaussian(std=[0, 0.05]))
    work = directed(cb.Problem(system, initial=[0, 0], safe=HALF_SPACES, horizon=2))
    y, q = np.concatenate([np.linspace(-1, 0.05, 12), np.linspace(0.13, 1, 11)]), np.linspace(-1.1, 1.2, 21)
    grid = Grid(axes=(y, q))
    value = Lines(nodal=0.4 * np.asarray(function(y[:, None], q) + 0 * y[:, None]), below=0.0, above=0.0)
    means = means_of(work, 0, grid, grid, ranges_of(q, work.noise))
    found, short = means.back(value, np.full(means.landing.live.size, np.nan), math.inf), []
    for i, j in np.ndindex(*grid.shape):
        place, m = (y[i] + y[i + 1]) / 2, (q[j] + q[j + 1]) / 2
        if abs(m) < 0.8:
            end = step([place, m])
            ends = [step([a, b]) for a in y[i : i + 2] for b in q[j : j + 2]]
            mean, *corners = (mean_along(value.nodal, y, q, (0, 0), *one, work.noise) for one in (end, *ends))
            assert mean <= found[i : i + 2, j : j + 2].mean() + 1e-13
            short.append(mean - np.mean(corners))
    assert max(short) > 1e-4


def test_lines_are_crossed_as_unevenly_as_is_granted():
    rng, (problem, _) = np.random.default_rng(5), turned("steep")
    work = directed(problem)
    y, q = np.sort(np.append(rng.uniform(-1, 1, 15), [-1, 1])), np.linspace(-0.6, 0.7, 8)
    mesh = ranges_of(q, work.noise).mesh
    landing = landing_of(work, 0, Grid(axes=(y, q)), y, mesh)
    image = landing.y.reshape(len(y), len(q))
    cells = [(i, j) for k, (i, j) in enumerate(np.ndindex(len(y) - 1, len(q) - 1)) if landing.live[k]]
    lines = landing.crossed.entries[landing.crossed.start] // (len(mesh) - 1)
    for cell, line, weight in zip(landing.cell, lines, landing.weight):
        (i, j), least = cells[cell], 0.0
        along = image[i, j : j + 2], image[i + 1, j : j + 2], np.linspace(0, 1, 41)
        across = image[i : i + 2, j], image[i : i + 2, j + 1], [0.0, 1.0]
        for one, two, shares in (along, across):
            begin, change = one[0] + np.multiply(shares, one[1] - one[0]), two[0] - one[0]
            change = change + np.multiply(shares, two[1] - two[0] - one[1] + one[0])
            place = np.clip((y[line] - begin) / change, 0, 1)
            least += (np.abs(change) * place * (1 - place)).max()
        assert weight >= least - 1e-12


@pytest.mark.parametrize("start", [-0.5, 0.0, 0.39])
def test_one_step_is_known_in_closed_form(start):
    """The first step moves x to x + h v, whatever the noise does; a limit of v is met by a normal tail."""
    safe = [cb.Inside(cb.HalfSpace([0, 1], 0.4))]
    found = bound_directed_failure(servo(horizon=1, initial=(0, start), safe=safe), seconds=0.5)
    exact = ndtr(-(0.4 - start - 0.1 * np.clip(-4 * start, -0.8, 0.8)) / 0.1)
    assert found.lower <= exact <= found.upper < 1.001 * exact + 1e-10
    assert found.lower > 0.999 * exact - 1e-10
    none = bound_directed_failure(servo(horizon=1, initial=(0.3, 0.5)), seconds=0.5)
    assert none.upper < 1e-9
    sure = bound_directed_failure(servo(horizon=1, initial=(0.3, 1.01)), seconds=0.5)
    assert sure.upper == 1
    assert sure.lower > 1 - 1e-9


def test_a_position_that_never_moves_leaves_by_no_limit_of_its_own():
    kept = [*HALF_SPACES, cb.Inside(cb.HalfSpace([0, 1], 0.3))]
    found = bound_directed_failure(servo(h=0.0, horizon=3, initial=(1.0, 0.0), safe=kept), seconds=0.5)
    places = np.linspace(-1.5, 0.3, 1801)
    rate, value = np.diff(places)[0] / 0.1 / math.sqrt(2 * math.pi), np.zeros(1801)
    for _ in range(3):
        stays = np.exp(-(((places[:, None] - places) / 0.1) ** 2) / 2) * rate
        stays[:, [0, -1]] /= 2
        value = 1 - stays @ (1 - value)
    exact = value[np.argmin(np.abs(places))]
    assert found.lower <= exact + 1e-6
    assert exact - 1e-6 <= found.upper
    assert found.upper < 1.5 * found.lower


def test_two_steps_leave_by_the_position():
    """x_2 = x + h v + h (v + h u) + h w: a normal tail."""
    problem = servo(horizon=2, initial=(0.37, 0.1))
    found = bound_directed_failure(problem, seconds=1.0)
    first = 0.37 + 0.01
    exact = ndtr(-(0.4 - first - 0.1 * (0.1 + 0.1 * np.clip(-8 * 0.37 - 0.4, -0.8, 0.8))) / 0.01)
    assert found.lower <= exact <= found.upper < 2.5 * exact
    assert found.lower > 0.2 * exact


CASES = {
    "servo": servo(horizon=60, initial=(0.0, 0.0), std=0.12),
    "box of starts": servo(horizon=30, std=0.12).replace(initial=cb.Box([-0.01, -0.01], [0.01, 0.01])),
    "one limit": servo(horizon=40, std=0.15, safe=[cb.Inside(cb.HalfSpace([1, 0], 0.4))]),
    "window": servo(horizon=40, std=0.15, safe=[cb.Inside(cb.HalfSpace([1, 0], 0.3), during=(20, 40))], initial=(0, 0)),
    "obstacle": servo(horizon=30, std=0.15, safe=[*HALF_SPACES, cb.Outside(cb.Box([-0.1, -0.6], [0.05, -0.3]))]),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CASES))
def test_simulated_paths_leave_as_often(name):
    problem = CASES[name]
    found = bound_directed_failure(problem, seconds=4.0)
    share = simulated(problem, 100_000)
    away = 5 * math.sqrt(max(share, 1e-5) / 1e5)
    assert found.lower - away <= share <= found.upper + away
    assert found.upper < (12 if name == "obstacle" else 2.5) * share + 1e-5


def test_noise_on_both_states_along_one_direction():
    """Symplectic Euler's step of a pendulum: the velocity's noise moves the angle too."""

    def step(x):
        fast = x[1] - 0.1 * (4 * np.sin(x[0]) + 0.4 * x[1])
        return [x[0] + 0.1 * fast, fast]

    system = cb.DiscreteSystem(step, states=2, noise=cb.Gaussian(std=[0.2]), noise_matrix=[[0.1], [1]])
    kept = [cb.Inside(cb.Box([-0.5, -4], [0.5, 4]))]
    problem = cb.Problem(system, initial=[0.1, 0], safe=kept, horizon=15)
    found = bound_directed_failure(problem, seconds=1.0)
    share = simulated(problem, 20_000)
    away = 5 * math.sqrt(share / 20_000)
    assert found.lower - away < share < found.upper + away
    assert 0.3 * share < found.lower
    assert found.upper < 2 * share


def test_a_map_that_changes_with_time():
    def step(t, x):
        return [x[0] + 0.1 * x[1], 0.9 * x[1] + 0.05 * (t - 3)]

    system = cb.DiscreteSystem(step, states=2, noise=cb.Gaussian(std=[0, 0.1]))
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.HalfSpace([1, 0], 0.1))], horizon=8)
    assert not directed(problem).steady
    found, share = bound_directed_failure(problem, seconds=2.5), simulated(problem, 20_000)
    away = 5 * math.sqrt(max(share, 1e-3) / 20_000)
    assert found.lower - away < share < found.upper + away
    assert found.upper < 3 * share + 0.01


def test_half_spaces_say_the_same_as_a_box():
    box = servo(horizon=5, safe=[cb.Inside(cb.Box([-0.4, -math.inf], [0.4, math.inf]))])
    one, two = bound_directed_failure(servo(horizon=5), seconds=0.1), bound_directed_failure(box, seconds=0.1)
    assert one.cells == two.cells
    assert one.upper == pytest.approx(two.upper, rel=1e-9)


def test_a_start_on_an_obstacle_has_failed():
    problem = servo(horizon=2, safe=[*HALF_SPACES, cb.Outside(cb.Box([0.2, -0.1], [0.3, 0.1]))], initial=(0.1, 0))
    start = cb.Box([0.1, 0], [0.2, 0])
    assert bound_directed_failure(problem.replace(initial=start), seconds=0.3).upper == 1
    assert bound_directed_failure(problem.replace(initial=cb.Box([0.1, 0], [0.15, 0])), seconds=0.3).upper < 1e-3


def test_cells_on_which_the_map_is_undefined_are_left_out():
    system = cb.DiscreteSystem(
        lambda x: [x[0] + 0.1 * x[1], 0.5 * np.sqrt(x[1])], states=2, noise=cb.Gaussian(std=[0, 0.1])
    )
    problem = cb.Problem(system, initial=[0, 0.5], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=3)
    work = directed(problem)
    grid = Layout(work).grid((2.0, 0.3))
    landing = landing_of(work, 0, grid, grid.axes[0], ranges_of(grid.axes[1], work.noise).mesh)
    assert landing is not None
    below = np.broadcast_to(grid.axes[1][:-1] < 0, grid.shape).ravel()
    assert not landing.live[below].any()
    assert landing.live[~below].all()


def test_the_engine_asks_it_where_chains_said_little(monkeypatch):
    monkeypatch.setattr("certbound.safety.engines.values._SECONDS", 0.2)
    answer = values_engine(servo(horizon=5, initial=(0, 0), std=0.06))
    assert answer.applicable
    assert answer.log10_delta < -1.5


def test_no_certificate_is_written_where_chains_hardly_show_it():
    problem = servo(horizon=8, initial=(0, 0), std=0.1)
    found = bound_directed_failure(problem, seconds=0.1)
    answer = EngineAnswer(log10_delta=-3.5, method="values", details=found)
    with pytest.raises(CertificateError, match="not independent from state to state"):
        values_proof(problem, answer)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"noise": cb.Gaussian(std=[0.1, 0.1])}, "one direction"),
        ({"noise": cb.Uniform(halfwidth=[0, 0.1])}, "normal"),
        ({"initial": cb.GaussianStart([0, 0], 1e-4 * np.eye(2))}, "sets of starts"),
        ({"reach": cb.Reach(cb.Box([0, 0], [0.1, 0.1]))}, "targets"),
        ({"horizon": 10_000}, "at most"),
        ({"horizon": math.inf}, "end"),
    ],
)
def test_what_is_refused(change, words):
    problem = servo()
    if "noise" in change:
        system = cb.DiscreteSystem(lambda x: [x[0] + x[1], 0.5 * x[1]], states=2, noise=change["noise"])
        problem = cb.Problem(system, initial=[0, 0], safe=HALF_SPACES, horizon=3)
        change = {}
    with pytest.raises(InfeasibleError, match=words):
        bound_directed_failure(problem.replace(**change), seconds=0.3)


def test_a_state_on_the_face_of_an_obstacle_has_failed() -> None:
    """p+ = where(q < 1, 0, 1), or 1: in the obstacle p >= 1, and in the set p <= 1 to stay in."""
    wide = cb.Inside(cb.Box([-np.inf, -40.0], [np.inf, 40.0]))
    truth = float(ndtr(-0.5))
    for region in (cb.HalfSpace([-1.0, 0.0], -1.0), cb.Box([1.0], [np.inf], coordinates=[0])):
        for jumps, probability in ((True, truth), (False, 1.0)):
            system = cb.DiscreteSystem(
                lambda x, jumps=jumps: [np.where(x[1] < 1, 0.0, 1.0) if jumps else 1 + 0 * x[0], 0.9 * x[1]],
                states=2, noise=cb.Gaussian(std=[2.0]), noise_matrix=np.array([[0.0], [1.0]]),
            )  # fmt: skip
            problem = cb.Problem(system, initial=[0.0, 0.0], safe=[cb.Outside(region), wide], horizon=2)
            found = bound_directed_failure(problem, seconds=1.0, delta=0.05)
            assert 0.5 * probability < found.lower <= probability * (1 + 1e-9)
            assert probability * (1 - 1e-9) <= found.upper <= 1.5 * probability
            within = problem.replace(safe=[cb.Inside(cb.HalfSpace([1.0, 0.0], 1.0)), wide])
            found = bound_directed_failure(within, seconds=1.0, delta=0.05)
            assert found.lower == 0
            assert found.upper < 0.25
