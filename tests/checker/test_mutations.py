"""Changed certificates: what a claim rests on cannot be taken away, and harmless changes crash nothing."""

from __future__ import annotations

import copy
import json
import random
from pathlib import Path
from typing import Any

import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.verification import verify_safety
from tests.checker.conftest import contraction, stirred
from tests.checker.mutations import (
    BARRIER,
    CONSTANTS,
    HARMLESS,
    LINEAR,
    STATE,
    VALUES,
    VALUES_BELOW,
    larger_claim,
    mutated,
    rejected,
    stronger_claim,
)

pytestmark = pytest.mark.usefixtures("kept_tables")


def survivors(data: Any, problem: Any, changes: Any, count: int, seed: int) -> list[str]:
    """Names of the weakening changes that were accepted."""
    report = check_data(data, problem)
    proved = report.log10_proved
    every = [*changes, larger_claim if proved is None else stronger_claim(proved)]
    return [name for name, altered in mutated(data, every, count, seed) if not rejected(altered, problem)]


@pytest.mark.parametrize(
    ("name", "changes", "count"),
    [("stepping", LINEAR, 55), ("flowing", LINEAR, 11), ("contracting", CONSTANTS, 14), ("springing", BARRIER, 27),
     ("stirring", STATE, 24), ("valuing", VALUES, 8), ("valuing_below", VALUES_BELOW, 8)],
)
def test_what_weakens_the_support_of_a_claim_is_rejected(
    name: str, changes: Any, count: int, request: pytest.FixtureRequest
) -> None:
    case = request.getfixturevalue(name)
    assert survivors(case.data, case.given, changes, count, seed=1) == []


@pytest.mark.parametrize(("name", "count"), [("stepping", 12), ("contracting", 4), ("springing", 6), ("valuing", 4)])
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


@pytest.mark.parametrize(
    ("name", "count"),
    [("stepping", 120), ("contracting", 8), ("springing", 40), ("stirring", 30), ("valuing", 20), ("valuing_below", 20),
     ("squaring", 30)],
)
def test_anything_anywhere_ends_in_a_report_or_a_refusal(
    name: str, count: int, request: pytest.FixtureRequest
) -> None:
    case = request.getfixturevalue(name)
    for _, altered in mutated(case.data, [anything_anywhere], count, seed=6):
        rejected(altered)
        rejected(altered, case.given)


BENCHMARKS = Path(__file__).resolve().parents[2] / "experiments" / "benchmarks"
WEAKENED = [
    ("chain", "linear", LINEAR, 80),
    ("chain_rest", "linear", LINEAR, 40),
    ("pendulum", "linear", LINEAR, 40),
    ("unicycle", "linear", LINEAR, 30),
    ("contraction_14d", "linear", LINEAR, 40),
    ("ou", "constants", CONSTANTS, 50),
    ("chain_rest", "constants", CONSTANTS, 50),
    ("room_3d", "constants", CONSTANTS, 20),
    ("disturbed", "constants", CONSTANTS, 40),
    ("oscillator_cubic", "barrier", BARRIER, 70),
    ("stirred", "linear", STATE, 40),
]
UNHARMED = [
    ("chain", "linear", 30), ("pendulum", "linear", 10), ("ou", "constants", 20), ("chain_rest", "constants", 20),
    ("oscillator_cubic", "barrier", 20),
]  # fmt: skip


def stated(name: str, method: str) -> tuple[cb.Problem, str]:
    """A bundled problem, a benchmark or one made for the tests, and its certificate."""
    path = BENCHMARKS / f"{name}.toml"
    made = {"disturbed": contraction, "stirred": stirred}
    problem = made[name]() if name in made else cb.load(str(path) if path.exists() else name)
    return problem, certificate_text(problem, verify_safety(problem, method=method))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method", "changes", "count"), WEAKENED)
def test_500_weakening_changes_are_rejected(name: str, method: str, changes: Any, count: int) -> None:
    problem, text = stated(name, method)
    given = json.loads(json.dumps(problem_data(problem)))
    assert check_data(parse(text), given).valid
    assert survivors(parse(text), given, changes, count, seed=3) == []


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method", "count"), UNHARMED)
def test_100_harmless_changes_crash_nothing(name: str, method: str, count: int) -> None:
    problem, text = stated(name, method)
    for kind, altered in mutated(parse(text), HARMLESS, count, seed=4):
        assert check_data(altered, problem_data(problem)).valid or kind == "wider"


def test_the_lists_hold_500_and_100_changes() -> None:
    assert sum(count for *_, count in WEAKENED) == 500
    assert sum(count for *_, count in UNHARMED) == 100
