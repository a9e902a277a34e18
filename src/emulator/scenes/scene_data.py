"""The description of a scene: all that a user says of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws import Law
from emulator.scenes.fibre_rules import FibreRule
from emulator.scenes.loads.load import Load
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.supports.boundary_condition import BoundaryCondition
from emulator.scenes.tissue import FibreAngles

Dilatation = Literal["pointwise", "mean", "patch"]
"""The part of a body that shares a volume change: a point, an element, or a patch of elements."""


@dataclass(frozen=True, eq=False, repr=False)
class SceneData:
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
        (:mod:`emulator.geometry.patches`).
    sheets : unit sheet directions across the fibres, likewise.
    regions : (m,) whole number of the region each element lies in. Region 3 takes a parameter or a
        constant ``stiffness_3``, by which the law's energy there is multiplied, except its
        volumetric part; see :mod:`emulator.scenes.tissue`.
    fibre_rule : the rule by which the directions of this mesh were made, which gives those of
        another mesh of the body (:mod:`emulator.scenes.finer`).
    angles : parameters that turn fibres and sheets (:mod:`emulator.scenes.tissue`), one
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
