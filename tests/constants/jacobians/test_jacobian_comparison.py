"""The comparison of interval Jacobians: ours enclose, the same ones without outward rounding do not."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.constants.model_data import model_of
from certbound.constants.state_jacobian import StateJacobian
from certbound.rigor.intervals import Interval
from experiments import jacobian_comparison as comparison
from experiments.constants_suite import suite


@pytest.mark.parametrize("name", ["pendulum", "cart_pole"])
def test_outward_rounding_is_what_makes_point_boxes_enclose(name, monkeypatch):
    monkeypatch.setattr(comparison, "immrax_version", lambda: None)
    table = comparison.compare(name, 100, np.random.default_rng(0))
    assert set(table) == {"certbound", "certbound centred", "unrounded"}
    for label in ("certbound", "certbound centred"):
        assert np.all(table[label][:, 1] == 1)
        assert np.all(table[label][1:, 0] >= 1)
    assert table["unrounded"][0, 1] < 0.5
    assert table["certbound centred"][2, 0] <= table["certbound"][2, 0]


def test_a_value_outside_is_seen_and_rounding_comes_back():
    source, domain = suite()["pendulum"]
    model = model_of(source, domain, 1.0)
    jacobian = StateJacobian(model.dynamics, model.state_slots, model.ranges)
    boxes = Interval([[0.1]], [[0.2]])
    before = jacobian.enclose(boxes)
    rounded = comparison.without_rounding(jacobian, boxes)
    after = jacobian.enclose(boxes)
    assert np.array_equal(before.lo, after.lo)
    assert np.all(rounded.lo >= before.lo)
    assert np.any(rounded.lo > before.lo)
    values = comparison.exact(jacobian, np.array([[0.1], [0.15]]))
    assert comparison.encloses(before, values, 0)
    assert not comparison.encloses(jacobian.enclose(Interval([[0.11]], [[0.2]])), values, 0)
