"""NumPyro's No-U-Turn sampler, all chains in one vectorised program.

A pilot run straightens the posterior (see :mod:`calibrate.samplers.shear`); the draws returned are
those of a second run from fresh starting points. Both are the same compiled program, and so are
runs on further data of the same shape: NumPyro's functional interface is used, whose ``MCMC`` class
compiles anew for every run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro.infer.hmc import hmc
from numpyro.infer.util import initialize_model
from tqdm import tqdm

from calibrate.model import Model
from calibrate.samplers import shear
from emulator.errors import InputError, SolverError

_CHUNK = 50  # iterations between two updates of the progress bar
_CANDIDATES = 16  # starting points tried, for forward maps that are not valid everywhere


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
    start: Callable  # (keys, data, map) -> states
    advance: Callable  # (states, data, map, count=) -> states, (z, statistics) by chain
    constrain: Callable  # (data, z (s, p)) -> draws by name
    dimension: int


@lru_cache(maxsize=4)
def _compiled(model: Model, options: NUTSOptions) -> _Compiled:
    """The programs of one model, in straightened coordinates; data and map are their arguments."""
    example = np.zeros_like(model.observe.points)
    info = initialize_model(jax.random.key(0), model, model_args=(example,), dynamic_args=True)
    flat, unravel = ravel_pytree(info.param_info.z)

    def potential(data: jax.Array, map_: shear.Shear) -> Callable:
        return lambda zeta: info.potential_fn(data)(unravel(shear.apply(map_, zeta)))

    init_kernel, sample_kernel = hmc(potential_fn_gen=potential, algo="NUTS")

    def start(key: jax.Array, data: jax.Array, map_: shear.Shear) -> Any:
        here, onwards = jax.random.split(key)
        candidates = jax.random.uniform(here, (_CANDIDATES, flat.size), float, -2.0, 2.0)
        heights = jax.lax.map(potential(data, map_), candidates)
        return init_kernel(
            candidates[jnp.argmax(jnp.isfinite(heights))],
            num_warmup=options.warmup,
            dense_mass=True,
            target_accept_prob=options.target_accept,
            model_args=(data, map_),
            rng_key=onwards,
        )

    def advance(state: Any, data: jax.Array, map_: shear.Shear, count: int) -> Any:
        def step(state: Any, _: None) -> Any:
            state = sample_kernel(state, (data, map_), {})
            statistics = {
                "diverging": state.diverging,
                "acceptance_rate": state.accept_prob,
                "n_steps": state.num_steps,
                "lp": -state.potential_energy,
                "energy": state.energy,
            }
            return state, (shear.apply(map_, state.z), statistics)

        return jax.lax.scan(step, state, length=count)

    chains = {"in_axes": (0, None, None)}
    return _Compiled(
        start=jax.jit(jax.vmap(start, **chains)),
        advance=jax.jit(
            lambda s, d, m, count: jax.vmap(partial(advance, count=count), **chains)(s, d, m),
            static_argnames="count",
        ),
        constrain=jax.jit(
            jax.vmap(lambda data, z: info.postprocess_fn(data)(unravel(z)), (None, 0))
        ),
        dimension=flat.size,
    )


def _run(
    compiled: _Compiled,
    data: jax.Array,
    map_: shear.Shear,
    options: NUTSOptions,
    key: jax.Array,
    bar: tqdm,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Draws of ``z`` (chains, draws, p) after warm-up, and statistics (chains, draws)."""
    states = compiled.start(jax.random.split(key, options.chains), data, map_)
    if not np.isfinite(states.potential_energy).all():
        raise SolverError("the posterior density is zero or undefined wherever a chain could start")
    kept = []
    for total, keep in ((options.warmup, False), (options.draws, True)):
        for done in range(0, total, _CHUNK):
            count = min(_CHUNK, total - done)
            states, out = compiled.advance(states, data, map_, count=count)
            if keep:
                kept.append(jax.tree.map(np.asarray, out))
            bar.update(count)
    return jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *kept)


def nuts(
    model: Model, data: jax.Array, options: NUTSOptions, seed: int, *, progress: bool = False
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws and statistics by name, each (chains, draws).

    Raises
    ------
    SolverError
        No starting point with a finite density was found.
    """
    compiled = _compiled(model, options)
    pilot, final = jax.random.split(jax.random.key(seed))
    map_ = shear.identity(compiled.dimension)
    runs = 2 if compiled.dimension > 1 else 1  # a single coordinate has nothing to be sheared by
    total = runs * (options.warmup + options.draws)
    with tqdm(total=total, desc="NUTS", disable=not progress) as bar:
        if runs == 2:
            z, _ = _run(compiled, data, map_, options, pilot, bar)
            map_ = shear.fit(z.reshape(-1, compiled.dimension))
        z, statistics = _run(compiled, data, map_, options, final, bar)
    named = compiled.constrain(data, jnp.asarray(z.reshape(-1, compiled.dimension)))
    shape = (options.chains, options.draws)
    return {name: np.asarray(named[name]).reshape(shape) for name in model.names}, statistics
