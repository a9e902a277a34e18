"""The No-U-Turn sampler (Hoffman and Gelman 2014), dense metric: NumPyro's and BlackJAX's.

Which of the two is faster depends on the posterior: BlackJAX's on landmarks and strains, NumPyro's
on a volume (docs/experiments.md, "Effective draws by what is observed"). NumPyro's kernel adapts
step size and metric in its first steps and is compiled once a model, where its ``MCMC`` class
compiles for every run. BlackJAX's runs Stan's window adaptation in ``init``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
from numpyro.infer.hmc import hmc

from calibrate.samplers.chains import ChainSampler
from calibrate.samplers.protocol import ChainOptions, Kernel, Statistics


@dataclass(frozen=True)
class NUTSOptions(ChainOptions):
    """Length of a run.

    target_accept : the acceptance rate in (0, 1) that the step size adapts to.
    """

    target_accept: float = 0.85

    label: ClassVar[str] = "NUTS"
    shares: ClassVar[tuple[str, ...]] = ("target_accept",)


@dataclass(frozen=True)
class BlackJAXNUTSOptions(NUTSOptions):
    """Length of a run."""

    label: ClassVar[str] = "BlackJAX NUTS"


class _TunedState(NamedTuple):
    """State of BlackJAX's chain: random key, position and its density, what was adapted."""

    rng_key: jax.Array
    state: Any
    step_size: jax.Array
    inverse_mass_matrix: jax.Array


def numpyro_kernel(log_density: Callable[..., jax.Array], options: NUTSOptions) -> Kernel:
    """Return NumPyro's kernel; its first ``options.warmup`` steps adapt step size and metric."""

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

    def step(state: Any, *arguments: Any) -> tuple[Any, jax.Array, Statistics]:
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


def blackjax_kernel(log_density: Callable[..., jax.Array], options: BlackJAXNUTSOptions) -> Kernel:
    """Return BlackJAX's kernel; ``init`` runs the whole window adaptation."""
    import blackjax  # only some samplers need this import
    from blackjax.adaptation.base import get_filter_adapt_info_fn

    transition = blackjax.nuts.build_kernel()

    def init(rng_key: jax.Array, position: jax.Array, *arguments: Any) -> _TunedState:
        adaptation_key, next_key = jax.random.split(rng_key)
        adaptation = blackjax.window_adaptation(
            blackjax.nuts,
            lambda zeta: log_density(zeta, *arguments),
            is_mass_matrix_diagonal=False,
            target_acceptance_rate=options.target_accept,
            adaptation_info_fn=get_filter_adapt_info_fn(),
        )
        (state, tuned), _ = adaptation.run(adaptation_key, position, options.warmup)
        return _TunedState(next_key, state, tuned["step_size"], tuned["inverse_mass_matrix"])

    def step(state: _TunedState, *arguments: Any) -> tuple[_TunedState, jax.Array, Statistics]:
        transition_key, next_key = jax.random.split(state.rng_key)
        inner, info = transition(
            transition_key, state.state, lambda zeta: log_density(zeta, *arguments),
            step_size=state.step_size, inverse_mass_matrix=state.inverse_mass_matrix,
        )  # fmt: skip
        statistics = {
            "diverging": info.is_divergent,
            "acceptance_rate": info.acceptance_rate,
            "n_steps": info.num_integration_steps,
            "lp": inner.logdensity,
            "energy": info.energy,
            "tree_depth": info.num_trajectory_expansions,
        }
        return state._replace(rng_key=next_key, state=inner), inner.position, statistics

    return Kernel(init, step)


NUTS: ChainSampler = ChainSampler("nuts", NUTSOptions, numpyro_kernel)
BLACKJAX_NUTS: ChainSampler = ChainSampler(
    "blackjax_nuts", BlackJAXNUTSOptions, blackjax_kernel, adapts_in_steps=False
)
