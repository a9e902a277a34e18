"""NumPyro's No-U-Turn sampler, all chains in one vectorised program.

A pilot run straightens the posterior (see :mod:`calibrate.samplers.shear`); the draws returned are
those of a second run from fresh starting points. Both are the same compiled program, and so are
runs on further data of the same shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax.flatten_util import ravel_pytree
from numpyro.distributions import constraints
from numpyro.infer import MCMC, NUTS, init_to_uniform
from numpyro.infer.util import initialize_model

from calibrate.model import Model
from calibrate.samplers import shear
from emulator.errors import InputError

_STATS = ("diverging", "accept_prob", "num_steps", "potential_energy", "energy")
_NAMES = {"accept_prob": "acceptance_rate", "num_steps": "n_steps", "potential_energy": "lp"}


@dataclass(frozen=True)
class NUTSOptions:
    """Length of a run; the pilot is equally long."""

    warmup: int = 500
    draws: int = 1000
    chains: int = 4
    target_accept: float = 0.85

    def __post_init__(self) -> None:
        for name in ("warmup", "draws", "chains"):
            if getattr(self, name) < 1:
                raise InputError(f"NUTS: {name} is {getattr(self, name)}; it must be 1 or more")
        if not 0.0 < self.target_accept < 1.0:
            raise InputError(f"NUTS: target_accept is {self.target_accept}; give one in (0, 1)")


class _Compiled(NamedTuple):
    mcmc: MCMC
    constrain: Any  # (data, z (s, p)) -> draws by name
    dimension: int


@lru_cache(maxsize=4)
def _compiled(model: Model, options: NUTSOptions, progress: bool) -> _Compiled:
    """One MCMC object a model, in straightened coordinates."""
    example = np.zeros_like(model.observe.points)
    info = initialize_model(jax.random.key(0), model, model_args=(example,), dynamic_args=True)
    flat, unravel = ravel_pytree(info.param_info.z)

    def program(data: jax.Array, map_: shear.Shear) -> None:
        improper = dist.ImproperUniform(constraints.real_vector, (), flat.shape)
        zeta = numpyro.sample("zeta", improper)
        z = numpyro.deterministic("z", shear.apply(map_, zeta))
        with numpyro.handlers.block():  # the model's own sites are not this program's
            density = -info.potential_fn(data)(unravel(z))
        numpyro.factor("density", density)

    kernel = NUTS(
        program,
        dense_mass=True,
        target_accept_prob=options.target_accept,
        init_strategy=init_to_uniform(),
    )
    mcmc = MCMC(
        kernel,
        num_warmup=options.warmup,
        num_samples=options.draws,
        num_chains=options.chains,
        chain_method="vectorized",
        progress_bar=progress,
        jit_model_args=True,
    )
    constrain = jax.jit(jax.vmap(lambda data, z: info.postprocess_fn(data)(unravel(z)), (None, 0)))
    return _Compiled(mcmc, constrain, flat.size)


def nuts(
    model: Model, data: jax.Array, options: NUTSOptions, seed: int, *, progress: bool = False
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws and statistics by name, each (chains, draws)."""
    mcmc, constrain, dimension = _compiled(model, options, progress)
    pilot, final = jax.random.split(jax.random.key(seed))
    map_ = shear.identity(dimension)
    if dimension > 1:
        mcmc.run(pilot, data, map_, extra_fields=_STATS)
        map_ = shear.fit(np.asarray(mcmc.get_samples()["z"]))
    mcmc.run(final, data, map_, extra_fields=_STATS)
    named = constrain(data, mcmc.get_samples()["z"])
    shape = (options.chains, options.draws)
    draws = {name: np.asarray(named[name]).reshape(shape) for name in model.names}
    extra = mcmc.get_extra_fields(group_by_chain=True)
    stats = {_NAMES.get(name, name): np.asarray(extra[name]) for name in _STATS}
    stats["lp"] = -stats["lp"]
    return draws, stats
