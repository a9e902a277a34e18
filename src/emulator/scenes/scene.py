"""A scene: geometry, law, loads, supports and parameters of one problem.

:class:`~emulator.scenes.scene_data.SceneData` is all that a user says. :class:`Scene` adds what
follows from it, by topic: discretisation, tissue, prescribed displacements and identity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import (
    Blocks,
    Discretisation,
    discretise,
    patchwise,
)
from emulator.geometry.facets import Cavity, encloses
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.identity import Identity, fingerprint, identity_of
from emulator.scenes.scene_data import SceneData
from emulator.scenes.tissue import Fibres, Tissue, at_every_point, stiffness_of, turned

ENDOCARDIUM = "endocardium"
"""The facet set that is a cavity's wall also where no pressure acts on it."""


@dataclass(frozen=True, eq=False, repr=False)
class Scene(SceneData):
    """Geometry, law, loads, supports and parameters of one problem, and what follows from them.

    The fields are listed in :class:`~emulator.scenes.scene_data.SceneData`. They are checked, and
    frozen, arrays included, so that compiled functions of the scene never go stale.
    """

    @property
    def node_count(self) -> int:
        """The number of nodes of the mesh."""
        return len(self.mesh.nodes)

    # Discretisation.

    @cached_property
    def discretisation(self) -> Discretisation:
        """Shape functions and quadrature of the mesh."""
        return discretise(self.mesh)

    @cached_property
    def blocks(self) -> Blocks:
        """The elements, or patches of them, that the strain energy is a sum over."""
        return patchwise(self.discretisation) if self.dilatation == "patch" else self.discretisation

    def gradients(self, u: jax.Array) -> jax.Array:
        """Return ``H = du/dX`` at every quadrature point, (m, q, 3, 3), from ``u`` (n, 3) in mm."""
        local = u[self.discretisation.connectivity]
        return jnp.einsum("mai,mqaj->mqij", local, self.discretisation.gradients)

    # Tissue: directions and regions at the quadrature points.

    @property
    def fibres_at_points(self) -> np.ndarray:
        """Unit fibre directions at the quadrature points, (m, q, 3); of a scene with fibres."""
        if self.fibres is None:
            raise InputError(f"scene '{self.name}' has no fibres")
        return at_every_point(self.fibres, self.point_count)

    @property
    def fibres_of_loads(self) -> Fibres | None:
        """The fibres in the form that loads take; None in a scene without."""
        return None if self.fibres is None else Fibres(self.fibres_at_points, self.angles)

    def fibres_at(self, theta: jax.Array) -> jax.Array:
        """Return unit fibre directions (m, q, 3) at ``theta`` (p,); of a scene with fibres."""
        return jnp.asarray(turned(self.fibres_at_points, self.angles, self.resolve(theta)))

    def tissue_at(self, theta: jax.Array) -> Tissue:
        """Return material data at ``theta`` (p,), stacked over elements and points, (m, q, ...)."""
        directions, values = self._tissue.directions, self.resolve(theta)
        if directions is not None:
            directions = turned(directions, self.angles, values)
        stiffness = stiffness_of(self.regions, self.stiffness_modes, values)
        if stiffness is not None:
            stiffness = jnp.broadcast_to(stiffness[:, None], (len(stiffness), self.point_count))
        return Tissue(directions, stiffness)

    def block_tissue_at(self, theta: jax.Array) -> Tissue:
        """Return material data at ``theta`` (p,) stacked over :attr:`blocks`, (b, q, ...)."""
        if not self.angles and self.regions is None and self.stiffness_modes is None:
            return self._block_tissue
        return jax.tree.map(self.blocks.gather, self.tissue_at(theta))

    @cached_property
    def _tissue(self) -> Tissue:
        # NumPy arrays: JAX arrays made inside jit would be tracers, and a scene keeps these.
        directions = self.fibres_at_points if self.law.fibres else None
        if directions is not None and self.sheets is not None:
            directions = np.stack(
                [directions, at_every_point(self.sheets, self.point_count)], axis=2
            )
        return Tissue(cast(Any, directions))

    @cached_property
    def _block_tissue(self) -> Tissue:
        return jax.tree.map(self.blocks.gather, self._tissue)

    # Prescribed displacements.

    @property
    def held(self) -> np.ndarray:
        """Whether each displacement component is prescribed, (n, 3) bool."""
        return self.prescribed.held

    @property
    def held_displacement(self) -> np.ndarray:
        """Prescribed displacement in mm that no parameter scales, zero elsewhere, (n, 3)."""
        return self.prescribed.displacement

    def held_at(self, theta: jax.Array, nodes: np.ndarray | slice = slice(None)) -> jax.Array:
        """Return the prescribed displacement in mm at ``theta`` (..., p), zero elsewhere.

        The shape is (n, 3), or (k, 3) at ``nodes`` (k,), where no parameter scales it, else
        (..., n, 3).
        """
        values = self.resolve(jnp.moveaxis(jnp.asarray(theta), -1, 0))
        return self.prescribed.at(values, nodes)

    def on_supports(
        self,
        u: jax.Array,
        theta: jax.Array,
        nodes: np.ndarray | slice = slice(None),
        *,
        level: jax.Array | float = 1.0,
    ) -> jax.Array:
        """Return ``u`` with its prescribed components set to their values.

        Parameters
        ----------
        u : the displacement (..., n, 3) in mm, or (..., k, 3) at ``nodes``.
        theta : the parameters, (..., p).
        nodes : the numbers (k,) of the nodes; all by default.
        level : the fraction of the prescribed displacements that is applied.
        """
        return jnp.where(self.held[nodes], level * self.held_at(theta, nodes), u)

    # Identity and summary.

    @cached_property
    def identity(self) -> Identity:
        """Everything the solutions depend on; see :mod:`emulator.scenes.identity`."""
        return identity_of(self)

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of the identity, and of the order and the box of theta."""
        return fingerprint(self, self.identity)

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Return the title, and rows of mesh, law, loads, supports and theta."""
        mesh = self.mesh
        order = "linear" if mesh.order == 1 else "quadratic"
        if (mesh.order, self.dilatation) != (1, "pointwise"):
            order = f"{order}, {self.dilatation} dilatation"
        law, theta = self._summary_of_law()
        return f"Scene '{self.name}'", [
            ("mesh", f"{len(mesh.nodes)} nodes, {len(mesh.elements)} tetrahedra, {order}"),
            law,
            ("loads", ", ".join(load.kind for load in self.loads) or "none"),
            ("supports", ", ".join(support.kind for support in self.supports)),
            theta,
        ]


def with_mesh(problem: ForwardProblem) -> Scene:
    """Return ``problem`` if it is a scene; :class:`InputError` for a specimen."""
    if not isinstance(problem, Scene):
        raise InputError(
            f"scene '{problem.name}' is {problem.noun}; simulate, infer, certify and report take it"
        )
    return problem


def all_nodes(problem: ForwardProblem) -> np.ndarray:
    """Return the number of every node of a scene or a specimen, (n,)."""
    return np.arange(problem.node_count)


def check_nodes(problem: ForwardProblem, nodes: np.ndarray) -> np.ndarray:
    """Return ``nodes`` as integers; refuse any that is no node of the scene or specimen."""
    nodes = np.atleast_1d(np.asarray(nodes))
    if nodes.size == 0 or not np.issubdtype(nodes.dtype, np.integer):
        raise InputError("observed nodes must be a list of whole numbers, not empty")
    unknown = nodes[(nodes < 0) | (nodes >= problem.node_count)]
    if unknown.size:
        raise InputError(
            f"node {unknown[0]} is unknown; scene '{problem.name}' has nodes 0 to "
            f"{problem.node_count - 1}"
        )
    return nodes


# Cavities: facet sets that enclose a volume.


def cavity_sets(scene: Scene) -> tuple[str, ...]:
    """Return the facet sets that enclose a volume: sets under pressure, and ``endocardium``."""
    endocardium = [ENDOCARDIUM] if ENDOCARDIUM in scene.mesh.facet_sets else []
    pressed = [load.pressed for load in scene.loads if load.pressed is not None]
    names = dict.fromkeys([*pressed, *endocardium])
    return tuple(name for name in names if encloses(scene.mesh, name))


def inflated_cavity(scene: Scene) -> tuple[str, str] | None:
    """Return wall and pressure of the first cavity whose pressure is a parameter, or None."""
    closed = cavity_sets(scene)
    for load in scene.loads:
        if load.pressed in closed:
            for quantity in load.quantities:
                if quantity.name in scene.parameter_names:
                    return str(load.pressed), quantity.name
    return None


def find_cavity(scene: Scene, facet_set: str | None = None) -> Cavity:
    """Return the cavity whose wall is ``facet_set``; by default the only one of the scene.

    Raises
    ------
    InputError
        The set is missing or encloses no volume; several cavities, or none, and no name.
    """
    if facet_set is not None:
        return Cavity(scene.mesh, facet_set)
    names = cavity_sets(scene)
    if len(names) != 1:
        known = ", ".join(names or sorted(scene.mesh.facet_sets)) or "none"
        raise InputError(
            f"scene '{scene.name}' has {len(names)} cavities; name a facet set: {known}"
        )
    return Cavity(scene.mesh, names[0])
