"""Fig. 6: Theorem 5's radius over the window, L = 0.9999 and 0.99, sigma^2 = 0.01 (1 - L), delta = 0.01."""

from __future__ import annotations

import math

import numpy as np

import certbound as cb
from certbound.tubes.tube import Tube
from experiments.harness import Arrays, Claims, main
from experiments.limits import discrete_radius

HORIZON, DELTA = 2000, 0.01
CASES = {"left": (0.9999, 450), "right": (0.99, 40)}
INSTANTS = (500.0, 1000.0, 2000.0)
EPSILONS = {"printed": 1 / 16, "reading": 15 / 16}


def tube(gain: float, method: str, **parameters: float) -> Tube:
    """A tube of the scalar discrete-time system with Gaussian noise."""
    constants = cb.Constants(gain=gain, sigma=math.sqrt(0.01 * (1 - gain)), dimension=1, isotropic=True)
    return cb.tune_tube(constants, horizon=HORIZON, delta=DELTA, method=method, **parameters)


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Radii over the window at three times, with N = T/step as printed and with N rounded up as proved."""
    arrays: Arrays = {"instants": np.array(INSTANTS)}
    claims: Claims = {}
    instants = np.array(INSTANTS)
    for side, (gain, last) in CASES.items():
        steps = np.arange(1, last + 1)
        arrays[f"{side}_steps"] = steps
        for reading, epsilon in EPSILONS.items():
            for count, method in (("real", "thm5_as_printed"), ("whole", "thm5")):
                radii = np.stack(
                    [tube(gain, method, epsilon=epsilon, step=int(step)).radius(instants) for step in steps],
                    axis=1,
                )
                arrays[f"{side}_{reading}_{count}"] = radii
                claims[f"{side}_{reading}_{count}_best"] = int(steps[np.argmin(radii[-1])])
        kummer = tube(gain, "kummer")
        arrays[f"{side}_kummer"] = np.asarray(kummer.radius(instants))
        claims[f"{side}_kummer_final"] = float(kummer.radius(HORIZON))
        exact = discrete_radius(gain, 1, HORIZON, DELTA, math.sqrt(0.01 * (1 - gain)))
        arrays[f"{side}_exact"] = np.full(len(instants), exact)
        claims[f"{side}_exact"] = exact
    return arrays, claims


if __name__ == "__main__":
    main("fig6", compute)
