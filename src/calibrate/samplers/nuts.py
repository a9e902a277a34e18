"""NumPyro's No-U-Turn sampler, all chains in one vectorised program."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import jax
import numpy as np
from numpyro.infer import MCMC, NUTS, init_to_sample

from calibrate.model import Model

_STATS = ("diverging", "accept_prob", "num_steps", "potential_energy", "energy")


@dataclass(frozen=True)
class NUTSOptions:
    """Length of a run; the metric is dense, since elastic parameters trade off against each other."""

    warmup: int = 1000
    draws: int = 1000
    chains: int = 4
    target_accept: float = 0.9


@lru_cache(maxsize=4)
def _compiled(model: Model, options: NUTSOptions, progress: bool) -> MCMC:
    """One MCMC object a model: further data of the same shape need no compilation."""
    kernel = NUTS(
        model,
        dense_mass=True,
        target_accept_prob=options.target_accept,
        init_strategy=init_to_sample,
    )
    return MCMC(
        kernel,
        num_warmup=options.warmup,
        num_samples=options.draws,
        num_chains=options.chains,
        chain_method="vectorized",
        progress_bar=progress,
        jit_model_args=True,
    )


def nuts(
    model: Model, data: jax.Array, options: NUTSOptions, seed: int, *, progress: bool = False
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws and statistics by name, each (chains, draws)."""
    mcmc = _compiled(model, options, progress)
    mcmc.run(jax.random.key(seed), data, extra_fields=_STATS)
    samples = mcmc.get_samples(group_by_chain=True)
    draws = {name: np.asarray(samples[name]) for name in model.names}
    extra = mcmc.get_extra_fields(group_by_chain=True)
    names = {"accept_prob": "acceptance_rate", "num_steps": "n_steps", "potential_energy": "lp"}
    stats = {names.get(name, name): np.asarray(extra[name]) for name in _STATS}
    stats["lp"] = -stats["lp"]
    return draws, stats
