"""Small policies for standard tasks, trained with NumPy alone: the same seed gives the same weights.

A policy imitates a saturated feedback law by least squares (Adam on random batches). What is certified is the network,
whatever it was taught: how well it imitates only matters for how large the certified probability is.

``python -m experiments.networks.training FOLDER`` writes every policy and its problem file there.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import certbound as cb
from certbound.arrays import Array
from certbound.problem.networks import write_network

__all__ = ["POLICIES", "TASKS", "Task", "train", "write"]


@dataclass(frozen=True)
class Task:
    """A task: the box that states are drawn from, the law that is imitated, and its problem file."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    law: Callable[[Array], Array]
    problem: str
    clip: float | None = None  # of the outputs, by a last layer of the network


LINEAR = """# linear-sys of the RASM, logRASM and NeuralStoc papers: github LAVA-LAB/logRASM models/linearsystem.py.
name = "linear-sys with a learned policy"
time = "discrete"
horizon = 100
delta = 1e-6
states = ["x", "v"]
networks = {{ policy = "{file}" }}

[dynamics]
x = "x + 0.045*v + 0.45*policy(x, v)[0]"
v = "0.9*v + 0.5*policy(x, v)[0]"

[noise]
law = "triangular"
halfwidth = [0.01, 0.005]

[[initial]]
box = [[-0.25, -0.2], [-0.1, 0.1]]

[[initial]]
box = [[0.2, 0.25], [-0.1, 0.1]]

[[avoid]]
box = {{ x = [-1.5, -1.4], v = [-1.5, 0] }}

[[avoid]]
box = {{ x = [1.4, 1.5], v = [0, 1.5] }}
"""

PENDULUM = """# inverted pendulum of logRASM (models/pendulum.py): torque 2 clip(u), gravity 10, length .5, mass .15.
name = "inverted pendulum with a learned policy"
time = "discrete"
horizon = 100
delta = 1e-6
states = ["x", "v"]
networks = {{ policy = "{file}" }}

[definitions]
next = "0.9*v + 0.75*sin(x) + 8*policy(x, v)[0]"

[dynamics]
x = "x + 0.05*next"
v = "next"

[noise]
law = "triangular"
halfwidth = [0.01, 0.02]

[initial]
box = [[-0.3, 0.3], [-0.3, 0.3]]

[[avoid]]
box = {{ x = [-0.7, -0.6], v = [-0.7, 0] }}

[[avoid]]
box = {{ x = [0.6, 0.7], v = [0, 0.7] }}
"""


COLLISION = """# collision avoidance of logRASM (models/collision_avoidance.py): pushed near (0, 1), (0, -1).
# Reach the middle within 20 steps (published: at any time) with probability .999.
name = "collision avoidance with a learned policy"
time = "discrete"
horizon = 20
delta = 1e-3
states = ["x", "y"]
networks = {{ policy = "{file}" }}

[definitions]
above = "min(hypot(x, y - 1)/0.3, 1)"
below = "min(hypot(x, y + 1)/0.3, 1)"
right = "2*min(max(policy(x, y)[0], -1), 1)"
up = "2*min(max(policy(x, y)[1], -1), 1)"

[dynamics]
x = "x + 0.2*below*above*right"
y = "y + 0.2*(below*(above*up + (1 - above)) - (1 - below))"

[noise]
law = "triangular"
halfwidth = [0.05, 0.05]

[[initial]]
box = [[-1.0, -0.9], [-0.6, 0.6]]

[[initial]]
box = [[0.9, 1.0], [-0.6, 0.6]]

[[avoid]]
box = {{ x = [-0.3, 0.3], y = [0.7, 1.0] }}

[[avoid]]
box = {{ x = [-0.3, 0.3], y = [-1.0, -0.7] }}

[[reach]]
box = {{ x = [-0.2, 0.2], y = [-0.2, 0.2] }}
"""


CART_POLE = """# cart-pole with the constants of Barto, Sutton and Anderson (1983), as gymnasium has them. The force is
# computed every .05 s and held. Noise pushes cart and pole; at the limits an episode fails.
name = "cart-pole with a learned policy"
time = "continuous"
horizon = 5
delta = 1e-6
states = ["x", "v", "th", "w"]
networks = {{ policy = "{file}" }}
inputs = {{ force = [-10, 10] }}
plan = {{ force = "policy(x, v, th, w)[0]", hold = 0.05 }}

[definitions]
push = "(force + 0.05*w**2*sin(th))/1.1"
turn = "(9.8*sin(th) - cos(th)*push)/(0.5*(4/3 - 0.1*cos(th)**2/1.1))"

[dynamics]
x = "v"
v = "push - 0.05*turn*cos(th)/1.1"
th = "w"
w = "turn"

[noise]
diffusion = [[0, 0], [0.02, 0], [0, 0], [0, 0.05]]

[initial]
box = [[-0.03, 0.03], [-0.03, 0.03], [-0.03, 0.03], [-0.03, 0.03]]

[[stay]]
box = {{ x = [-2.4, 2.4], th = [-0.2095, 0.2095] }}
"""

LANE = """# a kinematic bicycle (wheelbase 2.8 m) at 10 m/s keeps its lane: offset y, heading psi, steering angle.
# The rate of steering is computed every .05 s and held, and the network's last layer clips it.
name = "lane keeping with a learned policy"
time = "continuous"
horizon = 5
delta = 1e-6
states = ["y", "psi", "steer"]
networks = {{ policy = "{file}" }}
inputs = {{ rate = [-0.5, 0.5] }}
plan = {{ rate = "policy(y, psi, steer)[0]", hold = 0.05 }}

[dynamics]
y = "10*sin(psi)"
psi = "10/2.8*tan(steer)"
steer = "rate"

[noise]
diffusion = [[0.06, 0], [0, 0.01], [0, 0]]

[initial]
box = [[-0.1, 0.1], [-0.01, 0.01], [-0.005, 0.005]]

[[stay]]
box = {{ y = [-0.9, 0.9] }}

[[stay]]
box = {{ steer = [-0.3, 0.3], psi = [-0.3, 0.3] }}

[[stay]]
box = {{ y = [-0.6, 0.6] }}
during = [3, 5]
"""


def _linear_law(points: Array) -> Array:
    return np.clip(-1.2 * points[:, :1] - 0.5 * points[:, 1:], -1.0, 1.0)


def _pendulum_law(points: Array) -> Array:
    x, v = points[:, :1], points[:, 1:]
    return np.clip(-(0.75 * np.sin(x) + 1.5 * x + 0.5 * v) / 8, -1.0, 1.0)


def _collision_law(points: Array) -> Array:
    return np.clip(-1.5 * points, -1.0, 1.0)


def _cart_pole_law(points: Array) -> Array:
    return points @ np.array([[1.0], [2.2], [35.0], [8.0]])


def _lane_law(points: Array) -> Array:
    return points @ np.array([[-0.2], [-2.5], [-4.0]])


TASKS: dict[str, Task] = {
    "linear-sys": Task((-1.5, -1.5), (1.5, 1.5), _linear_law, LINEAR),
    "pendulum": Task((-0.7, -0.7), (0.7, 0.7), _pendulum_law, PENDULUM),
    "collision": Task((-1.2, -1.2), (1.2, 1.2), _collision_law, COLLISION),
    "cart-pole": Task((-0.5, -0.7, -0.2, -0.7), (0.5, 0.7, 0.2, 0.7), _cart_pole_law, CART_POLE, 10.0),
    "lane": Task((-0.9, -0.2, -0.15), (0.9, 0.2, 0.15), _lane_law, LANE, 0.5),
}


SIZES = (("tanh", 64), ("tanh", 128), ("tanh", 256), ("relu", 64))
POLICIES = [(task, *size) for task in TASKS for size in SIZES if TASKS[task].clip is None or size == SIZES[0]]
POLICIES.append(("cart-pole", "tanh", 32))
"""Tasks, activations and widths: networks that are held are trained in the sizes that are proved in a minute."""


def train(task: Task, *, width: int, activation: str, seed: int = 0, steps: int = 2000) -> list[dict[str, Any]]:
    """Layers (two hidden ones of ``width``) that imitate the task's law, by Adam on batches of 256."""
    rng = np.random.default_rng(seed)
    sizes = [len(task.low), width, width, task.law(np.zeros((1, len(task.low)))).shape[1]]
    values = []
    for k, p in itertools.pairwise(sizes):
        values += [rng.normal(size=(p, k)) / np.sqrt(k), np.zeros(p)]
    moments = [(np.zeros_like(value), np.zeros_like(value)) for value in values]
    for step in range(1, steps + 1):
        points = rng.uniform(task.low, task.high, (256, sizes[0]))
        for number, gradient in enumerate(_gradients(values, points, task.law(points), activation)):
            first, second = moments[number]
            first += 0.1 * (gradient - first)
            second += 0.001 * (gradient**2 - second)
            size = 3e-3 * (1 - step / steps) * np.sqrt(1 - 0.999**step) / (1 - 0.9**step)
            values[number] -= size * first / (np.sqrt(second) + 1e-8)
    kinds = [activation, activation, "linear"]
    return [
        {"weights": values[2 * k], "bias": values[2 * k + 1], "activation": kind} for k, kind in enumerate(kinds)
    ]


def _gradients(values: list[Array], points: Array, wanted: Array, activation: str) -> list[Array]:
    """Of the mean squared error by every weight and bias, layer by layer."""
    outputs = [points]
    for k in range(0, len(values), 2):
        z = outputs[-1] @ values[k].T + values[k + 1]
        outputs.append(z if k == len(values) - 2 else np.tanh(z) if activation == "tanh" else np.maximum(z, 0.0))
    error = 2 * (outputs[-1] - wanted) / len(points)
    found: list[Array] = []
    for k in range(len(values) - 2, -1, -2):
        found = [error.T @ outputs[k // 2], error.sum(axis=0), *found]
        before = outputs[k // 2]
        error = (error @ values[k]) * (1 - before**2 if activation == "tanh" else before > 0)
    return found


def write(folder: Path, task: str, *, width: int, activation: str) -> Path:
    """Train a policy and write it, with its problem file, which is returned."""
    folder.mkdir(parents=True, exist_ok=True)
    stem = f"{task}-{activation}{width}"
    layers, clip = train(TASKS[task], width=width, activation=activation), TASKS[task].clip
    if clip is not None:
        identity = np.eye(len(layers[-1]["bias"]))
        layers.append({"weights": identity, "activation": "clip", "low": -clip, "high": clip})
    policy = cb.network(layers, name="policy")
    write_network(policy, folder / f"{stem}.npz")
    path = folder / f"{stem}.toml"
    path.write_text(TASKS[task].problem.format(file=f"{stem}.npz"), encoding="utf-8")
    return path


def main() -> None:
    """Write all policies."""
    parser = argparse.ArgumentParser(prog="python -m experiments.networks.training")
    parser.add_argument("folder", type=Path, help="where the policies and problem files are written")
    folder = parser.parse_args().folder
    for task, activation, width in POLICIES:
        print(write(folder, task, width=width, activation=activation))


if __name__ == "__main__":
    main()
