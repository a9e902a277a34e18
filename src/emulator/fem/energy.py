r"""Total potential energy of a scene, summed over the terms the scene has.

.. math::
    \Pi(u, \theta) = \int_\Omega W(\nabla u; \theta)\, dX + \text{springs}
        - \sum_\text{loads} \text{work}

in mN mm (= micro J; kPa mm3), Dalton et al. (2023), Eq. 20. The displacement ``u`` is the full
nodal field, (n, 3) in mm, prescribed displacements included.

With mean dilatation the law sees the mean volume ratio of the element,

.. math::
    \hat F = \left(\bar J / J\right)^{1/3} F, \qquad
    \bar J = \frac{\int_e J\, dX}{\int_e dX},

and W is evaluated at :math:`\hat F`: one volume constraint an element, which quadratic tetrahedra
can meet without locking (Simo, Taylor & Pister 1985). With patch dilatation the mean is taken over
a patch of linear tetrahedra (:class:`~emulator.geometry.discretisation.Patches`). A *block* shares
one mean: an element, or a patch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Blocks
from emulator.mechanics.kinematics import Barriers, Strain, determinant
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.part import LocalForce, LocalTerm, Values
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import Tissue

Energy = Callable[[jax.Array, jax.Array], jax.Array]


def require_rest(scene: ForwardProblem) -> None:
    """Raise :class:`InputError` for a scene in time, or whose mesh is the shape under load."""
    if scene.in_time and not scene.is_step:
        raise InputError(f"scene '{scene.name}' goes through time: follow it by Simulator.path")
    if scene.loaded_by:
        raise InputError(
            f"scene '{scene.name}' is known under load (loaded_by), and this needs a scene at "
            "rest: use FEM's displacements, or unload the scene"
        )


def require_shape(scene: Scene, name: str, array: jax.Array, shape: tuple[int, ...]) -> None:
    """Raise :class:`InputError` unless ``array`` has the ``shape``."""
    if array.shape != shape:
        raise InputError(f"scene '{scene.name}': {name} has shape {array.shape}; expected {shape}")


def volume_ratio(scene: ForwardProblem, u: jax.Array) -> jax.Array:
    """Return ``J = det F`` at every point, (m, q), or state, (m,); J <= 0 is an inverted one."""
    H = scene.gradients(u)
    F = (H + jnp.eye(3, dtype=H.dtype)).reshape(-1, 3, 3)
    return jax.vmap(determinant)(F).reshape(H.shape[:-2])


def parameters_at(scene: ForwardProblem, theta: jax.Array) -> Callable[[Tissue], list[jax.Array]]:
    """Return the law's parameters as a function of a point's tissue, at ``theta`` (p,).

    The tissue's stiffness scales the moduli that the law names in ``shape_moduli``.
    """
    require_rest(scene)
    values, law = scene.resolve(theta), scene.law

    def parameters(at: Tissue) -> list[jax.Array]:
        scaled = {}
        if at.stiffness is not None:
            scaled = {name: at.stiffness * values[name] for name in law.shape_moduli}
        return [scaled.get(name, values[name]) for name in law.parameters]

    return parameters


def point_energy(
    scene: ForwardProblem, theta: jax.Array, barriers: Barriers | None = None
) -> Callable:
    """Return ``W(H, tissue)`` in kPa, of one displacement gradient (3, 3), at ``theta`` (p,)."""
    law, parameters = scene.law, parameters_at(scene, theta)

    def energy(H: jax.Array, at: Tissue = Tissue()) -> jax.Array:
        return law.energy(Strain(H, barriers, at.directions), *parameters(at))

    return energy


def at_points(function: Callable, H: jax.Array, *fields: Any) -> Any:
    """Return ``function(*point)`` at every point of ``H`` (m, q, 3, 3) and of more ``fields``.

    Fields are trees of arrays (m, q, ...), as the result is. All points are one batch: a ``vmap``
    in a ``vmap`` takes half as long again to trace.
    """
    points = jax.tree.map(lambda array: array.reshape(-1, *array.shape[2:]), (H, *fields))
    values = jax.vmap(function)(*points)
    return jax.tree.map(lambda array: array.reshape(*H.shape[:2], *array.shape[1:]), values)


def with_volume_change(
    H: jax.Array, change: jax.Array, barriers: Barriers | None = None
) -> jax.Array:
    """Return the displacement gradient ``H`` (3, 3) scaled isotropically to ``J - 1 = change``."""
    stretch = jnp.expm1((jnp.log1p(change) - Strain(H, barriers).ln_J) / 3.0)
    return H + stretch * (H + jnp.eye(3, dtype=H.dtype))


def mean_change(H: jax.Array, weights: jax.Array, barriers: Barriers | None = None) -> jax.Array:
    """Return the mean (), by ``weights`` (q,), of J - 1 over the points ``H`` (q, 3, 3)."""
    J_minus_1 = jax.vmap(lambda h: Strain(h, barriers).J_minus_1)(H)
    return jnp.vdot(weights, J_minus_1) / jnp.sum(weights)


def nodal_vectors(blocks: Blocks, P: jax.Array) -> jax.Array:
    """Return nodal forces (b, a, 3) in mN of the blocks from ``P = dW/dH`` (b, q, 3, 3) in kPa."""
    return jnp.einsum("bq,bqij,bqaj->bai", blocks.weights, P, blocks.gradients)


_CHUNK = 128  # blocks whose products of gradients stay in a processor's cache


def pair_matrices(
    blocks: Blocks, A: jax.Array, pairs: tuple[np.ndarray, np.ndarray] | None = None
) -> jax.Array:
    r"""Return nodal stiffnesses (b, pairs, 3, 3) in mN/mm from moduli ``A`` (b, q, 3, 3, 3, 3).

    pairs : the pairs of a block's nodes; by default those of ``np.triu_indices``, each once, for a
    symmetric ``A``. With the products of gradients at the points,
    :math:`G_{ab,kl} = w N_{a,k} N_{b,l}`, one matrix product a block gives all of them,
    :math:`K_{ab} = \sum_{q,kl} G_{ab,kl} A_{kl}`. Blocks are taken a few at a time, so that the
    products stay in the cache.
    """
    one, other = np.triu_indices(blocks.gradients.shape[2]) if pairs is None else pairs
    count, points = A.shape[:2]
    chunks = -(-count // _CHUNK)
    size = -(-count // chunks)

    def chunk_matrices(chunk: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        weights, N, A = chunk
        products = weights[:, :, None, None, None] * N[:, :, one, :, None] * N[:, :, other, None, :]
        left = products.transpose(0, 2, 1, 3, 4).reshape(size, len(one), points * 9)
        right = A.transpose(0, 1, 3, 5, 2, 4).reshape(size, points * 9, 9)
        return jnp.matmul(left, right)

    def chunked(array: jax.Array | np.ndarray) -> jax.Array:
        spare = [(0, chunks * size - count), *[(0, 0)] * (array.ndim - 1)]
        return jnp.pad(jnp.asarray(array), spare).reshape(chunks, size, *array.shape[1:])

    data = chunked(blocks.weights), chunked(blocks.gradients), chunked(A)
    matrices = jax.lax.map(chunk_matrices, data).reshape(chunks * size, len(one), 3, 3)
    return matrices[:count]


def pair_products(pairs: jax.Array, local: jax.Array) -> jax.Array:
    """Return the products (b, a, 3) of symmetric ``pairs`` (b, pairs, 3, 3) and ``local``."""
    one, other = np.triu_indices(local.shape[1])
    below = jnp.where((one != other)[:, None], local[:, one], 0.0)
    upper = jnp.einsum("bpij,bpj->bpi", pairs, local[:, other])
    lower = jnp.einsum("bpij,bpi->bpj", pairs, below)
    return jnp.zeros_like(local).at[:, one].add(upper).at[:, other].add(lower)


def strain_energy(scene: Scene, barriers: Barriers | None = None) -> Energy:
    """Return ``(u, theta) -> int W dX`` in mN mm."""
    return lambda u, theta: energy_of_gradient(scene, scene.gradients(u), theta, barriers)


def energy_of_gradient(
    scene: Scene, H: jax.Array, theta: jax.Array, barriers: Barriers | None = None
) -> jax.Array:
    """Return ``int W dX`` in mN mm from the displacement gradient ``H`` (m, q, 3, 3)."""
    density = point_energy(scene, theta, barriers)
    values = at_points(density, _seen_by_law(scene, H, barriers), scene.block_tissue_at(theta))
    return jnp.sum(scene.blocks.weights * values)


def block_energies(
    scene: Scene, theta: jax.Array, H: jax.Array, rows: np.ndarray, points: np.ndarray | None = None
) -> jax.Array:
    """Return the strain energy (k, q) in mN mm of each point of the blocks ``rows`` (k,).

    H : the displacement gradient (k, q, 3, 3) at their points.
    points : the number (k,) of one point of each block, the only one that is evaluated, (k, 1).
    """
    weights = scene.blocks.weights[rows]
    tissue = jax.tree.map(lambda array: array[rows], scene.block_tissue_at(theta))
    change = None
    if scene.dilatation != "pointwise":
        change = jax.vmap(mean_change)(H, jnp.asarray(weights))[:, None]
    if points is not None:
        weights, H, tissue = jax.tree.map(partial(one_of_each, points), (weights, H, tissue))
    if change is not None:
        H = at_points(with_volume_change, H, jnp.broadcast_to(change, weights.shape))
    return weights * at_points(point_energy(scene, theta), H, tissue)


def one_of_each[A: (jax.Array, np.ndarray)](points: np.ndarray, field: A) -> A:
    """Return a ``field`` (k, q, ...) at one point of each block, ``points`` (k,): (k, 1, ...)."""
    return field[np.arange(len(points)), points][:, None]


def law_gradients(scene: Scene, u: jax.Array) -> jax.Array:
    """Return the displacement gradients (b, q, 3, 3) that the law sees at ``u`` (n, 3) mm."""
    return _seen_by_law(scene, scene.gradients(u))


def _seen_by_law(scene: Scene, H: jax.Array, barriers: Barriers | None = None) -> jax.Array:
    H = scene.blocks.gather(H)
    if scene.dilatation == "pointwise":
        return H

    def to_mean_volume(H: jax.Array, weights: jax.Array) -> jax.Array:
        change = mean_change(H, weights, barriers)
        return jax.vmap(lambda h: with_volume_change(h, change, barriers))(H)

    return jax.vmap(to_mean_volume)(H, jnp.asarray(scene.blocks.weights))


def spring_terms(scene: Scene) -> list[LocalTerm]:
    """Return the potentials of the elastic supports."""
    return [t for support in scene.supports for t in support.terms(scene.discretisation)]


def local_terms(scene: Scene) -> list[LocalTerm]:
    """Return the potentials of the loads that follow the deformation."""
    fibres = scene.fibres_of_loads
    return [t for load in scene.loads for t in load.terms(scene.discretisation, fibres)]


def local_forces(scene: Scene) -> list[LocalForce]:
    """Return the loads that follow the deformation and have no potential."""
    forces = (load.force(scene.discretisation) for load in scene.loads)
    return [force for force in forces if force is not None]


def force_on_body(
    parts: Iterable[LocalTerm | LocalForce], u: jax.Array, values: Values
) -> jax.Array | float:
    """Return the nodal force (n, 3) in mN of potentials and forces; 0 where there are none."""
    forces = (
        -jax.grad(part.total)(u, values) if isinstance(part, LocalTerm) else part.total(u, values)
        for part in parts
    )
    return sum(forces, 0.0)


@dataclass(frozen=True, eq=False)
class DeadForce:
    """The nodal force of the dead loads, which do not follow the deformation.

    constant : the part that no parameter scales, (n, 3) in mN.
    per_unit : the force (n, 3) in mN per unit of a parameter, by the parameter's name.
    """

    constant: np.ndarray
    per_unit: Mapping[str, np.ndarray]

    def total(self, values: Values) -> jax.Array:
        """Return the force (n, 3) in mN at the scene's parameter ``values``."""
        scaled = (values[name] * force for name, force in self.per_unit.items())
        return sum(scaled, jnp.asarray(self.constant))


def dead_force(scene: Scene) -> DeadForce:
    """Return the force of the dead loads; zero when there are none."""
    forces: dict[str | None, np.ndarray] = {}
    for load in scene.loads:
        for name, force in load.dead_forces(scene.discretisation).items():
            forces[name] = forces.get(name, 0.0) + force
    constant = forces.pop(None, np.zeros(scene.held.shape))
    return DeadForce(constant, {str(name): force for name, force in forces.items()})


def potential_energy(scene: Scene, barriers: Barriers | None = None) -> Energy:
    """Return the total potential energy ``Pi(u, theta)`` in mN mm.

    Parameters
    ----------
    scene : the scene whose terms the energy has.
    barriers : the limits on the invariants for training; ``None`` gives the exact energy, which is
        NaN wherever an element is inverted.

    Raises
    ------
    InputError
        A load of the scene has no potential.
    """
    require_rest(scene)
    for load in scene.loads:
        if not load.has_potential:
            raise InputError(
                f"scene '{scene.name}': the {load.kind.replace('_', ' ')} on "
                f"'{', '.join(load.facet_sets)}' has no potential, so the scene has no energy; "
                "hold the rim and use CavityPressure, or work with FEM displacements"
            )
    internal, springs = strain_energy(scene, barriers), spring_terms(scene)
    dead, terms = dead_force(scene), local_terms(scene)

    def energy(u: jax.Array, theta: jax.Array) -> jax.Array:
        total = internal(u, theta)
        if dead.per_unit or dead.constant.any():
            total = total - jnp.vdot(dead.total(scene.resolve(theta)), u)
        for term in springs + terms:
            total = total + term.total(u, scene.resolve(theta))
        return total

    return energy
