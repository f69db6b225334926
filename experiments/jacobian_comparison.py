"""Interval Jacobians side by side, on the same boxes: width, time, and whether each encloses.

- certbound: the natural extension, rounded outward; and its intersection with the mean-value form.
- unrounded: the same operations with every outward rounding left out, to see what the rounding is worth.
- immrax: ``natif`` of JAX's Jacobian, in float32 (JAX's default) and in float64. It needs Python 3.12 and the extra
  ``compare`` (``pip install 'certbound[compare]'``); where it is missing, the table says so and goes without it.
  immrax 0.3.8 reads the operations of JAX 0.7; those that JAX 0.12 has added are reported as not supported.

Boxes of width 0, 1e-6 and 0.1 lie at random in the domain of each model of `constants_suite`. The yardsticks are the
hull of sampled Jacobians (sum of the entries' widths over that of the hull: nothing that encloses is below 1), and
Jacobians at points of the boxes in 200-bit ball arithmetic: a box is enclosed if none of them lies outside. Operations
that immrax lacks are named.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import flint
import numpy as np

import certbound.rigor.arithmetic
import certbound.rigor.elementary
from certbound.checker.expressions import OPERATIONS
from certbound.constants.model_data import Model, model_of
from certbound.constants.state_jacobian import StateJacobian
from certbound.rigor.intervals import Interval, matmul
from experiments.constants_suite import suite
from experiments.harness import Arrays, Claims, main

WIDTHS = (0.0, 1e-6, 0.1)
SIDE = 3.0
"""Half-width of the domain where a model has none."""
CHECKED = 60
"""Boxes on which ball arithmetic is asked."""

Method = Callable[[Interval], Interval]


def same(value: Any, **_: float) -> Any:
    """Stands for ``lower`` and ``upper`` where nothing is rounded outward."""
    return value


@contextmanager
def unrounded() -> Iterator[None]:
    """Interval arithmetic without outward rounding."""
    parts = [
        mock.patch.object(module, name, same)
        for module in (certbound.rigor.arithmetic, certbound.rigor.elementary)
        for name in ("lower", "upper")
        if hasattr(module, name)
    ]
    for part in parts:
        part.start()
    try:
        yield
    finally:
        for part in parts:
            part.stop()


def centred(jacobian: StateJacobian, boxes: Interval) -> Interval:
    """Natural extension, intersected with the mean-value form."""
    natural, form = jacobian.enclose(boxes), jacobian.spread(boxes)
    if form is None:
        return natural
    middle, (slopes, reach) = form
    count, k, n, _ = slopes.shape
    row = Interval(-reach[:, None, :], reach[:, None, :])
    moved = matmul(row, slopes.reshape(count, k, n * n)).reshape(count, n, n)
    total = middle + moved
    return Interval(np.maximum(natural.lo, total.lo), np.minimum(natural.hi, total.hi))


def without_rounding(jacobian: StateJacobian, boxes: Interval) -> Interval:
    """Natural extension, rounded to nearest."""
    with unrounded():
        return jacobian.enclose(boxes)


def full_boxes(jacobian: StateJacobian, boxes: Interval) -> Interval:
    """Boxes of all input slots: those that the Jacobian does not depend on stay at one point."""
    point = np.clip(0.0, jacobian.ranges.lo, jacobian.ranges.hi)
    lo, hi = (np.repeat(point[None], len(boxes), axis=0) for _ in range(2))
    lo[:, list(jacobian.active)], hi[:, list(jacobian.active)] = boxes.lo, boxes.hi
    return Interval(lo, hi)


def peer(model: Model, jacobian: StateJacobian, *, double: bool) -> Method:
    """immrax's interval Jacobian of the same tape, batched and compiled."""
    jax = importlib.import_module("jax")
    jnp, inclusion = jax.numpy, importlib.import_module("immrax.inclusion")
    kind = jnp.float64 if double else jnp.float32
    operations: dict[str, Callable[..., Any]] = {
        "const": float,  # which takes the precision of what it meets
        "pow": lambda x, e: x ** (int(e) if float(e).is_integer() else e),
        "neg": lambda x: -x,
        "sq": lambda x: x * x,
        "add": lambda x, y: x + y,
        "sub": lambda x, y: x - y,
        "mul": lambda x, y: x * y,
        "div": lambda x, y: x / y,
        "atan2": jnp.arctan2,
        **{name: getattr(jnp, name) for name in ("sin", "cos", "tan", "tanh", "exp", "log", "sqrt")},
    }
    n = model.dimension

    def dynamics(x: Any, others: Any) -> Any:
        rest = [others[k] for k in range(len(model.dynamics.inputs) - n)]
        inputs = [rest[0], *(x[k] for k in range(n)), *rest[1:]]
        return jnp.stack([jnp.asarray(value, kind) for value in model.dynamics.evaluate(operations, inputs)])

    extension = jax.jit(jax.vmap(inclusion.natif(jax.jacfwd(dynamics))))

    def enclose(boxes: Interval) -> Interval:
        jax.config.update("jax_enable_x64", double)  # immrax mixes precisions where it is on for float32
        whole = full_boxes(jacobian, boxes)
        states = slice(1, n + 1)
        lo, hi = ((np.asarray(end[:, states]), np.delete(end, states, axis=1)) for end in (whole.lo, whole.hi))
        found = extension(*(inclusion.interval(jnp.asarray(a, kind), jnp.asarray(b, kind)) for a, b in zip(lo, hi)))
        low, high = (np.asarray(end.block_until_ready(), dtype=float) for end in (found.lower, found.upper))
        return Interval(np.where(low <= high, low, -np.inf), np.where(low <= high, high, np.inf))  # NaN: unbounded

    return enclose


def methods(model: Model, jacobian: StateJacobian) -> dict[str, Method]:
    """Name to enclosure; immrax only where it is installed."""
    found: dict[str, Method] = {
        "certbound": jacobian.enclose,
        "certbound centred": lambda boxes: centred(jacobian, boxes),
        "unrounded": lambda boxes: without_rounding(jacobian, boxes),
    }
    if immrax_version() is not None:
        for name, double in (("immrax float32", False), ("immrax float64", True)):
            found[name] = peer(model, jacobian, double=double)
    return found


def immrax_version() -> str | None:
    """Version of immrax, or None where it is not installed."""
    try:
        return importlib.metadata.version("immrax")
    except importlib.metadata.PackageNotFoundError:
        return None


def exact(jacobian: StateJacobian, points: np.ndarray) -> list[list[Any]]:
    """Jacobians at points (N, k) of the active slots, as balls of 200 bits."""
    operations = {"const": flint.arb, **{op: row.ball for op, row in OPERATIONS.items()}}
    point = np.clip(0.0, jacobian.ranges.lo, jacobian.ranges.hi)
    rows = []
    with flint.ctx.workprec(200):
        for active in points:
            point[list(jacobian.active)] = active
            rows.append(jacobian.tape.evaluate(operations, [flint.arb(float(x)) for x in point]))
    return rows


def encloses(enclosed: Interval, values: list[list[Any]], box: int) -> bool:
    """Whether no exact Jacobian at points of a box lies outside the enclosure."""
    lo, hi = enclosed.lo[box].ravel(), enclosed.hi[box].ravel()
    return not any(
        (np.isfinite(a) and value < flint.arb(float(a))) or (np.isfinite(b) and value > flint.arb(float(b)))
        for row in values
        for value, a, b in zip(row, lo, hi)
    )


def points_of(boxes: Interval, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random points of each box, the first two of them corners, shape (N, count, k)."""
    share = rng.uniform(size=(len(boxes), count, boxes.shape[-1]))
    share[:, :2] = np.round(share[:, :2])
    lo, hi = boxes.lo[:, None], boxes.hi[:, None]
    return np.clip(lo + share * (hi - lo), lo, hi)


def sampled_hull(jacobian: StateJacobian, boxes: Interval, rng: np.random.Generator) -> np.ndarray:
    """Widths of the hulls of sampled Jacobians, shape (N, n, n)."""
    points = points_of(boxes, 256, rng)
    values = jacobian.values(points.reshape(-1, points.shape[-1])).reshape(*points.shape[:2], *[jacobian.dimension] * 2)
    return np.asarray(values.max(axis=1) - values.min(axis=1))


def measure(method: Method, boxes: Interval) -> tuple[Interval, float]:
    """The enclosures, and microseconds a box (best of three, after one call to warm up)."""
    enclosed, best = method(boxes), np.inf
    for _ in range(3):
        start = time.perf_counter()
        method(boxes)
        best = min(best, time.perf_counter() - start)
    return enclosed, 1e6 * best / len(boxes)


def compare(name: str, count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Method to (width over that of the sampled hull, share of boxes enclosed, microseconds a box), per width."""
    source, domain = suite()[name]
    model = model_of(source, domain, 5.0)
    jacobian = StateJacobian(model.dynamics, model.state_slots, model.ranges)
    lo, hi = np.maximum(jacobian.box.lo, -SIDE), np.minimum(jacobian.box.hi, SIDE)
    boxes_of = {}
    for width in WIDTHS:
        centre = rng.uniform(lo, hi, (count, len(lo)))
        boxes = Interval(np.maximum(centre - width / 2, lo), np.minimum(centre + width / 2, hi))
        first = boxes[:CHECKED]
        values = [exact(jacobian, points) for points in points_of(first, 4, rng)]
        boxes_of[width] = boxes, values, sampled_hull(jacobian, first, rng)
    table = {}
    for label, method in methods(model, jacobian).items():
        rows = []
        try:
            for boxes, values, hull in boxes_of.values():
                enclosed, micros = measure(method, boxes)
                varying = hull > 1e-12 * (1 + np.abs(enclosed.mid[:CHECKED]))
                wide = enclosed.width[:CHECKED][varying].sum()
                ratio = float(wide / hull[varying].sum()) if varying.any() else np.nan
                share = np.mean([encloses(enclosed, row, box) for box, row in enumerate(values)])
                rows.append((ratio, share, micros))
        except NotImplementedError as error:
            print(f"{name:18s} {label:18s} not supported: {error}")
            continue
        table[label] = np.array(rows)
        text = "   ".join(f"{ratio:8.3f} {100 * share:4.0f} % {micros:8.2f}" for ratio, share, micros in rows)
        print(f"{name:18s} {label:18s} {text}", flush=True)
    return table


def compute(full: bool) -> tuple[Arrays, Claims]:
    """One table per model and method."""
    rng = np.random.default_rng(0)
    version = immrax_version()
    print("immrax is not installed here: the comparison goes without it" if version is None else f"immrax {version}")
    print(f"{'boxes of width':37s} " + "   ".join(f"{width:<24g}" for width in WIDTHS))
    print(f"{'model':18s} {'method':18s} " + "   ".join(f"{'/ hull':>8s} {'in':>6s} {'us/box':>8s}" for _ in WIDTHS))
    arrays, claims = {}, Claims(immrax="absent" if version is None else version)
    for name in suite():
        for label, rows in compare(name, 20_000 if full else 2_000, rng).items():
            key = label.replace(" ", "_")
            arrays[f"{name}_{key}"] = rows[:, :2]
            claims[f"{name}_{key}_always_encloses"] = bool(np.all(rows[:, 1] == 1))
    return arrays, claims


if __name__ == "__main__":
    main("jacobian_comparison", compute)
