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
# # Accuracy for time
#
# Calibration sees a forward map, theta to displacement, and nothing else of the mechanics. Finite elements are one; cheaper
# ones are wrong by a little. Which rung of this ladder should a posterior stand on? We measure error and time of several for a
# left ventricle, ask from how many evaluations on each pays, and see what its error does to a posterior.

# %%
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import calibrate as cal
import emulator as em

COLOURS = {"fem": "#009E73", "emulator": "#0072B2", "corrected": "#CC79A7", "reduced": "#E69F00"}

# %% [markdown]
# ## The rungs
#
# - **FEM**, from rest: exact for its mesh.
# - **The shipped emulator**: a Taylor series of FEM about the centre of the box, of order 3, and a model of what it leaves at
#   200 more FEM runs.
# - **The same and one Newton step**: about squares the error, for one factorisation.
# - **The series alone**, cut at order 1, 2 or 3: a single FEM run. Order 1 is a linear model.
# - **POD + GP**: Gaussian processes of the leading modes of 30 FEM runs, made here.

# %%
emulator = em.load("left_ventricle")
scene, simulator = emulator.scene, em.Simulator(emulator.scene)
print(emulator)


def series(order):
    """The Taylor series cut at ``order``, as an emulator of its own."""
    whole = emulator.taylor
    kept = (whole.indices >= 0).sum(axis=1) <= order
    cut = replace(whole, indices=whole.indices[kept], derivatives=whole.derivatives[kept])
    return em.Emulator(scene, taylor=cut).cache()


simulator.solve(scene.centre)  # compiles, so that the runs below are timed without it
began = time.process_time()
runs = em.fem.run_campaign(simulator, em.fem.sobol(scene, 30, seed=4))
reduced = em.fit_reduced(scene, runs)
offline_reduced = time.process_time() - began
print(f"30 FEM runs and the fit of POD + GP: {offline_reduced:.0f} s")

full = emulator.cache()
rungs = {
    "FEM from rest": em.fem_forward(simulator),
    "emulator + 1 Newton step": em.corrected(full, simulator, steps=1),
    "emulator": full,
    "POD + GP, 30 runs": reduced,
    **{f"series, order {order}": series(order) for order in (3, 2, 1)},
}

# %% [markdown]
# ## Error and time
#
# The error is measured at 8 theta that no map was made from, at all nodes. The time is that of what a gradient-based sampler
# asks for: the observed displacements and the gradient of a number made of them, compiled. We observe 24 landmarks and the
# volume of the cavity. Of several calls we take the least processor time, which other work on the machine disturbs least.
# FEM runs inside `jit` here, as a gradient-based sampler needs it; called from Python with numbers it is faster.

# %%
reference = em.fem_reference(simulator, 8)
points = cal.landmarks(scene, cal.spread_landmarks(scene, 24, seed=3))
volume = cal.CavityVolume(scene)
seen = np.union1d(points.nodes, volume.nodes)


def error_of(forward):
    """Median and largest distance in mm over nodes and theta."""
    evaluate = jax.jit(forward.evaluate)
    found = np.stack([evaluate(theta).displacement for theta in reference.thetas])
    distance = np.linalg.norm(found - np.asarray(reference.displacement), axis=-1)
    return np.median(distance), distance.max()


def seconds_of(forward, calls):
    """Least processor seconds of a value with its gradient, at the nodes that are seen."""
    local = forward.at(seen)
    gradient = jax.jit(jax.value_and_grad(lambda theta: jnp.sum(local(theta) ** 2)))
    jax.block_until_ready(gradient(scene.centre))
    taken = []
    for theta in em.fem.sobol(scene, calls, seed=9):
        began = time.process_time()
        jax.block_until_ready(gradient(theta))
        taken.append(time.process_time() - began)
    return min(taken)


table = {}
for name, forward in rungs.items():
    slow = forward.kind in ("fem", "corrected")
    median, largest = (0.0, 0.0) if forward.kind == "fem" else error_of(forward)
    seconds = seconds_of(forward, 3 if slow else 60)
    table[name] = {"median": median, "largest": largest, "seconds": seconds, "kind": forward.kind}
    print(f"{name:26s}error {median:8.1e} mm, largest {largest:8.1e} mm; {1e3 * seconds:9.3f} ms")

assert table["series, order 3"]["median"] < table["series, order 1"]["median"] / 5.0
assert table["emulator"]["median"] < 1e-3
assert table["emulator + 1 Newton step"]["median"] < 1e-2 * table["emulator"]["median"]

# %%
figure, axes = plt.subplots(figsize=(6.6, 3.8), layout="constrained")
shown = {name: row for name, row in table.items() if row["kind"] != "fem"}
for name, row in shown.items():
    axes.plot(1e3 * row["seconds"], row["median"], "o", color=COLOURS[row["kind"]], ms=8)
    left = row["kind"] in ("corrected", "reduced")
    side = {"xytext": (-8 if left else 8, -4), "ha": "right" if left else "left"}
    at = (1e3 * row["seconds"], row["median"])
    axes.annotate(name, at, textcoords="offset points", **side)
axes.axvline(
    1e3 * table["FEM from rest"]["seconds"], color=COLOURS["fem"], lw=2, label="FEM from rest"
)
axes.axhline(0.3, color="0.5", ls="--", lw=1, label="noise of the data")
axes.set(xscale="log", yscale="log", xlabel="value and gradient (ms)", ylabel="median error (mm)")
axes.margins(0.45, 0.15)
axes.legend(frameon=False, loc="lower left")
plt.show()

# %% [markdown]
# A point is on the *Pareto front* if no other is both faster and more accurate:

# %%
costs = {name: np.array([row["seconds"], row["median"]]) for name, row in table.items()}
front = [a for a in costs if not any((costs[b] < costs[a]).all() for b in costs)]
print("on the front:", ", ".join(front))
assert "emulator" in front

# %% [markdown]
# ## From how many evaluations on does it pay?
#
# A map that costs $T$ seconds to make and $t$ seconds to evaluate beats FEM, which costs $t_\text{FEM}$, from
# $N = T / (t_\text{FEM} - t)$ evaluations on. For the emulator, $T$ is what its file records of its training, on another day
# and maybe on another machine: read the answer as an order of magnitude.

# %%
fem_seconds = table["FEM from rest"]["seconds"]
offline = {"emulator": float(emulator.record["seconds"]), "POD + GP, 30 runs": offline_reduced}
count = np.geomspace(1, 1e6, 50)
figure, axes = plt.subplots(figsize=(6.0, 3.4), layout="constrained")
axes.plot(count, count * fem_seconds, color=COLOURS["fem"], label="FEM from rest")
for name, seconds in offline.items():
    row = table[name]
    even = seconds / (fem_seconds - row["seconds"])
    axes.plot(count, seconds + count * row["seconds"], color=COLOURS[row["kind"]], label=name)
    axes.plot(even, even * fem_seconds, "o", color=COLOURS[row["kind"]])
    print(f"{name:20s}{seconds:6.0f} s to make, break-even at {even:.0f} evaluations")
    assert 1 < even < 1e5
axes.axvspan(1e4, 1e5, color="0.9", lw=0, label="a NUTS posterior")
axes.set(
    xscale="log",
    yscale="log",
    xlabel="evaluations with gradient",
    ylabel="seconds, making included",
)
axes.legend(frameon=False)
plt.show()

# %% [markdown]
# ## What does the error do to a posterior?
#
# Data are made by FEM: 24 landmarks with 0.3 mm of noise, and the volume with 1 mL. The emulator infers, and so does the
# series of order 1, whose median error is below the noise of the data.

# %%
truth = scene.theta(a=0.3, b=1.5, a_f=4.2, b_f=1.8, pressure=1.1)
exact = simulator.solve(truth).require_converged("the data").displacement
rng = np.random.default_rng(3)
observe = {"displacement": points, "volume": volume}
noise = {"displacement": cal.GaussianNoise(sd=0.3), "volume": cal.GaussianNoise(sd=1.0)}
data = {
    "displacement": np.asarray(points(exact[points.nodes], truth)) + rng.normal(0, 0.3, (24, 3)),
    "volume": np.asarray(volume(exact[volume.nodes], truth)) + rng.normal(),
}
length = {
    "options": cal.samplers.NUTSOptions(warmup=300, draws=500, chains=2, rounds=2),
    "predictions": False,
    "seed": 1,
}
chosen = ("emulator", "series, order 1")
posteriors = {
    name: cal.sample(cal.model(rungs[name], observe, noise), data, **length) for name in chosen
}
best = posteriors["emulator"].summary()


def shifts(posterior):
    """Means less the emulator's, in sd of the emulator's posterior."""
    rows = posterior.summary()
    return {name: (rows[name]["mean"] - row["mean"]) / row["sd"] for name, row in best.items()}


poor = shifts(posteriors["series, order 1"])
for name, shift in poor.items():
    print(f"{name:9s} the mean moves by {shift:+.2f} sd")
assert max(map(abs, poor.values())) > 1.0  # a wrong posterior

# %% [markdown]
# Why does an error below the noise do this? Noise averages out over $n$ data. An error of the map does not: it acts like an
# error of the data that has the same sign for many of them. It is safe only well below $\sigma / \sqrt n$, and it counts where
# the posterior is, not in the middle of the box:

# %%
limit = 0.3 / np.sqrt(3 * 24)
print(f"noise 0.3 mm, 72 numbers: safe well below {limit:.3f} mm")
at_truth = {}
for name in ("emulator", "series, order 3", "series, order 2", "series, order 1"):
    local = rungs[name].at(points.nodes)
    difference = points(local(truth) - exact[points.nodes], truth)
    at_truth[name] = float(np.linalg.norm(difference, axis=1).mean())
    print(f"{name:18s}{at_truth[name]:.4f} mm at the landmarks, at the true theta")
assert at_truth["emulator"] < 0.2 * limit
assert at_truth["series, order 1"] > limit

# %% [markdown]
# You need not know the truth to see it: `certify` solves FEM where it matters, and gives a verdict. `reweight` says that the
# draws are wrong, and that the FEM runs suffice to repair them: `cal.reweight` returns FEM's posterior.

# %%
certificate = cal.certify(posteriors["series, order 1"], simulator, draws=80)
print(certificate)
assert certificate.verdict != "accepted"

# %% [markdown]
# ## The cheapest repair
#
# The series of order 3 comes from the same single FEM run and is evaluated in well under a millisecond, too. Its error at the
# truth is a fifth of the limit.

# %%
repaired = cal.sample(cal.model(rungs["series, order 3"], observe, noise), data, **length)
names = list(best)
print(f"{'':17s}" + "".join(f"{name:>16s}" for name in names))
for label, found in (
    ("emulator", best),
    ("series, order 1", posteriors["series, order 1"].summary()),
    ("series, order 3", repaired.summary()),
):
    cells = [f"{found[name]['mean']:.2f} +- {found[name]['sd']:.2f}" for name in names]
    print(f"{label:17s}" + "".join(f"{cell:>16s}" for cell in cells))
better = shifts(repaired)
print("order 3 moves a mean by at most", f"{max(map(abs, better.values())):.2f} sd")
assert max(map(abs, better.values())) < 0.4

# %%
figure, axes = plt.subplots(figsize=(5.6, 3.0), layout="constrained")
edges = np.linspace(scene.parameters[3].low, scene.parameters[3].high, 40)
for label, posterior, style in (
    ("emulator", posteriors["emulator"], "-"),
    ("series, order 3", repaired, ":"),
    ("series, order 1", posteriors["series, order 1"], "--"),
):
    heights, _ = np.histogram(posterior.draws()["b_f"], edges, density=True)
    colour = "#D55E00" if label.endswith("1") else COLOURS["emulator"]
    axes.stairs(heights, edges, color=colour, ls=style, lw=1.6, label=label)
axes.axvline(float(truth[3]), color="black", lw=1, label="truth")
axes.set(xlabel="b_f", ylabel="posterior density")
axes.legend(frameon=False)
plt.show()

# %% [markdown]
# ## Choosing
#
# - Few evaluations, or a mesh used once: FEM, or a series of order 3 from a single run.
# - A posterior, or many patients' data on one mesh: an emulator. `calibrate train SCENE --recipe mechanics` takes a minute or
#   two.
# - A doubt about the emulator: a certificate. It takes a hundred FEM runs; a chain with a Newton step inside takes thousands.
# - A poor map: `calibrate infer --forward rounds` makes a better one, from FEM runs where the posterior is.
