"""Problems that ask for the impossible: the answer names the argument, the rule, the value and the cure."""

from __future__ import annotations

import re

import numpy as np
import pytest

import certbound as cb
from certbound.errors import EngineError


def problem(**changes: object) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=0.05 * np.eye(2))
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    given = {"initial": cb.Box([0.2, 0.2], [0.3, 0.3]), "safe": safe, "horizon": 2.0}
    return cb.Problem(system, **{**given, **changes})  # type: ignore[arg-type]


def test_a_domain_that_the_tube_leaves_is_named_with_time_and_depth() -> None:
    verdict = cb.verify_safety(problem(domain=cb.Box([0.1, -1], [1, 1])), method="linear")
    assert verdict.status == "UNKNOWN"
    assert verdict.margin is not None
    assert verdict.margin < 0
    assert verdict.time is not None
    assert re.search(r"the model's domain.* at t = 1\.9\d*", verdict.reason)
    assert re.search(r"margin: -0\.\d+ at t = 1\.9\d*, the model's domain", str(verdict))


@pytest.mark.parametrize(("gain", "blows_up"), [(1.0, 4.0), (20.0, 0.2)])
def test_the_time_of_a_blow_up_is_not_overstated(gain: float, blows_up: float) -> None:
    system = cb.ContinuousSystem(lambda x: [gain * x[0] ** 2], states=1, diffusion=[[0.01]])
    safe = [cb.Inside(cb.HalfSpace([-1.0], 50))]
    lost = cb.Problem(system, initial=[0.25], safe=safe, horizon=1.5 * blows_up)
    with pytest.raises(EngineError, match="is lost after t = ") as caught:
        cb.bound_reach(lost, noise=False, method="linear")
    found = re.search(r"after t = ([\d.]+),", str(caught.value))
    assert found is not None
    assert 0.7 * blows_up < float(found[1]) <= blows_up * 1.0001


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"safe": [cb.Outside(cb.Ball([0.25, 0.25], 0.2))]}, "`initial` must satisfy .* violates .*; move the start"),
        ({"safe": [cb.Inside(cb.HalfSpace([1, 0, 0], 1))]}, "must have dimension 2 .*, got 3; .*`coordinates`"),
        ({"safe": [cb.Inside(cb.Ball([0, 0], 1, coordinates=(0, 2)))]}, r"indices below 2, got .*\(0, 2\); the first"),
        ({"safe": [cb.Inside(cb.Box([-1, -1], [1, 1]), during=(1, 3))]}, r"within \[0, 2\], got \[1.0, 3.0\]; change"),
    ],
)
def test_malformed_sets_and_windows_name_the_cure(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        problem(**changes)


def test_an_unbounded_disturbance_is_shown() -> None:
    box = cb.Box([-np.inf, 0], [1, 1])
    with pytest.raises(ValueError, match=r"bounded box, got the sides \[-inf, 1\], \[0, 1\]; give each finite ends"):
        cb.ContinuousSystem(lambda x, d: -x + d, states=2, disturbance=box)
