r"""Inertia, and rates at the end of a time step.

With the mass matrix M, forces f (those of the body less those of its loads) and a step of h,
Newmark's formulas and the balance of Wood, Bossak and Zienkiewicz (1980), which is the
generalised-alpha method of Chung and Hulbert (1993) with :math:`\alpha_f = 0`, are

.. math::
    u = \tilde u + \beta h^2 a, \quad \tilde u = u_0 + h v_0 + (\tfrac12 - \beta) h^2 a_0, \quad
    v = v_0 + h\,[(1 - \gamma) a_0 + \gamma a], \quad
    M [(1 - \alpha) a + \alpha a_0] + f(u) = 0 ,

    \alpha = \frac{\rho - 1}{\rho + 1}, \quad \gamma = \tfrac12 - \alpha, \quad
    \beta = \tfrac14 (1 - \alpha)^2 ,

of second order, stable for every step, with the share :math:`\rho` of the highest frequencies that
a step leaves. So u minimises the potential of f and of springs of mass,

.. math::
    \Pi(u) + \tfrac{c}{2} (u - w)^T M (u - w), \qquad c = \frac{1 - \alpha}{\beta h^2}, \quad
    w = \tilde u - \frac{\alpha}{c}\, a_0 .

A rate is that of the parabola through the last three values, which is of second order and damps
what is fast; of a first step, or of one more than twice as long as the one before, of a line:

.. math::
    \dot x = \frac{1}{h} (k_0 x + k_1 x_0 + k_2 x_{-1}), \qquad
    k_0 = \frac{1 + 2 r}{1 + r}, \quad k_1 = -(1 + r), \quad k_2 = \frac{r^2}{1 + r}, \quad
    r = h / h_{-1} .
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.viscosity.series import of_table

_LONGER = 2.0  # times as long as the step before, up to which a parabola is stable
_KG_PER_MM3 = 1e-6  # g/cm3; 1 kg is 1 mN s2/mm


@dataclass(frozen=True)
class Inertia:
    """The mass of a body, and how a time step treats it.

    Parameters
    ----------
    density : the mass density in g/cm3, above 0.
    spectral_radius : the share rho, 0 to 1, of the fastest vibrations that a time step leaves.
    """

    density: float = 1.05
    spectral_radius: float = 0.8

    def __post_init__(self) -> None:
        if not 0.0 < self.density < np.inf:
            raise InputError(f"inertia: density is {self.density} g/cm3; it must be above 0")
        if not 0.0 <= self.spectral_radius <= 1.0:
            raise InputError(
                f"inertia: spectral_radius is {self.spectral_radius}; give a share from 0 to 1"
            )

    @property
    def mass_density(self) -> float:
        """The density in kg/mm3."""
        return _KG_PER_MM3 * self.density

    @property
    def newmark(self) -> tuple[float, float, float]:
        """The numbers alpha, beta and gamma of the method."""
        alpha = (self.spectral_radius - 1.0) / (self.spectral_radius + 1.0)
        return alpha, 0.25 * (1.0 - alpha) ** 2, 0.5 - alpha


def inertia_of(entries: Inertia | Mapping[str, Any]) -> Inertia:
    """Return the inertia of the table of a scene file; one that is made already as it is."""
    return of_table(Inertia, entries, "inertia")


class Motion(NamedTuple):
    """The motion of a body at a time.

    u, before : the displacement at that time and at the one before it, (n, 3) mm.
    velocity, acceleration : (n, 3) in mm/s and mm/s2; of a body without inertia, zero.
    interval : the interval between the two times, s, (); 0 at the beginning.
    """

    u: jax.Array
    before: jax.Array
    velocity: jax.Array
    acceleration: jax.Array
    interval: jax.Array


def rest(shape: tuple[int, ...]) -> Motion:
    """Return the motion of a body at rest, with arrays of ``shape``."""
    zero = jnp.zeros(shape)
    return Motion(zero, zero, zero, zero, jnp.zeros(()))


class Anchor(NamedTuple):
    """A factor, in 1/s2 or 1/s, of the way from a place (n, 3) mm: of an acceleration or a rate."""

    factor: jax.Array
    place: jax.Array


def mass_anchor(inertia: Inertia, motion: Motion, interval: jax.Array) -> Anchor:
    """Return c and w of a step of ``interval`` s."""
    alpha, beta, _ = inertia.newmark
    factor = (1.0 - alpha) / (beta * interval**2)
    predicted = _predicted(beta, motion, interval)
    return Anchor(factor, predicted - alpha / factor * motion.acceleration)


def _predicted(beta: float, motion: Motion, interval: jax.Array) -> jax.Array:
    way = motion.velocity + (0.5 - beta) * interval * motion.acceleration
    return motion.u + interval * way


def rate_anchor(now: jax.Array, before: jax.Array, motion: Motion, interval: jax.Array) -> Anchor:
    """Return the anchor of the rate, in 1/s, of a quantity at the end of a step.

    now, before : the quantity (...) at the time of ``motion`` and at the one before it.
    """
    longer = interval > _LONGER * motion.interval
    r = interval / jnp.where(longer, 1.0, motion.interval)
    k0 = jnp.where(longer, 1.0, (1.0 + 2.0 * r) / (1.0 + r))
    k1 = jnp.where(longer, -1.0, -(1.0 + r))
    k2 = jnp.where(longer, 0.0, r**2 / (1.0 + r))
    return Anchor(k0 / interval, -(k1 * now + k2 * before) / k0)


def motion_after(
    inertia: Inertia | None, motion: Motion, u: jax.Array, interval: jax.Array
) -> Motion:
    """Return the motion after a step of ``interval`` s to ``u`` (n, 3) mm."""
    velocity, acceleration = motion.velocity, motion.acceleration
    if inertia is not None:
        _, beta, gamma = inertia.newmark
        new = (u - _predicted(beta, motion, interval)) / (beta * interval**2)
        velocity = velocity + interval * ((1.0 - gamma) * acceleration + gamma * new)
        acceleration = new
    return Motion(u, motion.u, velocity, acceleration, interval)
