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
# # Samplers
#
# The forward map is a differentiable JAX function, so any sampler that takes a log density can use it. Three ways lead to
# draws, from the most to the least of your own code:
#
# 1. BlackJAX, with a kernel of yours on the toolkit's log density;
# 2. NumPyro, with the forward map inside a model of yours;
# 3. `cal.sample` with one of its samplers: importance sampling, NUTS of NumPyro or BlackJAX, SMC, and the Laplace
#    approximation.
#
# At the end all are compared by effective draws a second, and by what they would cost with FEM in place of the emulator.

# %%
import time

import blackjax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, NUTS

import calibrate as cal
import emulator as em

BLUE = "#0072B2"

# %% [markdown]
# ## The problem
#
# The liver of the notebook on verification: two moduli from 20 points, 0.3 mm of noise.

# %%
forward = em.load("liver").cache()
scene, simulator = forward.scene, em.Simulator(forward.scene)
truth = scene.theta(lam=6.0, mu=5.0)
observe = cal.landmarks(scene, cal.spread_landmarks(scene, 20, seed=5))
exact = np.asarray(observe(simulator(truth)[observe.nodes], truth))
data = exact + np.random.default_rng(5).normal(0.0, 0.3, exact.shape)  # mm
model = cal.model(forward, observe, cal.GaussianNoise(sd=0.3))

# %% [markdown]
# ## 1. BlackJAX with a kernel of your own choice
#
# `density_of` gives the posterior's log density in unconstrained coordinates `z`: each parameter's range is mapped to the real
# line, and the Jacobian is included. The data is an argument, so a compiled sampler serves the next data set too.

# %%
density = cal.samplers.density_of(model)
_, given = model.given(data)  # checked, by name
print("coordinates:", density.names)


def log_density(z):
    return density.log_density(z, given)


z = density.unconstrain({"lam": 6.0, "mu": 5.0})
print("log density at the truth:", float(log_density(z)))
slope = jax.jit(jax.grad(log_density))(z)
for k in range(2):  # against a central difference
    step = 1e-4 * jnp.eye(2)[k]
    assert (
        abs((log_density(z + step) - log_density(z - step)) / 2e-4 - slope[k])
        < 1e-4 * abs(slope[k]) + 1e-4
    )

# %% [markdown]
# From here on it is BlackJAX alone. We take Hamiltonian Monte Carlo of ten steps, which the toolkit does not offer, adapt it,
# and run four chains at once by `vmap`.


# %%
def run_chain(key):
    start, adapt, run = jax.random.split(key, 3)
    warmup = blackjax.window_adaptation(blackjax.hmc, log_density, num_integration_steps=10)
    (state, parameters), _ = warmup.run(adapt, density.prior_draw(start), num_steps=400)
    kernel = blackjax.hmc(log_density, **parameters).step

    def advance(state, key):
        state, info = kernel(key, state)
        return state, (state.position, info.acceptance_rate)

    return jax.lax.scan(advance, state, jax.random.split(run, 800))[1]


positions, acceptance = jax.jit(jax.vmap(run_chain))(jax.random.split(jax.random.key(1), 4))
own = {
    name: np.asarray(values).reshape(4, 800)
    for name, values in density.constrain(positions.reshape(-1, 2)).items()
}
print(f"acceptance rate {float(acceptance.mean()):.2f}")
for name, values in own.items():
    r_hat = float(cal.array_stats.rhat(values))
    print(f"{name}: {values.mean():.3f} +- {values.std():.3f}, R-hat {r_hat:.4f}")
    assert r_hat < 1.02

# %% [markdown]
# ## 2. NumPyro with a model of your own
#
# The toolkit's model has one body. Suppose there are three livers of one species: each has its own moduli, which scatter about
# those of the species, and the noise is unknown. That is a hierarchical model, and a dozen lines of NumPyro.
# `forward.evaluate` returns a displacement and whether it may be used: outside the box the emulator was trained on, it may not.

# %%
seen = forward.at(observe.nodes)
space = np.log([[p.low for p in scene.parameters], [p.high for p in scene.parameters]])


def livers(measured):
    centre = numpyro.sample("centre", dist.Uniform(*space).to_event(1))  # log of (lam, mu)
    spread = numpyro.sample("spread", dist.HalfNormal(0.3))
    noise_sd = numpyro.sample("noise_sd", dist.HalfNormal(1.0))  # mm
    with numpyro.plate("liver", len(measured)):
        log_theta = numpyro.sample("log_theta", dist.Normal(centre, spread).to_event(1))
    prediction = jax.vmap(seen.evaluate)(jnp.exp(log_theta))
    numpyro.factor("inside", jnp.where(prediction.valid, 0.0, -jnp.inf).sum())
    means = observe(prediction.displacement, None)
    numpyro.sample("measured", dist.Normal(means, noise_sd).to_event(3), obs=measured)


rng = np.random.default_rng(8)
thetas = np.array([[5.6, 4.6], [6.4, 5.0], [5.2, 5.5]])  # kPa
measured = np.stack(
    [np.asarray(observe(simulator(jnp.asarray(t))[observe.nodes], t)) for t in thetas]
)
measured += rng.normal(0.0, 0.3, measured.shape)
mcmc = MCMC(
    NUTS(livers, init_strategy=numpyro.infer.init_to_median),
    num_warmup=400,
    num_samples=500,
    num_chains=2,
    chain_method="sequential",
    progress_bar=False,
)
mcmc.run(jax.random.key(2), jnp.asarray(measured))
found = {name: np.asarray(values) for name, values in mcmc.get_samples().items()}
moduli = np.exp(found["log_theta"])
for k, row in enumerate(thetas):
    mean, sd = moduli[:, k].mean(axis=0), moduli[:, k].std(axis=0)
    print(f"liver {k}: mu {mean[1]:.2f} +- {sd[1]:.2f}, truth {row[1]}")
    assert abs(mean[1] - row[1]) < 4.0 * sd[1]
print(f"noise {found['noise_sd'].mean():.3f} +- {found['noise_sd'].std():.3f} mm, truth 0.3")
assert abs(found["noise_sd"].mean() - 0.3) < 4.0 * found["noise_sd"].std()

# %% [markdown]
# ## 3. The toolkit's samplers
#
# Each is run twice with different seeds: the first run compiles, the second is timed, in processor time, which other work on
# the machine does not lengthen much.

# %%
size = {"warmup": 300, "draws": 400, "chains": 4}
OPTIONS = {
    "importance": cal.samplers.ImportanceOptions(draws=400),
    "nuts": cal.samplers.NUTSOptions(**size, rounds=1),
    "blackjax_nuts": cal.samplers.BlackJAXNUTSOptions(**size, rounds=1),
    "smc": cal.samplers.SMCOptions(draws=300, transitions=5),
    "laplace": cal.samplers.LaplaceOptions(draws=400),
}
posteriors, seconds = {}, {}
for name, options in OPTIONS.items():
    for seed in (1, 2):
        began = time.process_time()
        posteriors[name] = cal.sample(
            model, data, sampler=name, options=options, seed=seed, predictions=False
        )
        seconds[name] = time.process_time() - began

# %% [markdown]
# **The same posterior.** All means must agree within their Monte Carlo errors. The Laplace approximation is an exception: it is a
# Gaussian at the mode, and only as good as the posterior is Gaussian. Its draws carry a diagnosis, the Pareto shape k of their
# importance ratios. Above 0.7 it should not be believed.

# %%
tables = {name: posterior.summary() for name, posterior in posteriors.items()}
reference = tables["nuts"]
for name, table in tables.items():
    print(
        f"{name:20s}"
        + "   ".join(f"{p} {row['mean']:.3f} +- {row['sd']:.3f}" for p, row in table.items())
    )
    for parameter, row in table.items():
        error = row["sd"] * np.hypot(
            row["ess_bulk"] ** -0.5, reference[parameter]["ess_bulk"] ** -0.5
        )
        away = abs(row["mean"] - reference[parameter]["mean"])
        assert name == "laplace" or away < 4.0 * error, name
laplace, smc = posteriors["laplace"].tree.attrs, posteriors["smc"].tree.attrs
print(f"Laplace: Pareto k {laplace['pareto_k']:.2f}")
print(f"SMC: log evidence {smc['log_evidence']:.2f} +- {smc['log_evidence_error']:.2f}")
assert laplace["pareto_k"] > 0.7
assert tables["laplace"]["lam"]["sd"] < reference["lam"]["sd"]

# %% [markdown]
# Here it is above 0.7, with reason: the posterior of lam reaches both ends of the range and is cut there, which no Gaussian is.
# The approximation's sd of lam is too small.
#
# The hand-made chain of part 1 draws from the same density:

# %%
for name, values in own.items():
    ess = float(cal.array_stats.ess(values, method="bulk", chain_axis=0, draw_axis=1))
    error = values.std() * np.hypot(ess**-0.5, reference[name]["ess_bulk"] ** -0.5)
    both = f"{values.mean():.3f}, by the toolkit {reference[name]['mean']:.3f}"
    print(f"{name}: {both}; effective draws {ess:.0f}")
    assert abs(values.mean() - reference[name]["mean"]) < 4.0 * error

# %% [markdown]
# ## Effective draws a second, and what FEM would cost
#
# Draws of a chain depend on each other; the *effective* number (ESS) says how many independent ones they are worth. We divide
# the smallest ESS of any parameter by the processor seconds of the second run.
#
# What would the same chains take with FEM inside? NUTS evaluates one gradient for each of its `n_steps`. We count those of the
# draws alone, without warm-up, and multiply by the time of one FEM gradient, which is measured. This is an estimate: nobody
# would wait for it.

# %%
by_fem = em.fem_forward(simulator).at(observe.nodes)
gradient = jax.jit(jax.value_and_grad(lambda theta: jnp.sum(by_fem(theta) ** 2)))
jax.block_until_ready(gradient(truth))
began = time.process_time()
for k in range(3):
    jax.block_until_ready(gradient(truth * (1.0 + 0.01 * k)))
fem_gradient = (time.process_time() - began) / 3.0
print(f"one FEM value with its gradient: {1e3 * fem_gradient:.0f} ms")

heads = ("least ESS", "seconds", "ESS / s", "with FEM inside")
print(f"{'sampler':20s}" + "".join(f"{head:>16s}" for head in heads))
rate, cost = {}, {}
for name, posterior in posteriors.items():
    ess = min(row["ess_bulk"] for row in tables[name].values())
    rate[name] = ess / seconds[name]
    statistics = posterior.tree["sample_stats"]
    inside = ""
    if "n_steps" in statistics:
        cost[name] = float(statistics["n_steps"].sum()) * fem_gradient / 60.0
        inside = f"about {cost[name]:.0f} min"
    print(f"{name:20s}{ess:16.0f}{seconds[name]:16.2f}{rate[name]:16.0f}{inside:>16s}")

# %%
figure, axes = plt.subplots(figsize=(6.0, 2.8), layout="constrained")
for name in sorted(rate, key=lambda name: rate[name]):
    axes.plot(rate[name], name, "o", color=BLUE, ms=8)
axes.set(xscale="log", xlabel="effective draws a second")
axes.grid(axis="x", color="0.9")
axes.set_axisbelow(True)
axes.spines[["top", "right"]].set_visible(False)
plt.show()

# %% [markdown]
# Draws of the Laplace approximation are independent, so its rate means nothing beyond the quality of the Gaussian. Those of
# `importance` are resampled from weighted points: equal ones occur, and the effective number counts them once.
#
# ## FEM's verdict at 80 solves
#
# All of these draws are of the emulator's posterior. A certificate solves FEM at some of them, and where they are not, and says
# whether they may stand for draws of FEM's posterior. The data are of FEM on the mesh of the emulator, so the certificate leaves
# the finer one out (`mesh=0`).

# %%
certificate = cal.certify(posteriors["nuts"], simulator, draws=80, mesh=0)
print(certificate)
assert 0.02 * float(posteriors["nuts"].tree["sample_stats"]["n_steps"].sum()) > 80
assert certificate.verdict == "accepted"

# %% [markdown]
# It says for 80 solves, without gradients, that the emulator's draws may be used as they are. So the order of things is: draws
# with the emulator; a certificate; and where it does not accept, `cal.reweight`, or a better emulator.
#
# Which sampler? `auto`, the default, unless there is a reason. For up to eight unknowns it takes `importance`, which sees the
# whole prior, finds several modes and gives the evidence; for more, `nuts`. `smc` finds several modes among many unknowns,
# `laplace` is for a first look.
