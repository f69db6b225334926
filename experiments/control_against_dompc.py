"""Tube MPC beside do-mpc on the chain of Sec. VIII-B: cost, violations in noisy runs, time per step.

All controllers see the same model (one tape), cost, horizon of prediction (20 steps), constraints and input bounds.

- certbound: the plan on the linear response; the same with an ancillary Riccati feedback; and receding horizon on the
  noise-free state. All come with a verdict for delta = 0.002.
- do-mpc, nominal, on the noise-free state: the same idea without a tube.
- do-mpc, nominal, from the measured state: replans with what it sees. Its constraints are soft (penalty 1e4 per unit,
  as in certbound), since noise takes the state across them.
- do-mpc, multi-stage, from the measured state: a scenario tree over a few values of the noise, branching once. It
  represents parameters of finitely many values; the noise is Gaussian and anew at every step, so no tree covers it.

The controllers that measure have an advantage in cost that a plan has not, and no guarantee. Needs the extra
``compare``. ``python -m experiments.control_against_dompc [--full]``: 3000 runs of everything that is carried out
without measuring; of the others 20, with ``--full`` 3000 (multi-stage 200), which takes about an hour.
"""

from __future__ import annotations

import time
import warnings
from typing import Any

import numpy as np

import certbound as cb
from certbound.problem.adapters import casadi_module, to_casadi
from certbound.problem.model import compile_numpy
from certbound.synthesis.faces import faces_of
from certbound.synthesis.tightening import initial_center
from experiments.harness import Arrays, Claims, main

HORIZON = 20
RUNS = 3000
SPREAD = 3.0
"""Scenarios of the multi-stage controller: all w_i = 0, or + or - this many standard deviations."""


def controller(chain: cb.Problem, *, soft: bool, scenarios: bool) -> Any:
    """A do-mpc controller for the chain, its model read from the problem's tape."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import do_mpc
    ca = casadi_module()
    system = chain.system
    model = do_mpc.model.Model("discrete", "SX")
    x = model.set_variable("_x", "x", (system.dimension, 1))
    u = model.set_variable("_u", "u", (len(system.input_names), 1))
    w = model.set_variable("_p", "w", (system.noise_dimension, 1))
    model.set_rhs("x", to_casadi(system.dynamics, [ca.SX(0), x, u]) + ca.DM(system.noise_matrix) @ w)
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    mpc.settings.n_horizon, mpc.settings.t_step = HORIZON, 1.0
    mpc.settings.n_robust = 1 if scenarios else 0
    mpc.settings.store_full_solution = False
    mpc.settings.supress_ipopt_output()
    weight, effort = chain.cost  # type: ignore[misc]
    ends = ca.bilin(ca.DM(weight), x, x)
    mpc.set_objective(mterm=ends, lterm=ends + ca.bilin(ca.DM(effort), u, u))
    mpc.set_rterm(u=0.0)
    mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = system.inputs.low, system.inputs.high
    for index, face in enumerate(faces_of(chain)):
        gap = face.gap(ca, x, ca.SX(0), ca.DM(0.0), None)
        options = {"soft_constraint": True, "penalty_term_cons": 1e4} if soft else {}
        mpc.set_nl_cons(f"c{index}", -gap, ub=0.0, **options)
    size = SPREAD * chain.parameters["sigma"]
    values = [np.full(system.noise_dimension, value) for value in ((0.0, size, -size) if scenarios else (0.0,))]
    mpc.set_uncertainty_values(w=np.array(values))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mpc.setup()
    return mpc


def carried_out(chain: cb.Problem, mpc: Any, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """States (runs, N + 1, n), inputs (runs, N, m) and ms per step behind the first, measured at every step."""
    step = compile_numpy(chain.system.dynamics)
    start = initial_center(chain.initial)
    states, inputs, times = [], [], []
    for shocks in noise:
        mpc.reset_history()
        x = start
        mpc.x0 = x
        mpc.set_initial_guess()
        path, used = [x], []
        for k, shock in enumerate(shocks):
            began = time.perf_counter()
            u = mpc.make_step(x.reshape(-1, 1)).ravel()
            times += [1e3 * (time.perf_counter() - began)] if k else []
            x = step(float(k), *x, *u) + shock
            path.append(x)
            used.append(u)
        states.append(path)
        inputs.append(used)
    return np.array(states), np.array(inputs), times


def blind(chain: cb.Problem, inputs: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """States (runs, N + 1, n) under inputs (N, m), whatever happens."""
    step = compile_numpy(chain.system.dynamics)
    states = [np.tile(initial_center(chain.initial), (len(noise), 1))]
    for k, u in enumerate(inputs):
        states.append(step(float(k), *states[-1].T, *u) + noise[:, k])
    return np.stack(states, axis=1)


def judged(chain: cb.Problem, states: np.ndarray, inputs: np.ndarray, times: list[float]) -> Claims:
    """Mean cost, runs that broke a constraint, largest input, ms per step."""
    weight, effort = chain.cost  # type: ignore[misc]
    used = np.broadcast_to(inputs, (len(states), *inputs.shape[-2:]))
    cost = np.einsum("rti,ij,rtj->r", states, weight, states) + np.einsum("rti,ij,rtj->r", used, effort, used)
    broken = ~np.all([np.all(c.satisfied(states), axis=1) for c in chain.constraints], axis=0)
    found: Claims = {"runs": len(states), "violations": int(broken.sum()), "mean cost": float(cost.mean())}
    found["max |u|"] = float(np.abs(used).max())
    if times:
        found |= {"ms per step": float(np.median(times)), "99 %": float(np.quantile(times, 0.99))}
    return found


def ours(chain: cb.Problem, noise: np.ndarray) -> dict[str, Claims]:
    """The three ways of this package."""
    rows = {}
    for name, feedback in (("certbound, plan", None), ("certbound, plan and Riccati feedback", "riccati")):
        plan = cb.synthesize_plan(chain, method="linear", feedback=feedback)
        if feedback is None:
            states, inputs = blind(chain, plan.plan, noise), plan.plan
            first = plan
        else:
            states = blind(plan.problem, plan.plan, noise)
            inputs = plan.plan + states[:, :-1] @ plan.feedback.T
        proved = {"status": plan.status, "log10 P": plan.log10_delta, "s for the plan": plan.seconds}
        rows[name] = judged(chain, states, inputs, []) | proved
    receding, times = cb.PredictiveController(chain, horizon=HORIZON, plan=first), []
    for _ in range(chain.horizon):
        times.append(1e3 * receding.step().seconds)
    verdict, inputs = receding.verify(), np.array(receding.applied)
    rows["certbound, receding horizon"] = judged(chain, blind(chain, inputs, noise), inputs, times[1:]) | {
        "status": verdict.status, "log10 P": verdict.log10_delta,
    }  # fmt: skip
    return rows


def compute(full: bool) -> tuple[Arrays, Claims]:
    """One row per controller."""
    chain = cb.load("chain")
    shocks = np.random.default_rng(0).normal(0.0, chain.parameters["sigma"], (RUNS, chain.horizon, 3))
    noise = shocks @ np.asarray(chain.system.noise_matrix).T
    claims: Claims = {}

    def tell(name: str, row: Claims) -> None:
        claims[name] = row
        print(name)
        for key, value in row.items():
            print(f"{key:>20}  {value}", flush=True)

    for name, row in ours(chain, noise).items():
        tell(name, row)
    nominal = controller(chain, soft=False, scenarios=False)
    _, inputs, times = carried_out(chain, nominal, 0 * noise[:1])
    tell("do-mpc, nominal, noise-free state", judged(chain, blind(chain, inputs[0], noise), inputs[0], times))
    for name, scenarios in (("do-mpc, nominal, measured state", False), ("do-mpc, multi-stage, measured state", True)):
        count = (200 if scenarios else RUNS) if full else 20
        mpc = controller(chain, soft=True, scenarios=scenarios)
        tell(name, judged(chain, *carried_out(chain, mpc, noise[:count])))
    return {}, claims


if __name__ == "__main__":
    main("control_against_dompc", compute)
