# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A first posterior
#
# A 100 mm beam, clamped at its left end, bends under its own weight. From the noisy displacements of 20 points we infer its two Lamé parameters with the emulator, and let finite elements check the result.

# %%
import time

import jax
import matplotlib.pyplot as plt
import numpy as np

import calibrate as cal
import emulator as em

# %% [markdown]
# ## The scene and its FEM solution
#
# A scene is geometry, law, loads, supports and parameters. The simulator minimises its potential energy and says how it went.

# %%
scene = em.scenes.once_clamped_beam()
for parameter in scene.parameters:
    print(parameter)

simulator = em.Simulator(scene)
truth = scene.theta(mu=73.0, lam=61.0)
solution = simulator.solve(truth)
print(em.fem.Status(int(solution.status)).text, "in", int(solution.iterations), "iterations")
print(f"tip moves by {float(np.linalg.norm(solution.displacement, axis=1).max()):.2f} mm")

# %% [markdown]
# ## The emulator
#
# The processor of the graph network depends on the geometry alone. `.cache()` runs it once; what is left is a small function of theta.

# %%
forward = em.load("once_clamped_beam").cache()
error = np.linalg.norm(forward(truth) - solution.displacement, axis=1)
print(f"emulator error: median {np.median(error):.1e} mm, largest {error.max():.1e} mm")
assert np.median(error) < 2e-2  # the paper's median, after a million steps on a GPU

# %% [markdown]
# ## Data
#
# Twenty material points inside the body, wherever they happen to lie between nodes, each displacement with 0.2 mm of noise.

# %%
observe = cal.landmarks(scene, cal.spread_landmarks(scene, 20, seed=7))
noise = np.random.default_rng(7).normal(0.0, 0.2, (20, 3))
data = np.asarray(observe(solution.displacement[observe.nodes], truth)) + noise

# %%
seen = forward.at(observe.nodes)  # decodes only the corners of the observed elements
gradient = jax.jit(jax.value_and_grad(lambda theta: (seen(theta) ** 2).sum()))
jax.block_until_ready(gradient(truth))
started = time.perf_counter()
for k in range(100):
    jax.block_until_ready(gradient(truth * (1 + 1e-4 * k)))
print(f"value and gradient: {10 * (time.perf_counter() - started):.2f} ms")

# %% [markdown]
# ## Posterior
#
# The prior is log-uniform over the scene's box. Two unknowns and a fast map: the sampler by default weights points of the whole box by their posterior density, in four independent populations, whose R-hat says whether they agree.

# %%
model = cal.model(forward, observe, cal.GaussianNoise(sd=0.2))
posterior = cal.sample(model, data, seed=1)
summary = posterior.summary()
for name, row in summary.items():
    print(name, {key: round(value, 4) for key, value in row.items()})
assert all(row["r_hat"] < 1.02 for row in summary.values())
assert summary["mu"]["low"] - 1.0 < 73.0 < summary["mu"]["high"] + 1.0

# %%
draws = posterior.draws()
figure, axes = plt.subplots(figsize=(4.5, 4))
axes.plot(draws["mu"], draws["lam"], ".", ms=3, alpha=0.4)
axes.plot(*truth, "k+", ms=14, mew=2)
axes.set(xlim=(50, 100), ylim=(50, 100), xlabel="mu (kPa)", ylabel="lam (kPa)")
# %% [markdown]
# Bending fixes one combination of the two parameters; the other is hardly seen. A point estimate would have hidden that.

# %% [markdown]
# ## What does FEM say?
#
# FEM runs at draws of the posterior, around them and at draws of the prior train a correction of the map, and a pool of cheap points follows the corrected map's posterior. Further FEM runs at points of this pool, weighted by the ratio of likelihoods, test it. If the weights have a light tail and the means do not move, the emulator's posterior is FEM's.

# %%
certificate = cal.certify(posterior, simulator)
print(certificate)
assert certificate.verdict == "accepted"
