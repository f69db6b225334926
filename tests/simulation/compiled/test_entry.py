"""Kernels without wrappers of their own: what they return and raise comes out, also of those that were kept."""

import numpy as np
import pytest

from certbound.simulation.compiled import cache, load_kernel
from certbound.simulation.compiled.entry import KERNEL

NAMES = (
    "stream, starts, signals, inputs, moving, windows, nominal, profile, marks, p, steps, counts, marginals, out, notes"
)
SOURCE = f"""
from numba import njit
from certbound.simulation.compiled.entry import KERNEL

@njit(KERNEL, nogil=True, cache=@CACHE@, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def run({NAMES}):
    if steps < 0:
        raise ValueError("no steps")
    notes[0] = starts[1, 0] + p[1]
    counts[0, 1] += steps
    return marginals.shape[3] * windows[0, 0] + int(stream[0])
"""


@pytest.mark.parametrize("kept", [False, True])
def test_a_kernel_reads_and_writes_what_it_is_given(tmp_path, monkeypatch, kept):
    tmp_path.chmod(0o700)
    monkeypatch.setenv("CERTBOUND_CACHE", str(tmp_path) if kept else "off")
    for _ in range(1 + kept):
        monkeypatch.setattr(cache, "_LOADED", {})
        kernel = load_kernel(SOURCE)
        types = dict(zip(NAMES.split(", "), KERNEL.args))
        given = {
            name: 7 if name == "steps" else np.full((2,) * kind.ndim, 3, dtype=str(kind.dtype))
            for name, kind in types.items()
        }
        assert kernel(*given.values()) == 2 * 3 + 3
        assert given["notes"].tolist() == [6.0, 3.0]
        assert given["counts"].tolist() == [[3, 10], [3, 3]]
        with pytest.raises(ValueError, match="no steps"):
            kernel(*{**given, "steps": -1}.values())
        with pytest.raises(TypeError, match="No matching definition"):
            kernel(*{**given, "p": given["counts"]}.values())
    assert len(list(tmp_path.rglob("*.nbc"))) == kept
