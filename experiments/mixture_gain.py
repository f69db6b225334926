"""What a mixture gains over the best single Kummer tube: on the shape of a transient, and on clearances of problems.

Scales are the least factors by which a profile must be multiplied to hold a tube of the level delta; levels are
log10 of the probability for the profile as it is.
"""

from __future__ import annotations

import time
from typing import Any
from unittest import mock

import numpy as np

import certbound as cb
from certbound.errors import CertboundError
from certbound.safety.engines import constants as contraction
from certbound.tubes.kummer import mixture_level
from certbound.tubes.objective import make_objective, read_clearance
from certbound.tubes.schedule import make_schedule
from certbound.tubes.tuning import tube_objective
from experiments.harness import Arrays, Claims, main

__all__ = ["clearances", "compute", "gain"]

Profile = tuple[np.ndarray, np.ndarray]
PROBLEMS: tuple[tuple[str, dict[str, float]], ...] = (
    ("chain", {}),
    ("chain_rest", {}),
    ("unicycle", {"sigma": 0.001, "disturbance": 0.0, "x0_halfwidth": 0.01}),
)


def transient(constants: cb.Constants, horizon: float, pieces: int) -> Profile:
    """4.5 standard deviations of the linear system at the end of each piece."""
    times = np.linspace(0.0, horizon, pieces + 1)
    schedule = make_schedule(constants, horizon).refined(times)
    return times, 4.5 * schedule.unit * np.sqrt(schedule.nodes[1][1:])


def clearances(name: str, parameters: dict[str, float]) -> tuple[cb.Constants, float, Profile, float]:
    """(constants, horizon, rooms, delta) of the least demanding rooms that the verification of a problem came to."""
    problem, seen = cb.load(name, **parameters), []
    asked = contraction.room_level

    def record(constants: cb.Constants, **options: Any) -> float:
        level = asked(constants, **options)
        seen.append((level, constants, options["horizon"], options["profile"]))
        return level

    with mock.patch.object(contraction, "room_level", record):
        cb.verify_safety(problem, method="kummer")
    _, constants, horizon, profile = min(seen, key=lambda row: row[0])
    return constants, horizon, profile, problem.delta


def gain(constants: cb.Constants, horizon: float, profile: Profile, delta: float) -> dict[str, float | None]:
    """Levels and scales of the best single tube and of the mixture; None where no mixture was found."""
    schedule, held = make_schedule(constants, horizon), read_clearance(profile, horizon)
    single = cb.bound_exit_probability(constants, horizon=horizon, clearance=profile)
    found: dict[str, float | None] = {"single_level": single, "mixture_level": None}
    begin = time.perf_counter()
    try:
        found["mixture_level"] = mixture_level(schedule, held, best=[])
    except CertboundError as error:
        print(f"  no level by a mixture: {error}")
    found["seconds"] = time.perf_counter() - begin
    for method in ("kummer", "mixture"):
        try:
            tube = cb.tune_tube(constants, horizon=horizon, delta=delta, objective=profile, method=method)
            found[f"{method}_scale"] = tube_objective(tube, make_objective(profile, horizon))
        except CertboundError as error:
            found[f"{method}_scale"] = None
            print(f"  no {method} tube: {error}")
    one, mixed = found["kummer_scale"], found["mixture_scale"]
    found["scale_gain"] = None if one is None or mixed is None else 1 - mixed / one
    return found


def compute(full: bool) -> tuple[Arrays, Claims]:
    """One row per profile."""
    flow = [cb.Constants(rate=-1.0, sigma=1.0, dimension=n) for n in (1, 3)]
    chain = [cb.Constants(gain=gain, sigma=1.0, dimension=1) for gain in (0.5, 0.8)]
    rows = [(f"transient, c=-1, n={c.dimension}, T=4", c, 4.0, transient(c, 4.0, 8), 1e-3) for c in flow]
    rows += [(f"transient, L={c.gain:g}, T=20", c, 20.0, transient(c, 20.0, 20), 1e-3) for c in chain]
    for name, parameters in PROBLEMS if full else PROBLEMS[:1]:
        constants, horizon, profile, delta = clearances(name, parameters)
        rows.append((f"rooms of {name}", constants, horizon, profile, delta))
    claims: Claims = {}
    for label, constants, horizon, profile, delta in rows:
        claims[label] = found = gain(constants, horizon, profile, delta)
        print(label, {key: None if value is None else round(value, 5) for key, value in found.items()}, flush=True)
    return {}, claims


if __name__ == "__main__":
    main("mixture_gain", compute)
