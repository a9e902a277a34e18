"""The description of a scene: all that a user says of it, checked and frozen.

Each parameter has an owner, directions have readers, and the body is fixed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal, get_args, override

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import quadrature_points
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws import Law
from emulator.scenes.fibre_rules import FibreRule
from emulator.scenes.forward_problem import ForwardProblem, Owners, add_owners
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.part import BoundaryCondition, Load, Prescribed
from emulator.scenes.supports.dirichlet import check_motions, prescribe
from emulator.scenes.tissue import (
    FibreAngles,
    checked_modes,
    checked_regions,
    stiffness_quantities,
)

Dilatation = Literal["pointwise", "mean", "patch"]
"""The part of a body that shares a volume change: a point, an element, or a patch of elements."""


@dataclass(frozen=True, eq=False, repr=False)
class SceneData(ForwardProblem):
    """The description of one problem: geometry, law, loads, supports and parameters.

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
        (:class:`~emulator.geometry.discretisation.Patches`).
    sheets : unit sheet directions across the fibres, likewise.
    regions : (m,) whole number of the region each element lies in. Region 3 takes a parameter or a
        constant ``stiffness_3``, by which the law's energy there is multiplied, except its
        volumetric part; see :mod:`emulator.scenes.tissue`.
    stiffness_modes : (m, k) change of the logarithm of the stiffness, likewise, for a size of 1 of
        each mode, in each element. The sizes are parameters ``stiffness_mode_1`` to k.
    fibre_rule : the rule by which the directions of this mesh were made, which gives those of
        another mesh of the body (:mod:`emulator.scenes.finer`).
    angles : parameters that turn fibres and sheets (:mod:`emulator.scenes.tissue`), one
        rotation after the other, as the rule's ``angles_in`` gives them; ``fibres`` and ``sheets``
        are those at angle zero.
    loaded_by : empty where the mesh is at rest. Where it is the loaded shape of an image: for every
        load parameter of theta the name of the parameter or constant that holds its value there,
        ``{"pressure": "imaged"}``. A simulator then unloads and loads
        (:mod:`emulator.fem.loaded`), and displacements are those from the mesh.
    viscosity : how the law's stress relaxes (:mod:`emulator.viscosity`), as a scene file's table;
        theta then has a ``time`` in s, through which ``Simulator.path`` goes.
    inertia : the body's mass (:mod:`emulator.viscosity.motion`), likewise.
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
    stiffness_modes: np.ndarray | None = None
    viscosity: Any = None
    inertia: Any = None

    def __post_init__(self) -> None:
        for name in ("constants", "origin", "loaded_by"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        try:
            self._check_time()
            self._check_tissue()
            prescribed = self.prescribed  # refuses supports that contradict one another
            self._check_parameters()
            self._check_dilatation()
            if self.inertia is None:  # else it may move freely
                check_motions(self.mesh, self.supports)
            for part in (*self.loads, *self.supports):
                for name in part.facet_sets:
                    self.mesh.facet_set(name)
                if "node_set" in vars(part):
                    self.mesh.node_set(vars(part)["node_set"])
            for load in self.loads:
                load.check(self.mesh, prescribed)
            self._check_image()
        except InputError as error:
            raise InputError(f"scene '{self.name}': {error}") from error

    @cached_property
    def prescribed(self) -> Prescribed:
        """The displacements that supports prescribe, in mm."""
        return prescribe(self.mesh, self.supports)

    @property
    def point_count(self) -> int:
        """The number of quadrature points of an element."""
        return len(quadrature_points(self.mesh.order))

    @property
    def load_parameters(self) -> tuple[str, ...]:
        """Entries of theta that belong to loads or move supports; the others are the body's."""
        names = {q.name for load in self.loads if not load.shared for q in load.quantities}
        names |= {*self.prescribed.per_unit, *(("time",) if self.in_time else ())}
        return tuple(parameter.name for parameter in self.parameters if parameter.name in names)

    @override
    def _owners(self) -> Owners:
        """Return every parameter and its owner in words; loads may share one, and so may supports.

        :class:`InputError`, too, where ``loaded_by`` names a parameter that no load has.
        """
        owners = super()._owners()
        of_modes = stiffness_quantities(None, self.stiffness_modes)
        owners |= {q.name: (q, "a mode of stiffness") for q in of_modes}
        add_owners(owners, "load", self.loads)
        add_owners(owners, "support", self.supports)
        of_loads = {quantity.name: quantity for load in self.loads for quantity in load.quantities}
        for load, image in self.loaded_by.items():
            if load not in of_loads:
                known = ", ".join(of_loads) or "none"
                raise InputError(
                    f"loaded_by: '{load}' is no parameter of a load; there are {known}"
                )
            quantity = replace(of_loads[load], name=image)
            owners.setdefault(image, (quantity, f"'{load}' in the image"))
        return owners

    def _check_tissue(self) -> None:
        """Refuse regions, modes and directions that do not fit; keep them as frozen arrays."""
        mesh, tissue = self.mesh, dict[str, np.ndarray]()
        if self.regions is not None:
            tissue["regions"] = checked_regions(self.regions, len(mesh.elements), self.law)
        if self.stiffness_modes is not None:
            modes = checked_modes(self.stiffness_modes, len(mesh.elements), self.law)
            tissue["stiffness_modes"] = modes
        for name, value in tissue.items():
            object.__setattr__(self, name, value)
        self._check_directions(len(mesh.elements), self.point_count, self.loads)

    def _check_dilatation(self) -> None:
        """Refuse an unknown ``dilatation``, or one that the elements do not have."""
        if self.dilatation not in get_args(Dilatation):
            raise InputError(
                f"dilatation '{self.dilatation}'; use pointwise, mean, or patch on linear elements"
            )
        faults = {
            ("mean", 1): "mean dilatation on linear tetrahedra changes nothing, they have "
            "one point each; make the mesh quadratic, or write dilatation 'patch'",
            ("patch", 2): "patch dilatation is for linear tetrahedra; on quadratic ones write "
            "dilatation 'mean'",
        }
        if fault := faults.get((self.dilatation, self.mesh.order)):
            raise InputError(fault)

    def _check_image(self) -> None:
        """Refuse a load in theta without a value in the image, and one for a constant load."""
        loads = self.load_parameters
        for name in loads if self.loaded_by else ():
            if name not in self.loaded_by:
                raise InputError(
                    f"loaded_by says nothing of '{name}'; name the parameter or constant that "
                    "holds its value in the image"
                )
        for name in self.loaded_by:
            if name not in loads:
                raise InputError(
                    f"loaded_by: '{name}' is a constant, so the mesh is loaded by it anyway; "
                    "leave it out, or make it a parameter"
                )
