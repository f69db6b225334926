"""A shape that the package does not know: what CONTRIBUTING.md asks of one is all that every room needs."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import pytest
from matplotlib.patches import Polygon

import certbound as cb
from certbound.checker import check_data, parse
from certbound.checks import frozen
from certbound.errors import CertificateError
from certbound.plotting import Scene, draw_scene
from certbound.problem.model import Tape, trace
from certbound.problem.sets import Faces, Region
from certbound.rigor.intervals import Interval
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.engines import barrier
from certbound.values.discrete import bound_failure


@dataclass(frozen=True, eq=False)
class Diamond(Region):
    """{|x - center|_1 <= radius}."""

    center: Any
    radius: float
    coordinates: Any = None

    @cached_property
    def form(self) -> Faces:
        size = self.center.shape[0] if isinstance(self.center, Tape) else len(self.center)
        normals = np.array(list(itertools.product((1.0, -1.0), repeat=size)))
        return Faces(frozen(normals), frozen(np.full(len(normals), self.radius)))

    def extent(self) -> Interval:
        reach = np.full(self.dimension, self.radius)
        return Interval(-reach, reach)


MOVING = trace(lambda t: [0.7 - 0.05 * t, 0.5], {"t": ["t"]})


def course(start: Any = Diamond([0.3, -0.2], 0.05), **options: Any) -> cb.Problem:
    system = cb.DiscreteSystem(
        lambda x: [0.9 * x[0] - 0.1 * x[1], 0.1 * x[0] + 0.8 * x[1]], states=2, noise=cb.Gaussian(std=0.08)
    )
    safe = [
        cb.Inside(Diamond([0.1, 0.0], 0.9)), cb.Outside(Diamond(MOVING, 0.25)),
        cb.Outside(Diamond([-0.4, -0.5], 0.2), during=(1, 3)),
    ]  # fmt: skip
    return cb.Problem(system, **({"initial": start, "safe": safe, "horizon": 4, "delta": 0.1} | options))


@cache
def counted() -> cb.ExitCounts:
    """Paths of the course that leave."""
    return cb.simulate_exits(course(), paths=20_000, rng=np.random.default_rng(0), halve=False)


@cache
def proved(method: str) -> cb.Verdict:
    return cb.verify_safety(course(), method=method)


def as_polytopes(problem: cb.Problem) -> cb.Problem:
    """The same problem with the package's own shapes, where nothing moves."""
    safe = [type(c)(cb.Polytope(*around_origin(c.region)), during=c.during) for c in problem.safe]
    return problem.replace(safe=safe)


def around_origin(region: Region) -> tuple[Any, Any]:
    normals, bounds = region.halfspaces()
    return normals, bounds + normals @ region.center_at()


def test_it_contains_what_it_says_and_samples_it() -> None:
    region = Diamond(MOVING, 0.25, coordinates=(2, 0))
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    inside = np.abs(points[:, [2, 0]] - region.center_at(2.0)).sum(axis=1) <= 0.25
    assert inside.any()
    np.testing.assert_array_equal(region.contains(points, 2.0), inside)
    found = Diamond([0.1, 0.2], 0.3).sample(np.random.default_rng(1), 500)
    assert np.all(np.abs(found - [0.1, 0.2]).sum(axis=1) <= 0.3 * (1 + 1e-12))
    np.testing.assert_allclose(region.support([[1.0, 0.0, -3.0]], 2.0), 0.5 - 3 * 0.6 + 0.75)
    assert np.isinf(region.support([[0.0, 1.0, 0.0]])[0])


@pytest.mark.parametrize("method", ["auto", "constants", "linear"])
def test_what_is_certified_lies_above_the_simulation(method: str) -> None:
    verdict = proved(method)
    (answer,) = [a for a in verdict.answers.values() if a.log10_delta == verdict.log10_delta]
    assert answer.applicable, answer.reason
    assert 1e-4 < 10**verdict.log10_delta < 0.9
    assert counted().lower <= 10**verdict.log10_delta


def test_value_functions_bound_it_from_both_sides() -> None:
    found, counts = bound_failure(course(), seconds=0.5), counted()
    assert 1e-4 < found.upper < 0.9
    assert counts.lower <= found.upper
    assert 0 < found.lower <= counts.upper


def test_it_is_proved_in_continuous_time_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(barrier._FINE, 2, 21)  # where the program looks; what is proved does not rest on it
    flow = cb.ContinuousSystem(lambda x: [0.3 * x[1] - x[0], -x[1] - x[0] ** 3], states=2, diffusion=0.15 * np.eye(2))
    safe = [cb.Inside(Diamond([0.0, 0.0], 1.0)), cb.Outside(Diamond([0.6, 0.6], 0.3))]
    problem = cb.Problem(
        flow, initial=Diamond([0.1, 0.0], 0.05), safe=safe, horizon=0.5, delta=0.2,
        domain=cb.Box([-1.1, -1.1], [1.1, 1.1]),  # for the barrier, which asks for a box
    )  # fmt: skip
    low = cb.simulate_exits(problem, paths=10_000, steps=200, rng=np.random.default_rng(0), halve=False).lower
    for method in ("constants", "linear", "barrier"):
        verdict = cb.verify_safety(problem, method=method)
        assert low <= 10**verdict.log10_delta < 1, method


def test_a_start_that_leaves_the_set_somewhere_is_refused() -> None:
    with pytest.raises(ValueError, match="a part of it violates 'inside a Diamond of 4 faces'"):
        course(Diamond([0.3, -0.2], 0.6), safe=[cb.Inside(Diamond([0.1, 0.0], 0.9))])
    with pytest.raises(ValueError, match="`initial` must be a fixed set"):
        course(Diamond(MOVING, 0.1))


def test_a_start_whose_box_does_not_hold_it_is_refused() -> None:
    short = type("Short", (Region,), dict(vars(Diamond), extent=lambda region: Interval([-0.01] * 2, [0.01] * 2)))
    with pytest.raises(ValueError, match=r"its `extent` from .*let `extent` of Short hold the whole set"):
        course(short([0.3, -0.2], 0.05))


def test_polytopes_with_the_same_faces_have_the_same_bound() -> None:
    centred = [cb.Inside(Diamond([0.0, 0.0], 1.0)), cb.Outside(Diamond([0.75, 0.5], 0.25), during=(0, 2))]
    problem = course(safe=centred)
    for method in ("constants", "linear"):
        bounds = [cb.verify_safety(p, method=method).log10_delta for p in (problem, as_polytopes(problem))]
        assert bounds[0] == pytest.approx(bounds[1], rel=1e-9), method


def test_a_file_states_its_faces(tmp_path: Any) -> None:
    problem = course([0.3, -0.2], safe=[cb.Inside(Diamond([0.1, 0.0], 0.9)), cb.Outside(Diamond([0.7], 0.2, (1,)))])
    cb.save(problem, tmp_path / "course.toml")
    again = cb.load(tmp_path / "course.toml")
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (2000, 2))
    for mine, theirs in zip(problem.safe, again.safe, strict=True):
        assert type(theirs.region) is cb.Polytope
        np.testing.assert_array_equal(mine.satisfied(points), theirs.satisfied(points))
    with pytest.raises(ValueError, match="a moving Diamond cannot be written"):
        cb.save(course([0.3, -0.2]), tmp_path / "moving.toml")
    with pytest.raises(ValueError, match="a Diamond cannot be written as a start"):
        cb.save(course(safe=[]), tmp_path / "start.toml")


@pytest.mark.parametrize("method", ["constants", "linear"])
def test_its_certificate_is_accepted_and_a_forged_one_is_not(method: str) -> None:
    problem = course()
    text = certificate_text(problem, proved(method))
    report = check_data(parse(text), json.loads(json.dumps(problem_data(problem))))
    assert report.valid, report.reason
    assert counted().lower <= 10**report.log10_proved
    for number, change in ((0, -0.3), (1, 0.2)):  # a smaller safe set, a larger obstacle
        forged = parse(text)
        region = forged["problem"]["constraints"][number]["region"]
        assert region["kind"] == "polytope"
        region["b"] = [(float.fromhex(b) + change).hex() for b in region["b"]]
        assert not check_data(forged).valid
    moved = parse(text)  # the obstacle stands where the paths begin
    moved["problem"]["constraints"][1]["region"]["center"] = [(0.3).hex(), (-0.2).hex()]
    assert not check_data(moved).valid


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coordinates": [0, 0]}, "different states"),
        ({"coordinates": [0, 2]}, r"must lie in 0\.\.1"),
        ({"coordinates": [1]}, "must have 1 entries"),
        ({"center": [(0.0).hex()]}, "must have 2 entries"),
        ({"radius": (1.0).hex()}, "unknown entry"),
    ],
)
def test_a_certificate_whose_faces_do_not_fit_is_refused(change: dict[str, Any], message: str) -> None:
    problem = course()
    data = parse(certificate_text(problem, cb.verify_safety(problem, method="linear")))
    data["problem"]["constraints"][0]["region"] |= change
    with pytest.raises(CertificateError, match=message):
        check_data(data)


def test_it_is_drawn_as_far_as_the_picture_goes() -> None:
    problem = course(safe=[cb.Inside(Diamond([0.1, 0.0], 0.9)), cb.Outside(Diamond([0.45, 0.15], 0.1))])
    plane = draw_scene(Scene(problem=problem, reach=cb.verify_safety(problem, method="constants").reach)).axes[0]
    border, obstacle = (patch.get_path().vertices for patch in plane.patches if isinstance(patch, Polygon))
    assert len(obstacle) == 5  # and back to the first corner
    for reach in (np.sum, np.max):
        np.testing.assert_allclose(reach(np.abs(obstacle - [0.45, 0.15]), axis=1), 0.1)
    np.testing.assert_allclose(np.abs(border - [0.1, 0.0]).sum(axis=1), 0.9)
