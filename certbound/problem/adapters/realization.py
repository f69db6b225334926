"""State equations for transfer functions: the observer form, whose first state is the output.

y_i = sum_j n_ij(s)/d_i(s) u_j with d_i = s^n + a_1 s^(n-1) + ... + a_n, the product of the row's distinct
denominators: x_k' = x_(k+1) - a_k x_1 + (b_kj - a_k b_0j) u_j and y = x_1 + b_0j u_j (x+ in discrete time, in powers of
z). Nothing is cancelled. Products and quotients of coefficients are those of floating point: what is certified is the
system that is made here, whose matrices can be read.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from certbound.arrays import Array


def realized(
    num: Sequence[Sequence[Any]], den: Sequence[Sequence[Any]], outputs: Sequence[str], inputs: Sequence[str]
) -> tuple[Array, Array, Array, Array, list[str]]:
    """A, B, C, D and the states' names of a matrix of transfer functions, given by coefficients, highest power first.

    The states of the output y are y, y_2, y_3, ... An entry that is improper is a ValueError.

    Examples
    --------
    >>> A, B, C, D, names = realized([[[1.0, 3.0]]], [[[2.0, 4.0, 6.0]]], ["y"], ["u"])
    >>> A.tolist(), B.tolist(), C.tolist(), D.tolist(), names
    ([[-2.0, 1.0], [-3.0, 0.0]], [[0.5], [1.5]], [[1.0, 0.0]], [[0.0]], ['y', 'y_2'])
    """
    blocks = [_row(tops, bottoms, output, inputs) for tops, bottoms, output in zip(num, den, outputs)]
    names = [f"{output}_{k + 1}" if k else output for output, (a, _, _) in zip(outputs, blocks) for k in range(len(a))]
    a, c, first = np.zeros((len(names), len(names))), np.zeros((len(blocks), len(names))), 0
    for row, (block, _, _) in enumerate(blocks):
        last = first + len(block)
        a[first:last, first:last] = block
        c[row, first:last][:1] = 1.0
        first = last
    return a, np.vstack([b for _, b, _ in blocks]), c, np.vstack([d for _, _, d in blocks]), names


def _row(num: Sequence[Any], den: Sequence[Any], output: str, inputs: Sequence[str]) -> tuple[Array, Array, Array]:
    """A, B and D of one output."""
    tops, bottoms = [], []
    for top, bottom, label in zip(map(_trimmed, num), map(_trimmed, den), inputs):
        if len(top) > len(bottom):
            raise ValueError(
                f"the transfer function from {label} to {output} must be proper, got degree {len(top) - 1} over "
                f"{len(bottom) - 1}; divide it by a filter, such as (0.01 s + 1)."
            )
        tops.append(top / bottom[0])
        bottoms.append(tuple(bottom / bottom[0]) if len(top) else (1.0,))
    distinct = list(dict.fromkeys(bottoms))
    common = functools.reduce(np.convolve, distinct, np.ones(1))
    powers = np.zeros((len(common), len(tops)))
    for column, (top, own) in enumerate(zip(tops, bottoms)):
        wide = functools.reduce(np.convolve, (other for other in distinct if other != own), top) if len(top) else top
        powers[len(common) - len(wide) :, column] = wide
    a = np.eye(len(common) - 1, k=1)
    a[:, :1] -= common[1:, None]
    return a, powers[1:] - common[1:, None] * powers[0], powers[:1]


def _trimmed(coefficients: Any) -> Array:
    """Without leading zeros."""
    return np.trim_zeros(np.asarray(coefficients, dtype=float), "f")
