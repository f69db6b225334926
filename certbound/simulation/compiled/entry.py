"""The one way into all simulation kernels.

What turns Python's arrays into a kernel's arguments is compiled once for all of them and kept, instead of anew with
each: a sixth of the time that a kernel takes. A kernel is called by its address, in numba's own convention.

Importing this module imports numba: import it inside functions.
"""

from __future__ import annotations

from collections.abc import Callable
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


def _leap(_: Any, address: Any, arguments: Any) -> tuple[Signature, Callable[..., Any]]:
    """Call the function at an address."""

    def generate(context: Any, builder: Any, signature: Signature, values: Any) -> Any:
        convention = context.call_conv
        place = convention.get_function_type(KERNEL.return_type, KERNEL.args).as_pointer()
        given = [builder.extract_value(values[1], i) for i in range(len(KERNEL.args))]
        status, steps = convention.call_function(
            builder, builder.inttoptr(values[0], place), KERNEL.return_type, KERNEL.args, given
        )
        with builder.if_then(status.is_error, likely=False):
            convention.return_status_propagate(builder, status)
        return steps

    return KERNEL.return_type(address, arguments), generate


_call = cast(Any, intrinsic)(_leap)


def _enter(  # type: ignore[no-untyped-def]
    address, stream, starts, signals, inputs, moving, windows, nominal, profile, marks, p, steps, counts, marginals,
    out, notes,
):  # fmt: skip
    return _call(
        address,
        (stream, starts, signals, inputs, moving, windows, nominal, profile, marks, p, steps, counts, marginals, out,
         notes),
    )  # fmt: skip


_options: Any = {"nogil": True, "cache": True, "no_cfunc_wrapper": True}
_enter_kernel = njit(types.int64(types.uintp, *_ARGUMENTS), **_options)(_enter)


def entered(kernel: Any) -> Callable[..., Any]:
    """A kernel of the type `KERNEL`, compiled without a wrapper of its own, as a function; others as they are."""
    code = kernel.overloads.get(KERNEL.args)
    if code is None:
        return kernel  # type: ignore[no-any-return]
    address = code.library.get_pointer_to_function(code.fndesc.llvm_func_name)
    if not address:
        raise RuntimeError("numba gave the compiled kernel no address.")

    def run(*arguments: Any, kept: Any = kernel) -> int:
        return int(_enter_kernel(address, *arguments))

    return run
