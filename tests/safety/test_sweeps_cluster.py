"""Sweeps and cells on a dask cluster: the same answers, also where a worker is killed."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import certbound as cb
from certbound.watch import Progress
from tests.reach.linear.test_bisection import flattening

distributed = pytest.importorskip("distributed", reason="needs the extra `cluster` (dask[distributed])")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore"),  # of dask's own making, in processes that are being killed
]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "silence_logs": 50}
    folder = tmp_path_factory.mktemp("dask")
    with distributed.LocalCluster(processes=True, local_directory=str(folder), **options) as running:
        yield running


def lines(found: cb.Sweep) -> list[str]:
    """The table but for the seconds."""
    return [line.rpartition(",")[0] for line in found.table().splitlines()]


def test_a_killed_worker_changes_nothing_in_the_table(cluster: Any, tmp_path: Path) -> None:
    over = {"sigma": [0.1 + 0.02 * k for k in range(20)], "horizon": [1, 2]}
    killed: list[int] = []

    def kill(state: Progress) -> None:
        if state.phase.startswith(("10 ", "11 ", "12 ", "13 ")) and not killed:
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

    here = cb.sweep("ou", over, method="linear")
    with distributed.Client(cluster) as client:
        there = cb.sweep("ou", over, method="linear", executor=client, progress=kill, resume=tmp_path / "r.jsonl")
    assert len(killed) == 1
    assert len(here.points) == 40
    assert lines(there) == lines(here)


def test_cells_on_a_cluster_give_the_same_answer_bit_for_bit(cluster: Any) -> None:
    here = cb.verify_safety(flattening(), method="linear")
    with distributed.Client(cluster) as client:
        there = cb.verify_safety(flattening(), method="linear", executor=client)
    assert here.status == there.status == "SAFE"
    assert here.log10_delta == there.log10_delta
    assert here.deviation is not None
    assert there.deviation is not None
    assert (here.deviation.extent == there.deviation.extent).all()
