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
# # A left ventricle: stiffness and pressure
#
# In diastole a relaxed heart fills. Images give the volume of its cavity and the displacements of some points in its wall.
# Wanted are the stiffness of the muscle and, because a catheter is invasive, the filling pressure. We ask what such data can
# tell, and let finite elements check the answer.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import calibrate as cal
import emulator as em

BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "0.75"

# %% [markdown]
# ## The model
#
# The muscle is Holzapfel and Ogden's: an isotropic matrix, and fibres that stiffen exponentially when stretched,
#
# $$ W = \frac{a}{2b}\left[e^{b(\bar I_1 - 3)} - 1\right]
#      + \frac{a_f}{2 b_f}\left[e^{b_f (\bar I_{4f} - 1)^2} - 1\right] + W_\text{vol}(J). $$
#
# `a` and `a_f` (kPa) set the stiffness at small strain, `b` and `b_f` how fast it grows. The fifth parameter is the pressure.
# An emulator of this scene is shipped, so nothing has to be trained.

# %%
forward = em.load("left_ventricle").cache()
scene, simulator = forward.scene, em.Simulator(forward.scene)
for parameter in scene.parameters:
    print(f"{parameter.name:9s}{parameter.low:6.3f} to {parameter.high:6.3f} {parameter.unit}")

# %% [markdown]
# ## Data
#
# We make them by finite elements, so that the truth is known: 1 kPa, or 7.5 mmHg, of filling pressure. Noise is 1 mL on the
# volume and 0.3 mm on each component of the displacement of 24 material points. Never make data with the emulator that you
# infer with: its errors would cancel.

# %%
truth = {"a": 0.36, "b": 1.8, "a_f": 4.6, "b_f": 2.4, "pressure": 1.0}
solution = simulator.solve(scene.theta(**truth)).require_converged("the data")
points = cal.landmarks(scene, cal.spread_landmarks(scene, 24, seed=3))
volume = cal.CavityVolume(scene)


def seen(observation):
    displacement = solution.displacement[observation.nodes]
    return np.asarray(observation(displacement, scene.theta(**truth)))


rng = np.random.default_rng(3)
data = {
    "displacement": seen(points) + rng.normal(0.0, 0.3, (24, 3)),  # mm
    "volume": seen(volume) + rng.normal(0.0, 1.0),  # mL
}
print(f"cavity: {volume.cavity.rest:.1f} mL at rest, {seen(volume):.1f} mL filled")
print(f"landmarks move by {np.linalg.norm(seen(points), axis=1).mean():.1f} mm on average")

# %% [markdown]
# ## The volume alone
#
# One number for five unknowns. The prior is the scene's box. Its ranges of stiffness are wide guesses, and a posterior that ran into
# the end of one would be no result; that of the pressure is knowledge: hearts fill at 4 to 10 mmHg. `bounded` says so.

# %%
noise = {"displacement": cal.GaussianNoise(sd=0.3), "volume": cal.GaussianNoise(sd=1.0)}
only_volume = cal.sample(
    cal.model(forward, {"volume": volume}, {"volume": noise["volume"]}, bounded=["pressure"]),
    {"volume": data["volume"]},
    seed=1,
)
only_volume

# %%
print(cal.analysis.in_words(cal.identify(only_volume)))

# %% [markdown]
# *Known best* is a product of powers. It says in one line what the volume measures: pressure over stiffness, to a few percent.
# Of the single parameters, `pressure` and `a_f` have lost a quarter and a third of their prior width, the others next to nothing.
#
# ## Volume and displacements

# %%
model = cal.model(forward, {"displacement": points, "volume": volume}, noise, bounded=["pressure"])
posterior = cal.sample(model, data, seed=2)
posterior

# %%
found = cal.identify(posterior)
print(cal.analysis.in_words(found))
summary = posterior.summary()
for name, row in summary.items():
    assert row["r_hat"] < 1.02, name
    assert abs(row["mean"] - truth[name]) < 3.0 * row["sd"], name

# %%
figure, panels = plt.subplots(1, 5, figsize=(11.0, 2.6), layout="constrained")
for axes, parameter in zip(panels, scene.parameters, strict=True):
    name, edges = parameter.name, np.linspace(parameter.low, parameter.high, 36)
    values = np.linspace(parameter.low, parameter.high, 200)[1:-1]
    prior = np.exp(model.prior[name].log_prob(values))
    axes.fill_between(values, prior, color=GREY, lw=0, label="prior")
    for draws, colour, label in (
        (only_volume.draws()[name], ORANGE, "volume"),
        (posterior.draws()[name], BLUE, "both"),
    ):
        axes.hist(draws, edges, density=True, histtype="step", color=colour, lw=1.5, label=label)
    axes.axvline(truth[name], color="black", lw=1.2, ls="--", label="truth")
    axes.set(xlabel=f"{name} ({parameter.unit})" if parameter.unit else name, yticks=[])
panels[0].set_ylabel("density")
panels[-1].legend(frameon=False, fontsize=8)
plt.show()

# %% [markdown]
# The displacements say how the wall moves as well as how far the cavity grows. They separate fibres from matrix, and yet
# pressure and stiffness are still correlated: a stiffer heart under more pressure moves almost alike.

# %%
draws = posterior.draws()
names = scene.parameter_names
figure, panels = plt.subplots(1, 2, figsize=(7.5, 3.2), layout="constrained")
for axes, name in zip(panels, ("a_f", "a"), strict=True):
    parameter = scene.parameters[names.index(name)]
    axes.plot(draws["pressure"], draws[name], ".", color=BLUE, ms=2, alpha=0.4)
    axes.plot(truth["pressure"], truth[name], "k+", ms=13, mew=2)
    correlation = found["correlation"]["pressure"][name]
    axes.set(
        xlabel="pressure (kPa)", ylabel=f"{name} (kPa)", title=f"correlation {correlation:.2f}"
    )
plt.show()
assert found["correlation"]["pressure"]["a_f"] > 0.9

# %% [markdown]
# ## What of the pressure?
#
# A catheter measures it; images do not. Suppose a catheter of 0.05 kPa (0.4 mmHg) was in place. It is one more observation.

# %%
catheter = cal.MeasuredParameter(scene, "pressure")
invasive = cal.sample(
    cal.model(
        forward,
        {"displacement": points, "volume": volume, "parameter:pressure": catheter},
        {**noise, "parameter:pressure": cal.GaussianNoise(sd=0.05)},
        bounded=["pressure"],
    ),
    {**data, "parameter:pressure": truth["pressure"] + rng.normal(0.0, 0.05)},
    seed=3,
    predictions=False,
)
rows = {"volume": only_volume, "+ displacements": posterior, "+ catheter": invasive}
print(f"{'sd of':18s}" + "".join(f"{name:>10s}" for name in names))
for label, found_by in rows.items():
    table = found_by.summary()
    print(f"{label:18s}" + "".join(f"{table[name]['sd']:10.3f}" for name in names))

# %% [markdown]
# ## From parameters to predictions
#
# What one wants in the end is often not a parameter. Two examples: the stress in a fibre at a given stretch, and the volume at
# a pressure at which nothing was measured.

# %%
wall = forward.at(volume.nodes)
pressures = np.linspace(0.55, 1.3, 16)  # kPa
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.2), layout="constrained")
width = {}
for label, found_by, colour in (
    ("images", posterior, BLUE),
    ("images and catheter", invasive, ORANGE),
):
    band = cal.analysis.stress_band(found_by, "fibre", stretches=np.linspace(1.0, 1.2, 21))
    left.fill_between(
        band.stretch, band.low, band.high, color=colour, alpha=0.35, lw=0, label=label
    )
    curves = []
    for pressure in pressures:
        at = np.asarray(found_by.thetas())[::40].copy()
        at[:, names.index("pressure")] = pressure
        curves.append(np.asarray(volume(wall(jnp.asarray(at)), None)))
    low, high = np.quantile(curves, [0.05, 0.95], axis=1)
    right.fill_between(pressures, low, high, color=colour, alpha=0.35, lw=0)
    width[label] = float(np.interp(truth["pressure"], pressures, high - low))
left.set(xlabel="fibre stretch", ylabel="axial less transverse stress (kPa)")
left.legend(frameon=False, title="90 % band from")
right.errorbar(
    truth["pressure"], data["volume"], 1.0, fmt="k.", label="measured, at the true pressure"
)
right.set(xlabel="pressure (kPa)", ylabel="cavity volume (mL)")
right.legend(frameon=False, loc="lower right")
plt.show()
for label, value in width.items():
    print(f"90 % band of the volume at 1 kPa, from {label}: {value:.1f} mL wide")
assert width["images and catheter"] < width["images"]

# %% [markdown]
# The volume was measured to 1 mL, yet the blue band at 1 kPa is many mL wide: images do not say at which pressure they were
# taken. The catheter does, and narrows both bands.

# %% [markdown]
# ## The certificate
#
# Everything above was the emulator's. Finite elements are asked at as many theta as decide, 70 to 200, chosen where the posterior
# is and where it might have been missed. The verdict is `accepted` only if no mean, sd or correlation would change by more than
# a stated limit, and if the data are such as the model predicts.

# %%
certificate = cal.certify(posterior, simulator)
print(certificate)
for name, shift in certificate.shift.items():
    print(f"{name:9s} mean under FEM less mean of the draws: {shift:+.3f} sd")
assert certificate.verdict == "accepted"
