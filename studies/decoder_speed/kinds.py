"""What each kind of observation costs, and how fast samplers draw from its posterior."""

import time
from collections.abc import Callable
from typing import Any

import arviz
import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer import MCMC, NUTS
from studies.common.timing import milliseconds, per_call

import calibrate as cal
import emulator as em
from calibrate.measurements import parse_observation
from calibrate.samplers import SAMPLERS, density_of
from calibrate.statistical_model import Data, Model

SCENE = "left_ventricle"
KINDS: dict[str, dict[str, float]] = {
    "landmarks:24": {"displacement": 0.3},
    "volume": {"volume": 1.0},
    "strain:fibre:10": {"strain": 0.02},
    "landmarks:24+volume": {"displacement": 0.3, "volume": 1.0},
}
CHAINS = 2
OURS = ("importance", "nuts", "blackjax_nuts")


def problem(observe: str, noise: dict[str, float], seed: int) -> tuple[Model, dict[str, Any]]:
    """The model of an observation, and data of it with noise, at a theta near the centre."""
    forward = em.load(SCENE).cache()
    scene = forward.scene
    parts = parse_observation(scene, observe, seed)
    levels = {name: cal.GaussianNoise(sd=noise[name]) for name in parts.parts}
    model = cal.model(forward, parts, levels)
    truth = scene.from_unit(jnp.full(len(scene.parameters), 0.4))
    exact = parts(forward.at(parts.nodes)(truth)[None], truth[None])
    rng = np.random.default_rng(seed)
    data = {
        name: np.asarray(exact[name]) + noise[name] * rng.normal(size=parts.shapes[name])
        for name in parts.parts
    }
    return model, data


def gradient_s(model: Model, data: Data, count: int, seed: int) -> float:
    """Seconds of one value and gradient of the log posterior, in a compiled loop."""
    density = density_of(model)
    value = jax.value_and_grad(lambda z: density.log_density(z, data))
    keys = jax.random.split(jax.random.key(seed), 6 * count).reshape(6, count)
    points = jax.vmap(jax.vmap(density.prior_draw))(keys)

    @jax.jit
    def every(points: jax.Array) -> jax.Array:
        def step(total: jax.Array, z: jax.Array) -> tuple[jax.Array, None]:
            found, slope = value(z)
            return total + found + slope.sum(), None

        return jax.lax.scan(step, jnp.zeros(()), points)[0]

    return per_call(every, points) / count


def by_ours(sampler: str, model: Model, data: dict[str, Any], draws: int, seed: int) -> np.ndarray:
    """Draws (chains, s, p) of one of our samplers, a fixed number of them."""
    length = {"draws": draws, "chains": CHAINS, "rounds": 1}
    if sampler != "importance":
        length["warmup"] = draws
    given = SAMPLERS[sampler].options(**length)
    told = cal.sample(model, data, sampler=sampler, options=given, seed=seed, predictions=False)
    return np.stack([told.tree["posterior"][name].values for name in model.names], axis=-1)


def by_numpyro(model: Model, data: Data, draws: int) -> Callable[[int], np.ndarray]:
    """NumPyro's own NUTS with a dense metric, chains one after the other; compiled once."""
    run = MCMC(
        NUTS(model, dense_mass=True), num_warmup=draws, num_samples=draws, num_chains=CHAINS,
        chain_method="sequential", progress_bar=False,
    )  # fmt: skip

    def draw(seed: int) -> np.ndarray:
        run.run(jax.random.key(seed), data)
        found = run.get_samples(group_by_chain=True)
        return np.stack([np.asarray(found[name]) for name in model.names], axis=-1)

    return draw


def study(kinds: int, draws: int, loop: int, seed: int) -> list[dict[str, Any]]:
    """A case for each of the first ``kinds`` observations: seconds of a gradient, and effective
    draws of the slowest parameter by processor second and sampler.
    """
    cases = []
    for observe, noise in list(KINDS.items())[:kinds]:
        model, data = problem(observe, noise, seed)
        checked = model.check_data(data)
        samplers: dict[str, Callable[[int], np.ndarray]] = {
            name: lambda s, n=name, m=model, d=data: by_ours(n, m, d, draws, s) for name in OURS
        } | {
            "NumPyro's NUTS": by_numpyro(model, checked, draws),
        }
        one = gradient_s(model, checked, loop, seed)
        case: dict[str, Any] = {
            "name": f"observed: {observe}", "status": "done",
            "observed_nodes": len(model.observe.nodes), "gradient_s": one, "samplers": {},
        }  # fmt: skip
        for name, draw in samplers.items():
            draw(seed)  # compiles
            begin = time.process_time()
            found = draw(seed + 1)
            seconds = time.process_time() - begin
            each = [float(arviz.ess(found[..., k])) for k in range(found.shape[-1])]
            case["samplers"][name] = {"ess": min(each), "processor_s": round(seconds, 2)}
        told = ", ".join(
            f"{name} {row['ess'] / row['processor_s']:.0f}"
            for name, row in case["samplers"].items()
        )
        print(f"{case['name']:34s} gradient {milliseconds(one)}; ESS/s: {told}", flush=True)
        cases.append(case)
    return cases
