"""Problem files say what Python says and are safe to open; faults are named."""

import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from certbound.problem.files.loading import load, loads, save
from certbound.problem.model.evaluation import compile_numpy
from tests.problem.toml_files import COURSE, STEPS, changed, course_in_python, same


def test_a_file_says_what_python_says():
    assert same(loads(COURSE), course_in_python())
    assert dict(loads(COURSE).parameters) == {"sigma": 0.01, "v": 1.0}


def test_independent_noises_may_be_a_table_by_state():
    given = '[["sigma", 0, 0], [0, "sigma", 0], [0, 0, "sigma"]]'
    problem = loads(changed(COURSE, given, '{ th = "sigma", px = 2 }'))
    np.testing.assert_array_equal(problem.system.diffusion, [[2, 0], [0, 0], [0, 0.01]])


def test_parameters_are_changed_by_name():
    problem = loads(COURSE, sigma=0.2, v=3)
    np.testing.assert_array_equal(problem.system.diffusion, 0.2 * np.eye(3))
    assert compile_numpy(problem.closed_loop)(0, 0, 0, 0, 0)[0] == 3.0
    with pytest.raises(ValueError, match="`sgma` is no parameter of this problem; did you mean 'sigma'"):
        loads(COURSE, sgma=0.2)
    with pytest.raises(ValueError, match="`sigma` must not contain nan"):
        loads(COURSE, sigma=float("nan"))


def test_matrices_plans_costs_and_laws_are_read():
    problem = loads(STEPS)
    assert problem.closed_loop.inputs == ("t", "x", "y")
    x, y, t = 0.3, 0.7, 2.0
    expected = [0.9 * x + 0.1 * y - 0.1 * x + 0.5, 0.8 * y + np.sin(t) * y]
    np.testing.assert_allclose(compile_numpy(problem.closed_loop)(t, x, y), expected, rtol=1e-15)
    np.testing.assert_array_equal(problem.cost[0], np.diag([1.0, 2.0]))
    np.testing.assert_array_equal(problem.system.noise_matrix, [[1.0], [0.5]])


def test_a_matrix_model_may_have_a_disturbance():
    text = changed(STEPS, "[dynamics]", "[disturbances]\nd = [-1, 1]\n[dynamics]\nE = [[0], [3]]")
    assert compile_numpy(loads(text).closed_loop)(0, 0, 0, 2.0)[1] == 6.0


@pytest.mark.parametrize("path", ["/etc/passwd", "../plan.json", "a/../../plan.json"])
def test_a_plan_is_read_from_the_files_folder_only(path, tmp_path):
    text = changed(STEPS, 'u = "-0.1*x"\nw = "sin(t)*y"', f'file = "{path}"')
    with pytest.raises(ValueError, match=r"`plan\.file` must be a file in the problem file's folder"):
        loads(text, folder=tmp_path)
    with pytest.raises(ValueError, match=r"`plan\.file` must be a file in the problem file's folder"):
        loads(changed(text, path, "plan.json"))


def test_numbers_may_be_expressions_in_the_parameters():
    text = changed(COURSE, "horizon = 5.0", 'horizon = "10*v/2"')
    text = changed(text, "radius = 0.9", 'radius = "sqrt(v)*0.9"')
    text = changed(text, "px = [-1, 10]", 'px = ["-v", 10]')
    problem = loads(text, v=4)
    assert problem.horizon == 20
    assert problem.safe[1].region.radius == 1.8
    assert problem.safe[0].region.low[0] == -4
    with pytest.raises(ValueError, match=r"`horizon` must be an expression, got 'px': unknown name 'px'|unknown name"):
        loads(changed(COURSE, "horizon = 5.0", 'horizon = "px"'))


def test_definitions_see_earlier_definitions_only():
    text = changed(COURSE, 'turn = "-0.5*th + d"', 'gain = "0.5*th"\nturn = "d - gain"')
    assert same(loads(text), loads(changed(COURSE, '"-0.5*th + d"', '"d - 0.5*th"')))
    with pytest.raises(ValueError, match=r"`definitions\.turn` must not use 'gain', which stands below it"):
        loads(changed(COURSE, 'turn = "-0.5*th + d"', 'turn = "d - gain"\ngain = "0.5*th"'))


def test_a_thousand_chained_definitions_are_read():
    chain = "\n".join(['s0 = "th"'] + [f's{k} = "s{k - 1} + 1"' for k in range(1, 1000)])
    text = changed(COURSE, 'turn = "-0.5*th + d"', chain + '\nturn = "s999 + d"')
    assert compile_numpy(loads(text).closed_loop)(0, 0, 0, 0, 0)[2] == 999


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('states = ["px", "py", "th"]', 'states = ["px", "del", "th"]', "'del', a word of Python's own; del_ would"),
        ("horizon = 5.0", "horizn = 5.0", "unknown key 'horizn' in the problem file; did you mean 'horizon'"),
        ("horizon = 5.0", "", "`horizon` is missing"),
        ("horizon = 5.0", "horizon = -5", "`horizon` must be positive, got -5"),
        ("horizon = 5.0", "horizon = true", "`horizon` must be a number or an expression, got true"),
        ("horizon = 5.0", "horizon = nan", "`horizon` must be a number, got nan"),
        ("horizon = 5.0", "horizon = [1, 2]", r"`horizon` must be a number or an expression in quotes, got \[1, 2\]"),
        ("horizon = 5.0", 'horizon = "5"', "`horizon` must be a number, got the text '5'; write it without quotes"),
        ("during = [0, 2]", 'during = ["0", "2"]', r"`avoid\.0\.during\.0` must be a number, got the text '0'"),
        ("v = 1.0", 'v = "1.0"', r"`parameters\.v` must be a number, got the text '1\.0'"),
        ("delta = 1e-3", "delta = 0", r"`delta` must lie in \(0, 1\), got 0"),
        ('"continuous"', '"hybrid"', "`time` must be 'continuous' or 'discrete', got 'hybrid'"),
        ('["px", "py", "th"]', '["px", "py", "t"]', "`states` must not use the name 't'"),
        ('["px", "py", "th"]', '["px", "py", "sin"]', "`states` must not use the name 'sin'"),
        ('["px", "py", "th"]', "[]", "`states` must have at least 1 entries, got 0"),
        ("v = 1.0", "px = 1.0", "`parameters` must not use the name 'px'"),
        ("v = 1.0", "v = nan", "`v` must be a number, got nan"),
        ("v = 1.0", 'v = "2*sigma"', "`parameters.v` must be a number"),
        ("d = [-0.1, 0.1]", "d = [0.1, -0.1]", r"`disturbances\.d` must be \[low, high\], got"),
        ("d = [-0.1, 0.1]", "d = [0.1]", "`disturbances.d` must have at least 2 entries, got 1"),
        ("d = [-0.1, 0.1]", "d = [-inf, 0.1]", "`disturbance` must be a bounded box"),
        ('th = "turn"', "", "`dynamics` must give every state, th is missing"),
        ('th = "turn"', "th = true", r"`dynamics\.th` must be an expression in quotes, got true"),
        ('th = "turn"', 'th = "turn"\nthh = "1"', "unknown key 'thh' in \\[dynamics\\]; did you mean 'th'"),
        ('th = "turn"', "th = [1]", r"`dynamics\.th` must be an expression in quotes, got \[1\]"),
        ('"v*cos(th)"', '"v*coss(th)"', r"`dynamics\.px` .* unknown function 'coss'; did you mean 'cos'"),
        ('"v*cos(th)"', '"w*cos(th)"', r"`dynamics\.px` .* unknown name 'w'"),
        ('"v*cos(th)"', '"().__class__.__bases__"', r"`dynamics\.px` must be an expression"),
        ('"v*cos(th)"', '"__import__(1)"', "unknown function '__import__'"),
        ('"v*cos(th)"', '"th.real"', "attribute access does not exist here"),
        ("diffusion", "std", "`noise` must hold `diffusion` alone in continuous time, .* got std"),
        ('[["sigma", 0, 0], [0, "sigma", 0], [0, 0, "sigma"]]', "0.1", r"got 0\.1; write diffusion = \{ px = "),
        ('[["sigma", 0, 0], [0, "sigma", 0], [0, 0, "sigma"]]', "[1, 2, 'px']", "got a list of 3; write diffusion = "),
        ('[["sigma", 0, 0], [0, "sigma", 0], [0, 0, "sigma"]]', "{ pz = 1 }", "unknown key 'pz' in `noise.diffusion`"),
        ('[["sigma", 0, 0], [0, "sigma", 0], [0, 0, "sigma"]]', '[["sigma"]]', "must have 3 rows|must return 3 rows"),
        ('[["sigma", 0, 0], [0, "sigma", 0], [0, 0, "sigma"]]', "[[1, 2], [1], [1, 2]]", "rows of equal length"),
        ('["sigma", 0, 0]', '["d", 0, 0]', r"`noise\.diffusion\.0\.0`: 'd' must not be used here, only t, px, py, th"),
        ('["sigma", 0, 0]', '["turn", 0, 0]', r"`noise\.diffusion\.0\.0`: .* 'd' must not be used here"),
        ("[noise]\ndiffusion = ", "[noise]\nuniform = ", 'write law = "uniform" and halfwidth = 0.1'),
        ("[noise]\ndiffusion = ", "[noise]\nlaw = 'gaussian'\nstd = 1\nq = ", "unknown key 'q' in \\[noise\\]"),
        ("[noise]\n", "[noise]\nlaw = 'gaussian'\n", "`noise` must hold `diffusion` alone in continuous time"),
        ("[-0.1, 0.1], [-0.1, 0.1], [-0.1, 0.1]]", "[-0.1, 0.1]]", r"`initial\.box` must have 3 entries, got 1"),
        ("box = [[-0.1, 0.1], [-0.1, 0.1]", "box = [[-0.1, 0.1], 0.1", r"wrong: `initial\.box\.1` must be a pair"),
        ("[initial]\nbox", '[initial]\npoint = "origin" #', "`initial.point` must be a list, .* or a table, "),
        ("[initial]\nbox", "[initial]\npoint = [0, true, 0] #", r"wrong: `initial\.point\.1` must be a number"),
        ("box = [[-0.1, 0.1]", "boxx = [[-0.1, 0.1]", "unknown key 'boxx' in \\[initial\\]; did you mean 'box'"),
        ("[initial]\nbox", "[initial]\npoint = [0, 0, 0]\nbox", r"\[initial\] needs exactly one of .*'point', 'box'"),
        (
            "[initial]\nbox = [[-0.1, 0.1], [-0.1, 0.1], [-0.1, 0.1]]",
            "[initial]\nbox = { px = [0, 0] }",
            "py, th is missing",
        ),
        (
            "[initial]\nbox = [[-0.1, 0.1], [-0.1, 0.1], [-0.1, 0.1]]",
            "[initial]\npoint = { px = 0 }",
            r"`initial\.point` must give every state, py, th is missing",
        ),
        ("px = [-1, 10]", "px = [10, -1]", r"`stay\.0\.box\.px` must be \[low, high\], got 10 > -1; swap"),
        ("px = [-1, 10]", "pz = [-1, 10]", r"`stay\.0\.box` must use the states' names, got 'pz'; known: px, py"),
        ("px = [-1, 10]", "px = [2, 10]", "`initial` must satisfy every constraint"),
        ("radius = 0.9", "radius = -1", r"`avoid\.0\.ball\.radius` must not be negative"),
        ("radius = 0.9", "radis = 0.9", "unknown key 'radis' in ball; did you mean 'radius'"),
        ('"5 + 0.1*t"', '"5 + px"', r"`avoid\.0\.ball\.center\.0`: 'px' must not be used here, only t"),
        ("during = [0, 2]", "during = [0, 9]", r"must have `during` within \[0, 5\]"),
        ("during = [0, 2]", "during = [2, 0]", r"`avoid\.0\.during` must be \[a, b\] with 0 <= a <= b"),
        ("during = [0, 2]", "box = { px = [1, 2] }", "needs exactly one of box, ball"),
        ("during = [0, 2]", "center = { px = 1 }", "`center` beside the region moves a box"),
        ("[domain]\nbox", "[domain]\nballs", "unknown key 'balls' in \\[domain\\]"),
        ("[[stay]]", "[stay]", r"`stay` must be a list of tables; write \[\[stay\]\]"),
        ("[noise]\ndiffusion = ", "[noise]\nlaw = 'uniform'\nlow = -1\nq = ", "write halfwidth = 0.1 for"),
        ("[noise]", "[nosie]", "unknown key 'nosie' in the problem file; did you mean 'noise'"),
        ("[noise]", "[constants]\nc = 1\n[noise]", "unknown key 'constants'.*; did you mean 'parameters'"),
        ("[noise]\n", "noise = 0.1\n[nois]\n", "unknown key|is wrong"),
        ("delta = 1e-3", "delta = 1e-3\nnoise = 0.1\n[junk]\n", "unknown key 'junk'|TOML"),
        ("time = ", "time == ", "the problem file is not TOML"),
        ("delta = 1e-3", "delta = 1e-3\n[parameters]\nq = 1e400", "must not hold 1e400, which is too large; write inf"),
    ],
)
def test_faults_are_named(old, new, message):
    with pytest.raises(ValueError, match=message):
        loads(changed(COURSE, old, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("std = 0.1", "", r"law 'gaussian' needs exactly one of std, variance, covariance; got none"),
        ("std = 0.1", "std = 0.1\nvariance = 1", r"got \['std', 'variance'\]"),
        ("std = 0.1", "halfwidth = 0.1", r"needs exactly one of std, variance, covariance; got \['halfwidth'\]"),
        ("std = 0.1", "std = 0.1\nindependent = true", "`noise.independent` must be omitted for law 'gaussian'"),
        ('law = "gaussian"', 'law = "cauchy"', r"`noise.law` must be one of gaussian, .*, got 'cauchy'"),
        ('law = "gaussian"', 'law = "normal"', "got 'normal'; did you mean 'gaussian'"),
        ('law = "gaussian"\nstd = 0.1\nmatrix', "diffusion", "`diffusion` is for continuous time"),
        ("matrix = [[1], [0.5]]", "matrix = 0.1", "`noise_matrix` must be a matrix with 2 rows"),
        ("matrix = [[1], [0.5]]", "matrix = [[1], [0.5, 2]]", r"`noise\.matrix` must have rows of equal length"),
        ("horizon = 3", "horizon = 2.5", "must be a whole number of steps"),
        ("A = [[0.9, 0.1], [0, 0.8]]", "A = [[0.9, 0.1]]", r"`A` must have shape \(1, 1\)"),
        ("b = [0.5, 0]", "c = [0.5, 0]", r"unknown key 'c' in \[dynamics\]"),
        ("B = [[1, 0], [0, 1]]", "", "must come with a matrix `B`"),
        ('u = "-0.1*x"', "", "`plan` must give every input, 'u' is missing"),
        ('u = "-0.1*x"', 'v = "-0.1*x"', "unknown key 'v' in \\[plan\\]"),
        ('u = "-0.1*x"', 'u = "w"', r"`plan\.u`: 'w' must not be used here, only t, x, y"),
        ("Q = [1, 2]", "Q = [1]", "`Q` must have 2 entries"),
        ("Q = [1, 2]", "Q = [1, -2]", "`Q` must be positive semidefinite"),
        ("[inputs]", "[inputs]\nx = [0, 1]", "`inputs` must not use the name 'x'"),
        ("point = [0, 0]", "ball = { center = [0, 't'], radius = 1 }", "must not move with t"),
        ("point = [0, 0]", "ball = { center = { x = 0 }, radius = 1 }", "must give every state"),
        ("point = [0, 0]", "point = [0, 0, 0]", r"`initial\.point` must have 2 entries, got 3"),
        ("point = [0, 0]", "ball = 3", r"ball must be a table of keys, got 3"),
    ],
)
def test_faults_of_discrete_files_are_named(old, new, message):
    with pytest.raises(ValueError, match=message):
        loads(changed(STEPS, old, new))


@pytest.mark.parametrize("opening", ["[", "{ a = "])
def test_huge_nesting_is_refused(opening):
    with pytest.raises(ValueError, match=r"nested too deeply|not TOML|is wrong"):
        loads("states = " + opening * 20_000)


def test_nothing_runs_when_a_file_is_opened(tmp_path, monkeypatch):
    """The classic attempts, in every place that holds an expression."""
    monkeypatch.chdir(tmp_path)
    attack = "__import__('os').system('touch owned')"
    places = ['"v*cos(th)"', '"-0.5*th + d"', '"5 + 0.1*t"']
    for place in places:
        with pytest.raises(ValueError, match="must be an expression"):
            loads(changed(COURSE, place, f'"{attack}"'))
    assert not (tmp_path / "owned").exists()


def test_files_are_loaded_from_paths(tmp_path):
    path = tmp_path / "course.toml"
    path.write_text(COURSE)
    assert load(str(path)).name == load(path, sigma=0.5).name == "obstacle course"
    path.rename(tmp_path / "course.txt")
    assert load(str(tmp_path / "course.txt")).name == "obstacle course"
    with pytest.raises(ValueError, match=r"`source` must be a readable file, got .*missing.toml"):
        load(str(tmp_path / "missing.toml"))
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match="must be a text file in UTF-8"):
        load(tmp_path / "bytes.toml")


def test_files_of_windows_are_read(tmp_path):
    path = tmp_path / "course.toml"
    path.write_bytes(b"\xef\xbb\xbf" + COURSE.replace("\n", "\r\n").encode())
    assert same(load(str(path)), loads(COURSE))


def test_an_enormous_file_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("certbound.problem.files.loading._LARGEST", 10)
    (tmp_path / "big.toml").write_text(COURSE)
    with pytest.raises(ValueError, match="must be smaller than"):
        load(tmp_path / "big.toml")


def test_an_unknown_name_suggests_the_nearest():
    with pytest.raises(ValueError, match="no bundled problem is called 'unicyle'; did you mean 'unicycle'"):
        load("unicyle")
    with pytest.raises(ValueError, match="no bundled problem is called 'qqq'; known: chain"):
        load("qqq")


MODULE = """
import certbound as cb

def build(size=1.0):
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=0.1)
    return cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-size], [size]))], horizon=1)

ready = build()
number = 3
"""


def test_problems_are_found_in_modules(tmp_path, monkeypatch):
    (tmp_path / "my_models_of_test_files.py").write_text(textwrap.dedent(MODULE))
    monkeypatch.chdir(tmp_path)
    name = "my_models_of_test_files"
    path = list(sys.path)
    try:
        assert load(f"{name}:ready").safe[0].region.high[0] == 1
        assert load(f"{name}:build", size=3.0).safe[0].region.high[0] == 3
        with pytest.raises(ValueError, match="is a finished problem without parameters"):
            load(f"{name}:ready", size=3.0)
        with pytest.raises(ValueError, match="has no 'biuld'; did you mean 'build'"):
            load(f"{name}:biuld")
        with pytest.raises(TypeError, match=r"must be a cb\.Problem or a function that returns one, got 3"):
            load(f"{name}:number")
    finally:
        sys.modules.pop(name, None)
    assert sys.path == path
    with pytest.raises(ValueError, match="`source` must name an importable module"):
        load("no_such_module_of_ours:build")
    for name in (":build", "a..b:build", "no-name:build"):
        with pytest.raises(ValueError, match=r"must be package.module:name"):
            load(name)


@pytest.mark.parametrize(("line", "error", "words"), [
    ("import a_module_that_is_not_there", ModuleNotFoundError, "No module named 'a_module_that_is_not_there'"),
    ("from math import nothing", ImportError, "cannot import name 'nothing'"),
    ("import certbound as cb; cb.Box([1], [0])", ValueError, "`low` must not exceed `high`"),
    ("{}['key']", KeyError, "key"),
])  # fmt: skip
def test_what_a_module_raises_while_it_is_loaded_is_passed_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, error: type[Exception], words: str
) -> None:
    """Its name is right, and was called wrong."""
    (tmp_path / "raising_when_loaded.py").write_text(f"{line}\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=words) as caught:
        load("raising_when_loaded:build")
    assert "must name" not in str(caught.value)
    assert "package.module" not in str(caught.value)


def test_states_may_have_greek_names(tmp_path):
    text = STEPS.replace("x", "\u03b8").replace("m\u03b8", "mx").replace("matri\u03b8", "matrix")
    text = text.replace('"y"', '"\u03c9"').replace("*y", "*\u03c9").replace('["\u03b8"', '["\u03b8"')
    text = changed(text, "-0.1*\u03b8", "-0.1*\u03b8 - \u03c9")
    problem = loads(text)
    assert problem.system.states == ("\u03b8", "\u03c9")
    save(problem.replace(name="again"), tmp_path / "greek.toml")
    assert same(problem.replace(name="again"), load(tmp_path / "greek.toml"))


def test_an_empty_file_is_called_so():
    with pytest.raises(ValueError, match="the problem file is empty; `certbound new NAME`"):
        loads("\n# nothing yet\n")
