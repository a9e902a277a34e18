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
# # Adding a law
#
# A hyperelastic law is one function, its strain energy density. Stress, tangent, FEM, emulator and posterior follow from it by
# differentiation. We add a law of skin that the package does not have, check it as one should check any law, and infer its
# two parameters from a bulge test.

# %%
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import brentq

import calibrate as cal
import emulator as em

BLUE, ORANGE = "#0072B2", "#D55E00"

# %% [markdown]
# ## The law
#
# Veronda and Westmann (1970) pulled strips of cat skin and proposed
#
# $$ W = c_1\left[e^{c_2 (\bar I_1 - 3)} - 1\right] - \frac{c_1 c_2}{2} (\bar I_2 - 3) + \frac{\kappa}{2} (J - 1)^2 , $$
#
# with $c_1$ in kPa and $c_2$ a number. We write it in the isochoric invariants $\bar I_1 = J^{-2/3} I_1$ and
# $\bar I_2 = J^{-4/3} I_2$. The function below is that of one material point. `Strain` has $\bar I_1 - 3$ and
# $J - 1$, but not $I_2$. With the Green-Lagrange strain $E$,
#
# $$ I_2 - 3 = 4 \operatorname{tr} E + 2 \left[(\operatorname{tr} E)^2 - E : E\right] , $$
#
# in which nothing is taken off again, so that small strains keep their digits.


# %%
def isochoric_I2_minus_3(strain):
    E = strain.green_lagrange
    trace = jnp.trace(E)
    change = 4.0 * trace + 2.0 * (trace**2 - jnp.sum(E * E))
    power = -4.0 / 3.0 * strain.ln_J
    return change * jnp.exp(power) + 3.0 * jnp.expm1(power)


def energy(strain, c_1, c_2, kappa):
    """Strain energy density in kPa."""
    shape = c_1 * jnp.expm1(c_2 * strain.isochoric_I1_minus_3)
    return shape - 0.5 * c_1 * c_2 * isochoric_I2_minus_3(strain) + em.laws.quadratic(strain, kappa)


parameters = (em.laws.modulus("c_1"), em.laws.number("c_2"), em.laws.modulus("kappa"))
law = em.laws.Law("veronda_westmann", parameters, energy, exponential=True)

# %% [markdown]
# The quantities come in the order in which the function takes them. `modulus` is in kPa and above 0, `number` has no unit.
# `exponential=True` tells the solver that stress grows exponentially, which makes it start more carefully.
#
# In the package this would be the file `src/emulator/mechanics/laws/veronda_westmann.py` with a line `LAWS = (law,)`, and it
# would be found by itself. In a notebook, the next line does the same.

# %%
em.laws.LAWS[law.name] = law
assert em.find_law("veronda_westmann") is law

# %% [markdown]
# ## Is it a law?
#
# Four checks at one material point, none of which needs FEM. They take a minute to write and find nearly every mistake.

# %%
values = (8.0, 2.0, 200.0)  # c_1 (kPa), c_2, kappa (kPa)


def W(H):
    """Energy of one point at the displacement gradient H."""
    return law.energy(em.laws.Strain(H), *values)


stress, tangent = jax.jit(jax.grad(W)), jax.jit(jax.hessian(W))  # first Piola, and its derivative
identity = np.eye(3)

# %% [markdown]
# **Zero energy and stress at rest.**

# %%
print(
    "W(0) =",
    float(W(jnp.zeros((3, 3)))),
    " largest stress at rest:",
    np.abs(stress(jnp.zeros((3, 3)))).max(),
)
assert W(jnp.zeros((3, 3))) == 0.0
assert np.abs(stress(jnp.zeros((3, 3)))).max() < 1e-12

# %% [markdown]
# **Hooke's law at small strain.** The first derivatives of $W$ in both invariants give the shear modulus
# $\mu = 2 (c_1 c_2 - c_1 c_2 / 2) = c_1 c_2$. The tangent at rest must be
# $\lambda\, \delta_{ij}\delta_{kl} + \mu (\delta_{ik}\delta_{jl} + \delta_{il}\delta_{jk})$ with
# $\lambda = \kappa - \tfrac23 \mu$.

# %%
mu, kappa = values[0] * values[1], values[2]
hooke = (kappa - 2.0 / 3.0 * mu) * np.einsum("ij,kl->ijkl", identity, identity)
hooke += mu * (
    np.einsum("ik,jl->ijkl", identity, identity) + np.einsum("il,jk->ijkl", identity, identity)
)
gap = np.abs(tangent(jnp.zeros((3, 3))) - hooke).max()
print(f"largest difference from Hooke's tangent: {gap:.1e} kPa")
assert gap < 1e-11 * kappa

# %% [markdown]
# **Frame indifference.** A rotation after a deformation must not change the energy. A law of the components of $H$ instead of
# the invariants fails here.

# %%
rng = np.random.default_rng(0)
F = identity + 0.2 * rng.normal(size=(3, 3))
Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
Q *= np.sign(np.linalg.det(Q))
change = float(W(Q @ F - identity) / W(F - identity)) - 1.0
print(f"relative change of the energy under a rotation: {change:.1e}")
assert abs(change) < 1e-13

# %% [markdown]
# **Derivatives against finite differences.** What is left of the energy after its first derivative must fall with the square
# of the step, and what is left of the stress after the tangent too. The slope in a doubly logarithmic plot is the test: a
# wrong derivative has slope 1.

# %%
direction = rng.normal(size=(3, 3))
steps = 0.5 ** np.arange(4, 12)
H = F - identity
first = np.vdot(stress(H), direction)
second = np.einsum("ijkl,kl->ij", tangent(H), direction)
left = {
    "energy": [abs(float(W(H + h * direction) - W(H)) - h * first) for h in steps],
    "stress": [np.linalg.norm(stress(H + h * direction) - stress(H) - h * second) for h in steps],
}
for name, sizes in left.items():
    slope = np.polyfit(np.log(steps[2:]), np.log(sizes[2:]), 1)[0]
    print(f"remainder of the {name} falls with step^{slope:.3f}")
    assert abs(slope - 2.0) < 0.05

# %% [markdown]
# ## Uniaxial tension, in closed form and by FEM
#
# A cube is pulled along x and free along y and z. In principal stretches the first Piola stress is
# $P_i = \partial W / \partial \lambda_i$, which we write out by hand. The lateral stretch follows from $P_2 = 0$.


# %%
def piola(stretches, c_1, c_2, kappa):
    """P_i in kPa, (3,), by hand in NumPy: it shares no code with the law."""
    squares = stretches**2
    J, I1 = np.prod(stretches), squares.sum()
    I2 = squares[0] * squares[1] + squares[1] * squares[2] + squares[2] * squares[0]
    d_I1 = J ** (-2 / 3) * (2 * stretches - 2 / 3 * I1 / stretches)
    d_I2 = J ** (-4 / 3) * (2 * stretches * (I1 - squares) - 4 / 3 * I2 / stretches)
    rise = c_1 * c_2 * np.exp(c_2 * (J ** (-2 / 3) * I1 - 3))
    return rise * d_I1 - c_1 * c_2 / 2 * d_I2 + kappa * (J - 1) * J / stretches


def uniaxial(stretch, *values):
    """Lateral stretch and axial stress."""
    lateral = brentq(lambda w: piola(np.array([stretch, w, w]), *values)[1], 0.5, 1.5, xtol=1e-14)
    return lateral, piola(np.array([stretch, lateral, lateral]), *values)[0]


lateral, pull = uniaxial(1.3, *values)
cube = em.Scene(
    name="pulled cube",
    mesh=em.generators.box((10.0, 10.0, 10.0), (2, 2, 2)),
    law=law,
    parameters=(
        em.Parameter("c_1", "kPa", 4.0, 16.0, "log"),
        em.Parameter("c_2", "", 1.0, 4.0, "log"),
    ),
    loads=(em.loads.Traction("right", (pull, 0.0, 0.0)),),
    supports=(
        em.Support("left", components="x"),
        em.Support("front", components="y"),
        em.Support("bottom", components="z"),
    ),
    constants={"kappa": kappa},
)
u = em.Simulator(cube)(cube.theta(c_1=values[0], c_2=values[1]))
found = 1.0 + np.asarray(u).max(axis=0)[0] / 10.0, 1.0 + np.asarray(u).min(axis=0)[1] / 10.0
print(f"by hand: stretches 1.300000 and {lateral:.6f} under {pull:.4f} kPa")
print(f"by FEM:  stretches {found[0]:.6f} and {found[1]:.6f}")
assert np.allclose(found, (1.3, lateral), atol=1e-9)

# %%
stretches = np.linspace(0.85, 1.4, 56)
figure, axes = plt.subplots(figsize=(5.0, 3.4), layout="constrained")
for c_2, style in ((1.0, ":"), (2.0, "-"), (4.0, "--")):
    curve = [uniaxial(s, 16.0 / c_2, c_2, kappa)[1] for s in stretches]
    axes.plot(stretches, curve, style, color=BLUE, label=f"c_1 = {16 / c_2:g} kPa, c_2 = {c_2:g}")
axes.axhline(0.0, color="0.7", lw=0.6)
axes.set(xlabel="stretch", ylabel="first Piola stress (kPa)", ylim=(-20.0, 60.0))
axes.legend(frameon=False, fontsize=8)
plt.show()

# %% [markdown]
# All three have the same modulus at small strain, $c_1 c_2 = 16$ kPa. A test that stretches little cannot tell them apart.
#
# ## A bulge test
#
# A square of skin, 40 mm wide and 2 mm thick, is clamped along its edges and blown up from below. The pressure is known; the
# displacements of 12 points are seen from above. The pressure acts on a surface whose rim is held, so its work is exactly
# $-pV$ and `CavityPressure` may be used.

# %%
mesh = em.generators.box((40.0, 40.0, 2.0), (10, 10, 1))
scene = em.Scene(
    name="bulge test",
    mesh=mesh,
    law=law,
    parameters=(
        em.Parameter("c_1", "kPa", 4.0, 16.0, "log"),
        em.Parameter("c_2", "", 1.0, 4.0, "log"),
        em.Parameter("pressure", "kPa", 0.3, 4.0),
    ),
    loads=(em.loads.CavityPressure("bottom"),),
    supports=tuple(em.Support(side) for side in ("left", "right", "front", "back")),
    constants={"kappa": kappa},
)
simulator = em.Simulator(scene)
truth = {"c_1": 9.0, "c_2": 2.2}
low, high = 0.5, 3.5  # kPa
fields = {p: simulator(scene.theta(**truth, pressure=p)) for p in (low, high)}
for p, u in fields.items():
    print(f"{p} kPa: the middle rises by {float(u[:, 2].max()):.2f} mm")

# %% [markdown]
# An emulator of the new law: nothing more has to be written. The law was differentiated three times for the Taylor series and
# once for every FEM run.

# %%
emulator = em.train(scene, replace(em.recipe("mechanics"), simulations=30), "training")
forward = emulator.cache()
for p, u in fields.items():
    error = np.linalg.norm(forward(scene.theta(**truth, pressure=p)) - u, axis=1).max()
    print(f"{p} kPa: largest error {error:.1e} mm")
    assert error < 0.02

# %% [markdown]
# ## Two posteriors
#
# Two load states share the material; the pressure belongs to a state (`name@state`). First only the low pressure, then both.

# %%
rng = np.random.default_rng(1)
top = np.flatnonzero(mesh.nodes[:, 2] == 2.0)
inner = top[(np.abs(mesh.nodes[top, :2] - 20.0) < 17.0).all(axis=1)]
points = cal.nodal_displacements(scene, np.sort(rng.choice(inner, 12, replace=False)))
noise = cal.GaussianNoise(sd=0.1)  # mm
data = {
    f"displacement@{state}": np.asarray(fields[p][points.nodes]) + rng.normal(0.0, 0.1, (12, 3))
    for state, p in (("low", low), ("high", high))
}
known = {"pressure@low": low, "pressure@high": high}
posteriors = {}
for states in (("low",), ("low", "high")):
    names = [f"displacement@{state}" for state in states]
    model = cal.model(
        forward,
        dict.fromkeys(names, points),
        noise,
        known={f"pressure@{state}": known[f"pressure@{state}"] for state in states},
    )
    posteriors[states] = cal.sample(
        model,
        {name: data[name] for name in names},
        options=cal.samplers.NUTSOptions(warmup=300, draws=400, rounds=3),
        seed=1,
    )
    print(f"seen at {' and '.join(states)} pressure:")
    print(cal.analysis.in_words(cal.identify(posteriors[states])))

# %%
figure, axes = plt.subplots(figsize=(4.6, 3.8), layout="constrained")
for (states, posterior), colour in zip(posteriors.items(), (ORANGE, BLUE), strict=True):
    draws = posterior.draws()
    label = " and ".join(states) + " pressure"
    chosen = np.linspace(0, len(draws["c_1"]) - 1, 1200).astype(int)
    axes.plot(draws["c_1"][chosen], draws["c_2"][chosen], ".", color=colour, ms=3, label=label)
axes.plot(truth["c_1"], truth["c_2"], "k+", ms=12, mew=2, label="truth")
axes.set(xlabel="c_1 (kPa)", ylabel="c_2", xlim=(4, 16), ylim=(1, 4))
axes.legend(frameon=False)
plt.show()

# %% [markdown]
# At low pressure the posterior follows the curve $c_1 c_2 = $ const.: it is the modulus at small strain that has been measured.
# The high pressure stretches the skin into its exponential range and separates the two.

# %%
weak, strong = posteriors.values()
product = weak.draws()["c_1"] * weak.draws()["c_2"]
print(f"c_1 c_2 from the low pressure: {product.mean():.1f} +- {product.std():.1f} kPa")
for name, row in strong.summary().items():
    print(f"{name}: {row['mean']:.2f} +- {row['sd']:.2f}, truth {truth[name]}")
    assert abs(row["mean"] - truth[name]) < 3.0 * row["sd"]
    assert row["sd"] < 0.5 * weak.summary()[name]["sd"]

# %% [markdown]
# Finite elements with the same law have the last word, on the mesh that made the data (`mesh=0`). A finer mesh of this thin sheet
# of linear tetrahedra would not agree: with your own data, take quadratic ones.

# %%
certificate = cal.certify(strong, simulator, draws=80, mesh=0)
print(certificate)
assert certificate.verdict == "accepted"

# %% [markdown]
# To give the law to others, move the function into its file, give it values in `tests/law_support.py`, and the package's tests
# repeat the checks above for it. [`docs/extending.md`](../docs/extending.md) has the steps, and adds an observation and a
# sampler as well.
