"""Files of LUCID and StochasticBarrier.jl: the problem that these tools solve, what became what, and refusals."""

import json

import numpy as np
import pytest

import certbound as cb
from certbound.cli.app import run
from certbound.problem.files import notes
from certbound.problem.files.parser import parse
from certbound.problem.foreign.dialects import JULIA, LUCID, rewritten
from certbound.problem.model import Graph, compile_numpy

SPIRAL = """\
system_dynamics: ["0.9*x1 + 0.1*x2", x2 - 0.1*sin(x1)^2 - 0.2*x2]
X_bounds: "RectSet([-2, -2], [2, 2])"
X_init:
  - RectSet: {lower: [0.9, 0], upper: [1.1, 0.1]}
  - SphereSet: {center: [0.5, 0.5], radius: 0.1}
X_unsafe: "MultiSet([RectSet([-2, -2], [-1.5, -1]), EllipseSet([-1, 1.5], [0.2, 0.1])])"
time_horizon: 7
noise_scale: 1e-2
seed: 3
sigma_l: [0.1, 0.2]
"""
TANKS = """\
system_flag: "linear"
dim: 2
A: [[0.9, 0.1], [0.0, 0.8]]
b: [0.5, 0.2]
σ: [0.1, 0.2]
state_space: {low: [1, 0], high: [9, 8]}
initial_region: {c: [4, 3], r: [0.25]}
obstacle_region:
  num_obstacles: 1
  obstacle_1: {low: [8, 7], high: [9, 8]}
barrier_settings: {barrier_type: SOS, time_horizon: 10, barrier_degree: 4}
"""
ROOM = """\
system_flag: polynomial
dim: 2
f: ["4.3 + 0.7x[1] + 0.002*x[1]^2", "x[2] - 2e-1x[1]*x[2]"]
σ: [0.1, 0.1]
state_space: {low: [0, 0], high: [50, 50]}
initial_region: {low: [19, 1], high: [20, 2]}
barrier_settings: {barrier_type: SOS}
"""


def read(folder, text, name="own.yaml"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return cb.load(path), notes(path)


def test_a_configuration_of_lucid(tmp_path):
    problem, told = read(tmp_path, SPIRAL)
    assert (problem.name, problem.system.time, problem.horizon, problem.delta) == ("own", "discrete", 7, 1e-3)
    x = np.array([0.7, -0.4])
    moved = [0.9 * x[0] + 0.1 * x[1], x[1] - 0.1 * np.sin(x[0]) ** 2 - 0.2 * x[1]]
    np.testing.assert_allclose(compile_numpy(problem.closed_loop)(0, *x), moved, rtol=1e-14)
    np.testing.assert_allclose(problem.system.noise.proxy, 1e-4 * np.eye(2), rtol=1e-12)
    assert problem.ending
    assert problem.domain.low.tolist() == [-2, -2]
    assert [type(start).__name__ for start in problem.starts] == ["Box", "Ball"]
    inside = [bool(c.region.contains(np.array([p]))[0]) for c, p in zip(problem.safe, [[-1.6, -1.1], [-1.15, 1.5]])]
    assert inside == [True, True]
    assert not problem.safe[1].region.contains(np.array([[-1.0, 1.65]]))[0]
    assert "noise_scale -> [noise] law = 'gaussian', std = 0.01, independent in each state" in told
    assert "seed, sigma_l -> not taken: settings of LUCID's search" in told


def test_what_lucid_takes_where_a_file_says_nothing(tmp_path):
    text = "\n".join(line for line in SPIRAL.splitlines() if not line.startswith(("time_horizon", "noise_scale")))
    problem, told = read(tmp_path, text)
    assert problem.horizon == 5
    assert problem.system.noise.std.tolist() == [0.01, 0.01]
    assert sum("(LUCID's default)" in line for line in told) == 2


def test_a_benchmark_of_stochastic_barrier_has_the_matrix_that_the_tool_makes(tmp_path):
    problem, told = read(tmp_path, TANKS)
    moved = [0.9 * 2 + 0.5, 0.1 * 2 + 0.8 * 5 + 0.2]
    np.testing.assert_allclose(compile_numpy(problem.closed_loop)(0, 2.0, 5.0), moved)
    np.testing.assert_allclose(problem.system.noise.std, [0.1, 0.2])
    assert problem.initial.low.tolist() == [3.75, 2.75]
    assert problem.horizon == 10
    assert not problem.ending
    assert any("its lists are columns, as the tool reads them" in line for line in told)
    assert [c.region.contains(np.array([[0.5, 4], [5, 5], [8.5, 7.5]])).tolist() for c in problem.safe] == [
        [False, True, True], [False, False, True]
    ]  # fmt: skip


def test_polynomials_of_julia(tmp_path):
    problem, told = read(tmp_path, ROOM, "room.yml")
    found = compile_numpy(problem.closed_loop)(0, 20.0, 1.5)
    np.testing.assert_allclose(found, [4.3 + 0.7 * 20 + 0.002 * 400, 1.5 - 0.2 * 20 * 1.5])
    assert any("horizon = 1 steps (the default of the tool)" in line for line in told)


def test_what_was_read_is_saved_as_a_file_of_our_own(tmp_path):
    problem, _ = read(tmp_path, SPIRAL)
    cb.save(problem, tmp_path / "own.toml")
    again = cb.load(tmp_path / "own.toml")
    assert again.closed_loop.nodes == problem.closed_loop.nodes
    assert notes(tmp_path / "own.toml") == ()


def test_verify_says_what_it_took_for_what(tmp_path, capsys):
    (tmp_path / "tanks.yaml").write_text(TANKS, encoding="utf-8")
    code = run(["verify", str(tmp_path / "tanks.yaml"), "--json", "--method", "constants", "--time-limit", "5"])
    out, err = capsys.readouterr()
    assert code in (0, 1)
    taken = json.loads(out)["taken"]
    assert taken[0] == "tanks is a file of StochasticBarrier.jl:"
    assert "  obstacle_region -> [[avoid]] [8, 9] x [7, 8]\n" in err


@pytest.mark.parametrize(
    ("text", "dialect", "value"),
    [
        ("-(x1^2)", LUCID, -4.0), ("2^-x2", LUCID, 0.125), ("x2 - x1^2", LUCID, -1.0), ("(-x1)^2/2", LUCID, 2.0),
        ("-x[1]^2", JULIA, -4.0), ("2x[1]^2", JULIA, 8.0), ("1 - 2x[1]", JULIA, -3.0), ("2(x[1] + 1)", JULIA, 6.0),
        ("1/2*x[1]", JULIA, 1.0), ("1.5e1x[2]", JULIA, 45.0),
    ],
)  # fmt: skip
def test_expressions_mean_what_they_mean_to_the_tool(text, dialect, value):
    graph = Graph(["x1", "x2"])
    node = parse(rewritten(text, "f", 2, dialect), graph, {"x1": graph.input(0), "x2": graph.input(1)}, "f")
    assert compile_numpy(graph.tape([node], (1,)))(2.0, 3.0)[0] == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "dialect", "message"),
    [
        ("-x1^2", LUCID, "a sign before a power .* write par"), ("2*-sin(x1)^2", LUCID, "a sign before a power"),
        ("1/2x[1]", JULIA, "a product without a sign"), ("x[1]x[2]", JULIA, "a product without a sign"),
        ("x3", LUCID, "of the 2 states, .* x3 is none"), ("x[0]", JULIA, r"x\[0\] is none"), ("x1", JULIA, "x1 is"),
        ("foo(x1)", LUCID, "uses 'foo'"), ("u1", LUCID, "uses 'u1'"), ("x1 > 0", LUCID, "'>' is not"),
        ("sin(x[1])", JULIA, "uses 'sin'"), ("", LUCID, "must be an expression"), ("x1; 2", LUCID, "';' is not"),
    ],
)  # fmt: skip
def test_an_expression_of_two_readings_is_refused(text, dialect, message):
    with pytest.raises(ValueError, match=f"`f`.*{message}"):
        rewritten(text, "f", 2, dialect)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seed: 3", "sede: 3", "unknown key `sede` in a file of LUCID; did you mean 'seed'"),
        ("seed: 3", "time_horizon: 7", "`time_horizon` must stand once"),
        ("seed: 3", "seed: &a 3\nplot: *a", r"must not repeat parts by reference, got \*a"),
        ("seed: 3", "seed: [", "is not YAML"),
        ("time_horizon: 7", "time_horizon: 7.5", "`time_horizon` must be a positive whole number, got 7.5"),
        ("noise_scale: 1e-2", "noise_scale: .inf", "`noise_scale` must be a finite number"),
        ("noise_scale: 1e-2", "noise_scale: true", "`noise_scale` must be a finite number"),
        ("radius: 0.1", "radius: 0.1, colour: red", "unknown key `X_init.SphereSet.colour`"),
        ("lower: [0.9, 0]", "lower: [0.9]", "`X_init.RectSet.lower` must have 2 entries"),
        ("lower: [0.9, 0]", "lower: [1.9, 0]", "`X_init.RectSet` must have its lower ends first"),
        ("RectSet([-2, -2], [2, 2])", "SphereSet([0, 0], 2)", "`X_bounds` must be one RectSet"),
        ("RectSet([-2, -2], [2, 2])", "Box([-2, -2], [2, 2])", r"`X_bounds` must be RectSet\(\[...\], \[...\]\) or"),
        ("[-1.5, -1]), E", "[-1.5, -1]); E", "`X_unsafe` must be RectSet"),
        ("RectSet([-2, -2], [-1.5", "RectSet([-2.5, -2], [-1.5", "`X_unsafe` must lie within `X_bounds`"),
        ("X_unsafe:", "X_unsave:", "`X_unsafe` is missing; the file has `X_unsave` instead"),
        ("X_unsafe:", "verbose:", "`X_unsafe` is missing; LUCID needs it"),
        ("system_dynamics:", "xp_samples: [[1, 2]]\nsystem_dynamics:", "`xp_samples` cannot be taken for anything"),
        ('["0.9*x1 + 0.1*x2",', '["0.9*x1 + y",', "`system_dynamics.0` uses 'y'"),
    ],
)
def test_what_lucid_would_not_say_is_refused_by_its_key(tmp_path, old, new, message):
    assert old in SPIRAL
    with pytest.raises(ValueError, match=message):
        read(tmp_path, SPIRAL.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"linear"', '"nonlinear"', "`system_flag` must be linear or polynomial, got 'nonlinear': the bounds of other"),
        ("dim: 2", "dim: 3", "`σ` must have 3 entries, got 2"),
        ("b: [0.5, 0.2]", "b: [0.5]", "`b` must have 2 entries"),
        ("b: [0.5, 0.2]", "offset: [0.5, 0.2]", "`b` is missing; StochasticBarrier.jl needs it"),
        ("σ: [0.1, 0.2]", "σ: [0.1, -0.2]", "`σ` must not be negative"),
        ("σ: [0.1, 0.2]", "σ: [0.1, 0.2]\nsigma: 3", "unknown key `sigma`"),
        ("A: [[0.9, 0.1], [0.0, 0.8]]", "A: [[0.9, 0.1]]", "`A` must be 2 lists"),
        ("num_obstacles: 1", "num_obstacles: 2", "`obstacle_region.obstacle_2` is missing"),
        ("obstacle_1:", "obstacle_2: {low: [1, 1], high: [2, 2]}\n  obstacle_1:", "obstacle_2` stands beside"),
        ("barrier_degree", "barrier_degrees", "unknown key `barrier_settings.barrier_degrees`"),
        ("{low: [1, 0], high: [9, 8]}", "3", "`state_space` must be a table of keys, got 3"),
    ],
)
def test_what_stochastic_barrier_would_not_say_is_refused_by_its_key(tmp_path, old, new, message):
    assert old in TANKS
    with pytest.raises(ValueError, match=message):
        read(tmp_path, TANKS.replace(old, new, 1))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("states: [x]\ndynamics: {x: -x}", "must be a file of LUCID .* state your own problem in TOML"),
        ("- 1", "must be a table of keys, got list"),
        ("x_samples: [[1]]\nxp_samples: [[2]]\nX_init: 3", "`xp_samples` are of a system without equations"),
        ("[" * 500 + "]" * 500, "nested too deeply"),
    ],
)
def test_a_file_of_neither_is_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        read(tmp_path, text)
