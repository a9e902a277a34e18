r"""Adaptive tempered sequential Monte Carlo (Del Moral, Doucet and Jasra 2006), BlackJAX's parts.

Particles from the prior pass through :math:`\pi_\lambda(z) \propto p(z)\,L(z)^\lambda` for
:math:`0 = \lambda_0 < \dots < \lambda_T = 1`. A step from :math:`\lambda` weights particle *i* by

.. math:: w_i = L(z_i)^{\Delta\lambda}

with the largest :math:`\Delta\lambda` that leaves an effective sample size
:math:`(\sum w_i)^2 / \sum w_i^2` of a given fraction, resamples, and moves every particle by a few
Hamiltonian transitions that leave :math:`\pi_{\lambda + \Delta\lambda}` invariant. No particle has
to cross between modes, so several modes keep their shares. The evidence follows from the weights,

.. math:: \hat Z = \prod_t \frac{1}{n} \sum_i w_i^{(t)}

(Neal 2001). Independent populations take the place of chains: their R-hat tells whether a
population has particles enough, their spread is the error of the evidence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from tqdm import tqdm

from calibrate.samplers.density import Density
from calibrate.samplers.options import check_counts, check_target_accept
from calibrate.samplers.protocol import Context, Draws
from calibrate.statistical_model import Data
from emulator.core.errors import InputError, SolverError
from emulator.core.progress import counting

# Log likelihood of particles where the forward map has no answer. Finite, because its product with
# a temperature of 0 must be 0; so low that such particles die out at the first step.
_LOWEST = -1e10


@dataclass(frozen=True)
class SMCOptions:
    """Size of a run.

    draws : particles of a population.
    chains : independent populations.
    survivors : effective sample size that a step leaves, as a fraction in (0, 1).
    transitions : Hamiltonian transitions of a particle at each temperature.
    leapfrogs : of a transition.
    target_accept : acceptance rate in (0, 1) that the step size adapts to.
    temperatures : largest number of temperatures before the run is given up.
    """

    draws: int = 1000
    chains: int = 4
    survivors: float = 0.6
    transitions: int = 10
    leapfrogs: int = 5
    target_accept: float = 0.8
    temperatures: int = 200

    label: ClassVar[str] = "SMC"

    @classmethod
    def sized(cls, *, warmup: int, draws: int, chains: int) -> Self:  # noqa: ARG003
        """Options of a run of this size; particles have no warm-up."""
        return cls(draws=draws, chains=chains)

    def __post_init__(self) -> None:
        check_counts(self, "draws", "chains", "transitions", "leapfrogs", "temperatures")
        check_target_accept(self.label, self.target_accept)
        if not 0.0 < self.survivors < 1.0:
            raise InputError(f"{self.label}: survivors is {self.survivors}; give one in (0, 1)")


class _Population(NamedTuple):
    """One population at one temperature; with a leading axis, several."""

    key_data: Any  # of the next key
    particles: Any  # (n, p)
    temperature: Any
    log_evidence: Any
    step_size: Any  # of leapfrogs, in units of the particles' spread
    acceptance_rate: Any  # of each particle's last transitions, (n,)
    steps: Any  # temperatures passed


class _State(NamedTuple):
    """All that a run goes on from: populations that are done, and the one under way."""

    done: _Population
    current: _Population


@dataclass(frozen=True)
class TemperedSMC:
    """The sampler; see :class:`~calibrate.samplers.protocol.Sampler`."""

    name: str = "smc"
    options: type[SMCOptions] = SMCOptions
    statistics: tuple[str, ...] = ("acceptance_rate", "lp")
    solves_fem: bool = False

    def sample(
        self,
        density: Density,
        data: Data,
        options: SMCOptions,
        seed: int,
        context: Context = Context(),
    ) -> Draws:
        """Populations one after the other, and the evidence as attributes.

        ``log_evidence`` is the logarithm of the populations' mean evidence, ``log_evidence_error``
        its standard error, missing for a single population, and ``temperatures`` the mean number of
        steps.

        Raises
        ------
        SolverError
            A population did not reach the posterior in ``options.temperatures`` steps.
        """
        programs = _compile(density, options)
        with counting(desc=self.name, total=options.chains, disable=not context.progress) as bar:
            found = _run(programs, data, options, seed, context, bar)
        heights = programs.finish(found.particles, data)
        rates = np.asarray(found.acceptance_rate)
        statistics = {"acceptance_rate": rates, "lp": np.asarray(heights)}
        return Draws(np.asarray(found.particles), statistics, evidence(found.log_evidence) | {
            "temperatures": float(np.mean(found.steps))
        })  # fmt: skip


def evidence(logarithms: np.ndarray) -> dict[str, float]:
    r"""Attributes from :math:`\log \hat Z` of K populations, (K,): mean evidence and its error.

    The estimates :math:`\hat Z` are unbiased, so their mean is taken, not that of the logarithms.
    The error of its logarithm is the relative standard error of the mean.
    """
    shifted = np.exp(np.asarray(logarithms) - np.max(logarithms))
    mean, count = shifted.mean(), len(shifted)
    found = {"log_evidence": float(np.max(logarithms) + np.log(mean))}
    if count > 1:
        found["log_evidence_error"] = float(shifted.std(ddof=1) / np.sqrt(count) / mean)
    return found


def _run(
    programs: _Programs, data: Data, options: SMCOptions, seed: int, context: Context, bar: tqdm
) -> _Population:
    """All populations at temperature 1, stacked."""
    keys = jax.random.split(jax.random.key(seed), options.chains)
    template = jax.eval_shape(programs.start, keys[0])
    kept = context.checkpoint.restore(lambda: _State(template, template))
    done = [] if kept is None else _unstack(kept.done)
    current = programs.start(keys[0]) if kept is None else kept.current
    bar.update(len(done))
    while True:
        while current.temperature < 1.0:
            current = jax.tree.map(np.asarray, programs.step(current, data))
            bar.set_postfix(temperature=f"{float(current.temperature):.2g}")
            if current.steps >= options.temperatures and current.temperature < 1.0:
                raise SolverError(
                    f"{options.label}: a population is at temperature "
                    f"{float(current.temperature):.2g} after {options.temperatures} steps; allow "
                    "more temperatures, or look at the likelihood: it may be flat or very sharp"
                )
            context.checkpoint.keep(lambda: _State(_stack(done, template), current))  # noqa: B023
        done.append(current)
        bar.update()
        if len(done) == options.chains:
            return _stack(done, template)
        current = programs.start(keys[len(done)])


def _stack(populations: list[_Population], template: Any) -> _Population:
    if not populations:
        return jax.tree.map(lambda leaf: np.zeros((0, *leaf.shape), leaf.dtype), template)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *populations)


def _unstack(populations: _Population) -> list[_Population]:
    count = len(populations.temperature)
    return [jax.tree.map(lambda leaf: leaf[k], populations) for k in range(count)]  # noqa: B023


class _Programs(NamedTuple):
    start: Callable[..., Any]  # (rng_key) -> population at temperature 0
    step: Callable[..., Any]  # (population, data) -> population at the next temperature
    finish: Callable[..., Any]  # (particles (k, n, p), data) -> log densities (k, n)


@lru_cache(maxsize=4)
def _compile(density: Density, options: SMCOptions) -> _Programs:
    import blackjax  # here: other samplers need not wait for it
    from blackjax.smc import base, resampling

    count = options.draws
    hmc = blackjax.hmc.build_kernel()

    def log_likelihood(z: jax.Array, data: Data) -> jax.Array:
        return jnp.maximum(density.log_likelihood(z, data), _LOWEST)

    def start(rng_key: jax.Array) -> _Population:
        here, onwards = jax.random.split(rng_key)
        particles = jax.vmap(density.prior_draw)(jax.random.split(here, count))
        # The step that is best for a normal density shrinks with its dimension to the power 1/4.
        step_size = jnp.asarray(density.dimension**-0.25)
        zero = jnp.zeros(())
        key_data = jax.random.key_data(onwards)
        return _Population(key_data, particles, zero, zero, step_size, jnp.ones(count), 0)

    def step(population: _Population, data: Data) -> _Population:
        here, onwards = jax.random.split(jax.random.wrap_key_data(population.key_data))
        particles, temperature = population.particles, population.temperature
        heights = jax.vmap(log_likelihood, (0, None))(particles, data)
        increment = _increment(heights, 1.0 - temperature, options.survivors)
        # Sums of increments may miss 1 by round-off.
        last = increment >= 1.0 - temperature
        temperature = jnp.where(last, 1.0, temperature + increment)
        log_weights = increment * heights
        weights = jax.nn.softmax(log_weights)
        covariance = jnp.atleast_2d(jnp.cov(particles, rowvar=False, aweights=weights))

        def tempered(z: jax.Array) -> jax.Array:
            return density.log_prior(z) + temperature * log_likelihood(z, data)

        def transition(rng_key: jax.Array, state: Any, log_density: Any) -> Any:
            # Trajectories of one length could come back to where they began, again and again.
            length_key, hmc_key = jax.random.split(rng_key)
            size = population.step_size * jax.random.uniform(length_key, minval=0.5)
            return hmc(hmc_key, state, log_density, size, covariance, options.leapfrogs)

        move, _ = base.update_and_take_last(
            blackjax.hmc.init, tempered, transition, options.transitions, count
        )
        moved, info = base.step(
            here,
            base.SMCState(particles, weights, {}),
            move,
            lambda particles: jnp.zeros(len(particles)),
            resampling.systematic,
        )
        rates = info.update_info.acceptance_rate.mean(axis=1)
        return _Population(
            jax.random.key_data(onwards),
            moved.particles,
            temperature,
            population.log_evidence + logsumexp(log_weights) - jnp.log(count),
            population.step_size * jnp.exp(rates.mean() - options.target_accept),
            rates,
            population.steps + 1,
        )

    def finish(particles: jax.Array, data: Data) -> jax.Array:
        return jax.vmap(jax.vmap(density.log_density, (0, None)), (0, None))(particles, data)

    return _Programs(jax.jit(start), jax.jit(step), jax.jit(finish))


def _increment(heights: jax.Array, left: jax.Array, survivors: float) -> jax.Array:
    """The largest step of the temperature that leaves the wanted effective sample size."""
    from blackjax.smc import ess, solver

    def surplus(increment: jax.Array) -> jax.Array:
        return ess.log_ess(increment * heights) - jnp.log(survivors * len(heights))

    return solver.dichotomy(surplus, 0.0, left)


SMC = TemperedSMC()
