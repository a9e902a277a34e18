r"""What happens at one integration point: a law as a function of strain measures, linearised.

.. math:: W(H) = \varphi(\xi(H)), \qquad
    \frac{\partial^2 W}{\partial H^2} = \xi'^T \varphi''\, \xi' + \varphi' \cdot \xi''

with the measures' derivatives in closed form (:mod:`emulator.mechanics.measures`): a quarter of
the time that differentiating W twice takes, and of its compilation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp

from emulator.fem.energy import point_energy, strain_law
from emulator.mechanics.measures import Measures, measures_read
from emulator.scenes.regions import Tissue
from emulator.scenes.scene import Scene

_BISECTIONS = 7
_REFINEMENTS = 3


def stress_and_moduli(
    scene: Scene, theta: jax.Array
) -> Callable[[jax.Array, Tissue], tuple[jax.Array, jax.Array]]:
    """``dW/dH`` (3, 3) and ``d2W/dH2`` (3, 3, 3, 3) in kPa at a gradient (3, 3) and its tissue."""
    if measures_read(scene.law) is None:
        energy = point_energy(scene, theta)
        return lambda H, at: (jax.grad(energy)(H, at), jax.hessian(energy)(H, at))
    point = MaterialPoint(scene, theta)

    def at_point(H: jax.Array, at: Tissue) -> tuple[jax.Array, jax.Array]:
        return point.linearise(H, point.measures.of(H, at.directions), at)[:2]

    return at_point


def _measures(scene: Scene) -> Measures:
    names = measures_read(scene.law)
    assert names is not None
    return Measures(names)


@dataclass(frozen=True)
class MaterialPoint:
    """What happens at one integration point, at ``theta`` (p,)."""

    scene: Scene
    theta: jax.Array

    @cached_property
    def measures(self) -> Measures:
        """The strain measures that the law reads."""
        return _measures(self.scene)

    def energy(self, at: Tissue) -> Callable[[jax.Array], jax.Array]:
        """Strain energy density in kPa as a function of the measures (k,)."""
        law = strain_law(self.scene, self.theta)
        return self.measures.energy(lambda strain: law(strain, at), at.directions)

    def linearise(
        self, H: jax.Array, own: jax.Array, at: Tissue, geometric: jax.Array | float = 1.0
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Stress P (3, 3), tangent (3, 3, 3, 3) and known stress (3, 3) in kPa at a point.

        The known stress is that whose stiffness the tangent has. geometric : fraction of the
        stresses' change since rest that is known.
        """
        phi = self.energy(at)

        def stresses(own: jax.Array) -> tuple[jax.Array, jax.Array]:
            s = jax.grad(phi)(own)
            return s, s

        # Derivatives with their values beside them are traced once less.
        C, s = jax.jacfwd(stresses, has_aux=True)(own)
        at_rest = jax.grad(phi)(jnp.zeros_like(own))
        known = at_rest + geometric * (s - at_rest)
        now = self.measures.of(H, at.directions)
        slope, curvature = self.measures.derivatives(H, at.directions, known)
        stress = jnp.tensordot(s + C @ (now - own), slope, 1)
        tangent = jnp.einsum("kij,kl,lab->ijab", slope, C, slope) + curvature
        return stress, tangent, jnp.tensordot(known, slope, 1)

    def at_stress(self, H: jax.Array, change: jax.Array, own: jax.Array, at: Tissue) -> jax.Array:
        """Measures (k,) of a point where the law has the stress that its step promises."""
        phi = self.energy(at)
        xi, along = jax.jvp(lambda H: self.measures.of(H, at.directions), (H,), (change,))
        step, blocks = xi + along - own, jnp.asarray(self.measures.blocks)
        parts = fractions_at_stress(len(blocks), lambda beta: phi(own + (beta @ blocks) * step))
        return own + (parts @ blocks) * step


def fractions_at_stress(count: int, energy: Callable[[jax.Array], jax.Array]) -> jax.Array:
    r"""The parts of a step, (count,) in [0, 1], that take a law to the stresses that are promised.

    ``energy`` e is a function of the parts. They have
    :math:`e_{,i}(\beta) = e_{,i}(0) + \sum_j e_{,ij}(0)`; 1 where the whole step does not stiffen
    the law, and short of where the energy is not finite. All are sought at the same time, each by
    its own equation: most laws are sums of functions of one measure each, and there they do not
    know of each other. Where the law begins without stiffness it promises nothing: a fibre that
    pulls taut on the way is taken just past that point, for its stiffness to be met there by the
    next iteration.
    """

    def slopes(beta: jax.Array) -> jax.Array:
        value, along = jax.value_and_grad(energy)(beta)
        finite = jnp.isfinite(along)
        # The slope of a logarithm is finite where the logarithm itself is not.
        return jnp.where(finite & (jnp.isfinite(value) | ~finite.all()), along, jnp.inf)

    def both(beta: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(slopes, (beta,), (jnp.ones(count),))

    start, stiffness = both(jnp.zeros(count))
    wanted = start + stiffness

    def halve(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        below = slopes(middle) <= wanted
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    low, high = jax.lax.fori_loop(0, _BISECTIONS, halve, (jnp.zeros(count), jnp.ones(count)))

    def refine(_: int, beta: jax.Array) -> jax.Array:
        value, rise = both(beta)
        better = beta - (value - wanted) / jnp.where(rise > 0.0, rise, jnp.inf)
        return jnp.where(jnp.isfinite(better), jnp.clip(better, low, high), beta)

    beta = jax.lax.fori_loop(0, _REFINEMENTS, refine, 0.5 * (low + high))
    beta = jnp.where(stiffness > 0.0, beta, high)
    return jnp.where(slopes(jnp.ones(count)) <= wanted, 1.0, beta)
