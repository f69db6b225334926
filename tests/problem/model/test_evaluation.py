"""Compiled tapes evaluate batches, broadcast, and give nan or inf where a function is undefined."""

import numpy as np
import pytest

from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.tracing import trace


def test_inputs_broadcast_to_the_batch():
    evaluate = compile_numpy(trace(lambda t, x: [[t, x[0]], [1.0, x[0] * t]], {"t": ["t"], "x": ["x"]}))
    assert evaluate(1.0, 2.0).shape == (2, 2)
    result = evaluate(np.zeros((4, 1)), np.ones(3))
    assert result.shape == (4, 3, 2, 2)
    np.testing.assert_array_equal(result[0, 0], [[0, 1], [1, 0]])


def test_undefined_values_are_nan_or_inf_without_a_warning():
    evaluate = compile_numpy(trace(lambda x: [np.log(x[0]), 1 / x[0], np.sqrt(x[0])], {"x": ["x"]}))
    with np.errstate(all="raise"):
        result = evaluate([0.0, -1.0])
    np.testing.assert_array_equal(result[0], [-np.inf, np.inf, 0.0])
    assert np.isnan(result[1, 0])
    assert np.isnan(result[1, 2])


def test_the_number_of_inputs_is_checked():
    with pytest.raises(ValueError, match=r"`inputs` must hold 2 values \(a, b\), got 1"):
        compile_numpy(trace(lambda x: x, {"x": ["a", "b"]}))(1.0)


def test_results_do_not_alias_the_inputs():
    value = np.array([1.0, 2.0])
    result = compile_numpy(trace(lambda x: x, {"x": ["a"]}))(value)
    result[:] = 0.0
    np.testing.assert_array_equal(value, [1.0, 2.0])


def test_registers_are_reused_without_mixing_values():
    """A long computation that keeps an early value to the end."""

    def function(x):
        y = x[0]
        for k in range(50):
            y = np.sin(y) + k * x[1]
        return [y, x[0] + y, x[1]]

    a, b = np.array([0.3, 0.4]), np.array([0.5, 0.6])
    y = a
    for k in range(50):
        y = np.sin(y) + k * b
    result = compile_numpy(trace(function, {"x": ["a", "b"]}))(a, b)
    np.testing.assert_allclose(result, np.stack([y, a + y, b], axis=-1), rtol=1e-14)
