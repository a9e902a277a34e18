"""A scene on the next finer mesh of its body: law, loads, supports and parameters stay."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.fibres import across
from emulator.geometry.refinement import Refinement, refined
from emulator.scenes.fibre_angles import FibreAngles
from emulator.scenes.fibre_rules import FibreRule
from emulator.scenes.scene import Scene

FINER = "finer"
"""What the origin of such a scene calls itself."""


@dataclass(frozen=True, eq=False)
class Finer:
    """``scene`` on a finer mesh than ``coarse`` has; ``refinement`` carries fields to it."""

    coarse: Scene
    scene: Scene
    refinement: Refinement


def finer(scene: Scene) -> Finer:
    """``scene`` with quadratic elements for linear ones, or eight quadratic ones for each.

    Fibres and sheets are the rule's that made them, where it is known, else continued linearly:
    what a coarse mesh makes of a rule may be most of its error (docs/experiments.md, "Fibres of the
    finer mesh"). The body is the mesh's own: what its elements miss of a curved surface is not put
    right.

    Raises
    ------
    InputError
        A load that is defined on linear elements only.
    """
    refinement = refined(scene.mesh)
    children = refinement.children
    fibres, sheets = _directions(scene, refinement)
    angles = _angles(scene, refinement) if scene.angles else ()
    moved: dict[str | None, np.ndarray] = {None: refinement.carry(scene.held_displacement)}
    moved |= {n: refinement.carry(per_unit) for n, per_unit in scene.prescribed.per_unit.items()}
    fine = replace(
        scene,
        mesh=refinement.mesh,
        fibres=fibres,
        sheets=sheets,
        angles=angles,
        # A finer mesh is quadratic, and patches are for linear elements.
        dilatation="mean" if scene.dilatation == "patch" else scene.dilatation,
        regions=None if scene.regions is None else np.repeat(scene.regions, children),
        supports=tuple(support.on_finer(refinement.mesh, moved) for support in scene.supports),
        origin={"scene": FINER, "of": dict(scene.origin)} if scene.origin else {},
    )
    return Finer(scene, fine, refinement)


def _directions(scene: Scene, refinement: Refinement) -> tuple[np.ndarray | None, ...]:
    """Fibres and sheets on the finer mesh, None where the scene has none."""
    rule = scene.fibre_rule
    if rule is not None and _made_by(rule, scene):
        made, across_them = rule.directions(refinement.mesh)
        return made, None if scene.sheets is None else across_them
    fibres = None if scene.fibres is None else refinement.directions(scene.fibres)
    sheets = None if scene.sheets is None else refinement.directions(scene.sheets)
    if fibres is not None and sheets is not None:
        sheets = across(sheets, fibres)
    return fibres, sheets


def _angles(scene: Scene, refinement: Refinement) -> tuple[FibreAngles, ...]:
    """Fibre angles on the finer mesh, by the rule that made them."""
    rule = scene.fibre_rule
    angles = rule.angles_in(refinement.mesh) if rule is not None and _made_by(rule, scene) else ()
    if len(angles) != len(scene.angles):
        raise InputError(
            f"scene '{scene.name}': fibre angles without the rule that made them have no finer mesh"
        )
    return angles


def _made_by(rule: FibreRule, scene: Scene) -> bool:
    """Whether the scene's fibres are the rule's: they may have been replaced since."""
    if scene.fibres is None:
        return False
    try:
        made = rule.directions(scene.mesh)[0]
    except InputError:  # another mesh, without the rule's facet sets
        return False
    return made.shape == scene.fibres.shape and np.allclose(made, scene.fibres, atol=1e-9)
