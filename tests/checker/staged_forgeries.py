"""Forged certificates by the backward equation of windows, targets, time, disturbances and normal starts."""

from __future__ import annotations

import numpy as np

from certbound.safety.answers import exact
from tests.checker import conftest
from tests.checker.backward_forgeries import LESS, MORE, moved, uncut
from tests.checker.forgeries import _BASES, Data, _scale, _sharp, forges

_PROOF, _LIMITS = "values/kolmogorov/solution.py", "values/kolmogorov/stage_limits.py"
_RESIDUAL, _CELLS = "values/kolmogorov/patch_residual.py", "values/kolmogorov/cell_operator.py"
_START, _TAPES = "values/kolmogorov/start_mean.py", "values/batch_tapes.py"
_STAGE = "values/kolmogorov/stage.py"
_FINE = {"cell": 0.12, "steps": 12}

_BASES |= {
    "gated": _sharp(lambda: conftest.backward_certificate(conftest.gated, cell=0.2, steps=8)),
    "gated below": _sharp(lambda: conftest.backward_certificate(conftest.loud_gated, lower=True, cell=0.2, steps=8)),
    "arrived": _sharp(lambda: conftest.backward_certificate(conftest.arriving, **_FINE)),
    "arrived below": _sharp(lambda: conftest.backward_certificate(conftest.arriving, lower=True, **_FINE)),
    "pushed": _sharp(lambda: conftest.backward_certificate(conftest.pushed, cell=0.5, steps=8)),
    "pushed below": _sharp(lambda: conftest.backward_certificate(conftest.pushed, lower=True, cell=0.2, steps=14)),
    "scattered": _sharp(lambda: conftest.backward_certificate(conftest.scattered, **_FINE)),
    "scattered below": _sharp(lambda: conftest.backward_certificate(conftest.scattered, lower=True, **_FINE)),
}


def place_of(data: Data, axis: int, x: float, stage: int = 0) -> int:
    """The middle one of the six coefficients of the cell that begins at x, or holds it."""
    proof = data["proof"]["stages"][stage] if "stages" in data["proof"] else data["proof"]
    nodes = np.array([float.fromhex(node) for node in proof["axes"][axis]])
    return int(np.searchsorted(nodes, x + 1e-9, side="right")) + 2


def constant(data: Data, value: float, factor: float, part: str = "dynamics") -> None:
    """Change the constants of one value of the drift, or of the noise."""
    tape = data["problem"]["dynamics"] if part == "dynamics" else data["problem"]["noise"]["diffusion"]
    nodes = [node for node in tape["nodes"] if node[0] == "const" and float.fromhex(node[1]) == value]
    assert nodes
    for node in nodes:
        _scale(node, 1, factor)


# ---- stages of time ------------------------------------------------------------------------------------------


@forges("where a stage ends v is at least the next one", "gated", _STAGE, "Stage._below_next", MORE)
def _(data: Data) -> None:
    moved(data, (-1, place_of(data, 0, 0.1), place_of(data, 1, 0.1)), -0.1)


@forges("where a limit is due v reaches 1 beyond it", "gated", _STAGE, "Stage._at_end", MORE)
def _(data: Data) -> None:
    moved(data, (-1, slice(place_of(data, 0, 0.9), None), slice(None)), -0.2)


@forges("a limit that is due is the problem's", "gated", _LIMITS, "StageLimits.__init__", MORE)
def _(data: Data) -> None:
    _scale(data["problem"]["constraints"][1]["region"]["high"], 0, 0.99)


@forges("a limit holds in all of its window", "gated", _LIMITS, "StageLimits._overlaps", "grid was not shown")
def _(data: Data) -> None:
    data["problem"]["constraints"][1]["during"] = exact([0.49, 0.5])


@forges("a limit holds in its window, wherever stages are cut", "gated", _LIMITS, "StageLimits._overlaps", "was not")
def _(data: Data) -> None:
    data["problem"]["constraints"][1]["during"] = exact([0.6, 0.6])


@forges("the stages of a solution follow each other", "gated", _PROOF, "Solution.__init__", "stage by stage")
def _(data: Data) -> None:
    _scale(data["proof"]["stages"][1]["times"], 0, 0.999)


@forges("stages have the nodes in common that lie in both", "gated", _LIMITS, "common", "nodes in common")
def _(data: Data) -> None:
    _scale(data["proof"]["stages"][1]["axes"][0], 7, 1.0001)


@forges("in every stage v reaches 1 where paths leave", "gated", _STAGE, "Stage._at_face", MORE)
def _(data: Data) -> None:
    moved(data, (slice(None), slice(None), 0), -0.2, stage=1)


@forges("in every stage what v_t + L v exceeds 0 by is paid for", "gated", _PROOF, "Solution.bound", MORE)
def _(data: Data) -> None:
    moved(data, (12, place_of(data, 0, 0.1, 1), place_of(data, 1, 0.1, 1)), -0.1, stage=1)


@forges("the start of a solution breaks no limit of time 0", "gated", _PROOF, "Solution._at_starts", "initial set was")
def _(data: Data) -> None:
    region = {"kind": "halfspace", "normal": exact([1.0, 0.0]), "bound": exact(0.1)}
    more = {"kind": "inside", "region": region, "during": exact([0.0, 0.0]), "label": ""}
    data["problem"]["constraints"].append(more)


@forges("paths fail only on cells that break a limit that is due", "gated below", _LIMITS, "StageLimits", LESS)
def _(data: Data) -> None:
    _scale(data["problem"]["constraints"][1]["region"]["high"], 0, 1.001)


@forges("paths fail only where the limit is due", "gated below", _LIMITS, "StageLimits", LESS)
def _(data: Data) -> None:
    data["problem"]["constraints"][1]["during"] = exact([0.75, 0.75])


@forges("where a stage ends v is at least the next one from below", "gated below", _STAGE, "Stage._below_next", LESS)
def _(data: Data) -> None:
    moved(data, (-1, place_of(data, 0, 0.1), place_of(data, 1, 0.1)), -0.1)


@forges("v exceeds -1 where a limit is due", "gated below", _STAGE, "Stage._at_end", LESS)
def _(data: Data) -> None:
    moved(data, (-1, slice(place_of(data, 0, 0.9), None), slice(None)), -0.2)


@forges(
    "paths fail by faces of limits that hold in all of a stage", "gated below", _LIMITS, "StageLimits._covers", LESS
)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["during"] = exact([0.25, 1.0])


# ---- targets -------------------------------------------------------------------------------------------------


@forges("v is at least 0 where paths meet the target", "arrived", _STAGE, "Stage._at_target", MORE)
def _(data: Data) -> None:
    moved(data, (slice(None), slice(place_of(data, 0, 0.8) - 2, None), slice(None)), -0.1)


@forges("a path is over only on cells that lie in the target", "arrived", _LIMITS, "StageLimits", MORE)
def _(data: Data) -> None:
    _scale(data["problem"]["reach"]["region"]["low"], 0, 1.0001)


@forges("a path that meets the target too early is not over", "arrived", _LIMITS, "StageLimits", MORE)
def _(data: Data) -> None:
    data["problem"]["reach"]["during"] = exact([0.5, 1.0])
    uncut(data)


@forges("a path that touches an obstacle in the target is not over", "arrived", _LIMITS, "StageLimits", MORE)
def _(data: Data) -> None:
    wall = {"kind": "halfspace", "normal": exact([1.0, 0.0]), "bound": exact(0.9)}
    data["problem"]["constraints"].append({"kind": "inside", "region": wall, "during": exact([1.0, 1.0]), "label": ""})
    uncut(data)


@forges("v reaches 1 where a path has not met the target", "arrived", _STAGE, "Stage._at_end", MORE)
def _(data: Data) -> None:
    moved(data, (-1, place_of(data, 0, 0.0), place_of(data, 1, 0.0)), -0.3)


@forges("the stages end where the target's window does", "arrived", _LIMITS, "end_of", "end of the target's window")
def _(data: Data) -> None:
    data["problem"]["reach"]["during"] = exact([0.0, 0.9])


@forges("a path is over on cells that may hold the target", "arrived below", _LIMITS, "StageLimits", LESS)
def _(data: Data) -> None:
    _scale(data["problem"]["reach"]["region"]["low"], 0, 0.9)


@forges("v is at least 0 where paths may meet the target", "arrived below", _STAGE, "Stage._at_target", LESS)
def _(data: Data) -> None:
    place = place_of(data, 0, 0.8)
    moved(data, (slice(None), slice(place - 2, place + 2), slice(None)), -0.1)


@forges("a stated start may not lie in the target", "arrived below", _STAGE, "Stage.is_over", "keep off the target")
def _(data: Data) -> None:
    data["problem"]["initial"] |= {"low": exact([0.9, 0.0]), "high": exact([0.9, 0.0])}
    data["proof"]["starts"] = exact([[0.9, 0.0]])


@forges(
    "the target counts from the beginning of its window", "arrived below", _LIMITS, "StageLimits", "end of the"
)
def _(data: Data) -> None:
    data["problem"]["reach"]["during"] = exact([0.0, 0.5])


# ---- time and disturbances -----------------------------------------------------------------------------------


@forges("the residual has the drift of every time", "pushed", _CELLS, "Clock", MORE)
def _(data: Data) -> None:
    constant(data, 0.5, 0.9)


@forges("a jump in time lies within a slab that is paid", "pushed", _TAPES, "_on_both_sides", MORE)
def _(data: Data) -> None:
    constant(data, 0.6, 1.02)


@forges("the residual has the noise of every time", "pushed", _CELLS, "Operator._squares", MORE)
def _(data: Data) -> None:
    constant(data, 0.16, 1.2, "noise")
    uncut(data)


@forges("from above all disturbances are served", "pushed", _CELLS, "Operator._drift", MORE)
def _(data: Data) -> None:
    data["problem"]["disturbance_set"] = [exact([-0.2, 0.21])]


@forges("from below one stated disturbance serves each patch", "pushed below", _RESIDUAL, "Residual._needs", LESS)
def _(data: Data) -> None:
    data["proof"]["disturbances"] = exact([[0.2]])
    uncut(data)


@forges("a stated disturbance lies in its set", "pushed below", _PROOF, "Solution._actings", "stated disturbance")
def _(data: Data) -> None:
    data["problem"]["disturbance_set"] = [exact([-0.19, 0.2])]


@forges("from below no drift jumps by the state", "pushed below", _CELLS, "Operator._drift", "defined")
def _(data: Data) -> None:
    tape = data["problem"]["dynamics"]
    count = len(tape["nodes"])
    tape["nodes"] += [["input", 1], ["sign", count], ["const", exact(1e-9)], ["mul", count + 1, count + 2],
                      ["add", tape["outputs"][0], count + 3]]  # fmt: skip
    tape["outputs"][0] = count + 4


# ---- normal starts -------------------------------------------------------------------------------------------


@forges("the directions of a start are independent", "scattered", _START, "StartMean.__init__", "independent")
def _(data: Data) -> None:
    data["problem"]["initial"]["covariance"] = exact([[0.04, 0.021], [0.021, 0.03]])


@forges("what a start's directions leave of it is counted", "scattered", _START, "StartMean._extra", MORE)
def _(data: Data) -> None:
    data["proof"]["gains"] = exact([[0.9 * float.fromhex(x) for x in row] for row in data["proof"]["gains"]])


@forges("the mean of v is that over the start's law", "scattered", _START, "StartMean.bound", MORE)
def _(data: Data) -> None:
    data["problem"]["initial"]["mean"] = exact([0.22, 0.1])


@forges("who starts beyond the grid counts as failing", "scattered", _START, "StartMean.bound", MORE)
def _(data: Data) -> None:
    data["problem"]["initial"]["mean"] = exact([0.7, 0.1])


@forges(
    "of v between the corners of a start's cells its bends are counted", "scattered", _START, "StartMean._extra", MORE
)
def _(data: Data) -> None:
    data["proof"]["parts"] = 30


@forges("a start's cells are at most a million", "scattered", _START, "StartMean.__init__", "at most 1000000 cells")
def _(data: Data) -> None:
    data["proof"]["parts"] = 1001


@forges("the mean of v from below is that over the start's law", "scattered below", _START, "StartMean.bound", LESS)
def _(data: Data) -> None:
    data["problem"]["initial"]["mean"] = exact([0.15, 0.1])


@forges("who starts beyond a limit has failed, others have not", "scattered below", _START, "StartMean._lost", LESS)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["high"] = exact([1.001, 1.0])
