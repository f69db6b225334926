"""Networks over boxes hold every point, with their derivatives, their planes and their series."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.arrays import Array
from certbound.problem.model.network_rows import weights_of
from certbound.rigor.activations import ACTIVATIONS
from certbound.rigor.arithmetic import Interval
from certbound.rigor.layers import bound_network, expand_network, relax_network
from certbound.rigor.planes import Weights
from experiments.networks.crown import crown
from tests.networks import random_network

BOXES = 200

every_activation = pytest.mark.parametrize("activation", sorted(ACTIVATIONS))


def layers(activation: str, seed: int = 0) -> list[Weights]:
    return weights_of(random_network(activation, seed).data)


def values(network: list[Weights], points: Array) -> Array:
    for layer in network:
        points = layer.row.numpy(layer.weights @ points + layer.bias[:, None], *layer.constants)
    return points


def boxes(seed: int = 0) -> tuple[Interval, list[Array]]:
    """Boxes of all sizes, and points in them, corners among them."""
    rng = np.random.default_rng(seed)
    centre, radius = rng.normal(size=(2, BOXES)), 10 ** rng.uniform(-6, 0.3, size=(2, BOXES))
    box = Interval(centre - radius, centre + radius)
    shares = [np.sign(rng.uniform(-1, 1, (2, BOXES))) if k < 5 else rng.uniform(-1, 1, (2, BOXES)) for k in range(20)]
    return box, [np.clip(centre + share * radius, box.lo, box.hi) for share in shares]


def outside(value: Array, bounds: Interval, slack: float) -> int:
    room = slack * (1 + np.abs(value))
    return int(((value < bounds.lo - room) | (value > bounds.hi + room)).sum())


@every_activation
def test_no_point_of_a_box_is_outside_the_range_or_the_planes(activation: str) -> None:
    for seed in range(3):
        network, (box, points) = layers(activation, seed), boxes(seed)
        found, (slopes, rest) = bound_network(network, box, 1).value, relax_network(network, box)
        for point in points:
            value = values(network, point)
            assert outside(value, found, 1e-14) == 0
            assert outside(value - np.einsum("pnm,nm->pm", slopes, point - box.mid), rest, 1e-13) == 0


@every_activation
def test_derivatives_over_a_box_hold_the_differences_of_values(activation: str) -> None:
    network, (box, points) = layers(activation), boxes()
    found, step = bound_network(network, box, 2), 1e-6
    assert found.slopes is not None
    assert found.bends is not None
    slopes = bound_network(network, Interval(points[-1], points[-1]), 1).slopes
    assert slopes is not None
    for j, side in enumerate(np.eye(2) * step):
        ends = [values(network, points[-1] + sign * side[:, None]) for sign in (1, -1)]
        inside = (np.abs(points[-1] - box.mid) < box.rad - step).all(axis=0)
        assert outside(((ends[0] - ends[1]) / (2 * step))[:, inside], found.slopes[:, j][:, inside], 1e-8) == 0
        thin = [bound_network(network, Interval(p, p), 1).slopes for p in (points[-1] + side[:, None], points[-1])]
        assert thin[0] is not None
        assert thin[1] is not None
        change = (thin[0].mid - thin[1].mid) / step
        smooth = inside & ~found.kinked
        assert outside(change[..., smooth], found.bends[:, :, j][..., smooth], 1e-4) == 0


def test_planes_are_as_tight_as_the_curvature_lets_them_be() -> None:
    """What is left between planes falls with the square of the box; that of a ReLU on one side of 0 is nothing."""
    network = layers("tanh")
    widths = []
    for radius in (1e-2, 1e-3):
        box = Interval(np.full((2, 1), 0.3 - radius), np.full((2, 1), 0.3 + radius))
        widths.append(relax_network(network, box)[1].width.max())
    assert widths[1] < widths[0] / 80
    line = Weights(np.eye(1), np.zeros(1), "relu")
    assert relax_network([line], Interval([[1.0]], [[2.0]]))[1].width[0, 0] < 3e-14


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("sizes", [(2, 16, 16, 1), (3, 8, 8, 8, 2)])
def test_ranges_are_hardly_wider_than_those_of_crown_in_floats(activation: str, sizes: tuple[int, ...]) -> None:
    """Hidden layers are bounded by planes to the inputs too: intervals there are up to 1.6 times as wide."""
    network, rng = weights_of(random_network(activation, 1, sizes=sizes).data), np.random.default_rng(2)
    for radius in (0.02, 0.5, 2.0):
        centre = rng.normal(size=(sizes[0], 4))
        box = Interval(centre - radius, centre + radius)
        width = bound_network(network, box, 0).value.width
        for number in range(4):
            low, high = crown(network, box.lo[:, number], box.hi[:, number])
            assert (width[:, number] <= 1.05 * (high - low)).all()


def test_rounding_in_the_products_is_covered() -> None:
    """Weights that cancel to the last digit: the exact sum is 2^-40, floats may say 0."""
    weights = np.array([[1e8, 2.0**-40, -1e8]])
    network = [Weights(np.ones((3, 1)), np.zeros(3), "linear"), Weights(weights, np.zeros(1), "linear")]
    value = bound_network(network, Interval([[1.0]], [[1.0]]), 0).value
    assert value.contains([[2.0**-40]]).all()


def test_an_unbounded_box_has_an_unbounded_range() -> None:
    network, box = layers("relu"), Interval(np.array([[-np.inf, 0.0], [0.0, 0.0]]), np.zeros((2, 2)))
    found, (_, rest) = bound_network(network, box, 1), relax_network(network, box)
    assert np.isinf(found.value.lo[:, 0]).all()
    assert np.isinf(rest.hi[:, 0]).all()
    assert np.isfinite(found.value.lo[:, 1]).all()


def test_networks_that_overflow_have_unbounded_ranges() -> None:
    rows = [np.full((3, 2), 1e8), *[np.full((3, 3), 1e308)] * 4, np.full((1, 3), 1e8)]
    network = [Weights(w, np.ones(len(w)), "relu" if len(w) > 1 else "linear") for w in rows]
    box = Interval(np.array([[1.0, -1e99], [2.0, 1.0]]), np.array([[1.5, 1e99], [2.0, 1.0]]))
    found, (slopes, rest) = bound_network(network, box, 2), relax_network(network, box)
    assert np.isinf(found.value.hi).all()
    assert np.isinf(rest.hi).all()
    assert np.isfinite(slopes).all()


@every_activation
def test_series_follow_the_network_along_a_line(activation: str) -> None:
    network, point = layers(activation), np.array([0.31, -0.22])
    direction, step = np.array([0.7, 0.4]), 1e-3
    line = [[Interval.point(np.array([x])) for x in pair] for pair in zip(point, direction)]
    series = expand_network(network, line, 3)
    expected = values(network, (point + step * direction)[:, None])[:, 0]
    found = [sum(float(c.mid[0]) * step**k for k, c in enumerate(output)) for output in series]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_no_point_of_a_million_is_outside() -> None:
    """50 networks of up to 2 x 64 neurons, 1e4 boxes, 1e6 points, against ranges and planes."""
    rng = np.random.default_rng(22)
    for seed in range(50):
        width, inputs = int(rng.integers(4, 65)), int(rng.integers(1, 5))
        kind = sorted(ACTIVATIONS)[seed % len(ACTIVATIONS)]
        network = weights_of(random_network(kind, seed, sizes=(inputs, width, width, 1)).data)
        centre, radius = rng.normal(size=(inputs, BOXES)), 10 ** rng.uniform(-8, 0.5, (inputs, BOXES))
        box = Interval(centre - radius, centre + radius)
        found, (slopes, rest) = bound_network(network, box, 0).value, relax_network(network, box)
        for number in range(100):
            share = rng.uniform(-1, 1, (inputs, BOXES))
            point = np.clip(centre + (np.sign(share) if number < 20 else share) * radius, box.lo, box.hi)
            value = values(network, point)
            assert outside(value, found, 1e-13) == 0
            assert outside(value - np.einsum("pnm,nm->pm", slopes, point - box.mid), rest, 1e-12) == 0
