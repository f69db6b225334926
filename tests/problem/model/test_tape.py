"""A tape is checked when it is built, and shows what its nodes mean."""

import pytest

from certbound.problem.model.tape import ARITY, JUMPS, Node, Tape


def test_a_node_must_refer_to_earlier_nodes():
    with pytest.raises(ValueError, match="must refer to earlier nodes only; node 0"):
        Tape(inputs=("x",), nodes=(Node("neg", (0,)),), outputs=(0,), shape=(1,))


def test_an_input_node_must_refer_to_a_slot():
    with pytest.raises(ValueError, match="must refer to earlier nodes only"):
        Tape(inputs=("x",), nodes=(Node("input", (1,)),), outputs=(0,), shape=(1,))


@pytest.mark.parametrize("node", [Node("erf", (0,)), Node("add", (0,)), Node("sin", (0, 0)), Node("pow", (0, 0))])
def test_an_unknown_operation_or_arity_is_refused(node):
    with pytest.raises(ValueError, match="unknown operation or arity: node 1"):
        Tape(inputs=("x",), nodes=(Node("input", (0,)), node), outputs=(1,), shape=(1,))


def test_an_output_must_be_a_node():
    with pytest.raises(ValueError, match="`outputs` must be indices of nodes"):
        Tape(inputs=("x",), nodes=(Node("input", (0,)),), outputs=(1,), shape=(1,))


def test_the_number_of_input_values_is_checked():
    tape = Tape(inputs=("x",), nodes=(Node("input", (0,)),), outputs=(0,), shape=(1,))
    with pytest.raises(ValueError, match="`inputs` must hold 1 values, got 2"):
        tape.evaluate({}, [1.0, 2.0])


def test_a_description_reads_like_the_expression_and_is_cut():
    nodes = (Node("input", (0,)), Node("const", (), 2.0), Node("mul", (1, 0)), Node("sin", (2,)), Node("sq", (3,)))
    tape = Tape(inputs=("x",), nodes=nodes, outputs=(4,), shape=(1,))
    assert tape.describe(4) == "sin((2 * x))**2"
    long = Tape(inputs=("x" * 200,), nodes=nodes, outputs=(4,), shape=(1,))
    assert len(long.describe(4)) == 120


def test_the_generalised_slope_of_abs_is_no_jump():
    assert ARITY["kink"] == 1
    assert "kink" not in JUMPS
    assert set(ARITY) >= JUMPS
