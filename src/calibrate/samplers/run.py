"""Markov chains of any kernel: starting points, warm-up, pilot, rounds, progress, checkpoint.

A pilot run straightens the posterior (:mod:`calibrate.samplers.transport`); the draws returned are
from a second run with fresh starting points. Both use the same compiled program. A density that
wants no pilot gets the second run alone.

That program is one chain's, and as many chains run at once as there are cores. Vectorised, every
transition of all chains would take as many gradients as the longest trajectory among them
(docs/experiments.md, "NUTS chains one after the other", "Chains on threads").
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from calibrate.samplers import transport
from calibrate.samplers.checkpoint import Checkpoint
from calibrate.samplers.density import Target
from calibrate.samplers.options import PATHFINDER, ChainOptions
from calibrate.samplers.pathfinder import pathfinder_start
from calibrate.samplers.protocol import Context, Draws, Kernel
from calibrate.samplers.stopping import converged
from emulator.core.errors import SolverError
from emulator.core.progress import counting

_CHUNK = 50  # iterations between two updates of the progress bar
_CANDIDATES = 16  # starting points tried, for forward maps that are not valid everywhere
_PILOT, _FINAL = 0, 1  # runs
_PILOT_DRAWS = 1000  # of all chains, that a map is fitted to; more for maps of many coefficients


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

    solves_fem: ClassVar[bool] = False

    def sample(
        self,
        density: Target,
        data: Any,
        options: Any,
        seed: int,
        context: Context = Context(),
    ) -> Draws:
        """Run rounds until the chains agree.

        A ridge cut by the prior's box may need several rounds. After the last one the chains may
        still disagree: read R-hat.

        Raises
        ------
        SolverError
            No starting point with a finite density was found.
        """
        pilot_key, key = jax.random.split(jax.random.key(seed))
        with counting(desc=self.name, total=0, disable=not context.progress) as bar:
            chains = Chains(self, density, data, options, context.checkpoint, bar)
            if not chains.resume():
                chains.start_straightened(pilot_key, key)
            elif chains.run == _PILOT:
                chains.straighten(key)
            for rounds in range(1, options.rounds + 1):
                draws = chains.draw(rounds * options.draws)
                if converged(draws.z, options.r_hat, options.ess):
                    break
        return draws


class Programs:
    """Compiled functions of one chain, for as many at once as threads may ask for a density.

    Parameters
    ----------
    start : (key, data, map) -> state, its log density.
    advance : (state, data, map, count) -> state, :class:`Draws`.
    """

    def __init__(
        self, start: Callable[..., Any], advance: Callable[..., Any], at_once: int
    ) -> None:
        self._start, self._advance, self._at_once = start, advance, at_once
        self._compiled: dict[Any, Callable[..., Any]] = {}

    def start(
        self, keys: jax.Array, data: Any, map_: transport.StandardMap
    ) -> tuple[tuple[Any, ...], np.ndarray]:
        """States of chains, by ``keys`` (c,), and their log densities (c,)."""
        begun = self._of_all("start", self._start, tuple(keys), data, map_)
        states, heights = zip(*begun, strict=True)
        return states, np.array(heights)

    def advance(
        self, states: tuple[Any, ...], data: Any, map_: transport.StandardMap, count: int
    ) -> tuple[tuple[Any, ...], Draws]:
        """``count`` iterations of all chains: their states, and draws (c, count, ...)."""
        advance = partial(self._advance, count=count)
        done = self._of_all(f"advance {count}", advance, states, data, map_)
        states, draws = zip(*done, strict=True)
        return states, jax.tree.map(lambda *chains: np.stack(chains), *draws)

    def shapes(
        self, chains: int, data: Any, map_: transport.StandardMap
    ) -> tuple[tuple[Any, ...], Draws]:
        """States and draws (c, 1, ...), as far as structure and types are concerned."""
        state, _ = jax.eval_shape(self._start, jax.random.key(0), data, map_)
        _, draws = jax.eval_shape(partial(self._advance, count=1), state, data, map_)
        every = jax.tree.map(lambda x: jax.ShapeDtypeStruct((chains, *x.shape), x.dtype), draws)
        return (state,) * chains, every

    def _of_all(
        self, name: str, function: Callable[..., Any], chains: tuple[Any, ...], *arrays: Any
    ) -> list[Any]:
        """``function`` of each chain and the arrays, compiled before threads ask for it."""
        key = name, *map(jax.typeof, jax.tree.leaves((chains[0], *arrays)))
        program = self._compiled.get(key)
        if program is None:
            program = jax.jit(function).lower(chains[0], *arrays).compile()
            self._compiled[key] = program

        def one(chain: Any) -> Any:
            return jax.block_until_ready(program(chain, *arrays))

        with ThreadPoolExecutor(min(self._at_once, len(chains))) as pool:
            return list(pool.map(one, chains))


@lru_cache(maxsize=4)
def compile_chains(sampler: ChainSampler, density: Target, options: ChainOptions) -> Programs:
    """The programs of one density in straightened coordinates; data and map are arguments."""

    def log_density(w: jax.Array, data: Any, map_: transport.StandardMap) -> jax.Array:
        return density.log_density(transport.apply_standard(map_, w), data)

    kernel = sampler.kernel(log_density, options)

    def start(key: jax.Array, data: Any, map_: transport.StandardMap) -> Any:
        here, onwards = jax.random.split(key)
        shape = (_CANDIDATES, density.dimension)
        candidates = jax.random.uniform(here, shape, float, -2.0, 2.0)

        def height(w: jax.Array) -> jax.Array:
            return log_density(w, data, map_)

        heights = jax.lax.map(height, candidates)
        if options.start == PATHFINDER:
            w = pathfinder_start(jax.random.fold_in(here, 1), height, candidates, heights)
            return kernel.init(onwards, w, data, map_), height(w)
        first = jnp.argmax(jnp.isfinite(heights))
        return kernel.init(onwards, candidates[first], data, map_), heights[first]

    def advance(state: Any, data: Any, map_: transport.StandardMap, count: int) -> Any:
        def step(state: Any, _: None) -> Any:
            state, w, statistics = kernel.step(state, data, map_)
            return state, Draws(transport.apply_standard(map_, w), statistics)

        return jax.lax.scan(step, state, length=count)

    return Programs(start, advance, density.at_once)


class _State(NamedTuple):
    """All that a run goes on from."""

    run: Any  # _PILOT or _FINAL
    warmed: Any  # iterations of warm-up done
    map_: transport.StandardMap
    states: tuple[Any, ...]
    draws: Draws


class Chains:
    """Chains under way: a pilot run, then the final one on the map fitted to it."""

    def __init__(
        self,
        sampler: ChainSampler,
        density: Target,
        data: Any,
        options: ChainOptions,
        checkpoint: Checkpoint,
        bar: tqdm,
    ) -> None:
        self.sampler, self.density, self.data, self.options = sampler, density, data, options
        self.checkpoint, self.bar = checkpoint, bar
        self.programs = compile_chains(sampler, density, options)
        self._warmup = options.warmup if sampler.adapts_in_steps else 0
        self._parts: list[Draws] = []
        wanted = max(_PILOT_DRAWS, 10 * transport.coefficient_count(density.dimension))
        # In whole chunks: a part of one would be compiled on its own.
        self._pilot = min(options.draws, -(-wanted // (options.chains * _CHUNK)) * _CHUNK)

    def start_straightened(self, pilot_key: jax.Array, key: jax.Array) -> None:
        """A pilot run, if the density wants one, and the start of the final one."""
        if self.density.piloted:
            self._start(_PILOT, self._identity(), pilot_key)
            self.straighten(key)
        else:
            self._start(_FINAL, self._identity(), key)

    def straighten(self, key: jax.Array) -> None:
        """The rest of the pilot run, and the start of the final one."""
        z = self.draw(self._pilot).z
        self._start(_FINAL, transport.fit_standard(z.reshape(-1, self.density.dimension)), key)

    def draw(self, total: int) -> Draws:
        """The first ``total`` kept iterations of this run."""
        while self.warmed < self._warmup:
            self.warmed += self._advance(self._warmup - self.warmed)[1]
            self.checkpoint.keep(self._state)
        while self._kept < total:
            draws, count = self._advance(total - self._kept)
            self._parts.append(draws)
            self._kept += count
            self.checkpoint.keep(self._state)
        return jax.tree.map(lambda array: array[:, :total], join(self._parts))

    def resume(self) -> bool:
        """Go on from the checkpoint; ``False`` where there is none."""
        state = self.checkpoint.restore(self._template)
        if state is None:
            return False
        self.run, self.warmed = int(state.run), int(state.warmed)
        self.map_, self.states = state.map_, state.states
        self._parts, self._kept = [state.draws], state.draws.z.shape[1]
        if self.run == _FINAL and self.density.piloted:
            self._show(self._warmup + self._pilot)
        self._show(self.warmed + self._kept)
        return True

    def _start(self, run: int, map_: transport.StandardMap, key: jax.Array) -> None:
        keys = jax.random.split(key, self.options.chains)
        self.states, heights = self.programs.start(keys, self.data, map_)
        if not np.isfinite(heights).all():
            raise SolverError("the posterior density is zero wherever a chain could start")
        self.run, self.map_, self.warmed = run, map_, 0
        self._parts, self._kept = [], 0

    def _advance(self, wanted: int) -> tuple[Draws, int]:
        count = min(_CHUNK, wanted)
        self.states, draws = self.programs.advance(self.states, self.data, self.map_, count)
        self._show(count)
        return draws, count

    def _show(self, count: int) -> None:
        pilot = self._warmup + self._pilot if self.density.piloted else 0
        planned = pilot + self._warmup + self.options.draws
        self.bar.total = max(self.bar.total, planned, self.bar.n + count)
        self.bar.update(count)

    def _state(self) -> _State:
        # While they warm up, chains have no draws, but their names and shapes are known.
        draws = join(self._parts) if self._parts else jax.tree.map(_none, self._template().draws)
        return _State(self.run, self.warmed, self.map_, self.states, draws)

    def _identity(self) -> transport.StandardMap:
        return transport.standard_identity(self.density.dimension, bends=self.density.piloted)

    def _template(self) -> _State:
        number = jax.ShapeDtypeStruct((), int)
        map_ = self._identity()
        states, draws = self.programs.shapes(self.options.chains, self.data, map_)
        return _State(number, number, map_, states, draws)


def _none(draws: jax.ShapeDtypeStruct) -> np.ndarray:
    return np.zeros((draws.shape[0], 0, *draws.shape[2:]), draws.dtype)


def join(parts: list[Draws]) -> Draws:
    """Draws one after the other."""
    return jax.tree.map(lambda *arrays: np.concatenate(arrays, axis=1), *parts)
