"""Whatever is wrong with the input: one line what, one line why, one line what to do, and no stack trace."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from certbound.cli.app import interruptible, run
from tests.cli.problem_files import GOOD, STEPS, change

MODULE = """
import math
import numpy as np
import certbound as cb

def build(f, **options):
    given = {"states": 1, "diffusion": 0.1} | options
    system = cb.ContinuousSystem(f, **given)
    return cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1)

def branching():
    return build(lambda x: -x if x[0] > 0 else x)

def mathematics():
    return build(lambda x: [math.sin(x[0])])

def scalar_noise():
    return build(lambda x: -x, states=2)

def too_many():
    return build(lambda x: [x[0], x[0]])

def bare_noise():
    return cb.DiscreteSystem(lambda x: x, states=1, noise=0.1)

def nothing():
    return 3

def forgetting():
    build(lambda x: -x)

unasked = build(lambda x: -x).system

def dividing():
    return 1 / 0
"""


def refused(capsys: pytest.CaptureFixture[str], words: list[str], code: int = 2) -> list[str]:
    """The three lines of a refusal."""
    assert run(words) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "Traceback" not in captured.err
    lines = captured.err.splitlines()
    assert len(lines) == 3, captured.err
    assert [lines[0][:11], lines[1][:7], lines[2][:7]] == ["certbound: ", "  why: ", "  try: "]
    assert all(len(line) > 15 for line in lines)
    return lines


FILES = {
    "a misspelt key": (change("horizon", "horizn"), "horizn", "horizon"),
    "a misspelt table": (change("[dynamics]", "[dynamcs]"), "dynamcs", "dynamics"),
    "a missing table": (change("[initial]\nbox = [[-0.1, 0.1], [-0.1, 0.1]]", ""), "initial", ""),
    "text that is no TOML": (change("horizon = 1.0", "horizon = = 1"), "not TOML", ""),
    "nothing at all": ("", "", ""),
    "a time that does not exist": (change('"continuous"', '"hybrid"'), "time", "'continuous' or 'discrete'"),
    "one state too few": (change('["angle", "speed"]', '["angle"]'), "speed", ""),
    "a start of the wrong size": (change("[[-0.1, 0.1], [-0.1, 0.1]]", "[[-0.1, 0.1]]"), "initial", "2"),
    "a start upside down": (change("[[-0.1, 0.1], [-0.1", "[[0.1, -0.1], [-0.1"), "low", ""),
    "a start that is unsafe": (change("box = { angle = [-1, 1] }", "box = { angle = [0.05, 1] }"), "initial", ""),
    "a diffusion of the wrong shape": (change('[[0], ["sigma"]]', '[["sigma"]]'), "diffusion", "2"),
    "a scalar diffusion": (change('[[0], ["sigma"]]', "0.1"), "diffusion", ""),
    "a state that does not exist": (change("angle = [-1, 1]", "angel = [-1, 1]"), "angel", "angle"),
    "a name that does not exist": (change("-sin(angle)", "-sin(angel)"), "angel", "angle"),
    "a function that does not exist": (change("-sin(angle)", "-sine(angle)"), "sine", "sin"),
    "code in an expression": (change("-sin(angle)", "__import__('os').getcwd()"), "", ""),
    "an unfinished expression": (change("-sin(angle)", "-sin(angle"), "", ""),
    "a level by a wrong name": (change("std = 0.1", "stdev = 0.1", STEPS), "stdev", "std"),
    "a level that is given twice": (change("std = 0.1", "std = 0.1\nvariance = 0.01", STEPS), "variance", ""),
    "a bare noise level": (change("std = 0.1", "sigma = 0.1", STEPS), "sigma", ""),
    "a law that does not exist": (change('"gaussian"', '"cauchy"', STEPS), "noise.law", "gaussian"),
    "a covariance of the wrong size": (change("std = 0.1", "covariance = [[1, 0], [0, 1]]", STEPS), "covariance", "1"),
    "half a step": (change("horizon = 5", "horizon = 2.5", STEPS), "horizon", ""),
    "a negative horizon": (change("horizon = 1.0", "horizon = -1"), "horizon", ""),
    "a probability above one": (change("delta = 1e-3", "delta = 1.5"), "delta", ""),
    "a domain without bounds": (
        change("-sin(angle)", "angle**3") + "[domain]\nbox = { angle = [-inf, inf] }\n", "", ""
    ),
    "a window after the end": (GOOD + "during = [0, 9]\n", "during", ""),
    "a set that is empty": (change("angle = [-1, 1]", "angle = [1, -1]"), "", ""),
    "a target outside the limits": (STEPS + "[[reach]]\nbox = { x = [2, 3] }\n", "must meet the safe set", "move the"),
    "an intersection that is empty": (
        STEPS + "[[avoid]]\nall = [ { box = { x = [0.3, 0.4] } }, { box = { x = [0.5, 1] } } ]\n", "in common", "",
    ),
    "a start in two dimensions among others": (
        change("[initial]", "[[initial]]", STEPS) + "[[initial]]\npoint = [0, 0]\n", "initial.1.point", "1 entries"
    ),
    "a histogram that sums to less than 1": (
        change('"gaussian"\nstd = 0.1', '"histogram"\nedges = [-1, 0, 1]\nprobabilities = [0.5, 0.499999]', STEPS),
        "must sum to 1 within 1e-12", "scale them",
    ),
    "a window of time that has no end": (
        change("horizon = 5", "horizon = inf", STEPS) + "during = [0, 5]\n", "no `during`", "give a finite horizon"
    ),
    "a target's window without an end": (
        change("horizon = 5", "horizon = inf", STEPS) + "[[reach]]\nbox = { x = [1, 2] }\nduring = [0, 5]\n",
        "`reach` must have no `during`", "give a finite horizon",
    ),
    "an unknown constant upside down": (
        change("[dynamics]", "[uncertain]\nk = [0.5, 0.2]\n[dynamics]", STEPS), "uncertain.k", "swap"
    ),
    "a random start by two levels": (
        change("point = [0]", "gaussian = { mean = [0], std = 1, covariance = [[1]] }", STEPS), "exactly one of std", ""
    ),
    "a plan that is not there": (
        GOOD + '[inputs]\nu = [-1, 1]\n[plan]\nfile = "none.json"\n', "none.json", ""
    ),
    "a key in the wrong table": (change("horizon = 5", 'horizon = 5\nleaving = "ends"', STEPS), "leaving", "[domain]"),
    "a word that is none of two": (
        STEPS + '[domain]\nbox = { x = [-2, 2] }\nleaving = "end"\n', "'unsafe' or 'ends', got 'end'", "domain.leaving"
    ),
    "noise without a law": (change('law = "gaussian"\n', "", STEPS), "noise.law", 'law = "gaussian"'),
    "a definition of a later one": (
        change("[dynamics]", '[definitions]\nf = "2*g"\ng = "1"\n[dynamics]', STEPS), "'g', which stands below", "order"
    ),
    "no sign to multiply": (change("-sin(angle)", "-2angle"), "'angle'", "2*angle"),
    "a comma for a point": (change("-sin(angle)", "-0,5*angle"), "','", "point"),
    "a function of NumPy": (change("-sin(angle)", "-np.sin(angle)"), "'.'", "sin(x)"),
    "a radius below 0": (STEPS + "[[avoid]]\nball = { center = [3], radius = -1 }\n", "avoid.0.ball.radius", ""),
    "a window that ends before it begins": (STEPS + "during = [2, 1]\n", "stay.0.during", ""),
    "a negative standard deviation": (change("std = 0.1", "std = -0.1", STEPS), "noise.std", ""),
    "a key that stands twice": (change("horizon = 5", "horizon = 5\nhorizon = 6", STEPS), "not TOML", "twice"),
    "inputs without a plan": (GOOD + "[inputs]\nu = [-1, 1]\n", "plan", "plan"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "why", "cure"), FILES.values(), ids=FILES.keys())
def test_a_wrong_problem_file(
    text: str, why: str, cure: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "problem.toml"
    path.write_text(text)
    command = "derive" if "angle**3" in text else "verify"
    lines = refused(capsys, [command, str(path)])
    assert why in lines[1]
    assert cure in lines[1] + lines[2]


def test_the_files_are_right_but_for_what_is_changed(tmp_path: Path) -> None:
    for name, text in {"good": GOOD, "steps": STEPS}.items():
        (tmp_path / f"{name}.toml").write_text(text)
        assert run(["verify", str(tmp_path / f"{name}.toml"), "--json"]) == 0


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("branching", "np.where"),
        ("mathematics", "np.sin"),
        ("scalar_noise", "np.eye(2)"),
        ("too_many", "must return 1 values"),
        ("bare_noise", "cb.Gaussian(std=..."),
        ("nothing", "must be a cb.Problem"),
        ("dividing", "division by zero"),
        ("missing", "has no 'missing'"),
        ("forgetting", "returned None"),
        ("unasked", "the `system` of a cb.Problem"),
    ],
)
def test_a_wrong_model_in_python(
    name: str, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models_of_mine.py").write_text(MODULE)
    monkeypatch.delitem(sys.modules, "models_of_mine", raising=False)
    lines = refused(capsys, ["verify", f"models_of_mine:{name}"])
    assert why in " ".join(lines)


@pytest.mark.parametrize(("text", "why"), [("1 +", "models_of_mine"), ("import not_there", "not_there")])
def test_a_module_that_cannot_be_imported(
    text: str, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models_of_mine.py").write_text(text)
    monkeypatch.delitem(sys.modules, "models_of_mine", raising=False)
    assert why in " ".join(refused(capsys, ["verify", "models_of_mine:problem"]))


@pytest.mark.parametrize(
    ("words", "why", "cure"),
    [
        (["verify", "ou", "--plot", "tube.xyz"], "xyz", "png"),
        (["verify", "ou", "--report", "."], "directory", "file"),
        (["verify", "ou", "--certificate", "no/such/place.json"], "does not exist", "mkdir"),
        (["verify", "ou", "--time-limit", "0"], "positive", "verify --help"),
        (["verify", "ou", "--time-limit", "soon"], "number", "verify --help"),
        (["check", "none.json"], "none.json", ""),
        (["check", "note.txt"], "", ""),
        (["verify", "note.txt"], "TOML", ""),
        (["verify", "."], "", ""),
        (["verify", "model.tml"], "No such file", "certbound new"),
        (["verify", "model.py"], "module:name", "model:problem"),
        (["verify", "nothing"], "no bundled problem", "known: chain"),
        (["simulate", "ou"], "--paths", "simulate --help"),
        (["simulate", "ou", "--paths", "100", "--time-limit", "5", "--checkpoint", "run.npz"], "--checkpoint", ""),
        (["new", "a/b"], "", ""),
        (["tune", "chain", "--horizon", "0.5"], "whole", ""),
        (["derive", "ou", "--delta", "0.1"], "--delta", "derive --help"),
        (["--paths"], "--paths", "certbound --help"),
    ],
)
def test_a_wrong_command_line(
    words: list[str], why: str, cure: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "note.txt").write_text("this is neither a problem nor a certificate\n")
    lines = refused(capsys, words)
    assert why in lines[1]
    assert cure in lines[2]
    assert [path.name for path in tmp_path.iterdir()] == ["note.txt"]


def test_an_output_that_may_not_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda *_, **__: False)
    lines = refused(capsys, ["verify", "ou", "--plot", str(tmp_path / "ou.png")])
    assert "cannot be written" in lines[1]


def test_a_disk_that_is_full(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device", "ou.png")

    monkeypatch.setattr(os, "replace", full)
    assert run(["verify", "ou", "--method", "kummer", "--plot", str(tmp_path / "ou.png")]) == 2
    captured = capsys.readouterr()
    assert captured.out.startswith("SAFE")  # the verdict stands
    assert "No space left" in captured.err.splitlines()[1]
    assert list(tmp_path.iterdir()) == []


def test_an_extra_that_is_not_installed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    lines = refused(capsys, ["simulate", "ou", "--paths", "10", "--cluster", "tcp://127.0.0.1:9"])
    assert "certbound[cluster]" in lines[2]


def test_an_interrupted_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import certbound.safety.verification as verification

    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(verification, "verify_safety", stop)
    lines = refused(capsys, ["verify", "ou", "--report", str(tmp_path / "ou.html")], code=130)
    assert "interrupted" in lines[0]
    assert "--time-limit" in lines[2]
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_that_compiled_code_drops_comes_again() -> None:
    class Dropped:
        def __del__(self) -> None:
            raise KeyboardInterrupt

    def waited() -> None:
        with interruptible() as lost:
            Dropped()
            assert lost
            for _ in range(1000):
                time.sleep(0.01)  # not one long sleep: what comes again is looked at between two lines of Python

    before, hook = signal.signal(signal.SIGINT, signal.default_int_handler), sys.unraisablehook
    try:
        with pytest.raises(KeyboardInterrupt):
            waited()
    finally:
        signal.signal(signal.SIGINT, before)
    assert sys.unraisablehook is hook


def _handed_over(text: str, pipe: Path, process: subprocess.Popen[str]) -> None:
    """Write to a pipe once a process reads it; it must not have ended before."""
    while True:
        assert process.poll() is None, process.communicate()[1]
        try:
            end = os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:  # nobody reads it yet
            time.sleep(0.02)
            continue
        with os.fdopen(end, "w") as file:
            file.write(text)
        return


def test_a_program_that_is_stopped_from_outside(tmp_path: Path) -> None:
    """Ctrl-C in a terminal: SIGINT to the installed program."""
    file = tmp_path / "swing.toml"
    command = [sys.executable, "-m", "certbound", "simulate", str(file), "--paths", "1e12", "--step", "0.005"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    os.mkfifo(file)  # it can be written to as soon as the program reads its problem: it has started
    # a program in the background of a shell inherits that Ctrl-C is ignored
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        for patience in (0.6, 10.0, 40.0):
            process = subprocess.Popen(command, text=True, cwd=tmp_path, **pipes)
            try:
                _handed_over(GOOD, file, process)
                time.sleep(patience)
                process.send_signal(signal.SIGINT)
                out, err = process.communicate(timeout=20)
            except subprocess.TimeoutExpired:  # it came within a weak reference's callback, where Python drops it
                continue
            finally:
                process.kill()
            if process.returncode != -signal.SIGINT:  # else it came before the program's own handler was there
                break
    finally:
        signal.signal(signal.SIGINT, before)
    assert process.returncode == 130
    assert out == ""
    said = [line for line in err.splitlines() if not line.startswith("simulating: ")]  # how far it was, after 10 s
    assert len(said) == 3
    assert "Traceback" not in err


def test_a_reader_that_goes_away_is_no_error(tmp_path: Path) -> None:
    command = f"{sys.executable} -m certbound problems --json | head -c 1"
    result = subprocess.run(command, shell=True, capture_output=True, text=True, cwd=tmp_path)
    assert result.stdout == "{"
    assert result.stderr == ""
