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

The mesh x + w is a new one for every theta; the program that loads it is one for all of them
(:func:`emulator.fem.moved.moved_system`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.continuation import find_equilibrium
from emulator.fem.implicit import Equations, inert
from emulator.fem.linear import Outcome
from emulator.fem.loop import jit, one_by_one
from emulator.fem.moved import moved_system
from emulator.fem.options import NewtonOptions
from emulator.fem.solution import Solution
from emulator.fem.system import System
from emulator.fem.unloading import Unloaded, Unloader
from emulator.scenes.image import image_theta, unmarked
from emulator.scenes.scene import Scene

_KEPT = 16  # shapes at rest that are kept, for the derivatives asked for after a solve


@dataclass(frozen=True, eq=False)
class LoadedEquilibrium:
    """Unloads the mesh of ``scene`` by the loads of its image and loads it by theta."""

    scene: Scene
    options: NewtonOptions
    factorisation: str

    @cached_property
    def _plain(self) -> Scene:
        return unmarked(self.scene)

    @cached_property
    def unloader(self) -> Unloader:
        """The way to the shape at rest."""
        return Unloader(self._plain, options=self.options, factorisation=self.factorisation)

    @cached_property
    def system(self) -> System:
        """The equations on the mesh, whose pattern those at rest have."""
        return System(self._plain, self.factorisation)

    def solve(self, theta: jax.Array, start: jax.Array | None) -> Solution:
        """Equilibrium at ``theta`` (p,), its displacement (n, 3) in mm from the mesh.

        From ``start`` (n, 3) mm, likewise, or from the unloaded shape. Where that is not found, the
        status is why, and the displacement zero.
        """
        unloaded = self.unloaded(theta)
        w = unloaded.displacement
        begin = jnp.zeros_like(w) if start is None else start - w
        loaded = self._load(theta, w, jax.lax.stop_gradient(begin))
        fine = unloaded.converged

        def chosen(yes: jax.Array, no: jax.Array | float) -> jax.Array:
            return jnp.where(fine, yes, no)

        return Solution(
            displacement=chosen(w + loaded.displacement, 0.0),
            status=chosen(loaded.status, unloaded.status),
            iterations=unloaded.iterations + loaded.iterations,
            factorisations=unloaded.factorisations + loaded.factorisations,
            residual=chosen(loaded.residual, unloaded.residual),
            load_reached=chosen(loaded.load_reached, 0.0),
        )

    def sensitivities(self, v: jax.Array, theta: jax.Array) -> jax.Array:
        """Derivatives (p, n, 3) of the displacement ``v`` (n, 3) mm from the mesh, for numbers."""
        unloaded, image = self.unloaded(theta), image_theta(self.scene, theta)
        turned = jax.jacfwd(partial(image_theta, self.scene))(theta)
        ways = jnp.tensordot(turned.T, self.unloader.sensitivities(unloaded, image), 1)
        w = unloaded.displacement
        return self._columns(theta, w, v - w, ways)

    def equations(self, v: jax.Array, theta: jax.Array) -> tuple[Equations, ...]:
        """Those of w, and those of u, at ``v`` (n, 3) mm from the mesh, for numbers."""
        image = partial(image_theta, self.scene)
        w = self.unloaded(theta).displacement
        (unloading,) = self.unloader.equations(w, image(theta))
        at_rest = unloading.residual
        tangent = self._tangent(theta, w, v - w)
        return (
            unloading._replace(residual=lambda theta, w: at_rest(image(theta), w)),
            Equations(self.system, v - w, tangent, lambda t, w, u: self._residual(u, t, w)),
        )

    def is_stable(self, v: jax.Array, theta: jax.Array) -> bool:
        """Whether the body at ``v`` (n, 3) mm from the mesh is at a minimum of its energy."""
        w = self.unloaded(theta).displacement
        K, nothing = self._tangent(theta, w, v - w), jnp.zeros(len(self.system.free))
        return int(self.system.attempt(K, nothing)[1]) == Outcome.OK

    def unloaded(self, theta: jax.Array) -> Unloaded:
        """The shape at rest; a solve and the derivatives after it share one."""
        image = image_theta(self.scene, theta)
        if isinstance(image, jax.core.Tracer):
            return self.unloader.solve(image)
        key = np.asarray(image).tobytes()
        if key not in self._shapes:
            while len(self._shapes) >= _KEPT:
                self._shapes.pop(next(iter(self._shapes)), None)
            self._shapes[key] = self.unloader.solve(image)
        return self._shapes[key]

    @cached_property
    def _shapes(self) -> dict[bytes, Unloaded]:
        return {}

    def _residual(self, u: jax.Array, theta: jax.Array, w: jax.Array) -> jax.Array:
        return moved_system(self.system, w, theta).residual(u, theta)

    @cached_property
    def _tangent(self) -> Callable[[jax.Array, jax.Array, jax.Array], jax.Array]:
        """Nonzeros (nnz,) of the tangent at theta, w and u."""

        @jit
        def tangent(theta: jax.Array, w: jax.Array, u: jax.Array) -> jax.Array:
            return moved_system(self.system, w, theta).safe_tangent(u, theta)[0]

        return tangent

    @cached_property
    def _load(self) -> Callable[[jax.Array, jax.Array, jax.Array], Solution]:
        """``(theta, w, start) -> Solution`` on the mesh x + w, differentiable in theta and w."""
        system, residual = self.system, self._residual

        def find(theta: jax.Array, w: jax.Array, start: jax.Array) -> Solution:
            return find_equilibrium(moved_system(system, w, theta), self.options, theta, start)

        closed = jit(one_by_one(find))

        @jit
        def moved(
            u: jax.Array, theta: jax.Array, w: jax.Array, *directions: jax.Array
        ) -> jax.Array:
            force = jax.jvp(partial(residual, u), (theta, w), directions)[1]
            tangent = moved_system(system, w, theta).safe_tangent(u, theta)[0]
            return system.extend(-system.solve(tangent, force))

        @jax.custom_jvp
        def load(theta: jax.Array, w: jax.Array, start: jax.Array) -> Solution:
            return closed(theta, w, start)

        @load.defjvp
        def derivative(primals, tangents):  # noqa: ANN001, ANN202
            theta, w, start = primals
            solution = load(theta, w, start)
            way = moved(solution.displacement, theta, w, *tangents[:2])
            return solution, inert(solution)._replace(displacement=way)

        return load

    @cached_property
    def _columns(self) -> Callable[[jax.Array, jax.Array, jax.Array, jax.Array], jax.Array]:
        """Derivatives (p, n, 3) of v, from those of w."""
        system, residual = self.system, self._residual

        @jit
        def columns(theta: jax.Array, w: jax.Array, u: jax.Array, ways: jax.Array) -> jax.Array:
            along = jax.vmap(
                lambda *directions: jax.jvp(partial(residual, u), (theta, w), directions)[1]
            )
            forces = along(jnp.eye(len(theta)), ways)
            tangent = moved_system(system, w, theta).safe_tangent(u, theta)[0]
            return ways + jax.vmap(system.extend, 1)(-system.solve(tangent, forces.T))

        return columns
