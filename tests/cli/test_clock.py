"""``--time-limit`` gives the best answer so far; bars and colours stay on terminals."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from certbound.cli import main
from certbound.cli.app import run
from certbound.cli.clock import Clock
from certbound.cli.commands.simulate import FIRST
from certbound.cli.output import SETTINGS
from certbound.safety.portfolio import ENGINES
from certbound.watch import OutOfTime, Watch, poll


def answer(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    code = run([*words, "--json"])
    return code, json.loads(capsys.readouterr().out)


def slowed(monkeypatch: pytest.MonkeyPatch, module: str, name: str, when: Any) -> None:
    """Let a function take for ever where ``when(arguments)`` holds."""
    import importlib

    home = importlib.import_module(module)
    original = getattr(home, name)

    def slow(*args: Any, **options: Any) -> Any:
        while when(options):
            time.sleep(0.01)
        return original(*args, **options)

    monkeypatch.setattr(home, name, slow)


def test_a_clock_stops_the_work_and_leaves_no_timer() -> None:
    before = signal.getsignal(signal.SIGALRM)
    clock = Clock(0.05)
    with pytest.raises(OutOfTime), clock.running():
        time.sleep(5)
    assert clock.left < 0
    with pytest.raises(OutOfTime), clock.running():
        raise AssertionError("the time was over before")
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert signal.getsignal(signal.SIGALRM) is before
    with Clock(None).running():
        assert Clock(None).left == float("inf")


def test_a_limit_counts_from_where_the_command_began(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """To load the program and to read the problem is part of what somebody waits for."""
    assert Clock(60.0).left > 0
    monkeypatch.setattr(SETTINGS, "began", time.perf_counter() - 100.0)
    assert Clock(60.0).left < 0
    monkeypatch.undo()
    words = ["verify", "ou", "--method", "values", "--time-limit", "60"]
    assert run([*words, "--json"], began=time.perf_counter() - 100.0) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["status"] == "UNKNOWN"
    assert "The search was stopped after 60 s." in found["reason"]
    assert SETTINGS.began is None
    assert run([*words[:2], "--method", "kummer", "--json"]) == 0


def test_the_process_itself_began_before_the_command() -> None:
    """What a process did before the command, here some work, counts where the command is its own."""
    script = (
        "import sys, time\n"
        "while time.process_time() < 0.5: pass\n"
        "import certbound.cli.app as app\n"
        "app.run = lambda arguments, began: sys.exit(7 if time.perf_counter() - began >= 0.5 else 1)\n"
        "from certbound.cli import main\n"
        "main()\n"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False, timeout=300).returncode == 7


def test_no_paths_are_simulated_when_the_time_is_over(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("certbound.simulation.estimates.simulate_exits", lambda *given, **options: pytest.fail("asked"))
    words = ["verify", "ou", "--method", "values", "--time-limit", "60"]
    assert run(words, began=time.perf_counter() - 100.0) == 1
    assert "simulated" not in capsys.readouterr().out


def test_a_limit_waits_for_a_module_that_is_being_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """cvxpy loaded by half had no attribute 'promote' for as long as the process went on."""
    (tmp_path / "slow_to_load.py").write_text("import time\ntime.sleep(0.15)\nwhole = True\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(OutOfTime), Clock(0.01).running():
        assert __import__("slow_to_load") is time.sleep(5)
    assert sys.modules.pop("slow_to_load").whole


def test_a_verdict_in_time_is_the_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("verify", "ou", "--method", "kummer")
    assert answer(capsys, *words, "--time-limit", "60")[1].keys() == answer(capsys, *words)[1].keys()


def endless(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Let engines take for ever."""

    def slow(*_: Any) -> Any:
        while True:
            poll("waiting")
            time.sleep(0.01)

    for name in names:
        monkeypatch.setitem(ENGINES, name, replace(ENGINES[name], prove=slow))


def test_no_engine_in_time_is_unknown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    endless(monkeypatch, *ENGINES)
    monkeypatch.chdir(tmp_path)
    code, found = answer(capsys, "verify", "ou", "--time-limit", "0.2", "--plot", "ou.png", "--certificate", "ou.json")
    assert code == 1
    assert (found["status"], found["log10_delta"], found["tube"]) == ("UNKNOWN", 0.0, None)
    assert "stopped after 0.2 s. More time would go on with" in found["reason"]
    assert [file.name for file in tmp_path.iterdir()] == ["ou.png"]  # limits and sample paths


def test_constants_fall_back_to_the_quick_ones(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    slowed(monkeypatch, "certbound.constants.bounds", "bound_constants", lambda o: "metric" not in o)
    code, found = answer(capsys, "derive", "ou", "--time-limit", "0.4")
    assert code == 0
    assert found["rate"] == -0.5
    assert found["metrics"] == []


def test_tubes_that_were_computed_are_compared(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    slowed(monkeypatch, "certbound.tubes.tuning", "tune_tube", lambda o: o["method"] == "prop1")
    code, found = answer(capsys, "tune", "ou", "--time-limit", "0.6")
    assert code == 0
    assert found["method"] in {row["method"] for row in found["rows"]}
    assert "prop1" not in {row["method"] for row in found["rows"]}


@pytest.mark.parametrize("command", ["derive", "tune"])
def test_nothing_in_time_is_a_failure(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    slowed(monkeypatch, "certbound.constants.bounds", "bound_constants", lambda _: True)
    assert run([command, "ou", "--time-limit", "0.1"]) == 3
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert "within 0.1 s" in lines[1]
    assert "--time-limit" in lines[2]


def test_a_plan_and_a_check_are_given_up_in_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    slowed(monkeypatch, "certbound.synthesis.plans", "synthesize_plan", lambda _: True)
    assert run(["synthesize", "chain", "--time-limit", "0.1"]) == 3
    assert "no plan was found and proved within 0.1 s" in capsys.readouterr().err
    file = tmp_path / "c.json"
    assert run(["verify", "ou", "--method", "kummer", "--certificate", str(file)]) == 0
    capsys.readouterr()
    slowed(monkeypatch, "certbound.checker", "check_data", lambda _: True)
    code, found = answer(capsys, "check", str(file), "--time-limit", "0.1")
    assert (code, found["valid"], found["outcome"]) == (1, False, "not proved")
    assert "the time of 0.1 s was over" in found["reason"]


def test_no_paths_in_time_is_a_failure_and_some_are_an_answer(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("simulate", "ou", "--step", "0.05", "--seed", "1", "--paths", "1e12")
    assert run([*words[:-1], "10"]) == 0  # compiles
    capsys.readouterr()
    slowed(monkeypatch, "certbound.simulation.estimates", "simulate_exits", lambda options: options["paths"] > FIRST)
    assert answer(capsys, *words, "--time-limit", "0.4")[1]["paths"] == FIRST
    slowed(monkeypatch, "certbound.simulation.estimates", "simulate_exits", lambda _: True)
    assert run([*words, "--time-limit", "0.1"]) == 3
    assert "no paths were simulated within 0.1 s" in capsys.readouterr().err


def test_a_watch_within_a_watch_leaves_its_timer_running() -> None:
    began = time.monotonic()

    def work() -> None:
        with Watch(0.3).running():
            with Watch(10.0).running():
                pass
            time.sleep(20)

    with pytest.raises(OutOfTime):
        work()
    assert time.monotonic() - began < 10


def test_deriving_says_what_it_is_at(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from certbound.cli.commands import derive

    heard: list[str] = []

    @contextlib.contextmanager
    def progress(title: str, limit: float | None = None) -> Iterator[Any]:
        yield lambda found: heard.append(found.phase)

    monkeypatch.setattr(derive, "progress", progress)
    assert run(["derive", "ou"]) == 0
    assert {"one metric for all constraints", "a metric for each constraint"} <= set(heard)


def test_as_many_paths_are_simulated_as_fit(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ("simulate", "ou", "--set", "radius=0.8", "--seed", "1")
    assert run([*words, "--paths", "10"]) == 0  # compiles
    capsys.readouterr()
    started = time.perf_counter()
    code, found = answer(capsys, *words, "--paths", "1e12", "--time-limit", "3")
    assert code == 0
    assert 2000 < found["paths"] < 1e12 == found["asked"]
    assert time.perf_counter() - started < 15
    assert found["lower"] < 0.136 < found["upper"]
    assert run([*words, "--paths", "1e12", "--time-limit", "0.2"]) == 0
    assert "of 1000000000000 paths" in capsys.readouterr().out
    assert answer(capsys, *words, "--paths", "500", "--time-limit", "30")[1]["paths"] == 500


COMMAND = [sys.executable, "-m", "certbound", "verify", "ou", "--method", "kummer"]


def test_nothing_but_text_reaches_a_pipe(tmp_path: Path) -> None:
    result = subprocess.run(COMMAND, capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 0
    assert "\x1b" not in result.stdout
    assert result.stderr == ""


def test_a_terminal_gets_colours_and_a_bar(tmp_path: Path) -> None:
    leader, follower = pty.openpty()
    environment = {key: value for key, value in os.environ.items() if key not in ("NO_COLOR", "CI")}
    environment |= {"TERM": "xterm-256color", "COLUMNS": "80"}
    with subprocess.Popen(COMMAND, stdout=follower, stderr=follower, cwd=tmp_path, env=environment) as process:
        os.close(follower)
        shown = b""
        while True:
            try:
                piece = os.read(leader, 4096)
            except OSError:
                break
            shown += piece
            if not piece:
                break
    os.close(leader)
    assert process.returncode == 0
    assert b"SAFE" in shown
    assert b"\x1b[1;32mSAFE" in shown
    assert b"verifying ou" in shown


@pytest.mark.parametrize(
    ("words", "count", "expected"),
    [("certbound ver", 1, ["verify"]), ("certbound verify un", 2, ["unicycle"]), ("certbound sim", 1, ["simulate"])],
)
def test_the_shell_completes_commands_and_problems(
    words: str, count: int, expected: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"_CERTBOUND_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(count)}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "argv", ["certbound"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    assert capsys.readouterr().out.split() == expected
