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
# # A unicycle past three obstacles
#
# A vehicle drives to the origin under a polar feedback. Its heading is disturbed by a bounded unknown signal, and
# everything is noisy. With what probability does it touch an obstacle within two seconds? (Open this file in Jupyter
# with jupytext, or run it as a script.)

# %%
import numpy as np

import certbound as cb

problem = cb.load("unicycle")
problem

# %% [markdown]
# The noise-free paths, from every start and under every disturbance, lie in a reach tube.

# %%
reach = cb.bound_reach(problem, noise=False)
print(reach)

# %% [markdown]
# The verdict adds the stochastic deviation to it. The feedback's Jacobian grows like one over the distance to the goal,
# so no contraction rate holds everywhere: the answer comes from the linear response along the path (Theorem K7).

# %%
verdict = cb.verify_safety(problem)
print(verdict)
assert verdict.status == "SAFE"

# %%
axes = verdict.plot()

# %% [markdown]
# The tube in numbers: columns for pandas, half-widths per state.

# %%
columns = verdict.to_columns()
widest = {name: float(values.max()) for name, values in columns.items() if name.startswith("extent")}
print(widest)

# %% [markdown]
# A simulation can contradict a bound, never prove one. It does not contradict this one.

# %%
counts = cb.simulate_exits(problem, paths=20_000, rng=np.random.default_rng(1))
print(f"{counts.exits} of {counts.paths} paths left; the exit probability is at most {counts.upper:.2g}")
assert not counts.refutes(10**verdict.log10_delta)

# %% [markdown]
# How much noise can it bear? The probability grows until the remainder of the linearisation feeds itself; then the
# answer is UNKNOWN, with the reason.

# %%
for sigma in (0.01, 0.02, 0.2):
    answer = cb.verify_safety(cb.load("unicycle", sigma=sigma), method="linear")
    print(f"sigma {sigma:g}: {answer.summary()}")
