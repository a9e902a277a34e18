# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Which parameter moves what?
#
# Before anyone measures a ventricle it pays to ask what a measurement could see. A sensitivity study varies all
# parameters over their prior and splits the variance of a prediction among them. With an emulator, thousands of
# predictions take seconds.

# %%
import matplotlib.pyplot as plt
import numpy as np

import calibrate as cal
import emulator as em

forward = em.load("left_ventricle").cache()
scene = forward.scene
for parameter in scene.parameters:
    print(f"{parameter.name:9s} {parameter.low:.3g} to {parameter.high:.3g} {parameter.unit}")

# %% [markdown]
# ## Shares of the variance
#
# The *first-order* index of a parameter is the share of the variance that would go if it were known. Its *total* index is
# the share that would be left if all others were known: what it does alone and together with others. Both come with 95 %
# intervals from resampling. Here is the filled cavity's volume, and the displacement of every node.

# %%
found = cal.sensitivity(forward, cal.CavityVolume(scene), samples=256, field=True)
volume = found["volume"].to_dataset()
for k, name in enumerate(volume["factor"].values):
    first, total = (float(volume[index][k, 0]) for index in ("first", "total"))
    near = float(volume["total_half_width"][k, 0])
    print(f"{name:9s} first {first:6.3f}   total {total:6.3f} +- {near:.3f}")
cal.index_figure(found)
plt.show()

# %% [markdown]
# Pressure and the fibres' stiffness `a_f` share nearly all of it. A volume is one number, and two parameters move it: from a
# volume alone they cannot both be inferred. Totals hardly exceed first-order indices, so parameters act one by one.

# %%
total = dict(zip(volume["factor"].values, volume["total"].values[:, 0], strict=True))
assert total["pressure"] + total["a_f"] > 0.8

# %% [markdown]
# ## Where on the body?
#
# The same, node by node. Grey is held. Where a map is bright, a landmark tells that parameter from the others.

# %%
cal.body_figure(found, scene)
plt.show()

# %% [markdown]
# ## What exact derivatives add
#
# The emulator is differentiable. The mean square of a derivative bounds the total index from above, for a tenth of the
# predictions, and the eigenvectors of the mean outer product of gradients are combinations of parameters, those that matter
# first.

# %%
slopes = cal.sensitivity(forward, cal.CavityVolume(scene), method="derivatives", samples=128)
bounds = slopes["volume"].to_dataset()
for k, name in enumerate(bounds["parameter"].values):
    print(f"{name:9s} total index at most {float(bounds['bound_on_total'][k, 0]):.3f}")
    assert total[name] < float(bounds["bound_on_total"][k, 0]) + 0.02
values = bounds["active_value"].values
print(f"{100 * values[0] / values.sum():.0f} % of the squared slopes along one direction:")
for name, weight in zip(
    bounds["parameter"].values, bounds["active_direction"].values[:, 0], strict=True
):
    print(f"  {weight:+.2f} {name}")

# %% [markdown]
# One direction of five carries almost everything: *more pressure over softer fibres*. That is what a volume measures.
#
# ## Does FEM agree?
#
# The same design of theta, by finite elements.

# %%
small = {"samples": 8, "seed": 3}
by_emulator = cal.sensitivity(forward, cal.CavityVolume(scene), **small)["volume"]
by_fem = cal.sensitivity(em.fem_forward(em.Simulator(scene)), cal.CavityVolume(scene), **small)[
    "volume"
]
difference = np.abs(by_fem["total"] - by_emulator["total"]).max()
runs = by_fem.attrs["evaluations"]
print(f"largest difference of a total index on {runs} FEM runs: {float(difference):.1e}")
assert difference < 5e-3
