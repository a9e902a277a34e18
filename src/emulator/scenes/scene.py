"""A scene: geometry, law, loads, supports and parameters of one problem."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.core.representation import TableRepr
from emulator.geometry.discretisation import (
    Blocks,
    Discretisation,
    discretise,
    quadrature_points,
)
from emulator.geometry.fibres import check_across, checked_directions
from emulator.geometry.mesh import Mesh
from emulator.geometry.patches import patchwise
from emulator.mechanics.laws import Law
from emulator.mechanics.laws.law import Quantity, law_identity
from emulator.scenes.dilatation import Dilatation, check_dilatation
from emulator.scenes.fibre_angles import (
    FibreAngles,
    Fibres,
    checked_angles,
    identity_of_angles,
    turned,
)
from emulator.scenes.fibre_rules import FibreRule
from emulator.scenes.identity import Identity, fingerprint, identity_of
from emulator.scenes.loads.load import Load
from emulator.scenes.owners import Owners, check_given, check_image, directions_read, owners_of
from emulator.scenes.parameter_space import Parameter, ParameterSpace
from emulator.scenes.regions import Tissue, checked_regions, tissue_of
from emulator.scenes.supports.boundary_condition import BoundaryCondition
from emulator.scenes.supports.dirichlet import Prescribed, prescribe
from emulator.scenes.supports.rigid import check_motions


@dataclass(frozen=True, eq=False, repr=False)
class Scene(TableRepr):
    """Geometry, law, loads, supports and parameters of one problem.

    Frozen, arrays included, so that compiled functions of it never go stale.

    Parameters
    ----------
    name : used in messages and reports.
    mesh : geometry in mm.
    law : hyperelastic law.
    parameters : entries of theta, in order.
    loads : what deforms the body; may be empty, when the supports alone deform the body.
    supports : prescribed displacements and springs.
    constants : parameters of the law and the loads that do not vary.
    fibres : unit fibre directions, for laws and loads that read them: at every quadrature
        point (m, q, 3), or of each element (m, 3). Constant in an element, they cost a quadratic
        one most of its accuracy.
    origin : how a built-in scene was made: its name and arguments, written to scene files.
    dilatation : ``pointwise``, or ``mean`` to use the mean volume change of each element, which
        keeps quadratic elements from locking when the material is nearly incompressible, or
        ``patch`` to use that of about six neighbouring linear ones, which helps these
        (:mod:`emulator.geometry.patches`).
    sheets : unit sheet directions across the fibres, likewise.
    regions : (m,) whole number of the region each element lies in. Region 3 takes a parameter or a
        constant ``stiffness_3``, by which the law's energy there is multiplied, except its
        volumetric part; see :mod:`emulator.scenes.regions`.
    fibre_rule : what made the directions of this mesh, for another mesh of the body
        (:mod:`emulator.scenes.finer`).
    angles : parameters that turn fibres and sheets (:mod:`emulator.scenes.fibre_angles`), one
        rotation after the other, as the rule's ``angles_in`` gives them; ``fibres`` and ``sheets``
        are those at angle zero.
    loaded_by : empty where the mesh is at rest. Where it is the loaded shape of an image: for every
        load parameter of theta the name of the parameter or constant that holds its value there,
        ``{"pressure": "imaged"}``. A simulator then unloads and loads
        (:mod:`emulator.fem.loaded`), and displacements are those from the mesh.
    """

    name: str
    mesh: Mesh
    law: Law
    parameters: tuple[Parameter, ...]
    loads: tuple[Load, ...] = ()
    supports: tuple[BoundaryCondition, ...] = ()
    constants: Mapping[str, float] = field(default_factory=dict)
    fibres: np.ndarray | None = None
    origin: Mapping[str, Any] = field(default_factory=dict)
    dilatation: Dilatation = "pointwise"
    sheets: np.ndarray | None = None
    regions: np.ndarray | None = None
    fibre_rule: FibreRule | None = None
    angles: tuple[FibreAngles, ...] = ()
    loaded_by: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "constants", MappingProxyType(dict(self.constants)))
        object.__setattr__(self, "origin", MappingProxyType(dict(self.origin)))
        object.__setattr__(self, "loaded_by", MappingProxyType(dict(self.loaded_by)))
        self._check_regions()
        self._check_directions()
        with self._named():
            check_given(self._owners, self.law, self.parameters, self.constants)
        with self._named():
            check_dilatation(self.dilatation, self.mesh.order)
        if not self.parameters:
            raise InputError(f"scene '{self.name}': no parameter varies, nothing to calibrate")
        self._check_supports()
        self._check_loads()

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Errors raised inside name the scene."""
        try:
            yield
        except InputError as error:
            raise InputError(f"scene '{self.name}': {error}") from error

    def _check_regions(self) -> None:
        if self.regions is not None:
            with self._named():
                labels = checked_regions(self.regions, len(self.mesh.elements), self.law)
            object.__setattr__(self, "regions", labels)

    def _check_directions(self) -> None:
        for kind, reader in directions_read(self.law, self.loads).items():
            given = getattr(self, kind)
            if given is None:
                if reader is not None:
                    raise InputError(f"scene '{self.name}': {reader} needs {kind}")
                continue
            if reader is None:
                raise InputError(f"scene '{self.name}': law '{self.law.name}' takes no {kind}")
            with self._named():
                object.__setattr__(self, kind, checked_directions(given, self.mesh, kind))
        with self._named():
            angles = checked_angles(self.angles, self.mesh, self.fibres, self.sheets)
            object.__setattr__(self, "angles", angles)
            if self.fibres is not None and self.sheets is not None:
                check_across(self._at_points(self.sheets), self.fibres_at_points)

    def _check_supports(self) -> None:
        if not self.supports:
            raise InputError(f"scene '{self.name}': no support, the body could move freely")
        self.prescribed  # noqa: B018 - supports that contradict each other are named first
        check_motions(self.name, self.mesh, self.supports)

    def _check_loads(self) -> None:
        for part in self.parts:
            for name in part.facet_sets:
                self.mesh.facet_set(name)
        _, fixed, per_unit = self.prescribed
        moved = sum((np.abs(each) for each in per_unit.values()), np.abs(fixed))
        for load in self.loads:
            load.check(self.mesh, self.held, moved)
        with self._named():
            check_image(self.loaded_by, self.load_parameters)

    @property
    def parts(self) -> tuple[Load | BoundaryCondition, ...]:
        """Loads and supports."""
        return (*self.loads, *self.supports)

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Every parameter that law, loads and regions take, by name."""
        return {name: quantity for name, (quantity, _) in self._owners.items()}

    @property
    def _owners(self) -> Owners:
        return owners_of(
            self.law, self.regions, self.angles, self.loads, self.supports, self.loaded_by
        )

    @cached_property
    def space(self) -> ParameterSpace:
        """The box that theta lies in."""
        return ParameterSpace(self.parameters)

    @property
    def load_parameters(self) -> tuple[str, ...]:
        """Parameters that loads take, and by which supports move; the others are the body's."""
        taken = {quantity.name for load in self.loads for quantity in load.quantities}
        taken |= set(self.prescribed.per_unit)
        return tuple(name for name in self.parameter_names if name in taken)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of theta, in order."""
        return self.space.names

    @property
    def centre(self) -> jax.Array:
        """Theta in the middle of its box, on each parameter's scale, shape (p,)."""
        return self.space.centre

    def theta(self, **values: float) -> jax.Array:
        """Theta from named values in the parameters' units, shape (p,).

        Raises
        ------
        InputError
            Unknown, missing or out-of-range value.
        """
        return self.space.theta(values, f"scene '{self.name}'")

    def to_unit(self, theta: jax.Array) -> jax.Array:
        """Theta (..., p) as positions in its box, 0 to 1 inside."""
        return self.space.to_unit(theta)

    def from_unit(self, position: jax.Array) -> jax.Array:
        """Inverse of :meth:`to_unit`."""
        return self.space.from_unit(position)

    def resolve(self, theta: jax.Array) -> dict[str, jax.Array]:
        """Every parameter of law, loads, supports and regions by name, from theta (p,)."""
        values: dict[str, Any] = dict(self.constants)
        values.update({name: theta[k] for k, name in enumerate(self.parameter_names)})
        return values

    @cached_property
    def discretisation(self) -> Discretisation:
        """Shape functions and quadrature of the mesh."""
        return discretise(self.mesh)

    @cached_property
    def blocks(self) -> Blocks:
        """What the strain energy is a sum over: the elements, or patches of them."""
        return patchwise(self.discretisation) if self.dilatation == "patch" else self.discretisation

    def _at_points(self, of_elements: np.ndarray) -> np.ndarray:
        """Directions (m, 3) or (m, q, 3) at every quadrature point, (m, q, 3)."""
        points = len(quadrature_points(self.mesh.order))
        if of_elements.shape[1:] == (points, 3):
            return of_elements
        return np.broadcast_to(of_elements[:, None], (len(of_elements), points, 3))

    @property
    def fibres_at_points(self) -> np.ndarray:
        """Unit fibre directions at the quadrature points, (m, q, 3); of a scene with fibres."""
        if self.fibres is None:
            raise InputError(f"scene '{self.name}' has no fibres")
        return self._at_points(self.fibres)

    @property
    def fibres_of_loads(self) -> Fibres | None:
        """What loads along the fibres act along; None in a scene without."""
        return None if self.fibres is None else Fibres(self.fibres_at_points, self.angles)

    def fibres_at(self, theta: jax.Array) -> jax.Array:
        """Unit fibre directions (m, q, 3) at ``theta`` (p,); of a scene with fibres."""
        given = Tissue(jnp.asarray(self.fibres_at_points))
        return cast(Any, turned(given, self.angles, self.resolve(theta)).directions)

    def tissue_at(self, theta: jax.Array) -> Tissue:
        """Material data at ``theta`` (p,), stacked over elements and points, (m, q, ...)."""
        return turned(self._tissue, self.angles, self.resolve(theta))

    def block_tissue_at(self, theta: jax.Array) -> Tissue:
        """The same stacked over :attr:`blocks` and their points, (b, q, ...)."""
        if not self.angles:
            return self._block_tissue
        return jax.tree.map(self.blocks.gather, self.tissue_at(theta))

    @cached_property
    def _tissue(self) -> Tissue:
        fibres = self.fibres_at_points if self.law.fibres else None
        sheets = None if self.sheets is None else self._at_points(self.sheets)
        return tissue_of(fibres, sheets, self.regions, len(quadrature_points(self.mesh.order)))

    @cached_property
    def _block_tissue(self) -> Tissue:
        return jax.tree.map(self.blocks.gather, self._tissue)

    @cached_property
    def prescribed(self) -> Prescribed:
        """Where the displacement is known, and its value, in mm."""
        return prescribe(self.mesh, self.supports)

    @property
    def held(self) -> np.ndarray:
        """Where the displacement is known, (n, 3) bool."""
        return self.prescribed.held

    @property
    def held_displacement(self) -> np.ndarray:
        """Known displacement in mm that no parameter scales, zero elsewhere, (n, 3)."""
        return self.prescribed.displacement

    def held_at(self, theta: jax.Array, nodes: np.ndarray | None = None) -> jax.Array:
        """Known displacement in mm at ``theta`` (..., p), zero elsewhere.

        (n, 3), or (k, 3) at ``nodes`` (k,), where no parameter scales it, else (..., n, 3).
        """
        values = self.resolve(jnp.moveaxis(jnp.asarray(theta), -1, 0))
        return self.prescribed.at(values, slice(None) if nodes is None else nodes)

    def on_supports(
        self,
        u: jax.Array,
        theta: jax.Array,
        nodes: np.ndarray | None = None,
        *,
        level: jax.Array | float = 1.0,
    ) -> jax.Array:
        """``u`` (..., n, 3) mm, or (..., k, 3) at ``nodes`` (k,), made exact where held.

        level : fraction of the way that the supports have gone.
        """
        held = self.held if nodes is None else self.held[nodes]
        return jnp.where(held, level * self.held_at(theta, nodes), u)

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Name, mesh, law, loads, supports, theta."""
        mesh = self.mesh
        order = "linear" if mesh.order == 1 else "quadratic"
        if (mesh.order, self.dilatation) != (1, "pointwise"):
            order = f"{order}, {self.dilatation} dilatation"
        loads, supports = (", ".join(p.kind for p in all_) for all_ in (self.loads, self.supports))
        ranges = [f"{p.name} {p.low:.4g} to {p.high:.4g} {p.unit}".strip() for p in self.parameters]
        return f"Scene '{self.name}'", [
            ("mesh", f"{len(mesh.nodes)} nodes, {len(mesh.elements)} tetrahedra, {order}"),
            ("law", self.law.name),
            ("loads", loads or "none"),
            ("supports", supports),
            ("theta", ", ".join(ranges)),
        ]

    @cached_property
    def identity(self) -> Identity:
        """Everything the solutions depend on; see :mod:`emulator.scenes.identity`."""
        springs = [support.to_json() for support in self.supports]
        description = {
            "law": law_identity(self.law),
            "constants": {name: float(value) for name, value in self.constants.items()},
            "parameters": sorted(self.parameter_names),
            "loads": sorted(json.dumps(load.to_json()) for load in self.loads),
            "springs": sorted(json.dumps(spring) for spring in springs if spring is not None),
            "dilatation": self.dilatation,
        }
        turning = identity_of_angles(self.angles)
        if self.loaded_by:  # fingerprints of selfs at rest are older
            description["loaded_by"] = dict(self.loaded_by)
        held, fixed, per_unit = self.prescribed
        moved = {f"displacement per unit of {name}": each for name, each in per_unit.items()}
        return identity_of(
            self.mesh,
            held,
            {"displacement": fixed, **moved},
            {"fibres": self.fibres, "sheets": self.sheets, **turning},
            self.regions,
            sorted({name for part in self.parts for name in part.facet_sets}),
            description,
        )

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of the identity, and of theta's order and box."""
        return fingerprint(self.identity, self.space)
