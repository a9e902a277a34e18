"""Samplers on one density: ours, NumPyro's, and BlackJAX's NUTS and nested slice sampling."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import arviz
import blackjax
import blackjax.ns.utils
import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer import MCMC, NUTS
from scipy.special import logsumexp
from scipy.stats import multivariate_t
from studies.common.timing import per_call

import calibrate as cal
from calibrate.statistical_model import Data, Model
from calibrate.statistical_model.density import density_of, heights, prior_draws

CHAINS = 4
FREEDOM = 5.0  # of the reference's proposal, a Student t
OF_PRIOR = 0.3  # share of the reference's points that are drawn from the prior
MOST_NESTED_STEPS = 4000
NUMPYRO = "NumPyro's NUTS"


class Drawn(NamedTuple):
    """Draws (chains, s, p) of the unknowns, and how many of each are worth one independent draw."""

    draws: np.ndarray
    inflation: float = 1.0


Way = Callable[[int], Drawn]
"""Draws by seed; compiled at the first call."""


def _ours(sampler: str, model: Model, data: dict[str, Any], count: int) -> Way:
    length = {"draws": count, "chains": CHAINS, "rounds": 1}
    if sampler != "importance":
        length["warmup"] = count
    options = cal.SAMPLERS[sampler].options(**length)

    def draw(seed: int) -> Drawn:
        tree = cal.sample(
            model, data, sampler=sampler, options=options, seed=seed, predictions=False
        ).tree
        found = np.stack([tree["posterior"][name].values for name in model.names], axis=-1)
        # Of weighted points, the variance of the points adds to that of the choice among them.
        points = tree.attrs.get("effective_points", np.inf)
        return Drawn(found, 1.0 + CHAINS * count / points)

    return draw


def _numpyro(model: Model, data: Data, count: int) -> Way:
    run = MCMC(
        NUTS(model, dense_mass=True), num_warmup=count, num_samples=count, num_chains=CHAINS,
        chain_method="sequential", progress_bar=False,
    )  # fmt: skip

    def draw(seed: int) -> Drawn:
        run.run(jax.random.key(seed), data)
        found = run.get_samples(group_by_chain=True)
        return Drawn(np.stack([np.asarray(found[name]) for name in model.names], axis=-1))

    return draw


def _named(model: Model, z: jax.Array) -> np.ndarray:
    """Return values (..., p) of the unknowns at coordinates z (..., p)."""
    found = density_of(model).constrain(z.reshape(-1, z.shape[-1]))
    columns = [np.asarray(found[name]) for name in model.names]
    return np.stack(columns, axis=-1).reshape(z.shape)


def _blackjax_nuts(model: Model, data: Data, count: int) -> Way:
    """BlackJAX's own window adaptation with a dense metric, chains one after the other."""
    density = density_of(model)

    def chain(key: jax.Array) -> jax.Array:
        def log_density(z: jax.Array) -> jax.Array:
            return density.log_density(z, data)

        start, adapt, run = jax.random.split(key, 3)
        warmup = blackjax.window_adaptation(
            blackjax.nuts, log_density, is_mass_matrix_diagonal=False
        )
        (state, parameters), _ = warmup.run(adapt, density.prior_draw(start), num_steps=count)
        kernel = blackjax.nuts(log_density, **parameters)

        def step(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            state, _ = kernel.step(key, state)
            return state, state.position

        return jax.lax.scan(step, state, jax.random.split(run, count))[1]

    program = jax.jit(lambda keys: jax.lax.map(chain, keys))
    return lambda seed: Drawn(
        _named(model, program(jax.random.split(jax.random.key(seed), CHAINS)))
    )


def _nested(model: Model, data: Data, count: int) -> Way:
    """BlackJAX's nested slice sampling: as many live points as draws, a tenth replaced a step."""
    density = density_of(model)
    live = count
    nested = blackjax.nss(
        density.log_prior,
        lambda z: density.log_likelihood(z, data),
        num_delete=live // 10,
        num_inner_steps=5 * density.dimension,
    )
    begin, step = jax.jit(nested.init), jax.jit(nested.step)

    def draw(seed: int) -> Drawn:
        first, key = jax.random.split(jax.random.key(seed))
        state = begin(jax.vmap(density.prior_draw)(jax.random.split(first, live)))
        dead = []
        for _ in range(MOST_NESTED_STEPS):
            key, this = jax.random.split(key)
            state, info = step(this, state)
            dead.append(info)
            integrator = state.integrator
            if float(integrator.logZ_live - integrator.logZ) < -3.0:
                break
        weigh = jax.random.fold_in(key, 1)
        ended = blackjax.ns.utils.finalise(state, dead, update_info=False)
        weights = blackjax.ns.utils.log_weights(weigh, ended).mean(axis=-1)
        weights = np.asarray(jnp.exp(weights - jnp.max(weights)))
        worth = weights.sum() ** 2 / (weights**2).sum()
        rows = np.random.default_rng(seed).choice(
            len(weights), CHAINS * count, p=weights / weights.sum()
        )
        found = _named(model, ended.particles.position)[rows]
        return Drawn(found.reshape(CHAINS, count, -1), 1.0 + CHAINS * count / worth)

    return draw


def ways(model: Model, data: dict[str, Any], count: int) -> dict[str, Way]:
    """Return the samplers by name, each for ``count`` draws of four chains."""
    checked = model.check_data(data)
    return {
        **{name: _ours(name, model, data, count) for name in ("importance", "nuts")},
        NUMPYRO: _numpyro(model, checked, count),
        "BlackJAX's NUTS": _blackjax_nuts(model, checked, count),
        "BlackJAX's nested sampling": _nested(model, checked, count),
    }


class Moments(NamedTuple):
    """Means and sds of the unknowns, each (p,), with their standard errors."""

    mean: np.ndarray
    sd: np.ndarray
    mean_error: np.ndarray
    sd_error: np.ndarray


def moments(drawn: Drawn) -> Moments:
    """Return the moments of draws, with Markov chain standard errors."""
    draws = drawn.draws
    columns = [draws[..., k] for k in range(draws.shape[-1])]
    errors = [[float(arviz.mcse(x, method=method)) for x in columns] for method in ("mean", "sd")]
    inflated = np.sqrt(drawn.inflation) * np.array(errors)
    return Moments(draws.mean(axis=(0, 1)), draws.std(axis=(0, 1)), *inflated)


def effective(drawn: Drawn) -> float:
    """Return the smallest number of independent draws that those of an unknown are worth."""
    draws = drawn.draws
    return min(float(arviz.ess(draws[..., k])) for k in range(draws.shape[-1])) / drawn.inflation


def reference(model: Model, data: dict[str, Any], like: np.ndarray, count: int) -> Moments:
    """Return moments by importance sampling of the whole prior, another way than any sampler's.

    The proposal is the prior and a Student t with the mean and covariance of the draws ``like``
    (..., p), in unconstrained coordinates. Errors are those of a ratio of two means.
    """
    density = density_of(model)
    columns = like.reshape(-1, like.shape[-1]).T
    named = dict(zip(model.names, map(jnp.asarray, columns), strict=True))
    at = np.asarray(jax.vmap(density.unconstrain)(named))
    at = at[np.isfinite(at).all(axis=1)]
    student = multivariate_t(at.mean(axis=0), 1.5 * np.cov(at, rowvar=False), df=FREEDOM, seed=1)
    of_prior = int(OF_PRIOR * count)
    z = np.concatenate(
        [
            prior_draws(density, jax.random.key(1), of_prior),
            student.rvs(count - of_prior).reshape(count - of_prior, -1),
        ]
    )
    found = heights(density, z, model.check_data(data))
    proposal = np.logaddexp(np.log(OF_PRIOR) + found.prior, np.log1p(-OF_PRIOR) + student.logpdf(z))
    log_weights = found.prior + found.likelihood - proposal
    weights = np.exp(log_weights - logsumexp(log_weights))
    values = _named(model, jnp.asarray(z))
    weights, values = weights[weights > 0.0], values[weights > 0.0]
    mean = weights @ values
    away = values - mean
    sd = np.sqrt(weights @ away**2)
    mean_error = np.sqrt(weights**2 @ away**2)
    sd_error = np.sqrt(weights**2 @ (away**2 - sd**2) ** 2) / (2.0 * sd)
    return Moments(mean, sd, mean_error, sd_error)


def gradient_s(model: Model, data: dict[str, Any], count: int = 2000) -> float:
    """Return the seconds of one value and gradient of the log posterior, in a compiled loop."""
    density, checked = density_of(model), model.check_data(data)
    value = jax.value_and_grad(lambda z: density.log_density(z, checked))
    keys = jax.random.split(jax.random.key(2), 6 * count).reshape(6, count)

    @jax.jit
    def every(points: jax.Array) -> jax.Array:
        def step(total: jax.Array, z: jax.Array) -> tuple[jax.Array, None]:
            found, slope = value(z)
            return total + found + slope.sum(), None

        return jax.lax.scan(step, jnp.zeros(()), points)[0]

    return per_call(every, jax.vmap(jax.vmap(density.prior_draw))(keys)) / count


def timed(way: Way, seed: int) -> tuple[Drawn, float]:
    """Return a second run's draws and processor seconds; the first one compiles."""
    way(seed)
    begin = time.process_time()
    return way(seed + 1), time.process_time() - begin
