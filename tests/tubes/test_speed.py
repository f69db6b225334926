"""Seconds of the two questions: ``pytest -n 0 tests/tubes/test_speed.py --benchmark-only`` on a quiet machine."""

from __future__ import annotations

import pytest

from experiments.tube_speed import LIMITS, QUESTIONS, medians


@pytest.mark.parametrize("name", [name for name in LIMITS if name != "table"])
def test_questions_are_answered_in_time(benchmark, name):
    medians(name, 1)  # warm
    for question in QUESTIONS[name][1:]:
        question()
    benchmark(QUESTIONS[name][0])
    assert benchmark.stats.stats.median < LIMITS[name]
