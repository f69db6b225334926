"""Functions in loops are compiled at their first call, with those of their module that they call."""

import signal
from typing import Any

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from certbound.lazy import compiled, within


@compiled
def _once(x: float) -> float:
    """A number and a half."""
    return 1.5 * x


@compiled
def _summed(x: np.ndarray) -> float:
    total = 0.0
    for k in range(len(x)):
        total += _once(x[k])
    return total


IMPORTED = (_summed, _once)  # as another module has them


def test_a_module_is_compiled_when_one_of_its_functions_is_called():
    given, other = IMPORTED
    assert isinstance(given, compiled)
    assert other.__doc__ == "A number and a half."
    assert given(np.array([1.0, 3.0])) == 6.0
    assert given(np.arange(3)) == 4.5
    assert other.kernel is _once is globals()["_once"]
    assert len(given.kernel.nopython_signatures) == 2


@within
def _halved(x: float) -> float:
    return 0.5 * x


@compiled
def _half_of(x: float) -> float:
    return _halved(x)


def test_what_only_compiled_functions_call_has_no_way_in_from_python():
    assert _half_of(3.0) == 1.5
    assert [one.targetoptions["no_cpython_wrapper"] for one in (_half_of, _halved)] == [False, True]
    assert _half_of.targetoptions["no_cfunc_wrapper"]
    assert _halved.targetoptions["no_cfunc_wrapper"]


@compiled
def _doubled(x: float) -> float:
    return _twice(x)


@compiled
def _twice(x: float) -> float:
    return 2 * x


ELSEWHERE = (_doubled, _twice)


def test_no_timer_interrupts_a_compilation_for_other_types_than_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """An interrupted one leaves a library without its object code, which fails whenever it is asked for."""
    masked: list[bool] = []
    compile_for = Dispatcher.compile

    def seen(self: Any, *args: Any) -> Any:
        masked.append(signal.SIGALRM in signal.pthread_sigmask(signal.SIG_BLOCK, []))
        return compile_for(self, *args)

    monkeypatch.setattr(Dispatcher, "compile", seen)
    doubled, twice = ELSEWHERE
    assert doubled(1.5) == 3.0
    assert doubled(1.5 + 0j) == 3.0  # another type
    assert twice(2) == 4  # a function that was not called itself before
    assert len(masked) >= 3
    assert all(masked)
