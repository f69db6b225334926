"""Fixtures of the tests of value functions."""

from __future__ import annotations

import pytest

from certbound.values.continuous import payment
from certbound.values.continuous.line import ladder


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """First attempts in one state take half the cells and a third of the steps, and fewer ways to pay are looked at.

    What is proved of a proposal is then more of what it costs, and bounds are a few per cent apart.
    """
    monkeypatch.setattr(ladder, "LADDER", ((2.0, 1e-3, 0.03), *ladder.LADDER[1:]))
    for name, some in (("_CUTS", (0.0, 0.5, 2.0, 8.0)), ("_CAPS", (0.03, 0.3)), ("_BASES", (0.0, 0.01))):
        monkeypatch.setattr(payment, name, some)
