"""A run that is killed goes on where it was, and only with its own file."""

import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import certbound as cb
from certbound.errors import SolverError
from certbound.simulation import executors
from certbound.simulation.estimates.halving import checkpoint_beside
from certbound.simulation.estimates.montecarlo import simulate_exits
from certbound.simulation.estimates.splitting import simulate_rare_exits

STEPS = 50


def ou(radius=0.8):
    system = cb.ContinuousSystem(lambda x: -0.5 * x, states=1, diffusion=[[0.1**0.5]])
    return cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Ball([0.0], radius))], horizon=5.0)


class Failing(Executor):
    """Runs some chunks, then breaks down."""

    def __init__(self, good):
        self.good = good

    def submit(self, function, /, *args, **kwargs):
        future = Future()
        self.good -= 1
        if self.good < 0:
            future.set_exception(BrokenExecutor("a worker died"))
        else:
            future.set_result(function(*args, **kwargs))
        return future


def test_finished_chunks_are_kept_and_the_answer_is_the_same(tmp_path):
    path = tmp_path / "run.npz"
    whole = simulate_exits(ou(), paths=80_000, rng=1, steps=STEPS)
    with pytest.raises(SolverError, match=r"after \d+ of 80000 paths .*a worker died.*run again with the checkpoint"):
        simulate_exits(ou(), paths=80_000, rng=1, steps=STEPS, checkpoint=path, executor=Failing(30))
    seen = []
    result = simulate_exits(ou(), paths=80_000, rng=1, steps=STEPS, checkpoint=path, progress=seen.append)
    np.testing.assert_array_equal(result.exits_by_time, whole.exits_by_time)
    assert seen[0].paths >= 30 * 1024
    assert seen[-1].paths == seen[-1].total == 80_000
    assert seen[-1].remaining == 0.0
    assert all(state.rate > 0 for state in seen)


def test_without_a_checkpoint_the_message_offers_one():
    with pytest.raises(SolverError, match="give `checkpoint=` to keep work"):
        simulate_exits(ou(), paths=80_000, rng=1, steps=STEPS, executor=Failing(3))


def test_a_finished_checkpoint_answers_at_once_and_brings_its_seed(tmp_path):
    path = tmp_path / "run.npz"
    first = simulate_exits(ou(), paths=5000, rng=1, steps=STEPS, checkpoint=path)
    again = simulate_exits(ou(), paths=5000, steps=STEPS, checkpoint=path, executor=Failing(0))
    np.testing.assert_array_equal(first.exits_by_time, again.exits_by_time)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"problem": ou(0.9)}, "problem"),
        ({"steps": 60}, "problem"),
        ({"paths": 6000}, "number of paths"),
        ({"rng": 2}, "seed"),
    ],
)
def test_a_checkpoint_of_something_else_is_refused_and_kept(tmp_path, changes, what):
    path = tmp_path / "run.npz"
    options = {"problem": ou(), "paths": 5000, "rng": 1, "steps": STEPS, "checkpoint": path}

    def run(problem, **rest):
        return simulate_exits(problem, **rest)

    run(**options)
    content = path.read_bytes()
    with pytest.raises(ValueError, match=f"belongs to another {what}.*choose another file, or delete it"):
        run(**(options | changes))
    assert path.read_bytes() == content


def test_a_checkpoint_of_another_version_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "run.npz"
    simulate_exits(ou(), paths=5000, rng=1, steps=STEPS, checkpoint=path)
    monkeypatch.setattr("certbound.simulation.checkpoint._VERSION", 2)
    with pytest.raises(ValueError, match=r"belongs to another version \(1, here 2\)"):
        simulate_exits(ou(), paths=5000, rng=1, steps=STEPS, checkpoint=path)


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04broken"])
def test_a_file_that_is_no_checkpoint_is_refused(tmp_path, content):
    path = tmp_path / "run.npz"
    path.write_bytes(content)
    for rng in (1, None):
        with pytest.raises(ValueError, match="is not a checkpoint of certbound"):
            simulate_exits(ou(), paths=5000, rng=rng, steps=STEPS, checkpoint=path)
    assert path.read_bytes() == content


def test_another_archive_is_refused(tmp_path):
    path = tmp_path / "run.npz"
    np.savez(path, counts=np.zeros(3))
    with pytest.raises(ValueError, match="is not a checkpoint of certbound"):
        simulate_exits(ou(), paths=5000, rng=1, steps=STEPS, checkpoint=path)


def test_a_folder_that_does_not_exist_is_refused_before_any_work(tmp_path):
    with pytest.raises(ValueError, match="`checkpoint` must lie in an existing folder"):
        simulate_exits(ou(), paths=5000, rng=1, steps=STEPS, checkpoint=tmp_path / "nowhere" / "run.npz")


def test_splitting_goes_on_from_a_checkpoint_too(tmp_path):
    path = tmp_path / "rare.npz"
    options = {"paths": 2000, "particles": 20, "rng": 3, "steps": STEPS}
    whole = simulate_rare_exits(ou(1.2), **options)
    with pytest.raises(SolverError, match="broke down"):
        simulate_rare_exits(ou(1.2), **options, checkpoint=path, executor=Failing(40))
    assert simulate_rare_exits(ou(1.2), **options, checkpoint=path).probability == whole.probability


SCRIPT = """
import sys
import time
import certbound as cb
from certbound.simulation import executors
from certbound.simulation.checkpoint import Checkpoint
from certbound.simulation.estimates import simulate_exits
executors._SAVE_EVERY = 0.0
save = Checkpoint.save
def saved(record):
    if record.done.sum() > 8:
        save(record)
        time.sleep(60.0)
Checkpoint.save = saved
system = cb.ContinuousSystem(lambda x: -0.5 * x, states=1, diffusion=[[0.1**0.5]])
problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Ball([0.0], 0.8))], horizon=5.0)
result = simulate_exits(problem, paths={paths}, rng=5, steps={steps}, checkpoint=sys.argv[1])
print(result.exits)
"""


def test_a_run_that_was_killed_goes_on(tmp_path):
    """It is killed after its first save, in which there is a part of the paths."""
    path = tmp_path / "run.npz"
    paths, steps = 20_000, 200
    script = SCRIPT.format(paths=paths, steps=steps)
    process = subprocess.Popen([sys.executable, "-c", script, str(path)])
    deadline = time.monotonic() + 60
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.kill()
    process.wait()
    kept = np.load(path)
    assert 0 < int(kept["finished"]) < paths
    with ThreadPoolExecutor(2) as pool:
        result = simulate_exits(ou(), paths=paths, rng=5, steps=steps, checkpoint=path, executor=pool)
    whole = simulate_exits(ou(), paths=paths, rng=5, steps=steps)
    assert result.exits == whole.exits
    assert sorted(tmp_path.iterdir()) == [path, checkpoint_beside(path)]


def test_an_interrupted_run_saves_what_is_finished(tmp_path, monkeypatch):
    path = Path(tmp_path / "run.npz")
    monkeypatch.setattr(executors, "_SAVE_EVERY", 1e9)

    def interrupt(state):
        if state.paths > 20_000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_exits(ou(), paths=80_000, rng=1, steps=STEPS, checkpoint=path, progress=interrupt)
    assert int(np.load(path)["finished"]) > 20_000
