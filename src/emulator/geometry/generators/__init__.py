"""Mesh generators: boxes, spheres, ventricles and an organ, with named node and facet sets."""

from emulator.geometry.generators.biventricle import RightVentricle, biventricle
from emulator.geometry.generators.box import box, cooks_membrane, slab, toward_ends
from emulator.geometry.generators.ellipsoid import (
    HUMAN,
    EllipsoidalWall,
    human_ventricle,
    land_ventricle,
    truncated_ellipsoid,
)
from emulator.geometry.generators.sphere import organ, sphere_octant

__all__ = [
    "HUMAN",
    "EllipsoidalWall",
    "RightVentricle",
    "biventricle",
    "box",
    "cooks_membrane",
    "human_ventricle",
    "land_ventricle",
    "organ",
    "slab",
    "sphere_octant",
    "toward_ends",
    "truncated_ellipsoid",
]
