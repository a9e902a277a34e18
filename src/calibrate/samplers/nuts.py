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
from arviz_stats.base import array_stats
from jax.flatten_util import ravel_pytree
from numpyro.infer.hmc import hmc
from numpyro.infer.util import initialize_model
from tqdm import tqdm

from calibrate.samplers import shear
from calibrate.statistical_model import Data, Model
from emulator.errors import InputError, SolverError

_CHUNK = 50  # iterations between two updates of the progress bar
_CANDIDATES = 16  # starting points tried, for forward maps that are not valid everywhere


@dataclass(frozen=True)
class NUTSOptions:
    """Length of a run.

    warmup : iterations that adapt, not kept.
    draws : kept iterations of a round; the pilot has one round.
    chains : all in one program.
    rounds : at most so many, the last one begun when R-hat or ESS ask for it.
    r_hat, ess : largest R-hat and smallest bulk and tail ESS of any parameter to stop at.
    """

    warmup: int = 500
    draws: int = 1000
    chains: int = 4
    rounds: int = 8
    r_hat: float = 1.008
    ess: float = 400.0
    target_accept: float = 0.85

    def __post_init__(self) -> None:
        for name in ("warmup", "draws", "chains", "rounds"):
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
    example = {name: np.zeros(shape) for name, shape in model.observe.shapes.items()}
    info = initialize_model(jax.random.key(0), model, model_args=(example,), dynamic_args=True)
    flat, unravel = ravel_pytree(info.param_info.z)

    def potential(data: Data, map_: shear.Shear) -> Callable:
        return lambda zeta: info.potential_fn(data)(unravel(shear.apply(map_, zeta)))

    init_kernel, sample_kernel = hmc(potential_fn_gen=potential, algo="NUTS")

    def start(key: jax.Array, data: Data, map_: shear.Shear) -> Any:
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

    def advance(state: Any, data: Data, map_: shear.Shear, count: int) -> Any:
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

    axes = (0, None, None)  # chains differ in key and state, not in data or map
    return _Compiled(
        start=jax.jit(jax.vmap(start, axes)),
        advance=jax.jit(
            lambda s, d, m, count: jax.vmap(partial(advance, count=count), axes)(s, d, m),
            static_argnames="count",
        ),
        constrain=jax.jit(
            jax.vmap(lambda data, z: info.postprocess_fn(data)(unravel(z)), (None, 0))
        ),
        dimension=flat.size,
    )


class _Chains:
    """Chains under way: their states, the data and the map they run on."""

    def __init__(
        self,
        compiled: _Compiled,
        data: Data,
        map_: shear.Shear,
        key: jax.Array,
        options: NUTSOptions,
        bar: tqdm,
    ) -> None:
        self.compiled, self.arguments, self.bar = compiled, (data, map_), bar
        self.states = compiled.start(jax.random.split(key, options.chains), data, map_)
        if not np.isfinite(self.states.potential_energy).all():
            raise SolverError("the posterior density is zero wherever a chain could start")
        self.advance(options.warmup)

    def advance(self, total: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """``z`` (chains, total, p) and statistics (chains, total) of the next iterations."""
        kept = []
        for done in range(0, total, _CHUNK):
            count = min(_CHUNK, total - done)
            self.states, out = self.compiled.advance(self.states, *self.arguments, count=count)
            kept.append(jax.tree.map(np.asarray, out))
            self.bar.update(count)
        return _join(kept)


def _join(parts: list[Any]) -> Any:
    return jax.tree.map(lambda *arrays: np.concatenate(arrays, axis=1), *parts)


def _agree(draws: dict[str, np.ndarray], options: NUTSOptions) -> bool:
    """Whether the chains agree on every parameter and hold enough information on each."""
    axes = {"chain_axis": 0, "draw_axis": 1}
    for values in draws.values():
        if not array_stats.rhat(values, **axes) <= options.r_hat:
            return False
        bulk = array_stats.ess(values, method="bulk", **axes)
        tail = array_stats.ess(values, method="tail", prob=(0.05, 0.95), **axes)
        if not min(bulk, tail) >= options.ess:
            return False
    return True


def nuts(
    model: Model, data: Data, options: NUTSOptions, seed: int, *, progress: bool = False
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws and statistics by name, each (chains, draws).

    Chains go on, round after round, until they agree; where the prior's box cuts a ridge they need
    a few. Read R-hat all the same: after the last round they may still not.

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
            z, _ = _Chains(compiled, data, map_, pilot, options, bar).advance(options.draws)
            map_ = shear.fit(z.reshape(-1, compiled.dimension))
        chains, kept = _Chains(compiled, data, map_, final, options, bar), []
        for _ in range(options.rounds):
            kept.append(chains.advance(options.draws))
            z, statistics = _join(kept)
            named = compiled.constrain(data, jnp.asarray(z.reshape(-1, compiled.dimension)))
            draws = {name: np.asarray(named[name]).reshape(z.shape[:2]) for name in model.names}
            if options.chains > 1 and _agree(draws, options):
                break
            bar.total += options.draws
    return draws, statistics
