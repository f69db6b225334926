"""Cells that were cut one by one: the checker proves that they cover the starts, and believes nothing else."""

from __future__ import annotations

import copy
import json
from typing import Any

import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.errors import CertificateError
from certbound.safety.certificate import certificate_data, problem_data
from certbound.safety.verification import verify_safety


def flattening() -> cb.Problem:
    system = cb.DiscreteSystem(lambda x: 1.3 * x - 0.6 * x**3, states=1, noise=cb.Gaussian(std=0.02))
    safe = [cb.Inside(cb.Box([-1.05], [1.05]))]
    return cb.Problem(system, initial=cb.Box([-0.9], [0.9]), safe=safe, horizon=6, delta=1e-3)


@pytest.fixture(scope="module")
def stated() -> dict[str, Any]:
    problem = flattening()
    return certificate_data(problem, verify_safety(problem, method="linear"))


def check(data: dict[str, Any]) -> Any:
    return check_data(parse(json.dumps(data)), problem_data(flattening()))


def test_a_proof_over_unequal_cells_is_accepted(stated: dict[str, Any]) -> None:
    proof = stated["proof"]
    cells = sum(item is None for item in proof["cuts"])
    assert len(proof["cells"]) == cells > 4
    assert len(proof["splits"][0]) == 2
    report = check(stated)
    assert report.valid, report.reason
    assert report.log10_proved < -3


def with_cuts(data: dict[str, Any], cuts: list[Any]) -> dict[str, Any]:
    forged = copy.deepcopy(data)
    forged["proof"]["cuts"] = cuts
    return forged


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda cuts: cuts[:-1], "must end every part in a cell"),
        (lambda cuts: [*cuts, None], "must end with its last cell"),
        (lambda cuts: [[0, (0.95).hex()], *cuts[1:]], "must lie inside the part"),
        (lambda cuts: [[0, (-5.0).hex()], *cuts[1:]], "must lie inside the part"),
        (lambda cuts: [[1, cuts[0][1]], *cuts[1:]], r"must lie in 0\.\.0, got 1"),
        (lambda cuts: [[0], *cuts[1:]], "must be null, or a state's number"),
        (lambda cuts: [], "must have 1 to"),
        (lambda cuts: {}, "must be a list"),
    ],
)
def test_cuts_that_are_none_are_malformed(stated: dict[str, Any], change: Any, match: str) -> None:
    with pytest.raises(CertificateError, match=match):
        check(with_cuts(stated, change(stated["proof"]["cuts"])))


def test_a_grid_that_is_cut_again_is_malformed(stated: dict[str, Any]) -> None:
    forged = copy.deepcopy(stated)
    low, high = forged["proof"]["splits"][0]
    forged["proof"]["splits"] = [[low, (0.0).hex(), high]]
    with pytest.raises(CertificateError, match="must make one box where"):
        check(forged)


def test_cells_that_leave_starts_out_prove_nothing(stated: dict[str, Any]) -> None:
    proof = stated["proof"]
    assert proof["cuts"][-1] is None
    forged = with_cuts(stated, [None])  # one cell for all starts, with the numbers of the first one
    forged["proof"]["cells"] = proof["cells"][:1]
    assert not check(forged).valid
    inner = copy.deepcopy(stated)
    inner["proof"]["splits"] = [[(-0.5).hex(), (0.5).hex()]]
    inner["proof"] |= {"cuts": [None], "cells": proof["cells"][:1]}
    assert not check(inner).valid


def test_a_cut_elsewhere_is_no_proof_of_the_cell_that_grows(stated: dict[str, Any]) -> None:
    cuts = copy.deepcopy(stated["proof"]["cuts"])
    last = max(index for index, item in enumerate(cuts) if item is not None)
    before = float.fromhex(cuts[last][1])
    cuts[last][1] = (before + 0.02).hex()
    assert not check(with_cuts(stated, cuts)).valid
