# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A chain of masses: a plan, its tube, its proof
#
# Masses coupled by springs and dampers with a saturating characteristic, pushed by noise at every step, are let down
# from a stretched start. The plan must keep neighbours from colliding. (Open this file in Jupyter with jupytext, or
# run it as a script.)

# %%
import numpy as np

import certbound as cb

problem = cb.load("chain")
problem

# %% [markdown]
# Contraction first: in the Euclidean norm a deviation of the positions alone does not shrink, so a metric has to be
# found. A semidefinite program proposes it; the gain that is printed is proved from that metric.

# %%
constants = cb.bound_constants(problem)
print(constants)
assert constants.certified
assert constants.gain < 1

# %%
tube = cb.tune_tube(constants, horizon=problem.horizon, delta=problem.delta)
paper = cb.tune_tube(constants, horizon=problem.horizon, delta=problem.delta, method="thm5")
print(tube, paper, sep="\n")
assert tube.maximum < paper.maximum

# %%
axes = tube.plot()

# %% [markdown]
# One metric for all constraints is a compromise: `bound_metrics` looks for one per constraint.

# %%
for constraint, own in zip(problem.safe, cb.bound_metrics(problem)):
    print(f"{constraint.label}: {own.summary()}")

# %% [markdown]
# The bundled plan is safe; the linear response along it proves a smaller probability than the constants do.

# %%
verdict = cb.verify_safety(problem)
print(verdict)
assert verdict.status == "SAFE"

# %% [markdown]
# A cheaper plan, found by predictive control with the tube taken off the safe set, and verified like any other:

# %%
planned = cb.synthesize_plan(problem)
print(planned.status, f"cost {planned.cost:.4g}, largest input {planned.max_input:.3g}")
assert planned.status == "SAFE"

# %%
runs = cb.simulate_closed_loop(planned, runs=500, rng=np.random.default_rng(1))
print(f"{runs.violations} of {runs.runs} noisy runs broke a constraint")
