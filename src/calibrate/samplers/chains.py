"""Markov chains of any kernel: starting points, warm-up, pilot, rounds, progress, checkpoint.

A pilot run straightens the posterior (:mod:`calibrate.importance.transport`); the draws returned
are from a second run with fresh starting points. Both use the same compiled program. A density that
wants no pilot gets the second run alone.

That program is one chain's, and as many chains run at once as there are cores. Vectorised, every
transition of all chains would take as many gradients as the longest trajectory among them
(docs/experiments.md, "NUTS chains one after the other", "Chains on threads").

A pilot run tells too little of many unknowns. There the chains run in coordinates that are white
at a mode (:func:`calibrate.samplers.modes.white_at_mode`), where there is one.

Chains start at random points, within two units of the centre.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.importance.transport import (
    StandardMap,
    apply_standard,
    coefficient_count,
    fit_standard,
    standard_identity,
)
from calibrate.samplers.modes import white_at_mode
from calibrate.samplers.protocol import ChainOptions, Context, Draws, Kernel, Sampler, in_rounds
from calibrate.statistical_model.density import Density, Target, prior_draws
from emulator.core.display import counting
from emulator.core.errors import SolverError
from emulator.core.kept import kept

_CHUNK = 50  # iterations at most between two updates of the progress bar
_SHOWN = 5.0  # seconds between them, where iterations are slow
_MANY_STEPS = 200  # gradients of an iteration from which the progress bar names them
_CANDIDATES = 16  # starting points tried, for forward maps that are not valid everywhere
_PILOT, _FINAL = 0, 1  # runs
_STARTS = 3  # draws of the prior from which a mode is searched
_PILOT_DRAWS = 1000  # draws of all chains to which a map is fitted; large maps take more

States = tuple[Any, ...]
"""The state of each chain's kernel."""


@dataclass(frozen=True)
class ChainSampler(Sampler):
    """A sampler made of a kernel.

    kernel : the function of a log density and the options that returns a :class:`Kernel`. The log
        density takes a position and further arguments.
    adapts_in_steps : whether the first ``options.warmup`` steps adapt; otherwise ``init`` adapts.
    """

    kernel: Callable[[Callable[..., jax.Array], Any], Kernel]
    adapts_in_steps: bool = True

    def sample(self, density: Target, data: Any, options: ChainOptions, context: Context) -> Draws:
        """Run rounds until the chains agree.

        A ridge cut by the prior's box may need several rounds. After the last one the chains may
        still disagree: read R-hat.

        Raises
        ------
        SolverError
            No starting point has a finite density.
        """
        chains = Chains(self, density, data, options, context)
        with chains.bar:
            chains.begin(jax.random.key(context.seed))
            return in_rounds(chains.draw, options)


class Programs:
    """Compiled functions of one chain, for as many at once as threads may evaluate a density.

    Parameters
    ----------
    start : (key, data, map) -> state, its log density.
    advance : (state, data, map, count) -> state, :class:`Draws` of which ``count`` rows count.
    """

    def __init__(
        self, start: Callable[..., Any], advance: Callable[..., Any], at_once: int
    ) -> None:
        self._start, self._advance, self._at_once = start, advance, at_once
        self._compiled: dict[Any, Callable[..., Any]] = {}

    def start(self, keys: jax.Array, data: Any, map_: StandardMap) -> tuple[States, np.ndarray]:
        """Return states of chains, by ``keys`` (c,), and their log densities (c,)."""
        results = self._for_all("start", self._start, tuple(keys), data, map_)
        states, heights = zip(*results, strict=True)
        return states, np.array(heights)

    def advance(
        self, states: States, data: Any, map_: StandardMap, count: int
    ) -> tuple[States, Draws]:
        """Return all chains' states after ``count`` iterations, and draws (c, count, ...)."""
        results = self._for_all("advance", self._advance, states, data, map_, jnp.array(count))
        states, draws = zip(*results, strict=True)
        return states, jax.tree.map(lambda *chains: np.stack(chains)[:, :count], *draws)

    def shapes(self, chains: int, data: Any, map_: StandardMap) -> tuple[States, Draws]:
        """Return structure, shapes and types of states and draws (c, 1, ...)."""
        state, _ = jax.eval_shape(self._start, jax.random.key(0), data, map_)
        _, draws = jax.eval_shape(self._advance, state, data, map_, jnp.array(1))
        every = jax.tree.map(lambda x: jax.ShapeDtypeStruct((chains, *x.shape), x.dtype), draws)
        return (state,) * chains, every

    def _for_all(
        self, name: str, function: Callable[..., Any], chains: States, *arrays: Any
    ) -> list[Any]:
        """Return ``function`` of each chain and the arrays, compiled before threads call it."""
        key = name, *map(jax.typeof, jax.tree.leaves((chains[0], *arrays)))
        program = self._compiled.get(key)
        if program is None:
            program = jax.jit(function).lower(chains[0], *arrays).compile()
            self._compiled[key] = program

        def one(chain: Any) -> Any:
            return jax.block_until_ready(program(chain, *arrays))

        with ThreadPoolExecutor(min(self._at_once, len(chains))) as pool:
            return list(pool.map(one, chains))


@kept
def compile_chains(density: Target, sampler: ChainSampler, options: ChainOptions) -> Programs:
    """Return the programs of a density in straightened coordinates; data and map are arguments."""

    def log_density(w: jax.Array, data: Any, map_: StandardMap) -> jax.Array:
        return density.log_density(apply_standard(map_, w), data)

    kernel = sampler.kernel(log_density, options)

    def start(key: jax.Array, data: Any, map_: StandardMap) -> Any:
        candidates_key, kernel_key = jax.random.split(key)
        shape = (_CANDIDATES, density.dimension)
        candidates = jax.random.uniform(candidates_key, shape, float, -2.0, 2.0)
        heights = jax.lax.map(lambda w: log_density(w, data, map_), candidates)
        first = jnp.argmax(jnp.isfinite(heights))
        return kernel.init(kernel_key, candidates[first], data, map_), heights[first]

    def advance(state: Any, data: Any, map_: StandardMap, count: jax.Array) -> Any:
        def step(state: Any) -> Any:
            state, w, statistics = kernel.step(state, data, map_)
            return state, Draws(apply_standard(map_, w), statistics)

        def iteration(k: jax.Array, carry: Any) -> Any:
            state, row = step(carry[0])
            return state, jax.tree.map(lambda rows, new: rows.at[k].set(new), carry[1], row)

        _, row = jax.eval_shape(step, state)
        rows = jax.tree.map(lambda x: jnp.zeros((_CHUNK, *x.shape), x.dtype), row)
        return jax.lax.fori_loop(0, count, iteration, (state, rows))

    return Programs(start, advance, density.at_once)


class _ChainCheckpoint(NamedTuple):
    """The state from which a killed run continues."""

    run: Any  # _PILOT or _FINAL
    warmed: Any  # finished iterations of the warm-up
    map_: StandardMap
    states: States
    draws: Draws


class Chains:
    """Running chains: a pilot run, then the final one on the map fitted to it."""

    def __init__(
        self,
        sampler: ChainSampler,
        density: Target,
        data: Any,
        options: ChainOptions,
        context: Context,
    ) -> None:
        self.density, self.data, self.options = density, data, options
        self.checkpoint = context.checkpoint
        self.bar = counting(desc=sampler.name, total=0, disable=not context.progress)
        self.programs = compile_chains(density, sampler, options)
        self._warmup = options.warmup if sampler.adapts_in_steps else 0
        wanted = max(_PILOT_DRAWS, 10 * coefficient_count(density.dimension))
        self._pilot = min(options.draws, -(-wanted // (options.chains * _CHUNK)) * _CHUNK)
        self.map_ = standard_identity(density.dimension, bends=density.piloted)
        self.states: States = ()
        self._parts: list[Draws] = []
        self.run = self.warmed = self._count = 0
        self._part = 1  # iterations until the next update, which no draw depends on

    def begin(self, rng_key: jax.Array) -> None:
        """Run the pilot, if the density wants one, and start the final run, or resume either."""
        pilot_key, key = jax.random.split(rng_key)
        if not self._resume():
            if self.density.whitened:
                self._whiten(pilot_key)
            self._start(*((_PILOT, pilot_key) if self.density.piloted else (_FINAL, key)))
        if self.run == _PILOT:
            z = self.draw(self._pilot).z
            self.map_ = fit_standard(z.reshape(-1, self.density.dimension))
            self._start(_FINAL, key)

    def _whiten(self, key: jax.Array) -> None:
        """Begin at a mode, in units of its curvature."""
        assert isinstance(self.density, Density)
        starts = prior_draws(self.density, key, _STARTS)
        if (whitening := white_at_mode(self.density, self.data, starts)) is not None:
            mode, root = map(jnp.asarray, whitening)
            self.map_ = self.map_._replace(centre=mode, root=root)

    def draw(self, total: int) -> Draws:
        """Return the first ``total`` draws of this run, after its warm-up."""
        while (warming := self.warmed < self._warmup) or self._count < total:
            count = min(self._part, self._warmup - self.warmed if warming else total - self._count)
            start = time.perf_counter()
            self.states, draws = self.programs.advance(self.states, self.data, self.map_, count)
            seconds = max(time.perf_counter() - start, 1e-9)
            self._part = min(max(int(count * _SHOWN / seconds), 1), _CHUNK)
            steps = float(np.mean(draws.statistics.get("n_steps", 0.0)))
            if steps > _MANY_STEPS:
                self.bar.set_postfix_str(f"{steps:.0f} gradients an iteration", refresh=False)
            if warming:
                self.warmed += count
            else:
                self._parts.append(draws)
                self._count += count
            self._show(count)
            self.checkpoint.keep(self._state)
        return jax.tree.map(lambda array: array[:, :total], join(self._parts))

    def _resume(self) -> bool:
        state = self.checkpoint.restore(self._template)
        if state is None:
            return False
        self.run, self.warmed = int(state.run), int(state.warmed)
        self.map_, self.states = state.map_, state.states
        self._parts, self._count = [state.draws], state.draws.z.shape[1]
        if self.run == _FINAL and self.density.piloted:
            self._show(self._warmup + self._pilot)
        self._show(self.warmed + self._count)
        return True

    def _start(self, run: int, key: jax.Array) -> None:
        keys = jax.random.split(key, self.options.chains)
        self.states, heights = self.programs.start(keys, self.data, self.map_)
        if not np.isfinite(heights).all():
            raise SolverError("the posterior density is zero wherever a chain could start")
        self.run, self.warmed, self._count, self._parts = run, 0, 0, []

    def _show(self, count: int) -> None:
        pilot = self._warmup + self._pilot if self.density.piloted else 0
        planned = pilot + self._warmup + self.options.draws
        self.bar.total = max(self.bar.total, planned, self.bar.n + count)
        self.bar.update(count)

    def _state(self) -> _ChainCheckpoint:
        # While they warm up, chains have no draws, but names and shapes of draws are known.
        def none(draws: jax.ShapeDtypeStruct) -> np.ndarray:
            return np.zeros((draws.shape[0], 0, *draws.shape[2:]), draws.dtype)

        draws = join(self._parts or [jax.tree.map(none, self._template().draws)])
        return _ChainCheckpoint(self.run, self.warmed, self.map_, self.states, draws)

    def _template(self) -> _ChainCheckpoint:
        number = jax.ShapeDtypeStruct((), int)
        states, draws = self.programs.shapes(self.options.chains, self.data, self.map_)
        return _ChainCheckpoint(number, number, self.map_, states, draws)


def join(parts: list[Draws]) -> Draws:
    """Return the draws of all parts, one after the other."""
    return jax.tree.map(lambda *arrays: np.concatenate(arrays, axis=1), *parts)
