"""Forged certificates of lower bounds by value functions, and of random starts: part of ``FORGERIES``."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import certbound as cb
from certbound.safety.answers import exact
from certbound.safety.verification import verify_safety
from tests.checker import conftest
from tests.checker.forgeries import _BASES, Data, _claim, _lower, _scale, _sharp, _stated, forges, repacked
from tests.checker.test_adversary import jumping

LESS = "less than the claimed"
MORE = "more than the claimed"
_STEPS = ("valued below", "values/step_back.py")
_ABOVE, _BELOW = "values/passage.py", "values/crossing.py"


def _below(build: Callable[[], cb.Problem]) -> Callable[[], str]:
    def text() -> str:
        problem = build()
        return conftest.side_of(problem, dict(verify_safety(problem, method="values").answers), lower=True)

    return text


_BASES |= {
    "valued below": _sharp(_below(conftest.valued)),
    "started": _sharp(_stated(conftest.started, "values")),
    "started below": _sharp(_below(conftest.started)),
    "shaken": _sharp(_stated(conftest.shaken, "values")),
    "shaken below": _sharp(_below(conftest.shaken)),
    "leaving below": _sharp(lambda: conftest.exit_certificate(conftest.leaving(), lower=True)),
    "drifting": _sharp(lambda: conftest.exit_certificate(conftest.drifting())),
    "drifting below": _sharp(lambda: conftest.exit_certificate(conftest.drifting(), lower=True)),
}


def _more(data: Data, amount: float) -> None:
    """Claim a larger lower bound."""
    data["claim"]["log10_lower"] = exact(float.fromhex(data["claim"]["log10_lower"]) + amount)


# ---- from below, discrete time -------------------------------------------------------------------------------


@forges("the claimed lower bound is at most what follows", "valued below", "check.py", "_compare_below", LESS)
def _(data: Data) -> None:
    _more(data, 0.001)


@forges("who claims a lower bound claims no upper one", "valued below", "check.py", "_levels", "must be 0")
def _(data: Data) -> None:
    _claim(data, -5.0)


@forges("a proof from below proves no upper bound", "valued below", "claims.py", "proof_of", "must be there just where")
def _(data: Data) -> None:
    _claim(data, float.fromhex(data["claim"].pop("log10_lower")) - 1.0)


@forges("a proof from above proves no lower bound", "valued", "claims.py", "proof_of", "must be there just where")
def _(data: Data) -> None:
    data["claim"] |= {"log10_delta": exact(0.0), "log10_lower": exact(-0.1)}


@forges("only value functions bound from below", "still", "claims.py", "proof_of", "in a proof by value functions")
def _(data: Data) -> None:
    data["claim"] |= {"log10_delta": exact(0.0), "log10_lower": exact(-0.1)}
    data["proof"]["side"] = "lower"


@forges("a start from below lies in the initial set", "valued below", "values/starting.py", "starts_of", "initial set")
def _(data: Data) -> None:
    data["problem"]["initial"]["high"] = exact([0.19])


@forges("a start from below is of the set itself", "valued below", "values/proof.py", "check_values_below", "around")
def _(data: Data) -> None:
    data["problem"]["initial"]["around"] = True


@forges("only a cell that breaks a constraint throughout counts as failed from below", *_STEPS, "zones", LESS)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["high"] = exact([1.01])


@forges("what lies beyond the grid counts for nothing from below", *_STEPS, "Values", LESS)
def _(data: Data) -> None:
    for grid in data["proof"]["grids"]:
        del grid[0][0], grid[0][-1]


@forges("what is missed is taken off from below", *_STEPS, "_without", LESS)
def _(data: Data) -> None:
    for grid in data["proof"]["grids"]:
        del grid[0][3:-3:2]
    _more(data, -0.001)


@forges("nothing is known of the dynamics from below where it jumps", *_STEPS, "bounded", LESS)
def _(data: Data) -> None:
    jumping(data, "sign", 1, 0.6)


@forges("the disturbance takes values of its set from below", *_STEPS, "_parts", LESS)
def _(data: Data) -> None:
    data["problem"]["disturbance_set"] = [exact([-0.05, 0.049])]


@forges("the mean is taken over the noise from below", "valued below", "values/normal_means.py", "axis_table", LESS)
def _(data: Data) -> None:
    _scale(data["problem"]["noise"], "values", 0.999)


# ---- normal starts, discrete time ----------------------------------------------------------------------------


@forges("the mean is taken over a normal start", "started", "values/proof.py", "_Discrete._over_law", MORE)
def _(data: Data) -> None:
    data["problem"]["initial"]["covariance"] = exact([[0.0401]])


@forges("the mean of a normal start, from below", "started below", "values/proof.py", "_Discrete._over_law", LESS)
def _(data: Data) -> None:
    data["problem"]["initial"]["covariance"] = exact([[0.0399]])


@forges("a normal start is about its mean", "started", "values/proof.py", "_Discrete._over_law", MORE)
def _(data: Data) -> None:
    data["problem"]["initial"]["mean"] = exact([0.101])


@forges("a normal start varies in every state", "started", "values/step_back.py", "independent", "every state")
def _(data: Data) -> None:
    data["problem"]["initial"]["covariance"] = exact([[0.0]])


@forges("a normal start breaks no constraint at step 0", "started", "values/proof.py", "_Discrete", MORE)
def _(data: Data) -> None:
    data["problem"]["constraints"].append(
        {"kind": "inside", "label": "x", "during": exact([0.0, 0.0]), "region": {
            "kind": "halfspace", "normal": exact([1.0]), "bound": exact(0.5),
        }}
    )  # fmt: skip


# ---- uniform noise -------------------------------------------------------------------------------------------

_MEANS = "values/uniform_means.py"


@forges("the mean is taken over uniform noise", "shaken", _MEANS, "halfwidth_of", MORE)
def _(data: Data) -> None:
    _scale(data["problem"]["noise"], "values", 1.001)


@forges("the mean is taken over uniform noise from below", "shaken below", _MEANS, "halfwidth_of", LESS)
def _(data: Data) -> None:
    _scale(data["problem"]["noise"], "values", 0.999)


@forges("uniform noise is a single number", "shaken", _MEANS, "halfwidth_of", "single uniform number")
def _(data: Data) -> None:
    data["problem"]["noise"] |= {"values": exact([0.3, 0.01]), "matrix": exact([[1.0, 1.0]])}


@forges("uniform noise moves the state", "shaken", _MEANS, "halfwidth_of", "single uniform number")
def _(data: Data) -> None:
    data["problem"]["noise"]["matrix"] = exact([[0.0]])


@forges("bounded noise is no uniform noise", "shaken", "values/step_back.py", "_deviations", "normal and uniform")
def _(data: Data) -> None:
    data["problem"]["noise"] |= {"law": "bounded", "independent": True}


@forges("what a slope misses of a mean is added", "shaken", _MEANS, "UniformTransition.mean", MORE)
def _(data: Data) -> None:
    for grid in data["proof"]["grids"]:
        del grid[0][3:-3:2]


@forges("what a slope misses of a mean is taken off", "shaken below", _MEANS, "UniformTransition.mean", LESS)
def _(data: Data) -> None:
    for grid in data["proof"]["grids"]:
        del grid[0][3:-3:2]


# ---- from below, continuous time -----------------------------------------------------------------------------


@forges("only a side that breaks a constraint counts", "leaving below", _BELOW, "Crossing.lower", LESS)
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["high"] = exact([1.001])


@forges("V is at most 0 from below", "leaving below", _BELOW, "Crossing._highest", LESS)
def _(data: Data) -> None:
    def change(values: np.ndarray) -> None:
        values[:, :, 0] += 0.5

    repacked(data, "values", change)
    _more(data, 0.1)


@forges("V at the end is taken off from below", "leaving below", _BELOW, "Crossing._at_end", LESS)
def _(data: Data) -> None:
    def change(values: np.ndarray) -> None:
        values[-1, :, 0] = -0.05

    repacked(data, "values", change)


@forges("a start from below lies in the grid", "leaving below", _BELOW, "Crossing._level", "lie in the grid")
def _(data: Data) -> None:
    data["problem"]["initial"]["high"] = exact([1.5])
    data["proof"]["starts"].append(exact([1.2]))


@forges("the residual of V is paid for from below", "leaving below", _BELOW, "Crossing._need", LESS)
def _(data: Data) -> None:
    nodes = data["problem"]["noise"]["diffusion"]["nodes"]
    nodes[nodes.index(["const", exact(0.75)])][1] = exact(0.745)


@forges("the residual from below is for one disturbance", "leaving below", _BELOW, "Crossing._need", LESS)
def _(data: Data) -> None:
    data["problem"]["disturbance_set"] = [exact([-0.1, 0.09])]


@forges("the dynamics is defined everywhere from below", "leaving below", _BELOW, "Crossing._need", "defined")
def _(data: Data) -> None:
    jumping(data, "sign", 1, 0.6)


@forges("q grows from below as its inequality asks", "leaving below", _ABOVE, "Levels", "q was not shown")
def _(data: Data) -> None:
    data["proof"] |= {"edges": exact([-8.0, 0.0]), "m": exact([0.5]), "q": exact([0.0, 0.0])}


@forges("q grows from below where it matters most", "leaving below", _ABOVE, "Levels", "q was not shown")
def _(data: Data) -> None:  # (1 + q)(3 - q) is 3 at both ends, and 4 in between
    data["proof"] |= {"edges": exact([-0.6, 0.0]), "m": exact([3.0]), "q": exact([0.0, 2.0])}


# ---- normal starts, continuous time --------------------------------------------------------------------------


@forges("the mean is taken over a normal start in continuous time", "drifting", _ABOVE, "Passage._mean", MORE)
def _(data: Data) -> None:
    data["problem"]["initial"]["covariance"] = exact([[0.0202]])


@forges("starts beyond the grid count as failed", "drifting", _ABOVE, "Passage._mean", MORE)
def _(data: Data) -> None:
    data["problem"]["initial"]["mean"] = exact([-4.0])


@forges("the mean over a normal start has its own side", "drifting below", _ABOVE, "Passage._mean", LESS)
def _(data: Data) -> None:
    data["problem"]["initial"]["covariance"] = exact([[0.0198]])


@forges("starts beyond the grid count where they fail", "drifting below", _BELOW, "Crossing._certain", LESS)
def _(data: Data) -> None:
    data["problem"]["initial"] |= {"mean": exact([2.0]), "covariance": exact([[0.02]])}
    data["problem"]["constraints"][0] |= {"kind": "outside", "region": {
        "kind": "box", "low": exact([1.0]), "high": exact([1.02]), "center": None, "coordinates": None,
    }}  # fmt: skip


@forges("the parts of a normal start are bounded", "drifting", _ABOVE, "Passage", "at most 20000 parts")
def _(data: Data) -> None:
    data["proof"]["pieces"] = 19_999
    _lower(data, 0.0)
