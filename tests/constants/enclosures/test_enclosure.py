"""Enclosures contain sampled values; what is undefined or jumps is refused by name, only where it does."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.constants.enclosures.enclosure import CHUNK, enclose
from certbound.errors import EnclosureError
from certbound.problem.model.derivative import jacobian
from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.tracing import trace
from certbound.rigor.intervals import Interval

FUNCTIONS = {
    "polynomial": lambda x: [x[0] ** 3 - 2 * x[0] * x[1], x[1] ** 2 - x[0]],
    "trigonometric": lambda x: [np.sin(x[0]) * np.cos(x[1]), np.tan(0.3 * x[1]), np.arctan2(x[0], 4 + x[1])],
    "saturating": lambda x: [np.tanh(x[0] + x[1]), np.exp(-x[0] ** 2),
                             1 / (1 + x[1] ** 2), np.hypot(x[0], x[1])],
    "kinks": lambda x: [abs(x[0] - x[1]), np.maximum(x[0], 0.3), np.minimum(x[1], x[0])],
    "roots": lambda x: [np.sqrt(4 + x[0]), np.log(4 + x[1]), np.arcsin(x[0] / 4), (4 + x[0]) ** 1.5],
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("derivative", [False, True])
def test_enclosures_contain_sampled_values(name, derivative):
    rng = np.random.default_rng(0)
    tape = trace(FUNCTIONS[name], {"x": ["a", "b"]})
    tape = jacobian(tape) if derivative else tape
    centre, width = rng.uniform(-2, 2, (2, 300)), 10 ** rng.uniform(-9, 0, (2, 300))
    boxes = enclose(tape, [Interval(c - w, c + w) for c, w in zip(centre, width, strict=True)])
    assert boxes.shape == (300, *tape.shape)
    function = compile_numpy(tape)
    for _ in range(20):
        point = centre + rng.uniform(-1, 1, centre.shape) * width
        slack = 1e-13 * (1 + np.abs(boxes.mid))
        values = function(*point)
        assert np.all((boxes.lo - slack <= values) & (values <= boxes.hi + slack))


def test_batches_larger_than_a_chunk_and_broadcast_inputs_come_back_in_order():
    tape = trace(lambda t, x: [x[0] + t, x[1]], {"t": ["t"], "x": ["a", "b"]})
    a = np.arange(2.0 * CHUNK + 10)
    result = enclose(tape, [Interval.point(1.0), Interval.point(a), Interval.point(np.zeros(len(a)))])
    assert result.contains(np.stack([a + 1, np.zeros(len(a))], axis=1)).all()
    rows, columns = Interval.point(np.zeros((3, 1))), Interval.point(np.zeros((1, 4)))
    grid = enclose(tape, [Interval.point(1.0), rows, columns])
    assert grid.shape == (3, 4, 2)


JUMPING = {
    "sign(a)": lambda x: [np.sign(x[0])],
    "step": lambda x: [np.where(x[0] > 0, 1.0, -1.0)],
    "floor(a)": lambda x: [np.floor(x[0])],
    "atan2": lambda x: [np.arctan2(x[0], x[1])],
    "jump used elsewhere in a branch that is off": lambda x: [
        np.sign(x[0]), np.where(x[1] > 5, np.exp(np.sign(x[0])), 0)
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", JUMPING)
@pytest.mark.parametrize("derivative", [False, True])
def test_an_undecided_jump_is_refused_and_a_decided_one_is_not(name, derivative):
    tape = trace(JUMPING[name], {"x": ["a", "b"]})
    tape = jacobian(tape) if derivative else tape
    across = [Interval([0.5, -1.0], [0.9, 1.0]), Interval([-2.0, -2.0], [-1.0, -1.0])]
    with pytest.raises(EnclosureError, match=r"may jump.* on the box a in \[-1, 1\]"):
        enclose(tape, across)
    kept = enclose(tape, across, undefined="infinite")
    assert np.isfinite(kept.lo[0]).all()
    assert np.isinf(kept.lo[1]).all()
    assert np.isinf(kept.hi[1]).all()


@pytest.mark.parametrize(
    ("function", "expression"),
    [
        (lambda x: [1 / x[0]], r"\(1 / a\)"),
        (lambda x: [np.sqrt(x[0])], r"sqrt\(a\)"),
        (lambda x: [np.log(x[0])], r"log\(a\)"),
        (lambda x: [np.arccos(2 * x[0])], "acos"),
        (lambda x: [np.tan(2 * x[0])], "tan"),
        (lambda x: [x[0] ** -0.5], r"a\*\*-0.5|sqrt"),
    ],
)
def test_an_undefined_operation_is_refused_by_name(function, expression):
    tape = jacobian(trace(function, {"x": ["a"]}))
    place = r".* is undefined somewhere on the box a in \[-1, 1\]"
    with pytest.raises(EnclosureError, match=expression + place):
        enclose(tape, [Interval([-1.0], [1.0])])
    assert np.isfinite(enclose(tape, [Interval([0.1], [0.2])]).lo).all()


def test_an_undefined_branch_that_is_switched_off_is_no_obstacle():
    tape = trace(lambda x: [np.where(x[0] > 0, np.sqrt(x[0]), 0.0)], {"x": ["a"]})
    for form in (tape, jacobian(tape)):
        result = enclose(form, [Interval([-2.0, 1.0], [-1.0, 4.0])])
        assert result.lo.ravel()[0] == 0.0 == result.hi.ravel()[0]
        assert result.contains(np.reshape([0.0, 0.5 if form is not tape else 1.5], result.shape))[1].all()


def test_kinks_get_their_generalised_derivative():
    tape = jacobian(trace(lambda x: [abs(x[0]), np.maximum(x[0], 2 * x[0])], {"x": ["a"]}))
    result = enclose(tape, [Interval([-1.0, 1.0], [1.0, 2.0])])
    assert result.contains(np.array([[[-1.0], [1.5]], [[1.0], [2.0]]])).all()
    assert result.lo[1, 0, 0] > 0.999


def test_infinite_boxes_are_legal():
    tape = jacobian(trace(lambda x: [np.tanh(x[0]), -(x[0] ** 3)], {"x": ["a"]}))
    result = enclose(tape, [Interval([-np.inf], [np.inf])])
    assert result.contains(np.array([[[0.0], [0.0]]])).all()
    assert result.hi[0, 0, 0] < 1 + 1e-15
    assert (result.lo[0, 1, 0], abs(result.hi[0, 1, 0]) < 1e-300) == (-np.inf, True)


def test_malformed_calls_are_refused():
    tape = trace(lambda x: [x[0]], {"x": ["a"]})
    with pytest.raises(ValueError, match="`inputs` must hold 1 intervals, got 2"):
        enclose(tape, [Interval([0.0], [1.0])] * 2)
    with pytest.raises(ValueError, match='`undefined` must be "raise"'):
        enclose(tape, [Interval([0.0], [1.0])], undefined="ignore")


def test_a_refusal_names_only_what_decides_it():
    tape = trace(lambda x: [x[1] + np.tan(x[2]), x[0]], {"x": ["a", "b", "c"]})
    wide = [Interval([-np.inf], [np.inf]) for _ in range(3)]
    with pytest.raises(EnclosureError, match=r"`tan\(c\)` is undefined somewhere on the box c in \[-inf, inf\];"):
        enclose(tape, wide)
