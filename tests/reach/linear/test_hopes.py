"""Which shares of a target are tried, and in what order: a guess costs little, a proof much."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import pytest

from certbound.reach.linear.hopes import hopes_of, refined
from certbound.reach.linear.run import LinearRun, Outcome
from certbound.reach.linear.shares import GUESSED, Share
from certbound.watch import Watch

TARGET = Share.of(1e-3)


class Guessed:
    """A run whose guesses are a function of the share: what the noise takes next to it, both as parts of the target."""

    def __init__(self, noise: Callable[[float], float]) -> None:
        self.hoped: Share | None = None
        self.lost = -math.inf
        self.noise, self.looked = noise, list[float]()

    def promise(self, share: Share, effort: int, limit: float) -> float:
        part = math.exp(share.log - TARGET.log)
        self.looked.append(round(part, 6))
        return TARGET.log + math.log(part + self.noise(part))


def run(noise: Callable[[float], float]) -> Any:
    return cast(LinearRun, Guessed(noise))


def test_shares_that_leave_the_noise_too_little_are_not_looked_at() -> None:
    dear = run(lambda part: 2.0 if part < 0.2 else 0.6)
    assert list(hopes_of(dear, TARGET)) == [(0.3, 3)]
    assert dear.looked == [0.1, 0.85, 0.1, 0.3]
    assert list(hopes_of(run(lambda part: 1.2), TARGET)) == []


def test_after_a_remainder_that_was_not_enclosed_only_the_last_share_is_tried() -> None:
    feeding = run(lambda part: 0.01)
    tried = []
    for share, _ in hopes_of(feeding, TARGET):
        tried.append(share)
        feeding.lost = TARGET.part(share).log
    assert tried == [GUESSED[0][0], GUESSED[-1][0]]


def test_what_promised_most_comes_first() -> None:
    parent = run(lambda part: 1.0 - part if part == pytest.approx(0.6) else 2.0)
    next(iter(hopes_of(parent, TARGET)), None)
    child = run(lambda part: 0.1)
    child.hoped = TARGET.part(0.6)
    assert next(iter(hopes_of(child, TARGET)))[0] == 0.6


def test_under_a_limit_a_smaller_probability_has_a_part_of_the_time() -> None:
    now = [0.0]

    class Slow:
        curved = True

        class engine:
            class model:
                blocks, active = [[[0]]], [0]

        def probability(self, share: Share, effort: int) -> Outcome:
            now[0] += 2.0
            watch.poll("levels")
            return Outcome(log_probability=share.log, nonlinear=share, bounds=None)

    first = Outcome(log_probability=TARGET.log, nonlinear=TARGET, bounds=None)
    for limit, halvings in ((1000.0, 2), (None, 3)):
        now[0] = 0.0
        watch = Watch(limit, clock=lambda: now[0])
        with watch.running():
            now[0] = 15.0
            found = refined(cast(LinearRun, Slow()), first, 2, TARGET)
        assert found.log_probability == pytest.approx(2**halvings * TARGET.log)
