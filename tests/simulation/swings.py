"""Twelve light oscillators and six stiff models, with the truth from a fine simulation that shares nothing with ours.

The truths were counted by a program in C that does what `reference` does, over more paths: a step is the drift's flow
by Runge and Kutta and then noise; between two steps a position that gets no noise follows the cubic through its ends
and slopes, any other a Brownian bridge. 6000 steps and more (20 a time constant of the fastest mode and more).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import certbound as cb

__all__ = ["MODELS", "Model", "reference"]


@dataclass(frozen=True, kw_only=True)
class Model:
    """A model as expressions of x, a limit of one coordinate on both sides, and exits counted of paths."""

    drift: tuple[str, ...]
    noise: tuple[tuple[int, int, str], ...]  # state, column and entry
    limit: float
    horizon: float
    truth: tuple[int, int]
    start: tuple[float, ...] = (0.0, 0.0)
    coordinate: int = 0

    def f(self, x):
        """The drift, of states x[0], x[1], ..."""
        return [_value(text, x) for text in self.drift]

    def g(self, x):
        """The diffusion, as rows."""
        columns = 1 + max(column for _, column, _ in self.noise)
        rows = [[0.0 * x[0]] * columns for _ in self.drift]
        for state, column, text in self.noise:
            rows[state][column] = _value(text, x) + 0.0 * x[0]
        return rows

    def problem(self):
        """The problem; its noise is a matrix where it is constant."""
        constant = not any("x" in text for *_, text in self.noise)
        diffusion = np.array(self.g(np.zeros(len(self.drift)))) if constant else self.g
        system = cb.ContinuousSystem(lambda x: self.f(x), states=len(self.drift), diffusion=diffusion)
        low, high = np.full(len(self.drift), -np.inf), np.full(len(self.drift), np.inf)
        low[self.coordinate], high[self.coordinate] = -self.limit, self.limit
        safe = [cb.Inside(cb.Box(low, high))]
        return cb.Problem(system, initial=list(self.start), safe=safe, horizon=self.horizon, delta=1e-2)


def _value(text, x):
    return eval(text, {"x": x, "sin": np.sin, "cos": np.cos, "sqrt": np.sqrt})  # noqa: S307  (texts of this file)


# fmt: off
MODELS = {
    "lin .001": Model(
        drift=("x[1]", "-x[0]-0.002*x[1]",), noise=((1, 0, "0.0448"),),
        limit=1.0, horizon=200, truth=(3445, 40000),
    ),
    "lin .003": Model(
        drift=("x[1]", "-x[0]-0.006*x[1]",), noise=((1, 0, "0.0496"),),
        limit=1.0, horizon=200, truth=(2972, 40000),
    ),
    "lin .01": Model(
        drift=("x[1]", "-x[0]-0.02*x[1]",), noise=((1, 0, "0.08"),),
        limit=1.0, horizon=100, truth=(3061, 40000),
    ),
    "lin .1": Model(
        drift=("x[1]", "-x[0]-0.2*x[1]",), noise=((1, 0, "0.19"),),
        limit=1.0, horizon=60, truth=(1893, 40000),
    ),
    "lin .3": Model(
        drift=("x[1]", "-x[0]-0.6*x[1]",), noise=((1, 0, "0.34"),),
        limit=1.0, horizon=40, truth=(2309, 40000),
    ),
    "soft .02": Model(
        drift=("x[1]", "-x[0]+x[0]*x[0]*x[0]-0.04*x[1]",), noise=((1, 0, "0.07"),),
        limit=0.9, horizon=80, truth=(2622, 40000),
    ),
    "hard .001": Model(
        drift=("x[1]", "-x[0]-x[0]*x[0]*x[0]-0.002*x[1]",), noise=((1, 0, "0.06912"),),
        limit=1.0, horizon=120, truth=(3704, 40000),
    ),
    "hard .05": Model(
        drift=("x[1]", "-x[0]-2*x[0]*x[0]*x[0]-0.1*x[1]",), noise=((1, 0, "0.22"),),
        limit=1.0, horizon=60, truth=(5050, 40000), start=(0.5, 0.0),
    ),
    "pendulum .01": Model(
        drift=("x[1]", "-sin(x[0])-0.02*x[1]",), noise=((1, 0, "0.126"),),
        limit=1.5, horizon=60, truth=(3283, 40000), start=(0.3, 0.0),
    ),
    "ship roll .05": Model(
        drift=("x[1]", "-0.1*x[1]-x[0]+x[0]*x[0]*x[0]+x[2]", "x[3]", "-0.18*x[3]-0.81*x[2]",), noise=((3, 0, "0.025"),),
        limit=1.0, horizon=100, truth=(2463, 40000), start=(0.0, 0.0, 0.0, 0.0),
    ),
    "two springs .005": Model(
        drift=("x[2]", "x[3]", "-x[0]-0.2*(x[0]-x[1])-0.3*x[0]*x[0]*x[0]-0.01*x[2]",
               "-1.5*x[1]-0.2*(x[1]-x[0])-0.02*x[3]",),
        noise=((2, 0, "0.08"), (3, 1, "0.05"),),
        limit=0.9, horizon=100, truth=(4011, 40000), start=(0.0, 0.0, 0.0, 0.0),
    ),
    "multiplicative .02": Model(
        drift=("x[1]", "-x[0]-0.2*x[0]*x[0]*x[0]-0.04*x[1]",), noise=((1, 0, "0.10125*sqrt(1+x[0]*x[0])"),),
        limit=1.0, horizon=80, truth=(3176, 40000),
    ),
    "stiff linear 500": Model(
        drift=("-500*(x[0]-x[1])", "-x[1]",), noise=((0, 0, "2.4"), (1, 1, "0.4"),),
        limit=1.1, horizon=4, truth=(575, 16000),
    ),
    "stiff slow manifold": Model(
        drift=("-400*(x[0]-sin(x[1]))", "-0.5*x[1]",), noise=((1, 0, "0.512"),),
        limit=0.95, horizon=4, truth=(1778, 16000),
    ),
    "stiff actuator": Model(
        drift=("x[1]", "-x[0]-0.2*x[1]+x[2]-0.3*x[0]*x[0]*x[0]", "-200*(x[2]+0.3*x[1])",), noise=((1, 0, "0.3"),),
        limit=0.8, horizon=20, truth=(1484, 16000), start=(0.0, 0.0, 0.0),
    ),
    "stiff cubic": Model(
        drift=("-60*x[0]-40*x[0]*x[0]*x[0]+30*x[1]", "-x[1]",), noise=((0, 0, "1.08"), (1, 1, "0.648"),),
        limit=0.75, horizon=4, truth=(949, 16000),
    ),
    "fast swing": Model(
        drift=("x[1]", "-10000*sin(x[0])-10*x[1]",), noise=((1, 0, "43.2"),),
        limit=0.35, horizon=2, truth=(837, 16000),
    ),
    "two rates": Model(
        drift=("-1000*(x[0]-cos(x[1]))", "1.0-x[1]",), noise=((0, 0, "1"), (1, 1, "0.5"),),
        limit=1.7, horizon=2, truth=(610, 16000), start=(1.0, 0.0), coordinate=1,
    ),
}
# fmt: on


def reference(model, paths, steps, rng):
    """Exits counted on a fine grid, all paths side by side."""
    h, j = model.horizon / steps, model.coordinate
    x = np.repeat(np.array(model.start)[:, None], paths, axis=1)
    alive = np.ones(paths, dtype=bool)
    columns = 1 + max(column for _, column, _ in model.noise)
    for _ in range(steps):
        slope = np.array(model.f(x))
        second = np.array(model.f(x + h / 2 * slope))
        third = np.array(model.f(x + h / 2 * second))
        moved = x + h / 6 * (slope + 2 * second + 2 * third + np.array(model.f(x + h * third)))
        noise = np.array(model.g(x))
        end = moved + np.sqrt(h) * np.einsum("ncp,cp->np", noise, rng.standard_normal((columns, paths)))
        variance = h * np.sum(noise[j] ** 2, axis=0)
        for side in (-1.0, 1.0):
            before, after = model.limit - side * x[j], model.limit - side * end[j]
            left = after < 0.0
            if np.any(variance > 0.0):
                left |= rng.random(paths) < np.exp(-2.0 * np.maximum(before * after, 0.0) / variance)
            else:
                left |= _dips(before, -side * h * slope[j], after, -side * h * np.array(model.f(moved))[j])
            alive &= ~left
        x = np.where(alive, end, np.array(model.start)[:, None])
    return paths - int(np.count_nonzero(alive))


def _dips(before, falling, after, rising):
    """Whether the cubic with these values and slopes at 0 and 1 has a least value below 0 in between."""
    a, b = 2 * before + falling - 2 * after + rising, -3 * before - 2 * falling + 3 * after - rising
    with np.errstate(all="ignore"):
        root = np.sqrt(np.maximum(b * b - 3 * a * falling, 0.0))
        s = np.where(np.abs(a) > 1e-12 * np.abs(b), (-b + root) / (3 * a), -falling / (2 * b))
    s = np.clip(np.nan_to_num(s), 0.0, 1.0)
    return (falling < 0.0) & (rising > 0.0) & (((a * s + b) * s + falling) * s + before < 0.0)
