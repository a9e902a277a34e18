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
# # My correlation data to a posterior
#
# Two pads are glued to skin, one is pulled, a camera follows points between them and a sensor the force. Image correlation gives tables of points over frames. How stiff is a scar beside its skin?
#
# The data here are made, so that the truth is known; `studies/living_skin` does it with a real scar. With tables of your own, `cal.fields.read_full_field("points.csv", "displacements.csv")` takes the place of the section *The tables*, and `em.hearts.mesh_sheet`, which takes Gmsh, that of the box.

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import calibrate as cal
import emulator as em

# %% [markdown]
# ## The sheet
#
# One quadratic element across 1.5 mm. Its edge is held, it lies on springs, and it is under a tension before anybody pulls. The pads are nodes of its top. The scar is a region with a factor of its own; its edge need not be one of elements.

# %%
mesh = em.generators.box((64.0, 40.0, 1.5), (16, 10, 1), 2)
x, y, z = mesh.nodes.T
top = z > 1.4
pads = {
    "moving": np.flatnonzero(top & (abs(x - 20.0) <= 4.0) & (abs(y - 20.0) <= 4.0)),
    "fixed": np.flatnonzero(top & (abs(x - 48.0) <= 4.0) & (abs(y - 20.0) <= 4.0)),
    "edge": np.flatnonzero((x < 0.1) | (x > 63.9) | (y < 0.1) | (y > 39.9)),
}
middles = mesh.nodes[mesh.corners].mean(axis=1)[:, :2]
scar = np.linalg.norm(middles - [31.0, 22.0], axis=1) < 7.0

sheet = em.Scene(
    name="skin between pads",
    mesh=replace(mesh, node_sets={**mesh.node_sets, **pads}),
    law=em.find_law("neo_hookean_split"),
    parameters=(
        em.Parameter("mu", "kPa", 1.0, 15.0, "log"),
        em.Parameter("stiffness_1", "", 1.0, 20.0, "log"),
        em.Parameter("foundation", "kPa/mm", 1e-3, 0.1, "log"),
        em.Parameter("prestress", "kPa", 0.5, 10.0),
        em.Parameter("pull", "", 0.0, 2.0),
    ),
    constants={"kappa": 2000.0, "stiffness_0": 1.0},
    supports=(
        em.Support("edge"),
        em.Support("fixed"),
        em.Support("moving", (-1.0, 0.0, 0.0), amount="pull"),
        em.Support("bottom", components="z"),
        em.supports.ElasticSupport("bottom", None, parameter="foundation"),
    ),
    loads=(em.loads.Prestress(),),
    regions=scar.astype(int),
    dilatation="mean",
)
simulator = em.Simulator(sheet)

# %% [markdown]
# ## The tables
#
# Two hundred points in four frames, of which some drop out. A number errs by 0.01 mm by itself. What correlation and the model miss besides is smooth: neighbours err alike, and it goes on from frame to frame.

# %%
truth = {"mu": 4.0, "stiffness_1": 5.0, "foundation": 0.02, "prestress": 3.0}
pulls = {"frame 1": 0.5, "frame 2": 1.0, "frame 3": 1.5, "frame 4": 2.0}
rng = np.random.default_rng(1)
points = np.column_stack([rng.uniform(26.0, 42.0, 200), rng.uniform(12.0, 28.0, 200)])
on_top = cal.landmarks(sheet, np.column_stack([points, np.full(200, 1.5)]))
distance = np.linalg.norm(points[:, None] - points[None], axis=-1) / 5.0
alike = np.linalg.cholesky((1.0 + 1.73 * distance) * np.exp(-1.73 * distance) + 1e-9 * np.eye(200))
missed = 0.05 * alike @ rng.normal(size=(200, 2))

moved, force = [], {}
for name, pull in pulls.items():
    theta = sheet.theta(**truth, pull=pull)
    u = simulator(theta)
    seen = np.asarray(on_top(u[on_top.nodes], theta))[:, :2] + missed * pull / 2.0
    moved.append(seen + rng.normal(0.0, 0.01, seen.shape))
    pad = cal.Reaction(sheet, "moving", "x")
    force[name] = float(pad(u[pad.nodes], theta)) + rng.normal(0.0, 0.002)
moved = np.array(moved)
moved[rng.uniform(size=moved.shape[:2]) < 0.05] = np.nan
field = cal.fields.FullField(points, moved, tuple(pulls))
print({name: f"{1e3 * value:.0f} mN" for name, value in force.items()})

# %% [markdown]
# ## The emulator
#
# Trained on 25 FEM runs and the energy. The force on the pad is the derivative of the least potential energy by the pad's motion, so that it is right to second order; stresses at the pad's edge, where they are singular, would miss it.

# %%
emulator = em.train(sheet, replace(em.recipe("mechanics"), simulations=25), "skin").cache()
theta = sheet.theta(**truth, pull=1.5)
exact = simulator(theta)
by_work, by_stress = pad.through(emulator)(theta), pad(emulator(theta)[pad.nodes], theta)
by_fem = pad(exact[pad.nodes], theta)
print(f"displacement off by {1e3 * abs(emulator(theta) - exact).max():.1f} micrometres at most")
off = [100.0 * abs(force / by_fem - 1.0) for force in (by_work, by_stress)]
print(f"force off by {off[0]:.2f} %, by stresses {off[1]:.1f} %")
assert abs(by_work / by_fem - 1) < 0.01

# %% [markdown]
# ## Two models of one error
#
# Frames are load states, whose pull is known. Once every number errs by itself, with an sd that is inferred; once the error is a `field`, alike over 5 mm.

# %%
observe, data = cal.fields.field_data(sheet, field.only(tuple(pulls), np.arange(60)), pulls)
parts = {**observe.parts, **{f"reaction:moving:x@{name}": pad for name in pulls}}
data = {**data, **{f"reaction:moving:x@{name}": np.array(value) for name, value in force.items()}}
known = {f"pull@{name}": pull for name, pull in pulls.items()}
of_force = {"reaction:moving:x": cal.GaussianNoise(sd=0.002)}
models = {}
alone = cal.model(
    emulator, parts, {"displacement": cal.GaussianNoise(sd_scale=0.1), **of_force}, known=known
)
models["each by itself"] = alone.given(data)
precise = cal.model(
    emulator, parts, {"displacement": cal.GaussianNoise(sd=0.01), **of_force}, known=known
)
error = {
    "kind": "field", "of": "displacement", "along": "pull", "length": 5.0, "sd_scale": 0.1,
}  # fmt: skip
models["a field"] = cal.with_described_errors(precise, data, {"missed": error})

found = {}
for name, (model, given) in models.items():
    found[name] = cal.sample(model, given, seed=0)
    for unknown, row in found[name].summary().items():
        print(f"{name}: {unknown} {row['mean']:.3g} +- {row['sd']:.2g}")

# %%
figure, axes = plt.subplots(1, 4, figsize=(12, 2.6), constrained_layout=True)
for axis, (unknown, value) in zip(axes, truth.items(), strict=True):
    for name, posterior in found.items():
        axis.hist(np.ravel(posterior.draws()[unknown]), 40, density=True, alpha=0.6, label=name)
    axis.axvline(value, color="black")
    axis.set(xlabel=unknown, yticks=[])
axes[0].legend(frameon=False)
plt.show()

# %% [markdown]
# ## Does FEM agree, and what is left over?

# %%
verdict = cal.certify(found["a field"], simulator, seed=0, mesh=0)
print(verdict.verdict, "-", verdict.reason)

# %%
names = ("each by itself", "a field")
off = {
    name: {
        k: (row["mean"] - truth[k]) / row["sd"]
        for k, row in found[name].summary().items()
        if k in truth
    }
    for name in names
}
print({name: {k: round(z, 1) for k, z in each.items()} for name, each in off.items()})
last = f"displacement@{list(pulls)[-1]}"
mean = {k: row["mean"] for k, row in found["a field"].summary().items()}
predicted = found["a field"].model.predict({k: mean[k] for k in truth})[0][last]
left = np.asarray(models["a field"][1][last]) - np.asarray(predicted)
seen = found["a field"].model.observe
where, along = seen.parts[last].points, seen.filled(last, left)[:, 0]
figure, axis = plt.subplots(figsize=(5, 4))
dots = axis.scatter(*where[:, :2].T, c=1e3 * along, cmap="coolwarm", vmin=-100, vmax=100)
axis.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)", title="what the mean misses along x")
figure.colorbar(dots, label="micrometres")
plt.show()
assert max(abs(z) for z in off["a field"].values()) < 3.0

# %% [markdown]
# The residuals are patches of one sign, as wide as the error's length: sixty points are not sixty facts. Whoever takes them as independent is too sure. Only stiffness times thickness is told by a force; a report of such a body says so.
