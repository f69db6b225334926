"""What constraints say about boxes."""

from __future__ import annotations

import json

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data
from certbound.problem.files.loading import loads
from certbound.rigor.intervals import Interval
from certbound.safety.certificate import certificate_text
from certbound.values.sets import active_at, box_around, contains, respected

REGIONS = [
    cb.Box([-0.5, -np.inf], [0.7, 0.4]),
    cb.Box([-0.5, -0.3], [0.7, 0.4], center=lambda t: [0.1 * t, -0.2]),
    cb.Box([-0.5], [0.4], coordinates=[1]),
    cb.Ball([0.1, 0.2], 0.6),
    cb.Ball(lambda t: [0.1 * t, 0.2], 0.6),
    cb.Ellipsoid([0.1, 0.0], [[0.5, 0.2], [0.2, 0.3]]),
    cb.HalfSpace([1.0, -2.0], 0.3),
    cb.Polytope([[1.0, 1.0], [-1.0, 0.5], [0.0, -1.0]], [0.5, 0.6, 0.7]),
]


@pytest.mark.parametrize("region", REGIONS)
@pytest.mark.parametrize("interiors", [False, True])
def test_surely_inside_and_surely_outside_hold_at_every_point(region: cb.Region, interiors: bool) -> None:
    rng = np.random.default_rng(0)
    low = rng.uniform(-1.2, 1.2, (400, 2))
    boxes = Interval(low, low + rng.uniform(0, 0.3, (400, 2)))
    inside, outside = contains(region, boxes, 2, interiors=interiors)
    assert inside.any()
    assert outside.any()
    assert not np.any(inside & outside)
    points = boxes.lo[:, None] + rng.uniform(0.001, 0.999, (400, 60, 2)) * (boxes.hi - boxes.lo)[:, None]
    held = region.contains(points, 2.0)
    assert held[inside].all()
    assert not held[outside].any()
    undecided = ~inside & ~outside
    assert undecided.mean() < 0.5


def test_a_face_counts_unless_only_interiors_do() -> None:
    boxes = Interval(np.array([[0.5, 0.0]]), np.array([[0.6, 0.1]]))
    obstacle = [cb.Outside(cb.Box([0.0, 0.0], [0.5, 1.0]))]
    assert not respected(obstacle, boxes, 0)[0].any()
    assert respected(obstacle, boxes, 0, interiors=True)[0].all()


@pytest.mark.parametrize("region", REGIONS)
def test_the_box_around_a_region_holds_it(region: cb.Region) -> None:
    low, high = box_around([cb.Inside(region)], 2, 2)
    points = np.random.default_rng(1).uniform(-2, 2, (5000, 2))
    held = points[region.contains(points, 2.0)]
    assert np.all((low <= held) & (held <= high))


def test_obstacles_and_windows_put_no_box_around_anything() -> None:
    constraints = [cb.Outside(cb.Ball([0, 0], 1)), cb.Inside(cb.Box([-1, -1], [1, 1]), during=(2, 3))]
    assert np.isinf(box_around(active_at(constraints, 1), 2, 1)[0]).all()
    assert np.isfinite(box_around(active_at(constraints, 2), 2, 2)[0]).all()


def test_a_half_space_to_keep_out_of_bounds_a_state() -> None:
    low, high = box_around([cb.Outside(cb.HalfSpace([-2, 0], -3)), cb.Outside(cb.HalfSpace([1, 1], 0))], 2, 0)
    np.testing.assert_allclose(high, [1.5, np.inf])
    assert np.isinf(low).all()


LEVEL = """
time = "continuous"
horizon = 1.5
states = ["gut", "blood"]
delta = 0.05

[dynamics]
gut = "0.3 - 0.3*gut"
blood = "0.5*gut - 0.5*blood"

[noise]
diffusion = { gut = "0.2*gut", blood = "0.2*blood" }

[initial]
point = [1.0, 1.0]

[[avoid]]
halfspace = { normal = { blood = -1 }, bound = -1.7 }

[[stay]]
box = { gut = [0.3, 2.5], blood = [0.4, 4] }
"""


def test_a_level_that_is_to_be_avoided_is_a_limit() -> None:
    """Simulated .0067; as a curved wall the limit left .30 after 52 s, of .015 over a horizon of 2."""
    problem = loads(LEVEL)
    verdict = cb.verify_safety(problem, method="values", time_limit=60)
    assert verdict.status == "SAFE"
    data = json.loads(certificate_text(problem, verdict))
    report = check_data(data)
    assert report.valid
    avoided = [one for one in data["problem"]["constraints"] if one["kind"] == "outside"]
    assert len(avoided) == 1
    avoided[0]["region"]["bound"] = (-1.69).hex()  # more is to be avoided than V vanishes at
    assert not check_data(data).valid
