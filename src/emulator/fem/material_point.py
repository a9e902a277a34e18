r"""Stress and moduli at one integration point: a law as a function of strain measures.

.. math:: W(H) = \varphi(\xi(H)), \qquad
    \frac{\partial^2 W}{\partial H^2} = \xi'^T \varphi''\, \xi' + \varphi' \cdot \xi''

with the measures' derivatives in closed form (:mod:`emulator.mechanics.measures`). That takes a
quarter of the time of differentiating W twice, and a quarter of the compilation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp

from emulator.fem.energy import parameters_at, point_energy
from emulator.mechanics.measures import Measures, measures_read
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import Tissue

_BISECTIONS = 7
_REFINEMENTS = 3


def stress_and_moduli(
    scene: Scene, theta: jax.Array
) -> Callable[[jax.Array, Tissue], tuple[jax.Array, jax.Array]]:
    """Return ``(H, tissue) -> dW/dH (3, 3), d2W/dH2 (3, 3, 3, 3)``, both in kPa."""
    if measures_read(scene.law) is None:
        energy = point_energy(scene, theta)
        return lambda H, at: (jax.grad(energy)(H, at), jax.hessian(energy)(H, at))
    point = MaterialPoint(scene, theta)

    def at_point(H: jax.Array, at: Tissue) -> tuple[jax.Array, jax.Array]:
        return point.linearise(H, point.measures.of(H, at.directions), at)[:2]

    return at_point


@dataclass(frozen=True)
class MaterialPoint:
    """One integration point of a scene whose law reads nothing but measures, at ``theta`` (p,)."""

    scene: Scene
    theta: jax.Array

    @cached_property
    def measures(self) -> Measures:
        """The strain measures that the law reads."""
        names = measures_read(self.scene.law)
        assert names is not None
        return Measures(names)

    def energy(self, at: Tissue) -> Callable[[jax.Array], jax.Array]:
        """Return the strain energy density in kPa as a function of the measures (k,)."""
        law, parameters = self.scene.law, parameters_at(self.scene, self.theta)(at)
        return self.measures.energy(lambda strain: law.energy(strain, *parameters), at.directions)

    def linearise(
        self, H: jax.Array, xi: jax.Array, at: Tissue, geometric: jax.Array | float = 1.0
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return stress P (3, 3), moduli (3, 3, 3, 3) and known stress (3, 3) in kPa.

        H : the displacement gradient, (3, 3).
        xi : the measures (k,) that the point's stresses belong to.
        at : the tissue.
        geometric : the fraction of the stresses' change since rest whose geometric stiffness the
            moduli have: the known stress is that at rest and this fraction of the change.
        """
        phi = self.energy(at)

        def stresses(xi: jax.Array) -> tuple[jax.Array, jax.Array]:
            s = jax.grad(phi)(xi)
            return s, s

        # Derivatives that return their values as well save one trace.
        C, s = jax.jacfwd(stresses, has_aux=True)(xi)
        at_rest = jax.grad(phi)(jnp.zeros_like(xi))
        known = at_rest + geometric * (s - at_rest)
        now = self.measures.of(H, at.directions)
        slope, curvature = self.measures.derivatives(H, at.directions, known)
        stress = jnp.tensordot(s + C @ (now - xi), slope, 1)
        tangent = jnp.einsum("kij,kl,lab->ijab", slope, C, slope) + curvature
        return stress, tangent, jnp.tensordot(known, slope, 1)

    def at_stress(self, H: jax.Array, change: jax.Array, xi: jax.Array, at: Tissue) -> jax.Array:
        """Return the measures (k,) at which the law has the stress that the step predicts.

        H, change : the displacement gradient (3, 3) and its change in the step.
        xi : the measures before the step.
        """
        phi = self.energy(at)
        now, along = jax.jvp(lambda H: self.measures.of(H, at.directions), (H,), (change,))
        step, blocks = now + along - xi, jnp.asarray(self.measures.blocks)
        parts = fractions_at_stress(len(blocks), lambda beta: phi(xi + (beta @ blocks) * step))
        return xi + (parts @ blocks) * step


def fractions_at_stress(count: int, energy: Callable[[jax.Array], jax.Array]) -> jax.Array:
    r"""Return the fractions (count,) in [0, 1] of a step at which a law has the predicted stresses.

    ``energy`` e is a function of the fractions. They satisfy
    :math:`e_{,i}(\beta) = e_{,i}(0) + \sum_j e_{,ij}(0)`; they are 1 where the whole step does not
    stiffen the law, and stop where the energy is no longer finite. Each has its own scalar
    equation, and all are solved at the same time: most laws are sums of functions of one measure
    each, whose equations do not interact. A law that begins without stiffness predicts no stress. A
    fibre that becomes taut on the way is therefore taken just past that point, so that the next
    iteration has its stiffness.
    """

    def slopes(beta: jax.Array) -> jax.Array:
        value, along = jax.value_and_grad(energy)(beta)
        finite = jnp.isfinite(along)
        # The slope of a logarithm is finite where the logarithm itself is not.
        return jnp.where(finite & (jnp.isfinite(value) | ~finite.all()), along, jnp.inf)

    def both(beta: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(slopes, (beta,), (jnp.ones(count),))

    start, stiffness = both(jnp.zeros(count))
    predicted = start + stiffness

    def halve(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        below = slopes(middle) <= predicted
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    low, high = jax.lax.fori_loop(0, _BISECTIONS, halve, (jnp.zeros(count), jnp.ones(count)))

    def refine(_: int, beta: jax.Array) -> jax.Array:
        value, rise = both(beta)
        better = beta - (value - predicted) / jnp.where(rise > 0.0, rise, jnp.inf)
        return jnp.where(jnp.isfinite(better), jnp.clip(better, low, high), beta)

    beta = jax.lax.fori_loop(0, _REFINEMENTS, refine, 0.5 * (low + high))
    beta = jnp.where(stiffness > 0.0, beta, high)
    return jnp.where(slopes(jnp.ones(count)) <= predicted, 1.0, beta)
