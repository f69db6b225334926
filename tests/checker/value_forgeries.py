"""Forged certificates of lower bounds by value functions, and of random starts: part of ``FORGERIES``."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable

import numpy as np

import certbound as cb
from certbound.safety.answers import exact
from tests.checker import conftest
from tests.checker.forgeries import _BASES, Data, _claim, _lower, _scale, _sharp, _stated, forges, repacked
from tests.checker.test_adversary import jumping

LESS = "less than the claimed"
MORE = "more than the claimed"
_STEPS = ("valued below", "values/step_back.py")
_ABOVE, _BELOW = "values/passage.py", "values/crossing.py"


def _below(build: Callable[[], cb.Problem]) -> Callable[[], str]:
    def text() -> str:
        problem, verdict = conftest.proved(build, "values")
        return conftest.side_of(problem, dict(verdict.answers), lower=True)

    return text


_BASES |= {
    "valued below": _sharp(_below(conftest.valued)),
    "started": _sharp(_stated(conftest.started, "values")),
    "started below": _sharp(_below(conftest.started)),
    "shaken": _sharp(_stated(conftest.shaken, "values")),
    "shaken below": _sharp(_below(conftest.shaken)),
    "squared": _sharp(lambda: conftest.squared_certificate(windows=True)),
    "leaving below": _sharp(lambda: conftest.exit_certificate(conftest.leaving, lower=True)),
    "drifting": _sharp(lambda: conftest.exit_certificate(conftest.drifting)),
    "drifting below": _sharp(lambda: conftest.exit_certificate(conftest.drifting, lower=True)),
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


@forges("a proof from below proves no upper bound", "valued below", "claims.py", "check_side", "be there just where")
def _(data: Data) -> None:
    _claim(data, float.fromhex(data["claim"].pop("log10_lower")) - 1.0)


@forges("a proof from above proves no lower bound", "valued", "claims.py", "check_side", "must be there just where")
def _(data: Data) -> None:
    data["claim"] |= {"log10_delta": exact(0.0), "log10_lower": exact(-0.1)}


@forges("only value functions bound from below", "still", "claims.py", "check_side", "in a proof by value functions")
def _(data: Data) -> None:
    data["claim"] |= {"log10_delta": exact(0.0), "log10_lower": exact(-0.1)}
    data["proof"]["side"] = "lower"


@forges("of an unknown constant no lower bound is stated", "valued below", "claims.py", "check_side", "does not react")
def _(data: Data) -> None:
    data["problem"]["unknown"] = list(data["problem"]["disturbances"])


@forges("a start from below lies in its set", "valued below", "statement/partition.py", "starts_of", "initial set")
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


@forges("q grows from below as its inequality asks", "leaving below", "values/hermite.py", "Levels", "q was not shown")
def _(data: Data) -> None:
    data["proof"] |= {"edges": exact([-8.0, 0.0]), "m": exact([0.5]), "q": exact([0.0, 0.0])}


@forges("q grows from below where it matters most", "leaving below", "values/hermite.py", "Levels", "q was not shown")
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


# ---- quadratic value bounds ----------------------------------------------------------------------------------

_FORMS, _WHERE, _FLOW = "values/quadratic.py", "values/walls.py", "values/second_order.py"
GROWTH = "growth of a quadratic bound was not shown"


def _windows(data: Data) -> list[Data]:
    """The two windows of the bound for the four sides of the box."""
    found: list[Data] = [one for one in data["proof"]["bounds"] if [-1, 1] in one["walls"]]
    assert len(found) == 2
    return found


def _wall(data: Data) -> Data:
    return _windows(data)[0]


@forges("a quadratic bound grows no faster than stated", "squared", _FORMS, "_Value._on_cell", GROWTH)
def _(data: Data) -> None:
    for k, rows in enumerate(_wall(data)["matrices"]):
        rows[2][2] = exact(float.fromhex(rows[2][2]) + 0.1 * k)
    _scale(_wall(data), "lam", 0.5)


@forges("the growth is not negative", "squared", _FORMS, "_Value._read", "must not be negative")
def _(data: Data) -> None:
    _wall(data)["lam"][0] = exact(-1.0)


@forges("a quadratic bound is at least 0 on its wall", "squared", _FORMS, "_Value._on_wall", "at least 0 on its wall")
def _(data: Data) -> None:
    for rows in _wall(data)["matrices"]:
        rows[2][2] = exact(float.fromhex(rows[2][2]) - 0.2)


@forges("a bound is at least 0 on all its walls", "squared", _FORMS, "_Value.prove", "at least 0 on its wall")
def _(data: Data) -> None:
    """The lower side of x is left to the bound of the obstacle."""
    obstacle = next(one for one in data["proof"]["bounds"] if one["walls"] == [[1, 0]])
    for name in ("walls", "wall_weights", "wall_rows"):
        side, _ = (one[name].pop(0) for one in _windows(data))
        obstacle[name].append(side if name == "walls" else [side[0]] * len(obstacle[name][0]))
    assert obstacle["walls"][1] == [-1, 0]


@forges("a bound is at least 0 in all its window", "squared", _FORMS, "_Value._on_wall", "at least 0 on its wall")
def _(data: Data) -> None:
    """The later window begins at 0, where V is low, at a rate of growth that pays for it."""
    early, late = _windows(data)
    data["proof"]["bounds"].remove(early)
    more = late["degree"] * late["first"]
    for name in ("wall_weights", "wall_rows"):
        late[name] = [[rows[0]] * more + rows for rows in late[name]]
    late["first"] = 0
    late["matrices"][0][2][2] = exact(float.fromhex(late["matrices"][0][2][2]) - 40.0)
    late["lam"][0] = exact(1000.0)


@forges("the slope of a quadratic bound counts", "squared", _FORMS, "_Value.prove", GROWTH)
def _(data: Data) -> None:
    late = _windows(data)[1]
    a, b = (float.fromhex(late["times"][place]) for place in (-2, -1))
    late["times"][-2] = exact(a + 0.5 * (b - a))


@forges("a quadratic bound is stated between its times", "squared", _FORMS, "_Value.prove", GROWTH)
def _(data: Data) -> None:
    late = _windows(data)[1]
    assert late["degree"] == 2
    assert late["first"] > 0
    late["matrices"][1][2][2] = exact(float.fromhex(late["matrices"][1][2][2]) + 1.0)


@forges("no wall is left out", "squared", _FORMS, "_check_covered", "all that paths can leave")
def _(data: Data) -> None:
    for one in _windows(data):
        data["proof"]["bounds"].remove(one)


@forges("the windows of a wall leave no gap", "squared", _FORMS, "_check_covered", "windows of a wall were not shown")
def _(data: Data) -> None:
    data["proof"]["bounds"].remove(_windows(data)[0])


@forges("the windows of a wall reach the horizon", "squared", _FORMS, "_check_covered", "windows of a wall were not")
def _(data: Data) -> None:
    data["proof"]["bounds"].remove(_windows(data)[1])


@forges("a wall is one of the problem's", "squared", _FORMS, "_Value._key", "is no wall")
def _(data: Data) -> None:
    _wall(data)["walls"][0] = [0, 0]


@forges("weights are not negative", "squared", _FORMS, "_Value._read", "negative weight")
def _(data: Data) -> None:
    _wall(data)["wall_weights"][0][0][0] = exact(-0.5)


@forges("the cells cover the working box", "squared", _FORMS, "_Value._cells", "rise from -1 to 1")
def _(data: Data) -> None:
    _wall(data)["cuts"][0][0] = exact(-0.9)


@forges("the pieces of a quadratic bound begin at the start", "squared", _FORMS, "_Value", "begin at time 0")
def _(data: Data) -> None:
    _wall(data)["times"][0] = exact(1e-3)


@forges("quadratic bounds cover the horizon", "squared", _FORMS, "_check_covered", "windows of a wall were not shown")
def _(data: Data) -> None:
    data["problem"]["horizon"] = exact(0.6)


@forges("the terms that a splitting moves cancel", "squared", _FORMS, "splitting", GROWTH)
def _(data: Data) -> None:
    words = zlib.decompress(base64.b64decode(_wall(data)["moves"])).decode().split(" ")
    changed = " ".join((float.fromhex(word) + 0.5).hex() for word in words)
    _wall(data)["moves"] = base64.b64encode(zlib.compress(changed.encode())).decode()


@forges("the starts of a quadratic bound count all", "squared", _FORMS, "_at_corners", MORE)
def _(data: Data) -> None:
    data["problem"]["initial"]["radius"] = exact(0.051)


@forges("a quadratic bound holds for the noise of the problem", "squared", _FORMS, "_Value._spread", GROWTH)
def _(data: Data) -> None:
    nodes = data["problem"]["noise"]["diffusion"]["nodes"]
    nodes[nodes.index(["const", exact(0.1)])][1] = exact(0.11)


@forges("a quadratic bound holds for every disturbance", "squared", _FORMS, "_Value._drift", GROWTH)
def _(data: Data) -> None:
    data["problem"]["disturbance_set"] = [exact([-0.12, 0.12])]


@forges("what is missing of the drift is paid for", "squared", _FLOW, "Flow.over", GROWTH)
def _(data: Data) -> None:
    nodes = data["problem"]["dynamics"]["nodes"]
    nodes[nodes.index(["const", exact(0.2)])][1] = exact(1.0)


@forges("second-order terms meet coordinates that are held", "squared", _FLOW, "Flow.held", "every second-order term")
def _(data: Data) -> None:
    for one in data["proof"]["bounds"]:
        one |= {"held": [], "cuts": []}


@forges("quadratic bounds need a diffusion that is affine", "squared", _FLOW, "Flow", "affine in the states")
def _(data: Data) -> None:
    nodes = data["problem"]["noise"]["diffusion"]["nodes"]
    product = next(node for node in nodes if node[0] == "mul")
    for place in product[1:]:
        nodes[place] = ["input", 1]


@forges("quadratic bounds need a smooth model", "squared", _FLOW, "Flow._refuse", "does not treat")
def _(data: Data) -> None:
    dynamics = data["problem"]["dynamics"]
    nodes, outputs = dynamics["nodes"], dynamics["outputs"]
    nodes += [["floor", nodes.index(["input", 1])], ["add", outputs[0], len(nodes)]]
    outputs[0] = len(nodes) - 1


@forges("quadratic bounds need a model at rest", "squared", _FLOW, "Flow._refuse", "changes with time")
def _(data: Data) -> None:
    nodes = data["problem"]["dynamics"]["nodes"]
    nodes[nodes.index(["input", 3])] = ["input", 0]


@forges("the working box lies in the safe set", "squared", _WHERE, "WorkingBox._faces", "was not shown to keep")
def _(data: Data) -> None:
    data["problem"]["constraints"][0]["region"]["high"] = exact([0.3, 1.0])


@forges("an obstacle is a wall where it is", "squared", _WHERE, "WorkingBox._ball", "at least 0 on its wall")
def _(data: Data) -> None:
    data["problem"]["constraints"][1]["region"]["center"] = exact([0.3, 0.3])


@forges("the starts of a quadratic bound lie in its box", "squared", _WHERE, "WorkingBox._start", "working box")
def _(data: Data) -> None:
    data["problem"]["initial"]["radius"] = exact(2.0)


@forges("the starts keep what is no side", "squared", _WHERE, "WorkingBox._check_start", "not shown to keep")
def _(data: Data) -> None:
    data["problem"]["constraints"][1]["region"]["center"] = exact([0.1, 0.1])


@forges("quadratic bounds treat no window", "squared", _WHERE, "WorkingBox", "has a window")
def _(data: Data) -> None:
    data["problem"]["constraints"][1]["during"] = exact([0.0, 0.3])


@forges("quadratic bounds need bounded starts", "squared", _WHERE, "WorkingBox._start", "bounded initial set")
def _(data: Data) -> None:
    data["problem"]["initial"] = {
        "kind": "gaussian", "mean": exact([0.0, 0.0]), "covariance": exact([[1e-4, 0.0], [0.0, 1e-4]])
    }  # fmt: skip


# ---- drifts that jump, in continuous time -----------------------------------------------------------------------


@forges(
    "where the drift of a value function jumps it has all values on either side", "drifting",
    "values/batch_tapes.py", "_on_both_sides", MORE,
)  # fmt: skip
def _(data: Data) -> None:
    tape = data["problem"]["dynamics"]
    count = len(tape["nodes"])
    tape["nodes"] += [
        ["input", 1], ["const", exact(-0.3)], ["add", count, count + 1], ["sign", count + 2], ["const", exact(1e-2)],
        ["mul", count + 3, count + 4], ["add", tape["outputs"][0], count + 5],
    ]  # fmt: skip
    tape["outputs"][0] = count + 6


@forges(
    "from below a drift that jumps under disturbances is unknown", "leaving below", _ABOVE, "Passage._drift",
    "not shown to be defined",
)  # fmt: skip
def _(data: Data) -> None:
    jumping(data, "sign", 1, 0.3)
