"""The interface of loads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation
from emulator.geometry.mesh import Mesh
from emulator.scenes.part import LocalForce, LocalTerm, Part
from emulator.scenes.tissue import Fibres


@dataclass(frozen=True, eq=False)
class Load(Part):
    """A part that deforms the body.

    A load contributes in one of three ways, and overrides the method for it: dead nodal forces, a
    potential, or a force that follows the deformation and has no potential.
    """

    @property
    def fibres(self) -> bool:
        """Whether the load reads fibre directions, which the scene must then have."""
        return False

    @property
    def pressed(self) -> str | None:
        """The facet set that a pressure acts on, or None."""
        return None

    @property
    def has_potential(self) -> bool:
        """Whether the load's work is a potential of the displacement."""
        return True

    @property
    def at_held_nodes(self) -> Load:
        """The load whose force is right at prescribed nodes, too.

        A potential only has to be right for nodes that are free.
        """
        return self

    def check(self, mesh: Mesh, prescribed: np.ndarray, displacement: np.ndarray) -> None:
        """Raise :class:`~emulator.core.errors.InputError` if the load cannot act on this body.

        Parameters
        ----------
        mesh : the mesh of the body.
        prescribed : whether the displacement is prescribed, (n, 3) bool.
        displacement : the prescribed displacement, (n, 3) mm, of parameters per unit.
        """

    def dead_forces(self, grid: Discretisation) -> Mapping[str | None, np.ndarray]:
        """Return nodal forces (n, 3) that do not follow the deformation.

        The force under a parameter's name is in mN per unit of it, the one under None in mN.
        """
        return {}

    def term(self, grid: Discretisation, fibres: Fibres | None = None) -> LocalTerm | None:
        """Return the potential of a load that follows the deformation, or None.

        Parameters
        ----------
        grid : the discretised body. Its arrays are traced in unloading, where the stress-free shape
            is an unknown.
        fibres : the fibres of the tissue, traced too; None in a scene without.
        """
        return None

    def force(self, grid: Discretisation) -> LocalForce | None:
        """Return the force of a load that follows the deformation without a potential, or None."""
        return None

    def first_piola(
        self, F: jax.Array, mesh: Mesh, fibres: jax.Array, values: Mapping[str, jax.Array]
    ) -> jax.Array | None:
        """Return the stress (m, q, 3, 3) in kPa added to the law's at F (m, q, 3, 3), or None."""
        return None

    def on_loaded(self, grid: Discretisation, fibres: Fibres | None = None) -> LocalForce:
        """Return the force on a body whose *loaded* shape is the mesh, in the inverse problem.

        The local displacements of the force are those of w, from the loaded to the stress-free
        shape (:mod:`emulator.fem.inverse_motion`). A force per volume or area of the stress-free
        body depends on w; one that follows the surface does not.

        Parameters
        ----------
        grid : the discretised loaded body.
        fibres : the fibres of the loaded tissue; None in a scene without.

        Raises
        ------
        InputError
            Bodies cannot be unloaded from this load.
        """
        raise InputError(f"a body cannot be unloaded from a load of kind '{self.kind}'")


def nodal_sums[A: (jax.Array, np.ndarray)](mesh: Mesh, nodes: np.ndarray, amounts: A) -> A:
    """Return the sum (n,) of ``amounts`` (k, a) at each of their ``nodes`` (k, a)."""
    if isinstance(amounts, np.ndarray):
        return np.bincount(nodes.ravel(), amounts.ravel(), minlength=len(mesh.nodes))
    return jax.ops.segment_sum(amounts.ravel(), nodes.ravel(), len(mesh.nodes))
