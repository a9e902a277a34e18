r"""Inverse motion: equilibrium on a known loaded shape, for the way back to the stress-free one.

The mesh of the scene, x, is loaded; the unknown is the displacement w to the stress-free shape
X = x + w (Govindjee & Mihalic 1996, Comput. Methods Appl. Mech. Engng 136, 47-57). With
:math:`h = \partial w/\partial x`, elements at X are mapped to those at x by

.. math::
    f = I + h, \qquad F = f^{-1}, \qquad H = F - I = -F h, \qquad dX = \det f\, dx,

so that the equations of the scene on the mesh X, at the displacement u = -w, are

.. math::
    r_a(w) = \sum_q \omega_q\, \sigma(f)\, \nabla_x N_a - f_a^\text{ext}(w) = 0,
    \qquad \sigma = \det f\; \tau, \qquad \tau = P(F)\, F^T

at free nodes, to round-off: loading the mesh X leads to x. :math:`\omega_q` are the quadrature
weights of x, :math:`\tau` is the Kirchhoff and :math:`\sigma` the Cauchy stress. A pressure acts on
the known shape and does not depend on w; weight and dead tractions are given per volume and area at
rest and do. Prescribed displacements are zero.

Directions m of the loaded tissue are carried back as material lines, :math:`f_0 = f m / |f m|`.
Sheets are carried back likewise and then turned to be orthogonal to the fibres, in the plane of
both: laws are written for orthogonal ones. The derivative of the stress is

.. math::
    d\tau = \left(\frac{\partial P}{\partial F} : dF
        + \frac{\partial P}{\partial f_0} \cdot df_0\right) F^T + P\, dF^T ,

where only F and :math:`f_0` are differentiated along all nine components of h, never the law. Where
points have volume ratios of their own, with :math:`A = \partial\sigma/\partial h`,

.. math::
    K_{ab} = \sum_q \omega_q\, \nabla N_a \cdot A\, \nabla N_b .

With mean dilatation, and with v and V the volumes of a block at x and at X,

.. math::
    r_a = \sum_q \omega_q \left(\det f\, \operatorname{dev} \hat\tau + p I\right) \nabla_x N_a,
    \qquad \theta = \frac{v}{V} = \frac{\sum_q \omega_q}{\sum_q \omega_q \det f},
    \qquad p = \frac{1}{3v} \sum_q \omega_q \det f\, \operatorname{tr} \hat\tau,

:math:`\hat\tau` being the law's Kirchhoff stress at :math:`\hat F = (\theta \det f)^{1/3} F`.
:math:`\theta` and p are unknowns, eliminated block by block: with :math:`c = V_w`,
:math:`b = \sum \omega \nabla N`, :math:`d = \sum \omega \det f \operatorname{dev}
\hat\tau_\theta \nabla N`, :math:`e = p_w`, :math:`g = p_\theta`, and the residuals
:math:`r_\theta = \theta V - v`, :math:`r_p = p - p(w, \theta)`,

.. math::
    K_e = K_{ww} - (d + g b) \otimes \theta c / V + b \otimes e, \qquad
    f_e = r_w - (d + g b)\, r_\theta / V - b\, r_p .

The tangent is not symmetric, and the solution is no minimum: natural monotonicity judges steps
(:mod:`emulator.fem.formulations.mean_dilatation`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.assembly import System
from emulator.fem.condensation import (
    Volumes,
    block_gradients,
    block_integral,
    per_point,
    volume_change,
)
from emulator.fem.energy import (
    DeadForce,
    at_points,
    nodal_vectors,
    pair_matrices,
    point_energy,
    with_volume_change,
)
from emulator.fem.linear import Pattern, block_pattern, whole_blocks
from emulator.fem.material_point import stress_and_moduli
from emulator.mechanics.kinematics import cofactor, determinant
from emulator.scenes.part import LocalForce, LocalTerm
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import Tissue

PointState = Callable[..., tuple[jax.Array, jax.Array | None]]
"""The displacement gradient and directions that the law sees, of a point and its directions."""


# One material point


def carried_back(h: jax.Array, directions: jax.Array | None) -> jax.Array | None:
    """Return the directions (3,) or (2, 3) at rest from the loaded tissue's directions."""
    if directions is None:
        return None
    f = h + jnp.eye(3, dtype=h.dtype)
    if directions.ndim == 1:
        return _unit(f @ directions)
    fibre, sheet = _unit(f @ directions[0]), f @ directions[1]
    return jnp.stack([fibre, _unit(sheet - jnp.vdot(sheet, fibre) * fibre)])


def from_rest(h: jax.Array) -> jax.Array:
    """Return the displacement gradient ``H = F - I`` (3, 3) from rest, without loss of digits."""
    f = h + jnp.eye(3, dtype=h.dtype)
    return -(cofactor(f).T / determinant(f)) @ h


def pointwise_state(h: jax.Array, directions: jax.Array | None) -> tuple[jax.Array, Any]:
    """Return what the law sees at a point with a volume ratio of its own."""
    return from_rest(h), carried_back(h, directions)


def block_state(
    h: jax.Array, change: jax.Array, directions: jax.Array | None
) -> tuple[jax.Array, Any]:
    """Return what the law sees at a point of a block whose volume ratio is ``1 + change``."""
    return with_volume_change(from_rest(h), change), carried_back(h, directions)


def kirchhoff(scene: Scene, theta: jax.Array, state: PointState) -> Callable[..., jax.Array]:
    """Return ``(*x, tissue) -> tau (3, 3)`` in kPa, ``state`` being what the law sees at x."""
    energy = point_energy(scene, theta)

    def stress(*x: Any) -> jax.Array:
        *point, at = x
        H, directions = state(*point, at.directions)
        P = jax.grad(energy)(H, at._replace(directions=directions))
        return P @ (H + jnp.eye(3, dtype=H.dtype)).T

    return stress


def kirchhoff_and_slopes(
    scene: Scene, theta: jax.Array, state: PointState, count: int
) -> Callable[..., tuple[jax.Array, tuple[jax.Array, ...]]]:
    """Return :func:`kirchhoff` with its derivatives in each of the ``count`` parts of ``x``."""
    every = tuple(range(count))
    law = stress_and_moduli(scene, theta)
    energy = point_energy(scene, theta)

    def linearised(*x: Any) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        *point, at = x

        def state_at(*x: jax.Array) -> tuple[jax.Array, jax.Array | None]:
            return state(*x, at.directions)

        def stress_along(directions: jax.Array) -> jax.Array:
            return jax.grad(energy)(H, at._replace(directions=directions)) @ F.T

        H, directions = state_at(*point)
        H_slopes, turns = jax.jacfwd(state_at, every)(*point)
        F = H + jnp.eye(3, dtype=H.dtype)
        P, A = law(H, at._replace(directions=directions))
        in_H = jnp.einsum("ijkl,mj->imkl", A, F) + jnp.einsum("il,mk->imkl", P, jnp.eye(3))
        slopes = [jnp.tensordot(in_H, slope, 2) for slope in H_slopes]
        if directions is not None:
            by_directions = jax.jacfwd(stress_along)(directions)
            turning = [jnp.tensordot(by_directions, turn, directions.ndim) for turn in turns]
            slopes = [one + other for one, other in zip(slopes, turning, strict=True)]
        return P @ F.T, tuple(slopes)

    return linearised


def _unit(vector: jax.Array) -> jax.Array:
    return vector / jnp.sqrt(jnp.sum(vector**2))


# Blocks


class Couplings(NamedTuple):
    """The coefficients that eliminate the volumes and pressures, as in the module docstring.

    change, pressure : the residuals of the volumes, (b,) mm3, and of the pressures, (b,) kPa.
    V : the volume at rest, (b,) mm3.
    c, e : the derivatives (b, a, 3) of V and of p in w.
    g : the derivative (b,) of p in the volume ratio.
    onto_change, onto_pressure : the derivatives (b, a, 3) of the force in either: d + g b, and b.
    """

    change: jax.Array
    pressure: jax.Array
    V: jax.Array
    c: jax.Array
    e: jax.Array
    g: jax.Array
    onto_change: jax.Array
    onto_pressure: jax.Array


class Condensed(NamedTuple):
    """The linearisation of the blocks, volumes eliminated where they share one.

    force : the nodal forces, (b, a, 3) mN.
    tangent : the derivatives of the forces in w, (b, 3a, 3a) mN/mm.
    couplings : the coefficients of the elimination; None without shared volumes.
    """

    force: jax.Array
    tangent: jax.Array
    couplings: Couplings | None = None


def block_forces(scene: Scene, w: jax.Array, theta: jax.Array) -> jax.Array:
    """Return the forces (b, a, 3) in mN of the blocks' stresses at ``w`` (n, 3) mm."""
    h, volumes = block_gradients(scene, w), consistent(scene, w, theta)
    if isinstance(volumes, Volumes):
        return _mean_forces(scene, h, volumes, theta)[0]
    law = kirchhoff(scene, theta, pointwise_state)
    tau = at_points(law, scene.block_tissue_at(theta), h)
    return nodal_vectors(scene.blocks, _det(h)[..., None, None] * tau)


def consistent(scene: Scene, w: jax.Array, theta: jax.Array) -> Volumes | tuple[()]:
    """Return the volumes and pressures that follow from ``w``; () where points have their own."""
    if scene.dilatation == "pointwise":
        return ()
    h = block_gradients(scene, w)
    change = _change(scene, h)
    tau = _stress(scene, h, change, theta)
    return Volumes(change, _pressure(scene, h, tau))


def linearise(
    scene: Scene, w: jax.Array, volumes: Volumes | tuple[()], theta: jax.Array
) -> Condensed:
    """Return the force and tangent of every block at ``w`` (n, 3) mm and ``volumes``."""
    h = block_gradients(scene, w)
    if isinstance(volumes, Volumes):
        return _condensed(scene, h, volumes, theta)
    law = kirchhoff_and_slopes(scene, theta, pointwise_state, 1)

    def point(h: jax.Array, at: Tissue) -> tuple[jax.Array, jax.Array]:
        tau, (slope,) = law(h, at)
        det, change = jax.value_and_grad(_det_of)(h)
        return det * tau, det * slope + tau[:, :, None, None] * change

    stress, moduli = at_points(point, scene.block_tissue_at(theta), h)
    return Condensed(nodal_vectors(scene.blocks, stress), _matrices(scene, moduli))


def eliminated_force(
    scene: Scene,
    w: jax.Array,
    volumes: Volumes | tuple[()],
    theta: jax.Array,
    couplings: Couplings | None,
) -> jax.Array:
    """Return the force (b, a, 3) at ``w``, eliminated with the ``couplings`` of an iterate."""
    if not isinstance(volumes, Volumes) or couplings is None:
        return block_forces(scene, w, theta)
    force, change, pressure = _mean_forces(scene, block_gradients(scene, w), volumes, theta)
    return _eliminated(force, couplings._replace(change=change, pressure=pressure))


def advance(
    scene: Scene,
    volumes: Volumes | tuple[()],
    couplings: Couplings | None,
    step: jax.Array,
    fraction: jax.Array,
) -> Volumes | tuple[()]:
    """Return ``volumes`` after ``fraction`` of the full ``step`` (n, 3) mm."""
    if not isinstance(volumes, Volumes) or couplings is None:
        return ()
    local, at = step[scene.blocks.connectivity], couplings
    along = lambda slope: jnp.einsum("bai,bai->b", slope, local)  # noqa: E731
    change = -(at.change + (1.0 + volumes.change) * along(at.c)) / at.V
    pressure = -at.pressure + along(at.e) + at.g * change
    return Volumes(volumes.change + fraction * change, volumes.pressure + fraction * pressure)


def _condensed(scene: Scene, h: jax.Array, volumes: Volumes, theta: jax.Array) -> Condensed:
    """Return the linearisation with mean dilatation."""
    grid, v = scene.blocks, block_integral(scene, jnp.ones(h.shape[:2]))
    law = kirchhoff_and_slopes(scene, theta, block_state, 2)

    def point(h: jax.Array, change: jax.Array, at: Tissue) -> tuple[jax.Array, ...]:
        tau, (in_h, in_change) = law(h, change, at)
        det, slope = jax.value_and_grad(_det_of)(h)
        in_h = det * in_h + tau[:, :, None, None] * slope
        return det * tau, in_h, det * in_change, slope

    tau, in_h, in_change, cof = at_points(
        point, scene.block_tissue_at(theta), h, per_point(h, volumes.change)
    )
    trace_h = jnp.einsum("bqiikl->bqkl", in_h)
    K = _matrices(scene, in_h - jnp.einsum("ij,bqkl->bqijkl", jnp.eye(3) / 3.0, trace_h))
    c, b = nodal_vectors(grid, cof), nodal_vectors(grid, jnp.broadcast_to(jnp.eye(3), h.shape))
    e = nodal_vectors(grid, trace_h) / (3.0 * v)[:, None, None]
    g = block_integral(scene, _trace(in_change)) / (3.0 * v)
    coupling = nodal_vectors(grid, _deviator(in_change)) + g[:, None, None] * b
    V, ratio = block_integral(scene, _det(h)), 1.0 + volumes.change
    pressure = volumes.pressure - block_integral(scene, _trace(tau)) / (3.0 * v)
    S = _deviator(tau) + volumes.pressure[:, None, None, None] * jnp.eye(3)
    K = K - _outer(coupling, (ratio / V)[:, None, None] * c) + _outer(b, e)
    at = Couplings(ratio * V - v, pressure, V, c, e, g, coupling, b)
    return Condensed(_eliminated(nodal_vectors(grid, S), at), K, at)


def _mean_forces(
    scene: Scene, h: jax.Array, volumes: Volumes, theta: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the force (b, a, 3) before elimination, and the residuals (b,) of both unknowns."""
    tau = _stress(scene, h, volumes.change, theta)
    v, V = block_integral(scene, jnp.ones(h.shape[:2])), block_integral(scene, _det(h))
    S = _det(h)[..., None, None] * _deviator(tau)
    S = S + volumes.pressure[:, None, None, None] * jnp.eye(3)
    r_pressure = volumes.pressure - _pressure(scene, h, tau)
    return nodal_vectors(scene.blocks, S), (1.0 + volumes.change) * V - v, r_pressure


def _eliminated(force: jax.Array, at: Couplings) -> jax.Array:
    """Return ``f_e`` (b, a, 3) of the module docstring."""
    force = force - (at.change / at.V)[:, None, None] * at.onto_change
    return force - at.pressure[:, None, None] * at.onto_pressure


def _stress(scene: Scene, h: jax.Array, change: jax.Array, theta: jax.Array) -> jax.Array:
    """Return the law's Kirchhoff stress (b, q, 3, 3) in kPa where blocks share a volume ratio."""
    law = kirchhoff(scene, theta, block_state)
    return at_points(law, scene.block_tissue_at(theta), h, per_point(h, change))


def _pressure(scene: Scene, h: jax.Array, tau: jax.Array) -> jax.Array:
    """Return ``p(w, theta)`` (b,) in kPa."""
    v = block_integral(scene, jnp.ones(h.shape[:2]))
    return block_integral(scene, _det(h) * _trace(tau)) / (3.0 * v)


def _change(scene: Scene, h: jax.Array) -> jax.Array:
    """Return ``v/V - 1`` (b,) of the blocks, without loss of digits."""
    det_less_1 = jax.vmap(jax.vmap(volume_change))(h)
    V = block_integral(scene, 1.0 + det_less_1)
    return -block_integral(scene, det_less_1) / V


def _matrices(scene: Scene, moduli: jax.Array) -> jax.Array:
    """Return matrices (b, 3a, 3a) from derivatives (b, q, 3, 3, 3, 3) of the stress in h."""
    count = scene.blocks.connectivity.shape[1]
    one, other = np.indices((count, count))
    pairs = pair_matrices(scene.blocks, moduli, (one.ravel(), other.ravel()))
    wide = pairs.reshape(-1, count, count, 3, 3).transpose(0, 1, 3, 2, 4)
    return wide.reshape(-1, 3 * count, 3 * count)


def _outer(one: jax.Array, other: jax.Array) -> jax.Array:
    """Return the outer products (b, 3a, 3a) of vectors (b, a, 3)."""
    flat = one.reshape(len(one), -1), other.reshape(len(other), -1)
    return flat[0][:, :, None] * flat[1][:, None, :]


def _det_of(h: jax.Array) -> jax.Array:
    return determinant(h + jnp.eye(3, dtype=h.dtype))


def _det(h: jax.Array) -> jax.Array:
    """Return ``det f`` (b, q)."""
    return jax.vmap(jax.vmap(_det_of))(h)


def _trace(stress: jax.Array) -> jax.Array:
    return jnp.trace(stress, axis1=-2, axis2=-1)


def _deviator(stress: jax.Array) -> jax.Array:
    return stress - _trace(stress)[..., None, None] * jnp.eye(3) / 3.0


# The system


class InverseSystem(System):
    """The equations of inverse motion of a scene whose mesh is its loaded shape.

    The unknown is w, from the loaded shape to the stress-free one. The forces of loads and elastic
    supports are those of their ``on_loaded``.
    """

    inverse: ClassVar[bool] = True

    @cached_property
    def springs(self) -> list[LocalTerm]:
        """No potentials; see :attr:`resistances`."""
        return []

    @cached_property
    def terms(self) -> list[LocalTerm]:
        """No potentials; see :attr:`forces`."""
        return []

    @cached_property
    def dead(self) -> DeadForce:
        """No force: all loads are in :attr:`forces`."""
        return DeadForce(np.zeros(self.scene.held.shape), {})

    @cached_property
    def forces(self) -> list[LocalForce]:
        """Loads on the loaded shape."""
        grid, fibres = self.scene.discretisation, self.scene.fibres_of_loads
        return [load.on_loaded(grid, fibres) for load in self.scene.loads]

    @cached_property
    def resistances(self) -> list[LocalForce]:
        """Elastic supports on the loaded shape."""
        grid = self.scene.discretisation
        forces = (support.on_loaded(grid) for support in self.scene.supports)
        return [force for force in forces if force is not None]

    @cached_property
    def pattern(self) -> Pattern:
        """The sparsity of the tangent: the bulk's blocks, then springs, then the loads."""
        groups = [self.scene.blocks.connectivity]
        groups += [part.nodes for part in (*self.resistances, *self.forces)]
        return block_pattern([whole_blocks(g) for g in groups], self.free_index, symmetric=False)

    def internal_force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the force (n, 3) in mN of the stresses and of the springs."""
        bulk = self.scatter(block_forces(self.scene, u, theta))
        return bulk - self.resistance(u, theta)

    def resistance(self, u: jax.Array, theta: jax.Array) -> jax.Array | float:
        """Return the force (n, 3) in mN of the springs on the body."""
        values = self.scene.resolve(theta)
        return sum((force.total(u, values) for force in self.resistances), 0.0)

    def springs_less_loads(
        self, u: jax.Array, theta: jax.Array, load: jax.Array | float
    ) -> jax.Array:
        """Return the part (n, 3) of the residual in mN that is not the bulk's."""
        return -self.resistance(u, theta) - load * self.external_force(u, theta)

    def bulk(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the derivatives (b, 3a, 3a) of the blocks' forces in w, mN/mm."""
        volumes = consistent(self.scene, u, theta)
        return linearise(self.scene, u, volumes, theta).tangent

    def assemble(
        self,
        bulk: jax.Array,
        u: jax.Array,
        theta: jax.Array,
        load_stiffness: jax.Array | float,
        load: jax.Array | float,
    ) -> jax.Array:
        """Return the nonzeros (nnz,) of the tangent, from the blocks, springs and loads."""
        del load
        values = self.scene.resolve(theta)
        blocks = [bulk, *(part.tangents(u, values) for part in self.resistances)]
        blocks += [load_stiffness * part.tangents(u, values) for part in self.forces]
        return self.pattern.sum(jnp.concatenate([block.reshape(-1) for block in blocks]))

    def equations(
        self,
        bulk: jax.Array,
        u: jax.Array,
        theta: jax.Array,
        load_stiffness: jax.Array | float,
        load: jax.Array | float,
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return :meth:`System.equations`; supports do not move, so the force is zero."""
        K = self.assemble(bulk, u, theta, load_stiffness, load)
        return self.pattern.safe_values(K), self.pattern.solvable(K), jnp.zeros(len(self.free))
