"""A hundred wrong inputs, on the command line and in Python: one message each, which names what is wrong and the cure.

``python -m tests.cli.test_all_messages`` prints the page of all of them, to be read beside each other.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.cli.app import run
from tests.cli.problem_files import GOOD, STEPS

# What is changed in a file that is right: the old text, the new one, and a word that the message has to hold.
SWINGS = [
    ("horizon = 1.0", "horizn = 1.0", "horizn"), ("[dynamics]", "[dynamcs]", "dynamcs"),
    ("[initial]\nbox = [[-0.1, 0.1], [-0.1, 0.1]]", "", "initial"), ("horizon = 1.0", "horizon = = 1", "TOML"),
    ('"continuous"', '"hybrid"', "time"), ('["angle", "speed"]', '["angle"]', "speed"),
    ('["angle", "speed"]', '["angle", "angle"]', "angle"), ('["angle", "speed"]', "[]", "states"),
    ('["angle", "speed"]', '["t", "speed"]', "'t'"), ('["angle", "speed"]', '["sin", "speed"]', "sin"),
    ("[[-0.1, 0.1], [-0.1, 0.1]]", "[[-0.1, 0.1]]", "initial"), ("[[-0.1, 0.1], [-0.1", "[[0.1, -0.1], [-0.1", "low"),
    ("angle = [-1, 1]", "angle = [0.5, 1]", "initial"), ('[[0], ["sigma"]]', '[["sigma"]]', "diffusion"),
    ('[[0], ["sigma"]]', "0.1", "diffusion"), ("angle = [-1, 1]", "angel = [-1, 1]", "angel"),
    ("-sin(angle)", "-sin(angel)", "angel"), ("-sin(angle)", "-sine(angle)", "sine"),
    ("-sin(angle)", "angle.real", "attribute"), ("-sin(angle)", "-sin(angle", "speed"),
    ("-sin(angle)", "angle^2", "**"), ("-sin(angle)", "sin(angle, 2)", "sin"),
    ("horizon = 1.0", "horizon = -1", "horizon"), ("horizon = 1.0", 'horizon = "long"', "horizon"),
    ("horizon = 1.0", "horizon = 0", "horizon"), ("delta = 1e-3", "delta = 1.5", "delta"),
    ("delta = 1e-3", "delta = 0", "delta"), ("delta = 1e-3", 'delta = "small"', "delta"),
    ("angle = [-1, 1]", "angle = [1, -1]", "angle"), ("angle = [-1, 1]", "angle = [-1]", "angle"),
    ("angle = [-1, 1]", 'angle = ["a", 1]', "angle"), ("sigma = 0.05", "sigma = true", "sigma"),
    ("sigma = 0.05", 'sigma = "big"', "sigma"), ("box = { angle = [-1, 1] }", "", "stay"),
    ("box = { angle = [-1, 1] }", "ball = { center = { angle = 0 } }", "radius"),
    ("box = { angle = [-1, 1] }", "ball = { center = { angle = 0 }, radius = -1 }", "radius"),
    ("box = { angle = [-1, 1] }", "halfspace = { normal = { angle = 0 }, bound = 1 }", "normal"),
    ("box = { angle = [-1, 1] }", "polytope = { A = [[1, 0]], b = [1, 2] }", "b"),
    ("box = { angle = [-1, 1] }", "ellipsoid = { center = [0, 0], shape = [[1, 2], [2, 1]] }", "shape"),
    ("box = { angle = [-1, 1] }", "box = { angle = [-1, 1] }\nduring = [0, 9]", "during"),
    ("box = { angle = [-1, 1] }", "box = { angle = [-1, 1] }\nduring = [0.5, 0.2]", "during"),
    ("[parameters]", "[inputs]\nu = [-1, 1]\n[parameters]", "plan"),
    ("[parameters]", '[plan]\nu = "1"\n[parameters]', "plan"),
    ("[parameters]", "[disturbances]\nd = [1, -1]\n[parameters]", "d"),
    ("[parameters]", "[disturbances]\nd = 3\n[parameters]", "d"),
    ("[parameters]", '[inputs]\nu = [-1, 1]\n[plan]\nfile = "none.json"\n[parameters]', "none.json"),
    ("[parameters]", '[inputs]\nu = [-1, 1]\n[plan]\nu = "fast"\n[parameters]', "fast"),
    ("[parameters]", "[domain]\nbox = { angle = [2, 3] }\n[parameters]", "domain"),
    ("[parameters]", '[definitions]\nangle = "1"\n[parameters]', "angle"),
    ("[parameters]", "[cost]\nQ = [1, 2, 3]\n[parameters]", "cost"),
    ("[[stay]]", "[stay]", "stay"), ("[[stay]]\nbox", "[[stay.box]]\nangle", "stay"), ('"swing"', "5", "`name`"),
    ("delta = 1e-3", "delta = 2024-01-01", "delta"), ("horizon = 1.0", "horizon = true", "horizon"),
    ("[[-0.1, 0.1], [-0.1", "[[nan, 0.1], [-0.1", "initial.box.angle.0"), ('[[0], ["sigma"]]', "[]", "noise.diffusion"),
    ("[[-0.1, 0.1], [-0.1", "[[-inf, 0.1], [-0.1", "initial"), ('[[0], ["sigma"]]', "[[], []]", "noise.diffusion"),
    ('[[0], ["sigma"]]', '[[0, 1], ["sigma"]]', "noise.diffusion"), ('["sigma"]]', "[nan]]", "noise.diffusion.1.0"),
    ('[[0], ["sigma"]]', "[0, 0.02]", "diffusion"), ("sigma = 0.05", "sigma = inf", "parameters.sigma"),
    ("sigma = 0.05", "sigma = [1, 2]", "parameters.sigma"), ("angle = [-1, 1]", 'angle = ["1 rad", 2]', "angle.0"),
    ('"angle", "speed"]', '"\u00e1ngulo", "speed"]', "'angle'"), ("-sin(angle)", "\u2212sin(angle)", "\u2212"),
    ("[parameters]", '[units]\nangl = "rad"\n[parameters]', "angl"), ("-sin(angle)", "(" * 5000 + ")" * 5000, "speed"),
    ("-sin(angle)", "__import__('os').getpid()", "dynamics.speed"), ("-sin(angle)", "dv/dt = 1", "dynamics.speed"),
    ("[parameters]", '[definitions]\na = "b"\nb = "a"\n[parameters]', "definitions.a"),
    ("[parameters]", '[networks]\np = "none.onnx"\n[parameters]', "`networks.p`"),
    ("[parameters]", '[networks]\np = "folder.npz"\n[parameters]', "`networks.p`"),
    ("[parameters]", '[networks]\np = "broken.npz"\n[parameters]', "`networks.p`"),
]  # fmt: skip
STEPPED = [
    ("std = 0.1", "stdev = 0.1", "stdev"), ("std = 0.1", "std = 0.1\nvariance = 0.01", "variance"),
    ("std = 0.1", "std = -0.1", "std"), ("std = 0.1", "variance = -1", "variance"), ("std = 0.1", "", "std"),
    ("std = 0.1", "sigma = 0.1", "sigma"), ('"gaussian"', '"cauchy"', "law"), ('"gaussian"', '"uniform"', "halfwidth"),
    ("std = 0.1", "covariance = [[1, 0], [0, 1]]", "covariance"), ("horizon = 5", "horizon = 2.5", "horizon"),
    ("point = [0]", "point = [0, 1]", "initial"), ("point = [0]", "point = 0", "point"),
    ("point = [0]", "gaussian = { mean = [0], covariance = [[-1]] }", "covariance"),
    ("point = [0]", "point = [0]\nbox = [[0, 1]]", "initial"), ("x = [-1, 1]", "x = [-1, 1], y = [0, 1]", "'y'"),
]  # fmt: skip
LINES = [
    ("verify none.toml", "none.toml"), ("verify nothing", "nothing"), ("verify ou --method magic", "method"),
    ("verify ou --method thm4", "thm4"), ("verify ou --delta 0", "delta"), ("verify ou --delta nan", "--delta"),
    ("verify ou --horizon -1", "horizon"), ("verify ou --horizon soon", "--horizon"), ("verify ou --cells 0", "cells"),
    ("verify ou --cells 1.5", "--cells"), ("verify ou --time-limit 0", "--time-limit"), ("verify ou --jobs 0", "jobs"),
    ("verify ou --plot a.xyz", "a.xyz"), ("verify ou --plot no/a.png", "no"), ("verify ou --report .", "."),
    ("verify ou --set", "--set"), ("verify ou --set sigma", "--set"), ("verify ou --set sgma=1", "sgma"),
    ("verify ou --set sigma=big", "sigma"), ("verify ou --set rate=1 --set rate=2", "rate"),
    ("verify ou --set sigma=-1", "sigma"), ("verify ou --set radius=-1", "radius"), ("verify ou more", "more"),
    ("verify ou --set dimension=1.5", "dimension"), ("verify chain --horizon 2.5", "--horizon"), ("verify", "PROBLEM"),
    ("verify chain --set masses=0", "masses"), ("verify math:inf", "math:inf"), ("verify no_such:thing", "no_such"),
    ("simulate ou", "--paths"), ("simulate ou --paths 0", "paths"), ("simulate ou --paths 10 --seed -1", "--seed"),
    ("simulate ou --paths 10 --step 0", "step"), ("sweep ou", "--over"), ("sweep ou --over sigma", "--over"),
    ("sweep ou --over sgma=0.1:0.2:3", "sgma"), ("tune ou --horizon 0", "horizon"), ("check none.json", "none.json"),
    ("check note.txt", "JSON"), ("new a/b", "a"), ("synthesize ou", "inputs"), ("derive ou --nothing", "--nothing"),
    ("vrfy ou", "vrfy"), ("exit-times", "PROBLEM"), ("problems all", "all"), ("verify latin.toml", "UTF-8"),
    ("verify folder.npz", "folder.npz"), ("verify problem.toml --report problem.toml", "own file"),
    ("verify ou --plot a.png --report a.png", "twice"), ("simulate ou --paths 1e300", "paths"),
    ("sweep ou --over sigma=0.1:1:1e9", "at most 1000000"), ("sweep ou --over sigma=nan,1", "sigma"),
    ("new a --example pendulm", "pendulum"), ("check folder.npz", "folder.npz"), ("verify ou --delta 0,01", "--delta"),
    ("sweep ou --over sigma=0.1,0.2 --resume --jobs", "--jobs"),
]  # fmt: skip


def system(**options: Any) -> cb.ContinuousSystem:
    return cb.ContinuousSystem(lambda x: -x, **({"states": 1, "diffusion": [[0.1]]} | options))


def problem(**options: Any) -> cb.Problem:
    given = {"initial": [0.0], "safe": [cb.Inside(cb.Box([-1], [1]))], "horizon": 1.0} | options
    return cb.Problem(given.pop("system", None) or system(), **given)


PYTHON: list[tuple[Callable[[], Any], str]] = [
    (lambda: cb.Box([1], [0]), "low"), (lambda: cb.Box([0, 0], [1]), "high"), (lambda: cb.Ball([0], -1), "radius"),
    (lambda: cb.Ellipsoid([0, 0], [[1, 2], [2, 1]]), "shape"), (lambda: cb.HalfSpace([0, 0], 1), "normal"),
    (lambda: cb.Polytope([[1, 0]], [1, 2]), "b"), (lambda: cb.Gaussian(), "std"),
    (lambda: cb.Gaussian(std=0.1, variance=0.1), "variance"), (lambda: cb.Gaussian(std=-1), "std"),
    (lambda: cb.Uniform(halfwidth=-1), "halfwidth"), (lambda: system(states=2, diffusion=0.1), "diffusion"),
    (lambda: system(diffusion=[[0.1], [0.1]]), "diffusion"), (lambda: system(states=[]), "states"),
    (lambda: system(states=["x", "x"]), "states"), (lambda: system(disturbance=3), "disturbance"),
    (lambda: problem(horizon=0), "horizon"), (lambda: problem(delta=2), "delta"),
    (lambda: problem(safe=cb.Box([-1], [1])), "safe"), (lambda: problem(initial=[3.0]), "initial"),
    (lambda: problem(initial=[0, 0]), "initial"), (lambda: problem(domain=3), "domain"),
    (lambda: problem(plan=np.zeros((2, 1))), "plan"), (lambda: cb.verify_safety(problem(), method="magic"), "method"),
    (lambda: cb.verify_safety(problem(), cells=0), "cells"),
    (lambda: cb.verify_safety(problem(), time_limit=-1), "limit"),
    (lambda: cb.Constants(rate=1.0, sigma=-1.0, dimension=1), "sigma"),
    (lambda: cb.Constants(sigma=1.0, dimension=1), "rate"), (lambda: cb.load("nothing"), "nothing"),
    (lambda: cb.simulate_exits(problem(), paths=0, rng=np.random.default_rng(0)), "paths"),
    (lambda: cb.ContinuousSystem(lambda x: [x[1], -x[0]], states=1), "x of 1"),
    (lambda: cb.ContinuousSystem(lambda x: sum(a for a, _ in [x]), states=3), "x of 3"),
    (lambda: cb.verify_safety(problem(), constants=0.1), "constants"),  # type: ignore[arg-type]
    (lambda: cb.verify_safety(problem(), progress=3), "progress"),  # type: ignore[arg-type]
    (lambda: cb.Constants(rate="fast", sigma=1.0, dimension=1), "rate"),
    (lambda: cb.tune_tube(0.1, horizon=1.0, delta=0.1), "constants"),  # type: ignore[arg-type]
    (lambda: cb.bound_exit_probability(cb.Constants(rate=1.0, sigma=1.0, dimension=1), horizon=1.0, clearance="a"),
     "clearance"),
    (lambda: cb.bound_reach("ou"), "problem"), (lambda: cb.synthesize_plan("ou"), "problem"),  # type: ignore[arg-type]
    (lambda: cb.SafetyFilter("ou"), "problem"), (lambda: cb.save("ou", "a.toml"), "problem"),  # type: ignore[arg-type]
    (lambda: cb.export_casadi("ou"), "problem"),  # type: ignore[arg-type]
    (lambda: cb.ConvexPlanner("ou", horizon=3), "problem"),  # type: ignore[arg-type]
]  # fmt: skip


def cases() -> Iterator[tuple[str, list[str], str, str]]:
    """A name, the words of a command, the file that it reads, and a word of the message."""
    for text, changes in ((GOOD, SWINGS), (STEPS, STEPPED)):
        for old, new, word in changes:
            assert old in text
            yield f"{old!r} -> {new!r}", ["verify", "problem.toml"], text.replace(old, new, 1), word
    for line, word in LINES:
        yield line, line.split(), GOOD, word


CASES = {name: rest for name, *rest in cases()}


def test_there_are_more_than_a_hundred() -> None:
    assert len(CASES) + len(PYTHON) >= 165


def furnish(folder: Path) -> None:
    """Files that are no problems."""
    (folder / "note.txt").write_text("this is neither a problem nor a certificate\n")
    (folder / "folder.npz").mkdir()
    (folder / "broken.npz").write_bytes(b"PK\x03\x04")
    (folder / "latin.toml").write_bytes(GOOD.replace("swing", "schw\u00fcng").encode("latin-1"))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    furnish(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", CASES)
def test_a_wrong_input_on_the_command_line(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words, text, named = CASES[name]
    (folder / "problem.toml").write_text(text)
    assert run([*words, "--json"]) == 2
    captured = capsys.readouterr()
    what, why, cure = captured.err.splitlines()
    assert json.loads(captured.out) == {"error": what[11:], "why": why[7:], "try": cure[7:]}
    assert named in why
    assert len(why) > 20
    assert len(cure) > 12
    python = r"" if "math" in name else r"\bcb\.|"
    assert not re.search(python + r"Traceback|<function|0x[0-9a-f]{6}|at most inf|\bNone\b", why + cure)


@pytest.mark.parametrize("number", range(len(PYTHON)))
def test_a_wrong_input_in_python(number: int) -> None:
    call, named = PYTHON[number]
    with pytest.raises((ValueError, TypeError)) as caught:
        call()
    message = str(caught.value)
    assert f"`{named}" in message or named in message
    assert message.endswith((".", "?"))
    assert re.search(r"\bgot\b|\bgive\b|\bmust not\b|; |, its ", message), message


def page() -> Iterator[str]:
    """Every message, under the input that it answers."""
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)
        furnish(Path(place))
        for name, (words, text, _) in CASES.items():
            Path("problem.toml").write_text(text)
            with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.redirect_stdout(io.StringIO()):
                code = run(words)
            yield f"{name}  [{code}]\n{said.getvalue()}"
        os.chdir(here)
    for call, named in PYTHON:
        try:
            call()
        except Exception as error:  # noqa: BLE001  (the message is what is printed)
            yield f"{named}\n  {type(error).__name__}: {error}\n"
        else:
            yield f"{named}\n  NOTHING\n"


if __name__ == "__main__":
    sys.stdout.writelines(f"{entry}\n" for entry in page())
