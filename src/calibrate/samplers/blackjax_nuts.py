"""BlackJAX's No-U-Turn sampler with Stan's window adaptation, dense metric."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax

from calibrate.samplers.options import ChainOptions, check_target_accept
from calibrate.samplers.protocol import Kernel
from calibrate.samplers.run import ChainSampler


@dataclass(frozen=True)
class BlackJAXNUTSOptions(ChainOptions):
    """Length of a run.

    target_accept : acceptance rate in (0, 1) that the step size adapts to.
    """

    target_accept: float = 0.85

    label: ClassVar[str] = "BlackJAX NUTS"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_target_accept(self.label, self.target_accept)


class State(NamedTuple):
    """Random key, BlackJAX's state and the adapted parameters."""

    rng_key: jax.Array
    nuts: Any
    step_size: jax.Array
    inverse_mass_matrix: jax.Array


def kernel(log_density: Callable[..., jax.Array], options: BlackJAXNUTSOptions) -> Kernel:
    """BlackJAX's kernel; ``init`` runs the whole window adaptation."""
    import blackjax  # here: other samplers need not wait for it
    from blackjax.adaptation.base import get_filter_adapt_info_fn

    transition = blackjax.nuts.build_kernel()

    def init(rng_key: jax.Array, position: jax.Array, *arguments: Any) -> State:
        here, onwards = jax.random.split(rng_key)
        adaptation = blackjax.window_adaptation(
            blackjax.nuts,
            lambda zeta: log_density(zeta, *arguments),
            is_mass_matrix_diagonal=False,
            target_acceptance_rate=options.target_accept,
            adaptation_info_fn=get_filter_adapt_info_fn(),
        )
        (state, found), _ = adaptation.run(here, position, options.warmup)
        return State(onwards, state, found["step_size"], found["inverse_mass_matrix"])

    def step(state: State, *arguments: Any) -> tuple[State, jax.Array, dict[str, jax.Array]]:
        here, onwards = jax.random.split(state.rng_key)
        nuts, info = transition(
            here,
            state.nuts,
            lambda zeta: log_density(zeta, *arguments),
            state.step_size,
            state.inverse_mass_matrix,
        )
        statistics = {
            "diverging": info.is_divergent,
            "acceptance_rate": info.acceptance_rate,
            "n_steps": info.num_integration_steps,
            "lp": nuts.logdensity,
            "energy": info.energy,
            "tree_depth": info.num_trajectory_expansions,
        }
        return state._replace(rng_key=onwards, nuts=nuts), nuts.position, statistics

    return Kernel(init, step)


BLACKJAX_NUTS = ChainSampler(
    "blackjax_nuts",
    BlackJAXNUTSOptions,
    ("diverging", "acceptance_rate", "n_steps", "lp", "energy", "tree_depth"),
    kernel,
    adapts_in_steps=False,
)
