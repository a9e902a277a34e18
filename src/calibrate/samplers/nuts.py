"""NumPyro's No-U-Turn sampler (Hoffman and Gelman 2014), dense metric.

Its functional interface is used: compiled once a model, where its ``MCMC`` class compiles for every
run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
from numpyro.infer.hmc import hmc

from calibrate.samplers.options import ChainOptions, check_target_accept
from calibrate.samplers.protocol import Kernel
from calibrate.samplers.run import ChainSampler


@dataclass(frozen=True)
class NUTSOptions(ChainOptions):
    """Length of a run.

    target_accept : acceptance rate in (0, 1) that the step size adapts to.
    """

    target_accept: float = 0.85

    label: ClassVar[str] = "NUTS"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_target_accept(self.label, self.target_accept)


def kernel(log_density: Callable[..., jax.Array], options: NUTSOptions) -> Kernel:
    """NumPyro's kernel; its first ``options.warmup`` steps adapt step size and metric."""

    def potential(*arguments: Any) -> Callable[[jax.Array], jax.Array]:
        return lambda zeta: -log_density(zeta, *arguments)

    init_kernel, sample_kernel = hmc(potential_fn_gen=potential, algo="NUTS")

    def init(rng_key: jax.Array, position: jax.Array, *arguments: Any) -> Any:
        return init_kernel(
            position,
            num_warmup=options.warmup,
            dense_mass=True,
            target_accept_prob=options.target_accept,
            model_args=arguments,
            rng_key=rng_key,
        )

    def step(state: Any, *arguments: Any) -> tuple[Any, jax.Array, dict[str, jax.Array]]:
        state = sample_kernel(state, arguments, {})
        statistics = {
            "diverging": state.diverging,
            "acceptance_rate": state.accept_prob,
            "n_steps": state.num_steps,
            "lp": -state.potential_energy,
            "energy": state.energy,
        }
        return state, state.z, statistics

    return Kernel(init, step)


NUTS = ChainSampler(
    "nuts", NUTSOptions, ("diverging", "acceptance_rate", "n_steps", "lp", "energy"), kernel
)
