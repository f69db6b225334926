"""Fixtures of the tests of value functions."""

from __future__ import annotations

import pytest

from certbound.values.continuous import payment
from certbound.values.continuous.line import ladder


@pytest.fixture
def frugal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sixth of the ways to pay for a residual are looked at: bounds change by some thousandths."""
    for name, some in (("_CUTS", (0.0, 0.5, 2.0, 8.0)), ("_CAPS", (0.03, 0.3)), ("_BASES", (0.0, 0.01))):
        monkeypatch.setattr(payment, name, some)


@pytest.fixture
def lighter(frugal: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """As well, first attempts in one state take two cells of three and as many steps: bounds 4 to 5 per cent apart."""
    monkeypatch.setattr(ladder, "LADDER", ((2.5, 3e-4, 0.01), *ladder.LADDER[1:]))


@pytest.fixture
def coarse(frugal: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """As well, first attempts in one state take half the cells and a third of the steps: bounds some 10 per cent apart.

    Of such a proposal more is left for the proof to pay.
    """
    monkeypatch.setattr(ladder, "LADDER", ((2.0, 1e-3, 0.03), *ladder.LADDER[1:]))
