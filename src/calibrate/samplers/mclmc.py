"""BlackJAX's adjusted microcanonical Langevin sampler (Robnik et al. 2025) and its tuning.

Hamiltonian dynamics at constant speed with partial refreshment of the direction, corrected by a
Metropolis step. Its cost per transition is fixed, where NUTS's is that of the trajectory's turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from calibrate.samplers.options import ChainOptions, check_target_accept
from calibrate.samplers.protocol import Kernel
from calibrate.samplers.run import ChainSampler
from emulator.core.errors import InputError

# Parts of the warm-up: step size, then the metric, then the step size again.
_STEP_SIZE, _METRIC = 0.25, 0.5
# Longest trajectory over the mean one. The tuning first keeps the length of a trajectory and adapts
# its steps; where the density ends they shrink, and one transition would take 1e5 of them.
_LONGEST = 8.0


@dataclass(frozen=True)
class MCLMCOptions(ChainOptions):
    """Length of a run.

    target_accept : acceptance rate in (0, 1) that the step size adapts to.
    leapfrogs : mean number of integration steps of a transition, above 1.1.
    """

    target_accept: float = 0.9
    leapfrogs: float = 4.0

    label: ClassVar[str] = "MCLMC"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_target_accept(self.label, self.target_accept)
        if not self.leapfrogs > 1.1:
            raise InputError(f"{self.label}: leapfrogs is {self.leapfrogs}; it must be above 1.1")


class State(NamedTuple):
    """Random key, BlackJAX's state and the tuned parameters."""

    rng_key: jax.Array
    mclmc: Any
    step_size: jax.Array
    inverse_mass_matrix: jax.Array


def kernel(log_density: Callable[..., jax.Array], options: MCLMCOptions) -> Kernel:
    """BlackJAX's kernel; ``init`` runs the whole tuning."""
    from blackjax.adaptation.adjusted_mclmc_adaptation import adjusted_mclmc_find_L_and_step_size
    from blackjax.mcmc import adjusted_mclmc_dynamic as mclmc

    random_length = mclmc.make_random_trajectory_length_fn(True)
    longest = math.ceil(_LONGEST * options.leapfrogs)

    def length(rng_key: jax.Array, mean: jax.Array) -> jax.Array:
        return jnp.minimum(random_length(rng_key, mean), longest)

    transition = mclmc.build_kernel(length)

    def init(rng_key: jax.Array, position: jax.Array, *arguments: Any) -> State:
        if position.size == 1:
            raise InputError("sampler 'mclmc' needs two parameters or more; use nuts for one")
        start_key, tuning_key, onwards = jax.random.split(rng_key, 3)

        def target(zeta: jax.Array) -> jax.Array:
            return log_density(zeta, *arguments)

        state, found, _ = adjusted_mclmc_find_L_and_step_size(
            mclmc_kernel=transition,
            logdensity_fn=target,
            num_steps=options.warmup,
            state=mclmc.init(position, target, start_key),
            rng_key=tuning_key,
            target=options.target_accept,
            frac_tune1=_STEP_SIZE,
            frac_tune2=_METRIC,
            target_num_integration_steps=options.leapfrogs,
        )
        return State(onwards, state, found.step_size, found.inverse_mass_matrix)

    def step(state: State, *arguments: Any) -> tuple[State, jax.Array, dict[str, jax.Array]]:
        here, onwards = jax.random.split(state.rng_key)
        moved, info = transition(
            here,
            state.mclmc,
            lambda zeta: log_density(zeta, *arguments),
            state.step_size,
            inverse_mass_matrix=state.inverse_mass_matrix,
            integration_steps_params=(options.leapfrogs,),
        )
        statistics = {
            "diverging": info.is_divergent,
            "acceptance_rate": info.acceptance_rate,
            "n_steps": info.num_integration_steps,
            "lp": moved.logdensity,
        }
        return state._replace(rng_key=onwards, mclmc=moved), moved.position, statistics

    return Kernel(init, step)


MCLMC = ChainSampler(
    "mclmc",
    MCLMCOptions,
    ("diverging", "acceptance_rate", "n_steps", "lp"),
    kernel,
    adapts_in_steps=False,
)
