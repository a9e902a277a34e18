"""A scene on the next finer mesh of its body."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.fibres import across
from emulator.geometry.refinement import Refinement, refined
from emulator.scenes.fibre_rules import FibreRule
from emulator.scenes.scene import Scene

FINER = "finer"
"""The name under which the origin of a scene says that its mesh was refined."""


@dataclass(frozen=True, eq=False)
class Finer:
    """A scene on a finer mesh.

    coarse : the scene on its own mesh.
    scene : the same scene on the finer mesh.
    refinement : the map of fields from the mesh of ``coarse`` to the finer one.
    """

    coarse: Scene
    scene: Scene
    refinement: Refinement


def finer(scene: Scene) -> Finer:
    """Return ``scene`` with quadratic elements for linear ones, or eight for each quadratic one.

    Fibres and sheets are evaluated by the rule that made them, where it is known, else continued
    linearly: most of the error of a coarse mesh may lie in its fibres (docs/experiments.md, "Fibres
    of the finer mesh"). The body stays the coarse mesh's: the gap between its elements and a
    curved surface remains.

    Raises
    ------
    InputError
        A load that is defined on linear elements only.
    """
    refinement = refined(scene.mesh)
    mesh, rule = refinement.mesh, scene.fibre_rule
    rule = rule if rule is not None and _is_made_by(rule, scene) else None
    fibres, sheets = _directions(scene, refinement) if rule is None else rule.directions(mesh)
    angles = rule.angles_in(mesh) if rule is not None and scene.angles else ()
    if len(angles) != len(scene.angles):
        raise InputError(
            f"scene '{scene.name}': fibre angles without the rule that made them have no finer mesh"
        )
    _, fixed, per_unit = scene.prescribed
    displacements: dict[str | None, np.ndarray] = {None: refinement.carry(fixed)}
    displacements |= {name: refinement.carry(u) for name, u in per_unit.items()}

    def inherited(of_elements: np.ndarray | None) -> np.ndarray | None:
        """Give every finer element the data of its parent."""
        return None if of_elements is None else np.repeat(of_elements, refinement.children, axis=0)

    fine = replace(
        scene,
        mesh=mesh,
        fibres=fibres,
        sheets=None if scene.sheets is None else sheets,
        angles=angles,
        # A finer mesh is quadratic, and patches are for linear elements.
        dilatation="mean" if scene.dilatation == "patch" else scene.dilatation,
        regions=inherited(scene.regions),
        stiffness_modes=inherited(scene.stiffness_modes),
        supports=tuple(support.on_finer(mesh, displacements) for support in scene.supports),
        origin={"scene": FINER, "of": dict(scene.origin)} if scene.origin else {},
    )
    return Finer(scene, fine, refinement)


def _directions(scene: Scene, refinement: Refinement) -> tuple[np.ndarray | None, ...]:
    """Return fibres and sheets continued to the finer mesh, None where the scene has none."""
    fibres, sheets = (
        None if directions is None else refinement.directions(directions)
        for directions in (scene.fibres, scene.sheets)
    )
    if fibres is not None and sheets is not None:
        sheets = across(sheets, fibres)
    return fibres, sheets


def _is_made_by(rule: FibreRule, scene: Scene) -> bool:
    """Return whether ``rule`` gives the fibres of ``scene``, which may have been replaced since."""
    if scene.fibres is None:
        return False
    try:
        fibres = rule.directions(scene.mesh)[0]
    except InputError:  # the mesh was replaced and lacks the rule's facet sets
        return False
    return fibres.shape == scene.fibres.shape and np.allclose(fibres, scene.fibres, atol=1e-9)
