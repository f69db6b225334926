"""Sets whose sides, radius or bounds are functions of t, in Python and in files."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.problem.sets import clearance

SYSTEM = cb.ContinuousSystem(lambda x: -x, states=["x", "y"], diffusion=0.1 * np.eye(2))
FILE = """
name = "moving"
time = "continuous"
horizon = {horizon}
states = ["x", "y"]
[parameters]
tau = 2
[definitions]
wall = "exp(-t/tau)"
[dynamics]
x = "-x"
y = "-y"
[noise]
diffusion = [[0.1, 0], [0, 0.1]]
[initial]
point = [0, 0]
{sets}
"""
SETS = """
[[stay]]
box = {{ x = ["-wall", 2] }}
[[stay]]
halfspace = {{ normal = {{ x = 1, y = 1 }}, bound = "2 - t/4" }}
[[avoid]]
ball = {{ center = {{ x = 2, y = "2 + t" }}, radius = "1 + 0.1*t" }}
[[stay]]
polytope = {{ A = [[1, 0], [0, 1]], b = ["3 - t", 3] }}
"""


def problem(*safe: cb.Inside, **options: object) -> cb.Problem:
    return cb.Problem(SYSTEM, initial=[0, 0], safe=list(safe), **({"horizon": 1.0} | options))


def test_a_set_is_at_every_time_what_its_sides_are_then() -> None:
    box = cb.Box([lambda t: -np.exp(-t), -np.inf], [1.0, lambda t: 1 + t], center=[0.5, 0])
    assert box.at(1.0).low.tolist() == pytest.approx([0.5 - np.exp(-1), -np.inf])
    assert box.at(1.0).high.tolist() == [1.5, 2.0]
    ball = cb.Ball([0, 0], lambda t: 1 + t)
    half = cb.HalfSpace([1, 0], lambda t: 2 - t)
    many = cb.Polytope([[1, 0], [0, 1]], lambda t: [1 - t, 1])
    for region in (box, ball, half, many):
        for t in (0.0, 0.3, 0.9):
            points = np.random.default_rng(1).uniform(-2, 3, (200, 2))
            assert np.array_equal(region.contains(points, t), region.at(t).contains(points))
            assert np.allclose(region.support([1, 0], t), region.at(t).support([1, 0]))
            inside = cb.Inside(region)
            assert np.allclose(clearance(inside, points, None, t), clearance(cb.Inside(region.at(t)), points))


def test_sides_that_do_not_move_are_numbers() -> None:
    box = cb.Box([lambda t: -1 + 0 * t], lambda t: [1.0])
    assert not box.moving
    assert box.low.tolist() == [-1.0]


def test_a_set_whose_sides_move_has_no_form_and_nothing_reads_its_sides_as_numbers() -> None:
    for region in (cb.Box([lambda t: t], [3]), cb.Ball([0], lambda t: 1 + t), cb.HalfSpace([1], lambda t: t + 1)):
        with pytest.raises(InfeasibleError, match="move with t"):
            _ = region.form
        with pytest.raises(InfeasibleError, match="move with t"):
            region.grown(0.1)
        with pytest.raises(InfeasibleError, match="move with t"):
            region.hull()


@pytest.mark.parametrize(
    ("region", "words"),
    [
        (cb.Box([lambda t: 4 * t - 1, -1], [1, 1]), r"safe\[0\].*at most `high` at all times.*at t = 0\.5"),
        (cb.Ball([0, 0], lambda t: 1 - 2 * t), r"positive `radius` at all times, got .* at t = 0\.5"),
        (cb.HalfSpace([1, 0], lambda t: np.sqrt(0.5 - t)), r"defined whenever the set counts.*is nan at t = 0\.5"),
    ],
)
def test_sides_that_are_no_set_at_some_time_are_refused_with_the_time(region: cb.Box, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        problem(cb.Inside(region))
    assert problem(cb.Inside(region, during=(0.0, 0.25))).safe


def test_what_sides_must_be_is_said() -> None:
    with pytest.raises(TypeError, match="from t"):
        cb.HalfSpace([1, 0], lambda s: s)
    with pytest.raises(ValueError, match="one number at every t"):
        cb.Ball([0, 0], lambda t: [t, t])
    with pytest.raises(ValueError, match="`high` must have 2 entries"):
        cb.Box([0, 0], lambda t: [t])
    with pytest.raises(ValueError, match="horizon is infinite"):
        problem(cb.Inside(cb.HalfSpace([1, 0], lambda t: 1 + t)), horizon=np.inf)


def test_files_state_sides_that_move_and_are_written_as_they_were_read(tmp_path: object) -> None:
    text = FILE.format(horizon=1.0, sets=SETS.format())
    read = cb.loads(text) if hasattr(cb, "loads") else None
    if read is None:
        path = tmp_path / "moving.toml"  # type: ignore[operator]
        path.write_text(text, encoding="utf-8")
        read = cb.load(str(path))
    stay, half, many, obstacle = read.safe
    assert stay.label == "-exp((-t / 2)) <= x <= 2"
    assert stay.region.at(1.0).low[0] == pytest.approx(-np.exp(-0.5))
    assert half.region.at(1.0).bound == 1.75
    assert obstacle.region.at(1.0).radius == pytest.approx(1.1)
    assert many.region.at(0.5).b.tolist() == [2.5, 3.0]
    written = tmp_path / "again.toml"  # type: ignore[operator]
    cb.save(read.replace(delta=0.01), written)
    again = cb.load(str(written))
    for one, other in zip(read.safe, again.safe, strict=True):
        assert type(one.region) is type(other.region)
        points = np.random.default_rng(2).uniform(-2, 4, (300, 2))
        assert np.array_equal(one.satisfied(points, 0.7), other.satisfied(points, 0.7))


@pytest.mark.parametrize(
    ("sets", "words"),
    [
        ('[[stay]]\nbox = { x = ["-wal", 1] }', "wal"),
        ('[[stay]]\nbox = { x = ["-y", 1] }', "only t"),
        ('[[stay]]\nhalfspace = { normal = { x = 1 }, bound = "2 - " }', "stay.0.halfspace.bound"),
        ('[[domain]]\nbox = { x = ["-wall", 1] }', "domain"),
    ],
)
def test_files_say_what_is_wrong_with_a_side(tmp_path: object, sets: str, words: str) -> None:
    path = tmp_path / "bad.toml"  # type: ignore[operator]
    path.write_text(FILE.format(horizon=1.0, sets=sets), encoding="utf-8")
    with pytest.raises(ValueError, match=words):
        cb.load(str(path))
