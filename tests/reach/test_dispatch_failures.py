"""What fails in one reach engine is no reason not to ask the next."""

from __future__ import annotations

from typing import Any

import pytest

import certbound as cb
from certbound.errors import EngineError
from certbound.reach import dispatch


def failing(*_: Any, **__: Any) -> Any:
    raise ValueError("`value` must be finite")


def test_the_next_engine_is_asked_where_one_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch, "response_reach", failing)
    assert "contraction" in cb.bound_reach(cb.load("ou"), noise=False).method


def test_with_all_failing_the_last_ones_reason_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch, "response_reach", failing)
    monkeypatch.setattr(dispatch, "contraction_reach", failing)
    with pytest.raises(EngineError, match=r"the contraction engine failed \(ValueError: `value` must be finite\)"):
        cb.bound_reach(cb.load("ou"))


def test_cells_that_cannot_be_are_bad_input() -> None:
    with pytest.raises(ValueError, match="`cells` must be a positive integer"):
        cb.bound_reach(cb.load("ou"), cells=0)
