r"""The stress-free shape by repeated loading: fixed-point iteration.

The displacement w from the loaded shape x to the stress-free one is corrected by how far the shape
x + w, once loaded, is from x,

.. math::
    R_k = w_k + u(x + w_k), \qquad w_{k+1} = w_k - \beta_k R_k

(Sellier 2011, Int. J. Comput. Methods 8, 463-474), with Aitken's relaxation

.. math::
    \beta_k = -\beta_{k-1} \frac{R_{k-1} \cdot (R_k - R_{k-1})}{|R_k - R_{k-1}|^2}

(Rausch, Genet & Humphrey 2017, J. Biomech. 58, 227-231). An iteration is a solve of the scene on a
mesh of its own, by one program for all of them (:func:`emulator.fem.moved.moved`). A correction is
halved until it inverts no element.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.continuation import find_equilibrium
from emulator.fem.halving import largest_sound
from emulator.fem.loop import while_loop
from emulator.fem.moved import moved_system
from emulator.fem.options import NewtonOptions
from emulator.fem.solution import Solution, Status
from emulator.fem.system import System

_MOST = 100  # corrections
_MET = 1e-11  # of the body's size: largest distance of the shape loaded again from the given one
_SHORTEST = 2.0**-6  # fraction of a correction
_RELAXATION = (0.1, 2.0)  # of Aitken's


class _State(NamedTuple):
    """Where the iteration stands.

    w, u : (n, 3) mm; u loads x + w. missed : R, (n, 3) mm, of the last correction. relaxation : (),
    its beta. corrections : so far. iterations, factorisations : of the solves. status : a
    :class:`Status`.
    """

    w: jax.Array
    u: jax.Array
    missed: jax.Array
    relaxation: jax.Array
    corrections: jax.Array
    iterations: jax.Array
    factorisations: jax.Array
    status: jax.Array


def find_by_loading(
    system: System, options: NewtonOptions, theta: jax.Array, start: jax.Array
) -> Solution:
    """The root w of the inverse ``system``, from ``start`` (n, 3) mm, by loading again and again.

    ``options`` are those of the solves. The residual is left to the caller.
    """
    enough = _MET * system.scene.mesh.size

    def correct(state: _State) -> _State:
        there = moved_system(system, state.w, theta)
        loaded = find_equilibrium(there, options, theta, state.u)
        solved = loaded.status == Status.CONVERGED
        missed = state.w + loaded.displacement
        relaxation = _aitken(state, missed)
        move = -relaxation * missed
        floor = options.shrink * system.least_volume_ratio(state.w)
        fraction = largest_sound(
            lambda part: floor < system.least_volume_ratio(state.w + part * move), _SHORTEST
        )
        met = jnp.max(jnp.abs(missed)) <= enough
        status = jnp.where(state.corrections + 1 >= _MOST, Status.ITERATION_LIMIT, Status.RUNNING)
        status = jnp.where(fraction > 0.0, status, Status.INVERTED_ELEMENT)
        status = jnp.where(met, Status.CONVERGED, status)
        status = jnp.where(solved, status, loaded.status)
        goes_on = status == Status.RUNNING
        return _State(
            w=jnp.where(goes_on, state.w + fraction * move, state.w),
            u=loaded.displacement,
            missed=missed,
            relaxation=relaxation,
            corrections=state.corrections + 1,
            iterations=state.iterations + loaded.iterations,
            factorisations=state.factorisations + loaded.factorisations,
            status=jnp.asarray(status, dtype=jnp.int64),
        )

    end = while_loop(lambda state: state.status == Status.RUNNING, correct, _begin(start))
    met = end.status == Status.CONVERGED
    return Solution(
        displacement=jnp.where(met, end.w, 0.0),
        status=end.status,
        iterations=end.iterations,
        factorisations=end.factorisations,
        residual=jnp.full((), jnp.inf),
        load_reached=jnp.where(met, 1.0, 0.0),
    )


def _begin(start: jax.Array) -> _State:
    count, nothing = jnp.zeros((), dtype=int), jnp.zeros_like(start)
    running = jnp.asarray(Status.RUNNING, dtype=jnp.int64)
    return _State(start, -start, nothing, jnp.ones(()), count, count, count, running)


def _aitken(state: _State, missed: jax.Array) -> jax.Array:
    """Relaxation () of the next correction; 1 at the first."""
    change = missed - state.missed
    size = jnp.sum(change**2)
    found = -state.relaxation * jnp.vdot(state.missed, change) / jnp.where(size > 0.0, size, 1.0)
    return jnp.where(state.corrections > 0, jnp.clip(found, *_RELAXATION), 1.0)
