"""Sweeps: the answers of verify_safety, wherever they are proved, and none of them twice."""

from __future__ import annotations

import csv
import io
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.errors import SolverError
from certbound.safety.sweeps import running
from certbound.safety.sweeps.record import digest_of
from certbound.watch import Progress

SIGMAS = [0.05, 0.1, 0.2, 0.4]
SHORT: dict[str, Any] = {"method": "linear", "jobs": 1}


def shrinking(sigma: float = 0.1, radius: float = 1.0, gain: float = 0.5) -> cb.Problem:
    """x+ = gain x + sigma w, three steps within [-radius, radius]."""
    system = cb.DiscreteSystem(lambda x: gain * x, states=1, noise=cb.Gaussian(std=sigma))
    return cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Ball([0.0], radius))], horizon=3, delta=1e-2)


def untimed(found: cb.Sweep) -> list[tuple[Any, ...]]:
    """The points but for their seconds."""
    return [(dict(row.parameters), row.status, row.log10_delta, row.log10_lower, row.method) for row in found.points]


@pytest.fixture
def quick() -> Iterator[dict[str, Any]]:
    """Proved by a thread of this process: for what has nothing to do with copies of it, a tenth of a second each."""
    with ThreadPoolExecutor(1) as pool:
        yield {"method": "linear", "executor": pool}


@pytest.fixture(scope="module")
def whole() -> cb.Sweep:
    return cb.sweep(shrinking, {"sigma": SIGMAS, "horizon": [1, 2]}, **SHORT)


def test_each_point_has_the_verdict_of_its_problem(whole: cb.Sweep) -> None:
    assert len(whole.points) == 8
    for row in whole.points:
        problem = shrinking(row.parameters["sigma"]).replace(horizon=int(row.parameters["horizon"]))
        verdict = cb.verify_safety(problem, method="linear")
        assert (row.status, row.log10_delta, row.reason) == (verdict.status, verdict.log10_delta, verdict.reason)
        assert row.seconds > 0
    assert {row.status for row in whole.points} == {"SAFE", "UNSAFE"}


def test_the_answers_do_not_depend_on_who_works(whole: cb.Sweep) -> None:
    over = {"sigma": SIGMAS, "horizon": [1, 2]}
    two = cb.sweep(shrinking, over, method="linear", jobs=2)
    with ThreadPoolExecutor(3) as pool:
        lent = cb.sweep(shrinking, over, method="linear", executor=pool)
    assert untimed(two) == untimed(lent) == untimed(whole)


def test_a_table_has_a_line_a_point_and_its_seconds_last(whole: cb.Sweep, tmp_path: Path) -> None:
    whole.to_csv(tmp_path / "s.csv")
    head, *lines = csv.reader(io.StringIO((tmp_path / "s.csv").read_text()))
    assert head == ["sigma", "horizon", "status", "log10_delta", "log10_lower", "method", "seconds"]
    assert [float(line[3]) for line in lines] == [row.log10_delta for row in whole.points]
    assert [line[:2] for line in lines[:3]] == [["0.05", "1.0"], ["0.05", "2.0"], ["0.1", "1.0"]]
    assert whole.to_dict()["rows"][0]["parameters"] == {"sigma": 0.05, "horizon": 1.0}


def test_the_boundary_is_that_of_the_whole_grid_for_fewer_proofs(quick: dict[str, Any]) -> None:
    sigmas = np.linspace(0.05, 0.6, 12)
    every = cb.sweep(shrinking, {"sigma": sigmas}, **quick)
    found = cb.sweep(shrinking, {"sigma": sigmas}, boundary="sigma", **quick)
    assert found.boundaries is not None
    (end,) = found.boundaries
    assert end.safe == max(row.parameters["sigma"] for row in every.points if row.status == "SAFE")
    assert end.not_safe == min(row.parameters["sigma"] for row in every.points if row.status != "SAFE")
    assert len(found.points) <= 6
    assert "largest SAFE sigma" in end.summary()
    assert found.table().splitlines()[1] == f"{end.safe},{end.not_safe},{end.log10_delta}"


def test_a_boundary_may_lie_the_other_way_or_nowhere(quick: dict[str, Any]) -> None:
    over = {"sigma": [0.01, 0.1, 3.0], "radius": [0.1, 0.2, 0.4, 0.8, 1.6]}
    found = cb.sweep(shrinking, over, boundary="radius", **quick).boundaries
    assert found is not None
    everywhere, smallest, nowhere = found
    assert (everywhere.safe, everywhere.not_safe) == (1.6, None)
    assert smallest.safe is not None
    assert smallest.not_safe is not None
    assert smallest.not_safe < smallest.safe
    assert "smallest SAFE radius" in smallest.summary()
    assert (nowhere.safe, nowhere.log10_delta) == (None, None)
    assert "neither end" in nowhere.summary()


# ---- going on --------------------------------------------------------------------------------------------------


def test_a_run_goes_on_where_it_was(
    whole: cb.Sweep, quick: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, over = tmp_path / "r.jsonl", {"sigma": SIGMAS, "horizon": [1, 2]}
    first = cb.sweep(shrinking, over, resume=file, **quick)
    lines = file.read_bytes().splitlines(keepends=True)
    assert len(lines) == 9
    file.write_bytes(b"".join(lines[:5]) + lines[5][:20])  # killed while it wrote
    second = cb.sweep(shrinking, over, resume=file, **quick)
    assert [row.seconds for row in second.points[:4]] == [row.seconds for row in first.points[:4]]
    assert untimed(second) == untimed(whole)
    assert len(file.read_bytes().splitlines()) == 9
    monkeypatch.setattr(running, "_proved", lambda problem, settings: 1 / 0)  # nothing is left to prove
    assert untimed(cb.sweep(shrinking, over, resume=file, **quick)) == untimed(whole)
    file.write_bytes(lines[0][:30])
    monkeypatch.undo()
    assert untimed(cb.sweep(shrinking, over, resume=file, **quick)) == untimed(whole)


def test_a_file_of_something_else_is_refused_and_left_alone(quick: dict[str, Any], tmp_path: Path) -> None:
    file, over = tmp_path / "r.jsonl", {"sigma": [0.1, 0.2]}
    cb.sweep(shrinking, over, resume=file, **quick)
    kept = file.read_bytes()
    cases: list[tuple[Any, dict[str, Any], dict[str, Any], str]] = [
        (shrinking, {"sigma": [0.1, 0.3]}, {}, "belongs to another grid"),
        (shrinking, over, {"cells": 2}, "belongs to another settings"),
        (lambda sigma: shrinking(sigma, gain=0.6), over, {}, r"belongs to another problem, at sigma = 0\.1"),
    ]
    for source, grid, more, words in cases:
        with pytest.raises(ValueError, match=words):
            cb.sweep(source, grid, resume=file, **quick, **more)
    assert file.read_bytes() == kept
    damaged = tmp_path / "d.jsonl"
    damaged.write_bytes(kept.replace(b'"status"', b'"stat"', 1))
    with pytest.raises(ValueError, match="damaged in line 2"):
        cb.sweep(shrinking, over, resume=damaged, **quick)
    other = tmp_path / "other.csv"
    other.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="was not written by a sweep"):
        cb.sweep(shrinking, over, resume=other, **quick)


def test_a_killed_run_goes_on_with_the_same_table(quick: dict[str, Any], tmp_path: Path) -> None:
    file, over = tmp_path / "r.jsonl", {"sigma": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]}
    script = (
        f"import sys, certbound as cb\ncb.sweep('ou', {over}, method='linear', jobs=2, resume=sys.argv[1])"
    )
    process = subprocess.Popen([sys.executable, "-c", script, str(file)])
    deadline = time.monotonic() + 120
    while (not file.exists() or file.read_bytes().count(b"\n") < 3) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.kill()
    process.wait()
    kept = file.read_bytes().count(b"\n") - 1
    assert 2 <= kept < 6
    found = cb.sweep("ou", over, resume=file, **quick)
    assert len(found.points) == 6
    assert untimed(found) == untimed(cb.sweep("ou", over, **quick))


def test_a_lost_process_is_replaced(whole: cb.Sweep) -> None:
    killed = []

    def kill(state: Progress) -> None:
        children = multiprocessing.active_children()
        if len(killed) < 2 and children:
            killed.append(children[0].pid)
            os.kill(children[0].pid or 0, signal.SIGKILL)

    found = cb.sweep(shrinking, {"sigma": SIGMAS, "horizon": [1, 2]}, method="linear", jobs=2, progress=kill)
    assert len(killed) == 2
    assert untimed(found) == untimed(whole)


def test_a_point_that_ends_every_process_has_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    proved = running._proved

    def ending(problem: cb.Problem, settings: Any) -> Any:
        if problem.horizon == 2:
            os._exit(9)
        if problem.horizon == 3:
            raise SolverError("two engines contradict each other.")
        return proved(problem, settings)

    monkeypatch.setattr(running, "_proved", ending)
    file = tmp_path / "r.jsonl"
    found = cb.sweep(shrinking, {"horizon": [1, 2, 3]}, resume=file, **SHORT)
    assert [row.status for row in found.points] == ["SAFE", "FAILED", "FAILED"]
    assert "was ended; give it fewer jobs, or more memory" in found.points[1].reason
    assert "contradict" in found.points[2].reason
    assert [json.loads(line)["point"] for line in file.read_text().splitlines()[1:]] == [[1.0]]


def test_a_digest_is_of_what_is_to_be_proved() -> None:
    same = digest_of(shrinking())
    problem = shrinking()
    cb.verify_safety(problem, method="linear")
    assert digest_of(problem) == same
    others = [shrinking(0.2), shrinking(radius=2.0), shrinking(gain=0.4), shrinking().replace(horizon=4),
              shrinking().replace(delta=0.02), shrinking().replace(initial=[0.1])]  # fmt: skip
    assert len({same, *map(digest_of, others)}) == 7


@pytest.mark.parametrize(
    ("source", "over", "more", "words"),
    [
        ("ou", {}, {}, "`over` must be a mapping"),
        ("ou", {"sigma": []}, {}, "at least one value"),
        ("ou", {"sigma": [0.1, 0.1]}, {}, "each value once, got 0.1 twice"),
        ("ou", {"sigma": [0.1, np.nan]}, {}, "must not contain nan"),
        ("ou", {"sigma": np.arange(1000.0), "radius": np.arange(1000.0)}, {}, "at most 100000 points, got 1000000"),
        ("ou", {"sigm": [0.1]}, {}, "`sigm` is no parameter of ou; did you mean 'sigma'"),
        ("ou", {"radius": [-1.0, 1.0]}, {}, "no problem at radius = -1: `radius` must"),
        ("chain", {"horizon": [1.5]}, {}, "counts steps and must be whole"),
        (shrinking, {"sgma": [0.1]}, {}, "`sgma` is no parameter of the function; did you mean 'sigma'"),
        (shrinking(), {"sigma": [0.1]}, {}, "`sigma` is no parameter of a finished problem"),
        (3, {"sigma": [0.1]}, {}, "`source` must be a problem"),
        (lambda sigma: sigma, {"sigma": [0.1]}, {}, "must return a cb.Problem"),
        ("ou", {"sigma": [0.1]}, {"boundary": "sigm"}, "must be a name in `over`, got 'sigm'; did you mean 'sigma'"),
        ("ou", {"sigma": [0.1]}, {"parameters": {"sigma": 1.0}}, "must not hold `sigma`"),
        ("ou", {"sigma": [0.1]}, {"method": "magic"}, "`method` must be one of"),
        ("ou", {"sigma": [0.1]}, {"jobs": 0}, "`jobs` must be a positive number"),
        ("ou", {"sigma": [0.1]}, {"executor": "dask"}, "`executor` must be a concurrent"),
    ],
)
def test_what_is_no_sweep_is_refused(source: Any, over: Any, more: dict[str, Any], words: str) -> None:
    with pytest.raises((ValueError, TypeError), match=words):
        cb.sweep(source, over, **more)


def test_pictures_show_curves_maps_and_boundaries(whole: cb.Sweep, quick: dict[str, Any]) -> None:
    from certbound.plotting import draw_sweep

    figure = draw_sweep(whole)
    assert [axes.get_xlabel() for axes in figure.axes[:1]] == ["sigma"]
    line = cb.sweep(shrinking, {"sigma": SIGMAS}, **quick)
    assert draw_sweep(line).axes[0].get_yscale() == "log"
    end = cb.sweep(shrinking, {"sigma": SIGMAS, "horizon": [1, 2]}, boundary="sigma", **quick)
    assert draw_sweep(end).axes[0].get_ylabel() == "sigma at the boundary"
