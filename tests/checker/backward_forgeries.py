"""Forged certificates by the backward equation: part of ``FORGERIES``."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable

import numpy as np

from certbound.safety.answers import exact
from tests.checker import conftest
from tests.checker.forgeries import _BASES, Data, _scale, _sharp, forges

LESS = "less than the claimed|no bound above 0"
MORE = "more than the claimed"
_PROOF, _SPLINES = "values/kolmogorov/solution.py", "values/kolmogorov/patches.py"
_TAPES, _STAGE = "values/batch_tapes.py", "values/kolmogorov/stage.py"
_RESIDUAL, _CELLS = "values/kolmogorov/patch_residual.py", "values/kolmogorov/cell_operator.py"

_BASES |= {
    "solved": _sharp(lambda: conftest.backward_certificate(conftest.toggle)),
    "solved below": _sharp(lambda: conftest.backward_certificate(conftest.loud_toggle, lower=True, steps=16)),
    "swung": _sharp(lambda: conftest.backward_certificate(conftest.pendulum)),
    "swung below": _sharp(
        lambda: conftest.backward_certificate(conftest.loud_pendulum, lower=True, cell=0.12, steps=16)
    ),
    "hunted": _sharp(lambda: conftest.backward_certificate(conftest.predator)),
}


def changed(data: Data, name: str, change: Callable[[np.ndarray], None], stage: int = 0) -> None:
    """Change the whole numbers of a packed array, time first."""
    proof = data["proof"]["stages"][stage] if "stages" in data["proof"] else data["proof"]
    shape = (len(proof["times"]), *(len(axis) + 4 for axis in proof["axes"]))
    words = zlib.decompress(base64.b64decode(proof[name])).decode().split(" ")
    found = np.array(list(map(int, words))).reshape(shape)
    axes = (0, *range(found.ndim))
    for axis in axes:
        found = np.cumsum(found, axis=axis)
    change(found)
    for axis in axes:
        found = np.diff(found, axis=axis, prepend=0)
    proof[name] = base64.b64encode(zlib.compress(" ".join(map(str, found.ravel().tolist())).encode())).decode()


def moved(data: Data, place: tuple, amount: float, name: str = "values", stage: int = 0) -> None:
    """Add to some of the coefficients."""
    proof = data["proof"]["stages"][stage] if "stages" in data["proof"] else data["proof"]
    unit = float.fromhex(proof["units"][name == "rates"])

    def change(found: np.ndarray) -> None:
        found[place] += round(amount / unit)

    changed(data, name, change, stage)


def uncut(data: Data) -> None:
    """State so large an eta that no patch is looked at more closely."""
    for proof in data["proof"].get("stages", [data["proof"]]):
        proof["eta"] = exact([1e9] * len(proof["eta"]))


# ---- from above ----------------------------------------------------------------------------------------------


@forges("what v_t + L v exceeds 0 by is paid for", "solved", _RESIDUAL, "Residual._need", MORE)
def _(data: Data) -> None:
    moved(data, (12, 10, 9), -0.01)


@forges("v_t counts in that, as the file states it", "hunted", _RESIDUAL, "Residual._need", MORE)
def _(data: Data) -> None:
    moved(data, (12, 10, 9), 2.0, "rates")


@forges("v at times between those stated is their cubic", "swung", _SPLINES, "Splines.patches", MORE)
def _(data: Data) -> None:
    _scale(data["proof"]["times"], 12, 1.01)


@forges("v between the nodes is their spline", "hunted", _SPLINES, "Splines.matrices", MORE)
def _(data: Data) -> None:
    _scale(data["proof"]["axes"][0], 7, 1.01)


@forges("every slab of time has its coefficients", "solved", _SPLINES, "read_splines", "numbers, got")
def _(data: Data) -> None:
    del data["proof"]["times"][12], data["proof"]["eta"][12]


@forges("the slabs of a solution cover the horizon", "solved", _PROOF, "Solution", "end at the horizon")
def _(data: Data) -> None:
    data["problem"]["horizon"] = exact(1.0001)


@forges("the nodes of a solution rise", "solved", _SPLINES, "read_splines", "numbers of usual size that rise")
def _(data: Data) -> None:
    axis = data["proof"]["axes"][0]
    axis[3], axis[4] = axis[4], axis[3]


@forges("a unit is a power of two", "solved", _SPLINES, "read_splines", "powers of two")
def _(data: Data) -> None:
    _scale(data["proof"]["units"], 0, 0.999)


@forges("sums of what the file states are exact", "solved", _SPLINES, "read_splines", "below 2\\^50")
def _(data: Data) -> None:
    words = zlib.decompress(base64.b64decode(data["proof"]["values"])).split(b" ")
    words[:2] = [b"9" * 15] * 2
    data["proof"]["values"] = base64.b64encode(zlib.compress(b" ".join(words))).decode()


@forges("v reaches 1 where paths leave", "solved", _STAGE, "Stage._at_face", MORE)
def _(data: Data) -> None:
    moved(data, (slice(None), slice(None), 0), -0.2)


@forges("where the drift leads out of a face without noise, v reaches 1", "swung", _CELLS, "Operator.leaving", MORE)
def _(data: Data) -> None:
    moved(data, (slice(None), -1, slice(10, None)), -0.3)


@forges("a face without noise is one by the whole of its row", "swung", _CELLS, "Operator._is_noisy", MORE)
def _(data: Data) -> None:
    data["problem"]["noise"]["diffusion"] = exact([[1e-9], [0.5]])


@forges("v is at least 0 at the horizon", "solved", _STAGE, "Stage._at_end", MORE)
def _(data: Data) -> None:
    moved(data, (-1, 10, 9), -0.5)


@forges("the grid of a solution lies in the safe set", "solved", _STAGE, "Stage.check_box", "grid was not shown")
def _(data: Data) -> None:
    _scale(data["problem"]["constraints"][0]["region"]["high"], 0, 0.9999)


@forges(
    "a start of a solution touches no obstacle", "solved", _PROOF, "Solution._at_starts", "initial set was not shown"
)
def _(data: Data) -> None:
    wall = {"kind": "halfspace", "normal": exact([1.0, 0.0]), "bound": exact(0.5)}
    data["problem"]["constraints"].append({"kind": "outside", "region": wall, "during": None, "label": "a wall"})
    data["problem"]["initial"] |= {"low": exact([0.5, 0.6]), "high": exact([0.5, 0.6])}


@forges("the grid of a solution holds the starts", "solved", _STAGE, "Stage.most_over", "lie in the grid")
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["high"] = exact([3.0, 3.0])
    data["problem"]["initial"] |= {"low": exact([2.7, 0.6]), "high": exact([2.7, 0.6])}


@forges("v is what it is at every start", "solved", _STAGE, "Stage._most_of", MORE)
def _(data: Data) -> None:
    data["problem"]["initial"]["low"] = exact([1.4, 0.5])


@forges("the residual has the model's drift", "hunted", _CELLS, "Operator._drift", MORE)
def _(data: Data) -> None:
    nodes = data["problem"]["dynamics"]["nodes"]
    place = next(k for k, node in enumerate(nodes) if node[0] == "const" and float.fromhex(node[1]) == 3.0)
    _scale(nodes[place], 1, 0.9)


@forges("the residual has the model's noise", "solved", _CELLS, "Operator._squares", MORE)
def _(data: Data) -> None:
    data["problem"]["noise"]["diffusion"] = exact([[0.301, 0.0], [0.0, 0.3]])


@forges("the residual has the noise of every pair of states", "solved", _CELLS, "Operator._squares", MORE)
def _(data: Data) -> None:
    data["problem"]["noise"]["diffusion"] = exact([[0.3, 0.0], [0.03, 0.3]])
    uncut(data)


@forges("nothing is known of the residual where the drift is not", "solved", _RESIDUAL, "Residual.payments", "defined")
def _(data: Data) -> None:
    tape = data["problem"]["dynamics"]
    count = len(tape["nodes"])
    tape["nodes"] += [
        ["input", 1], ["const", exact(-1.5)], ["add", count, count + 1], ["const", exact(1e-12)],
        ["div", count + 3, count + 2], ["add", tape["outputs"][0], count + 4],
    ]  # fmt: skip
    tape["outputs"][0] = count + 5


@forges("where the drift jumps it has all values on either side", "solved", _TAPES, "_on_both_sides", MORE)
def _(data: Data) -> None:
    tape = data["problem"]["dynamics"]
    count = len(tape["nodes"])
    tape["nodes"] += [
        ["input", 1], ["const", exact(-1.5)], ["add", count, count + 1], ["sign", count + 2], ["const", exact(1e-2)],
        ["mul", count + 3, count + 4], ["add", tape["outputs"][0], count + 5],
    ]  # fmt: skip
    tape["outputs"][0] = count + 6
    uncut(data)


# ---- from below ----------------------------------------------------------------------------------------------


@forges("what v_t + L v exceeds 0 by is taken off from below", "solved below", _RESIDUAL, "Residual._need", LESS)
def _(data: Data) -> None:
    moved(data, (12, 8, 6), -0.1)


@forges("paths fail only by faces that break a constraint", "solved below", _STAGE, "Stage._at_face", LESS)
def _(data: Data) -> None:
    _scale(data["problem"]["constraints"][0]["region"]["high"], 0, 1.0001)


@forges("v exceeds -1 where paths fail", "swung below", _STAGE, "Stage._at_face", LESS)
def _(data: Data) -> None:
    moved(data, (slice(None), -1, slice(12, None)), -0.01)


@forges("v is at least 0 where paths leave and do not fail", "swung below", _STAGE, "Stage._at_face", LESS)
def _(data: Data) -> None:
    moved(data, (slice(None), slice(None), -1), -0.01)


@forges("v is at least 0 at the horizon from below", "solved below", _STAGE, "Stage._at_end", LESS)
def _(data: Data) -> None:
    moved(data, (-1, 8, 6), -0.05)


@forges("v is what it is at a stated start", "solved below", _STAGE, "Stage._most_of", LESS)
def _(data: Data) -> None:
    data["problem"]["initial"] |= {"low": exact([1.49, 0.61]), "high": exact([1.49, 0.61])}
    data["proof"]["starts"] = exact([[1.49, 0.61]])


@forges("the stated start of a solution is of the set", "solved below", _PROOF, "check_backward_below", "around")
def _(data: Data) -> None:
    data["problem"]["initial"]["around"] = True
