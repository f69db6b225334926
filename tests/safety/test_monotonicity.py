"""An easier problem never gets a worse verdict: smaller X_0, T and noise, larger safe set and delta."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import certbound as cb

_ORDER = {"UNSAFE_NOMINAL": 0, "UNKNOWN": 1, "SAFE": 2}


@dataclass(frozen=True)
class Case:
    discrete: bool
    rotation: float
    cubic: float
    sigma: float
    start: float
    bound: float
    horizon: int
    delta: float

    def verdict(self) -> str:
        def pull(x: np.ndarray) -> np.ndarray:
            turned = np.array([self.rotation * x[1], -self.rotation * x[0]])
            return turned - x - self.cubic * np.array([x[0] ** 3, 0.0])

        noise = self.sigma * np.eye(2)
        if self.discrete:
            system = cb.DiscreteSystem(
                lambda x: x + 0.3 * pull(x), states=2, noise=cb.Gaussian(std=1.0), noise_matrix=noise
            )
        else:
            system = cb.ContinuousSystem(pull, states=2, diffusion=noise)
        problem = cb.Problem(
            system, initial=cb.Box([-self.start] * 2, [self.start] * 2),
            safe=[cb.Inside(cb.Box([-self.bound] * 2, [self.bound] * 2))],
            horizon=self.horizon if self.discrete else self.horizon / 5, delta=self.delta,
        )  # fmt: skip
        return cb.verify_safety(problem, method="linear").status


cases = st.builds(
    Case, discrete=st.booleans(), rotation=st.floats(-1.0, 1.0), cubic=st.sampled_from([0.0, 0.1, 0.3]),
    sigma=st.floats(0.01, 0.16), start=st.floats(0.0, 0.3), bound=st.floats(0.9, 1.5), horizon=st.integers(2, 8),
    delta=st.sampled_from([1e-2, 1e-3, 1e-5]),
)  # fmt: skip
eases = {
    "initial set": lambda case: replace(case, start=0.6 * case.start),
    "horizon": lambda case: replace(case, horizon=max(1, case.horizon - 1)),
    "noise": lambda case: replace(case, sigma=0.8 * case.sigma),
    "safe set": lambda case: replace(case, bound=1.2 * case.bound),
    "delta": lambda case: replace(case, delta=3 * case.delta),
}


@pytest.mark.slow
def test_two_hundred_cases() -> None:
    found = []

    @settings(max_examples=200, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None)
    @given(case=cases, ease=st.sampled_from(sorted(eases)))
    def judge(case: Case, ease: str) -> None:
        before, after = case.verdict(), eases[ease](case).verdict()
        found.append(before)
        assert _ORDER[after] >= _ORDER[before], f"easier {ease}: {before} became {after} for {case}"

    judge()
    assert found.count("SAFE") >= 150
