"""What is loaded, or compiled, when it is first used: names of a package, and functions in loops."""

from __future__ import annotations

import contextlib
import gc
import importlib
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Generic, ParamSpec, TypeVar

from certbound.watch import undisturbed

P = ParamSpec("P")
R = TypeVar("R")

_LOCK = threading.Lock()


def names_in(homes: Mapping[str, str]) -> list[str]:
    """All names of a table from modules to the names that they hold, in its order."""
    return [name for names in homes.values() for name in names.split()]


def lazily(
    package: str, homes: Mapping[str, str], offered: Sequence[str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package: a name comes from its module, and is an attribute from then on."""

    def load(name: str) -> Any:
        for home, names in homes.items():
            if name in names.split():
                value = getattr(importlib.import_module(f"{package}.{home}"), name)
                setattr(sys.modules[package], name, value)
                return value
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return load, lambda: sorted(offered)


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Without the garbage collector, which would walk what a compiler makes again and again: a seventh of its time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


def _protected(made: Any) -> Any:
    """A function of numba that compiles undisturbed, for whatever types it is called the first time.

    Numba's registries and files do not survive an exception while they are filled.
    """

    def undisturbed_compile(*args: Any, **kwargs: Any) -> Any:
        with undisturbed(), uncollected():
            return type(made).compile(made, *args, **kwargs)

    made.compile = undisturbed_compile
    return made


class compiled(Generic[P, R]):
    """A function that numba compiles, and keeps on disk, at its first call; so is what its module compiles beside it.

    To import numba takes as long as a small proof. What is called in a module must be compiled in that module.
    """

    entered = True

    def __init__(self, function: Callable[P, R]) -> None:
        self.function = function
        self.kernel: Callable[P, R] | None = None
        self.__doc__, self.__name__, self.__module__ = function.__doc__, function.__name__, function.__module__

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        if self.kernel is not None:
            return self.kernel(*args, **kwargs)
        with undisturbed(), uncollected():
            return self._ready()(*args, **kwargs)

    def _ready(self) -> Callable[P, R]:
        from numba import njit

        with _LOCK:
            for name, value in list(self.function.__globals__.items()):
                if isinstance(value, compiled) and value.__module__ == self.__module__:
                    ways: Any = {"no_cpython_wrapper": not value.entered, "no_cfunc_wrapper": True}
                    made = _protected(njit(cache=True, nogil=True, **ways)(value.function))
                    value.kernel = self.function.__globals__[name] = made
        assert self.kernel is not None
        return self.kernel


class within(compiled[P, R]):
    """A compiled function that only compiled ones of its module call.

    Without a way in from Python it takes a fifth less time to compile.
    """

    entered = False
