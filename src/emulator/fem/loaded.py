r"""Equilibria of a scene whose mesh x is its shape under load, as in an image.

With the stress-free shape x + w of the loads in the image, and the displacement u from there,

.. math::
    r_\text{inv}(w, \theta_\text{image}) = 0, \qquad r_{x + w}(u, \theta) = 0, \qquad
    v = w + u,

v is the displacement from the mesh, which observations of the image's body are functions of. Its
derivatives follow by the chain rule,

.. math::
    K\, du = -\left(\frac{\partial r}{\partial \theta}\, d\theta
        + \frac{\partial r}{\partial w}\, dw\right), \qquad dv = dw + du .

The mesh x + w is a new one for every theta; one program loads all of them
(:func:`emulator.fem.unloading.system_at_rest`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.assembly import System
from emulator.fem.compiled import compiled, is_traced, one_by_one
from emulator.fem.derivatives import Equations, implicit
from emulator.fem.fallbacks import find_equilibrium
from emulator.fem.newton import NewtonOptions
from emulator.fem.solution import Solution
from emulator.fem.unloading import Unloaded, Unloader, system_at_rest, unchecked
from emulator.scenes.scene import Scene

_RECENT = 16  # stress-free shapes kept for derivatives after a solve


@dataclass(frozen=True, eq=False)
class LoadedEquilibrium:
    """Unloads the mesh of a scene by the loads of its image, and loads it at theta.

    scene : the scene, with ``loaded_by``.
    options : the controls of Newton's method.
    """

    scene: Scene
    options: NewtonOptions

    @cached_property
    def _on_mesh(self) -> Scene:
        """The scene with its mesh taken as stress-free.

        A parameter that only the image has is then nobody's, which a new scene would refuse.
        """
        return unchecked(self.scene, loaded_by=MappingProxyType({}))

    @cached_property
    def unloader(self) -> Unloader:
        """The solver of the inverse problem, which returns the stress-free shape."""
        return Unloader(self._on_mesh, options=self.options)

    @cached_property
    def system(self) -> System:
        """The equations on the mesh; equations at rest have this sparsity pattern."""
        return System(self._on_mesh)

    def solve(self, theta: jax.Array, start: jax.Array | None) -> Solution:
        """Return the equilibrium at ``theta`` (p,), its displacement (n, 3) in mm from the mesh.

        It is sought from ``start`` (n, 3) mm, a displacement from the mesh, too; by default from
        the mesh itself, which is the equilibrium of the image's loads. Where it is not found, the
        status says why, and the displacement is zero.
        """
        unloaded = self.unloaded(theta)
        w = unloaded.displacement
        begin = -w if start is None else start - w
        loaded = self._load(theta, w, jax.lax.stop_gradient(begin))

        def select(if_unloaded: jax.Array, otherwise: jax.Array | float) -> jax.Array:
            return jnp.where(unloaded.converged, if_unloaded, otherwise)

        return Solution(
            displacement=select(w + loaded.displacement, 0.0),
            status=select(loaded.status, unloaded.status),
            iterations=unloaded.iterations + loaded.iterations,
            factorisations=unloaded.factorisations + loaded.factorisations,
            residual=select(loaded.residual, unloaded.residual),
            load_reached=select(loaded.load_reached, 0.0),
        )

    def unloaded(self, theta: jax.Array) -> Unloaded:
        """Return the stress-free shape; a solve and the derivatives after it share one."""
        image = image_theta(self.scene, theta)
        if is_traced(image):
            return self.unloader.solve(image)
        return self._recent(tuple(np.asarray(image).tolist()))

    @cached_property
    def _recent(self) -> Callable[[tuple[float, ...]], Unloaded]:
        """The stress-free shape by the numbers of theta; the most recent ones are kept."""
        return lru_cache(_RECENT)(lambda theta: self.unloader.solve(jnp.array(theta)))

    def sensitivities(self, v: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the derivatives (p, n, 3) of the displacement ``v`` (n, 3) mm, for numbers."""
        unloaded, image = self.unloaded(theta), image_theta(self.scene, theta)
        image_slopes = jax.jacfwd(partial(image_theta, self.scene))(theta)
        by_image = self.unloader.sensitivities(unloaded, image)
        w, w_slopes = unloaded.displacement, jnp.tensordot(image_slopes.T, by_image, 1)
        directions = jnp.eye(len(theta))
        return w_slopes + _derivatives_along(self.system, v - w, theta, w, directions, w_slopes)

    def equations(self, v: jax.Array, theta: jax.Array) -> tuple[Equations, ...]:
        """Return the equations of w and of u, at ``v`` (n, 3) mm from the mesh."""
        image, system = partial(image_theta, self.scene), self.system
        w = self.unloaded(theta).displacement
        (unloading,) = self.unloader.equations(w, image(theta))
        residual = unloading.residual
        return (
            unloading._replace(residual=lambda theta, w: residual(image(theta), w)),
            Equations(
                system,
                v - w,
                _tangent(system, v - w, theta, w),
                lambda theta, w, u: system_at_rest(system, w, theta).residual(u, theta),
            ),
        )

    def is_stable(self, v: jax.Array, theta: jax.Array) -> bool:
        """Return whether ``v`` (n, 3) mm from the mesh is a minimum of the energy."""
        w = self.unloaded(theta).displacement
        return self.system.is_definite(_tangent(self.system, v - w, theta, w))

    @cached_property
    def _load(self) -> Callable[[jax.Array, jax.Array, jax.Array], Solution]:
        """``(theta, w, start) -> Solution`` on the mesh x + w, differentiable in theta and w."""
        system = self.system

        def find(theta: jax.Array, w: jax.Array, start: jax.Array) -> Solution:
            return find_equilibrium(system_at_rest(system, w, theta), self.options, theta, start)

        def derivative(
            u: jax.Array, theta: jax.Array, w: jax.Array, *directions: jax.Array
        ) -> jax.Array:
            return _derivatives_along(system, u, theta, w, *(d[None] for d in directions))[0]

        return implicit(compiled(one_by_one(find)), derivative)


@compiled
def _tangent(system: System, u: jax.Array, theta: jax.Array, w: jax.Array) -> jax.Array:
    """Return the nonzeros (nnz,) of the tangent at ``u`` (n, 3) mm from the mesh x + w."""
    return system_at_rest(system, w, theta).safe_tangent(u, theta)[0]


@compiled
def _derivatives_along(
    system: System, u: jax.Array, theta: jax.Array, w: jax.Array, *directions: jax.Array
) -> jax.Array:
    """Return the derivatives (k, n, 3) of ``u`` along directions (k, p) in theta and in w."""
    residual = lambda theta, w: system_at_rest(system, w, theta).residual(u, theta)  # noqa: E731
    forces = jax.vmap(lambda *along: jax.jvp(residual, (theta, w), along)[1])(*directions)
    solution = -system.solve(_tangent(system, u, theta, w), forces.T)
    return jax.vmap(system.extend, 1)(solution)


def image_theta(scene: Scene, theta: jax.Array) -> jax.Array:
    """Return ``theta`` (p,) with the loads of the image, unchanged where the mesh is at rest."""
    values, theta = scene.resolve(theta), jnp.asarray(theta)
    for load, image in scene.loaded_by.items():
        theta = theta.at[scene.parameter_names.index(load)].set(values[image])
    return theta
