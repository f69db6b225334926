"""Draw the picture of the guide on observers: ``python docs/gallery/observer.py``."""

from __future__ import annotations

from pathlib import Path

import control
import numpy as np
from matplotlib.figure import Figure

import certbound as cb

PICTURE = Path(__file__).resolve().parents[1] / "pictures" / "observer.png"


def rail() -> cb.Problem:
    """The guide's cart, watched from a mast."""
    h = 0.1
    a, b = np.array([[1, h], [0, 1]]), np.array([[h * h / 2], [h]])
    gain, _, _ = control.dlqr(a, b, np.eye(2), np.eye(1))
    kalman, _, _ = control.dlqe(a, b, np.array([[np.sqrt(0.5), 0]]), [[0.01**2]], [[0.01**2]])
    plant = cb.linear_system(a, b, states=["p", "v"], noise=cb.Gaussian(std=0.01), noise_matrix=b)
    loop = cb.estimate_loop(
        plant, kalman, output=lambda p: np.hypot(p, 1.0), sensor_noise=cb.Gaussian(std=0.01),
        feedback=lambda p, v: -gain[0, 0] * (p - 1) - gain[0, 1] * v,
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([0.5], [1.5], coordinates=(0,)))]
    start = cb.Box([0.9, 0, 1, 0], [1.1, 0, 1, 0])
    return cb.Problem(loop, initial=start, safe=safe, horizon=60, delta=1e-4, name="cart seen from a mast")


def main() -> None:
    """Verify, draw, save."""
    figure = Figure(figsize=(6, 3.2), dpi=100, layout="constrained")
    cb.verify_safety(rail()).plot(figure.subplots(), states="p")
    figure.savefig(PICTURE, metadata={"Software": None})


if __name__ == "__main__":
    main()
