r"""Residual and tangent of inverse motion: equilibrium on a known loaded shape.

The mesh of the scene, x, is loaded; sought is the displacement w to the stress-free shape X = x + w
(Govindjee & Mihalic 1996, Comput. Methods Appl. Mech. Engng 136, 47-57). With the shape functions
of the mesh, :math:`f = I + \partial w/\partial x`, elements at X are mapped to those at x by
:math:`F = f^{-1}`, and :math:`dX = \det f\, dx`, so that the equations of the scene on the mesh X,
at the displacement u = -w, are

.. math::
    r_a(w) = \sum_q \omega_q\, \sigma(f)\, \nabla_x N_a - f_a^\text{ext}(w) = 0,
    \qquad \sigma = \det f\; P(f^{-1})\, f^{-T}

at free nodes, to round-off: loading the mesh X leads to x. :math:`\omega_q` are the quadrature
weights of x, and :math:`\sigma` is the Cauchy stress (:mod:`emulator.fem.loaded_point`).
A pressure acts on the known shape and does not depend on w; weight and dead tractions are given per
volume and area at rest and do. Held nodes stay where they are.

With mean dilatation, and with v and V the volumes of a block at x and at X,

.. math::
    r_a = \sum_q \omega_q \left(\det f\, \operatorname{dev} \hat\tau + p I\right) \nabla_x N_a,
    \qquad \theta = \frac{v}{V} = \frac{\sum_q \omega_q}{\sum_q \omega_q \det f},
    \qquad p = \frac{1}{3v} \sum_q \omega_q \det f\, \operatorname{tr} \hat\tau,

:math:`\hat\tau` being the law's Kirchhoff stress at :math:`\hat F = (\theta \det f)^{1/3} F`.
:math:`\theta` and p are iterates, eliminated block by block: with :math:`c = V_w`,
:math:`b = \sum \omega \nabla N`, :math:`d = \sum \omega \det f \operatorname{dev}
\hat\tau_\theta \nabla N`, :math:`e = p_w`, :math:`g = p_\theta`, and the residuals
:math:`r_\theta = \theta V - v`, :math:`r_p = p - p(w, \theta)`,

.. math::
    K_e = K_{ww} - (d + g b) \otimes \theta c / V + b \otimes e, \qquad
    f_e = r_w - (d + g b)\, r_\theta / V - b\, r_p .

The tangent is not symmetric, and nothing is a minimum: steps are judged by natural monotonicity.
"""

from __future__ import annotations

from functools import cached_property
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.energy import (
    DeadForce,
    at_points,
    displacement_gradient,
    nodal_vectors,
    pair_matrices,
)
from emulator.fem.linear import Pattern, block_pattern, whole_blocks
from emulator.fem.loaded_point import (
    kirchhoff,
    kirchhoff_and_slopes,
    seen_pointwise,
    seen_with_volume,
)
from emulator.fem.system import System
from emulator.mechanics.kinematics import Strain, determinant
from emulator.scenes.local_terms import LocalForce, LocalTerm
from emulator.scenes.regions import Tissue
from emulator.scenes.scene import Scene


class Volumes(NamedTuple):
    """Iterates of the blocks: volume ratio less 1 and pressure in kPa, both (b,)."""

    change: jax.Array
    pressure: jax.Array


class Condensed(NamedTuple):
    """Linearisation with the volumes eliminated.

    force : (b, a, 3) mN. tangent : (b, 3a, 3a) mN/mm. r_change (b,) mm3, r_pressure (b,) kPa.
    volume_slope, pressure_slope : c and e, (b, a, 3). pressure_change : g, (b,). coupling : d + g b,
    and spread : b, (b, a, 3). Nothing but force and tangent where each point has its own volume.
    """

    force: jax.Array
    tangent: jax.Array
    r_change: jax.Array | None = None
    r_pressure: jax.Array | None = None
    volume: jax.Array | None = None
    volume_slope: jax.Array | None = None
    pressure_slope: jax.Array | None = None
    pressure_change: jax.Array | None = None
    coupling: jax.Array | None = None
    spread: jax.Array | None = None


class InverseSystem(System):
    """The equations of inverse motion of a scene whose mesh is its loaded shape.

    Its unknown is w, from the loaded shape to the stress-free one; its forces, elastic supports
    included, are those of the loads' and supports' ``on_loaded``.
    """

    inverse: ClassVar[bool] = True

    @cached_property
    def springs(self) -> list[LocalTerm]:
        """None with a potential; see :attr:`resistances`."""
        return []

    @cached_property
    def terms(self) -> list[LocalTerm]:
        """None with a potential."""
        return []

    @cached_property
    def dead(self) -> DeadForce:
        """None that does not depend on w or on the shape: see :attr:`forces`."""
        return DeadForce(np.zeros(self.scene.held.shape), {})

    @cached_property
    def forces(self) -> list[LocalForce]:
        """Loads on the loaded shape."""
        grid = self.scene.discretisation
        return [load.on_loaded(grid) for load in self.scene.loads]

    @cached_property
    def resistances(self) -> list[LocalForce]:
        """Elastic supports on the loaded shape."""
        grid = self.scene.discretisation
        found = (support.on_loaded(grid) for support in self.scene.supports)
        return [force for force in found if force is not None]

    @cached_property
    def pattern(self) -> Pattern:
        """Sparsity of the tangent: the bulk's blocks, then springs, then the loads."""
        free_index = np.full(self.scene.held.size, -1)
        free_index[self.free] = np.arange(len(self.free))
        groups = [self.scene.blocks.connectivity]
        groups += [part.nodes for part in (*self.resistances, *self.forces)]
        return block_pattern([whole_blocks(g) for g in groups], free_index, symmetric=False)

    def internal_force(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Force (n, 3) in mN of the stresses and of the springs."""
        bulk = self.scatter(block_forces(self.scene, u, theta))
        return bulk - self.resistance(u, theta)

    def resistance(self, u: jax.Array, theta: jax.Array) -> jax.Array | float:
        """Force (n, 3) in mN of the springs on the body."""
        values = self.scene.resolve(theta)
        return sum((force.total(u, values) for force in self.resistances), 0.0)

    def others(self, u: jax.Array, theta: jax.Array, load: jax.Array | float) -> jax.Array:
        """Part (n, 3) of the residual outside the bulk, mN: springs less loads."""
        return -self.resistance(u, theta) - load * self.external_force(u, theta)

    def bulk(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Derivatives (b, 3a, 3a) of the blocks' forces in w, mN/mm."""
        volumes = consistent(self.scene, u, theta)
        return linearise(self.scene, u, volumes, theta).tangent

    def assemble(
        self, bulk: jax.Array, u: jax.Array, theta: jax.Array, load: jax.Array | float
    ) -> jax.Array:
        """Nonzeros (nnz,) of the tangent from that of the blocks ``bulk``, springs and loads."""
        values = self.scene.resolve(theta)
        blocks = [bulk, *(part.tangents(u, values) for part in self.resistances)]
        blocks += [load * part.tangents(u, values) for part in self.forces]
        return self.pattern.sum(jnp.concatenate([block.reshape(-1) for block in blocks]))

    def equations(
        self,
        bulk: jax.Array,
        u: jax.Array,
        theta: jax.Array,
        stiffening: jax.Array | float,
        level: jax.Array | float,
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """As a :class:`~emulator.fem.system.System`'s; supports that stay pull nothing."""
        del level
        K = self.assemble(bulk, u, theta, stiffening)
        return self.pattern.safe_values(K), self.pattern.solvable(K), jnp.zeros(len(self.free))


def block_forces(scene: Scene, w: jax.Array, theta: jax.Array) -> jax.Array:
    """Forces (b, a, 3) in mN of the blocks' stresses at ``w`` (n, 3) mm."""
    h = _gradient(scene, w)
    if scene.dilatation == "pointwise":
        tau = at_points(scene, kirchhoff(scene, theta, seen_pointwise), h, tissue=scene.block_tissue)
        return nodal_vectors(scene.blocks, _det(h)[..., None, None] * tau)
    return _mean_forces(scene, h, consistent(scene, w, theta), theta)[0]


def consistent(scene: Scene, w: jax.Array, theta: jax.Array) -> Volumes | tuple[()]:
    """Volumes and pressures that follow from ``w`` (n, 3); () where points have their own."""
    if scene.dilatation == "pointwise":
        return ()
    h = _gradient(scene, w)
    change = _change(scene, h)
    tau = _stress(scene, h, change, theta)
    return Volumes(change, _pressure(scene, h, tau))


def linearise(
    scene: Scene, w: jax.Array, volumes: Volumes | tuple[()], theta: jax.Array
) -> Condensed:
    """Force and tangent of every block at ``w`` (n, 3) and ``volumes``."""
    h = _gradient(scene, w)
    if isinstance(volumes, Volumes):
        return _condensed(scene, h, volumes, theta)
    law = kirchhoff_and_slopes(scene, theta, seen_pointwise, 1)

    def point(h: jax.Array, at: Tissue) -> tuple[jax.Array, jax.Array]:
        tau, (slope,) = law(h, at)
        det, change = jax.value_and_grad(_det_of)(h)
        return det * tau, det * slope + tau[:, :, None, None] * change

    stress, moduli = at_points(scene, point, h, tissue=scene.block_tissue)
    return Condensed(nodal_vectors(scene.blocks, stress), _matrices(scene, moduli))


def carried(
    scene: Scene, w: jax.Array, volumes: Volumes | tuple[()], theta: jax.Array, at: Condensed
) -> jax.Array:
    """Force (b, a, 3) at ``w`` and ``volumes``, eliminated with the couplings of ``at``."""
    if not isinstance(volumes, Volumes):
        return block_forces(scene, w, theta)
    force, r_change, r_pressure = _mean_forces(scene, _gradient(scene, w), volumes, theta)
    return _eliminated(force, r_change, r_pressure, at)


def advance(
    scene: Scene,
    volumes: Volumes | tuple[()],
    at: Condensed,
    move: jax.Array,
    fraction: jax.Array,
) -> Volumes | tuple[()]:
    """``volumes`` after ``fraction`` of the step whose displacement is ``move`` (n, 3)."""
    if not isinstance(volumes, Volumes):
        return ()
    local = move[scene.blocks.connectivity]
    along = lambda slope: jnp.einsum("bai,bai->b", slope, local)  # noqa: E731
    ratio = 1.0 + volumes.change
    change = -(at.r_change + ratio * along(at.volume_slope)) / at.volume
    pressure = -at.r_pressure + along(at.pressure_slope) + at.pressure_change * change
    return Volumes(volumes.change + fraction * change, volumes.pressure + fraction * pressure)


def _condensed(scene: Scene, h: jax.Array, volumes: Volumes, theta: jax.Array) -> Condensed:
    """The linearisation with mean dilatation."""
    grid, v = scene.blocks, _integral(scene, jnp.ones(h.shape[:2]))
    law = kirchhoff_and_slopes(scene, theta, seen_with_volume, 2)

    def point(h: jax.Array, change: jax.Array, at: Tissue) -> tuple[jax.Array, ...]:
        tau, (in_h, in_change) = law(h, change, at)
        det, slope = jax.value_and_grad(_det_of)(h)
        in_h = det * in_h + tau[:, :, None, None] * slope
        return det * tau, in_h, det * in_change, slope

    tau, in_h, in_change, cof = at_points(
        scene, point, h, _wide(h, volumes.change), tissue=scene.block_tissue
    )
    trace_h = jnp.einsum("bqiikl->bqkl", in_h)
    K = _matrices(scene, in_h - jnp.einsum("ij,bqkl->bqijkl", jnp.eye(3) / 3.0, trace_h))
    c, b = nodal_vectors(grid, cof), nodal_vectors(grid, jnp.broadcast_to(jnp.eye(3), h.shape))
    e = nodal_vectors(grid, trace_h) / (3.0 * v)[:, None, None]
    g = _integral(scene, _trace(in_change)) / (3.0 * v)
    coupling = nodal_vectors(grid, _deviator(in_change)) + g[:, None, None] * b
    V, ratio = _integral(scene, _det(h)), 1.0 + volumes.change
    r_change, r_pressure = ratio * V - v, volumes.pressure - _integral(scene, _trace(tau)) / (3 * v)
    S = _deviator(tau) + volumes.pressure[:, None, None, None] * jnp.eye(3)
    K = K - _outer(coupling, (ratio / V)[:, None, None] * c) + _outer(b, e)
    at = Condensed(nodal_vectors(grid, S), K, r_change, r_pressure, V, c, e, g, coupling, b)
    return at._replace(force=_eliminated(at.force, r_change, r_pressure, at))


def _mean_forces(
    scene: Scene, h: jax.Array, volumes: Volumes, theta: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Force (b, a, 3) before elimination, and the residuals (b,) of volumes and pressures."""
    tau = _stress(scene, h, volumes.change, theta)
    v, V = _integral(scene, jnp.ones(h.shape[:2])), _integral(scene, _det(h))
    S = _det(h)[..., None, None] * _deviator(tau)
    S = S + volumes.pressure[:, None, None, None] * jnp.eye(3)
    r_pressure = volumes.pressure - _pressure(scene, h, tau)
    return nodal_vectors(scene.blocks, S), (1.0 + volumes.change) * V - v, r_pressure


def _eliminated(
    force: jax.Array, r_change: jax.Array, r_pressure: jax.Array, at: Condensed
) -> jax.Array:
    """``f_e`` (b, a, 3) of the module docstring."""
    along = (r_change / at.volume)[:, None, None]
    return force - along * at.coupling - r_pressure[:, None, None] * at.spread


def _stress(scene: Scene, h: jax.Array, change: jax.Array, theta: jax.Array) -> jax.Array:
    """The law's Kirchhoff stress (b, q, 3, 3) in kPa where blocks share their volume change."""
    law = kirchhoff(scene, theta, seen_with_volume)
    return at_points(scene, law, h, _wide(h, change), tissue=scene.block_tissue)


def _pressure(scene: Scene, h: jax.Array, tau: jax.Array) -> jax.Array:
    """``p(w, theta)`` (b,) in kPa."""
    v = _integral(scene, jnp.ones(h.shape[:2]))
    return _integral(scene, _det(h) * _trace(tau)) / (3.0 * v)


def _change(scene: Scene, h: jax.Array) -> jax.Array:
    """Volume change (b,) of the blocks, ``v/V - 1``, without loss of digits."""
    det_less_1 = jax.vmap(jax.vmap(_volume_change))(h)
    V = _integral(scene, 1.0 + det_less_1)
    return -_integral(scene, det_less_1) / V


def _volume_change(h: jax.Array) -> jax.Array:
    return Strain(h).J_minus_1


def _matrices(scene: Scene, moduli: jax.Array) -> jax.Array:
    """Matrices (b, 3a, 3a) from derivatives (b, q, 3, 3, 3, 3) of stress in h."""
    count = scene.blocks.connectivity.shape[1]
    pairs = tuple(index.ravel() for index in np.indices((count, count)))
    found = pair_matrices(scene.blocks, moduli, pairs)
    wide = found.reshape(-1, count, count, 3, 3).transpose(0, 1, 3, 2, 4)
    return wide.reshape(-1, 3 * count, 3 * count)


def _outer(one: jax.Array, other: jax.Array) -> jax.Array:
    """Products (b, 3a, 3a) of vectors (b, a, 3)."""
    flat = one.reshape(len(one), -1), other.reshape(len(other), -1)
    return flat[0][:, :, None] * flat[1][:, None, :]


def _gradient(scene: Scene, w: jax.Array) -> jax.Array:
    """``h`` (b, q, 3, 3) at the blocks' points."""
    return scene.blocks.gather(displacement_gradient(scene, w))


def _det_of(h: jax.Array) -> jax.Array:
    return determinant(h + jnp.eye(3, dtype=h.dtype))


def _det(h: jax.Array) -> jax.Array:
    """``det f`` (b, q)."""
    return jax.vmap(jax.vmap(_det_of))(h)


def _integral(scene: Scene, density: jax.Array) -> jax.Array:
    """Integral (b,) over each block, as loaded, of ``density`` (b, q)."""
    return jnp.sum(scene.blocks.weights * density, axis=1)


def _trace(stress: jax.Array) -> jax.Array:
    return jnp.trace(stress, axis1=-2, axis2=-1)


def _deviator(stress: jax.Array) -> jax.Array:
    return stress - _trace(stress)[..., None, None] * jnp.eye(3) / 3.0


def _wide(h: jax.Array, change: jax.Array) -> jax.Array:
    return jnp.broadcast_to(change[:, None], h.shape[:2])
