"""What the time step adds to a probability: the same Brownian paths, simulated with the step and with half of it.

A path with step h takes as the noise of a step what the same path with step h/2 has in two: F w_1 + w_2, with F what a
step makes of noise of the step before. Each path has a stream of its own, so that both meet the same noise. Uniform
variates, of bridges, are not shared."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import Tape
from certbound.simulation.blocks import BLOCK, Tally, Work
from certbound.simulation.estimates.preparation import Setting
from certbound.simulation.estimates.statistics import bound_binomial
from certbound.simulation.stepping import Scenario, StepModel, step_model
from certbound.simulation.stiffness import exponential

OTHER = 2**128 - 1
"""Turns the bits of a run's seed into those of the run with half of the step."""

_ALL, _SHARE = 32 * BLOCK, 8
"""Paths up to which all are simulated with half of the step too (4e7 steps more, of 1000 a path and step: half a
second), and of more paths the share: they take .4 of the time of the rest."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class StepEffect:
    """What the step adds to a probability: that with the step, less that with half of it."""

    adds: float  # the estimate
    # limits of it, each missed with chance at most (1 - confidence)/2
    lower: float
    upper: float
    halved_lower: float  # lower limit of the probability with half of the step
    paths: int  # simulated with both


def checkpoint_beside(checkpoint: str | Path | None) -> Path | None:
    """The file that keeps what half of the step counts, beside that of a run."""
    return None if checkpoint is None else Path(f"{checkpoint}.halved")


def paired_paths(paths: int) -> int:
    """How many paths are simulated with both steps."""
    return min(paths, max(_ALL, paths // _SHARE))


def halved(problem: Any, setting: Setting, scenario: Scenario | None) -> Setting:
    """The setting with half of the step, and the same scheme."""
    steps = 2 * setting.steps
    model = step_model(problem, steps, scenario or Scenario())
    if setting.model.exponential is not None:
        model = exponential(model, setting.model.exponential.base)
    times = np.linspace(0.0, float(problem.horizon), steps + 1)
    return Setting(model=model, steps=steps, times=times, start=setting.start, fixed=setting.fixed)


def composed(coarse: StepModel, fine: StepModel) -> StepModel:
    """The coarse model whose noise is made of the variates that two steps of the fine one take."""
    if isinstance(fine.noise, Tape):
        return replace(coarse, pieces=2)
    before = fine.noise if fine.carry is None else fine.carry @ fine.noise
    return replace(coarse, noise=np.hstack([before, fine.noise]), pieces=2)


@dataclass(frozen=True, eq=False, kw_only=True)
class PairedWork(Work):
    """The work with half of the step, and beside it that with the step.

    A tally counts paths that fail with both, with the step alone, and with half of it alone.
    """

    coarse: Work
    rows: int  # of both works' counts
    ignored: int  # the row whose paths do not fail; -1 for none

    def compile(self) -> None:
        """Compile both kernels."""
        super().compile()
        self.coarse.compile()

    def digest(self) -> str:
        """Hash of all that the answer depends on, of both works."""
        return f"{super().digest()} {self.coarse.digest()} {self.ignored}"

    def run_block(self, block: int, tally: Tally, out: Array | None = None) -> int:
        count = min(self.block, self.paths - block * self.block)
        ends = np.zeros((2, count, 1, 1))
        none = np.zeros(self.marginals_shape, dtype=np.int64)
        scratch = Tally(counts=np.zeros((self.rows, 2), np.int64), marginals=none, steps=0, paths=0)
        done = super().run_block(block, scratch, ends[0]) + self.coarse.run_block(block, scratch, ends[1])
        fine, coarse = (ends[:, :, 0, 0] > 0.0) & (ends[:, :, 0, 0] != self.ignored + 1.0)
        for place, failing in enumerate((fine & coarse, coarse & ~fine, fine & ~coarse)):
            tally.counts[0, place] += np.count_nonzero(failing)
        return done


def step_effect(counts: Array, exits: tuple[int, int], pairs: int, confidence: float) -> StepEffect:
    """What paired counts (both, with the step alone, with half of it alone) say of the step.

    ``exits`` are those of a run of its own, with the step, and its paths. The lower limit with half of the step is the
    better one of its own, and of that with the step less those that fail with the step alone: four, and two, limits of
    Clopper and Pearson share its chance to miss.
    """
    both, coarse, fine = (int(count) for count in counts)
    half, quarter = 0.5 * (1.0 + confidence), 0.25 * (3.0 + confidence)
    above, below = (bound_binomial(count, pairs, half) for count in (coarse, fine))
    own = float(bound_binomial(both + fine, pairs, half)[0])
    less = float(bound_binomial(*exits, quarter)[0] - bound_binomial(coarse, pairs, quarter)[1])
    return StepEffect(
        adds=(coarse - fine) / pairs,
        lower=float(above[0] - below[1]),
        upper=float(above[1] - below[0]),
        halved_lower=max(own, less, 0.0),
        paths=pairs,
    )
