"""Polygons by corners and intersections: what they contain, on which side rounding lies, files, and bad input."""

from fractions import Fraction

import numpy as np
import pytest

import certbound as cb
from certbound.problem.files.loading import load, loads, save
from certbound.problem.sets import intersection, polygon

PLANE = """
time = "continuous"
horizon = 1
states = ["px", "py"]
[dynamics]
px = "-px"
py = "-py"
[noise]
diffusion = [[0.1, 0], [0, 0.1]]
[initial]
point = [0.1, 0.2]
"""


def exact_sides(corners):
    """For every side its exact normal (dy, -dx) and bound."""
    points = [(Fraction(x), Fraction(y)) for x, y in corners]
    for (x0, y0), (x1, y1) in zip(points, points[1:] + points[:1]):
        yield y1 - y0, x0 - x1, (y1 - y0) * x0 + (x0 - x1) * y0


@pytest.mark.parametrize("turned", [False, True])
def test_rounding_lies_on_the_asked_side(turned):
    rng = np.random.default_rng(3)
    for _ in range(20):
        angles = np.sort(rng.uniform(0, 2 * np.pi, 5))
        corners = 3 * rng.normal(size=2) + np.stack([np.cos(angles), np.sin(angles)], axis=1)
        outer, inner = (polygon(corners[::-1] if turned else corners, outward=side) for side in (True, False))
        assert all(outer.contains(corner) for corner in corners)
        assert not any(inner.contains(corner) for corner in corners)
        middle = corners.mean(axis=0)
        for share in (1 - 1e-12, 1 + 1e-12):
            points = middle + share * (corners - middle)
            sides, exact = list(exact_sides(corners)), [(Fraction(x), Fraction(y)) for x, y in points]
            inside = [all(x * a + y * b <= c for a, b, c in sides) for x, y in exact]
            assert all(outer.contains(p) or not held for p, held in zip(points, inside))
            assert all(held or not inner.contains(p) for p, held in zip(points, inside))


def test_a_polygon_in_two_of_three_states():
    found = polygon([[0, 0], [2, 0], [0, 1]], places=(2, 0), dimension=3, outward=True)
    assert found.contains([0.4, 100.0, 0.4])
    assert not found.contains([0.4, 0.0, 1.5])


@pytest.mark.parametrize(
    "corners",
    [
        [[0, 0], [1, 0]],
        [[0, 0], [1, 1], [2, 2]],
        [[0, 0], [1, 0], [2, 0], [1, 1]],
        [[0, 0], [2, 0], [0.5, 0.5], [0, 2]],
        [[0, 0], [1, 1], [1, 0], [0, 1]],
    ],
)
def test_what_is_no_convex_polygon_is_refused(corners):
    with pytest.raises(ValueError, match="corners of a convex polygon in order"):
        polygon(corners, outward=True)


def test_an_intersection_is_what_all_parts_hold():
    box, half = cb.Box([0.0, -np.inf], [1.0, 2.0], center=[0.3, 0.1]), cb.HalfSpace([1.0, 1.0], 1.5)
    both = intersection([box, half], dimension=2, outward=True)
    points = np.random.default_rng(0).uniform(-1, 3, (2000, 2))
    np.testing.assert_array_equal(both.contains(points), box.contains(points) & half.contains(points))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([cb.Ball([0, 0], 1.0), cb.HalfSpace([1, 0], 0)], "the ball is round; put a polygon around it"),
        ([cb.Box([0, 0], [1, 1], center=lambda t: [t, 0.0])], "the box moves"),
        ([cb.Box([0, 0], [1, 1]), cb.HalfSpace([1, 0], -1)], "must hold sets with a point in common"),
    ],
)
def test_what_cannot_be_intersected_is_refused(parts, message):
    with pytest.raises(ValueError, match=message):
        intersection(parts, dimension=2, outward=True)


def test_files_state_polygons_and_intersections(tmp_path):
    text = PLANE + """
[[stay]]
all = [ { ball = { center = [0, 0], radius = 2 } }, { box = { px = [-1, 1] } } ]
during = [0, 0.5]
[[avoid]]
polygon = { vertices = [[1, 1], [2, 1], [1, 2]] }
[[avoid]]
all = [ { box = { px = [0.5, 1], py = [0.5, 1] } }, { halfspace = { normal = { px = -1, py = 1 }, bound = 0 } } ]
[[reach]]
polygon = { vertices = { py = [-0.5, 0.5, 0], px = [-0.5, -0.5, 0.5] } }
"""
    problem = loads(text)
    assert [type(c.region).__name__ for c in problem.safe] == ["Ball", "Box", "Polytope", "Polytope"]
    assert problem.safe[0].during == problem.safe[1].during == (0.0, 0.5)
    assert problem.safe[2].satisfied([0.9, 0.9])
    assert not problem.safe[2].satisfied([1.2, 1.2])
    assert not problem.safe[3].satisfied([0.9, 0.6])
    assert problem.safe[3].satisfied([0.6, 0.9])
    assert problem.reach.region.contains([0.0, 0.1])
    assert not problem.reach.region.contains([0.4, 0.3])
    for again in (problem, problem.replace(name="traced")):
        save(again, tmp_path / "plane.toml")
        loaded = load(tmp_path / "plane.toml")
        points = np.random.default_rng(0).uniform(-2, 2, (500, 2))
        for mine, theirs in zip(problem.safe, loaded.safe, strict=True):
            np.testing.assert_array_equal(mine.satisfied(points), theirs.satisfied(points))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("[[avoid]]\nall = [ { ball = { center = [1, 1], radius = 0.2 } } ]", "the ball is round"),
        ("[[avoid]]\nall = []", "at least 1 entries"),
        ("[[avoid]]\nall = [ { box = { px = [0.5, 1] }, during = [0, 1] } ]", "unknown key 'during' in a part of all"),
        ("[[avoid]]\nbox = { px = [0.5, 1] }\nall = [ { box = { px = [0.5, 1] } } ]", "needs exactly one of"),
        ("[[avoid]]\npolygon = { vertices = { px = [1, 2, 3] } }", "two of the states px, py by name"),
        ("[[avoid]]\npolygon = { vertices = [[1, 1], [2, 1]] }", "corners of a convex polygon"),
        ("[[stay]]\nall = [ { boxx = { px = [0.5, 1] } } ]", "unknown key 'boxx' in a part of all"),
    ],
)
def test_bad_tables_are_refused(table, message):
    with pytest.raises(ValueError, match=message):
        loads(PLANE + table)


def test_a_polygon_whose_sides_floats_hold_is_exact():
    corners = [[3, 4], [-3, 4], [-3, -4], [3, -4]]
    for outward in (True, False):
        found = polygon(corners, outward=outward)
        assert found.contains(corners).all()
        assert not found.contains(np.array(corners) * (1 + 2.0**-52)).any()


def test_an_intersection_whose_faces_floats_hold_is_exact():
    shifted = cb.Box([-1, -1], [1, 1], center=lambda t: [2 + 0 * t, 0 * t])
    for outward in (True, False):
        found = intersection([shifted, cb.HalfSpace([1.0, 1.0], 4.0)], dimension=2, outward=outward)
        assert found.contains([[3, 1], [1, -1]]).all()
        assert not found.contains([[3 + 2.0**-51, 0], [1 - 2.0**-53, 0]]).any()
