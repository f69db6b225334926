"""Certificates of inputs that are held: what is proved again, and what is refused."""

from __future__ import annotations

import copy
import functools
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

import certbound as cb
from certbound.checker import check_data
from certbound.checker.linear.samplers import Sampler
from certbound.checker.statement.tapes import Hold
from certbound.errors import CertificateError
from certbound.problem.model import Node, Tape
from certbound.safety.certificate import certificate_data, problem_data

HOLDS = 3


def lane(hold: float | None = 0.2, gain: float = 0.8) -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x, u: [2 * np.sin(x[1]), np.tan(u[0])], states=["y", "psi"], inputs=cb.Box([-0.6], [0.6]),
        diffusion=0.03 * np.eye(2),
    )
    return cb.Problem(
        system, initial=[0.2, 0], safe=[cb.Inside(cb.Box([-0.6], [0.6], coordinates=[0]))], horizon=0.6, delta=1e-3,
        plan=lambda x: 0.5 * np.tanh(-gain * x[0] - 1.5 * x[1]), hold=hold,
    )


@functools.cache
def stated() -> dict[str, Any]:
    return certificate_data(lane(), cb.verify_safety(lane(), method="linear"))


def forged(*path: object, value: object) -> dict[str, Any]:
    data = copy.deepcopy(stated())
    place: Any = data
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return data


def test_a_certificate_is_proved_again() -> None:
    report = check_data(stated(), problem_data(lane()))
    assert report.valid, report.reason
    assert report.log10_delta < -3


def test_the_length_of_a_piece_is_as_exact_as_the_precision_allows() -> None:
    nothing: Any = None
    sampler = Sampler(count=100, parts=2, horizon=5.0, structure=nothing, outputs=[], hidden=[])
    with ctx.workprec(600):
        assert sampler.length.rad() < arb(2) ** -590
        assert all(end.rad() < arb(2) ** -590 for end in sampler.span(298))


@pytest.mark.parametrize(
    ("other", "words"),
    [(lane(0.1), "hold.count differs"), (lane(None), "inputs differs"), (lane(gain=0.9), "hold.law is another")],
)
def test_it_speaks_of_no_other_hold_and_law(other: cb.Problem, words: str) -> None:
    report = check_data(stated(), problem_data(other))
    assert not report.valid
    assert words in report.reason


def test_slopes_and_nominal_of_a_sampling_time_are_looked_at() -> None:
    cell = stated()["proof"]["cells"][0]
    slopes = [[(2.0).hex() for _ in row] for row in cell["sampled"]]
    assert not check_data(forged("proof", "cells", 0, "sampled", value=slopes)).valid
    nominal = copy.deepcopy(cell["nominal"])
    for k in range(stated()["proof"]["pieces"] // HOLDS):  # of the first hold: another input than the law's
        for point in nominal[k]:
            point[2] = (0.4).hex()
    assert not check_data(forged("proof", "cells", 0, "nominal", value=nominal)).valid


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("problem", "hold", "count"), 0, "count"),
        (("problem", "hold", "count"), 7, "must be a multiple of the sampling times"),
        (("problem", "time"), "discrete", "horizon|hold|law"),
        (("problem", "inputs"), [], "dynamics|hold|input"),
    ],
)
def test_malformed_holds_are_refused(path: tuple[object, ...], value: object, words: str) -> None:
    with pytest.raises(CertificateError, match=words):
        check_data(forged(*path, value=value))


def test_only_held_inputs_have_entries_of_a_law() -> None:
    plain = certificate_data(lane(None), cb.verify_safety(lane(None), method="linear"))
    plain["proof"]["sampled"] = []
    with pytest.raises(CertificateError, match="must be left out where no inputs are held"):
        check_data(plain)


def test_a_proof_by_another_engine_is_refused() -> None:
    data = copy.deepcopy(stated())
    data["claim"]["method"] = data["proof"]["engine"] = "constants"
    with pytest.raises(CertificateError, match="engine"):
        check_data(data)


def test_a_part_of_the_horizon_ends_at_a_sample_just_where_the_floats_say_so() -> None:
    hold = Hold(count=4, law=Tape(inputs=("t",), nodes=(Node("input", (0,)),), outputs=(0,), shape=(1,)), names=("u",))
    assert hold.until(1.5, 2.0).count == 3
    with pytest.raises(CertificateError, match="sampling time"):
        hold.until(0.225, 0.3)  # three quarters of the float 0.3 are another float
