"""Markov chains of any kernel: starting points, warm-up, pilot, rounds and progress.

A pilot run straightens the posterior (:mod:`calibrate.samplers.transport`); the draws returned are
from a second run with fresh starting points. Both use the same compiled program.

Chains run one after the other inside that program. Vectorised, every transition of all chains would
take as many gradients as the longest trajectory among them (docs/experiments.md, "NUTS chains one
after the other").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from calibrate.samplers import transport
from calibrate.samplers.density import Density
from calibrate.samplers.options import ChainOptions
from calibrate.samplers.protocol import Draws, Kernel
from calibrate.samplers.stopping import converged
from calibrate.statistical_model import Data
from emulator.errors import SolverError

_CHUNK = 50  # iterations between two updates of the progress bar
_CANDIDATES = 16  # starting points tried, for forward maps that are not valid everywhere


@dataclass(frozen=True)
class ChainSampler:
    """A sampler made of a kernel; see :class:`~calibrate.samplers.protocol.Sampler`.

    kernel : (log_density(position, *arguments), options) -> :class:`Kernel`.
    adapts_in_steps : whether the first ``options.warmup`` steps adapt; otherwise ``init`` adapts.
    """

    name: str
    options: type[Any]
    statistics: tuple[str, ...]
    kernel: Callable[[Callable[..., jax.Array], Any], Kernel]
    adapts_in_steps: bool = True

    def sample(
        self, density: Density, data: Data, options: Any, seed: int, *, progress: bool = False
    ) -> Draws:
        """Run rounds until the chains agree.

        A ridge cut by the prior's box may need several rounds. After the last one the chains may
        still disagree: read R-hat.

        Raises
        ------
        SolverError
            No starting point with a finite density was found.
        """
        programs = _compile(self, density, options)
        pilot_key, key = jax.random.split(jax.random.key(seed))
        map_ = transport.identity(density.dimension)
        # A single coordinate has no other one to depend on: no pilot.
        runs = 2 if density.dimension > 1 else 1
        total = runs * (options.warmup + options.draws)
        with tqdm(total=total, desc=self.name, disable=not progress) as bar:
            if runs == 2:
                pilot = _Chains(self, programs, data, map_, pilot_key, options, bar)
                z = pilot.advance(options.draws).z
                map_ = transport.fit(z.reshape(-1, density.dimension))
            chains = _Chains(self, programs, data, map_, key, options, bar)
            draws = chains.advance(options.draws)
            for _ in range(options.rounds - 1):
                if converged(draws.z, options.r_hat, options.ess):
                    break
                bar.total += options.draws
                draws = _join([draws, chains.advance(options.draws)])
        return draws


class _Programs(NamedTuple):
    start: Callable[..., Any]  # (keys, data, map) -> states, their log densities
    advance: Callable[..., Any]  # (states, data, map, count=) -> states, Draws


@lru_cache(maxsize=4)
def _compile(sampler: ChainSampler, density: Density, options: ChainOptions) -> _Programs:
    """The programs of one density in straightened coordinates; data and map are arguments."""

    def log_density(zeta: jax.Array, data: Data, map_: transport.TransportMap) -> jax.Array:
        return density.log_density(transport.apply(map_, zeta), data)

    kernel = sampler.kernel(log_density, options)

    def start(key: jax.Array, data: Data, map_: transport.TransportMap) -> Any:
        here, onwards = jax.random.split(key)
        shape = (_CANDIDATES, density.dimension)
        candidates = jax.random.uniform(here, shape, float, -2.0, 2.0)
        heights = jax.lax.map(lambda zeta: log_density(zeta, data, map_), candidates)
        first = jnp.argmax(jnp.isfinite(heights))
        return kernel.init(onwards, candidates[first], data, map_), heights[first]

    def advance(state: Any, data: Data, map_: transport.TransportMap, count: int) -> Any:
        def step(state: Any, _: None) -> Any:
            state, zeta, statistics = kernel.step(state, data, map_)
            return state, Draws(transport.apply(map_, zeta), statistics)

        return jax.lax.scan(step, state, length=count)

    def start_all(keys: jax.Array, data: Data, map_: transport.TransportMap) -> Any:
        return jax.lax.map(lambda key: start(key, data, map_), keys)

    def advance_all(states: Any, data: Data, map_: transport.TransportMap, count: int) -> Any:
        return jax.lax.map(partial(advance, data=data, map_=map_, count=count), states)

    return _Programs(jax.jit(start_all), jax.jit(advance_all, static_argnames="count"))


class _Chains:
    """Chains under way: their states, and the data and map they run on."""

    def __init__(
        self,
        sampler: ChainSampler,
        programs: _Programs,
        data: Data,
        map_: transport.TransportMap,
        key: jax.Array,
        options: ChainOptions,
        bar: tqdm,
    ) -> None:
        self.programs, self.arguments, self.bar = programs, (data, map_), bar
        keys = jax.random.split(key, options.chains)
        self.states, heights = programs.start(keys, *self.arguments)
        if not np.isfinite(heights).all():
            raise SolverError("the posterior density is zero wherever a chain could start")
        if sampler.adapts_in_steps:
            self.advance(options.warmup)
        else:
            bar.update(options.warmup)

    def advance(self, total: int) -> Draws:
        """The next ``total`` iterations."""
        parts = []
        for done in range(0, total, _CHUNK):
            count = min(_CHUNK, total - done)
            self.states, draws = self.programs.advance(self.states, *self.arguments, count=count)
            parts.append(jax.tree.map(np.asarray, draws))
            self.bar.update(count)
        return _join(parts)


def _join(parts: list[Draws]) -> Draws:
    return jax.tree.map(lambda *arrays: np.concatenate(arrays, axis=1), *parts)
