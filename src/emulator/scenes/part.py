"""Loads and supports: their interfaces, and sums of local contributions.

A load or support that depends on the displacement is a sum over small groups of nodes, one for each
facet or element: of energies, or of forces without a potential. Assembly adds their Hessians (or
Jacobians) to the tangent in the way of the element blocks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws.law import Quantity, number
from emulator.scenes.tissue import Fibres, Values


@dataclass(frozen=True, eq=False)
class LocalSum:
    """A sum of local contributions.

    nodes : the nodes (k, a) that each contribution depends on.
    data : the arrays with leading axis k, of NumPy, because JAX's made inside jit are tracers.
    """

    nodes: np.ndarray
    data: Any

    def _per_group(self, function: Callable, u: jax.Array, values: Values) -> jax.Array:
        """Return ``function(u, data_row, values)``, ``u`` (a, 3), of every group (k, ...)."""
        return jax.vmap(lambda v, d: function(v, d, values))(u[self.nodes], self.data)

    def _blocks(self, function: Callable, u: jax.Array, values: Values) -> jax.Array:
        """Return derivatives (a, 3, a, 3) of every group as blocks (k, 3a, 3a)."""
        size = 3 * self.nodes.shape[1]
        return self._per_group(function, u, values).reshape(-1, size, size)


@dataclass(frozen=True, eq=False)
class LocalTerm(LocalSum):
    """A sum of local energies.

    energy : ``energy(u, data_row, values) -> ()``, the energy in mN mm of one group, ``u`` (a, 3).
    convex : whether every local energy is convex. Its stiffness then helps an iteration that starts
        far from equilibrium.
    """

    energy: Callable[[jax.Array, Any, Values], jax.Array]
    convex: bool = False

    def energies(self, u: jax.Array, values: Values) -> jax.Array:
        """Return the energy (k,) in mN mm of each group."""
        return self._per_group(self.energy, u, values)

    def total(self, u: jax.Array, values: Values) -> jax.Array:
        """Return the sum, shape ()."""
        return jnp.sum(self.energies(u, values))

    def tangents(self, u: jax.Array, values: Values) -> jax.Array:
        """Return the Hessians (k, 3a, 3a) of the local energies."""
        return self._blocks(jax.hessian(self.energy), u, values)


@dataclass(frozen=True, eq=False)
class LocalForce(LocalSum):
    """A sum of local forces that have no potential.

    force : ``force(u, data_row, values) -> (a, 3)``, the forces in mN of one group, ``u`` (a, 3).
    """

    force: Callable[[jax.Array, Any, Values], jax.Array]

    def total(self, u: jax.Array, values: Values) -> jax.Array:
        """Return the nodal force (n, 3) in mN."""
        return jnp.zeros_like(u).at[self.nodes].add(self._per_group(self.force, u, values))

    def tangents(self, u: jax.Array, values: Values) -> jax.Array:
        """Return the derivatives (k, 3a, 3a) of minus the local forces, not symmetric."""
        return -self._blocks(jax.jacfwd(self.force), u, values)


@dataclass(frozen=True, eq=False)
class Part(ABC):
    """A load or a support: a frozen dataclass whose fields are the keys of its table in a file.

    Fields of these names mean the same in every part:

    facet_set : the surface that the part acts on.
    node_set : the nodes that it acts on.
    parameter : the name of the parameter that stands for :attr:`magnitude` where this is None.
    amount : the name of a parameter without a unit by which a vector is multiplied, or None.
    """

    kind: ClassVar[str]
    """Name in scene files and in the registry."""
    magnitude: ClassVar[Quantity | None] = None
    """Name, unit and admissible values of the field that is a number, or None for a parameter."""

    @property
    def known(self) -> float | None:
        """The magnitude where it is a number; None where it is a parameter, or there is none."""
        return None if self.magnitude is None else vars(self)[self.magnitude.name]

    def value(self, values: Values) -> jax.Array | float:
        """Return the magnitude in its unit, from ``values`` where it is a parameter."""
        return values[vars(self)["parameter"]] if self.known is None else self.known

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The parameters that the part takes from theta or from the scene's constants."""
        if self.magnitude is not None and self.known is None:
            return (replace(self.magnitude, name=vars(self)["parameter"]),)
        amount = vars(self).get("amount")
        return () if amount is None else (number(amount, -np.inf),)

    @property
    def facet_sets(self) -> tuple[str, ...]:
        """The facet sets that the part acts on, which the mesh must have."""
        facet_set = vars(self).get("facet_set")
        return () if facet_set is None else (facet_set,)

    @property
    def simpler(self) -> tuple[str, Any] | None:
        """The effect that can be left out, and the part without it, None for no part; or None."""
        return None

    def to_json(self) -> list[Any] | None:
        """Return kind and every field as plain JSON, for fingerprints; or None for nothing.

        Numbers are floats, -0.0 is 0.0, and the entries of a tuple or an array stand one by one.
        The name of the parameter is None where the magnitude is a number.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        if self.known is not None:
            values["parameter"] = None
        entries: list[Any] = [self.kind]
        for value in values.values():
            value = value.ravel().tolist() if isinstance(value, np.ndarray) else value
            for entry in value if isinstance(value, tuple | list) else (value,):
                numeric = isinstance(entry, int | float) and not isinstance(entry, bool)
                entries.append(float(entry) + 0.0 if numeric else entry)
        return entries


@dataclass(frozen=True, eq=False)
class Load(Part):
    """A part that deforms the body.

    A load contributes in one of three ways, and overrides the method for it: dead nodal forces, a
    potential, or a force that follows the deformation and has no potential.
    """

    fibres: ClassVar[bool] = False
    """Whether the load reads fibre directions, which the scene must then have."""
    has_potential: ClassVar[bool] = True
    """Whether the load's work is a potential of the displacement."""
    shared: ClassVar[bool] = False
    """Whether all load states share its parameter, which is then the body's."""

    @property
    def pressed(self) -> str | None:
        """The facet set that a pressure acts on, or None."""
        return None

    @property
    def at_held_nodes(self) -> Load:
        """The same load with its reactions at prescribed nodes included.

        A potential only has to be right for nodes that are free.
        """
        return self

    def check(self, mesh: Mesh, prescribed: Prescribed) -> None:
        """Raise :class:`~emulator.core.errors.InputError` if the load cannot act on this body."""

    @property
    def energy_density(self) -> Callable[[jax.Array, Values], jax.Array] | None:
        """The energy (...) in kPa at a displacement gradient (..., 3, 3), or None.

        Only of a load under which bodies at rest are in equilibrium, if they are held where it asks
        for it. What is linear in the gradient, and then adds up to nothing, is left out.
        """
        return None

    def dead_forces(self, grid: Discretisation) -> Mapping[str | None, np.ndarray]:
        """Return nodal forces (n, 3) that do not follow the deformation.

        The force under a parameter's name is in mN per unit of it, the one under None in mN.
        """
        return {}

    def terms(self, grid: Discretisation, fibres: Fibres | None = None) -> tuple[LocalTerm, ...]:
        """Return the potentials of a load that follows the deformation.

        Parameters
        ----------
        grid : the discretised body. Its arrays are traced in unloading, where the stress-free shape
            is an unknown.
        fibres : the fibres of the tissue, traced too; None in a scene without.
        """
        return ()

    def force(self, grid: Discretisation) -> LocalForce | None:
        """Return the force of a load that follows the deformation without a potential, or None."""
        return None

    def first_piola(
        self, F: jax.Array, mesh: Mesh, fibres: jax.Array | None, values: Mapping[str, jax.Array]
    ) -> jax.Array | None:
        """Return the stress (m, q, 3, 3) in kPa added to the law's at F (m, q, 3, 3), or None."""
        return None

    def on_loaded(
        self, grid: Discretisation, fibres: Fibres | None = None
    ) -> tuple[LocalForce, ...]:
        """Return the forces on a body whose *loaded* shape is the mesh, in the inverse problem.

        The local displacements of the forces are those of w, from the loaded to the stress-free
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


def sums[A: (jax.Array, np.ndarray)](count: int, places: np.ndarray, amounts: A) -> A:
    """Return the sum (count,) of ``amounts`` (...) at each of their ``places`` (...)."""
    if isinstance(amounts, np.ndarray):
        return np.bincount(places.ravel(), amounts.ravel(), minlength=count)
    return jax.ops.segment_sum(amounts.ravel(), places.ravel(), count)


class Held(NamedTuple):
    """Prescribed displacements of one support.

    where : the name of the node set, for error messages.
    nodes : the nodes (k,) of the set.
    displacement : the displacement, (k, 3) mm; with ``amount``, per unit of that parameter.
    axes : the numbers of the prescribed components.
    amount : the name of the parameter that multiplies the displacement, or None.
    """

    where: str
    nodes: np.ndarray
    displacement: np.ndarray
    axes: list[int]
    amount: str | None = None


class Prescribed(NamedTuple):
    """The displacements that all supports of a scene prescribe.

    held : (n, 3) bool, the components that are prescribed.
    displacement : their fixed part, (n, 3) mm, zero elsewhere.
    per_unit : (n, 3) mm per unit of a parameter, by the parameter's name.
    """

    held: np.ndarray
    displacement: np.ndarray
    per_unit: Mapping[str, np.ndarray]

    @property
    def moves(self) -> bool:
        """Whether any prescribed displacement differs from zero."""
        return bool(self.displacement.any()) or bool(self.per_unit)

    def at(self, values: Values, rows: slice | np.ndarray = slice(None)) -> jax.Array:
        """Return the displacement (..., k, 3) mm of nodes ``rows`` at amounts ``values`` (...)."""
        u = jnp.asarray(self.displacement[rows])
        for name, per_unit in self.per_unit.items():
            u = u + jnp.asarray(values[name])[..., None, None] * per_unit[rows]
        return u


@dataclass(frozen=True, eq=False)
class BoundaryCondition(Part):
    """A part that prescribes displacements, or resists them or their rates."""

    resists_velocity: ClassVar[bool] = False
    """Whether the part resists how fast the body moves; its scene then goes through time."""

    def held(self, mesh: Mesh) -> Held | None:
        """Return prescribed displacements, or None."""
        return None

    def terms(self, grid: Discretisation) -> tuple[LocalTerm, ...]:
        """Return the potentials of the springs."""
        return ()

    def on_loaded(self, grid: Discretisation) -> tuple[LocalForce, ...]:
        """Return the forces of the springs as :meth:`Load.on_loaded` does."""
        return ()

    def on_finer(
        self, mesh: Mesh, displacements: Mapping[str | None, np.ndarray]
    ) -> BoundaryCondition:
        """Return the support on a finer mesh.

        Parameters
        ----------
        mesh : the finer mesh.
        displacements : (f, 3) mm at its nodes, the fixed one under None, and one per unit of each
            parameter under the parameter's name.
        """
        return self

    @abstractmethod
    def resisted(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
        """Return points (k, 3) in mm, and directions (k, 3) in which they cannot move freely."""
