"""A scene on the next finer mesh of its body, or with wider ranges of its parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.fibres import across
from emulator.geometry.refinement import Refinement, refined
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.fibre_rules import FibreRule
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene, with_mesh

FINER = "finer"
"""The name under which the origin of a scene says that its mesh was refined."""
_AT_LIMIT = 0.02  # share of a range within which its end is at a limit
_SHORT_OF = 0.999  # share of the way to a limit that a wider range may go
WIDER = "wider"
"""The name under which the origin of a scene says that the ranges of its parameters are wider."""


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


def wider_within(
    parameter: Parameter, quantity: Quantity, wide: Parameter | None = None
) -> Parameter:
    """Return the parameter with a wider range that keeps off the limits of its values by nature.

    An end near such a limit stays.

    wide : the parameter with the range it would have; by default wider by half on each side.
    """
    wide, near = wide or parameter.wider(), _AT_LIMIT * (parameter.high - parameter.low)
    below, above = parameter.low - quantity.low, quantity.high - parameter.high
    stays = parameter.scale == "uniform" and below < near
    return replace(
        wide,
        low=parameter.low if stays else max(wide.low, parameter.low - _SHORT_OF * below),
        high=parameter.high if above < near else min(wide.high, parameter.high + _SHORT_OF * above),
    )


def wider[P: ForwardProblem](scene: P) -> P:
    """Return ``scene`` with every parameter's range wider by half of it on each side."""
    parameters = tuple(wider_within(p, scene.quantities[p.name]) for p in scene.parameters)
    origin = {"scene": WIDER, "of": dict(scene.origin)} if scene.origin else {}
    return cast(P, replace(cast(Any, scene), parameters=parameters, origin=origin))


CHANGES: Mapping[str, Callable[[ForwardProblem], ForwardProblem]] = {
    FINER: lambda scene: finer(with_mesh(scene)).scene,
    WIDER: wider,
}
"""What ``finer:SCENE`` and ``wider:SCENE`` are."""
