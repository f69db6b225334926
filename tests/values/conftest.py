"""Fixtures of the tests of value functions."""

from __future__ import annotations

import pytest

from certbound.values.continuous.line import ladder


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """First attempts in one state take half the cells and a third of the steps: what they pay for is the more."""
    monkeypatch.setattr(ladder, "LADDER", ((2.0, 1e-3, 0.03), *ladder.LADDER[1:]))
