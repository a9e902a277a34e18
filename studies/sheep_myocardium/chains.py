"""Chains of NumPyro's NUTS with moves between modes, as many at once as there are cores."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro.infer.hmc import HMCState, hmc
from numpyro.infer.util import constrain_fn, potential_energy
from studies.common.output import cores
from studies.sheep_myocardium.moves import Modes, moved

_PLACES = 4  # of which a chain begins at the likeliest
_ACCEPTED, _DEPTH = 0.9, 8  # of NUTS: acceptance its step size adapts to, doublings of a trajectory


class Chain(NamedTuple):
    """Draws z (d, u) of unconstrained positions, their log densities (d,), and divergences (d,)."""

    z: jax.Array
    log_density: jax.Array
    diverging: jax.Array


def chain(
    potential: Callable[[jax.Array], jax.Array],
    given: Modes,
    mirrored: np.ndarray,
    key: jax.Array,
    *,
    warmup: int,
    draws: int,
    room: int,
    dense: bool = True,
) -> Chain:
    """One chain of NumPyro's NUTS from somewhere, with moves after each step; under ``jit``.

    Its arrays have ``room`` for draws; ``draws`` of them are made, a number that may be traced, so
    that short chains and long ones are one program.

    It is the kernel alone, since ``numpyro.infer.MCMC`` compiles a model's start anew for every
    chain, and a process can map only so many programs.
    """
    begin, step = hmc(potential, algo="NUTS")
    places, first, then = jax.random.split(key, 3)
    somewhere = jax.random.uniform(places, (_PLACES, len(mirrored)), minval=-1.0, maxval=1.0)
    energies = jax.lax.map(potential, somewhere)
    start = somewhere[jnp.argmin(jnp.where(jnp.isfinite(energies), energies, jnp.inf))]
    state = begin(
        start,
        warmup,
        dense_mass=dense,
        target_accept_prob=_ACCEPTED,
        max_tree_depth=_DEPTH,
        rng_key=first,
    )

    def onwards(k: jax.Array, at: tuple[HMCState, Chain]) -> tuple[HMCState, Chain]:
        state, kept = step(at[0]), at[1]
        place = (state.z, state.potential_energy)
        z, energy = moved(potential, given, mirrored, place, jax.random.fold_in(then, k))
        state = state._replace(z=z, potential_energy=energy, z_grad=jax.grad(potential)(z))
        # Steps of warm-up write where the first draw will be.
        row = jnp.maximum(k - warmup, 0)
        found = Chain(z, -energy, state.diverging)
        return state, jax.tree.map(lambda all, one: all.at[row].set(one), kept, found)

    kept = Chain(jnp.zeros((room, len(start))), jnp.zeros(room), jnp.zeros(room, bool))
    every: Chain = jax.lax.fori_loop(0, warmup + draws, onwards, (state, kept))[1]
    return every


class Drawn(NamedTuple):
    """Draws by site, of deterministic ones too, with how their chains went."""

    draws: dict[str, jax.Array]
    chain: Chain


def marked(sites: dict[str, jax.Array], marks: dict[str, bool]) -> np.ndarray:
    """Whether each unconstrained position (u,) is of a marked site."""
    each = {site: jnp.full(zero.shape, marks.get(site, False)) for site, zero in sites.items()}
    return np.asarray(ravel_pytree(each)[0])


def sampler(
    program: Callable[[Any], None],
    sites: dict[str, jax.Array],
    mirrored: np.ndarray,
    *,
    warmup: int,
    room: int,
    dense: bool = True,
) -> Callable[[jax.Array, Any, Modes, int], Drawn]:
    """A chain of a ``program``, given a key, the program's arrays, modes, and how many draws.

    sites : zeros like each of its unknowns. mirrored : (u,) positions that may change their sign.
    dense : whether NUTS learns correlations; warm-up must have more steps than there are unknowns.
    """
    unravel = ravel_pytree(sites)[1]

    def run(key: jax.Array, of: Any, given: Modes, draws: int) -> Drawn:
        def potential(z: jax.Array) -> jax.Array:
            return potential_energy(program, (of,), {}, unravel(z))

        length = {"warmup": warmup, "draws": draws, "room": room, "dense": dense}
        found = chain(potential, given, mirrored, key, **length)

        def told(z: jax.Array) -> dict[str, jax.Array]:
            return constrain_fn(program, (of,), {}, unravel(z), return_deterministic=True)

        return Drawn(jax.lax.map(told, found.z), found)

    return jax.jit(run)


def side_by_side(
    run: Callable[[jax.Array, Any, Modes, int], Drawn],
    of: Any,
    given: Modes,
    seed: int,
    *,
    chains: int,
    draws: int,
) -> Drawn:
    """Draws of all ``chains``, one after the other, ``draws`` of each."""

    def one(key: jax.Array) -> Drawn:
        return jax.block_until_ready(run(key, of, given, draws))

    keys = jax.random.split(jax.random.key(seed), chains)
    # JAX compiles once: other threads wait for the one that does.
    with ThreadPoolExecutor(min(cores(), chains)) as pool:
        told = list(pool.map(one, keys))
    every: Drawn = jax.tree.map(lambda *parts: np.concatenate([p[:draws] for p in parts]), *told)
    return every


def by_chain(values: np.ndarray, chains: int) -> np.ndarray:
    """(d, ...) as (chains, d / chains, ...)."""
    return values.reshape(chains, -1, *values.shape[1:])
