"""BlackJAX's adjusted microcanonical Langevin sampler (Robnik et al. 2025) and its tuning.

Hamiltonian dynamics at constant speed with partial refreshment of the direction, corrected by a
Metropolis step. The cost of a transition is fixed, where the cost of a NUTS transition is that of
the trajectory until it turns.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from calibrate.samplers.chains import ChainSampler
from calibrate.samplers.protocol import ChainOptions, Kernel, TunedState, tuned_step
from emulator.core.errors import InputError

# Parts of the warm-up: step size, then the metric, then the step size again.
_STEP_SIZE, _METRIC = 0.25, 0.5
# Longest trajectory over the mean one. The tuning first keeps the length of a trajectory and adapts
# its steps; where the density ends they shrink, and one transition would take 1e5 of them.
_LONGEST = 8.0


@dataclass(frozen=True)
class MCLMCOptions(ChainOptions):
    """Length of a run.

    target_accept : the acceptance rate in (0, 1) that the step size adapts to.
    leapfrogs : the mean number of integration steps of a transition, above 1.1.
    """

    target_accept: float = 0.9
    leapfrogs: float = 4.0

    label: ClassVar[str] = "MCLMC"
    shares: ClassVar[tuple[str, ...]] = ("target_accept",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.leapfrogs > 1.1:
            raise InputError(f"{self.label}: leapfrogs is {self.leapfrogs}; it must be above 1.1")


def kernel(log_density: Callable[..., jax.Array], options: MCLMCOptions) -> Kernel:
    """Return BlackJAX's kernel; ``init`` runs the whole tuning."""
    from blackjax.adaptation.adjusted_mclmc_adaptation import adjusted_mclmc_find_L_and_step_size
    from blackjax.mcmc import adjusted_mclmc_dynamic as mclmc

    random_length = mclmc.make_random_trajectory_length_fn(True)
    longest = math.ceil(_LONGEST * options.leapfrogs)

    def length(rng_key: jax.Array, mean: jax.Array) -> jax.Array:
        return jnp.minimum(random_length(rng_key, mean), longest)

    transition = mclmc.build_kernel(length)

    def init(rng_key: jax.Array, position: jax.Array, *arguments: Any) -> TunedState:
        if position.size == 1:
            raise InputError("sampler 'mclmc' needs two parameters or more; use nuts for one")
        start_key, tuning_key, next_key = jax.random.split(rng_key, 3)

        def target(zeta: jax.Array) -> jax.Array:
            return log_density(zeta, *arguments)

        state, tuned, _ = adjusted_mclmc_find_L_and_step_size(
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
        return TunedState(next_key, state, tuned.step_size, tuned.inverse_mass_matrix)

    step = tuned_step(log_density, transition, integration_steps_params=(options.leapfrogs,))
    return Kernel(init, step)


MCLMC = ChainSampler(
    "mclmc",
    MCLMCOptions,
    ("diverging", "acceptance_rate", "n_steps", "lp"),
    kernel,
    adapts_in_steps=False,
)
