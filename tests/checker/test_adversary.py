"""Files made by hand to deceive: none of them is proved."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from flint import arb

import certbound as cb
from certbound.checker import check_data, parse
from certbound.checker.expressions.arithmetic import Undecided, generalised_kink, power
from certbound.checker.expressions.operations import OPERATIONS
from certbound.errors import CertificateError
from certbound.problem.model.tape import ARITY, JUMPS
from certbound.safety.answers import exact
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.verification import verify_safety
from tests.checker.mutations import rejected

Data = dict[str, Any]


def linear(**options: Any) -> Data:
    """The certificate of x+ = .5 x + w within [-2, .9], optionally with a disturbance."""
    system = cb.DiscreteSystem(
        (lambda x, d: [0.5 * x[0] + d[0]]) if options else (lambda x: [0.5 * x[0]]), states=["x"],
        noise=cb.Gaussian(std=0.05), **options,
    )
    problem = cb.Problem(system, initial=[0.1], safe=[cb.Inside(cb.Box([-2], [0.9]))], horizon=4)
    return parse(certificate_text(problem, verify_safety(problem, method="linear")))


def jumping(data: Data, op: str, slot: int, at: float) -> Data:
    """The dynamics of a certificate plus 5 (1 + op(input - at)), which the linearisation does not see."""
    tape = data["problem"]["dynamics"]
    nodes = tape["nodes"]
    nodes += [["input", slot], ["const", at.hex()], ["sub", len(nodes), len(nodes) + 1], [op, len(nodes) + 2]]
    nodes += [["const", (1.0).hex()], ["add", len(nodes) - 1, len(nodes)], ["const", (5.0).hex()]]
    nodes += [["mul", len(nodes) - 1, len(nodes) - 2], ["add", tape["outputs"][0], len(nodes)]]
    tape["outputs"] = [len(nodes) - 1]
    return data


@pytest.mark.parametrize("op", ["sign", "floor"])
def test_a_jump_in_a_state_that_enters_linearly_is_not_proved_over(op: str) -> None:
    report = check_data(jumping(linear(), op, 1, 0.2))
    assert not report.valid
    assert "may jump with x" in report.reason


def test_a_jump_in_a_disturbance_that_enters_linearly_is_not_proved_over() -> None:
    data = linear(disturbance=cb.Box([0.0], [0.1]))
    assert check_data(data).valid
    report = check_data(jumping(data, "sign", 2, 0.09))
    assert not report.valid
    assert "may jump with d" in report.reason


def test_a_step_far_from_the_tube_is_decided_where_its_state_has_bounds() -> None:
    """y enters the first row linearly but for a step at 1, and the second row nonlinearly."""
    system = cb.DiscreteSystem(
        lambda x: [0.5 * x[0] + 0.1 * x[1] + np.where(x[1] > 1.0, 2.0, 0.0), 0.5 * np.sin(x[1])], states=["x", "y"],
        noise=cb.Gaussian(std=0.05),
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-0.9, -0.9], [0.9, 0.9]))]
    problem = cb.Problem(system, initial=[0.1, 0.1], safe=safe, horizon=3)
    verdict = verify_safety(problem, method="linear")
    assert verdict.status == "SAFE"
    data = parse(certificate_text(problem, verdict))
    assert check_data(data).valid
    edge = data["problem"]["dynamics"]["nodes"].index(["const", (1.0).hex()])
    data["problem"]["dynamics"]["nodes"][edge][1] = (0.25).hex()
    report = check_data(data)
    assert not report.valid
    assert "may jump with y" in report.reason


def test_a_function_that_is_undefined_where_it_cancels_is_not_proved_over() -> None:
    data = linear()
    tape = data["problem"]["dynamics"]
    nodes = tape["nodes"]
    nodes += [["input", 1], ["log", len(nodes)], ["sub", len(nodes) + 1, len(nodes) + 1]]
    nodes += [["add", tape["outputs"][0], len(nodes) - 1]]
    tape["outputs"] = [len(nodes) - 1]
    assert not check_data(data).valid


def test_the_slope_of_abs_is_no_operation_of_a_model() -> None:
    """Its derivative counts as 0 and its value as all of [-1, 1]: a model with it would contract by decree."""
    with pytest.raises(CertificateError, match="no operation"):
        check_data(jumping(linear(), "kink", 1, 0.2))


@pytest.fixture
def chain_data(stepping: Any) -> Data:
    data: Data = stepping.data
    return data


def test_nodes_that_refer_forward_or_outside_are_refused(chain_data: Data) -> None:
    nodes = chain_data["problem"]["dynamics"]["nodes"]
    for node in (["neg", len(nodes)], ["neg", len(nodes) + 1], ["neg", 10**6], ["input", 99], ["add", 0, len(nodes)]):
        nodes.append(node)
        with pytest.raises(CertificateError):
            check_data(chain_data)
        nodes.pop()
    nodes.append(["neg", -1])
    with pytest.raises(CertificateError):
        check_data(chain_data)


@pytest.mark.parametrize(
    "text", ["nan", "inf", "-inf", "0x1.8p+99999", "0x.8p+0", "0X1.8P+1", "0x1.8p+1 ", "0x1.8p1", "1e-3", "٣", "", "-"]
)
def test_numbers_that_are_none_are_refused_everywhere(chain_data: Data, text: str) -> None:
    chain_data["claim"]["log10_delta"] = text
    with pytest.raises(CertificateError):
        check_data(chain_data)


@pytest.mark.parametrize("level", [-1.7976931348623157e308, -1e15])
def test_absurdly_small_probabilities_are_not_proved(request: pytest.FixtureRequest, level: float) -> None:
    for name in ("stepping", "contracting", "springing"):
        data = request.getfixturevalue(name).data
        data["claim"]["log10_delta"] = level.hex()
        report = check_data(data)
        assert not report.valid
        assert math.isfinite(report.log10_delta)


def test_the_trivial_claim_is_proved_with_a_sign_of_zero(chain_data: Data) -> None:
    for text in ("0x0.0p+0", "-0x0.0p+0"):
        chain_data["claim"]["log10_delta"] = text
        assert check_data(chain_data).valid


def test_ends_that_are_swapped_are_refused(request: pytest.FixtureRequest) -> None:
    stepping, contracting = (request.getfixturevalue(name) for name in ("stepping", "contracting"))
    data = stepping.data
    cell = data["proof"]["cells"][0]
    cell["remainder_low"], cell["remainder_high"] = cell["remainder_high"], cell["remainder_low"]
    assert rejected(data)
    for data in (stepping.data, contracting.data):
        initial = data["problem"]["initial"]
        initial["low"], initial["high"] = initial["high"], initial["low"]
        assert rejected(data)
    data = stepping.data
    data["proof"]["splits"] = [row[::-1] for row in data["proof"]["splits"]]
    assert rejected(data)
    data = contracting.data
    data["proof"]["times"].reverse()
    assert rejected(data)


def test_pieces_that_overlap_or_leave_a_gap_are_refused(contracting: Any, flowing: Any) -> None:
    data = contracting.data
    del data["proof"]["times"][3], data["proof"]["middles"][3], data["proof"]["rooms"][3]
    for name in ("nominal", "eta", "radius"):
        del data["proof"]["cells"][0][name][3]
    data["proof"]["cells"][0]["separations"] = [
        item if item is None else item[:3] + item[4:] for item in data["proof"]["cells"][0]["separations"]
    ]
    assert rejected(data)
    for index, value in ((0, 0.1), (-1, 0.9), (3, 0.0)):
        data = contracting.data
        data["proof"]["times"][index] = value.hex()
        assert rejected(data)
    data = flowing.data
    data["proof"]["cells"][0]["nominal"][5] = data["proof"]["cells"][0]["nominal"][4]
    assert rejected(data)


def test_cells_that_leave_a_part_of_the_initial_set_out_are_refused(chain_data: Data) -> None:
    splits = chain_data["proof"]["splits"]
    for j, row in enumerate(splits):
        kept = list(row)
        splits[j] = [kept[0], kept[0]]
        assert rejected(chain_data)
        splits[j] = [np.nextafter(float.fromhex(kept[0]), 9).hex(), *kept[1:]]
        edge = float.fromhex(chain_data["problem"]["initial"]["low"][j])
        assert rejected(chain_data) or float.fromhex(splits[j][0]) <= edge
        splits[j] = kept


def test_a_claim_about_another_horizon_is_refused(request: pytest.FixtureRequest) -> None:
    """Twice the horizon, with everything else as it was."""
    for name in ("stepping", "flowing", "contracting", "springing"):
        case = request.getfixturevalue(name)
        data = case.data
        data["problem"]["horizon"] = (2 * float.fromhex(data["problem"]["horizon"])).hex()
        for level in (data["claim"]["log10_delta"], (math.log10(float.fromhex(data["problem"]["delta"]))).hex()):
            data["claim"]["log10_delta"] = level
            assert rejected(data, case.given)
        if name != "springing":  # the barrier's own numbers say what follows for any horizon
            assert rejected(data)


def test_constraints_cannot_be_dropped_from_the_proof(request: pytest.FixtureRequest) -> None:
    for name in ("stepping", "flowing", "contracting"):
        case = request.getfixturevalue(name)
        data = case.data
        data["proof"]["cells"][0]["separations"].pop()
        assert rejected(data)
        data = case.data
        data["problem"]["constraints"].pop()
        assert rejected(data, case.given)
        data = case.data
        separations = data["proof"]["cells"][0]["separations"]
        place = next(k for k, item in enumerate(separations) if item is not None)
        separations[place] = None
        assert rejected(data)
        data = case.data
        separations = data["proof"]["cells"][0]["separations"]
        separations[place] = [
            [(0.0).hex()] * len(row) if isinstance(row, list) else row for row in separations[place]
        ]
        assert rejected(data) or not any(isinstance(row, list) for row in separations[place])


def test_negative_levels_rooms_and_radii_prove_nothing(request: pytest.FixtureRequest) -> None:
    stepping, contracting = (request.getfixturevalue(name) for name in ("stepping", "contracting"))
    data = stepping.data
    data["proof"]["cells"][0]["levels"][0][0] = (-1.0).hex()
    assert rejected(data)
    for name in ("rooms", "radius", "eta"):
        for value in (-1.0, -1e300, -0.0):
            data = contracting.data
            holder = data["proof"] if name == "rooms" else data["proof"]["cells"][0]
            holder[name] = [value.hex()] * len(holder[name])
            assert rejected(data)
    for name in ("sigma", "nu", "rate"):
        data = contracting.data
        data["proof"][name] = (-abs(float.fromhex(data["proof"][name])) - 10).hex()
        assert rejected(data)


def test_huge_numbers_prove_nothing(request: pytest.FixtureRequest) -> None:
    stepping, contracting, springing = (request.getfixturevalue(n) for n in ("stepping", "contracting", "springing"))
    for value in (1e308, 1e200, 5e-324):
        data = contracting.data
        data["proof"]["kummer"]["v0"] = value.hex()
        assert rejected(data)
        data = stepping.data
        data["proof"]["cells"][0]["levels"] = [
            [value.hex() for _ in row] for row in data["proof"]["cells"][0]["levels"]
        ]
        assert rejected(data)
        for name in ("growth", "start", "boundary"):
            data = springing.data
            data["proof"][name] = value.hex()
            assert rejected(data)
        data = springing.data
        data["proof"]["coefficients"] = [value.hex()] * len(data["proof"]["coefficients"])
        assert rejected(data)


def test_a_barrier_about_a_smaller_safe_set_or_start_is_bound_to_the_problem(springing: Any) -> None:
    def altered(part: str, name: str, factor: float) -> Data:
        data: Data = springing.data
        holder = data["problem"][part]
        if part == "initial":
            holder[name] = [(factor * float.fromhex(x)).hex() for x in holder[name]]
        else:
            holder[0]["region"][name] = (factor * float.fromhex(holder[0]["region"][name])).hex()
        return data

    for data in (altered("initial", "low", 0.5), altered("constraints", "bound", 1.1)):
        assert rejected(data, springing.given)
    assert rejected(altered("initial", "low", 1.5))
    assert rejected(altered("constraints", "bound", 0.9))


def test_an_initial_ellipsoid_that_is_none_is_refused(chain_data: Data) -> None:
    shape = exact([[1e-4, 1.0], [1.0, 1e-4]])
    chain_data["problem"]["initial"] = {"kind": "ellipsoid", "center": exact([0.25, 0.15]), "shape": shape}
    with pytest.raises(CertificateError, match="positive definite"):
        check_data(chain_data)


def test_objects_nested_deeply_inside_a_valid_frame_are_refused(chain_data: Data) -> None:
    inner: Any = []
    for _ in range(900):
        inner = [inner]
    for part in ("problem", "proof", "claim"):
        for name in list(chain_data[part]):
            kept = chain_data[part][name]
            chain_data[part][name] = inner
            assert rejected(chain_data)
            chain_data[part][name] = kept


@pytest.mark.parametrize("op", sorted(op for op in OPERATIONS if ARITY[op] == 1 and op not in ("kink", "pow")))
def test_no_operation_makes_a_number_of_what_is_undefined(op: str) -> None:
    for undefined in (arb.nan(), arb(0, 1).log(), 1 / arb(0, 1)):
        try:
            assert OPERATIONS[op].ball(undefined).is_nan()
        except Undecided:
            assert op in JUMPS
    assert all(power(arb.nan(), exponent).is_nan() for exponent in (0.0, 1.0, 2.0, -1.0, 0.5))
    assert generalised_kink(arb.nan()).is_nan()
    for second in ("add", "sub", "mul", "div", "hypot", "min", "max"):
        assert OPERATIONS[second].ball(arb.nan(), arb(1)).is_nan()
        assert OPERATIONS[second].ball(arb(0), arb.nan()).is_nan()
    assert OPERATIONS["atan2"].ball(arb.nan(), arb(1)).is_nan()


@pytest.mark.parametrize("rate", [lambda x: np.tanh(np.log(x)), lambda x: np.sin(np.sqrt(x - 0.05))])
def test_what_is_bounded_but_undefined_is_not_proved_over(rate: Any) -> None:
    """tanh and sine are bounded whatever they are given, but not where nothing is given to them."""
    system = cb.ContinuousSystem(lambda x: [-x[0] + 1e-9 * rate(x[0])], states=["x"], diffusion=[[0.3]])
    problem = cb.Problem(system, initial=cb.Box([0.1], [0.2]), safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1.0)
    data = {
        "format": "certbound certificate", "version": 1, "problem": problem_data(problem),
        "claim": {"log10_delta": (-1.0).hex(), "method": "barrier", "assumptions": []},
        "proof": {
            "engine": "barrier", "center": exact([0.0]), "scale": exact([1.0]), "exponents": [[2]],
            "coefficients": exact([8.0]), "growth": exact(0.8), "start": exact(0.4), "boundary": exact(7.9),
        },
    }  # fmt: skip
    report = check_data(parse(json.dumps(data)))
    assert not report.valid
    assert "grow as slowly" in report.reason
