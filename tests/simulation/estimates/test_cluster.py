"""The same answer from worker processes of a real cluster, also when one is killed, and when the scheduler goes."""

import os
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest

import certbound as cb
from certbound.errors import SolverError
from certbound.parallel import connect
from certbound.simulation.estimates.montecarlo import simulate_exits

distributed = pytest.importorskip("distributed", reason="needs the extra `cluster` (dask[distributed])")

pytestmark = pytest.mark.filterwarnings("ignore")  # of dask's own making, in processes that are being killed
PATHS, STEPS = 400_000, 100


def ou():
    system = cb.ContinuousSystem(lambda x: -0.5 * x, states=1, diffusion=[[0.1**0.5]])
    return cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Ball([0.0], 0.8))], horizon=5.0)


@pytest.fixture(scope="module")
def truth():
    return simulate_exits(ou(), paths=PATHS, rng=1, steps=STEPS).exits_by_time


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "silence_logs": 50}
    folder = tmp_path_factory.mktemp("dask")
    with distributed.LocalCluster(processes=True, local_directory=str(folder), **options) as running:
        yield running


def test_two_workers_give_the_answer_of_this_process(cluster, truth):
    with distributed.Client(cluster) as client:
        result = simulate_exits(ou(), paths=PATHS, rng=1, steps=STEPS, executor=client)
    np.testing.assert_array_equal(result.exits_by_time, truth)


@pytest.mark.slow
def test_a_clients_own_executor_will_do(cluster, truth):
    with distributed.Client(cluster) as client, client.get_executor() as pool:
        result = simulate_exits(ou(), paths=PATHS, rng=1, steps=STEPS, executor=pool)
    np.testing.assert_array_equal(result.exits_by_time, truth)


def test_a_worker_that_is_killed_changes_nothing(cluster, truth):
    killed = []

    def kill(state):
        if state.paths > PATHS // 8 and not killed:
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

    with distributed.Client(cluster) as client:
        result = simulate_exits(ou(), paths=PATHS, rng=1, steps=STEPS, executor=client, progress=kill)
    assert len(killed) == 1
    np.testing.assert_array_equal(result.exits_by_time, truth)


@pytest.mark.slow
def test_a_lost_scheduler_is_an_error_and_the_checkpoint_goes_on(tmp_path, truth):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    address, module = f"tcp://127.0.0.1:{port}", "distributed.cli.dask_"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    scheduler = subprocess.Popen(
        [sys.executable, "-m", f"{module}scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"],
        **quiet,
    )
    worker = subprocess.Popen(
        [sys.executable, "-m", f"{module}worker", address, "--no-nanny", "--local-directory", str(tmp_path)], **quiet
    )

    def kill(state):
        if state.paths > PATHS // 8:
            scheduler.kill()

    options = {"paths": PATHS, "rng": 1, "steps": STEPS, "checkpoint": tmp_path / "run.npz"}
    try:
        client = connect(address, timeout=60)
        client.wait_for_workers(1, timeout=60)
        with pytest.raises(SolverError, match=r"the scheduler is gone.*run again with the checkpoint"):
            simulate_exits(ou(), **options, executor=client, progress=kill)
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()
    client.close(timeout=1)
    assert int(np.load(options["checkpoint"])["finished"]) > PATHS // 8
    np.testing.assert_array_equal(simulate_exits(ou(), **options).exits_by_time, truth)


def test_a_scheduler_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match=r"must be the address of a running dask scheduler, got 'tcp://127.0.0.1:9'"):
        connect("tcp://127.0.0.1:9", timeout=0.5)


def test_an_address_that_is_none_is_refused():
    with pytest.raises(ValueError, match="must be the address of a running dask scheduler"):
        connect("nonsense://x", timeout=0.5)


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r"pip install 'certbound\[cluster\]'"):
        connect("tcp://127.0.0.1:9")
