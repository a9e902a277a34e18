r"""Local directions in which strains are measured.

In a ventricle's wall the transmural direction :math:`n` (:mod:`emulator.geometry.fibres`) and the
axis :math:`k` from apex to base, that of the scene's fibre rule or else the normal of the facet set
``base`` or else z, give

.. math:: r = n, \qquad c = k \times n / |k \times n|, \qquad l = n \times c ,

radial (out of the cavity), circumferential and longitudinal (towards the base): the cardiac
coordinates of tagged images. The fibre :math:`f` is the scene's, and the cross-fibre direction
:math:`n \times f / |n \times f|` lies in the wall's tangent plane, across the fibre.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.facets import mean_normal
from emulator.geometry.fibres import circumferential, unit, wall_depth
from emulator.scenes.scene import ENDOCARDIUM, Scene

EPICARDIUM = "epicardium"
BASE = "base"

COMPONENTS = {
    "fibre": "E_fibre",
    "cross_fibre": "E_cross",
    "circumferential": "E_circ",
    "longitudinal": "E_long",
    "radial": "E_rad",
}
"""Directions of the basis, with the name in files of the strain along each."""


def local_directions(scene: Scene, components: Sequence[str]) -> np.ndarray:
    """Return unit vectors (m, q, c, 3) along ``components`` at the quadrature points.

    Raises
    ------
    InputError
        An unknown component or one that is given twice; a fibre direction where the scene has no
        fibres; another direction where it has no wall.
    """
    for name in components:
        if name not in COMPONENTS:
            raise InputError(f"strain along '{name}' is unknown; known: {', '.join(COMPONENTS)}")
        if list(components).count(name) > 1:
            raise InputError(f"strain along '{name}' is observed twice; once is enough")
        if "fibre" in name and scene.fibres is None:
            raise InputError(f"strain along '{name}': scene '{scene.name}' has no fibres")
        if "fibre" in name and scene.angles:
            raise InputError(
                f"strain along '{name}': theta turns the fibres of scene '{scene.name}'; observe "
                "strains along circumferential, longitudinal or radial"
            )
    if not components:
        raise InputError(f"strain: name one component or more of {', '.join(COMPONENTS)}")
    if tuple(components) == ("fibre",):  # fibres are defined without a wall
        return scene.fibres_at_points[:, :, None]
    basis = _basis(scene)
    return np.stack([basis[name] for name in components], axis=2)


def _axis(scene: Scene) -> np.ndarray:
    """Return the unit vector from apex to base, (3,)."""
    mesh = scene.mesh
    if (axis := getattr(scene.fibre_rule, "axis", None)) is not None:
        return unit(np.asarray(axis, dtype=float))
    if BASE in mesh.facet_sets:
        return mean_normal(mesh.nodes[mesh.facet_set(BASE)])
    return np.array([0.0, 0.0, 1.0])


def _basis(scene: Scene) -> dict[str, np.ndarray]:
    """Return all directions that the scene has, (m, q, 3) each."""
    for name in (ENDOCARDIUM, EPICARDIUM):
        if name not in scene.mesh.facet_sets:
            known = ", ".join(sorted(scene.mesh.facet_sets)) or "none"
            raise InputError(
                f"strain in wall directions needs facet sets {ENDOCARDIUM} and {EPICARDIUM}; "
                f"scene '{scene.name}' has {known}"
            )
    normal = wall_depth(scene.mesh, (ENDOCARDIUM,), (EPICARDIUM,)).normal
    n = normal.reshape((*scene.discretisation.weights.shape, 3))
    c = circumferential(n, _axis(scene))
    basis = {"circumferential": c, "longitudinal": np.cross(n, c), "radial": n}
    if scene.fibres is not None:
        across = np.cross(n, scene.fibres_at_points)
        length = np.linalg.norm(across, axis=-1, keepdims=True)
        if not length.min() > 1e-6:
            raise InputError("strain: a fibre runs through the wall; it has no cross-fibre")
        basis |= {"fibre": scene.fibres_at_points, "cross_fibre": across / length}
    return basis
