"""The ways into simulation kernels.

What turns Python's arrays into a kernel's arguments is compiled once for all of them and kept, instead of anew with
each: a sixth of the time that a kernel takes. A kernel is called by its address, in numba's own convention.

Importing this module imports numba: import it inside functions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

from numba import njit, types
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

_F1, _F2, _F3 = (types.Array(types.float64, count, "C") for count in (1, 2, 3))
_I1, _I2, _I4 = (types.Array(types.int64, count, "C") for count in (1, 2, 4))
_WORDS = types.Array(types.uint64, 1, "C")
_ARGUMENTS = (_WORDS, _F2, _F2, _F2, _F2, _I2, _F2, _F1, _I1, _F1, types.int64, _I2, _I4, _F3, _F1)
KERNEL = types.int64(*_ARGUMENTS)
"""What a kernel takes: stream, starts, signals, inputs, moving, windows, nominal, profile, marks, p, steps, counts,
marginals, out, notes; it returns steps."""
FOLLOW = types.int64(_WORDS, _F2, _F2, _F2, _I2, _F2, _F1, types.int64, _F1, _F3, _F3, _F2, types.int64, types.int64)
"""What a kernel of importance splitting takes: stream, signals, inputs, moving, windows, nominal, p, steps, notes,
states, frees, tops, path, first; it returns steps."""
OPTIONS: Any = {"nogil": True, "cache": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def leap(kind: Signature) -> Any:
    """For compiled functions: a call of the function of a type that is at an address, with a tuple of arguments."""

    def typed(_: Any, address: Any, arguments: Any) -> tuple[Signature, Callable[..., Any]]:
        def generate(context: Any, builder: Any, signature: Signature, values: Any) -> Any:
            convention = context.call_conv
            place = convention.get_function_type(kind.return_type, kind.args).as_pointer()
            given = [builder.extract_value(values[1], i) for i in range(len(kind.args))]
            status, result = convention.call_function(
                builder, builder.inttoptr(values[0], place), kind.return_type, kind.args, given
            )
            with builder.if_then(status.is_error, likely=False):
                convention.return_status_propagate(builder, status)
            return result

        return kind.return_type(address, arguments), generate

    return cast(Any, intrinsic)(typed)


_call = leap(KERNEL)


def _enter(  # type: ignore[no-untyped-def]
    address, stream, starts, signals, inputs, moving, windows, nominal, profile, marks, p, steps, counts, marginals,
    out, notes,
):  # fmt: skip
    return _call(
        address,
        (stream, starts, signals, inputs, moving, windows, nominal, profile, marks, p, steps, counts, marginals, out,
         notes),
    )  # fmt: skip


enter = njit(types.int64(types.uintp, *KERNEL.args), **OPTIONS)(_enter)


def entered(kernel: Any, ways: Sequence[tuple[Signature, Callable[..., Any]]]) -> Callable[..., Any]:
    """A kernel compiled without a wrapper of its own as a function, by the way of its type; others as they are."""
    for kind, way in ways:
        if kind.args in kernel.overloads:
            return _bound(kernel, kernel.overloads[kind.args], way)
    return kernel  # type: ignore[no-any-return]


def _bound(kernel: Any, code: Any, way: Callable[..., Any]) -> Callable[..., Any]:
    address = code.library.get_pointer_to_function(code.fndesc.llvm_func_name)
    if not address:
        raise RuntimeError("numba gave the compiled kernel no address.")

    def run(*arguments: Any, kept: Any = kernel) -> int:
        return int(way(address, *arguments))

    return run
