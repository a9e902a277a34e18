"""Cavities of a scene: facet sets that enclose a volume."""

from __future__ import annotations

from emulator.core.errors import InputError
from emulator.geometry.facets import Cavity, encloses
from emulator.scenes.scene import Scene

ENDOCARDIUM = "endocardium"


def cavity_sets(scene: Scene) -> tuple[str, ...]:
    """Return the facet sets that enclose a volume: sets under pressure, and ``endocardium``."""
    pressed = [load.pressed for load in scene.loads if load.pressed is not None]
    endocardium = [ENDOCARDIUM] if ENDOCARDIUM in scene.mesh.facet_sets else []
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
