"""Noise that depends on the state: its certificates are proved again, and what they leave out is noticed."""

from __future__ import annotations

import functools
import math
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from flint import arb, arb_mat

import certbound as cb
from certbound.checker import check_data, parse
from certbound.checker.linear.diffusion import Asked, Stopped
from certbound.checker.linear.events import Windows
from certbound.checker.linear.response import continuous_piece
from certbound.checker.report import Budget
from certbound.errors import CertificateError
from certbound.reach.linear import linearisation
from certbound.safety.certificate import certificate_text
from certbound.safety.certificates import linear
from certbound.safety.verification import verify_safety

Data = dict[str, Any]


def proved(problem: cb.Problem) -> Data:
    """A certificate of the linear response, which the checker proves."""
    data: Data = parse(certificate_text(problem, verify_safety(problem, method="linear")))
    report = check_data(data)
    assert report.valid, report.reason
    assert report.assumptions == ()
    return data


def level(data: Data) -> float:
    return float.fromhex(data["claim"]["log10_delta"])


def rotating() -> cb.Problem:
    """Two states, nonlinear, disturbed; noise on the velocity that grows with it."""
    system = cb.ContinuousSystem(
        lambda x, d: [x[1], -np.sin(x[0]) - 0.5 * x[1] + d[0]], states=2, disturbance=cb.Box([-0.01], [0.01]),
        diffusion=lambda t, x: [[0.0], [0.05 * (1 + 0.5 * np.tanh(x[1]))]],
    )  # fmt: skip
    safe = [cb.Inside(cb.HalfSpace([-1.0, 0.0], 0.3)), cb.Outside(cb.Ball([0.4, -0.8], 0.3))]
    return cb.Problem(system, initial=cb.Box([0.38, -0.02], [0.4, 0.02]), safe=safe, horizon=1.0, delta=1e-2)


def growth(bound: float = 2.0, start: Any = (1.0,), gain: float = 0.3) -> cb.Problem:
    """Noise in proportion to the state."""
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=lambda t, x: [[gain * x[0]]])
    safe = [cb.Inside(cb.HalfSpace([1.0], bound))]
    return cb.Problem(system, initial=start, safe=safe, horizon=2.0, delta=5e-2)


def swinging() -> cb.Problem:
    """Noise of time alone."""
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=lambda t, x: [[0.1 + 0.05 * np.sin(t)]])
    return cb.Problem(system, initial=[0.5], safe=[cb.Inside(cb.Box([-0.5], [1.2]))], horizon=1.0, delta=1e-2)


def test_two_states_with_a_disturbance_and_an_obstacle_are_proved_again() -> None:
    usual = patch.object(linearisation, "FEWEST_PIECES", 50), patch.object(linear, "_FEWEST", 40)
    with usual[0], usual[1]:  # fewer pieces than these prove nothing by a reference
        data = proved(rotating())
    assert level(data) < -3
    assert data["proof"]["cells"][0]["stopped"]["reference"] is not None


def test_noise_in_proportion_to_the_state_is_all_in_the_martingale() -> None:
    data = proved(growth())
    assert level(data) < math.log10(5e-2)
    stopped = data["proof"]["cells"][0]["stopped"]
    assert stopped["reference"] is None
    assert stopped["rooms"] is None


def test_noise_of_time_alone_is_proved_again() -> None:
    data = proved(swinging())
    assert level(data) < -2
    assert data["proof"]["units"] == []


def test_a_random_start_is_a_part_of_the_gaussian_response() -> None:
    data = proved(growth(start=cb.GaussianStart([0.8], [[0.01]]), gain=0.1))
    data["problem"]["initial"]["covariance"] = [[(0.2).hex()]]
    assert not check_data(data).valid


def test_certificates_claim_no_more_than_what_simulation_finds() -> None:
    system = cb.ContinuousSystem(
        lambda x: [0 * x[0]], states=1, diffusion=lambda t, x: [[0.1 * (1 + 0.9 * np.tanh(5 * x[0]))]]
    )
    problem = cb.Problem(
        system, initial=[0.0], safe=[cb.Inside(cb.HalfSpace([1.0], 0.4))], horizon=1.0, delta=0.2
    )
    assert 10 ** level(proved(problem)) > 0.0071  # the truth; noise frozen on the nominal would say 1e-4


def test_a_state_that_the_noise_depends_on_needs_levels(stirring: Any) -> None:
    data = stirring.data
    data["problem"]["states"].append("y")
    for tape in (data["problem"]["dynamics"], data["problem"]["noise"]["diffusion"]):
        nodes = tape["nodes"]
        nodes += [["input", 2], ["add", tape["outputs"][0], len(nodes)]]
        tape["outputs"] = [len(nodes) - 1, len(nodes) - 2]
    with pytest.raises(CertificateError):  # one state more everywhere: nothing fits
        check_data(data)


def noisier(data: Data, build: Any) -> Data:
    """The certificate with another diffusion, made from its tape's output node."""
    tape = data["problem"]["noise"]["diffusion"]
    nodes = tape["nodes"]
    nodes += build(tape["outputs"][0], len(nodes))
    tape["outputs"] = [len(nodes) - 1]
    return data


def test_more_noise_than_was_written_is_noticed(stirring: Any) -> None:
    double = noisier(stirring.data, lambda g, n: [["const", (2.0).hex()], ["mul", g, n]])
    assert not check_data(double).valid
    hidden = noisier(stirring.data, lambda g, n: [["const", (0.05).hex()], ["add", g, n]])
    assert not check_data(hidden).valid


def test_noise_that_may_jump_or_is_not_defined_is_not_proved_over(stirring: Any) -> None:
    def step(g: int, n: int) -> list[Any]:  # g + (x > .2), which the nominal curve crosses
        return [["input", 1], ["const", (0.2).hex()], ["lt", n + 1, n], ["add", g, n + 2]]

    def root(g: int, n: int) -> list[Any]:  # g + 0 sqrt(x - .4)
        return [["input", 1], ["const", (0.4).hex()], ["sub", n, n + 1], ["sqrt", n + 2], ["const", (0.0).hex()],
                ["mul", n + 3, n + 4], ["add", g, n + 5]]  # fmt: skip

    for build in (step, root):
        report = check_data(noisier(stirring.data, build))
        assert not report.valid
        assert "may jump" in report.reason


def test_the_state_must_stay_strictly_inside_its_set(stirring: Any) -> None:
    data = stirring.data
    stopped = data["proof"]["cells"][0]["stopped"]
    for name in ("low", "high"):  # on the nominal alone the noise is the reference, and there is no martingale
        stopped[name] = [[(0.0).hex()] for _ in stopped[name]]
    report = check_data(data)
    assert not report.valid
    assert "was not shown to stay" in report.reason


def test_a_martingale_without_noise_that_depends_on_the_state_is_refused(stirring: Any, flowing: Any) -> None:
    data = flowing.data
    data["proof"]["cells"][0]["stopped"] = stirring.data["proof"]["cells"][0]["stopped"]
    with pytest.raises(CertificateError, match="does not depend on the state"):
        check_data(data)


def test_all_the_room_is_the_martingales_only_where_there_is_no_gaussian_part(stirring: Any) -> None:
    data = stirring.data
    data["proof"]["cells"][0]["stopped"]["rooms"] = None
    with pytest.raises(CertificateError, match="rooms"):
        check_data(data)


def test_windows_must_rise_from_the_first_piece(stirring: Any) -> None:
    for windows in ([1, 2], [0, 2, 2], []):
        data = stirring.data
        data["proof"]["cells"][0]["stopped"]["windows"] = windows
        with pytest.raises(CertificateError, match="windows"):
            check_data(data)


def filled(value: Any, number: float) -> Any:
    return [filled(item, number) for item in value] if isinstance(value, list) else number.hex()


@functools.cache
def growing_text() -> str:
    return certificate_text(growth(), verify_safety(growth(), method="linear"))


@pytest.mark.parametrize("number", [1e308, 1e200, 5e-324, 0.0])
def test_huge_and_tiny_numbers_prove_nothing(stirring: Any, number: float) -> None:
    for name in ("reference", "coordinates", "rows", "rooms"):
        data = stirring.data
        stopped = data["proof"]["cells"][0]["stopped"]
        stopped[name] = filled(stopped[name], number)
        assert not check_data(data).valid
    data = stirring.data
    stopped = data["proof"]["cells"][0]["stopped"]
    stopped["low"], stopped["high"] = filled(stopped["low"], -number), filled(stopped["high"], number)
    assert not check_data(data).valid  # sine is bounded on all numbers, but by more than near the nominal
    data = parse(growing_text())
    stopped = data["proof"]["cells"][0]["stopped"]
    stopped["low"], stopped["high"] = filled(stopped["low"], -number), filled(stopped["high"], number)
    assert not check_data(data).valid  # and this noise is not


# ---- kappa -------------------------------------------------------------------------------------------------


def decaying(pieces: int, rate: float) -> Windows:
    """Windows of two pieces each for x' = -rate x on [0, 1]."""
    slope, nothing = arb_mat([[arb(-rate)]]), arb_mat([[arb(0)]])
    piece = continuous_piece(slope, nothing, arb(1) / pieces, nothing)
    return Windows([piece] * pieces, [], list(range(0, pieces, 2)), Budget(60.0))


@pytest.mark.parametrize("rate", [0.0, 1.0, 3.0])
def test_kappa_is_little_more_than_the_integral(rate: float) -> None:
    """kappa^2 = int_0^t exp(-2 rate (t - u)) g^2 du."""
    windows = decaying(20, rate)
    excess = [arb_mat([[arb(0.2, 0.1)]])] * 20
    found = Stopped(windows, excess, arb(3), Budget(60.0)).kappas([[[arb(1)]]] * 10)
    for end, (kappa,) in zip(windows.ends, found):
        t = end / 20
        exact = 0.3 * math.sqrt(t if rate == 0 else -math.expm1(-2 * rate * t) / (2 * rate))
        assert exact <= kappa
        assert kappa < exact * (1.01 + 0.002 * rate**2)


def test_levels_of_rows_cost_what_their_factors_say() -> None:
    windows = decaying(20, 1.0)
    stopped = Stopped(windows, [arb_mat([[arb(0.2)]])] * 20, arb(5), Budget(60.0))
    rows = [[arb(1)]] * 20
    (part,) = stopped.along([Asked(rows=rows, levels=[arb(0)] * 20, factors=[arb(4)] * 10)])
    q = math.erfc(4 / math.sqrt(2)) / 2
    assert float(part.probability) == pytest.approx(20 * q)
    assert all(0 < float(part.at(k)) < 1 for k in range(20))
    levels = [part.at(k) for k in range(20)]
    (again,) = stopped.along([Asked(rows=rows, levels=levels, factors=None)])
    assert float(again.probability) == pytest.approx(20 * q, rel=0.01)
    (none,) = stopped.along([Asked(rows=rows, levels=[None] * 20, factors=[arb(0)] * 10)])
    assert none.probability == 0
    (low,) = stopped.along([Asked(rows=rows, levels=[arb(-1)] * 20, factors=None)])
    assert low.probability >= 1
