"""The interface every load implements."""

from __future__ import annotations

from abc import ABC
from typing import Any, ClassVar

import jax
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.fibre_angles import Fibres
from emulator.scenes.identity import plain_fields
from emulator.scenes.local_terms import LocalForce, LocalTerm, Values


class Load(ABC):
    """What deforms a body; a concrete one is a frozen dataclass whose fields a scene file can give.

    A load contributes in one of four ways, and overrides the method for it: a dead nodal force, one
    in proportion to parameters, a potential, or a force that has no potential.

    kind : name in scene files and in :data:`~emulator.scenes.loads.LOADS`.
    """

    kind: ClassVar[str]

    @property
    def facet_sets(self) -> tuple[str, ...]:
        """Facet sets the load acts on; they must be in the mesh."""
        return ()

    @property
    def fibres(self) -> bool:
        """Whether the load reads fibre directions, which the scene must then have."""
        return False

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Parameters the load takes from theta or from the scene's constants."""
        return ()

    @property
    def pressed(self) -> str | None:
        """Facet set a pressure acts on: a cavity's wall if it encloses a volume; else None."""
        return None

    @property
    def simpler(self) -> tuple[str, Load | None] | None:
        """An effect that can be left out: its name, and the load without it, None for no load."""
        return None

    @property
    def has_potential(self) -> bool:
        """Whether the load's work is a potential of the displacement."""
        return True

    @property
    def at_held_nodes(self) -> Load:
        """The load whose force is that of this one where nodes are held, too.

        A potential is only meant for nodes that move.
        """
        return self

    def check(self, mesh: Mesh, held: np.ndarray, displacement: np.ndarray) -> None:
        """Raise :class:`~emulator.core.errors.InputError` if the load cannot act on this body.

        Parameters
        ----------
        held, displacement : (n, 3) where the displacement is prescribed, and its value in mm.
        """

    def nodal_force(self, grid: Discretisation) -> np.ndarray | None:
        """Dead nodal force (n, 3) in mN, or None."""
        return None

    def nodal_force_per_unit(self, grid: Discretisation) -> dict[str, np.ndarray]:
        """Dead nodal force (n, 3) in mN per unit of each parameter that scales one."""
        return {}

    def term(self, grid: Discretisation, fibres: Fibres | None = None) -> LocalTerm | None:
        """Potential of a load that follows the deformation, or None.

        fibres : of the tissue, None in a scene without. They and the grid's arrays are traced
        where the body is at rest on a shape that is sought.
        """
        return None

    def force(self, grid: Discretisation) -> LocalForce | None:
        """Force of a load that follows the deformation and has no potential, or None."""
        return None

    def first_piola(
        self, F: jax.Array, mesh: Mesh, fibres: jax.Array, values: Values
    ) -> jax.Array | None:
        """Stress (m, q, 3, 3) in kPa that it adds to the law's, where F (m, q, 3, 3); or None."""
        return None

    def on_loaded(self, grid: Discretisation, fibres: Fibres | None = None) -> LocalForce:
        """Its force on the body whose *loaded* shape is the mesh, of w from there to rest.

        What is given per volume or area at rest depends on w; what follows the surface does not.
        Its local displacements are those of w (:mod:`emulator.fem.inverse_motion`). fibres : of the
        loaded tissue, None in a scene without.

        Raises
        ------
        InputError
            A kind, or a case of it, that bodies cannot be unloaded from.
        """
        raise InputError(f"a body cannot be unloaded from a load of kind '{self.kind}'")

    def to_json(self) -> list[Any]:
        """Plain JSON that differs between loads with different effects: every field."""
        return plain_fields(self)


def nodal_sums[A: (jax.Array, np.ndarray)](mesh: Mesh, nodes: np.ndarray, amounts: A) -> A:
    """Sum of ``amounts`` (k, a) at each of their ``nodes`` (k, a), shape (n,)."""
    if isinstance(amounts, np.ndarray):
        return np.bincount(nodes.ravel(), amounts.ravel(), minlength=len(mesh.nodes))
    return jax.ops.segment_sum(amounts.ravel(), nodes.ravel(), len(mesh.nodes))
