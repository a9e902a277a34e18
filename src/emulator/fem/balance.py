"""How far a state is from equilibrium: its residual, and the forces that it is measured by."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.loop import compiled
from emulator.fem.system import System


def relative_residual(
    system: System, u: jax.Array, theta: jax.Array, load: jax.Array | float = 1.0
) -> jax.Array:
    """Norm of the residual relative to the internal and external forces, shape ()."""
    return balance(system, u, theta, load)[1]


class Forces(NamedTuple):
    """Balance of a state.

    residual : (f,) in mN. internal : norm () in mN of the internal forces, reactions included.
    relative : norm of the residual relative to internal and external forces, ().
    """

    residual: jax.Array
    internal: jax.Array
    relative: jax.Array


@compiled
def forces_at(
    system: System,
    u: jax.Array,
    theta: jax.Array,
    load: jax.Array | float,
) -> Forces:
    """Forces at ``u`` (n, 3) mm and ``load`` times the loads, see :func:`balance`."""
    internal = system.internal_force(u, theta)
    external = load * system.external_force(u, theta)
    residual = system.restrict(internal - external)
    size, norm = _norm(internal), _norm(residual)
    scale = size + _norm(external)
    return Forces(residual, size, norm / jnp.where(scale > 0.0, scale, 1.0))


def balance(
    system: System,
    u: jax.Array,
    theta: jax.Array,
    load: jax.Array | float = 1.0,
) -> tuple[jax.Array, jax.Array]:
    """Residual (f,) in mN, and its norm relative to internal and external forces, shape ().

    The forces include reactions. The relative residual of a body without any forces is 0. NaN stays
    NaN.
    """
    forces = forces_at(system, u, theta, load)
    return forces.residual, forces.relative


def level_balance(
    system: System, u: jax.Array, theta: jax.Array, level: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """:func:`balance`, its relative size infinite unless finite and the supports are met."""
    residual, error = balance(system, u, theta, level)
    return residual, _where_met(system, u, theta, level, error)


@compiled
def _where_met(
    system: System, u: jax.Array, theta: jax.Array, level: jax.Array, error: jax.Array
) -> jax.Array:
    met = system.supports_met(u, theta, level)
    return jnp.where(met & jnp.isfinite(error), error, jnp.inf)


def _norm(field: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(field**2))
