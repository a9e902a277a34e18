"""Starting points by multi-path Pathfinder (Zhang et al. 2022), BlackJAX's.

Quasi-Newton paths climb from several points; the best Gaussian on each path is sampled, and one of
all samples is drawn with probability proportional to posterior over Gaussian. Chains then start in
the posterior's bulk, and in its modes about as often as their masses ask, where a random start may
be far out or have density zero.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

_PATHS = 4  # of a chain
_SAMPLES = 20  # of a Gaussian
_ITERATIONS = 30
_MEMORY = 6  # pairs of steps and gradients that make a Gaussian's covariance


def pathfinder_start(
    rng_key: jax.Array,
    log_density: Callable[[jax.Array], jax.Array],
    candidates: jax.Array,
    heights: jax.Array,
) -> jax.Array:
    """A starting point (p,), one of ``candidates`` where no path leads anywhere.

    Parameters
    ----------
    candidates, heights : (c, p), c of 4 or more, and their log densities (c,). Paths begin at the
        first ones with a finite density.
    """
    from blackjax.vi.multipathfinder import multi_approximate  # here: others need not wait for it

    path_key, choice_key = jax.random.split(rng_key)
    finite_first = jnp.argsort(~jnp.isfinite(heights), stable=True)
    found, _ = multi_approximate(
        path_key,
        log_density,
        candidates[finite_first[:_PATHS]],
        _SAMPLES,
        maxiter=_ITERATIONS,
        maxcor=_MEMORY,
    )
    samples = found.samples.reshape(-1, candidates.shape[1])
    log_ratios = (found.logp - found.logq).ravel()
    usable = jnp.isfinite(log_ratios) & jnp.isfinite(found.logp.ravel())
    chosen = jax.random.categorical(choice_key, jnp.where(usable, log_ratios, -jnp.inf))
    return jnp.where(jnp.any(usable), samples[chosen], candidates[finite_first[0]])
