"""The linear engine asks the exact law first."""

import numpy as np
import pytest

import certbound as cb
from certbound.errors import CertificateError
from certbound.safety.certificate import certificate_data


def areas(horizon, load=0.012, delta=0.05):
    """A stiff servo behind a slow load: rates from 1/300 to 100."""
    slope = np.array([[-0.05, 6, -6, 0.0], [-0.8, -2, 0, 2.0], [0, 0, -1 / 300, 0], [-20, 0, 0, -100.0]])
    noise = np.zeros((4, 1))
    noise[2] = load * np.sqrt(2 / 300)
    system = cb.ContinuousSystem(lambda x: slope @ x, states=4, diffusion=noise)
    safe = [cb.Inside(cb.Box([-0.08, *[-np.inf] * 3], [0.08, *[np.inf] * 3]))]
    return cb.Problem(system, initial=np.zeros(4), safe=safe, horizon=horizon, delta=delta)


def test_a_long_horizon_is_decided_near_the_truth():
    verdict = cb.verify_safety(areas(3000.0), time_limit=30)
    assert verdict.status == "SAFE"
    assert "exact law" in verdict.reason


def test_what_fails_more_often_than_is_asked_is_unsafe():
    safe = cb.verify_safety(areas(3000.0), time_limit=30)
    least = 10**safe.log10_lower
    assert cb.verify_safety(areas(3000.0, delta=least / 2), time_limit=30).status == "UNSAFE"


def test_a_certificate_states_what_the_linear_response_proves_or_is_refused_in_words():
    verdict = cb.verify_safety(areas(3000.0), method="linear")
    with pytest.raises(CertificateError, match=r"certificate|proof|prove"):
        certificate_data(areas(3000.0), verdict)
