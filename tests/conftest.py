"""Kernels of the tests are kept between runs in pytest's own cache, and a test leaves balls as precise as they were.

What is imported and collected stays to the end: the garbage collector does not walk it again and again (that took a
sixth of the time). The workers have one thread of linear algebra each, and keep the memory that NumPy gives back
instead of asking the system for fresh pages (a twentieth of the time). They write bytecode, as .ci/run lets them: else
each of them, and each program that a test starts, compiles the whole package anew (half a second each).
"""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

import pytest

gc.disable()
for _name, _value in (
    ("OPENBLAS_NUM_THREADS", "1"),
    *((f"MALLOC_{name}_", str(1 << 30)) for name in ("TRIM_THRESHOLD", "MMAP_THRESHOLD")),
):
    os.environ.setdefault(_name, _value)  # read when a worker starts
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()
    gc.set_threshold(200_000, 50, 50)


@pytest.fixture(scope="session", autouse=True)
def _kernel_cache(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory):
    cache = getattr(request.config, "cache", None)  # none with -p no:cacheprovider
    folder = tmp_path_factory.mktemp("kernels") if cache is None else Path(cache.mkdir("kernels"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CERTBOUND_CACHE", str(folder))
        yield


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """What a test computes in balls of its own must not change what the next one sees."""
    flint = sys.modules.get("flint")
    if flint is not None and (flint.ctx.prec, flint.ctx.cap) != (53, 10):
        flint.ctx.prec, flint.ctx.cap = 53, 10
        pytest.fail(f"{item.name} leaves flint at another precision; use flint.ctx.workprec, monkeypatch for cap.")
