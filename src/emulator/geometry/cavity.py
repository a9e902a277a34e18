r"""The volume of a cavity in mL, from the displacement of its wall's own nodes.

The wall is a facet set; a flat lid, a fan of facets from the middle of the rim, closes each of its
openings. By the divergence theorem the closed surface encloses

.. math::
    V = \frac13 \int_\Omega \nabla \cdot x \, dv = \frac13 \oint x \cdot n \, da
      = \sum_\text{facets} \frac16\, x_1 \cdot (x_2 \times x_3),

the last for linear facets; quadratic ones are integrated exactly. A closed surface has
:math:`\oint n\, da = 0`, so the volume does not depend on the origin. The facets are turned to face
out of the tissue whichever way round the set lists them, and the sign is the one that makes the
volume at rest positive; it is fixed there, so that the volume stays differentiable.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.geometry.facets import enclosed_volume
from emulator.scenes.loads.pressure import SurfacePressure

if TYPE_CHECKING:
    from emulator.geometry.mesh import Mesh
    from emulator.scenes.scene import Scene

ENDOCARDIUM = "endocardium"
MM3_PER_ML = 1000.0
_FLAT = 1e-9  # of the mesh's size cubed: round-off of a plane patch, which encloses nothing


class Cavity:
    """Volume of a cavity as a function of its wall's displacement.

    Parameters
    ----------
    scene : with the cavity in its mesh.
    facet_set : its wall; needed where the scene has several cavities (or none by its loads).

    Attributes
    ----------
    nodes : (k,) the nodes of the wall, in the order :meth:`__call__` wants them.
    rest : volume of the undeformed cavity, mL, above 0.

    Raises
    ------
    InputError
        The set is missing or encloses no volume; several cavities and no name.
    """

    def __init__(self, scene: Scene, facet_set: str | None = None) -> None:
        self.facet_set = _only(scene) if facet_set is None else facet_set
        facets = outward(scene.mesh, scene.mesh.facet_set(self.facet_set))
        self.nodes: np.ndarray = np.unique(facets)
        X = scene.mesh.nodes[self.nodes]
        self._X = X - X.mean(axis=0)  # cancels less
        self._volume = enclosed_volume(np.searchsorted(self.nodes, facets))
        with jax.ensure_compile_time_eval():  # a number, also where a trace is going on
            signed = float(self._volume(self._X))
        if abs(signed) <= _FLAT * scene.mesh.size**3:
            raise InputError(
                f"facet set '{self.facet_set}' encloses no volume: it is flat, or has no inside"
            )
        self._factor = float(np.sign(signed)) / MM3_PER_ML

    def __call__(self, displacement: jax.Array) -> jax.Array:
        """Volume (...) in mL where the nodes of the wall move by ``displacement`` (..., k, 3) mm.

        Differentiable; ``displacement[..., cavity.nodes, :]`` restricts a full field.
        """

        def one(u: jax.Array) -> jax.Array:
            return self._factor * self._volume(self._X + u)

        return jnp.vectorize(one, signature="(k,d)->()")(jnp.asarray(displacement))

    @cached_property
    def rest(self) -> float:
        """Volume of the undeformed cavity, mL."""
        with jax.ensure_compile_time_eval():
            return float(self(jnp.zeros(self._X.shape)))


def cavity_sets(scene: Scene) -> tuple[str, ...]:
    """Facet sets of the scene's cavities: those under pressure, and one called ``endocardium``.

    A patch that encloses no volume, such as a plane one, is no cavity.
    """
    pressed = [load.facet_set for load in scene.loads if isinstance(load, SurfacePressure)]
    named = [ENDOCARDIUM] if ENDOCARDIUM in scene.mesh.facet_sets else []
    return tuple(name for name in dict.fromkeys([*pressed, *named]) if _encloses(scene, name))


def _encloses(scene: Scene, facet_set: str) -> bool:
    try:
        Cavity(scene, facet_set)
    except InputError:
        return False
    return True


def _only(scene: Scene) -> str:
    names = cavity_sets(scene)
    if len(names) != 1:
        found = ", ".join(names or sorted(scene.mesh.facet_sets)) or "none"
        raise InputError(
            f"scene '{scene.name}' has {len(names)} cavities; name a facet set: {found}"
        )
    return names[0]


def outward(mesh: Mesh, facets: np.ndarray) -> np.ndarray:
    """``facets`` (k, 3 or 6) with their normals pointing out of the tissue, as on the surface."""
    found = {
        tuple(key): row
        for key, row in zip(np.sort(mesh.surface[:, :3]).tolist(), mesh.surface, strict=True)
    }
    return np.array([found[tuple(key)] for key in np.sort(facets[:, :3]).tolist()])
