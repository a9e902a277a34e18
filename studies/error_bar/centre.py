"""Error estimates by one tangent, factorised once at the centre of the box."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import emulator as em
from emulator.accuracy.estimate import valid_state
from emulator.fem.linear.reuse import conjugate_gradients

ITERATIONS = 4


def centre_estimate(simulator: em.Simulator) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Return a function of ``u`` (n, 3) mm and theta (p,) that estimates the error of ``u``.

    It solves ``K(u) e = r`` by conjugate gradients, preconditioned by the tangent of the centre.
    """
    scene, system = simulator.scene, simulator.system
    centre = simulator(scene.centre)
    factorised = jnp.asarray(np.asarray(simulator.tangent(centre, scene.centre)))

    @jax.jit
    def estimate(u: jax.Array, theta: jax.Array) -> jax.Array:
        state, theta = valid_state(scene, centre, u, theta)

        def stiffness(v: jax.Array) -> jax.Array:
            along = (system.extend(v),)
            return jax.jvp(lambda w: system.residual(w, theta), (state,), along)[1]

        force = system.residual(state, theta)
        solution = conjugate_gradients(
            stiffness, lambda b: system.attempt(factorised, b)[0], force, ITERATIONS, 0.0
        )
        error = u - state + system.extend(solution.x)
        return jnp.where(jnp.all(jnp.isfinite(error)), error, u - centre)

    return estimate
