r"""Adaptive tempered sequential Monte Carlo (Del Moral, Doucet and Jasra 2006), BlackJAX's parts.

Particles from the prior pass through :math:`\pi_\lambda(z) \propto p(z)\,L(z)^\lambda` for
:math:`0 = \lambda_0 < \dots < \lambda_T = 1`. A step from :math:`\lambda` weights particle *i* by

.. math:: w_i = L(z_i)^{\Delta\lambda}

with the largest :math:`\Delta\lambda` that leaves an effective sample size
:math:`(\sum w_i)^2 / \sum w_i^2` of a given fraction, resamples, and moves every particle by a few
Hamiltonian transitions that leave :math:`\pi_{\lambda + \Delta\lambda}` invariant. No particle has
to cross between modes, so several modes keep their shares. The evidence follows from the weights,

.. math:: \hat Z = \prod_t \frac{1}{n} \sum_i w_i^{(t)}

(Neal 2001). Independent sets of particles take the place of chains: their R-hat shows whether a set
is large enough, their spread is the error of the evidence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from calibrate.samplers.protocol import Context, Draws, Options, Sampler
from calibrate.statistical_model import Data
from calibrate.statistical_model.density import Density
from emulator.core.display import counting
from emulator.core.errors import SolverError
from emulator.core.kept import kept

# Log likelihood of particles where the forward map has no answer. Finite, because its product with
# a temperature of 0 must be 0; so low that such particles die out at the first step.
_LOWEST = -1e10


@dataclass(frozen=True)
class SMCOptions(Options):
    """Size of a run.

    draws : the number of particles of a set.
    chains : the number of independent sets of particles.
    survivors : the effective sample size that a step leaves, as a fraction in (0, 1).
    transitions : the number of Hamiltonian transitions of a particle at each temperature.
    leapfrogs : the number of leapfrog steps of a transition.
    target_accept : the acceptance rate in (0, 1) that the step size adapts to.
    temperatures : the largest number of temperatures before the run is given up.
    """

    draws: int = 1000
    chains: int = 4
    survivors: float = 0.6
    transitions: int = 10
    leapfrogs: int = 5
    target_accept: float = 0.8
    temperatures: int = 200

    label: ClassVar[str] = "SMC"
    shares: ClassVar[tuple[str, ...]] = ("target_accept", "survivors")


class _Particles(NamedTuple):
    """One set of particles at one temperature; with a leading axis, several."""

    key_data: Any  # data of the next key
    particles: Any  # (n, p)
    temperature: Any
    log_evidence: Any
    step_size: Any  # leapfrog step, in units of the particles' spread
    acceptance_rate: Any  # rate of each particle's last transitions, (n,)
    steps: Any  # number of temperatures so far


class _ParticleCheckpoint(NamedTuple):
    """The state from which a killed run continues: the finished sets, and the current one."""

    done: _Particles
    current: _Particles


class TemperedSMC(Sampler):
    """The sampler of tempered sequential Monte Carlo."""

    def sample(self, density: Density, data: Data, options: SMCOptions, context: Context) -> Draws:
        """Return the particles of all sets, one set after the other, and the evidence.

        The attribute ``log_evidence`` is the logarithm of the sets' mean evidence,
        ``log_evidence_error`` its standard error, missing for a single set, and ``temperatures``
        the mean number of steps.

        Raises
        ------
        SolverError
            A set of particles did not reach the posterior in ``options.temperatures`` steps.
        """
        programs, checkpoint = _compile(density, options), context.checkpoint
        keys = jax.random.split(jax.random.key(context.seed), options.chains)
        template = jax.eval_shape(programs.start, keys[0])
        state = checkpoint.restore(lambda: _ParticleCheckpoint(template, template))
        done: list[_Particles] = []
        current: Any = None
        if state is not None:
            count, current = len(state.done.steps), state.current
            done = [jax.tree.map(itemgetter(k), state.done) for k in range(count)]
        with counting(desc=self.name, total=options.chains, disable=not context.progress) as bar:
            bar.update(len(done))
            while len(done) < options.chains:
                current = programs.start(keys[len(done)]) if current is None else current
                while current.temperature < 1.0:
                    current = jax.tree.map(np.asarray, programs.step(current, data))
                    bar.set_postfix(temperature=f"{float(current.temperature):.2g}")
                    if current.steps >= options.temperatures and current.temperature < 1.0:
                        raise SolverError(
                            f"{options.label}: a population is at temperature "
                            f"{float(current.temperature):.2g} after {options.temperatures} steps; "
                            "allow more temperatures, or look at the likelihood: it may be flat or "
                            "very sharp"
                        )
                    checkpoint.keep(lambda: _ParticleCheckpoint(_stack(done, template), current))  # noqa: B023
                done.append(current)
                bar.update()
                current = None
        sets = _stack(done, template)
        statistics = {
            "acceptance_rate": np.asarray(sets.acceptance_rate),
            "lp": np.asarray(programs.finish(sets.particles, data)),
        }
        attributes = evidence(sets.log_evidence) | {"temperatures": float(np.mean(sets.steps))}
        return Draws(np.asarray(sets.particles), statistics, attributes)


def evidence(logarithms: np.ndarray) -> dict[str, float]:
    r"""Return attributes from K estimates :math:`\log \hat Z`, (K,): log of their mean, its error.

    The estimates :math:`\hat Z` are unbiased, so their mean is taken, not that of the logarithms.
    The error of its logarithm is the relative standard error of the mean.
    """
    shifted = np.exp(np.asarray(logarithms) - np.max(logarithms))
    mean, count = shifted.mean(), len(shifted)
    attributes = {"log_evidence": float(np.max(logarithms) + np.log(mean))}
    if count > 1:
        attributes["log_evidence_error"] = float(shifted.std(ddof=1) / np.sqrt(count) / mean)
    return attributes


def _stack(sets: list[_Particles], template: Any) -> _Particles:
    if not sets:
        return jax.tree.map(lambda leaf: np.zeros((0, *leaf.shape), leaf.dtype), template)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *sets)


class _SMCPrograms(NamedTuple):
    start: Callable[..., Any]  # (rng_key) -> a set at temperature 0
    step: Callable[..., Any]  # (set, data) -> the set at the next temperature
    finish: Callable[..., Any]  # (particles (k, n, p), data) -> log densities (k, n)


@kept
def _compile(density: Density, options: SMCOptions) -> _SMCPrograms:
    count = options.draws

    def start(rng_key: jax.Array) -> _Particles:
        prior_key, next_key = jax.random.split(rng_key)
        particles = jax.vmap(density.prior_draw)(jax.random.split(prior_key, count))
        # The step that is best for a normal density shrinks with its dimension to the power 1/4.
        step_size = jnp.asarray(density.dimension**-0.25)
        zero = jnp.zeros(())
        key_data = jax.random.key_data(next_key)
        return _Particles(key_data, particles, zero, zero, step_size, jnp.ones(count), 0)

    def finish(particles: jax.Array, data: Data) -> jax.Array:
        return jax.vmap(jax.vmap(density.log_density, (0, None)), (0, None))(particles, data)

    return _SMCPrograms(jax.jit(start), jax.jit(partial(_step, density, options)), jax.jit(finish))


def _step(density: Density, options: SMCOptions, current: _Particles, data: Data) -> _Particles:
    """Return the particles at the next temperature: weighted, resampled and moved by HMC."""
    import blackjax  # only some samplers need this import
    from blackjax.smc import base, resampling

    hmc, count = blackjax.hmc.build_kernel(), options.draws

    def log_likelihood(z: jax.Array) -> jax.Array:
        return jnp.maximum(density.log_likelihood(z, data), _LOWEST)

    step_key, next_key = jax.random.split(jax.random.wrap_key_data(current.key_data))
    particles, temperature = current.particles, current.temperature
    heights = jax.vmap(log_likelihood)(particles)
    increment = _increment(heights, 1.0 - temperature, options.survivors)
    # Sums of increments may miss 1 by round-off.
    last = increment >= 1.0 - temperature
    temperature = jnp.where(last, 1.0, temperature + increment)
    log_weights = increment * heights
    weights = jax.nn.softmax(log_weights)
    covariance = jnp.atleast_2d(jnp.cov(particles, rowvar=False, aweights=weights))

    def transition(rng_key: jax.Array, state: Any, log_density: Any) -> Any:
        # Trajectories of one length could return to their start, again and again.
        length_key, hmc_key = jax.random.split(rng_key)
        size = current.step_size * jax.random.uniform(length_key, minval=0.5)
        return hmc(hmc_key, state, log_density, size, covariance, options.leapfrogs)

    move, _ = base.update_and_take_last(
        blackjax.hmc.init,
        lambda z: density.log_prior(z) + temperature * log_likelihood(z),
        transition,
        options.transitions,
        count,
    )
    resampled, info = base.step(
        step_key,
        base.SMCState(particles, weights, {}),
        move,
        lambda particles: jnp.zeros(len(particles)),
        resampling.systematic,
    )
    rates = info.update_info.acceptance_rate.mean(axis=1)
    return _Particles(
        jax.random.key_data(next_key),
        resampled.particles,
        temperature,
        current.log_evidence + logsumexp(log_weights) - jnp.log(count),
        current.step_size * jnp.exp(rates.mean() - options.target_accept),
        rates,
        current.steps + 1,
    )


def _increment(heights: jax.Array, remaining: jax.Array, survivors: float) -> jax.Array:
    """Return the largest step of the temperature that leaves the wanted effective sample size."""
    from blackjax.smc import ess, solver

    def surplus(increment: jax.Array) -> jax.Array:
        return ess.log_ess(increment * heights) - jnp.log(survivors * len(heights))

    return solver.dichotomy(surplus, 0.0, remaining)


SMC: Sampler = TemperedSMC("smc", SMCOptions)
