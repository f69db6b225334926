"""What can be planned on the chain of Sec. VIII-B: tubes, levels of delta and of the noise, runs of the closed loop.

Every line is a call of ``synthesize_plan``, whose plan ``verify_safety`` judges. Levels of the noise are multiples of
the chain's own (sigma = 0.43, reconstructed) up to which a plan is found, by bisection. The threshold of the Markov
tube depends on the metric and on the plan, so several are printed.

``python -m experiments.control_levels [--full]``: about half a minute, with ``--full`` (finer bisection) two.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import certbound as cb
from certbound.synthesis.planning import Planner
from experiments.harness import Arrays, Claims, main

SIGMA = 0.43
PAPER: dict[str, Any] = {"method": "thm5", "epsilon": 15 / 16, "step": 1}
TUBES: dict[str, dict[str, Any]] = {
    "Thm 5 (eps = 15/16)": PAPER,
    "K1, one common metric": {"method": "kummer"},
    "K7', linear response": {"method": "linear"},
}


def feasible_up_to(works: Callable[[float], bool], low: float, high: float, tolerance: float) -> float:
    """The largest number in [low, high] at which ``works`` is true, from below; ``low`` if nowhere."""
    while high - low > tolerance:
        middle = (low + high) / 2
        low, high = (middle, high) if works(middle) else (low, middle)
    return low


def planned(tube: dict[str, Any], **changes: Any) -> cb.Synthesis:
    """A plan of the chain with another delta or noise."""
    scale = changes.pop("noise", 1.0)
    return cb.synthesize_plan(cb.load("chain", sigma=SIGMA * scale).replace(**changes), **tube)


def safe_at_noise(tube: dict[str, Any], delta: float) -> Callable[[float], bool]:
    """Whether a plan is verified at a multiple of the noise."""
    return lambda noise: planned(tube, noise=noise, delta=delta).status == "SAFE"


def markov_threshold_of_plan(objective: str, *, dimension: bool) -> float:
    """Smallest delta at which the Markov tube fits around the chain's plan in closed form.

    The radius sqrt(nu V / delta) scales like delta^-1/2: no search is needed.

    Parameters
    ----------
    objective : str
        Of the metric: "rate" or "erosion".
    dimension : bool
        Use the dimension n in place of nu.
    """
    chain = cb.load("chain").replace(delta=0.5)
    known = cb.bound_constants(chain, objective=objective)
    nu = known.effective_dimension
    scale = known.dimension / nu if dimension and nu is not None else 1.0
    tube = cb.tune_tube(known, horizon=chain.horizon, delta=0.5, method="markov")
    planner = Planner(chain)
    path = planner.rollout(planner.guess())
    taken = planner.around(tube, path).erosion
    rooms = np.stack([face.room(path.states[1:], planner.grid.times()[1:]) for face in planner.faces], axis=1)
    return float(0.5 * scale * np.max(taken / rooms) ** 2)


def compute(full: bool) -> tuple[Arrays, Claims]:
    """All levels."""
    tolerance = 0.005 if full else 0.02
    claims: Claims = {}

    def tell(name: str, value: Any) -> None:
        claims[name] = value
        print(f"{name:>58}  {value}", flush=True)

    for name, tube in TUBES.items():
        for delta in (2e-3, 1e-6):
            began = time.perf_counter()
            found = planned(tube, delta=delta)
            bound = f"log10 P <= {found.log10_delta:.3f}" if found.feasible else found.infeasibility.kind  # type: ignore[union-attr]
            tell(
                f"{name}, delta = {delta:g}",
                f"{found.status}, {bound}, cost {found.cost:.2f}, max |u| {found.max_input:.2f}, room for "
                f"{found.scale:.3f} tubes, {time.perf_counter() - began:.1f} s",
            )
            if found.method == "linear" and delta == 2e-3:
                runs = cb.simulate_closed_loop(found, runs=3000, rng=0)
                tell("3000 runs: violations", runs.violations)
                tell("3000 runs: probability at most (99 %)", runs.upper)
                tell("3000 runs: max |u|", runs.max_input)
                tell("3000 runs: mean stage cost, first and last", (runs.mean_cost[0], runs.mean_final_cost))
    levels = {}
    for name, tube in TUBES.items():
        for delta in (2e-3, 1e-6):
            high = 2.5 if name != "K7', linear response" else 4.5
            levels[name, delta] = feasible_up_to(safe_at_noise(tube, delta), 0.5, high, tolerance)
            tell(f"{name}: SAFE up to this noise, delta = {delta:g}", levels[name, delta])
    base = levels["Thm 5 (eps = 15/16)", 2e-3]
    for name in list(TUBES)[1:]:
        tell(f"{name}: over Thm 5's level", levels[name, 2e-3] / base)
    for delta in (0.03, 0.05):
        found = planned({"method": "markov"}, delta=delta)
        tell(f"Markov, delta = {delta:g}", f"feasible {found.feasible}, status {found.status}")
        if found.infeasibility is not None:
            tell("Markov: proved, and at most this much of the tube fits",
                 (found.infeasibility.proved, found.infeasibility.scale_bound))  # fmt: skip
            tell("Markov: smallest feasible delta, its own plan", found.smallest_delta)
    for objective in ("rate", "erosion"):
        for dimension in (False, True):
            label = f"Markov threshold, closed-form plan, metric of least {objective}, {'n' if dimension else 'nu'}"
            tell(label, markov_threshold_of_plan(objective, dimension=dimension))
    return {}, claims


if __name__ == "__main__":
    main("control_levels", compute)
