"""Kernels of the tests are kept between runs in pytest's own cache, not in the user's."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session", autouse=True)
def _kernel_cache(request: pytest.FixtureRequest):
    folder = Path(request.config.cache.mkdir("kernels"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CERTBOUND_CACHE", str(folder))
        yield
