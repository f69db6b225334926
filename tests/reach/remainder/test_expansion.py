"""Second-order expansions of the remainder against the remainder itself."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linprog

import certbound as cb
from certbound.problem.model.analysis import adds_plainly
from certbound.reach.linear.fit import fitted
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.run import LinearRun
from certbound.reach.linear.shares import Share
from certbound.reach.remainder.bound import Remainder
from certbound.reach.remainder.expansion import Expansion
from certbound.reach.remainder.polytope import Boxes, Polytope, linear_range
from certbound.reach.remainder.samples import sampled_range

Array = NDArray[np.float64]


def swinging() -> cb.Problem:
    """Explicit time, a mixed second derivative, a linear coordinate."""
    system = cb.ContinuousSystem(
        lambda t, x: [x[1], -np.sin(x[0]) * (1 + 0.5 * np.cos(3 * t)) - 0.2 * x[0] * x[1], x[0] - x[2]],
        states=3, diffusion=0.05 * np.eye(3),
    )
    return cb.Problem(system, initial=cb.Box([0.4, -0.1, 0.0], [0.6, 0.1, 0.1]), safe=[], horizon=1.5, delta=1e-2)


def stepping() -> cb.Problem:
    """Discrete time, two blocks that share no output, and one with all three coordinates."""
    system = cb.DiscreteSystem(
        lambda t, x: [0.9 * x[0] + 0.1 * np.tanh(x[1]), 0.8 * x[1] + 0.2 * x[0] ** 2, x[2] - 0.1 * x[2] ** 3],
        states=3, noise=cb.Gaussian(std=0.02),
    )
    return cb.Problem(system, initial=cb.Box([-0.3] * 3, [0.5] * 3), safe=[], horizon=8, delta=1e-2)


def bilinear() -> cb.Problem:
    system = cb.DiscreteSystem(lambda t, x: [x[0] * x[1], 0.5 * x[1]], states=2, noise=cb.Gaussian(std=0.02))
    return cb.Problem(system, initial=cb.Box([0.2, 0.2], [0.6, 0.6]), safe=[], horizon=3, delta=1e-2)


def creased() -> cb.Problem:
    """Kinks: the Jacobian jumps, and no second derivative tells that the coordinates are coupled."""
    system = cb.DiscreteSystem(
        lambda t, x: [0.5 * np.abs(x[0]), 0.4 * np.maximum(x[1], x[0])], states=2, noise=cb.Gaussian(std=0.05),
    )
    return cb.Problem(system, initial=[0.2, 0.1], safe=[], horizon=3, delta=1e-2)


def bent() -> cb.Problem:
    """Kinks in continuous time, with explicit time and a smooth part."""
    system = cb.ContinuousSystem(
        lambda t, x: [x[1], -np.abs(x[0] - 0.2) * x[1] - np.sin(x[0]) + 0.3 * np.sin(2 * t) * x[0]], states=2,
        diffusion=0.05 * np.eye(2),
    )
    return cb.Problem(system, initial=[0.3, -0.4], safe=[], horizon=1.5, delta=1e-2)


def remainder(engine: Linearisation, k: int, theta: Array, s: Array) -> Array:
    """beta at points of piece k, straight from its definition."""
    b, (slope, drift, _) = engine.controls[0], engine.slopes
    if engine.continuous:
        h, theta = engine.step, theta[:, None]
        rest = 1 - theta
        b = b[k]
        p = rest**3 * b[0] + 3 * theta * rest**2 * b[1] + 3 * theta**2 * rest * b[2] + theta**3 * b[3]
        rate = 3 / h * (rest**2 * (b[1] - b[0]) + 2 * theta * rest * (b[2] - b[1]) + theta**2 * (b[3] - b[2]))
        jacobian = slope[0, k] + h * theta[:, :, None] * drift[0, k]
        time = engine.times[k] + h * theta[:, 0]
    else:
        p, rate, jacobian, time = engine.nodes[0, k], engine.nodes[0, k + 1], slope[0, k], np.full(len(s), float(k))
    d = [np.full(len(s), value) for value in engine.d_middle]
    value = np.asarray(engine._compiled(time, *(p + s).T, *d))
    return value - rate - np.einsum("...ij,mj->mi" if jacobian.ndim == 2 else "mij,mj->mi", jacobian, s)


@pytest.mark.parametrize("fit", [False, True])
@pytest.mark.parametrize(
    "problem", [swinging(), stepping(), bilinear(), creased(), bent(), cb.load("unicycle")],
    ids=["swinging", "stepping", "bilinear", "creased", "bent", "unicycle"],
)
def test_boxes_and_their_parts_in_a_polytope_contain_the_remainder(problem: cb.Problem, fit: bool) -> None:
    engine = Linearisation(problem, pieces=12) if problem.system.time == "continuous" else Linearisation(problem)
    if fit:
        engine = fitted(engine, Share.of(1e-3))
        assert engine.correction is not None
    active, rng = engine.model.active, np.random.default_rng(5)
    count, boxes = len(active), 400
    items = rng.integers(0, engine.pieces, boxes)
    centre = rng.uniform(-0.3, 0.3, (boxes, count))
    radius = rng.uniform(0.0, 0.15, (boxes, count)) * rng.choice([0.0, 1.0], (boxes, count), p=[0.1, 0.9])
    rows = rng.normal(size=(engine.pieces, 2, count))
    low, high = -rng.uniform(0.1, 0.5, (engine.pieces, 2)), rng.uniform(0.1, 0.5, (engine.pieces, 2))
    expansion = Expansion(engine.model, engine.frame)
    some = Boxes(items, centre, radius)
    parts = expansion.parts(some)
    whole = expansion.plain_range(parts, some)
    curbed = expansion.polytope_range(parts, some, Polytope(low, high, rows))
    assert not parts.bad.any()
    assert np.all(curbed[0] >= whole[0] - 1e-9)
    assert np.all(curbed[1] <= whole[1] + 1e-9)
    sharper = 0
    for q, k in enumerate(items):
        corners = rng.choice([-1.0, 1.0], (60, count)) * rng.choice([rng.uniform(0, 1), 1.0], (60, 1))
        s = np.zeros((60, engine.n))
        s[:, active] = centre[q] + radius[q] * corners
        beta = remainder(engine, int(k), rng.uniform(0, 1, 60), s)
        assert np.all(beta >= whole[0][q] - 1e-13)
        assert np.all(beta <= whole[1][q] + 1e-13)
        along = s[:, active] @ rows[k].T
        inside = ((along >= low[k]) & (along <= high[k])).all(axis=1)
        assert np.all(beta[inside] >= curbed[0][q] - 1e-13)
        assert np.all(beta[inside] <= curbed[1][q] + 1e-13)
        sharper += bool(inside.any() and np.any(curbed[1][q] < whole[1][q] - 1e-6))
        # second order: what is lost is small where the box is
        if not engine.continuous and radius[q].max() < 0.02:
            assert np.all(whole[1][q] - whole[0][q] <= np.ptp(beta, axis=0) + 0.05)
    assert sharper > 5


def test_a_face_of_the_polytope_bounds_the_linear_term_as_the_linear_program_does() -> None:
    rng = np.random.default_rng(1)
    for _ in range(60):
        g, w, e, b = rng.normal(size=3), rng.normal(size=3), rng.uniform(0.1, 1, 3), rng.uniform(-0.3, 1.0)
        found = linear_range(g[None, None], e[None], w[None, None], np.array([[b]]))[0, 0]
        exact = linprog(-g, A_ub=w[None], b_ub=[b], bounds=list(zip(-e, e, strict=True)))
        if exact.status == 0:
            assert -exact.fun - 1e-9 <= found <= -exact.fun + 1e-6


def test_of_a_mixed_pair_of_second_derivatives_one_is_kept() -> None:
    model = Remainder(bilinear())
    assert len(model.second_index) == 1
    assert model.folded(*model.second_index[0])
    hessian = model.reference_hessians(Linearisation(bilinear()).frame)[0, 0]
    np.testing.assert_allclose(hessian, [[0.0, 1.0], [1.0, 0.0]])


def test_a_bound_asked_for_is_proved_with_less_work_than_a_tight_one(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = Linearisation(cb.load("unicycle"), pieces=10)
    low, high = -0.2 * np.ones((10, 3)), 0.2 * np.ones((10, 3))
    rows, seen = np.zeros((10, 0, 3)), [0]
    original = Expansion.parts

    def counted(self: Expansion, boxes: Boxes) -> object:
        seen[0] += len(boxes)
        return original(self, boxes)

    monkeypatch.setattr(Expansion, "parts", counted)
    tight = engine.model.bound(engine.frame, low, high, rows, 3)
    work, seen[0] = seen[0], 0
    width = tight[1] - tight[0]
    target = tight[0] - 0.5 * width, tight[1] + 0.5 * width
    loose = engine.model.bound(engine.frame, low, high, rows, 3, target)
    assert np.all(loose[0] >= target[0])
    assert np.all(loose[1] <= target[1])
    assert seen[0] < work / 2
    sample = sampled_range(engine.model, engine.frame, low, high, rows)
    assert np.all(sample[0] - 0.1 * width >= tight[0] - 0.3 * width)
    extra = 2 * engine.d_radius[0] * np.abs(engine.slopes[2]).max()
    assert np.all(sample[1] <= tight[1] + 1e-9 + extra)
    assert np.all(sample[0] >= tight[0] - 1e-9 - extra)


@pytest.mark.parametrize(("dynamics", "plain"), [
    (lambda x, d: [np.sin(x[0]) + 2 * d[0]], True),
    (lambda x, d: [np.sin(x[0]) + x[0] * d[0]], False),
    (lambda x, d: [np.sin(x[0]) + np.sign(d[0])], False),
    (lambda x, d: [np.sin(x[0]) + np.abs(d[0])], False),
])  # fmt: skip
def test_only_a_plain_sum_with_the_disturbance_needs_no_look_at_the_states(dynamics: object, plain: bool) -> None:
    system = cb.ContinuousSystem(
        dynamics, states=1, disturbance=cb.Box([-0.5], [0.5]), diffusion=[[0.1]],  # type: ignore[arg-type]
    )
    problem = cb.Problem(system, initial=[0.1], safe=[], horizon=1.0, delta=1e-2)
    engine = Linearisation(problem, pieces=5)
    assert engine.model.gain is not None
    assert adds_plainly(engine.model.value, engine.model.gain, 1) is plain
    lower, upper = engine.model.bound(engine.frame, -np.ones((5, 1)), np.ones((5, 1)), np.zeros((5, 0, 1)))
    if plain:
        assert np.all(np.abs(upper) < 1)
        assert np.all(np.abs(lower) < 1)
    s, d = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-0.5, 0.5, 21))
    for k in range(5):
        x = engine.nodes[0, k] + s
        beta = np.asarray(engine._compiled(0.0, x.ravel(), d.ravel()))[:, 0]
        beta = beta - engine._compiled(0.0, engine.nodes[0, k], 0.0)[..., 0] - engine.slopes[0][0, k, 0, 0] * s.ravel()
        beta = beta - engine.slopes[2][0, k, 0, 0] * d.ravel()
        assert np.all(beta <= upper[k] + 0.05)
        assert np.all(beta >= lower[k] - 0.05)


@pytest.mark.parametrize("width", [1e80, 1e110, 1e160, 1e300])
@pytest.mark.parametrize("count", [0, 1])
def test_over_boxes_next_to_all_floats_the_remainder_is_bounded_or_infinite_without_a_warning(
    width: float, count: int
) -> None:
    system = cb.ContinuousSystem(lambda x: [x[1], -(x[0] ** 3) - x[0] * x[1]], states=2, diffusion=np.eye(2) * 0.1)
    engine = Linearisation(cb.Problem(system, initial=[0.1, 0.2], safe=[], horizon=1.0, delta=1e-2), pieces=5)
    high, rows = np.full((5, 2 + count), width), np.ones((5, count, 2))
    lower, upper = engine.model.bound(engine.frame, -high, high, rows)
    assert not np.isnan(lower).any()
    assert not np.isnan(upper).any()
    least = 0.5 * np.longdouble(width) ** 3
    assert np.all(lower[:, 1] < -least)
    assert np.all(upper[:, 1] > least)


@pytest.mark.parametrize("width", [0.21, 0.3, 1.0])
def test_kinks_couple_coordinates_without_a_second_derivative(width: float) -> None:
    engine = Linearisation(creased())
    assert engine.model.blocks == [[[0, 1]]]
    size = width * np.ones((3, 2))
    lower, upper = engine.model.bound(engine.frame, -size, size, np.zeros((3, 0, 2)))
    s = np.stack(np.meshgrid(np.linspace(-width, width, 81), np.linspace(-width, width, 81)), -1).reshape(-1, 2)
    beta = remainder(engine, 0, np.zeros(len(s)), s)
    assert np.all(beta.max(axis=0) <= upper[0])
    assert np.all(beta.min(axis=0) >= lower[0])
    assert np.all(upper[0] <= beta.max(axis=0) + 0.12 * width)


def test_boxes_are_not_cut_where_cutting_does_not_help(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = cb.load("pendulum").replace(horizon=1.0)
    engine = Linearisation.of(problem)
    run = LinearRun(engine)
    original, seen = Expansion.parts, [0]

    def counted(self: Expansion, boxes: Boxes) -> object:
        seen[0] += len(boxes)
        return original(self, boxes)

    monkeypatch.setattr(Expansion, "parts", counted)
    assert run.include(run.levels(Share.of(1e-4))[0], 3) is not None
    assert seen[0] < 100 * engine.pieces


def ring(first: str = "product") -> cb.Problem:
    """Five coupled states, of which every output sees two or three."""

    def flow(t: object, x: Array) -> list[object]:
        bends = [np.sin(3 * x[(i + 1) % 5]) * x[(i + 2) % 5] for i in range(5)]
        bends[0] = bends[0] * np.cos(t) + np.sin(x[0]) if first == "product" else np.log(1.0 + x[0] + x[1] + x[2])
        return [bend - x[i] for i, bend in enumerate(bends)]

    system = cb.ContinuousSystem(flow, states=5, diffusion=0.05 * np.eye(5))
    return cb.Problem(system, initial=[0.3, 0.2, 0.1, 0.0, -0.1], safe=[], horizon=0.5, delta=1e-2)


def test_where_many_coordinates_are_coupled_every_output_has_boxes_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    engine, rng = Linearisation(ring(), pieces=3), np.random.default_rng(3)
    model = engine.model
    assert model.apart == {(0, 1, 2): [0], (2, 3): [1], (3, 4): [2], (0, 4): [3], (0, 1): [4]}
    rows = rng.normal(size=(3, 1, 5))
    low, high = np.full((3, 6), -0.4), np.full((3, 6), 0.3)
    lower, upper = model.bound(engine.frame, low, high, rows, 0)
    some = model.bound(engine.frame, low, high, rows, 0, only=np.array([1]))
    assert np.array_equal(some[0][1], lower[1])
    assert np.array_equal(some[1][1], upper[1])
    monkeypatch.setitem(vars(model), "apart", {})
    joint = model.bound(engine.frame, low, high, rows, 0)
    assert (upper - lower).sum() < 0.95 * (joint[1] - joint[0]).sum()
    s = rng.uniform(-0.4, 0.3, (4000, 5)) * rng.choice([0.5, 1.0], (4000, 1))
    for k in range(3):
        along = s @ rows[k, 0]
        inside = s[(along >= -0.4) & (along <= 0.3)]
        beta = remainder(engine, k, rng.uniform(0, 1, len(inside)), inside)
        assert len(inside) > 100
        assert np.all(beta >= lower[k] - 1e-13)
        assert np.all(beta <= upper[k] + 1e-13)


def test_boxes_of_one_output_that_reach_where_another_is_undefined_are_left_for_joint_ones() -> None:
    engine = Linearisation(ring("logarithm"), pieces=6)
    rows = np.broadcast_to(np.array([1.0, 1.0, 1.0, 0.0, 0.0]) / 3, (6, 1, 5))
    low, high = np.full((6, 6), -0.75), np.full((6, 6), 0.3)
    low[:, -1] = -0.3
    lower, upper = engine.model.bound(engine.frame, low, high, rows, 3)
    assert np.all(np.isfinite(lower))
    assert np.all(np.isfinite(upper))


def test_boxes_are_cut_no_further_than_their_own_middles_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bound that the remainder itself exceeds is out of reach, however finely boxes are cut."""
    system = cb.DiscreteSystem(
        lambda x: [np.sin(3 * x[0] * x[1] + x[2]), x[1] * np.cos(2 * x[0]), 0.5 * x[2]], states=3,
        noise=cb.Gaussian(std=0.02),
    )
    engine = Linearisation(cb.Problem(system, initial=[0.1] * 3, safe=[], horizon=1, delta=1e-2))
    seen, original = [0], Expansion.parts

    def counted(self: Expansion, boxes: Boxes) -> object:
        seen[0] += len(boxes)
        return original(self, boxes)

    monkeypatch.setattr(Expansion, "parts", counted)
    high, rows = np.full((1, 3), 0.5), np.zeros((1, 0, 3))
    s = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 21)] * 3), -1).reshape(-1, 3)
    beta = remainder(engine, 0, np.zeros(len(s)), s)
    hoped = 0.5 * beta.min(axis=0)[None] - 1e-9, 0.5 * beta.max(axis=0)[None] + 1e-9
    lower, upper = engine.model.bound(engine.frame, -high, high, rows, 3, hoped)
    assert seen[0] < 2000
    assert np.all(beta.max(axis=0) <= upper[0])
    assert np.all(upper[0] <= beta.max(axis=0) + 0.01 * np.ptp(beta, axis=0) + 1e-12)
    assert np.all(beta.min(axis=0) >= lower[0])


@pytest.mark.parametrize("meeting", [False, True])
def test_constraints_of_other_blocks_cull_no_boxes_of_one(meeting: bool) -> None:
    """Two saturated loops: boxes of one are 0 in the other, which its constraints may exclude."""

    def flow(x: Array) -> list[object]:
        first, second = (np.maximum(np.minimum(a + 2 * b, 0.2), -0.2) for a, b in (x[:2], x[2:]))
        return [x[1], -x[0] - first, x[3] + (first + second if meeting else 0), -x[2] - second]

    system = cb.ContinuousSystem(flow, states=4, diffusion=0.05 * np.eye(4))
    problem = cb.Problem(system, initial=[0.05, 0, 0.05, 0], safe=[], horizon=0.2, delta=1e-2)
    engine = Linearisation(problem, pieces=2)
    model, rng = engine.model, np.random.default_rng(4)
    normals = np.array([[1, 2, 0, 0], [0, 0, 1, 2]]) / np.sqrt(5)
    rows = np.broadcast_to(normals, (2, 2, 4))
    assert np.allclose(np.abs(model.kink_normals(engine.frame)), rows)
    assert len([block for group in model.blocks for block in group]) == 2
    assert bool(model.apart) != meeting
    low, high = (np.broadcast_to(a, (2, 6)) for a in ([-0.3] * 4 + [-0.1, 0.12], [0.4] * 4 + [0.2, 0.3]))
    lower, upper = model.bound(engine.frame, low, high, rows, 3)
    s = rng.uniform(-0.3, 0.4, (40_000, 4))
    along = s @ normals.T
    s = s[((along >= low[0, 4:]) & (along <= high[0, 4:])).all(axis=1)]
    for k in range(2):
        beta = remainder(engine, k, rng.uniform(size=len(s)), s)
        assert np.all(beta.max(axis=0) <= upper[k] + 1e-12)
        assert np.all(beta.min(axis=0) >= lower[k] - 1e-12)
        assert meeting or np.all(upper[k] - lower[k] <= 1.2 * np.ptp(beta, axis=0) + 0.01)
