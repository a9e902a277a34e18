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
# # A graph network in a model of your own
#
# A physics-informed graph network has learned a left ventricle from its energy alone. Its processor passes messages
# between the nodes and knows nothing of theta, so it is run once and its result is kept. What remains is a small
# differentiable map from material parameters and pressure to displacement. Here it goes into a NumPyro model that you
# write yourself, BlackJAX draws from it by its own interface, and the same map serves a sensitivity study.

# %%
import time

import arviz
import blackjax
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer.util import initialize_model

import calibrate as cal
import emulator as em

trained = em.load("left_ventricle")
scene = trained.scene
print(trained)

# %% [markdown]
# ## What is computed once, and what for every theta
#
# `cache` runs the processor. The map then decodes only the nodes that somebody observes: those of the cavity.

# %%
volume = cal.CavityVolume(scene)


def seconds(function, *arguments, calls=20):
    """Return the seconds of a call, without the first one, which compiles."""
    jax.block_until_ready(function(*arguments))
    start = time.perf_counter()
    for _ in range(calls):
        jax.block_until_ready(function(*arguments))
    return (time.perf_counter() - start) / calls


start = time.perf_counter()
forward = trained.cache().at(volume.nodes)
print(f"processor and cache, once:         {time.perf_counter() - start:8.2f} s")


def volume_at(theta):
    """Return the cavity's volume in mL at theta (5,)."""
    return volume.evaluate(forward(theta), theta)


value_and_gradient = jax.jit(jax.value_and_grad(volume_at))
print(
    f"volume and gradient, every theta:  {1e3 * seconds(value_and_gradient, scene.centre):8.3f} ms"
)

# %% [markdown]
# ## Data
#
# The volume at three known pressures, by finite elements, with noise of 1 mL.

# %%
names = scene.parameter_names
truth = {"a": 0.33, "b": 2.2, "a_f": 6.0, "b_f": 2.4}
pressures = jnp.array([5.0, 8.0, 10.0]) * 0.133322  # kPa
simulator = em.Simulator(scene)
thetas = jnp.stack([scene.theta(**truth, pressure=float(p)) for p in pressures])
exact = jnp.stack([volume.evaluate(simulator(theta)[volume.nodes], theta) for theta in thetas])
data = exact + jax.random.normal(jax.random.key(1), exact.shape)
print("volumes", np.round(data, 1), "mL")

# %% [markdown]
# ## A model in NumPyro
#
# Any prior and any parameters of your own: here the fibres' stiffness is a multiple of the ground's, and both exponents
# are known.


# %%
def ventricle(data):
    """Volumes (3,) in mL at the known pressures."""
    a = numpyro.sample("a", dist.LogUniform(0.2, 0.52))
    ratio = numpyro.sample("ratio", dist.LogNormal(jnp.log(15.0), 0.4))
    material = {"a": a, "b": 2.2, "a_f": ratio * a, "b_f": 2.4}

    def predicted(pressure):
        theta = jnp.stack([{**material, "pressure": pressure}[name] for name in names])
        answer = forward.evaluate(theta)
        return volume.evaluate(answer.displacement, theta), answer.valid

    volumes, valid = jax.vmap(predicted)(pressures)
    numpyro.factor("valid", jnp.where(jnp.all(valid), 0.0, -jnp.inf))  # outside of the learned box
    numpyro.sample("volumes", dist.Normal(volumes, 1.0), obs=data)


# %% [markdown]
# ## Draws by BlackJAX

# %%
start_key, warmup_key, sample_key = jax.random.split(jax.random.key(0), 3)
density = initialize_model(start_key, ventricle, model_args=(data,))


def log_density(z):
    """Return the log posterior density in NumPyro's unconstrained coordinates."""
    return -density.potential_fn(z)


def chain(key):
    """Return the draws of one chain of NUTS."""
    warmup_key, key = jax.random.split(key)
    warmup = blackjax.window_adaptation(blackjax.nuts, log_density, target_acceptance_rate=0.9)
    (state, parameters), _ = warmup.run(warmup_key, density.param_info.z, num_steps=300)
    step = blackjax.nuts(log_density, **parameters).step

    def draw(state, key):
        state, _ = step(key, state)
        return state, density.postprocess_fn(state.position)

    return jax.lax.scan(draw, state, jax.random.split(key, 500))[1]


start = time.perf_counter()
draws = jax.jit(lambda keys: jax.lax.map(chain, keys))(jax.random.split(sample_key, 4))
draws = {name: np.asarray(values) for name, values in draws.items()}
print(f"4 chains of 800 steps: {time.perf_counter() - start:.0f} s, compilation included")
posterior = arviz.from_dict({"posterior": draws})
summary = arviz.summary(posterior, round_to=3)
print(summary[["mean", "sd", "r_hat", "ess_bulk"]])
assert float(summary["r_hat"].astype(float).max()) < 1.05

# %% [markdown]
# Three volumes fix one combination of the two best. Which parameters does a volume see at all?
#
# ## Which parameter moves the volume?
#
# Total indices: the share of the volume's variance over the box that would be left if all other parameters were known.

# %%
indices = cal.sensitivity(trained.cache(), volume, samples=256)["volume"].to_dataset()
total = dict(zip(indices["factor"].values, indices["total"].values[:, 0], strict=True))
for name, share in total.items():
    print(f"{name:9s} {share:6.3f}")
assert total["pressure"] + total["a_f"] > 0.8

# %% [markdown]
# ## Finite elements, at draws of the posterior

# %%
rows = np.random.default_rng(0).integers(500, size=3)
for row in rows:
    one = {name: float(draws[name][0, row]) for name in draws}
    theta = scene.theta(a=one["a"], b=2.2, a_f=one["ratio"] * one["a"], b_f=2.4, pressure=1.0)
    by_fem = float(volume.evaluate(simulator(theta)[volume.nodes], theta))
    by_network = float(volume_at(theta))
    print(f"FEM {by_fem:8.3f} mL   network {by_network:8.3f} mL")
    assert abs(by_fem - by_network) < 0.1  # a tenth of the noise
