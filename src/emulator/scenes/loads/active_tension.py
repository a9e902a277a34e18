r"""Tension that muscle fibres develop, added to the passive stress.

With the tension :math:`T_a` along the fibre :math:`f_0`, and a share :math:`\eta` of it across,

.. math::
    \Psi = \int_\Omega \frac{T_a}{2}
        \left[(I_{4f} - 1) + \eta\,(I_{4s} + I_{4n} - 2)\right] dX, \qquad
    I_{4f} = |F f_0|^2, \quad I_{4s} + I_{4n} = I_1 - I_{4f},

so that the second Piola-Kirchhoff stress gains
:math:`S = T_a\,[f_0 \otimes f_0 + \eta\,(I - f_0 \otimes f_0)]`, as in Land et al. (2015),
problem 3, where :math:`\eta = 0`.

The measures are taken of F itself, also where the law reads isochoric measures or mean dilatation
replaces J, because the published stress depends on F. Isochoric measures would subtract the
pressure :math:`\tfrac13 \operatorname{tr}(F S F^T) / J`, which incompressible tissue cannot feel.

:math:`\Psi` is quadratic in the positions :math:`x = X + u` of the nodes,

.. math::
    \Psi = \frac{T_a}{2} \sum_{ab} k_{ab}\,(x_a \cdot x_b - X_a \cdot X_b), \qquad
    k_{ab} = \int (1 - \eta)\,(f_0 \cdot \nabla N_a)(f_0 \cdot \nabla N_b)
             + \eta\, \nabla N_a \cdot \nabla N_b \; dX .

Shape functions add up to 1, so rows of k add up to 0, and :math:`\Psi` is the energy of linear
springs of stiffness :math:`-T_a k_{ab}` between the nodes a < b of an element:

.. math:: \Psi = -T_a \sum_{a<b} k_{ab}\,\left(D \cdot \Delta + \tfrac12 \Delta \cdot \Delta\right),
          \qquad D = X_b - X_a, \quad \Delta = u_b - u_a .

k is positive semidefinite: the tangent is constant, and tension stiffens. Where parameters turn the
fibres, k differs with theta, and the energy is summed over elements in place of springs,

.. math:: \Psi_e = \frac{T_a}{2} \int (1 - \eta)\,(|f + h f|^2 - 1)
          + \eta\,(|I + h|^2 - 3) \; dX, \qquad h = \partial u/\partial X .

On a body whose loaded shape x is known, with w from there to rest and :math:`f = I + \partial
w/\partial x = F^{-1}`, fibres m of the loaded tissue are :math:`f_0 = f m / |f m|` at rest, and the
force on node a is

.. math:: -\int \sigma \nabla_x N_a\, dx, \qquad \sigma = \det f\; T_a \left[(1 - \eta)\,
          \frac{m \otimes m}{|f m|^2} + \eta\, (f^T f)^{-1}\right].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, override

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation
from emulator.geometry.mesh import Mesh, parts
from emulator.mechanics.kinematics import cofactor, determinant
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.part import Load, LocalForce, LocalTerm, Values, sums
from emulator.scenes.tissue import Fibres


@dataclass(frozen=True)
class ActiveTension(Load):
    """Tension along the fibres, by which muscle contracts; the scene must have fibres.

    Parameters
    ----------
    tension : T_a in kPa, 0 or more; without it, the tension is a parameter of the scene.
    parameter : name of that parameter. It belongs to a load state, so that end-diastole and
        end-systole are two states of one body that share its passive material.
    transverse : share eta of the tension that acts in every direction across the fibre, 0 to 1.
    within : facet set of the body that contracts, where a mesh has several
        (:mod:`emulator.geometry.side_by_side`); by default all do.
    """

    kind: ClassVar[str] = "active_tension"
    magnitude: ClassVar[Quantity] = Quantity("tension", "kPa", low_admitted=True)
    fibres: ClassVar[bool] = True

    tension: float | None = None
    parameter: str = "tension"
    transverse: float = 0.0
    within: str | None = None

    def __post_init__(self) -> None:
        if self.tension is not None and not 0.0 <= self.tension < np.inf:
            raise InputError(f"active_tension: tension is {self.tension} kPa; it must be 0 or more")
        if not 0.0 <= self.transverse <= 1.0:
            raise InputError(
                f"active_tension: transverse is {self.transverse}; it is a share between 0 and 1"
            )

    @property
    def facet_sets(self) -> tuple[str, ...]:
        """The facet set of the body that contracts."""
        return () if self.within is None else (self.within,)

    @property
    def simpler(self) -> tuple[str, None]:
        """Passive tissue."""
        return "active tension", None

    @override
    def first_piola(
        self, F: jax.Array, mesh: Mesh, fibres: jax.Array | None, values: Values
    ) -> jax.Array:
        along = jnp.einsum("mqij,mqj,mqk->mqik", F, fibres, fibres)
        stress = self.value(values) * (along + self.transverse * (F - along))
        return stress * self._contracts(mesh)[:, None, None, None]

    @override
    def terms(self, grid: Discretisation, fibres: Fibres | None = None) -> tuple[LocalTerm, ...]:
        """Return springs between nodes, or element energies where theta turns the fibres."""
        connectivity, (gradients, weights, along) = self._muscle(grid, fibres)

        def of_spring(u: jax.Array, spring: Any, values: Values) -> jax.Array:
            return self.value(values) * energy_of_spring(u, spring)

        def growth(h: jax.Array, weight: jax.Array, f: jax.Array) -> jax.Array:
            """Return the growth of the measures from rest, without cancellation for small h."""
            hf = h @ f
            along = 2.0 * jnp.vdot(f, hf) + jnp.vdot(hf, hf)
            everywhere = 2.0 * jnp.trace(h) + jnp.vdot(h, h)
            return weight * ((1.0 - self.transverse) * along + self.transverse * everywhere)

        def of_element(u: jax.Array, element: Any, values: Values) -> jax.Array:
            gradients, weights, along = element
            h = jnp.einsum("ai,qaj->qij", u, gradients)
            work = jax.vmap(growth)(h, weights, along.at(values))
            return 0.5 * self.value(values) * work.sum()

        if along.angles:
            return (LocalTerm(connectivity, (gradients, weights, along), of_element, convex=True),)
        f, X = along.directions, grid.mesh.nodes
        unit = (1.0 - self.transverse) * f[..., :, None] * f[..., None, :]
        unit = unit + self.transverse * np.eye(3)
        pairs, stiffness = springs(connectivity, gradients, weights, unit)
        ends = (stiffness, X[pairs[:, 1]] - X[pairs[:, 0]])
        return (LocalTerm(pairs, ends, of_spring, convex=True),)

    @override
    def on_loaded(
        self, grid: Discretisation, fibres: Fibres | None = None
    ) -> tuple[LocalForce, ...]:
        """Return the force of the stress on the nodes of each element."""

        def at_point(
            w: jax.Array, gradients: jax.Array, weight: jax.Array, m: jax.Array
        ) -> jax.Array:
            f = jnp.eye(3) + w.T @ gradients
            det, along = determinant(f), f @ m
            stress = (1.0 - self.transverse) * jnp.outer(m, m) / jnp.vdot(along, along)
            if self.transverse:
                F = cofactor(f).T / det
                stress += self.transverse * F @ F.T
            return -weight * det * gradients @ stress

        def force(w: jax.Array, element: Any, values: Values) -> jax.Array:
            gradients, weights, along = element
            forces = jax.vmap(at_point, (None, 0, 0, 0))(w, gradients, weights, along.at(values))
            return self.value(values) * forces.sum(0)

        return (LocalForce(*self._muscle(grid, fibres), force),)

    def _contracts(self, mesh: Mesh) -> np.ndarray:
        """Return whether each element contracts, (m,) bool."""
        if self.within is None:
            return np.ones(len(mesh.elements), bool)
        part = parts(mesh.elements, len(mesh.nodes))
        return np.isin(part[mesh.elements[:, 0]], part[mesh.facet_set(self.within)])

    def _muscle(self, grid: Discretisation, fibres: Fibres | None) -> tuple[np.ndarray, Any]:
        """Return nodes, and gradients, weights and fibres, of the elements that contract."""
        assert fibres is not None, "a scene with this load has fibres"
        muscle = grid.connectivity, (grid.gradients, grid.weights, fibres)
        if self.within is None:
            return muscle
        elements = np.flatnonzero(self._contracts(grid.mesh))
        return jax.tree.map(lambda array: array[elements], muscle)


def springs(
    connectivity: np.ndarray, gradients: Any, weights: Any, stress: Any
) -> tuple[np.ndarray, Any]:
    """Return the springs between nodes whose energy is that of a given stress at rest.

    Parameters
    ----------
    connectivity : (m, a) nodes of the elements.
    gradients, weights : (m, q, a, 3) 1/mm and (m, q) mm3, of their shape functions.
    stress : the second Piola-Kirchhoff stress of size 1, symmetric, (3, 3) or (m, q, 3, 3).

    Returns
    -------
    pairs : (k, 2) nodes of each spring.
    stiffness : ``-k_ab`` (k,) in mm, a traced array where an argument is traced, else of NumPy.
    """
    traced = any(isinstance(a, jax.core.Tracer) for a in (gradients, weights, stress))
    xp: Any = jnp if traced else np
    stressed = xp.matmul(gradients, stress)
    stiffness = xp.einsum("mq,mqai,mqbi->mab", weights, stressed, gradients, optimize=True)
    one, other = np.triu_indices(connectivity.shape[1], 1)
    ends = np.sort(connectivity[:, np.stack([one, other], axis=1)], axis=2).reshape(-1, 2)
    pairs, spring_of_pair = np.unique(ends, axis=0, return_inverse=True)
    return pairs, -sums(len(pairs), spring_of_pair, stiffness[:, one, other])


def energy_of_spring(u: jax.Array, spring: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Return the energy () in mm3 of a spring at size 1, ``stiffness (D . delta + |delta|^2 / 2)``.

    spring : its stiffness () in mm, and the vector D (3,) mm between its nodes at rest.
    """
    stiffness, D = spring
    delta = u[1] - u[0]
    return stiffness * (jnp.vdot(D, delta) + 0.5 * jnp.vdot(delta, delta))
