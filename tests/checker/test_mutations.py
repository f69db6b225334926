"""Changed certificates: what a claim rests on cannot be taken away, and harmless changes crash nothing."""

from __future__ import annotations

import copy
import json
import random
from typing import Any

import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.verification import verify_safety
from tests.checker.mutations import CONSTANTS, HARMLESS, LINEAR, mutated, rejected, stronger_claim


def survivors(data: Any, problem: Any, changes: Any, count: int, seed: int) -> list[str]:
    """Names of the weakening changes that were accepted."""
    proved = check_data(data, problem).log10_proved
    assert proved is not None
    every = [*changes, stronger_claim(proved)]
    return [name for name, altered in mutated(data, every, count, seed) if not rejected(altered, problem)]


@pytest.mark.parametrize(
    ("name", "changes", "count"), [("stepping", LINEAR, 55), ("flowing", LINEAR, 11), ("contracting", CONSTANTS, 14)]
)
def test_what_weakens_the_support_of_a_claim_is_rejected(
    name: str, changes: Any, count: int, request: pytest.FixtureRequest
) -> None:
    case = request.getfixturevalue(name)
    assert survivors(case.data, case.given, changes, count, seed=1) == []


@pytest.mark.parametrize(("name", "count"), [("stepping", 12), ("contracting", 4)])
def test_harmless_changes_crash_nothing(name: str, count: int, request: pytest.FixtureRequest) -> None:
    case = request.getfixturevalue(name)
    for kind, altered in mutated(case.data, HARMLESS, count, seed=2):
        valid = check_data(altered, case.given).valid
        assert valid or kind == "wider"


SURPRISES = (None, True, 0, -1, 10**8, "x", "", [], {}, [[]], (1.0).hex(), (0.0).hex(), (1e300).hex(), (-1e300).hex())


def anything_anywhere(data: Any, rng: random.Random) -> str | None:
    """Some value, at any depth, replaced by one of another kind or size."""
    holder: Any = data
    while True:
        keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        if not keys:
            return None
        key = rng.choice(keys)
        if isinstance(holder[key], (dict, list)) and rng.random() < 0.9:
            holder = holder[key]
        else:
            holder[key] = copy.deepcopy(rng.choice(SURPRISES))
            return "anything"


@pytest.mark.parametrize(("name", "count"), [("stepping", 120), ("contracting", 12)])
def test_anything_anywhere_ends_in_a_report_or_a_refusal(
    name: str, count: int, request: pytest.FixtureRequest
) -> None:
    case = request.getfixturevalue(name)
    for _, altered in mutated(case.data, [anything_anywhere], count, seed=6):
        rejected(altered)
        rejected(altered, case.given)


BUNDLED = [
    ("chain", "linear", LINEAR, 200),
    ("chain_rest", "linear", LINEAR, 100),
    ("pendulum", "linear", LINEAR, 40),
    ("unicycle", "linear", LINEAR, 40),
    ("ou", "constants", CONSTANTS, 120),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method", "changes", "count"), BUNDLED)
def test_500_weakening_changes_of_the_bundled_problems_are_rejected(
    name: str, method: str, changes: Any, count: int
) -> None:
    problem = cb.load(name)
    data = parse(certificate_text(problem, verify_safety(problem, method=method)))
    given = json.loads(json.dumps(problem_data(problem)))
    assert survivors(data, given, changes, count, seed=3) == []


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method", "count"), [("chain", "linear", 60), ("ou", "constants", 40)])
def test_100_harmless_changes_of_the_bundled_problems_crash_nothing(name: str, method: str, count: int) -> None:
    problem = cb.load(name)
    data = parse(certificate_text(problem, verify_safety(problem, method=method)))
    for kind, altered in mutated(data, HARMLESS, count, seed=4):
        assert check_data(altered).valid or kind == "wider"
